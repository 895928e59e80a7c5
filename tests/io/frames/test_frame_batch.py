"""Headers for datagrams that came without: read back by the demultiplexer and checked by plain arithmetic."""

from __future__ import annotations

import ipaddress
import struct

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.io.frames.frame_batch import ENDS, LINKTYPE_RAW, FramePage, ends_of, frames_at, frames_of
from edoras_tools.io.frames.linklayer import demux
from edoras_tools.model import Endpoint
from edoras_tools.wire.arrays import PADDING


def total(octets):
    """The Internet checksum's sum (RFC 1071): 0xFFFF over anything that carries its right checksum."""
    octets += bytes(len(octets) % 2)
    value = sum(struct.unpack(f">{len(octets) // 2}H", octets))
    while value >> 16:
        value = (value & 0xFFFF) + (value >> 16)
    return value


def build(version, datagrams):
    """Frames for (source, source port, destination, destination port, payload) rows."""
    width = 4 if version == 4 else 16
    ends = np.zeros(len(datagrams), ENDS)
    ends["version"] = version
    for row, (source, source_port, destination, port, _) in enumerate(datagrams):
        ends["source"][row, :width], ends["source_port"][row] = list(source), source_port
        ends["destination"][row, :width], ends["destination_port"][row] = list(destination), port
    length = np.array([len(row[4]) for row in datagrams], dtype=np.int32)
    data = np.frombuffer(b"".join(row[4] for row in datagrams) + b"\xa5" * PADDING, np.uint8)
    page = FramePage(rows=1, size=1)
    page.add(data, np.cumsum(length, dtype=np.int64) - length, length, np.arange(len(length)), ends)
    return page.frames(1)


def rows(width):
    address, port = st.binary(min_size=width, max_size=width), st.integers(0, 65535)
    return st.lists(st.tuples(address, port, address, port, st.binary(max_size=60)), min_size=1, max_size=8)


def check(version, datagrams):
    frames = build(version, datagrams)
    batch = demux(frames)
    assert len(batch) == len(datagrams)
    parsed = demux(frames_at(frames, np.arange(len(frames))))  # that they were made is not known any more
    for name in batch.__struct_fields__:
        made, read = getattr(batch, name), getattr(parsed, name)
        assert np.array_equal(made, read)
        assert getattr(made, "dtype", None) == getattr(read, "dtype", None)
    for row, (source, source_port, destination, port, payload) in enumerate(datagrams):
        datagram = batch[row]
        assert datagram.payload == payload
        assert datagram.source == Endpoint(str(ipaddress.ip_address(source)), source_port)
        assert datagram.destination == Endpoint(str(ipaddress.ip_address(destination)), port)
        assert not datagram.findings
        frame = datagram.frame
        udp = frame[datagram.payload_offset - 8 :]
        assert datagram.link_type == LINKTYPE_RAW
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


def test_a_page_in_parts_and_in_another_order():
    payloads = [bytes([number % 251]) * (number % 7) for number in range(300)]
    four, six = (ends_of(Endpoint(host, 1), Endpoint(host, 2)) for host in ("127.0.0.1", "::1"))
    page = FramePage()
    for number, payload in enumerate(payloads):
        data = np.frombuffer(payload + bytes(PADDING), np.uint8)
        one = np.array([len(payload)])
        page.add(data, np.zeros(1, np.int64), one, np.array([number]), six if number % 3 else four)
    rows = np.arange(300)[::-1]
    for frames in (page.part(rows).frames(7), page.frames(7, rows)):
        batch = demux(frames)
        assert [batch[row].payload for row in range(300)] == payloads[::-1]
        assert frames.number.tolist() == list(range(7, 307))
        assert frames.time_ns.tolist() == rows.tolist()
        assert [batch[row].source.address for row in (0, 299)] == ["::1", "127.0.0.1"]


def test_an_ipv4_end_beside_an_ipv6_one_is_mapped():
    frames = frames_of([(5, Endpoint("10.0.0.1", 1), Endpoint("fe80::1%lo", 2), b"x")], 3)
    datagram = demux(frames)[0]
    assert datagram.source == Endpoint("::ffff:a00:1", 1)
    assert datagram.destination == Endpoint("fe80::1", 2)
    assert (datagram.number, datagram.time_ns, datagram.payload) == (3, 5, b"x")
