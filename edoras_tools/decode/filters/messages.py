"""The fields of decoded ROS messages and C structs, found by their path.

The rules that this file keeps:

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
from copy import copy
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from msgspec.structs import replace

from edoras_tools.cfs.arguments import SERVICES
from edoras_tools.decode.filters.rows import (
    INDEX_DTYPE,
    MESSAGE_COST,
    ColumnRows,
    FilterField,
    PacketRows,
    Series,
    ValueKind,
)
from edoras_tools.links.table import among
from edoras_tools.ros.cdr.columns import MessageColumns, Ragged
from edoras_tools.ros.types import schema
from edoras_tools.structs.bindings import Bound, Encoded, Held, payloads
from edoras_tools.structs.messages import INLINED, aliased, field_name
from edoras_tools.structs.shapes import PACKETS, UDP_KEY
from edoras_tools.wire import cfe
from edoras_tools.wire.arrays import by_key

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from edoras_tools.decode.context import Context
    from edoras_tools.links.doors import KnownSamples
    from edoras_tools.model import Decoded
    from edoras_tools.wire.arrays import Integers, Mask

    Owned = tuple[Integers, MessageColumns]
    """Rows that hold messages, and the messages."""

_PART: Final = re.compile(r"(\w+)(?:\[(-?\d+)\])?")
_DOT: Final = re.compile(r"\.")
_PREFIX: Final = "ros."


class _Step(NamedTuple):
    """One part of a path: the field, and the index of an element, None for all."""

    field: schema.MessageField
    element: int | None

    @property
    def listed(self) -> bool:
        """Whether the field holds several values."""
        return self.field.shape is not schema.Shape.SCALAR


class MessageFieldFinder:
    """Finds fields of messages by their path.

    Args:
        context: decoder context with the routes, the types and the C structs.
    """

    def __init__(self, context: Context) -> None:
        self._context = context
        self._routes: dict[str, list[int]] = {}
        self._first: Collection[str] = ()
        self._definitions: dict[str, schema.Definition] = dict(context.structs.definitions)
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
        sections = () if name in self._routes else schema.sections(name, types.definition(name))
        self._routes.setdefault(name, []).extend(routes)
        for part in sections:
            self._definitions[part.name] = schema.parse_definition(part.name, part.text, part.name, part.line)

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
            yield from self._leaves(schema.full_name(name), "")
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
        definition: schema.Definition | None = self._definitions[schema.full_name(name)]
        for part, index in path:
            fields = definition.fields if definition else ()
            item = next((item for item in fields if item.name == part), None)
            if item is None and definition and definition.name in self._own:
                if part == field_name(INLINED) and not steps:
                    continue
                item = next((item for item in fields if item.name in aliased(part)), None)
            if item is None or (index is not None and item.shape is schema.Shape.SCALAR):
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
        dtype = np.dtype(schema.PRIMITIVES.get(last, "q"))
        kind = (
            ValueKind.STRUCT
            if last in self._definitions
            else ValueKind.TEXT
            if last in schema.STRINGS
            else ValueKind.BOOL
            if dtype.kind == "b"
            else ValueKind.NUMBER
        )
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
        index = indices[0] if indices else None
        return partial(field_series, messages, path, index)

    def _single(self, name: str) -> str:
        """Return the path of a value that each message of a type has exactly once; empty if there is none."""
        for item in self._definitions[name].fields:
            if item.shape is not schema.Shape.SCALAR:
                continue
            if item.type not in self._definitions:
                return item.name
            inner = self._single(item.type)
            if inner:
                return f"{item.name}.{inner}"
        return ""


_LAYERS: Final = {PACKETS[item] for item in (cfe.EVENT_MSG_ID, cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID)}
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
        if field.shape is schema.Shape.SCALAR:
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
            if schema.full_name(item.type) == schema.full_name(name):
                row = np.searchsorted(rows.indices(), item.row[item.valid])
                owner = np.concatenate([owner, row])
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
