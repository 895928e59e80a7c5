"""The page of an archive's report: the bars of its charts."""

from __future__ import annotations

import pytest

from edoras_tools.addons.archive.views import BINS, _round_time, bin_ns
from edoras_tools.units import SECOND

DAY_S = 86_400


@pytest.mark.parametrize(
    ("span_s", "bar", "told"),
    [
        (0, 1, "1 second"),
        (65, 2, "2 seconds"),
        (60 * 60, 60, "1 minute"),
        (3 * DAY_S, 2 * 3600, "2 hours"),
        (240 * DAY_S, 4 * DAY_S, "4 days"),
        (240 * DAY_S + 1, 7 * DAY_S, "7 days"),
        (60 * 28 * DAY_S, 28 * DAY_S, "28 days"),
    ],
)
def test_a_bar_is_a_round_time_and_bars_are_not_too_many(span_s, bar, told):
    start_ns = 1_772_323_200 * SECOND
    found = bin_ns({"start_ns": start_ns, "end_ns": start_ns + span_s * SECOND})
    assert (found, _round_time(found / SECOND)) == (bar * SECOND, told)
    assert span_s <= bar * BINS


def test_bars_of_more_than_four_years_are_as_long_as_need_be():
    end_ns = 61 * 28 * DAY_S * SECOND
    assert bin_ns({"start_ns": 0, "end_ns": end_ns}) == -(-end_ns // BINS)
