"""What submessages of DDS are about: writers, topics, sequence numbers; a datagram may have several."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.decode.filters.field import BYTES_COST, FilterField
from edoras_tools.decode.filters.series import INDEX_DTYPE, Series, ValueKind
from edoras_tools.links.rtps.link import RTPS
from edoras_tools.links.rtps.reader import NamedSubmessages, named_submessages
from edoras_tools.wire.rtps.messages import guid_text

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from edoras_tools.decode.filters.rows import ColumnRows, PacketRows
    from edoras_tools.model import Decoded

_DOCS: Final = {
    "writer": "GUIDs of the writers that submessages are about, or from",
    "topic": "topics of these writers, as they were announced",
    "writer_sn": "sequence numbers of samples, and of their fragments",
}


def sample_fields() -> Iterator[FilterField]:
    """Yield the fields that hold what submessages of DDS are about."""
    readers: dict[str, Callable[[ColumnRows], Series]] = {
        "writer": _writers,
        "topic": _topics,
        "writer_sn": _numbers,
    }
    for name, doc in _DOCS.items():
        number = name == "writer_sn"
        yield FilterField(
            f"{RTPS.label}.{name}",
            ValueKind.NUMBER if number else ValueKind.TEXT,
            partial(_pick, name),
            readers[name],
            cost=BYTES_COST,
            limits=(-(1 << 63), (1 << 63) - 1) if number else None,
            many=True,
            doc=doc,
        )


def _pick(name: str, _: PacketRows, decoded: Decoded) -> Any:
    values = (layer.values() for layer in decoded.layers if decoded.link is RTPS)
    return [item[name] for item in values if name in item] or None


def _found(rows: ColumnRows) -> NamedSubmessages:
    def make() -> NamedSubmessages:
        own = np.flatnonzero(rows.column("link") == RTPS)
        found = named_submessages(rows.batch, rows.indices()[own])
        return found._replace(row=own[found.row])

    told: NamedSubmessages = rows.once("rtps", make)
    return told


def _writers(rows: ColumnRows) -> Series:
    found = _found(rows)
    texts = [guid_text(guid) for guid in found.writers]
    return Series(len(rows), found.writer.astype(INDEX_DTYPE), found.row, table=texts)


def _topics(rows: ColumnRows) -> Series:
    found = _found(rows)
    endpoints = rows.context.endpoints
    told = map(endpoints.find, found.writers)
    texts = [item.ros_topic if item else "" for item in told]
    known = rows.datagram("number")[found.row] >= endpoints.since(found.writers)[found.writer]
    return Series(len(rows), found.writer[known].astype(INDEX_DTYPE), found.row[known], table=texts)


def _numbers(rows: ColumnRows) -> Series:
    found = _found(rows)
    there = found.numbered
    return Series(len(rows), found.number[there], found.row[there])
