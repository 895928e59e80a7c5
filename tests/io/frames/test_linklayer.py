from __future__ import annotations

import shutil
import struct
import subprocess

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scapy.layers.inet import ICMP, IP, TCP, UDP, fragment
from scapy.layers.inet6 import (
    IPv6,
    IPv6ExtHdrDestOpt,
    IPv6ExtHdrFragment,
    IPv6ExtHdrHopByHop,
    IPv6ExtHdrRouting,
    PadN,
    fragment6,
)
from scapy.layers.l2 import ARP, CookedLinux, CookedLinuxV2, Dot1AD, Dot1Q, Ether
from scapy.packet import Raw

from edoras_tools.io.frames.frame_batch import FrameBatch
from edoras_tools.io.frames.linklayer import Demux, demux, network_headers
from edoras_tools.io.frames.network import wrong_checksums
from edoras_tools.model import Finding

PAYLOAD = b"\x18\x27\x00\x00\x00\x05payload"
MAC = {"src": "02:00:00:00:00:01", "dst": "02:00:00:00:00:02"}
V4 = {"src": "10.1.2.3", "dst": "10.4.5.6"}
V6 = {"src": "fd00::1", "dst": "fd00::2"}
PORTS = {"sport": 4321, "dport": 1234}


def batch_of(frames, link_types=1, original=None, times=None):
    """Frames as bytes to a FrameBatch, without room behind the last one."""
    lengths = np.array([len(frame) for frame in frames], dtype=np.int32)
    count = len(frames)
    return FrameBatch(
        data=np.frombuffer(b"".join(frames), dtype=np.uint8),
        number=np.arange(1, count + 1),
        time_ns=np.arange(count) if times is None else np.array(times),
        link_type=np.broadcast_to(np.array(link_types, dtype=np.uint16), count),
        offset=np.cumsum(lengths, dtype=np.int64) - lengths,
        length=lengths,
        original_length=lengths if original is None else np.array(original, dtype=np.int32),
    )


def udp4(payload=PAYLOAD, **fields):
    return IP(**V4, **fields) / UDP(**PORTS) / Raw(payload)


def udp6(payload=PAYLOAD):
    return IPv6(**V6) / UDP(**PORTS) / Raw(payload)


def null(packet, order="<", family=2):
    return struct.pack(f"{order}I", family) + bytes(packet)


