"""The applications with sockets: Command Ingest (CI_LAB), Telemetry Output (TO_LAB), and SBN over UDP.

CI processes the datagrams that wait in its socket. One receive buffer is used for all datagrams. A datagram
shorter than the previous one leaves the end of that one in the buffer, and a packet whose length field is
larger than its datagram includes it. The flight code does the same, and so does SBN.

TO decides which messages go to the ground, and to which address. SBN has peers, their pipes and events like
stock cFS; each peer is an ``SbnConnection`` that behaves like stock SBN.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from ipaddress import AddressValueError, IPv4Address
from typing import TYPE_CHECKING, Final

import msgspec
from msgspec.structs import replace

from edoras_tools.addons.lab.emulator import messages
from edoras_tools.addons.lab.emulator.account import Fifo, socket
from edoras_tools.addons.lab.emulator.messages import bus_id, command_length, from_link, to_link, whole_packet
from edoras_tools.addons.lab.emulator.scheduler import Receive, Sleep, Work
from edoras_tools.cfs import command_ingest, software_bus, table_services, telemetry_output
from edoras_tools.cfs import sbn as facts
from edoras_tools.cfs.profile import SbnPeerConfig
from edoras_tools.cfs.queues import NO_LIMIT, QueueEnd
from edoras_tools.model import Endpoint, Peer
from edoras_tools.sessions.sbn import (
    STOCK,
    AppMessage,
    Connected,
    Disconnected,
    SbnConnection,
    Step,
    Subscriptions,
    Trigger,
    UnknownType,
    Version,
)
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe, sbn
from edoras_tools.wire.cfe import function_code_of, length_of, msg_id_of

if TYPE_CHECKING:
    from edoras_tools.addons.lab.emulator.cfs import Cfs
    from edoras_tools.addons.lab.emulator.scheduler import Task
    from edoras_tools.addons.lab.emulator.services.software_bus import Pipe
    from edoras_tools.cfs.event_services import EventText
    from edoras_tools.sessions.sbn import ConnectionEvent as SbnEvent


class CommandIngest:
    """Command Ingest on an emulated cFS: its task reads the socket after each message and each time-out.

    Attributes:
        ingest_packets: datagrams handed to the software bus.
        ingest_errors: datagrams too short to be a command.
        commands: accepted commands to CI itself.
        command_errors: refused commands to CI itself.
        queue: datagrams that wait in the socket.
        socket_drops: datagrams that found the socket's queue full.
    """

    def __init__(self, cfs: Cfs) -> None:
        profile = cfs.profile
        self.ingest_packets = 0
        self.ingest_errors = 0
        self.commands = 0
        self.command_errors = 0
        self.socket_drops = 0
        self.queue: Fifo[bytes] = cfs.account.watch(Fifo(profile.socket_queue), socket(profile.ci_port))
        self._cfs = cfs
        self._buffer = bytearray(profile.ci_buffer)
        self._pipe = cfs.create_pipe(
            command_ingest.PIPE, command_ingest.COMMAND_MSG_ID, command_ingest.REQUEST_MSG_ID
        )
        cfs.events.register(command_ingest.NAME, now=cfs.scheduler.now)
        cfs.say(command_ingest.INITIALIZED, version="Emulated")
        cfs.listen(profile.ci_port, self.receive_datagram)
        cfs.spawn(self._run())

    def receive_datagram(self, data: bytes) -> bool:
        """Put a datagram in the socket's queue until a wake-up reads it; return whether it fits."""
        has_room = self.queue.put(data) is QueueEnd.WAITING
        self.socket_drops += not has_room
        return has_room

    def read(self) -> bool:
        """Read one datagram and publish its packet, or report why not; return whether there was one."""
        data = self.queue.get()
        if data is None:
            return False
        cfs, profile = self._cfs, self._cfs.profile
        data = data[: profile.ci_buffer]
        self._buffer[: len(data)] = data
        if len(data) >= profile.headers.command_bytes:
            self.ingest_packets += 1
            length = max(len(data), length_of(data))
            packet = from_link(bytes(self._buffer[:length]), profile)
            status = cfs.publish(packet, command_ingest.NAME, stamp=False).status
            if status != software_bus.SUCCESS:
                cfs.say(command_ingest.NOT_SENT, line=359, status=status)
        elif data:
            self.ingest_errors += 1
            word, second = self._buffer[0] << 8 | self._buffer[1], self._buffer[2] << 8 | self._buffer[3]
            # The event contains the first word unchanged.
            msg_id = bus_id(word, profile)
            cfs.say(command_ingest.TOO_SHORT, line=369, msg_id=msg_id, second=second, length=len(data))
        return True

    def command(self, packet: bytes) -> None:
        """Process a command to CI itself."""
        cfs = self._cfs
        function_code, size = function_code_of(packet), length_of(packet)
        if function_code > 1:
            return  # the flight code neither counts nor reports it
        if size != cfe.COMMAND_HEADER_BYTES:
            self.command_errors += 1
            cfs.say(
                command_ingest.BAD_LENGTH,
                msg_id=command_ingest.COMMAND_MSG_ID,
                code=function_code,
                length=command_length(size, cfs.profile),
                expected=cfs.profile.headers.command_bytes,
            )
        elif function_code == 0:
            self.commands += 1
            cfs.say(command_ingest.NOOP)
        else:
            self.commands = self.command_errors = self.ingest_packets = self.ingest_errors = 0
            cfs.say(command_ingest.RESET)

    def housekeeping(self) -> bytes:
        """Return the payload of housekeeping packet 0x884, 24 bytes, little-endian."""
        return cfe.COMMAND_INGEST_HOUSEKEEPING.emit(
            {
                "command_error_counter": self.command_errors & 0xFF,
                "command_counter": self.commands & 0xFF,
                "socket_connected": 1,
                "ingest_packets": self.ingest_packets & 0xFFFFFFFF,
                "ingest_errors": self.ingest_errors & 0xFFFFFFFF,
            }
        )

    def _run(self) -> Task:
        cfs, profile = self._cfs, self._cfs.profile
        while cfs.executive.run_loop(command_ingest.NAME):
            packet = yield Receive(self._pipe, profile.ci_wake_ns)
            if packet is not None:
                yield Work(profile.work_ns)
                self._message(packet)
            for _ in range(profile.ci_datagrams_per_wake):
                if not self.read():
                    break
                yield Work(profile.ci_read_ns)

    def _message(self, packet: bytes) -> None:
        if msg_id_of(packet) == command_ingest.REQUEST_MSG_ID:
            self._cfs.telemetry(command_ingest.HOUSEKEEPING_MSG_ID, self.housekeeping(), command_ingest.NAME)
        else:
            self.command(packet)


