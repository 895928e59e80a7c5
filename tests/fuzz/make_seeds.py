"""Make the seeds anew: ``python tests/fuzz/make_seeds.py``; small inputs of every kind for every target."""

from __future__ import annotations

import gzip
import shutil
import sqlite3
import struct
import subprocess
import sys
from contextlib import closing
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

import fuzz_links
import rtps
import zstandard
from fuzz_inputs import BAG, SPLIT
from fuzz_targets import LINK_TYPES, MESSAGES, ROOMS, ROOT, SCENARIOS, TYPES
from fuzz_traffic import write_seeds
from mcap.writer import CompressionType, Writer

from edoras_tools.addons.rtps.link import RTPS_MAGIC
from edoras_tools.decode import Context, Dissector
from edoras_tools.io.formats.open import open_file
from edoras_tools.links.bare import CI, TO
from edoras_tools.links.sbn import SBN
from edoras_tools.mission import load
from edoras_tools.model import OTHER, Peer
from edoras_tools.pipelines.capture.record import Target, record
from edoras_tools.pipelines.reading import Limits
from edoras_tools.pipelines.selection import Selection
from edoras_tools.pipelines.workbench import Settings, open_files
from edoras_tools.wire import cfe, sbn
from edoras_tools.wire.envelope import EnvelopeFormat

SEEDS = Path(__file__).parent / "seeds"
CAPTURES = ROOT / "samples/captures"
TWIST = TYPES.encode("geometry_msgs/msg/Twist", {"linear": {"x": 0.5}, "angular": {"z": 0.2}})
PEER = Peer(0x42, 3)


def room(port, **wanted):
    """The number of a room: its port, and options that differ from the usual."""
    for index, (where, _, options) in enumerate(ROOMS):
        if where == port and all(getattr(options, name) == value for name, value in wanted.items()):
            return bytes([index])
    raise LookupError(port, wanted)


def captured():
    """A packet of every kind in the samples: one for each link, MsgId or SBN type, and set of findings."""
    mission = load([ROOT / "samples/missions/rover_ground.yaml"])
    ports = {CI: 1234, TO: 1235, SBN: 2234, OTHER: 8080}
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


def dds():
    """A message of RTPS with each set of submessages in the samples, and one that tells its topic itself."""
    found = {}
    for path in sorted((ROOT / "samples/rtps").glob("*.gz")):
        with closing(open_file(path)) as source:
            packets = [
                item for batch in source.batches() for item in map(batch.__getitem__, range(len(batch)))
            ]
        for item in packets:
            if item.payload.startswith(RTPS_MAGIC) and len(item.payload) < 1000:
                layers = Dissector(Context(types=TYPES)).dissect(item).layers
                name = "_".join(layer.name.removeprefix("rtps_") for layer in layers)[:60]
                found.setdefault(f"rtps_{name}", room(8080) + item.payload)
    found["rtps_topic"] = room(8080) + rtps.announced() + rtps.data(1, b"\0\1\0\0" + bytes(48))
    return found


