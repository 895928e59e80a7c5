"""Rows put in order, so that those which go together stand together."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray


def order_by(*keys: NDArray[np.integer]) -> NDArray[np.int64]:
    """Return the stable order that puts equal keys side by side; keys are u8, u16 or u32, radix sorted."""
    digits: list[NDArray[np.uint16]] = []
    room = 0  # what the last digit may still be multiplied by; a sort costs the same for each digit
    for key in keys:
        least, most = (int(key.min()), int(key.max())) if len(key) else (0, 0)
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
    if not digits:
        return np.arange(len(keys[0]))
    return np.lexsort(digits)


def by_value(values: NDArray[Any]) -> Iterator[tuple[int, NDArray[np.intp]]]:
    """Yield each distinct value with the indices that hold it, so that rows of one length go together."""
    least, most = (int(values.min()), int(values.max())) if len(values) else (0, 0)
    if least == most:
        if len(values):
            yield least, np.arange(len(values))
        return
    # 16 bits sort by radix, several times as fast.
    narrow = values.dtype.itemsize <= 2 or (least >= 0 and most <= 0xFFFF)
    order = np.argsort(values.astype(np.uint16) if narrow else values, kind="stable")
    ends = np.flatnonzero(np.diff(values[order])) + 1
    for rows in np.split(order, ends):
        yield int(values[rows[0]]), rows
