"""C structs as ROS messages: names that rosidl takes, and the definitions.

A struct that lies in a packet becomes a message that begins with ``CfsHeader`` in the place of cFE's own:
which packet it was, and from where. One that then holds nothing but ``Payload`` becomes what that holds. A
union's members stand side by side, each read from the same bytes. Arrays of several dimensions become flat
ones, texts become strings.
"""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING, Final, NamedTuple

from edoras_tools.ros.schema import Constant, Definition, Field, Shape
from edoras_tools.structs.shapes import OPEN, Basic, Kind, Layout, Member, Struct

if TYPE_CHECKING:
    from collections.abc import Iterable

HEADER: Final = "CfsHeader"
HEADER_FIELDS: Final = (
    Field("processor_id", "uint32"),
    Field("msg_id", "uint16"),
    Field("sequence_count", "uint16"),
    Field("function_code", "uint8"),
    Field("link", "uint8"),
)
"""What every message of a packet begins with: SBN ProcessorID of the sender (0 where it came without SBN),
MsgId, packet sequence count, function code of a command, and the ``Link``."""
LINKS: Final = ("OTHER", "CI", "TO", "SBN")

_WORD: Final = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")


class Part(NamedTuple):
    """A member as part of a message.

    Attributes:
        name: of the field.
        member: with the offset from the start of the packet's payload, or of the nested struct.
        open: whether it is a sequence that goes on to the end of the packet.
    """

    name: str
    member: Member
    open: bool


def type_name(name: str) -> str:
    """Return a struct's name as rosidl takes it: ``CFE_ES_HousekeepingTlm_t`` is ``CfeEsHousekeepingTlm``."""
    words = [item for item in name.removesuffix("_t").split("_") if item]
    text = "".join(item.capitalize() if item.isupper() else item[0].upper() + item[1:] for item in words)
    return text if text[:1].isalpha() else f"C{text}"


def field_name(name: str) -> str:
    """Return a member's name as rosidl takes it: ``ERLogIndex`` is ``er_log_index``."""
    words: list[str] = []
    for part in filter(None, name.split("_")):
        for match in _WORD.finditer(part):
            if words and match[0].isdigit() and match.start():
                words[-1] += match[0]  # a number belongs to the word before it
            else:
                words.append(match[0].lower())
    text = "_".join(words)
    return text if text[:1].isalpha() else f"m_{text}"


def unique(name: str, taken: set[str]) -> str:
    """Return a name, with a number where it is taken already; then it is taken."""
    found, number = name, 2
    while found in taken:
        found, number = f"{name}{number}", number + 1
    taken.add(found)
    return found


def parts(layout: Layout, struct: Struct, *, whole: bool) -> list[Part]:
    """Return what a message of a struct holds, in the order of its declaration.

    Args:
        layout: of the struct.
        struct: the struct.
        whole: it lies in a packet: its header is left out, ``Payload`` opened, the last array may be open.
    """
    members: Iterable[Member] = struct.members
    shift = struct.header if whole else 0
    if whole:
        shown = [item for item in members if item.offset >= struct.header]
        inner = layout.structs.get(str(shown[0].type)) if len(shown) == 1 else None
        if inner is not None and not shown[0].dims and shown[0].name.lower() == "payload":
            shift -= shown[0].offset
            shown, struct = list(inner.members), inner
        members = shown
    taken = {"header"} if whole else set()
    found = []
    for item in members:
        is_open = whole and not struct.union and item is struct.members[-1] and OPEN in item.dims
        if layout.size(item) * item.count == 0 and not is_open and not _empty(layout, item):
            continue
        name = unique(field_name(item.name), taken)
        found.append(Part(name, replace(item, offset=item.offset - shift), is_open))
    return found


def _empty(layout: Layout, member: Member) -> bool:
    """Tell whether a member is a struct without members, which is a message all the same."""
    return member.count > 0 and str(member.type) in layout.structs


def definition(
    layout: Layout, struct: Struct, name: str, names: dict[str, str], *, whole: bool
) -> Definition:
    """Return the message definition of a struct.

    Args:
        layout: of the struct.
        struct: the struct.
        name: the message's type in full.
        names: types in full of the structs that it uses, and of the header, by name.
        whole: as for :func:`parts`.
    """
    fields = [Field("header", names[HEADER])] if whole else []
    constants: list[Constant] = []
    for part in parts(layout, struct, whole=whole):
        kind, shape, size = _type(layout, part.member, names), Shape.SCALAR, 0
        if part.open and part.member.array:
            shape = Shape.SEQUENCE
        elif part.member.array:
            shape, size = Shape.ARRAY, part.member.count
        fields.append(Field(part.name, kind, 0, shape, size))
        enum = layout.enumeration(part.member)
        if enum is not None:
            taken = {item.name for item in constants}
            constants += [
                Constant(unique(f"{part.name}_{field_name(label)}".upper(), taken), kind, value)
                for value, label in enum.names.items()
                if _fits(value, enum.basic)
            ]
    return Definition(name, tuple(fields), tuple(constants))


def header_definition(name: str) -> Definition:
    """Return the definition of the header."""
    links = tuple(Constant(f"LINK_{text}", "uint8", value) for value, text in enumerate(LINKS))
    return Definition(name, HEADER_FIELDS, links)


def _fits(value: int, basic: Basic) -> bool:
    bits = 8 * basic.size
    low = -(1 << (bits - 1)) if basic.kind is Kind.INT else 0
    return low <= value < low + (1 << bits)


def _type(layout: Layout, member: Member, names: dict[str, str]) -> str:
    if member.text:
        return "string"
    basic = layout.basic(member)
    return primitive(basic) if basic is not None else names[str(member.type)]


def primitive(basic: Basic) -> str:
    """Return the ROS type of a basic type."""
    if basic.kind is Kind.BOOL:
        return "bool"
    if basic.kind in {Kind.CHAR, Kind.BYTE}:
        return "uint8"
    return str(basic)
