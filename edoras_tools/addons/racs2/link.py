"""RACS2: ROS 2 and cFS over WebSocket, as JAXA's public bridge connects them: messages in WebSocket frames.

The form is taken from its sources (racs2_bridge 1.1, https://github.com/jaxa/racs2_bridge): a header of 32
bytes, then the body. To ROS 2 the header is a topic's name; to cFS it starts with a MsgId. **The only length
on the wire** is that of the frame, and the cFS side always sends 128 bytes of body, with zeros behind the
content. The body can be anything; the public examples put a Protocol Buffers message of ``std_msgs`` there.
"""

from __future__ import annotations

import struct
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

import numpy as np

from edoras_tools.links.doors import Framing, OwnTopics, Reading, Site, StreamState, TopicSpace
from edoras_tools.links.protocol import BY_CONTENT, BatchRows, LinkProtocol, LinkSending, Located, Seen
from edoras_tools.model import Decoded, LayerField, PacketBatch, Transport
from edoras_tools.wire import cfe
from edoras_tools.wire.arrays import gather
from edoras_tools.wire.layout import Field, Layout

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from edoras_tools.wire.arrays import Integers, Mask, Octets, Places

BRIDGE_WEBSOCKET_PORT: Final = 8765
SUBPROTOCOL: Final = "example-protocol"
"""The subprotocol that the cFS side requests in the handshake; the public ROS side answers without one."""
BRIDGE_HEADER: Final = 32
LARGEST_MESSAGE: Final = 1 << 20
"""Bytes of the longest message that is read, its WebSocket header included."""
LARGEST_BODY: Final = 128
"""Size in bytes of the cFS side's buffer for a body; it copies longer ones beyond the buffer's end."""
TO_ROS: Final = Layout(
    "racs2_topic",
    "RACS2 to ROS 2",
    Field("topic_name", 8 * BRIDGE_HEADER, "the topic that the body is published on", kind="text"),
)
TO_CFS: Final = Layout(
    "racs2_message",
    "RACS2 to cFS",
    Field("msg_id", 16, "the MsgId that the body is sent with on the software bus", base=16),
    Field("rest", 8 * (BRIDGE_HEADER - 2), "not used, zeros", kind="bytes"),
)


class BodyField(NamedTuple):
    """A field of ``RACS2Bridge_std_msgs.proto``.

    Attributes:
        number: number of the field.
        kind: how its values are written: ``int64`` is a varint with a sign, ``uint64`` one without.
        type: type of ``std_msgs`` that the public ``.proto`` file names.
    """

    number: int
    kind: Literal["bool", "float", "double", "int64", "uint64", "string"]
    type: str

    @property
    def is_array(self) -> bool:
        """Whether it has several values."""
        return self.type.endswith("MultiArray")


BODY_FIELDS: Final = {
    "bool_data": BodyField(1, "bool", "Bool"),
    "float_data": BodyField(2, "float", "Float32"),
    "double_data": BodyField(3, "double", "Float64"),
    "int32_data": BodyField(4, "int64", "Int32"),
    "int64_data": BodyField(5, "int64", "Int64"),
    "string_data": BodyField(6, "string", "String"),
    "uint32_data": BodyField(7, "uint64", "UInt32"),
    "uint64_data": BodyField(8, "uint64", "UInt64"),
    "float32_array_data": BodyField(9, "float", "Float32MultiArray"),
    "float64_array_data": BodyField(10, "double", "Float64MultiArray"),
    "int32_array_data": BodyField(11, "int64", "Int32MultiArray"),
    "int64_array_data": BodyField(12, "int64", "Int64MultiArray"),
    "uint32_array_data": BodyField(13, "uint64", "UInt32MultiArray"),
    "uint64_array_data": BodyField(14, "uint64", "UInt64MultiArray"),
}
"""The fields of a body by name."""
_NAMES: Final = {field.number: name for name, field in BODY_FIELDS.items()}
_FIXED: Final = {"float": "<f", "double": "<d"}
_VARINT, _EIGHT, _BYTES, _FOUR = 0, 1, 2, 5


