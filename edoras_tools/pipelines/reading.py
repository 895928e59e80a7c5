"""The read loop: takes a batch, decodes it, selects rows, yields them; until the end, a limit or Ctrl-C.

A failure of the source comes after everything that could be read before it. ``reading`` raises it then, or
keeps it for callers that report on what was read.

Several files are one run or several (``RunCounter``). Rules:

1. Files are one run if they overlap in time, or if each begins at most 2 s after the end of those before it.
2. A file that begins later is another run if a cFS in it and before it restarted in between: the difference
   of capture time and mission time changed. So the parts of one recording are one run.
3. Files that show no common cFS are one run.

Work ends cleanly at Ctrl-C: captured data is written, and counts are shown. ``Keys`` reads single keys.

A signal handler runs in the main thread, between any two of its steps: if that thread holds a lock, a
handler that needs the same lock waits for ever. ``stop`` may take locks (of an ``Event``, of a socket), so
it is called in a thread of its own.

When its terminal is closed, a process gets SIGHUP, and every later write to the terminal fails. Output to
the terminal is then discarded, so that the work can still end normally.
"""

from __future__ import annotations

import _thread
import errno
import json
import os
import select
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from time import monotonic_ns
from typing import TYPE_CHECKING, Any, Final, TypeVar

import msgspec
import numpy as np

from edoras_tools import __version__
from edoras_tools.decode.conversations import LEFT_OUT, Conversations, in_doubt
from edoras_tools.decode.filters.rows import ColumnRows
from edoras_tools.errors import CaptureError, ConfigError, InterruptError
from edoras_tools.io.formats.merge import SEAM_NS
from edoras_tools.io.outputs import ENDING
from edoras_tools.links.protocol import LinkProtocol
from edoras_tools.links.table import LinkStates, among
from edoras_tools.model import OTHER, Columns, Finding, PacketBatch
from edoras_tools.pipelines.selection import Period, Selection, outside
from edoras_tools.units import SECOND
from edoras_tools.wire.arrays import Integers, Mask, by_value
from edoras_tools.words import plural

if TYPE_CHECKING:
    from types import FrameType

    from typing_extensions import Self

    from edoras_tools.decode.context import Context
    from edoras_tools.diagnosis.evidence.copies import Repeats
    from edoras_tools.io import Source
    from edoras_tools.links.doors import OwnRows
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.render.terminal.text import Watcher
    from edoras_tools.sessions.sequence import SequenceCounts

_SHOW_S: Final = 0.1
_SWITCH_S: Final = 0.0002
"""Longest time that another thread may hold the interpreter while a datagram waits."""


_Run = TypeVar("_Run")


@contextmanager
def watched(run: _Run, watcher: Watcher[_Run] | None) -> Iterator[None]:
    """Update a watcher from a thread of its own, because drawing takes milliseconds."""
    if watcher is None:
        yield
        return
    finished = threading.Event()

    def show() -> None:
        while not finished.wait(_SHOW_S):
            watcher.update(run)

    thread = threading.Thread(target=show, name="display", daemon=True)
    thread.start()
    try:
        yield
    finally:
        finished.set()
        thread.join()
        watcher.update(run)


