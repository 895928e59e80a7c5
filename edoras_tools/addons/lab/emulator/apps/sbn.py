"""The tasks of the Software Bus Network application: the main loop and the receive task."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.addons.lab.emulator.account import Fifo, socket
from edoras_tools.addons.lab.emulator.messages import command_length
from edoras_tools.addons.lab.emulator.scheduler import Receive, Work
from edoras_tools.addons.lab.emulator.services.sbn_node import Actions, SbnNode
from edoras_tools.cfs import sbn as facts
from edoras_tools.cfs import table_services
from edoras_tools.cfs.profile import SbnPeerConfig
from edoras_tools.cfs.queues import NO_LIMIT
from edoras_tools.model import Endpoint, Peer
from edoras_tools.wire import cfe
from edoras_tools.wire.cfe import function_code_of, length_of

if TYPE_CHECKING:
    from edoras_tools.addons.lab.emulator.cfs import Cfs
    from edoras_tools.addons.lab.emulator.scheduler import Task
    from edoras_tools.cfs.event_services import EventText


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
        self.node = SbnNode(cfs.profile, cfs.bus, now=cfs.scheduler.now)
        # TCP waits for its reader, so it drops nothing.
        room = NO_LIMIT if cfs.profile.sbn_tcp else cfs.profile.socket_queue
        self.socket: Fifo[bytes] = cfs.account.watch(Fifo(room), socket(cfs.profile.sbn_port))
        self._commands = cfs.create_pipe(facts.PIPE, facts.COMMAND_MSG_ID)
        cfs.say(facts.SUBSCRIBED_TO_COMMANDS, msg_id=facts.COMMAND_MSG_ID)
        cfs.listen(cfs.profile.sbn_port, self.receive_datagram)
        cfs.executive.owns(more_pipes=self._pipe_names)
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

    def _pipe_names(self) -> list[str]:
        return self.node.pipe_names()

    def receive_datagram(self, data: bytes) -> None:
        """Put a datagram in the socket's queue."""
        if not self._is_dead:
            self.socket.put(data)
            self._cfs.scheduler.notify(self.socket)

    def opened(self, peer: Peer) -> None:
        """Begin a TCP connection that this side opened."""
        self._do(self.node.opened(peer, now=self._cfs.scheduler.now))

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
            self._do(self.node.service(now=cfs.scheduler.now))
            if profile.sbn_polls:
                while (data := self.socket.get()) is not None:
                    self._do(self.node.receive_datagram(data, now=cfs.scheduler.now))
            elif restart:
                cfs.spawn(self._receive())
            yield Work(profile.work_ns)
        self._has_left = True  # it deletes its receive tasks itself
        self._do(self.node.leave())

    def _receive(self) -> Task:
        while True:
            data = yield Receive(self.socket)
            if self._has_left:
                return
            actions = self.node.receive_datagram(data, now=self._cfs.scheduler.now)
            self._do(actions)
            if actions.failed:
                return
            yield Work(self._cfs.profile.work_ns)

    def _do(self, actions: Actions) -> None:
        cfs = self._cfs
        for event in actions.events:
            cfs.report(event)
        for item in actions.sends:
            cfs.send(cfs.sbn_endpoint, Endpoint(item.peer.address, item.peer.port), item.data)
        for packet in actions.publish:
            cfs.publish(packet, facts.NAME, stamp=False)

    def _reload(self, size: int) -> None:
        """Start again with the activated table; without one SBN does not recover."""
        cfs = self._cfs
        if size == cfe.COMMAND_HEADER_BYTES:
            cfs.say(facts.BARE_RELOAD)
            return
        length, expected = (command_length(item, cfs.profile) for item in (size, cfe.COMMAND_HEADER_BYTES))
        cfs.say(facts.RELOAD_LENGTH, length=length, expected=expected)
        for event in facts.RELOADING:
            cfs.say(event)
        self._do(self.node.unload())
        self._is_dead = not cfs.tables.take(facts.TABLE)
        if self._is_dead:
            for event in facts.NOT_RELOADED:
                cfs.say(event)
            return
        cfs.say(table_services.UPDATED, app=facts.NAME, table=facts.TABLE)
        self.node = SbnNode(cfs.profile, cfs.bus, now=cfs.scheduler.now)
        self._say_start(facts.RESTARTING)
        cfs.say(facts.RELOADED)

    def _command(self, packet: bytes) -> None:
        if function_code_of(packet) == facts.RELOAD and not self._is_dead:
            self._reload(length_of(packet))
        if function_code_of(packet) == facts.HOUSEKEEPING and length_of(packet) == len(packet):
            self._cfs.say(facts.HOUSEKEEPING_SENT)
            body = bytes([facts.HOUSEKEEPING]).ljust(9, b"\0")
            self._cfs.telemetry(facts.HOUSEKEEPING_MSG_ID, body, facts.NAME)
