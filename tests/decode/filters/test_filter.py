"""What filters mean, told by what they let pass of real captures, judged by the packets' own JSON."""

import re
from contextlib import closing
from functools import cache

import numpy as np
import pytest
from effort import every
from msgspec.structs import replace
from places import ROOT

from edoras_tools.decode import ColumnDecoder, Context, Dissector
from edoras_tools.decode.filters.filter import Where
from edoras_tools.decode.filters.names import Names
from edoras_tools.decode.filters.syntax import WhereError
from edoras_tools.io.formats.open import open_file
from edoras_tools.mission import Mission, load, loads
from edoras_tools.ros import TypeStore
from edoras_tools.wire import cfe

TYPES = TypeStore()
ROVER = Context(load([ROOT / "samples/missions/rover_ground.yaml"]), TYPES)
ARM = Context(load([ROOT / "samples/missions/single_arm_ground.yaml"]), TYPES)


def decoded(name, context):
    """Return a capture as one batch, its columns, and its packets."""
    with closing(open_file(ROOT / f"samples/captures/{name}.pcap")) as source:
        batch = next(source.batches())
    batch = batch.take(np.array(every(3, range(len(batch)))))
    dissector = Dissector(context)
    return (
        batch,
        ColumnDecoder(context).decode(batch),
        [dissector.dissect(batch[row]) for row in range(len(batch))],
    )


@cache
def capture_of(name):
    """Return the context of a capture, and what was decoded of it with that."""
    context = {"a_rover": ROVER, "b_arm_single": ARM}[name]
    return context, decoded(name, context)


def layer(packet, name, field):
    found = packet.layer(name)
    return None if found is None else found.values().get(field)


def pose(packet):
    message = packet.message
    if message is None or not message.type.endswith("PoseStamped"):
        return None
    return message.values["pose"]["position"]["x"]


def joints(packet, name="position"):
    message = packet.message
    return message.values[name] if message and message.type.endswith("JointState") else None


def elapsed(packet):
    return packet.datagram.time_ns - capture_of("a_rover")[1][0].time_ns[0]


