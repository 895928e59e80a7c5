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
from edoras_tools.wire.arrays.window import PADDING

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
