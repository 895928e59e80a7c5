"""Known numbers as ranges, beside a plain set."""

import numpy as np
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from edoras_tools.sessions.ranges import MOST_RANGES, KnownRanges

NUMBERS = st.lists(st.integers(0, 60), max_size=30)


@settings(max_examples=examples(300), deadline=None)
@given(st.lists(NUMBERS, max_size=6))
def test_what_is_fresh(batches):
    ranges, known = KnownRanges(), set()
    for batch in batches:
        fresh = ranges.fresh(np.array(batch, np.int64)).tolist()
        for number, new in zip(batch, fresh, strict=True):
            assert new == (number not in known)
            known.add(number)
        assert ranges.size == len(known)
        assert {number for start, end in ranges for number in range(start, end)} == known
        gaps = {number for start, end in ranges.missing(0, 61) for number in range(start, end)}
        assert gaps == set(range(61)) - known


@settings(max_examples=examples(100), deadline=None)
@given(NUMBERS, st.integers(0, 61))
def test_what_is_forgotten(numbers, before):
    ranges = KnownRanges()
    ranges.fresh(np.array(numbers, np.int64))
    ranges.forget(before)
    assert {number for start, end in ranges for number in range(start, end)} == {
        number for number in numbers if number >= before
    }
    assert ranges.count == len(list(ranges))


def test_ranges_are_limited():
    ranges = KnownRanges()
    assert ranges.fresh(np.arange(0, 4 * MOST_RANGES, 2)).all()
    assert ranges.size == MOST_RANGES
