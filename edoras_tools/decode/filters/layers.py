"""The headers as fields: the layouts' own names, read at the offsets that the decoder found."""

from __future__ import annotations

from functools import cache, partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from msgspec.structs import replace

from edoras_tools.cfs.names import MSG_ID_NAMES
from edoras_tools.decode.filters.rows import (
    BYTES_COST,
    COLUMN_COST,
    INDEX_DTYPE,
    ColumnRows,
    FilterField,
    PacketRows,
    Series,
    ValueKind,
)
from edoras_tools.links.sbn import SBN
from edoras_tools.model import NO_MSG_ID, NO_ROUTE, Decoded, Finding
from edoras_tools.wire import ccsds, cfe, sbn
from edoras_tools.wire.arrays import gather
from edoras_tools.wire.envelope import DEFAULT, ENCAPSULATION

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from edoras_tools.decode.context import Context
    from edoras_tools.links.protocol import LinkProtocol
    from edoras_tools.wire.arrays import Integers, Mask, Octets
    from edoras_tools.wire.ccsds import MsgIds
    from edoras_tools.wire.layout import Layout, Slot

    Places = tuple[Integers, Integers]
    """Rows that have a header, and its start in the batch's data."""


_DECODED: Final = {
    "sbn.msg_type": ("sbn_msg_type", -1),
    "ccsds.msg_id": ("msg_id", NO_MSG_ID),
    "cfe_command.function_code": ("function_code", -1),
}
"""Fields that are columns: the column, and its value for an absent field."""

_FOUND_BY: Final = {"command": "function_code", "telemetry": "mission_time_ns"}
"""Column that is -1 if a packet does not have this header."""


def layer_fields(context: Context) -> Iterator[FilterField]:
    """Yield every header and every field of it that the tree can show."""
    for link in context.links:
        yield from _of_link(link.places, link)
    yield from _of_packets()
    for link in context.links:
        yield from link.fields()
    yield from _others(context.msg_ids)


@cache
def _of_link(_key: object, link: LinkProtocol) -> list[FilterField]:
    """Return the fields of a link's own headers; the key distinguishes links with equal numbers."""
    return [
        field
        for layout in link.layouts
        for field in _header(layout, partial(link.places, layout), by_field=True, many=link.samples)
    ]


@cache
def _of_packets() -> list[FilterField]:
    return [*_packet_headers()]


def _packet_headers() -> Iterator[FilterField]:
    yield from _header(ccsds.PRIMARY, _primary)
    yield from _header(cfe.EXTENDED, _extended)
    # Of each header the build with the most fields; the actual build is known when packets are read.
    yield from _header(cfe.COMMAND_EXTENDED, partial(_secondary, "command"), by_field=True)
    yield from _header(cfe.TELEMETRY, partial(_secondary, "telemetry"), by_field=True)
    yield from _header(cfe.EVENT, partial(_housekeeping, cfe.EVENT, cfe.EVENT_MSG_ID))
    yield from _header(
        cfe.SOFTWARE_BUS_HOUSEKEEPING,
        partial(_housekeeping, cfe.SOFTWARE_BUS_HOUSEKEEPING, cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID),
    )
    yield from map(_of_any_format, _header(DEFAULT.layout, None))
    yield from _header(ENCAPSULATION, _encapsulation)


def _others(msg_ids: MsgIds) -> Iterator[FilterField]:
    """Yield fields that are in no layout."""
    words = {name.lower(): msg_ids.of_known(value) for value, name in MSG_ID_NAMES.items()}
    yield FilterField(
        "ccsds.msg_id",
        ValueKind.NUMBER,
        _picker("ccsds", "msg_id"),
        partial(_decoded, *_DECODED["ccsds.msg_id"]),
        limits=(0, 0xFFFF),
        base=16,
        digits=4,
        words=words,
        doc=f"cFE's key: {msg_ids.made_of}",
    )
    yield FilterField(
        "sbn_sub.msg_ids",
        ValueKind.NUMBER,
        _picker("sbn_sub", "msg_ids"),
        scope=lambda rows: _presence(partial(SBN.places, sbn.SUBSCRIPTIONS), rows),
        limits=(0, 0xFFFFFFFF),
        base=16,
        digits=4,
        many=True,
        doc="the MsgIds wanted, or no longer wanted",
    )
    yield _struct("padding", lambda rows: _padding(rows)[0])
    yield FilterField(
        "padding.length",
        ValueKind.NUMBER,
        _picker("padding", "length"),
        lambda rows: Series.of_chosen(_padding(rows)[1], _padding(rows)[0]),
        doc="bytes after the CDR",
    )
    yield FilterField(
        "padding.stale",
        ValueKind.BOOL,
        _picker("padding", "stale"),
        lambda rows: Series.of_chosen(
            (rows.column("findings") & np.uint32(Finding.STALE_TAIL)) != 0, _padding(rows)[0]
        ),
        dtype=np.dtype(bool),
        doc="they are of an earlier, longer message",
    )


