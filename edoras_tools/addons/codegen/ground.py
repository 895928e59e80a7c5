"""Descriptions of the packets of a mission for ground systems: XTCE, and COSMOS.

Both are made from flat lists of items. Rules:

1. Items follow each other without a gap: padding is an item, too.
2. The position of an item behind a string depends on the string's length. CDR aligns items to at most 8
   bytes, so eight lists are enough, one for each remainder of the length divided by 8.
3. A list ends in front of a length that cannot be described like this: a sequence, a wide string, or a third
   string. The rest of the packet is left out, and the packet has a note of it.

COSMOS: telemetry and commands of a target, a file of its folder ``cmd_tlm``. Rules:

1. Items follow each other without a gap; positions are written only for the remainder (rule 2).
2. A packet is identified by its packet type and its APID. A packet in which items follow a string is
   described eight times: for each remainder of the string's length divided by 8, which determines the
   padding behind it. The remainder identifies these packets too; their names end in 0 to 7.
3. Behind a second string, or another value of variable size, COSMOS cannot describe positions: the packet
   ends with the block of bytes that begins there.

XTCE 1.2 (OMG formal/2018-10-04): telemetry containers, and commands of fixed size.

The length of a string is read as its three low bits and the rest, least significant byte first. The low bits
select the container of the following items, because they determine its padding. Strings of more than 255
bytes end a packet.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Final, Literal
from xml.etree import ElementTree as ET

import msgspec
from msgspec.structs import replace

from edoras_tools.errors import ConfigError
from edoras_tools.ros.cdr.plan import CdrPlan, PlanStep, PrimitiveRun, Repeat, Text
from edoras_tools.structs.messages import MessagePart, parts
from edoras_tools.structs.shapes import BasicKind, Enumeration, Member, Range, Struct, StructLayout
from edoras_tools.wire import ccsds
from edoras_tools.wire.cfe import EXTENDED, Headers, emit_command
from edoras_tools.wire.envelope import CDR_LE, DEFAULT, ENCAPSULATION, EnvelopeFormat

if TYPE_CHECKING:
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


_TYPES: Final = {"uint": "UINT", "int": "INT", "float": "FLOAT", "bytes": "BLOCK", "text": "STRING"}
_RESERVED: Final = {
    *(f"{when}_TIME{how}" for when in ("PACKET", "RECEIVED") for how in ("", "SECONDS", "FORMATTED")),
    "RECEIVED_COUNT",
    "COSMOS_DATA_TAG",
    "COSMOS_EXTRA",
}
"""Names that COSMOS uses for its own items."""
_NUMBERS: Final = {"uint", "int", "float"}
_TELLING: Final = {"apid", "packet_type", "function_code"}
"""Header fields that identify a command."""


def cosmos(
    name: str, telemetry: Iterable[GroundPacket], commands: Iterable[GroundPacket], headers: Headers
) -> bytes:
    """Return the text of a target.

    Args:
        name: name of the target.
        telemetry: packets from cFS.
        commands: packets to cFS; each must be of fixed size.
        headers: headers of the cFE.
    """
    target = _plain(name)
    lines = [line for packet in telemetry for line in _telemetry(target, packet, headers)]
    lines += [line for packet in commands for line in _command(target, packet, headers)]
    return "".join(f"{line}\n" for line in lines).encode()


def _telemetry(target: str, packet: GroundPacket, headers: Headers) -> Iterator[str]:
    """Yield the lines of a packet, or of the packets for each remainder of its first string's length."""
    first = packet.items[-1] if packet.items else None
    if isinstance(first, StringItem) and any(first.after):
        for remainder in range(REMAINDERS):
            yield f"TELEMETRY {target} {_plain(packet.name)}_{remainder} LITTLE_ENDIAN {_quoted(packet.doc)}"
            yield from _Items().telemetry(packet, headers, remainder)
    else:
        yield f"TELEMETRY {target} {_plain(packet.name)} LITTLE_ENDIAN {_quoted(packet.doc)}"
        yield from _Items().telemetry(packet, headers, None)


