"""Fixed-width windows of a byte buffer, gathered for many offsets at once."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray


def gather(data: NDArray[np.uint8], offset: NDArray[np.int64], width: int) -> NDArray[np.uint8]:
    """Copy ``width`` bytes at each offset into the rows of a matrix; bytes past the buffer's end are 0.

    A window is one element of an overlapping view, so that numpy copies each row whole, not byte by byte.

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
    view: NDArray[np.void] = np.ndarray((last + 1,), f"V{width}", buffer=data, strides=(1,))
    rows = view[np.minimum(offset, last)].view(np.uint8).reshape(len(offset), width)
    late = np.flatnonzero(offset > last)
    if len(late):
        tail = np.concatenate([data[last:], np.zeros(width, np.uint8)])
        rows[late] = gather(tail, offset[late] - last, width)
    return rows


def by_value(values: NDArray[Any]) -> Iterator[tuple[int, NDArray[np.intp]]]:
    """Yield each distinct value with the indices that hold it, so that rows of one length go together."""
    # 16 bits sort by radix, several times as fast.
    narrow = values.dtype.itemsize <= 2 or not len(values) or (values.min() >= 0 and values.max() <= 0xFFFF)
    order = np.argsort(values.astype(np.uint16) if narrow else values, kind="stable")
    ends = np.flatnonzero(np.diff(values[order])) + 1
    for rows in np.split(order, ends) if len(order) else ():
        yield int(values[rows[0]]), rows


def xor_bytes(
    data: NDArray[np.uint8], offset: NDArray[np.int64], length: NDArray[np.int32]
) -> NDArray[np.uint8]:
    """Return the XOR of the bytes of each range ``offset : offset + length``, u8 (n,)."""
    out = np.zeros(len(offset), np.uint8)
    for size, rows in by_value(length):
        if size <= 0:
            continue
        window = gather(data, offset[rows], -(-size // 8) * 8)
        window[:, size:] = 0
        words = window.view(np.uint64)
        folded = words[:, 0].copy()
        for column in range(1, words.shape[1]):
            folded ^= words[:, column]
        out[rows] = np.bitwise_xor.reduce(folded.view(np.uint8).reshape(-1, 8), axis=1)
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