def _header(
    layout: Layout, places: Callable[..., Places] | None, *, by_field: bool = False, many: bool = False
) -> Iterator[FilterField]:
    """Yield a header and its fields.

    Args:
        places: returns the places of the headers of many packets; None if each packet must be dissected.
        by_field: whether ``places`` takes the name of the ``field``, because some headers do not have the
            last fields.
        many: whether a packet may have several of them.
    """
    name = layout.name

    yield _struct(name, partial(_presence, places) if places is not None else None)
    for slot in layout.slots:
        of_field = partial(places, field=slot.field.name) if places and by_field else places
        field = _field(layout, slot, of_field)
        yield replace(field, pick=_each(name, slot.field.name), many=True) if many else field


def _presence(places: Callable[[ColumnRows], Places], rows: ColumnRows) -> Mask:
    """Return which packets have a header."""
    out = np.zeros(len(rows), bool)
    out[places(rows)[0]] = True
    return out


def _struct(name: str, presence: Callable[[ColumnRows], Mask] | None) -> FilterField:
    return FilterField(
        name,
        ValueKind.STRUCT,
        lambda _, decoded: 0 if decoded.layer(name) else None,
        presence and (lambda rows: Series.of_chosen(np.zeros(len(rows), INDEX_DTYPE), presence(rows))),
        cost=BYTES_COST,
        doc="whether there is this layer",
    )


def _field(layout: Layout, slot: Slot, places: Callable[[ColumnRows], Places] | None) -> FilterField:
    item, path = slot.field, f"{layout.name}.{slot.field.name}"
    read: Callable[[ColumnRows], Series] | None
    if path in _DECODED:
        read, cost = partial(_decoded, *_DECODED[path]), COLUMN_COST
    else:
        read, cost = (partial(_gathered, layout, slot, places), BYTES_COST) if places else (None, BYTES_COST)
    kind = {"text": ValueKind.TEXT, "bytes": ValueKind.BYTES}.get(item.kind, ValueKind.NUMBER)
    real = item.kind == "float"
    low, high = (-(slot.mask >> 1) - 1, slot.mask >> 1) if item.kind == "int" else (0, slot.mask)
    return FilterField(
        path,
        kind,
        _picker(layout.name, item.name),
        read,
        cost=cost,
        dtype=np.dtype(f"f{slot.end - slot.start}" if real else np.uint64 if high > 1 << 62 else np.int64),
        limits=(low, high) if kind is ValueKind.NUMBER and not real else None,
        base=item.base,
        digits=(item.bits + 3) // 4,
        names=item.names,
        doc=item.doc,
    )


def _picker(layer: str, name: str) -> Callable[[PacketRows, Decoded], Any]:
    def pick(_: PacketRows, decoded: Decoded) -> Any:
        part = decoded.layer(layer)
        return part.values().get(name) if part else None

    return pick


def _each(layer: str, name: str) -> Callable[[PacketRows, Decoded], Any]:
    def pick(_: PacketRows, decoded: Decoded) -> Any:
        return [item.values()[name] for item in decoded.layers if item.name == layer] or None

    return pick


def _decoded(column: str, none: int, rows: ColumnRows) -> Series:
    values = rows.column(column)
    return Series.of_chosen(values, values != none)


_OWN_ORDER: Final = (cfe.EVENT, cfe.SOFTWARE_BUS_HOUSEKEEPING, cfe.TELEMETRY)
"""Layouts that the flight computer writes in its own byte order."""


def _gathered(layout: Layout, slot: Slot, places: Callable[[ColumnRows], Places], rows: ColumnRows) -> Series:
    """Read one field of the headers in a batch."""
    owner, start = places(rows)
    layout = rows.context.in_order(layout) if layout in _OWN_ORDER else layout
    values = slot_values(layout, slot, gather(rows.batch.data, start + slot.start, slot.end - slot.start))
    if isinstance(values, list):
        return Series.of_objects(len(rows), values, owner)
    return Series(len(rows), values, None if len(owner) == len(rows) else owner)


