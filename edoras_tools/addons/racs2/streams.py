"""Framing and state of WebSocket streams; loaded with the first stream.

WebSocket: the handshake, then frames. One row is one frame (RFC 6455) or one side of the handshake. A
message in several frames has its content in the row of the last one; the rows before it are parts. Compressed
messages (permessage-deflate, RFC 7692) are read if the capture has the stream from its start, because a
message may refer to earlier ones; otherwise they are parts. Headers are big-endian; sections are those of
RFC 6455.

RACS2: which WebSocket connections are its own, and where a message probably starts.
"""

from __future__ import annotations

import re
import zlib
from enum import IntEnum
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from edoras_tools.addons.racs2 import link as racs2
from edoras_tools.links.doors import NOT_A_MESSAGE, NOT_YET, Framing, MessageContents
from edoras_tools.wire import cfe
from edoras_tools.wire.arrays import copy_rows, gather

if TYPE_CHECKING:
    from edoras_tools.wire.arrays import Integers, Mask, Octets


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


class WebSocketFraming(Framing):
    """Cuts a stream into the handshake and frames; messages have the header of RACS2."""

    def lengths(self, data: Octets, at: Integers, end: Integers | int) -> Integers:
        """Return the size in bytes of a frame, or of a handshake up to and including its blank line."""
        room = np.broadcast_to(np.asarray(end - at), at.shape)
        headers = read_headers(data, at, end)
        size = headers.size + headers.length
        fits = headers.valid & (headers.length <= racs2.LARGEST_MESSAGE - LARGEST_HEADER)
        lengths = np.where(headers.complete, np.where(fits, size, NOT_A_MESSAGE), NOT_YET)
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
        holds = headers.valid & headers.complete & headers.final & (headers.length >= racs2.BRIDGE_HEADER)
        holds &= (headers.opcode == Opcode.TEXT) | (headers.opcode == Opcode.BINARY)
        holds &= ~headers.compressed & (room >= headers.size + racs2.BRIDGE_HEADER)
        head = gather(data, np.where(holds, at + headers.size, 0), racs2.BRIDGE_HEADER)
        head ^= np.tile(masking_keys(data, at, headers), racs2.BRIDGE_HEADER // 4)
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

    def contents(self, data: Octets, offset: Integers, length: Integers, forward: Mask) -> MessageContents:
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
        contents = MessageContents(np.concatenate(parts), start, content_bytes, part)
        messages = headers.valid & (headers.opcode < Opcode.CLOSE) & ~part
        if not self._judged and messages.any():
            self._judged = True
            first = int(np.argmax(messages))
            begin = int(start[first])
            head = contents.data[begin : begin + min(int(content_bytes[first]), racs2.BRIDGE_HEADER)][None]
            full = head.shape[1] == racs2.BRIDGE_HEADER
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
        if len(partial[0]) > racs2.LARGEST_MESSAGE:
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
            out = inflate.decompress(data + _TAIL, racs2.LARGEST_MESSAGE)
        except zlib.error:
            return None
        return None if inflate.unconsumed_tail else out


def _handshake_length(data: Octets, text: bytes) -> int:
    """Return the size in bytes of a request or response that begins with ``text``, with its blank line."""
    head = data[:_LONGEST_HANDSHAKE].tobytes()
    if head[: len(text)] != text[: len(head)]:
        return NOT_A_MESSAGE
    end = head.find(_BLANK_LINE)
    if end >= 0:
        return end + len(_BLANK_LINE)
    return NOT_YET if len(head) < _LONGEST_HANDSHAKE else NOT_A_MESSAGE


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
