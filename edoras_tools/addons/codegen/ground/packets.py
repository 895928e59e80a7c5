"""The packets of a mission as flat lists of items, from which every description is made.

Rules:

1. Items follow each other without a gap: padding is an item, too.
2. The position of an item behind a string depends on the string's length. CDR aligns items to at most 8
   bytes, so eight lists are enough, one for each remainder of the length divided by 8.
3. A list ends in front of a length that cannot be described like this: a sequence, a wide string, or a third
   string. The rest of the packet is left out, and the packet has a note of it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Literal

import msgspec
from msgspec.structs import replace

from edoras_tools.errors import ConfigError
from edoras_tools.ros.cdr.plan import CdrPlan, PlanStep, PrimitiveRun, Repeat, Text
from edoras_tools.structs.messages import MessagePart, parts
from edoras_tools.structs.shapes import BasicKind, Enumeration, Member, Struct, StructLayout
from edoras_tools.wire import ccsds
from edoras_tools.wire.cfe import EXTENDED, Headers, emit_command
from edoras_tools.wire.envelope import CDR_LE, DEFAULT, ENCAPSULATION, EnvelopeFormat

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from edoras_tools.mission import Route
    from edoras_tools.ros import TypeStore
    from edoras_tools.structs.bindings import Bound
    from edoras_tools.wire.layout import Layout

Encoding = Literal["uint", "int", "float", "bytes", "text"]
REMAINDERS: Final = 8
"""Largest alignment of CDR, bytes."""
LENGTH_BYTES: Final = 4
"""Size of a string's length, bytes."""
_MOST_STRINGS: Final = 2
_MOST_ELEMENTS: Final = 1024
_CODES: Final[dict[str, Encoding]] = {"f": "float", "d": "float", **dict.fromkeys("bhiq", "int")}
"""Encodings by ``struct`` code; other codes are unsigned."""
_KINDS: Final[dict[BasicKind, Encoding]] = {
    BasicKind.UINT: "uint",
    BasicKind.BOOL: "uint",
    BasicKind.CHAR: "uint",
    BasicKind.BYTE: "uint",
    BasicKind.INT: "int",
    BasicKind.FLOAT: "float",
}


class PacketItem(msgspec.Struct, frozen=True):
    """One value, directly behind the items before it.

    Attributes:
        name: dotted name; empty for padding.
        encoding: encoding of its bytes; ``text`` ends at its first NUL.
        bits: width in bits.
        doc: description, one line.
        little: whether it is little-endian.
        fixed: constant bytes in a command; empty if they are an argument.
        enum: names of its values, if any.
        member: struct member with unit, calibration and limits; None if it has none of them.
    """

    name: str
    encoding: Encoding
    bits: int
    doc: str = ""
    little: bool = True
    fixed: bytes = b""
    enum: Enumeration | None = None
    member: Member | None = None


class StringItem(msgspec.Struct, frozen=True):
    """A CDR string: its length as u32, then that number of bytes, the last of which is NUL.

    Attributes:
        name: dotted name.
        after: items behind it, by the remainder of its length divided by ``REMAINDERS``.
    """

    name: str
    after: tuple[Items, ...]


Items = tuple["PacketItem | StringItem", ...]


class GroundPacket(msgspec.Struct, frozen=True):
    """One packet.

    Attributes:
        name: unique name of letters, digits and ``_``.
        doc: description.
        msg_id: MsgId of version 1.
        items: items behind the cFE header.
        whole: whether the items cover the whole packet.
        function_code: function code of a command.
    """

    name: str
    doc: str
    msg_id: int
    items: Items
    whole: bool = True
    function_code: int = 0

    @property
    def apid(self) -> int:
        """APID of the packet."""
        return self.msg_id & ccsds.PRIMARY.by_name["apid"].mask


def identifier(text: str) -> str:
    """Return a name of letters, digits and ``_``."""
    return "".join(letter if letter.isalnum() and letter.isascii() else "_" for letter in text.strip("/"))


