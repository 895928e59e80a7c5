"""The public EDORAS flight bridge as it behaves on the SBN link, bugs included.

It sends a SUB for every MsgId each 500 ms for good, answers every datagram with a PROTO, never sends an
UNSUB, keeps a received length in a ``uint8_t`` (so drops what is shorter than a header modulo 256), looks at
its socket each 100 ms and stops looking at the first datagram that is no application message.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from edoras_tools.errors import TruncatedError
from edoras_tools.sessions.profile import MILLISECOND
from edoras_tools.wire import sbn

if TYPE_CHECKING:
    from collections.abc import Sequence

POLL_NS: Final = 100 * MILLISECOND
SUBSCRIBE_NS: Final = 500 * MILLISECOND
RECEIVE_BYTES: Final = 4096


@dataclass(slots=True)
class Polled:
    """What one poll did.

    Attributes:
        sends: datagrams for cFS, in order.
        packets: space packets for ROS.
        dropped: datagrams lost to the 8-bit length.
    """

    sends: list[bytes] = field(default_factory=list)
    packets: list[bytes] = field(default_factory=list)
    dropped: int = 0


class FlightBridge:
    """The bridge's side of the link.

    Attributes:
        peer: as it calls itself.
        msg_ids: what it subscribes to: its configuration's ``telemetry``.
    """

    def __init__(self, msg_ids: Sequence[int], *, now: int, peer: sbn.Peer | None = None) -> None:
        self.peer = peer or sbn.Peer(0x42, 3)
        self.msg_ids = tuple(msg_ids)
        self._queue: deque[bytes] = deque()
        self._subscribe_ns = now

    def receive_datagram(self, data: bytes) -> None:
        """Put a datagram in the socket's queue until the next poll."""
        self._queue.append(data[:RECEIVE_BYTES])

    def emit(self, packet: bytes) -> bytes:
        """Return the datagram that carries a packet to cFS."""
        return sbn.emit(sbn.MsgType.APP, self.peer, packet)

    def poll(self, *, now: int) -> Polled:
        """Do one round, due every ``POLL_NS``."""
        polled = Polled()
        while self._queue:
            data = self._queue.popleft()
            if len(data) % 256 < sbn.HEADER.size:
                polled.dropped += 1
                continue
            polled.sends.append(sbn.emit(sbn.MsgType.PROTO, self.peer, sbn.emit_proto()))
            try:
                msg_type = sbn.HEADER.parse(data)["msg_type"]
            except TruncatedError:
                break
            if msg_type == sbn.MsgType.HEARTBEAT:
                polled.sends.append(sbn.emit(sbn.MsgType.HEARTBEAT, self.peer))
            if msg_type != sbn.MsgType.APP:
                break
            polled.packets.append(data[sbn.HEADER.size :])
        if now >= self._subscribe_ns:
            self._subscribe_ns = now + SUBSCRIBE_NS
            for msg_id in self.msg_ids:
                payload = sbn.emit_subscriptions([sbn.Subscription(msg_id)])
                polled.sends.append(sbn.emit(sbn.MsgType.SUB, self.peer, payload))
        return polled
