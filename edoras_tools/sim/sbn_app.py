"""The tasks of the Software Bus Network application: the main loop and the receive task."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from edoras_tools.model import Endpoint
from edoras_tools.sessions import sbn_peer, software_bus
from edoras_tools.sessions.sbn_peer import Actions, SbnNode
from edoras_tools.sim.scheduler import Receive, Work

if TYPE_CHECKING:
    from edoras_tools.sim.cfs import Cfs
    from edoras_tools.sim.scheduler import Task

_HOUSEKEEPING = 10


class Socket:
    """What the operating system keeps for a socket: a queue with an end.

    Attributes:
        drops: datagrams that found it full.
    """

    def __init__(self, depth: int) -> None:
        self.drops = 0
        self._depth = depth
        self._queue: deque[bytes] = deque()

    def put(self, data: bytes) -> None:
        """Add a datagram, or drop it where there is no room."""
        if len(self._queue) < self._depth:
            self._queue.append(data)
        else:
            self.drops += 1

    def get(self) -> bytes | None:
        """Take the oldest datagram, or None."""
        return self._queue.popleft() if self._queue else None

    def __len__(self) -> int:
        return len(self._queue)


class SbnApp:
    """SBN on an emulated cFS.

    Attributes:
        node: its state machine.
        socket: its receive queue.
    """

    def __init__(self, cfs: Cfs) -> None:
        self._cfs = cfs
        cfs.events.register(sbn_peer.NAME, now=cfs.scheduler.now)
        self.node = SbnNode(cfs.profile, cfs.bus, now=cfs.scheduler.now)
        self.socket = Socket(cfs.profile.socket_queue)
        self._commands = cfs.create_pipe("SBN_CMD_PIPE", sbn_peer.COMMAND_MSG_ID)
        cfs.say(
            sbn_peer.NAME, 2, f"SBN subscribed to command pipe SBN_CMD_MID 0x{sbn_peer.COMMAND_MSG_ID:04X}"
        )
        cfs.spawn(self._main())
        if not cfs.profile.sbn_polls:
            cfs.spawn(self._receive())

    def receive_datagram(self, data: bytes) -> None:
        """Put a datagram in the socket's queue."""
        self.socket.put(data)
        self._cfs.scheduler.notify(self.socket)

    def _main(self) -> Task:
        cfs, profile = self._cfs, self._cfs.profile
        while True:
            packet = yield Receive(self._commands, profile.sbn_wake_ns)
            if packet is not None:
                self._command(packet)
            restart = not self.node.receiving
            self._do(self.node.service(now=cfs.scheduler.now))
            if profile.sbn_polls:
                while (data := self.socket.get()) is not None:
                    self._do(self.node.receive_datagram(data, now=cfs.scheduler.now))
            elif restart:
                cfs.spawn(self._receive())
            yield Work(profile.work_ns)

    def _receive(self) -> Task:
        while True:
            data = yield Receive(self.socket)
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
            cfs.publish(packet, sbn_peer.NAME, stamp=False)

    def _command(self, packet: bytes) -> None:
        if packet[6] & 0x7F == _HOUSEKEEPING and software_bus.length(packet) == len(packet):
            self._cfs.say(sbn_peer.NAME, 7, "hk command")
            body = bytes([_HOUSEKEEPING]).ljust(9, b"\0")
            self._cfs.telemetry(sbn_peer.HOUSEKEEPING_MSG_ID, body, sbn_peer.NAME)
