"""The Software Bus Network's header and its messages over UDP, big-endian."""

from __future__ import annotations

from collections.abc import Iterable
from enum import IntEnum
from typing import TYPE_CHECKING, Final

import msgspec
from msgspec.structs import asdict

from edoras_tools.errors import TruncatedError
from edoras_tools.wire.layout import Field, Layout

if TYPE_CHECKING:
    from edoras_tools.model import Peer

PROTOCOL_VERSION: Final = 11
IDENT: Final = "$Id: dccf6239093d99c4c9351e140c15b61a95d8fc37 $"
"""Text in SUB and UNSUB, a literal of the SBN sources; a peer that sends another is refused."""
IDENT_BYTES: Final = 48
LARGEST_PAYLOAD: Final = 32767
"""Largest MsgSz, which is signed: a larger payload is an error at the receiver."""


class MsgType(IntEnum):
    """SBN MsgType; types of the UDP module begin at 0xA0."""

    NO_MSG = 0x00
    SUB = 0x01
    UNSUB = 0x02
    APP = 0x03
    PROTO = 0x04
    HEARTBEAT = 0xA0
    ANNOUNCE = 0xA1
    DISCONNECT = 0xA2


MSG_TYPE_NAMES: Final = {int(item): item.name for item in MsgType}

HEADER: Final = Layout(
    "sbn",
    "Software Bus Network",
    Field("msg_size", 16, "payload bytes; this header is not counted", kind="int"),
    Field("msg_type", 8, "what the payload is", names=MSG_TYPE_NAMES, base=16),
    Field("processor_id", 32, "the sender's processor"),
    Field("spacecraft_id", 32, "the sender's spacecraft", base=16),
)
_SIZE_BYTES: Final = HEADER.slots[0].end
MSG_TYPE_AT: Final = HEADER.by_name["msg_type"].start
"""Offset of MsgType in a datagram; it is one byte."""
LEGACY_HEADER: Final = Layout(
    "sbn", "Software Bus Network (7-byte header, older sources)", *(slot.field for slot in HEADER.slots[:3])
)
SUBSCRIPTIONS: Final = Layout(
    "sbn_sub",
    "SBN Subscriptions",
    Field(
        "ident",
        8 * IDENT_BYTES,
        "$Id of the sender's SBN; another than the receiver's is refused",
        kind="text",
    ),
    Field("count", 16, "entries that follow"),
)
SUBSCRIPTION: Final = Layout(
    "sbn_subscription",
    "Subscription",
    Field("msg_id", 32, "the MsgId wanted", base=16),
    Field("priority", 8, "quality of service: priority"),
    Field("reliability", 8, "quality of service: reliability"),
)
PROTO: Final = Layout(
    "sbn_proto", "SBN Protocol", Field("protocol_version", 8, "11 here; another is refused")
)


class Subscription(msgspec.Struct, frozen=True):
    """One entry of a SUB or UNSUB."""

    msg_id: int
    priority: int = 0
    reliability: int = 0


def emit(msg_type: int, peer: Peer, payload: bytes = b"") -> bytes:
    """Write a whole SBN datagram.

    Raises:
        FieldError: the payload is over 32,767 bytes, or a value does not fit its field.
    """
    values = {
        "msg_size": len(payload),
        "msg_type": msg_type,
        "processor_id": peer.processor_id,
        "spacecraft_id": peer.spacecraft_id,
    }
    return HEADER.emit(values) + payload


class MessageHead:
    """The part of the header that is the same in every APP datagram of one sender.

    It avoids a parse of the whole header for each message: links carry 20,000 a second.
    """

    def __init__(self, sender: Peer) -> None:
        self._behind_size = emit(MsgType.APP, sender)[_SIZE_BYTES:]

    def fits(self, data: bytes) -> bool:
        """Return whether a datagram (any bytes) is an APP message of this sender with a size of 0 or more."""
        return data[_SIZE_BYTES : HEADER.size] == self._behind_size and data[0] < 0x80

    def emit(self, packet: bytes) -> bytes:
        """Write the datagram of a space packet, which has at most 32,767 bytes.

        Raises:
            OverflowError: the packet is longer.
        """
        return len(packet).to_bytes(_SIZE_BYTES, "big", signed=True) + self._behind_size + packet


def emit_subscriptions(subscriptions: Iterable[Subscription], *, ident: str = IDENT) -> bytes:
    """Write the payload of a SUB or UNSUB."""
    entries = [SUBSCRIPTION.emit(asdict(item)) for item in subscriptions]
    return SUBSCRIPTIONS.emit({"ident": ident, "count": len(entries)}) + b"".join(entries)


def parse_subscriptions(payload: bytes | memoryview) -> tuple[str, tuple[Subscription, ...]]:
    """Read the payload of a SUB or UNSUB.

    Returns:
        The $Id and the entries.

    Raises:
        TruncatedError: there are fewer entries than the count says.
    """
    head = SUBSCRIPTIONS.parse(payload)
    need = SUBSCRIPTIONS.size + head["count"] * SUBSCRIPTION.size
    if len(payload) < need:
        raise TruncatedError("sbn_sub", 0, need, len(payload))
    entries = tuple(
        Subscription(**SUBSCRIPTION.parse(payload, at))
        for at in range(SUBSCRIPTIONS.size, need, SUBSCRIPTION.size)
    )
    return head["ident"], entries


def emit_proto(version: int = PROTOCOL_VERSION) -> bytes:
    """Write the payload of a PROTO."""
    return PROTO.emit({"protocol_version": version})
