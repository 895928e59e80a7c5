"""Tables as CSV (RFC 4180)."""

from __future__ import annotations

import re
from typing import IO, TYPE_CHECKING, Final

from edoras_tools.io.formats.jsonl.writer import TextRows, json_texts, number_texts, time_texts

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from edoras_tools.io.formats.columns import TableColumn, TableHead

_SPECIAL: Final = re.compile(r'[",\r\n]')


class CsvWriter:
    """Writes one line a row; a list is JSON in one cell, a value that is not there is empty."""

    def __init__(self, file: IO[bytes], _: TableHead, columns: Sequence[TableColumn]) -> None:
        self._file = file
        self.write(_lines([_quoted([column.name for column in columns])]))

    @staticmethod
    def piece(columns: Sequence[TableColumn]) -> TextRows:
        """Return some rows as text."""
        return _lines(zip(*map(_cells, columns), strict=True))

    def write(self, piece: TextRows) -> None:
        """Write some rows."""
        self._file.write(piece)

    def close(self) -> None:
        """Do nothing: every row is written."""


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
    if column.there is None:
        return texts
    return [text if there else "" for text, there in zip(texts, column.there.tolist(), strict=True)]


def _quoted(texts: Sequence[str]) -> list[str]:
    """Quote the texts that need it."""
    return ['"' + text.replace('"', '""') + '"' if _SPECIAL.search(text) else text for text in texts]
