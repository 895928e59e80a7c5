"""Everything that can be wrong with a mission file, each by its one line, and all of them at once."""

# ruff: noqa: E501  one case a line, the message whole

from __future__ import annotations

import re

import pytest
from effort import examples
from hypothesis import example, given, settings
from hypothesis import strategies as st
from places import MISSIONS

from edoras_tools.errors import ConfigError
from edoras_tools.mission import load, loads

SAMPLES = MISSIONS
GROUND = """\
bridge:
  ros__parameters:
    communication:
      bridge_port: 1235
      fsw_port: 1234
      fsw_ip: "127.0.0.1"
      telemetry_ip: "0.0.0.0"
    command: ['drive']
    telemetry: ['pose']
    drive:
      type: "geometry_msgs/msg/Twist"
      topic: "cmd_vel"
      mid: 0x1827
    pose:
      type: "geometry_msgs/msg/Pose"
      topic: "pose"
      mid: 0x827
"""
FLIGHT = (SAMPLES / "two_rovers_flight.yaml").read_text()
FORM = re.compile(r"m\.yaml:\d+: ([^:]+: )?[^;]+; .+")


def mistakes(text: str | bytes, **options) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        loads({"m.yaml": text if isinstance(text, bytes) else text.encode()}, **options)
    assert caught.value.exit_code == 2
    assert str(caught.value).splitlines() == list(caught.value.mistakes)
    return list(caught.value.mistakes)


