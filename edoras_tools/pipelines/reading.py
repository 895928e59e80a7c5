"""The read loop: takes a batch, decodes it, selects rows, yields them; until the end, a limit or Ctrl-C.

A failure of the source comes after everything that could be read before it. ``reading`` raises it then, or
keeps it for callers that report on what was read.
"""

from __future__ import annotations

from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import partial
from time import monotonic_ns
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.decode.conversations import Conversations
from edoras_tools.decode.filters.rows import ColumnRows
from edoras_tools.errors import CaptureError, ConfigError
from edoras_tools.links.table import LinkStates
from edoras_tools.model import OTHER, Columns, PacketBatch
from edoras_tools.pipelines.interrupt import interrupted, interruptible
from edoras_tools.pipelines.selection import Period, Selection, outside
from edoras_tools.units import SECOND
from edoras_tools.words import plural

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from edoras_tools.io import Source
    from edoras_tools.links.doors import OwnRows
    from edoras_tools.pipelines.workbench import Workbench


_ENDING_NS: Final = SECOND // 4
"""After Ctrl-C, what has arrived is shown for so long; the rest is counted."""
_NEVER_NS: Final = 1 << 63
_NO_CLOCK_NS: Final = 946_684_800 * SECOND
"""The year 2000: a machine whose clock shows less has not set it."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Which part of a source is read.

    Attributes:
        count: maximum number of selected datagrams; 0 for all.
        duration_ns: how long to read; 0: to the end. Of a live source all that arrives in this time is read.
        clock: monotonic time in ns.
        period: which datagrams are yielded; all are decoded.
    """

    count: int = 0
    duration_ns: int = 0
    clock: Callable[[], int] = monotonic_ns
    period: Period = field(default_factory=Period)


