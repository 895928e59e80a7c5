"""Each departure by name: a case a line, on the bytes that a real cFS was sent."""

import struct

import pytest
from places import ROOT

from edoras_tools.decode import Context, Dissector, Options
from edoras_tools.links.bare import CI, ROBOT, TO
from edoras_tools.links.sbn import SBN
from edoras_tools.mission import Mission, load, loads
from edoras_tools.model import Datagram, Endpoint, Finding, Peer
from edoras_tools.ros import TypeStore
from edoras_tools.wire import cfe, sbn
from edoras_tools.wire.envelope import ENVELOPE_FORMATS

ROVER = load([ROOT / "samples/missions/rover_ground.yaml"])
ROVERS = load([ROOT / f"samples/missions/two_rovers_{side}.yaml" for side in ("ground", "flight")])
TYPES = TypeStore()
CDR = bytes.fromhex("00010000") + struct.pack("<6d", 1, 2, 3, 4, 5, 6)
TWIST = struct.pack("<QQ", 52, 52) + CDR
BRIDGE = {"sequence_flags": 0, "with_checksum": False}
PEER = Peer(0x42, 3)
USUAL = {"checksum_absent", "sequence_unset"}


def dissect(payload, port, *, source=40000, mission=ROVER, context=None, options=None):
    local = "127.0.0.1"
    datagram = Datagram(1, 0, 101, b"", payload, 0, 0, Endpoint(local, source), Endpoint(local, port))
    return Dissector(context or Context(mission, TYPES, options)).dissect(datagram)


def ci(msg_id, code, payload=b"", **keywords):
    return cfe.emit_command(msg_id, code, payload, **{**BRIDGE, **keywords})


def stamped(raw, length):
    """Give a packet another length field."""
    return raw[:4] + struct.pack(">H", length - 7) + raw[6:]


GOOD = ci(0x1827, 1, TWIST)
CI_CASES = [
    ("as the bridge sends it", GOOD, USUAL),
    ("as cFE sends it", cfe.emit_command(0x1827, 1, TWIST), set()),
    ("wrong checksum", bytes.fromhex("1806c0000001007a"), {"checksum_bad"}),
    ("unknown function code", ci(0x1827, 9, TWIST), USUAL | {"unknown_function_code"}),
    ("no-op with a payload", ci(0x1827, 0, TWIST), USUAL | {"command_length"}),
    ("core no-op with four bytes more", bytes.fromhex("1806c0000005002061626364"), {"command_length"}),
    ("TO function code 77", bytes.fromhex("1880000000014d00"), USUAL | {"unknown_function_code"}),
    ("MsgId of nobody", ci(0x18EE, 1, TWIST), USUAL | {"unknown_msg_id"}),
    (
        "MsgId 0",
        bytes(2) + GOOD[2:],
        {"sequence_unset", "invalid_msg_id", "wrong_direction"},
    ),
    ("MsgId over the highest", b"\x28" + GOOD[1:], {"sequence_unset", "invalid_msg_id", "wrong_direction"}),
    ("MsgId 0xFFFF", b"\xff\xff" + GOOD[2:], USUAL | {"invalid_msg_id"}),
    (
        "telemetry MsgId as a command",
        b"\x08" + GOOD[1:],
        {"sequence_unset", "wrong_direction", "envelope_overrun"},
    ),
    ("40 of 76 bytes", GOOD[:40], USUAL | {"length_mismatch", "envelope_overrun"}),
    ("8 of 76 bytes", GOOD[:8], USUAL | {"length_mismatch", "truncated"}),
    ("7 bytes", GOOD[:7], {"sequence_unset", "length_mismatch", "truncated"}),
    ("1 byte", GOOD[:1], {"truncated"}),
    ("no byte", b"", {"truncated"}),
    ("length says 8", stamped(GOOD, 8), USUAL | {"length_mismatch"}),
    ("length says 500", stamped(GOOD, 500), USUAL | {"length_mismatch"}),
    ("length says 65542", stamped(GOOD, 65542), USUAL | {"length_mismatch", "over_software_bus"}),
    ("768 bytes", ci(0x18EE, 1, bytes(760)), USUAL | {"unknown_msg_id"}),
    ("769 bytes", ci(0x18EE, 1, bytes(761)), USUAL | {"unknown_msg_id", "over_ci_buffer"}),
    ("buffer_length 5000", ci(0x1827, 1, struct.pack("<QQ", 5000, 5000) + CDR), USUAL | {"envelope_overrun"}),
    ("capacity below length", ci(0x1827, 1, struct.pack("<QQ", 52, 8) + CDR), USUAL | {"envelope_overrun"}),
    ("buffer_length 0", ci(0x1827, 1, bytes(60)), USUAL | {"cdr_invalid"}),
    ("unknown representation", ci(0x1827, 1, TWIST[:16] + b"\x00\x09" + TWIST[18:]), USUAL | {"cdr_invalid"}),
    ("body too short", ci(0x1827, 1, struct.pack("<QQ", 44, 44) + CDR[:44]), USUAL | {"cdr_invalid"}),
    ("what rounding leaves", ci(0x1827, 1, struct.pack("<QQ", 55, 55) + CDR + b"xyz"), USUAL),
    ("rounded up to 8", ci(0x1827, 1, struct.pack("<QQ", 56, 56) + CDR + b"wxyz"), USUAL | {"cdr_trailing"}),
    ("8 bytes more", ci(0x1827, 1, struct.pack("<QQ", 60, 60) + CDR + bytes(8)), USUAL | {"cdr_too_long"}),
    ("big-endian", ci(0x1827, 1, TWIST[:16] + bytes(4) + TWIST[20:]), USUAL | {"cdr_big_endian"}),
    ("zero padding", ci(0x1827, 1, TWIST + bytes(8)), USUAL),
    ("stale padding", ci(0x1827, 1, TWIST + bytes(7) + b"x"), USUAL | {"stale_tail"}),
    ("TO enable", ci(0x1880, 6, bytes(16)), USUAL),
    ("TO enable of 20 bytes", ci(0x1880, 6, bytes(20)), USUAL),
    ("TO add", ci(0x1880, 2, bytes(8)), USUAL),
    ("TO add with the packet's size", ci(0x1880, 2, bytes(12)), USUAL | {"struct_length"}),
    ("TO add of 4 bytes", ci(0x1880, 2, bytes(4)), USUAL | {"command_length"}),
    ("TO enable of 4 bytes", ci(0x1880, 6, bytes(4)), USUAL | {"command_length"}),
    ("route with nothing behind the header", ci(0x1827, 1), USUAL | {"header_only"}),
    ("route's no-op", ci(0x1827, 0), USUAL),
]


