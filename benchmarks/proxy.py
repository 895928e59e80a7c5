"""Measure the proxy on loopback: throughput with and without recording, bytes left alone.

Sender, proxy and receiver are three processes that share the machine's processors. Called by run.py; alone:
python benchmarks/proxy.py [--datagrams N]
"""

from __future__ import annotations

import argparse
import hashlib
import json
import select
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from paths import EDORAS
from rounds import busy_ns

from edoras_tools.io.net.buffer import make_buffer
from edoras_tools.io.net.sockets import kernel_drops, open_bound, open_socket
from edoras_tools.io.net.transmit import precise_timing
from edoras_tools.model import Endpoint
from edoras_tools.ros import TypeStore
from edoras_tools.wire import cfe
from edoras_tools.wire.envelope import DEFAULT

LISTEN, TARGET = 47234, 47235
BYTES, STAMP = 200, slice(68, 76)
RATES, RECORDING_RATES, SECONDS = (100_000, 150_000, 200_000, 250_000), (50_000, 75_000, 100_000), 5
QUIET_S = 1.0
RANDOM_BLOCK, MOST_BYTES, LARGEST = 1 << 22, 1473, 65507
SEED = 7


def connected(port: int) -> socket.socket:
    """Open a socket to a loopback port."""
    opened = open_socket(socket.AF_INET)
    opened.connect(("127.0.0.1", port))
    return opened


def random_datagram(block: bytes, chances: np.ndarray) -> bytes:
    """Return a slice of random bytes: mostly what fits a frame, one in a thousand up to the largest."""
    most = LARGEST if chances[2] % 1000 == 0 else MOST_BYTES
    start, length = int(chances[0]), int(chances[1] % (most + 1))
    return block[start : start + length]


def send_random(port: int, count: int) -> None:
    """Send random datagrams of all sizes at 40,000/s; print their digest."""
    chances = np.random.default_rng(SEED)
    block = chances.bytes(RANDOM_BLOCK + LARGEST)
    digest, buffer, opened = hashlib.sha256(), make_buffer(), connected(port)
    began, step = time.perf_counter(), 100
    for first in range(0, count, step):
        rows = min(step, count - first)
        for row, pick in enumerate(chances.integers(0, RANDOM_BLOCK, (rows, 3))):
            payload = random_datagram(block, pick)
            digest.update(len(payload).to_bytes(4, "big") + payload)
            buffer.put(row, payload)
        ahead = began + first / 40_000 - time.perf_counter()
        if ahead > 0:
            time.sleep(ahead)
        buffer.send(opened, rows, None)
    print(json.dumps({"sent": count, "digest": digest.hexdigest()}))


def payload() -> bytes:
    """Return a command with a whole message, padded as C structs are; its last field is the stamp."""
    packet = cfe.emit_command(0x1827, 1, DEFAULT.emit(TypeStore().encode("geometry_msgs/msg/Twist", {})))
    assert len(packet) == STAMP.stop
    head = packet[:4] + (BYTES - 7).to_bytes(2, "big") + packet[6:7] + b"\0"  # no checksum
    return head + packet[len(head) :] + bytes(BYTES - len(packet))


def send_at(port: int, rate: int, seconds: float, burst: int) -> None:
    """Send stamped datagrams at a rate, some at once; print how many."""
    buffer, opened = make_buffer(), connected(port)
    for row in range(burst):
        buffer.put(row, payload())
    stamps, counts = buffer.slots[:burst, STAMP], buffer.slots[:burst, 2:4]
    rising = np.arange(burst)
    sent, step_ns = 0, burst * 10**9 // rate
    with precise_timing():
        began = due = time.monotonic_ns() + 10**6
        end = due + int(seconds * 1e9)
        while due < end:
            ahead = due - time.monotonic_ns()
            if ahead > 0:
                time.sleep(ahead / 1e9)
            stamps[:] = np.frombuffer(time.time_ns().to_bytes(8, "little"), np.uint8)
            counts[:] = (sent + rising & 0x3FFF | 0xC000).astype(">u2").view(np.uint8).reshape(-1, 2)
            sent += buffer.send(opened, burst, None).accepted
            due += step_ns
    print(json.dumps({"sent": sent, "seconds": (time.monotonic_ns() - began) / 1e9}))


