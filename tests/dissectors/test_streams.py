"""Links over TCP in Wireshark: our Lua reads what its TCP and WebSocket dissectors put together."""

from __future__ import annotations

import pytest
from racs2_peer import Talk, to_cfs, to_ros
from scapy.layers.l2 import Ether
from streams import frames, sbn_messages, segments_of, write_segments

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