# What is written, and which packets of the rover's capture must pass.
ON_ROVER = {
    "msg_id == 0x827 and pose.position.x > 1": lambda it: (
        layer(it, "ccsds", "msg_id") == 0x827 and pose(it) is not None and pose(it) > 1
    ),
    "ros.pose.position.x > 1": lambda it: pose(it) is not None and pose(it) > 1,
    "pose.position.x": lambda it: pose(it) is not None,
    "not pose.position.x > 1": lambda it: pose(it) is None or pose(it) <= 1,
    "pose.position.x != 0.1": lambda it: pose(it) is not None and pose(it) != 0.1,
    "not pose.position.x == 0.1": lambda it: pose(it) != 0.1,
    "pose.position.x in 0.1..0.35": lambda it: pose(it) is not None and 0.1 <= pose(it) <= 0.35,
    "link == ci": lambda it: it.link.label == "ci",
    "link == CI || link == TO": lambda it: it.link.label in {"ci", "to"},
    "link in {ci, sbn}": lambda it: it.link.label in {"ci", "sbn"},
    "link not in {ci, sbn}": lambda it: it.link.label not in {"ci", "sbn"},
    "sbn.msg_type == SUB": lambda it: layer(it, "sbn", "msg_type") == 1,
    "msg_type == 0xa0": lambda it: layer(it, "sbn", "msg_type") == 0xA0,
    "sbn && !ccsds": lambda it: it.layer("sbn") is not None and it.layer("ccsds") is None,
    "sbn.processor_id != 2": lambda it: layer(it, "sbn", "processor_id") not in {None, 2},
    "processor_id == 2": lambda it: layer(it, "sbn", "processor_id") == 2,
    "sbn_sub.msg_ids contains 0x1880": lambda it: 0x1880 in (layer(it, "sbn_sub", "msg_ids") or ()),
    "sbn_sub.msg_ids in 0x1880..0x18ff": lambda it: any(
        0x1880 <= item <= 0x18FF for item in layer(it, "sbn_sub", "msg_ids") or ()
    ),
    "len(sbn_sub.msg_ids) > 3": lambda it: len(layer(it, "sbn_sub", "msg_ids") or ()) > 3,
    "msg_id in 0x1800..0x18ff": lambda it: 0x1800 <= (layer(it, "ccsds", "msg_id") or 0) <= 0x18FF,
    "msg_id in {TO_CMD, 0x800..0x805}": lambda it: (
        layer(it, "ccsds", "msg_id") in {0x1880, *range(0x800, 0x806)}
    ),
    "ccsds.apid == 0x27": lambda it: layer(it, "ccsds", "apid") == 0x27,
    "ccsds.packet_type == telecommand": lambda it: layer(it, "ccsds", "packet_type") == 1,
    "ccsds.packet_sequence_count < 3": lambda it: (
        (layer(it, "ccsds", "packet_sequence_count") or 0) < 3 and it.layer("ccsds") is not None
    ),
    "cfe_command.function_code == 6": lambda it: layer(it, "cfe_command", "function_code") == 6,
    "edoras.buffer_length == 84": lambda it: layer(it, "edoras", "buffer_length") == 84,
    "cfe_event.message contains 'Msg Limit'": lambda it: (
        "Msg Limit" in (layer(it, "cfe_event", "message") or "")
    ),
    r'cfe_event.message matches "MsgId 0x\d+"': lambda it: bool(
        re.search(r"MsgId 0x\d+", layer(it, "cfe_event", "message") or "")
    ),
    'app_name == "CFE_SB"': lambda it: layer(it, "cfe_event", "app_name") == "CFE_SB",
    "event_type == error": lambda it: layer(it, "cfe_event", "event_type") == 3,
    "topic == /cmd_vel": lambda it: layer(it, "ccsds", "msg_id") == 0x1827,
    "topic == cmd_vel": lambda it: layer(it, "ccsds", "msg_id") == 0x1827,
    "type == Twist": lambda it: layer(it, "ccsds", "msg_id") == 0x1827,
    "type == geometry_msgs/Twist": lambda it: layer(it, "ccsds", "msg_id") == 0x1827,
    "findings": lambda it: bool(it.findings),
    "findings contains checksum_absent": lambda it: "checksum_absent" in it.findings.labels,
    "findings in {checksum_absent, sequence_unset} and link == ci": lambda it: (
        bool({"checksum_absent", "sequence_unset"} & {*it.findings.labels}) and it.link.label == "ci"
    ),
    "length > 100": lambda it: len(it.datagram.payload) > 100,
    "length > 99.5": lambda it: len(it.datagram.payload) > 99.5,
    "length >= -1e300 and length < inf": lambda it: True,
    "length == 67.5": lambda it: False,
    "number in 10..20": lambda it: 10 <= it.datagram.number <= 20,
    "time < 2.5": lambda it: elapsed(it) < 2_500_000_000,
    "time in 500ms..0.05m": lambda it: 500_000_000 <= elapsed(it) <= 3_000_000_000,
    "mission_time > 1000010s": lambda it: (layer(it, "cfe_telemetry", "seconds") or 0) >= 1_000_010,
    "utc >= 2026-11-21T06:14:10.5": lambda it: it.datagram.time_ns >= 1_795_241_650_500_000_000,
    'utc < "2026-11-21 06:14:10"': lambda it: it.datagram.time_ns < 1_795_241_650_000_000_000,
    "source == 127.0.0.1:2234": lambda it: str(it.datagram.source) == "127.0.0.1:2234",
    "source == 127.0.0.1": lambda it: True,
    "destination.port == 1235": lambda it: it.datagram.destination.port == 1235,
    "port == 1235": lambda it: 1235 in {it.datagram.source.port, it.datagram.destination.port},
    "port != 1235": lambda it: 1235 not in {it.datagram.source.port, it.datagram.destination.port},
    "all(port) in 2234..2236": lambda it: (
        {it.datagram.source.port, it.datagram.destination.port} <= {2234, 2235, 2236}
    ),
    "header.frame_id == world": lambda it: (
        pose(it) is not None and it.message.values["header"]["frame_id"] == "world"
    ),
    "len(header.frame_id) == 5": lambda it: pose(it) is not None,
    "message": lambda it: it.message is not None,
    "padding.stale == false": lambda it: layer(it, "padding", "stale") is False,
    "payload contains 00:01:00:00": lambda it: bytes([0, 1, 0, 0]) in it.datagram.payload,
    "len(payload) > 200": lambda it: len(it.datagram.payload) > 200,
    'summary contains "x=" and link == ci': lambda it: "x=" in it.summary and it.link.label == "ci",
    "stop": lambda it: it.stop is not None,
}
ON_ARM = {
    "position > 1": lambda it: any(item > 1 for item in joints(it) or ()),
    "any(position) > 1": lambda it: any(item > 1 for item in joints(it) or ()),
    "all(position) > -1": lambda it: bool(joints(it)) and all(item > -1 for item in joints(it)),
    "position != 0": lambda it: bool(joints(it)) and all(item != 0 for item in joints(it)),
    "any(position) != 0": lambda it: any(item != 0 for item in joints(it) or ()),
    "position[0] < 0": lambda it: bool(joints(it)) and joints(it)[0] < 0,
    "position[-1] < 0": lambda it: bool(joints(it)) and joints(it)[-1] < 0,
    "position[99] < 0": lambda it: False,
    "len(position) == 7": lambda it: joints(it) is not None and len(joints(it)) == 7,
    "len(effort) == 0": lambda it: joints(it, "effort") == [],
    "effort": lambda it: bool(joints(it, "effort")),
    "name contains joint": lambda it: any("joint" in item for item in joints(it, "name") or ()),
    "name[1] matches 2$": lambda it: (
        len(joints(it, "name") or ()) > 1 and joints(it, "name")[1].endswith("2")
    ),
}
CASES = [("a_rover", *case) for case in ON_ROVER.items()]
CASES += [("b_arm_single", *case) for case in ON_ARM.items()]


