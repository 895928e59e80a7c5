"""Both directions from one case list, on bytes that a running cFS and the bridges sent."""

import binascii
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.errors import ConfigError, FieldError, TruncatedError, WireError
from edoras_tools.model import Peer
from edoras_tools.wire import arrays, ccsds, cfe, sbn
from edoras_tools.wire.ccsds import VERSION_1
from edoras_tools.wire.envelope import DEFAULT, ENVELOPE_FORMATS, EnvelopeFormat, detect, intact_rows

COMMANDS = [
    ("1806c00000010020", (0x1806, 0, b""), {}),
    ("1803c00000010227", (0x1803, 2, b""), {}),
    ("1884c000000500a261626364", (0x1884, 0, b"abcd"), {}),
    (
        "18800000001106003132372e302e302e3100000000000000",
        (0x1880, 6, b"127.0.0.1".ljust(16, b"\0")),
        {"sequence_flags": 0, "with_checksum": False},
    ),
    ("18fac00000010ad6", (0x18FA, 10, b""), {}),
]


@pytest.mark.parametrize(("raw", "arguments", "keywords"), COMMANDS)
def test_commands(raw, arguments, keywords):
    packet = bytes.fromhex(raw)
    head = ccsds.PRIMARY.parse(packet)
    assert head["packet_data_length"] + ccsds.LENGTH_BIAS == len(packet)
    assert VERSION_1.is_command(ccsds.msg_id(head))
    assert cfe.emit_command(*arguments, **keywords) == packet
    assert (cfe.checksum(packet) == 0) == keywords.get("with_checksum", True)


def test_commands_that_a_cfe_with_msg_ids_of_version_2_took():
    """As a real one answered them: Telemetry Output enabled, no-ops of its services and of an app."""
    made = [
        cfe.emit_command(msg_id, code, payload, with_checksum=False, headers=cfe.WITH_EXTENDED_2)
        for msg_id, code, payload in (
            (0x1880, 6, b"127.0.0.1".ljust(16, b"\0")),
            (0x0086, 0, b""),
            (0x18F0, 0, b""),
        )
    ]
    assert [item.hex() for item in made] == [
        "1800c0000019001800000600000000003132372e302e302e3100000000000000",
        "1806c000000900000000000000000000",
        "1870c000000900180000000000000000",
    ]
    with pytest.raises(FieldError, match="0x1806 lacks the command bit 0x0080"):
        cfe.emit_command(0x1806, 0, headers=cfe.WITH_EXTENDED_2)


def test_telemetry_header():
    packet = bytes.fromhex("0803c0020025000f462ab0ae00000000") + bytes(28)
    head, rest = ccsds.PRIMARY.parse(packet), cfe.TELEMETRY.parse(packet, 6)
    assert (ccsds.msg_id(head), head["packet_sequence_count"]) == (0x803, 2)
    assert rest == {"seconds": 0x000F462A, "subseconds": 0xB0AE, "spare": bytes(4)}
    assert (
        cfe.emit_telemetry(0x803, bytes(28), seconds=0x000F462A, subseconds=0xB0AE, sequence_count=2)
        == packet
    )
    assert cfe.MissionTime().ns(1, 0x8000) == 1_500_000_000


MISSION_TIMES = [
    ("", cfe.MissionTime(), "00000001 8000", 315_532_801_500_000_000),
    ("little", cfe.MissionTime("little"), "01000000 0080", 315_532_801_500_000_000),
    ("1/1000 s", cfe.MissionTime(ticks=1000), "00000001 01f4", 315_532_801_500_000_000),
    ("since 1970-01-01T00:00:00", cfe.MissionTime(epoch_s=0), "00000001 8000", 1_500_000_000),
    (
        "little, 1/1000 s, since 2000-01-01T12:00:00",
        cfe.MissionTime("little", 1000, 946_728_000),
        "01000000 f401",
        946_728_001_500_000_000,
    ),
]


@pytest.mark.parametrize(("text", "time", "raw", "time_ns"), MISSION_TIMES)
def test_mission_time_of_any_form(text, time, raw, time_ns):
    assert cfe.MissionTime.of_text(text) == time
    assert str(time) == text
    assert time.words(time_ns)["seconds"] == 1
    packet = cfe.emit_telemetry(0x803, **time.words(time_ns), time=time)
    assert packet[6:12] == bytes.fromhex(raw)
    values = time.layout(cfe.TELEMETRY).parse(packet, 6)
    assert time.ns(values["seconds"], values["subseconds"]) == 1_500_000_000
    assert time.words(-1)["seconds"] == 0


def test_seconds_are_shown_as_utc_where_the_epoch_is_known():
    slot = cfe.MissionTime.of_text("since 2000-01-01").layout(cfe.TELEMETRY).by_name["seconds"]
    assert slot.field.text(86_400) == "2000-01-02T00:00:00Z (86400)"


@pytest.mark.parametrize(
    "text", ["middle", "1/0 s", "1/65537 s", "1/1000", "since noon", "since 2000-13-01", "12"]
)
def test_a_mission_time_of_no_form_is_said(text):
    with pytest.raises(ConfigError, match="is not known; in this order"):
        cfe.MissionTime.of_text(text)


