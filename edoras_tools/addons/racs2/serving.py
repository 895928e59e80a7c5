"""A TCP connection from a client, to send messages on: the server counterpart of ``StreamTransmitter``."""

from __future__ import annotations

import selectors
import socket
from typing import TYPE_CHECKING

from edoras_tools.errors import CaptureError
from edoras_tools.io.net.address import address_of, resolve
from edoras_tools.io.net.sockets import bind, local_endpoint
from edoras_tools.io.net.transmit import SendStatistics
from edoras_tools.io.net.transmit_stream import ANSWER_WITHIN_S, StreamTransmitter

if TYPE_CHECKING:
    from edoras_tools.links.framing import Framing
    from edoras_tools.model import Endpoint


class ServerTransmitter(StreamTransmitter):
    """A server of one client: the first that connects; later ones get no answer. It is a context manager.

    Args:
        place: endpoint to listen at.
        framing: framing that cuts the data of the client.

    Raises:
        CaptureError: it cannot listen there.
    """

    def __init__(self, place: Endpoint, framing: Framing) -> None:
        self.statistics = SendStatistics()
        self._framing, self._name, self._rest = framing, f"TCP {place}", b""
        family, address = resolve(place, self._name)
        self._socket = socket.socket(family, socket.SOCK_STREAM)
        self._selector = selectors.DefaultSelector()
        self._listens = True
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            bind(self._socket, address, self._name, "choose another with --target")
            self._socket.listen(1)
        except BaseException:
            self.__exit__()
            raise
        self._selector.register(self._socket, selectors.EVENT_READ)
        self.target = self.local = local_endpoint(self._socket)

    def __exit__(self, *_: object) -> None:
        self._selector.close()
        self._socket.close()

    def fileno(self) -> int:
        """Return a descriptor that becomes readable when a client connects, and when it sends data."""
        return self._selector.fileno()

    def receive(self) -> list[tuple[bytes, Endpoint]]:
        """Accept the client, or return its complete messages.

        Raises:
            CaptureError: it closed the connection, or sends something else.
        """
        if self._listens and self._selector.select(0):
            self._accept()
        return [] if self._listens else super().receive()

    def send(self, payload: bytes | memoryview) -> bool:
        """Send one message; see ``StreamTransmitter``.

        Raises:
            CaptureError: there is no client, the connection is broken, or the client does not read.
        """
        if self._listens:
            raise CaptureError(f"{self._name}: nobody has connected")
        return super().send(payload)

    def _accept(self) -> None:
        """Accept the client, and use its socket in place of the listening one."""
        listener, (self._socket, address) = self._socket, self._socket.accept()
        self._selector.unregister(listener)
        listener.close()
        self._selector.register(self._socket, selectors.EVENT_READ)
        self._socket.settimeout(ANSWER_WITHIN_S)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._listens = False
        self.target = address_of(self._socket.family, address).endpoint
        self._name = f"TCP {self.target}"
