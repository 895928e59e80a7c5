"""RACS2: what the public bridges send, made by the `websockets` package, is decoded to what was sent."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from racs2_peer import Talk, to_cfs, to_ros
from streams import frames, segments_of
from websockets.frames import Opcode

from edoras_tools.addons.racs2 import link as racs2
from edoras_tools.addons.racs2.link import RACS2
from edoras_tools.decode import ColumnDecoder, Context, Dissector
from edoras_tools.io.frames.linklayer import Demux
from edoras_tools.model import OTHER, Finding

TEXT = b"\x32\x05hello"  # string_data of RACS2Bridge_std_msgs, field 6
PART = Finding.FRAGMENT


def rows(segments, *more):
    demux = Demux()
    found = [demux.demux(frames(item)) for item in (segments, *more)]
    rest = demux.finish()
    return [batch[row] for batch in (*found, *([rest] if rest else [])) for row in range(len(batch))]


def messages(found):
    """Return the payloads that are of the link: the same by both readers."""
    dissector = Dissector(Context())
    return [item.payload for item in found if dissector.dissect(item).link == RACS2]


def conversation(talk):
    """Let both sides speak; return what they said."""
    said = [
        to_ros("/Recv/RACS2Bridge", TEXT),
        to_cfs(0x1894, TEXT),
        to_ros("chatter", bytes(range(128))),
        to_cfs(0x1FFF, b""),
        to_cfs(0x0801, bytes(255)),
    ]
    for number, item in enumerate(said * 3):
        side = talk.cfs if len(item) == 160 and item[0] > 0x20 else talk.ros
        side.send_binary(item)
        if number % 4 == 0:
            side.send_ping(b"tick")
        talk.pass_on()
    talk.cfs.send_text(to_ros("/version_1", b"text"), fin=False)
    talk.cfs.send_ping(b"between")
    talk.cfs.send_continuation(b" in frames", fin=False)
    talk.cfs.send_continuation(b"!", fin=True)
    talk.pass_on()
    talk.ros.send_close(1000)
    talk.pass_on()
    return [*(said * 3), to_ros("/version_1", b"text") + b" in frames!"]


@pytest.fixture(params=["plain", "compressed", "compressed, no context"])
def talk(request):
    return Talk(deflate=request.param != "plain", takeover="no" not in request.param)


def test_what_the_bridges_send_is_what_is_read(talk):
    said = conversation(talk)
    if talk.cfs.extensions:
        assert talk.streams[0].count(bytes(64)) == 0
    found = rows(talk.segments)
    assert messages(found) == said
    others = [item.payload for item in found if item.payload not in said and PART not in item.findings]
    assert [item for item in others if item == b"tick"] == [b"tick"] * 8  # and the answers to them
    assert others.count(b"between") == 2
    assert others[-2:] == [struct.pack(">H", 1000)] * 2
    assert others[0].startswith(b"GET / ")
    assert others[1].startswith(b"HTTP/1.1 101")
    assert sum(PART in item.findings for item in found) == 2


def test_columns_and_fields_agree(talk):
    conversation(talk)
    batch = Demux().demux(frames(talk.segments))
    context = Context()
    columns, dissector = ColumnDecoder(context).decode(batch), Dissector(context)
    for row in range(len(batch)):
        decoded = dissector.dissect(batch[row])
        assert decoded.link == columns.link[row]
        assert int(decoded.findings) == columns.findings[row]


def test_fields_and_summary():
    dissector = Dissector(Context())
    talk = Talk()
    talk.cfs.send_binary(to_ros("/Recv/RACS2Bridge", TEXT))
    talk.pass_on()
    talk.ros.send_binary(to_cfs(0x1894, bytes(129)))
    talk.pass_on()
    first, second = (dissector.dissect(item) for item in rows(talk.segments)[2:])
    values = first.layers[0].values()
    assert values == {"topic_name": "/Recv/RACS2Bridge", "body_length": 128, "string_data": "hello"}
    assert first.summary == "/Recv/RACS2Bridge: string_data 'hello'"
    assert second.layers[0].values()["msg_id"] == 0x1894
    assert second.summary == "0x1894: 129 bytes, more than the 128 that cFS has room for"


def test_a_recording_of_the_rows_is_a_capture_of_the_same_messages(talk):
    said = conversation(talk)
    found = rows(talk.segments)
    whole = np.cumsum([len(item.frame) for item in found])
    batch = frames(talk.segments[:1])
    again = type(batch)(
        np.frombuffer(b"".join(item.frame for item in found), np.uint8),
        np.arange(1, len(found) + 1),
        np.array([item.time_ns for item in found]),
        np.ones(len(found), np.uint16),
        np.append(0, whole[:-1]),
        np.diff(whole, prepend=0).astype(np.int32),
        np.diff(whole, prepend=0).astype(np.int32),
    )
    demux = Demux()
    read = demux.demux(again)
    assert [
        read[row].payload for row in range(len(read)) if Finding.STREAM_GAP not in read[row].findings
    ] == [item.payload for item in found]
    assert messages([read[row] for row in range(len(read))]) == said


def test_a_capture_that_begins_in_the_connection_finds_the_messages():
    talk = Talk()
    said = conversation(talk)
    assert messages(rows(talk.segments[6:]))[-8:] == said[-8:]


def test_foxglove_on_the_same_port_is_left_out():
    talk = Talk(subprotocol="foxglove.websocket.v1")
    for _ in range(5):
        talk.ros.send_text(b'{"op":"serverInfo"}')
        talk.pass_on()
    demux = Demux()
    assert len(demux.demux(frames(talk.segments))) == 0
    later = Demux()
    talk.ros.send_binary(b"\x01\x07\0\0\0" + bytes(range(100)) * 1000)
    talk.pass_on()
    assert len(later.demux(frames(talk.segments[4:]))) == 0
    assert later.finish() is None


@given(st.data())
def test_messages_do_not_depend_on_segments(data):
    talk = Talk(deflate=data.draw(st.booleans()))
    said = conversation(talk)
    pieces = []
    for side, stream in enumerate(talk.streams):
        ends = {"source": talk.segments[side].source, "destination": talk.segments[side].destination}
        where = data.draw(st.lists(st.integers(1, len(stream)), max_size=12))
        pieces.append(segments_of(stream, where, (100, 500)[side], **ends))
    # Each direction in its order, the handshake first: what a capture of the connection holds.
    first = [item for part in pieces for item in part]
    assert sorted(messages(rows(first))) == sorted(said)


@given(st.lists(st.binary(max_size=300), max_size=6))
def test_nothing_in_a_stream_makes_it_fail(junk):
    talk = Talk()
    for item in junk:
        talk.cfs.send_binary(item)
        talk.pass_on()
    stream = talk.streams[0] + b"".join(junk)
    ends = {"source": talk.segments[0].source, "destination": talk.segments[0].destination}
    for segments in (
        segments_of(stream, [300], 100, **ends),
        segments_of(b"".join(junk) or b"x", [], 100, **ends),
    ):
        for item in rows(segments):
            Dissector(Context()).dissect(item)


@pytest.mark.parametrize("length", [1 << 20, 1 << 31, (1 << 63) - 1, 1 << 63])
def test_a_frame_that_claims_to_be_large_is_no_frame(length):
    talk = Talk()
    talk.ros.send_binary(to_cfs(0x1894, b"first"))
    talk.pass_on()
    opening = talk.streams[1]
    claimed = b"\x82\x7f" + struct.pack(">Q", length) + bytes(70_000)
    ends = {"source": talk.segments[1].source, "destination": talk.segments[1].destination}
    demux = Demux()
    batch = demux.demux(frames(segments_of(opening + claimed, [len(opening)], 500, **ends)))
    assert to_cfs(0x1894, b"first") in [batch[row].payload for row in range(len(batch))]
    assert demux.finish() is None


def test_a_bomb_is_not_inflated():
    talk = Talk(deflate=True)
    talk.ros.send_binary(to_cfs(0x1894, bytes(100)))
    talk.ros.send_binary(to_cfs(0x1894, bytes(50_000_000)))
    talk.pass_on()
    batch = Demux().demux(frames(talk.segments))
    assert batch.data.size < 2_000_000
    assert sum(Finding.FRAGMENT in batch[row].findings for row in range(len(batch))) == 1


@given(st.binary(max_size=200))
def test_any_body_is_values_or_none(body):
    values = racs2.std_msgs_values(body)
    assert values is None or set(values) <= set(racs2.BODY_FIELDS)


@pytest.mark.parametrize(
    ("body", "values"),
    [
        (b"\x08\x01", {"bool_data": True}),
        (b"\x15" + struct.pack("<f", 0.5), {"float_data": 0.5}),
        (b"\x19" + struct.pack("<d", -2.25), {"double_data": -2.25}),
        (b"\x20\xfb\xff\xff\xff\xff\xff\xff\xff\xff\x01", {"int32_data": -5}),
        (b"\x32\x05hello" + bytes(20), {"string_data": "hello"}),
        (b"\x38\xff\xff\xff\xff\x0f", {"uint32_data": 0xFFFFFFFF}),
        (b"\x52\x10" + struct.pack("<2d", 1, 2), {"float64_array_data": [1.0, 2.0]}),
        (b"\x5a\x03\x01\x96\x01", {"int32_array_data": [1, 150]}),
        (b"\x32\x05hell", None),
        (b"hello", None),
        (bytes(128), None),
        (b"", None),
    ],
)
def test_values_of_the_public_examples_messages(body, values):
    assert racs2.std_msgs_values(body) == values


@pytest.mark.each(3)
@pytest.mark.parametrize(
    ("payload", "link"),
    [
        (to_ros("/a", b""), RACS2),
        (to_ros("a" * 32, b""), RACS2),
        (to_cfs(1, b""), RACS2),
        (to_cfs(0, b""), OTHER),
        (to_cfs(0x2000, b""), OTHER),
        (to_cfs(0x1894, b"")[:31], OTHER),
        (b"GET / HTTP/1.1\r\nHost: somewhere.example\r\n\r\n", OTHER),
        (bytes([0x18, 0x94, 1]) + bytes(29), OTHER),
        ("/tópico".encode().ljust(32, b"\0"), OTHER),
        (b"9topic".ljust(32, b"\0"), OTHER),
        (b'{"op":"serverInfo","name":"Foxglove"}', OTHER),
    ],
)
def test_a_header_is_recognised(payload, link):
    talk = Talk()
    for side in (talk.ros, talk.cfs):
        side.send_binary(to_cfs(0x1894, b"first"))
        side.send_binary(payload)
        talk.pass_on()
    found = [item for item in rows(talk.segments) if item.payload == payload]
    assert len(found) == 2
    batch = Demux().demux(frames(talk.segments))
    columns = ColumnDecoder(Context()).decode(batch)
    for item in found:
        assert Dissector(Context()).dissect(item).link == link
    lengths = [batch[row].payload == payload for row in range(len(batch))]
    assert set(columns.link[np.array(lengths)].tolist()) == {int(link)}


def test_opcodes_are_those_of_the_public_package():
    from edoras_tools.addons.racs2.link import Opcode as Ours

    assert {item.name.removesuffix("INUATION"): int(item) for item in Opcode} == {
        item.name.removesuffix("INUATION"): int(item) for item in Ours
    }
