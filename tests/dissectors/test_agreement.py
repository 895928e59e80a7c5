"""Three readers, one answer: our own decoder, the scapy layers, and tshark with our Lua."""

import re
import struct
from contextlib import closing
from pathlib import Path

import pytest
from scapy.packet import Raw

from edoras_tools.decode import Context, Dissector
from edoras_tools.dissectors import scapy_layers
from edoras_tools.mission import load
from edoras_tools.model import Link
from edoras_tools.render.severity import EXPLANATIONS, Severity, ranked
from edoras_tools.ros import TypeStore
from edoras_tools.sources import open_file

ROOT = Path(__file__).parents[2]
COMMITTED = ROOT / "dissectors/edoras.lua"
CAPTURES = {
    "a_rover": ("rover_ground",),
    "b_arm_single": ("single_arm_ground",),
    "c1_tlm_rate_limit4": ("rover_ground",),
    "d3_cpu1_cpu2": ("two_rovers_ground", "two_rovers_flight"),
    "e_ci_errors": ("rover_ground",),
    "f_sbn_disconnect": ("two_rovers_ground", "two_rovers_flight"),
}
PREFIXES = {
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
}
RENAMED = {"ccsds_sp.msg_id": "edoras.msg_id", "sbn.sub.msg_ids": "sbn.subscription.msg_id"}
TYPES = TypeStore()
CONTROLS = dict.fromkeys(range(32), " ")
INDEX = re.compile(r"\[\d+\]")


def missions(names):
    return [ROOT / f"samples/missions/{name}.yaml" for name in names]


def decoded(capture, mission):
    """Yield every packet of a capture, by our own decoder."""
    dissector = Dissector(Context(mission, TYPES))
    with closing(open_file(capture)) as source:
        for batch in source.batches():
            for row in range(len(batch)):
                yield dissector.dissect(batch[row])


def header_fields(packet):
    """Return Wireshark's field name to values, of every header."""
    found = {}
    for layer in packet.layers:
        for item in layer.fields if layer.name in PREFIXES else ():
            name = f"{PREFIXES[layer.name]}.{item.name}"
            values = list(item.value) if isinstance(item.value, list) else [item.value]
            if values:
                found[RENAMED.get(name, name)] = values
    return found


def ros_fields(packet):
    """Return Wireshark's field name to values, of the ROS message."""
    found = {}
    if packet.message is not None:
        prefix = "ros2." + packet.message.type.replace("/msg/", ".")
        for path, value, _, _ in TYPES.spans(packet.message.type, packet.message.cdr):
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
    return text(shown, like) if isinstance(like, str) else int(shown, 0)


def text(shown, like):
    """Return the text meant: a line end is a space in an XML attribute, and in the packet list."""
    return like if shown == like.translate(CONTROLS) else shown


def read_ros(shown, raw, like, order):
    if isinstance(like, str):
        return text(shown, like)
    data = bytes.fromhex(raw)
    if isinstance(like, float):
        return struct.unpack(f"{order}{'f' if len(data) == 4 else 'd'}", data)[0]
    if isinstance(like, bool):
        return data != b"\0"
    return int.from_bytes(data, "big" if order == ">" else "little", signed=like < 0)


def agree_with_tshark(packet, frame):
    """Hold a frame of tshark's to a packet of ours; all that one says the other must say."""
    fields = dict(frame.fields)
    if packet.link is Link.OTHER or not packet.datagram.payload:
        assert not fields
        return 0
    headers, messages = header_fields(packet), ros_fields(packet)
    for name, values in headers.items():
        assert [read_header(*item, values[0]) for item in fields[name]] == values, name
    order = ">" if headers.get("ros2cdr.representation") == [0] else "<"
    for name, values in messages.items():
        there = fields[name]
        if len(there) == 1 and len(values) > 1:  # bytes
            assert list(bytes.fromhex(there[0][1])) == values, name
            continue
        read = [read_ros(*item, values[0], order) for item in there]
        assert list(map(bits, read)) == list(map(bits, values)), name
    said = {"edoras.link": [packet.link.label], "edoras.finding": packet.findings.labels}
    if packet.message is not None:
        said |= {"edoras.topic": [packet.message.topic], "edoras.type": [packet.message.type]}
    for name, values in said.items():
        assert [shown for shown, _ in fields.get(name, [])] == values, name
    expert = {f"edoras.finding.{label}" for label in packet.findings.labels}
    assert {name for name in fields if name.startswith("edoras.finding.")} == expert
    assert ("edoras.stop" in fields) == (packet.stop is not None)
    more = {name for name in fields if name not in headers and name not in messages}
    ours = ("edoras.", "sbn.subscription.")
    left = {name for name in more if not name.startswith(ours) and not name.endswith(("._count", "._item"))}
    types = {f"ros2.{packet.message.type.replace('/msg/', '.')}"} if packet.message else {"ros2cdr.body"}
    assert left <= types
    return len(headers) + len(messages)


