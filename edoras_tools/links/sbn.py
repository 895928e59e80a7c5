"""The Software Bus Network over UDP or TCP: a header that names the sender, then a packet or its own message.

Its TCP module (``modules/protocol/tcp`` of nasa/SBN) sends the same messages one after the other, without
anything between them. There is no handshake: the peer with the smaller ProcessorID connects to the other, and
each identifies itself by its first message. The only other message is the heartbeat: after 6 seconds without
another message, several at each wake-up, until there is one.
"""

from __future__ import annotations

from itertools import chain
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.cfs.edoras_app import BRIDGE_LENGTH_MODULUS
from edoras_tools.links import PORTS
from edoras_tools.links.doors import NOT_A_MESSAGE, NOT_YET, Framing, Reading, Site, prefixed
from edoras_tools.links.protocol import CERTAIN, BatchRows, LinkProtocol, Located
from edoras_tools.model import Decoded, Finding, LayerField, PacketBatch, Transport
from edoras_tools.wire import ccsds, sbn
from edoras_tools.wire.arrays import Integers, Mask, Octets, Places, by_value, gather, groups

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.wire.layout import Layout

_WINDOW: Final = 64
"""Bytes that hold a header, and a subscription's $Id and count."""
_BEGINNING: Final = 16
"""Bytes that hold a header and what is looked at behind it: all of most messages, not of subscriptions."""
_IDENT: Final = np.frombuffer(sbn.IDENT.encode().ljust(sbn.IDENT_BYTES, b"\0"), np.uint64)
_KNOWN_TYPES: Final = np.isin(np.arange(256), list(sbn.MsgType))
_LISTING: Final = (sbn.MsgType.SUB, sbn.MsgType.UNSUB)
_KINDS: Final = {
    sbn.SUBSCRIPTIONS.name: (sbn.MsgType.SUB, sbn.MsgType.UNSUB),
    sbn.PROTO.name: (sbn.MsgType.PROTO,),
}
"""The message types of each layout after the header."""
_SHOWN: Final = 3
"""Most MsgIds of a subscription that a summary line lists."""


class SoftwareBusNetworkFraming(Framing):
    """Messages that follow each other in a TCP stream, each with its size in its header."""

    head = sbn.HEADER.size
    largest = sbn.HEADER.size + sbn.LARGEST_PAYLOAD
    sender = slice(sbn.HEADER.by_name["processor_id"].start, sbn.HEADER.by_name["spacecraft_id"].end)

    def lengths(self, data: Octets, at: Integers, end: Integers | int) -> Integers:
        """Return the bytes of header and payload; the size is signed, and receivers reject a negative one."""
        size = sbn.HEADER.column("msg_size", gather(data, at, self.head)).astype(np.int64)
        return prefixed(size >= 0, size + self.head, end - at, self.head, self.largest)

    def length(self, data: memoryview, at: int, end: int) -> int:
        """Return the same for one position."""
        if end - at < self.head:
            return NOT_YET
        return NOT_A_MESSAGE if data[at] & 0x80 else (data[at] << 8 | data[at + 1]) + self.head

    def likely(self, data: Octets, at: Integers, end: Integers | int) -> Mask:
        """Require a known type, and a size that agrees with the content."""
        head = gather(data, at, _WINDOW)
        size = sbn.HEADER.column("msg_size", head).astype(np.int64)
        kind = sbn.HEADER.column("msg_type", head)
        inner = self.head
        packet = ccsds.PRIMARY.column("packet_data_length", head, inner).astype(np.int64) + ccsds.LENGTH_BIAS
        count = sbn.SUBSCRIPTIONS.column("count", head, inner).astype(np.int64)
        listed = sbn.SUBSCRIPTIONS.size + count * sbn.SUBSCRIPTION.size
        expected = np.select(
            [kind == sbn.MsgType.APP, kind == sbn.MsgType.PROTO, np.isin(kind, _LISTING)],
            [packet, np.int64(sbn.PROTO.size), listed],
            0,
        )
        # Payloads are full of zeros, which would be messages without content.
        standard = _KNOWN_TYPES[kind] & (kind != sbn.MsgType.NO_MSG) & head[:, self.sender].any(axis=1)
        return standard & (size == expected) & (end - at >= self.head)


