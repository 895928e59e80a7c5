"""Lines between two clocks: what pairs of cause and effect leave of all offsets and drifts."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.diagnosis.evidence.clocks.lines import (
    ClockLine,
    ClockLines,
    Ordered,
    constant_offset,
    one_way,
)
from edoras_tools.units import MICROSECOND, MILLISECOND, SECOND

BEGIN = 1_800_000_000 * SECOND


@given(
    offset=st.integers(-(10**18), 10**18),
    ppm=st.floats(-499, 499),
    seconds=st.integers(2, 20_000),
    seed=st.integers(0, 2**32 - 1),
    wait_ms=st.integers(1, 600),
)
def test_the_true_line_is_always_among_them(offset, ppm, seconds, seed, wait_ms):
    dice = np.random.default_rng(seed)
    line = ClockLine(BEGIN, offset, ppm / 1e6)
    times = BEGIN + np.sort(dice.integers(0, seconds * SECOND, 40))
    delay = dice.integers(0, wait_ms * MILLISECOND, 40)
    there = Ordered(times, times + delay + line.ahead(times + delay))
    back = Ordered(times + delay, times + line.ahead(times), back=True)
    waited = there._replace(wait_ns=wait_ms * MILLISECOND, each=True)
    for told in ([there, back], [waited], [waited, back]):
        lines = ClockLines.of(told)
        assert lines
        low, high = lines.offset(BEGIN)
        assert low <= offset <= high
        low, high = lines.drift
        assert low - 1e-9 <= ppm / 1e6 <= high + 1e-9


def test_packets_both_ways_tell_a_drift_that_no_constant_offset_explains():
    line = ClockLine(BEGIN, 5 * SECOND, 100e-6)
    times = BEGIN + np.arange(0, 60 * SECOND, SECOND)
    there = Ordered(times, times + MILLISECOND + line.ahead(times + MILLISECOND))
    back = Ordered(times + MILLISECOND, times + line.ahead(times), back=True)
    low, high = constant_offset([there, back])
    assert low > high
    lines = ClockLines.of([there, back])
    assert lines.drift_known
    assert sum(lines.drift) / 2 == pytest.approx(100e-6, abs=1e-7)
    low, high = lines.drifting(100e-6)
    assert low <= 5 * SECOND <= high <= low + 3 * MILLISECOND


@given(offset=st.integers(-(10**18), 10**18), ppm=st.floats(-499, 499), at=st.integers(0, 10**14))
def test_setting_a_clock_back_undoes_its_line(offset, ppm, at):
    line = ClockLine(BEGIN, offset, ppm / 1e6)
    times = np.array([BEGIN + at])
    assert abs(int(line.set_back(times + line.ahead(times))[0]) - int(times[0])) <= 1 + 1e-7 * at


@pytest.mark.parametrize("ppm", [0, 80, -200])
def test_packets_one_way_tell_a_drift_by_the_quickest(ppm):
    dice = np.random.default_rng(1)
    line = ClockLine(BEGIN, 0, ppm / 1e6)
    times = BEGIN + np.arange(0, 120 * SECOND, SECOND // 10)
    delay = 300 * MICROSECOND + dice.exponential(200 * MICROSECOND, len(times)).astype(np.int64)
    lines = ClockLines.of(one_way(times, times + delay + line.ahead(times)))
    low, high = lines.drift
    assert low <= ppm / 1e6 <= high <= low + 10e-6


def test_pairs_that_contradict_each_other_leave_no_line():
    times = BEGIN + np.arange(10) * SECOND
    there, back = Ordered(times, times), Ordered(times, times + SECOND, back=True)
    assert not ClockLines.of([there, back])
    assert ClockLines.of([there, back], loose_ns=SECOND)


def test_one_bound_alone_tells_nothing():
    times = BEGIN + np.arange(10) * SECOND
    assert ClockLines.of([Ordered(times, times)]) is None
