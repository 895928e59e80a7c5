"""UDP sockets: opening, binding, connecting, sending one datagram, drop counters; errors become one line."""

from __future__ import annotations

import errno
import socket
import struct
import sys
from contextlib import suppress
from typing import TYPE_CHECKING, Final, NamedTuple

from edoras_tools.errors import CaptureError, OnFailure
from edoras_tools.io.net.address import Address, address_of, resolve
from edoras_tools.model import Endpoint

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping


LINUX: Final = sys.platform.startswith("linux")
LARGEST_DATAGRAM: Final = 65507
"""Maximum UDP payload over IPv4; over IPv6 it is 20 bytes more."""
BUFFER_BYTES: Final = 32 << 20
"""The size of the buffers requested for a socket in each direction; the kernel may limit it."""
SO_TIMESTAMPNS: Final = 35
IP_PKTINFO: Final = 8
IPV6_PKTINFO: Final = 50
_IPV6_RECVPKTINFO: Final = 49
_SO_SNDBUFFORCE: Final = 32
_SO_RCVBUFFORCE: Final = 33
_SO_MEMINFO: Final = 55
_MEMINFO_RECEIVED: Final = 0  # SK_MEMINFO_RMEM_ALLOC
_MEMINFO_DROPS: Final = 8  # SK_MEMINFO_DROPS


def open_socket(family: int, buffer_bytes: int = BUFFER_BYTES) -> socket.socket:
    """Open a non-blocking UDP socket with large buffers and (Linux) the kernel's receive times."""
    opened = socket.socket(family, socket.SOCK_DGRAM)
    opened.setblocking(False)
    for option, forced in ((socket.SO_RCVBUF, _SO_RCVBUFFORCE), (socket.SO_SNDBUF, _SO_SNDBUFFORCE)):
        with suppress(OSError):  # some systems refuse a size above their limit, others reduce it
            opened.setsockopt(socket.SOL_SOCKET, option, buffer_bytes)
        if LINUX:
            with suppress(OSError):  # a privileged process may exceed the limit
                opened.setsockopt(socket.SOL_SOCKET, forced, buffer_bytes)
    if LINUX:
        opened.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    return opened


def open_bound(
    endpoint: Endpoint,
    name: str = "",
    instead: str = "choose another",
    *,
    buffer_bytes: int = BUFFER_BYTES,
    destinations: bool = False,
) -> socket.socket:
    """Open a UDP socket and bind it.

    Args:
        endpoint: address and port; with port 0 the system chooses one.
        name: name of the endpoint in messages, e.g. ``--listen HOST:PORT``; by default the endpoint itself.
        instead: alternative to suggest if another program uses the port.
        buffer_bytes: buffer size to request.
        destinations: have the kernel report each datagram's destination address; an IPv6 socket then takes
            no IPv4.

    Raises:
        CaptureError: it cannot be bound.
    """
    family, address = resolve(endpoint, name)
    opened = open_socket(family, buffer_bytes)
    with OnFailure(opened.close):
        if destinations:
            _request_destinations(opened)
        bind(opened, address, name, instead)
    return opened


def bind(opened: socket.socket, address: Address, name: str = "", instead: str = "choose another") -> None:
    """Bind a socket; arguments and exception as in ``open_bound``."""
    try:
        opened.bind(address.host)
    except OSError as error:
        why = _reason(error, address.endpoint.port, instead)
        raise CaptureError(f"{name or address.endpoint}: cannot be bound: {why}") from error


def connect(opened: socket.socket, address: Address, name: str) -> None:
    """Connect a socket, so that the kernel reports refusals.

    Raises:
        CaptureError: it cannot send to this address.
    """
    try:
        opened.connect(address.host)
    except OSError as error:
        routeless = error.errno in {errno.ENETUNREACH, errno.EHOSTUNREACH}
        why = "there is no route to it" if routeless else error.strerror or error
        raise CaptureError(f"{name}: cannot be sent to: {why}; name another") from error


