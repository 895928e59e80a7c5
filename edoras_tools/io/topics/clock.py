"""Mission time to UTC, by the clock of the capture."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.links import table
from edoras_tools.wire.arrays.order import order_by

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.model import Columns

_JUMP_NS = 5_000_000_000
"""A change of a sender's offset that only a restart or a clock that was set can explain."""
_MAX_SENDERS = 4096
"""Corrupt packets could name any number of senders; above this number the oldest are forgotten."""
_FEW = 128
"""Up to this many senders and jumps in a batch, one call for each is faster."""


class MissionClock:
    """Offset of each sender's mission clock from UTC: the smallest (capture time - mission time) so far.

    Delays only increase it, so the smallest is the best estimate. A sender is a (link, ProcessorID).
    When the offset changes by more than 5 s, the sender's clock was reset, and the estimate starts again.
    """

    def __init__(self) -> None:
        self._link = np.zeros(0, dtype=np.uint8)
        self._processor = np.zeros(0, dtype=np.uint32)
        self._least = np.zeros(0, dtype=np.int64)
        self._last = np.zeros(0, dtype=np.int64)

    def publish_times(self, time_ns: NDArray[np.int64], columns: Columns) -> NDArray[np.int64]:
        """Return the time in each packet, ns since 1970 UTC; its capture time if it has none.

        A mission time of 0 is no time: cFS counts from a start offset, and senders without a clock write 0.

        Args:
            time_ns: i64, capture time.
        """
        rows = np.flatnonzero(columns.mission_time_ns > 0)
        published = time_ns.copy()
        if len(rows) == 0:
            return published
        mission = columns.mission_time_ns[rows]
        # Each sender's state is put before the batch as two rows: its smallest and its last offset.
        known = len(self._link)
        link = np.concatenate((self._link, self._link, columns.link[rows]))
        processor = np.concatenate((self._processor, self._processor, columns.processor_id[rows]))
        offset = np.concatenate((self._least, self._last, time_ns[rows] - mission))
        order = order_by(link, processor)
        least = np.empty_like(offset)
        least[order], ends = _running_least(link[order], processor[order], offset[order], order < 2 * known)
        published[rows] = mission + least[2 * known :]
        last = order[ends]
        if len(last) > _MAX_SENDERS:
            last = np.sort(last)[-_MAX_SENDERS:]
        self._link, self._processor = link[last], processor[last]
        self._least, self._last = least[last], offset[last]
        return published

    def offsets(self) -> dict[str, int]:
        """Return the offset of each sender in ns, named ``LINK/PROCESSOR``, e.g. ``to/0``."""
        senders = zip(self._link.tolist(), self._processor.tolist(), self._least.tolist(), strict=True)
        return {f"{table.link(link).label}/{processor}": least for link, processor, least in senders}


def _running_least(
    link: NDArray[np.uint8],
    processor: NDArray[np.uint32],
    offset: NDArray[np.int64],
    known: NDArray[np.bool_],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the running minimum of each sender's offsets, reset at jumps, and each sender's last state."""
    changes = (link[1:] != link[:-1]) | (processor[1:] != processor[:-1])
    # There is no jump between a sender's stored smallest and last offset: the offset changed slowly.
    jumps = (np.abs(np.diff(offset)) > _JUMP_NS) & ~(known[1:] & known[:-1])
    starts = np.concatenate(([0], np.flatnonzero(changes | jumps) + 1))
    if len(starts) <= _FEW:
        least = np.empty_like(offset)
        for first, end in pairwise([*starts.tolist(), len(offset)]):
            np.minimum.accumulate(offset[first:end], out=least[first:end])
        return least, np.append(np.flatnonzero(changes), len(offset) - 1)
    segment = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(offset))))
    # One accumulate for all segments: each is shifted down so far that no earlier value can be smaller.
    step = (1 << 62) // (len(starts) + 1)
    base = offset[starts][segment]
    moved = np.clip(offset - base, -(step // 2) + 1, step // 2 - 1) - segment * step
    least = np.minimum.accumulate(moved) + segment * step + base
    return least, np.append(np.flatnonzero(changes), len(offset) - 1)
