"""ICMP errors about UDP datagrams: a closed port, no route, a firewall, fragments that never came.

No port carries them, so their port is 0, like that of stored packets. Their content identifies them.

An error contains the beginning of the datagram that reached nobody. RFC 792 and RFC 4443: destination
unreachable, packet too big, time exceeded. Only errors about UDP are read, and only if the header of the
quoted IP packet has no options (IPv4) and no extension headers (IPv6).
"""

from __future__ import annotations

import ipaddress
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.links.protocol import CERTAIN, BatchRows, LinkProtocol, Seen
from edoras_tools.model import Datagram, Decoded, Endpoint, Finding, PacketBatch, Transport
from edoras_tools.wire.arrays import Integers, Mask, Places, gather, read_at
from edoras_tools.wire.layout import Field, Layout

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.links.doors import Reading, Site


class _AddressField(Field, frozen=True):
    """An IP address; its value is its bytes, in network byte order."""

    def text(self, value: Any) -> str:
        """Return the address as people write it."""
        return str(ipaddress.ip_address(value))


_UNREACHABLE: Final = (
    *("network unreachable", "host unreachable", "protocol unreachable", "port unreachable"),
    *("fragmentation needed", "source route failed", "network unknown", "host unknown"),
    *("source host isolated", "network prohibited", "host prohibited", "network unreachable for service"),
    *("host unreachable for service", "communication prohibited", "host precedence violation"),
    "precedence too low",
)
_UNREACHABLE_6: Final = (
    *("no route", "communication prohibited", "beyond the scope of the source", "address unreachable"),
    *("port unreachable", "source address not allowed", "route rejected", "error in source route"),
)
_EXCEEDED: Final = "hop limit exceeded", "fragment reassembly time exceeded"
_PORTS: Final = Field("source_port", 16, "of the sender"), Field("destination_port", 16, "that it was for")


def _header(name: str, kind: int, meaning: str, codes: Sequence[str], *rest: Field) -> Layout:
    """Return the layout of the eight bytes with which errors of one kind begin."""
    return Layout(
        name,
        "ICMPv6" if "v6" in name else "ICMP",
        Field("type", 8, "the kind of message", names={kind: meaning}),
        Field("code", 8, "why", names=dict(enumerate(codes))),
        Field("icmp_checksum", 16, "of the message; of ICMPv6 with a pseudo-header", base=16),
        *rest,
    )


_REST: Final = (
    Field("unused", 8, "always 0"),
    Field("length", 8, "of what is quoted, in words of 4 bytes; 0 where extensions are not used"),
    Field("next_hop_mtu", 16, "bytes that would fit, where fragmentation is needed; else 0"),
)
_REST_6: Final = (
    Field("length", 8, "of what is quoted, in words of 8 bytes; 0 where extensions are not used"),
    Field("unused", 24, "always 0"),
)
_MTU: Final = Field("mtu", 32, "bytes that would fit")
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
_UNREACHED: Final = "destination unreachable"


class ErrorForm(msgspec.Struct, frozen=True):
    """The errors of ICMP or of ICMPv6.

    Attributes:
        protocol: number of the protocol in an IP header.
        version: version of IP, also of the quoted packet.
        kinds: type of an error to the header with which it begins; all have the same size.
        quoted: the quoted IP header, and the UDP header; the quoted payload follows.
        constants: fields of the quoted IP header with fixed values.
        closed: type and code for a port on which nobody listens.
    """

    protocol: int
    version: int
    kinds: Mapping[int, Layout]
    quoted: tuple[Layout, Layout]
    constants: Mapping[str, int]
    closed: tuple[int, int]

    @property
    def size(self) -> int:
        """Bytes of all headers."""
        return self.start(self.quoted[-1]) + self.quoted[-1].size

    def start(self, layout: Layout) -> int:
        """Return the offset of one of the headers."""
        at = self.quoted.index(layout) + 1 if layout in self.quoted else 0
        return sum(item.size for item in (self.kinds[self.closed[0]], *self.quoted)[:at])

    def conditions(self) -> Iterator[tuple[Layout, str, Collection[int]]]:
        """Yield fields that tell the form: header, name, and the values that the field may have."""
        yield self.kinds[self.closed[0]], "type", self.kinds
        for name, value in self.constants.items():
            yield self.quoted[0], name, (value,)

    def fits(self, field: Callable[[Layout, str, int], Any]) -> Any:
        """Return whether a message has this form, with all headers complete.

        Args:
            field: reads a number of a header that starts at a byte of the message: of one message, or an
                array for many; -1 if the message ends before it.
        """
        last = self.quoted[-1]
        fit: Any = field(last, "udp_checksum", self.start(last)) >= 0
        for layout, name, values in self.conditions():
            read = field(layout, name, self.start(layout))
            fit = fit & (sum(read == value for value in values) > 0)
        return fit


