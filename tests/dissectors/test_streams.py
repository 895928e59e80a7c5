"""Links over TCP in Wireshark: our Lua reads what its TCP and WebSocket dissectors put together."""

from __future__ import annotations

import itertools
import random
import struct

import pytest
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from places import ROOT
from racs2_peer import Talk, to_cfs, to_ros
from scapy.layers.l2 import Ether
from streams import frames, sbn_messages, segments_of, write_segments

from edoras_tools.addons.racs2 import link as racs2
from edoras_tools.decode import Context, Dissector
from edoras_tools.dissectors import scapy_layers
from edoras_tools.io.frames.linklayer import Demux


def capture_of(segments, path):
    """Write segments as a pcap file; return our own reading of them."""
    write_segments(path, segments)
    demux, dissector = Demux(), Dissector(Context())
    found = demux.demux(frames(segments))
    return [dissector.dissect(found[row]) for row in range(len(found))]


def said(tshark, capture, *fields):
    """Return every value of some fields that tshark gives, in order."""
    asked = [word for name in fields for word in ("-e", name)]
    how = ["-T", "fields", "-E", "occurrence=a", "-E", "aggregator=,"]
    lines = tshark().run("-r", capture, *how, *asked).decode().splitlines()
    columns = zip(*(line.split("\t") for line in lines), strict=True)
    return [[item for row in column for item in row.split(",") if item] for column in columns]


@pytest.mark.quick("cuts1")
@pytest.mark.parametrize("cuts", [[], [33, 70, 200, 201, 777], range(0, 2000, 64)])
def test_sbn_messages_of_any_segments(cuts, tshark, tmp_path):
    messages = sbn_messages(60)
    ours = capture_of(segments_of(b"".join(messages), cuts), tmp_path / "sbn.pcap")
    names = ("msg_size", "msg_type", "processor_id", "spacecraft_id")
    theirs = said(tshark, tmp_path / "sbn.pcap", *(f"sbn.{name}" for name in names), "edoras.link")
    headers = [item.layer("sbn").values() for item in ours]
    assert len(ours) == 60
    for name, values in zip(names, theirs, strict=False):
        assert [int(value, 0) for value in values] == [item[name] for item in headers]


@pytest.mark.quick("6")
@pytest.mark.parametrize("seed", range(12))
def test_a_capture_that_begins_inside_a_message_shows_every_whole_one_behind(seed, tshark, tmp_path):
    """In segments that begin anywhere, too; our own decoder starts with one of these messages."""
    chance, messages = random.Random(seed), sbn_messages(60)
    stream, first = b"".join(messages), chance.randrange(1, 1500)
    cuts = chance.sample(range(1, len(stream) - first), 12)
    _syn, *segments = segments_of(stream[first:], cuts)
    ours = capture_of(segments, tmp_path / "cut.pcap")
    ends = itertools.accumulate(map(len, messages))
    whole = [message for end, message in zip(ends, messages, strict=True) if end - len(message) >= first]
    (sizes,) = said(tshark, tmp_path / "cut.pcap", "sbn.msg_size")
    assert [int(size) for size in sizes] == [len(message) - 11 for message in whole]
    found = [bytes(item.datagram.payload) for item in ours if item.layers]
    assert found
    assert found == whole[-len(found) :]


@pytest.mark.each(2)
@pytest.mark.quick("example-protocol-False", "None-True")
@pytest.mark.parametrize("deflate", [False, True])
@pytest.mark.parametrize("subprotocol", ["example-protocol", None])
def test_racs2_messages(deflate, subprotocol, tshark, tmp_path):
    talk = Talk(deflate=deflate, subprotocol=subprotocol)
    for number in range(20):
        talk.cfs.send_binary(to_ros(f"/topic_{number}", bytes([number])))
        talk.pass_on()
        talk.ros.send_binary(to_cfs(0x1894 + number, b"body" * number))
        talk.pass_on()
    ours = capture_of(talk.segments, tmp_path / "racs2.pcap")
    topics, ids = said(tshark, tmp_path / "racs2.pcap", "racs2.topic.topic_name", "racs2.message.msg_id")
    values = [item.layers[0].values() for item in ours if item.layers]
    assert topics == [item["topic_name"] for item in values if "topic_name" in item]
    assert [int(item, 0) for item in ids] == [item["msg_id"] for item in values if "msg_id" in item]
    assert len(topics) == len(ids) == 20


BODIES = [
    {"string_data": "hello é", "bool_data": True},
    {"int32_data": -5, "int64_data": -(1 << 62), "uint32_data": 0xFFFFFFFF, "uint64_data": (1 << 64) - 1},
    {
        "float_data": 0.5,
        "double_data": -2.25,
        "float64_array_data": [1.0, 1e300],
        "float32_array_data": [0.25],
    },
    {"int32_array_data": [1, -150, 3], "uint64_array_data": [0, 1 << 63], "int64_array_data": [-1]},
]


MISSIONS = [ROOT / f"samples/missions/two_rovers_{side}.yaml" for side in ("ground", "flight")]


