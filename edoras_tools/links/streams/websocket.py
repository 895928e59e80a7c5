"""WebSocket over TCP: the handshake, then frames; what messages hold, without mask and compression.

One row is one frame (RFC 6455) or one side of the handshake. A message in several frames has its content in
the row of the last one; the rows before it are parts. Compressed messages (permessage-deflate, RFC 7692) are
read where the capture has them from the start, because a message may refer to earlier ones; others are parts.
"""

from __future__ import annotations

import re
import zlib
from typing import TYPE_CHECKING, ClassVar, Final

import numpy as np

from edoras_tools.links.framing import NOT_A_MESSAGE, NOT_YET, Framing, MessageContents
from edoras_tools.wire.arrays.window import copy_rows
from edoras_tools.wire.websocket import (
    LARGEST_HEADER,
    FrameHeaders,
    Opcode,
    masking_keys,
    read_headers,
    unmask,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

_HTTP: Final = (b"GET ", b"HTTP/1.1 ")
_BLANK_LINE: Final = b"\r\n\r\n"
_LONGEST_HANDSHAKE: Final = 8192
_TAIL: Final = b"\0\0\xff\xff"
"""What a sender leaves out at the end of a compressed message (RFC 7692 section 7.2.1)."""
_PROTOCOL: Final = re.compile(rb"(?im)^sec-websocket-protocol:[ \t]*([^\r\n]*)")
_EXTENSIONS: Final = re.compile(rb"(?im)^sec-websocket-extensions:[ \t]*([^\r\n]*)")


class WebSocketFraming(Framing):
    """Cuts a stream into the handshake and frames.

    Args:
        longest: bytes of the longest message.
    """

    def __init__(self, longest: int) -> None:
        self.longest = longest

    def lengths(
        self, data: NDArray[np.uint8], at: NDArray[np.int64], end: NDArray[np.int64] | int
    ) -> NDArray[np.int64]:
        """Return the bytes of a frame, or of a handshake up to its blank line."""
        room = np.broadcast_to(np.asarray(end - at), at.shape)
        headers = read_headers(data, at, end)
        size = headers.size + headers.length
        fits = headers.valid & (headers.length <= self.longest - LARGEST_HEADER)
        found = np.where(headers.known, np.where(fits, size, NOT_A_MESSAGE), NOT_YET)
        first = data[np.minimum(at, len(data) - 1)]
        for text in _HTTP:  # the first byte of neither can begin a frame
            for row in np.flatnonzero((first == text[0]) & (room > 0)).tolist():
                start = int(at[row])
                found[row] = _handshake_length(data[start : start + int(room[row])], text)
        return found.astype(np.int64)

    def state(self) -> WebSocketState:
        """Return what is known of a new connection."""
        return WebSocketState(self.longest)


class WebSocketState:
    """One connection: its handshake, messages of which more frames are to come, and how they are compressed.

    Args:
        largest: bytes of the longest message that is put together.

    Attributes:
        foreign: whether it carries another protocol than the link's.
    """

    foreign_protocols: ClassVar[tuple[bytes, ...]] = ()

    def __init__(self, largest: int) -> None:
        self.foreign = False
        self._largest = largest
        self._begun: dict[bool, tuple[bytearray, bool]] = {}
        self._inflate: dict[bool, zlib._Decompress] = {}
        self._takeover = True

    def contents(
        self,
        data: NDArray[np.uint8],
        offset: NDArray[np.int64],
        length: NDArray[np.int64],
        forward: NDArray[np.bool_],
    ) -> MessageContents:
        """Return the payloads of frames, unmasked; see :class:`~edoras_tools.links.framing.StreamState`."""
        headers = read_headers(data, offset, offset + length)
        http = ~headers.valid
        size = np.where(http, 0, headers.size)
        held = length - size
        start = np.cumsum(held) - held
        out = np.zeros(int(held.sum()), np.uint8)
        copy_rows(out, start, data, offset + size, held)
        keys = masking_keys(data, offset, headers)
        keys[http] = 0
        if keys.any():
            unmask(out, start, held, keys)
        part = np.zeros(len(offset), bool)
        single = headers.final & ~headers.compressed & (headers.opcode != Opcode.CONTINUATION)
        parts: list[NDArray[np.uint8]] = [out]
        used = len(out)
        for row in np.flatnonzero(http | ~single).tolist():
            content = out[start[row] : start[row] + held[row]].tobytes()
            if http[row]:
                self._handshake(content)
                continue
            whole = self._put_together(content, bool(forward[row]), headers, row)
            part[row] = whole is None
            if whole is not None:
                start[row], held[row] = used, len(whole)
                parts.append(np.frombuffer(whole, np.uint8))
                used += len(whole)
        return MessageContents(np.concatenate(parts), start, held, part)

    def _handshake(self, text: bytes) -> None:
        """Learn what a request or a response says."""
        protocols = b",".join(_PROTOCOL.findall(text))
        if any(name.strip().startswith(self.foreign_protocols) for name in protocols.split(b",") if name):
            self.foreign = True
        if text.startswith(b"HTTP"):
            self._takeover = b"no_context_takeover" not in b",".join(_EXTENSIONS.findall(text))

    def _put_together(self, content: bytes, forward: bool, headers: FrameHeaders, row: int) -> bytes | None:
        """Add a frame to its message; return the message when it is complete and could be read."""
        compressed = bool(headers.compressed[row])
        if headers.opcode[row] == Opcode.CONTINUATION:
            begun = self._begun.get(forward)
            if begun is None:
                return None
            begun[0].extend(content)
        else:
            begun = self._begun[forward] = bytearray(content), compressed
        if len(begun[0]) > self._largest:
            del self._begun[forward]
            return None
        if not headers.final[row]:
            return None
        del self._begun[forward]
        return self._inflated(bytes(begun[0]), forward) if begun[1] else bytes(begun[0])

    def _inflated(self, data: bytes, forward: bool) -> bytes | None:
        if not self._takeover or forward not in self._inflate:
            self._inflate[forward] = zlib.decompressobj(-zlib.MAX_WBITS)
        inflate = self._inflate[forward]
        try:
            out = inflate.decompress(data + _TAIL, self._largest)
        except zlib.error:
            return None
        return None if inflate.unconsumed_tail else out


def _handshake_length(data: NDArray[np.uint8], text: bytes) -> int:
    """Return the bytes of a request or response that begins with ``text``, its blank line included."""
    head = data[:_LONGEST_HANDSHAKE].tobytes()
    if head[: len(text)] != text[: len(head)]:
        return NOT_A_MESSAGE
    end = head.find(_BLANK_LINE)
    if end >= 0:
        return end + len(_BLANK_LINE)
    return NOT_YET if len(head) < _LONGEST_HANDSHAKE else NOT_A_MESSAGE