def agree_with_columns(packet, frame):
    """Hold the packet list to ours: the same words."""
    if packet.link is Link.OTHER or not packet.datagram.payload:
        return
    assert frame.protocol == packet.link.name
    layers = {layer.name: layer.values() for layer in packet.layers}
    words = packet.summary.translate(CONTROLS)
    for finding in ranked(packet.findings, at_least=Severity.WARNING):
        assert EXPLANATIONS[finding].short in frame.info
    if "ccsds" in layers:
        assert f"0x{layers['ccsds']['msg_id']:04x}" in frame.info
    if packet.message:
        assert packet.message.topic in frame.info
    info = re.sub(r"  \[(gap of \d+|duplicate|reordered)\]$", "", frame.info)
    assert words.strip() in info, (words, info)


LAYERS = {
    "ccsds": "SpacePacket",
    "cfe_command": "CommandHeader",
    "cfe_telemetry": "TelemetryHeader",
    "cfe_event": "Event",
    "cfe_software_bus": "SoftwareBusHousekeeping",
    "sbn": "SBN",
    "sbn_sub": "SBNSubscriptions",
    "sbn_proto": "SBNProto",
    "edoras": "EdorasEnvelope",
    "cdr": "CDR",
}


def agree_with_scapy(packet):
    """Hold the scapy layers to a packet of ours."""
    payload = packet.datagram.payload
    if packet.link is Link.OTHER or not payload:
        return
    first = scapy_layers.SBN if packet.link is Link.SBN else scapy_layers.SpacePacket
    if not any(layer.name in LAYERS for layer in packet.layers):
        return  # not even the first header is whole
    read = first(payload)
    assert bytes(read) == payload
    for layer in packet.layers:
        if layer.name not in LAYERS:
            continue
        theirs = read.getlayer(getattr(scapy_layers, LAYERS[layer.name]))
        for item in layer.fields:
            if item.name == "msg_ids":
                assert [entry.msg_id for entry in theirs.subscriptions] == item.value
            else:
                assert getattr(theirs, item.name) == item.value, item.name
    names = {type(layer).__name__.replace("SBNLegacy", "SBN") for layer in layers_of(read)}
    assert names == {LAYERS[layer.name] for layer in packet.layers if layer.name in LAYERS}
    cdr = read.getlayer(scapy_layers.CDR)
    if packet.message is not None:
        assert repr(cdr.values) == repr(packet.message.values)
    elif cdr is not None:
        assert cdr.values is None


def layers_of(packet):
    while packet and not isinstance(packet, Raw):
        yield packet
        packet = packet.payload


@pytest.fixture
def taught():
    """Let scapy's layers know a mission, for one test."""

    def teach(mission):
        scapy_layers.use({route.msg_id: route.type for route in mission.routes}, TYPES)

    yield teach
    scapy_layers.use({})


@pytest.mark.parametrize("name", CAPTURES)
def test_on_every_packet_of_every_capture(name, tshark, taught):
    configs = missions(CAPTURES[name])
    capture = next((ROOT / "samples/captures").glob(f"{name}.pcap*"))  # tshark reads .gz too
    mission = load(configs)
    taught(mission)
    frames = tshark(*configs).frames(capture)
    fields = total = 0
    for packet in decoded(capture, mission):
        frame = frames[packet.datagram.number]
        fields += agree_with_tshark(packet, frame)
        agree_with_columns(packet, frame)
        agree_with_scapy(packet)
        total += 1
    assert total == len(frames) > 900
    assert fields > 5 * total


@pytest.mark.parametrize("name", ["a_rover", "b_arm_single"])
def test_the_committed_script_knows_each_demo(name, tshark):
    mission = load(missions(CAPTURES[name]))
    capture = ROOT / f"samples/captures/{name}.pcap"
    frames = tshark(script=COMMITTED).frames(capture)
    messages = 0
    for packet in decoded(capture, mission):
        if packet.message is not None:
            agree_with_tshark(packet, frames[packet.datagram.number])
            messages += 1
    assert messages > 100


