"""The Software Bus Network application (SBN over UDP) as stock cFS runs it: peers, subscriptions, time-outs.

Every peer is in one of two states; what moves it:

=============  =====================================================  =============
state          what happens                                           becomes
=============  =====================================================  =============
disconnected   any datagram of the peer but a DISCONNECT              connected
connected      DISCONNECT                                             disconnected
connected      nothing from the peer for ``sbn_timeout_s`` seconds    disconnected
=============  =====================================================  =============

Like Command Ingest, it receives into one buffer for good: a short datagram is read together with what the
last one left behind.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from edoras_tools.errors import TruncatedError
from edoras_tools.sessions import software_bus
from edoras_tools.sessions.events import Event, EventType
from edoras_tools.sessions.profile import SECOND
from edoras_tools.wire import ccsds, cfe, sbn

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.sessions.profile import SbnPeerConfig, SimProfile
    from edoras_tools.sessions.software_bus import Pipe, SoftwareBus

NAME: Final = "SBN"
COMMAND_MSG_ID: Final = 0x18FA
HOUSEKEEPING_MSG_ID: Final = 0x08FA
NOT_REPORTED: Final = frozenset({cfe.EVENT_MSG_ID, COMMAND_MSG_ID, HOUSEKEEPING_MSG_ID})
"""Subscriptions that no peer hears of: SBN's own, and events, which its filter holds back."""
_BUFFER_BYTES: Final = 65536


@dataclass(frozen=True, slots=True)
class Send:
    """A datagram for a peer."""

    peer: SbnPeerConfig
    data: bytes


@dataclass(slots=True)
class Actions:
    """What a call asks its caller to do, each list in order.

    Attributes:
        sends: datagrams to send.
        publish: packets for the software bus, from sender ``SBN``, not stamped.
        events: to report.
        failed: the receive task ends after this datagram; the next :meth:`SbnNode.service` starts it anew.
    """

    sends: list[Send] = field(default_factory=list)
    publish: list[bytes] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    failed: bool = False

    def say(self, event_id: int, text: str, event_type: EventType = EventType.INFORMATION) -> None:
        """Add an event."""
        self.events.append(Event(NAME, event_id, event_type, text))

    def fail(self, event_id: int, text: str, consequence: str) -> None:
        """Add an error and what follows from it; end the receive task."""
        self.say(event_id, text, EventType.ERROR)
        self.say(10, consequence, EventType.ERROR)
        self.failed = True


@dataclass(slots=True)
class PeerState:
    """A peer as this side sees it.

    Attributes:
        config: from the table.
        pipe: what waits to go to it; None while it is not connected.
        last_sent_ns: when something last went to it, or was announced.
        last_received_ns: when something last came from it.
    """

    config: SbnPeerConfig
    pipe: Pipe | None = None
    last_sent_ns: int = 0
    last_received_ns: int = 0

    @property
    def connected(self) -> bool:
        """Whether messages cross."""
        return self.pipe is not None