CASES = {
    "ethernet": (1, Ether(**MAC) / udp4()),
    "ethernet, IPv6": (1, Ether(**MAC) / udp6()),
    "VLAN": (1, Ether(**MAC) / Dot1Q(vlan=5) / udp4()),
    "QinQ": (1, Ether(**MAC) / Dot1AD(vlan=5) / Dot1Q(vlan=6) / udp4()),
    "three tags, IPv6": (1, Ether(**MAC) / Dot1AD(vlan=5) / Dot1Q(vlan=6) / Dot1Q(vlan=7) / udp6()),
    "IP options": (1, Ether(**MAC) / udp4(options=b"\x01\x01\x01\x01\x01\x01\x01\x00")),
    "padded to 60": (1, bytes(Ether(**MAC) / udp4(b"ab")).ljust(60, b"\xee")),
    "hop-by-hop": (1, Ether(**MAC) / IPv6(**V6) / IPv6ExtHdrHopByHop() / UDP(**PORTS) / Raw(PAYLOAD)),
    "three extension headers": (
        1,
        Ether(**MAC)
        / IPv6(**V6)
        / IPv6ExtHdrHopByHop(options=[PadN(optdata=bytes(12))])
        / IPv6ExtHdrRouting(addresses=["fd00::9"], segleft=0)
        / IPv6ExtHdrDestOpt()
        / UDP(**PORTS)
        / Raw(PAYLOAD),
    ),
    "atomic fragment": (
        1,
        Ether(**MAC) / IPv6(**V6) / IPv6ExtHdrFragment(id=5) / UDP(**PORTS) / Raw(PAYLOAD),
    ),
    "cooked": (113, CookedLinux() / udp4()),
    "cooked, IPv6": (113, CookedLinux() / udp6()),
    "cooked v2": (276, CookedLinuxV2() / udp4()),
    "cooked v2, VLAN": (276, CookedLinuxV2(proto=0x8100) / Dot1Q(vlan=3) / udp4()),
    "null, little-endian": (0, null(udp4())),
    "null, big-endian": (0, null(udp4(), ">")),
    "null, IPv6 of Linux": (0, null(udp6(), "<", 10)),
    "null, IPv6 of FreeBSD": (0, null(udp6(), "<", 28)),
    "null, IPv6 of macOS": (0, null(udp6(), "<", 30)),
    "loop": (108, null(udp4(), ">")),
    "raw": (101, udp4()),
    "raw, IPv6": (101, udp6()),
    "raw as DLT 12": (12, udp4()),
    "raw as DLT 14": (14, udp6()),
    "IPv4": (228, udp4()),
    "IPv6": (229, udp6()),
    "empty payload": (1, Ether(**MAC) / udp4(b"")),
}
NO_DATAGRAM = {
    "ARP": (1, Ether(**MAC) / ARP()),
    "TCP": (1, Ether(**MAC) / IP(**V4) / TCP()),
    "ICMP": (1, Ether(**MAC) / IP(**V4) / ICMP()),
    "TCP over IPv6": (1, Ether(**MAC) / IPv6(**V6) / TCP()),
    "not even a header": (1, b"\x02"),
    "nothing at all": (1, b""),
    "IP header cut": (1, bytes(Ether(**MAC) / udp4())[:30]),
    "header length below 20": (1, Ether(**MAC) / udp4(ihl=4)),
    "version 5": (1, Ether(**MAC) / udp4(version=5)),
    "IP holds no UDP header": (1, Ether(**MAC) / udp4(len=27)),
    "Wi-Fi": (105, bytes(64)),
}


def frame_of(case):
    return case[0], bytes(case[1])


@pytest.mark.parametrize("name", CASES)
def test_every_way_to_carry_a_datagram(name):
    link_type, frame = frame_of(CASES[name])
    (datagram,) = demux(batch_of([frame], link_type))
    expected = {"padded to 60": b"ab", "empty payload": b""}.get(name, PAYLOAD)
    assert datagram.payload == expected
    assert datagram.frame == frame
    assert frame[datagram.payload_offset :].startswith(expected)
    ends = V6 if datagram.source.address.startswith("fd") else V4
    assert (datagram.source.address, datagram.source.port) == (ends["src"], 4321)
    assert (datagram.destination.address, datagram.destination.port) == (ends["dst"], 1234)
    assert datagram.findings == Finding(0)


@pytest.mark.parametrize("name", NO_DATAGRAM)
def test_what_is_no_datagram_is_skipped_and_counted(name):
    link_type, frame = frame_of(NO_DATAGRAM[name])
    reader = Demux()
    assert len(reader.demux(batch_of([frame], link_type))) == 0
    assert reader.skipped == 1
    assert reader.unknown_link_types == ({105} if name == "Wi-Fi" else set())


def test_a_batch_of_all_kinds_keeps_the_order():
    cases = [
        frame_of(case) for pair in zip(CASES.values(), NO_DATAGRAM.values(), strict=False) for case in pair
    ]
    reader = Demux()
    batch = reader.demux(batch_of([frame for _, frame in cases], [link_type for link_type, _ in cases]))
    assert batch.number.tolist() == list(range(1, len(cases) + 1, 2))
    assert reader.skipped == len(NO_DATAGRAM)
    for datagram in batch:
        alone = demux(batch_of([datagram.frame], datagram.link_type))[0]
        assert (datagram.payload, datagram.source, datagram.destination) == (
            alone.payload,
            alone.source,
            alone.destination,
        )


def test_no_frames():
    assert len(demux(batch_of([]))) == 0