def std_msgs_values(body: bytes) -> dict[str, Any] | None:
    """Return the values of a body that is a ``RACS2Bridge_std_msgs``; None if it is something else.

    Zeros at its end are padding. Field names are those of the public ``.proto`` file.
    """
    values: dict[str, Any] = {}
    try:
        for number, raw in _fields(body):
            name = _NAMES[number]
            field = BODY_FIELDS[name]
            if field.is_array:
                values.setdefault(name, []).extend(_numbers(field.kind, raw))
            elif field.kind == "string":
                values[name] = raw.decode()
            else:
                (values[name],) = _numbers(field.kind, raw)
    except (KeyError, ValueError, struct.error, AttributeError, TypeError):
        return None
    return values or None


def _fields(body: bytes) -> Iterator[tuple[int, Any]]:
    """Yield the number and the content of each field: an int, or bytes.

    Raises:
        ValueError: the body is no Protocol Buffers message.
    """
    at = 0
    while at < len(body) and any(body[at:]):
        key, at = _varint(body, at)
        number, kind = key >> 3, key & 7
        if kind == _VARINT:
            value, at = _varint(body, at)
            yield number, value
            continue
        size, at = _varint(body, at) if kind == _BYTES else ({_EIGHT: 8, _FOUR: 4}[kind], at)
        if at + size > len(body):
            raise ValueError("it ends inside a field")
        yield number, body[at : at + size]
        at += size


def _varint(body: bytes, at: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(body):
            raise ValueError("it ends inside a number")
        value |= (body[at] & 0x7F) << shift
        at += 1
        if body[at - 1] < 0x80:
            return value, at
    raise ValueError("a number is too long")


def _numbers(kind: str, raw: Any) -> list[Any]:
    """Return the numbers of a field, packed or not."""
    if kind in _FIXED:
        return [item for (item,) in struct.iter_unpack(_FIXED[kind], raw)]
    numbers = [] if isinstance(raw, bytes) else [raw]
    at = 0
    while isinstance(raw, bytes) and at < len(raw):
        item, at = _varint(raw, at)
        numbers.append(item)
    if kind == "int64":
        return [item - (1 << 64) if item >> 63 else item for item in numbers]
    return [bool(item) for item in numbers] if kind == "bool" else numbers


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
    largest = LARGEST_MESSAGE
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
    transport = Transport("tcp", (BRIDGE_WEBSOCKET_PORT,), first="client")
    framing = RacsBridgeFraming()
    to_cfs = True
    from_cfs = True
    layouts = (TO_ROS, TO_CFS)
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
        return BY_CONTENT * ((facts.length > BRIDGE_HEADER - 1) & (to_cfs | name))

    def locate(self, batch: PacketBatch, rows: Places, site: Site) -> Located:
        """Find no packets: the messages have none."""
        return Located(len(rows))

    def dissect(self, reading: Reading, site: Site) -> None:
        """Read the header and the body of one message."""
        data = reading.data
        first = int.from_bytes(data[:2], "big")
        reading.read(TO_CFS if first <= cfe.HIGHEST_MSG_ID else TO_ROS, 0)
        body = data[BRIDGE_HEADER:]
        values = {"body_length": len(body), **(std_msgs_values(body) or {})}
        for name, value in values.items():
            doc = "bytes of the body" if name == "body_length" else "in the body, as the public examples do"
            reading.extend(LayerField(name, value, BRIDGE_HEADER, len(data), str(value), doc))

    def places(self, layout: Layout, rows: BatchRows, field: str = "") -> tuple[Places, Integers]:
        """Find the headers of one direction."""
        owner = np.flatnonzero(rows.column("link") == self)
        offset = rows.datagram("offset")[owner]
        to_cfs = gather(rows.batch.data, offset, 1)[:, 0] <= cfe.HIGHEST_MSG_ID >> 8
        present = to_cfs == (layout is TO_CFS)
        return owner[present], offset[present]

    def engine_values(self) -> Mapping[str, Any]:
        """Return the table that ``engine/lua`` reads: the fields of a body, with their numbers."""
        kinds = {
            field.number: {"name": name, "kind": field.kind, "array": field.is_array or None}
            for name, field in BODY_FIELDS.items()
        }
        return {"subprotocol": SUBPROTOCOL, "largest": LARGEST_BODY, "values": kinds}

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
        over = "msg_id" in values and size > LARGEST_BODY
        room = f", more than the {LARGEST_BODY} that cFS has room for" if over else ""
        return f"{target}: {content or f'{size} bytes'}{room}"


RACS2: Final = RacsBridgeLink()
