"""Times in which nothing was captured although everybody went on sending: the capture has a hole.

1. Nothing at all was captured for longer than Telemetry Output and SBN ever wait.
2. What cFS counts went on meanwhile: most of its streams miss counts there.
3. Others who sent steadily were not captured either: those who command, or a second SBN peer. A network that
   fails between two of them does not hide both.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.links.table import among
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire.arrays.order import by_value, numbered

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.evidence.table import Rows

_LEAST_NS: Final = 1500 * MILLISECOND
"""Telemetry Output wakes up three times in so long."""
_AROUND_NS: Final = 30 * SECOND
_IDLE_NS: Final = SECOND
_LEAST_ROWS: Final = 2
_LEAST_STREAMS: Final = 3
_MOST: Final = 64
"""Holes that are told, the longest."""


def find_holes(rows: Rows) -> list[tuple[int, int]]:
    """Return from when to when the capture has holes; rows are in order of time."""
    steps = np.diff(rows.time_ns)
    long = np.flatnonzero(steps >= _LEAST_NS)
    if not len(long):
        return []
    long = np.sort(long[np.argsort(-steps[long], kind="stable")[:_MOST]])
    streams = _streams(rows)
    commands = rows.time_ns[among(rows.link, lambda link: link.only_to_cfs)]
    network = np.flatnonzero(among(rows.link, lambda link: link.peers))
    who = rows.spacecraft_id[network].astype(np.int64) << 32 | rows.processor_id[network]
    peers = [rows.time_ns[network[members]] for _, members in by_value(who)]
    found = []
    for start_ns, end_ns in zip(rows.time_ns[long].tolist(), rows.time_ns[long + 1].tolist(), strict=True):
        others = _steady(commands, start_ns, end_ns)
        others |= sum(_steady(times, start_ns, end_ns) for times in peers) > 1
        if others and _went_on(rows, streams, start_ns, end_ns):
            found.append((start_ns, end_ns))
    return found


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
