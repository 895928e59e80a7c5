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

import queue
import select
import threading
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from edoras_tools.errors import CaptureError, EdorasError
from edoras_tools.io.forked import await_end, fork, killed, portable, receive, send
from edoras_tools.io.formats.tee import Tee
from edoras_tools.io.frames.build import HEADER_BYTES, FramePage
from edoras_tools.io.frames.linklayer import Demux
from edoras_tools.model import Columns, PacketBatch, SourceInfo, SourceStatistics
from edoras_tools.pipelines.capture.flushing import Flushing
from edoras_tools.pipelines.capture.ledger import Ledger
from edoras_tools.pipelines.capture.record import Target, open_sink
from edoras_tools.sessions.sequence import SequenceCounts

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from edoras_tools.io import Sink
    from edoras_tools.io.formats.watched import OutputLoss
    from edoras_tools.io.foxglove.sink import FoxgloveSink
    from edoras_tools.io.net.buffer import DatagramBuffer
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.sessions.faults.fault import Fault

PAGE_BYTES: Final = 2 << 20
PAGE_ROWS: Final = 16384
_QUEUE_BYTES: Final = 256 << 20
_PAGE_NS: Final = 40_000_000
"""A page goes to the thread after this time, even if it is not full; smaller batches would be inefficient."""


@dataclass(slots=True, eq=False)
class _Page:
    """Datagrams in the order in which they were sent, and the faults injected meanwhile."""

    datagrams: FramePage = field(default_factory=lambda: FramePage(PAGE_ROWS, PAGE_BYTES))
    faults: list[Fault] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class PushedSource:
    """The parts of a source that a sink needs, when datagrams are pushed to it."""

    info: SourceInfo
    statistics: SourceStatistics

    def batches(self) -> Iterator[PacketBatch]:
        """Return no batches."""
        return iter(())

    def close(self) -> None:
        """Do nothing: nothing is open."""


class Recorded(NamedTuple):
    """What was recorded.

    Attributes:
        datagrams: how many.
        routes: their counts by route, in the shape of ``info --json``.
        losses: outputs that were removed while they were written.
        shown: what the Foxglove server showed, in the form of ``proxy --json``; None without one.
    """

    datagrams: int = 0
    routes: Sequence[dict[str, Any]] = ()
    losses: Sequence[OutputLoss] = ()
    shown: dict[str, Any] | None = None


class _Writer:
    """Decodes and writes pages; arguments and exceptions as of ``RelayRecorder``."""

    def __init__(
        self,
        target: Target | None,
        bench: Workbench,
        info: SourceInfo,
        tap: Callable[[PacketBatch, Columns], None] | None,
        show: Callable[[SourceInfo, SourceStatistics], FoxgloveSink] | None,
    ) -> None:
        self._bench, self._tap = bench, tap
        sequences = SequenceCounts()
        self._ledger = Ledger(bench.mission, sequences)
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
        shown = self._shown.summary() if self._shown else None
        return Recorded(self._ledger.datagrams, self._ledger.routes(), self._losses, shown)

    @property
    def wait_s(self) -> float | None:
        """How long nothing has to be done, in s; None: as long as no page comes."""
        return self._flushing.wait_s

    def look(self) -> None:
        """Flush if it is time."""
        self._flushing.look()

    def write(self, page: _Page) -> None:
        if page.datagrams.rows:
            self._write(page.datagrams)
        if page.faults:
            self._sink.write_faults(page.faults)
            self._flushing.noted()
        self._flushing.look()

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
        self._flushing.look()  # first of all: the rest may wait
        if self._tap is not None:
            self._tap(batch, columns)
        self._ledger.add(batch, columns)
        statistics = self._source.statistics
        statistics.frames += len(frames)
        statistics.datagrams += len(batch)
        statistics.bytes += int(frames.length.sum())


class _WriterApart:
    """The same in a second process.

    Raises:
        OSError: there can be none.
    """

    wait_s = None

    def __init__(self, begin: Callable[[], _Writer], path: Path | None) -> None:
        self.recorded = Recorded()
        self._path = path
        self._process, self._link = fork(partial(_serve, begin))
        try:
            self._answer()
        except EdorasError:
            self._end()
            raise

    def look(self) -> None:
        """Do nothing: the other process flushes in time."""

    def write(self, page: _Page) -> None:
        self._answer("write", page)

    def close(self, kernel_drops: int) -> None:
        try:
            self._answer("close", kernel_drops)
        finally:
            self._end()

    def _answer(self, *request: Any) -> None:
        """Send a request, if any, and wait until it is done."""
        try:
            if request:
                send(self._link, request)
            failure, recorded = receive(self._link)
        except (OSError, EOFError):
            shows = CaptureError("the process that shows it in Foxglove was killed")
            failure, recorded = killed(self._path) if self._path else shows, None
        self.recorded = recorded or self.recorded
        if failure is not None:
            raise failure

    def _end(self) -> None:
        self._link.close()
        await_end(self._process)


