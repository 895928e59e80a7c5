"""Nothing that was taken waits long for the file, whoever is behind."""

from types import SimpleNamespace

import numpy as np
import pytest
from msgspec.structs import replace

from edoras_tools.model import Columns
from edoras_tools.pipelines.capture.flushing import FLUSH_NS, Flushing, Waiting

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
        self.flushing.flush_if_due()


class _Batch(SimpleNamespace):
    def __len__(self):
        return len(self.time_ns)


@pytest.fixture
def clocks():
    return Clocks()


def test_what_comes_in_time_is_flushed_together(clocks):
    for clocks.now in range(0, 1001 * MS, 10 * MS):
        clocks.take()
    assert clocks.flushed == [200, 410, 620, 830]


@pytest.mark.parametrize("behind_ms", [200, 900, 60_000])
def test_who_is_behind_flushes_every_batch(clocks, behind_ms):
    for clocks.now in range(100 * MS, 400 * MS, 100 * MS):
        clocks.take(behind_ms)
    assert clocks.flushed == [100, 200, 300]


def test_age_and_wait_together_are_bounded(clocks):
    clocks.take(150)
    for clocks.now in range(0, 100 * MS, 10 * MS):
        clocks.flushing.flush_if_due()
    assert clocks.flushed == [50]


def test_a_clock_set_back_delays_nothing(clocks):
    clocks.offset -= 3600 * 10**9
    clocks.take(-3600 * 1000)
    clocks.now = FLUSH_NS
    clocks.flushing.flush_if_due()
    assert clocks.flushed == [200]


def test_it_is_flushed_with_nothing_to_write_too(clocks):
    for clocks.now in range(0, 2550 * MS, 50 * MS):
        clocks.flushing.flush_if_due()
    assert clocks.flushed == [200, 1200, 2200]


def test_what_has_no_packets_is_flushed_as_soon(clocks):
    clocks.now = 200 * MS
    clocks.flushing.flush_if_due()
    for clocks.now in range(250 * MS, 1000 * MS, 50 * MS):
        if clocks.now == 300 * MS:
            clocks.flushing.noted()
        clocks.flushing.flush_if_due()
    assert clocks.flushed == [200, 500]


def test_swift_traffic_fills_chunks_by_itself(clocks):
    for clocks.now in range(0, 500 * MS, 10 * MS):
        clocks.take(size=1 << 20)
    assert clocks.flushed == []


def test_of_files_no_age_is_taken(clocks):
    clocks.flushing = Flushing(clocks, lambda: clocks.now, None)
    clocks.take(10**9)
    assert clocks.flushed == []
    assert clocks.flushing.wait_s == 0.2


@pytest.mark.parametrize(
    ("patient", "step_ms", "size", "written"),
    [
        (True, 200, 10, [3, 3]),
        (True, 100, 10, [5]),
        (True, 200, 300_000, [1] * 8),
        (False, 200, 10, [1] * 8),
    ],
    ids=["quiet", "quick", "much", "watched"],
)
def test_small_batches_wait_for_each_other(patient, step_ms, size, written, batches):
    """For 0.35 s from the first on; none is older than a second when the next one is written."""
    now, taken = 0, []
    waiting = Waiting(patient=patient, clock=lambda: now)
    one = batches[0].take(slice(0, 2))
    one = replace(one, data=np.zeros(size, np.uint8))
    for _ in range(8):
        waiting.add(one, Columns(**{name: np.zeros(2, int) for name in Columns.__struct_fields__}))
        if not waiting.waits:
            taken.append(len(waiting.take()[0]) // 2)
        now += step_ms * MS
    assert taken == written
    left = waiting.take()
    assert (len(left[0]) // 2 if left else 0) == 8 - sum(written)
    assert waiting.take() is None