@pytest.mark.parametrize(
    ("payload", "findings"), [case[1:] for case in CI_CASES], ids=[case[0] for case in CI_CASES]
)
def test_commands(payload, findings):
    decoded = dissect(payload, 1234)
    assert decoded.link is CI
    assert set(decoded.findings.labels) == findings


SUB = sbn.emit_subscriptions([sbn.Subscription(0x82A)])
SBN_CASES = [
    ("subscription", sbn.emit(1, PEER, SUB), set()),
    (
        "wrong $Id",
        sbn.emit(1, PEER, sbn.emit_subscriptions([], ident=f"$Id: {'0' * 40} $")),
        {"sbn_id_mismatch"},
    ),
    ("fewer entries than counted", sbn.emit(1, PEER, SUB[:-1]), {"truncated"}),
    ("no entries at all", sbn.emit(2, PEER, SUB[:20]), {"truncated"}),
    ("protocol version 10", sbn.emit(4, PEER, sbn.emit_proto(10)), {"sbn_version_mismatch"}),
    ("protocol without a version", sbn.emit(4, PEER), {"truncated"}),
    ("type 7", sbn.emit(7, PEER, b"abc"), {"sbn_unknown_type"}),
    ("NO_MSG", sbn.emit(0, PEER), {"sbn_no_message"}),
    ("5 bytes", bytes.fromhex("0001030000"), {"truncated"}),
    ("heartbeat", sbn.emit(0xA0, PEER), set()),
    ("MsgSz 500", bytes.fromhex("01f40300000003000000421829") + bytes(18), {"sbn_size_mismatch"}),
    ("MsgSz over 32767", bytes.fromhex("90000300000003000000421829") + bytes(18), {"sbn_size_mismatch"}),
    ("legacy heartbeat", bytes.fromhex("0000a000000003"), {"sbn_legacy_header"}),
    ("legacy command", bytes.fromhex("00080300000003") + cfe.emit_command(0x1806, 0), {"sbn_legacy_header"}),
]


@pytest.mark.parametrize(
    ("payload", "findings"), [case[1:] for case in SBN_CASES], ids=[case[0] for case in SBN_CASES]
)
def test_software_bus_network(payload, findings):
    decoded = dissect(payload, 2234, source=2236, mission=ROVERS)
    assert decoded.link is SBN
    assert set(decoded.findings.labels) >= findings
    beyond = set(decoded.findings.labels) - findings
    assert not {name for name in beyond if name.startswith("sbn")}, beyond


def test_a_second_identity_from_one_endpoint_is_foreign():
    context = Context(Mission(), TYPES)
    proto = sbn.emit_proto()
    first = dissect(sbn.emit(4, PEER, proto), 2234, source=2236, context=context)
    other = dissect(sbn.emit(4, Peer(0x42, 9), proto), 2234, source=2236, context=context)
    again = dissect(sbn.emit(4, PEER, proto), 2234, source=2236, context=context)
    assert [item.findings for item in (first, other, again)] == [0, Finding.SBN_ID_MISMATCH, 0]


@pytest.mark.parametrize(
    ("length", "dropped"), [(255, False), (256, True), (266, True), (267, False), (522, True)]
)
def test_lengths_that_the_flight_bridge_drops(length, dropped):
    payload = sbn.emit(3, Peer(0x42, 1), cfe.emit_telemetry(0x0800, bytes(length - 27)))
    assert len(payload) == length
    to_bridge, to_cfs = (dissect(payload, port).findings for port in (2236, 2235))
    assert (Finding.BRIDGE_DROPS_LENGTH in to_bridge) == dropped
    assert Finding.BRIDGE_DROPS_LENGTH not in to_cfs


