import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.diagnosis.accounting.claims import (
    Claim,
    Counts,
    Rank,
    Rival,
    settle,
    settle_perhaps_missed,
    settle_possible,
    shares,
)

SECOND = 10**9
KINDS = ("limit", "overflow")


def counts(limit, overflow):
    times = np.arange(len(limit) + 1) * SECOND
    return Counts(times, {"limit": np.array(limit, np.int64), "overflow": np.array(overflow, np.int64)})


def claim(key, first, last, number, kinds, rank=0, flow=0):
    """Return a claim of some whole seconds, first and last included."""
    return Claim(key, first * SECOND + 1, (last + 1) * SECOND, number, kinds, (0,), rank, flow)


@pytest.mark.parametrize(
    ("claims", "left"),
    [
        # Who can wait for a later second does, though it has one kind only.
        ([claim(0, 0, 1, 1, ("overflow",)), claim(1, 0, 0, 2, KINDS)], ([0, 0], [0, 0])),
        # Of two in one second, who has one kind only is served with it.
        ([claim(0, 0, 0, 1, KINDS), claim(1, 0, 0, 1, ("overflow",))], ([0, 0], [0, 1])),
        # Who is served first moves to another second for who is served last.
        ([claim(0, 0, 1, 1, KINDS[:1]), claim(1, 0, 0, 1, KINDS[:1], rank=1)], ([0, 0], [1, 0])),
    ],
)
def test_as_many_as_possible_are_explained(claims, left):
    there = counts([1, 0], [1, 1])
    if claims[1].rank:
        there = counts([1, 1], [1, 0])
    settle({0: there}, claims)
    assert all(sum(item.assigned.values()) == item.number for item in claims)
    assert tuple(there.left[kind].tolist() for kind in KINDS) == left


CLAIMS = st.lists(
    st.builds(
        lambda first, more, number, kinds, rank, flow: claim(
            0, first, first + more, number, kinds, rank, flow
        ),
        st.integers(-1, 5),
        st.integers(0, 6),
        st.integers(0, 9),
        st.sampled_from([KINDS, KINDS[:1], KINDS[1:], ()]),
        st.integers(0, 2),
        st.integers(0, 2),
    ),
    max_size=8,
)
GROWN = st.lists(st.integers(0, 9), min_size=5, max_size=5)


def greatest(limit, overflow, claims):
    """Return how many counts can be given at all, by moving them one by one along any path."""
    places = [
        (kind, second) for kind, grown in zip(KINDS, (limit, overflow), strict=True) for second in range(5)
    ]
    units = [place for place in places for _ in range((limit, overflow)[KINDS.index(place[0])][place[1]])]
    rooms = [at for at, item in enumerate(claims) for _ in range(item.number)]

    def fits(place, at):
        low, high = claims[at].low_ns, claims[at].high_ns
        inside = low <= (place[1] + 1) * SECOND and high > place[1] * SECOND
        return place[0] in claims[at].kinds and inside

    owner = {}

    def seat(unit, looked):
        for room, at in enumerate(rooms):
            if room not in looked and fits(units[unit], at):
                looked.add(room)
                if room not in owner or seat(owner[room], looked):
                    owner[room] = unit
                    return True
        return False

    return sum(seat(unit, set()) for unit in range(len(units)))


@given(GROWN, GROWN, CLAIMS)
def test_no_other_choice_explains_more(limit, overflow, claims):
    there = counts(limit, overflow)
    settle({0: there}, claims)
    taken = {kind: sum(item.by_kind().get((0, kind), 0) for item in claims) for kind in KINDS}
    for kind, grown in zip(KINDS, (limit, overflow), strict=True):
        assert there.left[kind].min() >= 0
        assert int(there.left[kind].sum()) + taken[kind] == sum(grown)
    assert all(0 <= sum(item.assigned.values()) <= item.number for item in claims)
    assert sum(taken.values()) == greatest(limit, overflow, claims)


@given(GROWN, GROWN, CLAIMS)
def test_what_may_be_of_several_is_given_to_none(limit, overflow, claims):
    there = counts(limit, overflow)
    shared = settle_possible({0: there}, claims)
    taken = sum(sum(item.assigned.values()) for item in claims)
    left = sum(int(column.sum()) for column in there.left.values())
    assert left + taken + sum(item.number for item in shared) == sum(limit) + sum(overflow)
    assert all(item.number > 0 and len(item.flows) > 1 for item in shared)
    assert all(item.open >= 0 for item in claims)
    assert sum(item.reserved for item in claims) == sum(item.number for item in shared)


