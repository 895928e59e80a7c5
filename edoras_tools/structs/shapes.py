"""C data types as values, from debug information or from a layout file."""

from __future__ import annotations

from enum import Enum
from math import inf, prod
from typing import TYPE_CHECKING, Any, Final, Literal, Protocol

import msgspec
from msgspec.structs import replace

from edoras_tools.cfs import sbn, telemetry_output
from edoras_tools.wire import cfe, robot

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from edoras_tools.wire.msg_id import MsgIds


SHIPPED: Final = "cfe"
"""The name of their layout."""
PACKETS: Final = {
    0x0800: "CFE_ES_HousekeepingTlm",
    0x0801: "CFE_EVS_HousekeepingTlm",
    cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID: "CFE_SB_HousekeepingTlm",
    0x0804: "CFE_TBL_HousekeepingTlm",
    0x0805: "CFE_TIME_HousekeepingTlm",
    0x0806: "CFE_TIME_DiagnosticTlm",
    cfe.EVENT_MSG_ID: "CFE_EVS_LongEventTlm",
    0x080A: "CFE_SB_StatsTlm",
    0x080B: "CFE_ES_OneAppTlm",
    0x0880: "TO_LAB_HkTlm",
    0x0884: "CI_LAB_HkTlm",
}
"""Struct by MsgId of version 1; :mod:`edoras_tools.structs.cfe` describes them."""
COMMANDED: Final = (
    *(0x1801, 0x1803, 0x1804, 0x1805, 0x1806, telemetry_output.COMMAND_MSG_ID),
    *(0x1895, 0x18B3, 0x18BB, sbn.COMMAND_MSG_ID),
)
"""MsgIds of version 1 whose commands take arguments, as :mod:`edoras_tools.cfs.arguments` has them."""
UDP_KEY: Final = 1 << 16
"""A key from here on is a UDP port, not a MsgId: of datagrams of the robot link, on any port if it is 0."""
ENTRY_KEY: Final = 2 * UDP_KEY
"""A key from here on is a place in the table of a dictionary's entries."""
DATAGRAMS: Final = {layout.size: layout for layout in robot.SENT_TO}
"""The header that a datagram on the robot link is, by its bytes."""
OWN_LAYERS: Final = frozenset(
    layout.name for layout in (cfe.EVENT, cfe.SOFTWARE_BUS_HOUSEKEEPING, *DATAGRAMS.values())
)
"""Headers that are structs as well: their layers show the same fields."""


def commanded(msg_ids: MsgIds) -> list[int]:
    """Return :data:`COMMANDED` by the MsgIds of a version."""
    return list(map(msg_ids.of_known, COMMANDED))


def packets(msg_ids: MsgIds) -> dict[int, str]:
    """Return :data:`PACKETS` by the MsgIds of a version, without one that would be 0, which cFE refuses."""
    return {msg_id: name for msg_id_1, name in PACKETS.items() if (msg_id := msg_ids.of_known(msg_id_1))}


ByteOrder = Literal["little", "big"]
Range = tuple[float | None, float | None]
"""The lowest and the highest value that belong to it; None for no end."""
_ANY: Final[Range] = (None, None)
OPEN: Final = 0
"""The dimension of an array that extends to the end of the packet; only the last member may have it."""


class BasicKind(Enum):
    """How the bytes of a basic type are read."""

    UINT = "uint"
    INT = "int"
    FLOAT = "float"
    BOOL = "bool"
    CHAR = "char"
    BYTE = "byte"


class Basic(msgspec.Struct, frozen=True):
    """A type without parts.

    Attributes:
        kind: how its bytes are read.
        size: how many there are.
    """

    kind: BasicKind
    size: int

    def __str__(self) -> str:
        """The name in a layout file, as ``uint16``, ``float64`` or ``char``."""
        plain = (
            self.kind is BasicKind.CHAR
            or self.kind is BasicKind.BYTE
            or (self.kind is BasicKind.BOOL and self.size == 1)
        )
        return self.kind.value if plain else f"{self.kind.value}{8 * self.size}"

    def holds(self, value: int) -> bool:
        """Tell whether an integer of this type can have a value."""
        bits = 8 * self.size
        low = -(1 << (bits - 1)) if self.kind is BasicKind.INT else 0
        return low <= value < low + (1 << bits)


BASIC: Final = {
    str(item): item
    for item in (
        *(
            Basic(kind, size)
            for kind in (BasicKind.UINT, BasicKind.INT, BasicKind.BOOL)
            for size in (1, 2, 4, 8)
        ),
        *(Basic(BasicKind.FLOAT, size) for size in (4, 8)),
        Basic(BasicKind.CHAR, 1),
        Basic(BasicKind.BYTE, 1),
    )
}
"""Every basic type by its name."""


