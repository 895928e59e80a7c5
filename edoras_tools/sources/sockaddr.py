"""Socket addresses in the two forms that systems want: as bytes, and as Python's tuples."""

from __future__ import annotations

import ipaddress
import socket
import struct
from typing import Any, Final, NamedTuple

from edoras_tools.errors import CaptureError
from edoras_tools.model import Endpoint

PACKED_BYTES: Final = 32
"""Room for a socket address: 16 bytes of IPv4, 28 of IPv6."""


class Address(NamedTuple):
    """Where a datagram comes from or goes to, in both forms that systems want.

    Attributes:
        packed: the socket address as bytes, zeros behind it; tells senders apart.
        host: as ``socket.sendto`` takes it.
        length: bytes of ``packed`` that count.
    """

    packed: bytes
    host: tuple[Any, ...]
    length: int

    @property
    def endpoint(self) -> Endpoint:
        """Address and port as people read them."""
        return Endpoint(str(self.host[0]), int(self.host[1]))


def address_of(family: int, host: tuple[Any, ...]) -> Address:
    """Return a socket address in both forms."""
    if family == socket.AF_INET6:
        name, port, flow, scope = host
        body = struct.pack("!HI", port, flow) + socket.inet_pton(socket.AF_INET6, name.partition("%")[0])
        packed = struct.pack("=H", family) + body + struct.pack("=I", scope)
    else:
        packed = struct.pack("=H", family) + struct.pack("!H", host[1]) + socket.inet_aton(host[0])
        packed = packed.ljust(16, b"\0")
    return Address(packed.ljust(PACKED_BYTES, b"\0"), host, len(packed))


def host_of(packed: bytes) -> Address:
    """Return a socket address from its bytes, as ``senders`` gives them."""
    if struct.unpack_from("=H", packed)[0] == socket.AF_INET6:
        port, flow = struct.unpack_from("!HI", packed, 2)
        scope = struct.unpack_from("=I", packed, 24)[0]
        return Address(packed, (socket.inet_ntop(socket.AF_INET6, packed[8:24]), port, flow, scope), 28)
    port = struct.unpack_from("!H", packed, 2)[0]
    return Address(packed, (socket.inet_ntoa(packed[4:8]), port), 16)


def resolve(endpoint: Endpoint, option: str) -> tuple[int, Address]:
    """Return the address family and address that an endpoint names.

    Raises:
        CaptureError: its host is not known.
    """
    try:
        family, _, _, _, host = socket.getaddrinfo(endpoint.address, endpoint.port, type=socket.SOCK_DGRAM)[0]
    except (OSError, UnicodeError) as error:
        raise CaptureError(f"{option} {endpoint}: no such host; name an address or a known host") from error
    return family, address_of(family, host)


def comes_in(target: Endpoint, listen: Endpoint) -> bool:
    """Tell whether what this machine sends to ``target`` comes in where it listens; an unknown host: no."""
    if target.port != listen.port:
        return False
    try:
        to, at = (_ip(resolve(item, "")[1].host[0]) for item in (target, listen))
    except CaptureError:
        return False
    if to.is_unspecified:  # sent to, it is the loopback
        to = ipaddress.ip_address("127.0.0.1" if to.version == 4 else "::1")
    if not at.is_unspecified:
        return to == at
    # A socket of any IPv6 address takes IPv4 too.
    return at.version >= to.version and (to.is_loopback or _is_own(to))


def _ip(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    address = ipaddress.ip_address(host.partition("%")[0])
    return getattr(address, "ipv4_mapped", None) or address


def _is_own(address: ipaddress.IPv4Address | ipaddress.IPv6Address) -> bool:
    """Tell whether an address is of one of this machine's interfaces: only to such can a socket be bound."""
    family = socket.AF_INET if address.version == 4 else socket.AF_INET6
    try:
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.bind((str(address), 0))
    except OSError:
        return False
    return True