@pytest.mark.parametrize(
    ("length", "payload"),
    [(0, PAYLOAD), (7, PAYLOAD), (9999, PAYLOAD), (8, b""), (12, PAYLOAD[:4]), (8 + len(PAYLOAD), PAYLOAD)],
)
def test_a_udp_length_is_believed_where_it_can_be(length, payload):
    frame = bytes(Ether(**MAC) / IP(**V4) / UDP(**PORTS, len=length) / Raw(PAYLOAD))
    (datagram,) = demux(batch_of([frame.ljust(80, b"\xee")]))
    assert datagram.payload == payload
    assert datagram.findings == Finding(0)


def test_a_total_length_of_0_means_the_rest_of_the_frame():
    frame = bytes(Ether(**MAC) / IP(**V4, len=0) / UDP(**PORTS) / Raw(PAYLOAD))
    assert demux(batch_of([frame]))[0].payload == PAYLOAD


@pytest.mark.parametrize("kept", [34, 36, 38, 41, 42, 45])
def test_a_frame_cut_by_the_capture(kept):
    frame = bytes(Ether(**MAC) / udp4())
    (datagram,) = demux(batch_of([frame[:kept]], original=[len(frame)]))
    assert datagram.findings == Finding.CAPTURE_CUT
    assert datagram.payload == PAYLOAD[: max(kept - 42, 0)]
    assert datagram.source.port == (4321 if kept >= 38 else 0)
    assert (datagram.frame, datagram.original_length) == (frame[:kept], len(frame))


@pytest.mark.each(5)
@pytest.mark.parametrize(
    "layers",
    [
        [Ether(**MAC)],
        [CookedLinux()],
        [CookedLinuxV2()],
        [Ether(**MAC) / Dot1Q(vlan=5)],
        [Ether(**MAC), Ether(**MAC) / Dot1Q(vlan=5)],
    ],
    ids=["ethernet", "cooked", "cooked v2", "tagged", "some tagged"],
)
@pytest.mark.parametrize("options", [b"", b"\x45\x01\x01\x00"], ids=["plain", "options"])
@pytest.mark.parametrize("more", [-8, -5, -4, -1, 0, 1, 4, 99])
def test_where_network_headers_are_and_what_they_say(layers, options, more):
    """The capture cuts frames near the beginning of their payloads."""
    packets = [
        layer / udp4(id=0x4500 + at, ttl=9 + at, options=options) for layer in layers for at in range(3)
    ]
    frames = [bytes(item)[: len(item) - len(PAYLOAD) + more] for item in packets]
    kind = {CookedLinux: 113, CookedLinuxV2: 276}.get(type(layers[0]), 1)
    found = network_headers(demux(batch_of(frames, kind, [len(item) for item in packets])))
    ends = np.cumsum([len(item) for item in frames])
    starts = ends - [len(item) for item in frames] + [len(item) - len(item[IP]) for item in packets]
    assert found[0].tolist() == starts.tolist()
    assert found[1].tolist() == [item[IP].id for item in packets]
    assert found[2].tolist() == [item[IP].ttl for item in packets]
    assert [item.dtype for item in found] == [np.int64, np.uint16, np.uint8]


def test_a_frame_that_holds_less_than_ip_says():
    (datagram,) = demux(batch_of([bytes(Ether(**MAC) / udp4())[:-3]]))
    assert datagram.findings == Finding.CAPTURE_CUT
    assert datagram.payload == PAYLOAD[:-3]


LONG = bytes(range(256)) * 12


def fragments4(number=7):
    return [bytes(Ether(**MAC) / part) for part in fragment(udp4(LONG, id=number), fragsize=1000)]


def fragments6():
    packet = IPv6(**V6) / IPv6ExtHdrFragment(id=99) / UDP(**PORTS) / Raw(LONG)
    return [bytes(Ether(**MAC) / part) for part in fragment6(packet, 1280)]


