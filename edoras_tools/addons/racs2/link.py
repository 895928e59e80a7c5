"""RACS2: ROS 2 and cFS over WebSocket, as JAXA's public bridge connects them: messages in WebSocket frames.

The form is taken from its sources (racs2_bridge 1.1, https://github.com/jaxa/racs2_bridge): a header of 32
bytes, then the body. To ROS 2 the header is a topic's name; to cFS it starts with a MsgId. **The only length
on the wire** is that of the frame, and the cFS side always sends 128 bytes of body, with zeros behind the
content. The body can be anything; the public examples put a Protocol Buffers message of ``std_msgs`` there.

WebSocket: the handshake, then frames. One row is one frame (RFC 6455) or one side of the handshake. A
message in several frames has its content in the row of the last one; the rows before it are parts. Compressed
messages (permessage-deflate, RFC 7692) are read if the capture has the stream from its start, because a
message may refer to earlier ones; otherwise they are parts. Headers are big-endian; sections are those of
RFC 6455.

The header tells which WebSocket connections are RACS2's, and where a message probably starts.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator, Mapping
from enum import IntEnum
from typing import Any, Final, Literal, NamedTuple

import numpy as np

from edoras_tools.links import doors
from edoras_tools.links.protocol import BY_CONTENT, BatchRows, LinkProtocol, LinkSending, Located, Seen
from edoras_tools.model import Decoded, LayerField, PacketBatch, Transport
from edoras_tools.wire import cfe
from edoras_tools.wire.arrays import Integers, Mask, Octets, Places, copy_rows, gather
from edoras_tools.wire.layout import Field, Layout

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


class Opcode(IntEnum):
    """The type of a frame (section 5.2)."""

    CONTINUATION = 0
    TEXT = 1
    BINARY = 2
    CLOSE = 8
    PING = 9
    PONG = 10


LARGEST_HEADER: Final = 14
"""Bytes of a header with an 8-byte length and a masking key."""
_KNOWN: Final = np.isin(np.arange(16), list(Opcode))
_CONTROL: Final = 8
"""First opcode of control frames, which are never split and hold at most ``_LARGEST_CONTROL`` bytes."""
_LARGEST_CONTROL: Final = 125
_KEY_BYTES: Final = 4


class FrameHeaders(NamedTuple):
    """The headers of some frames; arrays of one length.

    Attributes:
        final: bool, whether the frame ends its message.
        compressed: bool, RSV1: the message is compressed (RFC 7692).
        opcode: u8.
        masked: bool, whether the payload is masked.
        size: i64, size of the header in bytes.
        length: i64, size of the payload in bytes.
        valid: bool, whether a frame can begin like this.
        complete: bool, whether the header is complete.
    """

    final: Mask
    compressed: Mask
    opcode: Octets
    masked: Mask
    size: Integers
    length: Integers
    valid: Mask
    complete: Mask


def read_headers(data: Octets, at: Integers, end: Integers | int) -> FrameHeaders:
    """Read the headers of the frames that start at some positions.

    Args:
        data: u8.
        at: i64 (n,), positions in ``data``.
        end: one past the last byte that is available.
    """
    head = gather(data, at, LARGEST_HEADER)
    first, second = head[:, 0], head[:, 1]
    opcode: Octets = np.bitwise_and(first, 15, dtype=np.uint8)
    final, short = first >= 0x80, (second & 0x7F).astype(np.int64)
    masked = second >= 0x80
    two = head[:, 2:4].view(">u2")[:, 0].astype(np.int64)
    eight = np.ascontiguousarray(head[:, 2:10]).view(">u8")[:, 0]
    length = np.select([short == 126, short == 127], [two, eight.astype(np.int64)], short)
    extended = np.select([short == 126, short == 127], [2, 8], 0)
    size = 2 + extended + _KEY_BYTES * masked
    control = opcode >= _CONTROL
    compressed = first & 0x40 != 0
    valid = _KNOWN[opcode] & (first & 0x30 == 0) & (length >= 0)
    valid &= ~control | (final & ~compressed & (short <= _LARGEST_CONTROL))
    valid &= ~compressed | (opcode != Opcode.CONTINUATION)
    return FrameHeaders(final, compressed, opcode, masked, size, length, valid, end - at >= 2 + extended)


def unmask(data: Octets, start: Integers, length: Integers, keys: Octets) -> None:
    """Remove the masks of payloads, in place (section 5.3).

    Args:
        data: u8, the payloads end to end.
        start: i64 (n,), first byte of each payload.
        length: i64 (n,), size of each payload in bytes.
        keys: u8 (n, 4), masking keys; zeros for payloads that are not masked.
    """
    row = np.repeat(np.arange(len(start)), length)
    place = np.arange(len(row)) - np.repeat(np.cumsum(length) - length, length)
    data[start[row] + place] ^= keys[row, place & 3]


def masking_keys(data: Octets, at: Integers, headers: FrameHeaders) -> Octets:
    """Return the masking key of each frame, u8 (n, 4); zeros where there is none."""
    keys = gather(data, np.maximum(at + headers.size - _KEY_BYTES, 0), _KEY_BYTES)
    keys[~headers.masked] = 0
    return keys


_HTTP: Final = (b"GET ", b"HTTP/1.1 ")
_FOREIGN: Final = b"foxglove."
"""Beginning of the names of another protocol on the same port."""
_BLANK_LINE: Final = b"\r\n\r\n"
_LONGEST_HANDSHAKE: Final = 8192
_TAIL: Final = b"\0\0\xff\xff"
"""Bytes that a sender omits at the end of a compressed message (RFC 7692 section 7.2.1)."""
_PROTOCOL: Final = re.compile(rb"(?im)^sec-websocket-protocol:[ \t]*([^\r\n]*)")
_EXTENSIONS: Final = re.compile(rb"(?im)^sec-websocket-extensions:[ \t]*([^\r\n]*)")


class WebSocketFraming(doors.Framing):
    """Cuts a stream into the handshake and frames; messages have the header of RACS2."""

    head = 14
    largest = LARGEST_MESSAGE
    checked = True

    def lengths(self, data: Octets, at: Integers, end: Integers | int) -> Integers:
        """Return the size in bytes of a frame, or of a handshake up to and including its blank line."""
        room = np.broadcast_to(np.asarray(end - at), at.shape)
        headers = read_headers(data, at, end)
        size = headers.size + headers.length
        fits = headers.valid & (headers.length <= LARGEST_MESSAGE - LARGEST_HEADER)
        lengths = np.where(headers.complete, np.where(fits, size, doors.NOT_A_MESSAGE), doors.NOT_YET)
        first = data[np.minimum(at, len(data) - 1)]
        for text in _HTTP:  # no frame can begin with the first byte of either
            for row in np.flatnonzero((first == text[0]) & (room > 0)).tolist():
                start = int(at[row])
                lengths[row] = _handshake_length(data[start : start + int(room[row])], text)
        return lengths.astype(np.int64)

    def likely(self, data: Octets, at: Integers, end: Integers | int) -> Mask:
        """Return where a one-frame message with a header of RACS2 begins, or a handshake; bool (n,)."""
        headers = read_headers(data, at, end)
        room = np.broadcast_to(np.asarray(end - at), at.shape)
        holds = headers.valid & headers.complete & headers.final & (headers.length >= BRIDGE_HEADER)
        holds &= (headers.opcode == Opcode.TEXT) | (headers.opcode == Opcode.BINARY)
        holds &= ~headers.compressed & (room >= headers.size + BRIDGE_HEADER)
        head = gather(data, np.where(holds, at + headers.size, 0), BRIDGE_HEADER)
        head ^= np.tile(masking_keys(data, at, headers), BRIDGE_HEADER // 4)
        handshake = ~headers.valid & (self.lengths(data, at, end) > 0)
        return np.asarray(handshake | (holds & (_names_topic(head) | _names_msg_id(head))))

    def state(self) -> WebSocketState:
        """Return the state of a new connection."""
        return WebSocketState()


class WebSocketState:
    """State of one connection: its handshake, its incomplete messages, and how they are compressed.

    Attributes:
        foreign: whether the handshake or the first message shows another protocol, as Foxglove's.
    """

    def __init__(self) -> None:
        self.foreign = self._judged = False
        self._partial: dict[bool, tuple[bytearray, bool]] = {}
        self._inflate: dict[bool, zlib._Decompress] = {}
        self._takeover = True

    def contents(
        self, data: Octets, offset: Integers, length: Integers, forward: Mask
    ) -> doors.MessageContents:
        """Return the payloads of frames, unmasked; see :class:`~edoras_tools.links.doors.StreamState`."""
        headers = read_headers(data, offset, offset + length)
        http = ~headers.valid
        size = np.where(http, 0, headers.size)
        content_bytes = length - size
        start = np.cumsum(content_bytes) - content_bytes
        out = np.zeros(int(content_bytes.sum()), np.uint8)
        copy_rows(out, start, data, offset + size, content_bytes)
        keys = masking_keys(data, offset, headers)
        keys[http] = 0
        if keys.any():
            unmask(out, start, content_bytes, keys)
        part = np.zeros(len(offset), bool)
        single = headers.final & ~headers.compressed & (headers.opcode != Opcode.CONTINUATION)
        parts: list[Octets] = [out]
        used = len(out)
        for row in np.flatnonzero(http | ~single).tolist():
            content = out[start[row] : start[row] + content_bytes[row]].tobytes()
            if http[row]:
                self._handshake(content)
                continue
            whole = self._put_together(content, bool(forward[row]), headers, row)
            part[row] = whole is None
            if whole is not None:
                start[row], content_bytes[row] = used, len(whole)
                parts.append(np.frombuffer(whole, np.uint8))
                used += len(whole)
        contents = doors.MessageContents(np.concatenate(parts), start, content_bytes, part)
        messages = headers.valid & (headers.opcode < Opcode.CLOSE) & ~part
        if not self._judged and messages.any():
            self._judged = True
            first = int(np.argmax(messages))
            begin = int(start[first])
            head = contents.data[begin : begin + min(int(content_bytes[first]), BRIDGE_HEADER)][None]
            full = head.shape[1] == BRIDGE_HEADER
            self.foreign |= not (full and bool((_names_topic(head) | _names_msg_id(head))[0]))
        return contents

    def _handshake(self, text: bytes) -> None:
        """Note the protocol and the compression that a request or a response states."""
        protocols = b",".join(_PROTOCOL.findall(text))
        if any(name.strip().startswith(_FOREIGN) for name in protocols.split(b",") if name):
            self.foreign = True
        if text.startswith(b"HTTP"):
            self._takeover = b"no_context_takeover" not in b",".join(_EXTENSIONS.findall(text))

    def _put_together(self, content: bytes, forward: bool, headers: FrameHeaders, row: int) -> bytes | None:
        """Add a frame to its message; return the message if it is complete and can be read, else None."""
        compressed = bool(headers.compressed[row])
        if headers.opcode[row] == Opcode.CONTINUATION:
            partial = self._partial.get(forward)
            if partial is None:
                return None
            partial[0].extend(content)
        else:
            partial = self._partial[forward] = bytearray(content), compressed
        if len(partial[0]) > LARGEST_MESSAGE:
            del self._partial[forward]
            return None
        if not headers.final[row]:
            return None
        del self._partial[forward]
        return self._inflated(bytes(partial[0]), forward) if partial[1] else bytes(partial[0])

    def _inflated(self, data: bytes, forward: bool) -> bytes | None:
        if not self._takeover or forward not in self._inflate:
            self._inflate[forward] = zlib.decompressobj(-zlib.MAX_WBITS)
        inflate = self._inflate[forward]
        try:
            out = inflate.decompress(data + _TAIL, LARGEST_MESSAGE)
        except zlib.error:
            return None
        return None if inflate.unconsumed_tail else out


def _handshake_length(data: Octets, text: bytes) -> int:
    """Return the size in bytes of a request or response that begins with ``text``, with its blank line."""
    head = data[:_LONGEST_HANDSHAKE].tobytes()
    if head[: len(text)] != text[: len(head)]:
        return doors.NOT_A_MESSAGE
    end = head.find(_BLANK_LINE)
    if end >= 0:
        return end + len(_BLANK_LINE)
    return doors.NOT_YET if len(head) < _LONGEST_HANDSHAKE else doors.NOT_A_MESSAGE


_NAME_BYTES: Final = np.isin(
    np.arange(256), list(b"/_~0123456789abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ")
)


def _names_topic(head: Octets) -> Mask:
    """Return which headers hold a topic's name and zeros, bool (n,); the first byte is no digit."""
    ended = np.logical_or.accumulate(head == 0, axis=1)
    fits = np.where(ended, head == 0, _NAME_BYTES[head]).all(axis=1)
    return np.asarray(fits & (head[:, 0] > ord("9")) | fits & (head[:, 0] == ord("/")))


def _names_msg_id(head: Octets) -> Mask:
    """Return which headers hold a valid MsgId and zeros, bool (n,)."""
    msg_id = head[:, 0].astype(np.int32) << 8 | head[:, 1]
    return np.asarray((msg_id > 0) & (msg_id <= cfe.HIGHEST_MSG_ID) & ~head[:, 2:].any(axis=1))


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
    framing = WebSocketFraming()
    to_cfs = True
    from_cfs = True
    layouts = (TO_ROS, TO_CFS)
    port_decides = False
    sends = True

    def send(self, site: doors.Site, *, up: bool) -> LinkSending:
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

    def locate(self, batch: PacketBatch, rows: Places, site: doors.Site) -> Located:
        """Find no packets: the messages have none."""
        return Located(len(rows))

    def dissect(self, reading: doors.Reading, site: doors.Site) -> None:
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

    def topics(self, space: doors.TopicSpace) -> doors.OwnTopics:
        """Return the maker of the link's messages; its code is loaded with the first."""
        return self.part("sending:BridgeTopics")(space)

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
