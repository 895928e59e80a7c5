"""Sets of many whole numbers as ranges: bytes of a file, sequence numbers of a writer."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterator
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from edoras_tools.wire.arrays import Integers, Mask

MOST_RANGES: Final = 1 << 12


class KnownRanges:
    """The bytes of a file, or sequence numbers, that are present, as ordered ranges that do not touch."""

    def __init__(self) -> None:
        self._starts: list[int] = []
        self._ends: list[int] = []

    def __iter__(self) -> Iterator[tuple[int, int]]:
        return zip(self._starts, self._ends, strict=True)

    @property
    def end(self) -> int:
        """The last number in the set, plus 1; 0 if it is empty."""
        return self._ends[-1] if self._ends else 0

    @property
    def size(self) -> int:
        """The size of the set."""
        return sum(self._ends) - sum(self._starts)

    @property
    def count(self) -> int:
        """The number of ranges."""
        return len(self._starts)

    def start_of(self, index: int) -> int:
        """Return the first number of a range."""
        return self._starts[index]

    def forget(self, before: int) -> None:
        """Remove all numbers below one."""
        at = bisect_right(self._ends, before)
        del self._starts[:at], self._ends[:at]
        if self._starts:
            self._starts[0] = max(self._starts[0], before)

    def missing(self, start: int, end: int) -> list[tuple[int, int]]:
        """Return the parts of a range that are not in the set."""
        gaps = []
        for index in range(bisect_left(self._ends, start), bisect_right(self._starts, end)):
            if start < self._starts[index]:
                gaps.append((start, self._starts[index]))
            start = max(start, self._ends[index])
        return [*gaps, (start, end)] if start < end else gaps

    def add(self, start: int, end: int) -> bool:
        """Add a range and return True; if there are too many, one that touches no other is ignored: False."""
        first, last = bisect_left(self._ends, start), bisect_right(self._starts, end)
        if first < last:
            start, end = min(start, self._starts[first]), max(end, self._ends[last - 1])
        elif len(self._starts) >= MOST_RANGES:
            return False
        self._starts[first:last] = [start]
        self._ends[first:last] = [end]
        return True

    def fresh(self, numbers: Integers) -> Mask:
        """Add numbers; return which of them were not in the set, each at its first place, bool (n,)."""
        distinct, first = np.unique(numbers, return_index=True)
        starts, ends = np.array(self._starts, np.int64), np.array(self._ends, np.int64)
        before = np.searchsorted(starts, distinct, side="right")
        new = before == 0
        new[~new] = ends[before[~new] - 1] <= distinct[~new]
        out = np.zeros(len(numbers), bool)
        out[first[new]] = True
        added = distinct[new]
        breaks = np.flatnonzero(np.diff(added) != 1) + 1
        for run in np.split(added, breaks) if len(added) else ():
            self.add(int(run[0]), int(run[-1]) + 1)
        return out
