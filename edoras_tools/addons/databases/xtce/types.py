"""The declarations in space systems, by kind and path, and the types of parameters and arguments.

A type gives the bytes of a value, and their meaning. References lead from one declaration to another.
"""

from __future__ import annotations

import posixpath
import re
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import PurePosixPath
from typing import Final

import msgspec
from msgspec.structs import replace

from edoras_tools.addons.databases import placement
from edoras_tools.addons.databases.placement import NESTING, Node, Notes, SheetError
from edoras_tools.structs.shapes import BASIC, BasicKind, ByteOrder, Member, Range

TYPE_KINDS: Final = (
    *("AbsoluteTime", "Aggregate", "Array", "Binary", "Boolean", "Enumerated", "Float", "Integer"),
    *("RelativeTime", "String"),
)
"""Kinds of types: each is an element for parameters and one for arguments."""
_ROLE: Final = re.compile(r"(Parameter|Argument)Type$")
_OWN_PREFIX: Final = re.compile(r"(?:arg_)?u?int\d+(?:_[lb]e)?_(?=.)", re.ASCII)
"""Start of the names that 'edoras xtce' gives to types of enumerations."""
_ENCODINGS: Final = {
    "unsigned": BasicKind.UINT,
    "twosComplement": BasicKind.INT,
    "twosCompliment": BasicKind.INT,
    "IEEE754_1985": BasicKind.FLOAT,
    "IEEE754": BasicKind.FLOAT,
}
"""Kind of bytes by the encoding of a number; also as spelled in XTCE 1.1."""
_TEXTS: Final = frozenset({"UTF-8", "US-ASCII", "ISO-8859-1", "Windows-1252"})
_ORDERS: Final[dict[str, ByteOrder]] = {
    "mostSignificantByteFirst": "big",
    "leastSignificantByteFirst": "little",
}
_YELLOW: Final = ("WarningRange", "WatchRange")
_RED: Final = ("CriticalRange", "DistressRange", "SevereRange")
"""Alarm ranges that count as a limit; the first existing one is used."""
_NUMBER: Final = re.compile(r"(0[xX][0-9a-fA-F]+)|[-+]?(?:\d+|(?=\.\d))(\.?\d*(?:[eE][-+]?\d+)?)", re.ASCII)
_HIGHEST: Final = 1e300


class MemberPlace(msgspec.Struct, frozen=True):
    """A member of an aggregate.

    Attributes:
        name: name of the member.
        bit: first bit in the aggregate.
        data_type: type of the member.
    """

    name: str
    bit: int
    data_type: placement.DataType


def number(node: Node, text: str) -> float:
    """Return a number from the notation of XTCE.

    Raises:
        SheetError: the text is no number, or out of range.
    """
    value: float = _HIGHEST
    match = _NUMBER.fullmatch(text.strip())
    with suppress(ValueError):  # an integer of thousands of digits
        if match and match[1]:
            value = int(text, 16)
        elif match:
            value = float(text) if match[2] else int(text)
    if not abs(value) < _HIGHEST:
        raise SheetError(f"{node.tag} {node.name}".rstrip() + f": {text[:40]!r} is no number")
    return value


def fixed_value(node: Node, *path: str) -> int | None:
    """Return the ``FixedValue`` on a path of tags; None if there is none, but a value from a packet."""
    item = next(node.inside(*path, "FixedValue"), None)
    if item is None:
        return None
    value = number(item, item.text)
    if value != int(value) or abs(value) > placement.MOST_VALUE_BITS:
        raise SheetError(f"{node.tag} {node.name}".rstrip() + f": {value} is no count of bits")
    return int(value)


