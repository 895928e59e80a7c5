"""Which packets hold which struct, and what they say: one packet or many."""

from __future__ import annotations

from functools import cache, cached_property
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from edoras_tools.errors import ConfigError
from edoras_tools.ros import TypeStore
from edoras_tools.ros.schema import Definition, complete_text
from edoras_tools.structs import cfe
from edoras_tools.structs.messages import (
    HEADER,
    HEADER_FIELDS,
    definition,
    header_definition,
    parts,
    type_name,
    unique,
)
from edoras_tools.structs.transcode import HEAD, Plan
from edoras_tools.wire import ccsds
from edoras_tools.wire.order import by_value
from edoras_tools.wire.window import gather

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from edoras_tools.structs.shapes import Key, Layout, Member, Struct

_MSG_IDS: Final = 65536


class Encoded(NamedTuple):
    """Messages one after the other.

    Attributes:
        data: u8, their CDR, encapsulation included.
        start: i64 (n,), where each starts.
        size: i64 (n,), its bytes.
    """

    data: NDArray[np.uint8]
    start: NDArray[np.int64]
    size: NDArray[np.int64]


class Bound:
    """A struct that lies in the packets of a MsgId.

    Args:
        key: which packets.
        layout: of the struct.
        struct: what lies in them.
        topic: where its messages go.
        type: their type, in full.

    Attributes:
        key: which packets.
        struct: what lies in them.
        topic: where its messages go.
        type: their type, in full.
        size: bytes of the payload, where it is not open to the end.
    """

    def __init__(self, key: Key, layout: Layout, struct: Struct, topic: str, type: str) -> None:  # noqa: A002
        self.key = key
        self.layout = layout
        self.struct = struct
        self.topic = topic
        self.type = type
        self._plans: dict[int, Plan] = {}
        members = parts(layout, struct, whole=True)
        self._open = members[-1].member if members and members[-1].open else None
        self.size = struct.size - struct.header
        self._least = max((self._end(part.member) for part in members), default=0)
        self._step = self._row(self._open) if self._open is not None else 0

    @property
    def name(self) -> str:
        """The struct's name without ``_t``."""
        return self.struct.name.removesuffix("_t")

    def fits(self, length: NDArray[np.integer[Any]] | int) -> NDArray[np.bool_]:
        """Tell which payload lengths hold this struct: exactly, or but for padding at its end."""
        length = np.asarray(length)
        fits: NDArray[np.bool_] = length >= self._least
        fits &= (length - self._least) % self._step == 0 if self._step else length <= self.size
        return fits

    @property
    def expected(self) -> str:
        """The payload length in words."""
        return f"{self._least} + n x {self._step}" if self._step else str(self.size)

    def plan(self, length: int) -> Plan:
        """Return how payloads of one length are read; the length fits.

        Raises:
            ConfigError: the struct spells out too many values.
        """
        if length not in self._plans:
            self._plans[length] = Plan(self.layout, self.struct, length)
        return self._plans[length]

    def encode(
        self,
        data: NDArray[np.uint8],
        offset: NDArray[np.int64],
        length: NDArray[np.integer[Any]],
        heads: NDArray[np.void],
    ) -> Encoded:
        """Return the messages of many packets.

        Args:
            data: u8, the buffer that holds them.
            offset: i64 (n,), where each payload starts.
            length: (n,) their bytes; all fit.
            heads: (n,) of ``HEAD``.
        """
        start, size = np.zeros(len(offset), np.int64), np.zeros(len(offset), np.int64)
        pieces, base = [], 0
        for one, rows in by_value(length):
            window = np.empty((len(rows), HEAD.itemsize + one), np.uint8)
            window[:, : HEAD.itemsize] = heads[rows].view(np.uint8).reshape(len(rows), -1)
            if one:
                window[:, HEAD.itemsize :] = gather(data, offset[rows], one)
            piece, at, size[rows] = self.plan(one).encode(window)
            start[rows] = at + base
            base += len(piece)
            pieces.append(piece)
        return Encoded(np.concatenate([*pieces, np.zeros(1, np.uint8)]), start, size)

    def encode_one(self, payload: bytes, origin: tuple[int, ...]) -> bytes:
        """Return the message of one packet.

        Args:
            payload: what follows the header; its length fits.
            origin: the values of ``HEADER_FIELDS``.
        """
        head = np.array(origin, HEAD).tobytes()
        window = np.frombuffer(head + payload, np.uint8).reshape(1, -1)
        return self.plan(len(payload)).encode(window)[0].tobytes()

    def spans(self, values: Mapping[str, Any], length: int) -> Iterator[tuple[str, Any, int, int, Member]]:
        """Yield every value of a message as (dotted path, value, start, end, member).

        Args:
            values: the message.
            length: bytes of the payload; places count from its start.
        """
        for leaf in self.plan(length).leaves:
            value: Any = values
            path = ""
            for part in leaf.path:
                value = value[part]
                path += f"[{part}]" if isinstance(part, int) else f".{part}"
            yield path.removeprefix("."), value, leaf.start, leaf.end, leaf.member

    def member(self, path: Sequence[str]) -> Member | None:
        """Return what a field of the message is, by its path without indices; None for the header's."""
        struct, whole, found = self.struct, True, None
        for name in path:
            found = next((p.member for p in parts(self.layout, struct, whole=whole) if p.name == name), None)
            if found is None:
                return None
            struct, whole = self.layout.structs.get(str(found.type), struct), False
        return found

    def values(self, member: Member) -> Mapping[int, str]:
        """Return what the values of a member mean."""
        enum = self.layout.enumeration(member)
        return enum.names if enum else {}

    def text(self, member: Member, value: Any) -> str:
        """Return a value as people read it."""
        if isinstance(value, list):
            return "[" + ", ".join(self.text(member, item) for item in value) + "]"
        name = self.values(member).get(value) if isinstance(value, int) else None
        if member.base == 16 and isinstance(value, int):
            basic = self.layout.basic(member)
            number = f"0x{value:0{2 * basic.size if basic else 1}x}"
        else:
            number = f"{value:.9g}" if isinstance(value, float) else str(value)
        return f"{name} ({number})" if name else number

    def _row(self, member: Member) -> int:
        size = self.layout.size(member) if member.array or not member.text else 1
        for count in member.array[1:]:
            size *= count
        return size

    def _end(self, member: Member) -> int:
        if member.bits:
            return member.offset + (member.bit + member.bits + 7) // 8
        if member is self._open:
            return member.offset
        return member.offset + member.count * self.layout.size(member)