def test_what_only_one_may_have_lost_is_its_own():
    there = counts([3, 2], [0, 0])
    claims = [
        claim(0, 0, 0, 9, KINDS, Rank.POSSIBLE, flow=7),
        claim(1, 1, 1, 9, KINDS, Rank.POSSIBLE, flow=7),
    ]
    claims.append(claim(2, 1, 1, 1, KINDS, Rank.POSSIBLE, flow=8))
    (item,) = settle_possible({0: there}, claims)
    # Of the two behind it one can be of the other; that one of them is not is sure.
    assert [sum(each.assigned.values()) for each in claims] == [3, 1, 0]
    assert (item.number, item.flows) == (1, frozenset({7, 8}))
    assert (item.start_ns, item.end_ns) == (SECOND, 2 * SECOND)


def test_what_traffic_that_is_not_in_the_capture_may_be_is_shared_with_it():
    there = counts([3, 2], [0, 0])
    claims = [claim(0, 0, 1, 9, KINDS, Rank.POSSIBLE, flow=7)]
    rival = Rival(8, 0, "limit", 3 * SECOND // 2, 9 * SECOND)
    (item,) = settle_possible({0: there}, claims, [rival])
    assert (claims[0].assigned, claims[0].reserved) == ({(0, "limit", 0): 3}, 2)
    assert (item.number, item.flows) == (2, frozenset({7, 8}))


def test_as_many_as_all_of_several_can_have_are_shared_by_none():
    there = counts([5], [0])
    claims = [
        claim(0, 0, 0, 3, KINDS, Rank.POSSIBLE, flow=7),
        claim(1, 0, 0, 2, KINDS, Rank.POSSIBLE, flow=8),
    ]
    assert settle_possible({0: there}, claims) == []
    assert [item.open for item in claims] == [0, 0]


@pytest.mark.parametrize(("rank", "lost"), [(Rank.POSSIBLE, 2), (Rank.MISSING, 0)])
def test_counts_of_others_make_room_for_what_only_one_may_have_lost(rank, lost):
    # Two counts of the first second went to what could be counted in the second one as well.
    there = counts([0, 2], [0, 0])
    sure, tail = claim(0, 0, 1, 2, KINDS[:1]), claim(1, 0, 0, 9, KINDS[:1], rank, flow=7)
    sure.give((0, "limit", 0), 2)
    settle_possible({0: there}, [sure, tail])
    assert sum(tail.assigned.values()) == lost
    assert int(there.left["limit"].sum()) == 2 - lost
    assert sum(sure.assigned.values()) == 2


def test_counts_of_the_likelier_counter_go_before_the_second_choice_of_others():
    """One takes its counts of the first second where another could have them; a third has none here."""
    there = counts([0, 0], [2, 2])
    named = [claim(at, 0, last, 2, KINDS[::-1], Rank.POSSIBLE, flow=7) for at, last in enumerate((1, 0))]
    other = claim(2, 1, 1, 1, KINDS, Rank.POSSIBLE, flow=8)
    assert settle_possible({0: there}, [*named, other]) == []
    assert [sum(item.assigned.values()) for item in (*named, other)] == [2, 2, 0]


@pytest.mark.parametrize(("rank", "number"), [(Rank.POSSIBLE + 1, 2), (Rank.UNNAMED + 1, 0)])
def test_a_gap_gets_a_count_before_what_gave_way_to_a_newer_one_if_nothing_names_that(rank, number):
    there = counts([2], [0])
    gap, superseded = claim(0, 0, 0, 3, KINDS, Rank.MISSING), claim(1, 0, 0, 2, KINDS, rank, flow=7)
    assert settle_possible({0: there}, [gap, superseded]) == []
    assert (gap.explained, superseded.explained) == (2 - number, number)


def test_what_the_capture_may_have_missed_takes_what_is_left_at_the_end():
    there = counts([3], [0])
    missing = claim(0, 0, 0, 1, KINDS, Rank.MISSING)
    missing.perhaps_missed = 1
    settle_perhaps_missed({0: there}, [missing])
    assert (missing.assigned, missing.number) == ({(0, "limit", 0): 2}, 2)
    assert int(there.left["limit"].sum()) == 1


def test_what_traffic_that_is_not_here_can_be_at_most_is_not_shared_beyond_that():
    claims = [claim(0, 0, 0, 9, KINDS, Rank.POSSIBLE, flow=7)]
    (item,) = settle_possible({0: counts([5], [0])}, claims, [Rival(8, 0, "limit", 0, SECOND, most=2)])
    assert (sum(claims[0].assigned.values()), item.number) == (3, 2)


def test_what_was_lost_behind_the_last_sample_is_in_no_count():
    there = counts([2, 2], [0, 0])
    claims = [claim(0, 0, 1, 2, KINDS), claim(1, 5, 6, 4, KINDS)]
    settle({0: there}, claims, slack_ns=9 * SECOND)
    assert [sum(each.assigned.values()) for each in claims] == [2, 0]


@given(st.integers(0, 60), st.integers(1, 9))
def test_equal_shares_differ_by_one_at_most(number, parts):
    found = shares(number, [7] * parts)
    assert sum(found) == min(number, 7 * parts)
    assert max(found) - min(found) <= 1
