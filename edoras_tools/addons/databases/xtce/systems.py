"""Reads XTCE: containers and commands of space systems become structs; APID and function code give packets.

1. All files are read together. The entries of a container, or of a command, follow those of its base.
2. Conditions and assignments on the first 16 bits give the MsgId. A container with a condition on anything
   else applies only to some packets: its base describes all of them.
3. cFE's header is not part of a struct: it ends where the container with the condition on the APID begins.
4. Anything that cannot be read is noted with file and line; all the rest is read.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Final, NamedTuple

import msgspec
from msgspec.structs import replace

from edoras_tools.addons.databases import placement
from edoras_tools.addons.databases.xtce import types
from edoras_tools.errors import ConfigError
from edoras_tools.structs.files import Database
from edoras_tools.structs.shapes import BASIC, COMMANDED, PACKETS, ByteOrder, Key, StructLayout
from edoras_tools.wire import ccsds

_READ: Final = frozenset(
    """
    Argument ArgumentAssignment ArgumentAssignmentList ArgumentList ArgumentRefEntry ArgumentTypeSet
    ArrayArgumentRefEntry ArrayParameterRefEntry BaseContainer BaseMetaCommand BinaryDataEncoding
    CommandContainer CommandContainerSet CommandMetaData Comparison ComparisonList ContainerRefEntry
    ContainerSet CriticalRange DefaultAlarm DefaultCalibrator Dimension DimensionList DistressRange
    Encoding EndingIndex EntryList Enumeration EnumerationList Fixed FixedValue FixedValueEntry
    FloatDataEncoding IntegerDataEncoding LocationInContainerInBits Member MemberList MetaCommand
    MetaCommandSet Parameter ParameterRefEntry ParameterSet ParameterTypeSet PolynomialCalibrator
    RestrictionCriteria SequenceContainer SevereRange SizeInBits SpaceSystem StartingIndex
    StaticAlarmRanges StringDataEncoding TelemetryMetaData Term TerminationChar Unit UnitSet ValidRange
    ValidRangeSet WarningRange WatchRange
    """.split()  # noqa: SIM905  read as a text
).union(f"{kind}{role}Type" for kind in types.TYPE_KINDS for role in ("Argument", "Parameter"))
_QUIET: Final = frozenset(
    """
    AlgorithmSet AliasSet AncillaryDataSet BinaryEncoding DefaultRateInStream DefaultSignificance
    DynamicValue Header IncludeCondition IndirectParameterRefEntry LeadingSize LongDescription
    MathOperationCalibrator MessageSet ParameterProperties ParameterToSetList ReferenceTime RepeatEntry
    ServiceSet SizeRangeInCharacters SplineCalibrator StreamSet ToString TransmissionConstraintList
    Variable VerifierSet
    """.split()  # noqa: SIM905  read as a text
)
"""Elements that are not about the structure of packets, or that have their own notes."""
_BASES: Final = {
    "command": ("BaseMetaCommand", "metaCommandRef"),
    "container": ("BaseContainer", "containerRef"),
}
_ALIGNMENT: Final = re.compile(r"(?:.*_)?padding_\d+", re.ASCII)
"""Names that 'edoras xtce' gives to padding."""
_ELEMENT: Final = re.compile(r"(.*)_(\d+)_", re.ASCII)
"""Names that 'edoras xtce' gives to elements of an array."""
_TELEMETRY_HEADERS: Final = (16, 12, 20)
"""Sizes of cFE's telemetry headers, bytes; the usual one first."""
_FUNCTION_CODES: Final = {8: 49, 12: 49, 16: 81}
"""First bit of the function code, by the size of a command's header: 16 bytes have the extended header."""
_ODD: Final = frozenset({"BooleanExpression", "CustomAlgorithm"})
"""Conditions that are no comparisons."""
_NOTHING: Final = placement.DataType(BASIC["byte"], 8)
_MOST_TAIL: Final = 1 << 16
_HIGHEST: Final = 0x1FFF
"""The highest MsgId of version 1."""
_MOST_SLOTS: Final = 1 << 14


class _Slot(NamedTuple):
    """An entry with a fixed position: its bit from the start of the packet, and its constant value, if any.

    Attributes:
        key: name in conditions: path of its parameter, or name of its argument.
        entry: element.
        fixed: constant bits that are no value of the message.
    """

    name: str
    key: str
    bit: int
    data_type: placement.DataType
    entry: placement.Node
    fixed: int | None = None

    @property
    def end(self) -> int:
        return self.bit + self.data_type.whole_bits


