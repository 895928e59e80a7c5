"""The names of fields: of the packet itself, of every header, and of every message of a route."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from copy import copy
from difflib import get_close_matches
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.decode.filters.layers import MessageFieldFinder, layer_fields, samples_of, structs_of
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
from edoras_tools.decode.spacecraft import FIRST_SPACECRAFT
from edoras_tools.model import NO_MSG_ID, NO_ROUTE, OTHER, Decoded, Endpoint, Finding
from edoras_tools.ros.library import full_name
from edoras_tools.structs.bindings import payloads
from edoras_tools.structs.shapes import OWN_LAYERS
from edoras_tools.wire.arrays import by_key
from edoras_tools.words import either, listed

if TYPE_CHECKING:
    from edoras_tools.decode.context import Context

_ALIASES: Final = {
    "msg_id": "ccsds.msg_id",
    "sequence_count": "ccsds.packet_sequence_count",
    "processor_id": "sbn.processor_id",
    "spacecraft_id": "sbn.spacecraft_id",
    "message": "ros",
}
"""Short names, of ``sniff --json`` and of the columns; they have precedence over equal names."""
_OF_MESSAGES: Final = (
    *("number", "time_ns", "time", "utc", "length", "topic", "type"),
    *("findings", "ros", "summary", "stop", "payload"),
)
"""Names of the packet itself that messages without datagrams have, too."""
_BITS: Final = {bit: finding.label for bit, finding in enumerate(Finding)}
_CLOSE: Final = 0.6


class Unknown(Exception):  # noqa: N818  it never leaves the compiler
    """A name that is not a field, or is ambiguous; the message says what to write.

    Args:
        say: makes the message on demand, because the search for similar names is slow.
    """

    def __init__(self, say: Callable[[], str]) -> None:
        super().__init__()
        self._say = say

    def __str__(self) -> str:
        return self._say()


class Names:
    """Finds fields by name.

    Args:
        context: decoder context with the routes, the types and the options.
    """

    def __init__(self, context: Context) -> None:
        self.context = context
        self._packet = by_key(_packet_fields(context), lambda field: field.name)
        self._of_datagrams: frozenset[str] = frozenset()
        layers = list(layer_fields(context))
        if context.mission.recorded:  # messages without datagrams
            names = {*self._packet, *_ALIASES, *(field.name for field in layers)}
            self._packet = {name: self._packet[name] for name in _OF_MESSAGES}
            self._of_datagrams = frozenset(names - {*self._packet, "message"})
            layers = []
        self._layers = {field.name: field for field in layers}
        # F Prime's headers have some names of cFE's; these do not make cFE's names ambiguous.
        apart = {layout.name for link in context.links if link.dictionary for layout in link.layouts}
        others = (name for name in self._layers if name.partition(".")[0] not in apart)
        self._short = by_key(others, lambda name: name.rpartition(".")[2])
        self._messages = MessageFieldFinder(context)
        self._unread = [
            f"/{item.topic.removeprefix('/')} is {item.unread}"
            for item in context.mission.recorded
            if item.unread
        ]

    def of_types(self, types: Iterable[str]) -> Names:
        """Return the names for filters of messages whose types are among some types."""
        other = copy(self)
        other._messages = self._messages.of_types(types)  # noqa: SLF001  of its own kind
        return other

    def find(self, name: str) -> list[FilterField]:
        """Return the field of a name; several where message types or endpoints share it.

        Raises:
            Unknown: there is no such field, or the name is ambiguous.
        """
        if name in self._packet:
            return self._packet[name]
        layer = self._layers.get(_ALIASES.get(name, name))
        if layer is not None:
            return [layer]
        if name in _ALIASES and _ALIASES[name] in self._packet:
            return self._packet[_ALIASES[name]]
        messages = self._messages.find(name)
        short = [] if name.startswith("ros.") else self._short.get(name, [])
        if len(short) + bool(messages) > 1:
            clear = short + [f"ros.{name}"] * bool(messages)
            raise Unknown(lambda: f"{name!r} is more than one field; write {either(clear)}")
        layers = [self._layers[item] for item in short]
        # A name of the mission's messages has precedence over the same name of a C struct.
        if messages or (layers and short[0].partition(".")[0] not in OWN_LAYERS):
            return messages or layers
        fields = layers + self._messages.of_structs(name)
        if not fields:
            self._messages.look_ahead()
            fields = self._messages.find(name)
        if not fields:
            raise Unknown(partial(self._nothing, name))
        return fields

    def inside(self, field: FilterField) -> list[str]:
        """Return the names of the fields in a group of fields."""
        if field.name in self._layers:
            return [name for name in self._layers if name.startswith(f"{field.name}.")]
        return self._messages.inside(field.name)

    def all(self) -> Iterator[str]:
        """Yield every valid name, without indices."""
        yield from self._packet
        yield from (name for name, of in _ALIASES.items() if of in self._packet or of in self._layers)
        yield from self._layers
        yield from (name for name, layers in self._short.items() if len(layers) == 1)
        yield from self._messages.names()

    def _nothing(self, name: str) -> str:
        if name in self._of_datagrams:
            return f"{name!r} is of datagrams, and the recording has only messages"
        if "[" in name:
            plain = name.partition("[")[0]
            singular = self._packet.get(plain) or self._messages.find(plain)
            if singular and not singular[0].many:
                return f"{plain} is not a list of a message, so it takes no index"
        prefix = "ros." if name.startswith("ros.") else ""
        spellings = {item.lower(): prefix + item for item in self.all() if "." in item or "." not in name}
        near = get_close_matches(name.removeprefix(prefix).lower(), spellings, 3, _CLOSE)
        near = near or [item for item in spellings if item.endswith(f".{name.lower()}")][:3]
        text = name if len(name) <= 60 else f"{name[:60]}..."
        why = f"{text!r} is not a field; "
        with_mission = "the fields of messages are known once a mission is named with -c"
        if near:
            why += f"did you mean {either([spellings[item] for item in near])}?"
            return why if self._messages else f"{why} ({with_mission})"
        if self._unread and not self._messages:
            return why + listed(self._unread, 3)
        if not self._messages:
            return why + with_mission
        layers = ", ".join(item for item in self._layers if "." not in item)
        return why + f"there are {', '.join([*self._packet][:7])} and the fields of {layers} and the messages"


def _packet_fields(context: Context) -> Iterator[FilterField]:
    """Yield the fields of a datagram as a whole."""
    yield _number("number", "its place in the capture, from 1", lambda item: item.datagram.number)
    yield _number("time_ns", "when it was captured, ns since 1970", lambda item: item.datagram.time_ns)
    yield FilterField(
        "time",
        ValueKind.DURATION,
        lambda rows, decoded: decoded.datagram.time_ns - rows.begin_ns,
        lambda rows: Series(len(rows), rows.datagram("time_ns") - rows.begin_ns),
        doc="since the capture's first datagram",
    )
    yield FilterField(
        "utc",
        ValueKind.MOMENT,
        lambda _, decoded: decoded.datagram.time_ns,
        lambda rows: Series(len(rows), rows.datagram("time_ns")),
        doc="when it was captured",
    )
    yield FilterField(
        "mission_time",
        ValueKind.DURATION,
        _pick_mission_time,
        lambda rows: Series.of_chosen(rows.column("mission_time_ns"), rows.column("mission_time_ns") >= 0),
        doc="a telemetry packet's own time, since the mission's epoch",
    )
    yield _number("length", "bytes of the UDP payload", lambda item: len(item.datagram.payload))
    yield FilterField(
        "link",
        ValueKind.NUMBER,
        lambda _, decoded: int(decoded.link),
        lambda rows: Series(len(rows), rows.column("link")),
        limits=(0, 255),
        names={int(link): link.label for link in (OTHER, *context.links)},
        doc="which of the links it belongs to",
    )
    yield FilterField(
        "spacecraft",
        ValueKind.NUMBER,
        lambda _, decoded: context.spacecraft.of(decoded.datagram, decoded.link),
        lambda rows: Series(len(rows), rows.column("spacecraft")),
        limits=(1, 255),
        names={number: name for number, (name, _) in enumerate(context.mission.spacecraft, 1)},
        doc="which spacecraft it is of: 1, 2 and so on, in order of first sight",
    )
    for side in ("source", "destination"):
        yield _endpoint(side, side)
        for name in (f"{side}.address", "address"):
            yield _address(name, side)
        for name in (f"{side}.port", "port"):
            yield _port(name, side)
    yield _route(context, "topic", [route.topic for route in context.mission.routes], _same_topic)
    yield _route(context, "type", [route.type for route in context.mission.routes], _same_type)
    yield FilterField(
        "findings",
        ValueKind.NUMBER,
        lambda _, decoded: [int(bit).bit_length() - 1 for bit in decoded.findings],
        _read_findings,
        limits=(0, len(_BITS) - 1),
        names=_BITS,
        many=True,
        doc="departures from what the protocols say",
    )
    yield FilterField(
        "ros",
        ValueKind.STRUCT,
        lambda rows, decoded: 0 if decoded.message and not _of_json(rows, decoded) else None,
        _read_messages,
        cost=MESSAGE_COST,
        doc="whether a message was decoded, ROS or a C struct",
    )
    yield FilterField(
        "summary", ValueKind.TEXT, lambda _, decoded: decoded.summary, doc="the packet in a few words"
    )
    yield FilterField(
        "stop",
        ValueKind.TEXT,
        lambda _, decoded: str(decoded.stop) if decoded.stop else None,
        doc="why decoding went no further",
    )
    yield FilterField(
        "payload",
        ValueKind.BYTES,
        lambda _, decoded: decoded.datagram.payload,
        _read_payload,
        cost=BYTES_COST,
        doc="the UDP payload",
    )


def _of_json(rows: PacketRows, decoded: Decoded) -> bool:
    """Return whether a message has values but no fields: only ROS messages and C structs have fields."""
    topic = decoded.datagram.topic
    return topic != NO_ROUTE and bool(rows.context.mission.recorded[topic].unread)


def _number(name: str, doc: str, pick: Any) -> FilterField:
    return FilterField(
        name,
        ValueKind.NUMBER,
        lambda _, decoded: pick(decoded),
        lambda rows: Series(len(rows), rows.datagram(name)),
        doc=doc,
    )


def _pick_mission_time(rows: PacketRows, decoded: Decoded) -> int | None:
    layer = decoded.layer("cfe_telemetry")
    if layer is None:
        return None
    values = layer.values()
    return int(rows.context.time.ns(values["seconds"], values["subseconds"]))


def _read_findings(rows: ColumnRows) -> Series:
    column = rows.column("findings")
    set_bits = [
        bit for bit in _BITS if np.bitwise_or.reduce(column, initial=np.uint32(0)) & np.uint32(1 << bit)
    ]
    places = [np.flatnonzero(column & np.uint32(1 << bit)) for bit in set_bits]
    owner = np.concatenate([np.zeros(0, INDEX_DTYPE), *places])
    values = np.repeat(np.array(set_bits, INDEX_DTYPE), [len(item) for item in places])
    order = np.argsort(owner, kind="stable")
    return Series(len(rows), values[order], owner[order], np.arange(len(rows)))


def _read_messages(rows: ColumnRows) -> Series:
    """Return which packets hold a message: valid by the decoder's findings, and of a known type."""
    types, routes = rows.context.types, rows.context.mission.routes
    typed = np.array([types is not None and types.has(route.type) for route in routes] + [False])
    invalid = (rows.column("findings") & np.uint32(Finding.CDR_INVALID)) != 0
    present = typed[rows.routes()] & (rows.column("cdr_length") > 0)
    cut = (rows.column("findings") & np.uint32(Finding.CAPTURE_CUT)) != 0
    for row in np.flatnonzero(present & cut):
        # The decoder reports no findings for a packet that the capture cut.
        invalid[row] = rows.take(np.array([row])).packets()[0].message is None
    present &= ~invalid
    for group in structs_of(rows).values():
        present[group.rows] = True
    return Series.of_chosen(np.zeros(len(rows), INDEX_DTYPE), present)