def local_endpoint(opened: socket.socket) -> Endpoint:
    """Return the address and port that a socket is bound to."""
    return address_of(opened.family, opened.getsockname()).endpoint


def kernel_drops(opened: socket.socket) -> int:
    """Return the number of datagrams that the kernel dropped at a socket so far; 0 if unknown."""
    return _memory_information(opened, _MEMINFO_DROPS)


def waiting_bytes(opened: socket.socket) -> int:
    """Return the bytes that wait to be read, as the kernel counts them for the buffer; 0 if unknown."""
    return _memory_information(opened, _MEMINFO_RECEIVED)


def _memory_information(opened: socket.socket, place: int) -> int:
    if not LINUX:
        return 0
    information = opened.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, 4 * (place + 1))
    return int(struct.unpack_from("=I", information, 4 * place)[0])


def received(opened: socket.socket, most: int = 256) -> Iterator[tuple[bytes, Endpoint]]:
    """Yield the datagrams that have arrived, ``most`` at most, and their senders; for little traffic.

    Raises:
        OSError: an earlier datagram was refused (``ConnectionRefusedError``), or another error.
    """
    for _ in range(most):
        try:
            data, sender = opened.recvfrom(LARGEST_DATAGRAM + 20, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return
        yield data, Endpoint(*sender[:2])


def _request_destinations(opened: socket.socket) -> None:
    if opened.family == socket.AF_INET6:
        opened.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
    if LINUX and opened.family == socket.AF_INET6:
        opened.setsockopt(socket.IPPROTO_IPV6, _IPV6_RECVPKTINFO, 1)
    elif LINUX:
        opened.setsockopt(socket.IPPROTO_IP, IP_PKTINFO, 1)


def _reason(error: OSError, port: int, instead: str) -> str:
    match error.errno:
        case errno.EADDRINUSE:
            return f"another program has port {port} (a bridge?): stop it, or {instead}"
        case errno.EADDRNOTAVAIL:
            return "not an address of this machine: use one of its own, or 0.0.0.0 for all of them"
        case errno.EACCES:
            return f"port {port} needs privileges: use one from 1024 up"
        case _:
            return error.strerror or str(error)


MOST_REFUSALS: Final = 8
"""Most refusals in a row for the same datagram; each answers an earlier one."""


class SendResult(NamedTuple):
    """The result of sending datagrams.

    Attributes:
        sent: number of datagrams, from the first on, that were sent or failed.
        refused: number of answers that nothing listens (ICMP port unreachable) to earlier datagrams.
        errors: number of datagrams that failed, by system error.
        full: whether the socket accepts no more now.
    """

    sent: int
    refused: int = 0
    errors: Mapping[str, int] = {}
    full: bool = False

    @property
    def accepted(self) -> int:
        """Number of datagrams that the system accepted."""
        return self.sent - self.failed

    @property
    def failed(self) -> int:
        """Number of datagrams that the system did not send."""
        return sum(self.errors.values())


def send_one(
    opened: socket.socket, payload: bytes | memoryview, to: Address | None = None, flags: int = 0
) -> SendResult:
    """Send one datagram; on a non-blocking socket, without waiting.

    Args:
        payload: the bytes to send.
        to: the receiver; None for a connected socket.
        flags: of ``send``.
    """
    refused = 0
    while True:
        try:
            if to is None:
                opened.send(payload, flags)
            else:
                opened.sendto(payload, flags, to.host)
        except (BlockingIOError, InterruptedError):
            return SendResult(0, refused, full=True)
        except OSError as error:
            if error.errno == errno.ECONNREFUSED and refused < MOST_REFUSALS:
                refused += 1
                continue
            if error.errno == errno.ENOBUFS:
                return SendResult(0, refused, full=True)
            return SendResult(1, refused, {error.strerror or str(error): 1})
        else:
            return SendResult(1, refused)
