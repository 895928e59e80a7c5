"""A recording of what is sent and of what comes back: a wire that remembers.

Writing waits for a moment in which nothing is due soon, so that it makes nothing late; what comes back is
timed when it is picked up.
"""

from __future__ import annotations

import ipaddress
from typing import TYPE_CHECKING, Final

from edoras_tools.errors import ConfigError
from edoras_tools.model import SourceInfo, SourceStatistics
from edoras_tools.pipelines.record import open_sink
from edoras_tools.sessions.profile import MILLISECOND
from edoras_tools.sim.simulation import Sent
from edoras_tools.sim.source import frames_of
from edoras_tools.sinks.mcap import McapSink
from edoras_tools.sinks.rosbag2 import Rosbag2Sink
from edoras_tools.sources.linklayer import Demux

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from edoras_tools.model import Endpoint, PacketBatch
    from edoras_tools.pipelines.record import Target
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.sessions.faults import Fault
    from edoras_tools.sessions.outgoing import Outgoing
    from edoras_tools.sinks.transmit import SendStatistics
    from edoras_tools.sinks.wire import Arrival, Wire

_CALM_NS: Final = 50 * MILLISECOND
"""Nothing is due for so long: time to write a piece."""
_PIECE: Final = 256
"""Datagrams written at a time, which takes a few ms."""
_MOST: Final = 200_000
"""Datagrams that wait to be written; more are written at once, late or not."""


class TapeSource:
    """What a sink asks of a source; the datagrams themselves come from the wire."""

    def __init__(self, name: str) -> None:
        self.info = SourceInfo(name, "replay")
        self.statistics = SourceStatistics()

    def batches(self) -> Iterator[PacketBatch]:
        """Yield nothing."""
        return iter(())

    def close(self) -> None:
        """Hold nothing."""


class Tape:
    """A wire whose traffic is recorded.

    Args:
        wire: the wire.
        target: what to write.
        bench: mission, types and decoders.

    Raises:
        CaptureError: it cannot be written.
        ConfigError: the ends have IPv6 addresses.
    """

    def __init__(self, wire: Wire, target: Target, bench: Workbench) -> None:
        if any(ipaddress.ip_address(item.address.partition("%")[0]).version != 4 for item in wire.ends):
            raise ConfigError(f"{target.path}: only IPv4 is recorded here; record from the interface instead")
        self.now, self.ends = wire.now, wire.ends
        self._wire, self._bench = wire, bench
        self._source = TapeSource(f"sent to {wire.ends[1]}")
        self._sink = open_sink(target, self._source, bench)
        self._demux = Demux()
        self._waiting: list[Sent] = []
        self._faults: list[Fault] = []
        self._epoch_ns = wire.epoch_ns()

    @property
    def statistics(self) -> SendStatistics:
        """What became of the datagrams."""
        return self._wire.statistics

    def epoch_ns(self) -> int:
        """Return what to add to the time to have it since 1970."""
        return self._epoch_ns

    def wait(self, until_ns: int) -> bool:
        """Let time pass, and write meanwhile where there is much of it."""
        while self._waiting and until_ns - self.now() >= _CALM_NS:
            self._write(_PIECE)
        return self._wire.wait(until_ns)

    def send(self, out: Outgoing, first: int, last: int) -> int:
        """Send datagrams ``first`` up to ``last``, not included; return how many left."""
        now = self.now()
        left = self._wire.send(out, first, last)
        for index in range(first, last):
            self._keep(now, *self.ends, out[index])
        return left

    def put(self, payload: bytes) -> bool:
        """Send one datagram of the caller's own; tell whether it left."""
        self._keep(self.now(), *self.ends, payload)
        return self._wire.put(payload)

    def receive(self) -> list[Arrival]:
        """Return what has arrived."""
        arrived = self._wire.receive()
        now = self.now()
        for item in arrived:
            self._keep(now, item.source, item.destination, item.payload)
        return arrived

    def note(self, faults: Sequence[Fault]) -> None:
        """Take what was done on purpose."""
        self._faults += faults

    def close(self) -> None:
        """Write what is left, and make the recording whole.

        Raises:
            CaptureError: it cannot be written.
        """
        try:
            while self._waiting or self._faults:
                self._write(_MOST)
        finally:
            self._sink.close(self._source.statistics)

    def _keep(self, now: int, source: Endpoint, destination: Endpoint, payload: bytes) -> None:
        self._waiting.append(Sent(now + self._epoch_ns, source, destination, payload))
        if len(self._waiting) >= _MOST:
            self._write(_MOST)

    def _write(self, most: int) -> None:
        rows, self._waiting = self._waiting[:most], self._waiting[most:]
        if rows:
            frames = frames_of(rows, self._source.statistics.frames + 1)
            batch = self._demux.demux(frames)
            self._sink.write(batch, self._bench.columns.decode(batch))
            self._source.statistics.frames += len(frames)
            self._source.statistics.datagrams += len(batch)
        if self._faults and isinstance(self._sink, McapSink | Rosbag2Sink):
            self._sink.write_faults(self._faults)
        self._faults = []
        self._sink.flush()
