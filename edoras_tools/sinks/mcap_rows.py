"""Messages of one kind in columns, and their record headers: what a chunk is laid out from."""

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
