"""``edoras info`` of recordings of other tools."""

import pytest
from places import ROOT
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

BEGIN = 1_790_000_000_000_000_000


@pytest.fixture
def bag(tmp_path):
    """100 Twist at 10 Hz."""
    path = tmp_path / "bag"
    with Writer(path, version=9) as writer:
        store = get_typestore(Stores.ROS2_JAZZY)
        topic = writer.add_connection("/cmd_vel", "geometry_msgs/msg/Twist", typestore=store)
        for number in range(100):
            writer.write(topic, BEGIN + number * 10**8, bytes([0, 1, 0, 0]) + bytes(48))
    return path


def test_topics_are_shown(bag, call):
    done = call("info", bag, "--json")
    assert (done.code, done.json()["kind"], done.json()["messages"]) == (0, "topics", 100)
    seen = call("info", bag).out
    assert all(text in seen for text in ("100 messages", "/cmd_vel", "geometry_msgs/msg/Twist", "10.0 Hz"))
    assert not any(word in seen for word in ("MsgId", "Gaps", "drops"))
    assert (
        call("info", bag, "--start", "1", "--end", "3", "--topic", "cmd_*", "--json").json()["messages"] == 20
    )


@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        (["--link", "ci"], 2, "use --topic, --where, --start and --end"),
        (["--msg-id", "0x827"], 2, "use --topic, --where, --start and --end"),
        (["--where", "msg_id == 3"], 2, "'msg_id' is of datagrams, and the recording has only messages"),
        (["--start", "4000"], 1, "its times go from 0 to 9.900 s"),
        ([ROOT / "samples/captures/a_rover.pcap"], 2, "read them separately"),
    ],
)
def test_what_topics_do_not_have(words, code, told, bag, call):
    done = call("info", bag, *words)
    assert (done.code, done.out) == (code, "")
    assert any(told in line for line in done.err)


@pytest.mark.parametrize(
    ("capture", "mission", "lines"),
    [
        (
            "a_rover",
            "single_arm_ground",
            [
                (
                    "0 of 63 messages of /telemetry_joint_state fit sensor_msgs/msg/JointState; they fit "
                    "geometry_msgs/msg/PoseStamped (of rover_ground.yaml?) and 3 other types: "
                ),
                (
                    "0 of 600 messages of /command_pose fit geometry_msgs/msg/Pose; they fit "
                    "geometry_msgs/msg/Twist (of rover_ground.yaml?) and 3 other types: "
                ),
            ],
        ),
        (
            "b_arm_single",
            "rover_ground",
            [
                (
                    "0 of 63 messages of /telemetry_pose fit geometry_msgs/msg/PoseStamped; they fit "
                    "sensor_msgs/msg/JointState (of single_arm_ground.yaml?): "
                ),
                (
                    "0 of 120 messages of /cmd_vel fit geometry_msgs/msg/Twist; they fit "
                    "geometry_msgs/msg/Pose (of single_arm_ground.yaml?) and 1 other type: "
                ),
            ],
        ),
        ("a_rover", "rover_ground", []),
    ],
)
def test_a_mission_of_another_system_is_said(capture, mission, lines, call, tmp_path):
    words = ROOT / f"samples/captures/{capture}.pcap", "-c", ROOT / f"samples/missions/{mission}.yaml"
    for done in (call("info", *words), call("record", *words, "-o", tmp_path / "out.mcap")):
        said = [line.removeprefix("edoras: ") for line in done.err if ": 0 of " in line]
        assert sorted(
            line[: len(start)] for line, start in zip(sorted(said), sorted(lines), strict=True)
        ) == (sorted(lines))
    told = call("info", tmp_path / "out.mcap").err  # counted by the recorder, so no message is read again
    assert ["mission draft makes one" in line for line in told] == [True] * len(lines)