class SbnNode:
    """One SBN application with all of its peers.

    Attributes:
        peers: by (SpacecraftID, ProcessorID); nothing else tells them apart.
        receiving: whether the receive task runs.
    """

    def __init__(self, profile: SimProfile, bus: SoftwareBus, *, now: int) -> None:
        self.profile = profile
        self.bus = bus
        self.peers = {
            config.peer: PeerState(config, last_sent_ns=now, last_received_ns=now)
            for config in profile.sbn_peers
        }
        self.receiving = True
        self._reported = 0
        self._buffer = bytearray(_BUFFER_BYTES)

    def receive_datagram(self, data: bytes, *, now: int) -> Actions:
        """Take one datagram, any bytes."""
        actions = Actions()
        self._buffer[: len(data)] = data
        header = sbn.HEADER.parse(memoryview(self._buffer))
        if header["msg_size"] < 0:
            self._receive_failed(actions, "ERROR: could not unpack message")
            return actions
        identity = sbn.Peer(header["spacecraft_id"], header["processor_id"])
        state = self.peers.get(identity)
        if state is None:
            self._receive_failed(actions, f"ERROR: unknown peer {identity}")
            return actions
        state.last_received_ns = now
        if header["msg_type"] == sbn.MsgType.DISCONNECT:
            if state.connected:
                self._disconnect(state, actions)
            return actions
        if not state.connected:
            self._connect(state, actions, now)
        payload = memoryview(self._buffer)[sbn.HEADER.size :]
        self._message(state, header["msg_type"], payload, len(data) - sbn.HEADER.size, actions)
        self.receiving = not actions.failed
        return actions

    def _receive_failed(self, actions: Actions, text: str) -> None:
        consequence = "ERROR: during SBN Receive Net Task: RecvFromNet failed for net 0: status=0x00000001"
        actions.fail(259, text, consequence)
        self.receiving = False

    def _message(
        self, state: PeerState, msg_type: int, payload: memoryview, carried: int, actions: Actions
    ) -> None:
        failed = "SBN_ProcessNetMsg failed: 0x00000001"
        identity = state.config.peer
        if msg_type == sbn.MsgType.PROTO:
            version = payload[0]
            if version == sbn.PROTOCOL_VERSION:
                actions.say(1, f"SBN protocol version match with peer {identity}")
            else:
                text = f"SBN protocol version mismatch with peer {identity}"
                versions = f"my version={sbn.PROTOCOL_VERSION}, peer version {version}"
                whole_text = f"ERROR: could not process peer message: {text}, {versions}"
                actions.say(1, whole_text, EventType.ERROR)
        elif msg_type in {sbn.MsgType.SUB, sbn.MsgType.UNSUB}:
            try:
                ident, subscriptions = sbn.parse_subscriptions(payload)
            except TruncatedError:
                return  # 65,535 entries do not fit the buffer: flight code would read past it
            if ident != sbn.IDENT:
                text = f"version number mismatch with peer CpuID {identity.processor_id}"
                actions.fail(6, text, failed)
                return
            for item in subscriptions:
                self._subscription(state, msg_type, item.msg_id, actions)
        elif msg_type == sbn.MsgType.APP:
            if int.from_bytes(payload[:2], "big") > cfe.HIGHEST_MSG_ID:
                actions.fail(4097, "unable to set msgid", failed)
                return
            size = int.from_bytes(payload[4:6], "big") + ccsds.LENGTH_BIAS
            actions.publish.append(bytes(payload[: max(size, carried, cfe.COMMAND_HEADER_BYTES)]))
        elif msg_type not in {sbn.MsgType.NO_MSG, sbn.MsgType.HEARTBEAT, sbn.MsgType.ANNOUNCE}:
            text = f"ERROR: could not process peer message: unknown message type 0x{msg_type:08x}"
            actions.fail(10, text, failed)

    def _subscription(self, state: PeerState, msg_type: int, wanted: int, actions: Actions) -> None:
        pipe = state.pipe
        assert pipe is not None
        if msg_type == sbn.MsgType.SUB:
            if 0 < wanted <= cfe.HIGHEST_MSG_ID and wanted not in pipe.limits:
                self.bus.subscribe(pipe, wanted, self.profile.sbn_msg_limit, local=True)
        elif not self.bus.unsubscribe(pipe, wanted):
            processor = state.config.peer.processor_id
            text = f"cannot process unsubscription from ProcessorID {processor}, msg 0x{wanted:04X} not found"
            actions.say(8, text)

    def _connect(self, state: PeerState, actions: Actions, now: int) -> None:
        identity = state.config.peer
        name = f"SBN_{identity.processor_id}_{identity.spacecraft_id}_Pipe"
        state.pipe = self.bus.create_pipe(name, self.profile.sbn_pipe_depth, ignores=NAME)
        actions.say(259, f"connecting to peer {identity}")
        actions.say(5, f"Created peer pipe '{name}'")
        actions.say(5, f"Peer {identity} connected.")
        self._send(state, sbn.MsgType.PROTO, sbn.emit_proto(), actions, now)
        known = (sbn.Subscription(item) for item in self._reportable(0))
        self._send(state, sbn.MsgType.SUB, sbn.emit_subscriptions(known), actions, now)

    def _disconnect(self, state: PeerState, actions: Actions) -> None:
        assert state.pipe is not None
        self.bus.delete_pipe(state.pipe)
        state.pipe = None
        actions.say(5, f"Disconnected from peer {state.config.peer}.")

    def _send(
        self, state: PeerState, msg_type: sbn.MsgType, payload: bytes, actions: Actions, now: int
    ) -> None:
        actions.sends.append(Send(state.config, sbn.emit(msg_type, self.profile.peer, payload)))
        state.last_sent_ns = now

    def _reportable(self, start: int) -> Iterator[int]:
        return (item for item in self.bus.subscribed[start:] if item not in NOT_REPORTED)

    def service(self, *, now: int) -> Actions:
        """Do one round of the main loop, due every ``sbn_wake_ns``: subscriptions, peer pipes, time-outs."""
        actions = Actions()
        if not self.receiving:
            self.receiving = True
            actions.say(5, "Creating recv task for net 0")
        for wanted in list(self._reportable(self._reported)):
            # To every peer of the table, connected or not, one MsgId a datagram.
            payload = sbn.emit_subscriptions([sbn.Subscription(wanted)])
            for state in self.peers.values():
                self._send(state, sbn.MsgType.SUB, payload, actions, now)
        self._reported = len(self.bus.subscribed)
        for state in self.peers.values():
            self._serve(state, actions, now)
        return actions

    def _serve(self, state: PeerState, actions: Actions, now: int) -> None:
        identity = state.config.peer
        unsent_s = (now - state.last_sent_ns) // SECOND
        if state.pipe is None:
            if unsent_s >= self.profile.sbn_announce_s and self._announces_to(identity):
                self._send(state, sbn.MsgType.ANNOUNCE, b"", actions, now)
            return
        while (packet := state.pipe.get()) is not None:
            data = software_bus.whole(packet)
            if len(data) <= sbn.LARGEST_PAYLOAD:
                self._send(state, sbn.MsgType.APP, data, actions, now)
        if (now - state.last_received_ns) // SECOND >= self.profile.sbn_timeout_s:
            actions.say(259, f"disconnected peer {identity}")
            self._disconnect(state, actions)
        elif (now - state.last_sent_ns) // SECOND >= self.profile.sbn_heartbeat_s:
            self._send(state, sbn.MsgType.HEARTBEAT, b"", actions, now)

    def _announces_to(self, peer: sbn.Peer) -> bool:
        """Stock SBN announces only where both numbers differ, so never between peers of one spacecraft."""
        own = self.profile.peer
        return peer.spacecraft_id != own.spacecraft_id and peer.processor_id != own.processor_id
