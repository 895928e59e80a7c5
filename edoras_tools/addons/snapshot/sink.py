"""Keeps the last seconds of a source in memory; when a trigger fires, writes them and what follows to a file.

Rules that this file keeps:

1. Batches are kept by reference, with the columns that the read loop decoded anyway; nothing is written, and
   nothing else is decoded, before a trigger fires.
2. A trigger at time t requests the datagrams from t - before to t + after. A trigger before the end of an
   earlier one extends that one; any other gets a file of its own, with all of its time before.
3. Kept datagrams are written a little at a time, between two batches, so that a live source is read in time.
4. Kept datagrams use at most a given size. Beyond it, the oldest are dropped first, which is counted and
   reported; those that a trigger requested are written at once instead.
5. At the end, also at Ctrl-C, all requested datagrams that have arrived are written.

Triggers other than datagrams: a signal, a key, a datagram on a socket, a doctor's rule.
"""

from __future__ import annotations

import os
import signal
import socket
import stat
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import reduce
from operator import or_
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.decode.filters.filter import Where
from edoras_tools.diagnosis.case import Capture
from edoras_tools.diagnosis.examination import Examination
from edoras_tools.diagnosis.verdict import Severity
from edoras_tools.errors import CaptureError, ConfigError, os_errors
from edoras_tools.io import Sink, Source
from edoras_tools.io.formats.watched import Keep, OutputLoss, WatchedSink
from edoras_tools.io.outputs import path_beside
from edoras_tools.model import Columns, Finding, PacketBatch, SourceStatistics
from edoras_tools.pipelines.capture.record import ROW_BYTES, CaptureReport, Target, compact, open_sink, pour
from edoras_tools.pipelines.reading import Keys, Limits, reading
from edoras_tools.render.severity import NOTABLE
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.words import plural

if TYPE_CHECKING:
    from pathlib import Path

    from edoras_tools.cli.record import SnapshotOptions
    from edoras_tools.decode.context import Context
    from edoras_tools.pipelines.selection import Selection
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.render.terminal.text import Watcher

_SIGNAL: Final = getattr(signal, "SIGUSR1", None)
_MOST_BYTES: Final = 256
_ANSWER_S: Final = 5.0
_JUDGE_NS: Final = SECOND
"""Least time between two examinations by the doctor."""
_JUDGE_TIMES: Final = 5
"""Least pause after an examination, as a multiple of its duration."""
_JUDGE_ROWS: Final = 200_000
"""Most datagrams that the doctor examines, from the newest on; of at least one batch."""


class Triggers:
    """Triggers of this machine; none by default.

    Args:
        keys: the keyboard: ``t`` and Enter fire.
        listener: a bound socket, on which every datagram fires.
    """

    def __init__(self, keys: Keys | None = None, listener: socket.socket | None = None) -> None:
        self._keys, self._listener = keys, listener
        self._signals: list[str] = []
        self._senders: list[str] = []

    def signalled(self, *_: object) -> None:
        """Fire; for a signal handler."""
        self._signals.append("signal USR1")

    def fired(self) -> list[str]:
        """Return the reasons for snapshots since the last call."""
        reasons, self._signals = self._signals, []
        if self._keys is not None and set(self._keys.pressed()) & set("t\r\n"):
            reasons.append("a key")
        while self._listener is not None:
            try:
                text, sender = self._listener.recvfrom(_MOST_BYTES)
            except OSError:
                break
            words = " ".join(text.decode(errors="replace").split())
            reasons.append(f"asked for: {words}" if words else "asked for on the socket")
            if sender:
                self._senders.append(sender)
        return reasons

    def answer(self, text: str) -> None:
        """Answer the programs that asked on the socket."""
        senders, self._senders = self._senders, []
        for sender in senders:
            with suppress(OSError):
                assert self._listener is not None, "it was asked there"
                self._listener.sendto(text.encode(), sender)