class TelemetryOutput:
    """Telemetry Output on an emulated cFS.

    Args:
        cfs: the cFS that it runs on.
        telemetry: MsgIds that go to the ground besides those of the table, which may have their limits.

    Attributes:
        pipe: packets that wait for the next round.
        destination: IPv4 address that telemetry goes to; None before the first enable.
        commands: accepted commands.
        command_errors: refused commands.
    """

    def __init__(self, cfs: Cfs, telemetry: Iterable[int] = ()) -> None:
        profile = cfs.profile
        self.pipe = cfs.bus.create_pipe(telemetry_output.PIPE, profile.to_pipe_depth)
        self.destination: str | None = None
        self.commands = 0
        self.command_errors = 0
        self._cfs = cfs
        cfs.executive.owns(pipe=telemetry_output.PIPE)
        cfs.open_telemetry_socket()
        cfs.events.register(telemetry_output.NAME, now=cfs.scheduler.now)
        self._command_pipe = cfs.create_pipe(
            telemetry_output.COMMAND_PIPE, telemetry_output.COMMAND_MSG_ID, telemetry_output.REQUEST_MSG_ID
        )
        limits = dict.fromkeys(telemetry, profile.to_default_limit) | dict(profile.to_limits)
        for msg_id, limit in limits.items():
            cfs.bus.subscribe(self.pipe, msg_id, limit)
        cfs.say(telemetry_output.INITIALIZED, version="Emulated")
        cfs.spawn(self._run())

    def forward(self) -> bool:
        """Send one packet of the pipe to the ground, once output is enabled; return whether there was one."""
        packet = self.pipe.get()
        if packet is not None and self.destination is not None:
            cfs = self._cfs
            ground = Endpoint(self.destination, cfs.profile.to_port)
            cfs.send(cfs.to_endpoint, ground, to_link(whole_packet(packet), cfs.profile))
        return packet is not None

    def command(self, packet: bytes) -> None:
        """Process a command. Like the flight code, it trusts the payload's length."""
        cfs = self._cfs
        function_code = function_code_of(packet)
        payload = packet[cfe.COMMAND_HEADER_BYTES :].ljust(16, b"\0")
        if function_code > telemetry_output.ENABLE:
            self.command_errors += 1
            cfs.say(telemetry_output.BAD_FUNCTION_CODE, line=344, code=function_code)
            return
        self.commands += 1
        if function_code == telemetry_output.RESET:
            self.commands = self.command_errors = 0
        elif function_code == telemetry_output.ADD_PACKET:
            self._add(payload)
        elif function_code == telemetry_output.REMOVE_PACKET:
            self._remove(self._msg_id(payload))
        elif function_code == telemetry_output.REMOVE_ALL:
            for msg_id in list(self.pipe.limits):
                cfs.bus.unsubscribe(self.pipe, msg_id)
            cfs.say(telemetry_output.ALL_REMOVED, line=527)
        elif function_code == telemetry_output.SEND_DATA_TYPES:
            cfs.telemetry(telemetry_output.DATA_TYPES_MSG_ID, bytes(64), telemetry_output.NAME)
        elif function_code == telemetry_output.ENABLE:
            self._enable(payload[:16].split(b"\0")[0].decode("ascii", "replace"))
        else:
            cfs.say(telemetry_output.NOTHING_DONE)

    def housekeeping(self) -> bytes:
        """Return the payload of housekeeping packet 0x880, 4 bytes."""
        return bytes([self.commands & 0xFF, self.command_errors & 0xFF, 0, 0])

    def _run(self) -> Task:
        """Wait for a time, send everything in the pipe, read the commands, and again."""
        cfs, profile = self._cfs, self._cfs.profile
        while cfs.executive.run_loop(telemetry_output.NAME):
            yield Sleep(profile.to_wake_ns)
            while self.forward():
                yield Work(profile.work_ns)
            while (packet := self._command_pipe.get()) is not None:
                if msg_id_of(packet) == telemetry_output.REQUEST_MSG_ID:
                    cfs.telemetry(
                        telemetry_output.HOUSEKEEPING_MSG_ID, self.housekeeping(), telemetry_output.NAME
                    )
                else:
                    self.command(packet)
                yield Work(profile.work_ns)

    def _enable(self, text: str) -> None:
        try:
            self.destination = str(IPv4Address(text))
        except AddressValueError:
            # An address that cannot be read becomes 0.0.0.0, which the host takes for itself.
            self.destination = self._cfs.profile.address
        self._cfs.say(telemetry_output.ENABLED, address=text)

    def _add(self, payload: bytes) -> None:
        cfs = self._cfs
        msg_id, limit = self._msg_id(payload), payload[6] or cfs.profile.to_default_limit
        if not 0 < msg_id <= cfe.HIGHEST_MSG_ID:
            cfs.say(telemetry_output.NOT_ADDED, line=470, msg_id=msg_id, status=software_bus.BAD_ARGUMENT)
            return
        if msg_id in self.pipe.limits:
            self._bus_says(software_bus.DUPLICATE_SUBSCRIPTION, msg_id)
        cfs.bus.subscribe(self.pipe, msg_id, limit)
        priority, reliability = payload[4], payload[5]
        cfs.say(
            telemetry_output.ADDED,
            line=473,
            msg_id=msg_id,
            priority=priority,
            reliability=reliability,
            limit=limit,
        )

    def _remove(self, msg_id: int) -> None:
        cfs = self._cfs
        if not 0 < msg_id <= cfe.HIGHEST_MSG_ID:
            cfs.say(telemetry_output.NOT_REMOVED, line=494, msg_id=msg_id, status=software_bus.BAD_ARGUMENT)
            return
        if not cfs.bus.unsubscribe(self.pipe, msg_id):
            # cFE returns success, and TO relies on it.
            self._bus_says(software_bus.NOTHING_TO_UNSUBSCRIBE, msg_id)
        cfs.say(telemetry_output.REMOVED, line=497, msg_id=msg_id)

    def _msg_id(self, payload: bytes) -> int:
        return bus_id(int.from_bytes(payload[:4], "little"), self._cfs.profile)

    def _bus_says(self, event: EventText, msg_id: int) -> None:
        self._cfs.say(event, msg_id=msg_id, pipe=self.pipe.name, app=telemetry_output.NAME)


