"""The headers as fields: the layouts' own names, read from where the decoder found each header."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.decode.where_field import BYTES, COLUMN, Field
from edoras_tools.decode.where_series import INDEX, Kind, Series
from edoras_tools.model import NO_MSG_ID, NO_ROUTE, Finding
from edoras_tools.wire import ccsds, cfe, sbn
from edoras_tools.wire.cdr import ENCAPSULATION
from edoras_tools.wire.envelope import DEFAULT
from edoras_tools.wire.names import MSG_ID_NAMES
from edoras_tools.wire.window import gather

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from edoras_tools.decode.context import Context
    from edoras_tools.decode.where_rows import ColumnRows, Rows
    from edoras_tools.model import Decoded
    from edoras_tools.wire.layout import Layout, Slot

    Places = tuple[NDArray[np.int64], NDArray[np.int64]]
    """Which rows have a header, and where in the batch's data it starts."""

_DECODED: Final = {
    "sbn.msg_type": ("sbn_msg_type", -1),
    "ccsds.msg_id": ("msg_id", NO_MSG_ID),
    "cfe_command.function_code": ("function_code", -1),
}
"""Fields that are columns already: which one, and what stands there for none."""


def layer_fields(context: Context) -> Iterator[Field]:
    """Yield every header and every field of it that the tree can show."""
    options = context.options
    after = ccsds.PRIMARY.size + (cfe.EXTENDED.size if options.extended_header else 0)
    telemetry = cfe.TELEMETRY_SHORT if options.telemetry_header == 12 else cfe.TELEMETRY
    formats = set(context.envelopes) or {DEFAULT}
    envelope = next(iter(formats)) if len(formats) == 1 else None
    yield from _header(sbn.HEADER, _network)
    yield from _header(sbn.SUBSCRIPTIONS, _subscriptions)
    yield from _header(sbn.PROTO, _proto)
    yield from _header(ccsds.PRIMARY, partial(_behind, "packet_offset", 0))
    yield from _header(cfe.EXTENDED, _extended)
    yield from _header(cfe.COMMAND, partial(_behind, "function_code", after))
    yield from _header(telemetry, partial(_behind, "mission_time_ns", after))
    yield from _header(cfe.EVENT, partial(_housekeeping, cfe.EVENT, cfe.EVENT_MSG_ID))
    yield from _header(
        cfe.SOFTWARE_BUS_HOUSEKEEPING,
        partial(_housekeeping, cfe.SOFTWARE_BUS_HOUSEKEEPING, cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID),
    )
    yield from _header((envelope or DEFAULT).layout, partial(_envelopes, envelope.size) if envelope else None)
    yield from _header(ENCAPSULATION, _encapsulation)
    yield from _others()


def _others() -> Iterator[Field]:
    """Yield what no layout holds."""
    words = {name.lower(): value for value, name in MSG_ID_NAMES.items()}
    yield Field(
        "ccsds.msg_id",
        Kind.NUMBER,
        _picker("ccsds", "msg_id"),
        partial(_decoded, *_DECODED["ccsds.msg_id"]),
        limits=(0, 0xFFFF),
        base=16,
        digits=4,
        words=words,
        doc="cFE's key: the first word",
    )
    yield Field(
        "sbn_sub.msg_ids",
        Kind.NUMBER,
        _picker("sbn_sub", "msg_ids"),
        scope=lambda rows: _subscribing(rows)[0],
        limits=(0, 0xFFFFFFFF),
        base=16,
        digits=4,
        many=True,
        doc="the MsgIds wanted, or no longer wanted",
    )
    yield _struct("padding", lambda rows: _padding(rows)[0])
    yield Field(
        "padding.length",
        Kind.NUMBER,
        _picker("padding", "length"),
        lambda rows: Series.of_chosen(_padding(rows)[1], _padding(rows)[0]),
        doc="bytes after the CDR",
    )
    yield Field(
        "padding.stale",
        Kind.BOOL,
        _picker("padding", "stale"),
        lambda rows: Series.of_chosen(
            (rows.column("findings") & np.uint32(Finding.STALE_TAIL)) != 0, _padding(rows)[0]
        ),
        dtype=np.dtype(bool),
        doc="they are of an earlier, longer message",
    )


def _header(layout: Layout, places: Callable[[ColumnRows], Places] | None) -> Iterator[Field]:
    """Yield a header and its fields.

    Args:
        layout: the table.
        places: finds the headers of many packets; None where each packet is to be asked.
    """
    name = layout.name

    def there(rows: ColumnRows) -> NDArray[np.bool_]:
        out = np.zeros(len(rows), bool)
        if places is not None:
            out[places(rows)[0]] = True
        return out

    yield _struct(name, there if places is not None else None)
    for slot in layout.slots:
        yield _field(layout, slot, places)


def _struct(name: str, there: Callable[[ColumnRows], NDArray[np.bool_]] | None) -> Field:
    return Field(
        name,
        Kind.STRUCT,
        lambda _, decoded: 0 if decoded.layer(name) else None,
        there and (lambda rows: Series.of_chosen(np.zeros(len(rows), INDEX), there(rows))),
        cost=BYTES,
        doc="whether there is this layer",
    )