FORMS: Final = (
    ErrorForm(
        protocol=1,
        version=4,
        kinds={
            3: _header("icmp", 3, _UNREACHED, _UNREACHABLE, *_REST),
            11: _header("icmp_time_exceeded", 11, "time exceeded", _EXCEEDED, *_REST),
        },
        quoted=(QUOTED_IPV4, QUOTED_UDP),
        constants={"ip_version": 4, "header_length": 5, "fragment_offset": 0, "protocol": _UDP},
        closed=(3, 3),
    ),
    ErrorForm(
        protocol=58,
        version=6,
        kinds={
            1: _header("icmpv6", 1, _UNREACHED, _UNREACHABLE_6, *_REST_6),
            2: _header("icmpv6_too_big", 2, "packet too big", ["packet too big"], _MTU),
            3: _header("icmpv6_time_exceeded", 3, "time exceeded", _EXCEEDED, *_REST_6),
        },
        quoted=(QUOTED_IPV6, QUOTED_UDP),
        constants={"ip_version": 6, "next_header": _UDP},
        closed=(1, 4),
    ),
)
LONGEST: Final = max(form.size for form in FORMS)


ADDRESSED: Final = ("source", "destination")


class IcmpLink(LinkProtocol):
    """Errors that quote the beginning of a UDP datagram that reached nobody."""

    code = 12
    name = "ICMP"
    label = "icmp"
    colour = "red"
    doc = "ICMP errors: a UDP datagram reached nobody"
    transport = Transport(ports=(0,), first="server")
    layouts = tuple(dict.fromkeys(one for form in FORMS for one in (*form.kinds.values(), *form.quoted)))
    port_decides = False
    quotes = True

    def recognise(self, facts: Seen) -> Any:
        """Return the confidence: certain if the message quotes a UDP datagram."""
        fits: Any = sum(form.fits(facts.field) for form in FORMS)
        return CERTAIN * fits * (facts.destination_port == 0)

    def dissect(self, reading: Reading, site: Site) -> None:
        """Read the error, and the headers that it quotes."""
        form = _form_of(reading.data)
        for layout in (form.kinds[reading.data[0]], *form.quoted):
            reading.read(layout, form.start(layout))

    def places(self, layout: Layout, rows: BatchRows, field: str = "") -> tuple[Places, Integers]:
        """Find one of the headers; see :meth:`LinkProtocol.places`."""
        owner = np.flatnonzero(rows.column("link") == self)
        at = rows.datagram("offset")[owner].astype(np.int64)
        kind, shift = read_at(rows.batch.data, at, np.uint8), np.full(len(owner), -1)
        for form in FORMS:
            kinds = [number for number, own in form.kinds.items() if own == layout]
            own = rows.batch.ip_version[owner] == form.version
            shift[own & (np.isin(kind, kinds) | (layout in form.quoted))] = form.start(layout)
        present = shift >= 0
        return owner[present], at[present] + shift[present]

    def quoted(self, datagram: Datagram) -> Datagram:
        """Return the quoted part of the datagram that an error quotes; see :meth:`LinkProtocol.quoted`."""
        data = datagram.payload
        form = _form_of(data)
        header, at = form.quoted[0], form.start(QUOTED_UDP)
        ends = header.parse(data, form.start(header))
        ports = QUOTED_UDP.parse(data, at)
        whole = max(ports["length"] - QUOTED_UDP.size, 0)
        payload = data[form.size : form.size + whole]
        source, destination = (
            Endpoint(header.by_name[name].field.text(ends[name]), ports[f"{name}_port"]) for name in ADDRESSED
        )
        return Datagram(
            number=datagram.number,
            time_ns=datagram.time_ns,
            link_type=datagram.link_type,
            frame=payload,
            payload=payload,
            payload_offset=0,
            original_length=whole,
            source=source,
            destination=destination,
            findings=Finding.CAPTURE_CUT if len(payload) < whole else Finding(0),
        )

    def summary(self, decoded: Decoded) -> str:
        """Return the reason why the datagram reached nobody."""
        code = next(field for field in decoded.layers[0].fields if field.name == "code")
        return code.text.partition(" (")[0]