@contextmanager
def listening(keys: Keys | None = None, path: Path | None = None) -> Iterator[Triggers]:
    """Open the triggers of this machine: SIGUSR1, and keys and a socket if they are given.

    Args:
        path: path of a Unix socket to create, for this user alone; it is removed at the end.

    Raises:
        CaptureError: the socket cannot be created, or another program has it.
    """
    listener = _bound(path) if path is not None else None
    triggers = Triggers(keys, listener)
    handled = _SIGNAL is not None and threading.current_thread() is threading.main_thread()
    before = signal.signal(_SIGNAL, triggers.signalled) if handled and _SIGNAL is not None else None
    try:
        yield triggers
    finally:
        if handled and _SIGNAL is not None:
            signal.signal(_SIGNAL, before)
        if listener is not None and path is not None:
            listener.close()
            path.unlink(missing_ok=True)


def ask(path: Path, text: str = "") -> str:
    """Ask the recorder that listens on a socket for a snapshot; return its answer.

    Raises:
        CaptureError: no recorder listens there, or none answers.
    """
    with _unix() as asking:
        asking.settimeout(_ANSWER_S)
        try:
            asking.bind("")  # the system chooses a name for the answer
            asking.connect(str(path))
            asking.send(text.encode()[:_MOST_BYTES])
            return asking.recv(4096).decode(errors="replace")
        except TimeoutError:
            raise CaptureError(f"{path}: the recorder did not answer within {_ANSWER_S:g} s") from None
        except OSError as error:
            raise CaptureError(
                f"{path}: no recorder listens there ({error.strerror}); start one with record --snapshot "
                f"--socket {path}"
            ) from error


def _unix() -> socket.socket:
    if not hasattr(socket, "AF_UNIX"):
        raise ConfigError("--socket and --fire need Unix sockets, which this system does not have")
    return socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)


def _bound(path: Path) -> socket.socket:
    if path.exists() and _answers(path):
        raise CaptureError(f"{path}: another recorder listens there; name another socket")
    listener = _unix()
    try:
        if path.exists() and stat.S_ISSOCK(path.lstat().st_mode):
            path.unlink()  # left by a recorder that was killed
        before = os.umask(0o177)
        try:
            listener.bind(str(path))
        finally:
            os.umask(before)
    except OSError as error:
        listener.close()
        raise CaptureError(f"{path}: cannot listen there: {error.strerror or error}") from error
    listener.setblocking(False)
    return listener


def _answers(path: Path) -> bool:
    with _unix() as peer, suppress(OSError):
        peer.connect(str(path))
        return True
    return False


