"""The fields of many messages as columns, each read when it is first used."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from edoras_tools.ros.cdr import bulk
from edoras_tools.ros.cdr.plan import CdrPlan, Leaf, PrimitiveRun, Repeat, Text
from edoras_tools.ros.cdr.values import string_value

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.wire.arrays import Integers, Mask, Octets

    Piece = Callable[[], tuple[Integers, bulk.Position, NDArray[Any]]]
    """Reads a part of a column; returns i64, its rows; the number of values of each row; and the values."""


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
        rows = np.flatnonzero(bulk.trailing(plan, data, offset, length) >= 0)
        fields = _Fields(plan, len(offset))
        _walked(plan, data, offset[rows], length[rows], rows, fields)
    valid = np.zeros(len(offset), bool)
    valid[rows] = True
    return MessageColumns(name, valid, fields)


def _walked(
    plan: CdrPlan, data: Octets, offset: Integers, length: NDArray[np.int32], rows: Integers, fields: _Fields
) -> bool:
    """Collect the positions of all values; return whether all messages are valid."""
    cursor = bulk.start_cursor(plan, data, offset, length)
    if len(cursor) < len(rows):
        return False
    cursor.rows = rows
    bulk.walk_plan(plan, cursor, fields)
    return len(cursor) == len(rows) and bool((cursor.end >= cursor.position).all())


class _Fields(Mapping[str, "NDArray[Any] | Ragged"]):
    """Columns by name; collects the positions of their values, and reads the values on demand."""

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

    def run(self, prefix: str, run: PrimitiveRun, cursor: bulk.Cursor) -> None:
        """Take a run that starts at the cursor's position."""
        self.block(prefix, run, cursor, 1)

    def block(self, prefix: str, run: PrimitiveRun, cursor: bulk.Cursor, count: bulk.Position) -> None:
        """Take runs that follow each other from the cursor's position."""
        source, rows, swap, start = cursor.bytes, cursor.rows, cursor.swap, cursor.start

        def gather(leaf: Leaf) -> tuple[Integers, bulk.Position, NDArray[Any]]:
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
            self._add(bulk.joined(prefix, leaf.name), partial(gather, leaf))

    def text(self, name: str, text: Text, cursor: bulk.Cursor, length: bulk.Position) -> None:
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
                self._declare(step.plan, bulk.joined(prefix, step.name), ragged=True)
                continue
            for item in step.leaves if isinstance(step, PrimitiveRun) else (step,):
                name = bulk.joined(prefix, item.name)
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


def _read(source: bulk.Bytes, leaf: Leaf, start: Integers, swap: Mask | None) -> NDArray[Any]:
    """Read one leaf of the runs at some offsets: shape (offsets,), or (offsets, elements) for an array."""
    values = source.numbers(start + leaf.offset, leaf.code, leaf.count or 1, swap)
    return values.reshape(-1) if leaf.count is None else values


def _strings(
    source: bulk.Bytes, text: Text, start: Integers, length: Integers, swap: Mask | None
) -> NDArray[Any]:
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
