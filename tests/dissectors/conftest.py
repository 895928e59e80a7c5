"""Running tshark with our Lua, and reading what it says."""

import re
import struct
import subprocess
from contextlib import closing
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory
from xml.parsers import expat

import pytest

from edoras_tools.addons.fprime.link import FPRIME
from edoras_tools.addons.frames.link import FRAMES
from edoras_tools.addons.frames.unframer import Unframer
from edoras_tools.addons.racs2.link import BODY_FIELDS, RACS2
from edoras_tools.addons.wireshark.program import dissector
from edoras_tools.cfs.arguments import SERVICES
from edoras_tools.decode import ColumnDecoder, Context
from edoras_tools.io.formats.open import open_file
from edoras_tools.mission import Mission, load
from edoras_tools.model import OTHER
from edoras_tools.pipelines.reading import reading
from edoras_tools.pipelines.workbench import Settings, Workbench
from edoras_tools.render.severity import EXPLANATIONS, Level, ranked
from edoras_tools.ros import TypeStore
from edoras_tools.structs import Structs
from edoras_tools.structs.files import load_layout

OURS = "ccsds_sp cfe sbn robot racs2 frames fprime edoras ros2cdr"
PREFIXES = tuple(f"{name}." for name in (*OURS.split(), "ros2"))


COLUMNS = """
local file, tap = assert(io.open("%s", "w")), Listener.new("frame")
function tap.packet(packet)
  file:write(packet.number, "\\t", tostring(packet.cols.protocol), "\\t", tostring(packet.cols.info), "\\n")
end
"""
"""Lua that writes the columns. With the tree tshark makes none, but for statistics, here of no flows."""


@dataclass
class Frame:
    """What tshark says of one frame: field name to (show, raw bytes as hex) of each occurrence."""

    fields: dict[str, list[tuple[str, str]]] = field(default_factory=dict)
    info: str = ""
    protocol: str = ""


class Tshark:
    """tshark with one generated dissector; whatever it says of Lua fails the test."""

    def __init__(self, script, settings):
        self.script = script
        if settings is not None:
            script.write_text(dissector(settings)[0])

    def run(self, *arguments, script=True, more=()):
        scripts = [*([self.script] if script else []), *more]
        lua = [word for path in scripts for word in ("-X", f"lua_script:{path}")]
        command = ["tshark", "-n", *lua, *map(str, arguments)]
        done = subprocess.run(command, capture_output=True, check=False, timeout=300)
        said = [line for line in done.stderr.decode().splitlines() if line and "Running as user" not in line]
        assert not said, said[:5]
        assert done.returncode == 0
        assert b"Lua Error" not in done.stdout
        return done.stdout

    def frames(self, capture, *options):
        """Return what is said of every frame of a capture, by number: of the tree, and of the columns."""
        found: dict[int, Frame] = {}
        current = Frame()

        def start(name, attributes):
            nonlocal current
            label = attributes.get("name", "")
            if name == "field" and label == "num":
                current = found.setdefault(int(attributes["show"], 0), Frame())
            elif name == "field" and label.startswith(PREFIXES):
                shown = attributes.get("show", ""), attributes.get("value", "")
                current.fields.setdefault(label, []).append(shown)

        parser = expat.ParserCreate()
        parser.StartElementHandler = start
        with TemporaryDirectory() as folder:
            columns, script = Path(folder, "columns.txt"), Path(folder, "columns.lua")
            script.write_text(COLUMNS % columns)
            both = ["-T", "pdml", "-J", OURS, "-z", "flow,lbm_uim,standard", *options]
            parser.Parse(self.run("-r", capture, *both, more=[script]), True)
            for line in columns.read_text().splitlines():
                number, protocol, info = line.split("\t", 2)
                frame = found.setdefault(int(number), Frame())
                frame.protocol, frame.info = protocol, info
        return found


LAYERS = {
    "ccsds": "ccsds_sp",
    "cfe_extended": "cfe.extended",
    "cfe_command": "cfe.command",
    "cfe_telemetry": "cfe.telemetry",
    "cfe_event": "cfe.event",
    "cfe_software_bus": "cfe.software_bus",
    "sbn": "sbn",
    "sbn_sub": "sbn.sub",
    "sbn_proto": "sbn.proto",
    "edoras": "edoras",
    "cdr": "ros2cdr",
    "robot_command": "robot.command",
    "robot_pose": "robot.pose",
    "robot_state": "robot.state",
    "racs2_topic": "racs2.topic",
    "racs2_message": "racs2.message",
    "fprime": "fprime",
    **{layout.name: f"fprime.{layout.name[7:]}" for layout in FPRIME.layouts[1:]},
    **{layout.name: f"frames.{layout.name}" for layout in FRAMES.layouts},
}
RENAMED = {
    "ccsds_sp.msg_id": "edoras.msg_id",
    "sbn.sub.msg_ids": "sbn.subscription.msg_id",
    "fprime.fprime.crc32": "fprime.crc32",
}
CONTROLS = dict.fromkeys((*range(32), 127), " ")
INDEX = re.compile(r"\[\d+\]")


