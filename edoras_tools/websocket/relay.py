"""The way of a Foxglove client to its server, and a count of the messages that went along it.

The SDK drops what a slow client does not take, and tells nobody. So every client is relayed to a server of
its own, and what comes out of that is counted: what went in and has not come out yet is what waits.
"""

from __future__ import annotations

import contextlib
import secrets
import socket
import sys
import threading
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from edoras_tools.model import Endpoint

if TYPE_CHECKING:
    from collections.abc import Callable

_PIECE: Final = 1 << 18
_ROOM_BYTES: Final = 1 << 18
"""What the kernel may hold for a client: what is there already cannot be dropped any more."""
_TEXT: Final = 0x81
_BINARY: Final = 0x82
"""First bytes of unfragmented text and binary frames (RFC 6455 5.2)."""
_MESSAGE_HEAD: Final = 13
"""Bytes in front of a message's own: operation, subscription, time."""
_MESSAGE_DATA: Final = 1
_TIME: Final = 2
_GOODBYE_S: Final = 1.0


@dataclass(slots=True)
class Passed:
    """What went along.

    Attributes:
        messages: messages on subscribed topics.
        octets: their bytes.
        times: times of the server's clock.
    """

    messages: int = 0
    octets: int = 0
    times: int = 0


class Meter:
    """Counts messages in what a server sends, cut anywhere: an HTTP answer, then WebSocket frames.

    Attributes:
        passed: the counts so far.
    """

    def __init__(self) -> None:
        self.passed = Passed()
        self._texts = 0
        self._open = False
        self._skip = 0
        self._rest = b""

    @property
    def accepted(self) -> bool:
        """Whether the server takes the client for one: it tells who it is, and then what topics there are."""
        return self._texts > 1

    def feed(self, piece: bytes) -> None:
        """Take what follows."""
        data = self._rest + piece
        at, self._skip = self._skip, 0
        if not self._open:
            end = data.find(b"\r\n\r\n")
            if end < 0:
                self._rest = data
                return
            self._open, at = True, end + 4
        have = len(data)
        while at + 2 <= have:
            length, head = data[at + 1] & 0x7F, 2
            if length >= 126:
                head = 4 if length == 126 else 10
                length = int.from_bytes(data[at + 2 : at + head], "big")
            if at + head >= have and (length or at + head > have):
                break
            if data[at] == _BINARY and length:
                self._count(data[at + head], length)
            self._texts += data[at] == _TEXT
            at += head + length
        self._skip = max(at - have, 0)
        self._rest = data[at:]

    def _count(self, operation: int, length: int) -> None:
        if operation == _MESSAGE_DATA:
            self.passed.messages += 1
            self.passed.octets += length - _MESSAGE_HEAD
        elif operation == _TIME:
            self.passed.times += 1


class Relay:
    """Two threads that carry bytes between a client and its server, until either has enough.

    Args:
        client: an accepted connection.
        head: what it has sent already.
        server: where its server listens.
        ended: called once when all is over.

    Attributes:
        client: the client's address.
        passed: what came from the server and its socket took.
        idle_s: since when the server has nothing more for the client, on the monotonic clock; 0 while it has.

    Raises:
        OSError: the server is gone.
    """

    def __init__(
        self, client: socket.socket, head: bytes, server: Endpoint, ended: Callable[[], None]
    ) -> None:
        self.client = Endpoint(*client.getpeername()[:2])
        self._meter = Meter()
        self.passed = self._meter.passed
        self.idle_s = 0.0
        self._outer, self._head, self._ended = client, head, ended
        self._inner = socket.create_connection((server.address, server.port))
        for opened in (self._outer, self._inner):
            opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._outer.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _ROOM_BYTES)
        self._inner.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _ROOM_BYTES)
        self._up = threading.Thread(target=self._carry_up, name="foxglove up", daemon=True)
        self._down = threading.Thread(target=self._carry_down, name="foxglove down", daemon=True)

    @property
    def accepted(self) -> bool:
        """Whether the server has taken the client for one."""
        return self._meter.accepted

    def start(self) -> None:
        """Begin."""
        self._up.start()
        self._down.start()

    def close(self) -> None:
        """End it: what the server said last is still carried, for a moment."""
        self._down.join(_GOODBYE_S)
        self._hang_up()
        self._down.join()
        self._up.join()

    def _carry_up(self) -> None:
        with contextlib.suppress(OSError):
            self._inner.sendall(self._head)
            while data := self._outer.recv(_PIECE):
                self._inner.sendall(data)
        self._hang_up()

    def _carry_down(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                self.idle_s = time.monotonic()
                data = self._inner.recv(_PIECE)
                self.idle_s = 0.0
                if not data:
                    break
                self._outer.sendall(data)
                self._meter.feed(data)
        self._hang_up()
        self._up.join()
        self._outer.close()
        self._inner.close()
        self._ended()

    def _hang_up(self) -> None:
        for opened in (self._outer, self._inner):
            with contextlib.suppress(OSError):
                opened.shutdown(socket.SHUT_RDWR)


def secluded() -> str:
    """Return an address of this machine's that nobody guesses.

    A web page could try all ports of 127.0.0.1, and come to a server without passing its door.
    """
    if sys.platform != "linux":  # elsewhere the loopback has one address
        return "127.0.0.1"
    return ".".join(map(str, (127, *(1 + secrets.randbelow(254) for _ in range(3)))))
