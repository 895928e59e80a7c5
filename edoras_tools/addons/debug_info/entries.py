"""Reads single entries of debug information, in the encodings of DWARF 2 to 5."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.structs.shapes import OPEN, BasicKind, ByteOrder

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping


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