CHANGES = [
    # communication
    ("bridge_port: 1235", "bridge_port: 0", "4: communication.bridge_port: 0 is out of range; an integer from 1 to 65535 is needed"),
    ("fsw_port: 1234", "fsw_port: 65536", "5: communication.fsw_port: 65536 is out of range; an integer from 1 to 65535 is needed"),
    ("fsw_port: 1234", "fsw_port: 1e3", "5: communication.fsw_port: 1e3 is the float 1000.0; an integer from 1 to 65535 is needed"),
    ("fsw_port: 1234", "fsw_port: 0899", "5: communication.fsw_port: 0899 is the float 899.0; an integer from 1 to 65535 is needed"),
    ("fsw_port: 1234", "fsw_port: yes", "5: communication.fsw_port: yes is the boolean true; an integer from 1 to 65535 is needed"),
    ("fsw_port: 1234", "fsw_port: '1234'", '5: communication.fsw_port: "1234" is a string; write 1234 without quotes'),
    ("fsw_port: 1234", "fsw_port: !!str 1234", '5: communication.fsw_port: "1234" is a string; write 1234 without quotes'),
    ("fsw_port: 1234", "fsw_port: ci", '5: communication.fsw_port: "ci" is a string; an integer from 1 to 65535 is needed'),
    ("fsw_port: 1234", "fsw_port: [1234]", "5: communication.fsw_port: a list; an integer from 1 to 65535 is needed"),
    ("fsw_port: 1234", "fsw_port: {a: 1}", "5: communication.fsw_port: a mapping; an integer from 1 to 65535 is needed"),
    ("fsw_port: 1234", "fsw_port:", "5: communication.fsw_port: no value; write one, or '' for an empty string"),
    ("      fsw_port: 1234\n", "", "3: communication.fsw_port: missing; an integer from 1 to 65535 is needed"),
    ('fsw_ip: "127.0.0.1"', "fsw_ip: cfs", '6: communication.fsw_ip: "cfs" is not an IPv4 address; the bridges resolve no host names: write it as 127.0.0.1'),
    ('fsw_ip: "127.0.0.1"', "fsw_ip: ::1", '6: communication.fsw_ip: "::1" is not an IPv4 address; the bridges resolve no host names: write it as 127.0.0.1'),
    ('fsw_ip: "127.0.0.1"', "fsw_ip: 127.1", '6: communication.fsw_ip: 127.1 is the float 127.1; a string is needed: write "127.1" in quotes'),
    ('fsw_ip: "127.0.0.1"', "fsw_ip: 10.0.0.256", '6: communication.fsw_ip: "10.0.0.256" is not an IPv4 address; the bridges resolve no host names: write it as 127.0.0.1'),
    ('bridge_port: 1235\n      fsw_port: 1234\n      fsw_ip: "127.0.0.1"\n      telemetry_ip: "0.0.0.0"', "port: 1",
     "3: communication: neither a ground nor a flight bridge's; a ground bridge needs bridge_port, fsw_port, fsw_ip, telemetry_ip, bridge_ip (optional); a flight bridge peer_ip, peer_port, peer_processor_id, peer_spacecraft_id, udp_receive_port, udp_receive_ip, processor_id, spacecraft_id"),
    # lists
    ("    command: ['drive']\n", "", "2: command: missing; a list of keys is needed, as ['cmd_twist']"),
    ("['drive']", "drive", "8: command: \"drive\" is a string; a list of keys is needed, as ['cmd_twist']"),
    ("['drive']", "{drive: 1}", "8: command: a mapping; a list of keys is needed, as ['cmd_twist']"),
    ("['drive']", "[1]", "8: command: 1 is an integer; a list of keys is needed, as ['cmd_twist']"),
    ("['drive']", "['drive', 1]", "8: command: values of several kinds in one list; ROS 2 takes one kind"),
    ("['drive']", "[['drive']]", "8: command: a list or mapping inside a list; ROS 2 takes plain values there"),
    ("['drive']", "['drive', 'driv']", "8: command: driv has no mapping; did you mean drive? write driv: {type: ..., topic: ..., mid: ...}"),
    ("['drive']", "['drive',\n 'drive']", "9: command: drive is listed on line 8 already; list it once"),
    ("['pose']", "['pose', 'drive']", "9: telemetry: drive is listed on line 8 already; list it once"),
    ("['pose']", "['pose', 'x']\n    x: 3", "10: x: no mapping; type, topic and mid are needed below it"),
    # mappings
    ("      mid: 0x1827\n", "", "10: drive.mid: missing; a MsgId from 0x1 to 0x1FFF is needed"),
    ("0x1827", "'0x1827'", '13: drive.mid: "0x1827" is a string; write 0x1827 without quotes'),
    ("0x1827", "6183.0", "13: drive.mid: 6183.0 is the float 6183.0; a MsgId from 0x1 to 0x1FFF is needed"),
    ("0x1827", "0x11827", "13: drive.mid: 0x11827 does not fit 16 bits; a MsgId from 0x1 to 0x1FFF is needed"),
    ("0x1827", "-1", "13: drive.mid: -0x1 does not fit 16 bits; a MsgId from 0x1 to 0x1FFF is needed"),
    ("0x1827", "0x2827", "13: drive.mid: 0x2827 is refused by cFE; a MsgId from 0x1 to 0x1FFF is needed"),
    ("0x1827", "0", "13: drive.mid: 0x0 is refused by cFE; a MsgId from 0x1 to 0x1FFF is needed"),
    ("0x1827", "18446744073709551616", "13: drive.mid: 18446744073709551616 is the float 1.8446744073709552e+19; a MsgId from 0x1 to 0x1FFF is needed"),
    ('      type: "geometry_msgs/msg/Twist"\n', "", "10: drive.type: missing; a ROS type is needed, as package/msg/Name"),
    ("geometry_msgs/msg/Twist", "geometry_msgs/Twist", '11: drive.type: "geometry_msgs/Twist" is not of the form package/msg/Name; write geometry_msgs/msg/Twist'),
    ("geometry_msgs/msg/Twist", "geometry_msgs::msg::Twist", '11: drive.type: "geometry_msgs::msg::Twist" is not of the form package/msg/Name; write geometry_msgs/msg/Twist'),
    ("geometry_msgs/msg/Twist", "Twist", '11: drive.type: "Twist" is not of the form package/msg/Name; the bridge needs package/msg/Name'),
    ("geometry_msgs/msg/Twist", "std_srvs/srv/Empty", '11: drive.type: "std_srvs/srv/Empty" is not of the form package/msg/Name; the bridge needs package/msg/Name'),
    ('"cmd_vel"', "yes", '12: drive.topic: yes is the boolean true; a string is needed: write "yes" in quotes'),
    ('"cmd_vel"', "''", '12: drive.topic: "" is not a topic; letters, digits and _ between single slashes are allowed, no part starting with a digit'),
    ('"cmd_vel"', "a//b", '12: drive.topic: "a//b" is not a topic; letters, digits and _ between single slashes are allowed, no part starting with a digit'),
    ('"cmd_vel"', "1a", '12: drive.topic: "1a" is not a topic; letters, digits and _ between single slashes are allowed, no part starting with a digit'),
    ('"cmd_vel"', "/pose", "16: pose.topic: /pose is the topic of drive on line 12 already; a bridge takes a topic once"),
    ("mid: 0x827", "mid: 0x827\n      envelope: 3/3", '18: pose.envelope: "3/3" is not an envelope; auto, 8/8, 4/4, 2/2 and 1/1 are allowed, the first numbers with le or be behind'),
    ("mid: 0x827", "mid: 0x827\n      envelope: 8", '18: pose.envelope: 8 is an integer; a string is needed: write "8" in quotes'),
    # the form of the file
    ("fsw_port: 1234", "bridge_port: 1234\n      fsw_port: 1234", "5: communication.bridge_port: written twice, on line 4 before; keep one"),
    ("    pose:", "    drive: {type: x}\n    pose:", "14: drive: written twice, on line 10 before; keep one"),
    ("fsw_port: 1234", "fsw_port: &p 1234\n      x: *p", "6: communication.x: an alias (*); ROS 2 takes none: write the value out"),
    ("fsw_port: 1234", "fsw_port: 1234\n      [1]: 2", "6: communication: a key that is not a name; write NAME: VALUE"),
    ("bridge:\n", "1bridge:\n", "2: 1bridge: not the name of a node; allowed are letters, digits and _ between slashes, or the wildcards * and **"),
    ("bridge:\n", "rate: 5\nbridge:\n", "1: rate: a value outside ros__parameters; indent it below, or remove it"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "line"), CHANGES)
