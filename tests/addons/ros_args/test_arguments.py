"""Mission files as they are with ``--ros-args``: topics, nodes, parameters; what a recording keeps."""

import json
from pathlib import Path

import pytest
from ros_wheels import APART, asked

from edoras_tools.addons.ros_args.arguments import RosArguments
from edoras_tools.errors import ConfigError
from edoras_tools.mission import load, loads
from edoras_tools.mission.loading import read_file
from edoras_tools.mission.tree import Mistakes, NodeParameters

BRIDGE = """
{}:
  ros__parameters:
    communication: {{bridge_port: 1235, fsw_port: 1234, fsw_ip: 127.0.0.1, telemetry_ip: 0.0.0.0}}
    command: [a]
    telemetry: [b]
    a: {{type: geometry_msgs/msg/Twist, topic: cmd_vel, mid: {}}}
    b: {{type: geometry_msgs/msg/Twist, topic: {}, mid: 0x827}}
"""


def bridge(node, topic="pose", mid="0x1827"):
    return BRIDGE.format(node, mid, topic)


@pytest.fixture
def file(tmp_path):
    """Return what writes a file, and its path."""

    def write(text, name="m.yaml"):
        (tmp_path / name).write_text(text)
        return tmp_path / name

    return write


def named(mission):
    """Return the name of each bridge with its topics."""
    return {item.name: [route.topic for route in item.routes] for item in mission.bridges}


@pytest.mark.parametrize(
    ("node", "topic", "words", "expected"),
    [
        ("node", "pose", "", {"/node": ["/cmd_vel", "/pose"]}),
        ("/robot_1/node", "~/pose", "", {"/robot_1/node": ["/robot_1/cmd_vel", "/robot_1/node/pose"]}),
        ("/**/node", "~/pose", "", {"/**/node": ["/cmd_vel", "/node/pose"]}),
        ("/**", "/pose", "-r __ns:=/robot_1", {"/robot_1/*": ["/robot_1/cmd_vel", "/pose"]}),
        ("/**", "~/pose", "-r __node:=x -r __ns:=/r", {"/r/x": ["/r/cmd_vel", "/r/x/pose"]}),
        ("/robot_1/node", "pose", "-r __ns:=/robot_1 -r pose:=/p",
         {"/robot_1/node": ["/robot_1/cmd_vel", "/p"]}),
        ("/r/node", "pose", "-r other:pose:=/q -r node:pose:=/p", {"/r/node": ["/r/cmd_vel", "/p"]}),
    ],
)  # fmt: skip
def test_a_bridge_has_the_names_that_its_node_would_have(file, node, topic, words, expected):
    mission = load(file(bridge(node, topic)), ros_args=words.split())
    assert named(mission) == expected
    assert mission.warnings == ()
    # A recording of it keeps the words beside the files, and is read the same.
    again = loads(mission.files)
    assert named(again) == expected
    assert ("ros_args" in mission.files) == bool(words)


def test_of_several_robots_the_one_that_is_started_is_bridged(file):
    path = file(bridge("/robot_1/node") + bridge("/robot_2/node"))
    with pytest.raises(ConfigError, match="carries"):
        load(path)  # one cFS, one MsgId, two topics
    mission = load(path, ros_args=["-r", "__ns:=/robot_2"])
    assert named(mission) == {"/robot_2/node": ["/robot_2/cmd_vel", "/robot_2/pose"]}
    (warning,) = mission.warnings
    assert warning.endswith("/robot_1/node: left out: with these --ros-args another node is started")


def test_what_a_real_node_would_not_read_is_bridged_with_a_warning(file):
    mission = load(file(bridge("node")), ros_args=["-r", "__ns:=/robot_1"])
    assert named(mission) == {"/robot_1/node": ["/robot_1/cmd_vel", "/robot_1/pose"]}
    (warning,) = mission.warnings
    assert warning.endswith(
        "/node: a real node would be /robot_1/node and not read this; write /robot_1/node or /** in its place"
    )


def test_parameters_take_the_place_of_those_of_the_file_in_their_order(file):
    path = file(bridge("/r/node"))
    more = file("/**: {ros__parameters: {communication.fsw_port: 7, a.topic: x}}", "more.yaml")
    words = ["-p", "communication.fsw_port:=5", "--params-file", str(more), "-p", "a.topic:=~/y"]
    words += ["-p", "other:b.topic:=no", "-p", "a.qos.depth:=3"]
    for paths in ([path], [path, more]):
        mission = load(paths, ros_args=words)
        assert mission.links[0].fsw_port == 7
        assert named(mission) == {"/r/node": ["/r/node/y", "/r/pose"]}
        assert mission.routes[0].handling.depth == 3
    assert [item.topic for item in loads(mission.files).routes] == ["/r/node/y", "/r/pose"]


