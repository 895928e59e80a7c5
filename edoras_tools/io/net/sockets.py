"""UDP sockets: opening, binding, connecting, sending one datagram, drop counters; errors become one line.

Also their addresses: parsed, resolved, in both forms that systems use; own and loopback addresses.
"""

from __future__ import annotations

import errno
import ipaddress
import socket
import struct
import sys
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import Any, Final, NamedTuple

from edoras_tools.errors import CaptureError, ConfigError, OnFailure
from edoras_tools.model import Endpoint

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


LOOPBACK: Final = "127.0.0.1"
ANY_ADDRESS: Final = "0.0.0.0"  # noqa: S104  has to be written: nothing listens there by itself
_IPV4_BYTES: Final = 16
PACKED_BYTES: Final = 32
"""Bytes for a socket address: 16 of IPv4, 28 of IPv6."""
_LAST_PORT: Final = 0xFFFF


class Address(NamedTuple):
    """The address of a sender or receiver of datagrams, in both forms that systems use.

    Attributes:
        packed: socket address as bytes, padded with zeros; equal only for equal senders.
        host: tuple that ``socket.sendto`` takes.
        length: bytes of ``packed`` without padding.
    """

    packed: bytes
    host: tuple[Any, ...]
    length: int

    @property
    def endpoint(self) -> Endpoint:
        """Address and port, for the user."""
        return Endpoint(str(self.host[0]), int(self.host[1]))

    @property
    def ip(self) -> bytes:
        """The IP address alone, 4 or 16 bytes."""
        return self.packed[8:24] if self.length > _IPV4_BYTES else self.packed[4:8]


def address_of(family: int, host: tuple[Any, ...]) -> Address:
    """Return a socket address in both forms."""
    if family == socket.AF_INET6:
        name, port, flow, scope = host
        body = struct.pack("!HI", port, flow) + socket.inet_pton(socket.AF_INET6, name.partition("%")[0])
        packed = struct.pack("=H", family) + body + struct.pack("=I", scope)
    else:
        packed = struct.pack("=H", family) + struct.pack("!H", host[1]) + socket.inet_aton(host[0])
        packed = packed.ljust(_IPV4_BYTES, b"\0")
    return Address(packed.ljust(PACKED_BYTES, b"\0"), host, len(packed))


def host_of(packed: bytes) -> Address:
    """Return a socket address from its bytes, as ``senders`` returns them."""
    if struct.unpack_from("=H", packed)[0] == socket.AF_INET6:
        port, flow = struct.unpack_from("!HI", packed, 2)
        scope = struct.unpack_from("=I", packed, 24)[0]
        return Address(packed, (socket.inet_ntop(socket.AF_INET6, packed[8:24]), port, flow, scope), 28)
    port = struct.unpack_from("!H", packed, 2)[0]
    return Address(packed, (socket.inet_ntoa(packed[4:8]), port), _IPV4_BYTES)


def parse_endpoint(text: str, option: str = "") -> Endpoint:
    """Read ``HOST:PORT``, ``[IPV6]:PORT``, or ``PORT`` alone for this machine's loopback.

    Args:
        option: command line option of the value, for the message; empty if the caller adds it.

    Raises:
        ConfigError: the text has none of these forms.
    """
    host, _, number = text.rpartition(":")
    try:
        port = int(number, 0)
    except ValueError:
        port = -1
    bare = ":" in host and not (host.startswith("[") and host.endswith("]"))
    if bare or not 0 <= port <= _LAST_PORT or (":" in text and not host):
        raise ConfigError(
            f"{option} {text}: not an endpoint: HOST:PORT, [IPV6]:PORT or PORT, from 0 to 65535".lstrip()
        )
    return Endpoint(host.strip("[]") or LOOPBACK, port)


def resolve(endpoint: Endpoint, name: str = "") -> tuple[int, Address]:
    """Return the address family and address that an endpoint names.

    Args:
        endpoint: address or name of a host, and a port.
        name: name of the endpoint in messages, e.g. ``--target HOST:PORT``; by default the endpoint itself.

    Raises:
        CaptureError: the host is unknown, or the port is out of range.
    """
    name = name or str(endpoint)
    if not 0 <= endpoint.port <= _LAST_PORT:  # getaddrinfo reduces some larger numbers modulo 65536
        raise CaptureError(f"{name}: {endpoint.port} is not a UDP port: 0 to 65535")
    try:
        family, _, _, _, host = socket.getaddrinfo(endpoint.address, endpoint.port, type=socket.SOCK_DGRAM)[0]
    except (OSError, UnicodeError) as error:
        raise CaptureError(
            f"{name}: {endpoint.address!r} is neither an address nor the name of a known host"
        ) from error
    return family, address_of(family, host)


def own_address(target: Endpoint) -> str:
    """Return the address that this machine sends from to a target; loopback if there is no route."""
    try:
        family, address = resolve(target)
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.connect(address.host)  # sends nothing
            return str(probe.getsockname()[0])
    except (CaptureError, OSError):
        return LOOPBACK


def is_loopback(host: str) -> bool:
    """Return whether a host is this machine's loopback; False for an unknown name."""
    try:
        addresses = socket.getaddrinfo(host, None, type=socket.SOCK_DGRAM)
    except (OSError, UnicodeError):
        return False
    return all(_ip(str(item[4][0])).is_loopback for item in addresses)


def reach_note(
    endpoint: Endpoint, may: str, instead: str = "", who: str = "every machine that reaches it"
) -> str:
    """Return a line on who can reach a port; empty for a port on the loopback.

    Args:
        endpoint: address and port to listen on.
        may: action that a sender can do there, e.g. ``answer``.
        instead: way to restrict it; by default the loopback.
        who: who can reach it.
    """
    if is_loopback(endpoint.address):
        return ""
    instead = instead or f"{LOOPBACK}:{endpoint.port} is for this machine only"
    return f"{endpoint} is open: {who} may {may}; {instead}"


def arrives_at(target: Endpoint, listen: Endpoint) -> bool:
    """Return whether datagrams to ``target`` arrive at ``listen`` on this machine; unknown hosts: False."""
    if target.port != listen.port:
        return False
    try:
        to, at = (_ip(resolve(item)[1].host[0]) for item in (target, listen))
    except CaptureError:
        return False
    if to.is_unspecified:  # as a destination, it means the loopback
        to = ipaddress.ip_address(LOOPBACK if to.version == 4 else "::1")
    if not at.is_unspecified:
        return to == at
    # An IPv6 socket bound to :: takes IPv4 too.
    return at.version >= to.version and (to.is_loopback or _is_own(to))


def _ip(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    address = ipaddress.ip_address(host.partition("%")[0])
    return getattr(address, "ipv4_mapped", None) or address


def _is_own(address: ipaddress.IPv4Address | ipaddress.IPv6Address) -> bool:
    """Return whether an address belongs to an interface of this machine: only these can be bound."""
    family = socket.AF_INET if address.version == 4 else socket.AF_INET6
    try:
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.bind((str(address), 0))
    except OSError:
        return False
    return True
