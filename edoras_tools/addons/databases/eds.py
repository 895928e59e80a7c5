"""Reads electronic data sheets (CCSDS 876.0): packages become structs, topics packets.

1. All files are read together: a package may be in several files, and names may refer to other files.
2. A container that is based on one of cFE's headers is a packet. The component that has an interface with it
   gives its topic; a constraint of the container gives a command's function code.
3. Anything that cannot be read is noted with file and line; all the rest is read.
4. Entries of a container follow each other bit by bit, the most significant bit first. With a machine's byte
   order they are aligned as in the C structs of a cFS that is built without data sheets: each at a multiple
   of its size.
5. A design parameter, ``${PACKAGE/NAME}`` in an attribute, is replaced by its value. An expression has
   numbers (decimal, or hexadecimal behind ``0x``), ``+ - * / ^`` and parentheses; a text that is no
   expression keeps its value. Values, lengths and depth are limited: a few parameters that contain each other
   many times cannot produce a text that fills the memory.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from math import inf
from operator import add, mul, sub
from typing import Final

from msgspec.structs import replace

from edoras_tools.addons.databases import placement
from edoras_tools.addons.databases.placement import NESTING, Node, Notes, SheetError, has_root, parse_document
from edoras_tools.errors import ConfigError
from edoras_tools.structs.files import Database
from edoras_tools.structs.shapes import BASIC, BasicKind, ByteOrder, Key, Member, Range, StructLayout

_REFERENCE: Final = re.compile(r"\$\{([^{}]*)\}")
_TOKEN: Final = re.compile(r"0[xX][0-9a-fA-F]+|\d+\.?\d*(?:[eE][-+]?\d+)?|\S", re.ASCII)
_LONGEST: Final = 1000
_DEEPEST: Final = 32
_HIGHEST: Final = 1 << 64
_BINDINGS: Final = {"+": 1, "-": 1, "*": 2, "/": 2, "^": 4}
_NEGATION: Final = 3
"""How tightly operators bind; a sign in front of a number less than a power."""
Number = int | float


class Parameters:
    """The design parameters of some sheets.

    Args:
        defines: text of each parameter, by package and name as in ``CFE_MISSION/SPACECRAFT_ID``.
    """

    def __init__(self, defines: Mapping[str, str]) -> None:
        self._defines = defines
        self._values: dict[str, str] = {}
        self._open: list[str] = []

    def text(self, raw: str, package: str) -> str:
        """Return an attribute with its parameters replaced by their values.

        Args:
            package: package of the attribute, and of parameters without a package.

        Raises:
            SheetError: a parameter is in none of the sheets, or contains itself; or the text is too long.
        """
        text = _REFERENCE.sub(lambda match: self._value(match[1].strip(), package), raw)
        if len(text) > _LONGEST:
            raise SheetError(f"{raw[:40]!r} stands for more than {_LONGEST} characters")
        return text

    def number(self, raw: str, package: str) -> Number:
        """Return the value of an expression.

        Raises:
            SheetError: see ``text``; or the text is no expression, or out of range.
        """
        return _Expression(self.text(raw, package)).value()

    def integer(self, raw: str, package: str) -> int:
        """Return the value of an integer expression.

        Raises:
            SheetError: see ``number``; or the value is no integer.
        """
        value = self.number(raw, package)
        if value != int(value):
            raise SheetError(f"{raw!r} is {value}, no integer")
        return int(value)

    def _value(self, name: str, package: str) -> str:
        key = name if "/" in name else f"{package}/{name}"
        if key in self._values:
            return self._values[key]
        if key not in self._defines:
            raise SheetError(f"parameter {key} is in none of these files")
        if key in self._open or len(self._open) > _DEEPEST:
            raise SheetError(f"parameter {key} contains itself")
        self._open.append(key)
        try:
            text = self.text(self._defines[key], key.rpartition("/")[0])
        finally:
            self._open.pop()
        with suppress(SheetError):  # a text, such as the name of a type
            text = str(_Expression(text).value())
        self._values[key] = text
        return text


class _Expression:
    """Evaluator of arithmetic, from left to right with one token of look-ahead."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._tokens = _TOKEN.findall(text)[::-1]

    def value(self) -> Number:
        value = self._operators(0, 1)
        if self._tokens:
            raise self._error(" is no number")
        return value

    def _operators(self, least: int, depth: int) -> Number:
        """Return the value of an operand, and of the operators behind it that bind more than ``least``."""
        if depth > _DEEPEST:
            raise self._error(" is nested too deeply")
        first = self._tokens.pop() if self._tokens else ""
        if first == "-":
            value = -self._operators(_NEGATION, depth + 1)
        elif first == "(":
            value = self._operators(0, depth + 1)
            if not self._tokens or self._tokens.pop() != ")":
                raise self._error(": a parenthesis is not closed")
        elif first[:2] in {"0x", "0X"}:
            value = self._checked(int(first, 16))
        elif first.isascii() and first[:1].isdigit():
            value = self._checked(int(first) if first.isdigit() else float(first))
        else:
            raise self._error(" is no number")
        while self._tokens and (binding := _BINDINGS.get(self._tokens[-1], 0)) > least:
            sign = self._tokens.pop()
            power = sign == "^"  # from right to left
            other = self._operators(binding - power, depth + power)
            value = self._checked(self._calculated(value, sign, other))
        return value

    def _calculated(self, value: Number, sign: str, other: Number) -> Number:
        if sign == "^":
            if abs(other) > 64 or (value < 0 and other != int(other)) or (not value and other < 0):
                raise self._error(" has no value here")
            with suppress(OverflowError):
                return value**other
            return inf
        if sign == "/" and not other:
            raise self._error(" divides by 0")
        if sign == "/":
            exact = isinstance(value, int) and isinstance(other, int) and not value % other
            return value // other if exact else value / other
        return {"+": add, "-": sub, "*": mul}[sign](value, other)

    def _checked(self, value: Number) -> Number:
        if not -_HIGHEST <= value <= _HIGHEST:
            raise self._error(" is over 2^64")
        return value

    def _error(self, why: str) -> SheetError:
        return SheetError(f"{self._text[:80]!r}{why}")


