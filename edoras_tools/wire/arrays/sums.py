"""Sums of many byte ranges at once: cyclic redundancy checks, and hashes that tell equal bytes.

CRC-32 (zlib, MCAP, Ethernet) uses the ``isal`` library, which is ten times as fast as zlib, or zlib on
machines without it. CRC-16 (CCSDS: polynomial 0x1021, preset to ones, 132.0-B 4.1.6.2) uses the standard
library for one range of bytes; for many ranges it advances by two bytes of each at once. CRC-32C (Castagnoli,
RFC 3720 B.4) is combined from the CRCs of short rows, which are computed all at once.

A CRC without its preset and its last inversion is a polynomial in x modulo P: the CRC of consecutive pieces
is the sum of theirs, each times x to the power of the number of bits after it. So the CRC of a file can be
added up from its pieces in any order (``FileCrc``).

Equal bytes have equal hashes, different bytes almost never do.
"""

from __future__ import annotations

from binascii import crc_hqx
from functools import cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.wire.arrays.order import Integers, Octets, Places, by_value
from edoras_tools.wire.arrays.window import copy_rows, gather

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray
    from typing_extensions import Buffer

CRC16_BYTES: Final = 2
_ONES: Final = 0xFFFF
_FEW: Final = 32
"""Most ranges for which one call each is faster."""
_BLOCK: Final = 4 << 20
"""Most bytes that are laid out at once."""
_INVERTED: Final = 0xFFFFFFFF
"""Preset and last inversion of both CRCs of 32 bits."""
_CRC32: Final = 0xEDB88320
_CRC32C: Final = 0x82F63B78
"""The polynomials of 32 bits; x^31 is the lowest bit, and 1 is the highest bit."""
_ONE: Final = 1 << 31
_ROW: Final = 64
"""Bytes of a row for CRC-32C."""


@cache
def _fastest() -> Callable[[Buffer, int], int]:
    try:
        from isal.isal_zlib import crc32 as found
    except ImportError:
        from zlib import crc32 as found
    return found


def crc32(octets: Buffer, value: int = 0) -> int:
    """Return the CRC-32 of some bytes; ``value`` is the CRC of the bytes before them."""
    return _fastest()(octets, value)


def crc16(octets: bytes | memoryview) -> int:
    """Return the CRC-16 of some bytes; it is 0 if their own CRC-16, big-endian, follows them."""
    return crc_hqx(octets, _ONES)


@cache
def _words() -> NDArray[np.uint16]:
    """Return the remainder that two bytes, a big-endian number, make from 0; u16 (65536,)."""
    word = np.arange(1 << 16, dtype=np.uint32)
    for _ in range(16):
        word = (word << np.uint32(1)) ^ (word >> np.uint32(15)) * np.uint32(0x11021)
    return word.astype(np.uint16)


def crc16_rows(data: Octets, offset: Integers, length: NDArray[np.int32]) -> NDArray[np.uint16]:
    """Return the CRC-16 of each range ``offset : offset + length``, u16 (n,).

    Args:
        data: contiguous buffer, u8.
        offset: starts of the ranges, i64 (n,); the ranges lie inside ``data``.
        length: bytes of the ranges, i32 (n,), at least 2.
    """
    count = len(offset)
    if count <= _FEW:
        raw = memoryview(data)  # type: ignore[arg-type]
        ranges = zip(offset.tolist(), length.tolist(), strict=True)
        return np.array([crc16(raw[start : start + size]) for start, size in ranges], np.uint16)
    if count * int(length.max()) > _BLOCK and count > 1:
        half = count // 2
        parts = (slice(half), slice(half, None))
        return np.concatenate([crc16_rows(data, offset[part], length[part]) for part in parts])
    rows = _preset_rows(data, offset, length, CRC16_BYTES)
    words = np.ascontiguousarray(rows.view(">u2").T.astype(np.uint16))
    table, remainder = _words(), np.zeros(count, np.uint16)
    for word in words:
        remainder = table[remainder ^ word]
    return remainder


