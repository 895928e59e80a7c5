"""Limits for the next run, from one or many runs: tolerance intervals, each with its source.

1. A limit holds in 99 of 100 runs like the observed ones, with a confidence of 95 percent.
2. The variation of runs is first assumed. The assumption has the weight of ``_WORTH`` runs beside one
   observed run, and less beside more of them. It is: for a rate, a hundredth and the messages at both ends;
   for a silence and a latency, a quarter plus 150 ms; for a field, a twentieth of its range, or a
   two-hundredth if it is sent to cFS.
3. The variation of a loss comes from the queue model (``run``), with the weight of ``MODEL_WORTH`` runs.
4. If nothing was lost, nothing may be lost.
"""

from __future__ import annotations

import math
from statistics import NormalDist, fmean, variance
from typing import TYPE_CHECKING, Final, NamedTuple

from edoras_tools.addons.runs.check import TO_END, Figures
from edoras_tools.addons.runs.expectations import LOSS_KEYS, Unit
from edoras_tools.intervals import MEAN_CONFIDENCE, MeanInterval
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from edoras_tools.addons.runs.run import FieldValues

_DIGITS: Final = 15
"""Most decimals of a number; with more, it is written with an exponent."""
_WORTH: Final = 10
MODEL_WORTH: Final = 100
_RATE: Final = 0.01
_TIME: Final = 0.25
_LEAST_S: Final = 0.15
_SENT: Final = 0.005
_RECEIVED: Final = 0.05
_FEWEST: Final = 5
"""Least number of messages of a topic with a rate."""
_EQUAL: Final = 1e-6
_CONTENT: Final = 0.99
"""Share of all runs within a tolerance interval."""


class RunLimit(NamedTuple):
    """A limit for the next run.

    Attributes:
        low: lower bound.
        high: upper bound.
        why: observed values, for a comment.
        suffix: end of the bound's text.
        is_share: whether both bounds are shares.
    """

    low: float
    high: float
    why: str
    suffix: str = ""
    is_share: bool = False

    def text(self, unit: Unit) -> str:
        """Return the limit in the notation of a file of expectations."""
        sign = "%" if self.is_share else "s" if unit is Unit.TIME else ""
        low, high = (_rounded(value, how) for value, how in ((self.low, math.floor), (self.high, math.ceil)))
        if self.is_share:
            high = min(100, _rounded(100 * self.high, math.ceil))
        if unit in {Unit.TIME, Unit.LOSS}:
            return f"at most {high}{sign}" if high else "0"
        return f"{low}" if low == high else f"{low}..{high}{self.suffix}"

    def joined(self, other: RunLimit) -> RunLimit:
        """Return a limit that includes both."""
        low, high = min(self.low, other.low), max(self.high, other.high)
        return self._replace(low=low, high=high, why=other.why)


