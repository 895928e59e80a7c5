"""The packets of a mission as flat lists of items, which every description of them is made from.

Rules:

1. Items follow each other without a gap: padding is an item, too.
2. An item behind a string has a place that depends on the string's length. CDR aligns what follows to at most
   8 bytes, so eight lists of items are enough, one for each remainder of that length by 8.
3. A list ends where a length cannot be described so: at a sequence, a wide string, or a third string. The
   rest of such a packet is left out, and the packet says so.
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
from edoras_tools.wire.cdr import CDR_LE, ENCAPSULATION
from edoras_tools.wire.cfe import EXTENDED, Headers, emit_command
from edoras_tools.wire.envelope import DEFAULT, EnvelopeFormat

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from edoras_tools.mission import Route
    from edoras_tools.ros import TypeStore
    from edoras_tools.structs.bound import Bound
    from edoras_tools.wire.layout import Layout

Encoding = Literal["uint", "int", "float", "bytes", "text"]
REMAINDERS: Final = 8
"""The largest alignment of CDR, in bytes."""
LENGTH_BYTES: Final = 4
"""Of a string."""
_MOST_STRINGS: Final = 2
_MOST_ELEMENTS: Final = 1024
_CODES: Final[dict[str, Encoding]] = {"f": "float", "d": "float", **dict.fromkeys("bhiq", "int")}
"""By ``struct`` code; others are unsigned."""
_KINDS: Final[dict[BasicKind, Encoding]] = {
    BasicKind.UINT: "uint",
    BasicKind.BOOL: "uint",
    BasicKind.CHAR: "uint",
    BasicKind.BYTE: "uint",
    BasicKind.INT: "int",
    BasicKind.FLOAT: "float",
}


class PacketItem(msgspec.Struct, frozen=True):
    """One value at a fixed place behind the items before it.

    Attributes:
        name: dotted; empty for padding.
        encoding: how its bytes are read; ``text`` ends at its first NUL.
        bits: its width.
        doc: one line.
        little: whether its least significant byte comes first.
        fixed: its bytes where a command always has the same; none where they are an argument.
        enum: names of its values, if they have some.
        member: of a struct, which has its unit, calibration and limits; None for none of them.
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
    """A CDR string: its length as u32, then so many bytes, the last of which is NUL.

    Attributes:
        name: dotted.
        after: the items behind it, by the remainder of its length divided by ``REMAINDERS``.
    """

    name: str
    after: tuple[Items, ...]


Items = tuple["PacketItem | StringItem", ...]


class GroundPacket(msgspec.Struct, frozen=True):
    """One packet.

    Attributes:
        name: of letters, digits and ``_``; unique.
        doc: what it is.
        msg_id: as of MsgId version 1.
        items: what follows the cFE header.
        whole: whether the items reach to its end.
        function_code: of a command.
    """

    name: str
    doc: str
    msg_id: int
    items: Items
    whole: bool = True
    function_code: int = 0

    @property
    def apid(self) -> int:
        """The APID that tells it apart."""
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
    """Return the fields of cFE's headers of telemetry, which follow the primary header."""
    return (header_items(EXTENDED) if headers.extended else ()) + header_items(headers.telemetry)


def command_header(packet: GroundPacket, headers: Headers) -> bytes:
    """Return the cFE header of a command of fixed size, checksum 0."""
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
    """Return a word of an envelope: both lengths are the CDR's, what is spare is 0."""
    value = 0 if "spare_" in item.name else cdr_bytes
    return value.to_bytes(item.bits // 8, "little" if item.little else "big")


def _steps(plan: CdrPlan, prefix: str = "") -> Iterator[tuple[str, PlanStep]]:
    """Yield the steps of a plan with the names' prefix, fixed arrays of messages step by step."""
    for step in plan.steps:
        if isinstance(step, Repeat) and step.count is not None and step.count <= _MOST_ELEMENTS:
            for place in range(step.count):
                yield from _steps(step.plan, f"{prefix}{step.name}[{place}].")
        else:
            yield prefix, step


def _cdr(steps: Sequence[tuple[str, PlanStep]], at: int, strings: int) -> tuple[Items, bool]:
    """Return the items of steps from a place on, which is known up to a multiple of ``REMAINDERS``."""
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
    """Yield each member alone, bit-fields that share bytes together."""
    unit: list[MessagePart] = []
    for part in members:
        if unit and not (part.member.bits and part.member.offset < _end(unit[-1].member)):
            yield unit
            unit = []
        unit.append(part)
    if unit:
        yield unit


def _end(member: Member) -> int:
    """Return the byte behind a bit-field; the first of other members."""
    return member.offset + (member.bits and (member.bit + member.bits + 7) // 8)


def _bit_fields(unit: Sequence[MessagePart], prefix: str, *, little: bool) -> PacketItem:
    """Return the number that bit-fields are in: compilers let them lie across bytes."""
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