class Enumeration(msgspec.Struct, frozen=True):
    """Names for the values of an integer.

    Attributes:
        name: as in C.
        basic: the integer.
        names: what values mean.
    """

    name: str
    basic: Basic
    names: Mapping[int, str]


class Member(msgspec.Struct, frozen=True):
    """One member of a struct or union.

    Attributes:
        name: as in C.
        type: a basic type, or the name of an enumeration or a struct of the same layout.
        offset: its first byte, from the start of the struct; of a bit-field the byte its first bit is in.
        dims: dimensions of an array, outermost first; the last of a ``char`` array is its text.
        bits: width of a bit-field; 0 where it is none.
        bit: where in byte ``offset`` a bit-field starts: counted from the least significant bit where the
            byte order is little, from the most significant where it is big, as compilers do.
        base: of the number when it is shown: 10 or 16.
        doc: one line.
        unit: of its value, once it is calibrated.
        polynomial: coefficients by rising power, which make a value of the number; nothing: they are one.
        yellow: values that give no reason for attention; None for no such limits.
        red: values that are not an alarm.
        order: of its bytes; empty where it is that of its layout.
    """

    name: str
    type: Basic | str
    offset: int
    dims: tuple[int, ...] = ()
    bits: int = 0
    bit: int = 0
    base: Literal[10, 16] = 10
    doc: str = ""
    unit: str = ""
    polynomial: tuple[float, ...] = ()
    yellow: Range | None = None
    red: Range | None = None
    order: ByteOrder | Literal[""] = ""

    @property
    def text(self) -> bool:
        """Whether it is a text, or an array of texts."""
        return bool(self.dims) and isinstance(self.type, Basic) and self.type.kind is BasicKind.CHAR

    @property
    def array(self) -> tuple[int, ...]:
        """The dimensions that count elements: of texts all but the last."""
        return self.dims[:-1] if self.text else self.dims

    @property
    def count(self) -> int:
        """Elements in all; 0 where the array is open."""
        return prod(self.array)

    @property
    def row(self) -> int:
        """Elements of one row of an open array."""
        return prod(self.array[1:])

    def calibrated(self, number: Any) -> Any:
        """Return the value of a number, or of each of an array, in its unit."""
        value = 0.0
        for coefficient in reversed(self.polynomial):
            value = value * number + coefficient
        return value if self.polynomial else number

    def beyond(self, value: Any) -> tuple[Any, Any]:
        """Tell whether a value, or each of an array, is outside the yellow limits, and the red ones."""
        ends = ((-inf if low is None else low, inf if high is None else high) for low, high in self._ranges)
        yellow, red = ((value < low) | (value > high) for low, high in ends)
        return yellow, red

    @property
    def limits(self) -> str:
        """Its limits in words."""
        return ", ".join(
            f"{color} {' to '.join('any' if end is None else f'{end:.9g}' for end in ends)}"
            for color, ends in zip(("yellow", "red"), self._ranges, strict=True)
            if ends != _ANY
        )

    @property
    def _ranges(self) -> tuple[Range, Range]:
        return self.yellow or _ANY, self.red or _ANY


class Struct(msgspec.Struct, frozen=True):
    """The memory layout of a struct or union.

    Attributes:
        name: as in C.
        size: bytes, padding at the end included.
        members: in the order of the declaration.
        union: all members lie at its start.
        header: bytes of the cFE header at its start, which is not part of the message; 0 for none.
        doc: one line; of a command the application's name for it.
        tail: bytes that some builds and senders add.
    """

    name: str
    size: int
    members: tuple[Member, ...]
    union: bool = False
    header: int = 0
    doc: str = ""
    tail: int = 0


class Key(msgspec.Struct, frozen=True, order=True):
    """The packets that hold a struct, or the datagrams of the robot link, or an entry of a dictionary.

    Attributes:
        msg_id: of the packet; of datagrams ``UDP_KEY`` and the port that they are sent to; of an entry
            ``ENTRY_KEY`` and its place.
        function_code: of a command; None for all. Of datagrams their bytes.
    """

    msg_id: int
    function_code: int | None = None

    @property
    def port(self) -> int | None:
        """The port that datagrams are sent to, 0 for any of the robot link; None of packets."""
        return self.msg_id - UDP_KEY if UDP_KEY <= self.msg_id < ENTRY_KEY else None

    def __str__(self) -> str:
        if self.msg_id >= ENTRY_KEY:
            return f"entry:{self.msg_id - ENTRY_KEY}"
        text = f"0x{self.msg_id:04x}" if self.port is None else f"udp:{self.port or 'robot'}"
        return text + (f"/{self.function_code}" if self.function_code is not None else "")


