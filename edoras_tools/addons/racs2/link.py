"""RACS2: ROS 2 and cFS over WebSocket, as JAXA's public bridge connects them."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.addons.racs2 import wire as racs2
from edoras_tools.links.doors import Framing, OwnTopics, Reading, Site, StreamState, TopicSpace
from edoras_tools.links.protocol import BY_CONTENT, BatchRows, LinkProtocol, LinkSending, Located, Seen
from edoras_tools.model import Decoded, LayerField, PacketBatch, Transport
from edoras_tools.wire import cfe
from edoras_tools.wire.arrays.window import gather
from edoras_tools.wire.layout import Field, Layout

if TYPE_CHECKING:
    from collections.abc import Mapping

    from edoras_tools.wire.arrays.order import Integers, Mask, Octets, Places

_WORDS: Final = Layout(
    "racs2_words",
    "32 bytes",
    Field("first", 16, "a MsgId, or two characters"),
    Field("second", 16, "zeros, or two characters"),
    *(Field(f"word_{place}", 32, "zeros, or four characters") for place in range(1, 8)),
)
"""A header as numbers: a MsgId and zeros, or the characters of a topic's name."""
_REST: Final = tuple(slot.field.name for slot in _WORDS.slots[2:])
_NO_ASCII: Final = 0x80808080


class RacsBridgeFraming(Framing):
    """WebSocket whose messages have the header of RACS2; its reader is loaded with the first stream."""

    head = 14
    largest = racs2.LARGEST_MESSAGE
    checked = True

    @cached_property
    def _reader(self) -> Framing:
        from edoras_tools.addons.racs2.streams import WebSocketFraming

        return WebSocketFraming()

    def lengths(self, data: Octets, at: Integers, end: Integers | int) -> Integers:
        """Return the size in bytes of the frame, or of the side of the handshake, at each position."""
        return self._reader.lengths(data, at, end)

    def likely(self, data: Octets, at: Integers, end: Integers | int) -> Mask:
        """Return where a one-frame message with a header of RACS2 begins, or a handshake; bool (n,)."""
        return self._reader.likely(data, at, end)

    def state(self) -> StreamState | None:
        """Return the state of a new connection."""
        return self._reader.state()


def _has(word: Any, character: str) -> Any:
    """Return bits that are set where a word of four characters contains a character that no topic's name has.

    Every handshake has spaces, every JSON object quotation marks.
    """
    apart = word ^ (ord(character) * 0x01010101)
    return (apart - 0x01010101) & (apart ^ 0xFFFFFFFF) & _NO_ASCII


class RacsBridgeLink(LinkProtocol):
    """The link of the RACS2 bridges; the header of a message determines its direction."""

    code = 10
    name = "RACS2"
    label = "racs2"
    colour = "red"
    doc = "between the RACS2 bridges of ROS 2 and cFS, over WebSocket"
    transport = Transport("tcp", (racs2.BRIDGE_WEBSOCKET_PORT,), first="client")
    framing = RacsBridgeFraming()
    to_cfs = True
    from_cfs = True
    layouts = (racs2.TO_ROS, racs2.TO_CFS)
    port_decides = False
    sends = True

    def send(self, site: Site, *, up: bool) -> LinkSending:
        """Return what sends messages to the ROS side, a server; or (up), as that server, to the cFS side."""
        return self.part(f"sending:{'Server' if up else 'Bridge'}Sending")(self)

    def recognise(self, facts: Seen) -> Any:
        """Recognise the 32 bytes of a header; pings and handshakes are not recognised."""
        first, second = (facts.field(_WORDS, item) for item in ("first", "second"))
        letter = first >> 8
        to_cfs = (first > 0) & (first < cfe.HIGHEST_MSG_ID + 1) & (second == 0)
        starts_name = (
            (letter == ord("/")) | (letter == ord("~")) | ((letter > ord("@")) & (letter < ord("{")))
        )
        name = starts_name & ((first | second) & 0x8080 == 0)
        for item in _REST:
            word = facts.field(_WORDS, item)
            to_cfs = to_cfs & (word == 0)
            name = name & (word & _NO_ASCII == 0) & (_has(word, " ") == 0) & (_has(word, '"') == 0)
        return BY_CONTENT * ((facts.length > racs2.BRIDGE_HEADER - 1) & (to_cfs | name))

    def locate(self, batch: PacketBatch, rows: Places, site: Site) -> Located:
        """Find no packets: the messages have none."""
        return Located(len(rows))

    def dissect(self, reading: Reading, site: Site) -> None:
        """Read the header and the body of one message."""
        data = reading.data
        first = int.from_bytes(data[:2], "big")
        reading.read(racs2.TO_CFS if first <= cfe.HIGHEST_MSG_ID else racs2.TO_ROS, 0)
        body = data[racs2.BRIDGE_HEADER :]
        values = {"body_length": len(body), **(racs2.std_msgs_values(body) or {})}
        for name, value in values.items():
            doc = "bytes of the body" if name == "body_length" else "in the body, as the public examples do"
            reading.extend(LayerField(name, value, racs2.BRIDGE_HEADER, len(data), str(value), doc))

    def places(self, layout: Layout, rows: BatchRows, field: str = "") -> tuple[Places, Integers]:
        """Find the headers of one direction."""
        owner = np.flatnonzero(rows.column("link") == self)
        offset = rows.datagram("offset")[owner]
        to_cfs = gather(rows.batch.data, offset, 1)[:, 0] <= cfe.HIGHEST_MSG_ID >> 8
        present = to_cfs == (layout is racs2.TO_CFS)
        return owner[present], offset[present]

    def engine_values(self) -> Mapping[str, Any]:
        """Return the table that ``engine/racs2.lua`` reads: the fields of a body, with their numbers."""
        kinds = {
            field.number: {"name": name, "kind": field.kind, "array": field.is_array or None}
            for name, field in racs2.BODY_FIELDS.items()
        }
        return {"subprotocol": racs2.SUBPROTOCOL, "largest": racs2.LARGEST_BODY, "values": kinds}

    def topics(self, space: TopicSpace) -> OwnTopics:
        """Return the maker of the link's messages; its code is loaded with the first."""
        return self.part("topics:BridgeTopics")(space)

    def summary(self, decoded: Decoded) -> str:
        """Return the destination of the message and its content."""
        if not decoded.layers:
            return ""
        values = decoded.layers[0].values()
        target = values.get("topic_name") or f"0x{values.get('msg_id', 0):04x}"
        size = values.get("body_length", 0)
        names = ("topic_name", "msg_id", "rest", "body_length")
        content = ", ".join(f"{name} {value!r}" for name, value in values.items() if name not in names)
        over = "msg_id" in values and size > racs2.LARGEST_BODY
        room = f", more than the {racs2.LARGEST_BODY} that cFS has room for" if over else ""
        return f"{target}: {content or f'{size} bytes'}{room}"


RACS2: Final = RacsBridgeLink()
