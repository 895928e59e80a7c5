"""Headers, decoded ROS messages and C structs as fields, found by their path.

Headers have the layouts' own names, read at the offsets that the decoder found. Rules of messages:

1. A path is names with dots, each with an index or none: ``poses[-1].position.x``. Without an index a list
   gives all of its values; an index that is outside a message's list gives none.
2. One path may be a field of several types: each type has a ``FilterField`` of its own, and a packet has a
   value if its own type has the field.
3. A field has two readers: ``pick`` for one decoded packet, ``read`` for the columns of many. Both give the
   same values; ``tests/decode/filters/test_agreement.py`` checks that.
4. ``read`` is None if columns are not enough (an index inside a list of lists): those packets are decoded
   one by one.
5. The messages of a type are read once for each batch, even if a filter names many of their fields.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from copy import copy
from functools import cache, partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from msgspec.structs import replace

from edoras_tools.cfs.arguments import SERVICES
from edoras_tools.cfs.names import MSG_ID_NAMES
from edoras_tools.decode.filters.rows import (
    BYTES_COST,
    COLUMN_COST,
    INDEX_DTYPE,
    MESSAGE_COST,
    ColumnRows,
    FilterField,
    PacketRows,
    Series,
    ValueKind,
)
from edoras_tools.links.sbn import SBN
from edoras_tools.links.table import among
from edoras_tools.model import NO_MSG_ID, NO_ROUTE, Decoded, Finding
from edoras_tools.ros import library
from edoras_tools.ros.cdr.bulk import MessageColumns, Ragged
from edoras_tools.structs.bindings import Bound, Encoded, Held, payloads
from edoras_tools.structs.messages import INLINED, aliased, field_name
from edoras_tools.structs.shapes import PACKETS, UDP_KEY
from edoras_tools.wire import ccsds, cfe, sbn
from edoras_tools.wire.arrays import Integers, Mask, Octets, by_key, gather
from edoras_tools.wire.envelope import DEFAULT, ENCAPSULATION

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.decode.context import Context
    from edoras_tools.links.doors import KnownSamples
    from edoras_tools.links.protocol import LinkProtocol
    from edoras_tools.wire.ccsds import MsgIds
    from edoras_tools.wire.layout import Layout, Slot

    Places = tuple[Integers, Integers]
    """Rows that have a header, and its start in the batch's data."""

    Owned = tuple[Integers, MessageColumns]
    """Rows that hold messages, and the messages."""


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
    yield from _header(ccsds.PRIMARY, partial(_starts, "packet_offset"))
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
    yield from _header(ENCAPSULATION, partial(_starts, "cdr_offset"))


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
            return Series.of_chosen(np.zeros(len(rows), INDEX_DTYPE), _presence(places, rows))
        return _gathered(envelope.layout, envelope.layout.by_name[name], places, rows)

    return replace(field, read=read)


def _starts(name: str, rows: ColumnRows) -> Places:
    """Return which packets have a place in a column, and the places."""
    start = rows.column(name)
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


def _padding(rows: ColumnRows) -> tuple[Mask, Integers]:
    """Return which packets have bytes after the CDR, and the number of these bytes."""
    end = rows.column("packet_offset") + rows.column("packet_length")
    length = end - rows.column("cdr_offset") - rows.column("cdr_length")
    return (rows.column("cdr_offset") >= 0) & (length > 0), length


_PART: Final = re.compile(r"(\w+)(?:\[(-?\d+)\])?")
_DOT: Final = re.compile(r"\.")
_PREFIX: Final = "ros."


class _Step(NamedTuple):
    """One part of a path: the field, and the index of an element, None for all."""

    field: library.MessageField
    element: int | None

    @property
    def listed(self) -> bool:
        """Whether the field holds several values."""
        return self.field.shape is not library.Shape.SCALAR


