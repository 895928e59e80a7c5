"""The highest rate of each kind of traffic of which a program that captures loses nothing, beside dumpcap.

A sender in C gives frames to one of two connected interfaces in a network namespace of their own; the program
captures at the other. Needs root and a C compiler. Called by run.py; alone: python benchmarks/limits.py
"""

from __future__ import annotations

import json
import shutil
import struct
import subprocess
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from paths import EDORAS, HERE
from rounds import absent, busy_ns, running

from edoras_tools.model import Peer
from edoras_tools.ros import TypeStore
from edoras_tools.wire import cfe, sbn
from edoras_tools.wire.envelope import DEFAULT

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

RATES = (50_000, 100_000, 200_000, 300_000, 400_000, 500_000)
SECONDS, SETTLE_S, DRAIN_S = 3, 2.0, 0.5
FRAMES = 1 << 14
"""As many as there are sequence counts, so that the counts rise without a gap from round to round."""
NEAR, FAR = "edoras0", "edoras1"
PORTS = {"ci": 1234, "sbn": 2236}
IMAGE_BYTES = 1313


class Kind(NamedTuple):
    """One kind of traffic: the types of its messages by MsgId, and its datagram of a sequence count."""

    link: str
    types: dict[int, str]
    datagram: Callable[[int], bytes]


def command(msg_id: int, cdr: bytes) -> bytes:
    """Return a command as the bridges send it: neither sequence count nor checksum."""
    return cfe.emit_command(msg_id, 1, DEFAULT.emit(cdr), sequence_flags=0, with_checksum=False)


def kinds() -> dict[str, Kind]:
    """Return the kinds of traffic by name."""
    types = TypeStore()
    twist = types.encode("geometry_msgs/msg/Twist", {})
    names = {"name": [f"joint_{number}" for number in range(7)], "position": [0.1] * 7}
    joints = command(0x1827, types.encode("sensor_msgs/msg/JointState", names))
    picture = DEFAULT.emit(types.encode("sensor_msgs/msg/Image", {"data": bytes(IMAGE_BYTES)}))
    packet = command(0x1827, twist)
    padded = packet[:4] + struct.pack(">H", 200 - 7) + packet[6:] + bytes(200 - len(packet))
    twists = [command(0x1900 + number, twist) for number in range(200)]

    def image(number: int) -> bytes:
        inner = cfe.emit_telemetry(0x82A, picture, sequence_count=number)
        return sbn.emit(sbn.MsgType.APP, Peer(1, 0x42), inner)

    rover = {0x1827: "geometry_msgs/msg/Twist"}
    many = {0x1900 + number: "geometry_msgs/msg/Twist" for number in range(200)}
    return {
        "200 bytes": Kind("ci", rover, lambda _: padded),
        "images of 1,400 bytes over SBN": Kind("sbn", {0x82A: "sensor_msgs/msg/Image"}, image),
        "JointState": Kind("ci", {0x1827: "sensor_msgs/msg/JointState"}, lambda _: joints),
        "200 topics": Kind("ci", many, lambda number: twists[number % 200]),
    }


def mission(kind: Kind) -> dict[str, object]:
    """Return the bridge's file of a kind of traffic."""
    names = {f"topic_{msg_id:x}": (msg_id, type_name) for msg_id, type_name in kind.types.items()}
    topics = {
        name: {"type": type_name, "topic": f"/{name}", "mid": msg_id}
        for name, (msg_id, type_name) in names.items()
    }
    near, far = "10.0.0.1", "10.0.0.2"
    ground = {"bridge_port": 1235, "fsw_port": PORTS["ci"], "fsw_ip": far, "telemetry_ip": near}
    peers = {"peer_processor_id": 1, "processor_id": 3, "peer_spacecraft_id": 0x42, "spacecraft_id": 0x42}
    flight = {"peer_ip": near, "peer_port": 2234, "udp_receive_port": PORTS["sbn"], "udp_receive_ip": far}
    commands, telemetry = (list(names), [""]) if kind.link == "ci" else ([""], list(names))
    communication = ground if kind.link == "ci" else {**flight, **peers}
    told = {"communication": communication, "command": commands, "telemetry": telemetry, **topics}
    return {"conversion_node": {"ros__parameters": told}}