class SoftwareBusNetworkLink(LinkProtocol):
    """The link between SBN peers. Its ports identify it; the port of either end is enough."""

    code = 3
    name = "SBN"
    label = "sbn"
    colour = "magenta"
    doc = "between Software Bus Network peers"
    transport = Transport("either", PORTS["sbn"], first="either")
    framing = SoftwareBusNetworkFraming()
    to_cfs = True
    from_cfs = True
    packets = True
    peers = True
    bridge = "flight"
    bridge_ports = ("peer_port", "udp_receive_port")
    largest = sbn.LARGEST_PAYLOAD
    header_bytes = sbn.HEADER.size
    layouts = (sbn.HEADER, sbn.SUBSCRIPTIONS, sbn.PROTO)
    sender_port = True
    port_sure = CERTAIN

    def locate(self, batch: PacketBatch, rows: Places, site: Site) -> Located:
        """Read the headers of many datagrams; see :meth:`LinkProtocol.locate`."""
        return _Columns(batch, rows, site).located

    def dissect(self, reading: Reading, site: Site) -> int | None:
        """Read the header of one datagram, and the message that is not a packet."""
        return _Message(reading, site).packet_start()

    def places(self, layout: Layout, rows: BatchRows, field: str = "") -> tuple[Places, Integers]:
        """Find the header, or the message that follows it; the older header has no SpacecraftID."""
        kind, offset = rows.column("sbn_msg_type"), rows.datagram("offset")
        present = kind >= 0
        if layout is sbn.HEADER:
            if field == "spacecraft_id":
                present &= ~_read_as_legacy(rows)
            owner = np.flatnonzero(present)
            return owner, offset[owner]
        at = np.where(_read_as_legacy(rows), sbn.LEGACY_HEADER.size, sbn.HEADER.size)
        present &= np.isin(kind, _KINDS[layout.name]) & (rows.datagram("length") - at >= layout.size)
        owner = np.flatnonzero(present)
        return owner, (offset + at)[owner]

    def message_name(self, kind: int) -> str:
        """Return the name of a message type; empty for the one that holds a packet."""
        if kind < 0 or kind == sbn.MsgType.APP:
            return ""
        return f"SBN_{sbn.MSG_TYPE_NAMES.get(kind, f'TYPE_0x{kind:02x}')}"

    def summary(self, decoded: Decoded) -> str:
        """Return a line with sender and content: the MsgIds of a subscription, or a protocol version."""
        head = decoded.layer(sbn.HEADER.name)
        values = head.values() if head else {}
        if not head or values["msg_type"] == sbn.MsgType.APP:
            return ""
        sender = f"from {values.get('spacecraft_id', '?')}:{values.get('processor_id', '?')}"
        listed, proto = decoded.layer(sbn.SUBSCRIPTIONS.name), decoded.layer(sbn.PROTO.name)
        if listed is not None:
            msg_ids = listed.values().get("msg_ids", [])
            some = ", ".join(f"0x{item:04x}" for item in msg_ids[:_SHOWN])
            more = f" and {len(msg_ids) - _SHOWN} more" if len(msg_ids) > _SHOWN else ""
            return f"{some}{more} {sender}".strip()
        if proto is not None:
            return f"protocol version {proto.values()['protocol_version']} {sender}"
        return sender


SBN: Final = SoftwareBusNetworkLink()


def _read_as_legacy(rows: BatchRows) -> Mask:
    """Return which headers are the older, shorter ones, without a SpacecraftID."""
    offset, spacecraft = rows.datagram("offset"), rows.column("spacecraft_id")
    slot = sbn.HEADER.by_name["spacecraft_id"]
    window = gather(rows.batch.data, offset + slot.start, slot.end - slot.start)
    short = rows.datagram("length") < sbn.HEADER.size
    short |= rows.column("packet_offset") == offset + sbn.LEGACY_HEADER.size
    return short | (sbn.HEADER.column("spacecraft_id", window, -slot.start) != spacecraft)