def _read_payload(rows: ColumnRows) -> Series:
    data = rows.batch.data
    places = zip(rows.datagram("offset").tolist(), rows.datagram("length").tolist(), strict=True)
    return Series.of_objects(len(rows), [data[at : at + length].tobytes() for at, length in places])


def _endpoint(name: str, side: str) -> FilterField:
    def read(rows: ColumnRows) -> Series:
        version, port = rows.datagram("ip_version"), rows.datagram(f"{side}_port")
        address = rows.datagram(f"{side}_address")
        key = address.astype(np.uint64) << 17 | port.astype(np.uint64) << 1 | (version == 6)
        return _distinct(rows, key, lambda row: str(Endpoint(_text(rows, side, row), int(port[row]))))

    return FilterField(
        name,
        ValueKind.TEXT,
        lambda _, decoded: str(getattr(decoded.datagram, side)),
        read,
        cost=BYTES_COST,
        alike=lambda text, word: word in {text, text.rpartition(":")[0].strip("[]")},
        doc="address and port",
    )


def _address(name: str, side: str) -> FilterField:
    def read(rows: ColumnRows) -> Series:
        key = rows.datagram(f"{side}_address").astype(np.uint64) << 1 | (rows.datagram("ip_version") == 6)
        return _distinct(rows, key, lambda row: _text(rows, side, row))

    return FilterField(
        name,
        ValueKind.TEXT,
        lambda _, decoded: getattr(decoded.datagram, side).address,
        read,
        cost=BYTES_COST,
    )