@pytest.mark.parametrize("frames", [fragments4(), fragments6()], ids=["IPv4", "IPv6"])
@pytest.mark.parametrize("together", [True, False])
@pytest.mark.parametrize("backwards", [True, False])
def test_fragments_are_put_together(frames, together, backwards):
    frames = frames[::-1] if backwards else frames
    reader = Demux()
    if together:
        rows = list(reader.demux(batch_of(frames)))
    else:
        rows = [reader.demux(batch_of([frame], times=[time]))[0] for time, frame in enumerate(frames)]
    assert [row.frame for row in rows] == frames
    assert [row.payload for row in rows] == [b""] * (len(frames) - 1) + [LONG]
    assert [row.findings for row in rows] == [Finding.FRAGMENT] * (len(frames) - 1) + [Finding(0)]
    assert rows[-1].payload_offset == -1
    assert (rows[-1].source.port, rows[-1].destination.port) == (4321, 1234)
    assert [row.source.port for row in rows[:-1]] == [0 if backwards else 4321] * (len(frames) - 1)
    assert (reader.incomplete, reader.skipped) == (0, 0)


def test_fragments_between_whole_datagrams():
    whole = bytes(Ether(**MAC) / udp4())
    first, *others = fragments4()
    rows = list(demux(batch_of([whole, first, whole, *others, whole])))
    assert [len(row.payload) for row in rows] == [13, 0, 13, *[0] * (len(others) - 1), len(LONG), 13]


def test_a_lost_fragment_is_reported():
    reader = Demux()
    rows = list(reader.demux(batch_of(fragments4()[:-1])))
    assert all(row.findings == Finding.FRAGMENT and not row.payload for row in rows)
    assert reader.incomplete == 1


def test_a_fragment_cut_by_the_capture_completes_nothing():
    frames = fragments4()
    cut = [frames[0][:100], *frames[1:]]
    rows = list(demux(batch_of(cut, original=[len(frame) for frame in frames])))
    assert rows[0].findings == Finding.FRAGMENT | Finding.CAPTURE_CUT
    assert all(not row.payload for row in rows)


garbage = st.tuples(
    st.sampled_from([0, 1, 12, 14, 101, 108, 113, 228, 229, 276, 105]),
    st.one_of(
        st.binary(max_size=120),
        st.tuples(
            st.sampled_from(
                [frame_of(case)[1] for case in CASES.values()] + fragments4()[:1] + fragments6()[-1:]
            ),
            st.lists(st.tuples(st.integers(0, 70), st.integers(0, 255)), max_size=4),
            st.integers(0, 120),
        ).map(lambda broken: _break(*broken)),
    ),
)


def _break(frame, changes, length):
    frame = bytearray(frame)
    for place, value in changes:
        if place < len(frame):
            frame[place] = value
    return bytes(frame[:length])


@given(st.lists(garbage, max_size=12), st.booleans())
def test_any_bytes_give_rows_that_stay_inside_the_buffer(cases, cut):
    frames = [frame for _, frame in cases]
    original = [len(frame) + (5 if cut else 0) for frame in frames]
    reader = Demux()
    batch = reader.demux(batch_of(frames, [link_type for link_type, _ in cases], original))
    assert len(batch) + reader.skipped == len(frames)
    assert (np.diff(batch.number) > 0).all()
    assert (batch.length >= 0).all()
    assert (batch.offset >= 0).all()
    assert (batch.offset + batch.length <= batch.data.size).all()
    for datagram in batch:
        assert datagram.frame == frames[datagram.number - 1]
        assert datagram.payload_offset >= 0 or len(datagram.payload) <= 65535
        if not datagram.findings & Finding.FRAGMENT and datagram.payload_offset >= 0:
            alone = demux(batch_of([datagram.frame], datagram.link_type, original[datagram.number - 1 :][:1]))
            assert [(datagram.payload, datagram.source)] == [(row.payload, row.source) for row in alone]