@contextmanager
def threads_take_turns() -> Iterator[None]:
    """Make busy threads switch soon to the one that moves datagrams."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(before)


_HANG_UP = getattr(signal, "SIGHUP", None)


@contextmanager
def on_interrupt(
    stop: Callable[[], None], *, patient: bool = False, in_handler: bool = False
) -> Iterator[threading.Event]:
    """Call ``stop`` at the first Ctrl-C, SIGTERM or SIGHUP; a second Ctrl-C or SIGTERM interrupts at once.

    SIGHUP requests a clean end, however often it comes. So does one SIGTERM after another signal, because
    closing a terminal or ending a process group sends several. A SIGHUP that is ignored, as under ``nohup``,
    stays ignored.

    Args:
        stop: ends the work; called in a thread of its own.
        patient: ignore second signals: a program that another program ends gets Ctrl-C from the terminal and
            SIGTERM from that program.
        in_handler: call ``stop`` inside the handler instead: it must take no lock, and may raise.

    Yields:
        An event that is set once ``stop`` was called. Outside the main thread, signals are not handled.
    """
    interrupted = threading.Event()
    terminated = False
    if threading.current_thread() is not threading.main_thread():
        yield interrupted
        return

    def handle(number: int, _frame: FrameType | None) -> None:
        nonlocal terminated
        if number == _HANG_UP:
            _leave_terminal()
        again, terminated = terminated, terminated or number == signal.SIGTERM
        if interrupted.is_set():
            if patient or not (number == signal.SIGINT or (number == signal.SIGTERM and again)):
                return
            raise KeyboardInterrupt
        interrupted.set()
        if in_handler:
            stop()
        else:
            _thread.start_new_thread(stop, ())

    before = {
        number: signal.signal(number, handle)
        for number in ENDING
        if number != _HANG_UP or signal.getsignal(number) is not signal.SIG_IGN
    }
    try:
        yield interrupted
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _leave_terminal() -> None:
    """Redirect output to a closed terminal to the null device."""
    import termios

    for fileno in (1, 2):
        try:
            termios.tcgetattr(fileno)
        except termios.error as error:
            if error.args[0] == errno.EIO:
                os.dup2(os.open(os.devnull, os.O_WRONLY), fileno)


def interrupted(source: Source) -> InterruptError:
    """Return the error that a file or pipe ends with after Ctrl-C."""
    return InterruptError(f"{source.info.name}: interrupted; everything before was read")


@contextmanager
def interruptible(
    source: Source, *, patient: bool = False
) -> Iterator[tuple[Iterator[PacketBatch], threading.Event]]:
    """Let Ctrl-C end the batches of a source: a live one after all that has arrived, a file or pipe at once.

    Args:
        patient: see ``on_interrupt``.

    Yields:
        The batches, and an event that is set once they were interrupted. Those of a file or pipe then end
        with an ``InterruptError``.
    """
    live, waiting = source.live, False

    def interrupt() -> None:
        # Interrupt only the wait for the next batch, never the work on one.
        if waiting:
            raise KeyboardInterrupt

    def batches() -> Iterator[PacketBatch]:
        nonlocal waiting
        batches_of = source.batches()
        while not stop_event.is_set():
            waiting = True
            try:
                batch = next(batches_of, None)
            except KeyboardInterrupt:
                if stop_event.is_set():
                    break
                raise
            finally:
                waiting = False
            if batch is None:
                return
            yield batch
        raise interrupted(source)

    with on_interrupt(source.stop if live else interrupt, patient=patient, in_handler=not live) as stop_event:
        yield source.batches() if live else batches(), stop_event


class Keys:
    """Standard input as a keyboard: a context manager that restores the terminal's mode."""

    def __init__(self) -> None:
        self._fileno = sys.stdin.fileno()
        self._before: list[Any] | None = None
        self._ended = False

    def __enter__(self) -> Self:
        if os.isatty(self._fileno):
            import termios
            import tty

            self._before = termios.tcgetattr(self._fileno)
            tty.setcbreak(self._fileno)
        return self

    def __exit__(self, *_: object) -> None:
        if self._before is not None:
            import termios

            termios.tcsetattr(self._fileno, termios.TCSADRAIN, self._before)

    def fileno(self) -> int:
        """Return the descriptor, which becomes readable when a key is pressed."""
        return self._fileno

    def pressed(self) -> str:
        """Return the keys pressed since the last call; always ``q`` once the input has ended."""
        with suppress(OSError, ValueError):
            while not self._ended and select.select((self._fileno,), (), (), 0)[0]:
                keys = os.read(self._fileno, 64).decode(errors="replace")
                self._ended = not keys
                if keys:
                    return keys.lower()
        return "q" if self._ended else ""


_ENDING_NS: Final = SECOND // 4
"""Time after Ctrl-C in which arrived packets are still shown; the rest is only counted."""
_NEVER_NS: Final = 1 << 63
_DOORS: Final = "rows", "unwrapper", "follow"
"""Methods of a link that join, unpack, or count the contents of several datagrams."""
_NO_CLOCK_NS: Final = 946_684_800 * SECOND
"""The year 2000: an earlier time shows that the clock was not set."""