def receive(port: int, *, digests: bool) -> None:
    """Take what comes until nothing has come for a second; print count, digest, latencies and drops."""
    buffer, opened = make_buffer(), open_bound(Endpoint("127.0.0.1", port))
    print("ready", flush=True)
    digest, late, count = hashlib.sha256(), [], 0
    while select.select([opened], [], [], 30 if not count else QUIET_S)[0]:
        rows = buffer.receive(opened)
        count += rows
        if digests:
            for row in range(rows):
                payload = buffer.payload(row)
                digest.update(len(payload).to_bytes(4, "big") + payload)
        else:
            stamps = np.ascontiguousarray(buffer.slots[:rows, STAMP]).view("<i8")[:, 0]
            late.append(buffer.times(rows) - stamps)
    late_us = np.concatenate(late) / 1000 if late else np.zeros(1)
    p50, p99 = np.percentile(late_us, (50, 99)).tolist()
    result = {"received": count, "p50_us": round(p50, 1), "p99_us": round(p99, 1)}
    print(json.dumps({**result, "digest": digest.hexdigest(), "drops": kernel_drops(opened)}))


def role(*arguments: object, **options: object) -> subprocess.Popen[str]:
    """Start this file in a role."""
    command = [sys.executable, __file__, *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, **options)


def through(
    sender: list[object],
    *proxy: str,
    direct: bool = False,
    digests: bool = False,
    by: list[str] | None = None,
) -> dict[str, object]:
    """Send through a proxy, directly, or ``by`` another relay; return what everybody reports.

    ``busy_s`` is the processor time of the proxy or the other relay while datagrams came.
    """
    receiver = role("receive", TARGET, int(digests))
    receiver.stdout.readline()
    relay = other = None
    if by:
        other = subprocess.Popen(by, stdout=subprocess.PIPE, text=True)
        other.stdout.readline()
    elif not direct:
        ends = ["--listen", f"127.0.0.1:{LISTEN}", "--target", f"127.0.0.1:{TARGET}"]
        relay = subprocess.Popen(
            [EDORAS, "proxy", "ci", *ends, "--json", *proxy],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        relay.stderr.readline()
    between = relay or other
    before = busy_ns(between.pid) if between else 0
    sent = json.loads(role(sender[0], TARGET if direct else LISTEN, *sender[1:]).communicate()[0])
    received = json.loads(receiver.communicate()[0])
    busy_s = (busy_ns(between.pid) - before) / 1e9 if between else 0.0
    report = {}
    if other:
        other.kill()
        other.communicate()
    if relay:
        relay.send_signal(signal.SIGINT)
        report = json.loads(relay.communicate()[0])
    return {"sent": sent, "received": received, "report": report, "busy_s": busy_s}


def throughput(folder: Path, *, recording: bool) -> list[dict[str, object]]:
    """How much goes through, a row a rate."""
    rows = []
    for rate in RECORDING_RATES if recording else RATES:
        target = folder / f"{rate}.mcap"
        found = through(["stamped", rate, SECONDS, rate // 1000], *(["-o", str(target)] if recording else []))
        report = found["report"]
        row = {
            "rate_hz": rate,
            "sent": found["sent"]["sent"],
            "sent_per_s": round(found["sent"]["sent"] / found["sent"]["seconds"]),
            "received": found["received"]["received"],
            "lost_by_proxy": report["lost"],
            "lost_by_receiver": found["received"]["drops"],
            "inside_p99_us": report["ways"][0]["latency_us"]["p99"],
        }
        if recording:
            row["recorded"] = report["recorded"]
        rows.append(row)
        if row["sent"] != row["received"]:
            break
    return rows


def byte_exact(datagrams: int) -> dict[str, object]:
    """Random datagrams come out as they went in, all of them, in order."""
    found = through(["random", datagrams], digests=True)
    return {
        "sent": found["sent"]["sent"],
        "received": found["received"]["received"],
        "same_bytes": found["sent"]["digest"] == found["received"]["digest"],
    }


def measure(folder: Path, datagrams: int = 1_000_000) -> dict[str, object]:
    """Measure everything."""
    return {
        "throughput": throughput(folder, recording=False),
        "throughput_recording": throughput(folder, recording=True),
        "byte_exact": byte_exact(datagrams),
    }


def main() -> None:
    """Play a role, or measure."""
    match sys.argv[1:]:
        case ["random", port, count]:
            send_random(int(port), int(count))
        case ["stamped", port, rate, seconds, burst]:
            send_at(int(port), int(rate), float(seconds), int(burst))
        case ["receive", port, digests]:
            receive(int(port), digests=bool(int(digests)))
        case _:
            parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
            parser.add_argument("--datagrams", type=int, default=1_000_000)
            with tempfile.TemporaryDirectory() as name:
                print(json.dumps(measure(Path(name), parser.parse_args().datagrams), indent=2))


if __name__ == "__main__":
    main()
