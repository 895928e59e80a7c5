"""What a filter and a table can ask a packet for."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Self

from edoras_tools.decode.where_series import INDEX, Kind

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from edoras_tools.decode.where_rows import ColumnRows, Rows
    from edoras_tools.decode.where_series import Series
    from edoras_tools.model import Decoded

COLUMN: Final = 0
"""Cost of what the decoder's columns hold."""
BYTES: Final = 1
"""Cost of what is gathered from the bytes."""
MESSAGE: Final = 2
"""Cost of what is read from ROS messages in bulk."""
PACKET: Final = 3
"""Cost of what takes a dissection of each packet."""


@dataclass(frozen=True, slots=True, eq=False)
class Field:
    """A named value of a packet, or a list of them.

    Attributes:
        name: as it is written, and as the tree and the JSON call it.
        kind: what the values are.
        pick: reads it from one packet: a value, a list, or None where the packet has none.
        read: reads it from many packets at once; None where each must be dissected.
        scope: which packets can have it, where ``read`` is None; None for any.
        cost: of ``read``.
        dtype: of numbers and truths.
        limits: least and greatest number that it can hold.
        base: how people read the number: 10 or 16.
        digits: at the least, in base 16.
        names: what numbers mean, shown and understood.
        words: further words for numbers, understood only.
        choices: all texts that it can have, where they are known.
        alike: tells whether a text is what a word means; None: where they are the same.
        many: whether it is a list.
        doc: one line.
    """

    name: str
    kind: Kind
    pick: Callable[[Rows, Decoded], Any]
    read: Callable[[ColumnRows], Series] | None = None
    scope: Callable[[ColumnRows], NDArray[np.bool_]] | None = None
    cost: int = COLUMN
    dtype: np.dtype[Any] = INDEX
    limits: tuple[int, int] | None = None
    base: int = 10
    digits: int = 1
    names: Mapping[int, str] = field(default_factory=lambda: MappingProxyType({}))
    words: Mapping[str, int] = field(default_factory=lambda: MappingProxyType({}))
    choices: Sequence[str] = ()
    alike: Callable[[str, str], bool] | None = None
    many: bool = False
    doc: str = ""

    @property
    def price(self) -> int:
        """What it costs to read."""
        return PACKET if self.read is None else self.cost

    def length(self) -> Self:
        """Return the field of how many values this one has, or of how many characters its text has."""
        pick, read = self.pick, self.read
        counted = self.many or self.kind not in {Kind.TEXT, Kind.BYTES}

        def pick_length(rows: Rows, decoded: Decoded) -> int | None:
            value = pick(rows, decoded)
            return None if value is None else len(value)

        def read_length(rows: ColumnRows) -> Series:
            series = read(rows)  # type: ignore[misc]  # used only where it is there
            return series.lengths() if counted else series.sizes()

        return replace(
            self,
            name=f"len({self.name})",
            kind=Kind.NUMBER,
            pick=pick_length,
            read=read_length if read else None,
            dtype=INDEX,
            limits=None,
            base=10,
            names={},
            words={},
            choices=(),
            many=False,
        )