class RuleTrigger:
    """Fires when the doctor finds something new in the newest datagrams.

    Args:
        rules: the rules whose verdicts fire.
        any_error: whether any verdict that is an error fires.
        apart: whether to judge in a thread, so that a live source is read on.
    """

    def __init__(self, context: Context, rules: frozenset[str], *, any_error: bool, apart: bool) -> None:
        self._context, self._rules, self._any = context, rules, any_error
        self._apart = apart
        self._thread: threading.Thread | None = None
        self._due_ns = 0
        self._judged_ns = 0
        self._known: set[tuple[str, str | None, int | None]] = set()
        self._found: deque[tuple[int, str]] = deque()

    def new_hits(self) -> list[tuple[int, str]]:
        """Return the triggers since the last call: time and reason."""
        return [self._found.popleft() for _ in range(len(self._found))]

    def look(self, batches: Iterable[tuple[PacketBatch, Columns]], newest_ns: int) -> None:
        """Start to judge the kept batches, if it is time.

        Args:
            batches: batches, the oldest first.
            newest_ns: time of the newest datagram, which new verdicts get as their time.
        """
        if not (self._rules or self._any) or (self._thread and self._thread.is_alive()):
            return
        now = time.monotonic_ns() if self._apart else newest_ns
        if now < self._due_ns or newest_ns == self._judged_ns:
            return
        waiting: list[tuple[PacketBatch, Columns]] = []
        rows = 0
        for batch, columns in reversed(list(batches)):
            rows += len(batch)
            if waiting and rows > _JUDGE_ROWS:
                break
            waiting.append((batch, columns))
        self._judged_ns, self._due_ns = newest_ns, now + _JUDGE_NS
        if self._apart:
            self._thread = threading.Thread(target=self._judge, args=(waiting[::-1], newest_ns), daemon=True)
            self._thread.start()
        else:
            self._judge(waiting[::-1], newest_ns)

    def end(self) -> None:
        """Wait for the judgement that is running."""
        if self._thread is not None:
            self._thread.join()

    def _judge(self, batches: list[tuple[PacketBatch, Columns]], newest_ns: int) -> None:
        began = time.monotonic_ns()
        examination = Examination(self._context)
        for batch, columns in batches:
            examination.add(batch, columns)
        reasons = {
            (item.rule, item.link, item.msg_id): item.reason
            for item in examination.diagnose(Capture()).verdicts
            if item.rule in self._rules or (self._any and item.severity >= Severity.ERROR)
        }
        fired = [f"rule {key[0]}: {reason}" for key, reason in reasons.items() if key not in self._known]
        self._known = set(reasons)
        self._found.extend((newest_ns, reason) for reason in fired)
        if self._apart:
            self._due_ns = time.monotonic_ns() + max(_JUDGE_NS, _JUDGE_TIMES * (time.monotonic_ns() - began))


_TURN_NS: Final = 50 * MILLISECOND
"""Longest time for writing kept datagrams before the source is read again."""
_QUIET_NS: Final = SECOND
"""Silence of a live source after which it has no more datagrams of a period that is over."""
_APART_NS: Final = 100 * MILLISECOND
"""Step in which datagrams that fire a trigger are examined."""
_MOST_REASONS: Final = 10


class Snapshot(msgspec.Struct):
    """One file, and the reasons for it.

    Attributes:
        reasons: the triggers that fired, in order; the first few.
        trigger_ns: time of the first trigger.
        start_ns: first requested time.
        until_ns: last requested time.
        path: the file; None before it is begun.
        datagrams: number of datagrams that were written.
        before_ns: time from its first datagram to the trigger; 0 without any.
        cut: whether older datagrams had been dropped because of the size.
        next: number of the kept batch that is written next.
        sink: writes the file; None before it is begun.
    """

    reasons: list[str]
    trigger_ns: int
    start_ns: int
    until_ns: int
    path: Path | None = None
    datagrams: int = 0
    before_ns: int = 0
    cut: bool = False
    next: int = 0
    sink: WatchedSink | None = None

    def as_json(self) -> dict[str, Any]:
        """Return the snapshot in the shape of ``record --snapshot --json``."""
        names = ("reasons", "trigger_ns", "until_ns", "datagrams", "before_ns", "cut")
        return {"path": str(self.path), **{name: getattr(self, name) for name in names}}


class _Piece(msgspec.Struct, frozen=True, eq=False):
    """A batch that is kept."""

    batch: PacketBatch
    columns: Columns
    first_ns: int
    last_ns: int

    @property
    def size(self) -> int:
        return self.batch.data.nbytes + ROW_BYTES * len(self.batch)