def _port(name: str, side: str) -> FilterField:
    return FilterField(
        name,
        ValueKind.NUMBER,
        lambda _, decoded: getattr(decoded.datagram, side).port,
        lambda rows: Series(len(rows), rows.datagram(f"{side}_port")),
        limits=(0, 0xFFFF),
    )


def _text(rows: ColumnRows, side: str, row: int) -> str:
    index = int(rows.indices()[row])
    return rows.batch.address(int(getattr(rows.batch, f"{side}_address")[index]), index)


def _distinct(rows: ColumnRows, key: Any, text: Any) -> Series:
    """Return texts, one for each distinct key."""
    _, first, codes = np.unique(key, return_index=True, return_inverse=True)
    return Series(len(rows), codes.reshape(-1), table=[text(row) for row in first.tolist()])


def _route(context: Context, name: str, routed: Sequence[str], alike: Any) -> FilterField:
    texts: list[str] = [*routed, *(getattr(bound, name) for bound in context.structs.all)]

    def of_spacecraft(text: str, number: int) -> str:
        first, own = (context.mission.prefix(item) for item in (FIRST_SPACECRAFT, number))
        return text if own == first or name != "topic" else own + text.removeprefix(first)

    def pick(_: PacketRows, decoded: Decoded) -> str | list[str] | None:
        if decoded.datagram.topic != NO_ROUTE:
            return texts[decoded.datagram.topic]
        if decoded.more:
            return [getattr(message, name) for message in decoded.messages]
        packet = decoded.layer("ccsds")
        if packet is None:
            return getattr(decoded.message, name, None)
        msg_id = packet.values()["msg_id"]
        route = int(context.routes_on(decoded.link)[msg_id])
        route = route if route != NO_ROUTE else int(context.any_route_of[msg_id])
        if route == NO_ROUTE:
            return getattr(decoded.message, name, None)
        return of_spacecraft(texts[route], context.spacecraft.of(decoded.datagram, decoded.link))

    def read(rows: ColumnRows) -> Series:
        routes = rows.routes()
        if rows.batch.recorded is not None:
            return Series(len(rows), routes.astype(INDEX_DTYPE), table=texts)
        which = np.where(rows.column("msg_id") == NO_MSG_ID, NO_ROUTE, routes).astype(INDEX_DTYPE)
        samples = payloads(context.structs, rows.column, rows.datagram, rows.batch.data)
        with_route = np.flatnonzero(which != NO_ROUTE)
        owner, values = [with_route], [which[with_route]]
        for bound, members, fits in context.structs.split(samples):
            owner.append(members.row[fits])
            values.append(np.full(len(owner[-1]), len(routed) + context.structs.all.index(bound)))
        table = [*texts]
        for item in samples_of(rows):
            owner.append(np.searchsorted(rows.indices(), item.row[item.valid]))
            values.append(np.full(len(owner[-1]), len(table)))
            table.append(getattr(item, name))
        owners, which = np.concatenate(owner), np.concatenate(values)
        order, number = np.argsort(owners, kind="stable"), rows.column("spacecraft")[owners]
        if context.spacecraft.several and len(number):
            which += (number.astype(INDEX_DTYPE) - FIRST_SPACECRAFT) * len(table)
            table = [of_spacecraft(text, 1 + more) for more in range(number.max()) for text in table]
        return Series(len(rows), which[order], owners[order], table=table)

    return FilterField(
        name,
        ValueKind.TEXT,
        pick,
        read,
        cost=COLUMN_COST,
        choices=sorted(set(texts)),
        alike=alike,
        doc=f"the {name} of the route, or of the C struct, that its MsgId is",
    )


def _same_topic(text: str, word: str) -> bool:
    return text in {word, f"/{word}"}


def _same_type(text: str, word: str) -> bool:
    return full_name(text) == full_name(word) or text.rpartition("/")[2] == word