def test_a_file_of_parameters_with_a_bridge_is_a_mission_file(file):
    path = file(bridge("/**"))
    mission = load(path, ros_args=["--params-file", str(path), "-r", "__ns:=/r"])
    assert named(mission) == {"/r/*": ["/r/cmd_vel", "/r/pose"]}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("-p communication.fsw_port:=x", 'm.yaml: communication.fsw_port: "x" is a string'),
        ("-p a.topic:=9", "m.yaml: a.topic: "),
        ("-p a:=[1,x]", "--ros-args: -p a:=[1,x]:3: a: values of several kinds"),
        ("-p a", "--ros-args: -p 'a' is no parameter; write NAME:=VALUE"),
        ("-r a", "--ros-args: -r 'a' is no rule; write FROM:=TO"),
        ("-r", "--ros-args: nothing follows -r"),
        ("-z", "--ros-args: '-z' is not known; there are -r, -p and --params-file"),
        ("--params-file /none.yaml", "/none.yaml: no such file"),
    ],
)
def test_what_is_wrong_is_one_line(file, words, said):
    with pytest.raises(ConfigError) as raised:
        load(file(bridge("/**")), ros_args=words.split())
    assert said in str(raised.value)
    assert "\n" not in str(raised.value)


def test_without_a_name_for_the_node_its_own_names_are_refused(file):
    path = file(bridge("/**", "~/pose"))
    with pytest.raises(ConfigError, match=r"b\.topic: .~/pose. is not a topic; ~ needs the node's name"):
        load(path)


def test_the_command_line_takes_them_as_ros_does(edoras, file):
    path = str(file(bridge("/**")))
    words = ["--ros-args", "-r", "__ns:=/r", "--params-file", path, "-p", "a.mid:=0x1899", "--"]
    done = edoras("bridge", "--ros", "local", *words, "--dry-run", "--json")
    (planned,) = json.loads(done.stdout)["bridges"]
    assert planned["name"] == "r/ground_bridge"
    assert [(item["topic"], item["msg_id"]) for item in planned["routes"]] == [
        ("/r/cmd_vel", "0x1899"),
        ("/r/pose", "0x0827"),
    ]


FILES = {
    "one.yaml": "/**: {ros__parameters: {of.a: 2, of.b: 2}}",
    "two.yaml": "/r/bridge: {ros__parameters: {of.a: 3, of.b: 3, of.c: 3}}",
    "both.yaml": "/r/bridge: {ros__parameters: {of.a: 3}}\n/**: {ros__parameters: {of.a: 4}}",
    "wild.yaml": "/**/bridge: {ros__parameters: {of.a: 5}}\n/*/bridge: {ros__parameters: {of: {b: 6}}}\n"
    "bridge: {ros__parameters: {of.c: 7}}",
}
ONE, TWO, BOTH, WILD = (f"--params-file {name}" for name in FILES)
PARAMETERS = (
    ("/r", f"-p of.a:=1 {ONE}", {"a": 2, "b": 2}),
    ("/r", f"{ONE} -p of.a:=1", {"a": 1, "b": 2}),
    ("/r", f"{TWO} {ONE}", {"a": 2, "b": 2, "c": 3}),
    ("/r", f"{ONE} {TWO}", {"a": 3, "b": 3, "c": 3}),
    ("", f"{ONE} {TWO}", {"a": 2, "b": 2}),
    ("/r", BOTH, {"a": 4}),
    ("/r", WILD, {"a": 5, "b": 6}),
    ("", WILD, {"a": 5, "c": 7}),
    ("/r", "-p bridge:of.a:=1", {}),
    ("", "-p bridge:of.a:=1 -p other:of.b:=1", {"a": 1}),
    ("", "-r __node:=z -p bridge:of.a:=1 -p z:of.b:=2", {"b": 2}),
    ("", f"-r __ns:=/r {TWO} -p of.b:=text", {"a": 3, "b": "text", "c": 3}),
    ("", "-p of.a:=[1,2] -p of.b:=1.5 -p of.c:=true", {"a": [1, 2], "b": 1.5, "c": True}),
)
"""Namespace, words, and the parameters below ``of`` of a node ``bridge``."""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, text in FILES.items():
        Path(name).write_text(text)


@pytest.mark.parametrize(("namespace", "words", "expected"), PARAMETERS)
def test_parameters_are_those_of_the_table(folder, namespace, words, expected):
    node = NodeParameters(f"{namespace}/bridge", 1, lines={"command": 1})
    (changed,) = RosArguments(words.split(), read_file).applied([node], Mistakes("m.yaml"))
    values = {
        name.removeprefix("of."): [one.value for one in item] if isinstance(item, tuple) else item.value
        for name, item in changed.values.items()
    }
    assert values == expected


@pytest.mark.long
@pytest.mark.parametrize("name", APART)
def test_rclpy_gives_a_node_the_parameters_of_the_table(folder, name):
    answers = asked(name, [(namespace, words.split(), []) for namespace, words, _ in PARAMETERS])
    for (_, words, expected), (_, values) in zip(PARAMETERS, answers, strict=True):
        assert values == expected, words