def _preset_rows(data: Octets, offset: Integers, length: NDArray[np.int32], preset: int) -> Octets:
    """Copy ranges into rows of one even length, with their first bytes inverted, which is a preset to ones.

    Zeros before a range change nothing while the remainder is 0.
    """
    count, width = len(offset), (int(length.max()) + 1) & ~1
    rows = np.zeros((count, width), np.uint8)
    first = np.arange(1, count + 1) * width - length
    copy_rows(rows.ravel(), first, data, offset, length)
    for place in range(preset):
        rows.ravel()[first + place] ^= 0xFF
    return rows


def crc32_rows(data: Octets, offset: Integers, length: NDArray[np.int32]) -> NDArray[np.uint32]:
    """Return the CRC-32 of each range ``offset : offset + length``, u32 (n,); see ``crc16_rows``.

    Args:
        length: bytes of the ranges, i32 (n,), at least 4.
    """
    count = len(offset)
    if count > 1 and count * int(length.max()) > _BLOCK:
        half = count // 2
        parts = (slice(half), slice(half, None))
        return np.concatenate([crc32_rows(data, offset[part], length[part]) for part in parts])
    if not count:
        return np.zeros(0, np.uint32)
    table, remainder = _octets(_CRC32), np.zeros(count, np.uint32)
    for column in np.ascontiguousarray(_preset_rows(data, offset, length, 4).T):
        remainder = table[(remainder ^ column) & np.uint32(0xFF)] ^ (remainder >> np.uint32(8))
    return ~remainder


def _times(one: Any, other: Any, polynomial: Any) -> Any:
    """Multiply modulo a polynomial: numbers, or u32 arrays."""
    product = one & 0
    for bit in range(32):
        product = product ^ (other * (one >> (31 - bit) & 1))
        other = (other >> 1) ^ (other & 1) * polynomial
    return product


@cache
def _power(polynomial: int, doublings: int, *, inverse: bool = False) -> int:
    """Return x to the power of 8 * 2^doublings, or its inverse, modulo a polynomial."""
    if doublings:
        half = _power(polynomial, doublings - 1, inverse=inverse)
        return int(_times(half, half, polynomial))
    value = _ONE
    for _ in range(8):
        if inverse:  # by x: shift to the left; if 1 would be lost, P is subtracted first
            carry = value >> 31
            value = ((value ^ polynomial * carry) << 1 & _INVERTED) | carry
        else:
            value = (value >> 1) ^ (value & 1) * polynomial
    return value


def _shifted(value: int, octets: int, polynomial: int, *, inverse: bool = False) -> int:
    """Multiply by x to the power of 8 * octets, or by its inverse."""
    for doublings in range(octets.bit_length()):
        if octets >> doublings & 1:
            value = int(_times(value, _power(polynomial, doublings, inverse=inverse), polynomial))
    return value


@cache
def _octets(polynomial: int) -> NDArray[np.uint32]:
    """Return the remainder after one byte from a remainder of 0; u32 (256,)."""
    value = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        value = (value >> np.uint32(1)) ^ (value & np.uint32(1)) * np.uint32(polynomial)
    return value


