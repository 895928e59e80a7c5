"""A relay for TCP: a connection to it becomes one to the target, with faults that a stream can have.

Rules:

1. Bytes leave unchanged and in order. If a peer reads slowly, the other one is read no faster.
2. When an end stops sending, the other end is told after all its bytes have left; a broken connection breaks
   the other one too.
3. The target is connected when the client's first complete message may leave, never before: a cFS with SBN
   over TCP ends if a connection closes before its first message, as that of a port scan. On all links here
   the client speaks first.
4. One thread moves everything. It sleeps until something arrives, is due, or has space again; no connection
   waits for another one's target.
"""

from __future__ import annotations

import errno
import select
import socket
import struct
import time
from collections import deque
from contextlib import suppress
from math import ceil
from typing import TYPE_CHECKING, Any, Final

import msgspec

from edoras_tools.addons.proxy.plan import ProxyPlan, StreamFaults
from edoras_tools.errors import os_errors
from edoras_tools.io.net.sockets import local_endpoint
from edoras_tools.links.doors import NOT_A_MESSAGE
from edoras_tools.links.table import protocol
from edoras_tools.wire.arrays import PADDING

if TYPE_CHECKING:
    from edoras_tools.model import Endpoint

_AT_ONCE: Final = 1 << 16
_MOST_BYTES: Final = 1 << 20
"""Bytes that may wait in one direction; further ones stay with their sender."""
_WAIT_S: Final = 0.05
_CONNECT_NS: Final = 5_000_000_000
_PENDING: Final = (errno.EINPROGRESS, errno.EALREADY)
_RESET: Final = struct.pack("ii", 1, 0)
"""``struct linger`` with a time of 0: close with a reset."""


class _Pipe(msgspec.Struct, eq=False):
    """One direction of a connection: waiting bytes, each with the time when they may leave.

    ``full`` is whether the target accepted no more at the last attempt to send.
    """

    source: socket.socket
    faults: StreamFaults
    counts: StreamCounts
    target: socket.socket | None = None
    waiting: deque[tuple[int, bytes]] = msgspec.field(default_factory=deque)
    size: int = 0
    ended: bool = False
    reported: bool = False
    full: bool = False

    def receive(self, now: int) -> None:
        """Receive bytes from the source.

        Raises:
            OSError: the connection is broken.
        """
        while self.size < _MOST_BYTES and not self.ended:
            try:
                data = self.source.recv(_AT_ONCE)
            except BlockingIOError:
                return
            self.ended = not data
            if data:
                self.waiting.append((self.faults.leave(now, len(data)), data))
                self.size += len(data)

    def due(self, now: int) -> bool:
        """Return whether bytes may leave."""
        return bool(self.waiting) and self.waiting[0][0] <= now

    def send(self, now: int) -> None:
        """Send the bytes that may leave, if there is a target.

        Raises:
            OSError: the connection is broken.
        """
        if self.target is None:
            return
        self.full = False
        while self.due(now):
            leave, data = self.waiting[0]
            try:
                sent = self.target.send(data)
            except BlockingIOError:
                self.full = True
                return
            self.size -= sent
            self.counts.octets += sent
            if sent < len(data):
                self.waiting[0] = leave, data[sent:]
                self.full = True
                return
            self.waiting.popleft()
        if self.ended and not self.waiting and not self.reported:
            self.reported = True
            with suppress(OSError):  # it may be closed already
                self.target.shutdown(socket.SHUT_WR)


class StreamCounts(msgspec.Struct, eq=False):
    """Counts of one direction, over all connections.

    Attributes:
        octets: number of bytes passed on.
    """

    octets: int = 0


class _Connection(msgspec.Struct, eq=False):
    """A client, and its target once it is connected; the first of ``pipes`` is the way to the target.

    ``asked_ns`` is when the connection to the target was requested, ``target`` the socket for it.
    """

    pipes: list[_Pipe]
    opened: int
    asked_ns: int = 0
    target: socket.socket | None = None


