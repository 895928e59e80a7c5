from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.errors import ConfigError
from edoras_tools.sessions.pacing import Lateness, Pacing

TIMES = np.array([1_000, 1_100, 1_350, 2_000], np.int64)
SECOND = 10**9


@pytest.mark.parametrize(
    ("pacing", "due"),
    [
        (Pacing(), [0, 100, 350, 1000]),
        (Pacing(speed=2), [0, 50, 175, 500]),
        (Pacing(speed=0.5), [0, 200, 700, 2000]),
        (Pacing(rate_hz=1e6), [0, 1000, 2000, 3000]),
        (Pacing(rate_hz=3e8), [0, 3, 7, 10]),
        (Pacing(unpaced=True), [0, 0, 0, 0]),
        (Pacing(cap_hz=5e6), [0, 200, 400, 1000]),
        (Pacing(unpaced=True, cap_hz=1e9), [0, 1, 2, 3]),
    ],
)
def test_deadlines(pacing, due):
    table = pacing.timetable(TIMES)
    assert table.due_ns.tolist() == due
    assert table.order.tolist() == [0, 1, 2, 3]


def test_a_time_that_steps_back_stands_still():
    assert Pacing().timetable(np.array([5, 9, 7, 10])).due_ns.tolist() == [0, 4, 4, 5]


def test_a_route_of_its_own_rate_leaves_the_others_alone():
    stream = np.array([7, 8, 7, 7])
    table = Pacing(stream_rates={7: 1e6}).timetable(TIMES, stream)
    assert table.order.tolist() == [0, 1, 2, 3]
    assert table.due_ns.tolist() == [0, 100, 1000, 2000]
    faster = Pacing(stream_rates={7: 1e8}).timetable(TIMES, stream)
    assert faster.order.tolist() == [0, 2, 3, 1]
    assert faster.due_ns.tolist() == [0, 10, 20, 100]


def test_passes_follow_each_other_at_the_same_rate():
    assert Pacing(rate_hz=100).timetable(TIMES).period_ns == SECOND // 25
    even = np.arange(5) * 10
    assert Pacing().timetable(even).period_ns == 50
    assert Pacing().timetable(TIMES[:1]).period_ns == SECOND
    assert Pacing(stream_rates={1: 10}).timetable(TIMES, np.ones(4)).period_ns == 4 * SECOND // 10


def test_the_rate_that_is_asked_for():
    assert Pacing(rate_hz=30).timetable(np.zeros(90, np.int64)).rate_hz == pytest.approx(30)
    assert Pacing(unpaced=True).timetable(TIMES).rate_hz is None
    assert Pacing(speed=2).timetable(np.arange(11) * SECOND // 10).rate_hz == pytest.approx(20)


def test_nothing_is_planned_of_nothing():
    table = Pacing(rate_hz=5, cap_hz=2).timetable(np.zeros(0, np.int64))
    assert (len(table.due_ns), table.rate_hz) == (0, None)


def test_ten_million_deadlines_do_not_drift():
    table = Pacing(rate_hz=30).timetable(np.zeros(3_000_001, np.int64))
    assert int(table.due_ns[-1]) == 100_000 * SECOND


@given(
    st.lists(st.integers(0, 1 << 40), min_size=1, max_size=50),
    st.sampled_from([Pacing(), Pacing(speed=3.7), Pacing(cap_hz=1234.5), Pacing(stream_rates={1: 9.0})]),
)
def test_deadlines_start_at_zero_never_decrease_and_miss_nothing(times, pacing):
    table = pacing.timetable(np.array(times, np.int64), np.arange(len(times)) % 3)
    assert table.due_ns.min() == 0
    assert (np.diff(table.due_ns) >= 0).all()
    assert sorted(table.order.tolist()) == list(range(len(times)))
    assert table.period_ns >= int(table.due_ns[-1])
    if pacing.cap_hz:
        assert (np.diff(table.due_ns) >= SECOND / pacing.cap_hz - 1).all()


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"speed": 0}, "speed 0"),
        ({"speed": float("nan")}, "speed nan"),
        ({"rate_hz": -1}, "rate -1"),
        ({"stream_rates": {1: 0}}, "rate 0"),
        ({"speed": 2, "rate_hz": 5}, "exclude each other"),
        ({"unpaced": True, "rate_hz": 5}, "exclude each other"),
    ],
)
def test_what_cannot_be_meant(given, words):
    with pytest.raises(ConfigError, match=words):
        Pacing(**given)


def test_lateness_is_known_to_a_percent():
    late = Lateness()
    for value in range(1, 1001):
        late.add(value * 1000)
    assert late.percentile_ns(50) == pytest.approx(500_000, rel=0.012)
    assert late.percentile_ns(99) == pytest.approx(990_000, rel=0.012)
    assert late.max_ns == 1_000_000
    assert late.count == 1000
    late.add_all(np.array([5_000_000, -3]))
    assert late.count == 1002
    assert late.summary()["max"] == 5000.0


def test_lateness_of_nothing_is_none():
    assert Lateness().summary() == {"p50": None, "p99": None, "max": None}


@given(st.lists(st.integers(-(10**6), 10**12), min_size=1, max_size=200), st.sampled_from([1, 50, 99, 100]))
def test_lateness_never_tells_less_than_it_was(values, percent):
    late = Lateness()
    late.add_all(np.array(values, np.int64))
    exact = sorted(max(value, 0) for value in values)[-(-len(values) * percent // 100) - 1]
    found = late.percentile_ns(percent)
    assert found == pytest.approx(exact, rel=0.012, abs=1.5)
    assert found <= late.max_ns or late.max_ns == 0
