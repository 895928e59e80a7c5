"""The Foxglove layouts are complete, and recordings of the demos have all that they name."""

from __future__ import annotations

import json
import re
from functools import cache

import pytest
from mcap.reader import make_reader
from places import SAMPLES
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

LAYOUTS = {
    "rover": ("foxglove_layout_rover", "rover_ground"),
    "arm": ("foxglove_layout_arm", "single_arm_ground"),
    "two-arms": ("foxglove_layout_two_arms", "two_arms_ground", "two_arms_flight"),
    "two-rovers": ("foxglove_layout", "two_rovers_ground", "two_rovers_flight"),
}
"""The layout of each demo, and its missions."""
PATH = re.compile(
    r"(?P<topic>/[\w/]+)(?:\{(?P<key>\w+)==\"(?P<value>[^\"]+)\"\})?\.(?P<field>[\w.]+)(?:\[(?P<index>\d+)\])?"
)


@cache
def layout(scenario):
    return json.loads((SAMPLES / f"{LAYOUTS[scenario][0]}.json").read_text())


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Scenario to topic to (type, messages), 8 s in simulated time."""
    from edoras_tools.addons.lab.emulator import Simulation
    from edoras_tools.addons.lab.emulator.simulation import SimulatedSource
    from edoras_tools.pipelines.capture.record import Target, record
    from edoras_tools.pipelines.workbench import Settings
    from edoras_tools.units import SECOND

    def make(scenario):
        path = tmp_path_factory.mktemp("layout") / "demo.mcap"
        bench = Settings([SAMPLES / f"missions/{name}.yaml" for name in LAYOUTS[scenario][1:]]).workbench()
        simulation = Simulation(scenario=scenario, start_ns=1_800_000_000 * SECOND, command_rate_hz=10)
        record(SimulatedSource(simulation, 8 * SECOND), bench, Target(path, transforms=True))
        store, found = get_typestore(Stores.EMPTY), {}
        with path.open("rb") as file:
            for schema, channel, message in make_reader(file).iter_messages():
                if schema.name not in store.types:
                    store.register(get_types_from_msg(schema.data.decode(), schema.name))
                value = store.deserialize_cdr(message.data, schema.name)
                found.setdefault(channel.topic, (schema.name, []))[1].append(value)
        return found

    return cache(make)


def leaves(node):
    return [node] if isinstance(node, str) else leaves(node["first"]) + leaves(node["second"])


def paths():
    return [
        (scenario, item["value"])
        for scenario in LAYOUTS
        for name, panel in layout(scenario)["configById"].items()
        if name.startswith("Plot!")
        for item in panel["paths"]
    ]


@pytest.mark.parametrize("scenario", LAYOUTS)
def test_it_has_the_form_that_foxglove_imports(scenario):
    made = layout(scenario)
    assert made.keys() >= {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"}
    assert sorted(leaves(made["layout"])) == sorted(made["configById"])
    assert all(re.fullmatch(r"(3D|Plot|RosOut|Teleop|Publish)!\w+", name) for name in made["configById"])


@pytest.mark.parametrize("scenario", LAYOUTS)
def test_titles_are_those_of_both_apps_and_legends_stand_beside_the_curves(scenario):
    for name, panel in layout(scenario)["configById"].items():
        assert panel["foxglovePanelTitle"] == panel["lichtblickPanelTitle"]
        if name.startswith("Plot!"):
            assert (panel["showLegend"], panel["legendDisplay"]) == (True, "left")


@pytest.mark.parametrize("scenario", LAYOUTS)
def test_splits_are_complete(scenario):
    def check(node):
        if isinstance(node, str):
            return
        assert node.keys() == {"direction", "first", "second", "splitPercentage"}
        assert node["direction"] in {"row", "column"}
        assert 0 < node["splitPercentage"] < 100
        check(node["first"])
        check(node["second"])

    check(layout(scenario)["layout"])


@pytest.mark.long
@pytest.mark.parametrize(
    ("scenario", "name", "followed"),
    [("two-rovers", "rovers", "/robot_1/ground/pose"), ("rover", "rover", "/telemetry_pose")],
)
def test_the_camera_follows_a_robot_whose_frame_is_there_with_its_first_pose(
    recordings, scenario, name, followed
):
    panel, recording = layout(scenario)["configById"][f"3D!{name}"], recordings(scenario)
    assert panel["followMode"] == "follow-position"
    type_name, messages = recording["/tf"]
    assert type_name == "tf2_msgs/msg/TFMessage"
    frames = [message.transforms[0] for message in messages]
    moved = [item.transform.translation for item in frames if item.child_frame_id == panel["followTf"]]
    assert {item.header.frame_id for item in frames} == {"world"}
    poses = [message.pose.position for message in recording[followed][1]]
    assert [(item.x, item.y, item.z) for item in moved] == [(item.x, item.y, item.z) for item in poses]
    assert len(moved) >= 5


def test_poses_of_both_rovers_are_shown_in_their_frame(recordings):
    panel, recording = layout("two-rovers")["configById"]["3D!rovers"], recordings("two-rovers")
    wanted = {"/robot_1/ground/pose", "/robot_2/ground/pose", "/robot_1/pose", "/robot_2/pose"}
    assert set(panel["topics"]) == wanted
    assert all(topic["visible"] for topic in panel["topics"].values())
    for topic in wanted:
        type_name, messages = recording[topic]
        assert type_name == "geometry_msgs/msg/PoseStamped"
        assert {message.header.frame_id for message in messages} == {"world"}
    assert panel["layers"]["grid"]["frameId"] == "world"


@pytest.mark.quick("arm")
@pytest.mark.parametrize("scenario", LAYOUTS)
def test_events_go_to_the_log(recordings, scenario):
    panel = layout(scenario)["configById"]["RosOut!events"]
    type_name, messages = recordings(scenario)[panel["topicToRender"]]
    assert type_name == "rcl_interfaces/msg/Log"
    assert len(messages) > 5


@pytest.mark.each(5)
@pytest.mark.parametrize(("scenario", "path"), paths())
def test_every_curve_has_points(recordings, scenario, path):
    found = PATH.fullmatch(path)
    values = []
    for value in recordings(scenario)[found["topic"]][1]:
        if found["key"] and getattr(value, found["key"]) != found["value"]:
            continue
        for name in found["field"].split("."):
            value = getattr(value, name)  # noqa: PLW2901  a walk
        values.append(value if found["index"] is None else float(value[int(found["index"])]))
    assert len(values) >= 5
    assert all(isinstance(value, (int, float)) for value in values)


@pytest.mark.parametrize("scenario", LAYOUTS)
def test_other_panels_name_topics_that_are_there(recordings, scenario):
    recording = recordings(scenario)
    for name, panel in layout(scenario)["configById"].items():
        kind = name.partition("!")[0]
        if kind == "3D":
            assert {recording[topic][0] for topic in panel["topics"]} == {"geometry_msgs/msg/PoseStamped"}
        elif kind == "RosOut":
            assert recording[panel["topicToRender"]][0] == "rcl_interfaces/msg/Log"
        elif kind == "Teleop":
            assert recording[panel["topic"]][0] == "geometry_msgs/msg/Twist"
        elif kind == "Publish":
            assert recording[panel["topicName"]][0] == panel["datatype"] == "geometry_msgs/msg/Pose"
            assert json.loads(panel["value"]).keys() == {"position", "orientation"}


def test_the_curves_show_what_they_are_for(recordings):
    def topics(kind):
        named = [path for scenario, path in paths() if scenario == "two-rovers"]
        return {PATH.fullmatch(path)["topic"] for path in named if kind in path}

    assert {"/robot_1/ground/cmd_vel", "/robot_1/cmd_vel"} <= topics("cmd_vel")
    assert {"/robot_1/ground/pose", "/robot_2/ground/pose"} <= topics("pose.position")
    assert topics("rate_hz") == {"/edoras/link_statistics"}
    assert topics("error_counter") == {"/edoras/software_bus"}
    assert recordings("two-rovers")["/edoras/software_bus"][1][-1].message_limit_error_counter > 0
