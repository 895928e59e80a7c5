"""Structs in packets: found by MsgId and function code, read one by one and all at once, never by force."""

import json
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.decode import ColumnDecoder, Context, Dissector
from edoras_tools.decode.filters.filter import Where, fields
from edoras_tools.decode.filters.rows import ColumnRows
from edoras_tools.errors import ConfigError
from edoras_tools.mission import loads as load_mission
from edoras_tools.model import Finding, PacketBatch
from edoras_tools.ros import TypeStore
from edoras_tools.structs import Structs, files, shipped_structs
from edoras_tools.structs.bindings import payloads
from edoras_tools.structs.files import parse_layout
from edoras_tools.wire import cfe as wire
from edoras_tools.wire.ccsds import VERSION_1

LAYOUT = """
package: rover_msgs
bind: {0x0890: Hk_t, 0x1890/2: Drive, 0x1890: Other, 0x0891: Log, 0x0892: Twice, 0x0893: Twice, 0x0894: Names}
enums: {Mode: {type: int8, values: {IDLE: 0, DRIVE: 1, LOST: -1}}}
structs:
  Point: {members: {X: uint8, Y: float32}}
  Hk_Payload:
    members:
      CommandCounter: uint16
      Mode: Mode
      Ok: bool
      Flags: 'uint8:3'
      Level: 'int8:5'
      Name: 'char[6]'
      Way: 'Point[2]'
      Grid: 'uint16[2][2]'
      Handle: 'uint32 hex'
  Hk_t: {header: 16, members: {TelemetryHeader: 'byte[16]', Payload: Hk_Payload}}
  Drive: {header: 8, members: {CommandHeader: 'byte[8]', Speed: float32}}
  Other: {members: {Raw: 'uint8[]'}}
  Log: {members: {Level: uint8, Text: 'char[]'}}
  Twice: {members: {A: uint8}}
  Names: {members: {Count: uint8, Names: 'char[][4]'}}
"""
PAYLOAD = bytes.fromhex(
    "0500 ff 02 8d 726f76657200 00 01000000 0000803f 02000000 000080bf 0100 0200 0300 0400 efbeadde"
)
"""Made by hand: level -15 and flags 5 share a byte, 3 bytes fill up before the points."""


def context(order="little", mission=None):
    layout = parse_layout(LAYOUT.encode() + f"byte_order: {order}\n".encode(), "rover.yaml")
    return Context(mission, TypeStore(), structs=Structs([layout, *shipped_structs().layouts]))


def batch_of(*packets, port=1235):
    lengths = np.array([len(packet) for packet in packets], np.int32)
    count, offsets = len(packets), np.cumsum([0, *lengths])[: len(packets)]
    same = {name: np.full(count, value, dtype) for name, value, dtype in SAME}
    return PacketBatch(
        data=np.frombuffer(b"".join(packets) or b"\0", np.uint8),
        number=np.arange(1, count + 1),
        time_ns=np.arange(count) * 1000,
        frame_offset=offsets.astype(np.int64),
        frame_length=lengths,
        original_length=lengths,
        offset=offsets.astype(np.int64),
        length=lengths,
        destination_port=np.full(count, port, np.uint16),
        **same,
    )


SAME = (
    ("link_type", 101, np.uint16),
    ("source_address", 0x7F000001, np.uint32),
    ("source_port", 40000, np.uint16),
    ("destination_address", 0x7F000001, np.uint32),
    ("ip_version", 4, np.uint8),
    ("capture_findings", 0, np.uint32),
)


def dissect(packet, where=None, port=1235):
    return Dissector(where or context()).dissect(batch_of(packet, port=port)[0])