class MessageFieldFinder:
    """Finds fields of messages by their path.

    Args:
        context: decoder context with the routes, the types and the C structs.
    """

    def __init__(self, context: Context) -> None:
        self._context = context
        self._routes: dict[str, list[int]] = {}
        self._first: Collection[str] = ()
        self._definitions: dict[str, library.Definition] = dict(context.structs.definitions)
        self._own = frozenset(self._definitions)
        self._structs = by_key(context.structs.all, lambda bound: bound.name)
        commands = (bound for bound in context.structs.all if bound.command)
        standard = context.msg_ids.standard
        services = by_key(commands, lambda bound: SERVICES[standard(bound.key.msg_id)][0])
        self._services = {name: bounds for name, bounds in services.items() if name not in self._structs}
        for index, route in enumerate(context.mission.routes):
            self._add(route.type, index)

    def _add(self, name: str, *routes: int) -> None:
        """Add the fields of a type, if it is known."""
        types = self._context.types
        if types is None or not types.has(name):
            return
        sections = () if name in self._routes else library.sections(name, types.definition(name))
        self._routes.setdefault(name, []).extend(routes)
        for part in sections:
            self._definitions[part.name] = library.parse_definition(
                part.name, part.text, part.name, part.line
            )

    def look_ahead(self) -> None:
        """Add the types of the DDS topics that the input announces."""
        for name in self._context.announced_topics().values():
            self._add(name)

    def __bool__(self) -> bool:
        return bool(self._routes)

    def of_types(self, types: Iterable[str]) -> MessageFieldFinder:
        """Return a finder that tries some types first, and the others only if none of these has the field."""
        other = copy(self)
        other._first = self._routes.keys() & types  # noqa: SLF001  of its own kind
        return other

    def find(self, path: str) -> list[FilterField]:
        """Return the fields with that path, one for each type of a route that has it."""
        path_steps = _split(path.removeprefix(_PREFIX))
        for names in (self._first, self._routes):
            fields = [
                self._field(path, name, tuple(self._routes[name]), steps)
                for name in names
                if (steps := self._steps(name, path_steps))
            ]
            if fields:
                break
        return fields

    def of_structs(self, path: str) -> list[FilterField]:
        """Return the fields with a path, one for each C struct that has it or that the path begins with."""
        path = path.removeprefix(_PREFIX)
        # The names of a dictionary have dots, too.
        names = [path, *(path[: match.start()] for match in reversed(list(_DOT.finditer(path))))]
        groups = self._structs | self._services
        name = next((name for name in names if name in groups), None)
        if name is not None:
            rest = path[len(name) + 1 :]
            fields = [self._of_struct(path, rest, bound) for bound in groups[name]]
        else:
            every = [bound for bounds in self._structs.values() for bound in bounds]
            fields = [self._of_struct(path, path, bound) for bound in every if not _is_layer(bound)]
        return [field for field in fields if field is not None]

    def _of_struct(self, path: str, inside: str, bound: Bound) -> FilterField | None:
        """Return the field of a path inside a C struct, if it has one; the struct for an empty path."""
        if not inside:
            return FilterField(
                path,
                ValueKind.STRUCT,
                lambda _, decoded: (
                    0 if any(message.topic == bound.topic for message in decoded.messages) else None
                ),
                partial(_read_struct, bound),
                cost=MESSAGE_COST,
                doc=f"whether there is a {bound.name}",
            )
        steps = self._steps(bound.type, _split(inside))
        if not steps:
            return None
        member = bound.member([step.field.name for step in steps])
        field = self._field(path, bound.type, (), steps, bound)
        return replace(
            field,
            names=bound.values(member) if member else {},
            base=member.base if member else 10,
            digits=2 * field.dtype.itemsize,
            doc=(member and member.doc) or f"of {bound.name}",
        )

    def inside(self, path: str) -> list[str]:
        """Return the names of the fields in a group of fields."""
        plain = re.sub(r"\[-?\d+\]", "", path.removeprefix(_PREFIX))
        return sorted({name for name in self.names() if name.startswith(f"{plain}.")})

    def names(self) -> Iterator[str]:
        """Yield the path of every single value, without indices."""
        for name in self._routes:
            yield from self._leaves(library.full_name(name), "")
        for name, bounds in self._structs.items():
            yield from self._leaves(bounds[0].type, f"{name}.")
        for name, bounds in self._services.items():
            inside = dict.fromkeys(path for bound in bounds for path in self._leaves(bound.type, f"{name}."))
            yield from (path for path in inside if not path.startswith(f"{name}.header."))

    def _leaves(self, name: str, prefix: str) -> Iterator[str]:
        for item in self._definitions[name].fields:
            path = prefix + item.name
            if item.type in self._definitions:
                yield from self._leaves(item.type, f"{path}.")
            else:
                yield path

    def _steps(self, name: str, path: Sequence[tuple[str, int | None]]) -> list[_Step]:
        """Return the steps of a path inside a type; empty if there is no such field."""
        steps: list[_Step] = []
        definition: library.Definition | None = self._definitions[library.full_name(name)]
        for part, index in path:
            fields = definition.fields if definition else ()
            item = next((item for item in fields if item.name == part), None)
            if item is None and definition and definition.name in self._own:
                if part == field_name(INLINED) and not steps:
                    continue
                item = next((item for item in fields if item.name in aliased(part)), None)
            if item is None or (index is not None and item.shape is library.Shape.SCALAR):
                return []
            steps.append(_Step(item, index))
            definition = self._definitions.get(item.type)
        return steps

    def _field(
        self, path: str, name: str, routes: tuple[int, ...], steps: list[_Step], bound: Bound | None = None
    ) -> FilterField:
        messages = partial(_messages, name, routes) if bound is None else partial(held_messages, bound)
        scope = partial(_may_hold, routes) if bound is None else partial(_holds, bound)
        last = steps[-1].field.type
        dtype = np.dtype(library.PRIMITIVES.get(last, "q"))
        kind = ValueKind.BOOL if dtype.kind == "b" else ValueKind.NUMBER
        if last in self._definitions:
            kind = ValueKind.STRUCT
        elif last in library.STRINGS:
            kind = ValueKind.TEXT
        limits = (int(np.iinfo(dtype).min), int(np.iinfo(dtype).max)) if dtype.kind in "iu" else None
        return FilterField(
            path,
            kind,
            partial(_pick, name if bound is None else bound.topic, steps),
            self._reader(messages, steps),
            scope=scope,
            cost=MESSAGE_COST,
            dtype=dtype,
            limits=limits if kind is ValueKind.NUMBER else None,
            many=any(step.listed and step.element is None for step in steps),
            doc=f"of {name}",
        )

    def _reader(
        self, messages: Callable[[ColumnRows], Owned], steps: list[_Step]
    ) -> Callable[[ColumnRows], Series] | None:
        """Return the reader of a field of many messages; None if columns are not enough."""
        indices = [step.element for step in steps if step.listed]
        path = ".".join(step.field.name for step in steps)
        if steps[-1].field.type in self._definitions:
            if not indices:
                return partial(_read_whole, messages)
            single = self._single(steps[-1].field.type)
            if not single:
                return None
            path = f"{path}.{single}"
        if len(indices) > 1 and any(index is not None for index in indices):
            return None
        return partial(field_series, messages, path, indices[0] if indices else None)

    def _single(self, name: str) -> str:
        """Return the path of a value that each message of a type has exactly once; empty if there is none."""
        for item in self._definitions[name].fields:
            if item.shape is not library.Shape.SCALAR:
                continue
            if item.type not in self._definitions:
                return item.name
            inner = self._single(item.type)
            if inner:
                return f"{item.name}.{inner}"
        return ""


