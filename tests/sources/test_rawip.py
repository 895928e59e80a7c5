"""Headers for datagrams that came without: read back by the demultiplexer and checked by plain arithmetic."""

from __future__ import annotations

import ipaddress
import struct

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.model import Endpoint
from edoras_tools.sources.bpf import RAW
from edoras_tools.sources.framing import PADDING
from edoras_tools.sources.linklayer import FrameBatch, demux
from edoras_tools.sources.rawip import ROOM, write_headers


def total(octets):
    """The Internet checksum's sum (RFC 1071): 0xFFFF over anything that carries its right checksum."""
    octets += bytes(len(octets) % 2)
    value = sum(struct.unpack(f">{len(octets) // 2}H", octets))
    while value >> 16:
        value = (value & 0xFFFF) + (value >> 16)
    return value


def build(version, datagrams):
    """Frames for (source, source port, destination, destination port, payload) rows."""
    places, data = [], b""
    for *_, payload in datagrams:
        places.append(len(data))
        data += b"\xa5" * ROOM[version] + payload + bytes(2 - len(payload) % 2)
    buffer = np.frombuffer(data + bytes(PADDING), dtype=np.uint8).copy()
    offset = np.array(places, dtype=np.int64)
    length = np.array([len(row[4]) for row in datagrams], dtype=np.int32)
    ends = [
        (
            np.array([list(row[at]) for row in datagrams], dtype=np.uint8),
            np.array([row[at + 1] for row in datagrams], dtype=np.uint16),
        )
        for at in (0, 2)
    ]
    write_headers(buffer, version, offset, length, *ends)
    whole = length + np.int32(ROOM[version])
    return FrameBatch(
        data=buffer,
        number=np.arange(1, len(offset) + 1),
        time_ns=np.zeros(len(offset), dtype=np.int64),
        link_type=np.full(len(offset), RAW, dtype=np.uint16),
        offset=offset,
        length=whole,
        original_length=whole,
    )


def rows(width):
    address, port = st.binary(min_size=width, max_size=width), st.integers(0, 65535)
    return st.lists(st.tuples(address, port, address, port, st.binary(max_size=60)), min_size=1, max_size=8)


def check(version, datagrams):
    frames = build(version, datagrams)
    batch = demux(frames)
    assert len(batch) == len(datagrams)
    for row, (source, source_port, destination, port, payload) in enumerate(datagrams):
        datagram = batch[row]
        assert datagram.payload == payload
        assert datagram.source == Endpoint(str(ipaddress.ip_address(source)), source_port)
        assert datagram.destination == Endpoint(str(ipaddress.ip_address(destination)), port)
        assert not datagram.findings
        frame = datagram.frame
        udp = frame[ROOM[version] - 8 :]
        pseudo = source + destination + struct.pack(">HH", 17, len(udp))
        assert total(pseudo + udp) == 0xFFFF
        assert udp[6:8] != b"\0\0"
        if version == 4:
            assert total(frame[:20]) == 0xFFFF
            assert struct.unpack_from(">H", frame, 2)[0] == len(frame)
        else:
            assert struct.unpack_from(">H", frame, 4)[0] == len(frame) - 40


@given(rows(4))
def test_ipv4(datagrams):
    check(4, datagrams)


@given(rows(16))
def test_ipv6(datagrams):
    check(6, datagrams)


def test_a_checksum_that_comes_out_as_zero_is_sent_as_ones():
    # RFC 768: zero means "none", so the sum is steered to 0xFFFF with two bytes of payload.
    frame = (bytes(4), 0, bytes(4), 0)
    base = total(struct.pack(">HHHHHH", 17, 10, 0, 0, 10, 0))
    payload = struct.pack(">H", 0xFFFF - base)
    built = build(4, [(*frame, payload)])
    assert built.data[26:28].tobytes() == b"\xff\xff"


def test_the_largest_payload():
    check(4, [(b"\x7f\0\0\1", 1, b"\x7f\0\0\1", 2, b"\xff" * 65507)])
