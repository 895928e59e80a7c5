"""Mission files into bridges: what can be bridged is, what cannot is told."""

from __future__ import annotations

import pytest
from places import MISSIONS

from edoras_tools.errors import ConfigError, RouteError
from edoras_tools.middleware import Qos
from edoras_tools.pipelines.bridge.plan import BridgeRequest, plan_bridges, qos_of
from edoras_tools.pipelines.workbench import Settings

GROUND, FLIGHT = MISSIONS / "two_rovers_ground.yaml", MISSIONS / "two_rovers_flight.yaml"


@pytest.fixture
def changed(tmp_path):
    """A function: a mission file with changes, under another name."""

    def write(path, name, *changes):
        text = path.read_text()
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        (tmp_path / name).write_text(text)
        return tmp_path / name

    return write


def plan(*files, kind=None, limits=()):
    return plan_bridges(Settings(files), BridgeRequest(kind, limits))


def test_every_bridge_of_every_file_or_those_of_a_kind():
    both = plan(GROUND, FLIGHT)
    assert [(item.name, item.kind, len(item.bridge.routes)) for item in both.stations] == [
        ("conversion_node", "ground", 4),
        ("flight_conversion_node", "flight", 4),
    ]
    assert both.notes == ()
    assert [item.kind for item in plan(GROUND, FLIGHT, kind="flight").stations] == ["flight"]
    assert len(plan(GROUND, GROUND).stations) == 1


def test_two_cfs_may_use_the_same_msg_ids(changed):
    port = ("fsw_port: 1234", "fsw_port: 1244"), ("bridge_port: 1235", "bridge_port: 1245")
    other = changed(GROUND, "other.yaml", *port, ("robot_", "rover_"))
    found = plan(GROUND, other)
    assert [item.name for item in found.stations] == ["conversion_node", "conversion_node_2"]
    assert [len(item.bridge.routes) for item in found.stations] == [4, 4]
    assert found.notes == ()
    with pytest.raises(ConfigError, match="0x1827 carries /robot_1/ground/cmd_vel already"):
        found.workbench()


def test_an_unknown_type_is_left_out_and_the_rest_goes_on(changed):
    file = changed(
        GROUND,
        "g.yaml",
        (
            'twist_cmd_1:\n      type: "geometry_msgs/msg/Twist"',
            'twist_cmd_1:\n      type: "geometry_msgs/msg/Twister"',
        ),
    )
    found = plan(file)
    assert [route.topic for route in found.stations[0].bridge.routes] == [
        "/robot_2/ground/cmd_vel", "/robot_1/ground/pose", "/robot_2/ground/pose",
    ]  # fmt: skip
    (note,) = found.notes
    assert note.startswith(f"{file}:14: twist_cmd_1: type 'geometry_msgs/msg/Twister' is not known")
    assert note.endswith("; /robot_1/ground/cmd_vel is left out")
    assert found.workbench().mission.routes[0].topic == "/robot_2/ground/cmd_vel"


def test_two_sides_that_disagree_are_told(changed):
    types = changed(FLIGHT, "f.yaml", ("/robot_1/pose", "/robot_1/ground/cmd_vel"))
    found = plan(GROUND, types)
    (note,) = found.notes
    assert note == (
        f"{types}:21: pose_tlm_1: the topic is geometry_msgs/msg/PoseStamped here and "
        f"geometry_msgs/msg/Twist in {GROUND}:14; /robot_1/ground/cmd_vel is left out"
    )
    ids = changed(
        GROUND, "g.yaml", ("/robot_1/ground/cmd_vel", "/other"), ("bridge_port: 1235", "bridge_port: 1236")
    )
    (note,) = plan(GROUND, ids).notes
    assert "twist_cmd_1: 0x1827 of the same cFS is /robot_1/ground/cmd_vel in" in note


def test_nothing_left_is_a_mistake(changed):
    file = changed(GROUND, "g.yaml", ("geometry_msgs", "geometry_masgs"))
    with pytest.raises(ConfigError) as caught:
        plan(file)
    assert len(caught.value.mistakes) == 4
    empty = changed(
        GROUND, "e.yaml", ("['twist_cmd_1', 'twist_cmd_2']", "['']"), ("['pose_tlm_1', 'pose_tlm_2']", "['']")
    )
    with pytest.raises(ConfigError, match="nothing to bridge"):
        plan(empty)
    with pytest.raises(ConfigError, match="no flight bridge in"):
        plan(GROUND, kind="flight")
    with pytest.raises(ConfigError, match="-c FILE"):
        plan()


def test_all_mistakes_of_all_files_are_told_at_once(changed):
    files = [changed(GROUND, f"{name}.yaml", ("fsw_port: 1234", "fsw_port: x")) for name in "ab"]
    with pytest.raises(ConfigError) as caught:
        plan(*files)
    assert len(caught.value.mistakes) == 2


def test_limits_of_the_command_line_come_before_those_of_the_files(changed):
    file = changed(FLIGHT, "f.yaml", ("mid: 0x1829", "mid: 0x1829\n      max_rate: 5\n      keep: first"))
    handlings = lambda found: [  # noqa: E731
        (route.handling.max_rate, route.handling.keep) for route in found.stations[0].bridge.routes
    ]
    assert handlings(plan(file)) == [(5.0, "first"), (None, None), (None, None), (None, None)]
    assert handlings(plan(file, limits=["30"])) == [(30.0, "first"), (30.0, None), (None, None), (None, None)]
    found = plan(file, limits=["/robot_2/pose=1.5,latest", "0x82A=2", "twist_cmd_2=3", "all=0x50"])
    assert handlings(found) == [(5.0, "first"), (1.5, "latest"), (2.0, None), (3.0, None)]
    assert found.stations[0].bridge.max_rate_total == 80


@pytest.mark.parametrize("text", ["", "x", "0", "-1", "all=x", "30,newest", "=30", "all=3,latest", "yes"])
def test_a_limit_that_is_none(text):
    with pytest.raises(ConfigError, match="write 30, /cmd_vel=30,first or all=100"):
        plan(GROUND, limits=[text])


def test_a_limit_of_a_topic_that_is_not_bridged():
    with pytest.raises(RouteError, match="/cmd_vel is not bridged; there are /robot_1/ground/cmd_vel, "):
        plan(GROUND, limits=["/cmd_vel=3"])


def test_quality_of_service_is_that_of_publishers_and_the_public_bridges_unless_the_file_says_other(changed):
    file = changed(
        GROUND, "g.yaml", ("mid: 0x1827", "mid: 0x1827\n      qos: {reliability: best_effort, depth: 3}")
    )
    assert [qos_of(route) for route in plan(file).stations[0].bridge.routes[:3]] == [
        Qos(reliable=False, transient_local=None, depth=3),
        Qos(reliable=None, transient_local=None, depth=10),
        Qos(reliable=True, transient_local=True, depth=10),
    ]


def test_a_bridge_that_would_send_to_itself_is_refused(changed):
    path = changed(GROUND, "circle.yaml", ("bridge_port: 1235", "bridge_port: 1234"))
    with pytest.raises(
        ConfigError, match=r"circle\.yaml: .* listens on .*:1234 and sends to .*:1234, which is itself"
    ):
        plan(path)
