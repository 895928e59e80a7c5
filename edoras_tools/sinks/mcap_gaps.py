"""Missing packets told from sequence counts, a batch at a time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

_MODULUS = 1 << 14
"""CCSDS 133.0-B 4.1.3.4.3: the packet sequence count has 14 bits."""
_MAX_FLOWS = 65536
"""Garbage could name any number of flows; beyond this many known ones, all are forgotten."""


class SequenceGaps:
    """Counts what is missing before each packet of a flow: one MsgId of one sender on a link.

    A count that steps back, by less than half the 14 bits, is a late or repeated packet and no gap.
    """

    def __init__(self) -> None:
        self._flow = np.zeros(0, dtype=np.int64)
        self._last = np.zeros(0, dtype=np.int64)

    def missing(self, flow: NDArray[np.int64], count: NDArray[np.uint16]) -> NDArray[np.int64]:
        """Return for each packet how many are missing right before it.

        Args:
            flow: i64, the flow of each packet; those of one flow side by side, in the order they came.
            count: u16, packet sequence count.
        """
        missing = np.zeros(len(flow), dtype=np.int64)
        if len(flow) == 0:
            return missing
        first = np.append(True, flow[1:] != flow[:-1])
        starts = np.flatnonzero(first)
        count = count.astype(np.int64)
        before = np.append(0, count[:-1])
        place = np.searchsorted(self._flow, flow[starts])
        known = np.append(self._flow, -1)[place] == flow[starts]
        # A flow not met before misses nothing before its first packet.
        before[starts] = np.where(known, np.append(self._last, 0)[place], count[starts] - 1)
        step = (count - before) % _MODULUS
        np.subtract(step, 1, out=missing, where=(step > 1) & (step < _MODULUS // 2))
        self._remember(flow[starts], count[np.append(starts[1:], len(flow)) - 1])
        return missing

    def _remember(self, flow: NDArray[np.int64], last: NDArray[np.int64]) -> None:
        flows = np.append(flow, self._flow)
        self._flow, where = np.unique(flows, return_index=True)
        self._last = np.append(last, self._last)[where]
        if len(self._flow) > _MAX_FLOWS:
            self._flow, self._last = self._flow[:0], self._last[:0]
