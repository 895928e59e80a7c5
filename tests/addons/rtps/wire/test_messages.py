"""RtpsMessages in columns: every submessage beside tshark, both byte orders, and any bytes."""

import struct

import numpy as np
import pytest
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from rtps import PREFIX, READER, WRITER, buffer, data, made, message, parameter, submessage

from edoras_tools.addons.rtps.wire import (
    MOST_SUBMESSAGES,
    NO_TIME,
    NOWHERE,
    SubmessageFields,
    SubmessageKind,
    guid_text,
    read_messages,
    read_samples,
    sequence_set,
)

OTHER = bytes(range(100, 112))
ORDERS = pytest.mark.parametrize("little", [True, False])


def read(*payloads):
    return read_messages(*buffer(*payloads))


@ORDERS
def test_what_is_said_of_what_follows(little):
    order = int(little)
    seconds = made(SubmessageKind.INFO_TS, order, seconds=7, fraction=1 << 31)
    raw = message(
        data(1, b"\0\1\0\0abcd", 4 | order),
        made(SubmessageKind.INFO_DST, order, guid_prefix=OTHER),
        seconds,
        data((5 << 32) + 9, b"\0\1\0\0", 4 | order),
        made(SubmessageKind.INFO_SRC, order, guid_prefix=OTHER),
        submessage(SubmessageKind.INFO_TS, b"", 2 | order),
        data(3, b"\0\1\0\0", 4 | order),
    )
    found, truncated, odd = read(raw)
    assert not truncated.any()
    assert not odd.any()
    kinds = [SubmessageKind(kind).name for kind in found.kind.tolist()]
    assert kinds == ["DATA", "INFO_DST", "INFO_TS", "DATA", "INFO_SRC", "INFO_TS", "DATA"]
    some = found.take(np.flatnonzero(found.kind == SubmessageKind.DATA))
    fields = SubmessageFields(buffer(raw)[0], some, SubmessageKind.DATA)
    assert fields.sequence_number("writer_sn").tolist() == [1, (5 << 32) + 9, 3]
    assert [item.tobytes() for item in fields.guid("writer_id")] == [
        PREFIX + WRITER,
        PREFIX + WRITER,
        OTHER + WRITER,
    ]
    assert [item.tobytes()[:12] for item in fields.guid("reader_id")] == [bytes(12), OTHER, OTHER]
    assert some.time_ns.tolist() == [NO_TIME, 7_500_000_000, NO_TIME]
    assert some.destination[0] == NOWHERE


def test_a_length_of_zero_goes_to_the_end_but_not_of_a_time():
    end = submessage(SubmessageKind.DATA, data(4, b"")[4:] + b"\0\1\0\0" + bytes(70_000), 5, length=0)
    raw = message(submessage(SubmessageKind.INFO_TS, b"", 3), submessage(SubmessageKind.PAD, b""), end)
    found, truncated, _ = read(raw)
    assert not truncated.any()
    assert found.kind.tolist() == [SubmessageKind.INFO_TS, SubmessageKind.PAD, SubmessageKind.DATA]
    assert found.end[-1] == len(raw)
    samples = read_samples(buffer(raw)[0], found, SubmessageKind.DATA)
    assert (samples.end - samples.start).tolist() == [70_004]


@ORDERS
def test_inline_qos_is_skipped(little):
    order = "<" if little else ">"
    qos = parameter(0x71, b"\0\0\0\1", order) + parameter(0x70, bytes(16), order)
    end = struct.pack(f"{order}HH", 1, 0)
    raw = message(
        data(1, b"\0\1\0\0abcd", 4 | little, qos + end),
        data(2, b"\0\3\0\0abcd", 4 | little, qos),  # it never ends: its data is not found
        data(3, b"\0\1\0\0abcd", 4 | little),
    )
    octets = buffer(raw)[0]
    samples = read_samples(octets, read(raw).submessages, SubmessageKind.DATA)
    assert samples.fits.tolist() == [True, False, True]
    assert [octets[a:b].tobytes() for a, b in zip(samples.start[::2], samples.end[::2], strict=True)] == [
        b"\0\1\0\0abcd"
    ] * 2


def test_a_cyclic_list_a_huge_length_and_too_many_end():
    qos = parameter(0x71, b"") * 5000  # no sentinel, lengths of 0
    far = submessage(SubmessageKind.DATA, data(1, b"")[4:], 5, length=0xFFFF)
    many = message(*[submessage(0x80, b"")[:2] + b"\4\0" + bytes(4)] * (MOST_SUBMESSAGES + 5))
    found, truncated, odd = read(message(data(1, b"xxxx", inline=qos)), message(far), many)
    assert truncated.tolist() == [False, True, False]
    assert odd.tolist() == [False, False, True]
    assert np.bincount(found.row).tolist() == [1, 1, MOST_SUBMESSAGES]
    octets = buffer(message(data(1, b"xxxx", inline=qos)))[0]
    assert not read_samples(octets, read(message(data(1, b"xxxx", inline=qos)))[0], 0x15).fits.any()


@ORDERS
def test_a_set_of_numbers(little):
    order = "<" if little else ">"
    words = struct.pack(f"{order}II", 0xA0000001, 0x80000000)
    assert sequence_set(words, 0, 8, little=little, base=10, bits=40) == [10, 12, 41, 42]
    assert sequence_set(words, 0, 8, little=little, base=10, bits=32) == [10, 12, 41]
    assert sequence_set(words, 0, 4, little=little, base=10, bits=1 << 31) == [10, 12, 41]
    assert sequence_set(b"", 0, 0, little=little, base=10, bits=256) == []


def test_acknacks_are_from_readers():
    raw = message(
        made(SubmessageKind.INFO_DST, guid_prefix=OTHER),
        made(SubmessageKind.ACKNACK, base=3, num_bits=0, tail=bytes(4)),
    )
    found = read(raw).submessages
    some = found.take(np.flatnonzero(found.kind == SubmessageKind.ACKNACK))
    fields = SubmessageFields(buffer(raw)[0], some, SubmessageKind.ACKNACK)
    assert fields.guid("writer_id")[0].tobytes() == OTHER + WRITER
    assert fields.guid("reader_id")[0].tobytes() == PREFIX + READER
    assert guid_text(OTHER + WRITER) == f"{OTHER.hex()}.00001203"


@settings(max_examples=examples(300), deadline=None)
@given(st.lists(st.binary(max_size=200), max_size=4), st.booleans())
def test_any_bytes(payloads, begun):
    payloads = [message(item) if begun else item for item in payloads] or [b""]
    octets, offset, length = buffer(*payloads)
    found, truncated, odd = read_messages(octets, offset, length)
    assert len(truncated) == len(odd) == len(payloads)
    assert (found.start >= offset[found.row] + 20).all()
    assert (found.end <= (offset + length)[found.row]).all()
    assert (found.end >= found.start + 4).all()
    for kind in (SubmessageKind.DATA, SubmessageKind.DATA_FRAG):
        samples = read_samples(octets, found, kind)
        assert (samples.start <= samples.end).all()
        assert (samples.start >= found.start[samples.which]).all()
