"""Batches that are kept in memory for longer: without the part of their buffer that no packet uses."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.model import Columns, PacketBatch, concatenate
from edoras_tools.wire.arrays.window import copy_rows

if TYPE_CHECKING:
    from collections.abc import Sequence


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


def join(parts: Sequence[tuple[PacketBatch, Columns]]) -> tuple[PacketBatch, Columns]:
    """Put batches and their columns end to end into one; the buffers are copied.

    Args:
        parts: at least one.
    """
    if len(parts) == 1:
        return parts[0]
    shifts = np.cumsum([0, *(len(batch.data) for batch, _ in parts[:-1])]).tolist()
    whole = {}
    for item in fields(Columns):
        values = [getattr(columns, item.name) for _, columns in parts]
        if item.name in OFFSETS:
            pairs = zip(values, shifts, strict=True)
            values = [np.where(value >= 0, value + shift, value) for value, shift in pairs]
        whole[item.name] = np.concatenate(values)
    return concatenate([batch for batch, _ in parts]), Columns(**whole)
