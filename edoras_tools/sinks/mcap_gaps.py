"""Missing packets told from sequence counts, a batch at a time."""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.sessions.sequence import SequenceTracker, runs

if TYPE_CHECKING:
    from numpy.typing import NDArray

_MAX_FLOWS = 65536
"""Garbage could name any number of flows; beyond this many known ones, all are forgotten."""


class SequenceGaps:
    """Counts what is missing before each packet of a flow: one MsgId of one sender on a link."""

    def __init__(self) -> None:
        self._trackers: defaultdict[int, SequenceTracker] = defaultdict(SequenceTracker)

    def missing(self, flow: NDArray[np.int64], count: NDArray[np.uint16]) -> NDArray[np.int64]:
        """Return for each packet how many are missing right before it.

        It is negative where a packet tells that what was counted as missing before was not.

        Args:
            flow: i64, the flow of each packet; those of one flow side by side, in the order they came.
            count: u16, packet sequence count.
        """
        missing = np.zeros(len(flow), dtype=np.int64)
        if not len(flow):
            return missing
        if len(self._trackers) > _MAX_FLOWS:
            self._trackers.clear()
        begins = np.append(0, np.flatnonzero(np.diff(flow)) + 1)
        trackers = [self._trackers[key] for key in flow[begins].tolist()]
        for owner, row, first, last in runs(count, begins):
            tracker = trackers[owner]
            before = tracker.gaps
            tracker.follow(first, last)
            if tracker.gaps != before:
                missing[row] = tracker.gaps - before
        return missing
