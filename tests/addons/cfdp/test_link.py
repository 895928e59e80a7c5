"""CFDP: PDUs that the ``spacepackets`` package writes, as our readers and Wireshark's dissector read them."""

import subprocess
from contextlib import closing
from itertools import pairwise

import numpy as np
import pytest
from effort import examples
from field_filters import compared
from hypothesis import given, settings
from hypothesis import strategies as st
from rewriting import Udp, write
from spacepackets.cfdp import (
    ChecksumType,
    ConditionCode,
    CrcFlag,
    Direction,
    DirectiveType,
    LargeFileFlag,
    PduConfig,
    TransmissionMode,
)
from spacepackets.cfdp.pdu import (
    AckPdu,
    EofPdu,
    FinishedPdu,
    KeepAlivePdu,
    MetadataParams,
    MetadataPdu,
    NakPdu,
    PromptPdu,
)
from spacepackets.cfdp.pdu.ack import TransactionStatus
from spacepackets.cfdp.pdu.file_data import (
    FileDataParams,
    FileDataPdu,
    RecordContinuationState,
    SegmentMetadata,
)
from spacepackets.cfdp.pdu.finished import DeliveryCode, FileStatus, FinishedParams
from spacepackets.cfdp.pdu.prompt import ResponseRequired
from spacepackets.util import ByteFieldGenerator
from transfer_frames import batch_of

from edoras_tools.addons.cfdp import link as cfdp
from edoras_tools.addons.cfdp.link import CFDP
from edoras_tools.addons.cfdp.transactions import FileEvidence
from edoras_tools.addons.wireshark.program import dissector
from edoras_tools.decode.filters.rows import ColumnRows
from edoras_tools.errors import ConfigError
from edoras_tools.io.formats.open import open_file
from edoras_tools.links.table import among
from edoras_tools.model import NO_FINDINGS, Finding
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.sessions.faults.rules import parse_rule
from edoras_tools.wire import cfe


def configuration(width=2, count=4, *, crc=False, large=False, toward_sender=False):
    return PduConfig(
        ByteFieldGenerator.from_int(width, 1),
        ByteFieldGenerator.from_int(width, 2),
        ByteFieldGenerator.from_int(count, 77),
        TransmissionMode.ACKNOWLEDGED,
        file_flag=LargeFileFlag(int(large)),
        crc_flag=CrcFlag(int(crc)),
        direction=Direction(int(toward_sender)),
    )


def every_kind(large):
    """Yield a PDU of each kind, and the fields that are to be read from it."""
    one, back = configuration(large=large), configuration(large=large, toward_sender=True)
    size = 1 << 33 if large else 1000
    names = {"source_file_name": "data/scan_1", "destination_file_name": "/scan_1"}
    told = MetadataParams(True, ChecksumType.CRC_32, size, *names.values())
    yield MetadataPdu(one, told), {"closure_requested": 1, "checksum_type": 3, "file_size": size, **names}
    yield FileDataPdu(one, FileDataParams(b"hello", size - 5)), {"offset": size - 5, "data_length": 5}
    pieces = FileDataParams(b"hello", 7, SegmentMetadata(RecordContinuationState.START_AND_END, b"about"))
    yield FileDataPdu(configuration(large=large, crc=True), pieces), {"offset": 7, "data_length": 5}
    missing = [(0, 10), (20, size)]
    yield NakPdu(back, 0, size, missing), {"end_of_scope": size, "segment_requests": [[0, 10], [20, size]]}
    yield (
        EofPdu(one, bytes(4), size, condition_code=ConditionCode.CANCEL_REQUEST_RECEIVED),
        {"condition_code": 15},
    )
    wrong = FinishedParams(
        ConditionCode.FILE_CHECKSUM_FAILURE, DeliveryCode.DATA_INCOMPLETE, FileStatus.DISCARDED_DELIBERATELY
    )
    yield FinishedPdu(back, wrong), {"condition_code": 5, "delivery_code": 1, "file_status": 0}
    ack = AckPdu(back, DirectiveType.EOF_PDU, ConditionCode.NO_ERROR, TransactionStatus.ACTIVE)
    yield ack, {"acknowledged_directive": 4, "transaction_status": 1}
    yield PromptPdu(one, ResponseRequired.KEEP_ALIVE), {"response_required": 1}
    yield KeepAlivePdu(back, 12), {"progress": 12}