def crc32c(octets: bytes, value: int = 0) -> int:
    """Return the CRC-32C of some bytes; ``value`` is the CRC of the bytes before them."""
    value ^= _INVERTED
    if not octets:
        return value ^ _INVERTED
    table = _octets(_CRC32C)
    rows = np.frombuffer(bytes(-len(octets) % _ROW) + octets, np.uint8).reshape(-1, _ROW)
    remainder = np.zeros(len(rows), np.uint32)
    for column in np.ascontiguousarray(rows.T):
        remainder = table[(remainder ^ column) & np.uint32(0xFF)] ^ (remainder >> np.uint32(8))
    doublings = _ROW.bit_length() - 1
    while len(remainder) > 1:  # in pairs: the first one times x to the power of the bits of the second
        if len(remainder) % 2:
            remainder = np.insert(remainder, 0, 0)
        factor = np.uint32(_power(_CRC32C, doublings))
        remainder = (
            _times(remainder[::2], np.full(len(remainder) // 2, factor), np.uint32(_CRC32C)) ^ remainder[1::2]
        )
        doublings += 1
    return int(remainder[0]) ^ _shifted(value, len(octets), _CRC32C) ^ _INVERTED


class FileCrc:
    """The CRC of a file whose pieces come in any order, each byte once.

    Args:
        castagnoli: CRC-32C instead of CRC-32.
    """

    def __init__(self, *, castagnoli: bool = False) -> None:
        self._polynomial = _CRC32C if castagnoli else _CRC32
        self._crc = crc32c if castagnoli else crc32
        self._sum = 0
        self._end = 0
        self._run = 0

    def add(self, piece: bytes, offset: int) -> None:
        """Add a piece that begins at an offset of the file."""
        if offset != self._end:
            self._sum, self._run = self._folded(), 0
        # Without preset and inversion: both are undone.
        self._run = self._crc(piece, self._run ^ _INVERTED) ^ _INVERTED
        self._end = offset + len(piece)

    def _folded(self) -> int:
        """Return the sum of all pieces, as if the file ended at its beginning."""
        return self._sum ^ _shifted(self._run, self._end, self._polynomial, inverse=True)

    def of_file(self, size: int) -> int:
        """Return the CRC of the whole file of ``size`` bytes, all of which were added."""
        return _shifted(self._folded() ^ _INVERTED, size, self._polynomial) ^ _INVERTED


HASHED_BYTES: Final = 4096
"""Bytes of a packet that are hashed; longer packets differ within these bytes."""
_ROWS: Final = 2048
"""Rows that are handled together: few enough to stay in the second-level cache."""
MIX: Final = np.uint64(0x9E3779B97F4A7C15)
"""An odd number without a pattern: multiplying by it spreads the bits of a word over the product."""


def of_bytes(data: Octets, offset: Integers, length: NDArray[Any]) -> NDArray[np.uint64]:
    """Return the fingerprint of each range of bytes, u64 (n,); 0 for an empty one."""
    out = np.zeros(len(offset), np.uint64)
    cut = np.minimum(length, HASHED_BYTES)
    sizes = ((size, rows) for size, rows in by_value((cut + 7) >> 3) if size > 0)
    for size, own, at in ((size, rows, at) for size, rows in sizes for at in range(0, len(rows), _ROWS)):
        some = slice(at, at + _ROWS)
        rows = some if len(own) == len(out) else own[some]
        words = gather(data, offset[rows], size * 8).view(np.uint64)
        words[:, -1] &= _LAST_WORD.take(cut[rows] & 7)
        # Folded first: a factor alone would let the highest bits of two words cancel each other.
        words ^= words >> np.uint64(32)
        out[rows] = finished(words @ WEIGHTS[:size] + length[rows].astype(np.uint64) * MIX)
    return out


def stirred(words: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Mix each word so that every bit depends on many bits of the input; different words stay different."""
    mixed = (words ^ (words >> np.uint64(29))) * MIX
    return np.asarray(mixed ^ (mixed >> np.uint64(32)), np.uint64)


def finished(total: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return fingerprints from sums of mixed words times ``WEIGHTS``; never 0."""
    return stirred(total) | np.uint64(1)


WEIGHTS: Final = stirred(np.arange(1, HASHED_BYTES // 8 + 2, dtype=np.uint64) * MIX) | np.uint64(1)
"""An odd factor for each word of a range."""
_LAST_WORD: Final = np.array([[0xFF] * (size or 8) + [0] * (-size % 8) for size in range(8)], np.uint8).view(
    np.uint64
)[:, 0]
"""Masks for the last word of a range, by its size modulo 8."""


def matches(first: NDArray[np.uint64], second: NDArray[np.uint64]) -> tuple[Places, Places]:
    """Return the indices of keys that occur exactly once in each array, and are not 0."""
    sides = []
    for keys in (first, second):
        values, at, count = np.unique(keys, return_index=True, return_counts=True)
        once = (count == 1) & (values != 0)
        sides.append((values[once], at[once]))
    _, ours, theirs = np.intersect1d(sides[0][0], sides[1][0], assume_unique=True, return_indices=True)
    return sides[0][1][ours], sides[1][1][theirs]
