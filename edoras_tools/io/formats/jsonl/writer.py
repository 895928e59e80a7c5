"""Values of many rows as JSON texts, and tables as JSON Lines."""

from __future__ import annotations

import pickle
from itertools import pairwise
from json import dumps
from math import isfinite
from typing import IO, TYPE_CHECKING, Any, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from edoras_tools.io.formats.columns import TableColumn, TableHead


NOT_FINITE: Final = {"nan": "NaN", "inf": "Infinity", "-inf": "-Infinity"}
"""The texts in JSON of the numbers that it does not know, by Python's."""
_OCTETS: Final = [str(value) for value in (*range(256), *range(-128, 0))]
"""The texts of ``uint8`` and ``int8`` by value: an index below zero counts from the end."""


class TextRows(bytes):
    """Rows as text; between processes they go through shared memory, and are copied where they arrive."""

    def __reduce_ex__(self, _: Any) -> tuple[Any, ...]:
        """Return what the rows are made again from."""
        return TextRows, (pickle.PickleBuffer(self),)


def json_texts(column: TableColumn) -> list[str]:
    """Return the JSON text of every row of a column; numbers that JSON does not know are texts."""
    values, offsets = column.spread()
    texts = value_texts(values)
    if offsets is not None:
        texts = [f"[{','.join(texts[first:last])}]" for first, last in pairwise(offsets.tolist())]
    if column.there is None:
        return texts
    return [text if there else "null" for text, there in zip(texts, column.there.tolist(), strict=True)]


def json_value(value: Any, octets: Callable[[bytes], Any] = list) -> Any:
    """Return a value as JSON takes it: numbers that it does not know as texts.

    Args:
        value: of a message or a header, nested.
        octets: what becomes of bytes; a list of numbers if not given.
    """
    if isinstance(value, dict):
        return {name: json_value(item, octets) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_value(item, octets) for item in value]
    if isinstance(value, (bytes, bytearray)):
        return octets(bytes(value))
    if isinstance(value, float) and not isfinite(value):
        return NOT_FINITE[repr(value)]
    return value


def number_texts(values: NDArray[Any]) -> list[str]:
    """Return the shortest text of every number that is read back as the same number of its type."""
    if values.dtype.kind == "f" and values.itemsize < 8:
        texts: list[str] = values.astype(str).tolist()
        return texts
    if values.itemsize == 1:
        return list(map(_OCTETS.__getitem__, values.tolist()))
    return list(map(repr, values.tolist()))


def time_texts(values: NDArray[np.datetime64]) -> list[str]:
    """Return times in UTC as ISO 8601, to the ns."""
    texts: list[str] = np.datetime_as_string(values, "ns", timezone="UTC").tolist()
    return texts


def value_texts(values: NDArray[Any]) -> list[str]:
    """Return the JSON text of every value of an array of one dimension."""
    kind = values.dtype.kind
    if kind == "O":
        items = values.tolist()
        quoted = {item: dumps(item, ensure_ascii=False) for item in set(items)}
        return [quoted[item] for item in items]
    if kind == "b":
        return ["true" if value else "false" for value in values.tolist()]
    if kind == "M":
        return [f'"{text}"' for text in time_texts(values)]
    texts = number_texts(values)
    if kind == "f" and not np.isfinite(values).all():
        return [f'"{NOT_FINITE[text]}"' if text in NOT_FINITE else text for text in texts]
    return texts


class JsonLinesWriter:
    """Writes one object a row, its keys in the order of the columns; see ``TableWriter``."""

    def __init__(self, file: IO[bytes], _: TableHead, __: Sequence[TableColumn]) -> None:
        self._file = file

    @staticmethod
    def piece(columns: Sequence[TableColumn]) -> TextRows:
        """Return some rows as text."""
        names = [dumps(column.name, ensure_ascii=False).replace("%", "%%") for column in columns]
        line = "{" + ", ".join(f"{name}: %s" for name in names) + "}\n"
        rows = zip(*map(json_texts, columns), strict=True)
        return TextRows("".join(map(line.__mod__, rows)).encode())

    def write(self, piece: TextRows) -> None:
        """Write some rows."""
        self._file.write(piece)

    def close(self) -> None:
        """Do nothing: every row is written."""
