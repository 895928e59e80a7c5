from __future__ import annotations

import struct

from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.websocket.relay import Meter

ANSWER = b"HTTP/1.1 101 Switching Protocols\r\nupgrade: websocket\r\n\r\n"


def frame(first, payload):
    """A frame as RFC 6455 5.2 has servers write it."""
    length = len(payload)
    if length < 126:
        head = struct.pack(">BB", first, length)
    elif length < 1 << 16:
        head = struct.pack(">BBH", first, 126, length)
    else:
        head = struct.pack(">BBQ", first, 127, length)
    return head + payload


def message(data):
    return frame(0x82, b"\x01" + bytes(12) + data)


others = st.one_of(
    st.binary(max_size=300).map(lambda text: frame(0x81, text)),
    st.just(frame(0x82, b"")),
    st.just(frame(0x88, b"")),
    st.just(frame(0x82, b"\x05" + bytes(20))),
)
sizes = st.sampled_from([0, 1, 111, 112, 113, 114, 65521, 65522, 65523, 65524, 70000])


@given(st.lists(st.one_of(sizes, others), max_size=12), st.data())
def test_counts_are_the_same_however_the_stream_is_cut(things, data):
    stream, messages, octets = bytearray(ANSWER), 0, 0
    for thing in things:
        if isinstance(thing, int):
            stream += message(bytes(thing))
            messages, octets = messages + 1, octets + thing
        else:
            stream += thing
    stream += frame(0x82, b"\x02" + bytes(8))
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=20)))
    meter = Meter()
    for start, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        meter.feed(bytes(stream[start:end]))
    assert (meter.passed.messages, meter.passed.octets, meter.passed.times) == (messages, octets, 1)


def test_byte_by_byte():
    meter = Meter()
    for octet in ANSWER + message(b"a" * 200) + message(b"") + frame(0x81, b"{}"):
        meter.feed(bytes([octet]))
    assert (meter.passed.messages, meter.passed.octets) == (2, 200)


def test_a_client_that_was_refused_is_none():
    meter = Meter()
    meter.feed(b"HTTP/1.1 400 Bad Request\r\n\r\nMissing expected header")
    assert not meter.accepted


def test_a_client_is_one_once_it_has_been_told_the_topics():
    meter = Meter()
    meter.feed(ANSWER + frame(0x81, b'{"op":"serverInfo"}'))
    assert not meter.accepted
    meter.feed(frame(0x81, b'{"op":"advertise"}'))
    assert meter.accepted


@given(st.lists(st.binary(max_size=64), max_size=20))
def test_anything_may_come(pieces):
    meter = Meter()
    meter.feed(ANSWER)
    for piece in pieces:
        meter.feed(piece)
