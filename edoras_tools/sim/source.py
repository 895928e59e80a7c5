"""A simulation as a source of datagrams: no sockets, no privilege, and as fast as it can be computed."""

from __future__ import annotations

import ipaddress
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.model import SourceInfo, SourceStatistics
from edoras_tools.sessions.profile import SECOND
from edoras_tools.sources.framing import PADDING
from edoras_tools.sources.linklayer import Demux, FrameBatch
from edoras_tools.sources.rawip import ROOM, write_headers

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from edoras_tools.model import Endpoint, PacketBatch
    from edoras_tools.sim.simulation import Sent, Simulation

_RAW_IP: Final = 101
_VERSION: Final = 4


class SimulatedSource:
    """A ``Source`` over a simulation in simulated time: a batch for every second of it.

    Args:
        simulation: what to run, from where it stands.
        duration_ns: how long.

    Attributes:
        info: what the source is.
        statistics: what it counted so far.
    """

    def __init__(self, simulation: Simulation, duration_ns: int) -> None:
        self.info = SourceInfo(name=f"emulated {simulation.scenario}", kind="sim", time_resolution_ns=1)
        self.statistics = SourceStatistics()
        self._simulation = simulation
        self._end_ns = simulation.now + duration_ns
        self._demux = Demux()

    def batches(self) -> Iterator[PacketBatch]:
        """Run, a second at a time."""
        while self._simulation.now < self._end_ns:
            until = min(self._simulation.now + SECOND, self._end_ns)
            sent = list(self._simulation.run(until))
            if sent:
                frames = frames_of(sent, self.statistics.frames + 1)
                self.statistics.frames += len(frames)
                self.statistics.datagrams += len(frames)
                self.statistics.bytes += int(frames.length.sum())
                yield self._demux.demux(frames)

    def close(self) -> None:
        """Hold nothing."""


def frames_of(sent: Sequence[Sent], number: int = 1) -> FrameBatch:
    """Make raw IP frames of datagrams over IPv4.

    Args:
        sent: at least one, in order.
        number: of the first.
    """
    room = ROOM[_VERSION]
    length = np.array([len(item.payload) for item in sent], np.int32)
    stride = room + length.astype(np.int64) + 2 - length % 2
    offset = np.cumsum(stride) - stride
    data = np.zeros(int(stride.sum()) + PADDING, np.uint8)
    for at, item in zip(offset.tolist(), sent, strict=True):
        start = at + room
        data[start : start + len(item.payload)] = np.frombuffer(item.payload, np.uint8)
    write_headers(
        data,
        _VERSION,
        offset,
        length,
        _endpoints([item.source for item in sent]),
        _endpoints([item.destination for item in sent]),
    )
    return FrameBatch(
        data=data,
        number=np.arange(number, number + len(sent), dtype=np.int64),
        time_ns=np.array([item.time_ns for item in sent], np.int64),
        link_type=np.full(len(sent), _RAW_IP, np.uint16),
        offset=offset,
        length=length + np.int32(room),
        original_length=length + np.int32(room),
    )


def _endpoints(
    endpoints: Sequence[Endpoint],
) -> tuple[np.ndarray[tuple[int, int], np.dtype[np.uint8]], np.ndarray[tuple[int], np.dtype[np.uint16]]]:
    """Return addresses, 4 bytes a row, and ports."""
    packed = b"".join(ipaddress.IPv4Address(item.address).packed for item in endpoints)
    ports = np.array([item.port for item in endpoints], np.uint16)
    return np.frombuffer(packed, np.uint8).reshape(-1, 4), ports
