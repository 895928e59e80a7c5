"""Blocks as the kernel lays them out, built here from the header file's description."""

from __future__ import annotations

import struct
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.io.capture import tpacket
from edoras_tools.io.capture.bpf import ETHERNET, LINUX_SLL2, RAW
from edoras_tools.io.capture.tpacket import cut
from edoras_tools.io.frames.frame_batch import FrameBatch, frames_of
from edoras_tools.io.frames.linklayer import demux
from edoras_tools.model import Endpoint, Finding
from edoras_tools.wire.arrays import PADDING

ETHERNET_MAC, COOKED_MAC = 82, 96
TIME_NS = 1_700_000_000_123_456_789


def packet(frame, *, mac=ETHERNET_MAC, time_ns=TIME_NS, tag=None, wire=0, sll=bytes(20), last=False, link=14):
    """A tpacket3_hdr, the address and the frame behind it, 8 bytes aligned."""
    size = -(-(mac + len(frame)) // tpacket.ALIGNMENT) * tpacket.ALIGNMENT
    status, tci, tpid = 1, 0, 0
    if tag:
        tci, tpid = tag
        status |= (1 << 4) | ((1 << 6) if tpid else 0)
    header = struct.pack(
        "=6I2H2I2H8x",
        0 if last else size,
        *divmod(time_ns, 1_000_000_000),
        len(frame),
        wire or len(frame),
        status,
        mac,
        mac + link,
        0,
        tci,
        tpid,
        0,
    )
    return (header + sll + b"\xa5" * (mac - len(header) - len(sll)) + frame).ljust(size, b"\xa5")


def block(*packets):
    body = b"".join(packets)
    return struct.pack("=8IQ8x", 1, 48, 1, len(packets), 48, 48 + len(body), 0, 0, 0)[:48].ljust(48) + body


def ring(*blocks):
    """Blocks end to end as the ring copies them, and where their packets' headers are."""
    data = np.frombuffer(b"".join(blocks) + bytes(PADDING), dtype=np.uint8).copy()
    ends = np.cumsum([len(one) for one in blocks]).tolist()
    runs = [
        tpacket.PacketRun(end - len(one) + 48, end, struct.unpack_from("=I", one, 12)[0])
        for end, one in zip(ends, blocks, strict=True)
    ]
    return data, tpacket.packet_heads(data, runs)


def cut_out(frames):
    return [
        frames.data[start : start + length].tobytes()
        for start, length in zip(frames.offset, frames.length, strict=True)
    ]


def test_frames_times_and_numbers():
    first = block(packet(b"a" * 60, time_ns=TIME_NS), packet(b"b" * 61, time_ns=TIME_NS + 1, last=True))
    second = block(packet(b"c" * 1, time_ns=TIME_NS + 5, wire=1500, last=True))
    frames = tpacket.frames(*ring(first, second), RAW, 7)
    assert cut_out(frames) == [b"a" * 60, b"b" * 61, b"c"]
    assert frames.time_ns.tolist() == [TIME_NS, TIME_NS + 1, TIME_NS + 5]
    assert frames.number.tolist() == [7, 8, 9]
    assert frames.original_length.tolist() == [60, 61, 1500]
    assert set(frames.link_type.tolist()) == {RAW}


@pytest.mark.parametrize(("tag", "ethertype"), [((0x2005, 0x88A8), 0x88A8), ((0x2005, 0), 0x8100)])
def test_a_tag_goes_back_to_its_place(tag, ethertype):
    plain = bytes(range(12)) + b"\x08\x00" + b"payload"
    frames = tpacket.frames(
        *ring(block(packet(plain), packet(plain, tag=tag), packet(plain, last=True))), ETHERNET, 1
    )
    tagged = bytes(range(12)) + struct.pack(">HH", ethertype, tag[0]) + b"\x08\x00" + b"payload"
    assert cut_out(frames) == [plain, tagged, plain]
    assert frames.original_length.tolist() == [len(plain), len(tagged), len(plain)]


def test_cooked_headers_are_written():
    address = struct.pack(
        "=HHiHBB8s", 17, int.from_bytes(b"\x86\xdd", sys.byteorder), 0x01020304, 772, 4, 6, b"12345678"
    )
    frames = tpacket.frames(
        *ring(
            block(
                packet(b"x" * 40, mac=COOKED_MAC, link=0, sll=address),
                packet(b"y", mac=COOKED_MAC, link=0, last=True),
            )
        ),
        LINUX_SLL2,
        1,
    )
    header = b"\x86\xdd\0\0\x01\x02\x03\x04\x03\x04\x04\x06" + b"12345678"
    assert cut_out(frames) == [header + b"x" * 40, bytes(20) + b"y"]
    assert frames.original_length.tolist() == [60, 21]


ADDRESS = struct.pack("=HHiHBB8s", 17, 0, 0x01020304, 1, 4, 6, b"12345678")


@pytest.mark.parametrize(
    ("header", "told", "written"),
    [
        (bytes(12) + b"\x08\x00", 0x0800, 0x0800),
        (bytes(12) + b"\x81\0\0\5\x86\xdd", 0x8100, 0x86DD),  # a tag that goes with its header
        (bytes(12) + b"\x81\0", 0x8100, 0x8100),  # a tag that stays
        (bytes(12) + b"\0\x40", 0x0004, 0x0004),  # no EtherType: IEEE 802.3
        (b"", 0x0800, 0x0800),
    ],
)
def test_a_cooked_header_takes_the_place_of_another(header, told, written):
    sll = ADDRESS[:2] + told.to_bytes(2, "big") + ADDRESS[4:]
    one = packet(header + b"x" * 40, mac=106 - len(header), link=len(header), sll=sll, wire=400)
    frames = tpacket.frames(*ring(block(one, packet(b"y", mac=106, link=0, last=True))), LINUX_SLL2, 1)
    cooked = written.to_bytes(2, "big") + b"\0\0\x01\x02\x03\x04\x00\x01\x04\x06" + b"12345678"
    assert cut_out(frames) == [cooked + b"x" * 40, bytes(20) + b"y"]
    assert frames.original_length.tolist() == [420 - len(header), 21]


def test_no_packet_at_all():
    assert len(tpacket.frames(*ring(block()), ETHERNET, 1)) == 0


@given(st.lists(st.binary(max_size=100), min_size=2, max_size=60), st.data())
def test_a_block_is_read_in_pieces_while_it_fills(wanted, data):
    """Only the packets counted are read of what was copied; the next one is where the last one says."""
    whole = block(*(packet(frame) for frame in wanted))
    copied, _ = ring(whole)
    first, seen = 48, []
    while len(seen) < len(wanted):
        count = data.draw(st.integers(1, len(wanted) - len(seen)))
        heads = tpacket.packet_heads(copied, [tpacket.PacketRun(first, len(whole), count)])
        seen += cut_out(tpacket.frames(copied, heads, RAW, 1))
        first = int(heads[-1]) + tpacket.behind(copied, int(heads[-1]))
    assert seen == wanted


IMITATION = packet(b"looks like a packet inside a packet")
FRAMES = st.lists(
    st.binary(max_size=200) | st.just(IMITATION) | st.just(IMITATION * 3), min_size=1, max_size=300
)


@given(st.lists(FRAMES, min_size=1, max_size=3), st.sampled_from([ETHERNET, LINUX_SLL2, RAW]), st.randoms())
def test_every_frame_is_found_whatever_it_holds(wanted, link_type, random):
    link = 0 if link_type == LINUX_SLL2 else 14
    blocks = [
        block(
            *(
                packet(frame, mac=random.choice([96, 112]), link=link, last=place == len(group))
                for place, frame in enumerate(group, 1)
            )
        )
        for group in wanted
    ]
    frames = tpacket.frames(*ring(*blocks), link_type, 1)
    cooked = bytes(20) if link_type == LINUX_SLL2 else b""
    assert cut_out(frames) == [cooked + frame for group in wanted for frame in group]


HOSTS = {4: ("10.0.0.1", "10.0.0.2"), 6: ("fd00::1", "fd00::2")}


def total(octets):
    """The Internet checksum's sum (RFC 1071): 0xFFFF over anything that carries its right checksum."""
    octets += bytes(len(octets) % 2)
    value = sum(struct.unpack(f">{len(octets) // 2}H", octets))
    while value >> 16:
        value = (value & 0xFFFF) + (value >> 16)
    return value


def captured(*datagrams, version=4, link=b"", captured=None):
    """Frames of payloads, the link header before each, of which so many bytes were captured."""
    ends = [Endpoint(host, 1000 + place) for place, host in enumerate(HOSTS[version])]
    made = [frames_of([(7, *ends, payload)]) for payload in datagrams]
    frames = [link + item.data[item.offset[0] :][: item.length[0]].tobytes() for item in made]
    kept = [frame[:captured] for frame in frames]
    length = np.array([len(frame) for frame in kept], np.int32)
    return FrameBatch(
        np.frombuffer(b"".join(kept) + b"\xa5" * PADDING, np.uint8),
        np.arange(5, 5 + len(kept)),
        np.arange(len(kept)) + 100,
        np.full(len(kept), 1 if link else 101, np.uint16),
        np.cumsum(length, dtype=np.int64) - length,
        length,
        np.array([len(frame) for frame in frames], np.int32),
    )


def payloads(batch):
    return [batch[row].payload for row in range(len(batch))]


@pytest.mark.parametrize("version", [4, 6])
@pytest.mark.parametrize("tag", [b"", b"\x81\x00\x00\x07"])
def test_a_frame_of_many_is_cut_and_the_others_stay(version, tag):
    link = bytes(12) + tag + {4: b"\x08\x00", 6: b"\x86\xdd"}[version]
    big = bytes(range(250)) * 10
    frames = captured(b"before", big, b"after", version=version, link=link)
    parts = cut(frames, np.array([0, 600, 0]), np.full(3, 20 if version == 4 else 40))
    assert parts.number.tolist() == list(range(5, 12))
    assert parts.time_ns.tolist() == [100, *[101] * 5, 102]
    batch = demux(parts)
    assert payloads(batch) == [b"before", *(big[at : at + 600] for at in range(0, 2500, 600)), b"after"]
    assert not batch.capture_findings.any()
    for row in range(1, 6):
        frame = batch[row].frame
        assert frame.startswith(link)
        packet = frame[len(link) :]
        head, addresses = (20, packet[12:20]) if version == 4 else (40, packet[8:40])
        pseudo = addresses + struct.pack(">HH", 17, len(packet) - head)
        assert total(pseudo + packet[head:]) == 0xFFFF
        if version == 4:
            assert total(packet[:20]) == 0xFFFF
            assert struct.unpack_from(">HH", packet, 2) == (len(packet), row - 1)
        else:
            assert struct.unpack_from(">H", packet, 4) == (len(packet) - 40,)


def test_of_a_cut_off_frame_the_parts_are_cut_off():
    frames = captured(b"a" * 1000, captured=28 + 450)
    batch = demux(cut(frames, np.array([200]), np.array([20])))
    assert [len(item) for item in payloads(batch)] == [200, 200, 50, 0, 0]
    assert (batch.capture_findings != 0).tolist() == [False, False, True, True, True]
    assert batch.capture_findings[2] == Finding.CAPTURE_CUT
    assert batch.original_length.tolist() == [228] * 5


def test_what_is_one_datagram_or_no_udp_stays():
    frames = captured(b"x" * 200, b"y" * 10)
    broken = np.array(frames.data)
    broken[frames.offset[1]] = 0
    frames = FrameBatch(broken, *(getattr(frames, name) for name in FrameBatch.__struct_fields__[1:]))
    parts = cut(frames, np.array([200, 4]), np.array([20, 20]))
    assert parts.length.tolist() == frames.length.tolist()
    assert cut(frames, np.zeros(2, int), np.zeros(2, int)) is frames
    inner = cut(frames, np.array([50, 0]), np.array([20 + 8 + 20, 0]))
    assert inner.length.tolist() == frames.length.tolist(), "what is cut in a tunnel stays whole"


@given(
    st.binary(max_size=300),
    st.integers(1, 400),
    st.sampled_from([1, 101, 113, 276]),
    st.integers(0, 300),
    st.sampled_from([20, 40]),
)
def test_any_frame_of_any_size_keeps_its_bytes(data, size, link_type, beyond, header):
    frames = FrameBatch(
        np.frombuffer(data + bytes(PADDING), np.uint8),
        np.array([1]),
        np.array([0]),
        np.array([link_type], np.uint16),
        np.array([0]),
        np.array([len(data)], np.int32),
        np.array([len(data) + beyond], np.int32),
    )
    whole, parts = demux(frames), demux(cut(frames, np.array([size]), np.array([header])))
    if len(whole):
        assert b"".join(payloads(parts)).startswith(b"".join(payloads(whole)))