NOT_REPORTED: Final = frozenset({cfe.EVENT_MSG_ID, facts.COMMAND_MSG_ID, facts.HOUSEKEEPING_MSG_ID})
"""Subscriptions that are not sent to peers: SBN's own, and events, which its filter blocks."""
_BUFFER_BYTES: Final = 65536
_HEARTBEATS: Final = 4
"""Heartbeats that the TCP module sends at each wake-up while nothing else is sent."""


class PeerState(msgspec.Struct):
    """A peer as this side sees it.

    Attributes:
        config: entry of the table.
        connection: SBN connection.
        pipe: packets that wait for it; None while it is not connected.
    """

    config: SbnPeerConfig
    connection: SbnConnection
    pipe: Pipe | None = None

    @property
    def connected(self) -> bool:
        """Whether messages are exchanged."""
        return self.connection.connected


class StreamConnection(SbnConnection):
    """A connection over TCP: without announcements, ended by the stream only, several heartbeats at once."""

    _has_greeted = False

    def introduce(self, *, now: int) -> list[bytes]:
        """Return the first messages of the side that connected; the other side answers with the same."""
        self._has_greeted = False
        first = self._greet(now)
        self._has_greeted = True
        return first

    def service(self, *, now: int) -> Step:
        """Send what is due: heartbeats, which do not count as sending, so that every wake-up sends them."""
        sent_ns = self._sent_ns
        step = super().service(now=now)
        self._sent_ns = sent_ns
        return Step(step.events, list(step.datagrams) * _HEARTBEATS)

    def _greet(self, now: int) -> list[bytes]:
        if self._has_greeted:
            self._has_greeted = False
            return []
        return super()._greet(now)


