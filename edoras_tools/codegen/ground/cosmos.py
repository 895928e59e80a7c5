"""COSMOS: a target's ``cmd.txt`` or ``tlm.txt``, one item a line behind the one before it.

A string has no fixed length, so a packet with one ends with the block of bytes that begins there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from edoras_tools.codegen.ground.packets import PacketItem, header_items, identifier, telemetry_items
from edoras_tools.wire import ccsds

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from edoras_tools.codegen.ground.packets import GroundPacket
    from edoras_tools.wire.cfe import Headers

_TYPES: Final = {"uint": "UINT", "int": "INT", "float": "FLOAT", "bytes": "BLOCK", "text": "STRING"}


def cosmos_telemetry(target: str, packets: Iterable[GroundPacket], headers: Headers) -> Iterator[str]:
    """Yield the lines of ``tlm.txt``; a packet is told by its APID and its type."""
    head = header_items(ccsds.PRIMARY) + telemetry_items(headers)
    for packet in packets:
        yield f'TELEMETRY {identifier(target).upper()} {packet.name.upper()} LITTLE_ENDIAN "{packet.doc}"'
        fixed = {"apid": packet.apid, "packet_type": ccsds.TELEMETRY_TYPE}
        yield from (_line(field, fixed.get(field.name)) for field in head)
        for number, item in enumerate(packet.items):
            if not isinstance(item, PacketItem):
                break
            yield _line(item, number=number)
        if not packet.whole or not all(isinstance(item, PacketItem) for item in packet.items):
            yield '  APPEND_ITEM REST 0 BLOCK "all that follows"'


def _line(item: PacketItem, fixed: int | None = None, number: int = 0) -> str:
    name = identifier(item.name or f"padding_{number}").upper()
    value = "" if fixed is None else f" {fixed}"
    order = "" if item.little or item.bits <= 8 else " BIG_ENDIAN"
    kind = "APPEND_ITEM" if fixed is None else "APPEND_ID_ITEM"
    return f'  {kind} {name} {item.bits} {_TYPES[item.encoding]}{value} "{item.doc or item.name}"{order}'
