"""Writes live traffic to the file in time, so that a killed recorder loses at most one second.

Rules:

1. The age of a datagram counts from its capture: a recorder that is late flushes after every batch.
2. Ages compare two clocks, and a step of one of them makes them wrong. So an age can only make a flush
   earlier.
3. The sink is flushed once a second even without data, because a sink then checks its files.
4. Batches that waited for others are flushed as soon as they are written.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final

import numpy as np
from msgspec.structs import replace

from edoras_tools.model import Columns, PacketBatch, concatenate
from edoras_tools.units import SECOND
from edoras_tools.wire.arrays.window import copy_rows

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from edoras_tools.io import Sink


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
    sizes = batch.frame_length.astype(np.int64) + np.where(outside, batch.length, 0)
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
    for name in Columns.__struct_fields__:
        values = [getattr(columns, name) for _, columns in parts]
        if name in OFFSETS:
            pairs = zip(values, shifts, strict=True)
            values = [np.where(value >= 0, value + shift, value) for value, shift in pairs]
        whole[name] = np.concatenate(values)
    return concatenate([batch for batch, _ in parts]), Columns(**whole)


FLUSH_NS: Final = 200_000_000
"""Largest age of data that is not in the file: a fifth of the guaranteed second, to leave time to write."""
_QUIET_NS: Final = 350_000_000
"""Longest time that small batches wait for others; the first may already be ``FLUSH_NS`` old."""
_SMALL: Final = 256 << 10
"""Size from which waiting batches are written, bytes."""
_SWIFT: Final = 16 << 20
"""Bytes since the last flush from which no flush is needed, because chunks fill up by themselves."""


class Waiting:
    """Joins small batches before they are written: each written batch costs a millisecond.

    Args:
        patient: whether batches wait for others while little arrives; for a recorder that nobody watches.
        clock: function that returns monotonic time, ns.
    """

    def __init__(self, *, patient: bool, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self._patient, self._clock = patient, clock
        self._parts: list[tuple[PacketBatch, Columns]] = []
        self._bytes = self._since = 0

    def add(self, batch: PacketBatch, columns: Columns) -> None:
        """Add a batch of at least one row."""
        if not self._parts:
            self._since = self._clock()
        self._parts.append((batch, columns))
        self._bytes += len(batch.data)

    @property
    def waits(self) -> bool:
        """Whether there are batches, and they may still wait."""
        waits = self._patient and self._bytes < _SMALL and self._clock() - self._since < _QUIET_NS
        return bool(self._parts) and waits

    def take(self) -> tuple[PacketBatch, Columns] | None:
        """Return the waiting batches as one; None if there are none."""
        parts, self._parts, self._bytes = self._parts, [], 0
        return join(parts) if parts else None


class Flushing:
    """Flushes a sink in time; ``flush_if_due`` must be called several times per ``FLUSH_NS``.

    Args:
        clock: function that returns monotonic time, ns.
        wall: function that returns ns since 1970; None if the datagrams are not captured live.
    """

    def __init__(
        self,
        sink: Sink,
        clock: Callable[[], int] = time.monotonic_ns,
        wall: Callable[[], int] | None = time.time_ns,
    ) -> None:
        self._sink, self._clock, self._wall = sink, clock, wall
        self._due = clock() + FLUSH_NS
        self._bytes = 0

    @property
    def wait_s(self) -> float:
        """Time until the next flush, s."""
        return max(0, self._due - self._clock()) / 1e9

    def took(self, batch: PacketBatch) -> None:
        """Record that the sink got a batch."""
        if len(batch):
            age = max(0, self._wall() - int(batch.time_ns[0])) if self._wall else 0
            self.noted(age)
            self._bytes += int(batch.frame_length.sum())

    def noted(self, age_ns: int = 0) -> None:
        """Record that the sink got data of an age."""
        self._due = min(self._due, self._clock() + FLUSH_NS - age_ns)

    def flush_if_due(self) -> None:
        """Flush if it is due.

        Raises:
            CaptureError: the output cannot be written.
        """
        if self._clock() >= self._due:
            if self._bytes < _SWIFT:
                self._sink.flush()
            self._due, self._bytes = self._clock() + SECOND, 0
