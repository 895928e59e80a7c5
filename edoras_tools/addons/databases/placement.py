"""Resolved data types, and the positions of one container's entries, in bits, with the resulting members.

Their documents are XML, read as plain nodes with their line: no document type, no entities except XML's own,
no other file.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Container, Iterator, Mapping
from math import prod
from typing import Any, Final, Literal, NoReturn
from xml.parsers import expat

import msgspec
from msgspec.structs import replace

from edoras_tools.errors import ConfigError
from edoras_tools.structs.messages import unique
from edoras_tools.structs.shapes import (
    BASIC,
    OPEN,
    Basic,
    BasicKind,
    ByteOrder,
    Enumeration,
    Member,
    Struct,
)

NESTING: Final = 64
"""Most elements that contain each other, types too, and most bases of one."""
_MOST_NODES: Final = 1 << 18
_SEARCHED: Final = 1 << 16
_LONGEST_TEXT: Final = 200
"""Maximum number of kept characters of an element's text: more than any unit or number has."""


class SheetError(Exception):
    """Error: a part of a file cannot be read; the other parts are."""


class Node(msgspec.Struct):
    """An element.

    Attributes:
        tag: name without a name space.
        attributes: attributes as written.
        file: name of its file.
        line: line in the file, from 1.
        children: child elements.
        text: text, without that of its children.
    """

    tag: str
    attributes: dict[str, str]
    file: str
    line: int
    children: list[Node] = msgspec.field(default_factory=list)
    text: str = ""

    @property
    def name(self) -> str:
        """Attribute ``name``; empty if it has none."""
        return self.attributes.get("name", "")

    @property
    def doc(self) -> str:
        """Short description, on one line, without Doxygen's marks."""
        words = self.attributes.get("shortDescription", "").split()
        return " ".join(word for word in words if word not in {"*", "\\brief"})

    def inside(self, *path: str) -> Iterator[Node]:
        """Yield the elements on a path of tags, one level each."""
        for item in self.children:
            if item.tag == path[0]:
                yield from item.inside(*path[1:]) if path[1:] else (item,)

    def walk(self) -> Iterator[Node]:
        """Yield the element and all its descendants."""
        yield self
        for item in self.children:
            yield from item.walk()

    def required(self, key: str) -> str:
        """Return an attribute.

        Raises:
            SheetError: the attribute is missing.
        """
        if key not in self.attributes:
            raise SheetError(f"{self.tag} {self.name}".rstrip() + f" has no {key}")
        return self.attributes[key]

    def __str__(self) -> str:
        return f"{self.file}:{self.line}"


class Notes(dict[str, Node]):
    """Notes on parts of the files that are not read, each with the first such element."""

    def add(self, node: Node, text: str) -> None:
        """Add a note, once."""
        self.setdefault(text, node)

    def unread(self, node: Node, read: Container[str], quiet: Container[str]) -> None:
        """Note the kinds of elements that are not read, each once.

        Args:
            read: tags that are read.
            quiet: tags that are not about packets, or that have their own notes; their descendants are
                skipped too.
        """
        if node.tag in quiet:
            return
        if node.tag not in read:
            self.add(node, f"{node.tag} is not read")
            return
        for item in node.children:
            self.unread(item, read, quiet)

    def lines(self) -> tuple[str, ...]:
        """Return one line for each note, with file and line."""
        return tuple(f"{node}: {text}" for text, node in self.items())


def has_root(data: bytes, *tags: str) -> bool:
    """Return whether a file is XML and begins with an element of one of these tags, in any name space."""
    root = rb"<(?:[\w.-]+:)?(?:%s)[\s>/]" % "|".join(tags).encode()
    is_xml = data[:4].lstrip(b"\xef\xbb\xbf \r\n\t").startswith(b"<")
    return is_xml and re.search(root, data[:_SEARCHED]) is not None


