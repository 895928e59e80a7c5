"""F Prime: frames that its own ground system makes and reads, as our readers read them, and any bytes."""

from collections import Counter
from contextlib import closing
from functools import partial

import numpy as np
import pytest
from effort import examples
from fprime_frames import BAD, PACKETS, any_frames
from fprime_session import (
    CAPTURE,
    DICTIONARY,
    SESSION,
    ask,
    datagrams,
    own,
    space,
    tc,
    tm,
    why_not,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from rewriting import Udp, write
from rewriting import datagrams as captured
from rosbags.highlevel import AnyReader
from streams import frames as stream_frames
from streams import segments_of, write_segments

from edoras_tools.addons.fprime.link import FPRIME
from edoras_tools.decode import ColumnDecoder, Context, Dissector, Options
from edoras_tools.decode.filters.filter import Where
from edoras_tools.decode.filters.names import Names
from edoras_tools.decode.filters.rows import ColumnRows
from edoras_tools.io.formats.open import open_file
from edoras_tools.io.frames.linklayer import Demux
from edoras_tools.links.bare import TO
from edoras_tools.mission import Mission
from edoras_tools.model import Finding, PacketBatch
from edoras_tools.pipelines.capture.info import inspect
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.structs import Structs
from edoras_tools.structs.bindings import payloads
from edoras_tools.structs.files import load_layout

STRUCTS = Structs([load_layout(DICTIONARY)])
PLAIN, NAMED = Context(), Context(structs=STRUCTS)


def batch_of(*frames, port=50001, findings=0):
    """Return frames as the datagrams of a batch."""
    lengths = np.array([len(frame) for frame in frames], np.int32)
    offsets = np.cumsum(lengths) - lengths.astype(np.int64)
    count = len(frames)
    return PacketBatch(
        data=np.frombuffer(b"".join(frames) + bytes(64), np.uint8),
        number=np.arange(1, count + 1),
        time_ns=np.arange(count) * 1000,
        link_type=np.full(count, 101, np.uint16),
        frame_offset=offsets,
        frame_length=lengths,
        original_length=lengths,
        offset=offsets,
        length=lengths,
        source_address=np.full(count, 0x7F000001, np.uint32),
        source_port=np.full(count, 40000, np.uint16),
        destination_address=np.full(count, 0x7F000001, np.uint32),
        destination_port=np.full(count, port, np.uint16),
        ip_version=np.full(count, 4, np.uint8),
        capture_findings=np.full(count, findings, np.uint32),
    )


def both_ways(context, *frames):
    """Read frames one by one and all at once; return the packets, which both must see alike."""
    batch = batch_of(*frames)
    columns = ColumnDecoder(context).decode(batch)
    dissector = Dissector(context)
    packets = [dissector.dissect(batch[index]) for index in range(len(batch))]
    assert columns.link.tolist() == [int(packet.link) for packet in packets]
    for packet, findings in zip(packets, columns.findings.tolist(), strict=True):
        assert packet.findings.labels == Finding(findings).labels, packet.layers
    found = payloads(context.structs, partial(getattr, columns), partial(getattr, batch), batch.data)
    told = [[] for _ in packets]
    for held in context.structs.payloads_of(found, partial(getattr, columns), batch.data):
        encoded = held.encode()
        ends = zip(held.rows.tolist(), encoded.start.tolist(), encoded.size.tolist(), strict=True)
        for row, start, size in ends:
            told[row].append((held.bound.topic, encoded.data[start : start + size].tobytes()))
    for packet, messages in zip(packets, told, strict=True):
        assert sorted((message.topic, message.cdr) for message in packet.messages) == sorted(messages)
    return packets, ColumnRows(context, 0, batch, columns)


def rounded(value):
    """Return a value without the digits that 32 bits do not hold, and enumerations by number."""
    if isinstance(value, dict):
        return {name: rounded(item) for name, item in value.items()}
    if isinstance(value, list):
        return [rounded(item) for item in value]
    return round(value, 6) if isinstance(value, float) else value


MODES = {"IDLE": 0, "DRIVING": 1, "LOST": 255}


def numbered(value):
    """Return a value of the session with its modes as numbers."""
    if isinstance(value, dict):
        return {name: numbered(item) for name, item in value.items()}
    if isinstance(value, list):
        return [numbered(item) for item in value]
    return MODES.get(value, value) if isinstance(value, str) else value


def sent():
    """Return topic, values and time of each message of the session, in order."""
    for item in SESSION:
        time = dict(zip(("base", "context", "seconds", "microseconds"), item.get("time", ()), strict=False))
        if "channels" in item:
            for name, value in item["channels"]:
                yield f"/fprime/channels/{name.replace('.', '/')}", [value], time
            continue
        word = next(word for word in ("command", "event", "packet") if word in item)
        yield f"/fprime/{word}s/{item[word].replace('.', '/')}", item.get("args", item.get("values")), time


def test_the_values_that_were_sent():
    frames = [datagram.payload for datagram in captured(CAPTURE)]
    packets, _ = both_ways(NAMED, *frames)
    messages = [message for packet in packets for message in packet.messages]
    wanted = list(sent())
    assert [message.topic for message in messages] == [topic for topic, _, _ in wanted]
    for message, (_, values, time) in zip(messages, wanted, strict=True):
        told = {name: value for name, value in message.values.items() if not name.startswith("structure_")}
        assert told.pop("time", {}) == time
        assert rounded(list(told.values())) == rounded(numbered(values))
    assert not any(packet.findings for packet in packets)
    both_ways(PLAIN, *frames)


@pytest.mark.skipif(bool(why_not()), reason=why_not())
def test_the_ground_system_of_f_prime_makes_the_sample_and_reads_our_frames(tmp_path):
    pairs = [PACKETS[index : index + 2] for index in range(0, len(PACKETS), 2)]
    frames = [tm(*map(space, pair), count=index) for index, pair in enumerate(pairs)]
    given = {"own": [own(packet).hex() for packet in PACKETS], "ccsds": [item.hex() for item in frames]}
    told = ask(SESSION, given)
    again = write(tmp_path / "again.pcap", datagrams(told["send"]))
    assert again.read_bytes() == CAPTURE.read_bytes()
    every = [bytes.fromhex(item["packet"]) for item in told["send"]]
    assert every == PACKETS
    assert [bytes.fromhex(item) for item in told["receive"]["own"]] == every
    assert [bytes.fromhex(item) for item in told["receive"]["ccsds"]] == every
    for item, packet in zip(told["send"], every, strict=True):
        assert bytes.fromhex(item["frames"]["own"]) == own(packet)
        (one,), _ = both_ways(NAMED, bytes.fromhex(item["frames"]["own"]))
        (other,), _ = both_ways(NAMED, bytes.fromhex(item["frames"]["ccsds"]))
        assert one.messages == other.messages
        values = [(message.topic, message.values) for message in one.messages]
        for name, value, *text in item["read"]:
            if not str(value).isascii():
                continue  # it counts the bytes of a text as characters, and reads what follows elsewhere
            if text:
                assert "{" in text[0] or one.summary.endswith(text[0])
                given = [item for key, item in values[0][1].items() if key != "time"]
                assert rounded(given) == rounded(numbered(value))
            else:
                assert any(
                    rounded(numbered(value)) in (rounded(one.get("value")), *map(rounded, one.values()))
                    for topic, one in values
                    if topic.endswith((name.replace(".", "/"), "Motion", "About"))
                )


@pytest.mark.each(3)
@pytest.mark.parametrize("what", BAD)
def test_what_is_said_of_frames_that_are_not_right(what):
    frame, findings, count = BAD[what]
    (packet,), _ = both_ways(NAMED, frame)
    assert packet.link is FPRIME
    assert packet.findings.labels == findings
    assert len(packet.messages) == count
    both_ways(PLAIN, frame)


@settings(max_examples=examples(60))
@given(frames=st.lists(any_frames(), max_size=6))
def test_any_bytes_are_read_alike_one_by_one_and_all_at_once(frames):
    both_ways(PLAIN, *frames)
    packets, rows = both_ways(NAMED, *frames)
    for packet in packets:
        for layer in packet.layers:
            assert all(0 <= item.start <= item.end <= len(packet.datagram.payload) for item in layer.fields)
    names = Names(NAMED)
    for name in NAMES:
        (field,) = names.find(name)
        one = Where(name, NAMED).mask(rows.batch, rows.columns)
        assert one.tolist() == Where(name, NAMED).judge(packets).tolist()
        if field.read is not None:
            series = field.read(rows)
            assert series.present().tolist() == one.tolist(), name


NAMES = [
    "fprime",
    "fprime_packet",
    "fprime_space_packet",
    "fprime_event",
    "fprime_channel",
    "fprime_command",
    "fprime_telemetry",
    "fprime_tm",
    "fprime_tc",
    "Rover.cmdDisp.CommandsDispatched",
    "Rover.drive.ModeChanged",
    "Rover.cmdDisp.CMD_NO_OP_STRING",
    "ros",
]

GDS, ROVER = ("10.0.0.1", 50000), ("10.0.0.2", 40000)
KEEP_ALIVE = b"sitting well"


def in_streams(frames, cuts, junk=b""):
    """Return what is read of frames that travel over one TCP connection, in both directions."""
    demux = Demux()
    found = []
    for up in (True, False):
        stream = b"".join(junk + frame for frame, way in frames if way == up)
        ends = (GDS, ROVER) if up else (ROVER, GDS)
        segments = segments_of(stream, cuts, source=ends[0], destination=ends[1])
        batch = demux.demux(stream_frames(segments))
        found += [batch[row].payload for row in range(len(batch)) if batch[row].stream]
    rest = demux.finish()
    return found, [rest[row].payload for row in range(len(rest))] if rest is not None else []


@settings(max_examples=examples(10))
@given(cuts=st.sets(st.integers(0, 8000), max_size=20))
@pytest.mark.parametrize("kind", ["own", "ccsds"])
def test_frames_over_tcp_are_messages_however_they_are_cut(kind, cuts):
    ways = [datagram.destination[1] == 50000 for datagram in captured(CAPTURE)]
    frames = [datagram.payload for datagram in captured(CAPTURE)]
    if kind == "own":
        frames, ways = [own(packet) for packet in PACKETS], [packet[:2] == b"\0\0" for packet in PACKETS]
    found, _ = in_streams(list(zip(frames, ways, strict=True)), cuts)
    assert sorted(found) == sorted(frames)


def test_a_mission_names_the_length_of_tm_frames_in_streams(tmp_path):
    down = [space(packet, count) for count, packet in enumerate(PACKETS) if packet[:2] != b"\0\0"]
    frames = [tm(packet, count=count, size=300) for count, packet in enumerate(down)]
    up = [tc(space(packet, up=True)) for packet in PACKETS if packet[:2] == b"\0\0"]
    segments = []
    for stream, ends in ((b"".join(frames), (ROVER, GDS)), (b"".join(up), (GDS, ROVER))):
        segments += segments_of(stream, range(0, 9000, 211), source=ends[0], destination=ends[1])
    write_segments(tmp_path / "x.pcap", segments)
    port = next(port for _, port in (GDS, ROVER) if port in {50000, 50001})
    told = RADIO.replace("50001", str(port)).replace("length: 100", "length: 300, transport: tcp")
    (tmp_path / "radio.yaml").write_text(told)
    with closing(open_file(tmp_path / "x.pcap")) as source:
        report = inspect(source, Settings([tmp_path / "radio.yaml"], structs=(DICTIONARY,)).workbench())
    counted = {item["link"]: item["count"] for item in report.summary()["routes"]}
    assert counted == {"frames": len(frames), "fprime": len(down) + len(up)}
    assert sum(report.entries.values()) == len(list(sent()))


def test_what_keeps_a_connection_alive_is_no_frame():
    frames = [(own(packet), packet[:2] == b"\0\0") for packet in PACKETS]
    found, _ = in_streams(frames, range(7, 3000, 7), KEEP_ALIVE)
    whole = [item for item in found if item.startswith(b"\xde\xad\xbe\xef")]
    assert sorted(whole) == sorted(frame for frame, _ in frames)
    assert {item for item in found if item not in whole} == {KEEP_ALIVE}


RADIO = """
radio:
  ros__parameters:
    frames:
      downlink: {port: 50001, kind: tm, length: 100, link: fprime}
"""


@pytest.mark.long
def test_packets_over_the_borders_of_frames_are_whole_where_a_mission_names_the_frames(call, tmp_path):
    down = [packet for packet in PACKETS if packet[:2] != b"\0\0"]
    spaces = [space(packet, count) for count, packet in enumerate(down)]
    stream = b"".join(spaces)
    starts = np.cumsum([0, *map(len, spaces)])
    frames = []
    for count, at in enumerate(range(0, len(stream), 92)):
        inside = starts[(starts >= at) & (starts < at + 92) & (starts < len(stream))]
        first = int(inside[0]) - at if len(inside) else 0x7FF
        frames.append(tm(stream[at : at + 92], count=count, size=100, first=first))
    assert len({len(frame) for frame in frames[:-1]}) == 1
    ends = ("127.0.0.1", 41000), ("127.0.0.1", 50001)
    items = [Udp(10**18 + index, *ends, one) for index, one in enumerate(frames)]
    path = write(tmp_path / "spanned.pcap", items)
    (tmp_path / "radio.yaml").write_text(RADIO)
    words = ("-c", tmp_path / "radio.yaml", "--structs", DICTIONARY, "--json", "--link", "fprime")
    lines = call("sniff", path, *words).lines()
    found = [item["topic"] for line in lines for item in (line, *line.get("more", []))]
    assert found == [topic for topic, _, _ in sent() if "/commands/" not in topic]
    assert not any(line["findings"] for line in lines)


def test_info_counts_every_entry():
    with closing(open_file(CAPTURE)) as source:
        report = inspect(source, Settings(structs=[DICTIONARY]).workbench(source.info))
    counted = {
        f"/fprime/{row['is']}s/{row['entry'].replace('.', '/')}": row for row in report.summary()["entries"]
    }
    wanted = Counter(topic for topic, _, _ in sent())
    assert {topic: row["count"] for topic, row in counted.items()} == wanted
    assert counted["/fprime/packets/Motion"]["id"] == "0x0001"


def test_a_recording_has_the_topics_and_the_log(call, tmp_path):
    path = tmp_path / "rover.mcap"
    assert call("record", CAPTURE, "--structs", DICTIONARY, "-o", path, "-q").code == 0
    told, values = [], []
    with AnyReader([path]) as reader:
        for connection, _, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            if connection.topic == "/edoras/events":
                told.append((message.level, message.name, message.function, message.msg))
            elif connection.topic.startswith("/fprime/"):
                values.append(connection.topic)
    assert sorted(values) == sorted(topic for topic, _, _ in sent())
    assert told == [
        (20, "Rover.cmdDisp", "OpCodeDispatched", "Opcode 0x1000000 dispatched to port 3"),
        (20, "Rover.cmdDisp", "OpCodeDispatched", "Opcode 0x1000001 dispatched to port 3"),
        (20, "Rover.cmdDisp", "NoOpStringReceived", "Received a NO-OP string=hello"),
        (20, "Rover.drive", "ModeChanged", "Mode is DRIVING at 0.25 m/s, command of {99}"),
        (10, "Rover.drive", "Arrived", "Arrived at {x=1.5, y=-2, heading=0.25}, wheels [0, 0, 0, 0]"),
        (20, "Rover.drive", "ModeChanged", "Mode is LOST at 0.00 m/s, dust \u00e9 of {9223372036854775808}"),
        (40, "Rover.drive", "Stuck", "Stuck"),
    ]
    (line,) = call("sniff", path, "--json", "--where", "Rover.drive.Odometer.value == 13").lines()
    assert [item["message"]["value"] for item in line["more"][:1]] == [13]


FILTERS = {
    "Rover.drive.Pose.value.x > 1": 1,
    "Rover.drive.Odometer.value == 12.75": 1,
    "Rover.drive.Odometer.value == 13": 1,
    "Rover.drive.ModeChanged.mode == LOST": 1,
    "Rover.version.Project.value == 'v1.2-rc1'": 1,
    "arg1 contains 'ell'": 1,
    "route[1].label == ''": 1,
    "topic == '/fprime/channels/Rover/version/Project'": 1,
    "fprime_command.opcode == 0x2000000": 1,
    "fprime_tm.spacecraft_id == 0x44": 6,
    "link == fprime": 10,
    "Rover.drive.Stuck": 1,
}


@pytest.mark.each(3)
@pytest.mark.parametrize("text", FILTERS)
def test_filters_know_the_names_of_the_dictionary(text):
    packets, rows = both_ways(NAMED, *(datagram.payload for datagram in captured(CAPTURE)))
    where = Where(text, NAMED)
    mask = where.mask(rows.batch, rows.columns)
    assert mask.tolist() == where.judge(packets).tolist()
    assert mask.sum() == FILTERS[text]


def test_a_port_that_is_named_for_another_link_is_left_to_it():
    context = Context(Mission(), None, Options(ports=((TO, 50001),)))
    assert [bool(context.ports[FPRIME][port]) for port in (50000, 50001)] == [True, False]
    assert context.ports[TO][50001]