def _worth(runs: int) -> int:
    return max(1, _WORTH // runs)


def range_text(low: float, high: float, text: Callable[[float], str] = "{:.6g}".format) -> str:
    """Return a range in words: ``1`` or ``1 to 2``."""
    first, last = text(low), text(high)
    return first if first == last else f"{first} to {last}"


def _observed(values: Sequence[float], text: Callable[[float], str]) -> str:
    """Return the range of a value of each run in words."""
    return f"{range_text(min(values), max(values), text)} in {plural(len(values), 'run')}"


def topic_limits(
    runs: Sequence[Figures], spread: float, rate_spread: float
) -> Iterator[tuple[str, RunLimit]]:
    """Yield the limits of one topic by their key.

    Args:
        runs: figures of the topic in each run.
        spread: standard deviation of its losses.
        rate_spread: standard deviation of its losses in front of the capture.
    """
    count = len(runs)
    rates = [item.rate for item in runs if item.rate and item.count >= _FEWEST]
    if len(rates) == count:
        fewest = min(item.count for item in runs)
        mean = sum(rates) / count
        own = mean * math.hypot(_RATE, 1 / (fewest * math.sqrt(12)), rate_spread / fewest)
        interval = tolerance_interval(rates, own, _worth(count))
        low = max(interval.low, 0.0)
        lasts = low and all(item.end_silence * (item.rate or 0.0) <= TO_END for item in runs)
        why = _observed(rates, lambda value: f"{value:.4g} Hz")
        yield "rate", RunLimit(low, interval.high, why, " to the end" if lasts else "")
        yield "silence", _time_limit([item.silence for item in runs])
    if sizes := [size for item in runs if item.size is not None for size in item.size]:
        yield "size", RunLimit(min(sizes), max(sizes), f"in {plural(count, 'run')}")
    delays = [item.latency for item in runs if item.latency is not None]
    if len(delays) == count:
        yield "latency", _time_limit(delays)
    yield from loss_limits(runs, spread)


def _time_limit(values: Sequence[float]) -> RunLimit:
    spread = _TIME * sum(values) / len(values) + _LEAST_S
    high = tolerance_interval(values, spread, _WORTH).high  # a longest time is no mean of many
    return RunLimit(0, high, _observed(values, lambda value: f"{value:.3g} s"))


def loss_limits(runs: Sequence[Figures], spread: float) -> Iterator[tuple[str, RunLimit]]:
    """Yield the limits of the losses, by their key; losses that nothing counts have none."""
    if not all(item.sent for item in runs):
        return
    for key in LOSS_KEYS:
        if key == "lost" and any(item.not_counted for item in runs):
            continue
        numbers = [int(getattr(item, key)) for item in runs]
        shares = [number / item.sent for number, item in zip(numbers, runs, strict=True)]
        whole = _observed(shares, "{:.3%}".format)
        if len(runs) == 1:
            whole = f"{numbers[0]:,} of {runs[0].sent:,} in 1 run"
        if not any(numbers):
            yield key, RunLimit(0, 0, whole)
            continue
        if key == "lost":
            expected, worth = max(spread, 1.0), MODEL_WORTH
        else:
            expected, worth = math.sqrt(max(numbers)), _worth(len(runs))
        high = tolerance_interval(shares, expected / min(item.sent for item in runs), worth).high
        yield key, RunLimit(0, min(1.0, high), whole, is_share=True)


def field_limit(runs: Sequence[FieldValues], *, to_cfs: bool) -> RunLimit | None:
    """Return the limit of a field; None if it has no number, or was still moving at the end of runs."""
    if not all(item.count for item in runs) or 2 * sum(item.is_moving for item in runs) > len(runs):
        return None
    lows, highs = [item.low for item in runs], [item.high for item in runs]
    span = max(highs) - min(lows)
    if span and runs[0].is_flag:
        return None
    why = f"{range_text(min(lows), max(highs), _number)} in {plural(len(runs), 'run')}"
    if not span:
        margin = 0.0 if runs[0].is_whole else _EQUAL * abs(lows[0])
        return RunLimit(lows[0] - margin, highs[0] + margin, why)
    spread = span * (_SENT if to_cfs else _RECEIVED)
    worth = _worth(len(runs))
    low, high = tolerance_interval(lows, spread, worth).low, tolerance_interval(highs, spread, worth).high
    if runs[0].is_whole:
        return RunLimit(math.floor(low), math.ceil(high), why)
    step = 10.0 ** (math.floor(math.log10(span)) - 3)
    return RunLimit(math.floor(low / step) * step, math.ceil(high / step) * step, why)


def field_filter(name: str, limit: RunLimit, *, is_flag: bool = False) -> str:
    """Return the filter that a field within its limit passes."""
    if is_flag:
        return f"{name} == {'true' if limit.low else 'false'}"
    low, high = _number(limit.low), _number(limit.high)
    return f"{name} == {low}" if low == high else f"{name} in {low}..{high}"


def _number(value: float) -> str:
    """Return a number without an exponent, unless it is too small."""
    if value == int(value):
        return f"{int(value)}"
    digits = max(1, 7 - math.floor(math.log10(abs(value))))
    return f"{value:.{digits}f}".rstrip("0").rstrip(".") if digits <= _DIGITS else repr(value)


def _rounded(value: float, how: Callable[[float], int]) -> float:
    """Return a value with three digits, rounded up or down by ``how``."""
    digits = 2 - math.floor(math.log10(value)) if value > 0 else 0
    scale = 10.0**digits
    rounded = how(round(value * scale, 6)) / scale
    return int(rounded) if rounded == int(rounded) else rounded


def tolerance_interval(values: Sequence[float], spread: float, freedom: int) -> MeanInterval:
    """Return the interval that contains ``_CONTENT`` of all runs, with confidence ``MEAN_CONFIDENCE``.

    Args:
        values: one value of each run, at least one.
        spread: standard deviation assumed before any run.
        freedom: number of runs that the assumption has the weight of.
    """
    count = len(values)
    squares = variance(values) * (count - 1) if count > 1 else 0.0
    total = freedom + count - 1
    deviation = math.sqrt((squares + freedom * spread * spread) / total)
    normal = NormalDist()
    part = 2 / (9 * total)
    chi_square = total * (1 - part + normal.inv_cdf(1 - MEAN_CONFIDENCE) * math.sqrt(part)) ** 3
    half = normal.inv_cdf((1 + _CONTENT) / 2) * math.sqrt((1 + 1 / count) * total / chi_square) * deviation
    mean = fmean(values)
    return MeanInterval(mean, mean - half, mean + half)
