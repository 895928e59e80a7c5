"""Single packets from a source, in order, for people and for JSON; fields of many as text, in bulk."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.decode.filters.rows import FilterField, PacketRows, Series, ValueKind
from edoras_tools.errors import CaptureError
from edoras_tools.pipelines.reading import Limits, selected_rows

if TYPE_CHECKING:
    from edoras_tools.io import Source
    from edoras_tools.model import Decoded
    from edoras_tools.pipelines.selection import Selection
    from edoras_tools.pipelines.workbench import Workbench

    Column = tuple[str, Sequence[FilterField]]
    """A column's title, and its field; several fields if message types or endpoints share the name."""


def column_texts(
    rows: PacketRows, columns: Sequence[Column], clean: Callable[[str], str] = str
) -> list[list[str]]:
    """Return the text of every column for some packets; empty if a packet has no such field.

    A filter can read the text back: enumerations by name, MsgIds in hex, times in seconds. Several values are
    joined by commas.

    Args:
        columns: result of ``decode.where.fields``.
        clean: makes text from packets safe for the output.
    """
    return [_column(rows, fields, clean) for _, fields in columns]


def is_number(column: Column) -> bool:
    """Return whether a column is aligned right."""
    return all(
        field.kind in {ValueKind.NUMBER, ValueKind.DURATION} and not field.many and not field.names
        for field in column[1]
    )


def _column(rows: PacketRows, fields: Sequence[FilterField], clean: Callable[[str], str]) -> list[str]:
    parts: list[list[str]] = []
    for field in (field for field in fields if field.kind is not ValueKind.STRUCT):
        series = field.series(rows)
        texts = texts_of(field, series, clean)
        if series.owner is None:
            parts.append(texts)
            continue
        part = [""] * len(rows)
        for row, text in zip(series.owner.tolist(), texts, strict=True):
            part[row] = f"{part[row]},{text}" if part[row] else text
        parts.append(part)
    if len(parts) == 1:
        return parts[0]
    return [",".join(filter(None, several)) for several in zip(*parts, strict=True)]


def texts_of(field: FilterField, series: Series, clean: Callable[[str], str] = str) -> list[str]:
    """Return the text of every value of a series."""
    values = series.values
    if series.table is not None:
        table = [item.hex() if isinstance(item, bytes) else clean(item) for item in series.table]
        return [table[code] for code in values.tolist()]
    if field.kind is ValueKind.BOOL:
        return ["true" if value else "false" for value in values.tolist()]
    if field.kind is ValueKind.MOMENT:
        times = values.astype("datetime64[ns]")
        return np.datetime_as_string(times, "ns" if (values % 1000).any() else "us").tolist()
    if field.kind is ValueKind.DURATION:
        return [_seconds(value) for value in values.tolist()]
    if values.dtype.kind == "f":
        return (
            values.astype(str).tolist() if values.itemsize < 8 else [repr(value) for value in values.tolist()]
        )
    names = field.names
    if field.base == 16:
        return [names.get(value) or f"0x{value:0{field.digits}x}" for value in values.tolist()]
    return [names.get(value) or str(value) for value in values.tolist()]


def _seconds(time_ns: int) -> str:
    whole, part = divmod(abs(time_ns), 10**9)
    sign = "-" if time_ns < 0 else ""
    return f"{sign}{whole}.{part:09}" if part % 1000 else f"{sign}{whole}.{part // 1000:06}"


AT_ONCE: Final = 8192
"""Largest number of packets that are shown at once."""


def sniff(
    source: Source,
    bench: Workbench,
    selection: Selection,
    limits: Limits = Limits(),  # noqa: B008  frozen
    started: Callable[[int], None] = lambda _: None,
) -> Iterator[Decoded]:
    """Yield the selected packets of a source, decoded; see ``selected_rows``."""
    for rows in selected_rows(source, bench, selection, limits, started, most=AT_ONCE):
        for row in rows.indices().tolist():
            yield bench.dissector.dissect(rows.batch[row])


def decode_packet(source: Source, bench: Workbench, number: int) -> Decoded:
    """Return one packet; everything before it is decoded first, because decoding keeps state.

    Args:
        number: the frame's number, from 1, as ``sniff`` and Wireshark show it.

    Raises:
        CaptureError: there is no such datagram.
    """
    last = 0
    source.follow(bench.columns.context.framings)
    with closing(source):
        for batch in source.batches():
            bench.columns.decode(batch)
            rows = (batch.number == number).nonzero()[0]
            if len(rows):
                return bench.dissector.dissect(batch[int(rows[0])])
            last = int(batch.number[-1]) if len(batch) else last
            if last > number:
                break
    word, unit = ("message", "message") if bench.mission.recorded else ("packet", "datagram")
    problem = (
        "is not a UDP datagram" if number <= last else f"does not exist: the last {unit} is number {last}"
    )
    raise CaptureError(f"{source.info.name}: {word} {number} {problem}")
