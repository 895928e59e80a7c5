"""A demo on DDS, in a network of its own: another program drives a rover and hears where it is."""

import json
import os
import subprocess
import sys
import threading

import pytest
from dds_loopback import OPTIONS, URI
from places import SUPPORT
from waiting import PATIENCE_S

from edoras_tools.addons.lab.demo.run import Demo, DemoPlan
from edoras_tools.ros import TypeStore

pytestmark = pytest.mark.own_network

PEER = SUPPORT / "dds_peer.py"
ZERO = {"x": 0.0, "y": 0.0, "z": 0.0}
DRIVE = {"linear": ZERO | {"x": 0.75}, "angular": ZERO | {"z": 0.125}}


@pytest.fixture
def peer():
    """Ask the other program something; give the list of what it tells."""
    process = subprocess.Popen(
        [sys.executable, PEER],
        env=os.environ | {"CYCLONEDDS_URI": URI},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    told = []
    reader = threading.Thread(target=lambda: told.extend(map(json.loads, process.stdout)))
    reader.start()

    def ask(**line):
        process.stdin.write(json.dumps(line) + "\n")
        process.stdin.flush()

    yield ask, told
    process.stdin.close()
    process.wait(PATIENCE_S)
    reader.join(PATIENCE_S)
    process.stdout.close()


def test_a_dds_node_of_another_process_drives_a_rover_and_hears_where_it_is(peer, until, tmp_path):
    ask, told = peer

    def heard(topic):
        return [line for line in list(told) if line.get("heard") == topic]

    def same(*topics):
        first, second = ({item["cdr"] for item in heard(topic)} for topic in topics)
        return first & second

    plan = DemoPlan(
        *("two-rovers", tmp_path / "a.mcap"), ros="dds", options=OPTIONS, command_hz=0, state_hz=50.0
    )
    with Demo(plan) as demo:
        thread = threading.Thread(target=demo.run)
        thread.start()
        try:
            for topic, kind in (
                ("rt/robot_1/ground/pose", "PoseStamped"),
                ("rt/robot_1/pose", "PoseStamped"),
                ("rt/robot_1/cmd_vel", "Twist"),
            ):
                ask(hear=topic, type=kind)
            ask(speak="rt/robot_1/ground/cmd_vel", type="Twist")

            def driven():
                ask(say="rt/robot_1/ground/cmd_vel", values=DRIVE)
                poses = heard("rt/robot_1/ground/pose")
                return poses and poses[-1]["values"]["pose"]["position"]["x"] > 0.1

            until(driven)
            until(lambda: heard("rt/robot_1/cmd_vel"))
            until(lambda: demo.station.others[0] > 0 and demo.station.seen[0].way > 0.05)
            until(lambda: same("rt/robot_1/ground/pose", "rt/robot_1/pose"))
        finally:
            demo.stop()
            thread.join(PATIENCE_S)
    drive = TypeStore().encode("geometry_msgs/msg/Twist", DRIVE)
    assert {bytes.fromhex(item["cdr"]) for item in heard("rt/robot_1/cmd_vel")} == {drive}
    robots = demo.summary()["robots"]
    assert (robots[0]["commands"]["said"], robots[0]["commands"]["others_said"] > 0) == (0, True)
    assert robots[0]["states"]["of_others"] == 0
    assert robots[1]["way"] == 0.0
