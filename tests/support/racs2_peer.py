"""Both RACS2 bridges as the public ones speak, over `websockets` without its sockets, as TCP segments.

The `websockets` package makes handshake, frames, masks and compression; messages are laid out as in the
public sources (racs2_bridge 1.1). Nothing of ours makes them.
"""

from __future__ import annotations

import struct

from streams import ACK, CLIENT, SYN, Segment
from websockets.client import ClientProtocol
from websockets.extensions.permessage_deflate import (
    ClientPerMessageDeflateFactory,
    ServerPerMessageDeflateFactory,
)
from websockets.http11 import Request
from websockets.server import ServerProtocol
from websockets.uri import parse_uri

SERVER = ("10.0.0.2", 8765)


def to_ros(topic: str, body: bytes) -> bytes:
    """Return what the cFS side sends: always 160 bytes."""
    return topic.encode().ljust(32, b"\0") + body.ljust(128, b"\0")


def to_cfs(msg_id: int, body: bytes) -> bytes:
    """Return what the ROS side sends."""
    return struct.pack(">H", msg_id) + bytes(30) + body


class Talk:
    """A connection between the cFS side, which is the client, and the ROS side.

    Attributes:
        segments: all TCP segments so far, in order.
        streams: the bytes of each direction: from the client, from the server.
    """

    def __init__(self, *, deflate=False, subprotocol="example-protocol", takeover=True):
        fresh = not takeover
        ours = [ClientPerMessageDeflateFactory(client_no_context_takeover=fresh)] if deflate else None
        theirs = [ServerPerMessageDeflateFactory(server_no_context_takeover=fresh)] if deflate else None
        uri = parse_uri("ws://10.0.0.2:8765/")
        asked = [subprotocol] if subprotocol else None
        self.cfs = ClientProtocol(uri, subprotocols=asked, extensions=ours)
        self.ros = ServerProtocol(extensions=theirs, subprotocols=asked)
        self.segments = [
            Segment(99, flags=SYN, destination=SERVER),
            Segment(499, flags=SYN | ACK, source=SERVER, destination=CLIENT),
        ]
        self.streams = [b"", b""]
        self.cfs.send_request(self.cfs.connect())
        self.pass_on()

    def pass_on(self) -> None:
        """Carry what each side has to send to the other, until neither has any."""
        while self._carry():
            pass

    def _carry(self) -> bool:
        sent = b"".join(self.cfs.data_to_send())
        self._segment(0, sent)
        if sent:
            self.ros.receive_data(sent)
        for event in self.ros.events_received():
            if isinstance(event, Request):
                self.ros.send_response(self.ros.accept(event))
        answer = b"".join(self.ros.data_to_send())
        self._segment(1, answer)
        if answer:
            self.cfs.receive_data(answer)
        self.cfs.events_received()
        return bool(sent or answer)

    def _segment(self, side: int, data: bytes) -> None:
        ends = [CLIENT, SERVER] if side == 0 else [SERVER, CLIENT]
        for first in range(0, len(data), 30_000):
            part = data[first : first + 30_000]
            at = (100, 500)[side] + len(self.streams[side])
            acknowledged = (500, 100)[side] + len(self.streams[1 - side])
            self.segments.append(Segment(at, part, ACK, acknowledged, ends[0], ends[1]))
            self.streams[side] += part
