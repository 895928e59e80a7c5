"""Structs bound to packets: where they may be, the definitions of their messages, their bytes as messages.

``StructPayloads`` are the bytes of a batch that may hold structs: after the headers of packets, and on the
robot link. ``Bound`` is one struct and the packets that hold it: it converts their bytes to messages, one or
many at a time. ``Bindings`` binds the structs of layouts to packets.
"""

from __future__ import annotations

import collections
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from edoras_tools.errors import ConfigError
from edoras_tools.links.table import accepted, among
from edoras_tools.ros.library import Definition, complete_text, with_used
from edoras_tools.structs import Structs, messages
from edoras_tools.structs.messages import HEAD, HEADER_FIELDS, MOST_VALUES, Counter, StructPlan, parts
from edoras_tools.structs.shapes import SHIPPED, Key, Member, Struct, StructLayout
from edoras_tools.wire import ccsds
from edoras_tools.wire.arrays import Integers, Mask, Octets, Places, by_value, gather

if TYPE_CHECKING:
    from numpy.typing import NDArray


class StructPayloads(NamedTuple):
    """Bytes that may hold structs, as columns of one length; for packets, the bytes after the cFE header.

    Attributes:
        row: i64, row of the packet or datagram in the batch.
        key: i32, MsgId, or UDP port as in ``Key``.
        code: i32, function code of a command; for datagrams, their bytes.
        offset: i64, first byte in the data of the batch.
        length: i32, bytes.
    """

    row: Places
    key: NDArray[np.int32]
    code: NDArray[np.int32]
    offset: Integers
    length: NDArray[np.int32]

    def take(self, some: Any) -> StructPayloads:
        """Return some of the payloads, chosen by indices, a mask or a slice."""
        return StructPayloads(*(column[some] for column in self))

    def join(self, others: StructPayloads) -> StructPayloads:
        """Return these payloads, followed by others."""
        pairs: Iterator[tuple[Any, Any]] = zip(self, others, strict=True)
        return StructPayloads(*(np.concatenate(pair) for pair in pairs))


_NOTHING: Final = StructPayloads(
    np.zeros(0, np.intp),
    np.zeros(0, np.int32),
    np.zeros(0, np.int32),
    np.zeros(0, np.int64),
    np.zeros(0, np.int32),
)


def payloads(
    structs: Structs,
    columns: Callable[[str], NDArray[Any]],
    datagrams: Callable[[str], NDArray[Any]],
    data: Octets,
) -> StructPayloads:
    """Return all payloads of a batch that structs are bound to.

    Args:
        columns: returns a column of the decoder by name.
        datagrams: returns a column of the batch by name; the same rows.
        data: u8, the buffer that the offsets point into.
    """
    key = columns("msg_id")
    bound_rows, bare = structs.has.take(key), _last_hops().take(columns("link"))
    if structs.dictionary is None and not np.count_nonzero(bound_rows) and not np.count_nonzero(bare):
        return _NOTHING  # the case of most small batches of a live link
    rows = np.flatnonzero(bound_rows)
    rows = rows[columns("header_length")[rows] > ccsds.PRIMARY.size]
    header = columns("header_length")[rows]
    samples = StructPayloads(
        rows,
        key[rows],
        columns("function_code")[rows],
        columns("packet_offset")[rows] + header,
        columns("packet_length")[rows] - header,
    )
    if structs.dictionary is not None:
        described = np.flatnonzero(among(columns("link"), lambda link: link.dictionary))
        offset, size = datagrams("offset")[described], datagrams("length")[described]
        entries = structs.dictionary.payloads(data, offset, size)
        samples = samples.join(entries._replace(row=described[entries.row]))
    described_rows = np.flatnonzero(bare)
    if not len(described_rows):
        return samples
    length = datagrams("length")[described_rows]
    ports = structs.of_port(datagrams("destination_port")[described_rows])
    return samples.join(
        StructPayloads(described_rows, ports, length, datagrams("offset")[described_rows], length)
    )


@cache
def _last_hops() -> Mask:
    return accepted(lambda link: link.last_hop)