@dataclass(slots=True, eq=False)
class ReadLoop:
    """A source that is being read; can be iterated once.

    Attributes:
        source: where datagrams come from.
        bench: mission, types and decoders.
        selection: which datagrams; already prepared for the bench.
        limits: when to end.
        examined: datagrams outside this period are not decoded; only what is announced there is learnt.
        keeps_failure: keep the error that ended the source in ``failure``, instead of raising it.
        conversations: of all that was read, if they are followed, else of what is on ports of no link; a
            batch is added before it is yielded.
        failure: why the source ended early, if it did.
        begin_ns: time of the first datagram; None before it.
        first_ns: earliest time of a datagram, also of one outside; None before.
        last_ns: latest time of a datagram, also of one outside; -1 before.
        outside: number of datagrams outside ``examined``.
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
    _ends_ns: int = 0
    _own_rows: LinkStates[OwnRows] = field(init=False)

    def __post_init__(self) -> None:
        context = self.bench.columns.context
        self._own_rows = LinkStates(lambda link: link.rows(context))

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C, SIGTERM or SIGHUP has come."""
        return self._interrupt.is_set()

    def note(self) -> None:
        """Add to the context's notes what conversations say of datagrams that are shown."""
        context = self.bench.columns.context
        context.notes += self.conversations.notes(keep_all=True)
        context.unnamed = self.conversations.unnamed

    def gives_up(self, at_hand: int) -> bool:
        """Return whether to show no more: after Ctrl-C, where that would take long; a note then says so.

        Args:
            at_hand: rows at hand that are not shown yet.

        Raises:
            InterruptError: after Ctrl-C, of a file or pipe.
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
                bench.columns.learn(whole)  # what is announced before the period names what is in it
            columns = self.source.decoded(batch, bench.columns.decode)
            for own in self._own_rows.of(columns):
                batch, columns = own.take(batch, columns, bench.columns.decode)
            shown = visible.holds(batch.time_ns - begin_ns) if visible else None
            self._follow(batch, columns, shown)
            rows = self.selection.rows(batch, columns)
            inside = inside or bool(len(batch) if shown is None else shown.any())
            rows = rows if shown is None else rows[shown[rows]]
            if limits.count:
                rows = rows[:remaining]
                remaining -= len(rows)
            yield ColumnRows(bench.columns.context, begin_ns, batch, columns, rows)
            if limits.count and not remaining:
                return
            if limits.duration_ns and limits.clock() - began >= limits.duration_ns:
                if not self.source.live:
                    return
                self.source.stop()  # what arrived until now is still read
        for own in self._own_rows.by_link.values():
            bench.columns.context.notes += own.notes()
        if self.first_ns is not None and self.first_ns < _NO_CLOCK_NS <= self.last_ns:
            self.bench.columns.context.notes.append(
                "some times are before the year 2000 and others are not: a clock was not set, and spans and "
                "rates over both are wrong; choose one of them with --start and --end"
            )
        if self.begin_ns is not None and not (inside or self.interrupted or self.source.live):
            raise outside(self.source.info.name, self.begin_ns, self.last_ns)

    def _follow(self, batch: PacketBatch, columns: Columns, shown: NDArray[np.bool_] | None) -> None:
        """Follow the conversations of the time that is asked for."""
        if batch.recorded is not None:
            return
        if self._conversing:
            self.conversations.add(batch, columns, shown)
            return
        others = columns.link == OTHER
        if others.any():
            self.conversations.add(batch, columns, others if shown is None else others & shown)

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
        except CaptureError as error:
            if not self.keeps_failure:
                raise
            self.failure = error


@contextmanager
def reading(
    source: Source,
    bench: Workbench,
    selection: Selection | None = None,
    limits: Limits = Limits(),
    *,
    examined: Period = Period(),  # noqa: B008  frozen
    keeps_failure: bool = False,
    conversing: bool = False,
    patient: bool = False,
) -> Iterator[ReadLoop]:
    """Read a source: iterate over the loop that this yields. The source is closed at the end.

    Ctrl-C and SIGTERM end the loop: for a live source after all that has arrived, for a file or pipe at once,
    with an ``InterruptError``.
    Outside the main thread, signals are not handled.

    Args:
        selection: which datagrams; all by default.
        limits: when to end; never by default.
        examined: see ``ReadLoop``.
        keeps_failure: see ``ReadLoop``.
        conversing: follow conversations; see ``ReadLoop``.
        patient: see ``on_interrupt``.

    Raises:
        RouteError: the selection names a topic that is not configured.
        ConfigError: its filter has an error.
    """
    with closing(source):
        ready = (selection or Selection()).over(bench)
        source.follow(bench.columns.context.framings)
        if (period := examined or limits.period) and _stands_alone(source, bench):
            source.narrow(partial(_span, period))
        with interruptible(source, patient=patient) as (batches, interrupt):
            spoken = Conversations(bench.columns.context)
            yield ReadLoop(
                source, bench, ready, limits, examined, keeps_failure, spoken, conversing, batches, interrupt
            )


def _stands_alone(source: Source, bench: Workbench) -> bool:
    """Return whether a period needs nothing of before: no link of the recording remembers anything."""
    labels, context = source.info.links, bench.columns.context
    if labels is None or bench.unwrappers:
        return False
    links = [link for link in context.links if link.label in labels]
    return all(door(context) is None for link in links for door in (link.rows, link.unwrapper, link.follow))


def _span(period: Period, begin_ns: int) -> tuple[int, int]:
    """Return the first time of a period, and the one after its last; all of the time if it has none."""
    try:
        chosen = period.since(begin_ns)
    except ConfigError:  # raised again, where the first batch is looked at
        return begin_ns, begin_ns
    return (
        begin_ns + chosen.start_ns if chosen.start_ns else 0,
        begin_ns + chosen.end_ns if chosen.end_ns else _NEVER_NS,
    )


def selected_rows(
    source: Source,
    bench: Workbench,
    selection: Selection,
    limits: Limits = Limits(),
    started: Callable[[int], None] = lambda _: None,
    *,
    most: int = 0,
) -> Iterator[ColumnRows]:
    """Yield the selected rows of every batch that has any; the source is closed at the end.

    Args:
        limits: when to end; never by default.
        started: called before each batch with the time of the source's first datagram, ns since 1970.
        most: rows at once, so that Ctrl-C ends slow work soon; 0: all of a batch.

    Raises:
        CaptureError: the source ended early; everything before was yielded.
        RouteError: the selection names a topic that is not configured.
        ConfigError: its filter has an error.
    """
    with reading(source, bench, selection, limits, conversing=True) as loop:
        try:
            for rows in loop:
                started(rows.begin_ns)
                for first in range(0, max(len(rows), 1), most or max(len(rows), 1)):
                    if loop.gives_up(len(rows) - first):
                        return
                    if len(rows):
                        yield rows.take(np.arange(first, min(first + most, len(rows)))) if most else rows
        finally:
            loop.note()
