"""Measure the bridge: messages a second each way, its own latency, and the whole way through both bridges.

The graph is inside the process of the bridge, so that its own cost is seen and not a middleware's; cFS is a
process of its own that sends and takes datagrams. The whole way is measured so, and by Zenoh from and to
another process. Called by run.py; alone: python benchmarks/bridge.py

By DDS, which binds every interface that there is, in a network of its own:
unshare --map-root-user --net python .ci/with_raw_sockets.py --in-namespace python benchmarks/bridge.py dds
"""

from __future__ import annotations

import json
import select
import socket
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from msgspec.structs import replace
from paths import MISSION, MISSIONS

from edoras_tools.addons.lab.emulator import Served, Simulation, WireDatagram
from edoras_tools.cfs.profile import SimProfile
from edoras_tools.io.net.buffer import make_buffer
from edoras_tools.io.net.sockets import kernel_drops, open_bound, open_socket
from edoras_tools.io.net.transmit import precise_timing
from edoras_tools.middleware import Qos, open_graph
from edoras_tools.model import Endpoint
from edoras_tools.pipelines.bridge.plan import BridgeRequest, plan_bridges
from edoras_tools.pipelines.bridge.run import Bridges
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.ros import TypeStore
from edoras_tools.units import MILLISECOND
from edoras_tools.wire import cfe, envelope

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

HOST, CI, TO = "127.0.0.1", 1234, 1235
CDR = bytes.fromhex("00010000") + bytes(48)
RATES, SECONDS = (1_000, 20_000, 30_000), 5
LOOPBACK = {"interface": "lo", "multicast": "false", "peers": HOST}
AT = 16 + envelope.DEFAULT.size  # behind the telemetry header
STATE = len(TypeStore().encode("geometry_msgs/msg/PoseStamped", {}))
TYPES = {"order": "geometry_msgs/msg/Twist", "state": "geometry_msgs/msg/Twist"}


def pace(rate: int, seconds: float, step: int, send) -> int:
    """Call ``send(count)`` at a rate, some at once; return how many were sent."""
    sent, step_ns = 0, step * 10**9 // rate
    with precise_timing():
        due = time.monotonic_ns() + 10**6
        end = due + int(seconds * 1e9)
        while due < end:
            ahead = due - time.monotonic_ns()
            if ahead > 0:
                time.sleep(ahead / 1e9)
            send(step)
            sent += step
            due += step_ns
    return sent