class _Columns:
    """The headers of some datagrams of a batch; every array has one element for each of them."""

    def __init__(self, batch: PacketBatch, rows: Places, site: Site) -> None:
        self.batch, self.rows, self.site = batch, rows, site
        self.length = batch.length[rows]
        self.head = gather(batch.data, batch.offset[rows], _BEGINNING)
        self.located = Located(len(rows))
        self.legacy = _legacy(self.head, self.length)
        self._read()

    def _read(self) -> None:
        located, head, legacy = self.located, self.head, self.legacy
        header = np.where(legacy, sbn.LEGACY_HEADER.size, sbn.HEADER.size).astype(np.int32)
        whole = self.length >= header
        located.flag(Finding.TRUNCATED, ~whole)
        located.flag(Finding.SBN_LEGACY_HEADER, legacy)
        dropped = (self.length >= sbn.HEADER.size) & (self.length % BRIDGE_LENGTH_MODULUS < sbn.HEADER.size)
        located.flag(
            Finding.BRIDGE_DROPS_LENGTH,
            dropped & self.site.bridge_ports[self.batch.destination_port[self.rows]] & ~self._streams(),
        )
        kind = sbn.HEADER.column("msg_type", head)
        payload = self.length - header
        mismatch = sbn.HEADER.column("msg_size", head) != payload
        spacecraft = np.where(legacy, np.uint32(0), sbn.HEADER.column("spacecraft_id", head))
        located.columns = {
            "sbn_msg_type": np.where(whole, kind, np.int16(-1)),
            "processor_id": np.where(whole, sbn.HEADER.column("processor_id", head), np.uint32(0)),
            "spacecraft_id": np.where(whole, spacecraft, np.uint32(0)),
        }
        located.flag(Finding.SBN_SIZE_MISMATCH, whole & mismatch)
        located.flag(Finding.SBN_UNKNOWN_TYPE, whole & ~_KNOWN_TYPES[kind])
        located.flag(Finding.SBN_NO_MESSAGE, whole & (kind == sbn.MsgType.NO_MSG))
        self._identities(np.flatnonzero(whole), trusted=_KNOWN_TYPES[kind] & ~mismatch)

        proto = whole & (kind == sbn.MsgType.PROTO)
        version = np.where(legacy, head[:, sbn.LEGACY_HEADER.size], head[:, sbn.HEADER.size])
        has_version = payload >= sbn.PROTO.size
        located.flag(Finding.TRUNCATED, proto & ~has_version)
        located.flag(Finding.SBN_VERSION_MISMATCH, proto & has_version & (version != sbn.PROTOCOL_VERSION))
        listed = whole & ((kind == sbn.MsgType.SUB) | (kind == sbn.MsgType.UNSUB))
        self._subscriptions(np.flatnonzero(listed), payload)
        app = whole & (kind == sbn.MsgType.APP)
        located.start[app] = header[app]

    def _streams(self) -> Mask | np.bool_:
        """Return which messages came over TCP, which no public bridge supports."""
        streams = self.batch.streams
        return np.False_ if streams is None else streams[self.rows]

    def _identities(self, members: Places, trusted: Mask) -> None:
        """Compare every sender's identity with the first identity of its endpoint."""
        batch, peers, rows = self.batch, self.site.peers, self.rows[members]
        trusted = trusted[members]
        spacecraft, processor = (
            self.located.columns[name][members].astype(np.uint64)
            for name in ("spacecraft_id", "processor_id")
        )
        identity = spacecraft << 32 | processor
        host = batch.source_address[rows].astype(np.uint64) << 8 | batch.ip_version[rows]
        # Ports first: they have 16 bits, which sort several times as fast, and mostly each has one host.
        ports = (near for _, near in by_value(batch.source_port[rows]))
        foreign = np.zeros(len(rows), bool)
        streams = np.zeros(len(rows), bool) if batch.streams is None else batch.streams[rows]
        for _, same in chain.from_iterable(groups(host, near) for near in ports):
            first = int(rows[same[0]])
            key = (batch.address(int(batch.source_address[first]), first), int(batch.source_port[first]))
            peer = peers.identity(key, int(batch.number[first]) - int(streams[same[0]]))
            if peer is None:
                # An identity is unknown only after the endpoint has sent another one.
                after = same[np.logical_or.accumulate(trusted[same])]
                if not len(after):
                    continue
                first_identity = int(identity[after[0]])
                introduction = int(batch.number[rows[after[0]]])
                after = after[~streams[after] | (batch.number[rows[after]] > introduction)]
                peer = peers.introduce(key, divmod(first_identity, 1 << 32), introduction)
            else:
                after = same
            foreign[after] = identity[after] != np.uint64(peer[0] << 32 | peer[1])
        for of_craft, of_processor in self.site.identities:
            foreign &= identity != np.uint64(of_craft << 32 | of_processor)
        self.located.flag(Finding.SBN_ID_MISMATCH, foreign, members)

    def _subscriptions(self, members: Places, payload: NDArray[np.int32]) -> None:
        """Check SUB and UNSUB: the $Id, and whether all entries are present."""
        batch, payload, legacy = self.batch, payload[members], self.legacy[members]
        whole = payload >= sbn.SUBSCRIPTIONS.size
        self.located.flag(Finding.TRUNCATED, ~whole, members)
        for old, at in ((False, sbn.HEADER.size), (True, sbn.LEGACY_HEADER.size)):
            pick = np.flatnonzero(whole & (legacy == old))
            rows = members[pick]
            head = gather(batch.data, batch.offset[self.rows[rows]] + at, sbn.SUBSCRIPTIONS.size)
            ident = head[:, : sbn.IDENT_BYTES].view(np.uint64)
            # Word for word: ``any`` over a short axis takes many times as long.
            other = np.zeros(len(rows), bool)
            for place, word in enumerate(_IDENT):
                other |= ident[:, place] != word
            self.located.flag(Finding.SBN_ID_MISMATCH, other, rows)
            count = sbn.SUBSCRIPTIONS.column("count", head).astype(np.int32)
            short = payload[pick] < sbn.SUBSCRIPTIONS.size + count * sbn.SUBSCRIPTION.size
            self.located.flag(Finding.TRUNCATED, short, rows)


