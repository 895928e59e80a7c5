"""Tables that are written column by column, to files that appear only when they are complete.

Columns become texts in bulk: values as JSON, rows as JSON Lines and CSV (RFC 4180).
"""

from __future__ import annotations

import pickle
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import pairwise
from json import dumps
from math import isfinite
from typing import IO, TYPE_CHECKING, Any, Final, Protocol

import msgspec
import numpy as np

from edoras_tools.errors import CaptureError
from edoras_tools.io.outputs import NewFile
from edoras_tools.ros.cdr.bulk import Ragged

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from edoras_tools.wire.arrays import Integers, Mask


class TableColumn(msgspec.Struct, frozen=True):
    """A column of a table.

    Attributes:
        name: unique in its table.
        values: one element per row: numbers, bool, ``datetime64[ns]`` (UTC), or ``object`` for texts; of
            shape (rows, elements) or ``Ragged`` if a row contains a list.
        present: bool, the rows that have a value; None for all.
        unit: of the numbers, e.g. ``ns``; empty if unknown.
    """

    name: str
    values: NDArray[Any] | Ragged
    present: Mask | None = None
    unit: str = ""

    def __len__(self) -> int:
        return len(self.values)

    def spread(self) -> tuple[NDArray[Any], Integers | None]:
        """Return all values in one array, and the start of each row's list in it.

        Returns:
            The values, and one offset more than rows; None if no row contains a list.
        """
        if isinstance(self.values, Ragged):
            return self.values.values, self.values.offsets
        if self.values.ndim == 1:
            return self.values, None
        rows, width = self.values.shape
        return self.values.reshape(-1), np.arange(rows + 1, dtype=np.int64) * width


class TableHead(msgspec.Struct, frozen=True):
    """The description of a table, for formats that store one.

    Attributes:
        topic: topic of the messages.
        type: ROS type of the messages.
        metadata: texts by name, such as the definition of the type.
    """

    topic: str
    type: str
    metadata: Mapping[str, str] = msgspec.field(default_factory=dict)


class TableWriter(Protocol):
    """Writes a table of rows that have the same columns.

    All methods raise the errors of the file and the library; ``TableFile`` turns them into ``CaptureError``.
    """

    def __init__(self, file: IO[bytes], head: TableHead, columns: Sequence[TableColumn]) -> None:
        """Start a table; ``columns`` may have no rows."""

    @staticmethod
    def piece(columns: Sequence[TableColumn]) -> Any:
        """Return some rows in the form that ``write`` takes; callable in any process, and long before."""

    def write(self, piece: Any) -> None:
        """Write some rows; their columns may change afterwards."""

    def close(self) -> None:
        """Write the remaining rows and complete the table; the file stays open."""


class TableFile:
    """A table in a file that appears under its name when it is complete.

    If the table cannot be finished, the incomplete file is removed, and an existing file stays unchanged
    (``outputs.NewFile``). A pipe or device is written directly.

    Args:
        make: makes the writer of the format.
        columns: see ``TableWriter``.

    Attributes:
        path: path of the file.
        head: description of the table.
        rows: number of rows written.

    Raises:
        CaptureError: from all methods: the file cannot be written.
    """

    def __init__(
        self, path: Path, make: Callable[..., TableWriter], head: TableHead, columns: Sequence[TableColumn]
    ) -> None:
        self.path, self.head, self.rows = path, head, 0
        try:
            self._new = NewFile(path)
        except OSError as error:
            raise self._failure(error) from error
        with self._removed_on_failure():
            self._writer = make(self._new.file, head, columns)

    def write(self, piece: Any, rows: int) -> None:
        """Write some rows."""
        with self._removed_on_failure():
            self._writer.write(piece)
        self.rows += rows

    def complete(self) -> None:
        """Write the rest of the table."""
        with self._removed_on_failure():
            self._writer.close()
            self._new.file.flush()

    def keep(self) -> None:
        """Close the file, and give it its name."""
        with self._removed_on_failure():
            self._new.keep()

    def remove(self) -> None:
        """Close the file, and remove it if it is incomplete."""
        self._new.remove()

    @contextmanager
    def _removed_on_failure(self) -> Iterator[None]:
        try:
            yield
        except BaseException as error:
            self.remove()
            if isinstance(error, OSError):
                raise self._failure(error) from error
            raise

    def _failure(self, error: OSError) -> CaptureError:
        return CaptureError(f"{self.path}: cannot be written: {error.strerror or error}")


