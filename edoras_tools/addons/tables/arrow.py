"""Tables as Parquet and Arrow files (Feather version 2), and read on demand, for Arrow, DuckDB and polars."""

from __future__ import annotations

import pickle
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from importlib import import_module
from itertools import chain
from typing import IO, TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from edoras_tools.errors import ConfigError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.io.formats.columns import TableColumn, TableHead
    from edoras_tools.pipelines.export.reading import TopicTable


def arrow_schema(head: TableHead, columns: Sequence[TableColumn]) -> Any:
    """Return the schema of a table: types, units, and the metadata of the table."""
    fields = [
        pa.field(column.name, _array(column).type, metadata={"unit": column.unit} if column.unit else None)
        for column in columns
    ]
    metadata = {"edoras.topic": head.topic, "edoras.type": head.type, **head.metadata}
    return pa.schema(fields, {name: text.encode() for name, text in metadata.items()})


def arrow_batch(columns: Sequence[TableColumn], schema: Any = None) -> Any:
    """Return rows as an Arrow record batch; lists are lists, times are timestamps in ns and UTC."""
    names = None if schema else [column.name for column in columns]
    return pa.RecordBatch.from_arrays([_array(column) for column in columns], names, schema=schema)


def arrow_table(batches: Sequence[Any]) -> Any:
    """Return record batches as a table, every column in one piece."""
    return pa.Table.from_batches(batches).combine_chunks()


def _array(column: TableColumn) -> Any:
    values, offsets = column.spread()
    valid = None if column.present is None else _bits(column.present)
    if offsets is None:
        return _flat(values, valid)
    child = _flat(values, None)
    buffers = [valid, pa.py_buffer(offsets.astype(np.int32))]
    return pa.Array.from_buffers(pa.list_(child.type), len(column), buffers, children=[child])


def _flat(values: NDArray[Any], valid: Any) -> Any:
    """Return one value per row. ``pa.array`` would import pandas, if it is installed: half a second."""
    kind = values.dtype.kind
    if kind == "O":
        texts = list(map(str.encode, values.tolist()))
        offsets = np.zeros(len(texts) + 1, np.int32)
        np.cumsum(np.fromiter(map(len, texts), np.int32, len(texts)), out=offsets[1:])
        buffers = [valid, pa.py_buffer(offsets), pa.py_buffer(b"".join(texts))]
        return pa.Array.from_buffers(pa.string(), len(texts), buffers)
    if kind == "b":
        return pa.Array.from_buffers(pa.bool_(), len(values), [valid, _bits(values)])
    data_type = pa.timestamp("ns", "UTC") if kind == "M" else pa.from_numpy_dtype(values.dtype)
    data = np.ascontiguousarray(values).view(np.int64) if kind == "M" else np.ascontiguousarray(values)
    return pa.Array.from_buffers(data_type, len(values), [valid, pa.py_buffer(data)])


def _bits(values: NDArray[np.bool_]) -> Any:
    return pa.py_buffer(np.packbits(values, bitorder="little"))


def record_batches(head: TableHead, pieces: Iterator[Sequence[TableColumn]]) -> Any:
    """Return a ``pyarrow.RecordBatchReader`` over the pieces of a table, of which the first has no rows."""
    first = next(pieces)
    schema = arrow_schema(head, first)
    batches = (arrow_batch(piece, schema) for piece in chain([first], pieces))
    return pa.RecordBatchReader.from_batches(schema, batches)


