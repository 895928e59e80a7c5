"""Measure the bridge: messages a second each way, its own latency, and the whole way through both bridges.

The graph is inside the process of the bridge, so that its own cost is seen and not a middleware's; cFS is a
process of its own that sends and takes datagrams. Called by run.py; alone: python benchmarks/bridge.py
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
from dataclasses import replace
from pathlib import Path

import numpy as np

from edoras_tools.middleware import Qos
from edoras_tools.middleware.local import open_graph
from edoras_tools.model import Endpoint
from edoras_tools.pipelines.bridge import Bridges
from edoras_tools.pipelines.bridge_plan import Wishes, plan_bridges
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.sessions.profile import MILLISECOND, SimProfile
from edoras_tools.sim import Simulation, serve
from edoras_tools.sinks.wire import precise_timing
from edoras_tools.sources.relay import make_arena, open_port, open_socket, stage
from edoras_tools.sources.udp import kernel_drops
from edoras_tools.wire import cfe, envelope

ROOT = Path(__file__).parents[1]
MISSIONS = ROOT / "samples/missions"
HOST, CI, TO = "127.0.0.1", 1234, 1235
CDR = bytes.fromhex("00010000") + bytes(48)
RATES, SECONDS = (1_000, 20_000, 30_000), 5
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
    arena, taken = make_arena(), open_port(Endpoint(HOST, CI))
    sender = open_socket(socket.AF_INET)
    sender.connect((HOST, TO))
    step = max(rate // 1000, 1)
    packet = cfe.emit_telemetry(0x0827, envelope.DEFAULT.emit(CDR))
    for row in range(256, 256 + step):
        stage(arena, row, packet)
    rows = np.arange(256, 256 + step)
    print("ready", flush=True)
    sys.stdin.readline()
    received = 0

    def send(_count: int) -> None:
        nonlocal received
        arena.send(sender, rows, None)
        received += max(arena.receive(taken), 0)

    sent = pace(rate, seconds, step, send)
    while select.select([taken], [], [], 1)[0]:
        received += max(arena.receive(taken), 0)
    print(json.dumps({"sent": sent, "received": received, "drops": kernel_drops(taken)}))


def mission(folder: Path) -> Path:
    """The rover's mission, with a state of fixed size."""
    text = (MISSIONS / "rover_ground.yaml").read_text().replace("PoseStamped", "Twist")
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
    wishes = Wishes(enable=False)
    plan = plan_bridges(Settings((mission(folder),)), wishes)
    bridges = Bridges(plan, wishes)
    thread = threading.Thread(target=bridges.run)
    thread.start()
    node = open_graph(plan.types, "bench")
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


def whole_way(rate: int = 10, seconds: float = 10) -> dict[str, object]:
    """State of a robot, through the flight bridge, the emulated cFS and the ground bridge.

    cFS wakes up each ms instead of each 500: what its wake-ups cost is its own, and left out this way.
    """
    fast = MILLISECOND
    profile = replace(SimProfile(), to_wake_ns=fast, ci_wake_ns=fast, sbn_wake_ns=fast)
    simulation = Simulation(profile, "two-rovers", bridges=False)
    stop, ready = threading.Event(), threading.Event()
    flight_software = threading.Thread(target=serve, args=(simulation, HOST, None, stop, ready.set))
    flight_software.start()
    ready.wait()
    plan = plan_bridges(
        Settings(tuple(MISSIONS / f"two_rovers_{side}.yaml" for side in ("ground", "flight"))), Wishes()
    )
    bridges = Bridges(plan)
    thread = threading.Thread(target=bridges.run)
    thread.start()
    node = open_graph(plan.types, "bench")
    began: dict[bytes, int] = {}
    took: list[int] = []
    kind = "geometry_msgs/msg/PoseStamped"
    node.subscribe(
        "/robot_1/ground/pose", kind, Qos(), lambda cdr: took.append(time.monotonic_ns() - began[cdr])
    )
    publish = node.advertise("/robot_1/pose", kind, Qos())
    time.sleep(2)
    count = 0

    def send(_count: int) -> None:
        nonlocal count
        count += 1
        cdr = plan.types.encode(kind, {"pose": {"position": {"x": float(count)}}})
        began[cdr] = time.monotonic_ns()
        publish(cdr)

    pace(rate, seconds, 1, send)
    time.sleep(1)
    bridges.stop()
    thread.join()
    bridges.close()
    node.close()
    stop.set()
    flight_software.join()
    p50, p99 = (np.percentile(took, (50, 99)) / 1e6).round(2).tolist()
    return {"sent": count, "came_back_byte_equal": len(took), "p50_ms": p50, "p99_ms": p99}


def measure(folder: Path) -> dict[str, object]:
    """Run all."""
    return {"both_ways": [both_ways(folder, rate) for rate in RATES], "whole_way": whole_way()}


if __name__ == "__main__":
    if sys.argv[1:2] == ["cfs"]:
        cfs(int(sys.argv[2]), float(sys.argv[3]))
    else:
        with tempfile.TemporaryDirectory() as name:
            print(json.dumps(measure(Path(name)), indent=2))