def test_a_struct_is_a_message():
    decoded = dissect(wire.emit_telemetry(0x0890, PAYLOAD, sequence_count=7))
    assert not decoded.findings
    assert (decoded.message.topic, decoded.message.type) == ("/cfs/Hk", "rover_msgs/msg/Hk")
    assert decoded.message.values == {
        "header": {"processor_id": 0, "msg_id": 0x890, "sequence_count": 7, "function_code": 0, "link": 2},
        "command_counter": 5,
        "mode": -1,
        "ok": True,
        "flags": 5,
        "level": -15,
        "name": "rover",
        "way": [{"x": 1, "y": 1.0}, {"x": 2, "y": -1.0}],
        "grid": [1, 2, 3, 4],
        "handle": 0xDEADBEEF,
    }
    told = {item.name: (item.text, item.start, item.end) for item in decoded.layer("cfs").fields}
    assert told["mode"] == ("LOST (-1)", 18, 19)
    assert told["handle"] == ("0xdeadbeef", 52, 56)
    assert told["way[1].y"] == ("-1", 40, 44)
    assert decoded.summary.startswith("command_counter=5 mode=-1 ok=True")


def test_big_endian():
    turned = bytes.fromhex(
        "0005 ff 02 b1 726f76657200 00 01000000 3f800000 02000000 bf800000 0001 0002 0003 0004 deadbeef"
    )
    little = dissect(wire.emit_telemetry(0x0890, PAYLOAD)).message.values
    assert dissect(wire.emit_telemetry(0x0890, turned), context("big")).message.values == little


def test_function_codes_and_what_has_none():
    drive = dissect(wire.emit_command(0x1890, 2, b"\0\0\xc0\x3f"), port=1234)
    assert (drive.message.topic, drive.message.values["speed"]) == ("/cfs/Drive", 1.5)
    assert drive.message.values["header"]["function_code"] == 2
    other = dissect(wire.emit_command(0x1890, 3, b"abc"), port=1234)
    assert (other.message.topic, other.message.values["raw"]) == ("/cfs/Other", [97, 98, 99])
    assert dissect(wire.emit_command(0x1890, 3), port=1234).message is None
    short = dissect(wire.emit_command(0x1890, 2, b"ab"), port=1234)
    assert (short.message, short.findings) == (None, Finding.STRUCT_LENGTH)


@pytest.mark.parametrize(
    ("payload", "fits"),
    [(PAYLOAD, True), (PAYLOAD[:-1], False), (PAYLOAD + b"\0", False), (b"", None), (b"\0", False)],
)
def test_another_length_is_said_and_left_alone(payload, fits):
    decoded = dissect(wire.emit_telemetry(0x0890, payload))
    assert (Finding.STRUCT_LENGTH in decoded.findings) == (fits is False)
    assert (decoded.message is not None) == (fits is True)


def test_what_is_open_goes_on_to_the_end():
    assert dissect(wire.emit_telemetry(0x0891, b"\x02now\0x")).message.values["text"] == "now"
    assert dissect(wire.emit_telemetry(0x0891, b"\x02")).message.values["text"] == ""
    names = dissect(wire.emit_telemetry(0x0894, b"\x02ab\0\0cdef")).message.values["names"]
    assert names == ["ab", "cdef"]
    assert Finding.STRUCT_LENGTH in dissect(wire.emit_telemetry(0x0894, b"\x02ab")).findings


def structs_of(text):
    return Context(structs=Structs([parse_layout(text.encode(), "f")]))


def test_what_lies_between_values_stays_out_and_truth_is_one():
    # Filled up where Half stands; nothing between Ok and Next, so those are one copy.
    members = "{A: uint16, B: uint32, C: uint8, Ok: bool, Next: uint16, D: uint8, Half: bool, E: uint32}"
    text = f"package: p\nbind: {{0x0890: Gap}}\nstructs: {{Gap: {{members: {members}}}}}\n"
    bound = structs_of(text).structs.bound_to(0x0890)[0]
    encoded = bound.encode_one(b"\xff" * bound.size, (0, 0, 0, 0, 0))
    assert encoded.hex(" ", 1) == " ".join(
        ["00 01 00 00", *["00"] * 10, "ff ff", "ff ff ff ff", "ff 01 ff ff", "ff 01 00 00", "ff ff ff ff"]
    )