def _legacy(head: Octets, length: NDArray[np.int32]) -> Mask:
    """Return which headers are the older ones of 7 bytes: the size fits, and so does the content."""
    at = sbn.LEGACY_HEADER.size
    fits: Mask = (length >= at) & (sbn.HEADER.column("msg_size", head) == length - at)
    rows = np.flatnonzero(fits)
    if not len(rows):
        return fits
    head, length = head[rows], length[rows]
    kind = sbn.HEADER.column("msg_type", head)
    packet = ccsds.PRIMARY.column("packet_data_length", head, at).astype(np.int32) + ccsds.LENGTH_BIAS
    app = kind == sbn.MsgType.APP
    proto = kind == sbn.MsgType.PROTO
    listed = (kind == sbn.MsgType.SUB) | (kind == sbn.MsgType.UNSUB)
    follows = np.select(
        [app, proto, listed],
        [packet == length - at, length == at + sbn.PROTO.size, head[:, at] == ord("$")],
        length == at,
    )
    fits[rows] = _KNOWN_TYPES[kind] & follows
    return fits


class _Message:
    """Reads the SBN layers of one datagram."""

    def __init__(self, reading: Reading, site: Site) -> None:
        self.reading, self.site, self.data = reading, site, reading.data

    def packet_start(self) -> int | None:
        """Read the header and SBN's own message; return the start of the space packet, or None.

        Raises:
            TruncatedError: a header is incomplete.
        """
        reading, length = self.reading, len(self.data)
        layout = sbn.LEGACY_HEADER if self._legacy() else sbn.HEADER
        if layout is sbn.LEGACY_HEADER:
            reading.findings |= Finding.SBN_LEGACY_HEADER
        if (
            length >= sbn.HEADER.size
            and not reading.datagram.stream
            and length % BRIDGE_LENGTH_MODULUS < sbn.HEADER.size
            and self.site.bridge_ports[reading.datagram.destination.port]
        ):
            reading.findings |= Finding.BRIDGE_DROPS_LENGTH
        head = reading.read(layout, 0)
        payload = length - layout.size
        standard = head["msg_type"] in sbn.MSG_TYPE_NAMES
        if head["msg_size"] != payload:
            reading.findings |= Finding.SBN_SIZE_MISMATCH
        if not standard:
            reading.findings |= Finding.SBN_UNKNOWN_TYPE
        if head["msg_type"] == sbn.MsgType.NO_MSG:
            reading.findings |= Finding.SBN_NO_MESSAGE
        self._identity(
            (head.get("spacecraft_id", 0), head["processor_id"]),
            trusted=standard and head["msg_size"] == payload,
        )
        if head["msg_type"] in {sbn.MsgType.SUB, sbn.MsgType.UNSUB}:
            self._subscriptions(layout.size)
        elif head["msg_type"] == sbn.MsgType.PROTO:
            version = reading.read(sbn.PROTO, layout.size)["protocol_version"]
            if version != sbn.PROTOCOL_VERSION:
                reading.findings |= Finding.SBN_VERSION_MISMATCH
        return layout.size if head["msg_type"] == sbn.MsgType.APP else None

    def _legacy(self) -> bool:
        data, at = self.data, sbn.LEGACY_HEADER.size
        if len(data) < at:
            return False
        head = sbn.LEGACY_HEADER.parse(data)
        size, kind = head["msg_size"], head["msg_type"]
        if size != len(data) - at or kind not in sbn.MSG_TYPE_NAMES:
            return False
        if kind == sbn.MsgType.APP:
            if size < ccsds.PRIMARY.size:
                return False
            return bool(ccsds.PRIMARY.parse(data, at)["packet_data_length"] + ccsds.LENGTH_BIAS == size)
        if kind == sbn.MsgType.PROTO:
            return bool(size == sbn.PROTO.size)
        if kind in {sbn.MsgType.SUB, sbn.MsgType.UNSUB}:
            return data[at : at + 1] == b"$"
        return bool(size == 0)

    def _identity(self, identity: tuple[int, int], *, trusted: bool) -> None:
        datagram, peers = self.reading.datagram, self.site.peers
        source = (datagram.source.address, datagram.source.port)
        if trusted:
            peers.introduce(source, identity, datagram.number)
        peer = peers.identity(source, datagram.number - datagram.stream)
        if peer is not None and peer != identity and identity not in self.site.identities:
            self.reading.findings |= Finding.SBN_ID_MISMATCH

    def _subscriptions(self, at: int) -> None:
        reading, data = self.reading, self.data
        head = reading.read(sbn.SUBSCRIPTIONS, at)
        if data[at : at + sbn.IDENT_BYTES] != sbn.IDENT.encode().ljust(sbn.IDENT_BYTES, b"\0"):
            reading.findings |= Finding.SBN_ID_MISMATCH
        first, need = at + sbn.SUBSCRIPTIONS.size, head["count"] * sbn.SUBSCRIPTION.size
        whole = min(head["count"], (len(data) - first) // sbn.SUBSCRIPTION.size)
        msg_ids = [
            sbn.SUBSCRIPTION.parse(data, first + index * sbn.SUBSCRIPTION.size)["msg_id"]
            for index in range(whole)
        ]
        end = first + whole * sbn.SUBSCRIPTION.size
        text = ", ".join(f"0x{item:04x}" for item in msg_ids)
        doc = "the MsgIds wanted, or no longer wanted"
        reading.extend(LayerField("msg_ids", msg_ids, first, end, text, doc))
        if len(data) - first < need:
            reading.truncated("sbn_subscription", first, need)