def test_one_mistake_is_one_line(old, new, line):
    assert GROUND.count(old) >= 1
    assert mistakes(GROUND.replace(old, new, 1)) == [f"m.yaml:{line}"]


WHOLE = [
    ("", "1: the file is empty; a bridge's file is NODE: ros__parameters: ..."),
    ("# nothing\n", "1: the file is empty; a bridge's file is NODE: ros__parameters: ..."),
    ("a: 1\n", "1: there is no ros__parameters; a bridge's file is NODE: ros__parameters: ..."),
    ("[1, 2]", "1: there is no ros__parameters; a bridge's file is NODE: ros__parameters: ..."),
    ("a:\n  ros__parameters:\n", "2: ros__parameters: no parameters below it; communication, command and telemetry are needed"),
    ("a:\n  ros__parameters: {b: 1}\n", "2: /a: no node here is a bridge; it needs communication, command and telemetry"),
    ("a:\n  b: [\n", "3: not YAML: while parsing a flow node, did not find expected node content; a bridge's file is NODE: ros__parameters: ..."),
    ("a: 1\n\tb: 2\n", "2: not YAML: while scanning a plain scalar, found a tab character that violates indentation; a bridge's file is NODE: ros__parameters: ..."),
    ("é: é\nü: \x01", "2: character 0x1 is not allowed in YAML; remove it"),
    ("a: \x01", "1: character 0x1 is not allowed in YAML; remove it"),
    ("[" * 5000, "1: nested more than 50 levels deep; a bridge's file is NODE: ros__parameters: ..."),
    (b"a: 1\nb: \xff", "2: not UTF-8 at byte 8; give the YAML file of a bridge"),
    ("{a: " * 60 + "1" + "}" * 60, "1: nested more than 50 levels deep; a bridge's file is NODE: ros__parameters: ..."),
]  # fmt: skip


