"""Reads the CDR of many messages at once: walks a type's plan step by step, each a few numpy operations.

The rules that this file keeps:

1. A cursor is a position in each of many messages. The position is one number while all messages agree on
   it, which is the usual case (messages of one topic have one shape), and an array once they differ.
2. Bytes are read only after ``need`` has checked that they are there. A message that ends too early, or has
   an impossible count or string, is dropped from the cursor at that step; the other rows are valid so far.
3. So every operation works on valid rows only, and no index can leave the buffer.
4. Alignment counts from the byte after the encapsulation (``base``), never from the buffer's start.
5. A loop over elements is as long as the longest message; once at most ``FEW`` rows are left they are
   finished one by one, so that one long message does not slow down the others.
6. A walk reports the positions of values to its collector. It reads only counts, lengths and the byte that
   ends a string.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np

from edoras_tools.ros.cdr.plan import CdrPlan, PrimitiveRun, Repeat, Text
from edoras_tools.ros.cdr.reader import ENCAPSULATION_BYTES, skip

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from typing_extensions import Self

    from edoras_tools.wire.arrays.order import Integers, Mask, Octets

    Position = int | Integers

_LITTLE: Final = 0x0100
_BIG: Final = 0x0000
"""Little-endian and big-endian: the first two bytes of a message, 00 01 and 00 00, read as ``<u2``."""


FEW: Final = 16
"""Number of rows up to which reading one by one is faster."""
MOST_SEEN: Final = 256
"""Most ranges of deciding bytes that are recorded for one row."""


class Bytes:
    """Reads fixed-size pieces at many offsets of one buffer.

    Args:
        data: u8, contiguous.
    """

    def __init__(self, data: Octets) -> None:
        self.data = data

    def gather(self, start: Integers, size: int) -> NDArray[np.void]:
        """Return ``size`` bytes from each offset; all must lie inside the buffer."""
        windows = np.ndarray((len(self.data) - size + 1,), f"V{size}", self.data, 0, (1,))
        return windows[start]

    def numbers(self, start: Integers, code: str, count: int, swap: Mask | None) -> NDArray[Any]:
        """Return ``count`` numbers from each offset, shape (offsets, count).

        Args:
            start: i64, byte offsets.
            code: ``struct`` code of a number.
            count: at least 1.
            swap: rows that are big-endian; None for no row.
        """
        dtype = np.dtype("u1" if code == "?" else "<" + code)
        if not len(start):
            return np.empty((0, count), bool if code == "?" else dtype)
        numbers = self.gather(start, dtype.itemsize * count).view(dtype).reshape(-1, count)
        if swap is not None and dtype.itemsize > 1:
            numbers[swap] = numbers[swap].byteswap()
        return numbers != 0 if code == "?" else numbers


class Collector(Protocol):
    """Receives the position of each value during a walk; it must not change the cursor."""

    def run(self, prefix: str, run: PrimitiveRun, cursor: Cursor) -> None:
        """Take a run that starts at the cursor's position."""

    def block(self, prefix: str, run: PrimitiveRun, cursor: Cursor, count: Position) -> None:
        """Take ``count`` runs that follow each other from the cursor's position."""

    def text(self, name: str, text: Text, cursor: Cursor, length: Position) -> None:
        """Take a string of ``length`` units that start at the cursor's position."""