@pytest.mark.each(4)
@pytest.mark.parametrize(("capture", "text", "wanted"), CASES, ids=[case[1] for case in CASES])
def test_what_passes(capture, text, wanted):
    context, (batch, columns, packets) = capture_of(capture)
    expected = [bool(wanted(packet)) for packet in packets]
    assert Where(text, context).mask(batch, columns).tolist() == expected
    assert Where(text, context).judge(packets).tolist() == expected


@pytest.mark.long
def test_that_the_cases_tell_packets_apart():
    told = 0
    for capture, text, _ in CASES:
        context, (batch, columns, _) = capture_of(capture)
        told += 0 < np.count_nonzero(Where(text, context).mask(batch, columns)) < len(batch)
    assert told > 0.8 * len(CASES)


def test_time_counts_from_the_first_datagram_of_the_first_batch():
    context, (batch, columns, _) = capture_of("a_rover")
    where = Where("time < 10s", context)
    parts = [slice(0, 100), slice(100, None)]
    masks = [where.mask(batch.take(part), columns.take(part)) for part in parts]
    assert np.concatenate(masks).tolist() == Where("time < 10s", context).mask(batch, columns).tolist()


def test_what_is_cheap_is_asked_first(monkeypatch):
    """Only what the columns let through is dissected."""
    context, (batch, columns, _) = capture_of("a_rover")
    asked = []
    monkeypatch.setattr(
        "edoras_tools.decode.stack.Dissector.dissect",
        lambda self, datagram, real=Dissector.dissect: asked.append(datagram.number) or real(self, datagram),
    )
    mask = Where("summary contains 'x=' and pose.position.x > 6 and number < 1800", context).mask(
        batch, columns
    )
    assert 0 < mask.sum() == len(asked) < 20
    asked.clear()
    Where("number > 5 or summary contains 'x='", context).mask(batch, columns)
    assert asked == batch.number[batch.number <= 5].tolist() != []