class SbnNode:
    """One SBN application with all of its peers.

    Attributes:
        peers: peers by (SpacecraftID, ProcessorID), their only identity.
        receiving: whether the receive task runs.
    """

    def __init__(self, cfs: Cfs) -> None:
        profile, now = cfs.profile, cfs.scheduler.now
        self._cfs = cfs
        habits = replace(
            STOCK,
            ask_ns=profile.sbn_announce_s * SECOND,
            heartbeat_ns=profile.sbn_heartbeat_s * SECOND,
            timeout_ns=profile.sbn_timeout_s * SECOND,
        )
        kind = SbnConnection
        if profile.sbn_tcp:
            kind, habits = StreamConnection, replace(habits, ask=(), farewell=(), timeout_ns=None)
        self.peers = {
            config.peer: PeerState(config, kind(profile.peer, habits=habits, peer=config.peer, now=now))
            for config in profile.sbn_peers
        }
        self.receiving = True
        self._reported = 0
        self._buffer = bytearray(_BUFFER_BYTES)

    def receive_datagram(self, data: bytes) -> None:
        """Process one datagram with any bytes; after an error the receive task does not run any more."""
        self.receiving = True
        self._buffer[: len(data)] = data
        whole = bytes(self._buffer)
        header = sbn.HEADER.parse(whole)
        if header["msg_size"] < 0:
            self._fail(facts.NOT_UNPACKED, facts.RECEIVE_FAILED)
            return
        identity = Peer(header["spacecraft_id"], header["processor_id"])
        state = self.peers.get(identity)
        if state is None:
            self._fail(facts.UNKNOWN_PEER, facts.RECEIVE_FAILED, **identity._asdict())
            return
        connection = state.connection
        if not connection.connected:
            connection.wanted = tuple(self._network_ids(self._reportable(0)))
        step = connection.receive_datagram(whole, now=self._cfs.scheduler.now)
        for event in step.events:
            self._happened(state, event, len(data) - sbn.HEADER.size)
        self._send(state, step.datagrams)

    def opened(self, peer: Peer) -> None:
        """Begin a TCP connection that this side opened: its first messages are those of the handshake."""
        state = self.peers[peer]
        connection = state.connection
        if isinstance(connection, StreamConnection):
            connection.wanted = tuple(self._network_ids(self._reportable(0)))
            self._send(state, connection.introduce(now=self._cfs.scheduler.now))

    def service(self) -> None:
        """Do one round of the main loop, due every ``sbn_wake_ns``: subscriptions, peer pipes, time-outs."""
        cfs = self._cfs
        if not self.receiving:
            self.receiving = True
            cfs.say(facts.RECEIVE_TASK_STARTED)
        for msg_id in list(self._reportable(self._reported)):
            # One MsgId in each datagram, to every peer of the table, connected or not.
            for state in self.peers.values():
                subscription = state.connection.subscribe(self._network_ids([msg_id]), now=cfs.scheduler.now)
                self._send(state, subscription)
        self._reported = len(cfs.bus.subscribed)
        for state in self.peers.values():
            self._serve(state)

    def unload(self) -> None:
        """Leave every peer, as before a new table: a connected peer gets a message."""
        say = self._cfs.say
        for index, state in enumerate(self.peers.values()):
            self._part(state)
            say(facts.UNLOADED, index=index)
        say(facts.NET_ENDED)
        for peer in self.peers:
            say(facts.UNSUBSCRIBED, processor_id=peer.processor_id)
            say(facts.ALREADY_DISCONNECTED, peer=peer)

    def leave(self) -> None:
        """Leave every connected peer, as SBN does when it ends."""
        for state in self.peers.values():
            if state.connected:
                self._part(state)
                self._cfs.say(facts.ALREADY_DISCONNECTED, peer=state.config.peer)

    def _part(self, state: PeerState) -> None:
        if state.connected:
            self._cfs.say(facts.SENDING_DISCONNECT, peer=state.config.peer)
            self._send(state, state.connection.goodbye())
            self._disconnect(state)

    def _serve(self, state: PeerState) -> None:
        connection, now = state.connection, self._cfs.scheduler.now
        while state.pipe is not None and (packet := state.pipe.get()) is not None:
            data = messages.to_link(messages.whole_packet(packet), self._cfs.profile)
            if len(data) <= sbn.LARGEST_PAYLOAD:
                self._send(state, [connection.frame(data)])
                connection.sent(now=now)
        step = connection.service(now=now)
        for event in step.events:
            self._happened(state, event, 0)
        self._send(state, step.datagrams)

    def _fail(self, event: EventText, consequence: EventText, **values: object) -> None:
        """Report an error and its consequence; end the receive task until the next round."""
        self._cfs.say(event, **values)
        self._cfs.say(consequence)
        self.receiving = False

    def _happened(self, state: PeerState, event: SbnEvent, carried: int) -> None:
        """Process an event of a connection; ``carried``: number of bytes behind the header."""
        cfs, identity = self._cfs, state.config.peer
        match event:
            case Connected():
                self._connect(state)
            case Disconnected(reason):
                if reason is Trigger.TIMEOUT:
                    cfs.say(facts.TIMED_OUT, peer=identity)
                self._disconnect(state)
            case Version(sbn.PROTOCOL_VERSION):
                cfs.say(facts.VERSION_MATCH, peer=identity)
            case Version(version):
                cfs.say(
                    facts.VERSION_MISMATCH,
                    failure=facts.NOT_PROCESSED,
                    peer=identity,
                    own=sbn.PROTOCOL_VERSION,
                    version=version,
                )
            case Subscriptions(msg_type, ident, msg_ids):
                if ident != sbn.IDENT:
                    self._fail(facts.OTHER_IDENT, facts.MESSAGE_FAILED, processor_id=identity.processor_id)
                    return
                for item in msg_ids:
                    self._subscription(state, msg_type, messages.bus_id(item, cfs.profile))
            case AppMessage():
                packet = event.packet
                if cfs.profile.headers.msg_ids.of(packet) > cfe.HIGHEST_MSG_ID:
                    self._fail(facts.BAD_MSG_ID, facts.MESSAGE_FAILED)
                    return
                size = max(length_of(packet), carried, cfe.COMMAND_HEADER_BYTES)
                cfs.publish(messages.from_link(packet[:size], cfs.profile), facts.NAME, stamp=False)
            case UnknownType(msg_type):
                self._fail(
                    facts.UNKNOWN_TYPE, facts.MESSAGE_FAILED, failure=facts.NOT_PROCESSED, msg_type=msg_type
                )
            # Else subscriptions were cut: 65,535 entries exceed the buffer; flight code would read past it.

    def _subscription(self, state: PeerState, msg_type: int, msg_id: int) -> None:
        cfs, pipe = self._cfs, state.pipe
        assert pipe is not None
        if msg_type == sbn.MsgType.SUB:
            if 0 < msg_id <= cfe.HIGHEST_MSG_ID and msg_id not in pipe.limits:
                cfs.bus.subscribe(pipe, msg_id, cfs.profile.sbn_msg_limit, local=True)
        elif not cfs.bus.unsubscribe(pipe, msg_id):
            processor = state.config.peer.processor_id
            cfs.say(facts.NOT_SUBSCRIBED, processor_id=processor, msg_id=msg_id)

    def _connect(self, state: PeerState) -> None:
        cfs, identity = self._cfs, state.config.peer
        name = facts.peer_pipe(identity)
        state.pipe = cfs.bus.create_pipe(name, cfs.profile.sbn_pipe_depth, ignores=facts.NAME)
        cfs.say(facts.CONNECTING, peer=identity)
        cfs.say(facts.PIPE_CREATED, pipe=name)
        cfs.say(facts.CONNECTED, peer=identity)

    def _disconnect(self, state: PeerState) -> None:
        assert state.pipe is not None
        self._cfs.bus.delete_pipe(state.pipe)
        state.pipe = None
        self._cfs.say(facts.DISCONNECTED, peer=state.config.peer)

    def _send(self, state: PeerState, datagrams: Iterable[bytes]) -> None:
        cfs, config = self._cfs, state.config
        for data in datagrams:
            cfs.send(cfs.sbn_endpoint, Endpoint(config.address, config.port), data)

    def _network_ids(self, msg_ids: Iterable[int]) -> list[int]:
        return [messages.link_id(item, self._cfs.profile) for item in msg_ids]

    def _reportable(self, start: int) -> Iterator[int]:
        return (item for item in self._cfs.bus.subscribed[start:] if item not in NOT_REPORTED)


