"""The commands on files: what they print, their JSON, and mistakes in one line."""

from __future__ import annotations

from contextlib import suppress

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from places import SAMPLES

from edoras_tools.addons.ros_verbs.cli import TextOptions
from edoras_tools.errors import ConfigError, WireError
from edoras_tools.ros import TypeStore

ROBOT, ROVER = SAMPLES / "recordings/robot.mcap", SAMPLES / "captures/a_rover.pcap"
MISSION = ("-c", SAMPLES / "missions/rover_ground.yaml")
DDS = SAMPLES / "rtps/cyclone_sender.pcap.gz"


def test_echo_of_a_recording(call):
    done = call("echo", ROBOT, "/text", "--once", "--include-message-info")
    assert done.out.splitlines() == [
        "publication_sequence_number: null",
        "received_timestamp: 1790000000003000000",
        "reception_sequence_number: null",
        "source_timestamp: 1790000000003000000",
        "---",
        "data: hello 0",
        "---",
    ]
    assert call("echo", ROBOT, "/text", "--csv").out == "hello 0\nhello 25\nhello 50\n"
    assert call("echo", ROBOT, "/text", "--raw", "--where", "data == 'hello 25'").out.count("hello") == 1


def test_echo_of_a_capture(call):
    done = call("echo", ROVER, "/cmd_vel", *MISSION, "--field", "linear", "--flow-style")
    assert done.code == 0
    assert len(done.out.splitlines()) == 1200
    assert done.out.splitlines()[1] == "---"


@pytest.mark.parametrize(
    ("words", "texts"),
    [
        (("bw", ROBOT, "/cmd_vel"), ["2.60 KB/s from 60 messages", "\tMessage size mean: 0.05 KB"]),
        (("bw", DDS, "/cmd_vel", "-w", 10), ["KB/s from 10 messages"]),
        (("bw", ROVER, "/cmd_vel", *MISSION), ["520 B/s from 100 messages"]),
        (("delay", ROBOT, "/scan"), ["average delay: 0.001\n\tmin: 0.001s max: 0.001s", "window: 30"]),
        (("hz", ROBOT, "/scan"), ["average rate: 25.000\n\tmin: 0.040s", "window: 29"]),
        (("hz", ROBOT, "/scan", "/cmd_vel"), ["/scan      25.000", "/cmd_vel   50.000"]),
        (("topic", "list", ROBOT, "-t"), ["/cmd_vel [geometry_msgs/msg/Twist]\n"]),
        (("topic", "list", ROBOT, "--count-topics"), ["5\n"]),
        (
            ("topic", "list", ROBOT, "-v"),
            ["Published topics:\n * /cmd_vel [geometry_msgs/msg/Twist] 1 publisher\n"],
        ),
        (("topic", "info", ROBOT, "/scan"), ["Type: sensor_msgs/msg/LaserScan\nPublisher count: 1\nSub"]),
    ],
)
def test_what_is_printed(call, words, texts):
    done = call(*words)
    assert (done.code, done.err) == (0, [])
    assert all(text in done.out for text in texts), done.out


@pytest.mark.parametrize(
    "words", [("bw", "/cmd_vel"), ("delay", "/scan"), ("topic", "list"), ("topic", "info", "/scan")]
)
def test_json(call, words):
    """``call`` holds it to its schema."""
    *verb, topic = words if words[-1][0] == "/" else (*words, None)
    topics = call(*verb, ROBOT, *filter(None, [topic]), "--json").json()["topics"]
    assert topic is None or topics[0]["topic"] == topic


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("echo", ROBOT), "name one topic: edoras echo"),
        (("bw", ROBOT, "/a", "/b"), "name one topic: edoras bw"),
        (("echo", ROBOT, "/text", "--field", "x"), "std_msgs/msg/String has no field 'x'; there are data"),
        (("delay", ROBOT, "/cmd_vel"), "geometry_msgs/msg/Twist has no header"),
        (("bw", ROBOT, "/cmd"), "no topic is called '/cmd'"),
        (
            ("bw", ROBOT, "/cmd_vel", "--ros", "dds"),
            "name one input: FILE..., -i IFACE, or --ros for a graph",
        ),
        (("topic", "info", ROBOT, "/cmd"), "unknown topic '/cmd'"),
        (("echo", "/text", "--ros", "zenoh"), "--ros zenoh tells nothing of endpoints"),
        (("observe", "file"), "file: observe looks at a graph; a topic begins with /"),
        (("play", ROBOT, "--topic", "/none"), "it has no ROS message that was selected"),
        (("hz", ROBOT), "name one topic: edoras hz"),
    ],
)
def test_mistakes_are_one_line(call, words, why):
    done = call(*words)
    assert done.code in {1, 2}
    assert len(done.err) == 1
    assert why in done.err[0]


TYPES = TypeStore()
JOINTS, STRING = "sensor_msgs/msg/JointState", "std_msgs/msg/String"
VALUES = {
    "header": {"stamp": {"sec": 7, "nanosec": 8}, "frame_id": "base"},
    "name": ["a", "b"],
    "position": [0.5, 1.0],
    "velocity": [],
    "effort": [2.0],
}


@pytest.mark.parametrize(
    ("form", "text"),
    [
        (
            TextOptions(),
            (
                "header:\n  stamp:\n    sec: 7\n    nanosec: 8\n  frame_id: base\nname:\n- a\n- b\n"
                "position:\n- 0.5\n- 1.0\nvelocity: []\neffort:\n- 2.0\n"
            ),
        ),
        (TextOptions(field="header.stamp"), "sec: 7\nnanosec: 8\n"),
        (TextOptions(field="header.frame_id"), "base\n"),
        (TextOptions(field="position", flow_style=True), "[0.5, 1.0]\n"),
        (TextOptions(field="name", truncate_length=1), "- a\n- '...'\n"),
        (TextOptions(field="header", csv=True), "7,8,base\n"),
        (TextOptions(csv=True), "7,8,base,a,b,0.5,1.0,2.0\n"),
        (TextOptions(field="header.frame_id", truncate_length=2), "ba...\n"),
        (TextOptions(field="header.frame_id", no_str=True), "'<string length: <4>>'\n"),
        (
            TextOptions(no_arr=True, csv=True),
            (
                "7,8,base,<sequence type: string, length: 2>,<sequence type: double, length: 2>,"
                "<sequence type: double, length: 0>,<sequence type: double, length: 1>\n"
            ),
        ),
    ],
)
def test_how_a_message_is_written(form, text):
    assert form.text(TYPES, JOINTS, TYPES.encode(JOINTS, VALUES)) == text


@pytest.mark.parametrize(
    ("field", "why"),
    [("pose", "has no field 'pose'; there are header, name"), ("header.stamp.sec.x", "has no field 'x'")],
)
def test_a_field_that_there_is_not(field, why):
    with pytest.raises(ConfigError, match=why):
        TextOptions(field=field).text(TYPES, JOINTS, TYPES.encode(JOINTS, VALUES))


@given(st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=40))
def test_yaml_reads_the_text_again(data):
    text = TextOptions(full_length=True).text(TYPES, STRING, TYPES.encode(STRING, {"data": data}))
    assert yaml.safe_load(text) == {"data": data}


@given(st.binary(max_size=40))
def test_garbage_is_refused_by_the_documented_error(cdr):
    with suppress(WireError):
        TextOptions().text(TYPES, STRING, cdr)
