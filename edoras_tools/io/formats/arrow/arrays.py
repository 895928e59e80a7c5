"""Columns to Arrow, without a copy where it can be."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from edoras_tools.io.formats.columns import TableColumn, TableHead


def arrow_schema(head: TableHead, columns: Sequence[TableColumn]) -> Any:
    """Return the schema of a table: types, units, and what the table is."""
    fields = [
        pa.field(column.name, _array(column).type, metadata={"unit": column.unit} if column.unit else None)
        for column in columns
    ]
    told = {"edoras.topic": head.topic, "edoras.type": head.type, **head.metadata}
    return pa.schema(fields, {name: text.encode() for name, text in told.items()})


def arrow_batch(columns: Sequence[TableColumn], schema: Any = None) -> Any:
    """Return rows as an Arrow record batch; lists are lists, times are timestamps in ns and UTC."""
    names = None if schema else [column.name for column in columns]
    return pa.RecordBatch.from_arrays([_array(column) for column in columns], names, schema=schema)


def arrow_table(batches: Sequence[Any]) -> Any:
    """Return record batches as a table, every column in one piece."""
    return pa.Table.from_batches(batches).combine_chunks()


def _array(column: TableColumn) -> Any:
    values, offsets = column.spread()
    there = None if column.there is None else _bits(column.there)
    if offsets is None:
        return _flat(values, there)
    child = _flat(values, None)
    buffers = [there, pa.py_buffer(offsets.astype(np.int32))]
    return pa.Array.from_buffers(pa.list_(child.type), len(column), buffers, children=[child])


def _flat(values: NDArray[Any], there: Any) -> Any:
    """Return one value a row. ``pa.array`` would import pandas, where it is installed: half a second."""
    kind = values.dtype.kind
    if kind == "O":
        texts = list(map(str.encode, values.tolist()))
        offsets = np.zeros(len(texts) + 1, np.int32)
        np.cumsum(np.fromiter(map(len, texts), np.int32, len(texts)), out=offsets[1:])
        buffers = [there, pa.py_buffer(offsets), pa.py_buffer(b"".join(texts))]
        return pa.Array.from_buffers(pa.string(), len(texts), buffers)
    if kind == "b":
        return pa.Array.from_buffers(pa.bool_(), len(values), [there, _bits(values)])
    said = pa.timestamp("ns", "UTC") if kind == "M" else pa.from_numpy_dtype(values.dtype)
    data = np.ascontiguousarray(values).view(np.int64) if kind == "M" else np.ascontiguousarray(values)
    return pa.Array.from_buffers(said, len(values), [there, pa.py_buffer(data)])


def _bits(values: NDArray[np.bool_]) -> Any:
    return pa.py_buffer(np.packbits(values, bitorder="little"))
