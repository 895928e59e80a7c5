from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from edoras_tools.links.bare import CI
from edoras_tools.links.sbn import SBN
from edoras_tools.model import Peer
from edoras_tools.sessions.outgoing import (
    Changes,
    ChecksumRule,
    Outgoing,
    Packet,
    SequenceRule,
    join_datagrams,
)
from edoras_tools.wire import ccsds, cfe, sbn
from edoras_tools.wire.ccsds import VERSION_1

PEER = Peer(0x42, 3)
STAMPED = bytes.fromhex("00010000") + struct.pack("<II", 7, 8) + b"rest"
BIG = bytes.fromhex("00000000") + struct.pack(">II", 7, 8) + b"rest"
TIME_NS = 1_795_241_636_250_000_000


def command(msg_id=0x1827, payload=b"payload"):
    return cfe.emit_command(msg_id, 1, payload, sequence_flags=0, with_checksum=False)


def outgoing(*packets, link=CI, sender=None, **places):
    return Outgoing.packets(link, [Packet(item, **places) for item in packets], sender=sender)


def words(out):
    return [ccsds.PRIMARY.parse(out[row], 11 * (out.link is SBN)) for row in range(len(out))]


def test_packets_are_laid_out_as_they_are():
    packets = [command(payload=bytes([n]) * n) for n in range(5)]
    out = outgoing(*packets)
    assert [out[row] for row in range(5)] == packets
    assert out.msg_id.tolist() == [0x1827] * 5


def test_on_the_sbn_link_a_header_goes_before():
    out = outgoing(command(), link=SBN, sender=PEER)
    assert out[0] == sbn.emit(sbn.MsgType.APP, PEER, command())
    assert out.packet_offset.tolist() == [11]


def test_nothing_is_changed_unless_it_is_asked_for():
    out = outgoing(command(), command(0x1828))
    assert Changes().once(out) is out
    assert Changes().each(out) is out


def test_a_change_leaves_the_recording_alone():
    out = outgoing(command())
    Changes({0x1827: 0x1828}, SequenceRule.ZERO, ChecksumRule.FIX).once(out)
    assert out[0] == command()


def test_msg_ids_take_each_others_places():
    out = outgoing(command(0x1827), command(0x1828), command(0x1829))
    changed = Changes({0x1827: 0x1828, 0x1828: 0x1827}).once(out)
    assert [changed[row] for row in range(3)] == [command(0x1828), command(0x1827), command(0x1829)]
    assert changed.msg_id.tolist() == [0x1828, 0x1827, 0x1829]


def test_sequence_counts_go_by_msg_id_and_on_over_passes():
    out = outgoing(command(0x1827), command(0x1828), command(0x1827))
    changes = Changes(sequence=SequenceRule.COUNT)
    counts = [
        [item["packet_sequence_count"] for item in words(changes.each(out, sent=sent))]
        for sent in (0, 1, 8191)
    ]
    assert counts == [[0, 0, 1], [2, 1, 3], [16382, 8191, 16383]]
    assert words(changes.each(out, sent=8192))[0]["packet_sequence_count"] == 0
    assert all(item["sequence_flags"] == 3 for item in words(changes.each(out)))
    zero = Changes(sequence=SequenceRule.ZERO).once(changes.each(out))
    assert [zero[row][2:4] for row in range(3)] == [bytes(2)] * 3


@given(st.binary(min_size=0, max_size=70), st.integers(0, 255))
def test_checksums(payload, before):
    packet = bytearray(command(payload=payload))
    packet[7] = before
    out = outgoing(bytes(packet), cfe.emit_telemetry(0x827, payload))
    fixed = Changes(checksum=ChecksumRule.FIX).once(out)
    assert cfe.checksum(fixed[0]) == 0
    assert cfe.checksum(Changes(checksum=ChecksumRule.WRONG).once(out)[0]) == 0xFF
    assert Changes(checksum=ChecksumRule.ZERO).once(out)[0][7] == 0
    assert fixed[1] == out[1]  # telemetry has none


def test_a_stamp_becomes_the_time_of_sending_in_the_order_of_its_bytes():
    head = len(command(payload=b""))
    packets = [command(payload=STAMPED), command(payload=BIG), command(payload=STAMPED)]
    rows = [Packet(item, route=route, cdr_at=head) for item, route in zip(packets, (0, 0, 1), strict=True)]
    out = Outgoing.packets(CI, rows)
    changes = Changes(restamp=np.array([True, False]))
    sent = changes.each(out, start_ns=TIME_NS, due_ns=np.array([0, 500, 0]))
    seconds = TIME_NS // 10**9
    assert struct.unpack_from("<II", sent[0], head + 4) == (seconds, 250_000_000)
    assert struct.unpack_from(">II", sent[1], head + 4) == (seconds, 250_000_500)
    assert sent[2] == packets[2]
    assert changes.differ


