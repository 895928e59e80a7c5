"""Spans of time in which a stream did one thing: they end where it pauses or where its rate changes."""

from __future__ import annotations

from bisect import bisect_left, insort
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.units import SECOND
from edoras_tools.wire.arrays.order import quantiles

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.diagnosis.evidence.table import Rows
    from edoras_tools.diagnosis.matching.streams import Stream

_CHANGE: Final = 1.6
"""A rate that differs by this factor for two seconds is another rate."""
_USUAL: Final = 600
"""The usual rate is the median of so many seconds at most,"""
_SILENT: Final = 10
"""and of a silence only so many seconds count."""
_LEAST_HZ: Final = 4.0
_BURST_NS: Final = 60_000_000
_FEW: Final = 4
_WINDOW_NS: Final = 2 * SECOND
_WINDOWS: Final = 3
_STEADY: Final = 0.9
"""Of windows of time that have as many messages as the others."""


@dataclass(frozen=True, slots=True)
class Span:
    """Part of a stream.

    Attributes:
        first: its first row, as an index into the stream's rows.
        last: its last row.
        start_ns: time of the first row.
        end_ns: time of the last row.
        count: rows.
        missing: counts that never came, those behind its last row included.
    """

    first: int
    last: int
    start_ns: int
    end_ns: int
    count: int
    missing: int

    @property
    def seconds(self) -> float:
        """How long it is."""
        return (self.end_ns - self.start_ns) / SECOND

    @property
    def rate_hz(self) -> float:
        """Rows a second."""
        return _rate(self.count, self.seconds)

    @property
    def offered_hz(self) -> float:
        """Rows and missing counts a second."""
        return _rate(self.count + self.missing, self.seconds)


def _rate(count: int, seconds: float) -> float:
    return (count - 1) / seconds if seconds > 0 and count > 1 else 0.0


def spans(stream: Stream, rows: Rows) -> list[Span]:
    """Divide a stream."""
    times = rows.time_ns[stream.rows]
    ends = np.flatnonzero(stream.pauses)
    bounds = [0, *(ends + 1).tolist(), len(times)]
    found: list[Span] = []
    for first, end in pairwise(bounds):
        cuts = _changes(times[first:end], stream.missing[first:end])
        edges = [first, *(first + cut for cut in cuts), end]
        found += [_span(times, stream.missing, low, high - 1) for low, high in pairwise(edges)]
    return found


def _span(times: NDArray[np.int64], missing: NDArray[np.int64], first: int, last: int) -> Span:
    return Span(
        first,
        last,
        int(times[first]),
        int(times[last]),
        last - first + 1,
        int(missing[first : last + 1].sum()),
    )


def _changes(times: NDArray[np.int64], missing: NDArray[np.int64]) -> list[int]:
    """Return the rows at which another rate begins, by whole seconds."""
    if len(times) < _FEW:
        return []
    # A clock that jumps may leave centuries between two rows.
    second = np.cumsum(np.minimum(np.diff((times - times[0]) // SECOND, prepend=0), _SILENT))
    offered = np.bincount(second, weights=1.0 + missing)
    if len(offered) < _FEW:
        return []
    rates, cuts, begin = offered.tolist(), [], 0
    known: list[float] = []  # in order, so that the median needs no sorting
    for at in range(1, len(rates) - 1):
        insort(known, rates[at - 1])
        if len(known) > _USUAL:
            del known[bisect_left(known, rates[at - 1 - _USUAL])]
        if at - begin < 2:
            continue
        usual = (known[(len(known) - 1) // 2] + known[len(known) // 2]) / 2
        low, high = sorted(rates[at : at + 2])
        other = low > usual * _CHANGE or high * _CHANGE < usual
        if other and max(usual, high) - min(usual, low) > _LEAST_HZ:
            cuts.append(int(np.searchsorted(second, at)))
            begin = at
            known.clear()
    return [cut for cut in cuts if 0 < cut < len(times)]


def steady_rate(times: NDArray[np.int64], missing: int = 0) -> float | None:
    """Return at what rate messages came, in Hz, if they came steadily; else None.

    Args:
        times: when each came.
        missing: counts that never came between them: they are of the rate too.
    """
    length = int(times[-1] - times[0]) if len(times) else 0
    if len(times) <= _FEW or not length:
        return None
    window = max(_WINDOW_NS, _FEW * length // (len(times) - 1))
    number = length // window
    if number < _WINDOWS:
        return None
    came = np.bincount((times - times[0]) // window)[:number]
    usual = float(np.median(came))
    near = np.abs(came - usual) <= max(1.0, usual / 4)
    return (len(times) - 1 + missing) * SECOND / length if near.mean() >= _STEADY else None


@dataclass(frozen=True, slots=True)
class Comb:
    """How a stream arrives in rounds.

    Attributes:
        period_ns: from round to round; 0 where it does not come in rounds.
        most: messages in a full round.
        share: of rounds that were full.
    """

    period_ns: int
    most: int
    share: float


def comb(times: NDArray[np.int64]) -> Comb:
    """Tell whether messages come in rounds, as what a task that wakes up now and then sends does."""
    if len(times) < 2 * _FEW:
        return Comb(0, 1, 0.0)
    begins = np.flatnonzero(np.diff(times, prepend=times[0] - SECOND) > _BURST_NS)
    sizes = np.diff(np.append(begins, len(times)))
    most = int(quantiles(sizes, 0.98)[0])
    period = int(np.median(np.diff(times[begins]))) if len(begins) > 2 else 0
    share = float((sizes >= most).mean()) if len(sizes) else 0.0
    return Comb(period, max(most, 1), share)
