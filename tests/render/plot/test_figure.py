"""What is drawn of a plot: thinning keeps peaks, axes have round numbers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from edoras_tools.render.plot.figure import (
    Figure,
    Panel,
    PlotLine,
    RateCounts,
    bar_seconds,
    extremes,
    tick_texts,
)


@given(
    arrays(np.float64, st.integers(1, 300), elements=st.floats(-1e6, 1e6)),
    st.integers(1, 20),
    st.randoms(use_true_random=False),
)
def test_every_column_keeps_its_least_and_its_greatest_value(values, columns, random):
    seconds = np.sort([random.uniform(0, 10) for _ in values])
    kept = extremes(seconds, values, columns, (0, 10))
    if len(values) <= 2 * columns:
        assert kept.tolist() == list(range(len(values)))
        return
    assert (np.diff(kept) > 0).all()
    places = {}
    for place, second in enumerate(seconds.tolist()):
        places.setdefault(int(second / 10 * columns), []).append(place)
    assert len(kept) <= 2 * len(places)
    for there in places.values():
        mine = [place for place in kept.tolist() if place in there]
        assert min(values[mine]) == min(values[there])
        assert max(values[mine]) == max(values[there])


def test_one_peak_among_a_million_remains():
    values = np.zeros(1_000_000)
    values[654_321] = 1.0
    line = PlotLine("x", 0, np.arange(1e6), values, len(values)).thinned(100, (0, 1e6))
    assert len(line.values) <= 200
    assert line.values.max() == 1.0
    assert line.seconds[line.values.argmax()] == 654_321


@pytest.mark.parametrize(
    ("low", "high", "texts"),
    [
        (0, 65.3, ["0", "20", "40", "60"]),
        (-0.21, 0.61, ["0.0", "0.5"]),
        (-0.21, 0.59, ["-0.2", "0.0", "0.2", "0.4"]),
        (1795241640.1, 1795241640.3, None),
        (1e-9, 3e-9, None),
        (-1e300, 1e300, None),
        (12_000, 16_000, ["12,000", "13,000", "14,000", "15,000", "16,000"]),
    ],
)
def test_axes_have_round_numbers_that_differ(low, high, texts):
    found = tick_texts(low, high, 5)
    some = (high - low) * 1e-6
    assert all(low - some <= value <= high + some for value, _ in found)
    assert [float(text.replace(",", "")) for _, text in found] == pytest.approx([value for value, _ in found])
    shown = [text for _, text in found]
    assert len(set(shown)) == len(shown) >= 2
    assert texts is None or shown == texts


@given(st.floats(-1e12, 1e12), st.floats(1e-6, 1e12))
def test_any_axis_has_numbers(low, wide):
    assert tick_texts(low, low + abs(low) * 1e-3 + wide, 6)


@pytest.mark.parametrize("value", [0.0, 5.0, -2.5])
def test_a_line_that_does_not_change_lies_inside_its_panel(value):
    low, high = Panel("x", [PlotLine("x", 0, np.arange(3.0), np.full(3, value), 3)]).ends
    assert low < value < high


def test_what_was_thinned_is_said():
    long, short = (PlotLine("x", 0, np.arange(size), np.zeros(int(size)), int(size)) for size in (1e4, 10.0))
    figure = [Figure(["a"], [Panel("x", [line])], (0, 1)) for line in (long, short)]
    assert figure[0].footnotes(100) == ["long lines: least and greatest value in each of 100 columns of time"]
    assert figure[1].footnotes(100) == []


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
