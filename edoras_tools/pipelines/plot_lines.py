"""Collects counts over time while an input is read, in bounded memory."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from edoras_tools.render.plot.figure import PlotLine

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.wire.arrays.order import Integers

_FINEST: Final = 0.1
"""Seconds of one interval in which messages are counted."""
_BARS: Final = 100
"""Most values of a rate."""
_MOST_PARTS: Final = 1_000_000
"""Most intervals that spans of messages are spread over."""


class RateCounts(msgspec.Struct):
    """Number of messages over time.

    Attributes:
        spread: number of messages with a span instead of a time; they are counted evenly over it.
    """

    spread: int = 0
    _parts: list[Integers] = msgspec.field(default_factory=list)
    _numbers: list[NDArray[np.float64]] = msgspec.field(default_factory=list)

    def add(self, seconds: NDArray[np.float64], numbers: NDArray[Any] | None = None) -> None:
        """Add messages.

        Args:
            seconds: times of the messages, s.
            numbers: number of messages of each row; one by default.
        """
        parts, places = np.unique(np.floor(seconds / _FINEST).astype(np.int64), return_inverse=True)
        self._parts.append(parts)
        self._numbers.append(np.bincount(places, numbers, len(parts)).astype(np.float64))

    def add_spans(self, begin: NDArray[np.float64], end: NDArray[np.float64], numbers: Integers) -> None:
        """Add messages with a span of time instead of a time.

        Spans beyond a day use coarser intervals: a clock that was set during a run gives spans of decades.

        Args:
            begin: starts of the spans, s.
            end: ends of the spans, s; not before ``begin``.
            numbers: number of messages of each row.
        """
        first, last = (np.floor(item / _FINEST).astype(np.int64) for item in (begin, end))
        exact = first == last
        self.add(begin[exact], numbers[exact])
        if exact.all():
            return
        first, last, counts = first[~exact], last[~exact], numbers[~exact]
        self.spread += int(counts.sum())
        start = int(first.min())
        coarse = (int(last.max()) - start) // _MOST_PARTS + 1
        first, last = (first - start) // coarse, (last - start) // coarse
        steps = np.zeros(int(last.max()) + 2)
        share = counts / (last - first + 1)
        np.add.at(steps, first, share)
        np.add.at(steps, last + 1, -share)
        self._parts.append(start + np.arange(len(steps) - 1) * coarse)
        self._numbers.append(np.cumsum(steps)[:-1].clip(0))

    def join(self, other: RateCounts) -> None:
        """Add the messages of another count."""
        self.spread += other.spread
        self._parts += other._parts
        self._numbers += other._numbers

    @property
    def total(self) -> int:
        """Number of all messages."""
        return round(sum(float(part.sum()) for part in self._numbers))

    def line(self, recording: int, span: tuple[float, float], width: float, label: str = "") -> PlotLine:
        """Return the messages per second over time.

        Args:
            recording: index of the recording.
            span: first and last time of the chart, s.
            width: seconds of one mean, a multiple of 0.1; the last mean covers the rest, 0.5 to 1.5 times as
                long.
            label: label in the legend.
        """
        begin = math.floor(span[0] / _FINEST + 1e-9) * _FINEST
        count = max(1, round((span[1] - begin) / width))
        edges = np.append(begin + np.arange(count) * width, span[1])
        rates = np.zeros(count)
        if self._parts:
            moments = (np.concatenate(self._parts) + 0.5) * _FINEST
            parts = np.floor((moments - begin) / width).astype(np.int64)
            np.add.at(rates, parts.clip(0, count - 1), np.concatenate(self._numbers))
        rates /= np.diff(edges).clip(_FINEST)
        return PlotLine(label, recording, (edges[1:] + edges[:-1]) / 2, rates, self.total)


def bar_seconds(span: tuple[float, float], most: int = _BARS) -> float:
    """Return the seconds of one mean: a round number that divides a span into at most ``most`` parts."""
    least = max((span[1] - span[0]) / most, _FINEST)
    unit = 10.0 ** math.floor(math.log10(least) + 1e-9)
    return next(unit * factor for factor in (1, 2, 5, 10) if unit * factor >= least * (1 - 1e-9))
