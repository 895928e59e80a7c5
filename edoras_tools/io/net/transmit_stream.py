"""One TCP connection that messages are sent on, with the interface of ``Transmitter``.

Rules that it keeps:

1. Each message is sent at once and whole. If the target reads slowly, sending waits for a limited time.
2. Bytes from the target are cut into messages as the link's ``Framing`` says.
3. A connection that is refused, breaks or ends is one error that names the target.
"""

from __future__ import annotations

import select
import socket
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Final

from edoras_tools.errors import CaptureError
from edoras_tools.io.net.address import resolve
from edoras_tools.io.net.sockets import local_endpoint
from edoras_tools.io.net.transmit import SendStatistics

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from edoras_tools.links.framing import Framing
    from edoras_tools.model import Endpoint
    from edoras_tools.wire.arrays.order import Integers, Octets

ANSWER_WITHIN_S: Final = 5.0
"""Longest wait for a connection, or for a target that does not read."""
_AT_ONCE: Final = 1 << 16


class StreamTransmitter(AbstractContextManager["StreamTransmitter"]):
    """A connection; it is a context manager.

    Args:
        target: address that listens for the connection.

    Attributes:
        target: resolved address.
        local: address and port of this end.
        statistics: counters of messages.

    Raises:
        CaptureError: the target is unknown, refuses, or does not answer.
    """

    def __init__(self, target: Endpoint, framing: Framing) -> None:
        self.statistics = SendStatistics()
        self._framing, self._name, self._rest = framing, f"TCP {target}", b""
        family, address = resolve(target, self._name)
        self._socket = socket.socket(family, socket.SOCK_STREAM)
        try:
            self._socket.settimeout(ANSWER_WITHIN_S)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._socket.connect(address.host)
        except OSError as error:
            self._socket.close()
            raise CaptureError(f"{self._name}: {_refusal(error)}") from error
        self.target, self.local = address.endpoint, local_endpoint(self._socket)

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def fileno(self) -> int:
        """Return the file descriptor, which becomes readable when something arrives."""
        return self._socket.fileno()

    def send(self, payload: bytes | memoryview) -> bool:
        """Send one message.

        Raises:
            CaptureError: the connection is broken, or the target does not read.
        """
        return bool(self._send(payload, 1))

    def rehearse(self, payload: bytes | memoryview) -> None:
        """Do nothing: TCP has no send that delivers nothing; see ``Transmitter.rehearse``."""

    def send_many(self, data: Octets, offset: Integers, length: NDArray[np.int32]) -> int:
        """Send messages one after the other; return their number; see ``Transmitter.send_many``.

        Raises:
            CaptureError: the connection is broken, or the target does not read.
        """
        view, ends = data.data, (offset + length).tolist()
        joined = b"".join(view[start:end] for start, end in zip(offset.tolist(), ends, strict=True))
        return self._send(joined, len(offset))

    def receive(self) -> list[tuple[bytes, Endpoint]]:
        """Return the messages that have arrived completely, with the target as their sender.

        Raises:
            CaptureError: the target closed the connection, or sends another protocol.
        """
        if not select.select([self._socket], (), (), 0)[0]:  # recv would block, up to the timeout of sends
            return []
        try:
            more = self._socket.recv(_AT_ONCE)
        except OSError as error:
            raise self._broken(error) from error
        if not more:
            raise CaptureError(f"{self._name}: closed the connection after {self.statistics.sent:,} messages")
        messages, self._rest, is_foreign = self._framing.cut(self._rest + more)
        if is_foreign:
            raise CaptureError(f"{self._name}: sends another protocol; name the target with --target")
        return [(message, self.target) for message in messages]

    def _send(self, octets: bytes | memoryview, count: int) -> int:
        try:
            self._socket.sendall(octets)
        except OSError as error:
            raise self._broken(error) from error
        self.statistics.sent += count
        return count

    def _broken(self, error: OSError) -> CaptureError:
        why = (
            f"takes nothing for {ANSWER_WITHIN_S:g} s"
            if isinstance(error, TimeoutError)
            else error.strerror or error
        )
        return CaptureError(
            f"{self._name}: the connection broke after {self.statistics.sent:,} messages: {why}"
        )


def _refusal(error: OSError) -> str:
    if isinstance(error, ConnectionRefusedError):
        return "refuses the connection: no program listens there; start it, or name its address with --target"
    if isinstance(error, TimeoutError):
        return f"does not answer within {ANSWER_WITHIN_S:g} s; name another address with --target"
    return f"cannot be connected to: {error.strerror or error}; name another address with --target"
