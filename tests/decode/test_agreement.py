"""Columns and stack give one answer, one line, one JSON: on every packet of the samples, and on any bytes."""

import json
import struct
from contextlib import closing

import numpy as np
import pytest
from effort import examples
from hypothesis import example, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from places import ROOT

from edoras_tools.addons.lab.emulator import Simulation, WireDatagram
from edoras_tools.cfs.profile import SimProfile
from edoras_tools.decode import ColumnDecoder, Context, Dissector, Options, lines
from edoras_tools.decode.filters.filter import Where
from edoras_tools.decode.filters.rows import ColumnRows
from edoras_tools.decode.lines import PacketLines, line_of
from edoras_tools.io.formats.open import open_file
from edoras_tools.io.frames.frame_batch import frames_of
from edoras_tools.io.frames.linklayer import Demux
from edoras_tools.links.bare import CI
from edoras_tools.mission import FlightSoftware, Mission, load
from edoras_tools.model import NO_MSG_ID, OTHER, Columns, Endpoint, Finding, PacketBatch, Peer
from edoras_tools.pipelines.capture.packet_json import PacketTexts, as_json
from edoras_tools.pipelines.sending.replay import Encoder
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.ros import TypeStore
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe, sbn
from edoras_tools.wire.envelope import EnvelopeFormat

CAPTURES = sorted((ROOT / "samples/captures").glob("*.pcap*"))
MISSIONS = {
    "none": (),
    "rover": ("rover_ground",),
    "arm": ("single_arm_ground",),
    "two rovers": ("two_rovers_ground", "two_rovers_flight"),
    "two arms": ("two_arms_ground", "two_arms_flight"),
}
TYPES = TypeStore()


def mission(name):
    files = [ROOT / f"samples/missions/{item}.yaml" for item in MISSIONS[name]]
    return load(files) if files else Mission()


def row_of_stack(decoded, context):
    """What columns say of a packet, read off its layers."""
    packet, head, command = (decoded.layer(name) for name in ("ccsds", "sbn", "cfe_command"))
    time, cdr = decoded.layer("cfe_telemetry"), decoded.layer("cdr")
    envelope = decoded.layer("edoras")
    ccsds, network = (layer.values() if layer else {} for layer in (packet, head))
    seconds = time.values() if time else None
    headers = [layer for layer in (packet, decoded.layer("cfe_extended"), command, time) if layer]
    secondary = command or time
    return {
        "link": decoded.link,
        "sbn_msg_type": network.get("msg_type", -1),
        "processor_id": network.get("processor_id", 0),
        "spacecraft_id": network.get("spacecraft_id", 0),
        "packet_offset": packet.start if packet else -1,
        "packet_length": len(decoded.datagram.payload) - packet.start if packet else 0,
        "msg_id": ccsds.get("msg_id", NO_MSG_ID),
        "sequence_flags": ccsds.get("sequence_flags", 0),
        "sequence_count": ccsds.get("packet_sequence_count", 0),
        "function_code": command.values()["function_code"] if command else -1,
        "mission_time_ns": context.time.ns(seconds["seconds"], seconds["subseconds"]) if seconds else -1,
        "header_length": (sum(item.end - item.start for item in headers) if secondary else 6)
        if packet
        else 0,
        "headers": decoded.layer("cfe_extended") is not None,
        "cdr_offset": cdr.start if cdr else -1,
        "cdr_length": envelope.values()["buffer_length"] if cdr else 0,
        "findings": decoded.findings.labels,
    }


def row_of_columns(batch, columns, index):
    row = {name: int(getattr(columns, name)[index]) for name in Columns.__struct_fields__}
    for name in ("packet_offset", "cdr_offset"):
        row[name] -= int(batch.offset[index]) if row[name] >= 0 else 0
    row["findings"] = Finding(row["findings"]).labels
    del row["route"]
    extended = cfe.HEADERS[row["headers"]].extended
    row["headers"] = extended and row["packet_length"] >= cfe.WITH_EXTENDED.start
    return row


