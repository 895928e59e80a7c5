"""The fields that filters and tables can read from a packet."""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.decode.filters.rows import INDEX_DTYPE, ColumnRows, PacketRows, Series, ValueKind

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from typing_extensions import Self

    from edoras_tools.model import Decoded
    from edoras_tools.wire.arrays.order import Mask

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
