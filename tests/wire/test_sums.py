"""The published check values, the definition bit by bit, and an independent library."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from fastcrc import crc16 as peer
from fastcrc import crc32 as peer32
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.wire import arrays
from edoras_tools.wire.arrays import CRC16_BYTES, FileCrc, crc16, crc16_rows, crc32, crc32c


def by_definition(octets):
    """132.0-B 4.1.6.2, a bit at a time."""
    remainder = 0xFFFF
    for octet in octets:
        for bit in range(8):
            carry = (remainder >> 15) ^ (octet >> (7 - bit) & 1)
            remainder = (remainder << 1 & 0xFFFF) ^ (0x1021 * carry)
    return remainder


def test_check_value():
    assert crc16(b"123456789") == 0x29B1


@given(st.binary(max_size=40))
def test_one_range(octets):
    assert crc16(octets) == by_definition(octets) == peer.ibm_3740(octets)
    assert crc16(octets + crc16(octets).to_bytes(CRC16_BYTES, "big")) == 0


@pytest.mark.parametrize("least", [1, 40, 300])
@given(st.lists(st.binary(min_size=2, max_size=33), min_size=1, max_size=6))
def test_many_ranges(least, parts):
    parts = parts * -(-least // len(parts))
    length = np.array([len(part) for part in parts], np.int32)
    offset = np.cumsum(length).astype(np.int64) - length + 3
    data = np.frombuffer(b"abc" + b"".join(parts), np.uint8)
    assert crc16_rows(data, offset, length).tolist() == [crc16(part) for part in parts]


def test_more_than_is_laid_out_at_once(monkeypatch):
    monkeypatch.setattr("edoras_tools.wire.arrays._BLOCK", 4096)
    data = np.random.default_rng(5).integers(0, 256, 200 * 97, dtype=np.uint8)
    offset, length = np.arange(200, dtype=np.int64) * 97, np.full(200, 97, np.int32)
    expected = [crc16(data[at : at + 97].tobytes()) for at in offset]
    assert crc16_rows(data, offset, length).tolist() == expected


def test_check_values_of_32_bits():
    assert crc32(b"123456789") == 0xCBF43926
    assert crc32c(b"123456789") == 0xE3069283
    assert (crc32c(bytes(32)), crc32c(b"\xff" * 32)) == (0x8A9136AA, 0x62A8AB43), "RFC 3720 B.4"


@given(st.binary(max_size=700), st.binary(max_size=300))
def test_castagnoli_goes_on_where_it_ended(front, back):
    assert crc32c(front) == peer32.iscsi(front)
    assert crc32c(back, crc32c(front)) == peer32.iscsi(front + back)


@pytest.mark.parametrize("castagnoli", [False, True])
@given(st.binary(max_size=300), st.lists(st.integers(0, 300), max_size=6), st.randoms())
def test_a_file_in_any_order(castagnoli, content, cuts, chance):
    ends = sorted({*(min(cut, len(content)) for cut in cuts), 0, len(content)})
    pieces = [(first, content[first:end]) for first, end in pairwise(ends)]
    chance.shuffle(pieces)
    found = FileCrc(castagnoli=castagnoli)
    for offset, piece in pieces:
        found.add(piece, offset)
    expected = (peer32.iscsi if castagnoli else peer32.iso_hdlc)(content)
    assert found.of_file(len(content)) == found.of_file(len(content)) == expected


def test_far_behind_the_beginning():
    found = FileCrc()
    found.add(b"end", (1 << 20) + 5)
    found.add(bytes((1 << 20) + 5), 0)
    assert found.of_file((1 << 20) + 8) == crc32(bytes((1 << 20) + 5) + b"end")


@given(st.lists(st.binary(min_size=1, max_size=40), min_size=1, max_size=12))
def test_equal_bytes_and_only_those_share_a_fingerprint(messages):
    data = np.frombuffer(b"".join(messages), np.uint8)
    data = np.append(data, np.zeros(8, np.uint8))  # as a batch has some bytes behind its last packet
    length = np.array([len(item) for item in messages], np.int32)
    found = arrays.of_bytes(data, np.cumsum(length, dtype=np.int64) - length, length)
    for index, one in enumerate(messages):
        for other, two in enumerate(messages):
            assert (found[index] == found[other]) == (one == two)