def test_every_field_of_what_streams_hold(agreed, tmp_path):
    """SBN and RACS2, several messages in a segment: as our own decoder has them, also in the packet list."""
    path, talk = tmp_path / "streams.pcap", Talk()
    for number, values in enumerate(BODIES):
        talk.cfs.send_binary(to_ros("/topic", encoded(values)))
        talk.pass_on()
        talk.ros.send_binary(to_cfs(0x1894 + number, b"body" * number + bytes(120)))
        talk.pass_on()
    messages = b"".join(sbn_messages(60))
    write_segments(path, [*talk.segments, *segments_of(messages, range(0, 3000, 150))])
    _, compared, ours, _ = agreed(path, *MISSIONS)
    assert compared > 200
    assert max(map(len, ours.values())) > 3


def encoded(values):
    """Write values as Protocol Buffers has them; by its specification, not with ours."""

    def varint(number):
        number &= (1 << 64) - 1
        out = bytearray()
        while number > 127:
            out.append(number & 127 | 128)
            number >>= 7
        return bytes([*out, number])

    body = b""
    for name, value in values.items():
        number = racs2.BODY_FIELDS[name][0]
        items = value if isinstance(value, list) else [value]
        if name.startswith(("float64", "double", "float")):
            raw = struct.pack(f"<{len(items)}{'d' if '64' in name or 'double' in name else 'f'}", *items)
        else:
            raw = items[0].encode() if name == "string_data" else b"".join(map(varint, items))
        kind = 2 if isinstance(value, (list, str)) else {"float_data": 5, "double_data": 1}.get(name, 0)
        body += varint(number << 3 | kind) + (varint(len(raw)) if kind == 2 else b"") + raw
    return body


def test_values_in_racs2_bodies(tshark, tmp_path):
    talk = Talk()
    for values in BODIES:
        talk.cfs.send_binary(to_ros("/topic", encoded(values)))
        talk.pass_on()
    talk.ros.send_binary(to_cfs(0x1894, b"\x32\x7fcut"))
    talk.ros.send_binary(to_cfs(0x1895, b"\x15" + bytes(4)))
    talk.pass_on()
    ours = capture_of(talk.segments, tmp_path / "racs2.pcap")
    names = list(racs2.BODY_FIELDS)
    theirs = dict(
        zip(names, said(tshark, tmp_path / "racs2.pcap", *(f"racs2.body.{n}" for n in names)), strict=True)
    )
    read = {name: [] for name in names}
    for item in ours:
        for name, value in (item.layers[0].values() if item.layers else {}).items():
            if name in read:
                read[name] += value if isinstance(value, list) else [value]
    for name in names:
        want = (
            [item for values in BODIES for item in values.get(name, ())]
            if "array" in name
            else [values[name] for values in BODIES if name in values]
        )
        want += [0.0] * (name == "float_data")
        assert read[name] == want
        if name == "string_data":
            assert theirs[name] == want
        else:
            truth = {"True": 1, "1": 1, "False": 0, "0": 0}
            assert [truth[item] if name == "bool_data" else float(item) for item in theirs[name]] == [
                float(item) for item in want
            ], name


@pytest.mark.long
@given(st.lists(st.binary(max_size=40), min_size=1, max_size=30))
@settings(max_examples=examples(3))
def test_both_tell_which_bodies_are_values(tshark, tmp_path_factory, bodies):
    path = tmp_path_factory.mktemp("racs2") / "racs2.pcap"
    talk = Talk()
    started = [
        bytes([8 * (1 + number % 14) | (0, 2, 1, 5)[number % 4]]) + item for number, item in enumerate(bodies)
    ]
    for item in started:
        talk.ros.send_binary(to_cfs(0x1894, item))
        talk.pass_on()
    ours = capture_of(talk.segments, path)
    names = list(racs2.BODY_FIELDS)
    counted = {
        name: len(values)
        for name, values in zip(names, said(tshark, path, *(f"racs2.body.{n}" for n in names)), strict=True)
    }
    read = dict.fromkeys(names, 0)
    for item in ours:
        for name, value in (item.layers[0].values() if item.layers else {}).items():
            if name in read and name != "string_data":
                read[name] += len(value) if isinstance(value, list) else 1
    assert read | {"string_data": 0} == counted | {"string_data": 0}


def test_foxglove_and_other_text_on_the_port_are_left_to_wireshark(tshark, tmp_path):
    talk = Talk(subprotocol=None)
    for number in range(5):
        talk.ros.send_text(b'{"op":"serverInfo"}' + bytes([48 + number]) * 60)
        talk.pass_on()
    capture_of(talk.segments, tmp_path / "other.pcap")
    assert said(tshark, tmp_path / "other.pcap", "racs2.topic.topic_name", "racs2.message.msg_id") == [[], []]


def test_scapy_reads_what_is_written():
    messages = sbn_messages(30)
    demux = Demux()
    batch = demux.demux(frames(segments_of(b"".join(messages), [33, 70, 500])))
    for row, message in enumerate(messages):
        packet = Ether(batch[row].frame)[scapy_layers.SBN]
        assert (packet.msg_type, packet.processor_id, packet.spacecraft_id) == (message[2], 3, 0x42)
        assert bytes(packet) == message
    topic, command = scapy_layers.RACS2(to_ros("/a/b", b"x")), scapy_layers.RACS2(to_cfs(0x1894, b"x"))
    assert topic.topic_name == "/a/b"
    assert (type(command), command.msg_id) == (scapy_layers.RACS2Message, 0x1894)
    assert bytes(command.payload) == b"x"
