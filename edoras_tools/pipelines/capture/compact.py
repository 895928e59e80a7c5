"""Batches that are kept in memory for longer: without the part of their buffer that no packet uses."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.wire.arrays.window import copy_rows

if TYPE_CHECKING:
    from edoras_tools.model import Columns, PacketBatch

OFFSETS: Final = ("packet_offset", "cdr_offset")
"""The columns that point into the buffer of their batch."""
ROW_BYTES: Final = 128
"""Approximate bytes that the columns of one packet take."""
_SPARE: Final = 64
"""Bytes after the last packet, for readers of whole words."""


def compact(batch: PacketBatch, columns: Columns) -> tuple[PacketBatch, Columns]:
    """Return the same packets over a smaller buffer, if most of the buffer is unused."""
    outside = (batch.offset < batch.frame_offset) | (
        batch.offset + batch.length > batch.frame_offset + batch.frame_length
    )
    extra = np.where(outside, batch.length, 0)
    sizes = batch.frame_length.astype(np.int64) + extra
    total = int(sizes.sum())
    if 2 * total >= len(batch.data) or not len(batch):
        return batch, columns
    starts = np.cumsum(sizes) - sizes
    data = np.zeros(total + _SPARE, np.uint8)
    copy_rows(data, starts, batch.data, batch.frame_offset, batch.frame_length)
    # A payload that was reassembled from fragments is copied to a place after its frame.
    offset = np.where(outside, starts + batch.frame_length, starts + batch.offset - batch.frame_offset)
    rows = np.flatnonzero(outside)
    copy_rows(data, offset[rows], batch.data, batch.offset[rows], batch.length[rows])
    shift = offset - batch.offset
    moved = {
        name: np.where(column >= 0, column + shift, column)
        for name in OFFSETS
        for column in (getattr(columns, name),)
    }
    return replace(batch, data=data, frame_offset=starts, offset=offset), replace(columns, **moved)
