"""ICMP errors about a datagram that reached nobody, and the beginning of that datagram in them.

RFC 792 and RFC 4443: destination unreachable. Only errors about UDP are read, and only if the header of the
quoted IP packet has no options (IPv4) and no extension headers (IPv6).
"""

from __future__ import annotations

import ipaddress
from typing import TYPE_CHECKING, Any, Final

import msgspec

from edoras_tools.wire.layout import Field, Layout

if TYPE_CHECKING:
    from collections.abc import Callable


class _AddressField(Field, frozen=True):
    """An IP address; its value is its bytes, in network byte order."""

    def text(self, value: Any) -> str:
        """Return the address as people write it."""
        return str(ipaddress.ip_address(value))


_CODES: Final = (
    *("network unreachable", "host unreachable", "protocol unreachable", "port unreachable"),
    *("fragmentation needed", "source route failed", "network unknown", "host unknown"),
    *("source host isolated", "network prohibited", "host prohibited", "network unreachable for service"),
    *("host unreachable for service", "communication prohibited", "host precedence violation"),
    "precedence too low",
)
_CODES_6: Final = (
    *("no route", "communication prohibited", "beyond the scope of the source", "address unreachable"),
    *("port unreachable", "source address not allowed", "route rejected", "error in source route"),
)
_PORTS: Final = Field("source_port", 16, "of the sender"), Field("destination_port", 16, "that it was for")

ICMPV4: Final = Layout(
    "icmp",
    "ICMP",
    Field("type", 8, "the kind of message", names={3: "destination unreachable"}, clause="RFC 792"),
    Field("code", 8, "why", names=dict(enumerate(_CODES))),
    Field("icmp_checksum", 16, "of the ICMP message", base=16),
    Field("unused", 8, "always 0"),
    Field("length", 8, "of what is quoted, in words of 4 bytes; 0 where extensions are not used"),
    Field("next_hop_mtu", 16, "bytes that would fit, with code 4; else 0"),
)
ICMPV6: Final = Layout(
    "icmpv6",
    "ICMPv6",
    Field("type", 8, "the kind of message", names={1: "destination unreachable"}, clause="RFC 4443 3.1"),
    Field("code", 8, "why", names=dict(enumerate(_CODES_6))),
    Field("icmp_checksum", 16, "of the ICMP message and a pseudo-header", base=16),
    Field("length", 8, "of what is quoted, in words of 8 bytes; 0 where extensions are not used"),
    Field("unused", 24, "always 0"),
)
QUOTED_IPV4: Final = Layout(
    "quoted_ipv4",
    "Quoted IPv4 header",
    Field("ip_version", 4, "4"),
    Field("header_length", 4, "in words of 4 bytes: 5"),
    Field("service", 8, "differentiated services"),
    Field("total_length", 16, "bytes of the packet, of which only the first are quoted"),
    Field("identification", 16, "tells the packets of a sender apart", base=16),
    Field("flags", 3, "2: must not be fragmented"),
    Field("fragment_offset", 13, "0: the packet is whole, or its first fragment"),
    Field("time_to_live", 8, "what was left of it"),
    Field("protocol", 8, "17: UDP"),
    Field("header_checksum", 16, "of this header", base=16),
    _AddressField("source", 32, "the sender of the datagram", kind="bytes"),
    _AddressField("destination", 32, "whom it was for", kind="bytes"),
)
QUOTED_IPV6: Final = Layout(
    "quoted_ipv6",
    "Quoted IPv6 header",
    Field("ip_version", 4, "6"),
    Field("traffic_class", 8, "differentiated services"),
    Field("flow_label", 20, "the same in the packets of a flow", base=16),
    Field("payload_length", 16, "bytes behind this header, of which only the first are quoted"),
    Field("next_header", 8, "17: UDP"),
    Field("hop_limit", 8, "what was left of it"),
    _AddressField("source", 128, "the sender of the datagram", kind="bytes"),
    _AddressField("destination", 128, "whom it was for", kind="bytes"),
)
QUOTED_UDP: Final = Layout(
    "quoted_udp",
    "Quoted UDP header",
    *_PORTS,
    Field("length", 16, "bytes of the datagram, this header included"),
    Field("udp_checksum", 16, "of the datagram", base=16),
)
_UDP: Final = 17


class ErrorForm(msgspec.Struct, frozen=True):
    """One of the two forms of an error.

    Attributes:
        protocol: number of the protocol in an IP header.
        version: version of IP, also of the quoted packet.
        headers: headers in wire order; the quoted payload follows.
        constants: fields with fixed values, by index in ``headers``.
        port_unreachable: code for a port on which nobody listens.
    """

    protocol: int
    version: int
    headers: tuple[Layout, Layout, Layout]
    constants: tuple[dict[str, int], dict[str, int]]
    port_unreachable: int

    @property
    def size(self) -> int:
        """Bytes of all headers."""
        return sum(layout.size for layout in self.headers)

    def start(self, layout: Layout) -> int:
        """Return the offset of one of the headers."""
        return sum(item.size for item in self.headers[: self.headers.index(layout)])

    def fits(self, field: Callable[[Layout, str, int], Any]) -> Any:
        """Return whether a message has this form, with all headers complete.

        Args:
            field: reads a number of a header that starts at a byte of the message: of one message, or an
                array for many; -1 if the message ends before it.
        """
        last = self.headers[-1]
        fit: Any = field(last, "udp_checksum", self.start(last)) >= 0
        for layout, values in zip(self.headers, self.constants, strict=False):
            for name, value in values.items():
                fit = fit & (field(layout, name, self.start(layout)) == value)
        return fit


FORMS: Final = (
    ErrorForm(
        protocol=1,
        version=4,
        headers=(ICMPV4, QUOTED_IPV4, QUOTED_UDP),
        constants=(
            {"type": 3},
            {"ip_version": 4, "header_length": 5, "fragment_offset": 0, "protocol": _UDP},
        ),
        port_unreachable=3,
    ),
    ErrorForm(
        protocol=58,
        version=6,
        headers=(ICMPV6, QUOTED_IPV6, QUOTED_UDP),
        constants=({"type": 1}, {"ip_version": 6, "next_header": _UDP}),
        port_unreachable=4,
    ),
)
LONGEST: Final = max(form.size for form in FORMS)
