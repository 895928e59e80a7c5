"""Tables as Parquet, and as Arrow files (Feather version 2)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import IO, TYPE_CHECKING, Any, Final

import pyarrow as pa
import pyarrow.parquet

from edoras_tools.io.formats.arrow.arrays import arrow_schema, arrow_table

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.io.formats.columns import TableColumn, TableHead

_ROWS: Final = 1 << 17
_BYTES: Final = 16 << 20
"""Rows are collected up to one of these: readers are slow with many small groups of rows."""


class _GroupWriter(ABC):
    """Collects rows, and writes them in groups; see ``TableWriter``."""

    def __init__(self, file: IO[bytes], head: TableHead, columns: Sequence[TableColumn]) -> None:
        self._schema = arrow_schema(head, columns)
        self._writer = self._open(file)
        self._tables: list[Any] = []

    @abstractmethod
    def _open(self, file: IO[bytes]) -> Any:
        """Return the library's writer."""

    def write(self, columns: Sequence[TableColumn]) -> None:
        """Write some rows."""
        self._tables.append(arrow_table(columns, self._schema))
        if sum(map(len, self._tables)) >= _ROWS or sum(item.nbytes for item in self._tables) >= _BYTES:
            self._flush()

    def close(self) -> None:
        """Write what is left, and the end of the file."""
        self._flush()
        self._writer.close()

    def _flush(self) -> None:
        tables, self._tables = self._tables, []
        if tables:
            self._writer.write_table(pa.concat_tables(tables).combine_chunks())


class _AbandonedQuietly(pyarrow.parquet.ParquetWriter):  # type: ignore[misc]  # the library has no types
    """The library's writer; one that is not closed writes no end into a file that is closed already."""

    def __del__(self) -> None:
        """Do nothing."""


class ParquetWriter(_GroupWriter):
    """Writes Parquet, compressed with zstd."""

    def _open(self, file: IO[bytes]) -> Any:
        texts = [item.name for item in self._schema if item.type == pa.string()]
        return _AbandonedQuietly(file, self._schema, compression="zstd", use_dictionary=texts)


class ArrowWriter(_GroupWriter):
    """Writes an Arrow file that can be mapped into memory: nothing is compressed."""

    def _open(self, file: IO[bytes]) -> Any:
        return pa.ipc.new_file(file, self._schema)
