"""Recording beside a proxy or bridges: a separate thread decodes and writes what they forward.

Rules that a recorder keeps:

1. The thread that moves datagrams only copies them to a page. A page goes to the recorder's thread when it is
   full or old.
2. It never waits for the recorder: if the recorder's thread is too slow, pages are not recorded, and their
   datagrams are counted in ``missed``.
3. After a failure nothing more is written. ``failure`` says why, and datagrams are still moved.
"""

from __future__ import annotations

import queue
import threading
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from edoras_tools.errors import CaptureError, EdorasError
from edoras_tools.io.formats.tee import Tee
from edoras_tools.io.frames.build import HEADER_BYTES, FramePage
from edoras_tools.io.frames.linklayer import Demux
from edoras_tools.model import SourceInfo, SourceStatistics
from edoras_tools.pipelines.capture.flushing import Flushing
from edoras_tools.pipelines.capture.ledger import Ledger
from edoras_tools.pipelines.capture.record import open_sink

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import numpy as np
    from numpy.typing import NDArray

    from edoras_tools.io import Sink
    from edoras_tools.io.foxglove.sink import FoxgloveSink
    from edoras_tools.io.net.buffer import DatagramBuffer
    from edoras_tools.model import Columns, PacketBatch
    from edoras_tools.pipelines.capture.record import Target
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


class RelayRecorder:
    """Records what a proxy or bridges forward.

    Args:
        target: what to write; None: only show.
        bench: mission, types and decoders.
        name: name of the source, for the recording's metadata.
        kind: kind of the source, likewise: ``proxy``, ``bridge``, ``demo``.
        tap: called with every batch, on the recorder's thread.
        show: makes a Foxglove sink from the source's info and statistics (``pipelines.live.attach``).

    Attributes:
        ledger: counts by route.
        missed: datagrams that were not recorded, because the thread was too slow or failed.
        failure: why recording ended early, if it did.
        path: the file that is written, or None.
        losses: outputs that were removed while they were written.
        shown: the sink made by ``show``.

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
    ) -> None:
        self.path = target.path if target else None
        self._tap = tap
        self.ledger = Ledger(bench.mission)
        self.missed = 0
        self.failure: EdorasError | None = None
        self._bench = bench
        self._source = PushedSource(SourceInfo(name, kind), SourceStatistics())
        self.shown = show(self._source.info, self._source.statistics) if show else None
        sinks: list[Sink] = [self.shown] if self.shown else []
        try:
            written = [open_sink(target, self._source, bench)] if target else []
            self.losses = written[0].losses if written else []
            self._sink = Tee([*written, *sinks])
        except CaptureError:
            for sink in sinks:
                sink.close(self._source.statistics)
            raise
        self._queue: queue.SimpleQueue[_Page | None] = queue.SimpleQueue()
        self._queued = 0
        self._written = 0
        self._page = _Page()
        self._opened_ns = 0
        self._number = 1
        self._demux = Demux()
        self._flushing = Flushing(self._sink)
        self._thread = threading.Thread(target=self._run, name="relay recorder", daemon=True)
        self._thread.start()

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
            buffer: contains the datagrams.
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
        self._source.statistics.kernel_drops = kernel_drops
        self._queue.put(None)
        self._thread.join()

    def _run(self) -> None:
        try:
            self._write_all()
        except EdorasError as error:
            self.failure = error
        except MemoryError:
            self.failure = CaptureError(f"{self.path}: the recording ended: out of memory")
        except Exception as error:  # noqa: BLE001  the recording must not look complete if this thread dies
            self.failure = CaptureError(f"{self.path}: the recording ended by an internal error: {error!r}")
        try:
            self._sink.close(self._source.statistics)
        except CaptureError as error:
            self.failure = self.failure or error

    def _write_all(self) -> None:
        while True:
            try:
                page = self._queue.get(timeout=self._flushing.wait_s)
            except queue.Empty:
                self._flushing.look()
                continue
            if page is None:
                return
            if page.datagrams.rows:
                self._write(page.datagrams)
            if page.faults:
                self._sink.write_faults(page.faults)
            self._written += page.datagrams.size
            self._flushing.look()

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
        self.ledger.add(batch, columns)
        statistics = self._source.statistics
        statistics.frames += len(frames)
        statistics.datagrams += len(batch)
        statistics.bytes += int(frames.length.sum())
