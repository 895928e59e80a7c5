"""Reads and writes single fields of one space packet, where parsing all headers would cost too much.

Every function takes at least the bytes it reads; ``decode`` is for packets of which that is not known.
"""

from __future__ import annotations

from edoras_tools.wire import ccsds


def msg_id_of(packet: bytes) -> int:
    """Return the MsgId of a packet: its first word."""
    return packet[0] << 8 | packet[1]


def length_of(packet: bytes) -> int:
    """Return the length that a packet states, header included; its buffer may hold more or less."""
    return (packet[4] << 8 | packet[5]) + ccsds.LENGTH_BIAS


def whole_packet(packet: bytes) -> bytes:
    """Return as many bytes as the length field states, padded with zeros if the buffer is shorter."""
    size = length_of(packet)
    return packet if len(packet) == size else packet[:size].ljust(size, b"\0")


def function_code_of(packet: bytes) -> int:
    """Return the function code of a command: 7 bits behind the primary header."""
    return packet[6] & 0x7F


def with_sequence_count(packet: bytes, count: int) -> bytes:
    """Return the packet with an unsegmented sequence word, as cFE stamps it.

    Args:
        packet: at least a primary header.
        count: 0 to 16383.
    """
    return packet[:2] + (ccsds.UNSEGMENTED << 14 | count).to_bytes(2, "big") + packet[4:]


def with_length(packet: bytes, size: int) -> bytes:
    """Return the packet with a length field for ``size`` bytes in all; nothing is added or cut."""
    return packet[:4] + (size - ccsds.LENGTH_BIAS).to_bytes(2, "big") + packet[6:]