class SbnApp:
    """SBN on an emulated cFS.

    Attributes:
        node: state machine.
        socket: receive queue.
    """

    def __init__(self, cfs: Cfs) -> None:
        self._cfs = cfs
        self._is_dead = self._has_left = False
        cfs.events.register(facts.NAME, now=cfs.scheduler.now)
        self.node = SbnNode(cfs)
        # TCP waits for its reader, so it drops nothing.
        room = NO_LIMIT if cfs.profile.sbn_tcp else cfs.profile.socket_queue
        self.socket: Fifo[bytes] = cfs.account.watch(Fifo(room), socket(cfs.profile.sbn_port))
        self._commands = cfs.create_pipe(facts.PIPE, facts.COMMAND_MSG_ID)
        cfs.say(facts.SUBSCRIBED_TO_COMMANDS, msg_id=facts.COMMAND_MSG_ID)
        cfs.listen(cfs.profile.sbn_port, self.receive_datagram)
        cfs.spawn(self._main())
        if not cfs.profile.sbn_polls:
            cfs.spawn(self._receive())
        if cfs.profile.sbn_says_start:
            cfs.scheduler.call_at(cfs.scheduler.now + facts.STARTS_AFTER_NS, self._say_start)

    def _say_start(self, starting: tuple[EventText, ...] = facts.STARTING) -> None:
        """Report its loading and configuration: more events than Telemetry Output and the squelch pass on."""
        say, profile = self._cfs.say, self._cfs.profile
        for module in facts.MODULES:
            *first, last = starting
            for event in (*first, *([facts.FILTER_INITIALIZED] if module["kind"] == "filter" else []), last):
                say(event, **module)
        own, net = SbnPeerConfig(profile.peer, profile.sbn_port, profile.address), {"net": "(nil)"}
        for config in (own, *profile.sbn_peers):
            values = config.peer._asdict() | net | {"address": config.address, "port": config.port}
            say(facts.CONFIGURING, **values)
            events = (facts.OTHER_PEER, facts.PEER_CONFIGURED)
            begin, end = (facts.OWN_NET, facts.NET_CONFIGURED) if config is own else events
            for event in (*begin, *facts.ADDRESS, end):
                say(event, **values)

    def receive_datagram(self, data: bytes) -> None:
        """Put a datagram in the socket's queue."""
        if not self._is_dead:
            self.socket.put(data)
            self._cfs.scheduler.notify(self.socket)

    def _main(self) -> Task:
        cfs, profile = self._cfs, self._cfs.profile
        while cfs.executive.run_loop(facts.NAME):
            packet = yield Receive(self._commands, profile.sbn_wake_ns)
            if packet is not None:
                self._command(packet)
            if self._is_dead:
                for event in facts.WITHOUT_PIPE:
                    cfs.say(event)
                continue
            restart = not self.node.receiving
            self.node.service()
            if profile.sbn_polls:
                while (data := self.socket.get()) is not None:
                    self.node.receive_datagram(data)
            elif restart:
                cfs.spawn(self._receive())
            yield Work(profile.work_ns)
        self._has_left = True  # it deletes its receive tasks itself
        self.node.leave()

    def _receive(self) -> Task:
        while True:
            data = yield Receive(self.socket)
            if self._has_left:
                return
            self.node.receive_datagram(data)
            if not self.node.receiving:
                return
            yield Work(self._cfs.profile.work_ns)

    def _reload(self, size: int) -> None:
        """Start again with the activated table; without one SBN does not recover."""
        cfs = self._cfs
        if size == cfe.COMMAND_HEADER_BYTES:
            cfs.say(facts.BARE_RELOAD)
            return
        length, expected = (
            messages.command_length(item, cfs.profile) for item in (size, cfe.COMMAND_HEADER_BYTES)
        )
        cfs.say(facts.RELOAD_LENGTH, length=length, expected=expected)
        for event in facts.RELOADING:
            cfs.say(event)
        self.node.unload()
        self._is_dead = not cfs.tables.take(facts.TABLE)
        if self._is_dead:
            for event in facts.NOT_RELOADED:
                cfs.say(event)
            return
        cfs.say(table_services.UPDATED, app=facts.NAME, table=facts.TABLE)
        self.node = SbnNode(cfs)
        self._say_start(facts.RESTARTING)
        cfs.say(facts.RELOADED)

    def _command(self, packet: bytes) -> None:
        if function_code_of(packet) == facts.RELOAD and not self._is_dead:
            self._reload(length_of(packet))
        if function_code_of(packet) == facts.HOUSEKEEPING and length_of(packet) == len(packet):
            self._cfs.say(facts.HOUSEKEEPING_SENT)
            body = bytes([facts.HOUSEKEEPING]).ljust(9, b"\0")
            self._cfs.telemetry(facts.HOUSEKEEPING_MSG_ID, body, facts.NAME)