def _field(layout: Layout, slot: Slot, places: Callable[[ColumnRows], Places] | None) -> Field:
    item, path = slot.field, f"{layout.name}.{slot.field.name}"
    read: Callable[[ColumnRows], Series] | None
    if path in _DECODED:
        read, cost = partial(_decoded, *_DECODED[path]), COLUMN
    else:
        read, cost = (partial(_gathered, layout, slot, places), BYTES) if places else (None, BYTES)
    kind = {"text": Kind.TEXT, "bytes": Kind.BYTES}.get(item.kind, Kind.NUMBER)
    low, high = (-(slot.mask >> 1) - 1, slot.mask >> 1) if item.kind == "int" else (0, slot.mask)
    return Field(
        path,
        kind,
        _picker(layout.name, item.name),
        read,
        cost=cost,
        dtype=np.dtype(np.uint64 if high > 1 << 62 else np.int64),
        limits=(low, high) if kind is Kind.NUMBER else None,
        base=item.base,
        digits=(item.bits + 3) // 4,
        names=item.names,
        doc=item.doc,
    )


def _picker(layer: str, name: str) -> Callable[[Rows, Decoded], Any]:
    def pick(_: Rows, decoded: Decoded) -> Any:
        found = decoded.layer(layer)
        return found.values().get(name) if found else None

    return pick


def _decoded(column: str, none: int, rows: ColumnRows) -> Series:
    values = rows.column(column)
    return Series.of_chosen(values, values != none)


def _gathered(layout: Layout, slot: Slot, places: Callable[[ColumnRows], Places], rows: ColumnRows) -> Series:
    """Read one field of the headers that a batch holds."""
    owner, start = places(rows)
    item = slot.field
    if layout is sbn.HEADER and item.name == "spacecraft_id":
        current = ~_legacy(rows)[owner]
        owner, start = owner[current], start[current]
    window = gather(rows.batch.data, start + slot.start, slot.end - slot.start)
    if item.kind in {"text", "bytes"}:
        raw = window.tobytes()
        size = slot.end - slot.start
        items = [raw[at : at + size] for at in range(0, len(raw), size)]
        if item.kind == "text":
            known = {one: one.split(b"\0", 1)[0].decode("utf-8", "replace") for one in set(items)}
            return Series.of_objects(len(rows), [known[one] for one in items], owner)
        return Series.of_objects(len(rows), items, owner)
    values = layout.column(item.name, window, -slot.start)
    return Series(len(rows), values, None if len(owner) == len(rows) else owner)


def _behind(column: str, at: int, rows: ColumnRows) -> Places:
    """Find headers at a fixed place in the space packet; the column is -1 where there is none."""
    owner = np.flatnonzero(rows.column(column) >= 0)
    return owner, rows.column("packet_offset")[owner] + at


def _network(rows: ColumnRows) -> Places:
    owner = np.flatnonzero(rows.column("sbn_msg_type") >= 0)
    return owner, rows.datagram("offset")[owner]


def _legacy(rows: ColumnRows) -> NDArray[np.bool_]:
    """Tell which SBN headers are the older, shorter ones: the decoder took no SpacecraftID from them."""
    offset, found = rows.datagram("offset"), rows.column("spacecraft_id")
    slot = sbn.HEADER.by_name["spacecraft_id"]
    window = gather(rows.batch.data, offset + slot.start, slot.end - slot.start)
    short = rows.datagram("length") < sbn.HEADER.size
    short |= rows.column("packet_offset") == offset + sbn.LEGACY_HEADER.size
    legacy: NDArray[np.bool_] = short | (sbn.HEADER.column("spacecraft_id", window, -slot.start) != found)
    return legacy


def _payload(rows: ColumnRows) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return where the payload of an SBN message starts, from the start of the datagram, and its bytes."""
    at = np.where(_legacy(rows), sbn.LEGACY_HEADER.size, sbn.HEADER.size)
    return at, rows.datagram("length") - at


def _subscribing(rows: ColumnRows) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    kind = rows.column("sbn_msg_type")
    at, size = _payload(rows)
    listed = (kind == sbn.MsgType.SUB) | (kind == sbn.MsgType.UNSUB)
    return listed & (size >= sbn.SUBSCRIPTIONS.size), at


def _subscriptions(rows: ColumnRows) -> Places:
    there, at = _subscribing(rows)
    owner = np.flatnonzero(there)
    return owner, (rows.datagram("offset") + at)[owner]


def _proto(rows: ColumnRows) -> Places:
    at, size = _payload(rows)
    owner = np.flatnonzero((rows.column("sbn_msg_type") == sbn.MsgType.PROTO) & (size >= sbn.PROTO.size))
    return owner, (rows.datagram("offset") + at)[owner]


def _extended(rows: ColumnRows) -> Places:
    if not rows.context.options.extended_header:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    owner = np.flatnonzero(rows.column("packet_length") >= ccsds.PRIMARY.size + cfe.EXTENDED.size)
    return owner, rows.column("packet_offset")[owner] + ccsds.PRIMARY.size


def _body(rows: ColumnRows) -> tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.int64]]:
    """Return which packets have a whole cFE header, where what follows it starts, and its bytes."""
    whole = (rows.column("function_code") >= 0) | (rows.column("mission_time_ns") >= 0)
    header = rows.column("header_length")
    return whole, rows.column("packet_offset") + header, rows.column("packet_length") - header


def _housekeeping(layout: Layout, msg_id: int, rows: ColumnRows) -> Places:
    whole, start, size = _body(rows)
    owner = np.flatnonzero(whole & (rows.column("msg_id") == msg_id) & (size >= layout.size))
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


def _padding(rows: ColumnRows) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Return which packets have bytes after the CDR, and how many."""
    end = rows.column("packet_offset") + rows.column("packet_length")
    length = end - rows.column("cdr_offset") - rows.column("cdr_length")
    return (rows.column("cdr_offset") >= 0) & (length > 0), length