def polars_frame(table: TopicTable, *, lazy: bool) -> Any:
    """Return a table as a frame of polars; a lazy one reads the input anew each time it is collected.

    Raises:
        ConfigError: polars is not installed.
    """
    try:
        polars, plugins = import_module("polars"), import_module("polars.io.plugins")
    except ImportError as error:
        raise ConfigError("to_polars() needs polars: pip install polars; to_numpy() does not") from error
    if not lazy:
        return polars.from_arrow(table.to_arrow())

    def read(names: list[str] | None, predicate: Any, rows: int | None, _size: int | None) -> Iterator[Any]:
        with table.to_arrow(lazy=True) as reader:
            for batch in reader:
                frame = polars.from_arrow(batch if names is None else batch.select(names))
                frame = frame if predicate is None else frame.filter(predicate)
                yield frame if rows is None else frame.head(rows)
                rows = rows if rows is None else rows - min(rows, len(frame))
                if rows == 0:
                    return

    def schema() -> Any:
        with table.to_arrow(lazy=True) as reader:
            return polars.from_arrow(reader.schema.empty_table()).schema

    return plugins.register_io_source(read, schema=schema)


_ROWS: Final = 1 << 17
_BYTES: Final = 16 << 20
"""Rows are collected up to one of these limits, because readers are slow with many small groups of rows."""


class _Piece:
    """Some rows; between processes they are sent as one Arrow message, which the receiver copies.

    Args:
        rows: a record batch, or an Arrow message of one, which is read when the rows are written.
        size: size of their values in bytes; 0 to compute it.
    """

    def __init__(self, rows: Any, size: int = 0) -> None:
        self._rows, self.size = rows, size or rows.nbytes

    @property
    def batch(self) -> Any:
        """The rows."""
        if not isinstance(self._rows, bytes):
            return self._rows
        with pa.ipc.open_stream(pa.py_buffer(self._rows)) as reader:
            return reader.read_next_batch()

    def __reduce_ex__(self, _: Any) -> tuple[Any, ...]:
        """Return what pickle needs to make the rows again: a function, and the Arrow message for it."""
        stream = pa.BufferOutputStream()
        with pa.ipc.new_stream(stream, self.batch.schema) as writer:
            writer.write_batch(self.batch)
        return _received, (pickle.PickleBuffer(stream.getvalue()), self.size)


def _received(data: Any, size: int) -> _Piece:
    return _Piece(bytes(data), size)


class _GroupWriter(ABC):
    """Collects rows and writes them in groups; see ``TableWriter``."""

    def __init__(self, file: IO[bytes], head: TableHead, columns: Sequence[TableColumn]) -> None:
        self._schema = arrow_schema(head, columns)
        self._writer = self._open(file)
        self._batches: list[Any] = []
        self._rows = self._bytes = 0

    @abstractmethod
    def _open(self, file: IO[bytes]) -> Any:
        """Return the library's writer of a file."""

    @staticmethod
    def piece(columns: Sequence[TableColumn]) -> _Piece:
        """Return some rows as Arrow arrays."""
        return _Piece(arrow_batch(columns))

    def write(self, piece: _Piece) -> None:
        """Add some rows; write a group when enough are collected."""
        batch = piece.batch
        self._batches.append(pa.RecordBatch.from_arrays(batch.columns, schema=self._schema))
        self._rows += len(batch)
        self._bytes += piece.size
        if self._rows >= _ROWS or self._bytes >= _BYTES:
            self._flush()

    def close(self) -> None:
        """Write the remaining rows, and the end of the file."""
        self._flush()
        self._writer.close()

    def _flush(self) -> None:
        batches, self._batches = self._batches, []
        self._rows = self._bytes = 0
        if batches:
            self._writer.write_table(arrow_table(batches))


class _AbandonedQuietly(pyarrow.parquet.ParquetWriter):  # type: ignore[misc]  # the library has no types
    """The library's writer; if it was not closed, it does not write to its file when it is deleted."""

    def __del__(self) -> None:
        """Do nothing."""


class ParquetWriter(_GroupWriter):
    """Writes Parquet, compressed with zstd."""

    def _open(self, file: IO[bytes]) -> Any:
        texts = [item.name for item in self._schema if item.type == pa.string()]
        return _AbandonedQuietly(file, self._schema, compression="zstd", use_dictionary=texts)


class ArrowWriter(_GroupWriter):
    """Writes an Arrow file that can be memory-mapped: nothing is compressed."""

    def _open(self, file: IO[bytes]) -> Any:
        return pa.ipc.new_file(file, self._schema)
