"""C data types as values, from debug information or from a layout file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from enum import Enum
from math import inf, prod
from typing import TYPE_CHECKING, Any, Final, Literal, Protocol

import msgspec
from msgspec.structs import replace

from edoras_tools.cfs import sbn, telemetry_output
from edoras_tools.links import bare
from edoras_tools.wire import cfe

if TYPE_CHECKING:
    from edoras_tools.wire.ccsds import MsgIds


SHIPPED: Final = "cfe"
"""Name of the built-in layout."""
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
"""Struct name by MsgId of version 1; :mod:`edoras_tools.structs.files` describes these structs."""
COMMANDED: Final = (
    *(0x1801, 0x1803, 0x1804, 0x1805, 0x1806, telemetry_output.COMMAND_MSG_ID),
    *(0x1895, 0x18B3, 0x18BB, sbn.COMMAND_MSG_ID),
)
"""MsgIds of version 1 of the commands with arguments that :mod:`edoras_tools.cfs.arguments` describes."""
UDP_KEY: Final = 1 << 16
"""First key that is a UDP port, not a MsgId: for datagrams of the robot link; port 0 means any port."""
ENTRY_KEY: Final = 2 * UDP_KEY
"""First key that is an index into the entries of a dictionary."""
DATAGRAMS: Final = {layout.size: layout for layout in bare.SENT_TO}
"""Header of a datagram on the robot link, by the datagram's bytes."""
OWN_LAYERS: Final = frozenset(
    layout.name for layout in (cfe.EVENT, cfe.SOFTWARE_BUS_HOUSEKEEPING, *DATAGRAMS.values())
)
"""Headers that are structs too; their layers show the same fields."""


def commanded(msg_ids: MsgIds) -> list[int]:
    """Return :data:`COMMANDED` by the MsgIds of a version."""
    return list(map(msg_ids.of_known, COMMANDED))


def packets(msg_ids: MsgIds) -> dict[int, str]:
    """Return :data:`PACKETS` by the MsgIds of a version, without a MsgId that would be 0: cFE refuses 0."""
    return {msg_id: name for msg_id_1, name in PACKETS.items() if (msg_id := msg_ids.of_known(msg_id_1))}


ByteOrder = Literal["little", "big"]
Range = tuple[float | None, float | None]
"""Lowest and highest value inside the range; None if it has no end on this side."""
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
    """A type without members.

    Attributes:
        kind: how its bytes are read.
        size: number of its bytes.
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
        """Return whether ``value`` is in the range of this integer type."""
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
        name: name in C.
        basic: the integer type.
        names: name of each value.
    """

    name: str
    basic: Basic
    names: Mapping[int, str]


class Member(msgspec.Struct, frozen=True):
    """One member of a struct or union.

    Attributes:
        name: name in C.
        type: a basic type, or the name of an enumeration or a struct of the same layout.
        offset: first byte, from the start of the struct; for a bit-field, the byte with its first bit.
        dims: dimensions of an array, outermost first; the last one of a ``char`` array is the size of its
            text.
        bits: width of a bit-field; 0 if the member is none.
        bit: first bit of a bit-field in byte ``offset``: counted from the least significant bit if the byte
            order is little, from the most significant bit if it is big, as compilers do.
        base: number base for display: 10 or 16.
        doc: description, one line.
        unit: unit of the value, after calibration.
        polynomial: coefficients by rising power, which turn the number into the value; empty: no calibration.
        yellow: range of values that need no attention; None if there are no such limits.
        red: range of values that are no alarm; None if there are no such limits.
        order: byte order of this member; empty: that of the layout.
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
        """Whether this member is a text or an array of texts."""
        return bool(self.dims) and isinstance(self.type, Basic) and self.type.kind is BasicKind.CHAR

    @property
    def array(self) -> tuple[int, ...]:
        """The dimensions that count elements; of texts all but the last, which counts characters."""
        return self.dims[:-1] if self.text else self.dims

    @property
    def count(self) -> int:
        """Number of elements; 0 if the array is open."""
        return prod(self.array)

    @property
    def row(self) -> int:
        """Number of elements in one row of an open array."""
        return prod(self.array[1:])

    def calibrated(self, number: Any) -> Any:
        """Return the calibrated value of a number, or of each number in an array."""
        value = 0.0
        for coefficient in reversed(self.polynomial):
            value = value * number + coefficient
        return value if self.polynomial else number

    def beyond(self, value: Any) -> tuple[Any, Any]:
        """Return whether a value, or each of an array, is outside the yellow, and outside the red limits."""
        ends = ((-inf if low is None else low, inf if high is None else high) for low, high in self._ranges)
        yellow, red = ((value < low) | (value > high) for low, high in ends)
        return yellow, red

    @property
    def limits(self) -> str:
        """The limits as text for users."""
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
        name: name in C.
        size: bytes, padding at the end included.
        members: members in the order of the declaration.
        union: whether all members start at its first byte.
        header: bytes of the cFE header at its start, which is not part of the message; 0 for none.
        doc: description, one line; for a command, its name in its application.
        tail: bytes that some builds and senders add at the end.
    """

    name: str
    size: int
    members: tuple[Member, ...]
    union: bool = False
    header: int = 0
    doc: str = ""
    tail: int = 0


