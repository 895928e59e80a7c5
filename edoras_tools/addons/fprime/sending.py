"""Sends frames of F Prime again: to its ground system like flight software, or the other way.

Frames of commands are made as its ground system makes them of the same command: CCSDS, the default since
version 4.
"""

from __future__ import annotations

from collections.abc import Sequence
from struct import error, pack
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.addons.fprime import link as fprime
from edoras_tools.errors import ConfigError
from edoras_tools.links.protocol import LinkSending
from edoras_tools.structs.shapes import BasicKind, Enumeration, Member, Struct, StructLayout
from edoras_tools.wire import ccsds
from edoras_tools.wire.arrays import CRC16_BYTES, Mask, crc16
from edoras_tools.wire.transfer_frames import TC_LENGTH_BIAS
from edoras_tools.words import did_you_mean, listed

if TYPE_CHECKING:
    from edoras_tools.addons.fprime.table import EntryTable
    from edoras_tools.links.doors import Framing
    from edoras_tools.model import Columns, Link, PacketBatch

_PORT: Final = 50000
"""Port of the ground system, and of flight software's TCP server."""
_SPACECRAFT: Final = 0x44
_CHANNEL: Final = 1
"""Defaults of F Prime."""
_COUNTS: Final = 1 << 14
_CODES: Final = {"float32": "f", "float64": "d"} | {
    f"{kind}{8 << place}": letter
    for kind, letters in (("int", "bhiq"), ("uint", "BHIQ"))
    for place, letter in enumerate(letters)
}
"""Codes of ``struct`` by type."""


class GroundDataSending(LinkSending):
    """Frames as they were captured, over one TCP connection.

    Args:
        link: link.
        framing: framing of the answers.
        up: whether commands and files go to flight software; else channels, events and files to the ground
            system.
    """

    port = _PORT

    def __init__(self, link: Link, framing: Framing, *, up: bool) -> None:
        super().__init__(link)
        self.framing, self._up = framing, up
        self._bare = 0

    def outgoing_rows(self, batch: PacketBatch, columns: Columns) -> Mask:
        """Return which frames go this way: TC frames and commands up, all others down; bool (n,)."""
        rows = np.flatnonzero(super().outgoing_rows(batch, columns))
        frames = fprime.read_ground_frames(batch.data, batch.offset[rows], batch.length[rows], checked=False)
        up = frames.shape == fprime.TC_SHAPE
        up[frames.packets.row[frames.packets.kind == fprime.PacketType.COMMAND]] = True
        bare = frames.shape == fprime.SPACE_SHAPE
        self._bare += int(np.count_nonzero(bare & (up == self._up)))
        text = "are space packets without a frame: neither side takes these over TCP"
        self.refusals = [f"{self._bare:,} {text}"] if self._bare else []
        going = np.zeros(len(batch), bool)
        going[rows[(up == self._up) & ~bare]] = True
        return going

    def compose(self, name: str, values: Any, count: int, context: Any) -> list[bytes]:
        """Return the frames of a command from an F Prime dictionary."""
        if not self._up:
            raise ConfigError(f"commands go to flight software: --to {self.link.label}:up")
        entries = context.structs.dictionary
        if entries is None:
            raise ConfigError("commands have their names from a dictionary: --set structs=FILE.json")
        packet = packet_of_command(entries, name, values)
        return [command_frame(packet, number) for number in range(count)]


def packet_of_command(entries: EntryTable, name: str, values: Any) -> bytes:
    """Return the packet of a command, as F Prime's ground system makes it.

    Args:
        entries: entries of a dictionary.
        values: all arguments, by name or in order.

    Raises:
        ConfigError: there is no such command, or an argument is missing or does not fit.
    """
    kind = fprime.PacketType.COMMAND
    commands = {item.name: item for item in entries.bounds if item.entry.kind is kind}
    if name not in commands:
        near = did_you_mean(name, commands) or f"there are {listed(sorted(commands), 5)}"
        raise ConfigError(f"{name!r} is no command of the dictionary; {near}")
    item = commands[name]
    head = fprime.PACKET.emit({"packet_type": kind})
    head += fprime.ENTRY_HEADERS[kind].emit({"opcode": item.entry.id})
    return head + _struct(item.layout, item.struct, values, name)