class Bindings:
    """The structs of some layouts, each bound to the packets that hold it and named once.

    The built-in structs are bound only when they are used: no two of them have the same name.

    Args:
        layouts: the layouts; if several bind the same MsgId, the first one applies.

    Attributes:
        keys: the keys of each MsgId, by function code in rising order; the key for all other codes is under
            None.

    Raises:
        ConfigError: a struct cannot become a message.
    """

    def __init__(self, layouts: Sequence[StructLayout]) -> None:
        first: dict[int, StructLayout] = {}
        owners = {
            key: layout
            for layout in layouts
            for key in layout.bindings
            if first.setdefault(key.msg_id, layout) is layout
        }
        self._owners = dict(
            sorted(owners.items(), key=lambda item: (item[0].msg_id, item[0].function_code or 0))
        )
        self._often = collections.Counter(
            layout.bindings[key].removesuffix("_t") for key, layout in owners.items()
        )
        self.keys: dict[int, dict[int | None, Key]] = {}
        for key in sorted(self._owners, key=lambda key: key.function_code is None):
            self.keys.setdefault(key.msg_id, {})[key.function_code] = key
        self._bound: dict[Key, Bound] = {}
        self._prefix = ""
        self._definitions: dict[str, Definition] = {}
        self._texts: dict[str, str] = {}
        self._names: dict[tuple[int, str, bool], str] = {}
        self._used: set[str] = set()
        if any(layout.origin != SHIPPED for layout in layouts):
            _ = self.all  # this raises the ConfigError of a wrong layout now

    def under(self, prefix: str) -> Bindings:
        """Return these structs with ``prefix`` in front of their topics; the definitions are the same."""
        other = copy(self)
        other._prefix, other._bound = prefix, {}  # noqa: SLF001  of its own kind
        return other

    @property
    def all(self) -> tuple[Bound, ...]:
        """Every bound struct, by MsgId and function code."""
        return tuple(map(self.bound, self._owners))

    def of(self, msg_id: int) -> list[Bound]:
        """Return the structs of a MsgId, in the order of ``keys``."""
        return list(map(self.bound, self.keys[msg_id].values()))

    @property
    def definitions(self) -> Mapping[str, Definition]:
        """The definitions of all messages and of all types that these use, by type name."""
        _ = self.all
        return self._definitions

    @property
    def texts(self) -> Mapping[str, str]:
        """The ``.msg`` text of each of these definitions, by type name."""
        _ = self.all
        return self._texts

    def text(self, name: str) -> str | None:
        """Return the complete ``ros2msg`` text of a message type; None if no bound struct has this type."""
        is_bound = name in self._definitions
        return complete_text(with_used(name, self._definitions.__getitem__)) if is_bound else None

    def bound(self, key: Key) -> Bound:
        """Return the bound struct of a key, one of ``keys``."""
        if key not in self._bound:
            self._bound[key] = self._new(key, self._owners[key])
        return self._bound[key]

    def _new(self, key: Key, layout: StructLayout) -> Bound:
        struct = layout.structs[layout.bindings[key]]
        if struct.header and key.port is not None:
            why = f"{struct.name} begins with a cFE header, which a robot's datagram has not"
            raise ConfigError(f"{layout.origin}: {key}: {why}; bind what follows it")
        type_name = self.define(layout, struct, whole=True)
        if layout.entries:
            return layout.entries.bind(key, layout, struct, type_name)
        name = struct.name.removesuffix("_t")
        topic = f"/cfs/{name}/{key}".replace(":", "_") if self._often[name] > 1 else f"/cfs/{name}"
        return Bound(key, layout, struct, self._prefix + topic, type_name)

    def define(self, layout: StructLayout, struct: Struct, *, whole: bool) -> str:
        """Define the message of a struct, and every type that it uses; return its full type name."""
        return self._define(layout, struct, whole, ())

    def _define(self, layout: StructLayout, struct: Struct, whole: bool, within: tuple[str, ...]) -> str:
        key = (id(layout), struct.name, whole)
        if key in self._names:
            return self._names[key]
        if struct.name in within:
            raise ConfigError(f"{layout.origin}: {struct.name} contains itself")
        package = f"{layout.package}/msg/"
        name = self._names[key] = package + self._free(package, messages.message_type_name(struct.name))
        names = {}
        if whole and not layout.entries:
            names[messages.HEADER_TYPE] = package + messages.HEADER_TYPE
            self._used.add(names[messages.HEADER_TYPE])
        inside = (*within, struct.name)
        for part in messages.parts(layout, struct, whole=whole):
            nested = layout.structs.get(str(part.member.type))
            if nested is not None:
                names[nested.name] = self._define(layout, nested, False, inside)
        fields = messages.described(layout, struct, names, whole=whole)
        self._definitions[name] = messages.definition(name, fields)
        self._texts[name] = messages.definition_text(struct, fields)
        if messages.HEADER_TYPE in names and names[messages.HEADER_TYPE] not in self._definitions:
            self._definitions[names[messages.HEADER_TYPE]] = header = messages.header_definition(
                names[messages.HEADER_TYPE]
            )
            self._texts[names[messages.HEADER_TYPE]] = (
                "# what the packet was, and where it came from\n" + header.text
            )
        return name

    def _free(self, package: str, name: str) -> str:
        free = messages.unique(package + name, self._used | {package + messages.HEADER_TYPE})
        self._used.add(free)
        return free.removeprefix(package)