class Structs:
    """The structs that are bound to packets; of layouts that name the same packets the first holds.

    Args:
        layouts: in that order.
        claimed: MsgIds that something else is on.

    Attributes:
        layouts: as given.
        all: every struct that is bound, by MsgId and function code.
        has: bool (65536,), MsgIds that one is bound to.

    Raises:
        ConfigError: a struct cannot become a message.
    """

    def __init__(self, layouts: Sequence[Layout] = (), claimed: frozenset[int] = frozenset()) -> None:
        self.layouts = tuple(layouts)
        self._claimed = claimed
        taken: dict[Key, Layout] = {}
        for layout in layouts:
            for key in layout.bindings:
                if key.msg_id not in claimed and not any(
                    key.msg_id == other.msg_id and owner is not layout for other, owner in taken.items()
                ):
                    taken[key] = layout
        often: dict[str, int] = {}
        for key, layout in taken.items():
            often[layout.bindings[key]] = often.get(layout.bindings[key], 0) + 1
        self._definitions: dict[str, Definition] = {}
        self._names: dict[tuple[int, str, bool], str] = {}
        self._taken: set[str] = set()
        bound = []
        for key, layout in sorted(
            taken.items(), key=lambda item: (item[0].msg_id, item[0].function_code or 0)
        ):
            struct = layout.structs[layout.bindings[key]]
            name = struct.name.removesuffix("_t")
            topic = f"/cfs/{name}" + (f"/{key}".replace("/0x", "/x", 0) if often[struct.name] > 1 else "")
            bound.append(Bound(key, layout, struct, topic, self.define(layout, struct, whole=True)))
        self.all: tuple[Bound, ...] = tuple(bound)
        self._by_id: dict[int, list[Bound]] = {}
        for item in sorted(bound, key=lambda item: item.key.function_code is None):
            self._by_id.setdefault(item.key.msg_id, []).append(item)
        self.has: NDArray[np.bool_] = np.zeros(_MSG_IDS, np.bool_)
        self.has[list(self._by_id)] = True

    def define(self, layout: Layout, struct: Struct, *, whole: bool) -> str:
        """Make the definition of a struct's message, and of all that it uses; return its type in full."""
        return self._define(layout, struct, whole, ())

    @cached_property
    def types(self) -> TypeStore:
        """The types of the messages."""
        texts = {
            name: complete_text([item, *(other for other in self._definitions.values() if other is not item)])
            for name, item in list(self._definitions.items())[:1]
        }
        return TypeStore(definitions=texts)

    @property
    def definitions(self) -> Mapping[str, Definition]:
        """Every definition by type."""
        return self._definitions

    def find(self, msg_id: int, function_code: int | None, length: int) -> Bound | None:
        """Return the struct that should lie in a packet whose payload has so many bytes.

        A packet that is all header is a request or a wake-up, unless its function code is a struct's own.
        """
        for item in self._by_id.get(msg_id, ()):
            if (length > 0) if item.key.function_code is None else item.key.function_code == function_code:
                return item
        return None

    def name(self, msg_id: int) -> str:
        """Return what packets of a MsgId hold, in short; nothing where that is not known."""
        return " or ".join(item.name for item in self._by_id.get(msg_id, ()))

    def unclaimed(self, msg_ids: Iterable[int]) -> Structs:
        """Return these but for the MsgIds that something else claims."""
        claimed = frozenset(msg_ids) & self._by_id.keys() - {*self._claimed}
        return Structs(self.layouts, self._claimed | claimed) if claimed else self

    def split(
        self, rows: NDArray[np.intp], columns: Callable[[str], NDArray[Any]]
    ) -> Iterator[tuple[Bound, NDArray[np.intp], NDArray[np.bool_]]]:
        """Yield every struct that should lie in some of many packets.

        Args:
            rows: packets whose MsgIds have a struct, where ``has`` says so; increasing.
            columns: gives the decoder's by name.

        Yields:
            the struct; which of ``rows`` should hold it; bool, which of those are as long as it is.
        """
        header = columns("header_length")[rows]
        rows = rows[header > ccsds.PRIMARY.size]
        for value, members in by_value(columns("msg_id")[rows]):
            left = rows[members]
            for item in self._by_id[value]:
                code = item.key.function_code
                length = columns("packet_length")[left] - columns("header_length")[left]
                chosen = length > 0 if code is None else columns("function_code")[left] == code
                if chosen.any():
                    yield item, left[chosen], item.fits(length[chosen])
                left = left[~chosen]

    def messages(
        self, rows: NDArray[np.intp], columns: Callable[[str], NDArray[Any]], data: NDArray[np.uint8]
    ) -> Iterator[tuple[Bound, NDArray[np.intp], Encoded]]:
        """Yield the messages of many packets, a struct at a time.

        Args:
            rows: packets whose MsgIds have a struct; increasing.
            columns: gives the decoder's by name.
            data: u8, what they point into.

        Yields:
            the struct; which of ``rows`` hold it; their messages.
        """
        for item, members, fits in self.split(rows, columns):
            members = members[fits]  # noqa: PLW2901  only these hold it
            if not len(members):
                continue
            heads = np.empty(len(members), HEAD)
            for field in HEADER_FIELDS:
                heads[field.name] = np.maximum(columns(field.name)[members], 0)
            header = columns("header_length")[members]
            offset, length = (
                columns("packet_offset")[members] + header,
                columns("packet_length")[members] - header,
            )
            yield item, members, item.encode(data, offset, length, heads)

    def _define(self, layout: Layout, struct: Struct, whole: bool, within: tuple[str, ...]) -> str:
        key = (id(layout), struct.name, whole)
        if key in self._names:
            return self._names[key]
        if struct.name in within:
            raise ConfigError(f"{layout.origin}: {struct.name} contains itself")
        package = f"{layout.package}/msg/"
        name = self._names[key] = package + self._free(package, type_name(struct.name))
        names = {}
        if whole:
            names[HEADER] = package + HEADER
            self._taken.add(names[HEADER])
        inside = (*within, struct.name)
        for part in parts(layout, struct, whole=whole):
            nested = layout.structs.get(str(part.member.type))
            if nested is not None:
                names[nested.name] = self._define(layout, nested, False, inside)
        self._definitions[name] = definition(layout, struct, name, names, whole=whole)
        if whole and names[HEADER] not in self._definitions:
            self._definitions[names[HEADER]] = header_definition(names[HEADER])
        return name

    def _free(self, package: str, name: str) -> str:
        found = unique(package + name, self._taken | {package + HEADER})
        self._taken.add(found)
        return found.removeprefix(package)


@cache
def shipped() -> Structs:
    """Return the structs of what cFE itself sends."""
    return Structs([cfe.shipped()])
