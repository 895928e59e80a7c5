"""Intervals from few runs, against tables, and against many runs drawn by lot."""

from __future__ import annotations

import random
from statistics import NormalDist, fmean

import pytest

from edoras_tools.addons.runs.differences import difference_interval, tolerance_interval
from edoras_tools.intervals import mean_interval, t_quantile


def half_width(interval):
    """Return half the distance from ``low`` to ``high``."""
    return (interval.high - interval.low) / 2


@pytest.mark.parametrize(
    ("probability", "freedom", "value"),
    [
        (0.975, 1, 12.706),
        (0.975, 2, 4.303),
        (0.975, 3, 3.182),
        (0.95, 4, 2.132),
        (0.975, 9, 2.262),
        (0.995, 30, 2.750),
    ],
)
def test_quantiles_of_t(probability, freedom, value):
    """Any table of Student's t."""
    assert t_quantile(probability, freedom) == pytest.approx(value, abs=5e-4)


@pytest.mark.parametrize(("runs", "factor"), [(5, 5.741), (10, 3.981), (30, 3.064)])
def test_factors_are_near_those_of_tables(runs, factor):
    """One-sided factors of 99 % with 95 % confidence (Natrella, table A-7); Howe's are the two-sided kind."""
    values = list(range(runs))
    deviation = (sum((item - fmean(values)) ** 2 for item in values) / (runs - 1)) ** 0.5
    interval = tolerance_interval(values, 0.0, 0)
    assert 0.85 < half_width(interval) / deviation / factor < 1.3


def test_a_mean_is_where_the_interval_says():
    """Of 400 intervals from 5 values, 95 % hold the mean, give or take three standard deviations."""
    chance = random.Random(1)
    held = 0
    for _ in range(400):
        interval = mean_interval([chance.gauss(7, 2) for _ in range(5)])
        held += interval.low <= 7 <= interval.high
    assert held / 400 == pytest.approx(0.95, abs=0.033)


def test_a_difference_is_where_the_interval_says():
    chance, held = random.Random(2), 0
    for _ in range(400):
        before = [chance.gauss(0, 1) for _ in range(4)]
        after = [chance.gauss(3, 4) for _ in range(8)]
        interval = difference_interval(before, after)
        held += interval.low <= 3 <= interval.high
    assert held / 400 == pytest.approx(0.95, abs=0.033)


def test_an_expected_spread_counts_until_many_runs_were_seen():
    few, many = (tolerance_interval([10.0] * runs, 1.0, 10) for runs in (1, 30))
    assert half_width(few) > half_width(many) > 0
    assert half_width(few) > NormalDist().inv_cdf(0.99)


def test_equal_counts_show_no_more_than_their_rounding():
    assert half_width(mean_interval([0.0] * 5)) == 0
    assert 0 < half_width(mean_interval([0.0] * 5, step=1 / 160)) < 0.01
    assert mean_interval([3.0]) == (3.0, 3.0, 3.0)
