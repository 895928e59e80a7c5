"""How messages of RACS2 are sent again: as the cFS side, the client of a WebSocket server (RFC 6455)."""

from __future__ import annotations

import base64
import os
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.addons.racs2 import wire as racs2
from edoras_tools.addons.racs2.streams import WebSocketFraming
from edoras_tools.addons.racs2.websocket import Opcode
from edoras_tools.links.sending import LinkSending, SendingSession
from edoras_tools.wire import cfe
from edoras_tools.wire.arrays.window import gather

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from edoras_tools.model import Columns, Link, PacketBatch

_LARGEST: Final = 1 << 20
_REQUEST: Final = (
    "GET / HTTP/1.1\r\nHost: racs2\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    f"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Protocol: {racs2.SUBPROTOCOL}\r\nSec-WebSocket-Key: "
)
_NORMAL: Final = (1000).to_bytes(2, "big")


def masked_frame(opcode: Opcode, payload: bytes) -> bytes:
    """Return a frame of a client, which is masked (section 5.3)."""
    size = len(payload)
    if size < 126:
        head = bytes([0x80 | size])
    elif size < 1 << 16:
        head = b"\xfe" + size.to_bytes(2, "big")
    else:
        head = b"\xff" + size.to_bytes(8, "big")
    key = os.urandom(4)
    mask = np.resize(np.frombuffer(key, np.uint8), size)
    return bytes([0x80 | opcode]) + head + key + (np.frombuffer(payload, np.uint8) ^ mask).tobytes()


class BridgeClient(SendingSession):
    """The cFS side's connection: the handshake, answers to pings, the end."""

    def __init__(self) -> None:
        self.connected = False
        self.next_ns = 0
        self._refusal = ""

    def due(self, *, now: int) -> Iterable[bytes]:
        """Ask for the connection to become a WebSocket, once."""
        del now
        self.next_ns = SendingSession.next_ns
        return (f"{_REQUEST}{base64.b64encode(os.urandom(16)).decode()}\r\n\r\n".encode(),)

    def answer(self, data: bytes, *, now: int) -> Iterable[bytes]:
        """Take the server's answer, or a frame of its."""
        del now
        if data.startswith(b"HTTP/"):
            self.connected = data.split(b" ", 2)[1] == b"101"
            self._refusal = "" if self.connected else data.partition(b"\r\n")[0].decode("ascii", "replace")
        elif data[0] & 15 == Opcode.PING:  # a server's frames are not masked, and a ping's length is a byte
            return (masked_frame(Opcode.PONG, data[2:]),)
        return ()

    def goodbye(self) -> Iterable[bytes]:
        """Close the WebSocket."""
        return (masked_frame(Opcode.CLOSE, _NORMAL),) if self.connected else ()

    def notes(self) -> Iterable[str]:
        """Return why the server did not become one."""
        return (f"the server refused: {self._refusal}",) if self._refusal else ()


class BridgeSending(LinkSending):
    """Messages to ROS, in new frames."""

    port = racs2.BRIDGE_WEBSOCKET_PORT
    framing = WebSocketFraming(_LARGEST)
    renews = True
    instead = "edoras replay --to racs2 sends recorded messages; a new one comes from a node of cFS or ROS"

    def __init__(self, link: Link) -> None:
        super().__init__(link)
        self.session = BridgeClient()
        self._other_way = 0

    def outgoing_rows(self, batch: PacketBatch, columns: Columns) -> NDArray[np.bool_]:
        """Tell which messages name a topic; those with a MsgId are the server's to send."""
        own = super().outgoing_rows(batch, columns)
        first = gather(batch.data, batch.offset, 1)[:, 0]
        to_ros = own & (first > cfe.HIGHEST_MSG_ID >> 8)
        self._other_way += int(np.count_nonzero(own & ~to_ros))
        text = "of them go to cFS: the ROS side sends those, which is the server"
        self.refusals = [f"{self._other_way:,} {text}"] if self._other_way else []
        return to_ros

    def renew(
        self, messages: Sequence[bytes], time_ns: NDArray[np.int64]
    ) -> tuple[list[bytes], NDArray[np.int64]]:
        """Put each message in a frame."""
        return [masked_frame(Opcode.BINARY, item) for item in messages], time_ns