def header_items(layout: Layout) -> tuple[PacketItem, ...]:
    """Return the fields of a header."""
    little = layout.byte_order == "little"
    kinds: dict[str, Encoding] = {"uint": "uint", "int": "int", "float": "float", "text": "text"}
    return tuple(
        PacketItem(
            slot.field.name, kinds.get(slot.field.kind, "bytes"), slot.field.bits, slot.field.doc, little
        )
        for slot in layout.slots
    )


def telemetry_items(headers: Headers) -> tuple[PacketItem, ...]:
    """Return the fields of cFE's telemetry headers behind the primary header."""
    return (header_items(EXTENDED) if headers.extended else ()) + header_items(headers.telemetry)


def command_header(packet: GroundPacket, headers: Headers) -> bytes:
    """Return the cFE header of a command of fixed size, with checksum 0."""
    size = sum(item.bits for item in packet.items if isinstance(item, PacketItem)) // 8
    code = packet.function_code
    whole = emit_command(
        packet.msg_id, code, bytes(size), sequence_flags=0, with_checksum=False, headers=headers
    )
    return whole[: headers.command_bytes]


def route_packet(route: Route, types: TypeStore, function_code: int) -> GroundPacket:
    """Return the packet of a route: the envelope, CDR's encapsulation, then the message's fields."""
    envelope = DEFAULT if route.envelope in {None, "auto"} else EnvelopeFormat.of_name(str(route.envelope))
    if envelope.crc:
        raise ConfigError(f"{route.topic}: a CRC behind the message, which ground systems cannot describe")
    _, plan = types.plan(route.type)
    body, whole = _cdr(tuple(_steps(plan)), 0, 0)
    cdr = ENCAPSULATION.size + sum(item.bits for item in body if isinstance(item, PacketItem)) // 8
    representation = ENCAPSULATION.emit({"representation": CDR_LE, "options": 0})
    head = (
        *(replace(item, fixed=_word(item, cdr)) for item in header_items(envelope.layout)),
        PacketItem("encapsulation", "bytes", 32, "of the CDR", fixed=representation),
    )
    doc = f"{route.topic}, {route.type}"
    return GroundPacket(identifier(route.topic), doc, route.msg_id, head + body, whole, function_code)


