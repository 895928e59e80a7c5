"""Sequence counts as transcripts: what comes in, and what is told of it."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.sessions.sequence import MODULUS, SequenceTracker


def told(counts):
    """Return gaps, duplicates and late packets of counts that come one by one."""
    tracker = SequenceTracker()
    for count in counts:
        tracker.follow(count, count)
    return tracker.gaps, tracker.duplicates, tracker.reordered


CASES = [
    ("nothing missing", [5, 6, 7], (0, 0, 0)),
    ("two missing", [5, 8, 9], (2, 0, 0)),
    ("over the wrap", [16382, 16383, 0, 1], (0, 0, 0)),
    ("one missing at the wrap", [16383, 1], (1, 0, 0)),
    ("one twice", [5, 6, 6, 7], (0, 1, 0)),
    ("one late", [5, 7, 6, 8], (0, 0, 1)),
    ("one of three late", [5, 9, 8, 10], (2, 0, 1)),
    ("begun anew", [200, 201, 1, 2, 3], (0, 0, 0)),
    ("two senders", [100, 40, 101, 41, 102, 42], (0, 0, 0)),
    ("two senders, the other ahead", [40, 100, 41, 101, 42, 102], (0, 0, 0)),
    ("two senders, one loses", [40, 100, 41, 103, 42, 104], (2, 0, 0)),
    ("three senders", [1, 500, 9000, 2, 501, 9001, 3, 502, 9002], (0, 0, 0)),
    ("never counts", [0, 0, 0], (0, 2, 0)),
]


@pytest.mark.parametrize(
    ("counts", "expected"), [case[1:] for case in CASES], ids=[case[0] for case in CASES]
)
def test_transcripts(counts, expected):
    assert told(counts) == expected


def test_what_never_moves_does_not_count():
    tracker = SequenceTracker()
    for _ in range(3):
        tracker.follow(7, 7)
    assert not tracker.moved
    tracker.follow(8, 8)
    assert tracker.moved


LOSSES = st.lists(st.integers(0, 20), min_size=1, max_size=60)


@given(st.integers(0, MODULUS - 1), LOSSES)
def test_of_one_sender_every_loss_is_counted(start, losses):
    counts, at = [], start
    for lost in losses:
        counts.append(at % MODULUS)
        at += 1 + lost
    assert told(counts) == (sum(losses[:-1]), 0, 0)


@given(
    st.integers(0, MODULUS - 1),
    st.integers(100, MODULUS - 100),
    st.lists(st.booleans(), min_size=4, max_size=80),
)
def test_two_senders_that_lose_nothing_have_no_gap(start, apart, turns):
    at = {False: start, True: start + apart}
    counts = []
    for turn in [False, True, False, True, *turns]:
        counts.append(at[turn] % MODULUS)
        at[turn] += 1
    assert told(counts)[:2] == (0, 0)


@given(st.lists(st.integers(0, 12) | st.integers(0, MODULUS - 1), max_size=60))
def test_runs_say_the_same_as_single_packets(counts):
    tracker, first = SequenceTracker(), 0
    for index in range(1, len(counts) + 1):
        if index == len(counts) or (counts[index] - counts[index - 1]) % MODULUS != 1:
            tracker.follow(counts[first], counts[index - 1])
            first = index
    assert (tracker.gaps, tracker.duplicates, tracker.reordered) == told(counts)
    assert min(told(counts)) >= 0


@given(st.integers(0, MODULUS - 1), LOSSES)
def test_runs_and_single_packets_of_one_sender_agree(start, losses):
    tracker, at, counts = SequenceTracker(), start, []
    for lost in losses:
        tracker.follow(at % MODULUS, (at + 2) % MODULUS)
        counts += [(at + step) % MODULUS for step in range(3)]
        at += 3 + lost
    assert (tracker.gaps, tracker.duplicates, tracker.reordered) == told(counts)
