"""Nothing that was taken waits long for the file, whoever is behind."""

from types import SimpleNamespace

import numpy as np
import pytest

from edoras_tools.pipelines.capture.flushing import FLUSH_NS, Flushing

MS = 1_000_000


class Clocks:
    """Monotonic and wall time, moved by hand, and a sink that notes when it is flushed."""

    def __init__(self):
        self.now, self.offset, self.flushed = 0, 10**18, []
        self.flushing = Flushing(self, lambda: self.now, lambda: self.now + self.offset)

    def flush(self):
        self.flushed.append(self.now // MS)

    def take(self, age_ms=0, size=100):
        length = np.array([size], np.int32)
        times = np.array([self.now + self.offset - age_ms * MS])
        self.flushing.took(_Batch(time_ns=times, frame_length=length))
        self.flushing.look()


class _Batch(SimpleNamespace):
    def __len__(self):
        return len(self.time_ns)


@pytest.fixture
def clocks():
    return Clocks()


def test_what_comes_in_time_is_flushed_together(clocks):
    for clocks.now in range(0, 1001 * MS, 10 * MS):
        clocks.take()
    assert clocks.flushed == [200, 400, 600, 800, 1000]


@pytest.mark.parametrize("behind_ms", [200, 900, 60_000])
def test_who_is_behind_flushes_every_batch(clocks, behind_ms):
    for clocks.now in range(100 * MS, 400 * MS, 100 * MS):
        clocks.take(behind_ms)
    assert clocks.flushed == [100, 200, 300]


def test_age_and_wait_together_are_bounded(clocks):
    clocks.take(150)
    for clocks.now in range(0, 100 * MS, 10 * MS):
        clocks.flushing.look()
    assert clocks.flushed == [50]


def test_a_clock_set_back_delays_nothing(clocks):
    clocks.offset -= 3600 * 10**9
    clocks.take(-3600 * 1000)
    clocks.now = FLUSH_NS
    clocks.flushing.look()
    assert clocks.flushed == [200]


def test_it_is_flushed_with_nothing_to_write_too(clocks):
    for clocks.now in range(0, 550 * MS, 50 * MS):
        clocks.flushing.look()
    assert clocks.flushed == [200, 400]


def test_swift_traffic_fills_chunks_by_itself(clocks):
    for clocks.now in range(0, 500 * MS, 10 * MS):
        clocks.take(size=1 << 20)
    assert clocks.flushed == []


def test_of_files_no_age_is_taken(clocks):
    clocks.flushing = Flushing(clocks, lambda: clocks.now, None)
    clocks.take(10**9)
    assert clocks.flushed == []
    assert clocks.flushing.wait_s == 0.2
