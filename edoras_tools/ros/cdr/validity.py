"""Finds the end of each of many messages: mostly by comparison with one that was read, else one by one.

A few bytes decide whether a message is valid and where its last field ends: counts, string lengths, and the
NUL of each string. Messages with the same length, byte order and values of these bytes have the same result;
most messages of a topic do.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from edoras_tools.errors import WireError
from edoras_tools.ros.cdr.bulk import FEW, MOST_SEEN, Cursor, start_cursor, walk_plan
from edoras_tools.ros.cdr.plan import CdrPlan, PrimitiveRun, Text
from edoras_tools.ros.cdr.reader import ENCAPSULATION_BYTES, bytes_left, encapsulation_order

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.wire.arrays.order import Integers, Mask, Octets


_COUNTS: Final = struct.Struct("<I"), struct.Struct(">I")


def extent(name: str, plan: CdrPlan, cdr: bytes) -> int:
    """Return the bytes of a message with its encapsulation, without the bytes after the last field.

    Raises:
        WireError: the message ends before its last field does, or is not CDR.
    """
    count = _COUNTS[encapsulation_order(name, cdr)]
    try:
        end = ENCAPSULATION_BYTES + _end(plan, count, memoryview(cdr)[ENCAPSULATION_BYTES:], 0)
    except struct.error:
        end = len(cdr) + 1
    if end > len(cdr):
        raise WireError(f"{name}: the message ends at byte {len(cdr)}, before its last field does")
    return end


def _end(plan: CdrPlan, count: struct.Struct, body: memoryview, position: int) -> int:
    """Return the end of a plan that starts at a position; the end may be outside the body.

    Raises:
        struct.error: a count or a length is outside the body.
    """
    for step in plan.steps:
        if isinstance(step, PrimitiveRun):
            position = ((position + step.alignment - 1) & -step.alignment) + step.size
            continue
        times = None if isinstance(step, Text) else step.count
        if times is None:
            position = (position + 3) & -4
            (times,) = count.unpack_from(body, position)
            position += 4
        if isinstance(step, Text):
            position += times * step.width
        elif times and (run := step.plan.uniform):
            position = ((position + run.alignment - 1) & -run.alignment) + times * run.size
        else:
            for _ in range(times):
                position = _end(step.plan, count, body, position)
                if position > len(body):  # so that a wrong count does not make this loop long
                    return position
    return position


_CHUNK_ROWS: Final = 4096
"""Rows compared in one step: a number so small that the arrays stay in the processor's cache."""
_MOST_PATTERNS: Final = 4
"""Number of patterns to try before the remaining messages of a batch are read one by one."""
_GAP: Final = 48
"""Most bytes between deciding bytes that are compared together."""
_SHORT: Final = 8
_INVALID: Final = -1
_MOST: Final = 2048
"""Most bytes of a pattern; above this, comparing is not faster than reading."""


class _Window(NamedTuple):
    """Deciding bytes that lie close together.

    Attributes:
        first: offset of the first byte from the start of the body.
        size: bytes, a multiple of 8.
        want: u64 (``_CHUNK_ROWS``, size / 8), the expected bytes.
        mask: u64 (``_CHUNK_ROWS``, size / 8), the bits that decide.
    """

    first: int
    size: int
    want: NDArray[np.uint64]
    mask: NDArray[np.uint64]


