"""Recording beside a relay: datagrams are copied onto pages, and a thread of its own decodes and writes them.

What the thread cannot keep up with is not recorded, and counted: the relay does not wait for it.
"""

from __future__ import annotations

import ipaddress
import queue
import threading
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.errors import CaptureError, EdorasError
from edoras_tools.model import SourceInfo, SourceStatistics
from edoras_tools.pipelines.accounts import Ledger
from edoras_tools.pipelines.record import open_sink
from edoras_tools.sinks.tee import Tee
from edoras_tools.sources.bpf import RAW
from edoras_tools.sources.framing import PADDING
from edoras_tools.sources.linklayer import Demux, FrameBatch
from edoras_tools.sources.rawip import ROOM, write_headers
from edoras_tools.wire.window import copy_rows

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from edoras_tools.model import Columns, Endpoint, PacketBatch
    from edoras_tools.pipelines.record import Target
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.sessions.faults import Fault
    from edoras_tools.sinks import Sink
    from edoras_tools.sinks.foxglove import FoxgloveSink
    from edoras_tools.sources.relay import Arena

PAGE_BYTES: Final = 2 << 20
PAGE_ROWS: Final = 16384
_QUEUE_BYTES: Final = 256 << 20
_TURN_NS: Final = 40_000_000
"""A page goes to the thread after this long, full or not: batches that small cost more than they hold."""
_FLUSH_NS: Final = 500_000_000


@dataclass(slots=True, eq=False)
class _Page:
    """Datagrams in the order in which they were sent.

    ``flow`` says between whom; ``faults`` what was done on purpose meanwhile.
    """

    data: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(PAGE_BYTES + PADDING, np.uint8))
    time_ns: NDArray[np.int64] = field(default_factory=lambda: np.empty(PAGE_ROWS, np.int64))
    offset: NDArray[np.int64] = field(default_factory=lambda: np.empty(PAGE_ROWS, np.int64))
    length: NDArray[np.int32] = field(default_factory=lambda: np.empty(PAGE_ROWS, np.int32))
    flow: NDArray[np.int32] = field(default_factory=lambda: np.empty(PAGE_ROWS, np.int32))
    faults: list[Fault] = field(default_factory=list)
    rows: int = 0
    used: int = 0


@dataclass(frozen=True, slots=True)
class _RelaySource:
    """What sinks ask of a source; the datagrams themselves come on pages."""

    info: SourceInfo
    statistics: SourceStatistics

    def batches(self) -> Iterator[PacketBatch]:
        return iter(())

    def close(self) -> None:
        return