def agree(batch, context):
    columns = ColumnDecoder(context).decode(batch)
    dissector = Dissector(context)
    rows = ColumnRows(context, 0, batch, columns)
    shown, texts = list(PacketLines(context).of(rows)), PacketTexts(context).of(rows)
    for index in range(len(batch)):
        decoded = dissector.dissect(batch[index])
        assert shown[index] == line_of(decoded)
        row = {"schema": 1} | as_json(decoded)
        assert texts[index] == json.dumps(row, ensure_ascii=False, separators=(",", ":"))
        spacecraft = {"spacecraft": context.spacecraft.of(decoded.datagram, decoded.link)}
        expected = row_of_stack(decoded, context) | spacecraft
        assert row_of_columns(batch, columns, index) == expected, (index, decoded.stop)
        route = int(columns.route[index])
        if route >= 0:
            assert context.mission.routes[route].link == decoded.link
            assert context.mission.routes[route].msg_id == columns.msg_id[index]
        clean = not decoded.findings & (Finding.CDR_INVALID | Finding.CAPTURE_CUT)
        if route >= 0 and columns.cdr_length[index] and clean:
            start = int(columns.cdr_offset[index])
            assert decoded.message.cdr == batch.data[start : start + int(columns.cdr_length[index])].tobytes()
    return columns


@pytest.fixture(autouse=True)
def _columns_of_few_packets_too(monkeypatch):
    monkeypatch.setattr(lines, "_FEW", 0)


def test_the_captures_are_there():
    assert len(CAPTURES) == 6


FITTING = {
    "b_arm_single": "arm",
    "e_ci_errors": "rover",
    "f_sbn_disconnect": "two rovers",
}
"""The missions of ``make test``; the larger captures are for ``make long``."""
PAIRS = [
    pytest.param(path, name, id=f"{path.name}-{name}", marks=[] if fits else pytest.mark.long)
    for path in CAPTURES
    for name in MISSIONS
    for fits in [name == FITTING.get(path.name.partition(".")[0])]
]


@pytest.mark.each(2)
@pytest.mark.quick("b_arm*", "f_sbn*")
@pytest.mark.parametrize(("path", "name"), PAIRS)
def test_on_every_packet_of_every_capture(path, name):
    context = Context(mission(name), TYPES)
    total = 0
    with closing(open_file(path)) as source:
        for batch in source.batches():
            agree(batch, context)
            total += len(batch)
    assert total == source.statistics.datagrams > 900


def batch_of(rows):
    """Make a batch of (payload, source port, destination port, findings)."""
    payloads = [row[0] for row in rows]
    lengths = np.array([len(payload) for payload in payloads], np.int32)
    offsets = (
        np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int64) if rows else np.zeros(0, np.int64)
    )
    count = len(rows)
    return PacketBatch(
        data=np.frombuffer(b"".join(payloads) or b"\0", np.uint8),
        number=np.arange(1, count + 1),
        time_ns=np.arange(count) * 1000,
        link_type=np.full(count, 101, np.uint16),
        frame_offset=offsets,
        frame_length=lengths,
        original_length=lengths,
        offset=offsets,
        length=lengths,
        source_address=np.full(count, 0x7F000001, np.uint32),
        source_port=np.array([row[1] for row in rows], np.uint16),
        destination_address=np.full(count, 0x7F000001, np.uint32),
        destination_port=np.array([row[2] for row in rows], np.uint16),
        ip_version=np.full(count, 4, np.uint8),
        capture_findings=np.array([row[3] for row in rows], np.uint32),
    )


CDR = bytes.fromhex("00010000") + struct.pack("<6d", 1, 2, 3, 4, 5, 6)
ENVELOPE = struct.pack("<QQ", len(CDR), len(CDR)) + CDR
GOOD = [
    cfe.emit_command(0x1827, 1, ENVELOPE),
    cfe.emit_command(0x1827, 1, ENVELOPE, sequence_flags=0, with_checksum=False),
    cfe.emit_command(0x1880, 6, b"127.0.0.1".ljust(16, b"\0")),
    cfe.emit_command(0x1806, 0),
    cfe.emit_telemetry(0x0827, ENVELOPE + bytes(40), seconds=7, subseconds=9, sequence_count=5),
    cfe.emit_telemetry(0x0808, bytes(156)),
    sbn.emit(3, Peer(66, 3), cfe.emit_command(0x1829, 1, ENVELOPE)),
    sbn.emit(3, Peer(66, 2), cfe.emit_telemetry(0x082A, ENVELOPE)),
    sbn.emit(1, Peer(66, 3), sbn.emit_subscriptions([sbn.Subscription(0x82A)])),
    sbn.emit(4, Peer(66, 3), sbn.emit_proto()),
    sbn.emit(0xA0, Peer(66, 3)),
    bytes.fromhex("0827c00000010000"),
    struct.pack("<6d", 0.5, 0, 0, 0, 0, -0.2),
    struct.pack("<7d", 0.5, 0, 0.7, 0, 0, 0, 1),
    struct.pack(">7d2i", 0.1, 0.5, 0, 0, 0, 0, 1, 1795241709, 5),
    bytes.fromhex("20000b0001050207000000021c016101 62"),  # CFDP: Metadata, file data with a CRC, NAK, EOF
    bytes.fromhex("32000b000105020000000c68656c6c6fabcd"),
    bytes.fromhex("280011000105020800000000000000640000000a00000014"),
    bytes.fromhex("21000e00010502040001020304000000000000021c"),
    bytes.fromhex("0303000000000000450000380001400040110000 0a000002 0a000004 1f90 04d2 0024 0000")
    + bytes(28),
    bytes.fromhex("0104000000000000 60000000 0010 1140")
    + bytes(32)
    + bytes.fromhex("1f902189 0010 0000")
    + bytes(8),
]