def test_another_sender_is_written_into_every_whole_sbn_header():
    out = outgoing(command(), command(), link=SBN, sender=PEER)
    out = replace(out, length=np.array([len(out[0]), 5], np.int32))  # the second is cut
    changed = Changes(sender=Peer(0x99, 7)).once(out)
    assert changed[0] == sbn.emit(sbn.MsgType.APP, Peer(0x99, 7), command())
    assert changed[1] == out[1]
    assert Changes(sender=Peer(1, 2)).once(outgoing(command()))[0] == command()


def test_the_checksum_is_right_for_what_else_changed():
    out = outgoing(command())
    changed = Changes({0x1827: 0x1829}, SequenceRule.COUNT, ChecksumRule.FIX)
    sent = changed.each(changed.once(out), sent=5)
    assert cfe.checksum(sent[0]) == 0
    assert sent[0][:4] == bytes.fromhex("1829c005")


def test_parts_are_joined_end_to_end():
    one, two = outgoing(command(payload=b"a")), outgoing(command(payload=b"bb"), command(payload=b"c"))
    whole = join_datagrams([one, two])
    assert [whole[row] for row in range(3)] == [one[0], two[0], two[1]]
    assert whole.packet_offset.tolist() == whole.offset.tolist()
    assert whole.cdr_offset.tolist() == [-1, -1, -1]
    assert join_datagrams([one]) is one


@pytest.mark.parametrize("rule", ChecksumRule)
def test_a_packet_without_a_whole_header_is_let_be(rule):
    out = outgoing(command())
    cut = replace(out, packet_length=np.array([7], np.int32), length=np.array([7], np.int32))
    assert Changes(checksum=rule).once(cut)[0] == command()[:7]


@pytest.mark.parametrize(("old", "new"), [(0x1827, 0x0827), (0x0827, 0x1827)])
def test_a_command_becomes_telemetry_behind_an_extended_header(old, new):
    """Their headers are equally long there: what follows stays, the header is a new one."""
    payload = bytes(range(40))

    def packet(msg_id):
        made = {"sequence_flags": 0, "headers": cfe.WITH_EXTENDED}
        if VERSION_1.is_command(msg_id):
            return cfe.emit_command(msg_id, 1, payload, with_checksum=False, **made)
        return cfe.emit_telemetry(msg_id, payload, **made)

    out = Outgoing.packets(CI, [Packet(packet(old)), Packet(packet(old)[:9])], headers=cfe.WITH_EXTENDED)
    changed = Changes({old: new}).once(out)
    assert changed[0] == packet(new)
    assert changed[1] == packet(new)[:9]


@pytest.mark.parametrize("old", cfe.HEADERS, ids=lambda item: item.name)
@pytest.mark.parametrize("new", cfe.HEADERS, ids=lambda item: item.name)
@pytest.mark.parametrize("link", [CI, SBN], ids=lambda item: item.label)
def test_headers_of_another_build_as_one_packet_gets_them(old, new, link):
    """Lengths, MsgIds, checksums and what SBN says of the size: all packets at once as each by itself."""
    of, sender = old.msg_ids.of_known, PEER if link is SBN else None
    packets = [
        cfe.emit_command(of(0x1827), 1, b"\1" * 9, headers=old),
        cfe.emit_command(of(0x1828), 2, b"", with_checksum=False, headers=old),
        cfe.emit_telemetry(of(0x0827), b"\2" * 30, seconds=7, subseconds=9, sequence_count=5, headers=old),
        cfe.emit_telemetry(of(0x0808), b"", headers=old)[:11],
        b"\x18\x27\0\0\0",
    ]
    rows = [Packet(item, cdr_at=old.command_bytes + 2 if n == 0 else -1) for n, item in enumerate(packets)]
    out = Outgoing.packets(link, rows, sender=sender, headers=old)
    changed = Changes(headers=new).once(out)
    wanted = [cfe.with_headers(item, old, new) for item in packets]
    if sender:
        wanted = [sbn.emit(sbn.MsgType.APP, sender, item) for item in wanted]
    assert [changed[row] for row in range(len(out))] == wanted
    assert changed.msg_id.tolist()[:3] == [new.msg_ids.of_known(item) for item in (0x1827, 0x1828, 0x0827)]
    assert changed.command.tolist()[:3] == [True, True, False]
    assert int(changed.cdr_offset[0]) == int(changed.packet_offset[0]) + new.command_bytes + 2
    back = Changes(headers=old).once(changed)
    assert [back[row] for row in range(len(out))] == [out[row] for row in range(len(out))]


def test_a_msg_id_is_replaced_in_the_numbers_of_the_other_build():
    out = outgoing(command(), command(0x1828))
    changed = Changes({0x1827: 0x0191}, headers=cfe.WITH_EXTENDED_2, checksum=ChecksumRule.FIX).once(out)
    wanted = [
        cfe.emit_command(msg_id, 1, b"payload", sequence_flags=0, headers=cfe.WITH_EXTENDED_2)
        for msg_id in (0x0191, 0x00A8)
    ]
    assert [changed[row] for row in range(2)] == wanted
