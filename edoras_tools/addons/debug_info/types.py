"""Makes structs from entries of debug information, which it reads in the encodings of DWARF 2 to 5."""

from __future__ import annotations

import re
from math import prod
from typing import TYPE_CHECKING, Any, Final, Protocol, TypeVar

from msgspec.structs import replace

from edoras_tools.errors import ConfigError
from edoras_tools.structs.messages import unique
from edoras_tools.structs.shapes import BASIC, OPEN, Basic, BasicKind, ByteOrder, Enumeration, Member, Struct

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

_Kept = TypeVar("_Kept", Struct, Enumeration)

_LARGEST_STRUCT: Final = 1 << 24
"""Size in bytes that a struct must stay below."""


class File(Protocol):
    """Properties of the file that holds the entries.

    Attributes:
        path: name of the file in messages.
        byte_order: byte order of the machine.
        pointer: size of an address in bytes.
    """

    path: Path
    byte_order: ByteOrder
    pointer: int

    def called(self, die: Die) -> str:
        """Return the name of a type; empty if it has none."""

    def header(self, die: Die) -> int:
        """Return the size in bytes of the cFE header at the beginning of a struct; 0 without one."""


class Maker:
    """Turns entries into structs, together with the structs and enumerations that they use.

    Attributes:
        structs: structs that were made, by name.
        enums: enumerations that they use, by name.
        warnings: one line for each type that is declared in more than one way.
    """

    def __init__(self, info: File) -> None:
        self._info = info
        self.structs: dict[str, Struct] = {}
        self.enums: dict[str, Enumeration] = {}
        self.warnings: list[str] = []
        self._names: dict[int, str] = {}
        self._open: set[int] = set()

    def struct(self, die: Die, wish: str = "") -> str:
        """Make a struct and return its name."""
        if die.offset in self._names:
            return self._names[die.offset]
        if die.offset in self._open or len(self._open) > DEEPEST:
            raise ConfigError(f"{self._info.path}: {self._info.called(die) or 'a struct'} contains itself")
        self._open.add(die.offset)
        name = self._info.called(die) or wish or "Anonymous"
        listed = list(self._members(die, 0, name))
        # Only the last member may extend to the end of the packet; another array without a size is empty.
        members = [item for at, item in enumerate(listed, 1) if OPEN not in item.dims[at == len(listed) :]]
        struct = Struct(
            name,
            number_attribute(die, "DW_AT_byte_size"),
            tuple(members),
            union=STRUCTS[die.tag],
            header=self._info.header(die),
        )
        self._open.discard(die.offset)
        name = self._keep_struct(struct)
        self._names[die.offset] = name
        return name

    def check(self) -> None:
        """Check that every member lies inside its struct, and that no struct is too large.

        Raises:
            ConfigError: a member lies outside, so the debug information is damaged; or a struct is too large.
        """
        for item in self.structs.values():
            if item.size >= _LARGEST_STRUCT:
                text = f"{item.size} bytes are more than any packet holds; take a smaller struct"
                raise ConfigError(f"{self._info.path}: {item.name}: {text}")
            for member in item.members:
                width = (member.bit + member.bits + 7) // 8 or self._size(member) * prod(member.dims)
                if not 0 <= member.offset <= member.offset + width <= item.size:
                    raise ConfigError(f"{self._info.path}: {item.name}.{member.name} lies outside its struct")

    def _keep_struct(self, struct: Struct) -> str:
        """Add a struct; a different one of the same name gets a number."""
        name = self._keep(struct, self.structs, self.enums)
        if name != struct.name:
            self.warnings.append(
                f"{struct.name} is declared in more than one way; the other is called {name}"
            )
        return name

    @staticmethod
    def _keep(declared: _Kept, alike: dict[str, _Kept], others: Mapping[str, object]) -> str:
        """Keep a type under its name, or, if another type has that name, with a number; return the name."""
        name, copy = declared.name, 2
        while name in BASIC or name in others or alike.get(name) not in (None, replace(declared, name=name)):
            name, copy = f"{declared.name}_{copy}", copy + 1
        alike[name] = replace(declared, name=name)
        return name

    def _members(self, die: Die, base: int, owner: str) -> Iterator[Member]:
        names: set[str] = set()
        before: Member | None = None
        for item in children(die):
            if item.tag == "DW_TAG_inheritance":
                parent = underlying_type(type_of(item))
                inner = self._members(parent, base + offset_of(item), owner) if parent else iter(())
            elif item.tag == "DW_TAG_member" and "DW_AT_external" not in item.attributes:
                inner = self._member(item, base, owner)
            else:
                continue
            for part in inner:
                member = part if before is None or STRUCTS[die.tag] else self._behind(before, part)
                before = member
                name = unique(member.name, names)  # C++: a base class may have a member of that name
                yield replace(member, name=name) if name != member.name else member

    def _member(self, item: Die, base: int, owner: str) -> Iterator[Member]:
        name, at = name_of(item), base + offset_of(item)
        kind = underlying_type(type_of(item))
        if not name and kind is not None and kind.tag in STRUCTS:
            yield from self._members(kind, at, owner)  # C11: an anonymous struct's members
            return
        if not name:
            return
        member = self._typed(kind, Member(name, BASIC["byte"], at), f"{owner.removesuffix('_t')}_{name}")
        width = number_attribute(item, "DW_AT_bit_size")
        if width:
            size = number_attribute(item, "DW_AT_byte_size") or self._size(member)
            place = bit_place(item, at, base, size, width, self._info.byte_order)
            if member.dims:  # of __int128, which no ROS type holds: the bytes that contain part of it
                place = {"offset": place["offset"], "dims": ((place["bit"] + width + 7) // 8,)}
                yield replace(member, **place)
                return
            if member.type == BASIC["char"]:
                sign = DWARF_ENCODINGS.get(number_attribute(kind, "DW_AT_encoding"))
                member = replace(member, type=BASIC["int8" if sign is BasicKind.INT else "uint8"])
            whole = width == 8 * self._size(member) and not place["bit"]
            member = replace(member, **({"offset": place["offset"]} if whole else place))
        yield member

    def _behind(self, before: Member, member: Member) -> Member:
        """Return a member as a bit-field if it begins inside the last byte of the bit-field before it.

        Clang does not mark a bit-field as one if it is as wide as its type.
        """
        bit = 8 * before.offset + before.bit + before.bits
        whole = not before.bits or member.bits or member.dims or member.type in self.structs
        if whole or not 0 < bit - 8 * member.offset < 8:
            return member
        kind = BASIC["int8"] if member.type == BASIC["char"] else member.type
        return replace(member, type=kind, offset=bit // 8, bit=bit % 8, bits=8 * self._size(member))

    def extent(self, item: Die) -> int:
        """Return the size of a member in bytes."""
        members = list(self._member(item, 0, ""))
        return max((self._size(member) * prod(member.dims) for member in members), default=0)

    def _size(self, member: Member) -> int:
        if isinstance(member.type, Basic):
            return member.type.size
        if member.type in self.enums:
            return self.enums[member.type].basic.size
        return self.structs[member.type].size

    def _typed(self, die: Die | None, member: Member, wish: str) -> Member:
        """Return a member with the properties of its type."""
        if die is None:
            return replace(member, dims=(OPEN,))
        if die.tag in STRUCTS:
            return replace(member, type=self.struct(die, wish))
        if die.tag == "DW_TAG_array_type":
            inner = self._typed(underlying_type(type_of(die)), member, wish)
            return replace(inner, dims=(*dimensions(die), *inner.dims))
        if die.tag == "DW_TAG_enumeration_type":
            return replace(member, type=self._enumeration(die, wish))
        if die.tag in POINTERS:
            size = number_attribute(die, "DW_AT_byte_size") or self._info.pointer
            return replace(member, type=BASIC[f"uint{8 * size}"], base=16)
        if die.tag == "DW_TAG_base_type":
            return self._basic(die, member)
        size = number_attribute(die, "DW_AT_byte_size")
        return replace(member, dims=(size,))

    def _basic(self, die: Die, member: Member) -> Member:
        size, encoding = (
            number_attribute(die, "DW_AT_byte_size"),
            number_attribute(die, "DW_AT_encoding"),
        )
        if name_of(die) == "char" and size == 1:
            return replace(member, type=BASIC["char"])
        if encoding == 0x03 and size in {8, 16}:  # a complex number: real, then imaginary
            return replace(member, type=BASIC[f"float{4 * size}"], dims=(2,))
        kind = DWARF_ENCODINGS.get(encoding)
        basic = BASIC.get(str(Basic(kind, size))) if kind else None
        turned = BYTE_ORDERS.get(number_attribute(die, "DW_AT_endianity"), self._info.byte_order)
        if basic is None or turned != self._info.byte_order:
            # No ROS type holds it (e.g. a long double), or its byte order is not that of the file.
            return replace(member, type=BASIC["byte"], dims=(size,))
        return replace(member, type=basic)

    def _enumeration(self, die: Die, wish: str) -> str:
        size = number_attribute(die, "DW_AT_byte_size") or 4
        names: dict[int, str] = {}
        for item in children(die):
            if item.tag == "DW_TAG_enumerator" and name_of(item):
                names.setdefault(int(item.attributes["DW_AT_const_value"].value), name_of(item))
        under = underlying_type(type_of(die))
        signed = min(names, default=0) < 0
        if under is not None and "DW_AT_encoding" in under.attributes:
            signed = DWARF_ENCODINGS.get(number_attribute(under, "DW_AT_encoding")) is BasicKind.INT
        bits = 8 * size
        low = -(1 << (bits - 1)) if signed else 0
        names = {(value - low) % (1 << bits) + low: name for value, name in names.items()}
        basic = BASIC[f"{'' if signed else 'u'}int{bits}"]
        enumeration = Enumeration(self._info.called(die) or wish or "Enumeration", basic, names)
        return self._keep(enumeration, self.enums, self.structs)


STRUCTS: Final = {"DW_TAG_structure_type": False, "DW_TAG_class_type": False, "DW_TAG_union_type": True}
PLAIN: Final = frozenset(
    {
        *("DW_TAG_typedef", "DW_TAG_const_type", "DW_TAG_volatile_type", "DW_TAG_restrict_type"),
        *("DW_TAG_atomic_type", "DW_TAG_packed_type"),
    }
)
"""Typedefs and qualifiers of another type."""
_SCOPES: Final = frozenset({"DW_TAG_namespace", *STRUCTS})
POINTERS: Final = frozenset(
    {
        "DW_TAG_pointer_type",
        "DW_TAG_reference_type",
        "DW_TAG_rvalue_reference_type",
        "DW_TAG_ptr_to_member_type",
    }
)
DWARF_ENCODINGS: Final = {
    0x02: BasicKind.BOOL,
    0x04: BasicKind.FLOAT,
    0x05: BasicKind.INT,
    0x06: BasicKind.INT,
    0x07: BasicKind.UINT,
    0x08: BasicKind.UINT,
    0x10: BasicKind.UINT,
}
"""DW_ATE_boolean, float, signed, signed_char, unsigned, unsigned_char, UTF."""
BYTE_ORDERS: Final[Mapping[int, ByteOrder]] = {1: "big", 2: "little"}
"""DW_END_big, little: the byte order of a type that states one."""
_ADD: Final = 0x23
"""DW_OP_plus_uconst: the operation with which DWARF 2 states a member's offset."""
DEEPEST: Final = 64
_NO_NAME: Final = re.compile(r"\W|^(?=\d)", re.ASCII)

Die = Any
"""An entry of the debug information; pyelftools has no types."""


def underlying_type(die: Die | None) -> Die | None:
    """Return the type behind typedefs and qualifiers."""
    for _ in range(DEEPEST):
        if die is None or die.tag not in PLAIN:
            return die
        die = type_of(die)
    return None


def bit_place(item: Die, at: int, base: int, size: int, width: int, order: ByteOrder) -> dict[str, Any]:
    """Return the position of a bit-field, counted as in ``Member``."""
    if "DW_AT_data_bit_offset" in item.attributes:  # DWARF 4 and 5: from the start of the struct
        bit = 8 * base + number_attribute(item, "DW_AT_data_bit_offset")
    elif "DW_AT_bit_offset" in item.attributes:  # DWARF 2 and 3: from the unit's most significant bit
        offset = number_attribute(item, "DW_AT_bit_offset")
        if offset >= 1 << 63:
            offset -= 1 << 64
        bit = 8 * at + (8 * size - offset - width if order == "little" else offset)
    else:
        bit = 8 * at
    return {"offset": bit // 8, "bit": bit % 8, "bits": width}


def children(die: Die) -> Iterator[Die]:
    """Yield the entries inside an entry.

    Raises:
        ValueError: they form a cycle, as in damaged files, where pyelftools would never end.
    """
    for item in die.iter_children():
        sibling = item.attributes.get("DW_AT_sibling")
        yield item
        if sibling is not None:
            base = 0 if sibling.form == "DW_FORM_ref_addr" else item.cu.cu_offset
            if base + sibling.value <= item.offset:
                raise ValueError("its entries go in a circle")
        elif item.has_children:
            for _ in children(item):  # up to its end; pyelftools would search for it without a limit
                pass


def types_in(die: Die, depth: int) -> Iterator[Die]:
    """Yield the types inside an entry, including those in name spaces."""
    for item in children(die):
        if item.tag == "DW_TAG_typedef" or item.tag in STRUCTS:
            yield item
        if item.tag in _SCOPES and depth < DEEPEST:
            yield from types_in(item, depth + 1)


def members_of(die: Die) -> list[Die]:
    """Return the members of a struct."""
    return [item for item in children(die) if item.tag == "DW_TAG_member"]


def name_of(die: Die) -> str:
    """Return an entry's name as a C identifier; empty if it has none."""
    entry = die.attributes.get("DW_AT_name")
    return spelled(entry.value.decode(errors="replace")) if entry else ""


def spelled(name: str) -> str:
    """Return a name as a C identifier: ``Tp<int>`` is ``Tp_int_``."""
    return _NO_NAME.sub("_", name)


def type_of(die: Die) -> Die | None:
    """Return the entry of an entry's type."""
    return die.get_DIE_from_attribute("DW_AT_type") if "DW_AT_type" in die.attributes else None


def number_attribute(die: Die, attribute: str) -> int:
    """Return an attribute that is a number; 0 where there is none."""
    entry = die.attributes.get(attribute)
    return entry.value if entry is not None and isinstance(entry.value, int) else 0


def offset_of(item: Die) -> int:
    """Return a member's offset: a number, or the one expression that DWARF 2 uses.

    Raises:
        ValueError: it is another expression.
    """
    entry = item.attributes.get("DW_AT_data_member_location")
    if entry is None:
        return 0
    if isinstance(entry.value, int):
        return entry.value
    operation, *operand = entry.value
    if operation != _ADD:
        raise ValueError(f"the place of {name_of(item) or 'a virtual base class'} is computed at run time")
    value = 0
    for index, octet in enumerate(operand):
        value |= (octet & 0x7F) << (7 * index)
    return value


def dimensions(die: Die) -> Iterator[int]:
    """Yield the dimensions of an array, outermost first."""
    for item in children(die):
        if item.tag != "DW_TAG_subrange_type":
            continue
        if "DW_AT_count" in item.attributes:
            yield number_attribute(item, "DW_AT_count")
        elif "DW_AT_upper_bound" in item.attributes:
            bound = item.attributes["DW_AT_upper_bound"].value
            # The upper bound of a zero-length array is -1, written as the largest number.
            size = bound + 1 if isinstance(bound, int) else OPEN
            yield size if size < 1 << 31 else OPEN
        else:
            yield OPEN
