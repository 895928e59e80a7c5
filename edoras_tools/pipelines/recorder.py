"""Recording beside a proxy or bridges: a thread or a process of its own decodes and writes what they forward.

Rules that a recorder keeps:

1. The thread that moves datagrams only copies them to a page. A page goes to the recorder's thread when it is
   full or old.
2. It never waits for the recorder: if that is too slow, pages are not recorded, and their datagrams are
   counted in ``missed``.
3. The thread may hand the pages to a second process, which takes no time of the interpreter that moves
   datagrams. That process ends with this one; what was not yet flushed is then lost.
4. After a failure nothing more is written. ``failure`` says why, and datagrams are still moved.
"""

from __future__ import annotations

import pickle
import queue
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from mmap import mmap
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from edoras_tools.errors import CaptureError, EdorasError, OnFailure
from edoras_tools.io import DisplaySink, Sink, SourceDefaults
from edoras_tools.io.frames.frame_batch import HEADER_BYTES, FramePage
from edoras_tools.io.frames.linklayer import Demux
from edoras_tools.io.outputs import Patience, waiting_for_room
from edoras_tools.io.processes import Desk, Workers, portable, run_soon, writer_killed
from edoras_tools.model import Columns, PacketBatch, SourceInfo, SourceStatistics
from edoras_tools.pipelines.capture.ledger import Ledger
from edoras_tools.pipelines.capture.record import Flushing, Target, open_sink
from edoras_tools.sessions.sequence import SequenceCounts

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from edoras_tools.io.formats.watched import OutputLoss
    from edoras_tools.io.net.buffer import DatagramBuffer
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.sessions.faults.rules import Fault
    from edoras_tools.wire.arrays import Integers

PAGE_BYTES: Final = 2 << 20
PAGE_ROWS: Final = 16384
_QUEUE_BYTES: Final = 256 << 20
_PAGE_NS: Final = 40_000_000
"""A page goes to the thread after this time, even if it is not full; smaller batches would be inefficient."""


class _Page(msgspec.Struct, eq=False):
    """Datagrams in the order in which they were sent, and the faults injected meanwhile."""

    datagrams: FramePage = msgspec.field(default_factory=lambda: FramePage(PAGE_ROWS, PAGE_BYTES))
    faults: list[Fault] = msgspec.field(default_factory=list)


@dataclass(frozen=True, slots=True)
class PushedSource(SourceDefaults):
    """The parts of a source that a sink needs, when datagrams are pushed to it."""

    info: SourceInfo
    statistics: SourceStatistics

    def batches(self) -> Iterator[PacketBatch]:
        """Return no batches."""
        return iter(())

    def close(self) -> None:
        """Do nothing: nothing is open."""


class Tee(Sink):
    """A ``Sink`` that forwards to others, in order; an error of one ends it for all.

    Args:
        sinks: the sinks to write to.

    Raises:
        CaptureError: from every method: a sink cannot be written.
    """

    def __init__(self, sinks: Sequence[Sink]) -> None:
        self._sinks = tuple(sinks)

    def write(self, batch: PacketBatch, columns: Columns) -> None:
        """Write a batch to all sinks."""
        for sink in self._sinks:
            sink.write(batch, columns)

    def write_faults(self, faults: Sequence[Fault]) -> None:
        """Write injected faults to all sinks."""
        for sink in self._sinks:
            sink.write_faults(faults)

    def flush(self) -> None:
        """Flush all sinks."""
        for sink in self._sinks:
            sink.flush()

    def close(self, statistics: SourceStatistics) -> None:
        """Close all sinks, even if one fails."""
        with ExitStack() as stack:
            for sink in self._sinks:
                stack.callback(sink.close, statistics)


class Recorded(NamedTuple):
    """The result of a recording.

    Attributes:
        datagrams: number of recorded datagrams.
        routes: counts by route, in the shape of ``info --json``.
        losses: outputs that were removed while they were written.
        display: messages shown to clients, in the form of ``proxy --json``; None without clients.
    """

    datagrams: int = 0
    routes: Sequence[dict[str, Any]] = ()
    losses: Sequence[OutputLoss] = ()
    display: dict[str, Any] | None = None


