"""Many short stretches of bytes at once: read, copied, summed, sorted and compared as columns.

1. Ranges. A numpy ``V{n}`` view with a stride of one byte has an element at *every* offset of a buffer, so
   one indexed operation moves n bytes for each of many rows: a memcpy a row, and no Python.
2. Sums: cyclic redundancy checks, and hashes; equal bytes have equal hashes, different bytes almost never do.
   CRC-32 (zlib, MCAP, Ethernet) uses the ``isal`` library, which is ten times as fast as zlib, or zlib on
   machines without it. CRC-16 (CCSDS: polynomial 0x1021, preset to ones, 132.0-B 4.1.6.2) uses the standard
   library for one range of bytes; for many ranges it advances by two bytes of each at once. CRC-32C
   (Castagnoli, RFC 3720 B.4) is combined from the CRCs of short rows, which are computed all at once.
3. A CRC without its preset and its last inversion is a polynomial in x modulo P: the CRC of consecutive
   pieces is the sum of theirs, each times x to the power of the number of bits after it. So the CRC of a file
   can be added up from its pieces in any order (``FileCrc``).
4. Order: rows sorted, grouped and counted by key.
"""

from __future__ import annotations

from binascii import crc_hqx
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final, TypeAlias, TypeVar

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import DTypeLike, NDArray
    from typing_extensions import Buffer

_LARGE: Final = 1 << 16
"""Fewest rows for which numpy is faster than one step of Python for each row."""
_FEW_WIDTHS: Final = 16
"""Most different lengths for which each length is its own group."""
_BITS: Final = np.frexp(np.arange(_LARGE + 1.0))[1].astype(np.uint8)
"""Number of bits of each length up to ``_LARGE``."""
_WASTE: Final = 4
"""Most bytes to move, as a multiple of the bytes requested."""
_BLOCK_ROWS: Final = 2048
"""Rows that are moved together: few enough to stay in the first-level cache."""

PADDING = 64
"""Bytes that must be readable after the last byte in use, so that header windows never leave a buffer."""


def at_every_byte(buffer: Octets, width: int) -> NDArray[np.void]:
    """Return a view with an element of ``width`` bytes at every offset where one fits.

    Args:
        buffer: u8, contiguous.
        width: at least 1.
    """
    return np.ndarray((max(len(buffer) - width + 1, 0),), f"V{width}", buffer, 0, (1,))


def read_at(data: Octets, positions: NDArray[np.integer[Any]], dtype: DTypeLike) -> NDArray[Any]:
    """Read one value at each of many byte positions, aligned or not.

    Args:
        data: u8, contiguous.
        positions: byte positions; each value must lie inside ``data``.
        dtype: type of the value, with its byte order; a structured type reads a whole header.

    Returns:
        A fresh array of ``dtype``, one element a position.
    """
    return at_every_byte(data, np.dtype(dtype).itemsize)[positions].view(dtype)


def gather(data: Octets, offset: Integers, width: int) -> Octets:
    """Copy ``width`` bytes at each offset into the rows of a matrix; bytes past the buffer's end are 0.

    Args:
        data: u8, contiguous.
        offset: i64 (n,), each within ``0 .. len(data)``.
        width: bytes a window, at least 1.

    Returns:
        u8 (n, width).
    """
    last = len(data) - width
    if last < 0:
        data, last = np.concatenate([data, np.zeros(-last, np.uint8)]), 0
    rows = at_every_byte(data, width)[np.minimum(offset, last)].view(np.uint8).reshape(len(offset), width)
    if len(offset) and int(offset.max()) > last:
        late = np.flatnonzero(offset > last)
        tail = np.concatenate([data[last:], np.zeros(width, np.uint8)])
        rows[late] = gather(tail, offset[late] - last, width)
    return rows


def put_rows(target: Octets, positions: Integers, rows: NDArray[Any]) -> None:
    """Write every element of the structured array ``rows`` at its byte position in ``target``."""
    width = rows.itemsize
    at_every_byte(target, width)[positions] = np.ascontiguousarray(rows).view(f"V{width}")


def copy_rows(
    target: Octets, positions: Integers, source: Octets, offsets: Integers, lengths: NDArray[np.integer[Any]]
) -> None:
    """Copy ``lengths[i]`` bytes from ``source[offsets[i]]`` to ``target[positions[i]]``, for every i.

    Rows are copied in groups of equal length, because messages of a type mostly have few lengths. If there
    are many, lengths that share their highest bit make a group: the first ``width`` bytes of a row and its
    last ``width`` cover it, so the number of moves does not grow with the number of lengths.
    """
    for width, rows in _widths(lengths):
        to, start = positions[rows], offsets[rows]
        if width >= _LARGE:
            for target_at, source_at, size in zip(
                to.tolist(), start.tolist(), lengths[rows].tolist(), strict=True
            ):
                target[target_at : target_at + size] = source[source_at : source_at + size]
        elif width:
            writable, readable = at_every_byte(target, width), at_every_byte(source, width)
            writable[to] = readable[start]
            rest = lengths[rows] - width
            if rest.any():
                writable[to + rest] = readable[start + rest]


