"""Limits from figures and fields: nothing lost stays so, more runs are narrower, a scaled field is out."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace

from edoras_tools.addons.runs.check import Figures
from edoras_tools.addons.runs.differences import field_filter, field_limit, topic_limits
from edoras_tools.addons.runs.expectations import Unit, parse_bound
from edoras_tools.addons.runs.run import FieldValues

GOOD = Figures(163, 10.0, 2.0, 1.0, (76, 76), 0.4, 163, 24, 0, 0, "")


def limits(*runs, spread=2.4, rate_spread=0.0):
    return dict(topic_limits(runs, spread, rate_spread))


def test_a_limit_holds_what_was_seen_and_says_from_what():
    own = limits(GOOD)
    assert own["lost"].low <= 24 / 163 <= own["lost"].high < 24 / 163 + 0.1
    assert own["lost"].why == "24 of 163 in 1 run"
    assert own["superseded"].text(Unit.LOSS) == "0"
    assert own["rate"].text(Unit.RATE).startswith("9.4")
    assert own["size"].text(Unit.BYTES) == "76"
    for key, unit in (
        ("rate", Unit.RATE),
        ("silence", Unit.TIME),
        ("latency", Unit.TIME),
        ("lost", Unit.LOSS),
    ):
        parse_bound(own[key].text(unit), unit)


def test_more_runs_are_narrower():
    runs = [
        replace(GOOD, lost=lost, rate=10 + lost / 1e4) for lost in (22, 23, 24, 25, 26, 24, 23, 25, 24, 24)
    ]
    one, many = limits(GOOD), limits(*runs)
    assert many["lost"].high < one["lost"].high
    assert many["rate"].high - many["rate"].low < one["rate"].high - one["rate"].low
    assert many["lost"].why == "13.497% to 15.951% in 10 runs"


def test_a_topic_that_lasts_is_expected_to_the_end():
    assert limits(replace(GOOD, end_silence=0.3))["rate"].suffix == " to the end"
    assert limits(GOOD)["rate"].suffix == ""


def values(*numbers):
    field = FieldValues()
    field.add(np.array(numbers))
    return field


WAVE = np.sin(np.arange(100) / 5)


@pytest.mark.parametrize("to_cfs", [True, False])
def test_a_field_stays_in_its_range_but_for_a_margin(to_cfs):
    limit = field_limit([values(*WAVE)], to_cfs=to_cfs)
    assert limit.low < WAVE.min() < WAVE.max() < limit.high
    scaled = 1.1 * WAVE.max()
    assert (scaled > limit.high) == to_cfs


def test_a_field_that_goes_on_has_no_limit():
    assert field_limit([values(*np.arange(100.0))], to_cfs=False) is None
    assert field_limit([values(*np.full(9, np.nan))], to_cfs=False) is None


@pytest.mark.parametrize(
    ("numbers", "text"),
    [
        ((0.0, 0.0), "x == 0"),
        ((0.5, 0.5), "x in 0.4999995..0.5000005"),
        (np.array([3, 3], np.int32), "x == 3"),
        (np.array([1, 5] * 20, np.int32), "x in 0..6"),
        (np.array([True, True]), "x == true"),
    ],
)
def test_the_filter_of_a_field(numbers, text):
    field = values(*numbers) if isinstance(numbers, tuple) else FieldValues()
    if not isinstance(numbers, tuple):
        field.add(numbers)
    assert field_filter("x", field_limit([field], to_cfs=True), is_flag=field.is_flag) == text


def test_a_flag_that_changes_has_no_limit():
    field = FieldValues()
    field.add(np.array([True, False] * 20))
    assert field_limit([field], to_cfs=True) is None