class LayoutEntry(Protocol):
    """One entry of a dictionary; they sort as a table shows them."""

    @property
    def name(self) -> str:
        """Qualified name."""

    @property
    def word(self) -> str:
        """What it is, as ``event``."""

    @property
    def id_text(self) -> str:
        """The ID as on the wire, in hex."""

    def __hash__(self) -> int: ...

    def __lt__(self, other: Any, /) -> bool: ...


class LayoutEntries(Protocol):
    """The entries of a dictionary, in the order of their keys; see ``structs.entries``."""

    def __len__(self) -> int: ...

    def __getitem__(self, place: int, /) -> LayoutEntry: ...

    def bind(self, key: Key, layout: StructLayout, struct: Struct, type_name: str) -> Any:
        """Return the struct of an entry as its messages are made, a ``bound.Bound``."""

    def table(self, structs: Any) -> Any:
        """Return the ``entries.LayoutEntryTable`` of them; ``structs`` is the ``table.Structs``."""


class StructLayout(msgspec.Struct, frozen=True):
    """Structs that belong together, and the packets that hold them.

    Attributes:
        structs: by name, all that these use among them.
        enums: by name.
        bindings: the struct of each packet.
        byte_order: of every number whose member says no other.
        package: ROS package of the messages.
        origin: the file it was read from, for messages.
        entries: of a dictionary, in the order of their keys; these have no cFE header. Else None.
        notes: what of its files was not read, a line each.
    """

    structs: Mapping[str, Struct]
    enums: Mapping[str, Enumeration] = msgspec.field(default_factory=dict)
    bindings: Mapping[Key, str] = msgspec.field(default_factory=dict)
    byte_order: ByteOrder = "little"
    package: str = "cfs_msgs"
    origin: str = ""
    entries: LayoutEntries | None = None
    notes: tuple[str, ...] = ()

    def is_little(self, member: Member) -> bool:
        """Tell whether the number of a member has its lowest byte first."""
        return (member.order or self.byte_order) == "little"

    def enumeration(self, member: Member) -> Enumeration | None:
        """Return the enumeration that a member is of, or None."""
        return self.enums.get(member.type) if isinstance(member.type, str) else None

    def basic(self, member: Member) -> Basic | None:
        """Return the basic type of a member, that of its enumeration too; None for a struct."""
        if isinstance(member.type, Basic):
            return member.type
        enumeration = self.enums.get(member.type)
        return enumeration.basic if enumeration else None

    def size(self, member: Member) -> int:
        """Return the bytes of one element of a member; of a text all its characters."""
        basic = self.basic(member)
        if basic is None:
            return self.structs[str(member.type)].size
        return member.dims[-1] if member.text else basic.size


class Wanted(msgspec.Struct, frozen=True):
    """A member whose offset is to be computed.

    Attributes:
        member: its offset and bit count only where it is ``placed``.
        size: bytes of one element.
        alignment: what its offset must be a multiple of.
        placed: whether the layout gives its offset.
    """

    member: Member
    size: int
    alignment: int
    placed: bool


def arrange(
    declared: Iterable[Wanted], *, union: bool = False, packed: bool = False
) -> tuple[list[Member], int, int]:
    """Compute the offset of every member, as the System V ABI does.

    Args:
        declared: in the order of the declaration.
        union: all members start at 0.
        packed: no padding at all.

    Returns:
        the members, the bytes of the struct with its padding, and its alignment.
    """
    members: list[Member] = []
    bit, end, widest = 0, 0, 1  # the next free bit, and the end of the members so far
    for item in declared:
        alignment = 1 if packed else item.alignment
        widest = max(widest, alignment)
        member, unit = item.member, 8 * item.size
        if union:
            bit = 0
        if item.placed:
            bit = 8 * member.offset + member.bit
        elif not member.bits:
            bit = -(-bit // (8 * alignment)) * 8 * alignment
        elif not packed and bit % unit + member.bits > unit:
            bit = -(-bit // unit) * unit  # a bit-field does not straddle units of its type
        members.append(replace(member, offset=bit // 8, bit=bit % 8 if member.bits else 0))
        bit += member.bits or 8 * item.size * prod(member.array)
        end = max(end, -(-bit // 8))
    return members, -(-end // widest) * widest, widest
