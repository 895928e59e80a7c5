"""Measure our Foxglove server beside that of the package foxglove-sdk: 1,000 messages/s to 10 and 50 clients.

    pip install foxglove-sdk && python benchmarks/foxglove_sdk.py

Both servers get 60 messages of 116 bytes each 60 ms, as `edoras live` hands them over. The processor's time
is that of the server's process while it publishes. In the last runs messages have 1,000 bytes, and one client
more reads nothing until all is published: what the others get then, and what it gets of all that was sent.
"""

from __future__ import annotations

import json
import os
import selectors
import subprocess
import sys
import time

from foxglove_live import Client as Handshake

SECONDS, EACH, PERIOD_S = 10, 60, 0.06
TOPIC = "/edoras/datagrams"
HEAD = 4 + 1 + 4 + 8
"""Bytes around a message: the frame's head, the operation, the subscription, the time."""


class Ours:
    """The server of edoras-tools."""

    def __init__(self, size: int) -> None:
        import numpy as np

        from edoras_tools.addons.foxglove.server.server import FoxgloveServer, ServerOptions
        from edoras_tools.io.topics.messages import Records
        from edoras_tools.io.topics.streams import Topic
        from edoras_tools.model import Endpoint

        options = ServerOptions(Endpoint("127.0.0.1", 0))
        self.server = FoxgloveServer(
            "bench", [Topic(TOPIC, "std_msgs/msg/String")], lambda _: "string data", options
        )
        self.port = self.server.endpoint.port
        start = np.arange(EACH) * size
        ids = np.zeros(EACH, np.uint16)
        times = np.zeros(EACH, np.uint64)
        self.records = Records(ids, times, start, start + size, bytes(EACH * size))

    def publish(self) -> None:
        self.server.publish(self.records)

    def dropped(self) -> int | None:
        return self.server.summary()["dropped"]


class Sdk:
    """The server of foxglove-sdk."""

    def __init__(self, size: int) -> None:
        import foxglove

        schema = foxglove.Schema(name="std_msgs/msg/String", encoding="ros2msg", data=b"string data")
        self.channel = foxglove.Channel(TOPIC, message_encoding="cdr", schema=schema)
        self.server = foxglove.start_server(name="bench", port=0)
        self.port = self.server.port
        self.message = bytes(size)

    def publish(self) -> None:
        for _ in range(EACH):
            self.channel.log(self.message, log_time=1)

    def dropped(self) -> int | None:
        return None  # it does not count


def serve(kind: str, size: int) -> None:
    """Serve until standard input ends: a port, then for each line a row of figures."""
    server = {"ours": Ours, "sdk": Sdk}[kind](size)
    print(server.port, flush=True)
    for _ in sys.stdin:
        begun, cpu, most, sent = time.monotonic(), time.process_time(), 0.0, 0
        while (now := time.monotonic()) < begun + SECONDS:
            server.publish()
            sent += EACH
            most = max(most, time.monotonic() - now)
            time.sleep(max(0.0, begun + sent / EACH * PERIOD_S - time.monotonic()))
        cpu = (time.process_time() - cpu) / (time.monotonic() - begun)
        row = {"sent": sent, "cpu_percent": round(100 * cpu, 1), "longest_call_ms": round(1e3 * most, 1)}
        print(json.dumps({**row, "dropped": server.dropped()}), flush=True)
    os._exit(0)


def one(kind: str, clients: int, *, slow: bool) -> dict[str, object]:
    """Run a server and its clients."""
    size = 1_000 if slow else 116
    words = [sys.executable, __file__, kind, str(size)]
    process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    port = int(process.stdout.readline())
    sockets = [Handshake(port).socket for _ in range(clients + slow)]
    poll, got = selectors.DefaultSelector(), [0] * len(sockets)
    for place, item in enumerate(sockets):
        item.setblocking(False)
        if place < clients:
            poll.register(item, selectors.EVENT_READ, place)
    time.sleep(0.5)
    process.stdin.write("\n")
    process.stdin.flush()

    def read(seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            for key, _ in poll.select(0.1):
                got[key.data] += len(key.fileobj.recv(1 << 20))

    read(SECONDS + 1.5)
    row = json.loads(process.stdout.readline())
    if slow:
        poll.register(sockets[-1], selectors.EVENT_READ, clients)
        read(3)
    process.stdin.close()
    process.wait()
    each = HEAD + size if HEAD - 4 + size > 125 else HEAD - 2 + size
    counts = [number // each for number in got]
    row |= {"server": kind, "clients": clients, "bytes": size, "least_got": min(counts[:clients])}
    return row | ({"slow_got": counts[-1]} if slow else {})


def main() -> None:
    """Print a row for each run."""
    for slow, clients in ((False, 10), (False, 50), (True, 10)):
        for kind in ("ours", "sdk"):
            print(json.dumps(one(kind, clients, slow=slow)), flush=True)


if __name__ == "__main__":
    serve(sys.argv[1], int(sys.argv[2])) if sys.argv[1:] else main()