def cfs(rate: int, seconds: float) -> None:
    """Play cFS: send telemetry at a rate, count commands; print what came of it."""
    buffer, taken = make_buffer(), open_bound(Endpoint(HOST, CI))
    sender = open_socket(socket.AF_INET)
    sender.connect((HOST, TO))
    step = max(rate // 1000, 1)
    packet = cfe.emit_telemetry(0x0827, envelope.DEFAULT.emit(CDR))
    for row in range(256, 256 + step):
        buffer.put(row, packet)
    rows = np.arange(256, 256 + step)
    print("ready", flush=True)
    sys.stdin.readline()
    received = 0

    def send(_count: int) -> None:
        nonlocal received
        buffer.send(sender, rows, None)
        received += max(buffer.receive(taken), 0)

    sent = pace(rate, seconds, step, send)
    while select.select([taken], [], [], 1)[0]:
        received += max(buffer.receive(taken), 0)
    print(json.dumps({"sent": sent, "received": received, "drops": kernel_drops(taken)}))


def mission(folder: Path) -> Path:
    """The rover's mission, with a state of fixed size."""
    text = MISSION.read_text().replace("PoseStamped", "Twist")
    path = folder / "bench.yaml"
    path.write_text(text)
    return path


def both_ways(folder: Path, rate: int) -> dict[str, object]:
    """Messages at a rate each way at once."""
    other = subprocess.Popen(
        [sys.executable, __file__, "cfs", str(rate), str(SECONDS)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    other.stdout.readline()
    request = BridgeRequest(enable=False)
    plan = plan_bridges(Settings((mission(folder),)), request)
    bridges = Bridges(plan, request)
    thread = threading.Thread(target=bridges.run)
    thread.start()
    node = open_graph("local", plan.types, "bench")
    heard: list[bytes] = []
    node.subscribe("/telemetry_pose", TYPES["state"], Qos(), heard.append)
    publish = node.advertise("/cmd_vel", TYPES["order"], Qos())

    def send(count: int) -> None:
        for _ in range(count):
            publish(CDR)

    other.stdin.write("go\n")
    other.stdin.flush()
    published = pace(rate, SECONDS, max(rate // 1000, 1), send)
    report = json.loads(other.communicate()[0])
    bridges.stop()
    thread.join()
    bridges.close()
    node.close()
    summary = bridges.summary()
    ways = summary["bridges"][0]
    return {
        "rate_hz": rate,
        "published": published,
        "reached_cfs": report["received"],
        "sent_by_cfs": report["sent"],
        "heard": len(heard),
        "lost_by_bridge": summary["lost"],
        "to_cfs_us": ways["to_cfs"]["latency_us"],
        "from_cfs_us": ways["from_cfs"]["latency_us"],
    }


def whole_way(ros: str, options: dict[str, str], other: dict[str, str]) -> dict[str, object]:
    """State of a robot, through the flight bridge, the emulated cFS and the ground bridge, back to a process.

    What the emulated cFS takes, its wake-ups, is its own: each message is found where it enters and where it
    leaves, and the time between is taken off (``beside_cfs``).
    """
    fast = MILLISECOND
    profile = replace(SimProfile(), to_wake_ns=fast, ci_wake_ns=fast, sbn_wake_ns=fast)
    simulation = Simulation(profile, "two-rovers", bridges=False)
    inside: dict[bytes, int] = {}
    feed, run = simulation.feed, simulation.run

    def entering(time_ns: int, place: Endpoint, data: bytes) -> None:
        inside.setdefault(data[-STATE:], -time.monotonic_ns())
        feed(time_ns, place, data)

    def leaving(until_ns: int) -> Iterator[WireDatagram]:
        for item in run(until_ns):
            cdr = item.payload[AT : AT + STATE]
            if item.destination.port == TO and inside.get(cdr, 0) < 0:
                inside[cdr] += time.monotonic_ns()
            yield item

    simulation.feed, simulation.run = entering, leaving
    flight_software = ExitStack()
    flight_software.enter_context(Served(simulation))
    bridges = Bridges(plan_bridges(Settings(MISSIONS), BridgeRequest()), ros=ros, options=options)
    thread = threading.Thread(target=bridges.run)
    thread.start()
    if ros == "local":
        found = robot(ros, other)
    else:
        words = [sys.executable, __file__, "robot", ros, json.dumps(other)]
        found = json.loads(subprocess.run(words, stdout=subprocess.PIPE, check=True).stdout)
    bridges.stop()
    thread.join()
    bridges.close()
    flight_software.close()
    took = found.pop("took_ns")
    beside = [total - inside[bytes.fromhex(cdr)] for cdr, total in took.items()]
    return {"ros": ros, **found, "whole_ms": spread(took.values()), "beside_cfs_ms": spread(beside)}


def spread(times_ns: Iterable[int]) -> dict[str, float]:
    """Return median and 99th percentile, ms."""
    p50, p99 = (np.percentile(list(times_ns), (50, 99)) / 1e6).round(2).tolist()
    return {"p50": p50, "p99": p99}


def robot(ros: str, options: dict[str, str], rate: int = 10, seconds: float = 10) -> dict[str, object]:
    """Say where a robot is, and hear it come back; return how long that took."""
    types, kind = TypeStore(), "geometry_msgs/msg/PoseStamped"
    node = open_graph(ros, types, "bench", options=options)
    began: dict[bytes, int] = {}
    took: dict[str, int] = {}

    def heard(cdr: bytes) -> None:
        took[cdr.hex()] = time.monotonic_ns() - began[cdr]

    node.subscribe("/robot_1/ground/pose", kind, Qos(), heard)
    publish = node.advertise("/robot_1/pose", kind, Qos())

    def send(_count: int) -> None:
        cdr = types.encode(kind, {"pose": {"position": {"x": float(len(began))}}})
        began[cdr] = time.monotonic_ns()
        publish(cdr)

    deadline = time.monotonic() + 30
    while not took and time.monotonic() < deadline:  # until all have found each other
        send(1)
        time.sleep(0.1)
    time.sleep(1)
    before = len(began)
    took.clear()
    pace(rate, seconds, 1, send)
    time.sleep(1)
    node.close()
    return {"sent": len(began) - before, "byte_equal": len(took), "took_ns": took}


def measure(folder: Path) -> dict[str, object]:
    """Run all."""
    with socket.create_server((HOST, 0)) as free:
        place = f"tcp/{HOST}:{free.getsockname()[1]}"
    return {
        "both_ways": [both_ways(folder, rate) for rate in RATES],
        "whole_way": [
            whole_way("local", {}, {}),
            whole_way("zenoh", {"router": place}, {"listen": place, "router": ""}),
        ],
    }


if __name__ == "__main__":
    if sys.argv[1:2] == ["cfs"]:
        cfs(int(sys.argv[2]), float(sys.argv[3]))
    elif sys.argv[1:2] == ["robot"]:
        print(json.dumps(robot(sys.argv[2], json.loads(sys.argv[3]))))
    elif sys.argv[1:2] == ["dds"]:
        print(json.dumps(whole_way("dds", LOOPBACK, LOOPBACK), indent=2))
    else:
        with tempfile.TemporaryDirectory() as name:
            print(json.dumps(measure(Path(name)), indent=2))
