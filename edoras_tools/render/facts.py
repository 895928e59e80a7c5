"""The few facts of a packet that every one-line view shows."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from edoras_tools.model import NO_MSG_ID, Link
from edoras_tools.wire.cfe import is_command
from edoras_tools.wire.sbn import MSG_TYPE_NAMES

if TYPE_CHECKING:
    from collections.abc import Mapping

    from edoras_tools.model import Decoded


class Facts(NamedTuple):
    """What a packet is, in short.

    Attributes:
        kind: ``cmd``, ``tlm``, an SBN message type as ``SUB`` or ``APP``, or nothing.
        msg_id: the space packet's MsgId; ``NO_MSG_ID`` where there is none.
        name: the topic, else what ``names`` calls the MsgId, else nothing.
    """

    kind: str
    msg_id: int
    name: str


def facts(decoded: Decoded, names: Mapping[int, str]) -> Facts:
    """Read the facts of a packet.

    Args:
        decoded: the packet.
        names: MsgId to a name, for packets that hold no message of a configured topic.
    """
    payload = decoded.datagram.payload
    kind, msg_id = "", NO_MSG_ID
    for layer in decoded.layers:
        if layer.name == "ccsds":
            word = payload[layer.start : layer.start + 2]
            if len(word) == 2:
                msg_id = word[0] << 8 | word[1]
                kind = kind or ("cmd" if is_command(msg_id) else "tlm")
            break
        if layer.name == "sbn":
            octet = payload[layer.start + 2 : layer.start + 3]
            if octet:
                kind = MSG_TYPE_NAMES.get(octet[0], f"0x{octet[0]:02x}")
    name = decoded.message.topic if decoded.message else names.get(msg_id, "")
    return Facts(kind, msg_id, name)


def link_name(link: Link) -> str:
    """Return ``CI``, ``TO``, ``SBN``, or ``UDP`` for what belongs to none of them."""
    return "UDP" if link is Link.OTHER else link.name