def slot_values(layout: Layout, slot: Slot, window: Octets) -> NDArray[Any] | list[Any]:
    """Return one field of many headers: numbers, or a list of str or bytes.

    Args:
        window: bytes of the field, u8 (n, width of the slot).
    """
    if slot.field.kind not in {"text", "bytes"}:
        return layout.column(slot.field.name, window, -slot.start)
    raw, size = window.tobytes(), window.shape[1]
    items = [raw[at : at + size] for at in range(0, len(raw), size)]
    if slot.field.kind == "bytes":
        return items
    texts = {one: one.split(b"\0", 1)[0].decode("utf-8", "replace") for one in set(items)}
    return [texts[one] for one in items]


def _of_any_format(field: FilterField) -> FilterField:
    """Return a field of the envelope that is read in the format that the routes have at that time."""

    def read(rows: ColumnRows) -> Series:
        formats = set(rows.context.envelopes) or {DEFAULT}
        name = field.name.rpartition(".")[2]
        if None in formats or len(formats) > 1:
            return field.series(rows)
        envelope = formats.pop() or DEFAULT
        if field.kind is not ValueKind.STRUCT and name not in envelope.layout.by_name:
            return Series.of_chosen(np.zeros(len(rows), np.uint64), np.zeros(len(rows), bool))
        places = partial(_envelopes, envelope.size)
        if field.kind is ValueKind.STRUCT:
            present = np.zeros(len(rows), bool)
            present[places(rows)[0]] = True
            return Series.of_chosen(np.zeros(len(rows), INDEX_DTYPE), present)
        return _gathered(envelope.layout, envelope.layout.by_name[name], places, rows)

    return replace(field, read=read)


def _primary(rows: ColumnRows) -> Places:
    start = rows.column("packet_offset")
    owner = np.flatnonzero(start >= 0)
    return owner, start[owner]


def _secondary(kind: str, rows: ColumnRows, field: str | None = None) -> Places:
    """Return the places of ``command`` or ``telemetry`` headers, or of those that have a field."""
    has = [field is None or field in getattr(item, kind).by_name for item in cfe.HEADERS]
    headers = rows.column("headers")
    owner = np.flatnonzero((rows.column(_FOUND_BY[kind]) >= 0) & np.array(has)[headers])
    start = np.array([item.start for item in cfe.HEADERS])
    return owner, rows.column("packet_offset")[owner] + start[headers[owner]]


def _extended(rows: ColumnRows) -> Places:
    extended = np.array([item.extended for item in cfe.HEADERS])[rows.column("headers")]
    owner = np.flatnonzero(extended & (rows.column("packet_length") >= cfe.WITH_EXTENDED.start))
    return owner, rows.column("packet_offset")[owner] + ccsds.PRIMARY.size


def _body(rows: ColumnRows) -> tuple[Mask, Integers, Integers]:
    """Return which packets have a whole cFE header, the start of the bytes after it, and their number."""
    whole = (rows.column("function_code") >= 0) | (rows.column("mission_time_ns") >= 0)
    header = rows.column("header_length")
    return whole, rows.column("packet_offset") + header, rows.column("packet_length") - header


def _housekeeping(layout: Layout, msg_id: int, rows: ColumnRows) -> Places:
    whole, start, size = _body(rows)
    own = rows.column("msg_id") == rows.context.msg_ids.of_known(msg_id)
    owner = np.flatnonzero(whole & own & (size >= layout.size))
    owner = owner[rows.routes()[owner] == NO_ROUTE]
    return owner, start[owner]


def _envelopes(size: int, rows: ColumnRows) -> Places:
    whole, start, have = _body(rows)
    owner = np.flatnonzero(whole & (rows.routes() != NO_ROUTE) & (have >= size))
    return owner, start[owner]


def _encapsulation(rows: ColumnRows) -> Places:
    start = rows.column("cdr_offset")
    owner = np.flatnonzero(start >= 0)
    return owner, start[owner]


def _padding(rows: ColumnRows) -> tuple[Mask, Integers]:
    """Return which packets have bytes after the CDR, and the number of these bytes."""
    end = rows.column("packet_offset") + rows.column("packet_length")
    length = end - rows.column("cdr_offset") - rows.column("cdr_length")
    return (rows.column("cdr_offset") >= 0) & (length > 0), length