NOT_FINITE: Final = {"nan": "NaN", "inf": "Infinity", "-inf": "-Infinity"}
"""JSON texts of the floats that JSON has no number for, by Python's ``repr``."""
_OCTETS: Final = [str(value) for value in (*range(256), *range(-128, 0))]
"""Texts of ``uint8`` and ``int8`` values; a negative index counts from the end."""


class TextRows(bytes):
    """Rows as text; they are passed between processes in shared memory, and copied by the receiver."""

    def __reduce_ex__(self, _: Any) -> tuple[Any, ...]:
        """Return the constructor and its arguments for ``pickle``."""
        return TextRows, (pickle.PickleBuffer(self),)


def json_texts(column: TableColumn) -> list[str]:
    """Return the JSON text of every row of a column; NaN and infinities become strings."""
    values, offsets = column.spread()
    texts = value_texts(values)
    if offsets is not None:
        texts = [f"[{','.join(texts[first:last])}]" for first, last in pairwise(offsets.tolist())]
    if column.present is None:
        return texts
    return [text if present else "null" for text, present in zip(texts, column.present.tolist(), strict=True)]


def json_value(value: Any, octets: Callable[[bytes], Any] = list) -> Any:
    """Return a value with only types of JSON; NaN and infinities become strings.

    Args:
        value: a value of a message or a header, possibly nested.
        octets: converts bytes; by default to a list of numbers.
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
    """Return the shortest text of each number that reads back as the same number of its type."""
    if values.dtype.kind == "f" and values.itemsize < 8:
        return values.astype(str).tolist()
    if values.itemsize == 1:
        return list(map(_OCTETS.__getitem__, values.tolist()))
    return list(map(repr, values.tolist()))


def time_texts(values: NDArray[np.datetime64]) -> list[str]:
    """Return times in UTC as ISO 8601, to the ns."""
    return np.datetime_as_string(values, "ns", timezone="UTC").tolist()


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


class _TextWriter:
    """Writes rows as they are made; see ``TableWriter``."""

    def __init__(self, file: IO[bytes], _: TableHead, __: Sequence[TableColumn]) -> None:
        self._file = file

    def write(self, piece: TextRows) -> None:
        """Write some rows."""
        self._file.write(piece)

    def close(self) -> None:
        """Do nothing: every row is written."""


class JsonLinesWriter(_TextWriter):
    """Writes one object a row, its keys in the order of the columns."""

    @staticmethod
    def piece(columns: Sequence[TableColumn]) -> TextRows:
        """Return some rows as text."""
        names = [dumps(column.name, ensure_ascii=False).replace("%", "%%") for column in columns]
        line = "{" + ", ".join(f"{name}: %s" for name in names) + "}\n"
        return TextRows("".join(map(line.__mod__, zip(*map(json_texts, columns), strict=True))).encode())


_SPECIAL: Final = re.compile(r'[",\r\n]')


class CsvWriter(_TextWriter):
    """Writes one line a row; a list is JSON in one cell, a missing value is an empty cell."""

    def __init__(self, file: IO[bytes], head: TableHead, columns: Sequence[TableColumn]) -> None:
        super().__init__(file, head, columns)
        self.write(_lines([_quoted([column.name for column in columns])]))

    @staticmethod
    def piece(columns: Sequence[TableColumn]) -> TextRows:
        """Return some rows as text."""
        return _lines(zip(*map(_cells, columns), strict=True))


def _lines(rows: Iterable[Sequence[str]]) -> TextRows:
    # Cells are quoted already, a column at a time: Python's csv module takes five times as long.
    return TextRows("".join(f"{','.join(row)}\n" for row in rows).encode())


def _cells(column: TableColumn) -> list[str]:
    values, offsets = column.spread()
    kind = values.dtype.kind
    if offsets is not None:
        texts = _quoted(json_texts(column))
    elif kind == "O":
        texts = _quoted(values.tolist())
    elif kind == "M":
        texts = time_texts(values)
    else:
        texts = json_texts(column) if kind == "b" else number_texts(values)
    if column.present is None:
        return texts
    return [text if present else "" for text, present in zip(texts, column.present.tolist(), strict=True)]


def _quoted(texts: Sequence[str]) -> list[str]:
    """Quote the texts that need it."""
    return ['"' + text.replace('"', '""') + '"' if _SPECIAL.search(text) else text for text in texts]