class _Items:
    """The items of one packet, with unique names."""

    def __init__(self) -> None:
        self._used = set(_RESERVED)
        self._bits = 0

    def telemetry(self, packet: GroundPacket, headers: Headers, remainder: int | None) -> Iterator[str]:
        head = header_items(ccsds.PRIMARY) + telemetry_items(headers)
        ids = {"apid": packet.apid, "packet_type": ccsds.TELEMETRY_TYPE}
        yield from (self._item(item, ids.get(item.name)) for item in head)
        whole = packet.whole
        items: Items = packet.items
        while items:
            yield from (self._item(item) for item in items if isinstance(item, PacketItem))
            last, items = items[-1], ()
            if isinstance(last, StringItem):
                yield from self._string(last, remainder)
                if remainder is None:
                    whole = whole and not any(last.after)
                else:
                    items, remainder = last.after[remainder], None
        if not whole:
            yield self._line(PacketItem("rest", "bytes", 0, "all that follows"))

    def _string(self, string: StringItem, remainder: int | None) -> Iterator[str]:
        """Yield the lines of a string: its length, and its characters, including the NUL at their end."""
        doc = "bytes of the string, a NUL at its end included"
        length = PacketItem(f"{string.name}.length", "uint", 8 * LENGTH_BYTES, doc)
        name, begin = self._name(length), self._bits
        yield self._line(length, name=name)
        if remainder is not None:  # the last bits of its first byte
            low = PacketItem(f"{length.name}_low", "uint", REMAINDERS.bit_length() - 1, "its low bits, again")
            place = f"{self._name(low)} {begin + 8 - low.bits} {low.bits}"
            yield f"  ID_ITEM {place} UINT {remainder} {_quoted(low.doc)}"
            yield "    OVERLAP"
        yield self._line(PacketItem(string.name, "text", 0))
        yield f"    VARIABLE_BIT_SIZE {name}"

    def _item(self, item: PacketItem, told_by: int | None = None) -> str:
        return self._line(item) if told_by is None else self._line(item, "ID_ITEM", f" {told_by}")

    def constant(self, item: PacketItem, value: object, *, tells: bool = False) -> str:
        """Return a parameter with a constant value, which may identify a command."""
        if isinstance(value, bytes):
            return self._line(item, "PARAMETER", f" 0x{value.hex()}")
        return self._line(item, "ID_PARAMETER" if tells else "PARAMETER", f" {value} {value} {value}")

    def argument(self, item: PacketItem) -> str:
        """Return a parameter that the operator sets."""
        zero = "0.0" if item.encoding == "float" else "0"
        return self._line(item, "PARAMETER", f" MIN MAX {zero}" if item.encoding in _NUMBERS else ' ""')

    def _name(self, item: PacketItem) -> str:
        """Return a name for COSMOS: no ``_`` at its end, no two in a row, and different from all others."""
        plain_name = name = _plain(item.name or "padding")
        number = 1
        while name in self._used:
            number += 1
            name = f"{plain_name}_{number}"
        self._used.add(name)
        return name

    def _line(self, item: PacketItem, kind: str = "ITEM", values: str = "", name: str = "") -> str:
        self._bits += item.bits
        order = "" if item.little or item.bits <= 8 else " BIG_ENDIAN"
        head = f"  APPEND_{kind} {name or self._name(item)} {item.bits} {_TYPES[item.encoding]}{values}"
        states = {label.upper(): value for value, label in (item.enum.names.items() if item.enum else ())}
        lines = [f"    STATE {_quoted(label)} {value}" for label, value in states.items()]
        return "\n".join([f"{head} {_quoted(item.doc or item.name or 'alignment')}{order}", *lines])


def _plain(text: str) -> str:
    return "_".join(part for part in identifier(text).upper().split("_") if part) or "UNNAMED"


def _quoted(text: str) -> str:
    plain = " ".join(text.split()).replace('"', "'")
    return f'"{plain}"'


