"""The facts of a packet that every one-line view shows."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from edoras_tools.model import NO_MSG_ID
from edoras_tools.wire.cfe import is_command
from edoras_tools.wire.sbn import MSG_TYPE_NAMES

if TYPE_CHECKING:
    from collections.abc import Mapping

    from edoras_tools.model import Decoded, Layer


class Facts(NamedTuple):
    """What a packet is, in short.

    Attributes:
        kind: ``cmd``, ``tlm``, an SBN message type as ``SUB`` or ``APP``, or nothing.
        msg_id: the space packet's MsgId; ``NO_MSG_ID`` where there is none.
        name: the topic, else what the MsgId is called, else nothing.
    """

    kind: str
    msg_id: int
    name: str


def facts(decoded: Decoded, names: Mapping[int, str] | None = None) -> Facts:
    """Read the facts of a packet.

    Args:
        decoded: the packet.
        names: MsgId to a name, where neither a message nor the layers have one.
    """
    payload = decoded.datagram.payload
    kind, name, msg_id = "", "", NO_MSG_ID
    for layer in decoded.layers:
        if layer.name == "ccsds":
            word = int.from_bytes(payload[layer.start : layer.start + 2], "big")
            kind = kind or ("cmd" if is_command(word) else "tlm")
            msg_id, name = _msg_id(layer, word)
            break
        if layer.name == "sbn":
            octet = int.from_bytes(payload[layer.start + 2 : layer.start + 3], "big")
            kind = MSG_TYPE_NAMES.get(octet, f"0x{octet:02x}")
    if decoded.message and (not name or decoded.layer("edoras")):
        name = decoded.message.topic  # of a C struct the packet's name says as much, and is shorter
    return Facts(kind, msg_id, name or (names or {}).get(msg_id, ""))


def _msg_id(layer: Layer, word: int) -> tuple[int, str]:
    """Return the MsgId and what follows it in its text: the name of the packet."""
    for item in layer.fields:
        # With the extended header the MsgId is not the first word.
        if item.name == "msg_id":
            return item.value, item.text.partition(" ")[2]
    return word, ""
