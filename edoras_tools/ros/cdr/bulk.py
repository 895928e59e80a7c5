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
6. A walk reports the positions of values to its collector (``_Fields``). It reads only counts, lengths and
   the byte that ends a string.

``trailing`` finds the end of each of many messages: mostly by comparison with one that was read, else one by
one. A few bytes decide whether a message is valid and where its last field ends: counts, string lengths, and
the NUL of each string. Messages with the same length, byte order and values of these bytes have the same
result; most messages of a topic do.

``MessageColumns`` are the fields of many messages, each read when it is first used.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
import numpy as np

from edoras_tools.errors import WireError
from edoras_tools.ros.cdr.plan import CdrPlan, Leaf, PrimitiveRun, Repeat, Text
from edoras_tools.ros.cdr.values import (
    ENCAPSULATION_BYTES,
    bytes_left,
    encapsulation_order,
    skip,
    string_value,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from typing_extensions import Self

    from edoras_tools.wire.arrays import Integers, Mask, Octets

    Position = int | Integers

    Piece = Callable[[], tuple[Integers, Position, NDArray[Any]]]
    """Reads a part of a column; returns i64, its rows; the number of values of each row; and the values."""

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
        self.rows, self.base = self.rows[good], self.base[good]
        self.end, self.parent = self.end[good], self.parent[good]
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


def walk_plan(plan: CdrPlan, cursor: Cursor, collector: _Fields | None, prefix: str = "") -> None:
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


def _walk_text(step: Text, cursor: Cursor, collector: _Fields | None, prefix: str) -> None:
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


def _walk_repeat(step: Repeat, cursor: Cursor, collector: _Fields | None, prefix: str) -> None:
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
    plan: CdrPlan, cursor: Cursor, collector: _Fields | None, name: str, count: Position
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
    ends = [skip(plan, *cursor.body(at), int(position[at]), int(remaining[at])) for at in range(len(cursor))]
    cursor.position = np.array([-1 if end is None else end for end in ends], np.int64)
    cursor.keep(cursor.position >= 0)


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
    if len(words) <= _SHORT:
        return np.tile(words, (_CHUNK_ROWS, 1))
    return np.broadcast_to(words, (_CHUNK_ROWS, len(words)))


class Ragged(msgspec.Struct, frozen=True, eq=False):
    """A column whose rows hold different numbers of values.

    Sequences inside sequences are joined: a row holds all of its values in wire order.

    Attributes:
        values: values of all rows, one row after the other.
        offsets: i64, one element more than rows; row ``i`` is ``values[offsets[i]:offsets[i + 1]]``.
    """

    values: NDArray[Any]
    offsets: Integers

    def __len__(self) -> int:
        return len(self.offsets) - 1

    def __getitem__(self, row: int) -> NDArray[Any]:
        """Return the values of one row.

        Raises:
            IndexError: there is no such row.
        """
        row = range(len(self))[row]
        return self.values[self.offsets[row] : self.offsets[row + 1]]


class MessageColumns(msgspec.Struct, frozen=True, eq=False):
    """Many messages of one type, a row each.

    Attributes:
        type: ROS type name.
        valid: bool, rows whose CDR ``TypeStore.decode`` accepts.
        fields: columns by dotted name, in wire order. A field of one value is an array of its own type
            (``object`` for strings); a fixed array of primitives has shape (rows, elements); every other
            array or sequence, and every field inside one, is ``Ragged``. Rows that are not valid hold zeros,
            empty strings and no elements.
    """

    type: str
    valid: Mask
    fields: Mapping[str, NDArray[Any] | Ragged]

    def __len__(self) -> int:
        return len(self.valid)


class TopicBlock(msgspec.Struct, frozen=True):
    """Messages of one topic, one row each.

    Attributes:
        topic: topic name with its leading slash.
        time_ns: i64, capture or recording time, ns since 1970.
        message: columns of the fields.
        publish_ns: i64, publish time in the packet, ns since 1970; None if the input has none.
        sequence: packet sequence counts; None if there are none.
        present: bool by field, rows that have this field; a field that is not listed is in all rows.
        recording: name of each row's recording, empty for a row of no recording; None if the input is one
            file.
    """

    topic: str
    time_ns: Integers
    message: MessageColumns
    publish_ns: Integers | None = None
    sequence: NDArray[np.unsignedinteger] | None = None
    present: Mapping[str, Mask] = msgspec.field(default_factory=dict)
    recording: NDArray[np.object_] | None = None

    def __len__(self) -> int:
        return len(self.time_ns)


def columns(
    name: str, plan: CdrPlan, data: Octets, offset: Integers, length: NDArray[np.int32]
) -> MessageColumns:
    """Return the fields of many messages as columns.

    Args:
        name: message type.
        plan: plan of the type.
        data: u8, the buffer.
        offset: i64, first byte of each message, encapsulation included; any value is safe.
        length: i32, bytes of each message; any value is safe.
    """
    data = np.ascontiguousarray(data)
    rows, fields = np.arange(len(offset)), _Fields(plan, len(offset))
    if not _walked(plan, data, offset, length, rows, fields):  # some do not fit the type: rarely
        rows = np.flatnonzero(trailing(plan, data, offset, length) >= 0)
        fields = _Fields(plan, len(offset))
        _walked(plan, data, offset[rows], length[rows], rows, fields)
    valid = np.zeros(len(offset), bool)
    valid[rows] = True
    return MessageColumns(name, valid, fields)


def _walked(
    plan: CdrPlan, data: Octets, offset: Integers, length: NDArray[np.int32], rows: Integers, fields: _Fields
) -> bool:
    """Collect the positions of all values; return whether all messages are valid."""
    cursor = start_cursor(plan, data, offset, length)
    if len(cursor) < len(rows):
        return False
    cursor.rows = rows
    walk_plan(plan, cursor, fields)
    return len(cursor) == len(rows) and bool((cursor.end >= cursor.position).all())


class _Fields(Mapping[str, "NDArray[Any] | Ragged"]):
    """Columns by name; collects the positions of their values, and reads the values on demand.

    A walk calls ``run``, ``block`` and ``text`` at the position of each value; they do not change the cursor.
    """

    def __init__(self, plan: CdrPlan, rows: int) -> None:
        self._rows = rows
        self._ragged: dict[str, bool] = {}
        self._items: dict[str, Leaf | Text] = {}
        self._pieces: dict[str, list[Piece]] = {}
        self._columns: dict[str, NDArray[Any] | Ragged] = {}
        self._declare(plan, "", ragged=False)

    def __getitem__(self, name: str) -> NDArray[Any] | Ragged:
        if name not in self._columns:
            self._columns[name] = self._gather(name)
        return self._columns[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._pieces)

    def __len__(self) -> int:
        return len(self._pieces)

    def run(self, prefix: str, run: PrimitiveRun, cursor: Cursor) -> None:
        """Take a run that starts at the cursor's position."""
        self.block(prefix, run, cursor, 1)

    def block(self, prefix: str, run: PrimitiveRun, cursor: Cursor, count: Position) -> None:
        """Take ``count`` runs that follow each other from the cursor's position."""
        source, rows, swap, start = cursor.bytes, cursor.rows, cursor.swap, cursor.start

        def gather(leaf: Leaf) -> tuple[Integers, Position, NDArray[Any]]:
            if isinstance(count, int) and count == 1:
                return rows, leaf.count or 1, _read(source, leaf, start, swap)
            if isinstance(count, int) and leaf.count is None and leaf.size == run.size:
                return rows, count, source.numbers(start, leaf.code, count, swap)
            each = np.broadcast_to(np.asarray(count), len(rows))
            within = np.arange(each.sum()) - np.repeat(np.cumsum(each) - each, each)
            places = np.repeat(start, each) + within * run.size
            swapped = None if swap is None else np.repeat(swap, each)
            return rows, count * (leaf.count or 1), _read(source, leaf, places, swapped)

        for leaf in run.leaves:
            self._add(joined(prefix, leaf.name), partial(gather, leaf))

    def text(self, name: str, text: Text, cursor: Cursor, length: Position) -> None:
        """Take a string whose characters start at the cursor's position."""
        source, rows, swap, start = cursor.bytes, cursor.rows, cursor.swap, cursor.start
        self._add(
            name, lambda: (rows, 1, _strings(source, text, start, np.broadcast_to(length, len(rows)), swap))
        )

    def _add(self, name: str, piece: Piece) -> None:
        self._pieces[name].append(piece)

    def _declare(self, plan: CdrPlan, prefix: str, *, ragged: bool) -> None:
        """Declare every column, so that columns without a value in this batch exist too."""
        for step in plan.steps:
            if isinstance(step, Repeat):
                self._declare(step.plan, joined(prefix, step.name), ragged=True)
                continue
            for item in step.leaves if isinstance(step, PrimitiveRun) else (step,):
                name = joined(prefix, item.name)
                self._pieces[name] = []
                self._ragged[name] = ragged
                self._items[name] = item

    def _gather(self, name: str) -> NDArray[Any] | Ragged:
        pieces = [piece() for piece in self._pieces[name]]
        if not self._ragged[name]:
            if pieces and len(pieces[0][0]) == self._rows:
                return pieces[0][2]
            column = _zeros(self._items[name], self._rows, flat=False)
            for rows, _, values in pieces:
                column[rows] = values
            return column
        offsets = np.zeros(self._rows + 1, np.int64)
        values = _zeros(self._items[name], 0, flat=True)
        if len(pieces) == 1:
            rows, each, values = pieces[0]
            offsets[rows + 1] = each
        elif pieces:
            rows = np.concatenate(
                [
                    rows if isinstance(each, int) and each == 1 else np.repeat(rows, each)
                    for rows, each, _ in pieces
                ]
            )
            values = np.concatenate([values.reshape(-1) for _, _, values in pieces])
            values = values[np.argsort(rows, kind="stable")]
            offsets[1:] = np.bincount(rows, minlength=self._rows)
        return Ragged(values.reshape(-1), np.cumsum(offsets))


def _zeros(item: Leaf | Text, rows: int, *, flat: bool) -> NDArray[Any]:
    if isinstance(item, Text):
        return np.full(rows, "", object)
    dtype = bool if item.code == "?" else np.dtype("<" + item.code)
    return np.zeros(rows if flat or item.count is None else (rows, item.count), dtype)


def _read(source: Bytes, leaf: Leaf, start: Integers, swap: Mask | None) -> NDArray[Any]:
    """Read one leaf of the runs at some offsets: shape (offsets,), or (offsets, elements) for an array."""
    values = source.numbers(start + leaf.offset, leaf.code, leaf.count or 1, swap)
    return values.reshape(-1) if leaf.count is None else values


def _strings(source: Bytes, text: Text, start: Integers, length: Integers, swap: Mask | None) -> NDArray[Any]:
    """Decode strings, each distinct one once."""
    texts = np.full(len(start), "", object)
    order = np.zeros(len(start), np.int64) if swap is None else swap.astype(np.int64)
    for units in np.unique(length):
        for big in np.unique(order):
            members = np.flatnonzero((length == units) & (order == big))
            if units == 0 or not len(members):
                continue
            raw = source.gather(start[members], int(units) * text.width).tolist()
            decoded = {item: string_value(text, int(big), item) for item in set(raw)}
            texts[members] = [decoded[item] for item in raw]
    return texts
