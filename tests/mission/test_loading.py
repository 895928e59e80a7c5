"""Files to a mission: the paper's figures as printed, the samples, and the forms that ROS 2 allows."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest
from places import MISSIONS

from edoras_tools.errors import ConfigError, RouteError
from edoras_tools.links.bare import CI, TO
from edoras_tools.links.sbn import SBN
from edoras_tools.mission import FlightLink, GroundLink, Mission, Route, load, loads
from edoras_tools.model import Endpoint

FIGURES = Path(__file__).parent / "figures"
SAMPLES = MISSIONS

TWIST, POSE, POSE_STAMPED = (f"geometry_msgs/msg/{name}" for name in ("Twist", "Pose", "PoseStamped"))
JOINT_STATE = "sensor_msgs/msg/JointState"
COMMUNICATION = "{bridge_port: 1235, fsw_port: 1234, fsw_ip: 127.0.0.1, telemetry_ip: 0.0.0.0}"
CMD_VEL = "{type: geometry_msgs/msg/Twist, topic: cmd_vel, mid: 0x1827}"


def read(text: str) -> Mission:
    return loads({"m.yaml": text.encode()})


def table(mission: Mission) -> set[tuple[str, str, int, str]]:
    return {
        (route.link.label, route.direction, route.msg_id, route.type, route.topic) for route in mission.routes
    }


def test_figure_4():
    path = str(FIGURES / "figure_4.yaml")
    mission = load(path)
    assert mission.links == (GroundLink(1235, 1235, "10.5.0.3", "0.0.0.0", None, path, 3),)
    assert mission.routes == (
        Route("/cmd_vel", TWIST, 0x1827, CI, "command", "cmd_twist", path, 10),
        Route("/telemetry_pose", POSE_STAMPED, 0x827, TO, "telemetry", "tlm_pose", path, 14),
    )
    assert mission.warnings == ()
    assert mission.files == {"figure_4.yaml": Path(path).read_bytes()}


def test_figure_19_which_names_no_node():
    path = str(FIGURES / "figure_19.yaml")
    mission = load([path])
    assert mission.links == (FlightLink("10.5.0.3", 2235, 2, 0x42, 2236, "0.0.0.0", 3, 0x42, path, 2),)
    assert mission.routes == (
        Route("/robot_1/pose", POSE_STAMPED, 0x1829, SBN, "command", "pose_tlm_1", path, 18),
        Route("/robot_2/pose", POSE_STAMPED, 0x182A, SBN, "command", "pose_tlm_2", path, 23),
        Route("/robot_1/cmd_vel", TWIST, 0x82A, SBN, "telemetry", "twist_cmd_1", path, 28),
        Route("/robot_2/cmd_vel", TWIST, 0x82B, SBN, "telemetry", "twist_cmd_2", path, 33),
    )
    (warning,) = mission.warnings
    assert warning == f"{path}:1: ros__parameters: no name of a node stands above; a bridge refuses this file"


DEMOS = {
    ("rover_ground",): {
        ("ci", "command", 0x1827, TWIST, "/cmd_vel"),
        ("to", "telemetry", 0x827, POSE_STAMPED, "/telemetry_pose"),
    },
    ("single_arm_ground",): {
        ("ci", "command", 0x1827, POSE, "/command_pose"),
        ("to", "telemetry", 0x827, JOINT_STATE, "/telemetry_joint_state"),
    },
    ("two_rovers_ground", "two_rovers_flight"): {
        ("ci", "command", 0x1827, TWIST, "/robot_1/ground/cmd_vel"),
        ("ci", "command", 0x1828, TWIST, "/robot_2/ground/cmd_vel"),
        ("to", "telemetry", 0x828, POSE_STAMPED, "/robot_1/ground/pose"),
        ("to", "telemetry", 0x829, POSE_STAMPED, "/robot_2/ground/pose"),
        ("sbn", "command", 0x1829, POSE_STAMPED, "/robot_1/pose"),
        ("sbn", "command", 0x182A, POSE_STAMPED, "/robot_2/pose"),
        ("sbn", "telemetry", 0x82A, TWIST, "/robot_1/cmd_vel"),
        ("sbn", "telemetry", 0x82B, TWIST, "/robot_2/cmd_vel"),
    },
    ("two_arms_ground", "two_arms_flight"): {
        ("ci", "command", 0x1827, POSE, "/big_arm/ground/target"),
        ("ci", "command", 0x1828, POSE, "/little_arm/ground/target"),
        ("to", "telemetry", 0x828, JOINT_STATE, "/big_arm/ground/joint_states"),
        ("to", "telemetry", 0x829, JOINT_STATE, "/little_arm/ground/joint_states"),
        ("sbn", "command", 0x1829, JOINT_STATE, "/big_arm/joint_states_throttled"),
        ("sbn", "command", 0x182A, JOINT_STATE, "/little_arm/joint_states_throttled"),
        ("sbn", "telemetry", 0x82A, POSE, "/big_arm/flight/target_pose"),
        ("sbn", "telemetry", 0x82B, POSE, "/little_arm/flight/target_pose"),
    },
}


@pytest.mark.parametrize("names", DEMOS)
def test_samples_hold_the_routes_of_the_demos(names):
    mission = load(SAMPLES / f"{name}.yaml" for name in names)
    assert table(mission) == DEMOS[names]
    assert len(mission.routes) == len(DEMOS[names])
    assert mission.warnings == ()
    assert list(mission.files) == [f"{name}.yaml" for name in names]
    (ground,) = mission.ground
    assert ground.command_ingest == Endpoint("127.0.0.1", 1234)
    assert (ground.telemetry_ip, ground.bridge_port) == ("127.0.0.1", 1235)
    for flight in mission.flight:
        assert flight.peer == Endpoint("127.0.0.1", 2234)
        assert flight.bridge == Endpoint("127.0.0.1", 2236)
        assert (flight.peer_processor_id, flight.processor_id) == (1, 3)
        assert flight.peer_spacecraft_id == flight.spacecraft_id == 0x42
    assert len(mission.links) == len(names)


def test_every_sample_is_tested():
    assert {path.stem for path in SAMPLES.glob("*.yaml")} == {name for names in DEMOS for name in names}


@pytest.mark.parametrize("names", DEMOS)
def test_a_mission_comes_back_out_of_its_own_files(names):
    mission = load([SAMPLES / f"{name}.yaml" for name in names])
    again = loads(mission.files)
    assert table(again) == table(mission)
    assert again.files == mission.files


def test_nothing_configured_is_a_mission():
    assert Mission() == load([]) == loads({})
    assert Mission().routes == Mission().links == Mission().warnings == ()
    assert dict(Mission().files) == {}


@pytest.mark.parametrize(
    "top",
    [
        "conversion_node",
        "/conversion_node",
        "/**",
        "/*",
        "ground/conversion_node",
        "/ground/conversion_node",
        "'**'",
    ],
)
def test_any_name_of_a_node_will_do(top):
    text = f"{top}:\n  ros__parameters:\n    communication: {COMMUNICATION}\n    a: {CMD_VEL}\n"
    mission = read(text + "    command: [a]\n    telemetry: ['']\n")
    assert mission.find("a").msg_id == 0x1827
    assert mission.find("a").topic == ("/ground/cmd_vel" if "ground" in top else "/cmd_vel")
    assert mission.warnings == ()


def test_namespaces_may_be_nested():
    body = f"communication: {COMMUNICATION}, command: [a], telemetry: [''], a: {CMD_VEL}"
    assert (
        read(f"ns: {{inner: {{node: {{ros__parameters: {{{body}}}}}}}}}").find("a").topic
        == "/ns/inner/cmd_vel"
    )


def test_a_wildcard_is_put_into_the_nodes_it_matches():
    mission = read(
        f"/**:\n  ros__parameters:\n    use_sim_time: yes\n    communication: {COMMUNICATION}\n"
        "camera:\n  ros__parameters: {rate: 30}\n"
        f"/ns/bridge:\n  ros__parameters:\n    {{command: [a], telemetry: [''], a: {CMD_VEL},\n"
        "     communication.fsw_port: 99}\n"
    )
    (link,) = mission.ground
    assert (link.bridge_port, link.fsw_port) == (1235, 99)
    assert mission.find("a").topic == "/ns/cmd_vel"


@pytest.mark.parametrize(
    ("pattern", "matches"),
    [("/ns/*", True), ("/*/bridge", True), ("/**/bridge", True), ("/*", False), ("/x/**", False)],
)
def test_wildcards_match_as_in_ros(pattern, matches):
    text = f"{pattern}: {{ros__parameters: {{communication: {COMMUNICATION}}}}}\n"
    text += f"/ns/bridge: {{ros__parameters: {{command: [a], telemetry: [''], a: {CMD_VEL}}}}}\n"
    if matches:
        assert len(read(text).links) == 1
    else:
        with pytest.raises(ConfigError, match=r"m\.yaml:2: communication: missing"):
            read(text)


def test_dotted_names_are_nested_names():
    mission = read(
        "n:\n  ros__parameters:\n"
        "    communication.bridge_port: 1235\n    communication.fsw_port: 1234\n"
        "    communication.fsw_ip: 127.0.0.1\n    communication.telemetry_ip: 0.0.0.0\n"
        "    command: [a]\n    telemetry: ['']\n"
        "    a.type: geometry_msgs/msg/Twist\n    a.topic: x\n    a.mid: 0x1827\n"
    )
    assert mission.routes == (Route("/x", TWIST, 0x1827, CI, "command", "a", "m.yaml", 9),)


def test_ground_and_flight_may_share_a_file_and_other_nodes_too():
    def body(name):
        lines = (SAMPLES / name).read_text().splitlines(keepends=True)
        return "".join(line for line in lines if not line.startswith("#"))

    text = body("two_rovers_ground.yaml") + body("two_rovers_flight.yaml")
    text += "talker: {ros__parameters: {rate: 5.0}}\n"
    mission = read(text)
    assert table(mission) == DEMOS["two_rovers_ground", "two_rovers_flight"]
    assert [type(link) for link in mission.links] == [GroundLink, FlightLink]
    parts = text.replace("flight_conversion_node:", "---\nflight_conversion_node:")
    assert table(read(parts)) == table(mission)


def test_tabs_between_tokens_are_spaces_as_for_the_bridges():
    text = (SAMPLES / "rover_ground.yaml").read_text()
    tabbed = text.replace("fsw_port: 1234", "fsw_port:\t1234\t").replace("mid: 0x827", "mid: 0x827\t# tlm")
    assert read(tabbed).routes == read(text).routes


@pytest.mark.parametrize("change", [lambda text: text.replace("\n", "\r\n"), lambda text: "\ufeff" + text])
def test_text_as_windows_writes_it(change):
    text = (SAMPLES / "rover_ground.yaml").read_text()
    assert read(change(text)).routes == read(text).routes


@pytest.mark.parametrize(
    ("written", "kept"),
    [
        ("auto", "auto"),
        ("8/8", "8/8 le"),
        ("'8/8'", "8/8 le"),
        ("4/4 be", "4/4 be"),
        ("1/1", "1/1"),
        ("8/8 BE", "8/8 be"),
    ],
)
def test_envelope(written, kept):
    text = (SAMPLES / "rover_ground.yaml").read_text() + f"      envelope: {written}\n"
    mission = read(text)
    assert mission.find("tlm_pose").envelope == kept
    assert mission.find("cmd_twist").envelope is None


def test_a_file_given_twice_counts_once():
    path = SAMPLES / "rover_ground.yaml"
    assert load([path, path]) == load(path)


def test_files_of_one_name_keep_both_contents(tmp_path):
    for folder, name in (("a", "two_rovers_ground"), ("b", "two_rovers_flight")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "bridge.yaml").write_bytes((SAMPLES / f"{name}.yaml").read_bytes())
    mission = load([tmp_path / "a/bridge.yaml", tmp_path / "b/bridge.yaml"])
    assert list(mission.files) == ["bridge.yaml", "bridge_2.yaml"]
    assert table(loads(mission.files)) == table(mission)


def test_two_flight_bridges_may_hear_the_same_topic():
    text = (SAMPLES / "two_rovers_flight.yaml").read_text()
    other = text.replace("udp_receive_port: 2236", "udp_receive_port: 2237").replace(
        "processor_id: 3", "processor_id: 4"
    )
    mission = loads({"a.yaml": text.encode(), "b.yaml": other.encode()})
    assert len(mission.routes) == 4
    assert [link.processor_id for link in mission.flight] == [3, 4]


def test_direction_is_from_the_bridge_and_says_who_hears():
    mission = load([SAMPLES / "two_rovers_ground.yaml", SAMPLES / "two_rovers_flight.yaml"])
    assert {route.topic for route in mission.routes if route.to_cfs} == {
        "/robot_1/ground/cmd_vel",
        "/robot_2/ground/cmd_vel",
        "/robot_1/pose",
        "/robot_2/pose",
    }


@pytest.mark.parametrize("name", ["/robot_1/pose", "robot_1/pose", 0x1829, "0x1829", "6185"])
def test_find(name):
    mission = load([SAMPLES / "two_rovers_ground.yaml", SAMPLES / "two_rovers_flight.yaml"])
    assert mission.find(name).key == "pose_tlm_1"
    assert mission.find(name).link is SBN


def test_find_says_what_there_is():
    mission = load([SAMPLES / "two_rovers_ground.yaml", SAMPLES / "two_rovers_flight.yaml"])
    with pytest.raises(
        RouteError, match=r"^'/nope' is not configured; there are /robot_1/ground/cmd_vel \(0x1827, ci\), "
    ):
        mission.find("/nope")
    with pytest.raises(
        RouteError, match=r"^'pose_tlm_1' names 2 routes: /robot_1/ground/pose \(0x0828, to\), "
    ):
        mission.find("pose_tlm_1")
    with pytest.raises(RouteError, match="no topic is configured; give mission files with -c"):
        Mission().find(0x1827)


def test_types_are_asked_for():
    asked = []
    load(SAMPLES / "rover_ground.yaml", check_type=asked.append)
    assert asked == [TWIST, POSE_STAMPED]


def test_a_mission_goes_to_other_processes():
    """Those that judge parts of a large capture get it, with its files or empty."""
    for mission in (Mission(), load(MISSIONS / "rover_ground.yaml")):
        other = pickle.loads(pickle.dumps(mission))
        assert (other.routes, other.files) == (mission.routes, mission.files)
