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


def test_a_mission_of_another_system_is_said(call, tmp_path):
    path, mission = tmp_path / "rover.yaml", ROOT / "samples/missions/rover_ground.yaml"
    path.write_text(mission.read_text(encoding="utf-8").replace("PoseStamped", "Twist"))
    capture = ROOT / "samples/captures/a_rover.pcap"
    (line,) = call("info", capture, "-c", path).err
    assert line.startswith(
        "edoras: 0 of 63 messages of /telemetry_pose fit geometry_msgs/msg/Twist: a mission"
    )
    assert call("info", capture, "-c", mission).err == []
