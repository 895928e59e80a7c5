"""The other end of an SBN link: who wants to send to cFS as one of its peers.

``SbnClient`` behaves as a stock SBN does: it introduces itself, answers, keeps heartbeats going and says
goodbye. ``BridgeClient`` is the public flight bridge, bugs included.

=============  ================================================  =============
state          what happens                                      becomes
=============  ================================================  =============
asking         any datagram of the peer but a DISCONNECT         connected
connected      DISCONNECT                                        asking
connected      nothing from the peer for ``TIMEOUT_S`` seconds   asking
=============  ================================================  =============
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Protocol

from edoras_tools.errors import TruncatedError
from edoras_tools.sessions.flight_bridge import POLL_NS, FlightBridge
from edoras_tools.sessions.profile import SECOND, SimProfile
from edoras_tools.wire import sbn

if TYPE_CHECKING:
    from collections.abc import Sequence

_STOCK: Final = SimProfile()
HEARTBEAT_S: Final = _STOCK.sbn_heartbeat_s
TIMEOUT_S: Final = _STOCK.sbn_timeout_s
ASK_NS: Final = SECOND
"""How often it introduces itself until somebody answers."""


class Peering(Protocol):
    """A session with cFS as its peer; time is an argument, in ns."""

    peer: sbn.Peer
    """As it calls itself."""
    answered: sbn.Peer | None
    """Who answered; None while nobody has."""
    subscribed: set[int]
    """What the other side wants to have."""

    @property
    def next_ns(self) -> int:
        """When ``service`` is due."""
        ...

    @property
    def connected(self) -> bool:
        """Whether messages cross."""
        ...

    def receive_datagram(self, data: bytes, *, now: int) -> list[bytes]:
        """Take a datagram, any bytes; return what to answer."""
        ...

    def service(self, *, now: int) -> list[bytes]:
        """Return what is due."""
        ...

    def sent(self, *, now: int) -> None:
        """Take note that something was sent."""
        ...

    def goodbye(self) -> list[bytes]:
        """Return what to send at the end."""
        ...


class Listener:
    """What any peer learns by listening: who answers, and what it wants to have.

    Attributes:
        answered: who answered.
        subscribed: MsgIds that it wants to have.
        last_ns: when it was heard last.
    """

    def __init__(self, *, now: int) -> None:
        self.answered: sbn.Peer | None = None
        self.subscribed: set[int] = set()
        self.last_ns = now

    def hear(self, data: bytes, *, now: int) -> int | None:
        """Take a datagram; return its MsgType, None where it is no SBN datagram."""
        try:
            header = sbn.HEADER.parse(data)
        except TruncatedError:
            return None
        self.last_ns = now
        self.answered = sbn.Peer(header["spacecraft_id"], header["processor_id"])
        kind: int = header["msg_type"]
        if kind in {sbn.MsgType.SUB, sbn.MsgType.UNSUB}:
            try:
                _, entries = sbn.parse_subscriptions(memoryview(data)[sbn.HEADER.size :])
            except TruncatedError:
                return kind
            wanted = {item.msg_id for item in entries}
            self.subscribed = (
                self.subscribed | wanted if kind == sbn.MsgType.SUB else self.subscribed - wanted
            )
        return kind

    def forget(self) -> None:
        """Begin anew: the peer is gone."""
        self.answered = None
        self.subscribed = set()


class SbnClient(Listener):
    """A stock peer.

    Args:
        peer: as it calls itself.
        msg_ids: what it wants to have of cFS.
        now: ns.

    Attributes:
        losses: times that a connection was lost.
    """

    def __init__(self, peer: sbn.Peer, msg_ids: Sequence[int] = (), *, now: int) -> None:
        super().__init__(now=now)
        self.peer = peer
        self.losses = 0
        self._ask_ns = self._sent_ns = now
        wanted = sbn.emit_subscriptions(sbn.Subscription(item) for item in msg_ids)
        self._hello = [
            sbn.emit(sbn.MsgType.PROTO, peer, sbn.emit_proto()),
            sbn.emit(sbn.MsgType.SUB, peer, wanted),
        ]

    @property
    def connected(self) -> bool:
        """Whether messages cross."""
        return self.answered is not None

    @property
    def next_ns(self) -> int:
        """When ``service`` is due."""
        if self.answered is None:
            return self._ask_ns
        return min(self._sent_ns + HEARTBEAT_S * SECOND, self.last_ns + TIMEOUT_S * SECOND)

    def receive_datagram(self, data: bytes, *, now: int) -> list[bytes]:
        """Take a datagram, any bytes; greet whoever answers for the first time."""
        new = self.answered is None
        kind = self.hear(data, now=now)
        if kind is None:
            return []
        if kind == sbn.MsgType.DISCONNECT:
            self._lose(now)
            return []
        return self._send(self._hello, now) if new else []

    def service(self, *, now: int) -> list[bytes]:
        """Ask, keep the connection alive, or notice that it is gone."""
        if self.answered is None:
            if now < self._ask_ns:
                return []
            self._ask_ns = now + ASK_NS
            return self._send(self._hello, now)
        if now - self.last_ns >= TIMEOUT_S * SECOND:
            self._lose(now)
            return []
        if now - self._sent_ns >= HEARTBEAT_S * SECOND:
            return self._send([sbn.emit(sbn.MsgType.HEARTBEAT, self.peer)], now)
        return []

    def sent(self, *, now: int) -> None:
        """Take note that something was sent: no heartbeat is needed for a while."""
        self._sent_ns = now

    def goodbye(self) -> list[bytes]:
        """Return the DISCONNECT that lets cFS close the pipe at once."""
        return [sbn.emit(sbn.MsgType.DISCONNECT, self.peer)] if self.connected else []

    def _lose(self, now: int) -> None:
        self.losses += self.answered is not None
        self.forget()
        self._ask_ns = now

    def _send(self, datagrams: Sequence[bytes], now: int) -> list[bytes]:
        self._sent_ns = now
        return list(datagrams)


class BridgeClient(Listener):
    """The public flight bridge as a session: it subscribes without end and answers everything with a PROTO.

    Args:
        peer: as it calls itself.
        msg_ids: what it wants to have of cFS.
        now: ns.
    """

    def __init__(self, peer: sbn.Peer, msg_ids: Sequence[int] = (), *, now: int) -> None:
        super().__init__(now=now)
        self.peer = peer
        self.next_ns = now
        self._bridge = FlightBridge(msg_ids, now=now, peer=peer)

    @property
    def connected(self) -> bool:
        """Whether somebody answered; the bridge itself does not care."""
        return self.answered is not None

    def receive_datagram(self, data: bytes, *, now: int) -> list[bytes]:
        """Take a datagram; the next poll answers it."""
        self.hear(data, now=now)
        self._bridge.receive_datagram(data)
        return []

    def service(self, *, now: int) -> list[bytes]:
        """Poll."""
        self.next_ns = max(self.next_ns + POLL_NS, now)
        return self._bridge.poll(now=now).sends

    def sent(self, *, now: int) -> None:
        """Take no note: the bridge keeps no time."""

    def goodbye(self) -> list[bytes]:
        """Say nothing: the bridge does not either."""
        return []