@st.composite
def payloads(draw):
    """Bytes at random, and good packets with a few bytes changed, cut or added."""
    if draw(st.booleans()):
        return draw(st.binary(max_size=120))
    data = bytearray(draw(st.sampled_from(GOOD)))
    for _ in range(draw(st.integers(0, 3))):
        data[draw(st.integers(0, len(data) - 1))] = draw(st.integers(0, 255))
    cut = draw(st.integers(0, len(data)))
    return bytes(data[:cut]) + draw(st.binary(max_size=30)) if draw(st.booleans()) else bytes(data)


ROWS = st.lists(
    st.tuples(
        payloads(),
        st.sampled_from([40000, 1235, 2234, 2235, 2236]),
        st.sampled_from([1234, 1235, 1236, 2234, 2235, 2236, 8080, 8585, 5111, 9, 0, 0]),
        st.sampled_from([0, 0, 0, int(Finding.CAPTURE_CUT)]),
    ),
    max_size=12,
)
ENVELOPE = st.sampled_from(["8/8", "4/4 be", "1/1", "auto"])
OPTIONS = st.builds(
    Options,
    extended_header=st.booleans(),
    telemetry_header=st.sampled_from([12, 16]),
    envelope=ENVELOPE,
) | st.builds(Options, msg_id_version=st.just(2), envelope=ENVELOPE)


@settings(max_examples=examples(400))
@given(rows=ROWS, name=st.sampled_from(sorted(MISSIONS)), options=OPTIONS)
@example(rows=[], name="none", options=Options())
@example(
    rows=[(good, 2236, port, 0) for good in GOOD for port in (1234, 1235, 2234, 8080, 8585, 5222, 0)],
    name="rover",
    options=Options(),
)
def test_on_any_bytes(rows, name, options):
    agree(batch_of(rows), Context(mission(name), TYPES, options))


@settings(max_examples=examples(60))
@given(rows=ROWS, name=st.sampled_from(sorted(MISSIONS)))
def test_a_batch_of_one_says_the_same_as_a_batch_of_many(rows, name):
    whole = batch_of(rows)
    together = ColumnDecoder(Context(mission(name), TYPES)).decode(whole)
    context = Context(mission(name), TYPES)
    for index in range(len(whole)):
        alone = ColumnDecoder(context).decode(whole.take(slice(index, index + 1)))
        for column in Columns.__struct_fields__:
            assert getattr(alone, column)[0] == getattr(together, column)[index], column


def test_what_the_capture_cut_is_not_blamed():
    cut = batch_of([(GOOD[0][:30], 1235, 1234, int(Finding.CAPTURE_CUT))])
    columns = ColumnDecoder(Context(mission("rover"), TYPES)).decode(cut)
    assert Finding(int(columns.findings[0])) == Finding.CAPTURE_CUT


def test_fragments_without_a_payload_belong_to_no_link():
    rows = batch_of([(b"", 0, 0, int(Finding.FRAGMENT)), (GOOD[3], 1235, 1234, 0)])
    columns = ColumnDecoder(Context(Mission(), TYPES)).decode(rows)
    assert list(columns.link) == [OTHER, CI]
    assert Finding(int(columns.findings[0])) == Finding.FRAGMENT


