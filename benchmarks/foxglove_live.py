"""Measure `edoras live` on loopback: a live capture shown to a client that reads and to one that does not.

Sender, server and clients are processes that share the machine's processors. Called by run.py; alone:
python benchmarks/foxglove_live.py
"""

from __future__ import annotations

import json
import signal
import socket
import struct
import subprocess
import sys
import threading
import time

from paths import EDORAS, HERE

PORT = 1234
BYTES, SECONDS = 200, 5
RATES = (1_000, 20_000, 50_000)
TOPIC = "/edoras/datagrams"
HANDSHAKE = (
    "GET / HTTP/1.1\r\nHost: bench\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
    "Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n"
)


class Client:
    """Speaks just enough of the protocol to subscribe; ``websockets`` would be the bottleneck."""

    def __init__(self, port: int) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port))
        self.socket.sendall(HANDSHAKE.encode())
        self._rest = b""
        while b"\r\n\r\n" not in self._rest:
            self._rest += self.socket.recv(1)
        self._rest = b""
        self.count, self.late_ms = 0, []
        channels = {}
        while TOPIC not in channels:
            for head, payload in self.frames():
                told = json.loads(payload) if head == 0x81 else {}
                channels |= {item["topic"]: item["id"] for item in told.get("channels", ())}
        wanted = {"op": "subscribe", "subscriptions": [{"id": 1, "channelId": channels[TOPIC]}]}
        text = json.dumps(wanted).encode()
        self.socket.sendall(bytes([0x81, 0x80 | len(text)]) + bytes(4) + text)  # masked with zeros

    def frames(self) -> list[tuple[int, bytes]]:
        """Wait for bytes; return the frames that they end."""
        data = self._rest + self.socket.recv(1 << 20)
        found, at = [], 0
        while at + 2 <= len(data):
            length, head = data[at + 1], 2
            if length >= 126:
                head = 4 if length == 126 else 10
                length = int.from_bytes(data[at + 2 : at + head], "big")
            if at + head + length > len(data):
                break
            found.append((data[at], data[at + head : at + head + length]))
            at += head + length
        self._rest = data[at:]
        if not data:
            raise ConnectionError
        return found

    def read(self) -> None:
        """Read until the server says goodbye."""
        while True:
            for head, payload in self.frames():
                if head == 0x88:
                    return
                if payload[0] == 1:
                    self.count += 1
                    if not self.count % 16:
                        sent = struct.unpack_from("<Q", payload, 5)[0]
                        self.late_ms.append((time.time_ns() - sent) / 1e6)


def one(rate: int) -> dict[str, object]:
    """Show a live capture at a rate."""
    server = subprocess.Popen(
        [EDORAS, "live", "-i", "lo", "--ws-port", "0", "--json"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    port = int(server.stderr.readline().rpartition(":")[2])
    while "capturing" not in (line := server.stderr.readline()):
        if not line:
            sys.exit("live capture needs CAP_NET_RAW")
    reader, sleeper = Client(port), Client(port)
    addresses = ["{}:{}".format(*item.socket.getsockname()) for item in (reader, sleeper)]
    thread = threading.Thread(target=reader.read)
    thread.start()
    time.sleep(0.5)
    sender = [sys.executable, str(HERE / "sender.py"), str(PORT), str(rate), str(BYTES), str(SECONDS)]
    sent = json.loads(subprocess.run(sender, check=True, capture_output=True, text=True).stdout)["sent"]
    time.sleep(1)
    server.send_signal(signal.SIGINT)
    report = json.loads(server.communicate()[0])
    thread.join()
    sleeper.socket.close()
    late = sorted(reader.late_ms)
    rows = {row["address"]: row for row in report["foxglove"]["clients"]}
    quick, slow = (rows[address] for address in addresses)
    return {
        "rate": rate,
        "sent": sent,
        "captured": report["datagrams"],
        "kernel_drops": report["capture_drops"],
        "reader_got": reader.count,
        "reader_dropped": quick["dropped"],
        "sleeper_sent": slow["sent"],
        "sleeper_dropped": slow["dropped"],
        "sleeper_waiting": slow["waiting"],
        "latency_ms_p50": round(late[len(late) // 2], 2),
        "latency_ms_p99": round(late[len(late) * 99 // 100], 2),
    }


def measure() -> dict[str, object]:
    """Return the figures of every rate."""
    return {"bytes": BYTES, "seconds": SECONDS, "runs": [one(rate) for rate in RATES]}


if __name__ == "__main__":
    print(json.dumps(measure(), indent=2))
