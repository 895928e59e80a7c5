from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.wire.arrays import PADDING, copy_rows, put_rows, read_at, spill_rows, word_sums

LENGTHS = st.lists(
    st.one_of(st.integers(0, 40), st.integers(250, 260), st.sampled_from([1, 127, 128, 1024])), max_size=40
)


@given(LENGTHS, st.integers(0, 2**32 - 1))
def test_every_row_arrives_and_nothing_else_changes(lengths, seed):
    random = np.random.default_rng(seed)
    length = np.array(lengths, dtype=np.int32)
    source = random.integers(0, 256, 2000, dtype=np.uint8)
    offsets = random.integers(0, 2001 - length) if lengths else np.zeros(0, dtype=np.int64)
    gaps = random.integers(0, 5, len(lengths))
    positions = np.cumsum(length + gaps) - length
    target = np.full(int(positions[-1] + length[-1]) if lengths else 0, 0xA5, dtype=np.uint8)
    expected = target.copy()
    for position, offset, size in zip(positions, offsets, lengths, strict=True):
        expected[position : position + size] = source[offset : offset + size]
    copy_rows(target, positions, source, offsets, length)
    assert np.array_equal(target, expected)


@given(LENGTHS, st.integers(0, 2**32 - 1), st.integers(0, 40))
def test_what_spills_stays_in_the_gaps(lengths, seed, behind):
    random = np.random.default_rng(seed)
    length = np.array(lengths, dtype=np.int32)
    source = random.integers(0, 256, 1024 + behind, dtype=np.uint8)
    offsets = random.integers(0, len(source) + 1 - length) if lengths else np.zeros(0, dtype=np.int64)
    positions = 3 + np.cumsum(length + random.integers(0, 5, len(lengths))) - length
    target = np.full((int(positions[-1] + length[-1]) if lengths else 3) + behind, 0xA5, dtype=np.uint8)
    spill_rows(target, positions, source, offsets, length)
    for position, offset, size in zip(positions, offsets, lengths, strict=True):
        assert np.array_equal(target[position : position + size], source[offset : offset + size])
    assert (target[: int(positions[0]) if lengths else None] == 0xA5).all()


def test_one_long_row_does_not_make_the_others_long():
    length = np.array([4] * 100 + [3000])
    positions = np.cumsum(length) - length
    target = np.zeros(int(length.sum()) + 3000, np.uint8)
    spill_rows(target, positions, np.full(3000, 7, np.uint8), np.zeros(101, np.int64), length)
    assert (target[: length.sum()] == 7).all()
    assert not target[length.sum() :].any()


@pytest.mark.parametrize("size", [0xFFFF, 0x10000, 0x10001, 300_000])
def test_large_rows(size):
    source = np.random.default_rng(size).integers(0, 256, size, dtype=np.uint8)
    target = np.zeros(size + 2, dtype=np.uint8)
    copy_rows(target, np.array([1]), source, np.array([0]), np.array([size]))
    assert np.array_equal(target[1:-1], source)
    assert target[0] == target[-1] == 0


def test_a_row_outside_its_buffer_is_refused_not_read():
    with pytest.raises(IndexError):
        copy_rows(np.zeros(8, np.uint8), np.array([0]), np.zeros(8, np.uint8), np.array([5]), np.array([4]))


def test_structures_are_put_byte_by_byte():
    rows = np.array([(1, 2), (3, 4)], dtype=[("a", "u1"), ("b", ">u2")])
    target = np.zeros(9, dtype=np.uint8)
    put_rows(target, np.array([5, 1]), rows)
    assert target.tolist() == [0, 3, 0, 4, 0, 1, 0, 2, 0]


def test_read_at_reads_unaligned_structures_in_their_byte_order():
    data = np.frombuffer(bytes(range(16)), dtype=np.uint8)
    header = read_at(data, np.array([1, 6]), np.dtype([("a", "u1"), ("b", ">u2"), ("c", "<u4")]))
    assert header["a"].tolist() == [1, 6]
    assert header["b"].tolist() == [0x0203, 0x0708]
    assert header["c"].tolist() == [0x07060504, 0x0C0B0A09]


@given(st.binary(max_size=200), st.integers(0, 200), st.integers(0, 200))
def test_words_add_up_wherever_they_begin(data, first, last):
    begin, end = sorted(min(place, len(data)) for place in (first, last))
    part = data[begin:end] + bytes((end - begin) % 2)
    total = sum(int.from_bytes(part[at : at + 2], "big") for at in range(0, len(part), 2))
    buffer = np.frombuffer(data + bytes(PADDING), np.uint8)
    assert word_sums(buffer, np.array([begin]), np.array([end - begin])).tolist() == [total % 0xFFFF]


def test_large_rows_are_not_copied_on_their_way():
    source = np.arange(8 << 20, dtype=np.uint32).view(np.uint8)
    target, at, length = np.empty_like(source), np.zeros(1, np.int64), np.array([len(source)])
    tracemalloc.start()
    spill_rows(target, at, source, at, length)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert (target == source).all()
    assert most < 1 << 20
