"""Captured frames in columns, and what is done with them whatever they hold."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.wire.arrays.window import PADDING, copy_rows

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

LINKTYPE_RAW = 101
"""The packet starts with its IP header."""


class FrameBatch(msgspec.Struct, frozen=True, eq=False):
    """Captured frames in columns over one contiguous byte buffer; all arrays have the same length.

    Attributes:
        data: u8. ``PADDING`` bytes after the last frame should be readable; if not, the buffer is copied.
        number: i64, number of the frame in its source, from 1.
        time_ns: i64, capture time, ns since 1970-01-01 UTC.
        link_type: u16, pcap LINKTYPE.
        offset: i64, start of the frame in ``data``.
        length: i32, captured bytes.
        original_length: i32, bytes on the wire; 2 GiB and more, which no frame has, become the largest one:
            below 0 is a row that was not captured.
    """

    data: NDArray[np.uint8]
    number: NDArray[np.int64]
    time_ns: NDArray[np.int64]
    link_type: NDArray[np.uint16]
    offset: NDArray[np.int64]
    length: NDArray[np.int32]
    original_length: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.time_ns)

    def __post_init__(self) -> None:
        """Keep garbled lengths from being read as those of rows that were made."""
        garbled = self.original_length < 0
        if garbled.any():
            self.original_length[garbled] = np.iinfo(np.int32).max


class MadeFrames(FrameBatch, frozen=True, eq=False):
    """Raw IPv4 frames that were made of datagrams: what their headers say need not be read out of them again.

    Attributes:
        ends: of each datagram, ``io.frames.build.ENDS``.
    """

    ends: NDArray[np.void]


def joined_frames(parts: Sequence[FrameBatch]) -> FrameBatch:
    """Join batches, at least one, in one padded buffer."""
    sizes = np.array([0, *(len(part.data) for part in parts)])
    columns = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in FrameBatch.__struct_fields__
        if name != "data"
    }
    columns["offset"] += np.repeat(np.cumsum(sizes)[:-1], [len(part) for part in parts])
    return FrameBatch(
        np.concatenate([*(part.data for part in parts), np.zeros(PADDING, np.uint8)]), **columns
    )


def packed_frames(frames: FrameBatch) -> FrameBatch:
    """Copy frames end to end."""
    length = frames.length.astype(np.int64)
    offset = np.cumsum(length) - length
    data = np.zeros(int(length.sum()), np.uint8)
    copy_rows(data, offset, frames.data, frames.offset, length)
    return replace(frames, data=data, offset=offset)


def frames_at(frames: FrameBatch, rows: NDArray[np.int64] | None) -> FrameBatch:
    """Return some frames, over the same buffer; None for all."""
    if rows is None:
        return frames
    return FrameBatch(
        frames.data, *(getattr(frames, name)[rows] for name in FrameBatch.__struct_fields__ if name != "data")
    )