FORMS = {
    "[{length: u16be}, {capacity: u16be}]": "2/2 be",
    "[{length: u16be}]": "length: u16be",
    '["spare: u32le", "length: u16le", "crc: crc16le"]': "spare: u32le, length: u16le, crc: crc16le",
    "[{length: u64be}, {capacity: u64be}, {spare: u64be}, {crc: crc32be}]": (
        "length: u64be, capacity: u64be, spare: u64be, crc: crc32be"
    ),
}
CI_PORT = Endpoint("127.0.0.1", 1234)


@pytest.fixture(params=FORMS)
def own_envelope(request, tmp_path):
    """A mission whose commands have an envelope of their own, and what that is."""
    text = (ROOT / "samples/missions/rover_ground.yaml").read_text(encoding="utf-8")
    path = tmp_path / "rover.yaml"
    path.write_text(text.replace("mid: 0x1827", f"mid: 0x1827\n      envelope: {request.param}"))
    bench = Settings([path]).workbench()
    assert bench.mission.routes[0].envelope == FORMS[request.param]
    return bench, EnvelopeFormat.of_name(FORMS[request.param])


def own_packets(bench, form):
    """Yield a packet as it is sent, and what can be wrong with it, with the findings of each."""
    route = bench.mission.routes[0]
    packet = Encoder.of(route, bench).packet(TYPES.encode(route.type, {"linear": {"x": 1.5}}), 0).packet
    length_end = cfe.COMMAND_HEADER_BYTES + form.layout.by_name["buffer_length"].end
    yield packet, Finding(0)
    yield packet + b"\0\0\1", Finding.STALE_TAIL | Finding.LENGTH_MISMATCH
    yield packet[: cfe.COMMAND_HEADER_BYTES + form.size - 1], Finding.TRUNCATED
    if form.byte_order == "big":
        longer = packet[: length_end - 1] + bytes([packet[length_end - 1] ^ 0x40]) + packet[length_end:]
        yield longer, Finding.ENVELOPE_OVERRUN
    if form.crc:
        yield packet[:-1] + bytes([packet[-1] ^ 1]), Finding.CHECKSUM_BAD
        yield packet[: -form.crc], Finding.ENVELOPE_OVERRUN


def test_an_envelope_of_its_own_is_read_alike(own_envelope):
    bench, form = own_envelope
    context = bench.columns.context
    cases = list(own_packets(bench, form))
    sent = [WireDatagram(at, CI_PORT, CI_PORT, data) for at, (data, _) in enumerate(cases)]
    batch = Demux().demux(frames_of(sent, 1))
    columns = agree(batch, context)
    for found, (_, findings) in zip(columns.findings.tolist(), cases, strict=True):
        assert found & int(findings) == int(findings)
    assert not columns.findings[0] & int(Finding.CHECKSUM_BAD | Finding.STALE_TAIL | Finding.CDR_INVALID)
    first = bench.dissector.dissect(batch[0])
    assert first.message.values["linear"]["x"] == 1.5
    assert (first.layer("edoras_crc") is not None) == bool(form.crc)
    for expression, hit in (
        ("edoras.buffer_length == 52", True),
        ("edoras.buffer_capacity == 52", "buffer_capacity" in form.layout.by_name),
        ("linear.x == 1.5", True),
    ):
        mask = Where(expression, context).mask(batch, columns)
        assert bool(mask[0]) == hit, expression


def test_a_big_endian_cfs_is_read_alike_in_its_order():
    """Counters, events and housekeeping, beside those of the same traffic of a little-endian one."""
    found = []
    for big in (0, 1):
        simulation = Simulation(SimProfile(big_endian=big), start_ns=10**18, command_rate_hz=20.0)
        batch = Demux().demux(frames_of(list(simulation.run(10**18 + 9 * SECOND)), 1))
        software = FlightSoftware({"big_endian": big})
        context = Context(replace(mission("rover"), software=software), TYPES)
        columns = agree(batch, context)
        dissector = Dissector(context)
        decoded = [dissector.dissect(item) for item in batch]
        counts = [
            item.layer("cfe_software_bus").values()["message_limit_error_counter"]
            for item in decoded
            if item.layer("cfe_software_bus")
        ]
        events = [item.layer("cfe_event").values()["event_id"] for item in decoded if item.layer("cfe_event")]
        mask = Where("cfe_software_bus.message_limit_error_counter > 0", context).mask(batch, columns)
        assert 0 < counts[-1] <= simulation.cfs.bus.counters.msg_limits
        found.append((counts, events, int(mask.sum())))
    assert found[0] == found[1]
    assert found[0][2] > 0