def parse_document(data: bytes, name: str) -> Node:
    """Return the root of a document.

    Raises:
        ConfigError: it is not XML, has a document type, or is too deep or too large for a description of
        packets.
    """
    parser = expat.ParserCreate(namespace_separator=" ")
    root = Node("", {}, name, 0)
    above = [root]
    count = 0

    def refuse(why: str) -> NoReturn:
        raise ConfigError(f"{name}:{parser.CurrentLineNumber}: {why}")

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1
        if len(above) > NESTING or count > _MOST_NODES:
            refuse(f"more than {NESTING} levels or {_MOST_NODES:,} elements; that describes no packets")
        plain = {key.rpartition(" ")[2]: value for key, value in attributes.items()}
        node = Node(tag.rpartition(" ")[2], plain, name, parser.CurrentLineNumber)
        above[-1].children.append(node)
        above.append(node)

    def doctype(*_: Any) -> None:
        refuse("a document type (<!DOCTYPE ...>) is not read, for its entities may hold anything; remove it")

    def characters(text: str) -> None:
        above[-1].text = (above[-1].text + text)[:_LONGEST_TEXT]

    parser.StartElementHandler = start
    parser.CharacterDataHandler = characters
    parser.EndElementHandler = lambda _: above.pop()
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise ConfigError(f"{name}:{error.lineno}: is not XML: {expat.ErrorString(error.code)}") from error
    except (LookupError, ValueError) as error:  # an encoding that Python does not have
        raise ConfigError(f"{name}: is not XML: {error}") from error
    return root.children[0]


_MOST_ELEMENTS: Final = 1 << 16
_HIGHEST_POWER: Final = 64
MOST_VALUE_BITS: Final = 1 << 27
"""Maximum size of a value, bits."""
UNNAMED: Final = Member("", BASIC["byte"], 0)
_WRAPPERS: Final = frozenset({"Value", "BaseType"})
_NO_NAME: Final = re.compile(r"\W+", re.ASCII)


def c_name(name: str) -> str:
    """Return a name in C: ``CFE_ES/HousekeepingTlm`` becomes ``CFE_ES_HousekeepingTlm``."""
    plain = _NO_NAME.sub("_", name) or "unnamed"
    return plain if not plain[0].isdigit() else f"_{plain}"


class DataType(msgspec.Struct, frozen=True):
    """A resolved type.

    Attributes:
        kind: basic type, or name of an enumeration or a struct.
        bits: size of one element; for a text, of all its characters.
        dims: dimensions of an array; for a text the last one is its length.
        scalar: whether it is a number, a flag or an enumeration.
        order: byte order; None for a single byte.
        alignment: alignment in C, bytes; for a scalar, the number of bytes that hold it.
        doubt: reason why its number cannot be read, and is shown as bytes; empty if it can.
        variable: whether its length varies, so that later entries have no fixed position.
        like: member with its unit, calibration and limits.
    """

    kind: Basic | str
    bits: int
    dims: tuple[int, ...] = ()
    scalar: bool = False
    order: ByteOrder | None = None
    alignment: int = 1
    doubt: str = ""
    variable: bool = False
    like: Member = UNNAMED

    @property
    def text(self) -> bool:
        """Whether it is a text or an array of texts."""
        return self.kind == BASIC["char"] and bool(self.dims)

    @property
    def whole_bits(self) -> int:
        """Size of all elements, bits."""
        return self.bits * prod(self.dims[:-1] if self.text else self.dims)


