"""Everything that runs for long, at load, at once: memory, open files and losses in one table.

Run: python benchmarks/soak.py --seconds 600 [--rate 2000] [--json FILE]

A sender gives datagrams at a steady rate to each of: ``record --listen`` (``record -i lo`` and ``sniff -i
lo`` see the same ones), ``proxy``, recorded, to a receiver of its own, ``bridge --ros local``, recorded, and
``live --listen`` with a client that follows all topics. Memory (resident) and open files are read once a
second; the first reading is the one after a tenth of the time. What each counted is held against what was
sent to it.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from paths import EDORAS, MISSION, ROOT

sys.path[:0] = [str(ROOT / "tests/support")]

import foxglove_client  # noqa: E402
from waiting import PATIENCE_S, free_ports, until  # noqa: E402

from edoras_tools.ros import TypeStore  # noqa: E402
from edoras_tools.wire import cfe  # noqa: E402
from edoras_tools.wire.envelope import DEFAULT  # noqa: E402

HOST = "127.0.0.1"
PAGE = os.sysconf("SC_PAGE_SIZE")
TURN_S = 0.01
TYPES = TypeStore()
TWIST = TYPES.encode("geometry_msgs/msg/Twist", {"linear": {"x": 0.5}})
POSE = TYPES.encode("geometry_msgs/msg/PoseStamped", {"header": {"frame_id": "world"}})
COMMAND = cfe.emit_command(0x1827, 1, DEFAULT.emit(TWIST))
TELEMETRY = cfe.emit_telemetry(0x827, DEFAULT.emit(POSE))


class Sender(threading.Thread):
    """Sends one datagram at a steady rate to several ports, each as often, and counts."""

    def __init__(self, ports: dict[int, bytes], rate: float) -> None:
        super().__init__(daemon=True)
        self.ports, self.rate, self.sent, self.ending = ports, rate, 0, threading.Event()

    def run(self) -> None:
        opened = {port: socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for port in self.ports}
        begin = time.monotonic()
        while not self.ending.wait(TURN_S):
            due = int((time.monotonic() - begin) * self.rate) - self.sent
            for _ in range(due):
                for port, data in self.ports.items():
                    opened[port].sendto(data, (HOST, port))
            self.sent += due
        for item in opened.values():
            item.close()


class Watched:
    """A command under way, what it used first and at most, and what it said at its end."""

    def __init__(self, stack: ExitStack, folder: Path, name: str, words: list[object]) -> None:
        self.name = name
        self._out, self._err = folder / f"{name}.out", folder / f"{name}.err"
        out, err = (stack.enter_context(path.open("wb")) for path in (self._out, self._err))
        command = [EDORAS, *map(str, words)]
        self.process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=out, stderr=err)
        stack.callback(self.process.kill)
        self.first: tuple[int, int] | None = None
        self.last = self.most = (0, 0)

    def ready(self) -> bool:
        said = self._err.read_text()
        assert self.process.poll() is None, f"{self.name}: {said}"
        return any(word in said for word in ("capturing on", "relaying", "bridging", "in Foxglove"))

    def read(self, *, settled: bool) -> None:
        memory = int(Path(f"/proc/{self.process.pid}/statm").read_text().split()[1]) * PAGE
        files = sum(1 for _ in Path(f"/proc/{self.process.pid}/fd").iterdir())
        self.last = memory, files
        self.most = max(self.most[0], memory), max(self.most[1], files)
        if settled and self.first is None:
            self.first = self.last

    def end(self) -> dict[str, Any]:
        """End it as Ctrl-C does; return what it said in JSON, or of a list how many lines it has."""
        self.process.send_signal(signal.SIGINT)
        self.process.wait(PATIENCE_S)
        if self.name.startswith("sniff"):
            with self._out.open("rb") as file:
                return {"datagrams": sum(1 for _ in file)}
        said: dict[str, Any] = json.loads(self._out.read_text())
        return said


def mission(folder: Path, listen: int, target: int) -> Path:
    text = MISSION.read_text()
    path = folder / "rover.yaml"
    path.write_text(text.replace("1235", str(listen)).replace("1234", str(target)))
    return path


def follow(url: str, seen: list[int], stop: threading.Event) -> None:
    """Be a Foxglove client that wants everything."""
    with foxglove_client.Client(url, 3) as client:
        client.subscribe()
        while not stop.is_set() and client.take(5):
            seen[0] += len(client.messages)
            client.messages.clear()


def receive(opened: socket.socket, seen: list[int], stop: threading.Event) -> None:
    """Count what arrives."""
    opened.settimeout(0.2)
    while not stop.is_set():
        with suppress(TimeoutError):
            opened.recv(65536)
            seen[0] += 1


def commands(folder: Path) -> tuple[dict[str, list[object]], dict[str, int]]:
    """Return the words of each command, and the ports."""
    names = ("listen", "relay", "target", "bridge", "cfs", "show", "web")
    ports = dict(zip(names, free_ports(len(names)), strict=True))
    link, show = f"ci:{ports['listen']}", f"ci:{ports['show']}"
    only = ["--port", link, "--where", f"port == {ports['listen']}"]
    target = f"{HOST}:{ports['target']}"
    path = mission(folder, ports["bridge"], ports["cfs"])
    words: dict[str, list[object]] = {
        "record -i": ["record", "-i", "lo", *only, "-o", folder / "i.mcap"],
        "sniff -i": ["sniff", "-i", "lo", *only],
        "record --listen": ["record", "--listen", ports["listen"], "--port", link, "-o", folder / "l.mcap"],
        "proxy": ["proxy", "ci", "--listen", ports["relay"], "--target", target, "-o", folder / "p.mcap"],
        "bridge": ["bridge", "-c", path, "--ros", "local", "--no-enable", "-o", folder / "b.mcap"],
        "live": ["live", "--listen", ports["show"], "--port", show, "--ws-port", ports["web"]],
    }
    return {name: [*given, "--json"] for name, given in words.items()}, ports


def soak(seconds: float, rate: float, folder: Path) -> list[dict[str, Any]]:
    """Run all of it; return a row a command."""
    words, ports = commands(folder)
    arrived, shown, stop = [0], [0], threading.Event()
    with ExitStack() as stack:
        target = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        target.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        target.bind((HOST, ports["target"]))
        running = [Watched(stack, folder, name, given) for name, given in words.items()]
        for item in running:
            until(item.ready, f"the start of {item.name}")
        url = f"ws://{HOST}:{ports['web']}"
        threads = [
            threading.Thread(target=receive, args=(target, arrived, stop), daemon=True),
            threading.Thread(target=follow, args=(url, shown, stop), daemon=True),
        ]
        sent_to = {ports[name]: COMMAND for name in ("listen", "relay", "show")} | {
            ports["bridge"]: TELEMETRY
        }
        sender = Sender(sent_to, rate)
        for thread in (*threads, sender):
            thread.start()
        begin = time.monotonic()
        while (now := time.monotonic() - begin) < seconds:
            for item in running:
                item.read(settled=now > seconds / 10)
            time.sleep(1)
        sender.ending.set()
        sender.join()
        time.sleep(1)  # what is on its way arrives
        for item in running:
            item.read(settled=True)
        stop.set()
        for thread in threads:
            thread.join(PATIENCE_S)
        rows = [row(item, item.end(), sender.sent, arrived[0]) for item in running]
    print(f"{sender.sent:,} datagrams to each at {rate:g}/s, {shown[0]:,} messages to a Foxglove client")
    return rows


def row(item: Watched, said: dict[str, Any], sent: int, arrived: int) -> dict[str, Any]:
    """Hold what a command counted against what was sent to it."""
    drops = said.get("capture_drops", 0)
    match item.name:
        case "proxy":
            counted = arrived
        case "bridge":
            counted = said["bridges"][0]["from_cfs"]["datagrams"]
            drops = said["bridges"][0]["from_cfs"]["kernel_drops"]
        case _:
            counted = said["datagrams"]
    assert item.first is not None
    return {
        "command": item.name,
        "exit_code": item.process.returncode,
        "sent": sent,
        "counted": counted,
        "lost": sent - counted,
        "kernel_drops": drops,
        "memory_first": item.first[0],
        "memory_last": item.last[0],
        "memory_most": item.most[0],
        "files_first": item.first[1],
        "files_most": item.most[1],
    }


def table(rows: list[dict[str, Any]]) -> str:
    """Return the rows as a table of a page."""
    lines = [
        "| command | sent | lost | MiB after a tenth, at the end, most | open files, most | exit code |",
        "|---|---|---|---|---|---|",
    ]
    for item in rows:
        memory = ", ".join(f"{item[f'memory_{name}'] / 2**20:.0f}" for name in ("first", "last", "most"))
        files = f"{item['files_first']}, {item['files_most']}"
        counts = f"{item['sent']:,} | {item['lost']:,}"
        lines.append(f"| `{item['command']}` | {counts} | {memory} | {files} | {item['exit_code']} |")
    return "\n".join(lines)


def main() -> int:
    """Soak, print the table; return 1 where something was lost, failed, or grew by half."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=600)
    parser.add_argument("--rate", type=float, default=1000, help="datagrams a second to each")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="soak") as folder:
        rows = soak(options.seconds, options.rate, Path(folder))
    print(table(rows))
    if options.json:
        options.json.write_text(json.dumps(rows, indent=2) + "\n")
    bad = [
        item["command"]
        for item in rows
        if item["lost"]
        or item["exit_code"]
        or item["memory_last"] > 1.5 * item["memory_first"] + 2**24
        or item["files_most"] > item["files_first"] + 2
    ]
    print(f"wrong: {', '.join(bad)}" if bad else "nothing was lost, nothing grew")
    return bool(bad)


if __name__ == "__main__":
    sys.exit(main())
