"""A message's end is found whatever follows it, and never behind what is there."""

from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.errors import WireError
from edoras_tools.pipelines.sending.inject import arbitrary
from edoras_tools.ros import TypeStore

TYPES = TypeStore()
NAMES = [name for name in TYPES.types() if TYPES.has(name)]


@given(st.sampled_from(NAMES), st.integers(0, 2**32), st.binary(max_size=9), st.booleans())
def test_what_follows_a_message_is_no_part_of_it(name, seed, tail, big_endian):
    cdr = TYPES.encode(name, arbitrary(TYPES, name, Random(seed)), big_endian=big_endian)
    assert TYPES.extent(name, cdr + tail) == len(cdr)


@given(st.sampled_from(NAMES), st.integers(0, 2**32), st.integers(1, 64))
def test_a_message_cut_short_is_refused(name, seed, cut):
    cdr = TYPES.encode(name, arbitrary(TYPES, name, Random(seed)))
    with pytest.raises(WireError):
        TYPES.extent(name, cdr[: max(0, len(cdr) - cut)])


@given(st.sampled_from(NAMES), st.binary(max_size=200), st.sampled_from([b"", b"\0\1\0\0", b"\0\0\0\0"]))
def test_of_any_bytes_the_end_lies_inside_and_agrees_with_decode(name, body, head):
    cdr = head + body
    try:
        end = TYPES.extent(name, cdr)
    except WireError:
        with pytest.raises(WireError):
            TYPES.decode(name, cdr)
    else:
        assert 4 <= end <= len(cdr)


def test_a_count_that_cannot_be_ends_at_once():
    with pytest.raises(WireError, match="std_msgs/msg/Float64MultiArray: the message ends at byte 12"):
        TYPES.extent("std_msgs/msg/Float64MultiArray", b"\0\1\0\0" + b"\xff\xff\xff\x7f" + b"\0\0\0\0")


def test_of_no_elements_nothing_is_aligned():
    cdr = TYPES.encode("std_msgs/msg/Float64MultiArray", {})
    assert TYPES.extent("std_msgs/msg/Float64MultiArray", cdr) == len(cdr)
