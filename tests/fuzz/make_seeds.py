"""Make the seeds anew: ``python tests/fuzz/make_seeds.py``; small inputs of every kind for every target."""

from __future__ import annotations

import gzip
import shutil
import struct
import sys
from contextlib import closing
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import zstandard
from fuzz_targets import LINK_TYPES, MESSAGES, ROOMS, ROOT, SCENARIOS, TYPES

from edoras_tools.decode import Context, Dissector
from edoras_tools.mission import load
from edoras_tools.model import Link
from edoras_tools.pipelines.record import Target, record
from edoras_tools.pipelines.selection import Selection
from edoras_tools.pipelines.workbench import Settings, open_files
from edoras_tools.sources import open_file
from edoras_tools.wire import cfe, sbn
from edoras_tools.wire.envelope import EnvelopeFormat

SEEDS = Path(__file__).parent / "seeds"
CAPTURES = ROOT / "samples/captures"
TWIST = TYPES.encode("geometry_msgs/msg/Twist", {"linear": {"x": 0.5}, "angular": {"z": 0.2}})
PEER = sbn.Peer(0x42, 3)


def room(port, **wanted):
    """The number of a room: its port, and options that differ from the usual."""
    for index, (where, _, options) in enumerate(ROOMS):
        if where == port and all(getattr(options, name) == value for name, value in wanted.items()):
            return bytes([index])
    raise LookupError(port, wanted)


def captured():
    """A packet of every kind in the samples: one for each link, MsgId or SBN type, and set of findings."""
    mission = load([ROOT / "samples/missions/rover_ground.yaml"])
    ports = {Link.CI: 1234, Link.TO: 1235, Link.SBN: 2234, Link.OTHER: 8080}
    seen = {}
    for path in sorted(CAPTURES.glob("*.pcap")):
        dissector = Dissector(Context(mission, TYPES))
        with closing(open_file(path)) as source:
            for batch in source.batches():
                for row in range(len(batch)):
                    decoded = dissector.dissect(batch[row])
                    layer = decoded.layer("ccsds") or decoded.layer("sbn")
                    values = layer.values() if layer else {}
                    kind = values.get("msg_id", values.get("msg_type", -1))
                    key = (decoded.link.label, kind, int(decoded.findings))
                    payload = decoded.datagram.payload
                    if key not in seen and len(payload) <= 1500:
                        seen[key] = room(ports[decoded.link]) + payload
    return {f"{link}_{kind & 0xFFFF:04x}_{findings:x}": data for (link, kind, findings), data in seen.items()}


def made():
    """What the samples lack: other headers, other envelopes, other ends."""
    packets = {
        "sbn_announce": room(2234) + sbn.emit(0xA1, PEER),
        "sbn_app_header_only": room(2234) + sbn.emit(3, PEER, bytes.fromhex("0827c0000001 0000")),
        "sbn_many_subscriptions": room(2234)
        + sbn.emit(1, PEER, sbn.emit_subscriptions([sbn.Subscription(0x800 + item) for item in range(20)])),
        "sbn_legacy_header": room(2234) + struct.pack(">hBI", 8, 3, 3) + bytes.fromhex("0827c00000010000"),
        "to_short_header": room(1235, telemetry_header=12)
        + cfe.emit_telemetry(0x827, EnvelopeFormat.named("8/8 le").emit(TWIST))[:6]
        + bytes(6)
        + EnvelopeFormat.named("8/8 le").emit(TWIST),
        "ci_extended_header": room(1234, extended_header=True)
        + bytes.fromhex("3827c000004901000000 0100")
        + EnvelopeFormat.named("8/8 le").emit(TWIST),
        "ci_big_endian": room(1234)
        + cfe.emit_command(
            0x1827,
            1,
            EnvelopeFormat.named("8/8 le").emit(TYPES.encode("geometry_msgs/msg/Twist", {}, big_endian=True)),
        ),
    }
    for name in ("4/4 le", "4/4 be", "8/8 be", "1/1"):
        envelope = EnvelopeFormat.named(name)
        for option in (name, "auto"):
            file = f"ci_envelope_{name.replace('/', '').replace(' ', '_')}_{option[0]}"
            packets[file] = room(1234, envelope=option) + cfe.emit_command(0x1827, 1, envelope.emit(TWIST))
    return packets


