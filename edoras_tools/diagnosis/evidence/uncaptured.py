"""What the capture itself lacks: times in which nothing was captured, and what the host's kernel dropped.

The capture has a hole if nothing was captured although everybody went on sending:

1. Nothing at all was captured for longer than Telemetry Output and SBN ever wait.
2. What cFS counts went on meanwhile: most of its streams miss counts there.
3. Others who sent steadily were not captured either: those who command, or a second SBN peer. A network that
   fails between two of them does not hide both.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.links.table import among
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire.arrays.order import by_value, numbered

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.evidence.table import Rows
    from edoras_tools.model import HostCounters


_LEAST_NS: Final = 1500 * MILLISECOND
"""Telemetry Output wakes up three times in so long."""
_AROUND_NS: Final = 30 * SECOND
_IDLE_NS: Final = SECOND
_LEAST_ROWS: Final = 2
_LEAST_STREAMS: Final = 3
_MOST: Final = 64
"""Holes that are told, the longest."""


def find_holes(rows: Rows) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Return from when to when the capture has holes, and may have; rows are in order of time.

    It may have one where nothing at all was captured, cFS went on counting, and no other shows that it went
    on sending.
    """
    steps = np.diff(rows.time_ns)
    long = np.flatnonzero(steps >= _LEAST_NS)
    if not len(long):
        return [], []
    long = np.sort(long[np.argsort(-steps[long], kind="stable")[:_MOST]])
    streams = _streams(rows)
    commands = rows.time_ns[among(rows.link, lambda link: link.only_to_cfs)]
    network = np.flatnonzero(among(rows.link, lambda link: link.peers))
    who = rows.spacecraft_id[network].astype(np.int64) << 32 | rows.processor_id[network]
    peers = [rows.time_ns[network[members]] for _, members in by_value(who)]
    found: tuple[list[tuple[int, int]], ...] = [], []
    for start_ns, end_ns in zip(rows.time_ns[long].tolist(), rows.time_ns[long + 1].tolist(), strict=True):
        others = _steady(commands, start_ns, end_ns)
        others |= sum(_steady(times, start_ns, end_ns) for times in peers) > 1
        if _went_on(rows, streams, start_ns, end_ns):
            found[not others].append((start_ns, end_ns))
    return found[0], found[1]


def _streams(rows: Rows) -> list[NDArray[np.intp]]:
    """Return the rows of each stream that cFS counts."""
    counted = np.flatnonzero(rows.counted & among(rows.link, lambda link: link.from_cfs))
    keys = (rows.link, rows.source, rows.destination, rows.processor_id, rows.msg_id)
    _, which = numbered(*(key[counted].astype(np.int64) for key in keys))
    return [counted[members] for _, members in by_value(which)]


def _steady(times: NDArray[np.int64], start_ns: int, end_ns: int) -> bool:
    """Tell whether someone sent before and after a time, and far more often than once in so long."""
    at = int(np.searchsorted(times, start_ns, "right"))
    before, after = times[:at], times[at:]
    before, after = before[before > start_ns - _AROUND_NS], after[after < end_ns + _AROUND_NS]
    if min(len(before), len(after)) < _LEAST_ROWS:
        return False
    usual = np.quantile(np.concatenate((np.diff(before), np.diff(after))), 0.9)
    idle = max(start_ns - int(before[-1]), int(after[0]) - end_ns)
    return bool(1.5 * usual < end_ns - start_ns and idle <= max(3 * usual, _IDLE_NS))


def _went_on(rows: Rows, streams: Sequence[NDArray[np.intp]], start_ns: int, end_ns: int) -> bool:
    """Tell whether most streams that are there before and after a time miss counts in it."""
    missing = there = 0
    for own in streams:
        at = int(np.searchsorted(rows.time_ns[own], start_ns, "right"))
        if _steady(rows.time_ns[own], start_ns, end_ns):
            there += 1
            missing += bool(rows.missing[own[at]] > 0)
    return missing >= _LEAST_STREAMS and 2 * missing > there


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
