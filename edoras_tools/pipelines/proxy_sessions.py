"""Who speaks through a proxy: a table of clients, each with sockets of its own before the targets."""

from __future__ import annotations

from dataclasses import dataclass
from operator import attrgetter
from typing import TYPE_CHECKING, Protocol

from edoras_tools.errors import CaptureError
from edoras_tools.pipelines.proxy_ways import Outlet, Way
from edoras_tools.sources.relay import open_socket
from edoras_tools.sources.sockaddr import host_of
from edoras_tools.sources.udp import LINUX, bind_reason, kernel_drops

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable, Iterator

    from edoras_tools.model import Endpoint
    from edoras_tools.sources.sockaddr import Address


class Flows(Protocol):
    """Gives directions numbers, as a recorder does."""

    def flow(self, source: Endpoint, destination: Endpoint) -> int:
        """Return the number of a direction."""


@dataclass(slots=True, eq=False)
class Session:
    """One client, and the sockets that stand for it before the targets.

    Attributes:
        number: from 0, in order of appearance.
        client: its address.
        ports: a socket a target.
        forth: an outlet a target.
        back: the outlet to the client.
        flows: how the recorder knows its two directions, towards the target and back.
        last_ns: when something last went either way.
        received: datagrams from the client.
        answered: datagrams to it.
    """

    number: int
    client: Address
    ports: list[socket.socket]
    forth: list[Outlet]
    back: Outlet
    flows: tuple[int, int]
    last_ns: int
    received: int = 0
    answered: int = 0


class Sessions:
    """The table.

    Args:
        listen: the socket that clients speak to.
        targets: family and address of each.
        ways: to each target, and back.
        queue_bytes: what may wait where a socket is full.
        most: how many clients are remembered; a further one takes the place of the idlest.
        watch: called with every socket that is opened, and who it belongs to.
        forget: called with every socket before it is closed.
        bind: family and address that the one client's socket is bound to; None for one a client.

    Attributes:
        evicted: clients that were forgotten for want of room.
        flows: numbers directions for a recorder; None where there is none.

    Raises:
        CaptureError: a target cannot be reached, or ``bind`` is in use.
    """

    def __init__(
        self,
        listen: socket.socket,
        targets: list[tuple[int, Address]],
        ways: tuple[list[Way], Way],
        *,
        queue_bytes: int,
        most: int,
        watch: Callable[[socket.socket, Session | None], None],
        forget: Callable[[socket.socket], None],
        bind: Address | None = None,
    ) -> None:
        self.evicted = 0
        self.flows: Flows | None = None
        self._listen, self._targets, self._ways = listen, targets, ways
        self._queue_bytes, self._most = queue_bytes, most
        self._watch, self._forget = watch, forget
        self._by_client: dict[bytes, Session] = {}
        self._by_number: dict[int, Session] = {}
        self._number = 0
        self._dropped = 0  # at sockets that are closed
        self._closed = False
        self._bound: list[socket.socket] | None = None
        ports = self._open(bind)  # a target that cannot be reached is told of at once
        if bind is None:
            for port in ports:
                port.close()
        else:
            self._bound = ports
            for port in ports:
                watch(port, None)

    def __iter__(self) -> Iterator[Session]:
        return iter(list(self._by_number.values()))

    def __len__(self) -> int:
        return len(self._by_number)

    def of(self, packed: bytes, now: int) -> Session:
        """Return the session of a client, by its socket address; a new one where it has none."""
        return self._by_client.get(packed) or self._begin(packed, now)

    def numbered(self, number: int) -> Session | None:
        """Return a session by number; None where it is over."""
        return self._by_number.get(number)

    def expire(self, now: int, idle_ns: int) -> None:
        """Forget the clients of whom nothing was heard for so long."""
        if self._bound is None:
            for session in self:
                if now - session.last_ns > idle_ns:
                    self._end(session)

    def drops(self) -> int:
        """Return what the kernel dropped on the way back, for want of room in receive buffers."""
        if self._closed or not LINUX:
            return self._dropped
        return self._dropped + sum(map(kernel_drops, self._ports()))

    def close(self) -> None:
        """Close every socket; the table stays, for reports."""
        self._dropped = self.drops()
        self._closed = True
        for session in self:
            self._settle(session)
        for port in {port.fileno(): port for port in self._ports()}.values():
            self._forget(port)
            port.close()

    def _begin(self, packed: bytes, now: int) -> Session:
        client = host_of(packed)
        if self._bound is None:
            if len(self._by_client) >= self._most:
                self.evicted += 1
                self._end(min(self, key=attrgetter("last_ns")))
            ports = self._open(None)
            number = self._number
        else:  # one peer: whoever spoke last is it
            for session in self:
                self._leave(session)
            ports, number = self._bound, 0
        forth, back = self._ways
        session = Session(
            number,
            client,
            ports,
            [Outlet(port, None, way, self._queue_bytes) for port, way in zip(ports, forth, strict=True)],
            Outlet(self._listen, client, back, self._queue_bytes),
            self._number_flows(client),
            now,
        )
        self._number += 1
        self._by_client[packed] = self._by_number[number] = session
        for port in ports:
            self._watch(port, session)
        return session

    def _number_flows(self, client: Address) -> tuple[int, int]:
        if self.flows is None:
            return 0, 0
        target = self._targets[0][1].endpoint
        return self.flows.flow(client.endpoint, target), self.flows.flow(target, client.endpoint)

    def _open(self, bind: Address | None) -> list[socket.socket]:
        ports: list[socket.socket] = []
        try:
            for family, target in self._targets:
                port = open_socket(family)
                ports.append(port)
                if bind is not None:
                    _bind(port, bind)
                _connect(port, target)
        except CaptureError:
            for port in ports:
                port.close()
            raise
        return ports

    def _ports(self) -> list[socket.socket]:
        return self._bound or [port for session in self for port in session.ports]

    def _leave(self, session: Session) -> None:
        """Take a session out of the table."""
        self._by_number.pop(session.number, None)
        self._by_client.pop(session.client.packed, None)
        self._settle(session)

    @staticmethod
    def _settle(session: Session) -> None:
        for outlet in (*session.forth, session.back):
            outlet.close()

    def _end(self, session: Session) -> None:
        self._leave(session)
        for port in session.ports:
            self._dropped += kernel_drops(port) if LINUX else 0
            self._forget(port)
            port.close()


def _bind(port: socket.socket, address: Address) -> None:
    try:
        port.bind(address.host)
    except OSError as error:
        endpoint = address.endpoint
        raise CaptureError(f"--bind {endpoint}: {bind_reason(error, endpoint.port)}") from error


def _connect(port: socket.socket, address: Address) -> None:
    try:
        port.connect(address.host)
    except OSError as error:
        why = error.strerror or error
        raise CaptureError(f"--target {address.endpoint}: cannot be sent to: {why}; name another") from error