def test_the_type_bit_decides_the_header():
    with pytest.raises(FieldError, match="lacks the command bit"):
        cfe.emit_command(0x0827, 1)
    with pytest.raises(FieldError, match="has the command bit"):
        cfe.emit_telemetry(0x1827)


@given(st.binary(max_size=100))
def test_checksum_is_plain_xor(data):
    plain = 0xFF
    for byte in data:
        plain ^= byte
    assert cfe.checksum(data) == plain


def test_extended_header():
    fields = cfe.EXTENDED.parse(bytes.fromhex("0c180042"))
    assert fields == {"eds_version": 1, "endian": 1, "playback": 0, "subsystem_id": 0x18, "system_id": 0x42}


@pytest.mark.parametrize(
    ("headers", "command", "telemetry"),
    [(cfe.STANDARD, 8, 16), (cfe.SHORT, 8, 12), (cfe.WITH_EXTENDED, 16, 16)],
    ids=lambda item: getattr(item, "name", item),
)
def test_header_bytes_of_each_build(headers, command, telemetry):
    assert (headers.command_bytes, headers.telemetry_bytes) == (command, telemetry)


def test_sbn_datagrams():
    peer = Peer(0x42, 3)
    assert sbn.emit(sbn.MsgType.PROTO, peer, sbn.emit_proto()).hex() == "00010400000003000000420b"
    assert sbn.emit(sbn.MsgType.HEARTBEAT, peer).hex() == "0000a00000000300000042"
    raw = sbn.emit(
        sbn.MsgType.SUB,
        peer,
        sbn.emit_subscriptions([sbn.Subscription(0x82A), sbn.Subscription(0x82B, 1, 2)]),
    )
    assert len(raw) == 11 + 50 + 12
    assert sbn.HEADER.parse(raw) == {"msg_size": 62, "msg_type": 1, "processor_id": 3, "spacecraft_id": 0x42}
    assert sbn.parse_subscriptions(raw[11:]) == (
        sbn.IDENT,
        (sbn.Subscription(0x82A), sbn.Subscription(0x82B, 1, 2)),
    )
    with pytest.raises(TruncatedError, match="needs 62 bytes, 61 are there"):
        sbn.parse_subscriptions(raw[11:-1])
    with pytest.raises(FieldError, match="32768 exceeds"):
        sbn.emit(sbn.MsgType.APP, peer, bytes(32768))


@given(st.binary(max_size=120))
def test_subscriptions_of_garbage(data):
    try:
        _, entries = sbn.parse_subscriptions(data)
    except TruncatedError:
        return
    assert len(entries) * 6 + 50 <= len(data)


CDR = bytes.fromhex("00010000") + bytes(48)


@pytest.mark.parametrize("item", ENVELOPE_FORMATS, ids=str)
def test_envelopes_both_ways_and_told_from_the_bytes(item):
    raw = item.emit(CDR)
    assert item.parse(raw) == (52, 52)
    assert raw[item.size :] == CDR
    assert detect(b"\xa5" * 8 + raw + bytes(16), 8) == item
    assert EnvelopeFormat.of_name(str(item)) == item


def test_envelope_of_the_captures():
    raw = bytes.fromhex("34000000000000003400000000000000")
    assert DEFAULT.parse(raw) == (52, 52)
    assert DEFAULT.emit(CDR, capacity=52)[:16] == raw
    assert EnvelopeFormat.of_name("8/8") == DEFAULT
    assert EnvelopeFormat.of_name("4/4 BE") == EnvelopeFormat(4, "big")
    for wrong in ("", "3/3", "8", "8/8 middle"):
        with pytest.raises(ConfigError, match="not known"):
            EnvelopeFormat.of_name(wrong)


OWN = {
    "length: u16be": "0034",
    "length: u32le, spare: u8": "3400000000",
    "spare: u16be, capacity: u64be, length: u16be": "000000000000000000340034",
    "length: u8, crc: crc16be": "34",
    "length: u16le, capacity: u16le, crc: crc32le": "34003400",
}
SAID_OTHERWISE = {"length: u16be, capacity: u16be": "2/2 be", "LENGTH:u8,capacity : u8": "1/1"}


@pytest.mark.parametrize("name", OWN)
def test_an_envelope_of_its_own_both_ways(name):
    form = EnvelopeFormat.of_name(name)
    assert str(form) == name
    raw = form.emit(CDR)
    head, body, crc = raw[: form.size], raw[form.size : form.size + len(CDR)], raw[form.size + len(CDR) :]
    assert (head.hex(), body, len(crc)) == (OWN[name], CDR, form.crc)
    assert form.parse(raw) == (52, 52)
    if form.crc:
        right = binascii.crc_hqx(head + body, 0xFFFF) if form.crc == 2 else zlib.crc32(head + body)
        assert int.from_bytes(crc, form.byte_order) == right
        assert form.trailer.parse(crc) == {"crc": right}
    with pytest.raises(WireError):
        form.emit(bytes(form.most + 1)) if form.most < 1 << 17 else form.parse(raw[: form.size - 1])


