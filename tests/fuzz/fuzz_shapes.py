"""Mutations that know files: records are moved, doubled, cut or garbled; lengths and checksums follow.

So what is garbled lies deep in a file that is sound around it, where changed bytes alone hardly come.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

import zstandard

if TYPE_CHECKING:
    from collections.abc import Callable
    from random import Random

    Garble = Callable[[bytes, list[bytes], Random], bytes]

MOST = 1 << 20
"""Bytes that are unpacked of one file or chunk."""
PCAP = dict.fromkeys((b"\xd4\xc3\xb2\xa1", b"\x4d\x3c\xb2\xa1"), "<")
PCAP |= dict.fromkeys((b"\xa1\xb2\xc3\xd4", b"\xa1\xb2\x3c\x4d"), ">")
PCAPNG = b"\x0a\x0d\x0d\x0a"
MCAP = b"\x89MCAP0\r\n"
GZIP, ZSTD = b"\x1f\x8b", b"\x28\xb5\x2f\xfd"
CHUNK = 6
TIMES = (0, 1, 999_999, 10**6, 10**9, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 1_700_000_000, 253_402_300_800)
LENGTHS = (0, 1, 15, 16, 65_535, 65_536, 262_144, 262_145, 0x7FFFFFFF, 0xFFFFFFFF)


@dataclass(slots=True)
class Shape:
    """A file as its records.

    Attributes:
        kind: pcap, pcapng or mcap.
        order: of its bytes, as ``struct`` writes it.
        head: what stands before the first record.
        records: each whole, its own head included.
        tail: what stands behind the last whole record.
    """

    kind: str
    order: str
    head: bytes
    records: list[bytes]
    tail: bytes

    def data(self) -> bytes:
        """Return the file."""
        return self.head + b"".join(self.records) + self.tail


def shape(data: bytes) -> Shape | None:
    """Return a file as its records; None where it is of no kind that is known here."""
    magic = data[:4]
    if magic in PCAP and len(data) >= 24:
        return _split("pcap", PCAP[magic], data, 24)
    if magic == PCAPNG and len(data) >= 12:
        return _split("pcapng", "<" if data[8:12] == b"\x4d\x3c\x2b\x1a" else ">", data, 0)
    return _split("mcap", "<", data, 8) if data[:8] == MCAP else None


HEADS = {"pcap": (16, 8, "I"), "pcapng": (0, 4, "I"), "mcap": (9, 1, "Q")}
"""Of a record: bytes that its length does not count, where its length stands, and as what."""


def _split(kind: str, order: str, data: bytes, start: int) -> Shape:
    head, place, form = HEADS[kind]
    records, at = [], start
    while at + 16 <= len(data):
        (length,) = struct.unpack_from(order + form, data, at + place)
        if head + length < 9 or at + head + length > len(data):
            break
        records.append(data[at : at + head + length])
        at += head + length
    return Shape(kind, order, data[:start], records, data[at:])


def mutate(data: bytes, others: list[bytes], random: Random, garble: Garble) -> bytes | None:
    """Return a file that differs in some of its records; None where it has none.

    Args:
        data: a file, or one byte and a file.
        others: more of them, to take records from.
        random: where to look and what to do.
        garble: changes the bytes of one record.
    """
    for skip in (0, 1):
        made = _mutate(data[skip:], [item[skip:] for item in others], random, garble)
        if made is not None:
            return data[:skip] + made
    return None


def _mutate(data: bytes, others: list[bytes], random: Random, garble: Garble) -> bytes | None:
    if data[:2] == GZIP or data[:4] == ZSTD:
        return _repacked(data, others, random, garble)
    file = shape(data)
    if file is None or not file.records:
        return None
    for _ in range(random.choice((1, 1, 2, 4))):
        _change(file, others, random, garble)
    return file.data()


def _repacked(data: bytes, others: list[bytes], random: Random, garble: Garble) -> bytes | None:
    is_gzip = data[:2] == GZIP
    try:
        plain = zlib.decompressobj(31).decompress(data, MOST) if is_gzip else _unzstd(data)
    except (zlib.error, zstandard.ZstdError):
        return None
    if plain[:2] == GZIP or plain[:4] == ZSTD:
        return None
    made = _mutate(plain, others, random, garble)
    if made is None:
        return None
    return gzip.compress(made, 1) if is_gzip else zstandard.compress(made)


def _unzstd(data: bytes) -> bytes:
    return zstandard.ZstdDecompressor().stream_reader(data).read(MOST)


def _change(file: Shape, others: list[bytes], random: Random, garble: Garble) -> None:
    records = file.records
    if not records:
        return
    place, to = random.randrange(len(records)), random.randrange(len(records))
    match random.randrange(9):
        case 0:
            del records[place]
        case 1:
            records[to:to] = records[place : place + random.choice((1, 2, 20))]
        case 2:
            records[place], records[to] = records[to], records[place]
        case 3:
            del records[min(place, to) : max(place, to)]
        case 4 if others:
            other = shape(random.choice(others))
            if other is not None and other.kind == file.kind and other.records:
                records[place:place] = random.choices(other.records, k=random.choice((1, 3)))
        case 5:
            records[place] = _with_number(file, records[place], random)
        case _:
            records[place] = _garbled(file, records[place], others, random, garble)


def _with_number(file: Shape, record: bytes, random: Random) -> bytes:
    """Garble a time or a length and leave the rest: the file may be cut in the middle of nothing."""
    made = bytearray(record)
    width = {"pcap": 4, "pcapng": 4, "mcap": 8}[file.kind]
    places = {"pcap": (0, 4, 8, 12), "pcapng": (4, 8, 12, 16, 20, 24)}.get(file.kind, (1, 9, 17, 25, 33))
    at = random.choice(places)
    value = random.choice((*TIMES, *LENGTHS, random.getrandbits(8 * width)))
    if at + width <= len(made):
        form = file.order + ("I" if width == 4 else "Q")
        struct.pack_into(form, made, at, value % (1 << 8 * width))
    return bytes(made)


def _garbled(file: Shape, record: bytes, others: list[bytes], random: Random, garble: Garble) -> bytes:
    """Garble what is in a record; its length, and the checksum of a chunk, are right again."""
    if file.kind == "pcap":
        body = garble(record[16:], [], random)
        return record[:8] + struct.pack(file.order + "II", len(body), len(body)) + body
    if file.kind == "pcapng":
        body = garble(record[8:-4], [], random)
        body += bytes(-len(body) % 4)
        length = struct.pack(file.order + "I", len(body) + 12)
        return record[:4] + length + body + length
    if record[0] == CHUNK and random.random() < 0.8:
        made = _chunk(record[9:], others, random, garble)
    else:
        made = garble(record[9:], [], random)
    return record[:1] + struct.pack("<Q", len(made)) + made


def _chunk(content: bytes, others: list[bytes], random: Random, garble: Garble) -> bytes:
    """Change the records of a chunk; its size and its checksum are right again."""
    if len(content) < 40:
        return content
    (named,) = struct.unpack_from("<I", content, 28)
    start = 32 + named + 8
    name, packed = content[32 : 32 + named], content[start:]
    try:
        plain = _unzstd(packed) if name == b"zstd" else packed
    except zstandard.ZstdError:
        return content
    inner = shape(MCAP + plain) if name in {b"zstd", b""} else None
    if inner is None or not inner.records:
        return content
    _change(inner, others, random, garble)
    made = inner.data()[8:]
    again = zstandard.compress(made) if name == b"zstd" else made
    head = content[:16] + struct.pack("<QII", len(made), zlib.crc32(made), named) + name
    return head + struct.pack("<Q", len(again)) + again