# What is written, the characters that are marked, and what is said.
MISTAKES = [
    ("pose.postion.x > 1", "pose.postion.x", "not a field; did you mean pose.position.x"),
    ("link == ci and pose.postion.x > 1", "pose.postion.x", "did you mean pose.position.x"),
    ("sbn.mgs_type == 1", "sbn.mgs_type", "did you mean sbn.msg_type"),
    ("ros.linear.z2 == 1", "ros.linear.z2", "did you mean ros.linear.z"),
    ("zzzz", "zzzz", "there are number, "),
    (
        "spare == 00",
        "spare",
        "more than one field; write cfe_command.spare, cfe_telemetry.spare, cfe_event.spare or",
    ),
    ("header.frame_id < 3", "<", "header.frame_id is text, and 3 is a number; < compares numbers"),
    ("header.frame_id >= world", ">=", "text takes ==, !=, in, contains and matches"),
    ('length > "3"', '"3"', 'length is a number, and "3" is text'),
    ("length > many", "many", "'many' is none"),
    ("link == cu", "cu", "link has no 'cu'; there are ci"),
    ("sbn.msg_type == SUBS", "SUBS", "there are NO_MSG, SUB, UNSUB"),
    ("msg_id == TO_CDM", "TO_CDM", "there are TO_CMD"),
    ("msg_id == 0x18277", "0x18277", "never 0x18277: it holds 0x0 to 0xffff"),
    ("msg_id in {0x827, 0x18277}", "0x18277", "never 0x18277"),
    ("msg_id in 9..3", "9", "ends before it begins"),
    ("findings contains checksum", "checksum", "findings has no 'checksum'; there are checksum_bad"),
    ("topic == /cmd_vle", "/cmd_vle", "topic is never '/cmd_vle'; there are /cmd_vel"),
    ("msg_id contains 3", "contains", "contains looks into text, bytes and lists; msg_id is a number"),
    ("msg_id matches 3", "matches", "matches looks into text; msg_id is a number"),
    ("summary matches 'a('", "'a('", "is not a regular expression"),
    ("padding.stale > false", ">", "compare it with == or !="),
    ("padding.stale == maybe", "maybe", "true or false, not maybe"),
    ("payload == hello", "hello", "write them in hex"),
    ("time > soon", "soon", "as 1.5s, 250ms or 10m"),
    ("utc > yesterday", "yesterday", "as 2026-11-21T06:14:00.5"),
    ("utc > 2026-13-21", "2026-13-21", "is not a time"),
    ("pose == 1", "pose", "pose is a group of fields, not a value; name one of its fields: pose."),
    ("sbn > 1", "sbn", "name one of its fields: sbn.msg_size"),
    ("len(link) > 1", "link", "len counts what is in a list or a text"),
    ("number[1] == 2", "number[1]", "takes no index"),
    ("pose.position.x[0] > 1", "pose.position.x[0]", "not a list of a message"),
    ("link = ci", "=", "equality is written =="),
    ("link == ci an length > 3", "a", "expected and, or, or the end"),
    ("(link == ci", "(", "is not closed"),
    ("(link == ci length", "(", "to close this"),
    ("link == ci)", ")", "expected and, or, or the end"),
    ("link in ci", "ci", "in wants a range or a set"),
    ("link in {ci to}", "t", "expected , or } in the set"),
    ("summary == 'x", "'", "this quote is not closed"),
    ("any(position)", None, "any(...) is to be compared"),
    ("len(position > 1", ">", "expected ) after the name"),
    ("0x827 == msg_id", "0", "a field's name belongs here"),
    ("msg_id ==", None, "ends where a value belongs"),
    ("msg_id == )", ")", "a value belongs here"),
    ("link == ci and", None, "a field's name belongs here"),
    ("   ", None, "the filter is empty"),
    ("position[x] == 1", "[", "an index is a whole number"),
    ("length == " + "9" * 500, "9" * 500, "beyond every field"),
]


@pytest.mark.parametrize(("text", "marked", "said"), MISTAKES, ids=[case[0][:40] for case in MISTAKES])
def test_mistakes_are_marked(text, marked, said):
    context = ARM if "position" in text and "pose" not in text else ROVER
    with pytest.raises(WhereError) as caught:
        Where(text, context)
    error = caught.value
    assert said in error.why
    assert "\n" not in error.why
    at = len(text) if marked is None else text.rindex(marked)
    assert error.at == at
    if marked is not None:
        assert text[error.at : error.end] == marked
    assert error.exit_code == 2


def test_the_mark_stands_under_the_place():
    with pytest.raises(WhereError) as caught:
        Where("link == ci and pose.postion.x > 1", ROVER)
    _, shown, mark = str(caught.value).splitlines()
    assert shown == "  link == ci and pose.postion.x > 1"
    assert mark == "                 ^^^^^^^^^^^^^^"