@pytest.mark.parametrize(("text", "name"), SAID_OTHERWISE.items())
def test_two_lengths_are_those_of_a_bridge(text, name):
    assert EnvelopeFormat.of_name(text) == EnvelopeFormat.of_name(name)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("length: u16", "needs its byte order: u16be or u16le"),
        ("length: u24be", "'length: u24be' is no word of it"),
        ("capacity: u16be", "one length"),
        ("length: u8, length: u8", "one length"),
        ("length: u16be, spare: u16le", "one byte order"),
        ("crc: crc16be, length: u8", "'length: u8' is no word of it; .* the CRC is last"),
        ("length: u8, crc: u16be", "is no word of it"),
    ],
)
def test_a_mistake_in_the_words_is_said(text, problem):
    with pytest.raises(ConfigError, match=problem):
        EnvelopeFormat.of_name(text)


@given(st.lists(st.binary(min_size=4, max_size=90), max_size=80), st.sampled_from(sorted(OWN)), st.data())
def test_crcs_of_many_envelopes_are_those_of_each(bodies, name, draw):
    form = EnvelopeFormat.of_name(name)
    parts = [bytearray(form.emit(body)) for body in bodies]
    for part in parts:
        if draw.draw(st.booleans()):
            part[draw.draw(st.integers(form.size, len(part) - 1))] ^= 0x10
    data = np.frombuffer(b"".join(parts) + b"\0", np.uint8)
    offset = np.cumsum([0, *map(len, parts)])[:-1].astype(np.int64)
    length = np.array([len(body) for body in bodies], np.int32)
    each = [form.intact(bytes(part), 0, len(body)) for part, body in zip(parts, bodies, strict=True)]
    assert intact_rows(data, offset, length, form).tolist() == each


@given(st.binary(max_size=64), st.integers(0, 70))
def test_detect_never_raises_and_never_runs_over(data, offset):
    found = detect(data, offset)
    if found is not None:
        length, capacity = found.parse(data, offset)
        assert 4 <= length <= capacity
        assert offset + found.size + length <= len(data)


def test_one_byte_lengths_hold_small_messages_only():
    with pytest.raises(WireError):
        ENVELOPE_FORMATS[-1].emit(bytes(256))


@given(st.binary(min_size=1, max_size=80), st.data())
def test_windows_are_the_bytes_and_zeros_beyond(data, draw):
    offsets = draw.draw(st.lists(st.integers(0, len(data)), max_size=8))
    width = draw.draw(st.integers(1, 90))
    rows = arrays.gather(np.frombuffer(data, np.uint8), np.array(offsets, np.int64), width)
    assert [bytes(row) for row in rows] == [data[at : at + width].ljust(width, b"\0") for at in offsets]


@given(st.binary(min_size=1, max_size=60), st.data())
def test_ranges_are_folded_like_the_loop_would(data, draw):
    ranges = draw.draw(st.lists(st.tuples(st.integers(0, len(data)), st.integers(0, 20)), max_size=8))
    ranges = [(at, min(size, len(data) - at)) for at, size in ranges]
    array = np.frombuffer(data, np.uint8)
    offset, length = np.array([r[0] for r in ranges], np.int64), np.array([r[1] for r in ranges], np.int32)
    pieces = [data[at : at + size] for at, size in ranges]
    assert list(arrays.any_nonzero(array, offset, length)) == [any(piece) for piece in pieces]
    assert [0xFF ^ int(x) for x in arrays.xor_bytes(array, offset, length)] == [
        cfe.checksum(p) for p in pieces
    ]


@given(
    word=st.sampled_from([0x1827, 0x0827]),
    rest=st.binary(min_size=10, max_size=60),
    old=st.sampled_from(cfe.HEADERS),
    new=st.sampled_from(cfe.HEADERS),
)
def test_headers_of_another_build_and_back(word, rest, old, new):
    """What follows the headers, function code or time, and a right checksum stay."""
    if VERSION_1.is_command(word):
        packet, made = (
            cfe.emit_command(item.msg_ids.of_known(word), rest[0] & 0x7F, rest, headers=item)
            for item in (old, new)
        )
    else:
        time = {"seconds": int.from_bytes(rest[:4], "big"), "subseconds": rest[4]}
        packet, made = (
            cfe.emit_telemetry(item.msg_ids.of_known(word), rest, headers=item, **time) for item in (old, new)
        )
    assert cfe.with_headers(packet, old, new) == made
    assert cfe.with_headers(made, new, old) == packet


@given(data=st.binary(max_size=40), old=st.sampled_from(cfe.HEADERS), new=st.sampled_from(cfe.HEADERS))
def test_headers_of_any_bytes(data, old, new):
    """No bytes are refused; a packet that is shorter than its headers stays as it is."""
    made = cfe.with_headers(data, old, new)
    assert made == data or len(made) >= min(new.command_bytes, new.telemetry_bytes)