def _word(item: PacketItem, cdr_bytes: int) -> bytes:
    """Return a word of an envelope: both lengths are the CDR's, spare words are 0."""
    value = 0 if "spare_" in item.name else cdr_bytes
    return value.to_bytes(item.bits // 8, "little" if item.little else "big")


def _steps(plan: CdrPlan, prefix: str = "") -> Iterator[tuple[str, PlanStep]]:
    """Yield the steps of a plan with prefixed names; fixed arrays of messages are unrolled."""
    for step in plan.steps:
        if isinstance(step, Repeat) and step.count is not None and step.count <= _MOST_ELEMENTS:
            for place in range(step.count):
                yield from _steps(step.plan, f"{prefix}{step.name}[{place}].")
        else:
            yield prefix, step


def _cdr(steps: Sequence[tuple[str, PlanStep]], at: int, strings: int) -> tuple[Items, bool]:
    """Return the items of steps from a position on, which is known modulo ``REMAINDERS``."""
    items: list[PacketItem | StringItem] = []
    for number, (prefix, step) in enumerate(steps):
        if isinstance(step, PrimitiveRun):
            items += _padding(-at % step.alignment)
            items += _run(prefix, step)
            at += -at % step.alignment + step.size
        elif isinstance(step, Text) and step.width == 1 and strings < _MOST_STRINGS:
            items += _padding(-at % LENGTH_BYTES)
            begin = at + -at % LENGTH_BYTES + LENGTH_BYTES
            after = [_cdr(steps[number + 1 :], begin + rest, strings + 1) for rest in range(REMAINDERS)]
            items.append(StringItem(prefix + step.name, tuple(follow for follow, _ in after)))
            return tuple(items), all(whole for _, whole in after)
        else:
            return tuple(items), False
    return tuple(items), True


def _padding(size: int) -> Iterator[PacketItem]:
    if size:
        yield PacketItem("", "bytes", 8 * size, "alignment", fixed=bytes(size))


def _run(prefix: str, run: PrimitiveRun) -> Iterator[PacketItem]:
    at = 0
    for leaf in run.leaves:
        yield from _padding(leaf.offset - at)
        at = leaf.end
        encoding = _CODES.get(leaf.code, "uint")
        if leaf.count is None:
            yield PacketItem(prefix + leaf.name, encoding, 8 * leaf.size)
        elif leaf.count > _MOST_ELEMENTS:
            yield PacketItem(prefix + leaf.name, "bytes", 8 * leaf.size * leaf.count)
        else:
            for place in range(leaf.count):
                yield PacketItem(f"{prefix}{leaf.name}[{place}]", encoding, 8 * leaf.size)


def struct_packet(bound: Bound) -> GroundPacket:
    """Return the packet of a C struct; an open array ends it."""
    struct = bound.struct
    items, whole = _members(bound.layout, struct, "", whole=True)
    name, doc = identifier(bound.topic.removeprefix("/cfs/")), struct.doc or struct.name
    return GroundPacket(name, doc, bound.key.msg_id, items, whole, bound.key.function_code or 0)


def _members(layout: StructLayout, struct: Struct, prefix: str, *, whole: bool) -> tuple[Items, bool]:
    if struct.union:
        return (PacketItem(prefix.removesuffix(".") or "union", "bytes", 8 * struct.size, struct.doc),), True
    items: list[PacketItem | StringItem] = []
    at = 0
    for unit in _units(parts(layout, struct, whole=whole)):
        name, member, is_open = unit[0]
        if is_open:
            return tuple(items), False
        items += _padding(member.offset - at)
        if member.bits:
            field = _bit_fields(unit, prefix, little=layout.is_little(member))
            items.append(field)
            at = member.offset + field.bits // 8
            continue
        some, full = _elements(layout, member, prefix + name)
        items += some
        if not full:
            return tuple(items), False
        at = member.offset + layout.size(member) * member.count
    items += _padding(struct.size - (struct.header if whole else 0) - at)
    return tuple(items), True


def _units(members: Iterable[MessagePart]) -> Iterator[list[MessagePart]]:
    """Yield each member alone, but bit-fields that share bytes together."""
    unit: list[MessagePart] = []
    for part in members:
        if unit and not (part.member.bits and part.member.offset < _end(unit[-1].member)):
            yield unit
            unit = []
        unit.append(part)
    if unit:
        yield unit


def _end(member: Member) -> int:
    """Return the byte behind a bit-field; for other members the first byte."""
    return member.offset + (member.bits and (member.bit + member.bits + 7) // 8)


def _bit_fields(unit: Sequence[MessagePart], prefix: str, *, little: bool) -> PacketItem:
    """Return the number that contains some bit-fields, because compilers let them cross bytes."""
    begin = unit[0].member.offset
    size = _end(unit[-1].member) - begin
    places = (
        f"{part.name} {part.member.bits} from {8 * (part.member.offset - begin) + part.member.bit}"
        for part in unit
    )
    doc = f"bits, the {'least' if little else 'most'} significant is 0: {', '.join(places)}"
    encoding: Encoding = "uint" if size in {1, 2, 4, 8} else "bytes"
    return PacketItem(prefix + "_".join(part.name for part in unit), encoding, 8 * size, doc, little)


def _elements(layout: StructLayout, member: Member, name: str) -> tuple[Items, bool]:
    """Return the items of a member, one for each element of an array."""
    names = [f"{name}[{place}]" for place in range(member.count)] if member.array else [name]
    basic, little = layout.basic(member), layout.is_little(member)
    if basic is None:
        struct = layout.structs[str(member.type)]
        inner = [_members(layout, struct, f"{item}.", whole=False) for item in names]
        return tuple(item for some, _ in inner for item in some), all(whole for _, whole in inner)
    encoding: Encoding = "text" if member.text else _KINDS[basic.kind]
    bits = 8 * layout.size(member)
    if member.count > _MOST_ELEMENTS:
        return (PacketItem(name, "bytes", bits * member.count, member.doc),), True
    enum = layout.enumeration(member)
    more = member if member.unit or member.polynomial or member.limits else None
    items = (PacketItem(item, encoding, bits, member.doc, little, enum=enum, member=more) for item in names)
    return tuple(items), True