class _Writer:
    """Decodes and writes pages; arguments and exceptions as of ``RelayRecorder``."""

    def __init__(
        self,
        target: Target | None,
        bench: Workbench,
        info: SourceInfo,
        tap: Callable[[PacketBatch, Columns], None] | None,
        show: Callable[[SourceInfo, SourceStatistics], DisplaySink] | None,
    ) -> None:
        self._bench, self._tap = bench, tap
        sequences = SequenceCounts()
        self._ledger = Ledger(bench.mission, sequences=sequences, structs=bench.columns.context.structs)
        self._source = PushedSource(info, SourceStatistics())
        self._shown = show(info, self._source.statistics) if show else None
        sinks: list[Sink] = [self._shown] if self._shown else []
        try:
            written = [open_sink(target, self._source, bench, sequences=sequences)] if target else []
        except CaptureError:
            for sink in sinks:
                sink.close(self._source.statistics)
            raise
        self._losses = written[0].losses if written else []
        self._sink = Tee([*written, *sinks])
        self._number = 1
        self._demux = Demux()
        self._flushing = Flushing(self._sink)

    @property
    def recorded(self) -> Recorded:
        display = self._shown.summary() if self._shown else None
        return Recorded(self._ledger.datagrams, self._ledger.routes(), self._losses, display)

    @property
    def wait_s(self) -> float | None:
        """Time until the next work, s; None: until the next page comes."""
        return self._flushing.wait_s

    def flush_if_due(self) -> None:
        """Flush if it is due."""
        self._flushing.flush_if_due()

    def write(self, page: _Page) -> None:
        if page.datagrams.rows:
            self._write(page.datagrams)
        if page.faults:
            self._sink.write_faults(page.faults)
            self._flushing.noted()
        self._flushing.flush_if_due()

    def close(self, kernel_drops: int) -> None:
        self._source.statistics.kernel_drops = kernel_drops
        self._sink.close(self._source.statistics)

    def _write(self, page: FramePage) -> None:
        frames = page.frames(self._number)
        self._number += len(frames)
        batch = self._demux.demux(frames)
        columns = self._bench.columns.decode(batch)
        self._sink.write(batch, columns)
        self._flushing.took(batch)
        self._flushing.flush_if_due()  # first: the rest can wait
        if self._tap is not None:
            self._tap(batch, columns)
        self._ledger.add(batch, columns)
        statistics = self._source.statistics
        statistics.frames += len(frames)
        statistics.datagrams += len(batch)
        statistics.bytes += int(frames.length.sum())


class _WriterApart:
    """A ``_Writer`` in a second process.

    Raises:
        OSError: the process cannot be started.
    """

    wait_s = None

    def __init__(self, begin: Callable[[], _Writer], path: Path | None) -> None:
        self.recorded = Recorded()
        shows = CaptureError("the process that shows it in Foxglove was killed")
        service = _Service(begin)
        self._workers = Workers(
            1, service.run, writer_killed(path) if path else shows, set_up=service.set_up, tasks=1
        )
        self._workers.start()
        if self._workers.full:
            raise OSError("no process can be forked")
        with OnFailure(self._workers.close):
            self._run("begin")

    def flush_if_due(self) -> None:
        """Do nothing: the second process flushes in time."""

    def write(self, page: _Page) -> None:
        self._run("write", pickle.PickleBuffer(pickle.dumps(page, protocol=5)))
        self.recorded = self.recorded._replace(datagrams=self.recorded.datagrams + page.datagrams.rows)

    def close(self, kernel_drops: int) -> None:
        try:
            self._run("close", kernel_drops)
        finally:
            self._workers.close()

    def _run(self, name: str, *values: Any) -> None:
        """Let the second process run a method, and wait until it is done."""
        self._workers.submit(name, *values)
        failure, recorded = self._workers.take()
        self.recorded = recorded or self.recorded
        if failure is not None:
            raise failure


class _Service:
    """A writer in the second process: flushes in time; after a failure it only repeats the failure."""

    def __init__(self, begin: Callable[[], _Writer]) -> None:
        self._begin = begin
        self._writer: _Writer | None = None
        self._failure: Exception | None = None

    def set_up(self, desk: Desk) -> None:
        desk.idle, desk.end = self._flush, self._close

    def run(self, name: str, *values: Any) -> tuple[Exception | None, Recorded | None]:
        if name == "close":
            return self._close(*values)
        self._attempt(self._open if name == "begin" else self._write, *values)
        return self._failure, None

    def _open(self) -> None:
        run_soon()
        self._writer = self._begin()

    def _write(self, page: bytes) -> None:
        assert self._writer is not None
        self._writer.write(pickle.loads(page))  # noqa: S301  from our own process

    def _flush(self) -> float | None:
        if self._writer is None:
            return None
        self._attempt(self._writer.flush_if_due)
        return None if self._failure else self._writer.wait_s

    def _close(self, kernel_drops: int = 0) -> tuple[Exception | None, Recorded | None]:
        """Complete the recording, once; also if the first process ended without a request."""
        writer, self._writer = self._writer, None
        if writer is None:
            return self._failure, None
        try:
            writer.close(kernel_drops)
        except Exception as error:  # noqa: BLE001  the caller in the other process gets it
            self._failure = self._failure or portable(error)
        return self._failure, writer.recorded

    def _attempt(self, work: Callable[..., None], *values: Any) -> None:
        """Run a function unless an earlier one failed, and keep the failure."""
        if self._failure is None:
            try:
                work(*values)
            except Exception as error:  # noqa: BLE001  the caller in the other process gets it
                self._failure = portable(error)


def _writer_apart(begin: Callable[[], _Writer], path: Path | None) -> _Writer | _WriterApart:
    """Return a writer in a second process, or in this one if that cannot be started."""
    try:
        return _WriterApart(begin, path)
    except OSError:
        return begin()


