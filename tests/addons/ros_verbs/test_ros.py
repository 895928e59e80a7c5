"""Against real nodes of ROS 2, which ``make ros`` installs: each figure beside theirs in the same run."""

import json
import os
import signal
import site
import socket
import statistics
import subprocess
import sys
import time

import pytest
from mcap.writer import Writer
from places import ROOT, SAMPLES, SUPPORT
from waiting import PATIENCE_S

from edoras_tools.ros import TypeStore

HOME, MISSION = ROOT / ".ros", SAMPLES / "missions/rover_ground.yaml"
STAMPED = "geometry_msgs/msg/TwistStamped"
pytestmark = [
    pytest.mark.own_network,
    pytest.mark.long,
    pytest.mark.skipif(not (HOME / "kilted/.installed").exists(), reason="ROS 2 is not installed: make ros"),
]
BOTH = [(ros, distro) for ros in ("rclpy", "dds") for distro in ("jazzy", "kilted")]


class Run:
    """Programs of one test: nodes, and commands of ours by either middleware; all are ended."""

    def __init__(self, ros, distro):
        self.ros, self._python, self._programs = ros, HOME / distro / "bin/python", []
        self._environ = os.environ | {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": "39"}
        self._ours = {"PYTHONPATH": os.pathsep.join([str(ROOT), *site.getsitepackages()])}

    def start(self, words, **more):
        pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
        words = [str(word) for word in words]
        self._programs.append(subprocess.Popen(words, env=self._environ | more, text=True, **pipes))
        return self._programs[-1]

    def node(self, program, *words, told=True):
        node = self.start([self._python, SUPPORT / f"{program}.py", *words], **self._ours)
        return node if not told or json.loads(node.stdout.readline()) else None

    def edoras(self, *words):
        own = self.ros == "rclpy"
        python = self._python if own else sys.executable
        return self.start([python, "-m", "edoras_tools", *words, "--ros", self.ros, "--json"], **self._ours)

    def end(self):
        for item in self._programs:
            if item.poll() is None:
                item.kill()
                item.communicate()


@pytest.fixture
def run(request):
    run = Run(*request.param)
    yield run
    run.end()


def result(process, code=0):
    """End a program; return what it says last."""
    out, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == code, err
    return json.loads(out)


@pytest.mark.parametrize("run", BOTH, indirect=True, ids="-".join)
def test_figures_are_those_of_nodes_within_one_percent(run):
    heard = run.node("ros_counts", "hear", "/twist", 100, 0)
    talker = run.node("ros_counts", "talk", "/twist", "TwistStamped", 300, 50, 100, 5, told=False)
    verbs = {verb: run.edoras(verb, "/twist", "-w", 1000, "--duration", 20) for verb in ("hz", "bw", "delay")}
    watched = run.edoras("observe", "/twist", "--duration", 20)
    assert json.loads(talker.stdout.readline()) == {"matched": True}
    assert len(json.loads(talker.stdout.readline())["published"]) == 300
    found = {verb: result(process)["topics"][0] for verb, process in verbs.items()}
    (topic,) = result(watched)["topics"]
    counted = result(heard)
    times, sizes = counted["times"], counted["sizes"]
    span_s = (times[-1] - times[0]) / 1e9
    near = {"rel": 0.01}
    assert found["hz"]["rate_hz"] == pytest.approx((len(times) - 1) / span_s, **near)
    assert found["bw"]["bytes_per_s"] == pytest.approx(sum(sizes[1:]) / span_s, **near)
    assert found["delay"]["min_s"] == pytest.approx(min(counted["ages"]) / 1e9, **near)
    assert found["delay"]["mean_s"] == pytest.approx(statistics.mean(counted["ages"]) / 1e9, **near)
    assert [item["messages"] for item in found.values()] == [len(times)] * 3 == [300] * 3
    (publisher,) = topic["publishers"]
    assert (publisher["node"], publisher["received"], topic["lost"]) == ("/talker", 300, 0)
    numbers = publisher["first_sequence"], publisher["last_sequence"], publisher["missed"]
    assert numbers == ((1, 300, 0) if run.ros == "rclpy" else (None, None, None))
    assert "/listener" in {item["node"] for item in topic["subscriptions"]}


@pytest.mark.parametrize("stops", [False, True], ids=["slow", "stopped"])
@pytest.mark.parametrize("run", BOTH, indirect=True, ids="-".join)
def test_what_a_slow_bridge_loses_is_found_at_its_hop(run, tmp_path, stops):
    """Publisher and bridge share memory; the bridge keeps one message. No wire shows what it lacks."""
    sink = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sink.bind(("127.0.0.1", 1234))
    wire, seen = tmp_path / "wire.mcap", tmp_path / "seen.mcap"
    ours = [sys.executable, "-m", "edoras_tools"]
    recorder = run.start([*ours, "record", "-i", "lo", "-o", wire, "-c", MISSION])
    assert recorder.stderr.readline().startswith("capturing")
    bridge = run.node("ros_slow_bridge", "/cmd_vel", 1, 0 if stops else 0.02, 1234)
    observer = run.edoras("observe", "/cmd_vel", "-o", seen)
    talker = run.node("ros_counts", "talk", "/cmd_vel", "Twist", 400, 200, 10, 2)
    if stops:
        time.sleep(1)
        bridge.send_signal(signal.SIGSTOP)
        time.sleep(1)
        bridge.send_signal(signal.SIGCONT)
    assert json.loads(talker.stdout.readline())
    time.sleep(2)
    passed_on = result(bridge)
    for program in (observer, recorder):
        program.send_signal(signal.SIGINT)
        program.communicate(timeout=PATIENCE_S)
    sink.close()
    numbers = passed_on["passed_on"]
    lost = numbers[-1] - numbers[0] + 1 - len(numbers)
    assert lost > 0
    assert passed_on["event"] <= lost  # rclpy's event does not count what its own history overwrote
    done = run.start([*ours, "doctor", wire, "-c", MISSION, "--bag", seen, "--json"])
    (way,) = result(done, 3)["chains"]
    hop = way["hops"][0]
    assert (hop["hop"], hop["lost"], hop["out"]) == ("publisher to ground bridge", lost, len(numbers))


@pytest.mark.parametrize("run", BOTH, indirect=True, ids="-".join)
def test_a_recording_is_heard_whole_and_the_clock_is_as_near_as_a_plain_one(run, tmp_path):
    path, types, start = tmp_path / "run.mcap", TypeStore(), 1_790_000_000 * 10**9
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        schema = writer.register_schema(STAMPED, "ros2msg", types.definition(STAMPED).encode())
        channel = writer.register_channel("/twist", "cdr", schema)
        for number in range(500):
            cdr = types.encode(STAMPED, {"twist": {"linear": {"x": number / 8}}})
            writer.add_message(channel, start + number * 10_000_000, cdr, start)
        writer.finish()
    heard = run.node("ros_clock", "hear", "/twist", "/clock", "/plain")
    plain = run.node("ros_clock", "tick", "/plain", 40)
    told = result(run.edoras("play", path, "--clock", "--delay", 60))
    result(plain)
    found = result(heard)
    assert told["sent"] == told["total"] == 500 + 200
    assert found["heard"] == [number / 8 for number in range(500)]
    late = {name: sorted(came - says for came, says in rows) for name, rows in found["clocks"].items()}
    assert len(late["/clock"]) == 200
    median = {name: rows[len(rows) // 2] - rows[0] for name, rows in late.items()}
    assert median["/clock"] <= median["/plain"] + 2_000_000