def ethernet(payload=b"\x18\x27\xc0\x00\x00\x01\x00\xde", ports=(40000, 1234), more=0, offset=0):
    """A frame; with ``more`` and ``offset`` a fragment."""
    udp = struct.pack(">HHHH", *ports, 8 + len(payload), 0) + payload if not offset else payload
    ip = struct.pack(
        ">BBHHHBBH4s4s",
        0x45,
        0,
        20 + len(udp),
        7,
        more << 13 | offset,
        64,
        17,
        0,
        b"\x7f\0\0\1",
        b"\x7f\0\0\1",
    )
    return bytes(12) + b"\x08\x00" + ip + udp


def framed(link_type, *frames):
    return bytes([LINK_TYPES.index(link_type)]) + b"".join(
        struct.pack("<H", len(item)) + item for item in frames
    )


def frames():
    frame = ethernet()
    ip = frame[14:]
    udp = ip[20:]
    ip6 = struct.pack(">IHBB", 0x60000000, len(udp), 17, 64) + bytes(15) + b"\1" + bytes(15) + b"\1" + udp
    fragment6 = struct.pack(">IHBB", 0x60000000, 8 + 16, 44, 64) + bytes(31) + b"\1"
    return {
        "ethernet": framed(1, frame, frame),
        "vlan": framed(1, frame[:12] + bytes.fromhex("8100000188a80002") + frame[12:]),
        "ipv6": framed(1, frame[:12] + b"\x86\xdd" + ip6),
        "fragments": framed(
            1,
            ethernet(bytes(16), more=1),
            ethernet(bytes(8), offset=3),
        ),
        "fragments6": framed(
            101,
            fragment6 + struct.pack(">BBHI", 17, 0, 1, 9) + udp,
            fragment6 + struct.pack(">BBHI", 17, 0, 2 << 3, 9) + bytes(8),
        ),
        "extensions6": framed(
            228 if 228 in LINK_TYPES else 101,
            ip6[:4] + struct.pack(">HBB", len(udp) + 8, 0, 64) + ip6[8:40] + b"\x11\0" + bytes(6) + udp,
        ),
        "cooked1": framed(113, bytes(14) + b"\x08\x00" + ip),
        "cooked2": framed(276, b"\x08\x00" + bytes(18) + ip),
        "loopback": framed(0, struct.pack("<I", 2) + ip),
        "loopback_network": framed(108, struct.pack(">I", 24) + ip6),
        "raw": framed(101, ip, ip6),
        "arp": framed(1, bytes(12) + b"\x08\x06" + bytes(28)),
    }


def captures(folder):
    """Files of every kind with a few packets each."""
    bench = Settings((ROOT / "samples/missions/rover_ground.yaml",)).workbench()
    files = {}
    for name in ("x.pcap", "x.pcapng", "x.mcap"):
        source = open_files([CAPTURES / "a_rover.pcap"])
        chosen = Selection(msg_ids=(0x1827, 0x827, 0x803, 0x808))
        record(source, bench, Target(folder / name), selection=chosen, clock=lambda: 0, count=8)
        # A recording names its source; where that is on this machine is nobody's business.
        files[name[2:]] = (folder / name).read_bytes().replace(bytes(ROOT), b"/" * len(bytes(ROOT)))
    pcap = files["pcap"]
    files["pcap_gz"] = gzip.compress(pcap, mtime=0)
    files["pcap_zst"] = zstandard.compress(pcap)
    words = struct.unpack("<IHHiIII", pcap[:24])
    swapped = bytearray(struct.pack(">IHHiIII", 0xA1B23C4D, *words[1:]))
    place = 24
    while place < len(pcap):
        head = struct.unpack_from("<IIII", pcap, place)
        swapped += struct.pack(">IIII", *head) + pcap[place + 16 : place + 16 + head[2]]
        place += 16 + head[2]
    files["pcap_big_endian_ns"] = bytes(swapped)
    files["pcapng_two_sections"] = files["pcapng"] * 2
    simple = ethernet()
    block = (
        struct.pack("<III", 3, 16 + (len(simple) + 3 & ~3), len(simple)) + simple + bytes(-len(simple) % 4)
    )
    start = files["pcapng"][: 28 + 32]
    files["pcapng_simple_packet"] = start + block + struct.pack("<I", len(block) + 4)
    return files


