from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.io.frames import frame_batch as framing
from edoras_tools.io.frames.frame_batch import walk_records
from edoras_tools.wire.arrays import read_at

HEADER = 2


def chain_of(raw):
    """The two successors of records that start with their length, u16, header included."""
    data = np.frombuffer(raw + bytes(64), dtype=np.uint8)

    def successor(positions):
        return positions + read_at(data, positions, "<u2")

    def step(position):
        return position + struct.unpack_from("<H", data, position)[0]

    return successor, step


def one_by_one(raw, start):
    """What ``walk_records`` promises, as plainly as it can be said."""
    _, step = chain_of(raw)
    positions = []
    while start < len(raw) and start < (after := step(start)) <= len(raw):
        positions.append(start)
        start = after
    return positions, start


def walked(raw, start, seeds):
    positions, stop = walk_records(start, len(raw), np.array(sorted(seeds), dtype=np.int64), *chain_of(raw))
    return positions.tolist(), stop


@pytest.fixture(params=[1, 3, 16])
def _lanes(monkeypatch, request):
    monkeypatch.setattr(framing, "_LANES", request.param)


records = st.lists(st.binary(max_size=40), max_size=60).map(
    lambda bodies: b"".join(struct.pack("<H", len(body) + HEADER) + body for body in bodies)
)


@pytest.mark.usefixtures("_lanes")
class TestWalk:
    @given(raw=records, tail=st.binary(max_size=50), data=st.data())
    def test_any_seeds_give_what_the_scalar_walk_gives(self, raw, tail, data):
        raw += tail
        seeds = data.draw(st.sets(st.integers(-3, len(raw) + 3), max_size=80))
        assert walked(raw, 0, seeds) == one_by_one(raw, 0)

    @given(raw=records, tail=st.binary(max_size=50))
    def test_a_seed_at_every_byte(self, raw, tail):
        raw += tail
        assert walked(raw, 0, range(len(raw))) == one_by_one(raw, 0)

    @given(raw=st.binary(max_size=300), data=st.data())
    def test_garbage(self, raw, data):
        start = data.draw(st.integers(0, len(raw)))
        seeds = data.draw(st.sets(st.integers(0, 300), max_size=80))
        assert walked(raw, start, seeds) == one_by_one(raw, start)

    @given(raw=records, keep=st.integers(1, 7))
    def test_true_seeds(self, raw, keep):
        positions, stop = one_by_one(raw, 0)
        assert walked(raw, 0, positions[::keep]) == (positions, stop)

    def test_payload_that_imitates_records(self):
        decoy = struct.pack("<HHH", 6, 1, 4) * 50
        raw = (struct.pack("<H", len(decoy) + HEADER) + decoy) * 40
        assert walked(raw, 0, range(0, len(raw), 7)) == one_by_one(raw, 0)


def test_long_stretches_beside_short_ones():
    raw = struct.pack("<H", 2) * 5000 + (struct.pack("<H", 500) + bytes(498)) * 100
    positions, stop = one_by_one(raw, 0)
    assert walked(raw, 0, positions[::50]) == (positions, stop)
    assert walked(raw, 0, positions[4000:]) == (positions, stop)


def test_nothing_there():
    assert walked(b"", 0, []) == ([], 0)