def scalar(kind: BasicKind, bits: int, order: ByteOrder | None, like: Member, doubt: str = "") -> DataType:
    """Return the type of a number or a flag of any width.

    Args:
        kind: kind of bytes.
        bits: width, bits.
        order: byte order.
        like: member with its unit and limits.
        doubt: reason why it cannot be read as that kind.
    """
    octets = 1 << max(0, (-(-bits // 8) - 1).bit_length())
    if octets > 8:
        octets, doubt = 8, doubt or f"{bits} bits"
    basic = BASIC["float64"] if doubt else BASIC[str(Basic(kind, octets))]
    return DataType(
        basic, bits, scalar=True, order=order if bits > 8 else None, alignment=octets, doubt=doubt, like=like
    )


def polynomial(terms: Mapping[float, float]) -> tuple[float, ...]:
    """Return the coefficients of a calibration by rising power, from those of some powers.

    Raises:
        SheetError: a power is no integer of 0 to ``_HIGHEST_POWER``.
    """
    for power in terms:
        if power not in range(_HIGHEST_POWER + 1):
            raise SheetError(f"exponent {power} of a calibration is not 0 to {_HIGHEST_POWER}")
    return tuple(terms.get(power, 0.0) for power in range(int(max(terms, default=-1)) + 1))


class TypeTable:
    """The types of some descriptions, each made once, and the structs and enumerations that they need.

    Attributes:
        structs: structs by name.
        enums: enumerations by name.
    """

    def __init__(self) -> None:
        self.structs: dict[str, Struct] = {}
        self.enums: dict[str, Enumeration] = {}
        self._used: set[str] = {*BASIC}
        self._types: dict[str, DataType | SheetError] = {}
        self._open: list[str] = []

    def resolve(self, name: str, make: Callable[[], DataType]) -> DataType:
        """Return a type by its full name; ``make`` makes it at the first use.

        Raises:
            SheetError: the type contains itself, or cannot be read.
        """
        result = self._types.get(name)
        if result is None:
            if name in self._open or len(self._open) > NESTING:
                raise SheetError(f"type {name} contains itself")
            self._open.append(name)
            try:
                result = make()
                if result.whole_bits > MOST_VALUE_BITS or prod(result.dims) > _MOST_ELEMENTS:
                    result = SheetError(f"type {name} is larger than any packet")
            except SheetError as error:
                result = error
            self._open.pop()
            self._types[name] = result
        if isinstance(result, SheetError):
            raise SheetError(str(result))
        return result

    def labelled(self, number: DataType, name: str, labels: Mapping[int, str]) -> DataType:
        """Return the type of a number whose values have labels; the number itself if it cannot have any.

        Args:
            labels: label of each value, as any text; dropped where the number cannot hold the value.
        """
        basic = number.kind
        if not labels or number.doubt or not isinstance(basic, Basic):
            return number
        used: set[str] = set()
        names = {value: unique(c_name(text), used) for value, text in labels.items() if basic.holds(value)}
        same = self.enums.get(name)
        if same is None or (same.basic, same.names) != (basic, names):
            name = unique(name, self._used)
            self.enums[name] = Enumeration(name, basic, names)
        return replace(number, kind=name)

    def add_struct(self, name: str, placed: Placement, doc: str, tail: int = 0) -> str:
        """Add the struct of a container; return its name, which differs from all others."""
        size, name = placed.end(), unique(c_name(name), self._used)
        self.structs[name] = Struct(name, -(-size // 8), tuple(placed.members), doc=doc, tail=tail)
        return name


class Placement:
    """The members of one container, and the present position.

    Attributes:
        members: members in order.
        alignment: alignment of the whole container in C, bytes.
        varies: whether later entries have no fixed position.
        wrapped: type of the only entry, if its name has no meaning, as ``Value``.
    """

    def __init__(self, order: ByteOrder, *, machine: bool) -> None:
        self._little = order == "little"
        self._order = order
        self._machine = machine
        self._bit = 0
        self._names: set[str] = set()
        self.members: list[Member] = []
        self.alignment = 1
        self.varies = False
        self.wrapped: DataType | None = None

    def pad(self, bits: int) -> None:
        """Skip bits."""
        self._bit += bits

    def go_to(self, bit: int) -> None:
        """Set the position of the next entry, bits."""
        self._bit = bit

    def end(self) -> int:
        """Return the size of the whole container, bits."""
        if self._machine and not self.varies:
            self._align(self.alignment)
        if self._bit > MOST_VALUE_BITS:
            raise SheetError(f"its {self._bit // 8:,} bytes are more than any packet holds")
        return self._bit

    def _align(self, alignment: int) -> None:
        self._bit = -(-self._bit // (8 * alignment)) * 8 * alignment

    def open(self, name: str, item: DataType) -> str:
        """Add a list at the end of the packet; return why its elements are not shown, empty if they are."""
        whole = item.bits == 8 * item.alignment if item.scalar else item.bits % 8 == 0
        if not whole or self._bit % 8 or item.doubt or item.variable:
            self.rest(BASIC["byte"], name)
            return (
                item.doubt or "its elements are not alike, or of other than whole bytes; it is shown as bytes"
            )
        self.rest(item.kind, name, item.dims, replace(item.like, order=self._own_order(item)))
        return ""

    def _own_order(self, item: DataType) -> ByteOrder | Literal[""]:
        """Return the byte order of a number if it differs from the layout's; else an empty text."""
        return item.order if item.order and item.order != self._order else ""

    def rest(
        self, kind: Basic | str, name: str = "rest", dims: tuple[int, ...] = (), like: Member | None = None
    ) -> None:
        """Add an open array up to the end of the packet."""
        self._bit = -(-self._bit // 8) * 8
        own_name = unique(c_name(name), self._names)
        self.members.append(
            replace(like or UNNAMED, name=own_name, type=kind, offset=self._bit // 8, dims=(OPEN, *dims))
        )
        self.varies = True

    def place(self, name: str, item: DataType) -> str:
        """Add a member at the position; return why it is not shown as its type, empty if it is."""
        if self._machine and item.bits % 8 == 0:
            self._align(item.alignment)
            self.alignment = max(self.alignment, item.alignment)
        at = self._bit
        self.wrapped = item if not at and item.scalar and not item.dims and name in _WRAPPERS else None
        self._bit += item.whole_bits
        if item.dims and not item.whole_bits:
            return ""
        why = item.doubt
        if not why and self._own_order(item) and (at % 8 or item.bits != 8 * item.alignment):
            why = f"its {item.order}-endian bits are beside {self._order}-endian numbers"
        member = self._member(unique(name, self._names), item, at, sound=not why)
        if member is None:
            return f"{why or 'it does not begin and end with a byte'}; it is left out"
        self.members.append(member)
        if item.variable and len(self.members) > 1:
            self.rest(BASIC["byte"])
        self.varies = item.variable
        return why and f"{why}; it is shown as bytes"

    def _member(self, name: str, item: DataType, at: int, *, sound: bool) -> Member | None:
        """Return a member at a bit: of its type if ``sound``, else as bytes; None if neither is possible."""
        byte, bit = divmod(at, 8)
        order = self._own_order(item)
        member = replace(item.like, name=name, type=item.kind, offset=byte, dims=item.dims, order=order)
        start = self._start(item, bit) if sound and not item.dims and not order else None
        if sound and not bit and item.bits % 8 == 0 and (not item.scalar or item.bits == 8 * item.alignment):
            return member
        if start is not None:
            return replace(member, bits=item.bits, bit=start)
        if bit or item.whole_bits % 8:
            return None
        doc = f"{item.whole_bits // item.bits} x {item.bits} bits" if item.dims else member.doc
        return Member(name, BASIC["byte"], byte, (item.whole_bits // 8,), doc=doc)

    def _start(self, item: DataType, bit: int) -> int | None:
        """Return the start of a bit-field, as in ``Member.bit``; None if it cannot be one."""
        if not item.scalar or (bit + item.bits + 7) // 8 > 8 or str(item.kind).startswith("float"):
            return None
        if not self._little or self._machine or item.bits % 8 == bit == 0:
            return bit
        return 8 - bit - item.bits if bit + item.bits <= 8 else None
