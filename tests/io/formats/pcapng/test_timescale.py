from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.io.formats.pcapng.timescale import TimeScale

SECONDS = 1_700_000_000


@given(
    st.sampled_from([2, 10]),
    st.integers(0, 63),
    st.integers(0, SECONDS),
    st.fractions(0, 1),
    st.integers(-1000, 1000),
)
def test_exact_for_every_resolution(base, exponent, seconds, fraction, offset):
    ticks = int((seconds + fraction) * base**exponent) % 2**64
    expected = ticks * 10**9 // base**exponent + offset * 10**9
    scale = TimeScale(exponent, base, offset)
    assert scale.to_ns(np.array([ticks], dtype=np.uint64)).tolist() == [expected]


@given(st.sampled_from([2, 10]), st.integers(0, 127), st.integers(0, 2**64 - 1))
def test_nothing_raises(base, exponent, ticks):
    TimeScale(exponent, base).to_ns(np.array([ticks], dtype=np.uint64))


@pytest.mark.parametrize(
    ("scale", "resolution"),
    [
        (TimeScale(), 1000),
        (TimeScale(9), 1),
        (TimeScale(12), 1),
        (TimeScale(3), 10**6),
        (TimeScale(10, 2), 976562),
    ],
)
def test_resolution(scale, resolution):
    assert scale.resolution_ns == resolution
