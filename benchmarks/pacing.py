"""How evenly and how fast datagrams leave: edoras beside tcpreplay and beside a sleep between messages.

Every sender's datagrams are timed by the kernel as they pass the loopback interface, so that all are judged
alike; what tcpreplay injects there reaches no socket. Needs CAP_NET_RAW.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import struct
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from functools import partial
from resource import RUSAGE_CHILDREN, getrusage
from typing import TYPE_CHECKING, Self

from paths import EDORAS
from rounds import absent, alternated

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

RATE, SECONDS = 1000, 4
LOOPS = 200
SO_TIMESTAMPNS = 35
BYTES = 76


class Receiver:
    """A port that somebody listens at, and the kernel's time of each datagram to it."""

    def __init__(self) -> None:
        self._port = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._port.bind(("127.0.0.1", 0))
        self.port = self._port.getsockname()[1]
        self._tap = socket.socket(socket.AF_PACKET, socket.SOCK_RAW)
        self._tap.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 32 << 20)
        self._tap.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self._tap.bind(("lo", 0x0800))
        self._tap.settimeout(0.5)
        self.times: list[int] = []
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        wanted = self.port.to_bytes(2, "big")
        while True:
            try:
                frame, ancillary, _, sender = self._tap.recvmsg(2048, 64)
            except TimeoutError:
                if self._done.is_set():
                    return
                continue
            if sender[2] == socket.PACKET_OUTGOING or frame[36:38] != wanted:
                continue
            seconds, nanoseconds = struct.unpack("qq", ancillary[0][2])
            self.times.append(seconds * 10**9 + nanoseconds)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self._thread.join()
        self._tap.close()
        self._port.close()

    def lateness(self) -> dict[str, float]:
        """Judge arrivals: late is what comes after the place that the most punctual hundredth gives it."""
        late = [stamp - index * 10**9 // RATE for index, stamp in enumerate(self.times)]
        punctual = sorted(late)[len(late) // 100]
        ordered = sorted(max(value - punctual, 0) / 1000 for value in late)
        tenth = max(len(late) // 10, 1)

        def middle(values: list[int]) -> int:
            return sorted(values)[len(values) // 2]

        return {
            "received": len(late),
            "late_us_p50": round(ordered[len(ordered) // 2], 1),
            "late_us_p99": round(ordered[len(ordered) * 99 // 100], 1),
            "late_us_max": round(ordered[-1], 1),
            "drift_us": round((middle(late[-tenth:]) - middle(late[:tenth])) / 1000, 1),
        }


def write_capture(path: Path, port: int) -> None:
    """Write a pcap of commands, one a millisecond, to a port."""
    payload = struct.pack(">HHHBB", 0x1827, 0, BYTES - 7, 1, 0) + bytes(BYTES - 8)
    udp = struct.pack(">HHHH", 4000, port, 8 + BYTES, 0) + payload
    head = struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0, b"\x7f\0\0\1", b"\x7f\0\0\1")
    total = sum(struct.unpack(">10H", head))
    total = (total & 0xFFFF) + (total >> 16)
    head = head[:10] + struct.pack(">H", ~(total + (total >> 16)) & 0xFFFF) + head[12:]
    frame = bytes(12) + b"\x08\x00" + head + udp
    with path.open("wb") as file:
        file.write(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 262144, 1))
        for index in range(RATE * SECONDS):
            second, microsecond = divmod(index * 1_000_000 // RATE, 1_000_000)
            file.write(
                struct.pack("<IIII", 1_795_241_000 + second, microsecond, len(frame), len(frame)) + frame
            )


def replay(path: Path, port: int, *options: str) -> dict[str, object]:
    """Send the capture by edoras."""
    command = [EDORAS, "replay", str(path), "--to", "ci", "--target", f"127.0.0.1:{port}", "--no-listen"]
    done = subprocess.run(
        [*command, "--port", f"ci:{port}", "--json", *options], check=True, capture_output=True, text=True
    )
    report: dict[str, object] = json.loads(done.stdout)
    return report


def sleeping(port: int) -> None:
    """Send as many players do: a sleep between one message and the next."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.connect(("127.0.0.1", port))
        for _ in range(RATE * SECONDS):
            sender.send(bytes(BYTES))
            time.sleep(1 / RATE)


def paced(folder: Path, sender: Callable[[Path, int], None]) -> dict[str, float]:
    """Judge one sender of the capture, and say how much of a processor it took, its start included."""
    path, before = folder / "paced.pcap", getrusage(RUSAGE_CHILDREN)
    with Receiver() as receiver:
        write_capture(path, receiver.port)
        sender(path, receiver.port)
    after = getrusage(RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {**receiver.lateness(), "cpu_percent": cpu_s / SECONDS * 100}


@contextmanager
def busy() -> Iterator[None]:
    """As many busy loops beside as there are processors."""
    loops = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(os.cpu_count() or 1)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


def by_edoras(path: Path, port: int) -> None:
    """Send by edoras."""
    replay(path, port)


def by_tcpreplay(path: Path, _port: int) -> None:
    """Send by tcpreplay."""
    command = ["tcpreplay", "-q", "-i", "lo", f"--pps={RATE}", str(path)]
    subprocess.run(command, check=True, capture_output=True)


def by_sleeping(_path: Path, port: int) -> None:
    """Send by a process that sleeps between messages."""
    subprocess.run([sys.executable, __file__, str(port)], check=True)


def measure(folder: Path) -> dict[str, object]:
    """1 kHz by each sender in alternation, alone and on a busy machine; then as fast as it goes."""
    found: dict[str, object] = {"rate_hz": RATE, "seconds": SECONDS, **absent("tcpreplay")}
    senders = {"edoras": by_edoras} | ({"tcpreplay": by_tcpreplay} if shutil.which("tcpreplay") else {})
    ways = {name: partial(paced, folder, sender) for name, sender in senders.items()}
    found["idle"] = alternated(ways)
    with busy():
        found["busy"] = alternated(ways)
    found["sleep_between"] = paced(folder, by_sleeping)
    path = folder / "paced.pcap"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sink:
        sink.bind(("127.0.0.1", 0))
        port = sink.getsockname()[1]
        write_capture(path, port)
        report = replay(path, port, "--max", "--loop", str(LOOPS))
    found["max_sent"] = report["sent"]
    found["max_per_s"] = round(float(str(report["rate_achieved_hz"])))
    return found


if __name__ == "__main__":
    sleeping(int(sys.argv[1]))
