"""Counts over time, beside plain loops."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.pipelines.plot_lines import RateCounts, bar_seconds


@given(
    st.lists(st.floats(0, 59.99), min_size=1, max_size=200),
    st.sampled_from([(0.0, 60.0), (0.0, 61.5), (-0.3, 60.0), (10.75, 60.0)]),
    st.sampled_from([0.1, 0.5, 1.0, 2.0]),
)
def test_rates_hold_every_message(seconds, span, width):
    made = RateCounts()
    half = len(seconds) // 2
    for part in (seconds[:half], seconds[half:]):
        made.add(np.array(part))
    line = made.line(0, span, width)
    assert made.total == line.read == len(seconds)
    assert line.values.min() >= 0
    shares = np.full(len(line.values), width)
    shares[-1] = 2 * (span[1] - line.seconds[-1])
    assert shares[-1] == pytest.approx(width, rel=0.51)
    assert (line.values * shares).sum() == pytest.approx(len(seconds))


def test_a_rate_counts_what_a_row_stands_for():
    made = RateCounts()
    made.add(np.array([0.0, 5.05]), np.array([10, 30]))
    line = made.line(0, (0.0, 10.0), 1.0)
    assert line.values.tolist() == [10, 0, 0, 0, 0, 30, 0, 0, 0, 0]


def test_what_was_at_an_unknown_time_is_counted_evenly_over_its_span():
    made = RateCounts()
    made.add_spans(np.array([2.0, 0.0, 7.0]), np.array([5.95, 9.95, 7.0]), np.array([8, 10, 4]))
    line = made.line(0, (0.0, 10.0), 1.0)
    assert line.values == pytest.approx([1, 1, 3, 3, 3, 3, 1, 5, 1, 1])
    assert (made.total, line.read, made.spread) == (22, 22, 18)


@given(st.lists(st.tuples(st.floats(0, 50), st.floats(0, 9.99), st.integers(0, 1000)), max_size=30))
def test_spans_hold_every_message(spans):
    begin, long, counts = (np.array(item) for item in zip(*spans, strict=True)) if spans else np.zeros((3, 0))
    made = RateCounts()
    made.add_spans(begin, begin + long, counts.astype(np.int64))
    line = made.line(0, (0.0, 60.0), 1.0)
    assert made.total == counts.sum() == pytest.approx(line.values.sum())
    assert line.values.min() >= 0


def test_spans_of_decades_hold_every_message_in_bounded_memory():
    """A clock that was not set at first: from 1970 to 2026 there are 18,000,000,000 tenths of a second."""
    made, years = RateCounts(), 1.8e9
    made.add_spans(np.array([0.0, 5.0, 100.0]), np.array([years, years, 100.05]), np.array([600, 50, 3]))
    assert (made.total, made.spread) == (653, 650)
    assert sum(len(part) for part in made._parts) < 1_000_002
    width = bar_seconds((0.0, years))
    values = made.line(0, (0.0, years), width).values
    assert values.sum() * width == pytest.approx(653, rel=0.01)
    assert values[1:].max() < 2 * values[1:].min(), "evenly"


@pytest.mark.parametrize(("end", "width"), [(0.001, 0.1), (9, 0.1), (65.3, 1), (125, 2), (86_400, 1000)])
def test_rates_are_means_over_round_times(end, width):
    assert bar_seconds((0, end)) == pytest.approx(width)
