"""Captured frames in columns, and operations on them that do not depend on their content."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.wire.arrays.window import PADDING, copy_rows

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from edoras_tools.wire.arrays.order import Integers, Octets

LINKTYPE_RAW = 101
"""The packet starts with its IP header."""


class FrameBatch(msgspec.Struct, frozen=True, eq=False):
    """Captured frames in columns over one contiguous byte buffer; all arrays have the same length.

    Attributes:
        data: buffer, u8. ``PADDING`` bytes after the last frame should be readable; if not, it is copied.
        number: number of the frame in its source, i64, from 1.
        time_ns: capture time, i64, ns since 1970-01-01 UTC.
        link_type: pcap LINKTYPE, u16.
        offset: start of the frame in ``data``, i64.
        length: captured bytes, i32.
        original_length: bytes on the wire, i32. Values from 2 GiB on, which no frame has, become the largest
            i32; a negative value marks a row that was not captured.
    """

    data: Octets
    number: Integers
    time_ns: Integers
    link_type: NDArray[np.uint16]
    offset: Integers
    length: NDArray[np.int32]
    original_length: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.time_ns)

    def __post_init__(self) -> None:
        """Keep garbled lengths from being taken for rows that were not captured."""
        garbled = self.original_length < 0
        if garbled.any():
            self.original_length[garbled] = np.iinfo(np.int32).max


class MadeFrames(FrameBatch, frozen=True, eq=False):
    """Raw IPv4 frames made from datagrams; their headers need not be parsed again.

    Attributes:
        ends: endpoints of each datagram, ``io.frames.build.ENDS``.
    """

    ends: NDArray[np.void]


def joined_frames(parts: Sequence[FrameBatch]) -> FrameBatch:
    """Join batches, at least one, into one with a padded buffer."""
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
    """Copy frames into a new buffer without gaps."""
    length = frames.length.astype(np.int64)
    offset = np.cumsum(length) - length
    data = np.zeros(int(length.sum()), np.uint8)
    copy_rows(data, offset, frames.data, frames.offset, length)
    return replace(frames, data=data, offset=offset)


def frames_at(frames: FrameBatch, rows: Integers | None) -> FrameBatch:
    """Return some frames, over the same buffer; None for all."""
    if rows is None:
        return frames
    return FrameBatch(
        frames.data, *(getattr(frames, name)[rows] for name in FrameBatch.__struct_fields__ if name != "data")
    )
