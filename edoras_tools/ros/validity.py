"""Which of many messages are valid: most are told by their likeness to another one, the rest are walked.

Few bytes decide over a message: counts, string lengths, and the NUL of each string. Messages of the same
length and byte order that agree with one on those bytes share its fate, and a topic's messages mostly do.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from edoras_tools.ros.bulk import FEW, MOST_SEEN, Cursor, start, walk
from edoras_tools.ros.reader import PADDING, accepts

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.ros.plan import Plan

CHUNK: Final = 4096
"""Rows looked at together: few enough that the arrays stay in the processor's cache."""
PATIENCE: Final = 4
"""Patterns tried before a batch is taken for one whose messages are not alike."""
_GAP: Final = 48
"""Deciding bytes no further apart than this are compared in one piece."""
_SHORT: Final = 8
_MOST: Final = 2048
"""Most bytes of a pattern; beyond, comparing is no faster than walking."""


class _Window(NamedTuple):
    """Deciding bytes that lie close together.

    Attributes:
        first: offset of the first byte from the start of the body.
        size: bytes, a multiple of 8.
        want: u64 (CHUNK, size / 8), what is there.
        mask: u64 (CHUNK, size / 8), which bits of it decide.
    """

    first: int
    size: int
    want: NDArray[np.uint64]
    mask: NDArray[np.uint64]


class _Pattern:
    """The deciding bytes of a cursor's first row, and the verdict on it."""

    def __init__(self, plan: Plan, cursor: Cursor) -> None:
        row = cursor.take(np.zeros(1, np.int64))
        row.seen = []
        self._end = row.end[0]
        self._swap = None if cursor.swap is None else cursor.swap[0]
        body = cursor.bytes.data[cursor.base[0] :]
        self.valid = bool(len(_finish(plan, row)))
        joined = _joined(row.seen)
        self._usable = len(row.seen) <= MOST_SEEN and sum(end - first for first, end in joined) <= _MOST
        self._windows = [_window(body, first, end, row.seen) for first, end in joined] if self._usable else []

    def matches(self, cursor: Cursor) -> NDArray[np.bool_]:
        """Tell which rows share this verdict for certain."""
        alike: NDArray[np.bool_] = cursor.end == self._end
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
            found = cursor.bytes.gather(begin, window.size).view("<u8").reshape(len(cursor), -1)
            found ^= window.want[: len(found)]
            found &= window.mask[: len(found)]
            if found.any():
                alike &= ~found.any(axis=1)
        return alike


def valid(
    plan: Plan, data: NDArray[np.uint8], offset: NDArray[np.int64], length: NDArray[np.int32]
) -> NDArray[np.bool_]:
    """Tell which messages ``reader.decode`` accepts.

    Args:
        plan: of their type.
        data: u8, the buffer.
        offset: i64, first byte of each message, encapsulation included; any value.
        length: i32, bytes of each message; any value.
    """
    data = np.ascontiguousarray(data)
    verdict = np.zeros(len(offset), bool)
    pattern, patience = None, PATIENCE
    for first in range(0, len(offset), CHUNK):
        cursor = start(plan, data, offset[first : first + CHUNK], length[first : first + CHUNK])
        if not len(cursor):
            continue
        if pattern is None and patience and len(cursor) > FEW:
            pattern, patience = _Pattern(plan, cursor), patience - 1
        if pattern is not None:
            alike = pattern.matches(cursor)
            if pattern.valid:
                verdict[first + cursor.rows[alike]] = True
            if 2 * np.count_nonzero(alike) < len(cursor):
                pattern = None
            cursor.keep(~alike)
        verdict[first + _finish(plan, cursor)] = True
    return verdict


def _finish(plan: Plan, cursor: Cursor) -> NDArray[np.int64]:
    """Walk a cursor to the end; return the rows that are valid."""
    if len(cursor) <= FEW and cursor.seen is None:
        cursor.keep(
            np.fromiter((accepts(plan, *cursor.body(row)) for row in range(len(cursor))), bool, len(cursor))
        )
        return cursor.rows
    walk(plan, cursor, None)
    left = cursor.end - cursor.position
    cursor.keep((left >= 0) & (left <= PADDING))
    return cursor.rows


def _joined(seen: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return ascending ranges with those joined that lie close together."""
    joined: list[tuple[int, int]] = []
    for first, end in seen:
        if joined and first - joined[-1][1] <= _GAP:
            joined[-1] = (joined[-1][0], end)
        else:
            joined.append((first, end))
    return joined


def _window(body: NDArray[np.uint8], first: int, end: int, seen: list[tuple[int, int]]) -> _Window:
    size = -(-(end - first) // 8) * 8
    want, mask = np.zeros(size, np.uint8), np.zeros(size, np.uint8)
    want[: end - first] = body[first:end]
    for begin, stop in seen:
        if first <= begin < end:
            mask[begin - first : stop - first] = 0xFF
    return _Window(first, size, _rows(want), _rows(mask))


def _rows(data: NDArray[np.uint8]) -> NDArray[np.uint64]:
    """Return bytes as u64, once for each row of a chunk; numpy is slow to repeat short rows by itself."""
    words = data.view("<u8")
    return np.tile(words, (CHUNK, 1)) if len(words) <= _SHORT else np.broadcast_to(words, (CHUNK, len(words)))