class _Content(msgspec.Struct):
    """The known structure of a packet.

    Attributes:
        slots: entries in order.
        own: first bit of the container with the condition on the APID.
        stop: entry behind which nothing has a fixed position, and the reason.
        more: whether further entries follow that one.
        values: values from conditions and assignments, by the key of a slot, or of its member behind ``/``.
        odd: whether a condition is no equality.
    """

    slots: list[_Slot] = msgspec.field(default_factory=list)
    own: int | None = None
    stop: tuple[placement.Node, str] | None = None
    more: bool = False
    values: dict[str, int] = msgspec.field(default_factory=dict)
    odd: bool = False

    @property
    def end(self) -> int:
        """Bit behind the last entry."""
        return self.slots[-1].end if self.slots else 0


def is_system(data: bytes) -> bool:
    """Return whether a file is a space system of XTCE."""
    return placement.has_root(data, types.SYSTEM)


def read_systems(files: Sequence[tuple[bytes, str]], flags: Sequence[str] = ()) -> StructLayout:
    """Make one layout of files of XTCE.

    Args:
        files: contents and name of each file.
        flags: must be empty; flags are for data sheets.

    Raises:
        ConfigError: a file is not XML, there is a flag, or no file has a packet.
    """
    if flags:
        raise ConfigError(f"--cflag: {flags[0]!r} says nothing of XTCE; leave it out")
    notes = placement.Notes()
    roots = []
    for root in (placement.parse_document(*file) for file in files):
        if root.tag == types.SYSTEM:
            roots.append(root)
            notes.unread(root, _READ, _QUIET)
        else:
            notes.add(root, f"{root.tag} is no space system")
    names = types.Declarations(roots, notes)
    before = placement.Notes(notes)
    reader = _Reader(names, "big", notes)
    orders = reader.orders(reader.contents)
    if orders["little"] > orders["big"]:
        reader = _Reader(names, "little", before)
    return reader.layout(files[0][1])


def read_system(data: bytes, name: str) -> StructLayout:
    """Make the layout of one file; see :func:`read_systems`."""
    return read_systems([(data, name)])


SYSTEMS: Final = Database(is_system, read_system, read_systems)


