"""Packets that are written are read back; what cannot be is refused with its reason."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.sessions.bridge import Envelope, PacketWriter, find_packet
from edoras_tools.wire import cfe, envelope

CDR = bytes.fromhex("00010000") + bytes(48)


def test_the_usual_packet_is_that_of_the_public_bridges():
    packet = PacketWriter().write(0x1827, Envelope(envelope.DEFAULT).wrap(CDR))
    wanted = cfe.emit_command(0x1827, 1, envelope.DEFAULT.emit(CDR), sequence_flags=0, with_checksum=False)
    assert packet == wanted
    assert (len(packet), packet[:8].hex()) == (76, "1827000000450100")


def test_real_checksums_and_counts_where_they_are_wanted():
    writer = PacketWriter(checksum=True, sequence=True)
    packets = [writer.write(mid, CDR) for mid in (0x1827, 0x1828, 0x1827)]
    assert [packet[2:4].hex() for packet in packets] == ["c000", "c000", "c001"]
    assert [cfe.checksum(packet) for packet in packets] == [0, 0, 0]
    assert packets[0][7] != 0
    for _ in range(1 << 14):
        last = writer.write(0x1828, b"")
    assert last[2:4].hex() == "c000"  # 14 bits, then from the beginning


@pytest.mark.parametrize("headers", cfe.HEADERS, ids=lambda item: item.name)
@pytest.mark.parametrize("checksum", [True, False])
def test_packets_have_the_headers_of_their_cfe(headers, checksum):
    """The same bytes as wire.cfe writes; their sizes are those of cFE's own structs."""
    writer = PacketWriter(headers=headers, checksum=checksum)
    state, command = map(headers.msg_ids.of_known, (0x0827, 0x1827))
    for msg_id, made in (
        (state, cfe.emit_telemetry(state, CDR, sequence_flags=0, headers=headers)),
        (
            command,
            cfe.emit_command(command, 1, CDR, sequence_flags=0, with_checksum=checksum, headers=headers),
        ),
    ):
        packet = writer.write(msg_id, CDR)
        assert packet == made
        size = writer.overhead(msg_id)
        assert size == len(packet) - len(CDR)
        place = find_packet(packet, 0, headers)
        assert (place.msg_id, place.body, place.end) == (msg_id, size, len(packet))
    extended = PacketWriter(headers=cfe.WITH_EXTENDED)
    assert [extended.overhead(msg_id) for msg_id in (0x1827, 0x0827)] == [16, 16]


OWN = [
    envelope.EnvelopeFormat.of_name(item) for item in ("length: u16be, spare: u8", "length: u8, crc: crc32le")
]


@pytest.mark.parametrize("form", [*envelope.ENVELOPE_FORMATS, *OWN, None], ids=str)
def test_every_envelope_both_ways(form):
    made = Envelope(form)
    assert len(made.wrap(CDR)) == made.size + len(CDR)
    data = b"head" + made.wrap(CDR) + b"\xa5" * 9
    assert made.open(data, 4, len(data)) == CDR


BAD = {
    "cut inside the envelope": bytes(12),
    "the envelope's length exceeds the packet": envelope.DEFAULT.emit(CDR)[:-1],
    "no CDR in the envelope": bytes(16) + CDR,
    "the content of the envelope is not CDR": envelope.DEFAULT.emit(b"\x12\x34\0\0data"),
    "not the 52 bytes of a geometry_msgs/msg/Twist": envelope.DEFAULT.emit(CDR[:40]),
}


@pytest.mark.parametrize("reason", BAD)
def test_what_is_refused_says_why(reason):
    data = BAD[reason]
    assert Envelope(envelope.DEFAULT, 52, "geometry_msgs/msg/Twist").open(data, 0, len(data)) == reason


def test_a_message_with_a_wrong_crc_is_refused():
    data = OWN[1].emit(CDR)
    assert Envelope(OWN[1]).open(data[:-1] + b"\0", 0, len(data)) == "the envelope's CRC is wrong"
    assert Envelope(OWN[1]).open(data, 0, len(data) - 1) == "the envelope's length exceeds the packet"


def test_a_length_is_believed_only_within_its_packet_though_the_datagram_goes_on():
    data = (60).to_bytes(8, "little") * 2 + CDR + bytes(100)
    assert Envelope(envelope.DEFAULT).open(data, 0, 68) == "the envelope's length exceeds the packet"
    assert Envelope(envelope.DEFAULT).open(data, 0, 76) == CDR + bytes(8)


def test_padding_of_rtps_is_no_other_type():
    assert Envelope(None, 5, "std_msgs/msg/Bool").open(envelope.DEFAULT.emit(CDR[:8]), 0, 24) == CDR[:8]


def test_no_envelope_fits_what_is_none():
    assert Envelope(None).open(b"\xff" * 80, 0, 80) == "no envelope that fits"


def test_a_packet_ends_where_it_says_or_where_the_datagram_does():
    packet = PacketWriter().write(0x1827, bytes(20))
    assert find_packet(packet + bytes(9), 0).end == 28
    assert find_packet(packet[:-3], 0).end == 25
    assert find_packet(packet[:7], 0) is None
    assert find_packet(b"sbn" + packet, 3).body == 11


@given(st.binary(max_size=90), st.integers(0, 12), st.sampled_from([*envelope.ENVELOPE_FORMATS, None]))
def test_any_bytes_give_a_message_or_a_reason(data, at, form):
    place = find_packet(data, at)
    if place is None:
        return
    assert at < place.body <= place.end <= len(data)
    found = Envelope(form).open(data, place.body, place.end)
    assert found if isinstance(found, str) else found in data
