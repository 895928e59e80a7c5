"""The order of the packets of the list by one of its columns."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.decode.filters.filter import fields
from edoras_tools.decode.filters.rows import ColumnRows
from edoras_tools.model import NO_MSG_ID, NO_ROUTE
from edoras_tools.wire.arrays.order import numbered

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from edoras_tools.addons.tui.data.store import Part
    from edoras_tools.decode.context import Context
    from edoras_tools.decode.filters.rows import FilterField

_FIELDS: Final = {
    "time": "time_ns",
    "ports": "source.port,destination.port",
    "packet": "link,sbn.msg_type",
    "bytes": "length",
}
"""Field of a list's column, if its name differs from the column's."""


def sort_order(
    parts: Sequence[Part],
    column: str,
    context: Context,
    *,
    reverse: bool,
    given_up: Callable[[], bool] = lambda: False,
) -> NDArray[np.int64] | None:
    """Return the rows of a list sorted by a column; rows without a value are last; the sort is stable.

    Args:
        parts: result of ``Store.parts``.
        column: one of the list's columns, or any field.
        reverse: whether the largest comes first.
        given_up: called between blocks; the result is None if it returns true.
    """
    fields_of = [
        several_fields for _, several_fields in fields(_FIELDS.get(column, column), context, "column")
    ]
    read = _names if column == "topic" else _values
    blocks: list[list[tuple[NDArray[Any], NDArray[np.bool_]]]] = []
    for block, _, selection in parts:
        if given_up():
            return None
        rows = ColumnRows(context, 0, block.batch, block.columns, np.asarray(selection))
        blocks.append([read(rows, several) for several in fields_of])
    keys: list[NDArray[Any]] = []
    for pieces in zip(*blocks, strict=True):
        _, ranks = np.unique(np.concatenate([values for values, _ in pieces]), return_inverse=True)
        has_value = np.concatenate([present for _, present in pieces])
        keys += [~has_value, np.where(has_value, -ranks if reverse else ranks, 0)]
    return np.lexsort(keys[::-1]) if keys else np.zeros(0, np.int64)


def _values(rows: ColumnRows, several: Sequence[FilterField]) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Return the first value of each row, numbers or texts, and which rows have one.

    Args:
        several: fields that share a name; a row has the value of the last field that it has.
    """
    out, present = np.zeros(len(rows)), np.zeros(len(rows), bool)
    for field in several:
        series = field.series(rows)
        values = series.values
        if series.table is not None:
            values = np.array([*map(str, series.table), ""])[values]
        owner, first = np.unique(
            np.arange(len(rows)) if series.owner is None else series.owner, return_index=True
        )
        if not present.any():
            out = np.zeros(len(rows), values.dtype)
        elif out.dtype.kind in "US" or values.dtype.kind in "US":
            out, values = out.astype(str), values.astype(str)
        out = out.astype(np.promote_types(out.dtype, values.dtype))
        out[owner] = values[first]
        present[owner] = True
    return out, present


def _names(rows: ColumnRows, _: Sequence[FilterField]) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Return the text in the list's column of topics: topic of the route, else name of the MsgId."""
    columns = rows.routes(), rows.column("msg_id"), rows.column("spacecraft")
    first, which = numbered(*columns)
    kinds = zip(*(column[first].tolist() for column in columns), strict=True)
    names = np.array([_name(rows.context, *kind) for kind in kinds], str)[which]
    return names, names != ""


def _name(context: Context, route: int, msg_id: int, spacecraft: int) -> str:
    if msg_id != NO_MSG_ID and route != NO_ROUTE:
        return context.of(spacecraft).mission.routes[route].topic
    return context.name(msg_id) if msg_id != NO_MSG_ID else ""