class ValueTypes(placement.TypeTable):
    """The types of some space systems.

    Args:
        names: declarations that it searches.
        order: byte order of all numbers; others are shown as bytes.
        notes: notes on parts that are not read.

    Attributes:
        parts: members of aggregates, by the name of the struct.
        labels: labels of values to their numbers, as written, by type.
    """

    def __init__(self, names: Declarations, order: ByteOrder, notes: Notes) -> None:
        super().__init__()
        self._names, self._order, self._notes = names, order, notes
        self.parts: dict[str, list[MemberPlace]] = {}
        self.labels: dict[str, dict[str, int]] = {}

    def find(self, item: Declared) -> placement.DataType:
        """Return the resolved type of a declaration.

        Raises:
            SheetError: the type contains itself, or cannot be read.
        """
        return self.resolve(item.path, lambda: self._make(replace(item, node=self._whole(item))))

    def _whole(self, item: Declared, depth: int = 0) -> Node:
        """Return the element of a type, extended by its ``baseType``."""
        name = item.node.attributes.get("baseType")
        if not name:
            return item.node
        if depth > NESTING:
            raise SheetError(f"type {item.path} is based on itself")
        base = self._whole(self._names.find(item.kind, name, item.system), depth + 1)
        own = {child.tag for child in item.node.children}
        return replace(
            item.node,
            attributes={**base.attributes, **item.node.attributes},
            children=[*item.node.children, *(child for child in base.children if child.tag not in own)],
        )

    def _make(self, item: Declared) -> placement.DataType:
        node, kind = item.node, _ROLE.sub("", item.node.tag)
        if kind == "Array":
            element = self.find(self._names.find(item.kind, node.required("arrayTypeRef"), item.system))
            if element.variable:
                raise SheetError(f"array {item.path}: the length of its elements varies")
            dims = self.dimensions(node)
            return replace(element, dims=(*(dims or ()), *element.dims), variable=dims is None)
        if kind == "Aggregate":
            return self._aggregate(item)
        if kind.endswith("Time"):
            node = next(node.inside("Encoding"), node)
        encoding = next((child for child in node.children if child.tag.endswith("DataEncoding")), None)
        if encoding is None:
            raise SheetError(f"type {item.path} has no encoding, so its value is in no packet")
        if encoding.tag == "StringDataEncoding":
            return self._text(item, encoding)
        if encoding.tag == "BinaryDataEncoding":
            bits = fixed_value(encoding, "SizeInBits")
            return placement.DataType(
                BASIC["byte"], 8, (-(-(bits or 0) // 8),), variable=bits is None, like=self._like(item)
            )
        return self._number(item, kind, encoding)

    def dimensions(self, node: Node) -> tuple[int, ...] | None:
        """Return the dimensions of an element; None if a packet contains one of them."""
        sizes = []
        for item in node.inside("DimensionList", "Dimension"):
            first, last = (fixed_value(item, f"{end}Index") for end in ("Starting", "Ending"))
            if last is None:
                return None
            sizes.append(max(0, last - (first or 0) + 1))
        return tuple(sizes) or None

    def _text(self, item: Declared, encoding: Node) -> placement.DataType:
        bits = fixed_value(encoding, "SizeInBits", "Fixed")
        coded = encoding.attributes.get("encoding", "UTF-8")
        led = next(encoding.inside("SizeInBits", "LeadingSize"), None) is not None
        if bits is None:
            return placement.DataType(BASIC["byte"], 8, (0,), variable=True)
        doubt = f"encoding {coded}" * (coded not in _TEXTS) or "its length stands before it" * led
        return placement.DataType(BASIC["char"], bits, (bits // 8,), doubt=doubt, like=self._like(item))

    def _number(self, item: Declared, kind: str, encoding: Node) -> placement.DataType:
        """Return the type of a number, a flag, a time or an enumeration."""
        node, words = item.node, encoding.attributes
        is_float = encoding.tag.startswith("Float")
        bits = number(encoding, words.get("sizeInBits", "32" if is_float else "8"))
        if bits not in range(1, 1 << 16):
            raise SheetError(f"type {item.path}: {bits} is no number of bits")
        coded = words.get("encoding", "IEEE754_1985" if is_float else "unsigned")
        basic_kind = _ENCODINGS.get(coded, BasicKind.BYTE)
        order = _ORDERS.get(words.get("byteOrder", "mostSignificantByteFirst"))
        sound = (basic_kind is BasicKind.FLOAT) == is_float and basic_kind is not BasicKind.BYTE
        sound = sound and (not is_float or bits in {32, 64})
        doubt = f"encoding {coded} of {bits} bits" * (not sound)
        if order is None and bits > 8:
            doubt = doubt or f"byte order {words.get('byteOrder')}"
        labels = self._labels(item, kind)
        if kind == "Boolean" and not labels:
            basic_kind = BasicKind.BOOL
        data_type = placement.scalar(basic_kind, int(bits), order, self._like(item, encoding), doubt)
        name = _OWN_PREFIX.sub("", placement.c_name(node.name))
        return data_type if is_float else self.labelled(data_type, name, labels)

    def _labels(self, item: Declared, kind: str) -> dict[int, str]:
        """Return the labels of a type's values."""
        node = item.node
        if kind == "Boolean":
            texts = [node.attributes.get(key, "") for key in ("zeroStringValue", "oneStringValue")]
            texts = [text or name for text, name in zip(texts, ("False", "True"), strict=True)]
            self.labels[item.path] = {text: value for value, text in enumerate(texts)}
            return {} if texts == ["False", "True"] else dict(enumerate(texts))
        labels: dict[int, str] = {}
        for entry in node.inside("EnumerationList", "Enumeration"):
            try:
                value = number(entry, entry.required("value"))
                labels.setdefault(int(value), entry.required("label"))
            except SheetError as error:
                self._notes.add(entry, str(error))
            if "maxValue" in entry.attributes:
                self._notes.add(entry, "maxValue: the label is shown for the first value alone")
        self.labels[item.path] = {text: value for value, text in labels.items()}
        return labels

    def _aggregate(self, item: Declared) -> placement.DataType:
        """Lay out an aggregate: its members follow each other bit by bit."""
        maker = placement.Placement(self._order, machine=False)
        parts, bit = [], 0
        for member in item.node.inside("MemberList", "Member"):
            name = member.attributes.get("typeRef") or member.required("parameterTypeRef")
            data_type = self.find(self._names.find(item.kind, name, item.system))
            if data_type.variable:
                raise SheetError(f"aggregate {item.path}: the length of {member.name} varies")
            doc = member.doc or data_type.like.doc
            placed = replace(data_type, like=replace(data_type.like, doc=doc))
            if why := maker.place(placement.c_name(member.name), placed):
                self._notes.add(member, f"{item.path}.{member.name}: {why}")
            parts.append(MemberPlace(member.name, bit, data_type))
            bit += data_type.whole_bits
        name = self.add_struct(item.node.name, maker, item.node.doc)
        self.parts[name] = parts
        return placement.DataType(name, bit)

    def _like(self, item: Declared, encoding: Node | None = None) -> Member:
        """Return a member with the unit, calibration and limits of a type."""
        node = item.node
        units = [" ".join(unit.text.split()) for unit in node.inside("UnitSet", "Unit")]
        like = replace(placement.UNNAMED, unit=" ".join(filter(None, units)), doc=node.doc)
        for holder in (*node.inside("ValidRange"), *node.inside("ValidRangeSet", "ValidRange")):
            like = replace(like, red=_range(holder))
        for holder in node.inside("DefaultAlarm", "StaticAlarmRanges"):
            if holder.attributes.get("rangeForm", "outside") != "outside":
                self._notes.add(holder, "StaticAlarmRanges of the form 'inside' are not read")
                continue
            yellow, red = (
                [_range(each) for tag in tags for each in holder.inside(tag)] for tags in (_YELLOW, _RED)
            )
            like = replace(like, yellow=(*yellow, like.yellow)[0], red=(*red, like.red)[0])
        return replace(like, polynomial=self._polynomial(encoding)) if encoding is not None else like

    def _polynomial(self, encoding: Node) -> tuple[float, ...]:
        terms: dict[float, float] = {}
        for holder in encoding.inside("DefaultCalibrator"):
            for item in holder.children:
                if item.tag != "PolynomialCalibrator":
                    self._notes.add(item, f"{item.tag} is not read: the number is shown as it is sent")
            for item in holder.inside("PolynomialCalibrator", "Term"):
                power = number(item, item.required("exponent"))
                terms[power] = number(item, item.required("coefficient"))
        return placement.polynomial(terms)


def _range(node: Node) -> Range:
    """Return the ends of a range; an exclusive end of integers becomes the next one inside."""
    ends: list[float | None] = []
    for name, inwards in (("min", 1), ("max", -1)):
        end = None
        for form, step in (("Inclusive", 0), ("Exclusive", inwards)):
            text = node.attributes.get(name + form)
            if text is not None:
                end = number(node, text)
                end += step if isinstance(end, int) else 0
        ends.append(end)
    return ends[0], ends[1]


def bits_of(types: ValueTypes, name: str, data_type: placement.DataType) -> Iterator[MemberPlace]:
    """Yield the numbers in a type by name, each with its first bit.

    Args:
        name: name of the whole; those of an aggregate's members follow behind ``/``.
    """
    parts = types.parts.get(str(data_type.kind))
    if parts is None:
        yield MemberPlace(name, 0, data_type)
    elif not data_type.dims:
        for part in parts:
            for inner in bits_of(types, f"{name}/{part.name}", part.data_type):
                yield replace(inner, bit=part.bit + inner.bit)


SYSTEM: Final = "SpaceSystem"
_MOST_MEMBERS: Final = 8
"""Maximum depth of members in a reference to a parameter."""
_SETS: Final = (
    (("TelemetryMetaData", "ParameterTypeSet"), "parameter type"),
    (("TelemetryMetaData", "ParameterSet"), "parameter"),
    (("TelemetryMetaData", "ContainerSet"), "container"),
    (("CommandMetaData", "ParameterTypeSet"), "parameter type"),
    (("CommandMetaData", "ParameterSet"), "parameter"),
    (("CommandMetaData", "ArgumentTypeSet"), "argument type"),
    (("CommandMetaData", "CommandContainerSet"), "container"),
    (("CommandMetaData", "MetaCommandSet"), "command"),
)
"""Path and kind of each set of declarations."""


class Declared(msgspec.Struct, frozen=True):
    """A declaration.

    Attributes:
        kind: kind, as ``parameter type``.
        path: name, behind the names of its space systems.
        node: element.
    """

    kind: str
    path: str
    node: Node

    @property
    def system(self) -> str:
        """Path of its space system."""
        return posixpath.dirname(self.path)


class Declarations:
    """All declarations in some space systems.

    Args:
        roots: elements of the outermost space systems; others may be inside.
        notes: notes, to which duplicate declarations are added.
    """

    def __init__(self, roots: Sequence[Node], notes: Notes) -> None:
        self._items: dict[tuple[str, str], Declared] = {}
        self._short: dict[tuple[str, str], list[Declared]] = defaultdict(list)
        for root in roots:
            for system, node in _systems(root, ""):
                for place, kind in _SETS:
                    for item in (child for holder in node.inside(*place) for child in holder.children):
                        if not item.name:
                            continue
                        entry = Declared(kind, f"{system}/{item.name}", item)
                        if self._items.setdefault((kind, entry.path), entry) is not entry:
                            notes.add(item, f"{kind} {entry.path} is declared twice; the first holds")
                        else:
                            self._short[kind, item.name].append(entry)

    def all(self, kind: str) -> Iterator[Declared]:
        """Yield the declarations of a kind."""
        return (item for (own, _), item in self._items.items() if own == kind)

    def find(self, kind: str, name: str, system: str) -> Declared:
        """Return the declaration that a name refers to in a space system, or in one of its parents.

        If several files are read, a system may belong into another one, which only the ground system's
        configuration
        says: then it is enough if the last part of the name is unique.

        Raises:
            SheetError: there is no declaration of that name.
        """
        name = name.strip()
        places = [""] if name.startswith("/") else [system, *map(str, PurePosixPath(system).parents)]
        for place in places:
            path = posixpath.normpath(f"/{place}/{name}")
            item = self._items.get((kind, "/" + path.lstrip("/")))
            if item is not None:
                return item
        alike = self._short.get((kind, posixpath.basename(name)), [])
        if len(alike) != 1:
            raise SheetError(f"{kind} {name} is in none of these files")
        return alike[0]

    def type_of(self, role: str, node: Node, system: str) -> Declared:
        """Return the type of a parameter or an argument; ``role`` is the kind."""
        return self.find(f"{role} type", node.required(f"{role}TypeRef"), system)

    def find_member(self, name: str, system: str) -> tuple[Declared, str]:
        """Return the parameter of a name, and the path of its member, ``/`` in front; empty for the whole.

        Raises:
            SheetError: there is no parameter of that name.
        """
        words = name.replace(".", "/").split("/") if not name.startswith(".") else name.split("/")
        for count in range(min(_MOST_MEMBERS, len(words))):
            whole = "/".join(words[: len(words) - count])
            with suppress(SheetError):
                return self.find("parameter", whole, system), "".join(
                    f"/{item}" for item in words[-count:] * bool(count)
                )
        raise SheetError(f"parameter {name} is in none of these files")


def _systems(node: Node, above: str) -> Iterator[tuple[str, Node]]:
    if node.tag == SYSTEM:
        path = f"{above}/{node.name}"
        yield path, node
        for item in node.children:
            yield from _systems(item, path)