class RelayRecorder:
    """Records what a proxy or bridges forward.

    Args:
        target: output; None: only show.
        name: name of the source, for the recording's metadata.
        kind: kind of the source, for the metadata: ``proxy``, ``bridge``, ``demo``.
        tap: called with every batch, on the recorder's thread.
        show: function of the source's info and statistics that makes a sink for watching clients.
        apart: decode and write in a second process, if possible; ``recorded`` is known at the end.

    Attributes:
        missed: datagrams that were not recorded, because the recorder was too slow or failed.
        failure: why recording ended early, if it did.
        path: the file that is written, or None.

    Raises:
        CaptureError: the output cannot be written.
    """

    def __init__(
        self,
        target: Target | None,
        bench: Workbench,
        name: str,
        kind: str = "proxy",
        tap: Callable[[PacketBatch, Columns], None] | None = None,
        show: Callable[[SourceInfo, SourceStatistics], DisplaySink] | None = None,
        *,
        apart: bool = False,
    ) -> None:
        self.path = target.path if target else None
        self.missed = 0
        self.failure: EdorasError | None = None
        begin = partial(_Writer, target, bench, SourceInfo(name, kind), tap, show)
        self._ending = mmap(-1, 1)  # shared with the second process
        self._opened = ExitStack()
        if target:
            patience = Patience(target.on_warning, lambda: self._ending[0] > 0)
            self._opened.enter_context(waiting_for_room(patience))
        with OnFailure(self._opened.close):
            self._writer = _writer_apart(begin, self.path) if apart else begin()
        self._queue: queue.SimpleQueue[_Page | None] = queue.SimpleQueue()
        self._queued = self._written = 0
        self._page = _Page()
        self._opened_ns = 0
        self._kernel_drops = 0
        self._thread = threading.Thread(target=self._run, name="relay recorder", daemon=True)
        self._thread.start()

    @property
    def recorded(self) -> Recorded:
        """The result; with a second process only the number of datagrams, and the rest once it has ended."""
        return self._writer.recorded

    @property
    def pending(self) -> bool:
        """Whether the page holds any datagrams."""
        return self._page.datagrams.rows > 0

    def take(
        self, buffer: DatagramBuffer, slots: int | Integers, times: Integers, ends: NDArray[np.void]
    ) -> None:
        """Copy datagrams from a buffer.

        Args:
            slots: the number of slots from 0 on, or their indices.
            times: i64, ns since 1970, for every slot of the buffer.
            ends: source and destination, one value of ``ENDS``.
        """
        selection = slice(0, slots) if isinstance(slots, int) else slots
        length = buffer.length[selection]
        if not len(length):
            return
        size = int(length.sum()) + len(length) * HEADER_BYTES
        page = self._page.datagrams
        if page.rows and (page.rows + len(length) > PAGE_ROWS or page.used + size > PAGE_BYTES):
            self.turn()
            page = self._page.datagrams
        page.add(buffer.slots.reshape(-1), buffer.starts[selection], length, times[selection], ends)
        self._opened_ns = self._opened_ns or int(page.time_ns[0])

    def note(self, faults: list[Fault]) -> None:
        """Record injected faults."""
        self._page.faults += faults

    def tick(self, now: int) -> None:
        """Hand the page over if it is old enough; ``now`` in ns since 1970."""
        if self._page.faults and not self._opened_ns:
            self._opened_ns = now
        if self._opened_ns and now - self._opened_ns >= _PAGE_NS:
            self.turn()

    def turn(self) -> None:
        """Hand the page over, and start another."""
        page = self._page
        self._opened_ns = 0
        if not page.datagrams.rows and not page.faults:
            return
        self._page = _Page()
        if self.failure or self._queued - self._written > _QUEUE_BYTES:
            self.missed += page.datagrams.rows
            return
        self._queued += page.datagrams.size
        self._queue.put(page)

    def close(self, kernel_drops: int) -> None:
        """Write the rest, and complete the recording."""
        self.turn()
        self._kernel_drops = kernel_drops
        self._queue.put(None)
        self._ending[0] = 1
        self._thread.join()
        self._opened.close()

    def _run(self) -> None:
        run_soon()
        self._attempt(self._write_all)
        self._attempt(lambda: self._writer.close(self._kernel_drops))

    def _attempt(self, work: Callable[[], None]) -> None:
        """Run a function, and keep the first failure."""
        failure: EdorasError | None = None
        try:
            work()
        except EdorasError as error:
            failure = error
        except MemoryError:
            failure = CaptureError(f"{self.path}: the recording ended: out of memory")
        except Exception as error:  # noqa: BLE001  the recording must not look complete if this thread dies
            failure = CaptureError(f"{self.path}: the recording ended by an internal error: {error!r}")
        self.failure = self.failure or failure

    def _write_all(self) -> None:
        while True:
            try:
                page = self._queue.get(timeout=self._writer.wait_s)
            except queue.Empty:
                self._writer.flush_if_due()
                continue
            if page is None:
                return
            self._writer.write(page)
            self._written += page.datagrams.size
