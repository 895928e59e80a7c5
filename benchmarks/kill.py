"""Kill recorders with SIGKILL under load, at random moments; tell how much of the traffic before is lost.

What is lost is the time from the last datagram in the file, made whole by ``edoras recover``, to the kill.

Run: python kill.py [--kills 104] [--rate 2000] [--seconds 900]
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from paths import EDORAS, HERE, MISSION, ROVER

BYTES = 200
LONGEST_S = 5.0


class Way(NamedTuple):
    """A command that records.

    Attributes:
        words: the command; ``PORT``, ``OTHER`` and ``MISSION`` are put in.
        says: what it says on standard error once it takes datagrams; empty: it sends them itself, to OTHER.
    """

    words: str
    says: str


WAYS = {
    "record -i": Way("record -i lo --port ci:PORT", "capturing"),
    "record --listen": Way("record --listen 127.0.0.1:PORT", "capturing"),
    "record --split-time 1s": Way("record -i lo --port ci:PORT --split-time 1s", "capturing"),
    "proxy": Way("proxy ci --listen 127.0.0.1:PORT --target 127.0.0.1:OTHER", "relaying"),
    "bridge": Way("bridge ground --ros local --no-enable -c MISSION", "bridging"),
    "live": Way("live -i lo --ws-port 0 --port ci:PORT", "in Foxglove"),
    "replay": Way(f"replay {ROVER} --to ci --target 127.0.0.1:OTHER --no-listen --rate 2000 --loop 0", ""),
    "inject": Way("inject /cmd_vel {} -c MISSION --target 127.0.0.1:OTHER --no-listen --hz 2000", ""),
}


class Kill(NamedTuple):
    """What one kill cost.

    Attributes:
        after_s: how long there was traffic.
        lost_s: from the last datagram that is kept to the kill.
        kept: datagrams kept.
        problem: what else is wrong; empty if nothing is.
    """

    after_s: float
    lost_s: float
    kept: int
    problem: str = ""


def free_port() -> int:
    """Return a UDP port that nobody has."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        port: int = one.getsockname()[1]
        return port


def kill(way: Way, rate: int, seed: int) -> Kill:
    """Start a recorder and its traffic, kill it at a random moment, and look at what is left."""
    chosen = random.Random(seed)
    with (
        tempfile.TemporaryDirectory() as name,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as target_socket,
    ):
        folder = Path(name)
        target_socket.bind(("127.0.0.1", 0))
        target_socket.settimeout(30)
        port, other = free_port(), target_socket.getsockname()[1]
        mission = folder / "ground.yaml"
        mission.write_text(MISSION.read_text().replace("bridge_port: 1235", f"bridge_port: {port}"))
        put = {"PORT": str(port), "OTHER": str(other), "MISSION": str(mission)}
        words = way.words
        for mark, value in put.items():
            words = words.replace(mark, value)
        target = folder / "x.mcap"
        process = subprocess.Popen(
            [EDORAS, *words.split(), "-o", str(target)], stderr=subprocess.PIPE, text=True
        )
        assert process.stderr is not None
        if not (any(way.says in line for line in process.stderr) if way.says else target_socket.recv(1)):
            return Kill(0, 0, 0, f"{words} did not start")
        threading.Thread(target=process.stderr.read, daemon=True).start()
        sender = subprocess.Popen(
            [sys.executable, str(HERE / "sender.py"), str(port), str(rate), str(BYTES), "60"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert sender.stderr is not None
        sender.stderr.readline()
        ran = chosen.uniform(1.0, LONGEST_S)
        time.sleep(ran)
        killed_ns = time.time_ns()
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        sender.kill()
        sender.stderr.close()
        sender.wait()
        return _left(folder, killed_ns, ran, (port, other))


def _left(folder: Path, killed_ns: int, ran: float, ports: tuple[int, int]) -> Kill:
    """Make what is left whole, and compare its last datagram with the kill."""
    files = sorted(folder.glob("x*.mcap"), key=lambda path: path.stat().st_ctime_ns)
    end_ns, kept, problem = 0, 0, ""
    for path in files:
        whole = path
        if path == files[-1]:
            whole = folder / "whole.mcap"
            subprocess.run([EDORAS, "recover", str(path), "-o", str(whole)], capture_output=True, check=False)
        told = subprocess.run(
            [EDORAS, "info", "--json", *(f"--port=ci:{port}" for port in ports), str(whole)],
            capture_output=True,
            text=True,
            check=False,
        )
        if not told.stdout:
            problem = "" if path == files[-1] and len(files) > 1 else told.stderr.strip()
            continue
        if told.returncode:
            problem = told.stderr.strip()
        summary = json.loads(told.stdout)
        kept += summary["datagrams"]
        end_ns = max(end_ns, summary["end_ns"] or 0)
    return Kill(ran, max(0.0, (killed_ns - end_ns) / 1e9) if end_ns else ran, kept, problem)


def main() -> None:
    """Kill as often as asked, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=104, help="in all, shared by the ways")
    parser.add_argument("--rate", type=int, default=2000, help="datagrams a second")
    parser.add_argument("--seconds", type=float, default=900, help="begin no kill after so long")
    parser.add_argument("--at-once", type=int, default=2)
    parser.add_argument("--only", choices=WAYS)
    wish = parser.parse_args()
    ways = {wish.only: WAYS[wish.only]} if wish.only else WAYS
    each, until = -(-wish.kills // len(ways)), time.monotonic() + wish.seconds

    def once(way: Way, seed: int) -> Kill | None:
        return kill(way, wish.rate, seed) if time.monotonic() < until else None

    print("| command | kills | lost, median | lost, most |\n|---|---|---|---|")
    worst, problems = 0.0, []
    with ThreadPoolExecutor(wish.at_once) as pool:
        rounds = {name: [pool.submit(once, way, seed) for seed in range(each)] for name, way in ways.items()}
        for name, futures in rounds.items():
            done = [result for future in futures if (result := future.result()) is not None]
            lost = sorted(result.lost_s for result in done)
            problems += [f"{name}: {result.problem}" for result in done if result.problem]
            if lost:
                print(max(done, key=lambda result: result.lost_s), file=sys.stderr)
                worst = max(worst, lost[-1])
                print(
                    f"| {name} | {len(lost)} | {lost[len(lost) // 2]:.2f} s | {lost[-1]:.2f} s |", flush=True
                )
    for line in problems:
        print(line, file=sys.stderr)
    sys.exit("a kill cost more than a second" if worst > 1 else bool(problems))


if __name__ == "__main__":
    main()
