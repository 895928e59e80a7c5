"""Tables that are read on demand: record batches for Arrow and DuckDB, lazy frames for polars."""

from __future__ import annotations

from importlib import import_module
from itertools import chain
from typing import TYPE_CHECKING, Any

import pyarrow as pa

from edoras_tools.addons.tables.arrow import arrow_batch, arrow_schema
from edoras_tools.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from edoras_tools.io.formats.columns import TableColumn, TableHead
    from edoras_tools.pipelines.export.reading import TopicTable


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