def header_fields(packet):
    """Return Wireshark's field name to values, of every header."""
    found = {}
    for layer in packet.layers:
        for item in layer.fields if layer.name in LAYERS else ():
            prefix = LAYERS[layer.name]
            if item.name in ("frame_error_control", "body_length"):
                prefix = packet.link.label
            elif packet.link is RACS2 and item.name in BODY_FIELDS:
                prefix = "racs2.body"
            name = f"{prefix}.{item.name}"
            values = list(item.value) if isinstance(item.value, list) else [item.value]
            if values:
                found.setdefault(RENAMED.get(name, name), []).extend(values)
    return found


def entry_fields(packet):
    """Return Wireshark's field name to values, of what a dictionary of F Prime names."""
    found = {}
    entries = [layer for layer in packet.layers if layer.name == "cfs"] if packet.link is FPRIME else []
    for layer, message in zip(entries, packet.messages if entries else (), strict=True):
        prefix = message.topic[1:].replace("/", ".")
        for item in layer.fields:
            values = item.value if isinstance(item.value, list) else [item.value]
            found.setdefault(f"{prefix}.{INDEX.sub('', item.name)}", []).extend(values)
    return found


def ros_fields(packet, types):
    """Return Wireshark's field name to values, of the ROS message."""
    found = {}
    if packet.message is not None and packet.message.cdr and packet.link is not FPRIME:
        prefix = "ros2." + packet.message.type.replace("/msg/", ".")
        for path, value, _, _ in types.spans(packet.message.type, packet.message.cdr):
            values = value if isinstance(value, list) else [value]
            if values:
                found.setdefault(f"{prefix}.{INDEX.sub('', path)}", []).extend(values)
    return found


def bits(value):
    """Return a value so that floats compare to the bit."""
    return struct.pack("<d", value) if isinstance(value, float) else value


def read_header(shown, raw, like):
    if isinstance(like, bytes):
        return bytes.fromhex(raw)
    if isinstance(like, float):
        return struct.unpack("<d" if len(raw) == 16 else "<f", bytes.fromhex(raw))[0]
    if isinstance(like, bool):
        return shown in {"1", "True"}
    return text(shown, like) if isinstance(like, str) else int(shown, 0)


def text(shown, like):
    """Return the text meant: Wireshark's ends at a NUL, and what cannot be printed it spells out."""
    like_shown = like.partition("\0")[0]
    return like if shown == like_shown or not like_shown.isprintable() else shown


def read_ros(shown, raw, like, order):
    if isinstance(like, str):
        return text(shown, like)
    data = bytes.fromhex(raw)
    if isinstance(like, float):
        return struct.unpack(f"{order}{'f' if len(data) == 4 else 'd'}", data)[0]
    if isinstance(like, bool):
        return data != b"\0"
    return int.from_bytes(data, "big" if order == ">" else "little", signed=like < 0)


def read_entry(shown, raw, like):
    if isinstance(like, str):
        return text(shown, like)
    data = bytes.fromhex(raw)
    if isinstance(like, float):
        return struct.unpack(">f" if len(data) == 4 else ">d", data)[0]
    return data != b"\0" if isinstance(like, bool) else int.from_bytes(data, "big", signed=like < 0)


def joined(found):
    """Return one dict of lists of many."""
    whole = {}
    for one in found:
        for name, values in one.items():
            whole.setdefault(name, []).extend(values)
    return whole


def agree_with_tshark(packets, frame, types):
    """Hold a frame of tshark's to what we found in it; all that one says the other must say."""
    fields = {name: list(values) for name, values in frame.fields.items()}
    packets = [item for item in packets if item.link is not OTHER and item.datagram.payload]
    if not packets:
        assert not fields
        return 0
    headers = joined(map(header_fields, packets))
    messages = joined(ros_fields(item, types) for item in packets)
    entries = joined(map(entry_fields, packets))
    for name, values in headers.items():
        read = [read_header(*item, like) for item, like in zip(fields[name], values, strict=True)]
        assert read == values, name
    for name, values in entries.items():
        read = [read_entry(*item, like) for item, like in zip(fields[name], values, strict=True)]
        assert list(map(bits, read)) == list(map(bits, values)), name
    order = ">" if headers.get("ros2cdr.representation") == [0] else "<"
    for name, values in messages.items():
        there = fields[name]
        if len(there) == 1 and len(values) > 1:  # bytes
            assert list(bytes.fromhex(there[0][1])) == values, name
            continue
        read = [read_ros(*item, like, order) for item, like in zip(there, values, strict=True)]
        assert list(map(bits, read)) == list(map(bits, values)), name
    if 0 in headers.get("ccsds_sp.packet_type", []) and not any(
        "struct_length" in item.findings.labels for item in packets
    ):
        # Without C structs housekeeping has any length; tests/addons/wireshark/test_lua.py holds it.
        fields["edoras.finding"] = [
            item for item in fields.get("edoras.finding", []) if item[0] != "struct_length"
        ]
        fields.pop("edoras.finding.struct_length", None)
    found = [message for item in packets for message in item.messages]
    said = {
        "edoras.link": [item.link.label for item in packets],
        "edoras.finding": [label for item in packets for label in item.findings.labels],
        "edoras.topic": [message.topic for message in found],
        "edoras.type": [message.type for message in found],
    }
    for name, values in said.items():
        if values or name not in {"edoras.topic", "edoras.type"}:
            assert [shown for shown, _ in fields.get(name, [])] == values, name
    expert = {f"edoras.finding.{label}" for label in said["edoras.finding"]}
    assert {name for name in fields if name.startswith("edoras.finding.")} == expert
    assert len(fields.get("edoras.stop", [])) == sum(item.stop is not None for item in packets)
    more = {name for name in fields if name not in headers and name not in messages and name not in entries}
    arguments = [f"cfe.{label}." for label, _ in SERVICES.values()]  # tests/dissectors/test_lua.py holds them
    ours = ("edoras.", "sbn.subscription.", *arguments)
    left = {name for name in more if not name.startswith(ours) and not name.endswith(("._count", "._item"))}
    kinds = {f"ros2.{item.type.replace('/msg/', '.')}" for item in found} or {"ros2cdr.body"}
    assert left <= kinds
    return len(headers) + len(messages) + len(entries)


