"""The packets of a mission as flat lists of items, which every description of them is made from.

Rules:

1. Items follow each other without a gap: padding is an item, too.
2. An item behind a string has a place that depends on the string's length. CDR aligns what follows to at most
   8 bytes, so eight lists of items are enough, one for each remainder of that length by 8.
3. A list ends where a length cannot be described so: at a sequence, a wide string, or a third string. The
   rest of such a packet is left out, and the packet says so.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

from edoras_tools.ros.cdr.plan import PrimitiveRun, Repeat, Text
from edoras_tools.structs.shapes import BasicKind
from edoras_tools.wire import ccsds
from edoras_tools.wire.cdr import CDR_LE, ENCAPSULATION
from edoras_tools.wire.cfe import EXTENDED, emit_command
from edoras_tools.wire.envelope import DEFAULT, EnvelopeFormat

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from edoras_tools.mission import Route
    from edoras_tools.ros import TypeStore
    from edoras_tools.ros.cdr.plan import CdrPlan, PlanStep
    from edoras_tools.structs.shapes import Key, Member, StructLayout
    from edoras_tools.wire.cfe import Headers
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


@dataclass(frozen=True, slots=True)
class PacketItem:
    """One value at a fixed place behind the items before it.

    Attributes:
        name: dotted; empty for padding.
        encoding: how its bytes are read; ``text`` ends at its first NUL.
        bits: its width.
        doc: one line.
        little: whether its least significant byte comes first.
    """

    name: str
    encoding: Encoding
    bits: int
    doc: str = ""
    little: bool = True


@dataclass(frozen=True, slots=True)
class StringItem:
    """A CDR string: its length as u32, then so many bytes, the last of which is NUL.

    Attributes:
        name: dotted.
        after: the items behind it, by the remainder of its length divided by ``REMAINDERS``.
    """

    name: str
    after: tuple[Items, ...]


Items = tuple["PacketItem | StringItem", ...]


@dataclass(frozen=True, slots=True)
class GroundPacket:
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


def command_parts(packet: GroundPacket, headers: Headers) -> list[bytes | PacketItem]:
    """Return the parts of a command of fixed size: bytes that are always the same, and arguments.

    The first part is all in front of the message: cFE's headers, the envelope and CDR's encapsulation.
    """
    items = [item for item in packet.items if isinstance(item, PacketItem)]
    lengths, values = items[:2], items[3:]  # the envelope, CDR's encapsulation, the message
    size = sum(item.bits for item in items) // 8
    cdr = size - sum(item.bits for item in lengths) // 8
    whole = emit_command(
        packet.msg_id,
        packet.function_code,
        bytes(size),
        sequence_flags=0,
        with_checksum=False,
        headers=headers,
    )
    head = [cdr.to_bytes(item.bits // 8, "little" if item.little else "big") for item in lengths]
    encapsulation = ENCAPSULATION.emit({"representation": CDR_LE, "options": 0})
    return [
        whole[: headers.command_bytes] + b"".join(head) + encapsulation,
        *(item if item.name else bytes(item.bits // 8) for item in values),
    ]


def route_packet(route: Route, types: TypeStore, function_code: int) -> GroundPacket:
    """Return the packet of a route: the envelope, CDR's encapsulation, then the message's fields."""
    envelope = DEFAULT if route.envelope in {None, "auto"} else EnvelopeFormat.named(str(route.envelope))
    head = (*header_items(envelope.layout), PacketItem("encapsulation", "bytes", 32, "of the CDR"))
    _, plan = types.plan(route.type)
    body, whole = _cdr(tuple(_steps(plan)), 0, 0)
    doc = f"{route.topic}, {route.type}"
    return GroundPacket(identifier(route.topic), doc, route.msg_id, head + body, whole, function_code)


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
        yield PacketItem("", "bytes", 8 * size, "alignment")


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


def struct_packet(key: Key, layout: StructLayout) -> GroundPacket:
    """Return the packet of a C struct; bit-fields and open arrays end it."""
    struct = layout.structs[layout.bindings[key]]
    items, whole = _members(layout, struct.name, "", struct.header)
    return GroundPacket(identifier(struct.name), struct.doc or struct.name, key.msg_id, items, whole)


def _members(layout: StructLayout, name: str, prefix: str, at: int = 0) -> tuple[Items, bool]:
    struct = layout.structs[name]
    items: list[PacketItem | StringItem] = []
    for member in struct.members:
        if member.offset < at or member.bits or (member.dims and not member.count):
            return tuple(items), False
        items += _padding(member.offset - at)
        some, whole = _elements(layout, member, prefix + member.name)
        items += some
        if not whole:
            return tuple(items), False
        at = member.offset + layout.size(member) * (member.count if member.array else 1)
    items += _padding(struct.size - at)
    return tuple(items), True


def _elements(layout: StructLayout, member: Member, name: str) -> tuple[Items, bool]:
    """Return the items of a member, one for each element of an array."""
    count = member.count if member.array else 1
    names = [f"{name}[{place}]" for place in range(count)] if member.array else [name]
    basic, little = layout.basic(member), layout.byte_order == "little"
    if basic is None:
        parts = [_members(layout, str(member.type), f"{item}.") for item in names]
        return tuple(item for some, _ in parts for item in some), all(whole for _, whole in parts)
    encoding: Encoding = "text" if member.text else _KINDS[basic.kind]
    bits = 8 * layout.size(member)
    if count > _MOST_ELEMENTS:
        return (PacketItem(name, "bytes", bits * count, member.doc),), True
    return tuple(PacketItem(item, encoding, bits, member.doc, little) for item in names), True