KINDS = [item for large in (False, True) for item in every_kind(large)]


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    ends = ("127.0.0.1", 5111), ("127.0.0.1", 5222)
    items = [
        Udp(number, *(ends[::-1] if pdu.pdu_header.direction else ends), bytes(pdu.pack()))
        for number, (pdu, _) in enumerate(KINDS)
    ]
    return write(tmp_path_factory.mktemp("cfdp") / "kinds.pcap", items)


@pytest.fixture(scope="module")
def rows(capture):
    bench = Settings().workbench()
    with closing(open_file(capture)) as source:
        (batch,) = (batch for batch in source.batches() if len(batch))
    return bench, ColumnRows(bench.columns.context, 0, batch, bench.columns.decode(batch))


def test_each_kind_is_read_as_it_was_written(rows):
    bench, found = rows
    assert among(found.column("link"), lambda link: link is CFDP).all()
    for index, (pdu, expected) in enumerate(KINDS):
        decoded = bench.dissector.dissect(found.batch[index])
        assert not decoded.findings
        assert decoded.stop is None
        head, last = decoded.layer("cfdp").values(), decoded.layers[-1].values()
        assert [head[name] for name in ("source_entity_id", "transaction_sequence_number")] == [1, 77]
        assert (head["destination_entity_id"], head["direction"]) == (2, pdu.pdu_header.direction)
        assert expected.items() <= last.items()
        assert " of 1:77" in decoded.summary


def with_crcs():
    """Yield PDUs that end with a CRC by ``spacepackets``; each also with one wrong bit in each byte."""
    one = configuration(crc=True)
    told = MetadataParams(False, ChecksumType.MODULAR, 1000, "a", "b")
    for pdu in (
        MetadataPdu(one, told),
        FileDataPdu(one, FileDataParams(b"hello", 7)),
        EofPdu(one, bytes(4), 5),
    ):
        raw = bytes(pdu.pack())
        yield raw, False
        for at in range(cfdp.PDU_HEADER.size, len(raw)):
            yield raw[:at] + bytes([raw[at] ^ 1 << at % 8]) + raw[at + 1 :], True


@pytest.mark.parametrize("inside", [False, True])
def test_a_wrong_crc_is_a_finding_of_both_readers_and_of_wireshark(inside, tmp_path):
    made, wrong = zip(*with_crcs(), strict=True)
    bench = Settings().workbench()
    payloads = made
    if inside:
        config = tmp_path / "cf.yaml"
        config.write_text("cf: {ros__parameters: {cfdp: {msg_ids: [0x18C8]}}}")
        bench = Settings([config]).workbench()
        payloads = [cfe.emit_command(0x18C8, 0, item) for item in made]
    batch = batch_of(payloads, destination=("127.0.0.1", 1234 if inside else 5222))
    columns = bench.columns.decode(batch)
    both = Finding.TRUNCATED | Finding.CHECKSUM_BAD
    for row, expected in enumerate(wrong):
        decoded = bench.dissector.dissect(batch[row])
        assert int(decoded.findings) == columns.findings[row]
        assert bool(decoded.findings & both) == expected, made[row].hex()
    follower = FileEvidence(msg_ids=(0x18C8,))
    follower.add(batch, columns)
    assert (
        follower.corrupt == sum(Finding.CHECKSUM_BAD in Finding(int(item)) for item in columns.findings) > 40
    )
    (taken,) = follower.transactions
    assert (taken.segments, taken.file_size, taken.destination_file_name) == (1, 5, "b")
    if not inside:
        at = ("127.0.0.1", 5111), ("127.0.0.1", 5222)
        capture = write(tmp_path / "x.pcap", [Udp(number, *at, item) for number, item in enumerate(made)])
        options = ["-d", "udp.port==5222,cfdp", "-r", capture, "-T", "fields", "-e", "cfdp.crc"]
        run = subprocess.run(
            ["tshark", "-n", *options], capture_output=True, check=True, timeout=300, text=True
        )
        # It shows the CRC where the rest can be read, and does not judge it.
        sound = {raw[:-2] for raw, bad in with_crcs() if not bad}
        told = [(row, line) for row, line in enumerate(run.stdout.splitlines()) if made[row][:-2] in sound]
        assert len(told) == 3 * 3
        for row, line in told:
            ours = bench.dissector.dissect(batch[row]).layers[-1].values()["crc"]
            assert ours == int(line, 16) == int.from_bytes(made[row][-2:], "big")


def test_filters_find_the_fields_that_the_tree_has(rows):
    bench, found = rows
    assert len(found) == len(KINDS)
    compared(bench, found, CFDP.layouts)


