"""The values of one field in many packets, as arrays; a packet may have none of them, one, or several."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray
    from typing_extensions import Self

INDEX_DTYPE = np.dtype(np.int64)


class ValueKind(Enum):
    """What a field's values are, and so what they may be compared with; the value reads in a message."""

    NUMBER = "a number"
    BOOL = "true or false"
    DURATION = "a length of time"
    MOMENT = "a point in time"
    TEXT = "text"
    BYTES = "bytes"
    STRUCT = "a group of fields"


@dataclass(frozen=True, slots=True)
class Series:
    """The values of a field in ``rows`` packets.

    Attributes:
        rows: how many packets.
        values: numbers, i64 ns for times, or where ``table`` is given indices into it.
        owner: i64, the row that each value belongs to; None where every row has one, in order.
        holders: i64, rows that have the field though maybe no value, as an empty list; None: the owners.
        table: the distinct texts or bytes.
    """

    rows: int
    values: NDArray[Any]
    owner: NDArray[np.int64] | None = None
    holders: NDArray[np.int64] | None = None
    table: Sequence[Any] | None = None

    @classmethod
    def of_objects(
        cls,
        rows: int,
        items: Iterable[Any],
        owner: NDArray[np.int64] | None = None,
        holders: NDArray[np.int64] | None = None,
    ) -> Self:
        """Make a series of texts or bytes, each distinct one kept once."""
        places: dict[Any, int] = {}
        codes = np.fromiter((places.setdefault(item, len(places)) for item in items), INDEX_DTYPE)
        return cls(rows, codes, owner, holders, list(places))

    @classmethod
    def of_chosen(cls, values: NDArray[Any], present: NDArray[np.bool_]) -> Self:
        """Make a series of a column and the rows where it holds a value."""
        if present.all():
            return cls(len(values), values)
        owner = np.flatnonzero(present)
        return cls(len(values), values[owner], owner)

    def where(self, hit: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return the rows of which a value is hit.

        Args:
            hit: bool, one a value.
        """
        if self.owner is None:
            return hit
        out = np.zeros(self.rows, bool)
        out[self.owner[hit]] = True
        return out

    def present(self) -> NDArray[np.bool_]:
        """Return the rows that have a value."""
        return self.where(np.ones(len(self.values), bool))

    def lengths(self) -> Self:
        """Return how many values every row that has the field holds."""
        if self.owner is None:
            return type(self)(self.rows, np.ones(self.rows, INDEX_DTYPE))
        holders = np.unique(self.owner) if self.holders is None else self.holders
        return type(self)(self.rows, np.bincount(self.owner, minlength=self.rows)[holders], holders)

    def sizes(self) -> Self:
        """Return how long every text is."""
        sizes = np.array([len(item) for item in self.table or ()], INDEX_DTYPE)
        return type(self)(self.rows, sizes[self.values], self.owner)

    def placed(self, rows: int, at: NDArray[np.int64]) -> Self:
        """Return the series of more rows, of which row ``at[i]`` is this one's row ``i``."""
        owner = at if self.owner is None else at[self.owner]
        holders = None if self.holders is None else at[self.holders]
        return type(self)(rows, self.values, owner, holders, self.table)