class _Reader:
    """Makes the layout of some space systems, with numbers of one byte order.

    Attributes:
        contents: known structure of each container and each command, by kind and path.
    """

    def __init__(self, names: types.Declarations, order: ByteOrder, notes: placement.Notes) -> None:
        self._names, self._order, self._notes = names, order, notes
        self._types = types.ValueTypes(names, order, notes)
        self.contents = dict(self._contents())

    def orders(
        self, contents: Mapping[tuple[str, str], tuple[types.Declared, _Content]]
    ) -> Counter[ByteOrder]:
        """Count numbers by byte order: in packets; else in cFE's own packets; else in all containers."""
        counts: tuple[Counter[ByteOrder], ...] = Counter(), Counter(), Counter()
        for item, content in contents.values():
            key, header = self._key(item, content)
            place = 2 if key is None else int(_is_built_in(key))
            counts[place].update(self._orders(content, header))
        return counts[0] or counts[1] or counts[2]

    def _orders(self, content: _Content, header: int) -> Iterator[ByteOrder]:
        for slot in content.slots:
            if slot.bit >= 8 * header:
                yield from (part.data_type.order for part in self._bits(slot) if part.data_type.order)

    def layout(self, origin: str) -> StructLayout:
        """Return all structs, and their packets.

        Raises:
            ConfigError: there is no container and no command.
        """
        declared, notes = self._types, self._notes
        contents = self.contents
        parted = {
            base.path
            for item, content in contents.values()
            if self._conditional(content) and (base := self._base(item))
        }
        bindings: dict[Key, str] = {}
        for (kind, path), (item, content) in contents.items():
            abstract = item.node.attributes.get("abstract") in {"true", "1"}
            is_part = kind == "container" and self._conditional(content)
            key, header = self._key(item, content)
            if is_part:
                notes.add(
                    item.node, f"{path} holds under a condition on more than the MsgId: bound to no packet"
                )
            elif key is None and not abstract:
                why = "nothing says its APID" + ", and function code" * (kind == "command")
                if header == ccsds.PRIMARY.size:
                    why = "its packets have no secondary header, which cFE's have"
                notes.add(item.node, f"{path} is bound to no packet: {why}")
            if abstract and (key is None or path not in parted):
                continue
            if _is_built_in(key) and {*self._orders(content, header)} - {self._order}:
                notes.add(item.node, f"{path} has another byte order: left to the built-in struct of {key}")
                continue
            name = self._struct(item, content, 8 * header, parted=path in parted)
            if key is not None and not is_part and bindings.setdefault(key, name) != name:
                notes.add(item.node, f"{key} is {bindings[key]} already, not {name}")
        if not declared.structs:
            raise ConfigError(*(notes.lines() or (f"{origin}: no container and no command in it",)))
        return StructLayout(
            declared.structs, declared.enums, bindings, self._order, origin=origin, notes=notes.lines()
        )

    def _contents(self) -> Iterator[tuple[tuple[str, str], tuple[types.Declared, _Content]]]:
        """Yield the structure of each container and each command, by kind and path."""
        for kind in ("container", "command"):
            for item in self._names.all(kind):
                try:
                    yield (kind, item.path), (item, self._content(item))
                except placement.SheetError as error:
                    self._notes.add(item.node, f"{item.path}: {error}")

    def _conditional(self, content: _Content) -> bool:
        """Return whether conditions are about more than the first 16 bits."""
        first = {part.key for slot in content.slots for part in self._bits(slot) if part.bit < 16}
        return content.odd or any(key not in first for key in content.values if key.startswith("/"))

    def _bits(self, slot: _Slot) -> Iterator[_Slot]:
        """Yield the numbers in a slot as separate slots."""
        for part in types.bits_of(self._types, slot.key, slot.data_type):
            yield slot._replace(key=part.name, bit=slot.bit + part.bit, data_type=part.data_type)

    def _content(self, item: types.Declared) -> _Content:
        """Return the structure of the packets of a container or a command.

        Raises:
            SheetError: it is based on itself, or on a base that is in none of the files.
        """
        content = _Content()
        chain = [item]
        while base := self._base(chain[-1]):
            if len(chain) > placement.NESTING or base in chain:
                raise placement.SheetError("it is based on itself")
            chain.append(base)
        for own in reversed(chain):
            begin, holder = content.end, own.node
            if own.kind == "command":
                self._assign(own, chain, content)
                holder = next(own.node.inside("CommandContainer"), holder)
            self._restrict(own, holder, content)
            self._entries(own, holder, content)
            if content.own is None and self._constant(content, 5, 11)[1] == 0x7FF:
                content.own = begin
        return content

    def _base(self, item: types.Declared) -> types.Declared | None:
        tag, key = _BASES[item.kind]
        holder = next(item.node.inside(tag), None)
        if holder is None and item.kind == "command":  # its container may have a base of no command
            for inner in item.node.inside("CommandContainer", "BaseContainer"):
                return self._names.find("container", inner.required("containerRef"), item.system)
        return self._names.find(item.kind, holder.required(key), item.system) if holder is not None else None

    def _assign(self, item: types.Declared, chain: Sequence[types.Declared], content: _Content) -> None:
        """Store the values that a command assigns to the arguments of its bases."""
        for node in item.node.inside("BaseMetaCommand", "ArgumentAssignmentList", "ArgumentAssignment"):
            name, text = node.required("argumentName"), node.required("argumentValue")
            for other in chain:
                for argument in other.node.inside("ArgumentList", "Argument"):
                    if argument.name == name:
                        kind = self._names.type_of("argument", argument, other.system)
                        content.values[name] = self._value(kind, text, node)

    def _restrict(self, item: types.Declared, holder: placement.Node, content: _Content) -> None:
        """Store the values that a container's conditions require."""
        for base in holder.inside("BaseContainer", "RestrictionCriteria"):
            for node in base.walk():
                equal = node.attributes.get("comparisonOperator", "==") == "=="
                content.odd |= node.tag in _ODD or (node.tag == "Comparison" and not equal)
                if node.tag != "Comparison" or not equal:
                    continue
                declared, member = self._names.find_member(node.required("parameterRef"), item.system)
                kind = self._names.type_of("parameter", declared.node, declared.system)
                for name in member.split("/")[1:]:
                    members = {each.name: each for each in kind.node.inside("MemberList", "Member")}
                    if name not in members:
                        raise placement.SheetError(f"{node.required('parameterRef')} is no parameter")
                    kind = self._names.find(kind.kind, members[name].required("typeRef"), kind.system)
                content.values[declared.path + member] = self._value(kind, node.required("value"), node)

    def _value(self, kind: types.Declared, text: str, node: placement.Node) -> int:
        """Return the number of a text in a condition or an assignment."""
        self._types.find(kind)
        labels = self._types.labels.get(kind.path, {})
        return labels[text] if text in labels else int(types.number(node, text))

    def _entries(
        self, item: types.Declared, holder: placement.Node, content: _Content, depth: int = 0
    ) -> None:
        """Append the entries of a container, until one has no fixed position."""
        for entry in (node for each in holder.inside("EntryList") for node in each.children):
            if content.stop is not None:
                content.more = True
                return
            if len(content.slots) > _MOST_SLOTS or depth > placement.NESTING:
                raise placement.SheetError("it has more entries than any packet")
            try:
                self._entry(item, entry, content, depth)
            except placement.SheetError as error:
                content.stop = entry, str(error)

    def _entry(self, item: types.Declared, entry: placement.Node, content: _Content, depth: int) -> None:
        bit = self._location(entry, content.end)
        for tag in ("IncludeCondition", "RepeatEntry"):
            if next(entry.inside(tag), None) is not None:
                raise placement.SheetError(f"{tag}: what follows has no fixed place")
        if entry.tag == "ContainerRefEntry":
            inner = self._names.find("container", entry.required("containerRef"), item.system)
            content.slots.append(_Slot("", "", bit, replace(_NOTHING, bits=0), entry, 0))
            self._entries(inner, inner.node, content, depth + 1)
            return
        if entry.tag == "FixedValueEntry":
            digits = entry.required("binaryValue")
            bits = int(types.number(entry, entry.required("sizeInBits")))
            if not 0 < bits <= 1 << 16 or not re.fullmatch(r"[0-9A-Fa-f]*", digits):
                raise placement.SheetError("FixedValueEntry is no hexadecimal number of so many bits")
            value = int(digits or "0", 16) & ((1 << bits) - 1)
            content.slots.append(_Slot(entry.name, "", bit, replace(_NOTHING, bits=bits), entry, value))
            return
        role = entry.tag.removesuffix("RefEntry").removeprefix("Array").lower()
        if role not in {"parameter", "argument"} or not entry.tag.endswith("RefEntry"):
            raise placement.SheetError(f"{entry.tag} is not read")
        declared = self._look_up(role, entry.required(f"{role}Ref"), item)
        kind = self._names.type_of(role, declared.node, declared.system)
        data_type = self._types.find(kind)
        if entry.tag.startswith("Array") and not data_type.dims:
            dims = self._types.dimensions(entry)
            data_type = replace(data_type, dims=dims or (), variable=dims is None)
        name = placement.c_name(declared.node.name.removeprefix(f"{item.node.name}_"))
        doc = declared.node.doc or data_type.like.doc
        if _plain(doc) == _plain(name):
            doc = ""
        data_type = replace(data_type, like=replace(data_type.like, doc=doc))
        key = declared.path if role == "parameter" else declared.node.name
        content.slots.append(_Slot(name, key, bit, data_type, entry))
        if data_type.variable:
            content.stop = entry, f"the length of {declared.node.name} is in the packet"

    def _look_up(self, role: str, name: str, item: types.Declared) -> types.Declared:
        """Return the parameter or argument that an entry refers to."""
        if role == "parameter":
            return self._names.find(role, name, item.system)
        command: types.Declared | None = item
        while command is not None:
            for node in command.node.inside("ArgumentList", "Argument"):
                if node.name == name:
                    return types.Declared("argument", f"{command.system}/{name}", node)
            command = self._base(command)
        raise placement.SheetError(f"argument {name} is in none of these files")

    def _location(self, entry: placement.Node, end: int) -> int:
        """Return the first bit of an entry; ``end`` is the end of the previous one."""
        holder = next(entry.inside("LocationInContainerInBits"), None)
        if holder is None:
            return end
        place = holder.attributes.get("referenceLocation", "previousEntry")
        offset = types.fixed_value(holder)
        if offset is None or place not in {"previousEntry", "containerStart"}:
            raise placement.SheetError(f"its place is counted from {place}, or is in the packet")
        bit = offset + (end if place == "previousEntry" else 0)
        if bit < 0:
            raise placement.SheetError(f"bit {bit} is before the packet")
        return bit

    def _key(self, item: types.Declared, content: _Content) -> tuple[Key | None, int]:
        """Return the packets of a container or a command, and the size of their header, bytes.

        The packets are None if the APID is not given, or if they are not cFE's.
        """
        word, mask = self._constant(content, 0, 16)
        is_command = bool(item.kind == "command" or mask & word & 0x1000)
        if not mask:  # no packet, but a part of some
            return None, 0
        if mask & 0x800 and not word & 0x800:
            return None, ccsds.PRIMARY.size
        header = _command_header(content) if is_command else _telemetry_header(content)
        word |= 0x800 | (0x1000 if is_command else 0)
        if mask & 0x7FF != 0x7FF or word > _HIGHEST:
            return None, header
        if not is_command:
            return Key(word), header
        code, mask = self._constant(content, _FUNCTION_CODES[header], 7)
        return (Key(word, code) if mask == 0x7F else None), header

    def _constant(self, content: _Content, bit: int, bits: int) -> tuple[int, int]:
        """Return the value of some bits, and a mask of those that are constant."""
        value = mask = 0
        for slot in content.slots:
            for part in self._bits(slot):
                fixed = part.fixed if part.fixed is not None else content.values.get(part.key)
                width = part.data_type.whole_bits
                if fixed is None or part.bit >= bit + bits or part.bit + width <= bit or fixed < 0:
                    continue
                shift = bit + bits - part.bit - width
                ones, own = (1 << width) - 1, fixed & ((1 << width) - 1)
                mask |= ones << shift if shift >= 0 else ones >> -shift
                value |= own << shift if shift >= 0 else own >> -shift
        return value & ((1 << bits) - 1), mask & ((1 << bits) - 1)

    def _struct(self, item: types.Declared, content: _Content, header: int, *, parted: bool) -> str:
        """Lay out the entries behind a header of some bits; return the name of the struct.

        Args:
            parted: whether some packets have further entries, by a condition.
        """
        maker, path, last = placement.Placement(self._order, machine=False), item.path, content.slots[-1:]
        end = 0
        for slot in _joined(content.slots):
            bit = slot.bit - header
            if bit < 0 or slot.fixed is not None or slot.data_type.variable or _is_alignment(slot):
                continue
            if bit < end:
                self._notes.add(
                    slot.entry, f"{path}: {slot.name} begins within what is before it; it is left out"
                )
                continue
            end = slot.end - header
            maker.go_to(bit)
            if why := maker.place(slot.name, slot.data_type):
                self._notes.add(slot.entry, f"{path}.{slot.name}: {why}")
        maker.go_to(max(content.end - header, end))
        if content.stop is not None:
            node, why = content.stop
            opened = last and last[0].data_type.variable and not content.more and last[0].data_type.bits
            if opened and BASIC["byte"] != last[0].data_type.kind:
                why = maker.open(last[0].name, replace(last[0].data_type, variable=False))
            else:
                maker.rest(BASIC["byte"])
                why = f"{why}; {path} from there on is shown as bytes"
            if why:
                self._notes.add(node, why)
        elif parted:
            maker.rest(BASIC["byte"])
        tail = _MOST_TAIL if item.kind == "container" and not maker.varies else 0
        return self._types.add_struct(item.node.name, maker, item.node.doc, tail)


