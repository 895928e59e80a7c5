"""COSMOS: telemetry and commands of a target, a file of its folder ``cmd_tlm``.

Rules:

1. Items follow each other without a gap; positions are written only for the remainder (rule 2).
2. A packet is identified by its packet type and its APID. A packet in which items follow a string is
   described eight times: for each remainder of the string's length divided by 8, which determines the
   padding behind it. The remainder identifies these packets too; their names end in 0 to 7.
3. Behind a second string, or another value of variable size, COSMOS cannot describe positions: the packet
   ends with the block of bytes that begins there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from edoras_tools.addons.codegen.ground.packets import (
    LENGTH_BYTES,
    REMAINDERS,
    PacketItem,
    StringItem,
    command_header,
    header_items,
    identifier,
    telemetry_items,
)
from edoras_tools.wire import ccsds
from edoras_tools.wire.cfe import EXTENDED, Headers

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from edoras_tools.addons.codegen.ground.packets import GroundPacket, Items

_TYPES: Final = {"uint": "UINT", "int": "INT", "float": "FLOAT", "bytes": "BLOCK", "text": "STRING"}
_RESERVED: Final = {
    *(f"{when}_TIME{how}" for when in ("PACKET", "RECEIVED") for how in ("", "SECONDS", "FORMATTED")),
    "RECEIVED_COUNT",
    "COSMOS_DATA_TAG",
    "COSMOS_EXTRA",
}
"""Names that COSMOS uses for its own items."""
_NUMBERS: Final = {"uint", "int", "float"}
_TELLING: Final = {"apid", "packet_type", "function_code"}
"""Header fields that identify a command."""


def cosmos(
    name: str, telemetry: Iterable[GroundPacket], commands: Iterable[GroundPacket], headers: Headers
) -> bytes:
    """Return the text of a target.

    Args:
        name: name of the target.
        telemetry: packets from cFS.
        commands: packets to cFS; each must be of fixed size.
        headers: headers of the cFE.
    """
    target = _plain(name)
    lines = [line for packet in telemetry for line in _telemetry(target, packet, headers)]
    lines += [line for packet in commands for line in _command(target, packet, headers)]
    return "".join(f"{line}\n" for line in lines).encode()


def _telemetry(target: str, packet: GroundPacket, headers: Headers) -> Iterator[str]:
    """Yield the lines of a packet, or of the packets for each remainder of its first string's length."""
    first = packet.items[-1] if packet.items else None
    if isinstance(first, StringItem) and any(first.after):
        for remainder in range(REMAINDERS):
            yield f"TELEMETRY {target} {_plain(packet.name)}_{remainder} LITTLE_ENDIAN {_quoted(packet.doc)}"
            yield from _Items().telemetry(packet, headers, remainder)
    else:
        yield f"TELEMETRY {target} {_plain(packet.name)} LITTLE_ENDIAN {_quoted(packet.doc)}"
        yield from _Items().telemetry(packet, headers, None)


