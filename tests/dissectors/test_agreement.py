"""Three readers, one answer: our own decoder, the scapy layers, and tshark with our Lua."""

import re
from contextlib import closing

import pytest
from effort import every, long_but
from places import ROOT, SAMPLE_MISSIONS
from scapy.packet import Raw

from edoras_tools.addons.lab.emulator import Simulation
from edoras_tools.cfs.arguments import ARGUMENTS, BARE_TOO, command_line
from edoras_tools.cfs.profile import SimProfile
from edoras_tools.decode import ColumnDecoder, Context, Dissector, Options
from edoras_tools.dissectors import scapy_layers
from edoras_tools.io.formats.open import open_file
from edoras_tools.links.sbn import SBN
from edoras_tools.mission import load
from edoras_tools.model import NO_MSG_ID, OTHER, Finding
from edoras_tools.ros import TypeStore
from edoras_tools.structs import Structs
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe
from edoras_tools.wire.ccsds import VERSION_1, VERSION_2

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


def decoded(capture, mission, options=None):
    """Yield every packet of a capture, by our own decoder."""
    dissector = Dissector(Context(mission, TYPES, options, structs=Structs()))
    with closing(open_file(capture)) as source:
        for batch in source.batches():
            for row in range(len(batch)):
                yield dissector.dissect(batch[row])


def agree_with_scapy(packet, known=LAYERS):
    """Hold the scapy layers to a packet of ours."""
    payload = packet.datagram.payload
    if packet.link is OTHER or not payload:
        return
    first = scapy_layers.SBN if packet.link is SBN else scapy_layers.SpacePacket
    if not any(layer.name in known for layer in packet.layers):
        return  # not even the first header is whole
    read = first(payload)
    assert bytes(read) == payload
    for layer in packet.layers:
        if layer.name not in known:
            continue
        theirs = read.getlayer(getattr(scapy_layers, known[layer.name]))
        for item in layer.fields:
            if item.name == "msg_ids":
                assert [entry.msg_id for entry in theirs.subscriptions] == item.value
            else:
                assert getattr(theirs, item.name) == item.value, item.name
    names = {type(layer).__name__.replace("SBNLegacy", "SBN") for layer in layers_of(read)}
    names -= {layout.name for layout in ARGUMENTS.values()}  # of commands, which are C structs to us
    assert names == {known[layer.name] for layer in packet.layers if layer.name in known}
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

    def teach(mission, **more):
        scapy_layers.use({route.msg_id: route.type for route in mission.routes}, TYPES, **more)

    yield teach
    scapy_layers.use({})


@pytest.mark.quick("f_sbn_disconnect")
@pytest.mark.parametrize("name", long_but(OF_EACH_KIND, SAMPLE_MISSIONS))
def test_on_every_packet_of_every_capture(name, tshark, taught, judge):
    configs = missions(SAMPLE_MISSIONS[name])
    capture = next((ROOT / "samples/captures").glob(f"{name}.pcap*"))  # tshark reads .gz too
    mission = load(configs)
    taught(mission)
    frames = tshark(*configs).frames(capture)
    fields = total = 0
    packets = list(decoded(capture, mission))
    for packet in every(3, packets):
        frame = frames[packet.datagram.number]
        fields += judge(packet, frame)
        agree_with_scapy(packet)
        total += 1
    assert len(packets) == len(frames) > 900
    assert fields > 5 * total


@pytest.mark.long
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


EXTENDED = LAYERS | {
    "cfe_extended": "ExtendedHeader",
    "cfe_command": "ExtendedCommandHeader",
    "cfe_telemetry": "ExtendedTelemetryHeader",
}


@pytest.mark.quick("version1*")
@pytest.mark.parametrize(
    ("version", "preference"), [(VERSION_1, "extended_header"), (VERSION_2, "msg_ids_of_version_2")]
)
def test_packets_with_extended_headers_that_we_wrote(
    version, preference, tshark, taught, judge, write_pcap, tmp_path
):
    """The traffic of an emulated cFS and its bridges, to four readers; all headers have 16 bytes."""
    profile = SimProfile(headers={item.msg_ids: item for item in cfe.HEADERS}[version])
    simulation = Simulation(profile, "two-rovers")
    sent = [(item.source.port, item.destination.port, item.payload) for item in simulation.run(8 * SECOND)]
    capture = write_pcap(tmp_path / "extended.pcap", sent)
    configs = [
        numbered(path, version, tmp_path) for path in missions(["two_rovers_ground", "two_rovers_flight"])
    ]
    mission = load(configs, msg_ids=version)
    assert not mission.warnings
    options = Options(extended_header=True, msg_id_version=version.version)
    taught(mission, extended_header=True, msg_ids=version)
    frames = tshark(*configs).frames(capture, "-o", f"edoras.{preference}:TRUE")
    seen = dict.fromkeys(("cfe_command", "cfe_telemetry", "cfe_event", "message"), 0)
    found = Finding(0)
    for packet in decoded(capture, mission, options):
        judge(packet, frames[packet.datagram.number])
        agree_with_scapy(packet, EXTENDED)
        for name in {layer.name for layer in packet.layers} & seen.keys():
            seen[name] += 1
        seen["message"] += packet.message is not None
        found |= packet.findings
    assert seen.pop("cfe_event") > 20
    assert min(seen.values()) > 100
    assert not found & (Finding.UNKNOWN_MSG_ID | Finding.WRONG_DIRECTION)
    decoder = ColumnDecoder(Context(mission, TYPES, options))
    with closing(open_file(capture)) as source:
        for batch in source.batches():
            columns = decoder.decode(batch)
            assert set(columns.header_length[columns.msg_id != NO_MSG_ID].tolist()) == {16}
            seen["message"] -= int((columns.cdr_offset >= 0).sum())
    assert seen["message"] == 0


def numbered(path, version, folder):
    """Write a mission file with the MsgIds that its packets have in a version."""
    text = path.read_text()
    made = re.sub(r"0x1?8[0-9A-Fa-f]{2}\b", lambda item: f"0x{version.of_known(int(item[0], 0)):04X}", text)
    (folder / path.name).write_text(made)
    return folder / path.name


def test_each_command_with_arguments_is_said_alike_by_tshark_and_our_lines(tshark, write_pcap, tmp_path):
    texts, sent = [], []
    for (msg_id, code), layout in ARGUMENTS.items():
        if layout.size and (msg_id, code) not in BARE_TOO:
            names = layout.by_name
            values = {
                name: "WORD" if slot.field.kind == "text" else next(iter(slot.field.names), 7)
                for name, slot in names.items()
                if name != "spare"
            }
            sent.append((1235, 1234, cfe.emit_command(msg_id, code, layout.emit(values))))
            texts.append(command_line(msg_id, code, values))
    capture = write_pcap(tmp_path / "commands.pcap", sent)
    frames = tshark().frames(capture)
    assert [frames[number].info.split("  ")[-1] for number in range(1, len(sent) + 1)] == texts
    context = Context()
    with closing(open_file(capture)) as source:
        ours = [
            Dissector(context).dissect(batch[row]) for batch in source.batches() for row in range(len(batch))
        ]
    assert [packet.summary for packet in ours] == texts
    assert len(texts) == 107
