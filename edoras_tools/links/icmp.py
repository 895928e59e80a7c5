"""ICMP errors about UDP datagrams: a closed port, a host or network that cannot be reached.

No port carries them, so their port is 0, like that of stored packets. Their content identifies them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from msgspec.structs import replace

from edoras_tools.links.protocol import CERTAIN, BatchRows, LinkProtocol, Seen
from edoras_tools.model import Datagram, Decoded, Endpoint, Finding, PacketBatch, Transport
from edoras_tools.wire.arrays.window import gather, read_at
from edoras_tools.wire.icmp import FORMS, QUOTED_UDP, ErrorForm

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.links.reading import Reading
    from edoras_tools.links.site import Site
    from edoras_tools.wire.arrays.order import Integers, Mask, Places
    from edoras_tools.wire.layout import Layout


ADDRESSED: Final = ("source", "destination")


class IcmpLink(LinkProtocol):
    """Errors that quote the beginning of a UDP datagram that reached nobody."""

    code = 12
    name = "ICMP"
    label = "icmp"
    colour = "red"
    doc = "ICMP errors: a UDP datagram reached nobody (destination unreachable)"
    transport = Transport(ports=(0,), first="server")
    layouts = tuple(dict.fromkeys(layout for form in FORMS for layout in form.headers))
    port_decides = False
    quotes = True

    def recognise(self, facts: Seen) -> Any:
        """Return the confidence: certain if the message quotes a UDP datagram."""
        fits: Any = sum(form.fits(facts.field) for form in FORMS)
        return CERTAIN * fits * (facts.destination_port == 0)

    def dissect(self, reading: Reading, site: Site) -> None:
        """Read the error, and the headers that it quotes."""
        at = 0
        for layout in _form_of(reading.data).headers:
            reading.read(layout, at)
            at += layout.size

    def places(self, layout: Layout, rows: BatchRows, field: str = "") -> tuple[Places, Integers]:
        """Find one of the headers; see :meth:`LinkProtocol.places`."""
        owner = np.flatnonzero(rows.column("link") == self)
        at = rows.datagram("offset")[owner].astype(np.int64)
        kind = read_at(rows.batch.data, at, np.uint8)
        shift = np.full(len(owner), -1)
        for form in FORMS:
            if layout in form.headers:
                shift[kind == form.constants[0]["type"]] = form.start(layout)
        present = shift >= 0
        return owner[present], at[present] + shift[present]

    def quoted(self, datagram: Datagram) -> Datagram:
        """Return the quoted part of the datagram that an error quotes; see :meth:`LinkProtocol.quoted`."""
        data = datagram.payload
        form = _form_of(data)
        (_, header, _), at = form.headers, form.size - QUOTED_UDP.size
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
        return next(field.text for field in decoded.layers[0].fields if field.name == "code").partition(" (")[
            0
        ]


class QuotedRows(NamedTuple):
    """The datagrams that errors quote, one row an error.

    Attributes:
        datagrams: batch with their endpoints; the other columns are those of the errors.
        identification: IPv4 identification, u16; 0 for IPv6, which has none.
        closed: whether the addressed host itself reports that nobody listens on the port, bool.
    """

    datagrams: PacketBatch
    identification: NDArray[np.uint16]
    closed: Mask


def quoted_rows(batch: PacketBatch, rows: Places) -> QuotedRows:
    """Return the datagrams that the errors of a batch quote.

    Args:
        rows: rows of the errors.
    """
    own = batch.take(rows)
    address = {name: np.zeros(len(rows), np.uint32) for name in ADDRESSED}
    port = {name: np.zeros(len(rows), np.uint16) for name in ADDRESSED}
    identification, closed = np.zeros(len(rows), np.uint16), np.zeros(len(rows), bool)
    addresses = np.frombuffer(b"".join(own.ipv6), np.uint8).reshape(-1, 16)
    table = addresses[:0]
    for form in FORMS:
        at = np.flatnonzero(own.ip_version == form.version)
        error, header, udp = form.headers
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
        closed[at] = error.column("code", window) == form.port_unreachable
        closed[at] &= (reporter == raw["destination"]).all(axis=1)
    datagrams = replace(
        own,
        source_address=address["source"],
        destination_address=address["destination"],
        source_port=port["source"],
        destination_port=port["destination"],
        ipv6=tuple(item.tobytes() for item in table),
    )
    return QuotedRows(datagrams, identification, closed)


def _form_of(data: bytes) -> ErrorForm:
    """Return the form of a complete error."""
    return next(form for form in FORMS if data[0] == form.constants[0]["type"])


ICMP: Final = IcmpLink()
