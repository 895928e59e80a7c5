"""Rate limits as transcripts, and what holds of any of them."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.sessions.bridge.limit import Limit, Limiter
from edoras_tools.units import MILLISECOND, SECOND


def run(limiter, offers, until):
    """Offer (time, lane, item) in turn, serving what is due in between; return those that left, and when."""
    left = []

    def serve(end):
        while (due := limiter.next_ns) is not None and due <= end:
            found = limiter.due(now=due)
            assert found
            left.extend((due, lane, item) for lane, item in found)

    for now, lane, item in offers:
        serve(now)
        if limiter.offer(lane, item, now=now):
            left.append((now, lane, item))
    serve(until)
    return left


def at(rate_hz, seconds, lane=0):
    return [(int(index * SECOND / rate_hz), lane, index) for index in range(int(rate_hz * seconds))]


def test_without_a_limit_all_goes_on():
    limiter = Limiter([Limit()])
    assert len(run(limiter, at(10_000, 1), SECOND)) == 10_000
    assert (limiter.held, limiter.next_ns) == ([0], None)


def test_the_first_goes_and_what_is_too_much_is_dropped():
    limiter = Limiter([Limit(2, "first")])
    second = SECOND // 2
    assert limiter.offer(0, "a", now=0)
    assert not limiter.offer(0, "b", now=second - 1)
    assert limiter.next_ns is None
    assert limiter.offer(0, "c", now=second)
    assert limiter.held == [1]


def test_the_latest_waits_for_its_time_and_takes_the_place_of_older_ones():
    limiter = Limiter([Limit(2, "latest")])
    assert limiter.offer(0, "a", now=0)
    assert not limiter.offer(0, "b", now=1)
    assert not limiter.offer(0, "c", now=2)
    assert (limiter.next_ns, limiter.waits(0)) == (SECOND // 2, True)
    assert limiter.due(now=SECOND // 2 - 1) == []
    assert limiter.due(now=SECOND // 2) == [(0, "c")]
    assert (limiter.held, limiter.next_ns, limiter.waits(0)) == ([1], None, False)


@pytest.mark.parametrize("keep", ["latest", "first"])
def test_250_hz_under_a_limit_of_30_are_30(keep):
    limiter = Limiter([Limit(30, keep)])
    left = run(limiter, at(250, 10), 10 * SECOND)
    assert len(left) in {300, 301}
    assert min(b[0] - a[0] for a, b in pairwise(left)) >= 28 * MILLISECOND
    assert limiter.held[0] == 2500 - len(left) - limiter.waits(0)


def test_after_an_idle_while_no_two_go_at_once():
    limiter = Limiter([Limit(10, "first")])
    assert limiter.offer(0, "a", now=0)
    assert limiter.offer(0, "b", now=5 * SECOND)
    assert not limiter.offer(0, "c", now=5 * SECOND + SECOND // 11)
    assert limiter.offer(0, "d", now=5 * SECOND + SECOND // 10)


def test_a_total_is_shared_in_turn_though_one_is_far_faster():
    limiter = Limiter([Limit(), Limit(), Limit()], 30)
    offers = sorted([*at(1000, 10, 0), *at(50, 10, 1), *at(20, 10, 2)])
    left = run(limiter, offers, 10 * SECOND)
    lanes = [lane for _, lane, _ in left]
    assert len(left) in {300, 301}
    assert all(95 <= lanes.count(lane) <= 105 for lane in range(3))


def test_a_lane_that_is_not_counted_passes_the_total_by():
    limiter = Limiter([Limit(), Limit(keep="first")], 1, [True, False])
    assert limiter.offer(0, "a", now=0)
    assert all(limiter.offer(1, "b", now=now) for now in range(100))
    assert not limiter.offer(0, "c", now=100)


limits = st.builds(Limit, st.none() | st.floats(0.5, 500), st.sampled_from(["latest", "first"]))


@given(
    st.lists(limits, min_size=1, max_size=3),
    st.none() | st.floats(0.5, 500),
    st.lists(st.tuples(st.integers(0, 20 * MILLISECOND), st.integers(0, 2)), max_size=200),
)
def test_nothing_is_lost_sight_of_and_no_limit_is_passed(lanes, total, steps):
    limiter = Limiter(lanes, total)
    now, offers = 0, []
    for index, (step, lane) in enumerate(steps):
        now += step
        offers.append((now, lane % len(lanes), index))
    left = run(limiter, offers, now + 10 * SECOND)
    assert limiter.next_ns is None
    for lane, limit in enumerate(lanes):
        mine = [item for item in left if item[1] == lane]
        came = [index for _, owner, index in offers if owner == lane]
        assert len(came) == len(mine) + limiter.held[lane]
        assert [item for *_, item in mine] == sorted(item for *_, item in mine)
        if came and limit.keep == "latest":
            assert mine[-1][2] == came[-1]  # the last word is heard
        keeps_within([time for time, *_ in mine], limit.rate_hz)
    keeps_within([time for time, *_ in left], total)


def keeps_within(times, rate_hz):
    if rate_hz is None:
        return
    period = round(SECOND / rate_hz)
    assert all(b - a >= period // 2 for a, b in pairwise(times))
    for first in range(len(times)):
        for last in range(first, len(times)):
            assert last - first <= (times[last] - times[first]) / period + 1
