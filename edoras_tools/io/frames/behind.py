"""Packets that are taken out of datagrams, as rows of their own behind those in which they end."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.model import PacketBatch


def order_behind(count: int, row: NDArray[np.int64]) -> NDArray[np.intp]:
    """Return the order of so many rows and of what comes behind some of them, in their order; i64.

    Args:
        count: of the rows; they are 0 to ``count`` - 1, the others follow.
        row: behind which row each of the others comes.
    """
    return np.argsort(np.concatenate([np.arange(count), row]), kind="stable")


def packets_behind(
    batch: PacketBatch,
    buffer: NDArray[np.uint8],
    row: NDArray[np.int64],
    start: NDArray[np.int64],
    length: NDArray[np.int64],
) -> PacketBatch:
    """Return a batch with packets behind the rows in which they end; their original length is -1.

    Args:
        buffer: u8, what the packets point into.
        row: of each packet, in which it ends.
        start: of each packet in the buffer.
        length: of each packet, in bytes.
    """
    if not len(row):
        return batch
    count = len(batch)
    order = order_behind(count, row)
    own = order >= count
    place = order[own] - count
    out = batch.take(np.concatenate([np.arange(count), row])[order])
    out.frame_length[own] = out.capture_findings[own] = 0
    out.original_length[own] = -1
    if out.streams is not None:
        out.streams[own] = False
    out.offset[own] = len(batch.data) + start[place]
    out.length[own] = length[place]
    return replace(out, data=np.concatenate([batch.data, buffer]))