class Encoded(NamedTuple):
    """Encoded messages, one after the other in one buffer.

    Attributes:
        data: u8, the CDR of the messages, encapsulation included.
        start: i64 (n,), offset of each message.
        size: i64 (n,), bytes of each message.
        width: bytes of a message if all have the same size and no bytes are between them, else 0.
    """

    data: Octets
    start: Integers
    size: Integers
    width: int


class Bound:
    """A struct and the packets of one key that hold it.

    Args:
        key: key of the packets.
        layout: the layout that the struct belongs to.
        struct: the struct.
        topic: topic of the messages.
        type: full type name of the messages.

    Attributes:
        key: key of the packets.
        struct: the struct that the packets hold.
        topic: topic of the messages.
        type: full type name of the messages.
        size: bytes of the payload; without the last array if that is open to the end.
        repeats: whether a packet may hold several of these structs.

    Raises:
        ConfigError: the struct has more than ``MOST_VALUES`` values.
    """

    repeats = False

    def __init__(self, key: Key, layout: StructLayout, struct: Struct, topic: str, type: str) -> None:  # noqa: A002
        self.key = key
        self.layout = layout
        self.struct = struct
        self.topic = topic
        self.type = type
        self._plans: dict[int, StructPlan] = {}
        members = parts(layout, struct, whole=True)
        self._open = members[-1].member if members and members[-1].open else None
        self.size = struct.size - struct.header
        self._least = max((self._end(part.member) for part in members), default=0)
        self._step = self._row(self._open) if self._open is not None else 0
        self._most = self._limit()

    @property
    def name(self) -> str:
        """The struct's name without ``_t``."""
        return self.struct.name.removesuffix("_t")

    @property
    def metadata(self) -> dict[str, str]:
        """The metadata of the struct's topic: the MsgId or the port, and the struct's name."""
        place = {"msg_id": f"0x{self.key.msg_id:04x}"} if self.key.port is None else {"port": str(self.key)}
        return {**place, "struct": self.struct.name}

    @property
    def shipped(self) -> bool:
        """Whether this is one of the built-in structs of cFE."""
        return self.layout.origin == SHIPPED

    @property
    def command(self) -> bool:
        """Whether this struct holds the arguments of one of the built-in commands."""
        return self.shipped and self.key.function_code is not None and self.key.port is None

    def fits(self, length: NDArray[np.integer[Any]] | int) -> Mask:
        """Return which payload lengths fit this struct, with or without the padding at its end."""
        length = np.asarray(length)
        fits: Mask = length >= self._least
        most = self.size + self.struct.tail
        fits &= (length - self._least) % self._step == 0 if self._step else length <= most
        if self._most is not None:
            fits &= length <= self._most
        return fits

    @property
    def extent(self) -> tuple[int, int, int]:
        """Bytes of the shortest and longest payload that fit (65,535: no limit), and of the step between."""
        return self._least, 0xFFFF if self._step else self.size + self.struct.tail, self._step

    @property
    def expected(self) -> str:
        """The payload length as text."""
        return f"{self._least} + n x {self._step}" if self._step else str(self.size)

    def plan(self, length: int) -> StructPlan:
        """Return the plan for payloads of one length, which must fit the struct."""
        if length not in self._plans:
            self._plans[length] = StructPlan(self.layout, self.struct, length)
        return self._plans[length]

    def encode(
        self, data: Octets, offset: Integers, length: NDArray[np.integer[Any]], heads: NDArray[np.void]
    ) -> Encoded:
        """Encode the payloads of many packets as messages.

        Args:
            data: u8, the buffer that holds the payloads.
            offset: i64 (n,), start of each payload.
            length: (n,), bytes of each payload; all of them fit the struct.
            heads: (n,), header values of each message, of dtype ``HEAD``.
        """
        if len(offset) and length.min() == length.max():
            one = int(length[0])
            whole, start, size = self.plan(one).encode(_window(data, offset, one, heads))
            return Encoded(whole, start, size, int(size[0]) if (size == size[0]).all() else 0)
        start, size = np.zeros(len(offset), np.int64), np.zeros(len(offset), np.int64)
        pieces, base = [np.empty(0, np.uint8)], 0
        for one, rows in by_value(length):
            piece, at, size[rows] = self.plan(one).encode(_window(data, offset[rows], one, heads[rows]))
            start[rows] = at + base
            base += len(piece)
            pieces.append(piece)
        return Encoded(np.concatenate(pieces), start, size, 0)

    def encode_one(self, payload: bytes, origin: tuple[int, ...]) -> bytes:
        """Return the message of one packet.

        Args:
            payload: the bytes after the header; their length fits the struct.
            origin: values of ``HEADER_FIELDS``.
        """
        head = np.array(origin, HEAD).tobytes()
        window = np.frombuffer(head + payload, np.uint8).reshape(1, -1)
        return self.plan(len(payload)).encode(window)[0].tobytes()

    def spans(self, values: Mapping[str, Any], length: int) -> Iterator[tuple[str, Any, int, int, Member]]:
        """Yield every value of a message as (dotted path, value, start, end, member).

        Args:
            values: decoded values of the message.
            length: bytes of the payload; start and end count from the payload's start.
        """
        for leaf in self.plan(length).leaves:
            value: Any = values
            path = ""
            for part in leaf.path:
                value = value[part]
                path += f"[{part}]" if isinstance(part, int) else f".{part}"
            yield path.removeprefix("."), value, leaf.start, leaf.end, leaf.member

    def member(self, path: Sequence[str]) -> Member | None:
        """Return the member of a field, by the path without indices; None for a field of the header."""
        struct, whole, match = self.struct, True, None
        for name in path:
            match = next((p.member for p in parts(self.layout, struct, whole=whole) if p.name == name), None)
            if match is None:
                return None
            struct, whole = self.layout.structs.get(str(match.type), struct), False
        return match

    @cached_property
    def limited(self) -> dict[str, Member]:
        """The numbers that have limits, by the dotted path of their field."""
        leaves = self.plan(self._least + self._step if self._step else self.size).leaves
        limited = (leaf for leaf in leaves if leaf.member.yellow or leaf.member.red)
        numbers = [leaf for leaf in limited if not leaf.member.text]
        return {
            ".".join(part for part in leaf.path if isinstance(part, str)): leaf.member for leaf in numbers
        }

    def values(self, member: Member) -> Mapping[int, str]:
        """Return the names of a member's values; empty if it is no enumeration."""
        enum = self.layout.enumeration(member)
        return enum.names if enum else {}

    def text(self, member: Member, value: Any) -> str:
        """Return a member's value as text for users, with its name, its unit or its calibrated value."""
        if isinstance(value, list):
            return "[" + ", ".join(self.text(member, item) for item in value) + "]"
        name = self.values(member).get(value) if isinstance(value, int) else None
        if member.base == 16 and isinstance(value, int):
            basic = self.layout.basic(member)
            number = f"0x{value:0{2 * basic.size if basic else 1}x}"
        else:
            number = f"{value:.9g}" if isinstance(value, float) else str(value)
        if member.polynomial:
            number = f"{f'{member.calibrated(value):.9g} {member.unit}'.rstrip()} ({number})"
        elif member.unit:
            number += f" {member.unit}"
        return f"{name} ({number})" if name else number

    def _row(self, member: Member) -> int:
        return (self.layout.size(member) if member.array or not member.text else 1) * member.row

    def _limit(self) -> int | None:
        """Return the longest payload that has at most ``MOST_VALUES`` values; None if no length has more."""
        counter = Counter(self.layout)
        spare = MOST_VALUES - counter.fixed(self.struct) - len(HEADER_FIELDS) - 1
        if spare < 0:
            name = f"{self.layout.origin}: {self.struct.name}"
            raise ConfigError(f"{name} holds more than {MOST_VALUES} values; bind a smaller one")
        each = counter.each(self._open) if self._open is not None else 0
        return self._least + spare // each * self._step if each else None

    def _end(self, member: Member) -> int:
        if member.bits:
            return member.offset + (member.bit + member.bits + 7) // 8
        if member is self._open:
            return member.offset
        return member.offset + member.count * self.layout.size(member)


