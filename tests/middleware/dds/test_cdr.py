"""Padding comes and goes without a trace, whether its writer tells of it or not."""

from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.errors import WireError
from edoras_tools.middleware.dds.cdr import is_little_endian, padded, rewritten, trimmed
from edoras_tools.ros import TypeStore
from edoras_tools.ros.arbitrary import arbitrary

TYPES = TypeStore()
NAMES = [name for name in TYPES.types() if TYPES.has(name)]
STRING = "std_msgs/msg/String"
HELLO = b"\0\1\0\0\x06\0\0\0hello\0"


@given(st.sampled_from(NAMES), st.integers(0, 2**64))
def test_padding_comes_and_goes(name, seed):
    cdr = TYPES.encode(name, arbitrary(TYPES, name, Random(seed)))
    there = padded(cdr)
    assert len(there) % 4 == 0
    assert len(there) - len(cdr) == there[3] < 4
    assert trimmed(TYPES, name, there) == cdr
    assert trimmed(TYPES, name, cdr + bytes(len(there) - len(cdr))) == cdr


def test_a_message_of_a_multiple_of_four_is_left_alone():
    cdr = TYPES.encode("geometry_msgs/msg/Twist", {})
    assert padded(cdr) is cdr
    assert trimmed(TYPES, "geometry_msgs/msg/Twist", cdr) is cdr


def test_the_options_tell_the_padding():
    assert padded(HELLO) == b"\0\1\0\2" + HELLO[4:] + b"\0\0"


def test_what_is_no_padding_stays():
    assert trimmed(TYPES, STRING, HELLO + bytes(4)) == HELLO + bytes(4)
    assert trimmed(TYPES, STRING, HELLO + b"\1") == HELLO + b"\1"


def test_which_byte_order():
    assert is_little_endian(HELLO)
    assert not is_little_endian(HELLO[:4])
    assert not is_little_endian(b"\0\0" + HELLO[2:])


def test_what_ros_would_write():
    assert rewritten(TYPES, STRING, TYPES.encode(STRING, {"data": "hello"}, big_endian=True)) == HELLO
    with pytest.raises(WireError, match=STRING):
        rewritten(TYPES, STRING, HELLO[:-1])
