"""Rate limits: how many messages a second pass in each lane (one topic each), and in all lanes together.

Rules that it keeps:

1. A message passes when its lane is due; then the lane is due again one period later.
2. Due times stay on a grid where messages come a little late: 250 Hz under a limit of 30 Hz leave at 30 Hz,
   not at the 27.8 Hz of every ninth message.
3. Two messages of a lane are never closer than half a period.
4. Where the total is reached, the lane that has waited longest is next.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, Literal, TypeVar

from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Sequence

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True)
class Limit:
    """The limit of a lane.

    Attributes:
        rate_hz: most messages a second; None for no limit.
        keep: ``latest``: one too many waits until the lane is due, and a newer one replaces it;
            ``first``: one too many is dropped.
    """

    rate_hz: float | None = None
    keep: Literal["latest", "first"] = "latest"


class Limiter(Generic[Item]):
    """Lanes, each with its limit, and a limit of all of them together.

    Args:
        limits: of each lane.
        total_hz: most messages a second of the counted lanes together; None for no limit.
        counted: which lanes the total counts; all by default.

    Attributes: held: for each lane, messages that never pass: dropped, or replaced by a newer one.
    """

    def __init__(
        self, limits: Sequence[Limit], total_hz: float | None = None, counted: Sequence[bool] | None = None
    ) -> None:
        self.held = [0] * len(limits)
        self._latest = [limit.keep == "latest" for limit in limits]
        self._clocks = [_Clock(limit.rate_hz) for limit in limits]
        free = _Clock(None)
        total = _Clock(total_hz)
        self._totals = [total if count else free for count in counted or [True] * len(limits)]
        self._waiting: dict[int, Item] = {}  # in the order in which the lanes began to wait
        self._free = [
            limit.rate_hz is None and (mine is free or total_hz is None)
            for limit, mine in zip(limits, self._totals, strict=True)
        ]

    @property
    def next_ns(self) -> int | None:
        """When ``due`` returns something; None when nothing waits."""
        if not self._waiting:
            return None
        return min(max(self._clocks[lane].due_ns, self._totals[lane].due_ns) for lane in self._waiting)

    def waits(self, lane: int) -> bool:
        """Tell whether a message of a lane waits."""
        return lane in self._waiting

    def offer(self, lane: int, item: Item, *, now: int) -> bool:
        """Return whether a message may pass at once; if not, it is dropped, or ``due`` returns it later."""
        if self._free[lane]:
            return True
        if lane in self._waiting:
            self._waiting[lane] = item  # it keeps its place in the order of waiting
            self.held[lane] += 1
            return False
        # Under a total, a message that waits already goes first.
        if self._may(lane, now) and not any(self._may(other, now) for other in self._waiting):
            self._pass(lane, now)
            return True
        if self._latest[lane]:
            self._waiting[lane] = item
        else:
            self.held[lane] += 1
        return False

    def due(self, *, now: int) -> list[tuple[int, Item]]:
        """Return the lanes and messages that are due, the longest waiting first."""
        found = []
        for lane in list(self._waiting):
            if self._may(lane, now):
                self._pass(lane, now)
                found.append((lane, self._waiting.pop(lane)))
        return found

    def _may(self, lane: int, now: int) -> bool:
        return now >= self._clocks[lane].due_ns and now >= self._totals[lane].due_ns

    def _pass(self, lane: int, now: int) -> None:
        self._clocks[lane].step(now)
        self._totals[lane].step(now)


class _Clock:
    """When the next message may pass, ns."""

    __slots__ = ("_period_ns", "due_ns")

    def __init__(self, rate_hz: float | None) -> None:
        self._period_ns = round(SECOND / rate_hz) if rate_hz else 0
        self.due_ns = -(1 << 62)

    def step(self, now: int) -> None:
        """Note that one passed."""
        period = self._period_ns
        if not period:
            return
        late = now - self.due_ns
        # Up to half a period late the grid is kept; after a longer pause a new one begins.
        self.due_ns = now + period if late >= period else max(self.due_ns + period, now + period // 2)
