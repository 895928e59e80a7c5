"""Chains of records: the place of the next record is known only from the length of the one before it.

pcap records, pcapng blocks, the packets of a TPACKET_V3 block and MCAP records are all such chains. ``walk``
follows many stretches of one chain at a time: it starts at the one place known to be a record and at
*seeds*, places that look like records, and moves all of them on together, one numpy operation for a step of
each.
A stretch counts only when the proven chain runs into its seed, so the result is exactly that of walking from
record to record, whatever the payloads hold; a bad seed costs time, never truth.
"""

from __future__ import annotations

from bisect import bisect_left
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

PADDING = 64
"""Bytes that must be readable behind the last byte in use, so that header windows never leave a buffer."""
_LANES = 16
"""With fewer stretches under way than this, a step of all of them costs more than steps one by one."""
_BLOCK = 16
"""Steps between two looks at which stretches have arrived."""


def walk(
    start: int,
    end: int,
    seeds: NDArray[np.int64],
    successor: Callable[[NDArray[np.int64]], NDArray[np.int64]],
    step: Callable[[int], int],
) -> tuple[NDArray[np.int64], int]:
    """Follow a chain of records from ``start`` as far as they are whole.

    Args:
        start: position of the first record.
        end: one past the last byte that is there.
        seeds: increasing positions that may be records; none is needed, good ones make it fast.
        successor: position of the record after each of the given ones, never less than the given one; the
            given one itself where the chain cannot go on. It is asked about positions up to ``end + 1``.
        step: the same for one position.

    Returns:
        The positions of all whole records (those whose successor is not past ``end``), and the position
        where the walk stopped: ``end``, or the first record that is not whole or cannot be passed.
    """
    seeds = seeds[(seeds > start) & (seeds < end)]
    starts = np.concatenate((np.array([start], dtype=np.int64), seeds))
    found, counts, landings = _march(starts, np.append(seeds, end), end, successor)
    bases = np.cumsum(counts) - counts
    joined = landings[:-1] == starts[1:]
    if joined.all() and landings[-1] == end:
        return found, end
    # The last lane is a break too: nothing follows it.
    breaks = np.append(np.flatnonzero(~joined), len(starts) - 1)
    begins = starts.tolist()
    pieces: list[NDArray[np.int64]] = []
    lane = 0
    while True:
        last = int(breaks[np.searchsorted(breaks, lane)])
        pieces.append(found[bases[lane] : bases[last] + counts[last]])
        position = int(landings[last])
        singles: list[int] = []
        while (lane := bisect_left(begins, position, last + 1)) == len(begins) or begins[lane] != position:
            after = step(position) if position < end else position
            if not position < after <= end:
                pieces.append(np.array(singles, dtype=np.int64))
                return np.concatenate(pieces), position
            singles.append(position)
            position = after
        pieces.append(np.array(singles, dtype=np.int64))


def _march(
    starts: NDArray[np.int64],
    limits: NDArray[np.int64],
    end: int,
    successor: Callable[[NDArray[np.int64]], NDArray[np.int64]],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Walk every stretch from its start up to its limit, all of them in step.

    Returns:
        The whole records below their stretch's limit, stretch by stretch; how many each stretch has; and
        where each stands: at or past its limit, or short of it when it could not go on or was left behind.
    """
    counts = np.zeros(len(starts), dtype=np.int64)
    landings = starts.copy()
    lanes = np.arange(len(starts))
    blocks = [np.empty(0, dtype=np.int64)]
    while len(lanes) >= _LANES:
        track = np.empty((_BLOCK + 1, len(lanes)), dtype=np.int64)
        track[0] = landings[lanes]
        for here, there in pairwise(track):
            np.minimum(successor(here), end + 1, out=there)
        here, there = track[:-1], track[1:]
        whole = (here < limits[lanes]) & (there > here) & (there <= end)
        steps = whole.sum(axis=0)
        blocks.append(here[whole])
        counts[lanes] += steps
        landings[lanes] = track[steps, np.arange(len(lanes))]
        lanes = lanes[steps == _BLOCK]
    # No stretch reaches into the next one, so in order of position is stretch by stretch.
    return np.sort(np.concatenate(blocks)), counts, landings