def test_scheduler_wake_ups_on_telemetry_ids_are_headers_only():
    decoded = dissect(bytes.fromhex("0827c0d400010000"), 1235)
    assert decoded.link is TO
    assert decoded.findings == Finding.HEADER_ONLY
    assert decoded.summary == "header only"


def test_telemetry_over_the_bridge_buffer():
    assert Finding.OVER_BRIDGE_BUFFER in dissect(cfe.emit_telemetry(0x0800, bytes(1009)), 1235).findings
    assert Finding.OVER_BRIDGE_BUFFER not in dissect(cfe.emit_telemetry(0x0800, bytes(1008)), 1235).findings


@pytest.mark.parametrize("item", ENVELOPE_FORMATS, ids=str)
@pytest.mark.parametrize("named", [True, False])
def test_every_envelope_named_or_told_from_the_bytes(item, named):
    options = Options(envelope=str(item) if named else "auto")
    decoded = dissect(cfe.emit_command(0x1827, 1, item.emit(CDR)), 1234, options=options)
    assert decoded.findings == 0
    assert decoded.message.values["linear"] == {"x": 1.0, "y": 2.0, "z": 3.0}


def test_short_telemetry_header_and_extended_header():
    payload = cfe.emit_telemetry(0x0827, b"", seconds=5, subseconds=0x8000)[:12]
    decoded = dissect(payload[:4] + b"\0\x05" + payload[6:], 1235, options=Options(telemetry_header=12))
    assert decoded.layer("cfe_telemetry").values() == {"seconds": 5, "subseconds": 0x8000}
    extended = bytes.fromhex("1827c0000009") + bytes.fromhex("0c180042") + bytes(6)
    decoded = dissect(extended, 1234, options=Options(extended_header=True))
    assert decoded.layer("ccsds").values()["msg_id"] == 0x1827
    assert decoded.layer("cfe_command").end == len(extended)
    assert decoded.layer("cfe_extended").values()["subsystem_id"] == 0x18


LINK_CASES = [
    ("command to CI", GOOD, 40000, 1234, CI),
    ("telemetry to the bridge", cfe.emit_telemetry(0x0800), 40000, 1235, TO),
    ("command to cpu2's CI, which is TO's port too", GOOD, 40000, 1235, CI),
    ("nothing at all on the shared port", b"", 40000, 1235, CI),
    ("SBN by its destination", b"", 40000, 2234, SBN),
    ("SBN by its source", b"", 2236, 50000, SBN),
    ("a state from the robot", bytes(64), 40000, 8080, ROBOT),
]


@pytest.mark.parametrize(
    ("payload", "source", "port", "link"), [c[1:] for c in LINK_CASES], ids=[c[0] for c in LINK_CASES]
)
def test_links(payload, source, port, link):
    assert dissect(payload, port, source=source).link is link


def test_the_mission_settles_the_shared_port_by_address():
    text = (ROOT / "samples/missions/rover_ground.yaml").read_text()
    text = text.replace("fsw_port: 1234", "fsw_port: 1235").replace("127.0.0.1", "10.5.0.3")
    context = Context(loads({"far.yaml": text.encode()}), TYPES)
    far, near = Endpoint("10.5.0.3", 1235), Endpoint("10.5.0.2", 1235)
    telemetry, command = cfe.emit_telemetry(0x0827), GOOD
    for payload in (telemetry, command):
        to_cfs = Datagram(1, 0, 101, b"", payload, 0, 0, near, far)
        from_cfs = Datagram(2, 0, 101, b"", payload, 0, 0, far, near)
        assert Dissector(context).dissect(to_cfs).link is CI
        assert Dissector(context).dissect(from_cfs).link is TO


def test_what_was_read_before_a_stop_stays():
    decoded = dissect(GOOD[:40], 1234)
    assert [layer.name for layer in decoded.layers] == ["ccsds", "cfe_command", "edoras"]
    assert str(decoded.stop) == "cdr at byte 24 needs 52 bytes, 16 are there"
    assert decoded.layer("edoras").values() == {"buffer_length": 52, "buffer_capacity": 52}


def test_layers_name_their_bytes():
    decoded = dissect(ci(0x1827, 1, TWIST + bytes(8)), 1234)
    spans = [(layer.name, layer.start, layer.end) for layer in decoded.layers]
    assert spans == [
        ("ccsds", 0, 6),
        ("cfe_command", 6, 8),
        ("edoras", 8, 24),
        ("cdr", 24, 28),
        ("ros", 28, 76),
        ("padding", 76, 84),
    ]
    angular_z = decoded.layer("ros").fields[-1]
    assert (angular_z.name, angular_z.value, angular_z.start, angular_z.end) == ("angular.z", 6.0, 68, 76)
    assert decoded.summary == "linear.x=1 linear.y=2 linear.z=3 angular.x=4 angular.y=5 angular.z=6"
