"""The clients of a proxy: each has its own sockets towards the targets, for the answers to it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from operator import attrgetter
from typing import TYPE_CHECKING

import msgspec

from edoras_tools.io.frames.frame_batch import ends_of
from edoras_tools.io.net.sockets import Address, bind, connect, host_of, kernel_drops, open_socket, resolve
from edoras_tools.io.net.transmit import Direction, Outlet

if TYPE_CHECKING:
    import socket

    import numpy as np
    from numpy.typing import NDArray

    from edoras_tools.addons.proxy.plan import ProxyPlan


class ProxyClient(msgspec.Struct, eq=False):
    """One client, and the sockets that represent it towards the targets.

    Attributes:
        number: from 0, in order of appearance.
        address: address of the client.
        sockets: sockets, one for each target.
        to_target: outlets, one for each target.
        to_client: the outlet to the client.
        ends: endpoints from client to target, and from target to client, made by ``ends_of``.
        last_ns: time of the last datagram in either direction.
        received: datagrams from the client.
        answered: datagrams to the client.
    """

    number: int
    address: Address
    sockets: list[socket.socket]
    to_target: list[Outlet]
    to_client: Outlet
    ends: tuple[NDArray[np.void], NDArray[np.void]]
    last_ns: int
    received: int = 0
    answered: int = 0

    @property
    def outlets(self) -> list[Outlet]:
        """All outlets of both directions."""
        return [*self.to_target, self.to_client]


class Clients:
    """The clients, by address and by number.

    Args:
        plan: settings of the proxy.
        listen: socket that clients send to.
        targets: family and address of each target.
        to_target: counters of the direction to each target.
        to_client: counters of the direction to the clients.
        watch: called with every socket that is opened, and its client.
        forget: called with every socket before it is closed.

    Attributes:
        evicted: clients that were removed because there were too many.

    Raises:
        CaptureError: a target cannot be reached, or ``bind`` is in use.
    """

    def __init__(
        self,
        plan: ProxyPlan,
        listen: socket.socket,
        targets: list[tuple[int, Address]],
        to_target: list[Direction],
        to_client: Direction,
        *,
        watch: Callable[[socket.socket, ProxyClient | None], None],
        forget: Callable[[socket.socket], None],
    ) -> None:
        self.evicted = 0
        self._plan, self._listen, self._targets = plan, listen, targets
        self._to_target, self._to_client = to_target, to_client
        self._watch, self._forget = watch, forget
        self._bind = resolve(plan.bind, f"--bind {plan.bind}")[1] if plan.bind else None
        self._by_address: dict[bytes, ProxyClient] = {}
        self._by_number: dict[int, ProxyClient] = {}
        self._number = 0
        self._dropped = 0  # at sockets that are already closed
        self._closed = False
        self._bound: list[socket.socket] | None = None
        sockets = self._open()  # a target that cannot be reached is reported at once
        if self._bind is None:
            for opened in sockets:
                opened.close()
        else:
            self._bound = sockets
            for opened in sockets:
                watch(opened, None)

    def __iter__(self) -> Iterator[ProxyClient]:
        return iter(list(self._by_number.values()))

    def __len__(self) -> int:
        return len(self._by_number)

    def at(self, packed: bytes, now: int) -> ProxyClient:
        """Return the client at a socket address; create it if it is new."""
        return self._by_address.get(packed) or self._begin(packed, now)

    def numbered(self, number: int) -> ProxyClient | None:
        """Return a client by number; None if it was removed."""
        return self._by_number.get(number)

    def expire(self, now: int, idle_ns: int) -> None:
        """Remove clients that were idle for this time."""
        if self._bound is None:
            for client in self:
                if now - client.last_ns > idle_ns:
                    self._end(client)

    def drops(self) -> int:
        """Return the number of targets' datagrams that the kernel dropped at full receive buffers."""
        return self._dropped + (0 if self._closed else sum(map(kernel_drops, self._sockets())))

    def close(self) -> None:
        """Close every socket; the table is kept for reports."""
        self._dropped = self.drops()
        self._closed = True
        for client in self:
            self._give_up(client)
        for opened in {opened.fileno(): opened for opened in self._sockets()}.values():
            self._forget(opened)
            opened.close()

    def _begin(self, packed: bytes, now: int) -> ProxyClient:
        address, queue_bytes = host_of(packed), self._plan.queue_bytes
        if self._bound is None:
            if len(self._by_address) >= self._plan.clients:
                self.evicted += 1
                self._end(min(self, key=attrgetter("last_ns")))
            sockets = self._open()
            number = self._number
        else:  # with --bind there is one client: the address that sent last
            for client in self:
                self._leave(client)
            sockets, number = self._bound, 0
        target = self._targets[0][1].endpoint
        client = ProxyClient(
            number,
            address,
            sockets,
            [
                Outlet(opened, None, direction, queue_bytes)
                for opened, direction in zip(sockets, self._to_target, strict=True)
            ],
            Outlet(self._listen, address, self._to_client, queue_bytes),
            (ends_of(address.endpoint, target), ends_of(target, address.endpoint)),
            now,
        )
        self._number += 1
        self._by_address[packed] = self._by_number[number] = client
        for opened in sockets:
            self._watch(opened, client)
        return client

    def _open(self) -> list[socket.socket]:
        sockets: list[socket.socket] = []
        with ExitStack() as stack:
            for family, target in self._targets:
                opened = stack.enter_context(open_socket(family))
                sockets.append(opened)
                if self._bind is not None:
                    bind(opened, self._bind, f"--bind {self._bind.endpoint}")
                connect(opened, target, f"--target {target.endpoint}")
            stack.pop_all()
        return sockets

    def _sockets(self) -> list[socket.socket]:
        return self._bound or [opened for client in self for opened in client.sockets]

    def _leave(self, client: ProxyClient) -> None:
        """Remove a client from the table."""
        self._by_number.pop(client.number, None)
        self._by_address.pop(client.address.packed, None)
        self._give_up(client)

    @staticmethod
    def _give_up(client: ProxyClient) -> None:
        for outlet in client.outlets:
            outlet.close()

    def _end(self, client: ProxyClient) -> None:
        self._leave(client)
        for opened in client.sockets:
            self._dropped += kernel_drops(opened)
            self._forget(opened)
            opened.close()
