"""Stop a recorder and tcpdump for a while, let them go on, count what each has; and how fresh a line is.

Run: python stall.py [--seconds 60] [--rates 100 1000] [--bytes 200]
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from paths import EDORAS, HERE

SENDER = str(HERE / "sender.py")
FRAMES = 50


def free_port() -> int:
    """Return a UDP port that nobody has."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        port: int = one.getsockname()[1]
        return port


def started(command: list[str], word: str) -> subprocess.Popen[str]:
    """Start a program and wait for a word on its standard error."""
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    for line in process.stderr:
        if word in line:
            threading.Thread(target=process.stderr.read, daemon=True).start()
            return process
    sys.exit(f"{command[0]} did not start")


def stall(rate: int, size: int, seconds: float, folder: Path) -> dict[str, Any]:
    """Stop both for some seconds of a traffic of so many datagrams a second; return what each has."""
    port = free_port()
    ours, theirs = folder / f"{rate}.mcap", folder / f"{rate}.pcap"
    recorders = [
        started([EDORAS, "record", "-i", "lo", "--port", f"ci:{port}", "-o", str(ours)], "capturing")
    ]
    if shutil.which("tcpdump"):
        command = ["tcpdump", "-i", "lo", "-w", str(theirs), "udp", "and", "port", str(port)]
        recorders.append(started(command, "listening"))
    sender = subprocess.Popen(
        [sys.executable, SENDER, str(port), str(rate), str(size), str(int(seconds) + 4)],
        stdout=subprocess.PIPE,
    )
    time.sleep(2)
    for recorder in recorders:
        os.kill(recorder.pid, signal.SIGSTOP)
    time.sleep(seconds)
    for recorder in recorders:
        os.kill(recorder.pid, signal.SIGCONT)
    sent = json.loads(sender.communicate()[0])["sent"]
    time.sleep(2)
    for recorder in recorders:
        recorder.send_signal(signal.SIGINT)
    codes = [recorder.wait(60) for recorder in recorders]
    return {
        "rate": rate,
        "bytes": size,
        "stalled_s": seconds,
        "sent": sent,
        "edoras": held(ours, port),
        "edoras_exit": codes[0],
        "tcpdump": held(theirs, port) if len(codes) > 1 else None,
    }


def held(file: Path, port: int) -> int:
    """Return how many datagrams to a port a file holds."""
    told = subprocess.run(
        [EDORAS, "info", "--json", "--port", f"ci:{port}", str(file)],
        capture_output=True,
        text=True,
        check=False,
    )
    summary = json.loads(told.stdout)
    return int(sum(route["count"] for route in summary["routes"] if route["link"] == "ci"))


def freshness() -> dict[str, float]:
    """Return how long the line of a single datagram takes to be printed, in ms."""
    port = free_port()
    command = [EDORAS, "sniff", "-i", "lo", "--port", f"ci:{port}", "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stderr is not None
    process.stderr.readline()
    times: list[float] = []
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
        contextlib.closing(process.stdout) as lines,
    ):
        for number in range(FRAMES):
            time.sleep(0.2 + 0.0037 * (number % 10))
            began = time.perf_counter()
            sender.sendto(bytes.fromhex("1827c00000010000"), ("127.0.0.1", port))
            lines.readline()
            times.append(1000 * (time.perf_counter() - began))
    process.terminate()
    process.wait(10)
    later = sorted(times[1:])
    return {
        "first_ms": round(times[0], 1),
        "median_ms": round(statistics.median(later), 1),
        "p95_ms": round(later[int(0.95 * len(later))], 1),
        "max_ms": round(later[-1], 1),
    }


def main() -> None:
    """Measure, and print JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--rates", type=int, nargs="*", default=[100, 1000])
    parser.add_argument("--bytes", type=int, default=200)
    wish = parser.parse_args()
    print(json.dumps({"line": freshness()}, indent=2))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with ThreadPoolExecutor() as pool:
            rows = [pool.submit(stall, rate, wish.bytes, wish.seconds, folder) for rate in wish.rates]
            print(json.dumps({"stall": [row.result() for row in rows]}, indent=2))


if __name__ == "__main__":
    main()