SAME = {
    "srcid": "source_entity_id",
    "transeqnum": "transaction_sequence_number",
    "dstid": "destination_entity_id",
    "fdtype": "directive_code",
    "offset": "offset",
    "file_size": "file_size",
    "condition_code": "condition_code",
    "checksum": "file_checksum",
    "src_file_name": "source_file_name",
    "dst_file_name": "destination_file_name",
    "nak_sp_scope": "end_of_scope",
    "progress": "progress",
    "dir_code_ack": "acknowledged_directive",
    "delivery_code": "delivery_code",
    "response_req": "response_required",
}
"""What tshark calls our fields."""


def test_the_lua_leaves_the_ports_to_wireshark_and_both_say_the_same(rows, capture, tmp_path):
    bench, found = rows
    script = tmp_path / "edoras.lua"
    script.write_text(dissector(Settings())[0])
    assert agreed(bench, found, script, capture) > 40


def agreed(bench, found, script, capture):
    """Hold what tshark says of PDUs, a packet each, to our reading; return how many values were compared."""
    fields = [part for name in SAME for part in ("-e", f"cfdp.{name}")]
    command = ["tshark", "-n", "-X", f"lua_script:{script}", "-r", capture, "-T", "fields", *fields]
    lines = subprocess.run(command, capture_output=True, check=True, timeout=300, text=True).stdout
    compared = 0
    for index, line in enumerate(lines.splitlines()):
        layers = bench.dissector.dissect(found.batch[index]).layers
        ours = {name: value for layer in layers for name, value in layer.values().items()}
        if ours["large_file_flag"] or ours["segment_metadata_flag"]:
            continue  # issues 1 to 4 of the standard had neither, nor has this dissector
        for name, value in zip(SAME.values(), line.split("\t"), strict=True):
            if name in ours:
                assert (value if name.endswith("_name") else int(value, 0)) == ours[name], name
                compared += 1
    return compared


@given(
    width=st.integers(1, 8),
    count=st.integers(1, 8),
    ids=st.lists(st.integers(0, 255), min_size=3, max_size=3),
)
def test_ids_of_every_width(width, count, ids):
    head = {"pdu_type": 1, "entity_id_length": width - 1, "sequence_number_length": count - 1}
    sizes = (width, count, width)
    numbers = [int.from_bytes(bytes([value]) * size, "big") for value, size in zip(ids, sizes, strict=True)]
    behind = b"".join(number.to_bytes(size, "big") for number, size in zip(numbers, sizes, strict=True))
    raw = cfdp.PDU_HEADER.emit(head | {"pdu_data_field_length": 9}) + behind + bytes([0, 0, 1, 0]) + b"piece"
    pdus = cfdp.read_pdus(np.frombuffer(raw, np.uint8), np.zeros(1, np.int64), np.array([len(raw)], np.int32))
    assert not pdus.truncated[0]
    read = pdus.source_entity_id, pdus.transaction_sequence_number, pdus.destination_entity_id
    assert [int(item[0]) for item in read] == numbers
    assert int(pdus.file_offset[0]) == 256
    assert raw[int(pdus.data[0]) : int(pdus.end[0])] == b"piece"


@settings(max_examples=examples(200))
@given(st.lists(st.binary(max_size=40), max_size=8))
def test_any_bytes_are_read_within_their_bounds(payloads):
    data = np.frombuffer(b"".join(payloads), np.uint8)
    length = np.array([len(item) for item in payloads], np.int32)
    offset = np.cumsum(length, dtype=np.int64) - length
    pdus = cfdp.read_pdus(data, offset, length)
    for index in np.flatnonzero(pdus.kind != cfdp.UNREAD).tolist():
        assert offset[index] < pdus.start[index] <= pdus.data[index] <= pdus.end[index]
        assert pdus.end[index] <= offset[index] + length[index]
        body = data[pdus.start[index] : pdus.end[index]].tobytes()
        assert cfdp.parameters(int(pdus.kind[index]), int(pdus.large[index]), body)


@given(st.binary(max_size=60), st.lists(st.integers(0, 60), max_size=4))
def test_the_modular_checksum_is_the_sum_of_its_pieces(data, cuts):

    words = [data[at : at + 4].ljust(4, b"\0") for at in range(0, len(data), 4)]
    whole = sum(int.from_bytes(word, "big") for word in words) & 0xFFFFFFFF
    ends = sorted({0, len(data), *(cut for cut in cuts if cut < len(data))})
    pieces = sum(cfdp.modular_checksum(data[first:end], first) for first, end in pairwise(ends))
    assert pieces & 0xFFFFFFFF == whole


