"""The fixed parts of MCAP records that are read without the library (https://mcap.dev/spec)."""

from __future__ import annotations

import struct
from typing import Final

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
