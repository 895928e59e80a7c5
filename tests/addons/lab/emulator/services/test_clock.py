from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.addons.lab.emulator.services.clock import Clock
from edoras_tools.cfs.profile import SimProfile
from edoras_tools.cfs.time_services import SETS
from edoras_tools.units import SECOND


@pytest.fixture
def clock():
    return Clock(SimProfile(), now=0)


def words(*values):
    return struct.pack("<II", *values)


def at(clock, now_s):
    return clock.met_ns(now_s * SECOND) / SECOND, clock.time_ns(now_s * SECOND) / SECOND


@pytest.mark.parametrize(
    ("code", "payload", "says", "met", "time"),
    [
        (
            7,
            words(5000, 500_000),
            "12: Set Time -- secs = 5000, usecs = 500000, ssecs = 0x80000000",
            1012,
            5002.5,
        ),
        (8, words(77, 0), "13: Set MET -- secs = 77, usecs = 0, ssecs = 0x0", 79, 1_000_079),
        (9, words(3, 0), "14: Set STCF -- secs = 3, usecs = 0, ssecs = 0x0", 1012, 1015),
        (
            *(11, words(2, 0), "15: STCF Adjust -- secs = 2, usecs = 0, ssecs = 0x0, dir[1=Pos, 2=Neg] = 1"),
            *(1012, 1_001_014),
        ),
        (
            *(12, words(2, 0), "15: STCF Adjust -- secs = 2, usecs = 0, ssecs = 0x0, dir[1=Pos, 2=Neg] = 2"),
            *(1012, 1_001_010),
        ),
        (
            13,
            words(1, 0),
            "16: STCF 1Hz Adjust -- secs = 1, ssecs = 0x0, dir[1=Pos, 2=Neg] = 1",
            1012,
            1_001_014,
        ),
        (
            14,
            words(0, 1 << 31),
            "16: STCF 1Hz Adjust -- secs = 0, ssecs = 0x80000000, dir[1=Pos, 2=Neg] = 2",
            1012,
            1_001_011,
        ),
        (10, b"\x26\0", "17: Set Leap Seconds = 38", 1012, 1_001_012),
        (7, words(1, 1_000_000), "34: Invalid Time -- secs = 1, usecs = 1000000", 1012, 1_001_012),
        (9, words(1, 2_000_000), "36: Invalid STCF -- secs = 1, usecs = 2000000", 1012, 1_001_012),
    ],
)
def test_the_time_is_set_and_adjusted(clock, code, payload, says, met, time):
    assert at(clock, 10) == (1010, 1_001_010)
    assert str(clock.command(code, payload, 10 * SECOND)) == f"CFE_TIME {says}"
    assert at(clock, 12) == (met, time)


@given(st.sampled_from(sorted(SETS)), st.binary(max_size=12), st.integers(0, 1 << 40))
def test_any_command_leaves_a_time_that_fits(code, payload, now):
    clock = Clock(SimProfile(), now=0)
    clock.command(code, payload, now)
    assert 0 <= clock.time_ns(now + SECOND) < (1 << 32) * SECOND