_LAYERS: Final = {PACKETS[item] for item in cfe.PAYLOADS}
"""Structs whose fields are the fields of a layer, too."""


def _is_layer(bound: Bound) -> bool:
    """Return whether a struct's fields are found as the fields of a layer."""
    return bound.shipped and (bound.struct.name in _LAYERS or bound.key.msg_id == UDP_KEY)


def _split(path: str) -> list[tuple[str, int | None]]:
    return [(match[1], None if match[2] is None else int(match[2])) for match in _PART.finditer(path)]


def _pick(name: str, steps: Sequence[_Step], _: PacketRows, decoded: Decoded) -> Any:
    items: list[Any] = [
        message.values for message in decoded.messages if name in {message.type, message.topic}
    ]
    if not items:
        return None
    many = len(items) > 1
    for field, index in steps:
        items = [item[field.name] for item in items]
        if field.shape is library.Shape.SCALAR:
            continue
        if index is None:
            items = [value for item in items for value in item]
            many = True
        else:
            items = [item[index] for item in items if -len(item) <= index < len(item)]
    return items if many else items[0] if items else None


def _messages(name: str, routes: tuple[int, ...], rows: ColumnRows) -> Owned:
    """Return the rows that carry messages of a type, and the messages."""

    def make() -> Owned:
        owner = np.flatnonzero(np.isin(rows.routes(), routes) & (rows.column("cdr_length") > 0))
        offset, length = rows.column("cdr_offset")[owner], rows.column("cdr_length")[owner]
        assert rows.context.types is not None, "messages have types"
        for item in samples_of(rows):
            if library.full_name(item.type) == library.full_name(name):
                owner = np.concatenate([owner, np.searchsorted(rows.indices(), item.row[item.valid])])
                offset = np.concatenate([offset, item.offset[item.valid]])
                length = np.concatenate([length, item.length[item.valid]])
        order = np.argsort(owner, kind="stable")
        owner, offset, length = owner[order], offset[order], length[order]
        return owner, rows.context.types.columns(name, rows.batch.data, offset, length)

    return rows.once(("messages", name), make)