def frame(port: int, datagram: bytes) -> bytes:
    """Return a datagram behind Ethernet, IPv4 and UDP headers."""
    udp = struct.pack(">HHHH", 40000, port, 8 + len(datagram), 0) + datagram
    ends = bytes([10, 0, 0, 1, 10, 0, 0, 2])
    ip = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0) + ends
    return b"\xff" * 6 + b"\x02" + bytes(5) + b"\x08\x00" + ip + udp


def write_capture(path: Path, kind: Kind) -> None:
    """Write the frames that are sent round and round."""
    with path.open("wb") as file:
        file.write(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 262144, 1))
        for number in range(FRAMES):
            octets = frame(PORTS[kind.link], kind.datagram(number))
            file.write(struct.pack("<IIII", 0, number, len(octets), len(octets)) + octets)


@contextmanager
def interfaces() -> Iterator[list[str]]:
    """Make two connected interfaces in a network namespace; yield what runs a command there."""
    lines = f"ip link add {NEAR} type veth peer name {FAR} && ip link set {NEAR} up && ip link set {FAR} up"
    ready = "echo ready && exec sleep infinity"
    holder = subprocess.Popen(
        ["unshare", "-n", "sh", "-c", f"{lines} && {ready}"], stdout=subprocess.PIPE, text=True
    )
    try:
        if holder.stdout.readline() != "ready\n":
            raise SystemExit("no network namespace: this needs root")
        yield ["nsenter", "-t", str(holder.pid), "-n"]
    finally:
        holder.kill()
        holder.communicate()


def measure(folder: Path) -> dict[str, object]:
    """Raise the rate for each program until it loses something; return what was sent, lost and used."""
    if not shutil.which("cc"):
        return {"sender": "no C compiler"}
    sender = folder / "frames"
    subprocess.run(["cc", "-O2", HERE / "frames.c", "-o", sender], check=True)
    found: dict[str, object] = {}
    with interfaces() as inside:
        for name, kind in kinds().items():
            capture, bridge = folder / "kind.pcap", folder / "kind.yaml"
            write_capture(capture, kind)
            bridge.write_text(json.dumps(mission(kind)))
            kept = folder / "kept"
            record = [EDORAS, "record", "--force", "-i", FAR, "-c", bridge, "-o", f"{kept}.mcap"]
            programs: dict[str, list[object]] = {"record -i": record}
            if shutil.which("dumpcap"):
                programs["dumpcap"] = ["dumpcap", "-q", "-i", FAR, "-f", "udp", "-w", f"{kept}.pcapng"]
            found[name] = {
                program: list(rising([*inside, *arguments], [*inside, str(sender), NEAR, str(capture)]))
                for program, arguments in programs.items()
            }
    return found | absent("dumpcap")


def rising(program: list[object], sender: list[str]) -> Iterator[dict[str, float]]:
    """Yield what became of each rate, as far as the first with a loss."""
    for rate in RATES:
        with running(program) as process:
            time.sleep(SETTLE_S)
            before = busy_ns(process.pid)
            done = subprocess.run(
                [*sender, str(rate), str(SECONDS)], check=True, capture_output=True, text=True
            )
            time.sleep(DRAIN_S)
            busy_s = (busy_ns(process.pid) - before) / 1e9
        sent = json.loads(done.stdout)
        told = subprocess.run([EDORAS, "info", "--json", program[-1]], capture_output=True, check=False)
        lost = sent["sent"] - json.loads(told.stdout)["datagrams"]
        yield {
            "asked_per_s": rate,
            "sent_per_s": round(sent["sent"] / sent["seconds"]),
            "lost": lost,
            "cpu_us_per_datagram": round(busy_s / sent["sent"] * 1e6, 2),
        }
        if lost:
            return


def main() -> None:
    """Measure."""
    with tempfile.TemporaryDirectory() as name:
        print(json.dumps(measure(Path(name)), indent=1))


if __name__ == "__main__":
    main()
