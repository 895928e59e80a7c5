"""Intervals from few runs: where a mean lies; in the add-on ``runs`` where the next run will lie.

1. A quantile of Student's t comes from the finite sums for whole degrees of freedom (Abramowitz and Stegun,
   26.7.3 and 26.7.4), one of chi square from Wilson and Hilferty's cube root, a tolerance factor from Howe
   (1969): errors of the last two are below 2 percent of the factor.
2. A count is a whole number, so equal counts in all runs do not show that there is no spread: rounding alone
   spreads values by their step divided by the root of 12.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import atan, cos, pi, sin, sqrt
from statistics import fmean, variance
from typing import Final, NamedTuple

MEAN_CONFIDENCE: Final = 0.95
"""Probability with which an interval holds the mean."""


class MeanInterval(NamedTuple):
    """An interval that holds a mean.

    Attributes:
        mean: mean of the values that were measured.
        low: lower end.
        high: upper end.
    """

    mean: float
    low: float
    high: float


def t_quantile(probability: float, freedom: int) -> float:
    """Return the value that Student's t exceeds with probability ``1 - probability``.

    Args:
        probability: between 0.5 and 1.
        freedom: degrees of freedom, 1 or more.
    """
    low, high = 0.0, 1.0
    while _t_within(high, freedom) < 2 * probability - 1:
        high *= 2
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if _t_within(middle, freedom) < 2 * probability - 1 else (low, middle)
    return high


def _t_within(value: float, freedom: int) -> float:
    """Return the probability that Student's t is between ``-value`` and ``value``."""
    angle = atan(value / sqrt(freedom))
    odd = freedom % 2
    term, total = (cos(angle) if odd else 1.0), 0.0
    for place in range(2 + odd, freedom + 1, 2):
        total += term
        term *= cos(angle) ** 2 * (place - 1) / place
    return 2 / pi * (angle + sin(angle) * total) if odd else sin(angle) * total


def mean_interval(values: Sequence[float], step: float = 0.0) -> MeanInterval:
    """Return the interval of the mean of all possible runs (``MEAN_CONFIDENCE``); one value gives width 0.

    Args:
        values: one value a run, at least one.
        step: difference of neighbouring possible values, as 1 / 160 for a share of 160 messages.
    """
    mean, count = fmean(values), len(values)
    if count < 2:
        return MeanInterval(mean, mean, mean)
    deviation = sqrt(variance(values) + step * step / 12)
    half = t_quantile((1 + MEAN_CONFIDENCE) / 2, count - 1) * deviation / sqrt(count)
    return MeanInterval(mean, mean - half, mean + half)