def made():
    """What the samples lack: other headers, other envelopes, other ends."""
    packets = {
        "sbn_announce": room(2234) + sbn.emit(0xA1, PEER),
        "sbn_app_header_only": room(2234) + sbn.emit(3, PEER, bytes.fromhex("0827c0000001 0000")),
        "sbn_many_subscriptions": room(2234)
        + sbn.emit(1, PEER, sbn.emit_subscriptions([sbn.Subscription(0x800 + item) for item in range(20)])),
        "sbn_legacy_header": room(2234) + struct.pack(">hBI", 8, 3, 3) + bytes.fromhex("0827c00000010000"),
        "to_short_header": room(1235, telemetry_header=12)
        + cfe.emit_telemetry(0x827, EnvelopeFormat.of_name("8/8 le").emit(TWIST))[:6]
        + bytes(6)
        + EnvelopeFormat.of_name("8/8 le").emit(TWIST),
        "ci_extended_header": room(1234, extended_header=True)
        + bytes.fromhex("3827c000004901000000 0100")
        + EnvelopeFormat.of_name("8/8 le").emit(TWIST),
        "ci_big_endian": room(1234)
        + cfe.emit_command(
            0x1827,
            1,
            EnvelopeFormat.of_name("8/8 le").emit(
                TYPES.encode("geometry_msgs/msg/Twist", {}, big_endian=True)
            ),
        ),
    }
    for name in ("4/4 le", "4/4 be", "8/8 be", "1/1"):
        envelope = EnvelopeFormat.of_name(name)
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
        record(source, bench, Target(folder / name), selection=chosen, limits=Limits(8, clock=lambda: 0))
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
    """Recordings damaged in every way, and those of other writers."""
    whole = captures(folder)["mcap"]
    half = len(whole) // 2
    others = {
        f"foreign_{compression.name.lower()}{name}": foreign(folder, compression, crc, chunked)
        for compression in CompressionType
        for name, crc, chunked in (("", True, True), ("_no_crc", False, True), ("_no_chunks", True, False))
    }
    flipped = bytearray(whole)
    flipped[half] ^= 8
    return {
        **{f"cut_{length}": whole[:length] for length in (8, 100, half, -300, -8)},
        **others,
        "whole": whole,
        "flipped": bytes(flipped),
        "zeroed": whole[:half] + bytes(500) + whole[half + 500 :],
        "inserted": whole[:half] + b"\5 more bytes" + whole[half:],
        "removed": whole[:half] + whole[half + 30 :],
        "hole": bytes(half) + whole[half:],
        "joined": others["foreign_zstd"] + whole,
        "cut_joined": whole[:half] + others["foreign_lz4"],
    }


def foreign(folder, compression, crc, chunked):
    """What the mcap library writes."""
    path = folder / "foreign.mcap"
    with path.open("wb") as file:
        writer = Writer(file, 300, compression, enable_crcs=crc, enable_data_crcs=crc, use_chunking=chunked)
        writer.start("ros2", "another")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channels = [writer.register_channel(f"/chatter_{index}", "cdr", schema) for index in range(2)]
        for index in range(20):
            writer.add_message(channels[index % 2], index, b"%040d" % index, index)
        writer.add_attachment(0, 0, "a.txt", "text/plain", b"attached")
        writer.add_metadata("about", {"a": "b"})
        writer.finish()
    return path.read_bytes()


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
    twist = cfe.emit_command(0x1827, 1, EnvelopeFormat.of_name("8/8 le").emit(TWIST))
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


def definitions():
    """Messages as people write them: every kind of line."""
    texts = {
        "kinds": "bool a\nint8 b -1\nuint64[3] c [1, 2, 3]\nfloat32[] d\nfloat64[<=4] e\nstring<=7 f 'x'\n"
        "wstring g\nbyte h\nchar i\nstring[<=2] j ['a', \"b\"]\n",
        "constants": "# what they mean\nint32 A=-5\nfloat64 B=1e3 # tail\n"
        "string C=a b 'c'\nbool D=true\nint32 v 7\n",
        "nested": "std_msgs/Header header\ngeometry_msgs/msg/Point[2] points\nHeader h\n",
        "mistakes": "int33 a\nint8 9a\nint8 a\nint8 a\nstring<=x b\nint8[<] c\nuint8 d 256\nbool e 2\n",
        "empty": "# nothing\n\n",
    }
    return {name: text.encode() for name, text in texts.items()}


def filters():
    """Filters of every operator and kind of field."""
    texts = (
        "msg_id == 0x1829 and not link in {ci, to}",
        "linear.x > 0.1 or pose.position.x in {-1..2.5, 7}",
        'topic matches "robot_[12]/" and sbn.msg_type == SUB',
        "time >= 5s and time < 1m and (findings == stale_tail or length > 40)",
        "source == 127.0.0.1 and destination.port != 2236 and payload contains 0a:ff",
        "sequence_count in {1, 2, 5..9} and not (sbn.processor_id == 3) and len(payload) > 20",
        'cfe_event.message contains "Pipe" or type == "geometry_msgs/msg/Twist" or length == 7',
    )
    return {f"filter_{number}": text.encode() for number, text in enumerate(texts)}