def spill_rows(
    target: Octets, positions: Integers, source: Octets, offsets: Integers, lengths: NDArray[np.integer[Any]]
) -> None:
    """Copy rows like ``copy_rows``, in a third of the time; the gaps after them are overwritten.

    Almost all rows are moved with one length, the longest among them; the next row overwrites the excess. The
    few longer rows are moved last.

    Args:
        target: buffer; write the gaps between rows, and the bytes after the last one, only afterwards.
        positions: increasing positions in ``target``.
        source: as for ``copy_rows``.
        offsets: as for ``copy_rows``.
        lengths: as for ``copy_rows``.
    """
    if not len(lengths):
        return
    most = _WASTE * int(lengths.sum()) // len(lengths)
    width = int(lengths[lengths <= most].max())
    large = width >= _LARGE  # such views copy twice: too slow for large rows
    apart = large | (lengths > most) | (positions > len(target) - width) | (offsets > len(source) - width)
    if width:
        writable, readable = at_every_byte(target, width), at_every_byte(source, width)
        to, start = (positions[~apart], offsets[~apart]) if apart.any() else (positions, offsets)
        for first in range(0, len(to), _BLOCK_ROWS):
            rows = slice(first, first + _BLOCK_ROWS)
            writable[to[rows]] = readable[start[rows]]
    copy_rows(target, positions[apart], source, offsets[apart], lengths[apart])


def _widths(lengths: NDArray[np.integer[Any]]) -> Iterator[tuple[int, Places | slice]]:
    """Yield groups of rows, each with a width such that two moves of it cover every length of the group."""
    shortest, longest = (int(lengths.min()), int(lengths.max())) if len(lengths) else (0, 0)
    if shortest == longest:
        yield shortest, slice(None)
        return
    if longest < _LARGE:
        distinct = np.flatnonzero(np.bincount(lengths)).tolist()
        if len(distinct) <= _FEW_WIDTHS:
            for length in distinct:
                yield length, np.flatnonzero(lengths == length)
            return
    bits = _BITS[np.minimum(lengths, _LARGE)]
    for count in np.flatnonzero(np.bincount(bits)).tolist():
        yield 1 << count >> 1, np.flatnonzero(bits == count)


def xor_bytes(data: Octets, offset: Integers, length: NDArray[np.int32]) -> Octets:
    """Return the XOR of the bytes of each range ``offset : offset + length``, u8 (n,).

    Bytes between two ranges are read too, and ignored: so the ranges are handled in their order in ``data``.
    """
    if not len(data) or not len(offset):
        return np.zeros(len(offset), np.uint8)
    if (offset[1:] < offset[:-1]).any():
        order = np.argsort(offset, kind="stable")
        out = np.empty(len(offset), np.uint8)
        out[order] = xor_bytes(data, offset[order], length[order])
        return out
    last = len(data) - 1
    end = offset + length
    most = int(end.max())
    bounds = np.minimum(np.stack([offset, end], axis=1), last)
    out = np.bitwise_xor.reduceat(data[: most + 1], bounds.reshape(-1))[::2]
    out = out * (bounds[:, 0] < bounds[:, 1])
    if most > last:  # a bound must be inside, so the last byte is added
        out ^= data[last] * ((end > last) & (length > 0))
    return out


def any_nonzero(data: Octets, offset: Integers, length: NDArray[np.int32]) -> Mask:
    """Return whether each range ``offset : offset + length`` holds a byte that is not 0, bool (n,)."""
    out = np.zeros(len(offset), bool)
    for size, rows in by_value(length):
        if size > 0:
            out[rows] = gather(data, offset[rows], size).any(axis=1)
    return out