PACKET_HEADERS: Final = {"CFE_HDR/CommandHeader": "command", "CFE_HDR/TelemetryHeader": "telemetry"}
"""cFE's header containers, on which every packet's container is based, with the kind of packet."""
DATA_TYPES: Final = frozenset(
    f"{kind}DataType"
    for kind in (
        *("Alias", "Array", "Binary", "Boolean", "Container", "Enumerated", "Float", "Integer", "String"),
        "SubRange",
    )
)
_ENTRIES: Final = frozenset({"Entry", "LengthEntry", "FixedValueEntry", "ErrorControlEntry", "ListEntry"})
_SINGLE: Final = "IEEE754_2008_single"
_KINDS: Final = {
    "Boolean": BasicKind.BOOL,
    "Float": BasicKind.FLOAT,
    "unsigned": BasicKind.UINT,
    "twosComplement": BasicKind.INT,
}
"""Kind of bytes by the kind of a type, or by the encoding of an integer."""
_EXCLUDED: Final = {
    "exclusiveMinExclusiveMax": ("min", "max"),
    "inclusiveMinExclusiveMax": ("max",),
    "exclusiveMinInclusiveMax": ("min",),
    "greaterThan": ("min",),
    "lessThan": ("max",),
}
"""Which ends of a range are excluded."""


