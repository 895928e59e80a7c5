"""Collects the values of a field over time while an input is read, in bounded memory."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from edoras_tools.render.plot.figure import PlotLine, extremes
from edoras_tools.ros.cdr.columns import Ragged

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from edoras_tools.io.formats.columns import TableColumn

_MOST: Final = 1 << 20
"""Most values of a line; a line with more is thinned."""
_COLUMNS: Final = 1 << 15
"""Parts of its time of which a thinned line keeps the least and the greatest value."""


class Values(msgspec.Struct):
    """The values of a field, in order of arrival."""

    _seconds: list[NDArray[np.float64]] = msgspec.field(default_factory=list)
    _values: list[NDArray[np.float64]] = msgspec.field(default_factory=list)
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
        """Return all values as a line."""
        self._join()
        return PlotLine("", recording, self._seconds[0], self._values[0], self._read, self._not_finite)


def numbers(
    column: TableColumn, index: int | None
) -> Iterator[tuple[int | None, NDArray[np.intp], NDArray[Any]]]:
    """Yield the numbers of a column: the element in its list, the rows that have it, their values.

    Args:
        index: the only element of lists to yield; None for all.
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
