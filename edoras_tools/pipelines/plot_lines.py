"""Collects values and counts over time while an input is read, in bounded memory."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.render.plot.figure import PlotLine, extremes
from edoras_tools.ros.cdr.columns import Ragged

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from edoras_tools.io.formats.columns import TableColumn

_MOST: Final = 1 << 20
"""Values of a line from which on it is thinned."""
_COLUMNS: Final = 1 << 15
"""Parts of its time that then keep their least and greatest value."""
_FINEST: Final = 0.1
"""Seconds of the parts in which messages are counted."""
_BARS: Final = 100
"""Values of a rate, at most."""
_MOST_PARTS: Final = 1_000_000
"""Places that messages are spread over."""


@dataclass(slots=True)
class Values:
    """The values of a field, as they come."""

    _seconds: list[NDArray[np.float64]] = field(default_factory=list)
    _values: list[NDArray[np.float64]] = field(default_factory=list)
    _count: int = 0
    _read: int = 0
    _not_finite: int = 0

    def add(self, seconds: NDArray[np.float64], values: NDArray[Any]) -> None:
        """Add values and their times."""
        numbers = values.astype(np.float64)
        finite = np.isfinite(numbers)
        if not finite.all():
            self._not_finite += int(len(numbers) - finite.sum())
            seconds, numbers = seconds[finite], numbers[finite]
        self._seconds.append(seconds)
        self._values.append(numbers)
        self._read += len(numbers)
        self._count += len(numbers)
        if self._count > _MOST:
            self._join()
            seconds, numbers = self._seconds[0], self._values[0]
            rows = extremes(seconds, numbers, _COLUMNS, (seconds[0], seconds[-1]))
            self._seconds, self._values, self._count = [seconds[rows]], [numbers[rows]], len(rows)

    def _join(self) -> None:
        seconds, values = np.concatenate(self._seconds), np.concatenate(self._values)
        order = np.argsort(seconds, kind="stable")
        self._seconds, self._values = [seconds[order]], [values[order]]

    def line(self, recording: int) -> PlotLine:
        """Return all of them."""
        self._join()
        return PlotLine("", recording, self._seconds[0], self._values[0], self._read, self._not_finite)


@dataclass(slots=True)
class RateCounts:
    """How many messages there were, by time.

    Attributes:
        spread: messages of which only a span of time is known; they are counted evenly over it.
    """

    spread: int = 0
    _parts: list[NDArray[np.int64]] = field(default_factory=list)
    _numbers: list[NDArray[np.float64]] = field(default_factory=list)

    def add(self, seconds: NDArray[np.float64], numbers: NDArray[Any] | None = None) -> None:
        """Add messages.

        Args:
            seconds: their times.
            numbers: how many each row stands for; one by default.
        """
        parts, places = np.unique(np.floor(seconds / _FINEST).astype(np.int64), return_inverse=True)
        self._parts.append(parts)
        self._numbers.append(np.bincount(places, numbers, len(parts)).astype(np.float64))

    def add_spans(
        self, begin: NDArray[np.float64], end: NDArray[np.float64], numbers: NDArray[np.int64]
    ) -> None:
        """Add messages of which only is known between which two times they were.

        Beyond a day they are placed less finely: a clock that is set on the way gives spans of decades.

        Args:
            begin: from when, s.
            end: until when, s; not before ``begin``.
            numbers: how many each row stands for.
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
        """All of them."""
        return round(sum(float(part.sum()) for part in self._numbers))

    def line(self, recording: int, span: tuple[float, float], width: float, label: str = "") -> PlotLine:
        """Return how many there were per second.

        Args:
            recording: place of the recording.
            span: the time that is drawn.
            width: seconds over which a rate is the mean, a multiple of 0.1; the last mean is over what is
                left, half as long to one and a half times.
            label: in the legend.
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


def bar_seconds(span: tuple[float, float]) -> float:
    """Return the seconds over which a rate is the mean: a round number, at most 100 in a span."""
    least = max((span[1] - span[0]) / _BARS, _FINEST)
    unit = 10.0 ** math.floor(math.log10(least) + 1e-9)
    return next(unit * factor for factor in (1, 2, 5, 10) if unit * factor >= least * (1 - 1e-9))


def numbers(
    column: TableColumn, index: int | None
) -> Iterator[tuple[int | None, NDArray[np.intp], NDArray[Any]]]:
    """Yield the numbers of a column: the element in its list, the rows that have it, their values.

    Args:
        index: only this element of lists.
    """
    values = column.values
    rows = np.arange(len(values)) if column.present is None else np.flatnonzero(column.present)
    if isinstance(values, Ragged):
        starts, lengths = values.offsets[:-1], np.diff(values.offsets)
        elements = range(int(lengths.max(initial=0))) if index is None else (index,)
        for place in elements:
            holders = rows[lengths[rows] > place]
            yield place, holders, values.values[starts[holders] + place]
    elif values.ndim == 2:
        for place in range(values.shape[1]) if index is None else (index,):
            yield place, rows, values[rows, place]
    else:
        yield None, rows, values[rows]
