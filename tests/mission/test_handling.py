"""The keys that are ours: below a topic, and below ``edoras`` for all topics of a bridge."""

# ruff: noqa: E501  one case a line, the message whole

from __future__ import annotations

import pytest

from edoras_tools.errors import ConfigError
from edoras_tools.mission import Handling, loads

FILE = """\
bridge:
  ros__parameters:
    communication: {peer_ip: "127.0.0.1", peer_port: 2234, peer_processor_id: 1, peer_spacecraft_id: 0x42,
      udp_receive_port: 2236, udp_receive_ip: "0.0.0.0", processor_id: 3, spacecraft_id: 0x42}
    command: ['pose', 'joints']
    telemetry: ['drive']
    edoras: {max_rate: 50, keep: first, max_rate_total: 80.5, max_size: 4096, qos: {depth: 1}}
    pose:
      type: "geometry_msgs/msg/PoseStamped"
      topic: "pose"
      mid: 0x1829
      max_rate: 30
      keep: latest
      qos: {reliability: best_effort, durability: transient_local, depth: 5}
    joints: {type: "sensor_msgs/msg/JointState", topic: "joints", mid: 0x182A}
    drive: {type: "geometry_msgs/msg/Twist", topic: "drive", mid: 0x82A, to_limit: 255}
"""


def test_a_topic_s_own_keys_come_before_its_bridge_s():
    mission = loads({"m.yaml": FILE.encode()})
    assert mission.warnings == ()
    (bridge,) = mission.bridges
    assert (bridge.name, bridge.link, bridge.routes) == ("/bridge", mission.links[0], mission.routes)
    assert (bridge.max_rate_total, bridge.max_size) == (80.5, 4096)
    pose, joints, drive = (route.handling for route in bridge.routes)
    assert pose == Handling(30.0, "latest", reliable=False, transient_local=True, depth=5)
    assert joints == Handling(50.0, "first", depth=1)
    # What comes from cFS is held back only where the topic itself asks for it.
    assert drive == Handling(None, "first", depth=1, to_limit=255)


def test_a_file_that_says_nothing_of_it():
    plain = FILE.replace(
        "    edoras: {max_rate: 50, keep: first, max_rate_total: 80.5, max_size: 4096, qos: {depth: 1}}\n", ""
    )
    (bridge,) = loads({"m.yaml": plain.encode()}).bridges
    assert bridge.routes[1].handling == Handling()
    assert (bridge.max_rate_total, bridge.max_size) == (None, None)


def test_each_bridge_has_its_own_routes_though_two_name_the_same():
    other = FILE.replace("bridge:", "bridge_2:").replace("2236", "2237")
    first, second = loads({"a.yaml": FILE.encode(), "b.yaml": other.encode()}).bridges
    assert [route.topic for route in first.routes] == [route.topic for route in second.routes]
    assert first.link.udp_receive_port != second.link.udp_receive_port


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("max_rate: 30", "max_rate: 0", "pose.max_rate: 0 is an integer; a rate in messages a second is needed, as 30 or 0.5"),
        ("max_rate: 30", "max_rate: fast", 'pose.max_rate: "fast" is a string; a rate in messages a second is needed, as 30 or 0.5'),
        ("max_rate: 30", "max_rate: .inf", "pose.max_rate: .inf is the float inf; a rate in messages a second is needed, as 30 or 0.5"),
        ("max_rate: 50", "max_rate: yes", "edoras.max_rate: yes is the boolean true; a rate in messages a second is needed, as 30 or 0.5"),
        ("keep: latest", "keep: lates", 'pose.keep: "lates" is not known; did you mean latest? latest or first is needed'),
        ("reliability: best_effort", "reliability: best", 'pose.qos.reliability: "best" is not known; reliable or best_effort is needed'),
        ("depth: 5", "depth: 0", "pose.qos.depth: 0 is out of range; an integer from 1 to 1048576 is needed"),
        ("to_limit: 255", "to_limit: 256", "drive.to_limit: 256 is out of range; an integer from 1 to 255 is needed"),
        ("max_size: 4096", "max_size: -1", "edoras.max_size: -1 is out of range; an integer from 1 to 65507 is needed"),
    ],
)  # fmt: skip
def test_mistakes(old, new, told):
    with pytest.raises(ConfigError) as caught:
        loads({"m.yaml": FILE.replace(old, new, 1).encode()})
    assert [line.partition(": ")[2] for line in caught.value.mistakes] == [told]


def test_keys_that_nobody_reads_are_told():
    text = FILE.replace("depth: 5", "dept: 5").replace("max_size", "max_sise")
    assert [line.partition(": ")[2] for line in loads({"m.yaml": text.encode()}).warnings] == [
        "edoras.max_sise: ignored; did you mean max_size? read are max_rate, keep, max_rate_total, max_size",
        "pose.qos.dept: ignored; did you mean depth? read are reliability, durability, depth",
    ]
