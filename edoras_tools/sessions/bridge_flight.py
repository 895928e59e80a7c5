"""A flight bridge towards cFS: an SBN peer as it should be.

=============  ================================================  =============
state          what happens                                      becomes
=============  ================================================  =============
asking         any datagram of the peer but a DISCONNECT         connected
connected      DISCONNECT                                        asking
connected      nothing from the peer for ``TIMEOUT_S`` seconds   asking
=============  ================================================  =============

Asking is a PROTO a second. On connecting, one SUB says all that is wanted; after that only changes are said,
each once. A peer that introduces itself anew while connected was started anew, and is told all once more.
Heartbeats go out only when nothing else did for ``HEARTBEAT_S`` seconds.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.errors import TruncatedError
from edoras_tools.sessions.profile import SECOND
from edoras_tools.sessions.sbn_client import ASK_NS, HEARTBEAT_S, TIMEOUT_S
from edoras_tools.wire import sbn

if TYPE_CHECKING:
    from collections.abc import Iterable

_HEADER: Final = struct.Struct(">hBII")
_LEGACY: Final = struct.Struct(">hBI")
_APP, _DISCONNECT, _PROTO = int(sbn.MsgType.APP), int(sbn.MsgType.DISCONNECT), int(sbn.MsgType.PROTO)
_QUIET: Final = frozenset(
    int(kind) for kind in (sbn.MsgType.NO_MSG, sbn.MsgType.HEARTBEAT, sbn.MsgType.ANNOUNCE)
)
_NOTHING: Final[list[bytes]] = []
_NO_PACKET: Final = -1
_MOST_TOLD: Final = 64
_PATIENCE_NS: Final = 2 * SECOND
"""What cFS wants has been said by then."""


class FlightSession:
    """One connection to cFS's Software Bus Network.

    Args:
        own: as this side calls itself.
        peer: as cFS does; nobody else is listened to.
        msg_ids: what this side wants to have.
        now: ns.

    Attributes:
        ready: connected: messages cross.
        wanted: MsgIds that this side wants to have.
        subscribed: MsgIds that cFS wants to have.
        connections: how often a connection was made.
        losses: how often one was lost: by ``disconnect``, by ``timeout``.
        refused: datagrams that were not taken, by reason.
        notes: what people should know; who reads it empties it.
    """

    def __init__(self, own: sbn.Peer, peer: sbn.Peer, msg_ids: Iterable[int] = (), *, now: int) -> None:
        self.own, self.peer = own, peer
        self.ready = False
        self.wanted = dict.fromkeys(msg_ids)
        self.subscribed: set[int] = set()
        self.connections = 0
        self.losses = {"disconnect": 0, "timeout": 0}
        self.refused: dict[str, int] = {}
        self.notes: list[str] = []
        self._told: set[str] = set()
        self._ask_ns = self._heard_ns = self._sent_ns = self._subscribed_ns = now
        self._unwanted: set[int] = set()
        self._anew = True
        self._greeted = False
        self._identity = struct.pack(">II", peer.processor_id, peer.spacecraft_id)

    @property
    def next_ns(self) -> int:
        """When ``service`` is due."""
        if not self.ready:
            return self._ask_ns
        return min(self._sent_ns + HEARTBEAT_S * SECOND, self._heard_ns + TIMEOUT_S * SECOND)

    def receive_datagram(self, data: bytes, *, now: int) -> tuple[int, list[bytes]]:
        """Take a datagram, any bytes.

        Returns:
            where a space packet starts, -1 where there is none, and what to answer.
        """
        if data[3:11] != self._identity or data[0] & 0x80:
            self._refuse(data)
            return _NO_PACKET, _NOTHING
        self._heard_ns = now
        kind = data[2]
        if kind == _APP and self.ready:
            return _HEADER.size, _NOTHING
        if kind == _DISCONNECT:
            if self.ready:
                self._lose("disconnect", f"peer {self.peer} disconnected; asking again", now)
            return _NO_PACKET, _NOTHING
        answers = self._connect(now) if not self.ready else _NOTHING
        if kind == _PROTO:
            answers = answers or self._greet(now)
            self._compare(data[_HEADER.size : _HEADER.size + 1])
            self._greeted = True
        elif kind in {sbn.MsgType.SUB, sbn.MsgType.UNSUB}:
            self._subscription(data, kind)
        elif kind == _APP:
            return _HEADER.size, answers
        elif kind not in _QUIET:
            self._count(f"unknown SBN message type 0x{kind:02x}")
        return _NO_PACKET, answers

    def service(self, *, now: int) -> list[bytes]:
        """Ask, keep the connection alive, or notice that it is gone."""
        if self.ready and now - self._heard_ns >= TIMEOUT_S * SECOND:
            text = f"nothing from peer {self.peer} for {TIMEOUT_S} s: connection lost; asking again"
            self._lose("timeout", text, now)
        if not self.ready:
            if now < self._ask_ns:
                return []
            self._ask_ns = now + ASK_NS
            # A peer that still takes us for connected would not answer: it forgets us first.
            farewell = [self._emit(sbn.MsgType.DISCONNECT)] if self._anew else []
            self._anew = False
            return [*farewell, self._emit(sbn.MsgType.PROTO, sbn.emit_proto())]
        if now - self._sent_ns >= HEARTBEAT_S * SECOND:
            self._sent_ns = now
            return [self._emit(sbn.MsgType.HEARTBEAT)]
        return []

    def want(self, msg_ids: Iterable[int], *, now: int) -> list[bytes]:
        """Change what this side wants to have; return what says so: a SUB, an UNSUB, or nothing."""
        wanted = dict.fromkeys(msg_ids)
        more = [item for item in wanted if item not in self.wanted]
        fewer = [item for item in self.wanted if item not in wanted]
        self.wanted = wanted
        if not self.ready:
            return []
        said = [
            self._subscriptions(kind, items)
            for kind, items in ((sbn.MsgType.SUB, more), (sbn.MsgType.UNSUB, fewer))
            if items
        ]
        if said:
            self._sent_ns = now
        return said

    def frame(self, packet: bytes) -> bytes:
        """Return the datagram of a packet, 32,767 bytes at the most."""
        msg_id = packet[0] << 8 | packet[1]
        if msg_id not in self.subscribed:
            self._unwanted.add(msg_id)
        return _HEADER.pack(len(packet), _APP, self.own.processor_id, self.own.spacecraft_id) + packet

    def sent(self, *, now: int) -> None:
        """Take note that messages were sent: no heartbeat is needed for a while."""
        self._sent_ns = now
        if self._unwanted and now - self._subscribed_ns >= _PATIENCE_NS:
            for msg_id in sorted(self._unwanted):
                self._tell(
                    f"cFS has not subscribed to 0x{msg_id:04X}: no application there takes it; "
                    "is the MsgId the same on both sides?"
                )
            self._unwanted.clear()

    def goodbye(self) -> list[bytes]:
        """Return the UNSUB and the DISCONNECT that let cFS close the pipe at once."""
        if not self.ready:
            return []
        unsub = [self._subscriptions(sbn.MsgType.UNSUB, self.wanted)] if self.wanted else []
        return [*unsub, self._emit(sbn.MsgType.DISCONNECT)]

    def summary(self) -> dict[str, Any]:
        """Return its part of ``bridge --json``."""
        return {
            "peer": str(self.peer),
            "connected": self.ready,
            "connections": self.connections,
            "losses": dict(self.losses),
        }

    def _connect(self, now: int) -> list[bytes]:
        self.ready = True
        self.connections += 1
        self._greeted = False
        self._sent_ns = now
        self.notes.append(f"connected to peer {self.peer}")
        return [self._emit(sbn.MsgType.PROTO, sbn.emit_proto()), *self._subscribe(now)]

    def _greet(self, now: int) -> list[bytes]:
        """Answer a PROTO that comes while connected."""
        # The first belongs to the handshake, and some peers send one for everything that they hear.
        if not self._greeted or now - self._subscribed_ns < ASK_NS:
            return _NOTHING
        self.subscribed.clear()
        self._sent_ns = now
        return self._subscribe(now)

    def _subscribe(self, now: int) -> list[bytes]:
        self._subscribed_ns = now
        return [self._subscriptions(sbn.MsgType.SUB, self.wanted)] if self.wanted else []

    def _lose(self, how: str, text: str, now: int) -> None:
        self.ready = False
        self.losses[how] += 1
        self.subscribed.clear()
        self._ask_ns = now
        self._anew = True
        self.notes.append(text)

    def _compare(self, version: bytes) -> None:
        if version and version[0] != sbn.PROTOCOL_VERSION:
            self._tell(
                f"peer {self.peer} speaks SBN protocol {version[0]}, this side {sbn.PROTOCOL_VERSION}: "
                "it may refuse what it hears; going on"
            )

    def _subscription(self, data: bytes, kind: int) -> None:
        try:
            ident, entries = sbn.parse_subscriptions(memoryview(data)[_HEADER.size :])
        except TruncatedError:
            self._count("subscriptions cut short")
            return
        if ident != sbn.IDENT:
            self._tell(
                f"peer {self.peer} is another SBN ({ident or 'no $Id'}): it will refuse what this side wants"
            )
        wanted = {item.msg_id for item in entries}
        self.subscribed = self.subscribed | wanted if kind == sbn.MsgType.SUB else self.subscribed - wanted
        self._unwanted -= self.subscribed

    def _refuse(self, data: bytes) -> None:
        if len(data) < _HEADER.size and not _is_legacy(data):
            self._count("shorter than an SBN header")
        elif _is_legacy(data):
            self._count("SBN header of 7 bytes")
            self._tell(
                "an SBN of the older kind, its header 7 bytes instead of 11, speaks here: not understood"
            )
        elif data[0] & 0x80:
            self._count("SBN size below 0")
        else:
            _, _, processor_id, spacecraft_id = _HEADER.unpack_from(data)
            other = sbn.Peer(spacecraft_id, processor_id)
            self._count(f"peer {other}" if len(self.refused) < 16 else "further peers")
            self._tell(f"peer {other} speaks here, the file expects {self.peer}: refused")

    def _count(self, reason: str) -> None:
        self.refused[reason] = self.refused.get(reason, 0) + 1

    def _tell(self, text: str) -> None:
        """Say something once."""
        if text not in self._told and len(self._told) < _MOST_TOLD:
            self._told.add(text)
            self.notes.append(text)

    def _subscriptions(self, kind: sbn.MsgType, msg_ids: Iterable[int]) -> bytes:
        return self._emit(kind, sbn.emit_subscriptions(sbn.Subscription(item) for item in msg_ids))

    def _emit(self, kind: sbn.MsgType, payload: bytes = b"") -> bytes:
        return sbn.emit(kind, self.own, payload)


def _is_legacy(data: bytes) -> bool:
    """Tell the older header: seven bytes, and a size that fits them and not eleven."""
    return len(data) >= _LEGACY.size and _LEGACY.unpack_from(data)[0] == len(data) - _LEGACY.size
