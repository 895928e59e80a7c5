"""Three readers, one answer: our own decoder, the scapy layers, and tshark with our Lua."""

from contextlib import closing

import pytest
from effort import long_but
from places import ROOT, SAMPLE_MISSIONS
from scapy.packet import Raw

from edoras_tools.decode import Context, Dissector
from edoras_tools.dissectors import scapy_layers
from edoras_tools.io.formats.open import open_file
from edoras_tools.links.sbn import SBN
from edoras_tools.mission import load
from edoras_tools.model import OTHER
from edoras_tools.ros import TypeStore
from edoras_tools.structs import Structs

COMMITTED = ROOT / "dissectors/edoras.lua"
OF_EACH_KIND = ("a_rover", "b_arm_single", "e_ci_errors", "f_sbn_disconnect")
TYPES = TypeStore()
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


def missions(names):
    return [ROOT / f"samples/missions/{name}.yaml" for name in names]


def decoded(capture, mission):
    """Yield every packet of a capture, by our own decoder."""
    dissector = Dissector(Context(mission, TYPES, structs=Structs()))
    with closing(open_file(capture)) as source:
        for batch in source.batches():
            for row in range(len(batch)):
                yield dissector.dissect(batch[row])


def agree_with_scapy(packet):
    """Hold the scapy layers to a packet of ours."""
    payload = packet.datagram.payload
    if packet.link is OTHER or not payload:
        return
    first = scapy_layers.SBN if packet.link is SBN else scapy_layers.SpacePacket
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


@pytest.mark.parametrize("name", long_but(OF_EACH_KIND, SAMPLE_MISSIONS))
def test_on_every_packet_of_every_capture(name, tshark, taught, judge):
    configs = missions(SAMPLE_MISSIONS[name])
    capture = next((ROOT / "samples/captures").glob(f"{name}.pcap*"))  # tshark reads .gz too
    mission = load(configs)
    taught(mission)
    frames = tshark(*configs).frames(capture)
    fields = total = 0
    for packet in decoded(capture, mission):
        frame = frames[packet.datagram.number]
        fields += judge(packet, frame)
        agree_with_scapy(packet)
        total += 1
    assert total == len(frames) > 900
    assert fields > 5 * total


@pytest.mark.parametrize("name", ["a_rover", "b_arm_single"])
def test_the_committed_script_knows_each_demo(name, tshark, judge):
    mission = load(missions(SAMPLE_MISSIONS[name]))
    capture = ROOT / f"samples/captures/{name}.pcap"
    frames = tshark(script=COMMITTED).frames(capture)
    messages = 0
    for packet in decoded(capture, mission):
        if packet.message is not None:
            judge(packet, frames[packet.datagram.number])
            messages += 1
    assert messages > 100