class Held:
    """The packets of a batch that hold one struct.

    Args:
        bound: the struct.
        payloads: payloads of these packets; at least one.
        columns: returns a column of the decoder by name, one element a packet of the batch.
        data: u8, the buffer that the offsets of ``payloads`` point into.

    Attributes:
        bound: the struct.
        rows: rows of the packets in the batch.
        repeats: whether ``rows`` may name a packet several times, since a packet may hold several structs.
        size: bytes of each message if all payloads have one length and their messages one size; else 0.
    """

    def __init__(
        self, bound: Bound, payloads: StructPayloads, columns: Callable[[str], NDArray[Any]], data: Octets
    ) -> None:
        self.bound = bound
        self.rows = payloads.row
        self.repeats = bound.repeats
        self._columns = columns
        self._data = data
        self._offset, self._length = payloads.offset, payloads.length
        least, most = int(self._length.min()), int(self._length.max())
        self.size = bound.plan(most).size if least == most else 0

    def encode(self) -> Encoded:
        """Return the messages of all packets."""
        return self.bound.encode(self._data, self._offset, self._length, self._heads())

    def fill(self, rows: Octets) -> None:
        """Write the messages into ``rows``, u8 (n, size), which holds zeros; only if ``size`` is not 0."""
        length = int(self._length[0])
        self.bound.plan(length).fill(rows, _window(self._data, self._offset, length, self._heads()))

    def _heads(self) -> NDArray[np.void]:
        heads = np.empty(len(self.rows), HEAD)
        for field in HEADER_FIELDS:
            values = self._columns(field.name)[self.rows]
            heads[field.name] = values if values.dtype.kind == "u" else np.maximum(values, 0)
        return heads


def headed(payloads: Octets, heads: NDArray[np.void]) -> Octets:
    """Return each packet's head and payload, u8 (n, size), side by side."""
    return np.concatenate([heads.view(np.uint8).reshape(len(heads), HEAD.itemsize), payloads], axis=1)


def _window(data: Octets, offset: Integers, length: int, heads: NDArray[np.void]) -> Octets:
    """Return each packet's head and payload side by side, u8 (n, bytes of ``HEAD`` + ``length``)."""
    front = HEAD.itemsize
    if len(offset) and offset.min() >= front:  # the bytes in front are copied too, and overwritten
        window = gather(data, offset - front, front + length)
    else:
        window = np.empty((len(offset), front + length), np.uint8)
        if length:
            window[:, front:] = gather(data, offset, length)
    window[:, :front] = heads.view(np.uint8).reshape(len(heads), front)
    return window
