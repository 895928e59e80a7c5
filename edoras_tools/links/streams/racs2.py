"""The streams of RACS2: which WebSocket connections are its own, and where a message probably starts."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.links.streams.websocket import WebSocketFraming, WebSocketState
from edoras_tools.wire import cfe, racs2
from edoras_tools.wire.arrays.window import gather
from edoras_tools.wire.websocket import Opcode, masking_keys, read_headers

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.links.framing import MessageContents

_NAME_BYTES: Final = np.isin(
    np.arange(256), list(b"/_~0123456789abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ")
)


class RacsBridgeStreams(WebSocketFraming):
    """WebSocket whose messages have the header of RACS2; Foxglove uses the same port."""

    def likely(
        self, data: NDArray[np.uint8], at: NDArray[np.int64], end: NDArray[np.int64] | int
    ) -> NDArray[np.bool_]:
        """Ask for a message in one frame that begins with a header, or for a handshake."""
        headers = read_headers(data, at, end)
        room = np.broadcast_to(np.asarray(end - at), at.shape)
        holds = headers.valid & headers.known & headers.final & (headers.length >= racs2.BRIDGE_HEADER)
        holds &= (headers.opcode == Opcode.TEXT) | (headers.opcode == Opcode.BINARY)
        holds &= ~headers.compressed & (room >= headers.size + racs2.BRIDGE_HEADER)
        head = gather(data, np.where(holds, at + headers.size, 0), racs2.BRIDGE_HEADER)
        head ^= np.tile(masking_keys(data, at, headers), racs2.BRIDGE_HEADER // 4)
        handshake = ~headers.valid & (self.lengths(data, at, end) > 0)
        return np.asarray(handshake | (holds & (_names_topic(head) | _names_msg_id(head))))

    def state(self) -> RacsBridgeState:
        """Return what is known of a new connection."""
        return RacsBridgeState(self.longest)


class RacsBridgeState(WebSocketState):
    """One connection: another protocol's, if the handshake or the first message says so."""

    foreign_protocols = (b"foxglove.",)

    def __init__(self, largest: int) -> None:
        super().__init__(largest)
        self._told = False

    def contents(
        self,
        data: NDArray[np.uint8],
        offset: NDArray[np.int64],
        length: NDArray[np.int64],
        forward: NDArray[np.bool_],
    ) -> MessageContents:
        """Return the payloads of frames, and judge by the first message whose connection it is."""
        found = super().contents(data, offset, length, forward)
        headers = read_headers(data, offset, offset + length)
        whole = headers.valid & (headers.opcode < Opcode.CLOSE) & ~found.part
        if not self._told and whole.any():
            self._told = True
            row = int(np.argmax(whole))
            start = int(found.offset[row])
            head = found.data[start : start + min(int(found.length[row]), racs2.BRIDGE_HEADER)][None]
            full = head.shape[1] == racs2.BRIDGE_HEADER
            self.foreign |= not (full and bool((_names_topic(head) | _names_msg_id(head))[0]))
        return found


def _names_topic(head: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Tell which headers are a topic's name and zeros, bool (n,); the first byte is no digit."""
    ended = np.logical_or.accumulate(head == 0, axis=1)
    fits = np.where(ended, head == 0, _NAME_BYTES[head]).all(axis=1)
    return np.asarray(fits & (head[:, 0] > ord("9")) | fits & (head[:, 0] == ord("/")))


def _names_msg_id(head: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Tell which headers are a valid MsgId and zeros, bool (n,)."""
    msg_id = head[:, 0].astype(np.int32) << 8 | head[:, 1]
    return np.asarray((msg_id > 0) & (msg_id <= cfe.HIGHEST_MSG_ID) & ~head[:, 2:].any(axis=1))
