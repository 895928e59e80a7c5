"""SBN over TCP as two running cFS and a peer spoke it, against a reader made of ``struct`` and scapy."""

import struct
from collections import Counter

import pytest
from captures import read
from places import ROOT
from scapy.layers.inet import IP, TCP
from scapy.utils import rdpcap

from edoras_tools.io.formats.open import open_file
from edoras_tools.model import NO_MSG_ID
from edoras_tools.pipelines.workbench import Settings

CAPTURE = ROOT / "samples/cfs_files/sbn_tcp.pcap.gz"
SUB, APP, PROTO, HEARTBEAT = 1, 3, 4, 0xA0


@pytest.fixture(scope="module")
def messages():
    """Every message: the frame that ends it, the sender's port, type, ProcessorID, SpacecraftID, payload."""
    streams, found = {}, []
    for number, frame in enumerate(rdpcap(str(CAPTURE)), 1):
        if TCP not in frame:
            continue
        tcp = frame[TCP]
        key = tcp.sport, tcp.dport
        if tcp.flags.S:
            streams[key] = [(tcp.seq + 1) % 2**32, b""]
        data = bytes(tcp.payload)[: frame[IP].len - 20 - tcp.dataofs * 4]
        known = (streams[key][0] - tcp.seq) % 2**32 if data else 0
        if known >= len(data):
            continue
        stream = streams[key]
        stream[0], rest = (tcp.seq + len(data)) % 2**32, stream[1] + data[known:]
        while len(rest) >= 11 and len(rest) >= 11 + (size := int.from_bytes(rest[:2], "big")):
            _, *head = struct.unpack(">hBII", rest[:11])
            found.append((number, tcp.sport, *head, rest[11 : 11 + size]))
            rest = rest[11 + size :]
        stream[1] = rest
    assert not any(rest for _, rest in streams.values())
    return found


def test_each_message_of_a_running_cfs_is_a_row(messages):
    rows, error = read(CAPTURE)
    theirs = [
        (number, port, struct.pack(">hBII", len(payload), *head) + payload)
        for number, port, *head, payload in messages
    ]
    ours = [(row.number, row.source.port, row.payload) for row in rows if row.stream and row.payload]
    assert (ours, error) == (theirs, "")
    assert Counter((head[3], head[2]) for head in messages) == {
        (1, PROTO): 2,
        (1, SUB): 2,
        (1, HEARTBEAT): 142,
        (1, APP): 16,
        (2, PROTO): 1,
        (2, SUB): 1,
        (2, APP): 16,
        (3, PROTO): 2,
        (3, APP): 60,
    }
    frames = rdpcap(str(CAPTURE))
    cut = [
        number for number, *_, payload in messages if len(payload) + 11 > len(frames[number - 1][TCP].payload)
    ]
    assert len(cut) == 3, "each SUB needed two segments"


def test_its_columns_are_those_of_its_headers(messages):
    decoder = Settings().workbench().columns
    found = []
    for batch in open_file(CAPTURE).batches():
        columns = decoder.decode(batch)
        own = columns.sbn_msg_type >= 0
        names = ("sbn_msg_type", "processor_id", "spacecraft_id", "msg_id", "findings")
        found += zip(*(getattr(columns, name)[own].tolist() for name in names), strict=True)
    assert found == [
        (kind, processor, spacecraft, int.from_bytes(payload[:2], "big") if kind == APP else NO_MSG_ID, 0)
        for _, _, kind, processor, spacecraft, payload in messages
    ]


def test_silence_makes_the_module_of_cfs_send_heartbeats_at_each_wake_up():
    """The heartbeats themselves do not count as sending, so they go on until a message is sent."""
    rows, _ = read(CAPTURE)
    (port,) = {
        row.source.port for row in rows if row.stream and row.payload[2:7] == bytes([PROTO, 0, 0, 0, 3])
    }
    times = [row.time_ns / 1e9 for row in rows if row.stream and row.destination.port == port]
    beats = [
        row.time_ns / 1e9
        for row in rows
        if row.stream and row.destination.port == port and row.payload[2] == HEARTBEAT
    ]
    assert len(beats) == 142
    assert 6 < beats[0] - max(when for when in times if when < beats[0]) < 7.3
    assert (len(beats) - 1) / (beats[-1] - beats[0]) == pytest.approx(21, abs=1)
