"""The two kinds of bridges towards cFS: what each sends, and when it may send messages.

A ground bridge sends commands to Command Ingest, and asks Telemetry Output for telemetry. A flight bridge has
an SBN connection, and lines about it for people.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.cfs import telemetry_output
from edoras_tools.sessions.sbn import (
    BRIDGE,
    AppMessage,
    Connected,
    Disconnected,
    NotTaken,
    Refusal,
    SbnConnection,
    Subscriptions,
    Trigger,
    UnknownType,
    Version,
)
from edoras_tools.units import SECOND
from edoras_tools.wire import sbn
from edoras_tools.wire.cfe import STANDARD, Headers

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from edoras_tools.model import Peer
    from edoras_tools.sessions.bridge.packets import PacketWriter
    from edoras_tools.sessions.sbn import ConnectionEvent

ASK_NS: Final = 2 * SECOND
SILENCE_NS: Final = 10 * SECOND
STEP_NS: Final = SECOND
"""Twice the time between Command Ingest's wake-ups."""
_ASKS: Final = 5
_AT_ONCE: Final = 4
"""Most commands of one MsgId that can wait in Telemetry Output's pipe."""
_ADD: Final = struct.Struct("<IBBBx")
"""MsgId, priority, reliability, message limit."""


class GroundSession:
    """CI and TO of one cFS.

    Args:
        address: IPv4 address that Telemetry Output shall send to; None: send it no commands.
        add: message limit of each MsgId to add to its table.
        now: present time, ns.

    Attributes:
        ready: whether commands may be sent: always True.
        next_ns: time at which ``service`` is due; None for never.
        hearing: whether telemetry arrives.
        asked: number of times that Telemetry Output was asked.
        notes: lines for people; the reader empties the list.
        refused: number of refused datagrams, by reason: always empty, because any sender may be TO.
    """

    def __init__(
        self, writer: PacketWriter, address: str | None, add: Mapping[int, int] | None = None, *, now: int
    ) -> None:
        self.ready = True
        self.hearing = False
        self.asked = 0
        self.notes: list[str] = []
        self.refused: dict[str, int] = {}
        self.next_ns: int | None = None if address is None else now
        self._writer, self._address, self._add = writer, address, dict(add or {})
        self._heard_ns = now
        self._told = False
        self._again_ns = now
        self._bursts: list[list[bytes]] = []

    def receive_datagram(self, data: bytes, *, now: int) -> tuple[int, list[bytes]]:
        """Take a datagram; return the start of its space packet, and no answers."""
        self._heard_ns = now
        if not self.hearing:
            self.hearing, self._told = True, False
            self.notes.append("telemetry arrives")
            if self.next_ns is not None and not self._bursts:
                self.next_ns = now + SILENCE_NS
        return 0, []

    def service(self, *, now: int) -> list[bytes]:
        """Command Telemetry Output to send, if no telemetry arrives."""
        if self.next_ns is None or now < self.next_ns:
            return []
        if not self._bursts:
            silent_ns = now - self._heard_ns
            if self.hearing and silent_ns < SILENCE_NS:
                self.next_ns = self._heard_ns + SILENCE_NS
                return []
            if silent_ns >= SILENCE_NS and not self._told:
                self._told = True
                self.notes.append(
                    f"no telemetry for {silent_ns // SECOND} s: is cFS running, does its TO send here? "
                    f"asking again"
                )
            self.hearing = False
            self.asked += 1
            self._again_ns = now + (ASK_NS if self.asked <= _ASKS else SILENCE_NS)
            self._bursts = self._ask()
        burst = self._bursts.pop(0)
        if self._bursts:
            self.next_ns = now + STEP_NS
        else:
            self.next_ns = self._heard_ns + SILENCE_NS if self.hearing else max(self._again_ns, now + STEP_NS)
        return burst

    def frame(self, packet: bytes) -> bytes:
        """Return the datagram of a packet: itself."""
        return packet

    def sent(self, *, now: int) -> None:
        """Do nothing: Command Ingest expects no heartbeat."""

    def goodbye(self) -> list[bytes]:
        """Return nothing: Telemetry Output has no command that disables it."""
        return []

    def summary(self) -> dict[str, Any]:
        """Return the session's part of ``bridge --json``."""
        return {"connected": self.hearing, "asked": self.asked}

    def _ask(self) -> list[list[bytes]]:
        assert self._address is not None
        write = self._writer.write
        command = self._writer.of_known(telemetry_output.COMMAND_MSG_ID)
        bursts = [[write(command, self._address.encode("ascii").ljust(16, b"\0"), telemetry_output.ENABLE)]]
        for msg_id, limit in self._add.items():
            if len(bursts[-1]) > _AT_ONCE - 2:
                bursts.append([])
            # TO keeps the old limit of a MsgId that is added twice: it is removed first.
            bursts[-1] += [
                write(command, _ADD.pack(msg_id, 0, 0, 0)[:4], telemetry_output.REMOVE_PACKET),
                write(command, _ADD.pack(msg_id, 0, 0, limit), telemetry_output.ADD_PACKET),
            ]
        return bursts


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
            if isinstance(event, AppMessage):
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
            case Connected():
                self.connections += 1
                self.notes.append(f"connected to peer {peer}")
            case Disconnected(Trigger.DISCONNECT):
                self.losses["disconnect"] += 1
                self.notes.append(f"peer {peer} disconnected; asking again")
            case Disconnected():
                self.losses["timeout"] += 1
                seconds = (BRIDGE.timeout_ns or 0) // SECOND
                self.notes.append(f"nothing from peer {peer} for {seconds} s: connection lost; asking again")
            case Version(version) if version not in {None, sbn.PROTOCOL_VERSION}:
                self._tell(
                    f"peer {peer} speaks SBN protocol {version}, this side {sbn.PROTOCOL_VERSION}: it may "
                    f"refuse messages; continuing"
                )
            case Subscriptions(ident=ident):
                self._unwanted -= self.connection.subscribed
                if ident != sbn.IDENT:
                    self._tell(
                        f"peer {peer} is another SBN ({ident or 'no $Id'}): it will refuse our subscriptions"
                    )
            case UnknownType(msg_type):
                self._count(f"unknown SBN message type 0x{msg_type:02x}")
            case NotTaken(Refusal.OTHER_PEER, other):
                self._count(f"peer {other}" if len(self.refused) < _MOST_PEERS else "further peers")
                self._tell(f"peer {other} sends here, but the file expects {peer}: refused")
            case NotTaken(reason):
                self._count(reason.value)
                if reason is Refusal.OLD_HEADER:
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
