"""The data types of sheets as structs: the position of every entry of a container, packed as in CCSDS 876.0.

Entries follow each other bit by bit, the most significant bit first. With a machine's byte order they are
aligned as in the C structs of a cFS that is built without data sheets: each at a multiple of its size.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from msgspec.structs import replace

from edoras_tools.addons.databases import placement
from edoras_tools.addons.databases.documents import NESTING, Node, SheetError
from edoras_tools.structs.shapes import BASIC, BasicKind, ByteOrder, Member, Range

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from edoras_tools.addons.databases.eds.parameters import Number, Parameters

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