class Types(placement.TypeTable):
    """The data types of sheets.

    Args:
        nodes: data types by package and name.
        parameters: design parameters.
        order: byte order of the layout's numbers; others become bytes.
        machine: whether numbers are aligned as in C structs of a machine with this byte order.
        note: called with an element that cannot be read, and the reason.

    Attributes:
        orders: number of entries with numbers of each byte order.
    """

    def __init__(
        self,
        nodes: Mapping[str, Node],
        parameters: Parameters,
        order: ByteOrder,
        *,
        machine: bool,
        note: Callable[[Node, str], None],
    ) -> None:
        super().__init__()
        self._nodes, self._parameters, self._note = nodes, parameters, note
        self._order, self._machine = order, machine
        self.orders: dict[ByteOrder, int] = {"little": 0, "big": 0}

    def full_name(self, raw: str, package: str) -> str:
        """Return the package and name of a type that a package refers to."""
        text = self._parameters.text(raw, package)
        return text if "/" in text else f"{package}/{text}"

    def bases(self, name: str) -> Iterator[str]:
        """Yield a container, its base, and so on, up to cFE's header or the last one.

        Raises:
            SheetError: the container is based on itself.
        """
        passed: list[str] = []
        while name:
            if name in passed or len(passed) > NESTING:
                raise SheetError(f"{name} is based on itself")
            passed.append(name)
            yield name
            node = self._nodes.get(name) if name not in PACKET_HEADERS else None
            base = node.attributes.get("baseType", "") if node is not None else ""
            name = self.full_name(base, name.rpartition("/")[0]) if base else ""

    def find(self, name: str) -> placement.DataType:
        """Return a type by its package and name.

        Raises:
            SheetError: the type is in none of the sheets, contains itself, or cannot be read.
        """
        if name not in self._nodes:
            raise SheetError(f"type {name} is in none of these files")
        return self.resolve(name, lambda: self._make(self._nodes[name], name))

    def _make(self, node: Node, name: str) -> placement.DataType:
        package = name.rpartition("/")[0]
        kind = node.tag.removesuffix("DataType")
        if kind == "Container":
            return self._container(node, name)
        if kind == "Alias":
            return self.find(self.full_name(node.required("type"), package))
        if kind == "SubRange":
            base = self.find(self.full_name(node.required("baseType"), package))
            return replace(base, like=self._like(node, package, base))
        if kind == "Array":
            element = self.find(self.full_name(node.required("dataTypeRef"), package))
            if element.variable:
                raise SheetError(f"array {name}: the length of {element.kind} varies")
            return replace(element, dims=(*self._dimensions(node, package), *element.dims))
        if kind == "String":
            size = self._count(node, "length", package)
            return placement.DataType(BASIC["char"], 8 * size, (size,))
        if kind == "Binary":
            return placement.DataType(BASIC["byte"], 8, (-(-self._count(node, "sizeInBits", package) // 8),))
        encoding = next(node.inside(f"{kind.replace('Enumerated', 'Integer')}DataEncoding"), None)
        return self._scalar(node, name, kind, encoding, package)

    def _dimensions(self, node: Node, package: str) -> Iterator[int]:
        for item in node.inside("DimensionList", "Dimension"):
            if "size" in item.attributes:
                yield self._count(item, "size", package)
                continue
            name = self.full_name(item.required("indexTypeRef"), package)
            labels = self.enums.get(str(self.find(name).kind))
            low, high = self.find(name).like.red or (0, None)
            if labels is None and (low is None or high is None):
                raise SheetError(f"index {name} has neither labels nor a range")
            yield len(labels.names) if labels else int((high or 0) - (low or 0)) + 1

    def _labels(self, node: Node, package: str) -> dict[int, str]:
        """Return the labels of an enumeration by value; a label without a value gets the next one."""
        labels: dict[int, str] = {}
        value = -1
        for item in node.inside("EnumerationList", "Enumeration"):
            try:
                value = self._parameters.integer(item.attributes.get("value", str(value + 1)), package)
            except SheetError as error:
                self._note(item, str(error))
            else:
                labels.setdefault(value, item.attributes.get("label", ""))
        return labels

    def _scalar(
        self, node: Node, name: str, kind: str, encoding: Node | None, package: str
    ) -> placement.DataType:
        """Return the type of a number, a flag or an enumeration."""
        labels, like = self._labels(node, package), self._like(node, package)
        words = encoding.attributes if encoding is not None else {}
        coded = self._parameters.text(words.get("encoding", "unsigned"), package)
        bits = self._count(encoding, "sizeInBits", package) if "sizeInBits" in words else kind == "Boolean"
        if encoding is None and kind != "Boolean":  # the number of bits that its values need
            least, most = (min(labels), max(labels)) if labels else (like.red or (0, None))
            bits = max(int(abs(least or 0)) * 2, int(abs(most or 0))).bit_length()
            coded = "twosComplement" if (least or 0) < 0 else "unsigned"
        if not bits:
            raise SheetError(f"{name} has no encoding that says its size")
        order = self._byte_order(words.get("byteOrder", "bigEndian"), package) if bits > 8 else None
        basic_kind = _KINDS.get(kind) or _KINDS.get(coded, BasicKind.BYTE)
        if words.get("falseValue", "zeroIsFalse") != "zeroIsFalse":
            basic_kind, labels = BasicKind.UINT, {0: "TRUE", 1: "FALSE"}
        doubt = self._doubt(kind, words, bits, package) or f"encoding {coded}" * (
            basic_kind is BasicKind.BYTE
        )
        if like.red and _all_of(like.red, bits, signed=basic_kind is BasicKind.INT):
            like = replace(like, red=None)
        return self.labelled(
            placement.scalar(basic_kind, int(bits), order, like, doubt), placement.c_name(name), labels
        )

    def _doubt(self, kind: str, words: Mapping[str, str], bits: int, package: str) -> str:
        """Return the reason why a float cannot be read; empty if it can, and for other kinds."""
        precision = self._parameters.text(words.get("encodingAndPrecision", _SINGLE), package)
        sound = kind != "Float" or (precision.startswith("IEEE754") and bits in {32, 64})
        return "" if sound else f"encoding {precision} of {bits} bits"

    def _byte_order(self, raw: str, package: str) -> ByteOrder:
        text = self._parameters.text(raw, package)
        if text not in {"bigEndian", "littleEndian"}:
            raise SheetError(f"byte order {text!r} is neither bigEndian nor littleEndian")
        return self._order if self._machine else "big" if text == "bigEndian" else "little"

    def _container(self, node: Node, name: str) -> placement.DataType:
        """Lay out a container: the entries of its bases, its own, and the trailers of all."""
        entries: list[tuple[Node, str]] = []
        trailers: list[tuple[Node, str]] = []
        for base in self.bases(name):
            if base in PACKET_HEADERS:
                break
            if base not in self._nodes:
                raise SheetError(f"type {base} is in none of these files")
            own, place = self._nodes[base], base.rpartition("/")[0]
            entries = [(item, place) for item in own.children if item.tag == "EntryList"] + entries
            trailers += [(item, place) for item in own.children if item.tag == "TrailerEntryList"]
        maker = placement.Placement(self._order, machine=self._machine)
        for listed, place in (*entries, *trailers):
            for entry in listed.children:
                self._entry(maker, entry, place, name)
        if maker.wrapped and base not in PACKET_HEADERS and not name.endswith("Payload"):
            return maker.wrapped
        called = self.add_struct(name, maker, node.doc)
        return placement.DataType(called, maker.end(), alignment=maker.alignment, variable=maker.varies)

    def _entry(self, maker: placement.Placement, entry: Node, package: str, owner: str) -> None:
        """Place an entry; if later entries then have no known position, the rest of the packet is bytes."""
        if maker.varies or entry.tag == "LongDescription":
            return
        try:
            why = self._laid(maker, entry, package, owner)
        except SheetError as error:
            self._note(entry, f"{error}; {owner} from there on is shown as bytes")
            maker.rest(BASIC["byte"])
        else:
            if why:
                self._note(entry, f"{owner}.{entry.name}: {why}")

    def _laid(self, maker: placement.Placement, entry: Node, package: str, owner: str) -> str:
        """Place an entry; return the reason why it is not shown as its type, empty if it is."""
        if entry.tag == "PaddingEntry":
            maker.pad(self._count(entry, "sizeInBits", package))
            return ""
        if entry.tag not in _ENTRIES:
            raise SheetError(f"{entry.tag} is no entry")
        if next(entry.inside("PresentWhen"), None) is not None:
            raise SheetError(f"{owner}.{entry.name} is there only sometimes")
        data_type = self._entry_type(entry, package, owner)
        if entry.tag == "ListEntry":
            return maker.open(entry.name, data_type)
        if data_type.order and not data_type.doubt:
            self.orders[data_type.order] += 1
        return maker.place(placement.c_name(entry.name), data_type)

    def _entry_type(self, entry: Node, package: str, owner: str) -> placement.DataType:
        """Return the type of an entry, which may have its own encoding, unit and limits."""
        name = self.full_name(entry.required("type"), package)
        data_type = self.find(name)
        own = next((item for item in entry.children if item.tag.endswith("DataEncoding")), None)
        if own is not None:
            kind = self._nodes[name].tag.removesuffix("DataType")
            data_type = self._scalar(self._nodes[name], f"{owner}_{entry.name}", kind, own, package)
        return replace(data_type, like=self._like(entry, package, data_type))

    def _like(self, node: Node, package: str, base: placement.DataType | None = None) -> Member:
        """Return a member with the unit, limits and documentation of a node; these override a type's."""
        like = base.like if base else placement.UNNAMED
        attributes = [node.attributes, *(item.attributes for item in node.inside("Semantics"))]
        unit = next((item["unit"] for item in attributes if item.get("unit")), like.unit)
        like = replace(like, unit=" ".join(unit.split()), doc=node.doc)
        terms: dict[float, float] = {}
        for item in node.inside("PolynomialCalibrator", "Term"):
            if node.tag == "LengthEntry":
                break  # it is about counting bytes, not about the meaning of the value
            exponent = self._parameters.integer(item.required("exponent"), package)
            terms[exponent] = float(self._parameters.number(item.required("coefficient"), package))
        if terms:
            like = replace(like, polynomial=placement.polynomial(terms))
        for tag in ("Range", "ValidRange", "SafeRange", "SafeRangeSet", "NominalRange", "NominalRangeSet"):
            for holder in node.inside(tag):
                for item in holder.walk():
                    if item.tag == "MinMaxRange":
                        among = self._range(item, package)
                        like = replace(like, yellow=among) if "Nominal" in tag else replace(like, red=among)
        return like

    def _range(self, node: Node, package: str) -> Range:
        excluded = _EXCLUDED.get(node.attributes.get("rangeType", ""), ())
        ends: list[Number | None] = []
        for key, inwards in (("min", 1), ("max", -1)):
            end = self._parameters.number(node.attributes[key], package) if key in node.attributes else None
            ends.append(end + inwards if isinstance(end, int) and key in excluded else end)
        return ends[0], ends[1]

    def _count(self, node: Node | None, key: str, package: str) -> int:
        assert node is not None, "its attribute was there"
        value = self._parameters.integer(node.required(key), package)
        if not 0 <= value <= placement.MOST_VALUE_BITS:
            raise SheetError(f"{key} {value} is not a number of 0 to {placement.MOST_VALUE_BITS}")
        return value


def _all_of(ends: Range, bits: int, *, signed: bool) -> bool:
    """Return whether a range contains all values of a number of bits."""
    low = -(1 << (bits - 1)) if signed else 0
    least, most = ends
    return (least is None or least <= low) and (most is None or most >= low + (1 << bits) - 1)


_ROOTS: Final = ("PackageFile", "DataSheet", "DesignParameters")
_TOPICS: Final = {
    "command": (
        ("CFE_MISSION/TELECOMMAND_BASE_TOPICID", 0x1800),
        ("CFE_MISSION/GLOBAL_CMD_BASE_TOPICID", 0x1860),
    ),
    "telemetry": (
        ("CFE_MISSION/TELEMETRY_BASE_TOPICID", 0x0800),
        ("CFE_MISSION/GLOBAL_TLM_BASE_TOPICID", 0x0860),
    ),
}
"""First topics of one processor and of all processors, with the MsgIds of the first ones."""
_MOST_TOPICS: Final = 0x100
_MACHINES: Final[dict[str, ByteOrder]] = {"-mlittle-endian": "little", "-mbig-endian": "big"}
_DEFINE: Final = re.compile(r"-D\s*([\w/]+)=(.*)", re.ASCII)
_READ: Final = DATA_TYPES.union(
    ("Package", "Define", "DataTypeSet", "DimensionList", "Dimension", "EnumerationList", "Enumeration"),
    ("Range", "ValidRange", "SafeRange", "SafeRangeSet", "NominalRange", "NominalRangeSet", "MinMaxRange"),
    ("PrecisionRange", "ConstraintSet", "ValueConstraint", "EntryList", "TrailerEntryList", "PaddingEntry"),
    ("Entry", "LengthEntry", "FixedValueEntry", "ErrorControlEntry", "ListEntry", "Semantics", "Component"),
    ("IntegerDataEncoding", "FloatDataEncoding", "BooleanDataEncoding", "StringDataEncoding", "Interface"),
    ("PolynomialCalibrator", "Term", "ComponentSet", "RequiredInterfaceSet", "ProvidedInterfaceSet"),
    ("Implementation", "GenericTypeMapSet", "GenericTypeMap", "VariableSet", "Variable", "ParameterMapSet"),
    ("ParameterMap",),
)
_QUIET: Final = frozenset({"LongDescription", "Metadata", "DeclaredInterfaceSet", "PresentWhen"})
"""Elements that are not about packets, or have their own notes; all others not in ``_READ`` are noted."""


def is_sheet(data: bytes) -> bool:
    """Return whether a file is a data sheet, or has design parameters of one."""
    return has_root(data, *_ROOTS)


def read_sheets(files: Sequence[tuple[bytes, str]], flags: Sequence[str] = ()) -> StructLayout:
    """Make one layout of data sheets.

    Args:
        files: contents and name of each file.
        flags: flags as for a compiler: ``-DPACKAGE/NAME=VALUE``, a design parameter that overrides the
            sheets; ``-mlittle-endian`` or ``-mbig-endian``, for the C structs of such a machine.

    Raises:
        ConfigError: a file is not XML, a flag is not one of these, or no file has a data type.
    """
    machine: ByteOrder | None = None
    defines: dict[str, str] = {}
    for flag in flags:
        match = _DEFINE.fullmatch(flag)
        if match:
            defines[match[1] if "/" in match[1] else f"CFE_MISSION/{match[1]}"] = match[2].strip()
        elif flag in _MACHINES:
            machine = _MACHINES[flag]
        else:
            flags_read = f"-DPACKAGE/NAME=VALUE, {' and '.join(_MACHINES)}"
            raise ConfigError(f"--cflag: {flag!r} says nothing of data sheets; there are {flags_read}")
    sheets = _Sheets([parse_document(*file) for file in files], defines)
    layout = sheets.layout(machine or "big", machine=machine is not None)
    if machine is None and sheets.little:
        layout = sheets.layout("little", machine=False)
    return layout


SHEETS: Final = Database(is_sheet, lambda data, name: read_sheets([(data, name)]), read_sheets)


class _Sheets:
    """The packages of some sheets.

    Attributes:
        little: whether the last layout has more little-endian than big-endian numbers.
    """

    def __init__(self, roots: Sequence[Node], defines: dict[str, str]) -> None:
        self._notes = Notes()
        self._nodes: dict[str, Node] = {}
        self._components: list[tuple[str, Node]] = []
        self._file = roots[0].file
        self.little = False
        written: dict[str, str] = {}
        for root in roots:
            if root.tag not in _ROOTS:
                self._notes.add(root, f"{root.tag} is no data sheet")
                continue
            for package in root.inside("Package"):
                for item in package.inside("Define"):
                    key, value = f"{package.name}/{item.name}", item.attributes.get("value", "")
                    if written.setdefault(key, value) != value:
                        self._notes.add(
                            item, f"parameter {key} has another value in an earlier file, which holds"
                        )
                for item in (node for each in package.inside("DataTypeSet") for node in each.children):
                    name = f"{package.name}/{item.name}"
                    if item.tag in DATA_TYPES and self._nodes.setdefault(name, item) is not item:
                        self._notes.add(
                            item, f"type {name} is declared in {self._nodes[name]}, too, which holds"
                        )
                self._components += (
                    (package.name, item) for item in package.inside("ComponentSet", "Component")
                )
                self._notes.unread(package, _READ, _QUIET)
        self._parameters = Parameters({**written, **defines})

    def layout(self, order: ByteOrder, *, machine: bool) -> StructLayout:
        """Return all structs, with numbers of one byte order, and their packets."""
        before = Notes(self._notes)
        types = Types(self._nodes, self._parameters, order, machine=machine, note=self._notes.add)
        names: dict[str, str] = {}
        for name, node in self._nodes.items():
            try:
                data_type = types.find(name)
                if node.tag == "ContainerDataType":
                    names[name] = str(data_type.kind)
            except SheetError as error:
                self._notes.add(node, str(error))
        bindings: dict[Key, str] = {}
        for key, name, node in self._packets(types):
            if name in names and bindings.setdefault(key, names[name]) != names[name]:
                self._notes.add(node, f"{key} is {bindings[key]} already, not {names[name]}")
        self.little = types.orders["little"] > types.orders["big"]
        notes = self._notes.lines()
        self._notes = before
        if not types.structs:
            raise ConfigError(
                *(notes or (f"{self._file}: no container in it; name the sheets of packages, too",))
            )
        return StructLayout(types.structs, types.enums, bindings, order, origin=self._file, notes=notes)

    def _packets(self, types: Types) -> Iterator[tuple[Key, str, Node]]:
        """Yield the packets: key, the container in the packet, and the interface that determines it."""
        derived: dict[str, list[str]] = {}
        kinds: dict[str, str] = {}
        for name, node in self._nodes.items():
            if node.tag != "ContainerDataType":
                continue
            try:
                *_, last = bases = list(types.bases(name))
                kinds[name] = PACKET_HEADERS.get(last, "")
            except SheetError as error:
                self._notes.add(node, str(error))
                continue
            for base in bases[1:]:
                derived.setdefault(base, []).append(name)
        for package, component in self._components:
            for interface, topic, name in self._topics(types, package, component):
                kind = kinds.get(name, "")
                try:
                    msg_id = self._msg_id(topic, kind, name)
                    for item in derived.get(name, ()):
                        code = self._function_code(types, item)
                        if code is not None and kind == "command":
                            yield Key(msg_id, code), item, interface
                        elif code is not None or item not in derived:
                            self._notes.add(
                                self._nodes[item], f"{item} has no function code; its packets are {name}"
                            )
                    if name not in derived:
                        bare = kind == "command" and not types.find(name).bits
                        yield Key(msg_id, 0 if bare else None), name, interface
                except SheetError as error:
                    self._notes.add(interface, f"{component.name}.{interface.name} of {package}: {error}")

    def _topics(self, types: Types, package: str, component: Node) -> Iterator[tuple[Node, int, str]]:
        """Yield the interfaces of a component with a topic: its number, and the type of its messages."""
        initial = {
            item.name: item.attributes.get("initialValue", "")
            for item in component.inside("Implementation", "VariableSet", "Variable")
        }
        variables = {
            item.attributes.get("interface", ""): item.attributes.get("variableRef", "")
            for item in component.inside("Implementation", "ParameterMapSet", "ParameterMap")
            if item.attributes.get("parameter") == "TopicId"
        }
        for group in ("RequiredInterfaceSet", "ProvidedInterfaceSet"):
            for interface in component.inside(group, "Interface"):
                if interface.name not in variables:
                    continue
                for item in interface.inside("GenericTypeMapSet", "GenericTypeMap"):
                    try:
                        number = self._parameters.integer(initial.get(variables[interface.name], ""), package)
                        yield interface, number, types.full_name(item.attributes.get("type", ""), package)
                    except SheetError as error:
                        self._notes.add(interface, f"topic of {interface.name}: {error}")

    def _msg_id(self, topic: int, kind: str, name: str) -> int:
        """Return the MsgId of a topic, as cFE maps it on the first processor."""
        if not kind:
            raise SheetError(f"{name} is based on none of {', '.join(PACKET_HEADERS)}")
        for parameter, first in _TOPICS[kind]:
            place = topic - self._parameters.integer(f"${{{parameter}}}", "")
            if 0 <= place < _MOST_TOPICS:
                return first + place
        raise SheetError(f"topic {topic} is not one of {kind}")

    def _function_code(self, types: Types, name: str) -> int | None:
        """Return the function code from the constraints of a container and of its bases."""
        for base in types.bases(name):
            if base in PACKET_HEADERS:
                break
            for item in self._nodes[base].inside("ConstraintSet", "ValueConstraint"):
                if item.attributes.get("entry", "").rpartition(".")[2] == "FunctionCode":
                    code = self._parameters.integer(item.attributes.get("value", ""), base.rpartition("/")[0])
                    if not 0 <= code <= 0x7F:
                        raise SheetError(f"function code {code} of {name} is not 0 to 127")
                    return code
        return None
