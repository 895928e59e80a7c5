"""All offsets and drifts between two clocks that agree with the captures.

Rules:

1. The second clock minus the first clock is a straight line over the time of the first: offset and drift.
2. No effect is captured before its cause. If the cause is in the first capture and the effect in the second,
   the line is at most the difference of their times. In the other direction it is at least that.
3. A message that waits for a periodic task waits at most one cycle. This gives the opposite bound.
4. Each bound cuts a half-plane off the set of lines. The rest is a polygon; its corners give the intervals of
   offset and drift. A line is stored as its values at two times, in ns relative to a base.
5. Two clocks drift by less than 500 ppm, the largest rate at which NTP slews a clock.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.units import MICROSECOND, SECOND

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray
    from typing_extensions import Self

    from edoras_tools.wire.arrays import Integers, Places

MOST_DRIFT: Final = 500e-6
"""Largest drift between two clocks, in ns per ns."""
_RESOLUTION_NS: Final = MICROSECOND
"""Resolution of capture times."""
_WINDOW_NS: Final = 300 * SECOND
"""In a window of this length, at least one of many messages had almost no delay."""
_FAR_NS: Final = 1 << 62
_PLACES: Final = 512
"""Largest number of upper, or of lower, bounds that are used: the tightest one of each part of the time."""


class ClockLine(NamedTuple):
    """The difference between a clock and another clock, which changes linearly.

    Attributes:
        begin_ns: time on the other clock at which ``offset_ns`` holds.
        offset_ns: time by which this clock is ahead of the other one then.
        drift: change of the offset, in ns per ns.
    """

    begin_ns: int
    offset_ns: int
    drift: float = 0.0

    def ahead(self, time_ns: Integers) -> Integers:
        """Return by how much this clock is ahead, i64 ns, at times of the other clock."""
        return self.offset_ns + np.asarray(np.rint((time_ns - self.begin_ns) * self.drift), np.int64)

    def set_back(self, time_ns: Integers) -> Integers:
        """Convert times of this clock to times of the other clock: i64, ns."""
        moved = time_ns - self.offset_ns
        gained = np.rint((moved - self.begin_ns) * (self.drift / (1 + self.drift)))
        return moved - np.asarray(gained, np.int64)


class Ordered(NamedTuple):
    """The n pairs of a cause in one capture and its effect in the other.

    Attributes:
        first_ns: i64 (n,), capture times in the first capture.
        second_ns: i64 (n,), capture times in the second capture.
        back: whether the causes are in the second capture.
        early_ns: largest time by which an effect may be captured before its cause.
        wait_ns: longest delay of the quickest pair; None if unknown.
        each: whether ``wait_ns`` limits the delay of every pair.
        at_once_ns: usual delay of the quickest pair; None if unknown.
        apart_ns: largest difference between the two times that a pair compares, by which drift matters.
    """

    first_ns: Integers
    second_ns: Integers
    back: bool = False
    early_ns: int = 0
    wait_ns: int | None = None
    each: bool = False
    at_once_ns: int | None = None
    apart_ns: int = 0

    @property
    def took_ns(self) -> Integers:
        """Time from cause to effect, each by the clock of its capture: i64 (n,), ns."""
        return self.first_ns - self.second_ns if self.back else self.second_ns - self.first_ns


class _Bounds(NamedTuple):
    """Points that the line has to pass on one side: times of the first clock, and offsets, i64 ns."""

    time_ns: Integers
    ahead_ns: Integers


def _sides(order: Ordered, drift: float) -> tuple[_Bounds, _Bounds]:
    """Return the points that the line stays below, and the points that it stays above."""
    took, apart = order.took_ns, round(order.apart_ns * drift)
    tight = _tightest(order.first_ns, took)
    limit = _Bounds(order.first_ns[tight], took[tight] + order.early_ns + apart)
    waited = _Bounds(tight[:0], tight[:0])
    if order.wait_ns is not None and order.each:
        loose = _tightest(order.first_ns, -took)
        waited = _Bounds(order.first_ns[loose], took[loose] - order.wait_ns - apart)
    elif order.wait_ns is not None:
        quickest = least_of_each((order.first_ns - order.first_ns.min()) // _WINDOW_NS, took)
        # The unknown drift decides which pair is the quickest.
        unsure = round(min(int(np.ptp(order.first_ns)), _WINDOW_NS) * drift)
        waited = _Bounds(order.first_ns[quickest], took[quickest] - order.wait_ns - unsure)
    if order.back:
        return _Bounds(waited.time_ns, -waited.ahead_ns), _Bounds(limit.time_ns, -limit.ahead_ns)
    return limit, waited


def _tightest(time_ns: Integers, value: Integers) -> Places:
    """Return the rows of the least value in each of ``_PLACES`` equal parts of the time: intp."""
    if len(value) <= _PLACES:
        return np.arange(len(value))
    begin = int(time_ns.min())
    return least_of_each((time_ns - begin) * _PLACES // (int(time_ns.max()) - begin + 1), value)


def least_of_each(group: Integers, value: Integers) -> Places:
    """Return the row of the least value of each group, intp; groups are numbers from 0."""
    order = np.lexsort((value, group))
    return order[np.flatnonzero(np.diff(group[order], prepend=-1))]


def one_way(first_ns: Integers, second_ns: Integers, *, back: bool = False) -> list[Ordered]:
    """Return the bounds from packets that all went from the first capture to the second, or all back.

    The only lower bound is an assumption: the quickest delays are not longer than delays vary. The lower
    convex hull of all delays gives the two quickest packets: one early, one late.

    Args:
        first_ns: i64 (n,), capture times in the first capture.
        second_ns: i64 (n,), capture times in the second capture.
    """
    sent_ns = second_ns if back else first_ns
    took = Ordered(first_ns, second_ns, back).took_ns
    tight = _tightest(sent_ns, took)
    hull: list[int] = []
    for row in tight[np.lexsort((took[tight], sent_ns[tight]))].tolist():
        while len(hull) > 1 and _above(sent_ns, took, hull[-2], hull[-1], row):
            hull.pop()
        if not hull or sent_ns[row] > sent_ns[hull[-1]]:
            hull.append(row)
    middle = (int(sent_ns.min()) + int(sent_ns.max())) // 2
    late = next((at for at, row in enumerate(hull) if sent_ns[row] >= middle), len(hull) - 1)
    touched = np.array(hull[max(late - 1, 0) : late + 1])
    first, right = int(touched[0]), int(touched[-1])
    slope = (took[right] - took[first]) / max(sent_ns[right] - sent_ns[first], 1)
    vary = int(np.median(took - took[first] - (sent_ns - sent_ns[first]) * slope))
    return [
        Ordered(first_ns, second_ns, back),
        Ordered(first_ns[touched], second_ns[touched], back, wait_ns=max(vary, 0), each=True),
    ]


def _above(time_ns: Integers, value: Integers, left: int, at: int, right: int) -> bool:
    """Return whether a point is on or above the line between the points on its left and on its right."""
    rise = int(value[right] - value[left]) * int(time_ns[at] - time_ns[left])
    return int(value[at] - value[left]) * int(time_ns[right] - time_ns[left]) >= rise


def quickest_ahead(order: Ordered, begin_ns: int, drift: float) -> int:
    """Return the offset at ``begin_ns``, ns, from the quickest pair, whose delay is ``at_once_ns``."""
    took = order.took_ns - (order.at_once_ns or 0)
    moved = (-took if order.back else took) - np.rint((order.first_ns - begin_ns) * drift).astype(np.int64)
    return int(moved.max() if order.back else moved.min())


def constant_offset(orders: Sequence[Ordered]) -> tuple[int, int]:
    """Return the interval of the offset, ns, of a clock without drift; low is above high if none fits."""
    low, high = -_FAR_NS, _FAR_NS
    for above, below in (_sides(item, 0.0) for item in orders):
        high = min([high, *above.ahead_ns.tolist()])
        low = max([low, *below.ahead_ns.tolist()])
    return low, high


class ClockLines(msgspec.Struct, frozen=True):
    """All lines that agree with the captures (rule 4).

    Attributes:
        begin_ns: first of the two times at which lines have their values.
        span_ns: time from the first to the second.
        base_ns: offset that the values in ``corners`` are relative to.
        corners: f64 (n, 2), values of the lines at both times, around the polygon; empty if no line agrees.
    """

    begin_ns: int
    span_ns: int
    base_ns: int
    corners: NDArray[np.float64]

    @classmethod
    def of(cls, orders: Sequence[Ordered], loose_ns: int = 0) -> Self | None:
        """Return the lines that agree with some pairs; None if the pairs give bounds on one side only.

        Args:
            orders: pairs of causes and effects, at least one.
            loose_ns: error of the capture times, by which bounds may contradict each other.
        """
        begin = min(int(item.first_ns.min()) for item in orders)
        span = max(SECOND, max(int(item.first_ns.max()) for item in orders) - begin)
        sides = [_sides(item, MOST_DRIFT) for item in orders]
        above, below = ([bound for side in sides for bound in side[at].ahead_ns.tolist()] for at in (0, 1))
        if not above or not below:
            return None
        base, most = min(above), span * MOST_DRIFT
        low, high = min(0, min(below) - base) - most - loose_ns, most + loose_ns + _RESOLUTION_NS
        corners = np.array([(low, low - most), (high, high - most), (high, high + most), (low, low + most)])
        return cls(begin, span, base, corners).within(orders, loose_ns)

    def within(self, orders: Iterable[Ordered], loose_ns: int = 0) -> Self:
        """Return the lines that also agree with further pairs; arguments are as in ``of``."""
        corners, gives = self.corners, loose_ns + _RESOLUTION_NS
        for sides in (_sides(item, MOST_DRIFT) for item in orders):
            for sign, side in zip((1, -1), sides, strict=True):
                part = (side.time_ns - self.begin_ns) / self.span_ns
                value = side.ahead_ns - self.base_ns
                for at, bound in zip(part.tolist(), value.tolist(), strict=True):
                    corners = _cut(corners, sign, at, bound + sign * gives)
        return replace(self, corners=corners)

    def __bool__(self) -> bool:
        return len(self.corners) > 0

    @property
    def drift(self) -> tuple[float, float]:
        """The smallest and the largest drift of a line, ns per ns."""
        steps = (self.corners[:, 1] - self.corners[:, 0]) / self.span_ns
        return float(steps.min()), float(steps.max())

    @property
    def drift_known(self) -> bool:
        """Whether the captures bound the drift, and not only ``MOST_DRIFT``."""
        low, high = self.drift
        return max(-low, high) < 0.999 * MOST_DRIFT

    def offset(self, time_ns: int) -> tuple[int, int]:
        """Return the smallest and the largest offset at a time, ns."""
        values = self.corners @ _weights((time_ns - self.begin_ns) / self.span_ns)
        return self.base_ns + int(np.floor(values.min())), self.base_ns + int(np.ceil(values.max()))

    @property
    def width(self) -> int:
        """The largest distance between two lines, in ns."""
        return max(int(np.ptp(self.corners[:, at])) for at in (0, 1))

    def drifting(self, drift: float) -> tuple[int, int]:
        """Return the interval of the offset at ``begin_ns``, ns, of the lines with one drift."""
        apart = self.corners[:, 1] - self.corners[:, 0] - drift * self.span_ns
        after = np.roll(self.corners, -1, axis=0), np.roll(apart, -1)
        crossing = np.flatnonzero((apart <= 0) != (after[1] <= 0))
        part = apart[crossing] / (apart[crossing] - after[1][crossing])
        values = self.corners[crossing, 0] + part * (after[0][crossing, 0] - self.corners[crossing, 0])
        values = values if len(values) else self.corners[:, 0]
        return self.base_ns + int(np.floor(values.min())), self.base_ns + int(np.ceil(values.max()))


def _weights(part: float) -> NDArray[np.float64]:
    """Return the weights of a line's two values that give its value at a part of the span."""
    return np.array((1 - part, part))


def _cut(corners: NDArray[np.float64], sign: int, part: float, bound: float) -> NDArray[np.float64]:
    """Return the part of a polygon on one side of a bound."""
    room = sign * (bound - corners @ _weights(part))
    inside = room >= 0
    if inside.all():
        return corners
    rest = []
    for at in range(len(corners)):
        if inside[at - 1] != inside[at]:
            share = room[at - 1] / (room[at - 1] - room[at])
            rest.append(corners[at - 1] + share * (corners[at] - corners[at - 1]))
        if inside[at]:
            rest.append(corners[at])
    return np.array(rest).reshape(-1, 2)