def _serve(begin: Callable[[], _Writer], link: socket.socket) -> None:
    """Write in the forked process until it is asked to close, or the other process has ended."""
    writer: _Writer | None = None
    failure: Exception | None = None
    kind, values = "begin", list[Any]()
    while True:
        try:
            if writer is None:
                writer = begin()
            elif kind == "close" or failure is None:
                getattr(writer, kind)(*values)
        except Exception as error:  # noqa: BLE001  the caller in the other process gets it
            failure = failure or portable(error)
        if kind != "look":
            with suppress(OSError):  # the other process has ended: the next read shows it
                send(link, (failure, writer.recorded if writer and kind == "close" else None))
        if kind == "close" or writer is None:
            return
        kind, values = "look", []
        if select.select([link], [], [], None if failure else writer.wait_s)[0]:
            try:
                kind, *values = receive(link)
            except (OSError, EOFError):
                kind, values = "close", [0]


def _writer_apart(begin: Callable[[], _Writer], path: Path | None) -> _Writer | _WriterApart:
    """Return a writer in a second process, or in this one if there can be none."""
    try:
        return _WriterApart(begin, path)
    except OSError:
        return begin()


class RelayRecorder:
    """Records what a proxy or bridges forward.

    Args:
        target: what to write; None: only show.
        name: name of the source, for the recording's metadata.
        kind: kind of the source, likewise: ``proxy``, ``bridge``, ``demo``.
        tap: called with every batch, on the recorder's thread.
        show: makes a Foxglove sink from the source's info and statistics (``pipelines.live.attach``).
        apart: a second process decodes and writes, where there can be one; ``recorded`` is known at the end.

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
        show: Callable[[SourceInfo, SourceStatistics], FoxgloveSink] | None = None,
        *,
        apart: bool = False,
    ) -> None:
        self.path = target.path if target else None
        self.missed = 0
        self.failure: EdorasError | None = None
        begin = partial(_Writer, target, bench, SourceInfo(name, kind), tap, show)
        self._writer = _writer_apart(begin, self.path) if apart else begin()
        self._queue: queue.SimpleQueue[_Page | None] = queue.SimpleQueue()
        self._queued = 0
        self._written = 0
        self._page = _Page()
        self._opened_ns = 0
        self._kernel_drops = 0
        self._thread = threading.Thread(target=self._run, name="relay recorder", daemon=True)
        self._thread.start()

    @property
    def recorded(self) -> Recorded:
        """What was recorded; by a second process: known once it has ended."""
        return self._writer.recorded

    @property
    def pending(self) -> bool:
        """Whether the page holds any datagrams."""
        return self._page.datagrams.rows > 0

    def take(
        self,
        buffer: DatagramBuffer,
        slots: int | NDArray[np.int64],
        times: NDArray[np.int64],
        ends: NDArray[np.void],
    ) -> None:
        """Copy datagrams from a buffer.

        Args:
            slots: the number of slots from 0 on, or their indices.
            times: i64, ns since 1970, for every slot of the buffer.
            ends: source and destination, one value of ``ENDS``.
        """
        chosen = slice(0, slots) if isinstance(slots, int) else slots
        length = buffer.length[chosen]
        if not len(length):
            return
        size = int(length.sum()) + len(length) * HEADER_BYTES
        page = self._page.datagrams
        if page.rows and (page.rows + len(length) > PAGE_ROWS or page.used + size > PAGE_BYTES):
            self.turn()
            page = self._page.datagrams
        page.add(buffer.slots.reshape(-1), buffer.starts[chosen], length, times[chosen], ends)
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
        self._thread.join()

    def _run(self) -> None:
        self._attempt(self._write_all)
        self._attempt(lambda: self._writer.close(self._kernel_drops))

    def _attempt(self, work: Callable[[], None]) -> None:
        """Do something, and keep the first failure."""
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
                self._writer.look()
                continue
            if page is None:
                return
            self._writer.write(page)
            self._written += page.datagrams.size
