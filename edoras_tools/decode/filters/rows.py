"""Packets in the form that a filter reads: a batch with its columns, or packets decoded one by one.

Both give the same series for every field.
"""

from __future__ import annotations

from enum import Enum
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from edoras_tools.decode.spacecraft import FIRST_SPACECRAFT
from edoras_tools.model import NO_ROUTE, Columns, Decoded, PacketBatch
from edoras_tools.wire.arrays.order import Integers, Mask, Places, by_value

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from numpy.typing import NDArray
    from typing_extensions import Self

    from edoras_tools.decode.context import Context


INDEX_DTYPE = np.dtype(np.int64)


class ValueKind(Enum):
    """The kind of a field's values, and so the possible comparisons; the value is its text in messages."""

    NUMBER = "a number"
    BOOL = "true or false"
    DURATION = "a length of time"
    MOMENT = "a point in time"
    TEXT = "text"
    BYTES = "bytes"
    STRUCT = "a group of fields"


class Series(NamedTuple):
    """The values of a field in ``rows`` packets.

    Attributes:
        rows: number of packets.
        values: numbers, i64 ns for times, or indices into ``table`` if that is set.
        owner: row of each value, i64; None if every row has one, in order.
        holders: rows that have the field, even without a value (an empty list), i64; None: the owners.
        table: distinct texts or bytes.
    """

    rows: int
    values: NDArray[Any]
    owner: Integers | None = None
    holders: Integers | None = None
    table: Sequence[Any] | None = None

    @classmethod
    def of_objects(
        cls, rows: int, items: Iterable[Any], owner: Integers | None = None, holders: Integers | None = None
    ) -> Self:
        """Make a series of texts or bytes; each distinct one is kept once."""
        places: dict[Any, int] = {}
        codes = np.fromiter((places.setdefault(item, len(places)) for item in items), INDEX_DTYPE)
        return cls(rows, codes, owner, holders, list(places))

    @classmethod
    def of_chosen(cls, values: NDArray[Any], present: Mask) -> Self:
        """Make a series from a column and a mask of the rows that have a value."""
        if present.all():
            return cls(len(values), values)
        owner = np.flatnonzero(present)
        return cls(len(values), values[owner], owner)

    def where(self, hit: Mask) -> Mask:
        """Return the rows with a value that is hit.

        Args:
            hit: whether each value is hit, bool.
        """
        if self.owner is None:
            return hit
        out = np.zeros(self.rows, bool)
        out[self.owner[hit]] = True
        return out

    def present(self) -> Mask:
        """Return the rows that have a value."""
        return self.where(np.ones(len(self.values), bool))

    def lengths(self) -> Self:
        """Return the number of values in every row that has the field."""
        if self.owner is None:
            return type(self)(self.rows, np.ones(self.rows, INDEX_DTYPE))
        holders = np.unique(self.owner) if self.holders is None else self.holders
        return type(self)(self.rows, np.bincount(self.owner, minlength=self.rows)[holders], holders)

    def sizes(self) -> Self:
        """Return the length of every text."""
        sizes = np.array([len(item) for item in self.table or ()], INDEX_DTYPE)
        return type(self)(self.rows, sizes[self.values], self.owner)

    def placed(self, rows: int, at: Integers) -> Self:
        """Return the series for more rows, where row ``at[i]`` is row ``i`` of this one."""
        owner = at if self.owner is None else at[self.owner]
        holders = None if self.holders is None else at[self.holders]
        return type(self)(rows, self.values, owner, holders, self.table)


class PacketRows:
    """Some packets, decoded one by one.

    Args:
        begin_ns: time of the capture's first datagram.
    """

    def __init__(self, context: Context, begin_ns: int, packets: Sequence[Decoded] = ()) -> None:
        self.context = context
        self.begin_ns = begin_ns
        self._packets = packets

    def __len__(self) -> int:
        return len(self._packets)

    def packets(self) -> Sequence[Decoded]:
        """Return the packets."""
        return self._packets

    def take(self, rows: Integers) -> Self:
        """Return some of the packets, given by index."""
        return type(self)(self.context, self.begin_ns, [self._packets[row] for row in rows])


class ColumnRows(PacketRows):
    """Rows of a batch, read in bulk where a field allows it.

    Attributes:
        batch: the whole batch.
        columns: columns decoded from it.
        selection: rows of the batch; an index array, or a slice for all.
    """

    def __init__(
        self,
        context: Context,
        begin_ns: int,
        batch: PacketBatch,
        columns: Columns,
        selection: Integers | slice = slice(None),
    ) -> None:
        super().__init__(context, begin_ns)
        self.batch = batch
        self.columns = columns
        self.selection = selection
        self._count = len(batch) if isinstance(selection, slice) else len(selection)
        self._known: dict[object, Any] = {}

    def __len__(self) -> int:
        return self._count

    def column(self, name: str) -> NDArray[Any]:
        """Return one of the decoder's columns for these rows."""
        return getattr(self.columns, name)[self.selection]

    def datagram(self, name: str) -> NDArray[Any]:
        """Return one of the batch's columns for these rows."""
        return getattr(self.batch, name)[self.selection]

    def indices(self) -> Integers:
        """Return the indices of these rows in the batch."""
        return np.arange(len(self.batch))[self.selection]

    def alone(self) -> tuple[PacketBatch, Columns]:
        """Return these rows as their own batch and columns; the originals if all rows are selected."""
        if len(self) == len(self.batch):
            return self.batch, self.columns
        rows = self.indices()
        return self.batch.take(rows), self.columns.take(rows)

    def routes(self) -> NDArray[np.int16]:
        """Return the route of each packet's message: a route of its link, else of any link."""

        def make() -> NDArray[np.int16]:
            exact, msg_id = self.column("route"), self.column("msg_id")
            return np.where(exact == NO_ROUTE, self.context.any_route_of[msg_id], exact)

        return self.once("routes", make)

    def packets(self) -> Sequence[Decoded]:
        """Return the packets, dissected one by one."""
        from edoras_tools.decode.stack import Dissector

        dissector = Dissector(self.context, detail=False)
        return self.once(
            "packets", lambda: [dissector.dissect(self.batch[row]) for row in self.indices().tolist()]
        )

    def take(self, rows: Integers) -> Self:
        """Return some of the rows, given by index."""
        selection = rows if isinstance(self.selection, slice) else self.selection[rows]
        return type(self)(self.context, self.begin_ns, self.batch, self.columns, selection)

    def by_spacecraft(self) -> Iterator[tuple[Places, Self]]:
        """Yield the places of each spacecraft's rows, and these rows with the context of that spacecraft."""
        for number, places in by_value(self.column("spacecraft")):
            own = self if number == FIRST_SPACECRAFT and len(places) == len(self) else self.take(places)
            own.context = self.context.of(number)
            yield places, own

    def once(self, key: object, make: Callable[[], Any]) -> Any:
        """Return the cached result for a key; ``make`` makes it the first time."""
        if key not in self._known:
            self._known[key] = make()
        return self._known[key]
