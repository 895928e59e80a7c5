"""Captures taken apart into datagrams, changed, and written again: pcap, nanoseconds, of any link layer."""

from __future__ import annotations

import gzip
import struct
from functools import cache
from ipaddress import ip_address
from typing import TYPE_CHECKING, Any

import msgspec
import zstandard
from msgspec.structs import replace

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path


address = cache(ip_address)
packed = cache(lambda text: address(text).packed)


class Udp(msgspec.Struct, frozen=True):
    """One captured datagram: when, from where to where, what, and what its frame says beside that."""

    time_ns: int
    source: tuple[str, int]
    destination: tuple[str, int]
    payload: bytes
    identification: int = 0
    time_to_live: int = 64
    tap: int = 0
    """Which interface of an ``any`` capture, and in which direction."""

    def at(self, shift_ns: int) -> Udp:
        """Return it, captured earlier or later."""
        return replace(self, time_ns=self.time_ns + shift_ns)


def datagrams(path: Path) -> list[Udp]:
    """Return the UDP datagrams of a pcap file of Ethernet frames with IPv4, in the file's order."""
    raw = path.read_bytes()
    unpack = {".gz": gzip.decompress, ".zst": zstandard.decompress}.get(path.suffix, bytes)
    data = unpack(raw)
    magic = data[:4]
    order = "<" if magic in {b"\xd4\xc3\xb2\xa1", b"\x4d\x3c\xb2\xa1"} else ">"
    unit = 1 if magic in {b"\x4d\x3c\xb2\xa1", b"\xa1\xb2\x3c\x4d"} else 1000
    found, at = [], 24
    while at + 16 <= len(data):
        seconds, part, length, _ = struct.unpack_from(order + "IIII", data, at)
        frame, at = data[at + 16 : at + 16 + length], at + 16 + length
        if frame[12:14] != b"\x08\x00" or frame[23] != 17:
            continue
        ip = frame[14:]
        udp = ip[(ip[0] & 15) * 4 :]
        ports = struct.unpack_from(">HHH", udp)
        found.append(
            Udp(
                seconds * 10**9 + part * unit,
                (str(address(ip[12:16])), ports[0]),
                (str(address(ip[16:20])), ports[1]),
                udp[8 : ports[2]],
                int.from_bytes(ip[4:6], "big"),
                ip[8],
            )
        )
    return found


def write(path: Path, items: Iterable[Udp], *, snap: int = 0, layer: str = "ethernet", cut: int = 0) -> Path:
    """Write datagrams in the order given; return the path.

    Args:
        path: of the new file.
        items: the datagrams.
        snap: bytes of a frame that are kept; 0 all.
        layer: ``ethernet``, ``vlan``, ``raw``, or ``any`` and ``any2``: Linux cooked, as ``tcpdump -i any``.
        cut: payload bytes of an IP fragment, a multiple of 8; 0: never fragment.
    """
    kinds = {"ethernet": 1, "vlan": 1, "any": 113, "any2": 276, "raw": 101}
    out = [struct.pack("<IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, snap or 262144, kinds[layer])]
    for item in items:
        for packet in _packets(item, cut):
            frame = _head(item, layer, version=packet[0] >> 4) + packet
            kept = frame[:snap] if snap else frame
            out.append(struct.pack("<IIII", *divmod(item.time_ns, 10**9), len(kept), len(frame)) + kept)
    path.write_bytes(b"".join(out))
    return path


def rewritten(source: Path, path: Path, change: Callable[[bytes], bytes], **how: Any) -> Path:
    """Write a capture again with every payload changed."""
    return write(path, [replace(item, payload=change(item.payload)) for item in datagrams(source)], **how)


def _head(item: Udp, layer: str, *, version: int) -> bytes:
    kind = b"\x86\xdd" if version == 6 else b"\x08\x00"
    if layer == "raw":
        return b""
    if layer == "any":
        return struct.pack(">HHH", 0 if item.tap else 4, 772, 6) + bytes(8) + kind
    if layer == "any2":
        return kind + struct.pack(">HIHBB", 0, 1 + item.tap, 772, 0 if item.tap else 4, 6) + bytes(8)
    mac = bytes([2, 0, 0, 0, 0, item.tap])
    tag = b"\x81\x00\x00\x07" if layer == "vlan" else b""
    return mac + mac + tag + kind


def _packets(item: Udp, cut: int) -> list[bytes]:
    udp = struct.pack(">HHHH", item.source[1], item.destination[1], 8 + len(item.payload), 0) + item.payload
    source, destination = packed(item.source[0]), packed(item.destination[0])
    if len(source) == 16:
        head = struct.pack(">IHBB", 6 << 28, len(udp), 17, item.time_to_live)
        return [head + source + destination + udp]
    parts = [(at, udp[at : at + cut]) for at in range(0, len(udp), cut)] if cut else [(0, udp)]
    return [
        struct.pack(
            ">BBHHHBBH",
            *(0x45, 0, 20 + len(part), item.identification),
            (at >> 3) | (0x2000 if at + len(part) < len(udp) else 0),
            *(item.time_to_live, 17, 0),
        )
        + source
        + destination
        + part
        for at, part in parts
    ]