class Cursor:
    """A position in each of many messages, one row a message.

    Attributes:
        bytes: the buffer.
        rows: i64, index of each row's message in the batch.
        base: i64, offset of each body in the buffer.
        end: i64, size of each body in bytes.
        swap: bool, rows that are big-endian; None for no row.
        position: offset from the start of the body; one number while all rows agree, else i64.
        parent: i64, index of each row in the cursor that this one was taken from.
        seen: if set, the walk of a single row records the bytes (first, one past last) that it depended on.
    """

    __slots__ = ("base", "bytes", "end", "parent", "position", "room", "rows", "seen", "swap")

    def __init__(
        self,
        source: Bytes,
        rows: Integers,
        base: Integers,
        end: Integers,
        swap: Mask | None,
        position: Position = 0,
    ) -> None:
        self.bytes = source
        self.rows = rows
        self.base = base
        self.end = end
        self.swap = swap
        self.position = position
        self.parent = rows
        self.seen: list[tuple[int, int]] | None = None
        self.room = int(end.min()) if len(end) else 0

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def start(self) -> Integers:
        """The offset of each row's position in the buffer."""
        return self.base + self.position

    def take(self, selection: Integers) -> Self:
        """Return a cursor over some rows, given by index."""
        position = self.position if isinstance(self.position, int) else self.position[selection]
        swap = None if self.swap is None else self.swap[selection]
        part = type(self)(
            self.bytes, self.rows[selection], self.base[selection], self.end[selection], swap, position
        )
        part.parent = selection
        return part

    def keep(self, good: Mask, carried: Position = 0) -> Position:
        """Drop the rows where ``good`` is False; return the column ``carried`` without them."""
        if good.all():
            return carried
        self.rows, self.base, self.end, self.parent = (
            self.rows[good],
            self.base[good],
            self.end[good],
            self.parent[good],
        )
        self.swap = None if self.swap is None else self.swap[good]
        self.position = self.position if isinstance(self.position, int) else self.position[good]
        self.room = int(self.end.min()) if len(self.end) else 0
        return carried if isinstance(carried, int) else carried[good]

    def need(self, size: Position, carried: Position = 0) -> Position:
        """Drop rows that have fewer than ``size`` bytes left; return the column ``carried`` without them."""
        end = self.position + size
        return carried if isinstance(end, int) and end <= self.room else self.keep(end <= self.end, carried)

    def body(self, row: int) -> tuple[int, bytes]:
        """Return the byte order of one row (0 is little-endian, 1 is big-endian), and its body."""
        base = int(self.base[row])
        return int(self.swap is not None and self.swap[row]), self.bytes.data[
            base : base + self.end[row]
        ].tobytes()

    def note(self, position: Position, size: int) -> None:
        """Record bytes that the result of a single row depends on; too many of them end its walk."""
        if self.seen is not None and len(self):
            self.seen.append((int(position), int(position) + size))
            if len(self.seen) > MOST_SEEN:
                self.keep(np.zeros(len(self), bool))

    def align(self, alignment: int) -> None:
        """Move the position up to the next multiple of ``alignment``."""
        if alignment > 1:
            self.position = (self.position + (alignment - 1)) & -alignment

    def count(self) -> Position:
        """Read a u32 and move past it; return one number if all rows agree."""
        self.align(4)
        self.need(4)
        if not len(self):
            return 0
        values = self.bytes.gather(self.start, 4).view("<u4")
        if self.swap is not None:
            values = np.where(self.swap, values.byteswap(), values)
        self.note(self.position, 4)
        self.position = self.position + 4
        first = values[0]
        return int(first) if (values == first).all() else values.astype(np.int64)


def start_cursor(plan: CdrPlan, data: Octets, offset: Integers, length: NDArray[np.int32]) -> Cursor:
    """Return a cursor over the messages that lie in the buffer, may be long enough, and are CDR."""
    offset, size = np.asarray(offset, np.int64), np.asarray(length, np.int64)
    inside = (offset >= 0) & (size >= ENCAPSULATION_BYTES + plan.least) & (offset <= len(data) - size)
    rows = np.flatnonzero(inside)
    source = Bytes(data)
    if not len(rows):
        return Cursor(source, rows, rows, rows, None)
    offset, size = offset[rows], size[rows]
    kind = source.gather(offset, 2).view("<u2")
    swap = kind == _BIG
    cursor = Cursor(
        source, rows, offset + ENCAPSULATION_BYTES, size - ENCAPSULATION_BYTES, swap if swap.any() else None
    )
    cursor.keep(swap | (kind == _LITTLE))
    return cursor


def joined(prefix: str, name: str) -> str:
    """Return a dotted name; elements of a sequence of primitives or strings have no name of their own."""
    return f"{prefix}.{name}" if prefix and name else prefix or name