@pytest.mark.parametrize(("text", "line"), WHOLE)
def test_a_file_that_is_no_mission(text, line):
    assert mistakes(text) == [f"m.yaml:{line}"]


def test_a_file_too_large_is_not_read():
    assert mistakes(b"#" * (1 << 19) + b"\n") == [
        "m.yaml: larger than 512 KiB; give the YAML file of a bridge"
    ]


def test_two_topics_on_one_msg_id():
    text = GROUND.replace("['drive']", "['drive', 'turn']")
    text += "    turn: {type: geometry_msgs/msg/Twist, topic: turn, mid: 0x1827}\n"
    assert mistakes(text) == [
        "m.yaml:18: turn.mid: 0x1827 carries /cmd_vel already (m.yaml:10: drive); one topic a MsgId on the ci link"
    ]


def test_two_topics_on_one_msg_id_of_the_software_bus_in_both_directions():
    text = FLIGHT.replace("mid: 0x82B", "mid: 0x1829")
    (line,) = mistakes(text)
    assert "twist_cmd_2.mid: 0x1829 carries /robot_1/pose already (m.yaml:21: pose_tlm_1); " in line
    assert line.endswith("on the sbn link")


def test_two_files_that_cannot_be_told_apart():
    with pytest.raises(ConfigError) as caught:
        load([SAMPLES / "rover_ground.yaml", SAMPLES / "single_arm_ground.yaml"])
    first, second = caught.value.mistakes
    assert "cmd_pose.mid: 0x1827 carries /cmd_vel already (" in first
    assert "rover_ground.yaml:14: cmd_twist); one topic a MsgId on the ci link" in first
    assert "0x0827 carries /telemetry_pose already (" in second


def test_a_flight_link_has_keys_of_its_own():
    text = FLIGHT.replace("processor_id: 3", "processor_id: 4294967296").replace(
        "      peer_port: 2234 # SBN of cpu1\n", ""
    )
    assert [line.partition("; ")[0] for line in mistakes(text)] == [
        "m.yaml:5: communication.peer_port: missing",
        "m.yaml:14: communication.processor_id: 4294967296 is out of range",
    ]


def test_all_mistakes_of_all_files_at_once(tmp_path):
    bad = tmp_path / "bad.yaml"
    bad.write_text(
        GROUND.replace("fsw_port: 1234", "fsw_port: ci").replace("0x827", "0x2827").replace("cmd_vel", "a b")
    )
    (tmp_path / "folder").mkdir()
    with pytest.raises(ConfigError) as caught:
        load([tmp_path / "none.yaml", bad, tmp_path / "folder"])
    assert [line.removeprefix(str(tmp_path)).partition("; ")[0] for line in caught.value.mistakes] == [
        "/none.yaml: no such file",
        '/bad.yaml:5: communication.fsw_port: "ci" is a string',
        '/bad.yaml:12: drive.topic: "a b" is not a topic',
        "/bad.yaml:17: pose.mid: 0x2827 is refused by cFE",
        "/folder: a folder without YAML files",
    ]


def test_unreadable_paths_are_mistakes(tmp_path):
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    for path in (loop, "nul\0", "x" * 5000):
        with pytest.raises(ConfigError, match="cannot be read"):
            load(path)


def test_an_unknown_type_is_told_by_the_type_store():
    sentence = "unknown type geometry_msgs/msg/Twist; did you mean geometry_msgs/msg/TwistStamped?"
    found = mistakes(GROUND, check_type=lambda name: sentence if name.endswith("/Twist") else None)
    assert found == [f"m.yaml:11: drive.type: {sentence}"]


