"""Where the entries of one container lie, bit by bit, and the members that they become."""

from __future__ import annotations

import re
from math import prod
from typing import Final, Literal

import msgspec
from msgspec.structs import replace

from edoras_tools.addons.databases.documents import SheetError
from edoras_tools.structs.messages import unique
from edoras_tools.structs.shapes import BASIC, OPEN, Basic, BasicKind, ByteOrder, Member

MOST_VALUE_BITS: Final = 1 << 27
"""Bits of a value at the most."""
UNNAMED: Final = Member("", BASIC["byte"], 0)
_WRAPPERS: Final = frozenset({"Value", "BaseType"})
_NO_NAME: Final = re.compile(r"\W+", re.ASCII)


def c_name(name: str) -> str:
    """Return a name as in C: ``CFE_ES/HousekeepingTlm`` is ``CFE_ES_HousekeepingTlm``."""
    plain = _NO_NAME.sub("_", name) or "unnamed"
    return plain if not plain[0].isdigit() else f"_{plain}"


class DataType(msgspec.Struct, frozen=True):
    """What a name of a type stands for.

    Attributes:
        kind: a basic type, or the name of an enumeration or a struct.
        bits: of one element; of a text all its characters.
        dims: of an array; the last of a text its length.
        scalar: whether it is a number, a flag or an enumeration.
        order: of the bytes of one; nothing where it has one byte.
        alignment: in C, in bytes; of a scalar the bytes that hold it.
        doubt: why its number cannot be read, which is then shown as bytes.
        variable: whether its length varies, so that nothing behind it has a fixed place.
        like: a member with its unit and limits.
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
        """All its bits."""
        return self.bits * prod(self.dims[:-1] if self.text else self.dims)


def scalar(kind: BasicKind, bits: int, order: ByteOrder | None, like: Member, doubt: str = "") -> DataType:
    """Return the type of a number or a flag of any width.

    Args:
        kind: how its bytes are read.
        bits: its width.
        order: of its bytes.
        like: a member with its unit and limits.
        doubt: why it cannot be read as that.
    """
    octets = 1 << max(0, (-(-bits // 8) - 1).bit_length())
    if octets > 8:
        octets, doubt = 8, doubt or f"{bits} bits"
    basic = BASIC["float64"] if doubt else BASIC[str(Basic(kind, octets))]
    return DataType(
        basic, bits, scalar=True, order=order if bits > 8 else None, alignment=octets, doubt=doubt, like=like
    )


class Placement:
    """The members of one container, and the bit behind the last.

    Attributes:
        members: in their order.
        alignment: of the whole in C, in bytes.
        varies: whether nothing more has a fixed place.
        wrapped: type of the only entry, where it has a name that says nothing, as ``Value``.
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
        """Leave bits out."""
        self._bit += bits

    def go_to(self, bit: int) -> None:
        """Place what follows at a bit."""
        self._bit = bit

    def end(self) -> int:
        """Return the bits of the whole."""
        if self._machine and not self.varies:
            self._align(self.alignment)
        if self._bit > MOST_VALUE_BITS:
            raise SheetError(f"its {self._bit // 8:,} bytes are more than any packet holds")
        return self._bit

    def _align(self, alignment: int) -> None:
        self._bit = -(-self._bit // (8 * alignment)) * 8 * alignment

    def open(self, name: str, item: DataType) -> str:
        """Add a list to the end of the packet; return why its elements are not shown, or nothing."""
        whole = item.bits == 8 * item.alignment if item.scalar else item.bits % 8 == 0
        if not whole or self._bit % 8 or item.doubt or item.variable:
            self.rest(BASIC["byte"], name)
            return (
                item.doubt or "its elements are not alike, or of other than whole bytes; it is shown as bytes"
            )
        self.rest(item.kind, name, item.dims, replace(item.like, order=self._own_order(item)))
        return ""

    def _own_order(self, item: DataType) -> ByteOrder | Literal[""]:
        """Return the byte order of a number where it is not that of the whole."""
        return item.order if item.order and item.order != self._order else ""

    def rest(
        self, kind: Basic | str, name: str = "rest", dims: tuple[int, ...] = (), like: Member | None = None
    ) -> None:
        """Add what reaches to the end of the packet."""
        self._bit = -(-self._bit // 8) * 8
        own_name = unique(c_name(name), self._names)
        self.members.append(
            replace(like or UNNAMED, name=own_name, type=kind, offset=self._bit // 8, dims=(OPEN, *dims))
        )
        self.varies = True

    def place(self, name: str, item: DataType) -> str:
        """Add a member behind the last; return why it cannot be shown as what it is, or nothing."""
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
        """Return a member at a bit: as what it is where it is ``sound``, else as bytes; None: as neither."""
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
        """Return where a bit-field starts, as ``Member.bit`` counts; None if it cannot be one."""
        if not item.scalar or (bit + item.bits + 7) // 8 > 8 or str(item.kind).startswith("float"):
            return None
        if not self._little or self._machine or item.bits % 8 == bit == 0:
            return bit
        return 8 - bit - item.bits if bit + item.bits <= 8 else None