def recordings(folder):
    """Recordings cut off in several places."""
    whole = captures(folder)["mcap"]
    return {f"cut_{length}": whole[:length] for length in (8, 100, len(whole) // 2, -300, -8)} | {
        "whole": whole
    }


def messages():
    """Every type with nothing in it, and what the bridges send."""
    made = {}
    for index, name in enumerate(MESSAGES):
        short = name.rpartition("/")[2].lower()
        made[f"{short}_empty"] = bytes([index]) + TYPES.encode(name, {})
        made[f"{short}_big_endian"] = bytes([index]) + TYPES.encode(name, {}, big_endian=True)
    full = {
        "sensor_msgs/msg/JointState": {
            "name": ["a", "bc"],
            "position": [1.0, 2.0],
            "velocity": [0.5],
            "effort": [],
        },
        "geometry_msgs/msg/PoseStamped": {"header": {"frame_id": "world"}},
        "std_msgs/msg/String": {"data": "grüße"},
        "geometry_msgs/msg/Twist": {"linear": {"x": 0.5}},
    }
    for name, values in full.items():
        made[name.rpartition("/")[2].lower()] = bytes([MESSAGES.index(name)]) + TYPES.encode(name, values)
    return made


def sessions():
    """A command, an SBN peer that connects and leaves, telemetry for the bridge."""
    twist = cfe.emit_command(0x1827, 1, EnvelopeFormat.named("8/8 le").emit(TWIST))
    enable = cfe.emit_command(0x1880, 6, b"127.0.0.1".ljust(16, b"\0"))
    subscription = sbn.emit(1, PEER, sbn.emit_subscriptions([sbn.Subscription(0x82A)]))
    steps = [
        [(0, enable), (0, twist), (0, twist)],
        [(1, subscription), (1, sbn.emit(4, PEER, sbn.emit_proto())), (1, sbn.emit(3, PEER, twist))],
        [(1, subscription), (1, sbn.emit(0xA2, PEER)), (1, sbn.emit(2, PEER, subscription[11:]))],
        [(3, bytes.fromhex("0827c000006d") + bytes(110)), (0, cfe.emit_command(0x1803, 2))],
    ]
    return {
        f"{scenario}_{index}": bytes([number])
        + b"".join(bytes([port, len(data)]) + data for port, data in given)
        for number, scenario in enumerate(SCENARIOS)
        for index, given in enumerate(steps)
    }


def missions():
    """The sample missions, the figures of the paper, and the words that YAML has."""
    files = {path.stem: path.read_bytes() for path in (ROOT / "samples/missions").glob("*.yaml")}
    files |= {path.stem: path.read_bytes() for path in (ROOT / "tests/mission/figures").glob("*.yaml")}
    files["yaml"] = (
        b"%YAML 1.2\n---\na: &x [1, 0x2, 1e3, .nan, yes, ~, !!binary aGk=]\nb: {<<: *x, ? c : |\n  d\n}\n"
    )
    return files


def main(folder: Path = SEEDS) -> None:
    """Write all seeds."""
    shutil.rmtree(folder, ignore_errors=True)
    scratch = folder / "scratch"
    scratch.mkdir(parents=True)
    for target, files in {
        "packet": captured() | made(),
        "frames": frames(),
        "capture": captures(scratch),
        "recover": recordings(scratch),
        "mission": missions(),
        "message": messages(),
        "session": sessions(),
    }.items():
        (folder / target).mkdir()
        for name, data in files.items():
            (folder / target / name).write_bytes(data)
    shutil.rmtree(scratch)


if __name__ == "__main__":
    main()
