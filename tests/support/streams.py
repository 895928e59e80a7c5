"""TCP segments and SBN messages for tests, made from RFC 9293 and the public SBN sources, not with ours."""

from __future__ import annotations

import ipaddress
import struct
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from edoras_tools.io.frames.frame_batch import FrameBatch

SYN, ACK, FIN = 2, 16, 1
CLIENT, SERVER = ("10.0.0.1", 40000), ("10.0.0.2", 2234)


class Segment(NamedTuple):
    """One TCP segment over IPv4 or IPv6 and Ethernet."""

    sequence: int
    data: bytes = b""
    flags: int = ACK
    acknowledged: int = 1
    source: tuple[str, int] = CLIENT
    destination: tuple[str, int] = SERVER
    time_ns: int = 0
    captured: int = 1 << 30

    def frame(self) -> bytes:
        """Return the whole frame, with right checksums."""
        ends = [ipaddress.ip_address(item[0]) for item in (self.source, self.destination)]
        addresses = b"".join(item.packed for item in ends)
        tcp = struct.pack(
            ">HHIIBBHHH",
            self.source[1],
            self.destination[1],
            self.sequence % (1 << 32),
            self.acknowledged % (1 << 32),
            5 << 4,
            self.flags,
            65535,
            0,
            0,
        )
        length = len(tcp) + len(self.data)
        pseudo = addresses + struct.pack(">IBBBB", length, 0, 0, 0, 6)
        tcp = tcp[:16] + struct.pack(">H", checksum(pseudo + tcp + self.data)) + tcp[18:]
        if ends[0].version == 4:
            head = struct.pack(">BBHHHBBH", 0x45, 0, 20 + length, 7, 0, 64, 6, 0) + addresses
            head = head[:10] + struct.pack(">H", checksum(head)) + head[12:]
            return bytes(12) + b"\x08\x00" + head + tcp + self.data
        return (
            bytes(12)
            + b"\x86\xdd"
            + struct.pack(">IHBB", 6 << 28, length, 6, 64)
            + addresses
            + tcp
            + self.data
        )


def checksum(octets: bytes) -> int:
    """Return the Internet checksum (RFC 1071)."""
    octets += bytes(len(octets) % 2)
    total = sum(struct.unpack(f">{len(octets) // 2}H", octets))
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    return ~total & 0xFFFF


def frames(segments, number: int = 1) -> FrameBatch:
    """Return the frames of segments, a millisecond apart unless they say a time."""
    wire = [item.frame() for item in segments]
    kept = [frame[: item.captured] for frame, item in zip(wire, segments, strict=True)]
    length = np.array([len(item) for item in kept], np.int32)
    count = len(kept)
    base = 1_700_000_000_000_000_000
    times = [item.time_ns or base + 1_000_000 * (number + at) for at, item in enumerate(segments)]
    return FrameBatch(
        np.frombuffer(b"".join(kept), np.uint8),
        np.arange(number, number + count),
        np.array(times, np.int64),
        np.ones(count, np.uint16),
        np.cumsum(length, dtype=np.int64) - length,
        length,
        np.array([len(item) for item in wire], np.int32),
    )


def write_segments(path, segments) -> None:
    """Write segments as a pcap file."""
    batch = frames(segments)
    out = [struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 262144, 1)]
    columns = batch.offset.tolist(), batch.length.tolist(), batch.time_ns.tolist()
    for offset, length, time_ns in zip(*columns, strict=True):
        seconds, rest = divmod(time_ns, 10**9)
        head = struct.pack("<IIII", seconds, rest // 1000, length, length)
        out.append(head + batch.data[offset : offset + length].tobytes())
    path.write_bytes(b"".join(out))


def sbn_message(kind: int, payload: bytes, processor: int = 3, spacecraft: int = 0x42) -> bytes:
    """Return one SBN message."""
    return struct.pack(">hBII", len(payload), kind, processor, spacecraft) + payload


def packet(msg_id: int, count: int, body: bytes) -> bytes:
    """Return a command packet."""
    return struct.pack(">HHHBB", msg_id, 0xC000 | count & 0x3FFF, 1 + len(body), 1, 0) + body


def sbn_messages(count: int, size: int = 20) -> list[bytes]:
    """Return different messages: a PROTO, then packets of growing size, and heartbeats between them."""
    made = [sbn_message(4, b"\x0b")]
    for number in range(count - 1):
        body = bytes((number * 7 + at) & 0xFF for at in range(size + number % 13))
        made.append(sbn_message(3, packet(0x1827, number, body)) if number % 5 else sbn_message(0xA0, b""))
    return made


def segments_of(stream: bytes, cuts, begin: int = 1000, **options) -> list[Segment]:
    """Return a stream as segments that end at ``cuts``, after its SYN."""
    inner = {at for at in (*cuts, *range(0, len(stream), 50_000)) if 0 < at < len(stream)}
    edges = [0, *sorted(inner), len(stream)]
    made = [Segment(begin - 1, flags=SYN, **options)]
    return made + [Segment(begin + first, stream[first:last], **options) for first, last in pairwise(edges)]
