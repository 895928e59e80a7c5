"""The fixed parts of MCAP records that are read without the library (https://mcap.dev/spec)."""

from __future__ import annotations

import struct
from contextlib import suppress
from typing import Final, NamedTuple

import numpy as np

RECORD_HEAD: Final = struct.Struct("<BQ")
"""Opcode and length of a record."""
MESSAGE_HEAD: Final = struct.Struct("<HIQQ")
"""Channel, sequence, log time and publish time of a Message record."""
CHUNK_HEAD: Final = struct.Struct("<QQQII")
"""Start time, end time, uncompressed size, CRC, length of the compression's name."""
INDEX_HEAD: Final = np.dtype([("opcode", "u1"), ("length", "<u8"), ("channel_id", "<u2"), ("bytes", "<u4")])
"""A MessageIndex record up to its entries."""
INDEX_ENTRY: Final = np.dtype([("log_time", "<u8"), ("offset", "<u8")])
INDEX_PLACE: Final = np.dtype([("channel_id", "<u2"), ("offset", "<u8")])
"""In a ChunkIndex record: the position of a channel's MessageIndex record."""
CHUNK_INDEX_HEAD: Final = struct.Struct("<QQQQI")
"""Start time, end time, position and length of the chunk, bytes of ``INDEX_PLACE`` entries."""
MAX_CHUNK_BYTES: Final = 1 << 30
"""A chunk with a length above this is considered damaged."""
CHUNK_HEAD_BYTES: Final = CHUNK_HEAD.size + 16 + 8
"""Bytes of a chunk's head with up to 16 letters for the compression."""
_LENGTH: Final = struct.Struct("<Q")


class ChunkHead(NamedTuple):
    """A chunk's record up to its data.

    Attributes:
        start_ns: smallest log time.
        end_ns: largest log time.
        size: uncompressed bytes of its records.
        crc: CRC-32 of these; 0 if the writer gave none.
        compression: "", "zstd", "lz4", or an unknown name.
        data: start of the compressed bytes, counted from the record's content.
        length: number of compressed bytes.
    """

    start_ns: int
    end_ns: int
    size: int
    crc: int
    compression: str
    data: int
    length: int


def chunk_head(content: bytes | memoryview) -> ChunkHead | None:
    """Read the head at the start of a chunk's content; None if it cannot be read."""
    with suppress(struct.error, UnicodeDecodeError):
        start_ns, end_ns, size, crc, name_bytes = CHUNK_HEAD.unpack_from(content)
        place = CHUNK_HEAD.size + name_bytes
        (length,) = _LENGTH.unpack_from(content, place)
        compression = bytes(content[CHUNK_HEAD.size : place]).decode()
        return ChunkHead(start_ns, end_ns, size, crc, compression, place + _LENGTH.size, length)
    return None
