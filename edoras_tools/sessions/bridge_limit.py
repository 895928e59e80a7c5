"""Rate limits: how many messages a second of each topic, and of all together, go on; the rest is held back.

A message passes when its lane is due, and then the lane is due again one period later. Due times stay on
their grid where messages come a little late, so that 250 Hz under a limit of 30 Hz go out at 30 Hz and not at
the 27.8 Hz that every ninth message would make; two messages are never closer than half a period.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, Literal, TypeVar

from edoras_tools.sessions.profile import SECOND

if TYPE_CHECKING:
    from collections.abc import Sequence

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True)
class Limit:
    """What a lane lets through.

    Attributes:
        rate_hz: messages a second at the most; None for any number.
        keep: ``latest``: what is too much waits, a newer one taking its place, and leaves when the lane is
            due; ``first``: what is too much is dropped.
    """

    rate_hz: float | None = None
    keep: Literal["latest", "first"] = "latest"


class Limiter(Generic[Item]):
    """Lanes, and what all of them together let through.

    Args:
        limits: one a lane.
        total_hz: messages a second of the counted lanes at the most; None for any number.
        counted: which lanes the total counts; all by default.

    Attributes:
        held: messages a lane that will never leave: dropped, or replaced by a newer one while they waited.
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
        """When ``due`` gives something; None when nothing waits."""
        if not self._waiting:
            return None
        return min(max(self._clocks[lane].due_ns, self._totals[lane].due_ns) for lane in self._waiting)

    def waits(self, lane: int) -> bool:
        """Tell whether a message of a lane waits."""
        return lane in self._waiting

    def offer(self, lane: int, item: Item, *, now: int) -> bool:
        """Tell whether a message may go on at once; otherwise it is dropped, or ``due`` gives it later."""
        if self._free[lane]:
            return True
        if lane in self._waiting:
            self._waiting[lane] = item  # the place in the line stays
            self.held[lane] += 1
            return False
        # Who waits already goes first, where all share what there is.
        if self._may(lane, now) and not any(self._may(other, now) for other in self._waiting):
            self._pass(lane, now)
            return True
        if self._latest[lane]:
            self._waiting[lane] = item
        else:
            self.held[lane] += 1
        return False

    def due(self, *, now: int) -> list[tuple[int, Item]]:
        """Return the lanes and messages whose time has come, those that wait longest first."""
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
        """Take note that one passed."""
        period = self._period_ns
        if not period:
            return
        late = now - self.due_ns
        # Half a period late still keeps the grid; after an idle while there is none to keep.
        self.due_ns = now + period if late >= period else max(self.due_ns + period, now + period // 2)