def _command(target: str, packet: GroundPacket, headers: Headers) -> Iterator[str]:
    head = command_header(packet, headers)
    yield f"COMMAND {target} {_plain(packet.name)} LITTLE_ENDIAN {_quoted(packet.doc)}"
    items = _Items()
    at = 0
    for layout in (ccsds.PRIMARY, *((EXTENDED,) if headers.extended else ()), headers.command):
        values = layout.parse(head, at)
        for item in header_items(layout):
            yield items.constant(item, values[item.name], tells=item.name in _TELLING)
        at += layout.size
    for part in packet.items:
        assert isinstance(part, PacketItem)
        if not part.fixed:
            yield items.argument(part)
        elif part.encoding == "bytes":
            yield items.constant(part, part.fixed)
        else:
            yield items.constant(part, int.from_bytes(part.fixed, "little" if part.little else "big"))


_NAMESPACE: Final = "http://www.omg.org/spec/XTCE/20180204"
_ROOT: Final = "CCSDSPacket"
_TELEMETRY: Final = "cFETelemetry"
_HIGH, _LOW, _REST = "length_high", "length_low", "length_rest"
_LENGTH: Final = (
    PacketItem(_HIGH, "uint", 5, "bytes of the string, a NUL at its end included: bits 3 to 7", little=False),
    PacketItem(_LOW, "uint", 3, "bits 0 to 2", little=False),
    PacketItem(_REST, "uint", 24, "bits 8 to 31: 0"),
)


def xtce(
    name: str, telemetry: Iterable[GroundPacket], commands: Iterable[GroundPacket], headers: Headers
) -> bytes:
    """Return the XML of a space system.

    Args:
        name: name of the space system.
        telemetry: packets from cFS.
        commands: packets to cFS; each must be of fixed size.
        headers: headers of the cFE.
    """
    return _System(name, headers).document(telemetry, commands)


