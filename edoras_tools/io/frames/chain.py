"""Chains of records: the position of a record is known only from the length of the one before it.

pcap records, pcapng blocks, the packets of a TPACKET_V3 block and MCAP records are such chains.
``walk_records`` follows several parts of one chain at the same time: it starts at the one position known to
be a record and at *seeds*, positions that look like records, and moves all of them forward, with one numpy
operation for a step of each.
A part counts only if the proven chain reaches its seed, so the result is exactly that of walking from record
to record, whatever the payloads contain; a wrong seed costs time, but never gives a wrong result.
"""

from __future__ import annotations

from bisect import bisect_left
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from edoras_tools.wire.arrays import Integers

    _Successor = Callable[[Integers], Integers]
    """Returns the start of the record after each of some records."""

_LANES = 16
"""Fewest parts for which one step of all of them costs less than single steps."""
_BLOCK = 16
"""Number of steps between two checks of which parts have reached their limit."""


def walk_records(
    start: int, end: int, seeds: Integers, successor: _Successor, step: Callable[[int], int]
) -> tuple[Integers, int]:
    """Follow a chain of records from ``start`` as far as the records are complete.

    Args:
        start: position of the first record.
        end: one past the last available byte.
        seeds: increasing positions that may be records; optional, good ones make the walk fast.
        successor: returns the position of the record after each given one, never less than that; the given
            position itself if the chain cannot continue. Its arguments go up to ``end + 1``.
        step: the same function for a single position.

    Returns:
        The positions of all complete records (whose successor is not past ``end``), and the position where
        the walk stopped: ``end``, or the first record that is incomplete or cannot be passed.
    """
    seeds = seeds[(seeds > start) & (seeds < end)]
    starts = np.concatenate((np.array([start], dtype=np.int64), seeds))
    positions, counts, landings = _march(starts, np.append(seeds, end), end, successor)
    bases = np.cumsum(counts) - counts
    joined = landings[:-1] == starts[1:]
    if joined.all() and landings[-1] == end:
        return positions, end
    # The last part also ends with a break, because nothing follows it.
    breaks = np.append(np.flatnonzero(~joined), len(starts) - 1)
    begins = starts.tolist()
    pieces: list[Integers] = []
    lane = 0
    while True:
        last = int(breaks[np.searchsorted(breaks, lane)])
        pieces.append(positions[bases[lane] : bases[last] + counts[last]])
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
    starts: Integers, limits: Integers, end: int, successor: _Successor
) -> tuple[Integers, Integers, Integers]:
    """Walk every part from its start up to its limit, all at the same time.

    Returns:
        The complete records below each part's limit, part by part; their number in each part; and the
        position where each part ended: at or past its limit, or before it if it could not continue or was
        left to single steps.
    """
    counts = np.zeros(len(starts), dtype=np.int64)
    landings = starts.copy()
    lanes = np.arange(len(starts))
    blocks = [np.empty(0, dtype=np.int64)]
    while len(lanes) >= _LANES:
        track = np.empty((_BLOCK + 1, len(lanes)), dtype=np.int64)
        track[0] = landings[lanes]
        for positions, following in pairwise(track):
            np.minimum(successor(positions), end + 1, out=following)
        positions, following = track[:-1], track[1:]
        whole = (positions < limits[lanes]) & (following > positions) & (following <= end)
        steps = whole.sum(axis=0)
        blocks.append(positions[whole])
        counts[lanes] += steps
        landings[lanes] = track[steps, np.arange(len(lanes))]
        lanes = lanes[steps == _BLOCK]
    # No part reaches into the next one, so sorting by position gives the order of the parts.
    # Blocks are runs, which a stable sort merges.
    return np.sort(np.concatenate(blocks), kind="stable"), counts, landings
