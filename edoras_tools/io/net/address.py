"""Addresses of sockets: parsed, resolved, in both forms that systems use; own and loopback addresses."""

from __future__ import annotations

import ipaddress
import socket
import struct
from typing import Any, Final, NamedTuple

from edoras_tools.errors import CaptureError, ConfigError
from edoras_tools.model import Endpoint

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