WARNINGS = [
    ("['drive']", "[]", ["8: command: an empty list, which ROS 2 refuses; [''] is an empty list to a bridge",
                         "10: drive: ignored; a bridge reads what command or telemetry lists"]),
    ("telemetry_ip", "rate: 3\n      telemetry_ip", ["7: communication.rate: ignored; a ground bridge reads bridge_port, fsw_port, fsw_ip, telemetry_ip, bridge_ip (optional)"]),
    ("mid: 0x827", "mid: 0x827\n      envelop: 4/4", ["18: pose.envelop: ignored; did you mean envelope? read are type, topic, mid, envelope, max_rate, keep, to_limit"]),
    ("0x1827", "1827", ["13: drive.mid: 0x0723 lacks 0x0800, the secondary header bit that cFE messages have; is it hexadecimal, written without 0x?"]),
    ("0x1827", "0x828", ["13: drive.mid: 0x0828 is a telemetry MsgId under command; a ground bridge's command has the bit 0x1000 as a rule"]),
    ("0x827", "0x1828", ["17: pose.mid: 0x1828 is a command MsgId under telemetry; a ground bridge's telemetry lacks the bit 0x1000 as a rule"]),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "lines"), WARNINGS)
def test_warnings(old, new, lines):
    mission = loads({"m.yaml": GROUND.replace(old, new, 1).encode()})
    assert list(mission.warnings) == [f"m.yaml:{line}" for line in lines]


def test_every_line_says_what_is_allowed():
    for _, _, line in CHANGES:
        assert FORM.fullmatch(f"m.yaml:{line}"), line
    for _, line in WHOLE:
        assert FORM.fullmatch(f"m.yaml:{line}"), line


def survives(files: dict[str, bytes]) -> None:
    """Show that a mission comes out, or a ConfigError of whole lines."""
    try:
        mission = loads(files)
    except ConfigError as error:
        lines = list(error.mistakes)
        whole = str(error).splitlines()
    else:
        assert loads(mission.files).routes == mission.routes
        lines = whole = [*mission.warnings, "fine"]
    assert lines
    assert lines == whole


@settings(deadline=None)
@given(st.binary())
def test_any_bytes(data):
    survives({"m.yaml": data})


@settings(deadline=None)
@given(st.text())
@example("%YAML 1.1\n%TAG ! x\n---\n!<a> b: &c *c")
@example('a: "\\xZZ"')
@example("? ? ?")
@example("%YAML 9999999999999999999.1\n---\na")
def test_any_text(text):
    survives({"m.yaml": text.encode("utf-8", "ignore")})


@settings(deadline=None)
@given(st.text("ab:-[]{},&*!|>'\"%#?\\ \t\r\n\x85\u2028~01.x", max_size=60))
def test_any_text_that_looks_like_yaml(text):
    survives({"m.yaml": text.encode()})


VALUES = st.sampled_from(
    [
        "0x1827",
        "'0x82A'",
        "[]",
        "[a, b]",
        "{a: 1}",
        "",
        "~",
        "*x",
        "&x 1",
        "1e3",
        "yes",
        "'\n'",
        "'a\\\\'",
        '"\\n\\u2028"',
    ]
)


@settings(max_examples=examples(200), deadline=None)
@given(st.lists(st.tuples(st.integers(0, 16), st.integers(0, 3), VALUES), max_size=4))
def test_any_damage_to_a_file_that_was_right(damages):
    lines = GROUND.splitlines()
    for place, kind, value in damages:
        index = place % len(lines)
        match kind:
            case 0:
                lines[index] = lines[index].partition(":")[0] + ": " + value
            case 1:
                lines.insert(index, lines[place % len(lines)])
            case 2:
                lines[index] = " " + lines[index]
            case _:
                del lines[index]
    survives({"m.yaml": "\n".join(lines).encode()})
