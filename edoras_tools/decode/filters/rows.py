"""Packets in the form that a filter reads, and the fields that filters and tables can read from them.

Packets are a batch with its columns, or decoded one by one. Both give the same series for every field.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from enum import Enum
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.decode.spacecraft import FIRST_SPACECRAFT
from edoras_tools.model import NO_ROUTE, Columns, Decoded, PacketBatch
from edoras_tools.wire.arrays import Integers, Mask, Places, by_value

if TYPE_CHECKING:
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


COLUMN_COST: Final = 0
"""Cost of values in the decoder's columns."""
BYTES_COST: Final = 1
"""Cost of values gathered from the bytes."""
MESSAGE_COST: Final = 2
"""Cost of values read from ROS messages in bulk."""
PACKET_COST: Final = 3
"""Cost of values that need a dissection of each packet."""


class FilterField(msgspec.Struct, frozen=True, eq=False):
    """A named value of a packet, or a list of them.

    Attributes:
        name: name in filters, in the tree and in JSON.
        kind: kind of the values.
        pick: reads the field from one packet: a value, a list, or None if the packet has none.
        read: reads it from many packets at once; None if each must be dissected.
        scope: returns the packets that can have it, if ``read`` is None; None for any.
        cost: cost of ``read``.
        dtype: type of numbers and bools.
        limits: smallest and largest number that it can hold.
        base: base in which the number is displayed: 10 or 16.
        digits: fewest digits in base 16.
        names: names of numbers, displayed and accepted.
        words: further names of numbers, accepted only.
        choices: all texts that it can have, if they are known.
        alike: returns whether a text matches a word; None: if they are equal.
        many: whether it is a list.
        doc: description, one line.
    """

    name: str
    kind: ValueKind
    pick: Callable[[PacketRows, Decoded], Any]
    read: Callable[[ColumnRows], Series] | None = None
    scope: Callable[[ColumnRows], Mask] | None = None
    cost: int = COLUMN_COST
    dtype: np.dtype[Any] = INDEX_DTYPE
    limits: tuple[int, int] | None = None
    base: int = 10
    digits: int = 1
    names: Mapping[int, str] = msgspec.field(default_factory=lambda: MappingProxyType({}))
    words: Mapping[str, int] = msgspec.field(default_factory=lambda: MappingProxyType({}))
    choices: Sequence[str] = ()
    alike: Callable[[str, str], bool] | None = None
    many: bool = False
    doc: str = ""

    @property
    def price(self) -> int:
        """The cost of reading it."""
        return PACKET_COST if self.read is None else self.cost

    def series(self, rows: PacketRows) -> Series:
        """Return the values in some packets: in bulk if possible, else packet by packet."""
        if not isinstance(rows, ColumnRows):
            return self._picked(rows)
        if self.read is not None:
            return self.read(rows)
        members = np.flatnonzero(self.scope(rows)) if self.scope else np.arange(len(rows), dtype=INDEX_DTYPE)
        part = PacketRows(rows.context, rows.begin_ns, rows.take(members).packets())
        return self._picked(part).placed(len(rows), members)

    def _picked(self, rows: PacketRows) -> Series:
        values: list[Any] = []
        owner: list[int] = []
        holders: list[int] = []
        for row, decoded in enumerate(rows.packets()):
            value = self.pick(rows, decoded)
            if value is None:
                continue
            holders.append(row)
            items = value if isinstance(value, list) else [value]
            values += items
            owner += [row] * len(items)
        places = np.array(owner, INDEX_DTYPE), np.array(holders, INDEX_DTYPE)
        if self.kind in {ValueKind.TEXT, ValueKind.BYTES}:
            return Series.of_objects(len(rows), values, *places)
        if self.kind is ValueKind.STRUCT:
            values = [0] * len(values)
        return Series(len(rows), np.array(values, self.dtype), *places)

    def length(self) -> Self:
        """Return a field with the number of values of this one, or the number of characters of its text."""
        pick, read = self.pick, self.read
        countable = self.many or self.kind not in {ValueKind.TEXT, ValueKind.BYTES}

        def pick_length(rows: PacketRows, decoded: Decoded) -> int | None:
            value = pick(rows, decoded)
            return None if value is None else len(value)

        def read_length(rows: ColumnRows) -> Series:
            series = read(rows)  # type: ignore[misc]  # used only where it is there
            return series.lengths() if countable else series.sizes()

        return replace(
            self,
            name=f"len({self.name})",
            kind=ValueKind.NUMBER,
            pick=pick_length,
            read=read_length if read else None,
            dtype=INDEX_DTYPE,
            limits=None,
            base=10,
            names={},
            words={},
            choices=(),
            many=False,
        )