def walk_plan(plan: CdrPlan, cursor: Cursor, collector: Collector | None, prefix: str = "") -> None:
    """Move a cursor past one plan; drop the rows that do not fit it.

    Args:
        plan: layout of the bytes at the cursor.
        cursor: cursor to move.
        collector: receives the position of every value; its content is valid only if no row was dropped.
        prefix: prefix of every name that the collector receives.
    """
    for step in plan.steps:
        if not len(cursor):
            return
        if isinstance(step, PrimitiveRun):
            cursor.align(step.alignment)
            cursor.need(step.size)
            if collector is not None:
                collector.run(prefix, step, cursor)
            cursor.position = cursor.position + step.size
        elif isinstance(step, Text):
            _walk_text(step, cursor, collector, prefix)
        else:
            _walk_repeat(step, cursor, collector, prefix)


def _walk_text(step: Text, cursor: Cursor, collector: Collector | None, prefix: str) -> None:
    length = cursor.count()
    narrow = step.width == 1
    length = cursor.need(length * step.width, length)
    if step.bound:
        length = cursor.keep(np.broadcast_to(length - narrow <= step.bound, len(cursor)), length)
    if narrow:
        last = length - 1  # where the length is 0, this is a byte of the length itself, and is not checked
        cursor.note(cursor.position + last, 1)
        length = cursor.keep((cursor.bytes.data[cursor.start + last] == 0) | np.equal(length, 0), length)
    if collector is not None:
        collector.text(joined(prefix, step.name), step, cursor, length)
    cursor.position = cursor.position + length * step.width


def _walk_repeat(step: Repeat, cursor: Cursor, collector: Collector | None, prefix: str) -> None:
    plan, run = step.plan, step.plan.uniform
    count: Position = step.count if step.count is not None else cursor.count()
    if step.bound:
        count = cursor.keep(np.broadcast_to(count <= step.bound, len(cursor)), count)
    count = cursor.need(count * plan.least, count)
    if run is None:
        _walk_elements(plan, cursor, collector, joined(prefix, step.name), count)
        return
    if isinstance(count, int):
        if count == 0:
            return
        cursor.align(run.alignment)
    else:
        aligned = (cursor.position + (run.alignment - 1)) & -run.alignment
        cursor.position = np.where(count > 0, aligned, cursor.position)
    count = cursor.need(count * run.size, count)
    if collector is not None:
        collector.block(joined(prefix, step.name), run, cursor, count)
    cursor.position = cursor.position + count * run.size


def _walk_elements(
    plan: CdrPlan, cursor: Cursor, collector: Collector | None, name: str, count: Position
) -> None:
    """Walk elements whose sizes may differ, one index at a time: the loop is as long as the longest row."""
    if isinstance(count, int):
        for _ in range(count):
            if not len(cursor):
                return
            walk_plan(plan, cursor, collector, name)
        return
    position = np.array(np.broadcast_to(cursor.position, len(cursor)))
    whole = count == 0
    running = cursor.take(np.flatnonzero(~whole))
    index = 0
    while len(running):
        if collector is None and len(running) <= FEW:
            _finish_elements(plan, running, count[running.parent] - index)
            whole[running.parent] = True
            position[running.parent] = running.position
            break
        walk_plan(plan, running, collector, name)
        index += 1
        complete = count[running.parent] == index
        if complete.any():
            rows = running.parent[complete]
            whole[rows] = True
            position[rows] = (
                running.position if isinstance(running.position, int) else running.position[complete]
            )
            running.keep(~complete)
    cursor.position = position
    cursor.keep(whole)


def _finish_elements(plan: CdrPlan, cursor: Cursor, remaining: Integers) -> None:
    """Move a few rows past their remaining elements one by one, so that one long row costs little."""
    position = np.broadcast_to(cursor.position, len(cursor))
    ends = [
        skip(plan, *cursor.body(row), int(position[row]), int(remaining[row])) for row in range(len(cursor))
    ]
    cursor.position = np.array([-1 if end is None else end for end in ends], np.int64)
    cursor.keep(cursor.position >= 0)