class StreamProxy:
    """One TCP relay; the constructor binds its port.

    Args:
        plan: one target, no ``bind``.
        cut_ns: time after which a connection is cut, ns; 0: never.

    Attributes:
        endpoint: address that it listens on.
        connections: number of connections to the target.
        refused: number of connections that the target refused.
        cut: number of connections that were cut on purpose.
        to_target: counts towards the target.
        to_client: counts towards clients.

    Raises:
        CaptureError: the port cannot be bound.
        ConfigError: a fault is not possible for a stream.
    """

    def __init__(self, plan: ProxyPlan, cut_ns: int = 0) -> None:
        self._plan, self._cut_ns = plan, cut_ns
        self._rules = plan.faults.rules
        for way in (True, False):
            StreamFaults(self._rules, to_cfs=way)
        self._struck = [0] * len(self._rules)
        self.connections = self.refused = self.cut = self._accepted = 0
        self.to_target, self.to_client = StreamCounts(), StreamCounts()
        self._open: list[_Connection] = []
        self._stopping = False
        self._begin = time.monotonic_ns()
        with os_errors(f"--listen {plan.listen}"):
            family = socket.AF_INET6 if ":" in plan.listen.address else socket.AF_INET
            self._listen = socket.create_server((plan.listen.address, plan.listen.port), family=family)
        self._listen.setblocking(False)
        self.endpoint: Endpoint = local_endpoint(self._listen)

    @property
    def title(self) -> str:
        """Description of the relay, for people."""
        return f"{self._plan.link.name} over TCP, {self.endpoint} to {self._plan.targets[0]}"

    @property
    def silent(self) -> int:
        """Number of clients that sent no message: the target was not connected for them."""
        return self._accepted - self.connections - self.refused

    def stop(self) -> None:
        """End ``run``; for any thread."""
        self._stopping = True

    def run(self, *, duration_ns: int = 0) -> None:
        """Relay until ``stop``, or for a duration."""
        while not self._stopping and not (duration_ns and self._now() >= duration_ns):
            self._sleep()
            self._accept()
            for connection in tuple(self._open):
                self._move(connection)

    def close(self) -> None:
        """Close all connections."""
        for connection in tuple(self._open):
            self._end(connection)
        self._listen.close()

    def summary(self) -> dict[str, Any]:
        """Return the relay's counts, in the shape of ``proxy --json``."""
        plan = self._plan.summary()
        for place, fault in enumerate(plan["faults"]):
            now = sum(pipe.faults.struck[place] for item in self._open for pipe in item.pipes)
            fault["struck"] = self._struck[place] + now
        return {
            **plan,
            "connections": self.connections,
            "refused": self.refused,
            "silent": self.silent,
            "cut": self.cut,
            "bytes_to_target": self.to_target.octets,
            "bytes_to_client": self.to_client.octets,
        }

    def _now(self) -> int:
        return time.monotonic_ns() - self._begin

    def _wait_s(self) -> float:
        due = [
            pipe.waiting[0][0]
            for item in self._open
            for pipe in item.pipes
            if pipe.waiting and not pipe.full and (pipe.target or not item.target)
        ]
        return min(_WAIT_S, max(0.0, (min(due) - self._now()) / 1e9)) if due else _WAIT_S

    def _accept(self) -> None:
        try:
            client, _ = self._listen.accept()
        except BlockingIOError:
            return
        self._accepted += 1
        self._prepare(client)
        faults = StreamFaults(self._rules, to_cfs=self._plan.to_cfs)
        self._open.append(_Connection([_Pipe(client, faults, self.to_target)], self._now()))

    def _prepare(self, end: socket.socket) -> None:
        end.setblocking(False)
        end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def _connect(self, connection: _Connection, now: int) -> bool:
        """Connect the target for a client, or continue to; return whether it may accept the connection."""
        target = self._plan.targets[0]
        opened = connection.target
        if opened is None:
            opened = socket.socket(socket.AF_INET6 if ":" in target.address else socket.AF_INET)
            connection.target, connection.asked_ns = opened, now
            self._prepare(opened)
        try:
            error = opened.connect_ex((target.address, target.port))
        except OSError:  # its name is unknown
            error = errno.EHOSTUNREACH
        if error in _PENDING and now - connection.asked_ns < _CONNECT_NS:
            return True
        if error not in {0, errno.EISCONN}:
            self.refused += 1
            return False
        self.connections += 1
        (to_target,) = connection.pipes
        to_target.target = opened
        faults = StreamFaults(self._rules, to_cfs=not self._plan.to_cfs)
        connection.pipes.append(_Pipe(opened, faults, self.to_client, to_target.source))
        return True

    def _move(self, connection: _Connection) -> None:
        now = self._now()
        if self._cut_ns and now - connection.opened >= self._cut_ns:
            self.cut += 1
            self._end(connection, abort=True)
            return
        first = connection.pipes[0]
        try:
            first.receive(now)
            if first.target is None:
                has_begun = self._has_message(first)
                over = first.ended and not has_begun
                if over or (has_begun and first.due(now) and not self._connect(connection, now)):
                    self._end(connection)
                    return
            for pipe in connection.pipes:
                pipe.receive(now)
                pipe.send(now)
        except OSError:
            self._end(connection, abort=True)
            return
        if all(pipe.reported for pipe in connection.pipes):
            self._end(connection)

    def _has_message(self, pipe: _Pipe) -> bool:
        """Return whether the waiting bytes begin with a complete message, or with no message of this link."""
        framing = protocol(self._plan.link).framing
        if framing is None or pipe.size > framing.largest:
            return bool(pipe.waiting)
        data = b"".join(piece for _, piece in pipe.waiting)
        length = framing.length(memoryview(data + bytes(PADDING)), 0, len(data))
        return length == NOT_A_MESSAGE or 0 < length <= len(data)

    def _sleep(self) -> None:
        """Sleep until a source with space sends, a target that was full accepts more, or bytes are due."""
        events_of = {self._listen: select.POLLIN}
        for connection in self._open:
            for pipe in connection.pipes:
                reads = pipe.size < _MOST_BYTES and not pipe.ended
                events_of[pipe.source] = events_of.get(pipe.source, 0) | reads * select.POLLIN
                target = pipe.target or connection.target
                if target is not None:
                    writes = pipe.full or pipe.target is None
                    events_of[target] = events_of.get(target, 0) | writes * select.POLLOUT
        poll = select.poll()
        for end, events in events_of.items():
            if events:
                poll.register(end, events)
        poll.poll(ceil(self._wait_s() * 1000))

    def _end(self, connection: _Connection, *, abort: bool = False) -> None:
        self._open.remove(connection)
        for place in range(len(self._struck)):
            self._struck[place] += sum(pipe.faults.struck[place] for pipe in connection.pipes)
        ends = {pipe.source for pipe in connection.pipes}
        for end in ends | ({connection.target} if connection.target else set()):
            if abort:  # the waiting bytes are lost, and the peers get a RST
                end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
            end.close()