class _System:
    def __init__(self, name: str, headers: Headers) -> None:
        self._headers = headers
        self._root = ET.Element("SpaceSystem", {"xmlns": _NAMESPACE, "name": identifier(name)})
        telemetry = ET.SubElement(self._root, "TelemetryMetaData")
        self._types = ET.SubElement(telemetry, "ParameterTypeSet")
        self._parameters = ET.SubElement(telemetry, "ParameterSet")
        self._containers = ET.SubElement(telemetry, "ContainerSet")
        self._known: set[str] = set()

    def document(self, telemetry: Iterable[GroundPacket], commands: Iterable[GroundPacket]) -> bytes:
        self._container(_ROOT, header_items(ccsds.PRIMARY), abstract=True)
        conditions = {"packet_type": ccsds.TELEMETRY_TYPE, "secondary_header_flag": 1}
        items = telemetry_items(self._headers)
        self._container(_TELEMETRY, items, base=_ROOT, conditions=conditions, abstract=True)
        for packet in telemetry:
            ids = {"apid": packet.apid}
            self._container(packet.name, packet.items, f"{packet.name}_", _TELEMETRY, ids, doc=packet.doc)
        some = list(commands)
        if some:
            self._commands(some)
        ET.indent(self._root)
        return b'<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(self._root) + b"\n"

    def _container(
        self,
        name: str,
        items: Items,
        prefix: str = "",
        base: str = "",
        conditions: dict[str, int] | None = None,
        *,
        doc: str = "",
        abstract: bool = False,
    ) -> ET.Element:
        """Append a container, and those of the items behind its string; return its entries."""
        container = ET.SubElement(self._containers, "SequenceContainer", {"name": name})
        if doc:
            container.set("shortDescription", doc)
        if abstract:
            container.set("abstract", "true")
        entries = ET.SubElement(container, "EntryList")
        for item in items:
            for part in _length_of(item) if isinstance(item, StringItem) else (item,):
                ET.SubElement(entries, "ParameterRefEntry", {"parameterRef": self._parameter(prefix, part)})
        if base:
            inherited = ET.SubElement(container, "BaseContainer", {"containerRef": base})
            criteria = ET.SubElement(ET.SubElement(inherited, "RestrictionCriteria"), "ComparisonList")
            for field, value in (conditions or {}).items():
                ET.SubElement(criteria, "Comparison", {"parameterRef": field, "value": str(value)})
        if items and isinstance(items[-1], StringItem):
            self._after(name, items[-1], prefix)
        return entries

    def _after(self, base: str, string: StringItem, prefix: str) -> None:
        """Append a container for each remainder of a string's length: its characters, and later items."""
        high, low, rest = (identifier(prefix + part.name) for part in _length_of(string))
        for remainder, items in enumerate(string.after):
            text = f"{prefix}{identifier(string.name)}"
            kind = f"string_{identifier(string.name)}_{prefix}{remainder}"
            self._string(kind, high, 8 * (remainder - 1))
            container = f"{base}_{remainder}"
            entry = f"{text}_{remainder}"
            self._declare(entry, kind, string.name)
            end = PacketItem("", "bytes", 8, "NUL")
            entries = self._container(container, (end, *items), prefix, base, {low: remainder, rest: 0})
            entries.insert(0, ET.Element("ParameterRefEntry", {"parameterRef": entry}))

    def _string(self, name: str, high: str, intercept_bits: int) -> None:
        if name in self._known:
            return
        self._known.add(name)
        string_type = ET.SubElement(self._types, "StringParameterType", {"name": name})
        encoding = ET.SubElement(string_type, "StringDataEncoding", {"encoding": "UTF-8"})
        variable = ET.SubElement(encoding, "Variable", {"maxSizeInBits": str(255 * 8)})
        dynamic = ET.SubElement(variable, "DynamicValue")
        ET.SubElement(dynamic, "ParameterInstanceRef", {"parameterRef": high})
        slope = {"slope": str(8 * REMAINDERS), "intercept": str(intercept_bits)}
        ET.SubElement(dynamic, "LinearAdjustment", slope)

    def _parameter(self, prefix: str, item: PacketItem) -> str:
        kind = _type_name(item)
        if kind not in self._known:
            self._known.add(kind)
            _data_type(self._types, "Parameter", kind, item)
        name = identifier(prefix + (item.name or f"padding_{item.bits // 8}"))
        self._declare(name, kind, item.doc or item.name)
        return name

    def _declare(self, name: str, kind: str, doc: str) -> None:
        if name not in self._known:
            self._known.add(name)
            attributes = {"name": name, "parameterTypeRef": kind, "shortDescription": doc}
            ET.SubElement(self._parameters, "Parameter", attributes)

    def _commands(self, packets: Sequence[GroundPacket]) -> None:
        meta = ET.SubElement(self._root, "CommandMetaData")
        types = ET.SubElement(meta, "ArgumentTypeSet")
        command_set = ET.SubElement(meta, "MetaCommandSet")
        declared: set[str] = set()
        for packet in packets:
            command = ET.SubElement(
                command_set, "MetaCommand", {"name": packet.name, "shortDescription": packet.doc}
            )
            arguments = ET.SubElement(command, "ArgumentList")
            container = ET.SubElement(command, "CommandContainer", {"name": f"{packet.name}_packet"})
            entries = ET.SubElement(container, "EntryList")
            _fixed(entries, command_header(packet, self._headers))
            for part in packet.items:
                assert isinstance(part, PacketItem)
                if part.fixed:
                    _fixed(entries, part.fixed)
                    continue
                kind = f"arg_{_type_name(part)}"
                if kind not in declared:
                    declared.add(kind)
                    _data_type(types, "Argument", kind, part)
                name = identifier(part.name)
                argument = {"name": name, "argumentTypeRef": kind, "shortDescription": part.doc or part.name}
                ET.SubElement(arguments, "Argument", argument)
                ET.SubElement(entries, "ArgumentRefEntry", {"argumentRef": name})


def _fixed(entries: ET.Element, value: bytes) -> None:
    fixed = {"binaryValue": value.hex().upper(), "sizeInBits": str(8 * len(value))}
    ET.SubElement(entries, "FixedValueEntry", fixed)