def samples_of(rows: ColumnRows) -> list[KnownSamples]:
    """Return the samples in some rows, by topic and type."""

    def make() -> list[KnownSamples]:
        context = rows.context
        groups: list[KnownSamples] = []
        for link in (item for item in context.links if item.samples):
            own = rows.indices()[np.flatnonzero(rows.column("link") == link)]
            groups += link.sample_reader().known_samples(context.types, context.endpoints, rows.batch, own)
        return groups

    return rows.once("samples", make)


def structs_of(rows: ColumnRows) -> dict[Bound, Held]:
    """Return the rows that hold each C struct."""

    def make() -> dict[Bound, Held]:
        if rows.batch.recorded is not None:
            return {}
        structs = rows.context.structs
        result = payloads(structs, rows.column, rows.datagram, rows.batch.data)
        return {item.bound: item for item in structs.payloads_of(result, rows.column, rows.batch.data)}

    return rows.once("structs", make)


def held_messages(bound: Bound, rows: ColumnRows) -> Owned:
    """Return the rows that hold a C struct, and its messages."""

    def make() -> Owned:
        nothing = np.zeros(0, np.int64)
        item = structs_of(rows).get(bound)
        encoded = item.encode() if item else Encoded(np.zeros(1, np.uint8), nothing, nothing, 0)
        columns = rows.context.structs.types.columns(
            bound.type, encoded.data, encoded.start, encoded.size.astype(np.int32)
        )
        return item.rows if item else nothing, columns

    return rows.once(("struct", bound.topic), make)


def _may_hold(routes: tuple[int, ...], rows: ColumnRows) -> Mask:
    """Return which rows may hold messages of some routes' types: packets of the routes, and samples."""
    return np.isin(rows.routes(), routes) | among(rows.column("link"), lambda link: link.samples)


def _holds(bound: Bound, rows: ColumnRows) -> Mask:
    out = np.zeros(len(rows), np.bool_)
    out[held_messages(bound, rows)[0]] = True
    return out


def _read_struct(bound: Bound, rows: ColumnRows) -> Series:
    owner = held_messages(bound, rows)[0]
    return Series(len(rows), np.zeros(len(owner), INDEX_DTYPE), owner)


def _read_whole(read: Callable[[ColumnRows], Owned], rows: ColumnRows) -> Series:
    owner, messages = read(rows)
    owner = owner[messages.valid]
    return Series(len(rows), np.zeros(len(owner), INDEX_DTYPE), owner)


def field_series(
    read: Callable[[ColumnRows], Owned], path: str, index: int | None, rows: ColumnRows
) -> Series:
    """Return a field's values (of all elements of an array or of one), and the rows that hold them."""
    owner, messages = read(rows)
    column, valid = messages.fields[path], messages.valid
    holders = owner[valid]
    values: NDArray[Any]
    if isinstance(column, Ragged):
        start, counts = column.offsets[:-1], np.diff(column.offsets)
        if index is None:
            values, owner = column.values, np.repeat(owner, counts)
        else:
            reached = (counts > index) if index >= 0 else (counts >= -index)
            values = column.values[(start + index + (counts if index < 0 else 0))[reached]]
            owner = holders = owner[reached]
    elif column.ndim > 1:
        inside = index is not None and -column.shape[1] <= index < column.shape[1]
        if index is None:
            values, owner = column[valid].reshape(-1), np.repeat(holders, column.shape[1])
        else:
            values = column[valid][:, index] if inside else column[:0, 0]
            owner = holders = holders if inside else holders[:0]
    else:
        values, owner = column[valid], holders
    if values.dtype == object:
        return Series.of_objects(len(rows), values.tolist(), owner, holders)
    return Series(len(rows), values, owner, holders)
