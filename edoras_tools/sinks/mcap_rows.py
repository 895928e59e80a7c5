"""Many rows of bytes moved at once: the only way bytes get into a chunk.

A numpy ``V{n}`` view with a stride of one byte has an element at *every* offset of a buffer, so one indexed
assignment moves n bytes for each of many rows, a memcpy a row and no Python.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

RECORD = [
    ("opcode", "u1"),
    ("record_length", "<u8"),
    ("channel_id", "<u2"),
    ("sequence", "<u4"),
    ("log_time", "<u8"),
    ("publish_time", "<u8"),
]
"""An MCAP Message record up to its data."""
RECORD_BYTES = np.dtype(RECORD).itemsize
PREFIX_BYTES = 9
"""Bytes of a record that its length does not count: the opcode and the length."""
OPCODE_MESSAGE = 0x05
ENCAPSULATION = 0x00000100
"""The CDR encapsulation ``00 01 00 00`` (little-endian CDR, no options) as a little-endian u32."""
_LARGE = 17
"""The group of rows of 64 KiB and more: few, and worth a step of Python each."""
_GROUPS = np.frexp(np.arange((1 << 16) + 1.0))[1].astype(np.uint8)
"""The group of a length up to 64 KiB: the number of its bits."""


@dataclass(frozen=True, slots=True)
class Messages:
    """Messages of one kind in columns: a fixed head, then bytes from a buffer.

    Attributes:
        rows: i64, increasing: the row of the batch that each belongs to.
        head_bytes: size of a head.
        heads: gives the heads of a slice of the messages: structured, ``RECORD`` first, then whatever fixed
            bytes the message data starts with. They hold until it is asked again.
        data: u8, the buffer that ``offset`` points into.
        offset: i64, where the rest of the message data is.
        length: integer, how long that rest is; may be 0.
        repeats: whether ``rows`` may hold a row more than once.
    """

    rows: NDArray[np.int64]
    head_bytes: int
    heads: Callable[[slice], NDArray[Any]]
    data: NDArray[np.uint8]
    offset: NDArray[np.int64]
    length: NDArray[np.integer[Any]]
    repeats: bool = False

    def __len__(self) -> int:
        return len(self.rows)


def fill_record(
    heads: NDArray[Any],
    channel_id: NDArray[np.integer[Any]] | int,
    length: NDArray[np.integer[Any]] | int,
    sequence: NDArray[np.integer[Any]] | int,
    log_time: NDArray[np.integer[Any]],
    publish_time: NDArray[np.integer[Any]],
) -> None:
    """Write the record header columns of ``heads``.

    Args:
        heads: structured, starts with ``RECORD``.
        channel_id: MCAP channel.
        length: bytes of message data that follow the head.
        sequence: u32.
        log_time: ns since 1970.
        publish_time: ns since 1970.
    """
    heads["opcode"] = OPCODE_MESSAGE
    heads["record_length"] = length + (heads.itemsize - PREFIX_BYTES)
    heads["channel_id"] = channel_id
    heads["sequence"] = sequence
    heads["log_time"] = log_time
    heads["publish_time"] = publish_time


def put_rows(target: NDArray[np.uint8], positions: NDArray[np.int64], rows: NDArray[Any]) -> None:
    """Write every element of the structured array ``rows`` at its byte position in ``target``."""
    width = rows.itemsize
    _at_every_byte(target, width)[positions] = np.ascontiguousarray(rows).view(f"V{width}")


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
            writable, readable = _at_every_byte(target, width), _at_every_byte(source, width)
            writable[to] = readable[start]
            rest = length - width
            if rest.any():
                writable[to + rest] = readable[start + rest]


def _at_every_byte(buffer: NDArray[np.uint8], width: int) -> NDArray[Any]:
    return np.ndarray((max(len(buffer) - width + 1, 0),), dtype=f"V{width}", buffer=buffer, strides=(1,))
