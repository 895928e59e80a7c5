"""The scapy layers: crafting fills in what is not given, showing names it, fuzzing and sniffing work."""

import pytest
from scapy.layers.inet import IP, UDP
from scapy.packet import Raw, fuzz
from scapy.sendrecv import sniff
from scapy.utils import hexdump, wrpcap

from edoras_tools.cfs.arguments import ARGUMENTS
from edoras_tools.decode import Context, Dissector
from edoras_tools.dissectors import scapy_layers as layers
from edoras_tools.dissectors.scapy_layers import (
    CDR,
    ENVELOPES,
    SBN,
    CommandHeader,
    EdorasEnvelope,
    Event,
    ExtendedCommandHeader,
    ExtendedHeader,
    ExtendedTelemetryHeader,
    SBNProto,
    SBNSubscription,
    SBNSubscriptions,
    ShortTelemetryHeader,
    SpacePacket,
    TelemetryHeader,
    command_arguments,
    envelope,
)
from edoras_tools.io.formats.open import open_file
from edoras_tools.links.bare import CI
from edoras_tools.links.sbn import SBN as SBN_LINK
from edoras_tools.mission import Mission
from edoras_tools.model import Finding, Peer
from edoras_tools.ros import TypeStore
from edoras_tools.wire import cfe, sbn
from edoras_tools.wire.envelope import ENVELOPE_FORMATS, EnvelopeFormat