def layouts():
    made = {"sample": (ROOT / "samples/structs/edoras_app.yaml").read_bytes()}
    made["all"] = (
        b"edoras_structs: 1\nbyte_order: big\npackage: made_msgs\nbind: {0x0826: A, '0x1827/2': B}\n"
        b"enums:\n  Mode: {type: int8, values: {OFF: 0, ON: 1, LOST: -1}}\n"
        b"structs:\n"
        b"  A: {size: 64, header: 16, members: {m: Mode, f: 'uint16:10', g: 'uint16:6', t: char, p: B}}\n"
        b"  B: {members: {x: float64 @ 0, y: 'float32[2][2] @ 8', u: U, last: 'uint8[]'}}\n"
        b"  U: {union: true, members: {a: uint32 hex, b: float32}}\n"
    )
    made["json"] = b'{"structs": {"A": {"members": {"x": "int32", "y": {"type": "byte[4]", "doc": "d"}}}}}'
    return made


def programs(folder):
    """Small object files with debug information, of four kinds; they need a compiler, and are kept."""
    source = folder / "a.c"
    source.write_text(
        "typedef enum { OFF, ON = -1 } Mode_t;\n"
        "typedef struct { unsigned char h[16]; Mode_t m; struct { float x, y; } p[2]; int f:10; } Hk_t;\n"
        "typedef union { int i; double d; } U_t;\n"
        "typedef struct { U_t u; char name[8]; struct Node *next; Hk_t hk; } Node_t;\nNode_t n;\n"
    )
    made = {}
    for name, flags in (
        ("dwarf4", ["-gdwarf-4"]),
        ("dwarf5", ["-gdwarf-5"]),
        ("packed", ["-g", "-fpack-struct"]),
        ("compressed", ["-g", "-gz"]),
    ):
        made[name] = _object(source, flags)
    made["no_debug_information"] = _object(source, [])
    return made


def _object(source, flags):
    target = source.with_suffix(".o")
    command = ["gcc", *flags, f"-fdebug-prefix-map={source.parent}=/", "-c", source.name, "-o", target.name]
    subprocess.run(command, check=True, cwd=source.parent)
    return target.read_bytes()


def scenarios():
    files = {path.stem: path.read_bytes() for path in (ROOT / "samples/scenarios").glob("*.yaml")}
    files["rules"] = (
        b"seed: 7\nprofile: lunar\nfaults:\n  - delay:200ms,to=cfs\n  - rate: 30\n    keep: latest\n"
        b"    msg_id: 0x1827\n    from: 10s\n    until: 1m\n  - corrupt: 1%\n    bits: 3\n  - silence: 12s\n"
    )
    return files


def bags(folder):
    """Bags of two messages: a database alone, with its metadata, and one that breaks its own rules."""
    made = {}
    for name, rows in {
        "database": [(1, 10**18, b"\0\1\0\0" + bytes(8)), (1, 10**18 + 1, b"\0\1\0\0x")],
        "wrong_kinds": [(1, "late", b"\0\1\0\0"), (1, 5, 7), (2, None, None), (1, 1.5, "text")],
    }.items():
        path = folder / f"{name}.db3"
        with closing(sqlite3.connect(path)) as database:
            database.execute("PRAGMA page_size = 512")
            database.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format)")
            database.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)")
            database.execute("INSERT INTO topics VALUES(1, '/a', 'std_msgs/msg/String', 'cdr')")
            if name == "wrong_kinds":
                database.execute("INSERT INTO topics VALUES(2, NULL, 7, 'cdr')")
            database.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)", rows)
            database.commit()
        made[name] = path.read_bytes()
    made["with_metadata"] = BAG + SPLIT + made["database"]
    made["mcap"] = captures(folder)["mcap"]
    return made


def main(folder: Path = SEEDS) -> None:
    """Write all seeds."""
    shutil.rmtree(folder, ignore_errors=True)
    scratch = folder / "scratch"
    scratch.mkdir(parents=True)
    for target, files in {
        "packet": captured() | made() | dds(),
        "frames": frames(),
        "capture": captures(scratch),
        "recover": recordings(scratch),
        "mission": missions(),
        "message": messages(),
        "session": sessions(),
        "definition": definitions(),
        "where": filters(),
        "structs": layouts(),
        "elf": programs(scratch),
        "scenario": scenarios(),
        "rosbag2": bags(scratch),
        "doctor": {name: data for name, data in captures(scratch).items() if not name.startswith("pcap_")},
        **fuzz_links.seeds(),
    }.items():
        (folder / target).mkdir()
        for name, data in files.items():
            (folder / target / name).write_bytes(data)
    (folder / "diagnosis").mkdir()
    write_seeds(folder / "diagnosis")
    shutil.rmtree(scratch)


if __name__ == "__main__":
    main()