def _type_name(item: PacketItem) -> str:
    order = "" if item.bits <= 8 or item.encoding in {"bytes", "text"} else "_le" if item.little else "_be"
    words = [item.enum.name] if item.enum else []
    if item.member:
        words += [item.member.unit, *map(str, item.member.polynomial), item.member.limits]
    return "_".join([f"{item.encoding}{item.bits}{order}", *map(identifier, words)])


def _length_of(string: StringItem) -> list[PacketItem]:
    return [replace(part, name=f"{string.name}.{part.name}") for part in _LENGTH]


def _data_type(types: ET.Element, role: str, name: str, item: PacketItem) -> None:
    order = {} if item.bits <= 8 else {"byteOrder": "leastSignificantByteFirst"} if item.little else {}
    bits = {"sizeInBits": str(item.bits)}
    member = item.member if role == "Parameter" else None
    if item.encoding == "float":
        element = ET.SubElement(types, f"Float{role}Type", {"name": name, **bits})
        encoded = ET.SubElement(element, "FloatDataEncoding", {**bits, "encoding": "IEEE754_1985", **order})
    elif item.encoding in {"uint", "int"}:
        signed = item.encoding == "int"
        if item.enum:
            element = ET.SubElement(types, f"Enumerated{role}Type", {"name": name})
        elif member and member.polynomial:
            element = ET.SubElement(types, f"Float{role}Type", {"name": name})
        else:
            element = ET.SubElement(
                types, f"Integer{role}Type", {"name": name, "signed": str(signed).lower()}
            )
        encoding = "twosComplement" if signed else "unsigned"
        encoded = ET.SubElement(element, "IntegerDataEncoding", {**bits, "encoding": encoding, **order})
        if item.enum:
            listed = ET.SubElement(element, "EnumerationList")
            for value, label in item.enum.names.items():
                ET.SubElement(listed, "Enumeration", {"value": str(value), "label": label})
    elif item.encoding == "text":
        element = ET.SubElement(types, f"String{role}Type", {"name": name})
        encoded = ET.SubElement(element, "StringDataEncoding", {"encoding": "UTF-8"})
        size = ET.SubElement(encoded, "SizeInBits")
        ET.SubElement(ET.SubElement(size, "Fixed"), "FixedValue").text = str(item.bits)
        ET.SubElement(size, "TerminationChar").text = "00"
    else:
        element = ET.SubElement(types, f"Binary{role}Type", {"name": name})
        size = ET.SubElement(ET.SubElement(element, "BinaryDataEncoding"), "SizeInBits")
        ET.SubElement(size, "FixedValue").text = str(item.bits)
    if item.member and not item.enum and item.encoding in {"float", "uint", "int"}:
        _add_meaning(element, encoded, item.member, is_argument=member is None)


def _ends(limits: Range | None) -> dict[str, str]:
    pairs = zip(("minInclusive", "maxInclusive"), limits or (), strict=False)
    return {key: str(end) for key, end in pairs if end is not None}


def _add_meaning(element: ET.Element, encoded: ET.Element, member: Member, *, is_argument: bool) -> None:
    """Add the unit, calibration and limits of a type; an argument is sent uncalibrated."""
    if member.unit and not (is_argument and member.polynomial):
        element.insert(0, ET.Element("UnitSet"))
        ET.SubElement(element[0], "Unit").text = member.unit
    if is_argument:
        if (ends := _ends(member.red)) and not member.polynomial:
            ET.SubElement(ET.SubElement(element, "ValidRangeSet"), "ValidRange", ends)
        return
    if member.polynomial:
        calibrator = ET.SubElement(ET.SubElement(encoded, "DefaultCalibrator"), "PolynomialCalibrator")
        for exponent, coefficient in enumerate(member.polynomial):
            ET.SubElement(calibrator, "Term", {"coefficient": str(coefficient), "exponent": str(exponent)})
    if member.limits:
        alarms = ET.SubElement(ET.SubElement(element, "DefaultAlarm"), "StaticAlarmRanges")
        for tag, among in (("WarningRange", member.yellow), ("CriticalRange", member.red)):
            if limits := _ends(among):
                ET.SubElement(alarms, tag, limits)
