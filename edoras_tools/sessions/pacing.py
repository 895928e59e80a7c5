"""The deadline of each message: absolute, from a recording's own times, a speed or rates.

Rules that it keeps:

1. A deadline counts from the start of the pass, never from the message before: lateness does not add up.
2. A whole recording is planned at once, in columns; nothing here waits, and no clock is read.
3. Each deadline is rounded from its exact value, so rounding does not add up either.
4. A pass ends one mean interval after its last message: the next pass continues at the same rate.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
import numpy as np

from edoras_tools.errors import ConfigError
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.wire.arrays import Integers

_STEPS: Final = 64
"""Steps of the lateness scale for each doubling: one step is 1.1 %."""
_FOLD: Final = 1 << 16


class Timetable(NamedTuple):
    """The order and the deadlines of one pass over a recording.

    Attributes:
        order: rows of the recording in the order they are sent, i64 (n,).
        due_ns: deadlines of ``order``, never decreasing, from 0 at the start of the pass, i64 (n,).
        period_ns: time from the start of one pass to the start of the next.
    """

    order: Integers
    due_ns: Integers
    period_ns: int

    @property
    def rate_hz(self) -> float | None:
        """Requested messages per second; None if no times are requested."""
        count = len(self.due_ns)
        return count * SECOND / self.period_ns if self.period_ns and count else None


class Pacing(msgspec.Struct, frozen=True):
    """The speed at which a recording is sent.

    Attributes:
        speed: factor on the recording's own times; 2 is twice as fast.
        rate_hz: rate at which all messages are sent evenly instead; 0 keeps their own times.
        stream_rates: own rate in Hz of some streams; it does not change the others.
        unpaced: whether there are no deadlines: as fast as possible.
        cap_hz: most messages a second; 0 for no limit.
    """

    speed: float = 1.0
    rate_hz: float = 0.0
    stream_rates: Mapping[int, float] = msgspec.field(default_factory=dict)
    unpaced: bool = False
    cap_hz: float = 0.0

    def __post_init__(self) -> None:
        """Check once.

        Raises:
            ConfigError: a speed or a rate is not a positive number, or they contradict each other.
        """
        rates = (self.rate_hz or 1.0, self.cap_hz or 1.0, *self.stream_rates.values())
        for name, value in (("speed", self.speed), *(("rate", rate) for rate in rates)):
            if not 0 < value < float("inf"):
                raise ConfigError(f"{name} {value:g} is not allowed; more than 0")
        ways = [self.speed != 1, bool(self.rate_hz or self.stream_rates), self.unpaced]
        if sum(ways) > 1:
            raise ConfigError("a speed, a rate and --speed max exclude each other; name one")

    def timetable(self, time_ns: Integers, stream: NDArray[Any] | None = None) -> Timetable:
        """Plan one pass.

        Args:
            time_ns: time of recording of each message, i64 (n,); a step back in time counts as no step.
            stream: key of ``stream_rates`` for each message, (n,); needed only if there are such rates.
        """
        count = len(time_ns)
        every = np.arange(count, dtype=np.int64)
        if not count or self.unpaced:
            return self._capped(every, np.zeros(count, np.int64), 0)
        if self.rate_hz:
            return self._capped(every, _evenly(count, self.rate_hz), _at(count, self.rate_hz))
        due = np.maximum.accumulate(time_ns) - time_ns[0]
        due = due if self.speed == 1 else np.rint(due / self.speed).astype(np.int64)
        # A pass ends one mean interval after its last message, so that the next goes on at the same rate.
        ends = [int(due[-1]) + int(due[-1]) // (count - 1) if count > 1 else SECOND]
        order = every
        if stream is not None and self.stream_rates:
            own = np.zeros(count, bool)
            for key, rate in self.stream_rates.items():
                rows = np.flatnonzero(stream == key)
                if len(rows):
                    first = int(due[rows[0]])
                    due[rows] = first + _evenly(len(rows), rate)
                    ends.append(first + _at(len(rows), rate))
                    own[rows] = True
            if own.all():
                ends = ends[1:]
            order = np.argsort(due, kind="stable")
            due = due[order]
        return self._capped(order, due, max(ends))

    def _capped(self, order: Integers, due: Integers, period_ns: int) -> Timetable:
        if self.cap_hz and len(due):
            least = _evenly(len(due), self.cap_hz)
            due = np.maximum.accumulate(due - least) + least
            period_ns = max(period_ns, int(due[-1]) + _at(1, self.cap_hz))
        return Timetable(order, due, period_ns)


def _evenly(count: int, rate_hz: float) -> Integers:
    """Return ``count`` deadlines, each rounded from its exact value, so that rounding does not add up."""
    return np.rint(np.arange(count) * (SECOND / rate_hz)).astype(np.int64)


def _at(index: int, rate_hz: float) -> int:
    return round(index * (SECOND / rate_hz))


class Lateness:
    """The lateness of sent messages, on a logarithmic scale, in bounded memory."""

    def __init__(self) -> None:
        self._count = self._max_ns = 0
        self._waiting: list[int] = []
        self._steps = np.zeros(_STEPS * 64, np.int64)

    def add(self, late_ns: int) -> None:
        """Add one message's lateness; a negative one counts as 0."""
        self._waiting.append(late_ns)
        if len(self._waiting) >= _FOLD:
            self._fold()

    def add_all(self, late_ns: Integers) -> None:
        """Add the latenesses of many messages."""
        self._waiting += late_ns.tolist()
        if len(self._waiting) >= _FOLD:
            self._fold()

    def _fold(self) -> None:
        if self._waiting:
            late_ns = np.maximum(np.array(self._waiting, np.int64), 0)
            self._waiting.clear()
            self._count += len(late_ns)
            self._max_ns = max(self._max_ns, int(late_ns.max()))
            steps = np.ceil(np.log2(np.maximum(late_ns, 1)) * _STEPS).astype(np.int64)
            self._steps += np.bincount(steps, minlength=len(self._steps))

    @property
    def count(self) -> int:
        """The number of messages."""
        self._fold()
        return self._count

    @property
    def max_ns(self) -> int:
        """The largest lateness; 0 without messages."""
        self._fold()
        return self._max_ns

    def percentile_ns(self, percent: float) -> int | None:
        """Return a percentile of the lateness, to 1.1 %; None without messages."""
        if not self.count:
            return None
        step = int(np.searchsorted(np.cumsum(self._steps), self.count * percent / 100))
        return min(round(2 ** (step / _STEPS)), self.max_ns)

    def summary(self) -> dict[str, float | None]:
        """Return p50, p99 and max in us, one digit after the point; None without messages."""
        figures = {"p50": self.percentile_ns(50), "p99": self.percentile_ns(99)}
        figures["max"] = self.max_ns if self.count else None
        return {name: None if value is None else round(value / 1000, 1) for name, value in figures.items()}