class _Items:
    """The items of one packet, with unique names."""

    def __init__(self) -> None:
        self._used = set(_RESERVED)
        self._bits = 0

    def telemetry(self, packet: GroundPacket, headers: Headers, remainder: int | None) -> Iterator[str]:
        head = header_items(ccsds.PRIMARY) + telemetry_items(headers)
        ids = {"apid": packet.apid, "packet_type": ccsds.TELEMETRY_TYPE}
        yield from (self._item(item, ids.get(item.name)) for item in head)
        whole = packet.whole
        items: Items = packet.items
        while items:
            yield from (self._item(item) for item in items if isinstance(item, PacketItem))
            last, items = items[-1], ()
            if isinstance(last, StringItem):
                yield from self._string(last, remainder)
                if remainder is None:
                    whole = whole and not any(last.after)
                else:
                    items, remainder = last.after[remainder], None
        if not whole:
            yield self._line(PacketItem("rest", "bytes", 0, "all that follows"))

    def _string(self, string: StringItem, remainder: int | None) -> Iterator[str]:
        """Yield the lines of a string: its length, and its characters, including the NUL at their end."""
        doc = "bytes of the string, a NUL at its end included"
        length = PacketItem(f"{string.name}.length", "uint", 8 * LENGTH_BYTES, doc)
        name, begin = self._name(length), self._bits
        yield self._line(length, name=name)
        if remainder is not None:  # the last bits of its first byte
            low = PacketItem(f"{length.name}_low", "uint", REMAINDERS.bit_length() - 1, "its low bits, again")
            place = f"{self._name(low)} {begin + 8 - low.bits} {low.bits}"
            yield f"  ID_ITEM {place} UINT {remainder} {_quoted(low.doc)}"
            yield "    OVERLAP"
        yield self._line(PacketItem(string.name, "text", 0))
        yield f"    VARIABLE_BIT_SIZE {name}"

    def _item(self, item: PacketItem, told_by: int | None = None) -> str:
        return self._line(item) if told_by is None else self._line(item, "ID_ITEM", f" {told_by}")

    def constant(self, item: PacketItem, value: object, *, tells: bool = False) -> str:
        """Return a parameter with a constant value, which may identify a command."""
        if isinstance(value, bytes):
            return self._line(item, "PARAMETER", f" 0x{value.hex()}")
        return self._line(item, "ID_PARAMETER" if tells else "PARAMETER", f" {value} {value} {value}")

    def argument(self, item: PacketItem) -> str:
        """Return a parameter that the operator sets."""
        zero = "0.0" if item.encoding == "float" else "0"
        return self._line(item, "PARAMETER", f" MIN MAX {zero}" if item.encoding in _NUMBERS else ' ""')

    def _name(self, item: PacketItem) -> str:
        """Return a name for COSMOS: no ``_`` at its end, no two in a row, and different from all others."""
        plain_name = name = _plain(item.name or "padding")
        number = 1
        while name in self._used:
            number += 1
            name = f"{plain_name}_{number}"
        self._used.add(name)
        return name

    def _line(self, item: PacketItem, kind: str = "ITEM", values: str = "", name: str = "") -> str:
        self._bits += item.bits
        order = "" if item.little or item.bits <= 8 else " BIG_ENDIAN"
        head = f"  APPEND_{kind} {name or self._name(item)} {item.bits} {_TYPES[item.encoding]}{values}"
        states = {label.upper(): value for value, label in (item.enum.names.items() if item.enum else ())}
        lines = [f"    STATE {_quoted(label)} {value}" for label, value in states.items()]
        return "\n".join([f"{head} {_quoted(item.doc or item.name or 'alignment')}{order}", *lines])


def _plain(text: str) -> str:
    return "_".join(part for part in identifier(text).upper().split("_") if part) or "UNNAMED"


def _quoted(text: str) -> str:
    plain = " ".join(text.split()).replace('"', "'")
    return f'"{plain}"'


def _command(target: str, packet: GroundPacket, headers: Headers) -> Iterator[str]:
    head = command_header(packet, headers)
    yield f"COMMAND {target} {_plain(packet.name)} LITTLE_ENDIAN {_quoted(packet.doc)}"
    items = _Items()
    at = 0
    for layout in (ccsds.PRIMARY, *((EXTENDED,) if headers.extended else ()), headers.command):
        values = layout.parse(head, at)
        for item in header_items(layout):
            yield items.constant(item, values[item.name], tells=item.name in _TELLING)
        at += layout.size
    for part in packet.items:
        assert isinstance(part, PacketItem)
        if not part.fixed:
            yield items.argument(part)
        elif part.encoding == "bytes":
            yield items.constant(part, part.fixed)
        else:
            yield items.constant(part, int.from_bytes(part.fixed, "little" if part.little else "big"))