def _plain(name: str) -> str:
    return re.sub(r"[\W_]+", "_", name).strip("_")


def _is_built_in(key: Key | None) -> bool:
    """Return whether packets contain a struct that this package has without a layout."""
    return key is not None and (key.msg_id in PACKETS or key.msg_id in COMMANDED)


def _is_alignment(slot: _Slot) -> bool:
    return slot.data_type.kind == BASIC["byte"] and _ALIGNMENT.fullmatch(slot.name) is not None


def _joined(slots: Sequence[_Slot]) -> Iterator[_Slot]:
    """Yield slots; array elements that 'edoras xtce' wrote one by one are joined."""
    place = 0
    while place < len(slots):
        slot, count = slots[place], 1
        match = _ELEMENT.fullmatch(slot.name)
        if match and match[2] == "0":
            while (
                place + count < len(slots)
                and (other := slots[place + count]).name == f"{match[1]}_{count}_"
                and other.data_type == slot.data_type
                and other.bit == slot.bit + count * slot.data_type.whole_bits
            ):
                count += 1
            data_type = slot.data_type
            yield slot._replace(name=match[1], data_type=replace(data_type, dims=(count, *data_type.dims)))
        else:
            yield slot
        place += count


def _command_header(content: _Content) -> int:
    """Return the size of a command's header, bytes: it ends with the entry of the checksum."""
    ends = [slot.end // 8 for slot in content.slots if slot.bit < 64 <= slot.end]
    return next((end for end in ends if end in _FUNCTION_CODES), min(_FUNCTION_CODES))


def _telemetry_header(content: _Content) -> int:
    """Return the size of a telemetry header, bytes: the container with the APID begins behind it."""
    edges = {slot.end // 8 for slot in content.slots}
    own = (content.own or 0) // 8
    usual = (size for size in _TELEMETRY_HEADERS if size in edges)
    return own if own in _TELEMETRY_HEADERS else next(usual, _TELEMETRY_HEADERS[0])