class SnapshotSink(Sink):
    """A sink that keeps datagrams, and writes those that triggers request.

    Args:
        request: what fires, and how much is kept before and after it; unless stated, 30 s and at most 512 MiB
            before, and 10 s after.
        source: the source that is read; a live one is read on while files are written.
        target: the output; the name of each file gets the trigger's time.
        begin: opens a sink at a path.
        triggers: triggers of this machine: a signal, a key, a socket.
        clock: monotonic time in ns.

    Attributes:
        snapshots: snapshots that are complete or being written.
        losses: files that were removed while they were written.
        keep: number of files to keep, and what was deleted.
        dropped: datagrams that were dropped because of the size though they were recent enough to keep.

    Raises:
        ConfigError: a filter has an error.
    """

    def __init__(
        self,
        request: SnapshotOptions,
        source: Source,
        context: Context,
        target: Target,
        begin: Callable[[Path], WatchedSink],
        *,
        triggers: Triggers | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.snapshots: list[Snapshot] = []
        self.losses: list[OutputLoss] = []
        self.keep = Keep(target.keep_files, target.keep_bytes)
        self.dropped = 0
        self._target, self._begin = target, begin
        before = dict(request.before or ())
        self._before_ns = before.get("time", 30 * SECOND)
        self._before_bytes = request.before_size or before.get("size", 512 << 20)
        self._after_ns = 10 * SECOND if request.after is None else request.after
        self._triggers = triggers or Triggers()
        self._live, self._clock = source.on_this_host, clock
        self._statistics = source.statistics
        fires: dict[str, list[str]] = {"finding": [], "where": [], "rule": []}
        for kind, rest in request.trigger or ():
            fires[kind].append(rest)
        labels = {"": NOTABLE, **{item.label: item for item in Finding}}
        self._findings = reduce(or_, (int(labels[rest]) for rest in fires["finding"]), 0)
        self._where = [Where(text, context) for text in fires["where"]]
        rules, any_rule = frozenset(filter(None, fires["rule"])), "" in fires["rule"]
        self._rules = RuleTrigger(context, rules, any_error=any_rule, apart=self._live)
        self._pieces: deque[_Piece] = deque()
        self._first = 0  # number of the oldest kept batch
        self._size = 0
        self._newest_ns = 0
        self._came_ns = clock()
        self._dropped_ns = -1
        self._open: deque[Snapshot] = deque()
        self._closed = False

    @property
    def paths(self) -> list[Path]:
        """The files that were written."""
        return [item.path for item in self.snapshots if item.path is not None]

    def write(self, batch: PacketBatch, columns: Columns) -> None:
        """Keep a batch; write requested datagrams for a short time.

        Raises:
            CaptureError: a file cannot be written.
        """
        piece = _Piece(*compact(batch, columns), int(batch.time_ns.min()), int(batch.time_ns.max()))
        self._pieces.append(piece)
        self._size += piece.size
        self._newest_ns, self._came_ns = max(self._newest_ns, piece.last_ns), self._clock()
        for time_ns, reason in self._finding_hits(piece):
            self.fire(time_ns, reason)
        self._look()
        self._forget()

    def flush(self) -> None:
        """Check whether a trigger fired, and write the remaining requested datagrams.

        Raises:
            CaptureError: a file cannot be written.
        """
        self._look()
        for item in self._open:
            if item.sink is not None:
                item.sink.flush()

    def fire(self, time_ns: int, reason: str) -> None:
        """Request the datagrams around a time; within the period of the last snapshot, extend that one."""
        last = self._open[-1] if self._open else None
        if last is not None and time_ns <= last.until_ns:
            last.until_ns = max(last.until_ns, time_ns + self._after_ns)
            if reason not in last.reasons and len(last.reasons) < _MOST_REASONS:
                last.reasons.append(reason)
            return
        start_ns, until_ns = time_ns - self._before_ns, time_ns + self._after_ns
        self._open.append(Snapshot([reason], time_ns, start_ns, until_ns, next=self._first))

    def close(self, statistics: SourceStatistics) -> None:
        """Write all requested datagrams that have arrived.

        Raises:
            CaptureError: a file cannot be written.
        """
        if self._closed:
            return
        self._closed = True
        self._rules.end()
        for time_ns, reason in self._rules.new_hits():
            self.fire(time_ns, reason)
        while self._open:
            self._advance(None)
            self._complete(self._open.popleft())

    def _finding_hits(self, piece: _Piece) -> Iterator[tuple[int, str]]:
        """Yield the times at which datagrams of a batch fire, with the reasons."""
        hits = []
        if self._findings:
            bits = piece.columns.findings & np.uint32(self._findings)
            if bits.any():
                findings = Finding(int(np.bitwise_or.reduce(bits)))
                hits.append((bits != 0, f"finding {', '.join(item.label for item in findings)}"))
        hits += [(where.mask(piece.batch, piece.columns), str(where)) for where in self._where]
        for hit, reason in hits:
            times = np.sort(piece.batch.time_ns[hit])
            if len(times):
                steps = np.append(True, np.diff(times // _APART_NS) > 0)
                steps[-1] = True
                yield from ((time_ns, reason) for time_ns in times[steps].tolist())

    def _look(self) -> None:
        """Check the triggers other than datagrams, and write for a short time."""
        now_ns = time.time_ns() if self._live else self._newest_ns
        for reason in self._triggers.fired():
            self.fire(now_ns, reason)
        self._rules.look(((item.batch, item.columns) for item in self._pieces), self._newest_ns)
        for time_ns, reason in self._rules.new_hits():
            self.fire(time_ns, reason)
        self._advance(self._clock() + _TURN_NS if self._live else None)
        if self._open and self._live and self._clock() - self._came_ns > _QUIET_NS:
            one = self._open[0]
            if now_ns > one.until_ns + _QUIET_NS and one.next >= self._first + len(self._pieces):
                self._complete(self._open.popleft())

    def _advance(self, until: int | None) -> None:
        """Write requested datagrams until all are written or a monotonic time is reached."""
        while self._open:
            one = self._open[0]
            while one.next < self._first + len(self._pieces):
                piece = self._pieces[max(one.next, self._first) - self._first]
                one.next = max(one.next, self._first) + 1
                self._write(one, piece)
                if until is not None and self._clock() > until:
                    return
            if self._newest_ns <= one.until_ns or self._closed:
                return
            self._complete(self._open.popleft())

    def _write(self, one: Snapshot, piece: _Piece) -> None:
        """Write the datagrams of a batch that a snapshot requests."""
        if piece.last_ns < one.start_ns or piece.first_ns > one.until_ns:
            return
        batch, columns = piece.batch, piece.columns
        if piece.first_ns < one.start_ns or piece.last_ns > one.until_ns:
            rows = np.flatnonzero((batch.time_ns >= one.start_ns) & (batch.time_ns <= one.until_ns))
            if not len(rows):
                return
            batch, columns = batch.take(rows), columns.take(rows)
        sink = one.sink or self._started(one)
        if not one.datagrams:
            one.before_ns = max(0, one.trigger_ns - int(batch.time_ns.min()))
        sink.write(batch, columns)
        one.datagrams += len(batch)

    def _started(self, one: Snapshot) -> WatchedSink:
        name = self._target.path
        when = time.strftime("%Y%m%d_%H%M%S", time.localtime(one.trigger_ns // SECOND))
        path = name.with_name(f"{name.stem}_{when}{name.suffix}")
        one.path = path_beside(path) if path.exists() else path
        one.cut = self._dropped_ns >= one.start_ns
        one.sink = self._begin(one.path)
        self.snapshots.append(one)
        self._triggers.answer(f"{one.path}: {one.reasons[0]}")
        return one.sink

    def _complete(self, one: Snapshot) -> None:
        sink = one.sink
        if sink is None:
            self._triggers.answer(f"nothing was captured around the trigger ({one.reasons[0]})")
            return
        sink.close(self._statistics)
        self.losses += sink.losses
        self._target.on_warning(snapshot_line(one, self._before_ns))
        self._delete_oldest()

    def _delete_oldest(self) -> None:
        """Delete the oldest complete files until the rest is within the limits of ``keep``."""
        keep = self.keep
        existing = [item for item in self.snapshots if item.path is not None and item.path.exists()]
        sizes = [item.path.stat().st_size for item in existing if item.path is not None]
        for place, item in enumerate(existing[:-1]):
            count, size = len(existing) - place, sum(sizes[place:])
            if not ((keep.files and count > keep.files) or (keep.size and size > keep.size)):
                return
            assert item.path is not None
            with os_errors(f"{item.path}: cannot be deleted"):
                item.path.unlink()
            self.snapshots.remove(item)
            keep.deleted += 1
            keep.datagrams += item.datagrams

    def _forget(self) -> None:
        """Drop batches that are too old, or exceed the size."""
        horizon = self._newest_ns - self._before_ns
        while self._pieces:
            oldest, excess = self._pieces[0], self._size > self._before_bytes
            if oldest.last_ns >= horizon and not excess:
                return
            if any(one.next <= self._first and oldest.last_ns >= one.start_ns for one in self._open):
                if not excess:
                    return
                self._advance(None)
            if oldest.last_ns >= horizon:
                self._drop(oldest)
            self._pieces.popleft()
            self._first += 1
            self._size -= oldest.size

    def _drop(self, oldest: _Piece) -> None:
        """Count a batch that is dropped because of the size; report it the first time."""
        if not self.dropped:
            holds = (self._newest_ns - oldest.first_ns) / SECOND
            self._target.on_warning(
                f"--before {self._before_bytes >> 20}MiB holds the last {holds:.1f} s of this "
                f"traffic, not {self._before_ns / SECOND:g} s; older datagrams are dropped first"
            )
        self.dropped += len(oldest.batch)
        self._dropped_ns = max(self._dropped_ns, oldest.last_ns)


def snapshot_line(one: Snapshot, before_ns: int) -> str:
    """Return the line that states the content of a file and the reason for it.

    Args:
        before_ns: time that was requested before the trigger, ns.
    """
    more = f" and {len(one.reasons) - 1} more" if len(one.reasons) > 1 else ""
    after = (one.until_ns - one.trigger_ns) / SECOND
    less = f" (--before held no more of the {before_ns / SECOND:g} s)" if one.cut else ""
    return (
        f"snapshot {one.path}: {plural(one.datagrams, 'datagram')}, from {one.before_ns / SECOND:.1f} s "
        f"before{less} to {after:.1f} s after: {one.reasons[0]}{more}"
    )


def record_snapshots(
    source: Source,
    bench: Workbench,
    target: Target,
    request: SnapshotOptions,
    *,
    selection: Selection | None = None,
    limits: Limits = Limits(),  # noqa: B008  frozen
    watcher: Watcher[CaptureReport] | None = None,
    triggers: Triggers | None = None,
) -> tuple[CaptureReport, SnapshotSink]:
    """Read a source until it ends, Ctrl-C, or a limit; write what triggers request.

    Args:
        source: source of the datagrams; it is closed.
        target: the output; its name gets the time of the trigger.
        request: see ``SnapshotSink``.
        selection: datagrams that are kept and can fire; all by default.
        watcher: called with the report after every batch.
        triggers: triggers of this machine; the caller, who opened them, closes them.

    Returns:
        The report of the capture, and the sink, which has the snapshots.

    Raises:
        CaptureError: a file cannot be written.
        RouteError: the selection names a topic that is not configured.
        ConfigError: a filter has an error.
    """
    with reading(source, bench, selection, limits, keeps_failure=True) as loop:
        about = str(loop.selection)

        def begin(path: Path) -> WatchedSink:
            # Kept batches must not lie in memory that the source reuses.
            return open_sink(replace(target, path=path, jobs=1), source, bench, selection=about)

        sink = SnapshotSink(request, source, bench.columns.context, target, begin, triggers=triggers)
        report = pour(loop, sink, watcher=watcher)
    report.outputs, report.losses, report.keep = sink.paths, sink.losses, sink.keep
    return report, sink