def test_of_a_long_filter_only_the_place_is_shown():
    text = " or ".join(["number == 1"] * 100) + " or numbre == 2 or " + " or ".join(["number == 1"] * 100)
    with pytest.raises(WhereError) as caught:
        Where(text, ROVER)
    _, shown, mark = str(caught.value).splitlines()
    assert len(shown) <= 102
    assert shown[mark.index("^") : mark.rindex("^") + 1] == "numbre"


def test_control_characters_do_not_reach_the_terminal():
    with pytest.raises(WhereError) as caught:
        Where("summary == '\x1b[31m' nonsense", ROVER)
    assert "\x1b" not in str(caught.value)


def test_without_a_mission_message_fields_ask_for_one():
    with pytest.raises(WhereError, match="once a mission is named with -c"):
        Where("pose.position.x > 1", Context(Mission(), TYPES))


def test_addresses_of_version_6():
    _, (batch, _, _) = capture_of("a_rover")
    two = replace(
        batch.take(slice(0, 2)),
        ip_version=np.array([6, 4], np.uint8),
        source_address=np.array([1, 0x0A000002], np.uint32),
        destination_address=np.array([0, 0x0A000003], np.uint32),
        ipv6=(bytes(16), bytes(15) + b"\1"),
    )
    columns = ColumnDecoder(ROVER).decode(two)
    for told, expected in {
        "source == ::1": [True, False],
        'source == "[::1]:2234"': [True, False],
        "source.address in {::1, 10.0.0.2}": [True, True],
        "address == 10.0.0.2": [False, True],
        "source matches '^10[.]'": [False, True],
    }.items():
        where = Where(told, ROVER)
        assert where.mask(two, columns).tolist() == expected, told
        assert where.judge([Dissector(ROVER).dissect(two[row]) for row in range(2)]).tolist() == expected, (
            told
        )


@pytest.mark.long
def test_names_that_two_types_share_mean_both():
    text = (ROOT / "samples/missions/rover_ground.yaml").read_text()
    more = "\n    tlm_arm: {type: sensor_msgs/msg/JointState, topic: arm, mid: 0x829}\n"
    both = Context(
        loads({"both.yaml": (text.replace("['tlm_pose']", "['tlm_pose', 'tlm_arm']") + more).encode()}), TYPES
    )
    batch, _, packets = decoded("a_rover", both)
    cdr = TYPES.encode("sensor_msgs/msg/JointState", {"header": {"frame_id": "arm"}})
    body = len(cdr).to_bytes(8, "little") * 2 + cdr
    row = next(index for index, it in enumerate(packets) if pose(it) is not None)
    poses = batch.take(np.array([row, row]))
    data = np.concatenate([batch.data, np.frombuffer(cfe.emit_telemetry(0x829, body), np.uint8)])
    mixed = replace(
        poses,
        data=data,
        offset=np.array([poses.offset[0], len(batch.data)]),
        length=np.array([poses.length[0], len(data) - len(batch.data)], np.int32),
    )
    columns = ColumnDecoder(both).decode(mixed)
    for told, expected in {
        "header.frame_id != nowhere": [True, True],
        "header.frame_id == arm": [False, True],
        "header.frame_id in {world}": [True, False],
        "pose or header.stamp": [True, True],
        "name": [False, False],
        "len(name) == 0": [False, True],
    }.items():
        assert Where(told, both).mask(mixed, columns).tolist() == expected, told


def test_names_of_some_types_are_theirs_and_where_none_has_one_those_of_all():
    stamped = ROVER.mission.routes[0]
    joints = replace(stamped, type="sensor_msgs/msg/JointState", topic="/joints", msg_id=0x829)
    names = Names(Context(replace(ROVER.mission, routes=(*ROVER.mission.routes, joints)), TYPES))
    own = names.of_types({"sensor_msgs/msg/JointState", "no/msg/Type"})
    assert [field.doc for field in own.find("header.frame_id")] == ["of sensor_msgs/msg/JointState"]
    assert len(names.find("header.frame_id")) == 2
    for name in ("linear.x", "msg_id"):
        assert [field.doc for field in own.find(name)] == [field.doc for field in names.find(name)]