def test_of_empty_structs_there_is_no_end():
    where = structs_of("bind: {0x890: A}\nstructs: {E: {members: {}}, A: {members: {n: uint8, e: 'E[]'}}}")
    assert dissect(wire.emit_telemetry(0x0890, b"\5"), where).message.values["n"] == 5
    assert Finding.STRUCT_LENGTH in dissect(wire.emit_telemetry(0x0890, b"\5\0"), where).findings


BITS = ", ".join(f"f{bit}: 'uint8:1'" for bit in range(8))
FLAGS = f"Flags: {{members: {{{BITS}}}}}"


def test_more_values_than_a_message_takes_are_refused_at_the_start():
    with pytest.raises(ConfigError, match="f: A holds more than 65536 values; bind a smaller one"):
        structs_of(f"bind: {{0x890: A}}\nstructs: {{{FLAGS}, A: {{members: {{f: 'Flags[9000]'}}}}}}")
    doubled = ", ".join(f"S{level + 1}: {{members: {{a: S{level}, b: S{level}}}}}" for level in range(60))
    with pytest.raises(ConfigError, match="f: S60 holds more than"):
        structs_of(f"bind: {{0x890: S60}}\nstructs: {{S0: {{members: {{}}}}, {doubled}}}")


@pytest.mark.long
def test_a_packet_of_more_values_than_a_message_takes_is_left_alone():
    where = structs_of(f"bind: {{0x890: A}}\nstructs: {{{FLAGS}, A: {{members: {{f: 'Flags[]'}}}}}}")
    packets = [wire.emit_telemetry(0x0890, bytes([255]) * size) for size in (8000, 9000)]
    assert len(dissect(packets[0], where).message.values["f"]) == 8000
    assert Finding.STRUCT_LENGTH in dissect(packets[1], where).findings
    found = ColumnDecoder(where).decode(batch_of(*packets)).findings & Finding.STRUCT_LENGTH
    assert (found != 0).tolist() == [False, True]


def test_names_with_and_without_t_have_topics_of_their_own():
    where = structs_of(
        "bind: {0x890: A, 0x891: A_t}\nstructs: {A: {members: {x: uint8}}, A_t: {members: {y: uint16}}}"
    )
    found = [(item.topic, item.type) for item in where.structs.all]
    assert found == [("/cfs/A/0x0890", "cfs_msgs/msg/A"), ("/cfs/A/0x0891", "cfs_msgs/msg/A2")]


def test_a_struct_of_several_packets_has_a_topic_for_each():
    topics = [dissect(wire.emit_telemetry(msg_id, b"\1")).message.topic for msg_id in (0x892, 0x893)]
    assert topics == ["/cfs/Twice/0x0892", "/cfs/Twice/0x0893"]


def test_bytes_that_are_no_text_are_shown_as_such():
    for raw, text in ((b"\xff\xfeab\0", "??ab"), ("Größe".encode(), "Größe"[:5])):
        packet = wire.emit_telemetry(0x0891, b"\0" + raw)
        assert dissect(packet).message.values["text"] == text


def test_a_mission_goes_before_a_struct():
    text = """
    bridge:
      ros__parameters:
        communication: {bridge_port: 1235, fsw_port: 1234, fsw_ip: 127.0.0.1, telemetry_ip: 127.0.0.1}
        command: []
        telemetry: [pose]
        pose: {type: geometry_msgs/msg/Pose, topic: /pose, mid: 0x0890}
    """
    mission = load_mission({"a.yaml": text.encode()})
    where = context(mission=mission)
    assert not where.structs.has[0x890]
    assert where.structs.has[0x891]
    assert dissect(wire.emit_telemetry(0x0890, PAYLOAD), where).message is None


def test_ones_own_go_before_those_that_are_shipped():
    layout = parse_layout(b"bind: {0x0800: Mine}\nstructs: {Mine: {members: {a: uint16}}}", "mine.yaml")
    where = Context(structs=Structs([layout, files.shipped_layout()]))
    assert dissect(wire.emit_telemetry(0x0800, b"\1\2"), where).message.values["a"] == 0x0201
    assert Finding.STRUCT_LENGTH in dissect(wire.emit_telemetry(0x0800, bytes(148)), where).findings


