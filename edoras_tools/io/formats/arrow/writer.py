"""Tables as Parquet, and as Arrow files (Feather version 2)."""

from __future__ import annotations

import pickle
from abc import ABC, abstractmethod
from typing import IO, TYPE_CHECKING, Any, Final

import pyarrow as pa
import pyarrow.parquet

from edoras_tools.io.formats.arrow.arrays import arrow_batch, arrow_schema, arrow_table

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.io.formats.columns import TableColumn, TableHead

_ROWS: Final = 1 << 17
_BYTES: Final = 16 << 20
"""Rows are collected up to one of these: readers are slow with many small groups of rows."""


class _Piece:
    """Some rows; between processes they are one Arrow message, which is copied where it arrives.

    Args:
        batch: the rows.
        size: bytes of their values; 0: counted here.
    """

    def __init__(self, batch: Any, size: int = 0) -> None:
        self.batch, self.size = batch, size or batch.nbytes

    def __reduce_ex__(self, _: Any) -> tuple[Any, ...]:
        """Return what the rows are made again from."""
        stream = pa.BufferOutputStream()
        with pa.ipc.new_stream(stream, self.batch.schema) as writer:
            writer.write_batch(self.batch)
        return _received, (pickle.PickleBuffer(stream.getvalue()), self.size)


def _received(data: Any, size: int) -> _Piece:
    with pa.ipc.open_stream(pa.py_buffer(bytes(data))) as reader:
        return _Piece(reader.read_next_batch(), size)


class _GroupWriter(ABC):
    """Collects rows, and writes them in groups; see ``TableWriter``."""

    def __init__(self, file: IO[bytes], head: TableHead, columns: Sequence[TableColumn]) -> None:
        self._schema = arrow_schema(head, columns)
        self._writer = self._open(file)
        self._batches: list[Any] = []
        self._rows = self._bytes = 0

    @abstractmethod
    def _open(self, file: IO[bytes]) -> Any:
        """Return the library's writer."""

    @staticmethod
    def piece(columns: Sequence[TableColumn]) -> _Piece:
        """Return some rows as arrays of Arrow."""
        return _Piece(arrow_batch(columns))

    def write(self, piece: _Piece) -> None:
        """Write some rows."""
        self._batches.append(pa.RecordBatch.from_arrays(piece.batch.columns, schema=self._schema))
        self._rows += len(piece.batch)
        self._bytes += piece.size
        if self._rows >= _ROWS or self._bytes >= _BYTES:
            self._flush()

    def close(self) -> None:
        """Write what is left, and the end of the file."""
        self._flush()
        self._writer.close()

    def _flush(self) -> None:
        batches, self._batches = self._batches, []
        self._rows = self._bytes = 0
        if batches:
            self._writer.write_table(arrow_table(batches))


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
