"""Both bridges as a user starts them, beside the emulated cFS: a program of neither speaks, moves, and hears.

The mission files are the samples, with the ports that they name: nobody else has those in an own network.
"""

import json
import os
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import pytest
from dds_loopback import URI
from mcap.reader import make_reader
from places import MISSIONS, SUPPORT
from waiting import Program

from edoras_tools.ros import TypeStore
from edoras_tools.ros.type_hash import type_hash

pytestmark = pytest.mark.own_network

EDORAS = Path(sys.executable).with_name("edoras")
TWIST, POSE = "geometry_msgs/msg/Twist", "geometry_msgs/msg/PoseStamped"
TYPES = TypeStore()
PORT = 7447
RATE, SECONDS, MOST = 250, 1, 30


class Peer(Program):
    """A program on the graph that knows nothing of this package."""

    def ask(self, **order):
        self.process.stdin.write(json.dumps(order) + "\n")
        self.process.stdin.flush()

    def told(self, name, value):
        return [line for line in map(json.loads, list(self.out.lines)) if line.get(name) == value]


class ZenohPeer(Peer):
    ros = "zenoh"
    options = (f"router=tcp/127.0.0.1:{PORT}", "listen=tcp/127.0.0.1:0")

    def __init__(self):
        super().__init__(sys.executable, SUPPORT / "zenoh_judge.py", PORT, stdin=-1)

    def join(self, speaks, hears):
        pass

    def say(self, topic, kind, values):
        self.ask(
            do="put", key=_key(topic, kind), cdr=TYPES.encode(kind, values).hex(), attachment=bytes(33).hex()
        )

    def heard(self, topic, kind):
        return [bytes.fromhex(line["cdr"]) for line in self.told("key", _key(topic, kind))]


class DdsPeer(Peer):
    ros = "dds"
    options = ("interface=lo", "multicast=false", "peers=127.0.0.1")

    def __init__(self):
        peer = SUPPORT / "dds_peer.py"
        super().__init__(sys.executable, peer, stdin=-1, env=os.environ | {"CYCLONEDDS_URI": URI})

    def join(self, speaks, hears):
        for word, topics in (("speak", speaks), ("hear", hears)):
            for topic, kind in topics.items():
                self.ask(**{word: f"rt{topic}"}, type=kind.rpartition("/")[2])

    def say(self, topic, kind, values):
        self.ask(say=f"rt{topic}", values=TYPES.decode(kind, TYPES.encode(kind, values)))

    def heard(self, topic, kind):
        return [bytes.fromhex(line["cdr"]) for line in self.told("heard", f"rt{topic}")]


def _key(topic, kind):
    package, _, name = kind.split("/")
    return f"0{topic}/{package}::msg::dds_::{name}_/{type_hash(TYPES, kind)}"


@pytest.mark.long
@pytest.mark.parametrize("way", [ZenohPeer, DdsPeer])
def test_an_order_moves_the_robot_and_its_pose_comes_back_byte_for_byte(way, tmp_path):
    recording = tmp_path / "a.mcap"
    words = [word for side in ("ground", "flight") for word in ("-c", MISSIONS / f"two_rovers_{side}.yaml")]
    words += [word for item in way.options for word in ("--ros-option", item)]
    words += ["--max-rate", f"/robot_2/pose={MOST}", "-o", recording, "--json"]
    with ExitStack() as stack:
        cfs = stack.enter_context(Program(EDORAS, "sim", "two-rovers", "--no-bridges"))
        peer = stack.enter_context(way())
        bridges = stack.enter_context(Program(EDORAS, "bridge", "--ros", way.ros, *words))
        peer.join(
            {"/robot_1/ground/cmd_vel": TWIST, "/robot_1/pose": POSE, "/robot_2/pose": POSE},
            {"/robot_1/cmd_vel": TWIST, "/robot_1/ground/pose": POSE, "/robot_2/ground/pose": POSE},
        )
        # An operator says how fast; the robot, who hears it, says where it is; the operator hears that.
        order = {"linear": {"x": 0.25, "y": -1.5}, "angular": {"z": 3.25}}
        moved = {"header": {"frame_id": "map"}, "pose": {"position": {"x": 0.25, "y": -1.5}}}
        carried = _until_heard(peer, bridges, ("/robot_1/ground/cmd_vel", "/robot_1/cmd_vel"), TWIST, order)
        back = _until_heard(peer, bridges, ("/robot_1/pose", "/robot_1/ground/pose"), POSE, moved)
        assert {*carried} == {TYPES.encode(TWIST, order)}
        assert {*back} == {TYPES.encode(POSE, moved)}

        began, said = time.monotonic(), len(cfs.out.lines)
        for number in range(RATE * SECONDS):
            peer.say("/robot_2/pose", POSE, {"pose": {"position": {"x": float(number)}}})
            time.sleep(1 / RATE)
        last = {"pose": {"position": {"x": -1.0}}}
        _until_heard(peer, bridges, ("/robot_2/pose", "/robot_2/ground/pose"), POSE, last)
        events = cfs.out.lines[said:]
        report = json.loads(bridges.end()[0])
        took = time.monotonic() - began
    rows = {row["topic"]: row for item in report["bridges"] for row in item["routes"]}
    state = rows["/robot_2/pose"]
    assert state["in"] == state["out"] + state["held"] + state["waiting"]
    assert state["out"] <= MOST * took + 1
    assert [line for line in events if "SBN" in line] == []
    assert report["lost"] == 0
    with recording.open("rb") as file:  # what crossed between the bridges and cFS
        crossed = {}
        for _, channel, message in make_reader(file).iter_messages():
            crossed.setdefault(channel.topic, set()).add(message.data)
    assert crossed["/robot_1/ground/cmd_vel"] == crossed["/robot_1/cmd_vel"] == {*carried}
    assert crossed["/robot_1/ground/pose"] == crossed["/robot_1/pose"] == {*back}


def _until_heard(peer, bridges, topics, kind, values):
    """Say something on one topic, at cFS's pace, until it comes out on another; return all that did."""
    wanted, said = TYPES.encode(kind, values), 0.0

    def heard():
        nonlocal said
        if time.monotonic() - said > 0.1:
            said = time.monotonic()
            peer.say(topics[0], kind, values)
        return wanted in (found := peer.heard(topics[1], kind)) and found

    return bridges.until(heard, f"{topics[0]} came out at {topics[1]}")