class Limits(msgspec.Struct, frozen=True):
    """The part of a source that is read.

    Attributes:
        count: maximum number of selected datagrams; 0 for all.
        duration_ns: reading time; 0: to the end. A live source still yields all that arrived in this time.
        clock: function that returns monotonic time, ns.
        period: period of the datagrams that are yielded; all are decoded.
    """

    count: int = 0
    duration_ns: int = 0
    clock: Callable[[], int] = monotonic_ns
    period: Period = msgspec.field(default_factory=Period)


@dataclass(slots=True, eq=False)
class ReadLoop:
    """A source that is being read; can be iterated once.

    Attributes:
        source: source of the datagrams.
        bench: mission, types and decoders.
        selection: selection of datagrams, already prepared for the bench.
        limits: conditions of the end.
        examined: period outside which datagrams are not decoded; only announcements there are learnt.
        keeps_failure: keep the error that ended the source in ``failure``, instead of raising it.
        conversations: conversations of all traffic if they are followed, else of traffic on ports of no
            link; a batch is added before it is yielded.
        failure: error that ended the source early, if any.
        begin_ns: time of the first datagram; None before it.
        first_ns: earliest time of any datagram, also outside ``examined``; None before the first.
        last_ns: latest time of any datagram, also outside ``examined``; -1 before the first.
        outside: number of datagrams outside ``examined``.
        part: number of the run, or of the clock, of the last batch: no state continues from one to the next.
    """

    source: Source
    bench: Workbench
    selection: Selection
    limits: Limits
    examined: Period
    keeps_failure: bool
    conversations: Conversations
    _conversing: bool
    _batches: Iterator[PacketBatch]
    _interrupt: threading.Event
    failure: CaptureError | None = None
    begin_ns: int | None = None
    first_ns: int | None = None
    last_ns: int = -1
    outside: int = 0
    part: int = 0
    _ends_ns: int = 0
    _own_rows: LinkStates[OwnRows] = field(init=False)
    _runs: RunCounter | None = field(init=False)

    def __post_init__(self) -> None:
        context = self.bench.columns.context
        self._own_rows = LinkStates(lambda link: link.rows(context))
        self._runs = RunCounter(self.source) if self.source.files else None

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C, SIGTERM or SIGHUP has come."""
        return self._interrupt.is_set()

    def note(self) -> None:
        """Add notes on the conversations of shown datagrams to the context."""
        context = self.bench.columns.context
        context.notes += self.conversations.notes(keep_all=True)
        context.unnamed = self.conversations.unnamed

    def stops_early(self, at_hand: int) -> bool:
        """Return whether to stop showing packets after Ctrl-C, because the rest takes long; note it then.

        Args:
            at_hand: number of rows that are read and not yet shown.

        Raises:
            InterruptError: Ctrl-C came, and the source is a file or pipe.
        """
        if not self.interrupted:
            return False
        if not self.source.live:
            raise interrupted(self.source)
        now = self.limits.clock()
        self._ends_ns = self._ends_ns or now + _ENDING_NS
        if now < self._ends_ns:
            return False
        count = plural(at_hand + self.source.discard(), "packet")
        self.bench.columns.context.notes.append(f"not shown: {count} that had arrived before Ctrl-C")
        return True

    def __iter__(self) -> Iterator[ColumnRows]:
        """Yield the selected rows of every batch, even if there are none: live sources give empty batches.

        Raises:
            CaptureError: the source ended early, and ``keeps_failure`` is not set.
            CaptureError: no datagram of a file is in the chosen time.
        """
        limits, bench = self.limits, self.bench
        remaining, began = limits.count, limits.clock()
        examined = visible = Period()
        inside = False
        for whole in self._until_failure():
            if len(whole):
                if self.begin_ns is None:
                    self.begin_ns = int(whole.time_ns[0])
                    examined, visible = self.examined.since(self.begin_ns), limits.period.since(self.begin_ns)
                earliest, latest = int(whole.time_ns.min()), int(whole.time_ns.max())
                self.first_ns = earliest if self.first_ns is None else min(self.first_ns, earliest)
                self.last_ns = max(self.last_ns, latest)
            begin_ns = self.begin_ns or 0
            batch = whole
            if examined:
                batch = whole.take(examined.holds(whole.time_ns - begin_ns))
                self.outside += len(whole) - len(batch)
                bench.columns.learn(whole)  # announcements before the period name the topics in it
            columns = self.source.decoded(batch, bench.columns.decode)
            for own in self._own_rows.of(columns):
                batch, columns = own.take(batch, columns, bench.columns.decode)
            in_time = visible.holds(batch.time_ns - begin_ns) if visible else None
            self._follow(batch, columns, in_time)
            rows = self.selection.rows(batch, columns)
            inside = inside or bool(len(batch) if in_time is None else in_time.any())
            rows = rows if in_time is None else rows[in_time[rows]]
            if limits.count:
                rows = rows[:remaining]
                remaining -= len(rows)
            yield ColumnRows(bench.columns.context, begin_ns, batch, columns, rows)
            if limits.count and not remaining:
                return
            if limits.duration_ns and limits.clock() - began >= limits.duration_ns:
                if not self.source.live:
                    return
                self.source.stop()  # packets that have arrived are still read
        for own in self._own_rows.by_link.values():
            bench.columns.context.notes += own.notes()
        if self.first_ns is not None and self.first_ns < _NO_CLOCK_NS <= self.last_ns:
            self.bench.columns.context.notes.append(
                "some times are before the year 2000 and others are not: a clock was not set, and spans and "
                "rates over both are wrong; choose one of them with --start and --end"
            )
        if self.begin_ns is not None and not (inside or self.interrupted or self.source.live):
            raise outside(self.source.info.name, self.begin_ns, self.last_ns)

    def _follow(self, batch: PacketBatch, columns: Columns, in_time: Mask | None) -> None:
        """Follow the runs of a batch, and the conversations in the requested time."""
        if self._runs:
            self.part = self._runs.add(batch, columns)
        if batch.recorded is not None:
            return
        if self._conversing:
            self.conversations.add(batch, columns, in_time)
            return
        others = columns.link == OTHER
        if others.any():
            self.conversations.add(batch, columns, others if in_time is None else others & in_time)

    def _until_failure(self) -> Iterator[PacketBatch]:
        try:
            batches = self._batches
            for unwrapper in self.bench.unwrappers.values():
                batches = map(unwrapper.take, batches)
            try:
                yield from batches
            finally:
                for unwrapper in self.bench.unwrappers.values():
                    self.bench.columns.context.notes += unwrapper.notes()
                if self._runs:
                    self.bench.columns.context.notes += self._runs.notes()
        except CaptureError as error:
            if not self.keeps_failure:
                raise
            self.failure = error


@contextmanager
def reading(  # noqa: PLR0913  see its arguments
    source: Source,
    bench: Workbench,
    selection: Selection | None = None,
    limits: Limits = Limits(),  # noqa: B008  frozen
    *,
    examined: Period = Period(),  # noqa: B008  frozen
    keeps_failure: bool = False,
    conversing: bool = False,
    patient: bool = False,
    selected: bool = False,
) -> Iterator[ReadLoop]:
    """Read a source: iterate over the loop that this yields. The source is closed at the end.

    Ctrl-C and SIGTERM end the loop: for a live source after all that has arrived, for a file or pipe at once,
    with an ``InterruptError``.
    Outside the main thread, signals are not handled.

    Args:
        selection: selected datagrams; all by default.
        limits: conditions of the end; never by default.
        examined: see ``ReadLoop``.
        keeps_failure: see ``ReadLoop``.
        conversing: follow conversations; see ``ReadLoop``.
        patient: see ``on_interrupt``.
        selected: whether the caller uses only the selected rows, so that others need not be read.

    Raises:
        RouteError: the selection names a topic that is not configured.
        ConfigError: its filter has an error.
    """
    with closing(source):
        ready = (selection or Selection()).over(bench)
        source.follow(bench.columns.context.framings)
        if period := examined or limits.period:
            if not _keeps(source, bench, *_DOORS):
                source.narrow(partial(_span, period))
        elif (
            selected
            and reads_by_heads(source, bench)
            and not (conversing and _talks(source, limits))
            and (choice := ready.by_heads(bench.mission))
        ):
            bench.columns.settle()
            source.choose(choice)
        with interruptible(source, patient=patient) as (batches, interrupt):
            spoken = Conversations(bench.columns.context)
            yield ReadLoop(
                source, bench, ready, limits, examined, keeps_failure, spoken, conversing, batches, interrupt
            )


def _keeps(source: Source, bench: Workbench, *doors: str) -> bool:
    """Return whether a link of the source may keep state between datagrams: it overrides one of some methods.

    Such a link needs the datagrams before a period. True also if the source does not state its links.
    """
    labels, context = source.info.links, bench.columns.context
    if labels is None or bench.unwrappers:
        return True
    inside = context.in_packets if len(context.pdu_msg_ids) else ()
    links = [link for link in context.links if link.label in labels or link in inside]
    return any(
        getattr(type(link), door) is not getattr(LinkProtocol, door) for link in links for door in doors
    )


def _talks(source: Source, limits: Limits) -> bool:
    """Return whether notes on conversations may differ if only a part of the datagrams is read.

    Traffic of no link is read whole, but a count of datagrams then ends it at another datagram.
    """
    info = source.info
    return not info.sound or bool(limits.count and OTHER.label in (info.links or ()))


def reads_by_heads(source: Source, bench: Workbench) -> bool:
    """Return whether datagrams can be read one by one, with the result that the recorder had."""
    info, context = source.info, bench.columns.context
    same = bench.mission.files == info.attachments and context.described == info.read_with
    return info.apart and same and not _keeps(source, bench, *_DOORS, "topics")


class Independence:
    """Finds out whether the datagrams of a recording can be read independently of each other.

    Args:
        context: context of the decoder.
        sequences: sequence counts of everything that is recorded; None if they are not followed.
        repeats: finds datagrams that may have been captured twice; None if the recording is not counted.

    Attributes:
        counts: answer of ``info`` to this recording, once everything in it is counted; None before.
    """

    def __init__(
        self, context: Context, sequences: SequenceCounts | None = None, repeats: Repeats | None = None
    ) -> None:
        self._context, self._usual = context, context.detected
        self._suspects = Conversations(context)
        self._apart = True
        self._sequences, self._repeats = sequences, repeats
        self.counts: dict[str, Any] | None = None

    def add(self, batch: PacketBatch, columns: Columns) -> None:
        """Add a batch; batches come in order."""
        fragments = (columns.findings & np.uint32(Finding.FRAGMENT)).any()
        several = self._context.spacecraft.several
        self._apart = self._apart and batch.streams is None and not (fragments or several)
        if self._apart and (doubt := in_doubt(batch, columns, self._context)).any():
            self._suspects.add(batch, columns, doubt)
        if self._apart and self._repeats and self._sequences and not self._repeats.possible:
            # In a stream whose counts only rise, a datagram captured twice would show as a repeated count.
            streams = self._sequences.follow(batch, columns).stream
            goes_on = np.array([*(item.goes_on for item in self._sequences.streams), False])
            self._repeats.add(batch, np.flatnonzero(~goes_on[streams] & (columns.link != OTHER)))

    def metadata(self) -> dict[str, str]:
        """Return the recording's metadata; empty if datagrams depend on each other, or the build is unusual.

        ``apart`` is the version that found this; ``sound`` says that no conversation would be left out.
        """
        if not self._apart or self._context.detected != self._usual:
            return {}
        # Other datagrams could only make a conversation look sounder.
        left_out = any(flow.kind in LEFT_OUT for flow in self._suspects.judge())
        return {"apart": __version__, "sound": json.dumps(not left_out)}

    def answers(self) -> str:
        """Return ``counts`` as JSON; empty if a reader of the recording might count differently."""
        always = all(flow.always_sound for flow in self._suspects.flows.values() if flow.link.packets)
        alone = self._repeats is not None and not self._repeats.possible
        sure = alone and always and self.metadata().get("sound") == "true"
        return json.dumps(self.counts) if sure and self.counts is not None else ""


def _span(period: Period, begin_ns: int) -> tuple[int, int]:
    """Return the first time of a period, and the one after its last; all of the time if it has none."""
    try:
        part = period.since(begin_ns)
    except ConfigError:  # it is raised again for the first batch
        return begin_ns, begin_ns
    return (
        begin_ns + part.start_ns if part.start_ns else 0,
        begin_ns + part.end_ns if part.end_ns else _NEVER_NS,
    )


def selected_rows(
    source: Source,
    bench: Workbench,
    selection: Selection,
    limits: Limits = Limits(),  # noqa: B008  frozen
    started: Callable[[int], None] = lambda _: None,
    *,
    most: int = 0,
) -> Iterator[ColumnRows]:
    """Yield the selected rows of every batch that has any; the source is closed at the end.

    Args:
        limits: conditions of the end; never by default.
        started: called before each batch with the time of the source's first datagram, ns since 1970.
        most: rows at once, so that Ctrl-C ends slow work soon; 0: all of a batch.

    Raises:
        CaptureError: the source ended early; everything before was yielded.
        RouteError: the selection names a topic that is not configured.
        ConfigError: its filter has an error.
    """
    with reading(source, bench, selection, limits, conversing=True, selected=True) as loop:
        try:
            for rows in loop:
                started(rows.begin_ns)
                for first in range(0, max(len(rows), 1), most or max(len(rows), 1)):
                    if loop.stops_early(len(rows) - first):
                        return
                    if len(rows):
                        yield rows.take(np.arange(first, min(first + most, len(rows)))) if most else rows
        finally:
            loop.note()


APART_NS: Final = 5 * SECOND
"""Least difference between two boots; clocks of hosts differ by less."""
_NOTE: Final = (
    "{} runs: between their files cFS was started anew and nothing was captured; each is counted and judged "
    "by itself, and rates leave out the time between"
)


class RunCounter:
    """Counts the runs of several files while they are read."""

    def __init__(self, source: Source) -> None:
        self._source, self._clock = source, source.part
        self._section = self._last_ns = self._part = self._restarts = 0
        self._seam = False
        self._boots: dict[int, Integers] = {}

    def add(self, batch: PacketBatch, columns: Columns) -> int:
        """Add the source's last batch; return the number of its run, or of its clock, from 0."""
        if not len(batch):
            return self._part
        if self._source.section != self._section:
            self._section = self._source.section
            self._seam = int(batch.time_ns.min()) - self._last_ns > SEAM_NS
        self._last_ns = max(self._last_ns, int(batch.time_ns.max()))
        boots = _boots(batch, columns)
        pairs = [(offsets, self._boots[key]) for key, offsets in boots.items() if key in self._boots]
        same = any((np.abs(new[:, None] - old) < APART_NS).any() for new, old in pairs)
        begins = self._seam and bool(pairs) and not same
        self._seam = self._seam and not pairs
        self._boots |= boots
        self._restarts += begins
        self._part += begins or self._source.part != self._clock
        self._clock = self._source.part
        return self._part

    def notes(self) -> list[str]:
        """Return one line that there are several runs; empty for one run."""
        return [_NOTE.format(self._restarts + 1)] if self._restarts else []


def _boots(batch: PacketBatch, columns: Columns) -> dict[int, Integers]:
    """Return capture time minus mission time of packets with a time, rounded down to s, in ns, by sender."""
    sent = among(columns.link, lambda link: link.from_cfs and link.packets)
    rows = np.flatnonzero(sent & (columns.mission_time_ns > 0))
    offset = batch.time_ns[rows] - columns.mission_time_ns[rows]
    sender = batch.source_address[rows].astype(np.int64) << 20 ^ columns.processor_id[rows].astype(np.int64)
    return {key: np.unique(offset[at] // SECOND) * SECOND for key, at in by_value(sender)}
