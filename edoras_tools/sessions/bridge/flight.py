"""A flight bridge towards cFS: its SBN connection, and lines about it for people."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from edoras_tools.sessions.sbn import events
from edoras_tools.sessions.sbn.connection import SbnConnection
from edoras_tools.sessions.sbn.habits import BRIDGE
from edoras_tools.units import SECOND
from edoras_tools.wire import sbn
from edoras_tools.wire.cfe import STANDARD, Headers

if TYPE_CHECKING:
    from collections.abc import Iterable

    from edoras_tools.model import Peer
    from edoras_tools.sessions.sbn.events import ConnectionEvent

_NO_PACKET: Final = -1
_MOST_TOLD: Final = 64
_MOST_PEERS: Final = 16
_SUBSCRIBED_WITHIN_NS: Final = 2 * SECOND
"""Time within which cFS has sent its subscriptions."""


class FlightSession:
    """One connection to cFS's Software Bus Network.

    Args:
        own: identity of this side.
        peer: identity of cFS; all others are refused.
        msg_ids: MsgIds that this side subscribes to.
        now: present time, ns.
        headers: headers of the cFE at the other end.

    Attributes:
        connection: the SBN connection.
        connections: number of times a connection was made.
        losses: number of times one was lost: by ``disconnect``, by ``timeout``.
        refused: number of refused datagrams, by reason.
        notes: lines for people; the reader empties the list.
    """

    def __init__(
        self, own: Peer, peer: Peer, msg_ids: Iterable[int] = (), *, now: int, headers: Headers = STANDARD
    ) -> None:
        self.connection = SbnConnection(own, msg_ids, habits=BRIDGE, peer=peer, now=now)
        self.connections = 0
        self.losses = {"disconnect": 0, "timeout": 0}
        self.refused: dict[str, int] = {}
        self.notes: list[str] = []
        self._peer, self._headers = peer, headers
        self._told: set[str] = set()
        self._unwanted: set[int] = set()

    @property
    def ready(self) -> bool:
        """Whether messages may be sent."""
        return self.connection.connected

    @property
    def next_ns(self) -> int:
        """Time at which ``service`` is due, ns."""
        return self.connection.next_ns

    def receive_datagram(self, data: bytes, *, now: int) -> tuple[int, list[bytes]]:
        """Take a datagram, any bytes.

        Returns:
            The start of its space packet, -1 if there is none, and the datagrams that answer it.
        """
        if self.connection.receive_message(data, now=now):
            return sbn.HEADER.size, []
        step = self.connection.receive_datagram(data, now=now)
        at = _NO_PACKET
        for event in step.events:
            if isinstance(event, events.AppMessage):
                at = sbn.HEADER.size
            else:
                self._note(event)
        return at, list(step.datagrams)

    def service(self, *, now: int) -> list[bytes]:
        """Request a connection, keep it alive, or detect that it is lost."""
        step = self.connection.service(now=now)
        for event in step.events:
            self._note(event)
        return list(step.datagrams)

    def want(self, msg_ids: Iterable[int], *, now: int) -> list[bytes]:
        """Change the subscriptions of this side; return the datagrams for it: a SUB, an UNSUB, or none."""
        return self.connection.want(msg_ids, now=now)

    def frame(self, packet: bytes) -> bytes:
        """Return the datagram of a packet, which has at most 32,767 bytes."""
        msg_id = self._headers.msg_ids.of(packet)
        if msg_id not in self.connection.subscribed:
            self._unwanted.add(msg_id)
        return self.connection.frame(packet)

    def sent(self, *, now: int) -> None:
        """Note that messages were sent: the next heartbeat is later."""
        self.connection.sent(now=now)
        if self._unwanted and now - self.connection.subscribed_ns >= _SUBSCRIBED_WITHIN_NS:
            for msg_id in sorted(self._unwanted):
                self._tell(
                    f"cFS has not subscribed to 0x{msg_id:04X}: no application there receives it; is the "
                    f"MsgId the same on both sides?"
                )
            self._unwanted.clear()

    def goodbye(self) -> list[bytes]:
        """Return the UNSUB and the DISCONNECT that let cFS close the pipe at once."""
        return self.connection.goodbye()

    def summary(self) -> dict[str, Any]:
        """Return the session's part of ``bridge --json``."""
        return {
            "peer": str(self._peer),
            "connected": self.ready,
            "connections": self.connections,
            "losses": dict(self.losses),
        }

    def _note(self, event: ConnectionEvent) -> None:
        """Count an event, and add a line for people if it needs one."""
        peer = self._peer
        match event:
            case events.Connected():
                self.connections += 1
                self.notes.append(f"connected to peer {peer}")
            case events.Disconnected(events.Trigger.DISCONNECT):
                self.losses["disconnect"] += 1
                self.notes.append(f"peer {peer} disconnected; asking again")
            case events.Disconnected():
                self.losses["timeout"] += 1
                seconds = (BRIDGE.timeout_ns or 0) // SECOND
                self.notes.append(f"nothing from peer {peer} for {seconds} s: connection lost; asking again")
            case events.Version(version) if version not in {None, sbn.PROTOCOL_VERSION}:
                self._tell(
                    f"peer {peer} speaks SBN protocol {version}, this side {sbn.PROTOCOL_VERSION}: it may "
                    f"refuse messages; continuing"
                )
            case events.Subscriptions(ident=ident):
                self._unwanted -= self.connection.subscribed
                if ident != sbn.IDENT:
                    self._tell(
                        f"peer {peer} is another SBN ({ident or 'no $Id'}): it will refuse our subscriptions"
                    )
            case events.UnknownType(msg_type):
                self._count(f"unknown SBN message type 0x{msg_type:02x}")
            case events.NotTaken(events.Refusal.OTHER_PEER, other):
                self._count(f"peer {other}" if len(self.refused) < _MOST_PEERS else "further peers")
                self._tell(f"peer {other} sends here, but the file expects {peer}: refused")
            case events.NotTaken(reason):
                self._count(reason.value)
                if reason is events.Refusal.OLD_HEADER:
                    self._tell(
                        "an older SBN with a header of 7 bytes instead of 11 sends here: not supported"
                    )

    def _count(self, reason: str) -> None:
        self.refused[reason] = self.refused.get(reason, 0) + 1

    def _tell(self, text: str) -> None:
        """Add a line once."""
        if text not in self._told and len(self._told) < _MOST_TOLD:
            self._told.add(text)
            self.notes.append(text)
