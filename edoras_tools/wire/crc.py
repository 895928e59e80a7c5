"""Cyclic redundancy checks: CRC-32 as zlib, MCAP and Ethernet have it, and CRC-16 as CCSDS has it.

CRC-32 comes by the ``isal`` library, at ten times the speed of zlib's; by zlib's on machines that it is not
made for. CRC-16 (polynomial 0x1021, preset to ones, 132.0-B 4.1.6.2) is the standard library's for one range
of bytes; over many ranges it goes on by two bytes of each at once.
"""

from __future__ import annotations

from binascii import crc_hqx
from functools import cache
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.wire.window import copy_rows

try:
    from isal.isal_zlib import crc32
except ImportError:
    from zlib import crc32

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["CRC16_BYTES", "crc16", "crc16_rows", "crc32"]

CRC16_BYTES: Final = 2
_ONES: Final = 0xFFFF
_FEW: Final = 32
"""Up to this many ranges, one call for each is faster."""
_BLOCK: Final = 4 << 20
"""Bytes that are laid out at once, at the most."""


def crc16(octets: bytes | memoryview) -> int:
    """Return the CRC-16 of some bytes; with their own CRC-16, big-endian, behind them it is 0."""
    return crc_hqx(octets, _ONES)


@cache
def _words() -> NDArray[np.uint16]:
    """Return what two bytes, as a big-endian number, make of a remainder of 0; u16 (65536,)."""
    word = np.arange(1 << 16, dtype=np.uint32)
    for _ in range(16):
        word = (word << np.uint32(1)) ^ (word >> np.uint32(15)) * np.uint32(0x11021)
    return word.astype(np.uint16)


def crc16_rows(
    data: NDArray[np.uint8], offset: NDArray[np.int64], length: NDArray[np.int32]
) -> NDArray[np.uint16]:
    """Return the CRC-16 of each range ``offset : offset + length``, u16 (n,).

    Args:
        data: u8, contiguous.
        offset: i64 (n,); the ranges lie inside ``data``.
        length: i32 (n,), at least 2.
    """
    count = len(offset)
    if count <= _FEW:
        raw = memoryview(data)  # type: ignore[arg-type]
        ranges = zip(offset.tolist(), length.tolist(), strict=True)
        return np.array([crc16(raw[start : start + size]) for start, size in ranges], np.uint16)
    width = (int(length.max()) + 1) & ~1
    if count * width > _BLOCK and count > 1:
        half = count // 2
        parts = (slice(half), slice(half, None))
        return np.concatenate([crc16_rows(data, offset[part], length[part]) for part in parts])
    # Zeros in front change nothing where the remainder is 0: the preset is put into the first two bytes.
    rows = np.zeros((count, width), np.uint8)
    first = np.arange(1, count + 1) * width - length
    copy_rows(rows.ravel(), first, data, offset, length)
    rows.ravel()[first] ^= 0xFF
    rows.ravel()[first + 1] ^= 0xFF
    words = np.ascontiguousarray(rows.view(">u2").T.astype(np.uint16))
    table, remainder = _words(), np.zeros(count, np.uint16)
    for word in words:
        remainder = table[remainder ^ word]
    return remainder