def command_frame(packet: bytes, count: int) -> bytes:
    """Return a Type-B TC frame with one space packet; its frame count is 0, as that of the ground system."""
    space = {"packet_type": 1, "sequence_flags": 3, "packet_sequence_count": count % _COUNTS}
    length = fprime.SPACE_PACKET.size + len(packet) - ccsds.LENGTH_BIAS
    data = fprime.SPACE_PACKET.emit({**space, "packet_data_length": length}) + packet
    size = fprime.COMMAND_FRAME.size + len(data) + CRC16_BYTES
    head = {"bypass_flag": 1, "spacecraft_id": _SPACECRAFT, "virtual_channel_id": _CHANNEL}
    frame = fprime.COMMAND_FRAME.emit({**head, "frame_length": size - TC_LENGTH_BIAS}) + data
    return frame + crc16(frame).to_bytes(CRC16_BYTES, "big")


def _struct(layout: StructLayout, form: Struct, values: Any, where: str) -> bytes:
    """Return the bytes of the members, in order."""
    names = [item.name for item in form.members]
    if isinstance(values, list) and len(values) == len(names):
        values = dict(zip(names, values, strict=True))
    takes = f"takes {', '.join(names)}" if names else "takes no argument"
    if not isinstance(values, dict):
        raise ConfigError(f"{where} {takes}; not {values!r}")
    if odd := [*(values.keys() - names), *(item for item in names if item not in values)]:
        raise ConfigError(
            f"{where} {takes}: {odd[0]} is {'not there' if odd[0] in names else 'none of them'}"
        )
    parts = (
        _member(layout, item, item.array, values[item.name], f"{where}.{item.name}") for item in form.members
    )
    return b"".join(parts)


def _member(layout: StructLayout, member: Member, dims: Sequence[int], value: Any, where: str) -> bytes:
    """Return the bytes of a member, or of one element of it."""
    if dims:
        if not isinstance(value, list) or len(value) != dims[0]:
            raise ConfigError(f"{where} takes a list of {dims[0]}, not {value!r}")
        return b"".join(_member(layout, member, dims[1:], item, where) for item in value)
    kind: Any = member.type
    if member.text:
        data = value.encode() if isinstance(value, str) else None
        if data is None or len(data) > member.dims[-1]:
            raise ConfigError(f"{where} takes a text of at most {member.dims[-1]} bytes, not {value!r}")
        return len(data).to_bytes(2, "big") + data
    if kind in layout.structs:
        return _struct(layout, layout.structs[kind], value, where)
    return _number(kind, layout.enums.get(kind), value, where)


def _number(kind: Any, enum: Enumeration | None, value: Any, where: str) -> bytes:
    """Return the bytes of a scalar value; an enumeration value may be a name."""
    if enum is not None:
        by_name = {name: number for number, name in enum.names.items()}
        if not isinstance(value, (str, int)) or (value not in by_name and value not in enum.names):
            raise ConfigError(f"{where} takes {', '.join(by_name)}; not {value!r}")
        kind, value = enum.basic, by_name[value] if isinstance(value, str) else value
    if kind.kind is BasicKind.BOOL:
        if not isinstance(value, bool):
            raise ConfigError(f"{where} takes true or false, not {value!r}")
        return b"\xff" if value else b"\0"
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ConfigError(f"{where} takes a number, not {value!r}")
    try:
        return pack(f">{_CODES[str(kind)]}", value)
    except (OverflowError, error):
        raise ConfigError(f"{where}: {value!r} does not fit {kind}") from None