class _Pattern:
    """The deciding bytes of a cursor's first row, and the bytes after its last field; -1: not valid."""

    def __init__(self, plan: CdrPlan, cursor: Cursor) -> None:
        row = cursor.take(np.zeros(1, np.int64))
        row.seen = []
        self._end = row.end[0]
        self._swap = None if cursor.swap is None else cursor.swap[0]
        body = cursor.bytes.data[cursor.base[0] :]
        rest = _finish(plan, row)
        self.rest = int(rest[0]) if len(rest) else _INVALID
        joined = _joined(row.seen)
        self._usable = len(row.seen) <= MOST_SEEN and sum(end - first for first, end in joined) <= _MOST
        self._windows = [_window(body, first, end, row.seen) for first, end in joined] if self._usable else []

    def matches(self, cursor: Cursor) -> Mask:
        """Return which rows certainly have the same result."""
        alike: Mask = cursor.end == self._end
        alike &= (cursor.swap if cursor.swap is not None else False) == bool(self._swap)
        alike &= self._usable
        for window in self._windows:
            last = len(cursor.bytes.data) - window.size
            if last < 0:
                return np.zeros(len(cursor), bool)
            begin = cursor.base + window.first
            if begin.max() > last:
                alike &= begin <= last
                begin = np.minimum(begin, last)
            differences = cursor.bytes.gather(begin, window.size).view("<u8").reshape(len(cursor), -1)
            differences ^= window.want[: len(differences)]
            differences &= window.mask[: len(differences)]
            if differences.any():
                alike &= ~differences.any(axis=1)
        return alike


def trailing(plan: CdrPlan, data: Octets, offset: Integers, length: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the bytes after each message's last field; -1 for messages that ``reader.decode`` refuses.

    Args:
        plan: plan of their type.
        data: u8, the buffer.
        offset: i64, first byte of each message, encapsulation included; any value is safe.
        length: i32, bytes of each message; any value is safe.
    """
    data = np.ascontiguousarray(data)
    result = np.full(len(offset), _INVALID, np.int32)
    pattern, patience = None, _MOST_PATTERNS
    for first in range(0, len(offset), _CHUNK_ROWS):
        cursor = start_cursor(
            plan, data, offset[first : first + _CHUNK_ROWS], length[first : first + _CHUNK_ROWS]
        )
        if not len(cursor):
            continue
        if pattern is None and patience and len(cursor) > FEW:
            pattern, patience = _Pattern(plan, cursor), patience - 1
        if pattern is not None:
            alike = pattern.matches(cursor)
            result[first + cursor.rows[alike]] = pattern.rest
            if 2 * np.count_nonzero(alike) < len(cursor):
                pattern = None
            cursor.keep(~alike)
        rest = _finish(plan, cursor)
        result[first + cursor.rows] = rest
    return result


def _finish(plan: CdrPlan, cursor: Cursor) -> Integers:
    """Walk a cursor to the end; drop the rows that are not valid; return the bytes left of the others."""
    if len(cursor) <= FEW and cursor.seen is None:
        rows = range(len(cursor))
        rest = np.fromiter((bytes_left(plan, *cursor.body(row)) for row in rows), np.int64, len(cursor))
    else:
        walk_plan(plan, cursor, None)
        rest = cursor.end - cursor.position
    cursor.keep(rest >= 0)
    return rest[rest >= 0]


def _joined(ranges: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return ascending ranges, with those joined that lie close together."""
    joined: list[tuple[int, int]] = []
    for first, end in ranges:
        if joined and first - joined[-1][1] <= _GAP:
            joined[-1] = (joined[-1][0], end)
        else:
            joined.append((first, end))
    return joined


def _window(body: Octets, first: int, end: int, ranges: list[tuple[int, int]]) -> _Window:
    size = -(-(end - first) // 8) * 8
    want, mask = np.zeros(size, np.uint8), np.zeros(size, np.uint8)
    want[: end - first] = body[first:end]
    for begin, stop in ranges:
        if first <= begin < end:
            mask[begin - first : stop - first] = 0xFF
    return _Window(first, size, _rows(want), _rows(mask))


def _rows(data: Octets) -> NDArray[np.uint64]:
    """Return bytes as u64, repeated for each row of a chunk; numpy is slow to broadcast short rows itself."""
    words = data.view("<u8")
    return (
        np.tile(words, (_CHUNK_ROWS, 1))
        if len(words) <= _SHORT
        else np.broadcast_to(words, (_CHUNK_ROWS, len(words)))
    )
