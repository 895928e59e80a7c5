"""What no counter explains: lost, or uncertain where the capture itself may have missed it."""

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.balance import wrong_rows

SECOND = 10**9


def figures(found):
    return found.lost + found.unaccounted, sum(row.uncertain for row in found.balance)


def without_some(sent, share, seed=1):
    chance = random.Random(seed)
    return [item for item in sent if chance.random() >= share]


@settings(max_examples=5)
@given(share=st.floats(0.005, 0.4), seed=st.integers(0, 1000))
def test_what_a_capture_missed_at_random_is_not_lost(lab, share, seed):
    sent, _ = lab.simulate(seconds=30)
    found = lab.examine(without_some(sent, share, seed), drops=None)
    assert not wrong_rows(found.balance)
    assert figures(found)[0] == 0


def test_it_is_where_drops_were_counted_and_there_were_none(lab, msg_id):
    sent, _ = lab.simulate(seconds=30)
    kept = [item for item in sent if not (msg_id(item) == 0x827 and item.time_ns // SECOND % 4 == 0)]
    assert figures(lab.examine(kept)) == (len(sent) - len(kept), 0)


@pytest.mark.parametrize("number", [1, 2])
def test_one_or_two_may_be_missed(lab, msg_id, number):
    sent, _ = lab.simulate(seconds=30)
    poses = [item for item in sent if msg_id(item) == 0x827]
    kept = [item for item in sent if item not in poses[5 : 5 + number]]
    assert figures(lab.examine(kept, drops=None)) == (0, number)


def test_what_is_missing_where_nothing_at_all_was_captured_is_uncertain(lab):
    """One command was sent long before: nobody shows whether cFS was heard then."""
    sent, _ = lab.simulate(seconds=40, count=1)
    telemetry = [item for item in sent if item.destination.port in {1234, 1235}]
    quiet = range(lab.start_ns + 15 * SECOND, lab.start_ns + 21 * SECOND)
    kept = [item for item in telemetry if item.time_ns not in quiet]
    found = lab.examine(kept, lab.mission("rover_ground"))
    proven, uncertain = figures(found)
    assert (proven, uncertain + sum(row.not_captured for row in found.balance)) == (
        0,
        len(telemetry) - len(kept),
    )