def word_sums(data: Octets, start: Integers, length: NDArray[np.integer[Any]]) -> Integers:
    """Return the sum of the big-endian 16-bit words of each range, modulo 0xFFFF; i64 (n,).

    An odd last byte is followed by a zero. The buffer has at least 64 bytes after the last range.
    """
    base = int(start.min(initial=len(data))) & ~3
    data, start = data[base : int((start + length).max(initial=0)) + 4], start - base
    end = start + length
    # Four bytes at once: 0x10000 is 1 modulo 0xFFFF, and changed bytes are 256 times the sum.
    words = data[: data.size // 4 * 4].view("<u4").astype(np.uint64)
    running = np.concatenate((np.zeros(1, np.uint64), np.cumsum(words)))
    inner, outer = ((place & 3).astype(np.uint64) * np.uint64(8) for place in (start, end))
    sums = running[end >> 2] - running[start >> 2]
    sums -= words[start >> 2] & ((np.uint64(1) << inner) - np.uint64(1))
    sums += words[end >> 2] & ((np.uint64(1) << outer) - np.uint64(1))
    sums *= np.where(start & 1, np.uint64(1), np.uint64(256))
    return (sums % np.uint64(0xFFFF)).astype(np.int64)


Integers: TypeAlias = "NDArray[np.int64]"
"""Times in ns, counts, or places in a buffer of bytes."""
Mask: TypeAlias = "NDArray[np.bool_]"
"""A selection of the elements of another array."""
Octets: TypeAlias = "NDArray[np.uint8]"
"""Bytes, or small numbers as the codes of links."""
Places: TypeAlias = "NDArray[np.intp]"
"""Indices of the elements of another array."""
Prints: TypeAlias = "NDArray[np.uint64]"
"""Fingerprints; 0 is unknown."""
_Item = TypeVar("_Item")
_Key = TypeVar("_Key")
MIX: Final = np.uint64(0x9E3779B97F4A7C15)
"""An odd number without a pattern: multiplying by it spreads the bits of a word over the product."""
_WIDE: Final = 1 << 31
"""Limit of numbers of which a pair fits into 63 bits."""
_SLOTS: Final = 18
"""Most bits of the lookup table that is used while distinct values are few."""
_SLOTS_EACH: Final = 3
"""Bits of the table beyond those that number the rows: a large table is too slow for few rows."""


def order_by(*keys: NDArray[np.integer]) -> Integers:
    """Return the stable order that groups equal keys; keys are u8, u16 or u32, radix sorted."""
    digits: list[NDArray[np.uint16]] = []
    room = 0  # the largest factor for the last digit; a sort costs the same for each digit
    for key in keys:
        least, most = _bounds(key)
        size = most - least + 1
        moved = key - key.dtype.type(least)
        if 1 < size <= room:
            digits[-1] = digits[-1] * np.uint16(size) + moved.astype(np.uint16)
            room //= size
        elif size > 1:
            digits.append(moved.astype(np.uint16))
            room = 0x10000 // size
            if size > 0x10000:
                digits.append((moved >> 16).astype(np.uint16))
    return np.arange(len(keys[0])) if not digits else np.lexsort(digits)


def in_16_bits(values: NDArray[Any]) -> NDArray[Any]:
    """Return non-negative numbers in 16 bits if they fit: radix sort is then several times as fast."""
    return values.astype(np.uint16) if values.max(initial=0) <= 0xFFFF else values


def changes(rows: Places, *columns: NDArray[Any]) -> Mask:
    """Return whether a column changes at each of some rows; True for the first row."""
    out = np.zeros(len(rows), np.bool_)
    out[:1] = True
    for column in columns:
        if (column != column[:1]).any():
            own = column[rows]
            out[1:] |= own[1:] != own[:-1]
    return out


def numbered(*keys: NDArray[Any]) -> tuple[Places, Places]:
    """Number the distinct rows of some columns of integers, in order of first occurrence.

    Nothing is sorted while there are few distinct rows, as is usual for kinds of traffic.

    Returns:
        The first row of each, and the number of each row: ``numpy.unique``'s index and inverse.
    """
    if len(keys) == 1:
        return _numbered(keys[0])
    whole, size = np.zeros(len(keys[0]), np.intp), 1
    for part, span in map(_from_zero, keys):
        if size * span > _WIDE * _WIDE:
            whole, size = _numbered(whole)[1], len(whole)
        whole, size = whole * span + part, size * span
    return _numbered(whole)


def _numbered(values: NDArray[Any]) -> tuple[Places, Places]:
    rows = np.arange(len(values))
    least, most = _bounds(values)
    if least == most:
        return rows[:1], np.zeros(len(rows), np.intp)
    if most - least >= len(values):
        first_rows = _first_rows(values)
        first = np.flatnonzero(first_rows == rows)
        rows[first] = np.arange(len(first))
        return first, rows[first_rows]
    place, size = _from_zero(values)
    table = np.full(size, -1)
    table[place[::-1]] = rows[::-1]  # numpy keeps the last of several values: the first row
    first = np.sort(table[table >= 0])
    table[place[first]] = np.arange(len(first))
    return first, table[place]


def _bounds(values: NDArray[Any]) -> tuple[int, int]:
    return (int(values.min()), int(values.max())) if len(values) else (0, 0)


def _from_zero(values: NDArray[Any]) -> tuple[Places, int]:
    """Return integers minus the smallest, and the size of their range; a wide range is numbered."""
    least, most = _bounds(values)
    if most - least >= _WIDE:
        return _numbered(values)[1], len(values)
    wide = values if values.dtype.itemsize == 8 else values.astype(np.intp)
    return (wide - wide.dtype.type(least)).astype(np.intp, copy=False), most - least + 1


def _first_rows(values: NDArray[Any], mix: int = int(MIX)) -> Places:
    """Return the first row with the value of each row, by hashes; on a collision another hash is used."""
    bits = min(_SLOTS, len(values).bit_length() + _SLOTS_EACH)
    place = ((values.astype(np.uint64) * np.uint64(mix)) >> np.uint64(64 - bits)).astype(np.intp)
    table = np.empty(1 << bits, np.intp)  # only written elements are read
    table[place[::-1]] = np.arange(len(values))[::-1]
    met = table[place]
    if len(others := np.flatnonzero(values[met] != values)):
        met[others] = others[_first_rows(values[others], mix * int(MIX) % (1 << 64))]
    return met


def perhaps_in(
    values: Prints, others: Prints, kinds: Octets | None = None, fits: Prints | None = None
) -> Mask:
    """Return which fingerprints are among others, and perhaps a few more: nothing is sorted.

    Args:
        kinds: kind of each of the others, below 64.
        fits: bit mask of the kinds that each fingerprint may match; by default any.
    """
    bits = min(_SLOTS, len(others).bit_length() + _SLOTS_EACH)
    table, shift = np.zeros(1 << bits, np.uint64), np.uint64(64 - bits)
    slots = others * MIX >> shift
    for kind, rows in by_value(np.zeros(len(others), np.uint8) if kinds is None else kinds):
        table[slots[rows]] |= np.uint64(1 << kind)
    met = table[values * MIX >> shift]
    return np.asarray((met if fits is None else met & fits) != 0)


def distinct_rows(values: NDArray[Any]) -> tuple[NDArray[Any], Places, Places]:
    """Return ``numpy.unique`` of one column with its index and inverse.

    ``numpy.unique`` imports ``numpy.ma``, which takes longer than the work of a short command.
    """
    first, which = numbered(values)
    order = np.argsort(values[first])
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    first = first[order]
    return values[first], first, place[which]


def distinct(values: NDArray[Any]) -> NDArray[Any]:
    """Return ``numpy.unique`` of one column; it is sixty times as fast if many values differ."""
    ranked = np.sort(values)
    new: Mask = np.append(True, ranked[1:] != ranked[:-1])
    return np.asarray(ranked[new[: len(ranked)]])


def by_value(values: NDArray[Any]) -> Iterator[tuple[int, Places]]:
    """Yield each distinct value with the indices of its elements."""
    least, most = _bounds(values)
    if least == most:
        if len(values):
            yield least, np.arange(len(values))
        return
    is_small = least >= 0 or values.dtype.itemsize <= 2
    order = np.argsort(in_16_bits(values) if is_small else values, kind="stable")
    ends = np.flatnonzero(np.diff(values[order])) + 1
    for first, end in pairwise([0, *ends.tolist(), len(order)]):  # ``numpy.split`` takes longer
        yield int(values[order[first]]), order[first:end]


def groups(values: NDArray[Any], rows: Places) -> Iterator[tuple[int, Places]]:
    """Yield each distinct value of a column among some rows, with the rows that have it."""
    for value, at in by_value(values[rows]):
        yield value, rows[at]


def places_within(sizes: Integers) -> Integers:
    """Return the place of each element within its group, for groups of some sizes: 0, 1, 0, 1, 2 for 2, 3."""
    return np.arange(int(sizes.sum())) - np.repeat(np.cumsum(sizes) - sizes, sizes)


def by_key(items: Iterable[_Item], key: Callable[[_Item], _Key]) -> dict[_Key, list[_Item]]:
    """Group items by key; keys and items are in their original order."""
    groups: dict[_Key, list[_Item]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


def quantiles(values: NDArray[Any], *shares: float) -> list[float]:
    """Return ``numpy.quantile`` of at least one value; it is several times as fast for few values."""
    ranked = np.sort(values)
    values_at = []
    for share in shares:
        place = (len(ranked) - 1) * share
        low = int(place)
        below, above = ranked[low], ranked[min(low + 1, len(ranked) - 1)]
        part = place - low
        step = above - below
        values_at.append(float(above - step * (1 - part) if part >= 0.5 else below + step * part))
    return values_at


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
