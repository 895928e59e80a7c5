"""What the kernel of the recording host dropped while the capture ran, from its counters."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.model import HostCounters


@dataclass(frozen=True, slots=True)
class HostDrops:
    """Increases of the kernel's counters.

    Attributes:
        by_port: datagrams dropped by full sockets, by UDP port; only ports that dropped some.
        reassembly_failures: IP packets whose fragments did not all come.
        interface_drops: frames that interfaces dropped on receipt.
        ports: UDP ports that a socket was open on.
    """

    by_port: dict[int, int]
    reassembly_failures: int = 0
    interface_drops: int = 0
    ports: frozenset[int] = frozenset()


def host_drops(readings: Sequence[HostCounters], start_ns: int, end_ns: int) -> HostDrops:
    """Return what was dropped between two times, as closely as the readings tell.

    Args:
        readings: oldest first.
        start_ns: ns since 1970; the last reading before it is the one that counting begins at.
        end_ns: the first reading after it is the one that counting ends at.
    """
    before = [item for item in readings if item.time_ns <= start_ns] or list(readings[:1])
    after = next((at for at, item in enumerate(readings) if item.time_ns >= end_ns), len(readings) - 1)
    used = [item for item in readings[: after + 1] if item.time_ns >= before[-1].time_ns] if before else []
    if not used:
        return HostDrops({})
    first = {item.inode: item.drops for item in used[0].sockets}
    last = {item.inode: item for reading in used for item in reading.sockets}
    dropped: Counter[int] = Counter()
    for inode, item in last.items():
        dropped[item.port] += max(0, item.drops - first.get(inode, 0))

    def increase(name: str) -> int:
        values = [value for item in used if (value := getattr(item, name)) is not None]
        return max(0, values[-1] - values[0]) if values else 0

    return HostDrops(
        {port: count for port, count in sorted(dropped.items()) if count},
        increase("reassembly_failures"),
        increase("interface_drops"),
        frozenset(item.port for item in last.values()),
    )