def test_tshark_agrees(tmp_path):
    tshark = shutil.which("tshark")
    assert tshark, "the suite needs tshark: apt install tshark"
    # Wireshark does not know Linux's AF_INET6 in a null header.
    cases = [frame_of(case) for name, case in CASES.items() if "Linux" not in name]
    cases += [(1, frame) for frame in fragments4() + fragments6()]
    link_types, frames = zip(*cases, strict=True)
    path = tmp_path / "all.pcapng"
    path.write_bytes(pcapng_of(link_types, frames))
    fields = ["frame.number", "ip.src", "ipv6.src", "udp.srcport", "udp.dstport", "udp.payload"]
    command = [tshark, "-r", str(path), "-T", "fields", "-Y", "udp", "-E", "occurrence=f"]
    command += [word for field in fields for word in ("-e", field)]
    lines = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    ours = [
        [
            str(row.number),
            *((row.source.address, "") if "." in row.source.address else ("", row.source.address)),
            str(row.source.port),
            str(row.destination.port),
            row.payload.hex(),
        ]
        for row in demux(batch_of(frames, link_types))
        if not row.findings & Finding.FRAGMENT
    ]
    assert ours == [line.split("\t") for line in lines]


def pcapng_of(link_types, frames):
    """A pcapng with an interface for each frame."""

    def block(kind, body):
        body += bytes(-len(body) % 4)
        return struct.pack("<II", kind, 12 + len(body)) + body + struct.pack("<I", 12 + len(body))

    section = block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1))
    interfaces = [block(1, struct.pack("<HHI", link_type, 0, 0)) for link_type in link_types]
    packets = [
        block(6, struct.pack("<IIIII", number, 0, 1, len(frame), len(frame)) + frame)
        for number, frame in enumerate(frames)
    ]
    return b"".join([section, *interfaces, *packets])


def damaged(frames):
    batch = demux(batch_of([bytes(item) for item in frames]))
    return wrong_checksums(batch, network_headers(batch)[0]).tolist()


def turned(frame, at, mask=0x10):
    data = bytearray(bytes(frame))
    data[at] ^= mask
    return bytes(data)


@pytest.mark.parametrize("packet", [udp4(), udp6(), udp4(b"odd"), udp6(b"odd")])
@pytest.mark.parametrize("tags", [0, 1])
def test_a_bit_that_turned_over_shows_in_the_checksum(packet, tags):
    frame = Ether(**MAC) / (Dot1Q(vlan=5) / packet if tags else packet)
    last = len(frame)
    assert damaged([frame, turned(frame, -1), turned(frame, last - 3, 1), frame]) == [0, 1, 1, 0]


def test_an_ipv4_header_has_a_checksum_of_its_own():
    frame = Ether(**MAC) / udp4(id=7)
    assert damaged([turned(frame, 19), turned(frame, 22, 1), turned(frame, 29)]) == [2, 2, 3]


def test_what_has_no_checksum_or_leaves_it_to_the_network_card_is_not_damaged():
    none = Ether(**MAC) / IP(**V4, chksum=0) / UDP(**PORTS, chksum=0) / Raw(PAYLOAD)
    pseudo = bytes([10, 1, 2, 3, 10, 4, 5, 6, 0, 17]) + struct.pack(">H", 8 + len(PAYLOAD))
    total = sum(struct.unpack(">6H", pseudo))
    left = Ether(**MAC) / IP(**V4) / UDP(**PORTS, chksum=total % 0xFFFF) / Raw(PAYLOAD)
    assert damaged([none, turned(none, -1), left, turned(left, -1)]) == [0] * 4


def test_what_was_cut_or_put_together_has_no_checksum_to_judge():
    frame = bytes(Ether(**MAC) / udp4())
    batch = demux(batch_of([frame[:-2]], original=[len(frame)]))
    assert not wrong_checksums(batch, network_headers(batch)[0]).any()
    pieces = [Ether(**MAC) / item for item in fragment(udp4(bytes(range(64)), id=9), 24)]
    assert not any(damaged(pieces))