def agree_with_columns(packet, frame, outer):
    """Hold the packet list to ours: the same words, also of what is in a frame, behind its own."""
    if packet.link is OTHER or not packet.datagram.payload:
        return
    assert frame.protocol == outer.link.name
    layers = {layer.name: layer.values() for layer in packet.layers}
    words = packet.summary.translate(CONTROLS)
    for finding in ranked(packet.findings, at_least=Level.WARNING):
        assert EXPLANATIONS[finding].short in frame.info
    if "ccsds" in layers:
        assert f"0x{layers['ccsds']['msg_id']:04x}" in frame.info
    if packet.message and packet.link is not FPRIME:
        assert packet.message.topic in frame.info
    info = re.sub(r"  \[(gap of \d+|duplicate|reordered)\]$", "", frame.info)
    # Without C structs a command is a name; Wireshark says its arguments, too.
    words = re.sub(r"^function code \d+ (?=[A-Z])", "", words)
    assert words.strip() in info, (words, info)


@pytest.fixture(scope="session")
def judge():
    """Hold a frame of tshark's to the packets of our own decoder in it: tree, findings and packet list."""
    humble = TypeStore()

    def hold(packet, frame, types=humble):
        packets = packet if isinstance(packet, list) else [packet]
        known = [item for item in packets if item.link is not OTHER]
        for item in known:
            agree_with_columns(item, frame, known[0])
        return agree_with_tshark(packets, frame, types)

    return hold


@pytest.fixture(scope="session")
def tshark(tmp_path_factory):
    """Make a tshark that knows missions, or runs a script that is there."""

    def make(*configs, script=None, **settings):
        if script is not None:
            return Tshark(script, None)
        return Tshark(tmp_path_factory.mktemp("lua") / "edoras.lua", Settings(configs, **settings))

    return make


@pytest.fixture(scope="session")
def agreed(tshark, judge):
    """Hold tshark to all that we find in a capture, frame by frame.

    It returns our bench, how many fields were compared, our packets by frame, and the gaps that tshark told.
    """

    def hold(path, *configs, structs=()):
        mission, types = load(configs) if configs else Mission(), TypeStore()
        context = Context(mission, types, structs=Structs([load_layout(item) for item in structs]))
        unwrappers = {FRAMES: Unframer(context.frames)} if context.frames else {}
        bench, found = Workbench(mission, types, ColumnDecoder(context), unwrappers), []
        with closing(open_file(path)) as source, reading(source, bench) as loop:
            for rows in loop:
                found += [bench.dissector.dissect(rows.batch[row]) for row in range(len(rows.batch))]
        groups = groupby(found, lambda packet: packet.datagram.number)
        ours = {number: list(packets) for number, packets in groups}
        theirs = tshark(*configs, structs=structs).frames(path)
        compared = sum(judge(packets, theirs[number], types) for number, packets in ours.items())
        assert all(not frame.fields for number, frame in theirs.items() if number not in ours)
        told = [item for frame in theirs.values() for item in frame.fields.get("edoras.gap", [])]
        return bench, compared, ours, [int(shown) for shown, _ in told]

    return hold


@pytest.fixture(scope="session")
def write_pcap():
    """Write (source port, destination port, payload) as raw IPv4 frames on loopback, 1 ms apart.

    All of them once for each of ``snaps``, and no more bytes of each than that.
    """

    def write(path, datagrams, *, snaps=(65535,)):
        with Path(path).open("wb") as file:
            file.write(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 262144, 101))
            cut = ((snap, *datagram) for snap in snaps for datagram in datagrams)
            for number, (snap, source, destination, payload) in enumerate(cut):
                udp = struct.pack(">HHHH", source, destination, 8 + len(payload), 0) + payload
                host = b"\x7f\0\0\1"
                ip = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0) + host + host
                frame = (ip + udp)[:snap]
                second, microsecond = divmod(number * 1000, 1_000_000)
                lengths = len(frame), len(ip + udp)
                file.write(struct.pack("<IIII", second, microsecond, *lengths) + frame)
        return path

    return write
