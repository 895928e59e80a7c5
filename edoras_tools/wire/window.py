"""Many short stretches of a byte buffer read, copied and folded at once.

A numpy ``V{n}`` view with a stride of one byte has an element at *every* offset of a buffer, so one indexed
operation moves n bytes for each of many rows: a memcpy a row, and no Python.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.wire.order import by_value

if TYPE_CHECKING:
    from numpy.typing import DTypeLike, NDArray

_LARGE: Final = 17
"""The group of rows of 64 KiB and more: few, and worth a step of Python each."""
_GROUPS: Final = np.frexp(np.arange((1 << 16) + 1.0))[1].astype(np.uint8)
"""The group of a length up to 64 KiB: the number of its bits."""
_KEEP: Final = np.where(np.arange(16) < np.arange(17)[:, None], np.uint8(0xFF), np.uint8(0)).view(np.uint64)
"""Masks of two words that keep the first 0 to 16 bytes."""


def at_every_byte(buffer: NDArray[np.uint8], width: int) -> NDArray[np.void]:
    """Return a view with an element of ``width`` bytes at every offset where one fits.

    Args:
        buffer: u8, contiguous.
        width: at least 1.
    """
    return np.ndarray((max(len(buffer) - width + 1, 0),), f"V{width}", buffer, 0, (1,))


def read_at(data: NDArray[np.uint8], positions: NDArray[np.integer[Any]], dtype: DTypeLike) -> NDArray[Any]:
    """Read one value at each of many byte positions, aligned or not.

    Args:
        data: u8, contiguous.
        positions: byte positions; each value must lie inside ``data``.
        dtype: what to read, with its byte order; a structured type reads a whole header.

    Returns:
        A fresh array of ``dtype``, one element a position.
    """
    values: NDArray[Any] = at_every_byte(data, np.dtype(dtype).itemsize)[positions].view(dtype)
    return values


def gather(data: NDArray[np.uint8], offset: NDArray[np.int64], width: int) -> NDArray[np.uint8]:
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
    late = np.flatnonzero(offset > last)
    if len(late):
        tail = np.concatenate([data[last:], np.zeros(width, np.uint8)])
        rows[late] = gather(tail, offset[late] - last, width)
    return rows


def put_rows(target: NDArray[np.uint8], positions: NDArray[np.int64], rows: NDArray[Any]) -> None:
    """Write every element of the structured array ``rows`` at its byte position in ``target``."""
    width = rows.itemsize
    at_every_byte(target, width)[positions] = np.ascontiguousarray(rows).view(f"V{width}")


def copy_rows(
    target: NDArray[np.uint8],
    positions: NDArray[np.int64],
    source: NDArray[np.uint8],
    offsets: NDArray[np.int64],
    lengths: NDArray[np.integer[Any]],
) -> None:
    """Copy ``lengths[i]`` bytes from ``source[offsets[i]]`` to ``target[positions[i]]``, for every i.

    Rows go in groups whose lengths share their highest bit: the first ``width`` bytes of a row and its last
    ``width`` cover it, whatever its length, so the number of moves does not grow with that of lengths.
    """
    groups = _GROUPS[np.minimum(lengths, len(_GROUPS) - 1)]
    for group in np.flatnonzero(np.bincount(groups)).tolist():
        rows = np.flatnonzero(groups == group)
        to, start, length = positions[rows], offsets[rows], lengths[rows]
        if group == _LARGE:
            for here, there, size in zip(to.tolist(), start.tolist(), length.tolist(), strict=True):
                target[here : here + size] = source[there : there + size]
        elif group:
            width = 1 << (group - 1)
            writable, readable = at_every_byte(target, width), at_every_byte(source, width)
            writable[to] = readable[start]
            rest = length - width
            if rest.any():
                writable[to + rest] = readable[start + rest]


def xor_bytes(
    data: NDArray[np.uint8], offset: NDArray[np.int64], length: NDArray[np.int32]
) -> NDArray[np.uint8]:
    """Return the XOR of the bytes of each range ``offset : offset + length``, u8 (n,)."""
    out = np.zeros(len(offset), np.uint8)
    for size, rows in by_value(length + 15 & ~15):
        if size <= 0:
            continue
        words = gather(data, offset[rows], size).view(np.uint64)
        words[:, -2:] &= _KEEP[length[rows] - (size - 16)]
        folded = words[:, 0].copy()
        for column in range(1, words.shape[1]):
            folded ^= words[:, column]
        for shift in (32, 16, 8):
            folded ^= folded >> np.uint64(shift)
        out[rows] = folded.astype(np.uint8)
    return out


def any_nonzero(
    data: NDArray[np.uint8], offset: NDArray[np.int64], length: NDArray[np.int32]
) -> NDArray[np.bool_]:
    """Tell of each range ``offset : offset + length`` whether it holds a byte that is not 0, bool (n,)."""
    out = np.zeros(len(offset), bool)
    for size, rows in by_value(length):
        if size > 0:
            out[rows] = gather(data, offset[rows], size).any(axis=1)
    return out
