"""The layout holds together, and all that it names is in a recording of the demo."""

from __future__ import annotations

import json
import re

import pytest
from mcap.reader import make_reader
from places import SAMPLES
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

LAYOUT = json.loads((SAMPLES / "foxglove_layout.json").read_text())
PANELS = LAYOUT["configById"]
PATH = re.compile(r"(?P<topic>/[\w/]+)(?:\{(?P<key>\w+)==\"(?P<value>[^\"]+)\"\})?\.(?P<field>[\w.]+)")


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Topic to (type, messages) of the demo's mission, 8 s of it in simulated time."""
    from edoras_tools.emulator import Simulation
    from edoras_tools.emulator.source import SimulatedSource
    from edoras_tools.pipelines.capture.record import Target, record
    from edoras_tools.pipelines.workbench import Settings
    from edoras_tools.units import SECOND

    path = tmp_path_factory.mktemp("layout") / "two_rovers.mcap"
    bench = Settings(
        [SAMPLES / f"missions/two_rovers_{side}.yaml" for side in ("ground", "flight")]
    ).workbench()
    simulation = Simulation(scenario="two-rovers", start_ns=1_800_000_000 * SECOND, command_rate_hz=10)
    record(SimulatedSource(simulation, 8 * SECOND), bench, Target(path))
    store, found = get_typestore(Stores.EMPTY), {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            if schema.name not in store.types:
                store.register(get_types_from_msg(schema.data.decode(), schema.name))
            value = store.deserialize_cdr(message.data, schema.name)
            found.setdefault(channel.topic, (schema.name, []))[1].append(value)
    return found


def leaves(node):
    return [node] if isinstance(node, str) else leaves(node["first"]) + leaves(node["second"])


def paths():
    return [
        item["value"] for name, panel in PANELS.items() if name.startswith("Plot!") for item in panel["paths"]
    ]


def test_it_has_the_form_that_foxglove_imports():
    assert LAYOUT.keys() >= {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"}
    assert sorted(leaves(LAYOUT["layout"])) == sorted(PANELS)
    assert all(re.fullmatch(r"(3D|Plot|RosOut)!\w+", name) for name in PANELS)


def test_splits_are_complete():
    def check(node):
        if isinstance(node, str):
            return
        assert node.keys() == {"direction", "first", "second", "splitPercentage"}
        assert node["direction"] in {"row", "column"}
        assert 0 < node["splitPercentage"] < 100
        check(node["first"])
        check(node["second"])

    check(LAYOUT["layout"])


def test_poses_of_both_rovers_are_shown_in_their_frame(recording):
    panel = PANELS["3D!rovers"]
    wanted = {"/robot_1/ground/pose", "/robot_2/ground/pose", "/robot_1/pose", "/robot_2/pose"}
    assert set(panel["topics"]) == wanted
    assert all(topic["visible"] for topic in panel["topics"].values())
    for topic in wanted:
        type_name, messages = recording[topic]
        assert type_name == "geometry_msgs/msg/PoseStamped"
        assert {message.header.frame_id for message in messages} == {panel["followTf"]} == {"world"}
    assert panel["layers"]["grid"]["frameId"] == "world"


def test_events_go_to_the_log(recording):
    type_name, messages = recording[PANELS["RosOut!events"]["topicToRender"]]
    assert type_name == "rcl_interfaces/msg/Log"
    assert len(messages) > 5


@pytest.mark.parametrize("path", paths())
def test_every_curve_has_points(path, recording):
    found = PATH.fullmatch(path)
    values = []
    for message in recording[found["topic"]][1]:
        value = message
        if found["key"] and getattr(message, found["key"]) != found["value"]:
            continue
        for name in found["field"].split("."):
            value = getattr(value, name)
        values.append(value)
    assert len(values) >= 5
    assert all(isinstance(value, (int, float)) for value in values)


def test_the_curves_show_what_they_are_for(recording):
    def topics(kind):
        return {PATH.fullmatch(path)["topic"] for path in paths() if kind in path}

    assert {"/robot_1/ground/cmd_vel", "/robot_1/cmd_vel"} <= topics("cmd_vel")
    assert {"/robot_1/ground/pose", "/robot_2/ground/pose"} <= topics("pose.position")
    assert topics("rate_hz") == {"/edoras/link_statistics"}
    assert topics("error_counter") == {"/edoras/software_bus"}
    assert recording["/edoras/software_bus"][1][-1].message_limit_error_counter > 0