class Recorder:
    """Writes what a relay sends.

    Args:
        target: what to write; None: nothing, it is only shown.
        bench: mission, types and decoders.
        name: of the relay, for the recording's metadata.
        kind: what the relay is, for the same.
        tap: takes every batch as well, on the recorder's thread.
        show: makes what shows it meanwhile of the relay's info and counts, as ``pipelines.live.attach`` does.

    Attributes:
        ledger: counts by route.
        missed: datagrams that were not recorded, because the thread could not keep up or failed.
        failure: why recording ended early, if it did.
        path: what is written, if anything is.
        shown: what ``show`` made.

    Raises:
        CaptureError: it cannot be written.
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
        self._source = _RelaySource(SourceInfo(name, kind), SourceStatistics())
        self.shown = show(self._source.info, self._source.statistics) if show else None
        sinks: list[Sink] = [self.shown] if self.shown else []
        try:
            self._sink = Tee([*sinks, open_sink(target, self._source, bench)] if target else sinks)
        except CaptureError:
            for sink in sinks:
                sink.close(self._source.statistics)
            raise
        self._versions: list[int] = []
        self._rooms: list[int] = []
        self._ends: list[tuple[bytes, int, bytes, int]] = []
        self._queue: queue.SimpleQueue[_Page | None] = queue.SimpleQueue()
        self._queued = 0
        self._written = 0
        self._page = _Page()
        self._opened_ns = 0
        self._number = 1
        self._demux = Demux()
        self._thread = threading.Thread(target=self._run, name="proxy recorder", daemon=True)
        self._thread.start()

    @property
    def pending(self) -> bool:
        """Whether the page holds anything."""
        return self._page.rows > 0

    def flow(self, source: Endpoint, destination: Endpoint) -> int:
        """Return the number of a direction between two ends."""
        ends = [ipaddress.ip_address(item.address.partition("%")[0]) for item in (source, destination)]
        if ends[0].version != ends[1].version:  # no frame holds both
            ends = [_mapped(item) for item in ends]
        self._versions.append(ends[0].version)
        self._rooms.append(ROOM[ends[0].version])
        self._ends.append((ends[0].packed, source.port, ends[1].packed, destination.port))
        return len(self._ends) - 1

    def take(self, arena: Arena, rows: int | NDArray[np.int64], times: NDArray[np.int64], flow: int) -> None:
        """Copy what lies in some rooms.

        Args:
            arena: the rooms.
            rows: so many from 0 on, or these.
            times: i64, ns since 1970, of every room of the arena.
            flow: between whom.
        """
        chosen: slice | NDArray[np.int64] = slice(0, rows) if isinstance(rows, int) else rows
        length = arena.length[chosen].astype(np.int64)
        count = len(length)
        if not count:
            return
        room = self._rooms[flow]
        stride = room + length + 2 & ~1
        ends = np.cumsum(stride)
        page = self._page
        if page.rows + count > PAGE_ROWS or page.used + int(ends[-1]) > PAGE_BYTES:
            self.turn()
            page = self._page
            if int(ends[-1]) > len(page.data) - PADDING:
                page.data = np.zeros(int(ends[-1]) + PADDING, np.uint8)
        offset = ends - stride + page.used
        into = slice(page.rows, page.rows + count)
        page.offset[into], page.length[into] = offset, length
        page.time_ns[into], page.flow[into] = times[chosen], flow
        where = np.arange(count) if isinstance(rows, int) else rows
        copy_rows(page.data, offset + room, arena.rooms.reshape(-1), where * arena.rooms.shape[1], length)
        page.rows += count
        page.used += int(ends[-1])
        self._opened_ns = self._opened_ns or int(times[where[0]])

    def note(self, faults: list[Fault]) -> None:
        """Take what was done on purpose."""
        self._page.faults += faults

    def tick(self, now: int) -> None:
        """Hand the page over if it is old enough; ``now`` in ns since 1970."""
        if self._page.faults and not self._opened_ns:
            self._opened_ns = now
        if self._opened_ns and now - self._opened_ns >= _TURN_NS:
            self.turn()

    def turn(self) -> None:
        """Hand the page over, and begin another."""
        page = self._page
        self._opened_ns = 0
        if not page.rows and not page.faults:
            return
        self._page = _Page()
        if self.failure or self._queued - self._written > _QUEUE_BYTES:
            self.missed += page.rows
            return
        self._queued += page.data.size
        self._queue.put(page)

    def close(self, kernel_drops: int) -> None:
        """Write what is left, and make the recording whole."""
        self.turn()
        self._source.statistics.kernel_drops = kernel_drops
        self._queue.put(None)
        self._thread.join()

    def _run(self) -> None:
        try:
            self._write_all()
        except EdorasError as error:
            self.failure = error
        except Exception as error:  # noqa: BLE001  what ends this thread must not look like a whole recording
            self.failure = CaptureError(f"{self.path}: the recording ended in a mistake of ours: {error!r}")
        try:
            self._sink.close(self._source.statistics)
        except CaptureError as error:
            self.failure = self.failure or error

    def _write_all(self) -> None:
        flushed = time.monotonic_ns()
        while True:
            try:
                page = self._queue.get(timeout=0.5)
            except queue.Empty:
                page = _Page(data=np.empty(0, np.uint8))
            if page is None:
                return
            if page.rows:
                self._write(page)
            if page.faults:
                self._sink.write_faults(page.faults)
            self._written += page.data.size
            now = time.monotonic_ns()
            if now - flushed >= _FLUSH_NS:
                self._sink.flush()
                flushed = now

    def _write(self, page: _Page) -> None:
        rows = slice(0, page.rows)
        flow, offset, length = page.flow[rows], page.offset[rows], page.length[rows]
        versions = np.array(self._versions, np.uint8)[flow]
        rooms = np.array(self._rooms, np.int32)[flow]
        for version in set(versions.tolist()):
            chosen = np.flatnonzero(versions == version)
            size = 4 if version == 4 else 16
            ends = [item if len(item[0]) == size else None for item in self._ends]
            source = _endpoints([item[:2] if item else (bytes(size), 0) for item in ends], flow[chosen])
            destination = _endpoints([item[2:] if item else (bytes(size), 0) for item in ends], flow[chosen])
            write_headers(page.data, version, offset[chosen], length[chosen], source, destination)
        frames = FrameBatch(
            data=page.data,
            number=np.arange(self._number, self._number + page.rows, dtype=np.int64),
            time_ns=page.time_ns[rows],
            link_type=np.full(page.rows, RAW, np.uint16),
            offset=offset,
            length=length + rooms,
            original_length=length + rooms,
        )
        self._number += page.rows
        batch = self._demux.demux(frames)
        columns = self._bench.columns.decode(batch)
        self._sink.write(batch, columns)
        if self._tap is not None:
            self._tap(batch, columns)
        self.ledger.add(batch, columns)
        statistics = self._source.statistics
        statistics.frames += len(frames)
        statistics.datagrams += len(batch)
        statistics.bytes += int(frames.length.sum())


def _endpoints(
    ends: list[tuple[bytes, int]], flow: NDArray[np.int32]
) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
    """Return addresses, one a row, and ports."""
    addresses = np.frombuffer(b"".join(address for address, _ in ends), np.uint8).reshape(len(ends), -1)
    return addresses[flow], np.array([port for _, port in ends], np.uint16)[flow]


def _mapped(address: ipaddress.IPv4Address | ipaddress.IPv6Address) -> ipaddress.IPv6Address:
    return (
        ipaddress.IPv6Address(f"::ffff:{address}")
        if address.version == 4
        else ipaddress.IPv6Address(int(address))
    )