PACKETS = [
    wire.emit_telemetry(0x0890, PAYLOAD),
    wire.emit_telemetry(0x0890, PAYLOAD.replace(b"rover", b"r\0\0\0\0")),
    wire.emit_telemetry(0x0890, PAYLOAD[:-1]),
    wire.emit_telemetry(0x0891, b"\x01abc"),
    wire.emit_telemetry(0x0894, b"\x01abcd"),
    wire.emit_telemetry(0x0894, b"\x02abcdef\0\0"),
]


@pytest.mark.each(3)
@pytest.mark.parametrize(
    ("text", "rows"),
    [
        ("Hk", [0, 1]),
        ("Hk.name == rover", [0]),
        ("mode == LOST", [0, 1]),
        ("handle == 0xdeadbeef and name == 'r'", [1]),
        ("way[1].y < 0 and any(grid) == 4", [0, 1]),
        ("topic == /cfs/Hk", [0, 1]),
        ("type == Hk or type == Log", [0, 1, 3]),
        ("findings == struct_length", [2]),
        ("len(names) == 2", [5]),
        ("names[-1] == 'ef'", [5]),
        ("message", [0, 1, 3, 4, 5]),
        ("header.msg_id == 0x891", [3]),
    ],
)
def test_filters(text, rows):
    where, batch = context(), batch_of(*PACKETS)
    columns = ColumnDecoder(where).decode(batch)
    assert np.flatnonzero(Where(text, where).mask(batch, columns)).tolist() == rows


def test_columns_of_fields():
    where, batch = context(), batch_of(*PACKETS)
    rows = ColumnRows(where, 0, batch, ColumnDecoder(where).decode(batch))
    [(_, [field])] = fields("Hk.way[0].x", where)
    series = field.series(rows)
    assert (series.values.tolist(), series.owner.tolist()) == ([1, 1], [0, 1])


def test_a_name_that_is_close_is_offered():
    with pytest.raises(ConfigError, match=r"did you mean Hk.command_counter"):
        Where("Hk.command_countr > 1", context())


def test_it_is_plain_json():
    from edoras_tools.pipelines.capture.packet_json import as_json

    packet = as_json(dissect(PACKETS[0]))
    assert json.loads(json.dumps(packet))["message"]["way"][1] == {"x": 2, "y": -1.0}
    assert "cfs" not in packet["layers"]


@given(
    st.lists(
        st.tuples(
            st.sampled_from([0x890, 0x891, 0x892, 0x894, 0x1890, 0x800, 0x801, 0x808]),
            st.integers(0, 3),
            st.binary(max_size=60) | st.binary(min_size=148, max_size=148) | st.just(PAYLOAD),
        ),
        max_size=8,
    ),
    st.sampled_from(["little", "big"]),
)
def test_one_by_one_and_all_at_once_agree(items, order):
    where = context(order)
    packets = [
        wire.emit_command(msg_id, code, data)
        if VERSION_1.is_command(msg_id)
        else wire.emit_telemetry(msg_id, data)
        for msg_id, code, data in items
    ]
    batch = batch_of(*packets)
    columns = ColumnDecoder(where).decode(batch)
    found = {}
    column = partial(getattr, columns)
    for held in where.structs.payloads_of(
        payloads(where.structs, column, partial(getattr, batch), batch.data), column, batch.data
    ):
        encoded = held.encode()
        assert held.size in {0, encoded.width}
        for row, start, size in zip(held.rows.tolist(), encoded.start, encoded.size, strict=True):
            found[row] = held.bound.topic, encoded.data[start : start + size].tobytes()
    for row in range(len(batch)):
        decoded = Dissector(where).dissect(batch[row])
        message = decoded.message
        assert (message and (message.topic, message.cdr)) == found.get(row)
        assert int(columns.findings[row]) == decoded.findings
        if message:
            assert where.structs.types.valid(
                message.type,
                np.frombuffer(message.cdr, np.uint8),
                np.zeros(1, np.int64),
                np.array([len(message.cdr)]),
            ).all()