TYPES = TypeStore()
TWIST = "geometry_msgs/msg/Twist"
VALUES = {"linear": {"x": 1.5, "y": 0.0, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": -0.25}}
BODY = TYPES.encode(TWIST, VALUES)
ENVELOPE = ENVELOPE_FORMATS[0].emit(BODY)


@pytest.fixture(autouse=True)
def known():
    layers.use({0x1827: TWIST, 0x0827: TWIST}, TYPES)
    yield
    layers.use({})


CRAFTED = [
    (
        SpacePacket(msg_id=0x1827) / CommandHeader(function_code=1) / EdorasEnvelope() / CDR(BODY),
        cfe.emit_command(0x1827, 1, ENVELOPE),
    ),
    (
        SpacePacket(msg_id=0x1827, sequence_flags=0) / CommandHeader(function_code=1, checksum=0) / ENVELOPE,
        cfe.emit_command(0x1827, 1, ENVELOPE, sequence_flags=0, with_checksum=False),
    ),
    (
        SpacePacket(apid=0x27) / TelemetryHeader(seconds=7) / EdorasEnvelope() / CDR(BODY) / Raw(bytes(8)),
        cfe.emit_telemetry(0x0827, ENVELOPE + bytes(8), seconds=7),
    ),
    (
        SpacePacket(msg_id=0x0808) / TelemetryHeader() / Event(app_name="APP", event_id=3, message="words"),
        cfe.emit_telemetry(0x0808, cfe.EVENT.emit({"app_name": "APP", "event_id": 3, "message": "words"})),
    ),
    (
        SBN(processor_id=3, spacecraft_id=66) / SpacePacket(msg_id=0x1806) / CommandHeader(),
        sbn.emit(sbn.MsgType.APP, Peer(66, 3), cfe.emit_command(0x1806, 0)),
    ),
    (
        SBN(processor_id=3, spacecraft_id=66)
        / SBNSubscriptions(subscriptions=[SBNSubscription(msg_id=2090)]),
        sbn.emit(sbn.MsgType.SUB, Peer(66, 3), sbn.emit_subscriptions([sbn.Subscription(0x82A)])),
    ),
    (
        SBN(processor_id=3, spacecraft_id=66) / SBNProto(),
        sbn.emit(sbn.MsgType.PROTO, Peer(66, 3), sbn.emit_proto()),
    ),
    (
        SBN(msg_type=sbn.MsgType.HEARTBEAT, processor_id=1, spacecraft_id=66),
        sbn.emit(sbn.MsgType.HEARTBEAT, Peer(66, 1)),
    ),
]


@pytest.mark.parametrize(("packet", "wire"), CRAFTED)
def test_crafted_packets_are_what_we_emit(packet, wire):
    assert bytes(packet) == wire
    carried = UDP(bytes(UDP() / packet))
    assert bytes(carried.payload) == wire
    assert [type(layer) for layer in _chain(carried.payload)][:1] == [type(packet)]


def _chain(packet):
    while packet and not isinstance(packet, Raw):
        yield packet
        packet = packet.payload


def test_a_message_from_values_and_back():
    packet = (
        SpacePacket(msg_id=0x1827) / CommandHeader(function_code=1) / EdorasEnvelope() / CDR.of(TWIST, VALUES)
    )
    read = UDP(bytes(UDP() / packet))
    assert read[CDR].values == VALUES
    assert read[CDR].type == TWIST
    assert read[SpacePacket].msg_id == 0x1827
    shown = read.show(dump=True)
    for words in (
        "CCSDS Space Packet",
        "packet_type= telecommand",
        "function_code= 1",
        "buffer_length= 52",
        TWIST,
    ):
        assert words in shown
    assert "0000" in hexdump(read, dump=True)
    layers.use({})
    with pytest.raises(ValueError, match="no types are known"):
        CDR.of(TWIST, VALUES)


def test_what_follows_the_cdr_is_not_of_it():
    read = SpacePacket(cfe.emit_telemetry(0x0827, ENVELOPE + b"stale"))
    assert read[CDR].body == BODY[4:]
    assert read[CDR].payload.load == b"stale"
    del read[EdorasEnvelope].buffer_length, read[EdorasEnvelope].buffer_capacity, read.packet_data_length
    assert bytes(read) == cfe.emit_telemetry(0x0827, ENVELOPE + b"stale")


@pytest.mark.parametrize("form", ENVELOPE_FORMATS, ids=str)
def test_envelopes_of_every_format_are_told_from_the_bytes(form):
    layers.use({})
    read = SpacePacket(cfe.emit_command(0x1999, 1, form.emit(BODY)))
    assert isinstance(read[ENVELOPES[form]].payload, CDR)
    crafted = SpacePacket(msg_id=0x1999) / CommandHeader(function_code=1) / ENVELOPES[form]() / CDR(BODY)
    assert bytes(crafted) == cfe.emit_command(0x1999, 1, form.emit(BODY))


@pytest.mark.parametrize("name", ["length: u16be, spare: u16be", "length: u32le, crc: crc32le"])
def test_an_envelope_of_its_own_is_read_and_built(name):
    form = EnvelopeFormat.of_name(name)
    layers.use({0x1999: TWIST}, TypeStore(), envelope=form)
    data = cfe.emit_command(0x1999, 1, form.emit(BODY))
    read = SpacePacket(data)
    assert read[envelope(form)].buffer_length == len(BODY)
    assert bytes(read[CDR])[: len(BODY)] == BODY
    assert len(read[CDR].payload) == form.crc
    crafted = SpacePacket(msg_id=0x1999) / CommandHeader(function_code=1) / envelope(form)() / CDR(BODY)
    assert bytes(crafted) == data


def test_other_headers():
    layers.use({}, extended_header=True)
    head = ExtendedHeader(subsystem_id=3, endian=1)
    packet = SpacePacket(msg_id=0x1827) / head / ExtendedCommandHeader(function_code=2) / Raw(b"ab")
    read = SpacePacket(bytes(packet))
    assert (read.msg_id, len(read)) == (0x1827, 18)
    assert read[ExtendedCommandHeader].function_code == 2
    assert cfe.checksum(bytes(packet)) == 0
    telemetry = SpacePacket(msg_id=0x0827) / head / ExtendedTelemetryHeader(seconds=7)
    assert SpacePacket(bytes(telemetry))[ExtendedTelemetryHeader].seconds == 7
    layers.use({}, telemetry_header=12)
    assert SpacePacket(cfe.emit_telemetry(0x0800, bytes(8)))[ShortTelemetryHeader].seconds == 0


def test_sbn_of_older_sources():
    read = UDP(bytes(UDP(sport=2236, dport=2234) / Raw(bytes.fromhex("000104000000030b"))))
    assert type(read[SBN]).__name__ == "SBNLegacy"
    assert read[SBNProto].protocol_version == sbn.PROTOCOL_VERSION


@pytest.mark.long
def test_fuzzed_packets_can_be_built_and_read():
    for _ in range(100):
        for packet in (
            SBN() / SpacePacket() / CommandHeader() / EdorasEnvelope() / CDR(),
            SpacePacket() / TelemetryHeader() / Event(),
            SBN() / SBNSubscriptions(),
        ):
            datagram = bytes(IP() / UDP() / fuzz(packet))
            assert bytes(IP(datagram)) == datagram


def test_our_own_decoder_reads_what_scapy_wrote(tmp_path):
    path = str(tmp_path / "crafted.pcap")
    wrpcap(path, [IP() / UDP() / packet for packet, _ in CRAFTED], linktype=101)
    dissector = Dissector(Context(Mission(), TYPES))
    (batch,) = open_file(path).batches()
    read = [dissector.dissect(batch[row]) for row in range(len(batch))]
    links = [CI] * 4 + [SBN_LINK] * 4
    assert [packet.link for packet in read] == links
    wrong = Finding.LENGTH_MISMATCH | Finding.CHECKSUM_BAD | Finding.SBN_SIZE_MISMATCH | Finding.TRUNCATED
    assert not any(packet.findings & wrong for packet in read)


def test_sniff_sees_layers(tmp_path):
    path = str(tmp_path / "crafted.pcap")
    wrpcap(path, [IP() / UDP() / packet for packet, _ in CRAFTED], linktype=101)
    seen = sniff(offline=path, lfilter=lambda packet: packet.haslayer(SpacePacket))
    assert [packet[SpacePacket].msg_id for packet in seen] == [0x1827, 0x1827, 0x0827, 0x0808, 0x1806]


def test_each_command_with_arguments_is_a_layer_of_its_own():
    for (msg_id, code), layout in ARGUMENTS.items():
        if layout.size:
            payload = bytes(range(1, layout.size + 1))
            packet = SpacePacket(cfe.emit_command(msg_id, code, payload))
            arguments = packet.lastlayer()
            assert isinstance(arguments, command_arguments(msg_id, code)), layout.title
            values = {name: arguments.getfieldval(name) for name in layout.by_name if name != "spare"}
            expected = layout.parse(payload)
            assert values == {name: expected[name] for name in values}
            assert bytes(arguments) == payload or any(slot.field.kind == "text" for slot in layout.slots)