class QuotedRows(NamedTuple):
    """The datagrams that errors quote, one row an error.

    Attributes:
        datagrams: batch with their endpoints; the other columns are those of the errors.
        identification: IPv4 identification, u16; 0 for IPv6, which has none.
        closed: whether the addressed host itself reports that nobody listens on the port, bool.
        reason: why, a number from 1 on, i64; :func:`error_text` returns its text.
    """

    datagrams: PacketBatch
    identification: NDArray[np.uint16]
    closed: Mask
    reason: Integers


def quoted_rows(batch: PacketBatch, rows: Places) -> QuotedRows:
    """Return the datagrams that the errors of a batch quote.

    Args:
        rows: rows of the errors.
    """
    own = batch.take(rows)
    address = {name: np.zeros(len(rows), np.uint32) for name in ADDRESSED}
    port = {name: np.zeros(len(rows), np.uint16) for name in ADDRESSED}
    identification, closed = np.zeros(len(rows), np.uint16), np.zeros(len(rows), bool)
    reason = np.zeros(len(rows), np.int64)
    addresses = np.frombuffer(b"".join(own.ipv6), np.uint8).reshape(-1, 16)
    table = addresses[:0]
    for form in FORMS:
        at = np.flatnonzero(own.ip_version == form.version)
        header, udp = form.quoted
        window, start = gather(batch.data, own.offset[at], form.size), form.start(header)
        places = {name: header.by_name[name] for name in ADDRESSED}
        raw = {
            name: np.ascontiguousarray(window[:, start + slot.start : start + slot.end])
            for name, slot in places.items()
        }
        if form.version == FORMS[0].version:
            identification[at] = header.column("identification", window, start)
            reporter = own.source_address[at].astype(">u4").view(np.uint8).reshape(-1, 4)
            numbers = {name: octets.view(">u4")[:, 0] for name, octets in raw.items()}
        else:
            reporter = addresses[own.source_address[at]]
            table, which = np.unique(np.concatenate(list(raw.values())), axis=0, return_inverse=True)
            numbers = dict(zip(ADDRESSED, np.split(which.reshape(-1), len(ADDRESSED)), strict=True))
        for name in ADDRESSED:
            address[name][at] = numbers[name]
            port[name][at] = udp.column(f"{name}_port", window, form.start(udp))
        kind, code = window[:, 0].astype(np.int64), window[:, 1]
        reason[at] = form.version << 16 | kind << 8 | code
        closed[at] = (kind == form.closed[0]) & (code == form.closed[1])
        closed[at] &= (reporter == raw["destination"]).all(axis=1)
    datagrams = replace(
        own,
        source_address=address["source"],
        destination_address=address["destination"],
        source_port=port["source"],
        destination_port=port["destination"],
        ipv6=tuple(item.tobytes() for item in table),
    )
    return QuotedRows(datagrams, identification, closed, reason)


NOT_JOINED: Final = (0x040B01,)
"""The reason that not all fragments of a datagram came: errors that are sent long after it.

Those of ICMPv6 quote an extension header, and are not read.
"""
TOO_LONG: Final = (0x040304, 0x060200)
"""The reasons that the way carries no packets as long as the datagram's."""


def error_text(reason: int) -> str:
    """Return why a datagram reached nobody, as the standards call it: ``host unreachable``."""
    version, kind, code = reason.to_bytes(3)
    layout = next(form for form in FORMS if form.version == version).kinds[kind]
    return layout.by_name["code"].field.text(code).partition(" (")[0]


def _form_of(data: bytes) -> ErrorForm:
    """Return the form of a complete error: that of the version of the IP packet that it quotes."""
    return next(form for form in FORMS if data[form.start(form.quoted[0])] >> 4 == form.version)


ICMP: Final = IcmpLink()
