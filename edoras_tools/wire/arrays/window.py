"""Reads, copies and folds many short ranges of a byte buffer at once.

A numpy ``V{n}`` view with a stride of one byte has an element at *every* offset of a buffer, so one indexed
operation moves n bytes for each of many rows: a memcpy a row, and no Python.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.wire.arrays.order import Integers, Mask, Octets, Places, by_value

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import DTypeLike, NDArray

_LARGE: Final = 1 << 16
"""Fewest rows for which numpy is faster than one step of Python for each row."""
_FEW: Final = 16
"""Most different lengths for which each length is its own group."""
_BITS: Final = np.frexp(np.arange(_LARGE + 1.0))[1].astype(np.uint8)
"""Number of bits of each length up to ``_LARGE``."""
_WASTE: Final = 4
"""Most bytes to move, as a multiple of the bytes requested."""
_BLOCK: Final = 2048
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
        for first in range(0, len(to), _BLOCK):
            rows = slice(first, first + _BLOCK)
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
        if len(distinct) <= _FEW:
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
