"""One thing wrong, everything else as it was: each case states the bytes that change."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.decode import Context, Dissector
from edoras_tools.links.bare import CI, TO
from edoras_tools.links.sbn import SBN
from edoras_tools.mission import Mission, Route
from edoras_tools.model import Datagram, Endpoint, Finding, Peer
from edoras_tools.sessions.faults.effects import CONTENT, Chance, Struck, packet_offset
from edoras_tools.sessions.faults.machine import FaultPlan
from edoras_tools.sessions.faults.rules import parse_rule
from edoras_tools.wire import cfe, envelope, sbn

CDR = bytes.fromhex("00010000") + bytes(range(48))
COMMAND = cfe.emit_command(0x1827, 1, envelope.DEFAULT.emit(CDR), sequence_count=5)
TELEMETRY = cfe.emit_telemetry(0x0827, envelope.DEFAULT.emit(CDR), seconds=9)
PEER = Peer(0x42, 3)
APP = sbn.emit(sbn.MsgType.APP, PEER, COMMAND)
BEAT = sbn.emit(sbn.MsgType.HEARTBEAT, PEER)

CASES = {
    # rule, link, datagram: what is different, and what is said of it
    ("packet-length:+8", CI, COMMAND): ({5: 69 + 8}, "packet_data_length 69 -> 77"),
    ("packet-length:0", SBN, APP): ({11 + 5: 0}, "packet_data_length 69 -> 0"),
    ("checksum", CI, COMMAND): (
        {7: COMMAND[7] ^ 0xFF},
        f"checksum 0x{COMMAND[7]:02x} -> 0x{COMMAND[7] ^ 0xFF:02x}",
    ),
    ("checksum", TO, TELEMETRY): ({}, ""),
    ("sequence:3", CI, COMMAND): ({3: 8}, "packet_sequence_count 5 -> 8"),
    ("sequence:16383", CI, COMMAND): ({3: 4}, "packet_sequence_count 5 -> 4"),
    ("envelope-length:+1", CI, COMMAND): ({8: 53}, "buffer_length 52 -> 53"),
    ("envelope-length:0x100", TO, TELEMETRY): ({16: 0, 17: 1}, "buffer_length 52 -> 256"),
    ("envelope-capacity", SBN, APP): ({11 + 16: 0}, "buffer_capacity 52 -> 0"),
    ("envelope-capacity", SBN, BEAT): ({}, ""),
    ("encapsulation", CI, COMMAND): ({24: 0xFF, 25: 0xFF}, "representation 0x01 -> 0xffff"),
    ("sbn-size:+1", SBN, APP): ({1: 77}, "msg_size 76 -> 77"),
    ("sbn-size:0x8000", SBN, BEAT): ({0: 0x80}, "msg_size 0 -> -32768"),
    ("sbn-type", SBN, APP): ({2: 7}, "msg_type 0x03 -> 0x07"),
    ("sbn-processor:9", SBN, BEAT): ({6: 9}, "processor_id 3 -> 9"),
    ("sbn-spacecraft:+1", SBN, BEAT): ({10: 0x43}, "spacecraft_id 0x42 -> 0x43"),
    ("sbn-spacecraft:+1", CI, COMMAND): ({}, ""),
}


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case[0]}, {case[1].label}")
def test_only_this_is_wrong(case):
    rule, link, payload = case
    changed, detail = CASES[case]
    machine = FaultPlan((parse_rule(rule),)).start()
    (delivery,), faults = machine.apply(payload, link=link, to_cfs=True, now=0)
    wanted = bytearray(payload)
    for place, value in changed.items():
        wanted[place] = value
    assert delivery.payload == bytes(wanted)
    assert [fault.detail for fault in faults] == ([detail] if detail else [])
    assert (delivery.payload is payload) is (not changed)


@pytest.mark.parametrize("headers", cfe.HEADERS, ids=lambda item: item.name)
def test_faults_behind_the_headers_of_each_build(headers):
    """A right checksum and the envelope are found where they are; what is before them stays."""
    body = envelope.DEFAULT.emit(CDR)
    command = cfe.emit_command(headers.msg_ids.of_known(0x1827), 1, body, headers=headers)
    telemetry = cfe.emit_telemetry(headers.msg_ids.of_known(0x0827), body, headers=headers)
    for rule, payload, link, place, said in (
        ("checksum", command, CI, headers.start + 1, "checksum"),
        ("envelope-length:+1", command, CI, headers.command_bytes, "buffer_length 52 -> 53"),
        ("envelope-length:+1", telemetry, TO, headers.telemetry_bytes, "buffer_length 52 -> 53"),
        ("encapsulation", command, CI, headers.command_bytes + 16, "representation 0x01 -> 0xffff"),
    ):
        machine = FaultPlan((parse_rule(rule),)).start(headers=headers)
        (delivery,), (fault,) = machine.apply(payload, link=link, to_cfs=True, now=0)
        differs = [
            at for at, pair in enumerate(zip(payload, delivery.payload, strict=True)) if len(set(pair)) > 1
        ]
        assert differs[0] == place
        assert fault.detail.startswith(said)


def test_truncated_and_padded():
    def applied(rule):
        deliveries, faults = (
            FaultPlan((parse_rule(rule),)).start().apply(COMMAND, link=CI, to_cfs=True, now=0)
        )
        return deliveries[0].payload, len(faults)

    assert applied("truncate:10") == (COMMAND[:10], 1)
    assert applied("truncate:0") == (b"", 1)
    assert applied("truncate:76") == (COMMAND, 0)
    assert applied("pad:3") == (COMMAND + bytes(3), 1)
    assert len(applied("pad:65507")[0]) == 65507


@given(payload=st.binary(min_size=1, max_size=90), bits=st.integers(1, 900), number=st.integers(0, 99))
def test_so_many_bits_are_turned_over(payload, bits, number):
    wronged = CONTENT["corrupt"](payload, Struck(CI, {"bits": bits}, Chance(1, number)))
    assert len(wronged.payload) == len(payload)
    different = int.from_bytes(payload, "big") ^ int.from_bytes(wronged.payload, "big")
    assert different.bit_count() == min(bits, 8 * len(payload))
    assert CONTENT["corrupt"](payload, Struck(CI, {"bits": bits}, Chance(1, number))) == wronged


@given(
    payload=st.binary(max_size=120),
    link=st.sampled_from([CI, TO, SBN]),
    name=st.sampled_from(sorted(CONTENT)),
)
def test_any_bytes_come_back_as_bytes(payload, link, name):
    values = {"bits": 2, "bytes": 5, "value": parse_rule("packet-length:+1").values["value"]}
    wronged = CONTENT[name](payload, Struck(link, values, Chance(1, 2)))
    assert bool(wronged.detail) is (wronged.payload != payload)
    assert packet_offset(payload, link) in {-1, 0, 11}


TWIST = Route("/cmd_vel", "geometry_msgs/msg/Twist", 0x1827, CI, "command")
FOUND = {
    "packet-length:+8": Finding.LENGTH_MISMATCH,
    "checksum": Finding.CHECKSUM_BAD,
    "envelope-length:0xFFFF": Finding.ENVELOPE_OVERRUN,
    "encapsulation": Finding.CDR_INVALID,
    "truncate:9": Finding.TRUNCATED | Finding.LENGTH_MISMATCH,
    "sbn-size:+5": Finding.SBN_SIZE_MISMATCH,
    "sbn-type": Finding.SBN_UNKNOWN_TYPE,
}


@pytest.mark.parametrize("rule", FOUND)
def test_the_decoder_finds_what_was_done(rule):
    link, payload, port = (SBN, APP, 2234) if rule.startswith("sbn") else (CI, COMMAND, 1234)
    (delivery,), _ = FaultPlan((parse_rule(rule),)).start().apply(payload, link=link, to_cfs=True, now=0)

    def findings(data):
        end = Endpoint("127.0.0.1", port)
        datagram = Datagram(1, 0, 101, data, data, 0, len(data), Endpoint("127.0.0.1", 9999), end)
        return Dissector(Context(Mission((TWIST,)))).dissect(datagram).findings

    assert not FOUND[rule] & findings(payload)
    assert FOUND[rule] & findings(delivery.payload)
