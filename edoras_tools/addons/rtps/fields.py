"""Filter fields for the subjects of submessages."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from edoras_tools.addons.rtps.link import RTPS
from edoras_tools.addons.rtps.reader import NamedSubmessages, named_submessages
from edoras_tools.addons.rtps.wire.messages import guid_text
from edoras_tools.decode.filters.rows import (
    BYTES_COST,
    INDEX_DTYPE,
    ColumnRows,
    FilterField,
    PacketRows,
    Series,
    ValueKind,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.model import Decoded


def sample_fields() -> Iterator[FilterField]:
    """Yield the filter fields for the subjects of DDS submessages."""
    text, number = ValueKind.TEXT, ValueKind.NUMBER
    for name, kind, column, doc in (
        ("writer", text, _writers, "GUIDs of the writers that submessages are about, or from"),
        ("topic", text, _topics, "topics of these writers, as they were announced"),
        ("writer_sn", number, _numbers, "sequence numbers of samples, and of their fragments"),
    ):
        limits = (-(1 << 63), (1 << 63) - 1) if kind is number else None
        label, pick = f"{RTPS.label}.{name}", partial(_pick, name)
        yield FilterField(label, kind, pick, column, cost=BYTES_COST, limits=limits, many=True, doc=doc)


def _pick(name: str, _: PacketRows, decoded: Decoded) -> Any:
    values = (layer.values() for layer in decoded.layers if decoded.link is RTPS)
    return [item[name] for item in values if name in item] or None


def _submessages(rows: ColumnRows) -> NamedSubmessages:
    def make() -> NamedSubmessages:
        own = np.flatnonzero(rows.column("link") == RTPS)
        table = named_submessages(rows.batch, rows.indices()[own])
        return table._replace(row=own[table.row])

    return rows.once("rtps", make)


def _writers(rows: ColumnRows) -> Series:
    table = _submessages(rows)
    texts = [guid_text(guid) for guid in table.writers]
    return Series(len(rows), table.writer.astype(INDEX_DTYPE), table.row, table=texts)


def _topics(rows: ColumnRows) -> Series:
    table = _submessages(rows)
    endpoints = rows.context.endpoints
    endpoint = map(endpoints.find, table.writers)
    texts = [item.ros_topic if item else "" for item in endpoint]
    announced = rows.datagram("number")[table.row] >= endpoints.since(table.writers)[table.writer]
    return Series(len(rows), table.writer[announced].astype(INDEX_DTYPE), table.row[announced], table=texts)


def _numbers(rows: ColumnRows) -> Series:
    table = _submessages(rows)
    numbered = table.numbered
    return Series(len(rows), table.number[numbered], table.row[numbered])