@pytest.fixture(scope="module")
def packets(tmp_path_factory):
    """Return each PDU in a command, and in telemetry, of a MsgId that a mission names."""
    folder = tmp_path_factory.mktemp("cf")
    config = folder / "cf.yaml"
    config.write_text("cf: {ros__parameters: {cfdp: {msg_ids: [0x18C8, 0x8C2]}}}")
    made = []
    for number, (pdu, _) in enumerate(KINDS):
        raw = bytes(pdu.pack())
        made.append(Udp(number, ("127.0.0.1", 40000), ("127.0.0.1", 1234), cfe.emit_command(0x18C8, 0, raw)))
        telemetry = cfe.emit_telemetry(0x8C2, raw, seconds=1, sequence_count=number)
        made.append(Udp(number, ("127.0.0.1", 49152), ("127.0.0.1", 1235), telemetry))
    bench = Settings([config]).workbench()
    with closing(open_file(write(folder / "x.pcap", made))) as source:
        (batch,) = (batch for batch in source.batches() if len(batch))
    return bench, ColumnRows(bench.columns.context, 0, batch, bench.columns.decode(batch))


def test_each_kind_in_space_packets(packets):
    bench, found = packets
    for index, row in enumerate(range(0, 2 * len(KINDS), 2)):
        for item in (row, row + 1):
            decoded = bench.dissector.dissect(found.batch[item])
            assert KINDS[index][1].items() <= decoded.layers[-1].values().items()
            assert (decoded.stop, decoded.findings & Finding.TRUNCATED) == (None, NO_FINDINGS)
            assert " of 1:77" in decoded.summary
    (name,) = {bench.columns.context.name(int(item)) for item in found.column("msg_id")}
    assert name == "CFDP_PDU"


def test_wireshark_reads_pdus_in_packets_of_a_missions_msg_ids(tmp_path):
    config = tmp_path / "cf.yaml"
    config.write_text("cf: {ros__parameters: {cfdp: {msg_ids: [0x18C8, 0x8C2]}}}")
    made = []
    for number, (pdu, _) in enumerate(KINDS):
        raw = bytes(pdu.pack())
        packet = (
            cfe.emit_command(0x18C8, 0, raw),
            cfe.emit_telemetry(0x8C2, raw, seconds=1, sequence_count=number),
        )
        ends = ("127.0.0.1", 40000), ("127.0.0.1", (1234, 1235)[number % 2])
        made.append(Udp(number, *ends, packet[number % 2]))
    capture = write(tmp_path / "x.pcap", made)
    bench = Settings([config]).workbench()
    with closing(open_file(capture)) as source:
        (batch,) = (batch for batch in source.batches() if len(batch))
    script = tmp_path / "edoras.lua"
    script.write_text(dissector(Settings([config]))[0])
    found = ColumnRows(bench.columns.context, 0, batch, bench.columns.decode(batch))
    assert agreed(bench, found, script, capture) > 40
    command = [
        "tshark",
        "-n",
        "-X",
        f"lua_script:{script}",
        "-r",
        capture,
        "-T",
        "fields",
        "-e",
        "edoras.name",
    ]
    names = subprocess.run(command, capture_output=True, check=True, timeout=300, text=True).stdout.split()
    assert names == ["CFDP_PDU"] * len(KINDS)


def test_filters_find_the_fields_of_pdus_in_packets(packets):
    bench, found = packets
    compared(bench, found, CFDP.layouts)


@given(st.lists(st.binary(max_size=40), min_size=1, max_size=8), st.booleans())
def test_both_readers_say_the_same_of_any_bytes_in_packets(packets, payloads, command):
    bench, _ = packets
    made = [
        cfe.emit_command(0x18C8, 0, item)
        if command
        else cfe.emit_telemetry(0x8C2, item, seconds=1, sequence_count=1)
        for item in payloads
    ]
    batch = batch_of(made, destination=("127.0.0.1", 1234 if command else 1235))
    columns = bench.columns.decode(batch)
    for row in range(len(batch)):
        decoded = bench.dissector.dissect(batch[row])
        assert int(decoded.findings) == columns.findings[row], payloads[row].hex()
    follower = FileEvidence(msg_ids=(0x18C8, 0x8C2))
    follower.add(batch, columns)
    assert follower.pdus == follower.packets <= len(payloads)


def test_faults_know_the_link():
    with pytest.raises(ConfigError, match="one of ci, to, sbn, cfdp is needed"):
        parse_rule("drop:1,link=cd")