class Key(msgspec.Struct, frozen=True, order=True):
    """Key of the packets that hold a struct, of datagrams of the robot link, or of an entry of a dictionary.

    Attributes:
        msg_id: MsgId of the packet; for datagrams ``UDP_KEY`` plus their destination port; for an entry
            ``ENTRY_KEY`` plus its index.
        function_code: function code of a command; None for all codes; for datagrams, their bytes.
    """

    msg_id: int
    function_code: int | None = None

    @property
    def port(self) -> int | None:
        """Destination port of datagrams, 0 for any port of the robot link; None for packets and entries."""
        return self.msg_id - UDP_KEY if UDP_KEY <= self.msg_id < ENTRY_KEY else None

    def __str__(self) -> str:
        if self.msg_id >= ENTRY_KEY:
            return f"entry:{self.msg_id - ENTRY_KEY}"
        text = f"0x{self.msg_id:04x}" if self.port is None else f"udp:{self.port or 'robot'}"
        return text + (f"/{self.function_code}" if self.function_code is not None else "")


class LayoutEntry(Protocol):
    """One entry of a dictionary; entries sort in the order of a table."""

    @property
    def name(self) -> str:
        """Qualified name."""

    @property
    def word(self) -> str:
        """Kind of the entry, as ``event``."""

    @property
    def id_text(self) -> str:
        """The ID as hex, as it is on the wire."""

    def __hash__(self) -> int: ...

    def __lt__(self, other: Any, /) -> bool: ...


class LayoutEntries(Protocol):
    """The entries of a dictionary, in the order of their keys; see ``structs.table``."""

    def __len__(self) -> int: ...

    def __getitem__(self, place: int, /) -> LayoutEntry: ...

    def bind(self, key: Key, layout: StructLayout, struct: Struct, type_name: str) -> Any:
        """Return the struct of an entry, a ``bindings.Bound`` that makes its messages."""

    def table(self, structs: Any) -> Any:
        """Return the ``table.LayoutEntryTable`` of these entries; ``structs`` is the ``table.Structs``."""


class StructLayout(msgspec.Struct, frozen=True):
    """Structs that belong together, and the packets that hold them.

    Attributes:
        structs: structs by name, with all structs that they use.
        enums: enumerations by name.
        bindings: struct name of each packet key.
        byte_order: byte order of every number whose member has none of its own.
        package: ROS package of the messages.
        origin: file that the layout was read from, for error messages.
        entries: entries of a dictionary, in the order of their keys; these have no cFE header. Else None.
        notes: parts of the files that were not read, a line each.
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
        """Return whether the number of a member is little-endian."""
        return (member.order or self.byte_order) == "little"

    def enumeration(self, member: Member) -> Enumeration | None:
        """Return the enumeration of a member, or None."""
        return self.enums.get(member.type) if isinstance(member.type, str) else None

    def basic(self, member: Member) -> Basic | None:
        """Return the basic type of a member, for an enumeration that of its values; None for a struct."""
        if isinstance(member.type, Basic):
            return member.type
        enumeration = self.enums.get(member.type)
        return enumeration.basic if enumeration else None

    def size(self, member: Member) -> int:
        """Return the bytes of one element of a member; for a text, the bytes of all its characters."""
        basic = self.basic(member)
        if basic is None:
            return self.structs[str(member.type)].size
        return member.dims[-1] if member.text else basic.size


class Wanted(msgspec.Struct, frozen=True):
    """A member whose offset is not computed yet.

    Attributes:
        member: the member; its offset and bit are valid only if ``placed``.
        size: bytes of one element.
        alignment: number that its offset must be a multiple of.
        placed: whether the layout states its offset.
    """

    member: Member
    size: int
    alignment: int
    placed: bool


def arrange(
    declared: Iterable[Wanted], *, union: bool = False, packed: bool = False
) -> tuple[list[Member], int, int]:
    """Compute the offset of every member by the rules of the System V ABI.

    Args:
        declared: members in the order of the declaration.
        union: whether all members start at 0.
        packed: whether there is no padding.

    Returns:
        the members, the bytes of the struct with its padding, and its alignment.
    """
    members: list[Member] = []
    bit, end, widest = 0, 0, 1  # next free bit, end of the members so far, widest alignment
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
