# SPDX-License-Identifier: GPL-2.0-only
"""EDORAS, cFE and SBN as scapy layers, made from the layouts; scapy is GPL-2.0-only, so this file is too.

Importing it binds the layers to the standard UDP ports. Lengths and the checksum are filled in where they are
not given::

    packet = SpacePacket(msg_id=0x1827) / CommandHeader(function_code=1) / EdorasEnvelope() / CDR(...)
    IP(dst="127.0.0.1") / UDP() / packet
    IP() / UDP() / SBN(processor_id=3, spacecraft_id=0x42) / packet

What a mission adds (which MsgIds carry an envelope, and of which type) is handed to :func:`use`. Without it
an envelope is told from the bytes.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any, Final, Protocol

import msgspec
from scapy.fields import PacketListField, StrLenField
from scapy.layers.inet import TCP, UDP
from scapy.packet import Packet, Raw, bind_bottom_up, bind_top_down

from edoras_tools.cfs.arguments import ARGUMENTS
from edoras_tools.dissectors.scapy_fields import fields, put
from edoras_tools.links import table
from edoras_tools.wire import ccsds, cfe, sbn
from edoras_tools.wire.ccsds import MSG_ID_BYTES, VERSION_1, MsgIds
from edoras_tools.wire.envelope import (
    CDR_LE,
    DEFAULT,
    ENCAPSULATION,
    ENVELOPE_FORMATS,
    EnvelopeFormat,
    detect,
)
from edoras_tools.wire.layout import Layout

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from edoras_tools.links.protocol import LinkProtocol

_LINKS: Final = tuple(
    link for link in table.links() if link.transport.udp and not (link.forms or link.wireshark)
)
"""Those whose ports tell what they carry, with fixed headers: scapy binds layers to ports, not to lengths."""
CAPTURE_FILTER: Final = " or ".join(
    f"udp port {port}" for port in sorted({port for link in _LINKS for port in link.transport.ports})
)
"""For ``sniff(filter=...)``."""


class Types(Protocol):
    """What knows ROS types: an ``edoras_tools.ros.TypeStore``."""

    def decode(self, type_name: str, cdr: bytes) -> dict[str, Any]:
        """Return a message as plain values."""

    def encode(self, type_name: str, values: Mapping[str, Any], *, big_endian: bool = False) -> bytes:
        """Return a message from plain values, encapsulation included."""


class Knowledge(msgspec.Struct):
    """What the layers cannot tell from the bytes; see :func:`use`."""

    routes: Mapping[int, str] = msgspec.field(default_factory=dict)
    types: Types | None = None
    extended_header: bool = False
    telemetry_header: int = cfe.TELEMETRY_HEADER_BYTES
    envelope: EnvelopeFormat | None = DEFAULT
    msg_ids: MsgIds = VERSION_1


_known = Knowledge()


def use(
    routes: Mapping[int, str],
    types: Types | None = None,
    *,
    extended_header: bool = False,
    telemetry_header: int = cfe.TELEMETRY_HEADER_BYTES,
    envelope: EnvelopeFormat | None = DEFAULT,
    msg_ids: MsgIds = VERSION_1,
) -> None:
    """Tell the layers what a mission knows.

    Args:
        routes: ROS type by MsgId; only these carry an envelope. Empty: the bytes tell.
        types: decodes and encodes the bodies.
        extended_header: packets carry cFE's extended header.
        telemetry_header: 16, or 12 in older builds.
        envelope: of all routes; None where the bytes shall tell.
        msg_ids: how MsgIds are built. Version 2 needs the extended header: ``subsystem_id`` is part of them.
    """
    global _known  # noqa: PLW0603  scapy's layers are classes of the process: so is what they know
    _known = Knowledge(routes, types, extended_header, telemetry_header, envelope, msg_ids)


_WORD: Final = 2
"""Bytes of the MsgId: the fields that end within them make it up."""


class SpacePacket(Packet):  # type: ignore[misc]
    """CCSDS space packet; ``msg_id`` sets its first word, or tells how cFE names the packet."""

    name = ccsds.PRIMARY.title
    fields_desc = fields(ccsds.PRIMARY, sequence_flags=ccsds.UNSEGMENTED, packet_data_length=None)

    def __init__(self, *args: Any, msg_id: int | None = None, **values: Any) -> None:
        if msg_id is not None:
            word = _known.msg_ids.words(msg_id)[0].to_bytes(_WORD, ccsds.PRIMARY.byte_order)
            first = [slot for slot in ccsds.PRIMARY.slots if slot.end <= _WORD]
            values = {slot.field.name: ccsds.PRIMARY.read(slot, word) for slot in first} | values
        super().__init__(*args, **values)

    @property
    def msg_id(self) -> int:
        """The MsgId by which cFE knows the packet."""
        return self.msg_id_with(self.getlayer(ExtendedHeader))

    def msg_id_with(self, extended: ExtendedHeader | None) -> int:
        """Return the MsgId of the packet with an extended header, which need not be in it yet."""
        fields = {slot.field.name: self.getfieldval(slot.field.name) for slot in ccsds.PRIMARY.slots}
        subsystem = extended.subsystem_id & 0xFF if extended is not None else 0
        head = ccsds.msg_id(fields).to_bytes(_WORD, ccsds.PRIMARY.byte_order)
        return _known.msg_ids.of(head.ljust(MSG_ID_BYTES - 1, b"\0") + bytes([subsystem]))

    def post_build(self, header: bytes, payload: bytes) -> bytes:
        """Fill in the length, and the checksum of a command."""
        if self.packet_data_length is None:
            total = len(header) + len(payload)
            header = put(header, ccsds.PRIMARY, "packet_data_length", total - ccsds.LENGTH_BIAS)
        command = self.getlayer(CommandHeader) or self.getlayer(ExtendedCommandHeader)
        if command is not None and command.checksum is None:
            extra = cfe.EXTENDED.size if self.haslayer(ExtendedHeader) else 0
            at = extra + cfe.COMMAND.by_name["checksum"].start
            payload = payload[:at] + bytes([cfe.checksum(header + payload)]) + payload[at + 1 :]
        return header + payload

    def guess_payload_class(self, payload: bytes) -> type[Packet]:
        """Choose the header by the type bit."""
        if _known.extended_header and len(payload) >= cfe.EXTENDED.size:
            return ExtendedHeader
        return _secondary(self, payload, 0)


def _secondary(packet: SpacePacket, payload: bytes, extra: int) -> type[Packet]:
    """Choose the cFE header; a telemetry packet of 8 bytes in all has the command header, as wake-ups do."""
    total = ccsds.PRIMARY.size + extra + len(payload)
    bare = total == cfe.COMMAND_HEADER_BYTES == packet.packet_data_length + ccsds.LENGTH_BIAS
    chosen: type[Packet]
    if packet.packet_type or bare:
        chosen, layout = (
            (ExtendedCommandHeader, cfe.COMMAND_EXTENDED) if extra else (CommandHeader, cfe.COMMAND)
        )
    elif extra:
        chosen, layout = ExtendedTelemetryHeader, cfe.TELEMETRY_EXTENDED
    elif _known.telemetry_header == cfe.SHORT.telemetry_bytes:
        chosen, layout = ShortTelemetryHeader, cfe.TELEMETRY_SHORT
    else:
        chosen, layout = TelemetryHeader, cfe.TELEMETRY
    return chosen if len(payload) >= layout.size else Raw


class ExtendedHeader(Packet):  # type: ignore[misc]
    """cFE's extended header."""

    name = cfe.EXTENDED.title
    fields_desc = fields(cfe.EXTENDED)

    def guess_payload_class(self, payload: bytes) -> type[Packet]:
        """Choose the header by the type bit."""
        return _secondary(self.underlayer, payload, cfe.EXTENDED.size)


class _Secondary(Packet):  # type: ignore[misc]
    """What both cFE headers do with what follows them."""

    name = "cFE Header"

    def guess_payload_class(self, payload: bytes) -> type[Packet]:
        """Choose an event, housekeeping, or an envelope."""
        packet, extended = self.underlayer, None
        while packet is not None and not isinstance(packet, SpacePacket):
            extended = packet if isinstance(packet, ExtendedHeader) else extended
            packet = packet.underlayer
        msg_id = packet.msg_id_with(extended) if packet is not None else -1
        if msg_id in _known.routes:
            chosen = _known.envelope or detect(payload) or DEFAULT
            return envelope(chosen) if len(payload) >= chosen.size else Raw
        for known, layer, layout in (
            (cfe.EVENT_MSG_ID, Event, cfe.EVENT),
            (cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID, SoftwareBusHousekeeping, cfe.SOFTWARE_BUS_HOUSEKEEPING),
        ):
            if msg_id == _known.msg_ids.of_known(known) and len(payload) >= layout.size:
                return layer
        if msg_id >= 0 and "function_code" in self.fields:
            key = _known.msg_ids.standard(msg_id), self.function_code
            arguments = ARGUMENTS.get(key)
            if arguments is not None and 0 < arguments.size <= len(payload):
                return command_arguments(*key)
        found = None if _known.routes else detect(payload)
        return ENVELOPES[found] if found else Raw


class CommandHeader(_Secondary):
    """cFE command header."""

    name = cfe.COMMAND.title
    fields_desc = fields(cfe.COMMAND, checksum=None)


class TelemetryHeader(_Secondary):
    """cFE telemetry header."""

    name = cfe.TELEMETRY.title
    fields_desc = fields(cfe.TELEMETRY)


class ExtendedCommandHeader(_Secondary):
    """cFE command header behind an extended one."""

    name = cfe.COMMAND_EXTENDED.title
    fields_desc = fields(cfe.COMMAND_EXTENDED, checksum=None)


class ExtendedTelemetryHeader(_Secondary):
    """cFE telemetry header behind an extended one."""

    name = cfe.TELEMETRY_EXTENDED.title
    fields_desc = fields(cfe.TELEMETRY_EXTENDED)


class ShortTelemetryHeader(_Secondary):
    """cFE telemetry header of older builds."""

    name = cfe.TELEMETRY_SHORT.title
    fields_desc = fields(cfe.TELEMETRY_SHORT)


@cache
def command_arguments(msg_id: int, function_code: int) -> type[Packet]:
    """Return the layer of a command's arguments, which follows its header.

    Args:
        msg_id: of version 1.

    Raises:
        KeyError: no such command is known.
    """
    layout = ARGUMENTS[msg_id, function_code]
    described: list[Any] = fields(layout)
    for place, item in enumerate(described):
        if item.name == "spare":
            item.name = f"spare{place}"  # scapy takes a name once
    members = {
        "__module__": __name__,
        "__doc__": layout.title,
        "name": layout.title,
        "fields_desc": described,
    }
    return type(layout.name, (Packet,), members)


class Event(Packet):  # type: ignore[misc]
    """Payload of a cFE event."""

    name = cfe.EVENT.title
    fields_desc = fields(cfe.EVENT)


class SoftwareBusHousekeeping(Packet):  # type: ignore[misc]
    """Payload of the software bus's housekeeping."""

    name = cfe.SOFTWARE_BUS_HOUSEKEEPING.title
    fields_desc = fields(cfe.SOFTWARE_BUS_HOUSEKEEPING)


class _Envelope(Packet):  # type: ignore[misc]
    """The EDORAS envelope of one format."""

    name = "EDORAS Envelope"
    format = DEFAULT

    def post_build(self, header: bytes, payload: bytes) -> bytes:
        """Fill in the lengths: of the CDR, not of what follows it."""
        behind = len(bytes(self.payload.payload)) if isinstance(self.payload, CDR) else 0
        length = len(payload) - behind
        for name in ("buffer_length", "buffer_capacity"):
            if name in self.format.layout.by_name and self.getfieldval(name) is None:
                header = put(header, self.format.layout, name, length)
        if self.format.crc and not behind:
            payload += self.format.check(header + payload).to_bytes(self.format.crc, self.format.byte_order)
        return header + payload

    def guess_payload_class(self, payload: bytes) -> type[Packet]:
        """Choose CDR where it is whole."""
        return CDR if ENCAPSULATION.size <= self.buffer_length <= len(payload) else Raw


@cache
def envelope(chosen: EnvelopeFormat) -> type[Packet]:
    """Return the envelope layer of a format; a CRC is the payload of its CDR, written where that has none."""
    suffix = "" if chosen == DEFAULT else f"{8 * chosen.width}{chosen.byte_order.title()}"
    suffix = "Own" if chosen.own else suffix
    lengths = {slot.field.name: None for slot in chosen.layout.slots if slot.field.name.startswith("buffer_")}
    members = {
        "__module__": __name__,
        "__doc__": f"The EDORAS envelope, {chosen}.",
        "format": chosen,
        "fields_desc": fields(chosen.layout, **lengths),
    }
    return type(f"EdorasEnvelope{suffix}", (_Envelope,), members)


ENVELOPES: Final = {item: envelope(item) for item in ENVELOPE_FORMATS}
"""The envelope layer of each format."""
EdorasEnvelope = ENVELOPES[DEFAULT]


class _Body(StrLenField):  # type: ignore[misc]
    """A CDR body, shown as the ROS message that it is where that is known."""

    def i2repr(self, packet: Any, value: Any) -> str:
        """Return the type and the values, or the bytes."""
        values = packet.values
        return repr(value) if values is None else f"{packet.type}: {values}"


class CDR(Packet):  # type: ignore[misc]
    """A ROS 2 message: encapsulation and body; what a fixed-size struct leaves behind it is its payload."""

    name = ENCAPSULATION.title
    fields_desc = [  # noqa: RUF012  scapy's way
        *fields(ENCAPSULATION, representation=CDR_LE),
        _Body("body", b"", length_from=lambda packet: packet.body_length()),
    ]

    @classmethod
    def of(cls, type_name: str, values: Mapping[str, Any], *, big_endian: bool = False) -> CDR:
        """Return a message from plain values; :func:`use` must have been given types."""
        if _known.types is None:
            raise ValueError("no types are known: scapy_layers.use(routes, TypeStore())")
        return cls(_known.types.encode(type_name, values, big_endian=big_endian))

    def body_length(self) -> int:
        """Return the bytes of the body that the envelope promises, or all."""
        if isinstance(self.underlayer, _Envelope):
            return int(self.underlayer.buffer_length) - ENCAPSULATION.size
        return 1 << 31

    @property
    def type(self) -> str | None:
        """The configured ROS type, or None."""
        packet = self.underlayer
        while packet is not None and not isinstance(packet, SpacePacket):
            packet = packet.underlayer
        return _known.routes.get(packet.msg_id) if packet is not None else None

    @property
    def values(self) -> dict[str, Any] | None:
        """The message as plain values, or None where its type is not known or it is not valid."""
        from edoras_tools.errors import EdorasError

        if self.type is None or _known.types is None:
            return None
        try:
            return _known.types.decode(self.type, self.self_build())
        except EdorasError:
            return None


class SBN(Packet):  # type: ignore[misc]
    """Software Bus Network header."""

    name = sbn.HEADER.title
    fields_desc = fields(sbn.HEADER, msg_size=None, msg_type=sbn.MsgType.APP)
    layout = sbn.HEADER
    match_subclass = True  # packet[SBN] finds the older header too

    @classmethod
    def dispatch_hook(cls, raw: bytes | None = None, *_args: Any, **_values: Any) -> type[Packet]:
        """Choose the older 7-byte header where its size fits, and so does what then follows it."""
        if cls is SBN and raw and _is_legacy(raw):
            return SBNLegacy
        return cls

    def post_build(self, header: bytes, payload: bytes) -> bytes:
        """Fill in the size."""
        if self.msg_size is None:
            header = put(header, self.layout, "msg_size", len(payload))
        return header + payload

    def guess_payload_class(self, payload: bytes) -> type[Packet]:
        """Choose by MsgType, where there is enough for it."""
        chosen, layout = _MESSAGES.get(self.msg_type, (Raw, None))
        return chosen if layout is not None and len(payload) >= layout.size else Raw


class SBNLegacy(SBN):
    """The header of older sources: no SpacecraftID."""

    name = sbn.LEGACY_HEADER.title
    fields_desc = fields(sbn.LEGACY_HEADER, msg_size=None, msg_type=sbn.MsgType.APP)
    layout = sbn.LEGACY_HEADER


class SBNSubscription(Packet):  # type: ignore[misc]
    """One entry of a SUB or UNSUB."""

    name = sbn.SUBSCRIPTION.title
    fields_desc = fields(sbn.SUBSCRIPTION)

    def extract_padding(self, raw: bytes) -> tuple[bytes, bytes]:
        """Leave the rest to the next entry."""
        return b"", raw


class SBNSubscriptions(Packet):  # type: ignore[misc]
    """Payload of SUB and UNSUB."""

    name = sbn.SUBSCRIPTIONS.title
    fields_desc = [  # noqa: RUF012  scapy's way
        *fields(sbn.SUBSCRIPTIONS, ident=sbn.IDENT, count=None),
        PacketListField("subscriptions", [], SBNSubscription, count_from=lambda packet: packet.whole()),
    ]

    def whole(self) -> int:
        """Return how many entries are there whole; what is left of a cut one stays raw."""
        there = len(self.original) - sbn.SUBSCRIPTIONS.size if self.original else 0
        return min(int(self.count or 0), there // sbn.SUBSCRIPTION.size)

    def post_build(self, header: bytes, payload: bytes) -> bytes:
        """Fill in the count."""
        if self.count is None:
            header = put(header, sbn.SUBSCRIPTIONS, "count", len(self.subscriptions))
        return header + payload


class SBNProto(Packet):  # type: ignore[misc]
    """Payload of PROTO."""

    name = sbn.PROTO.title
    fields_desc = fields(sbn.PROTO, protocol_version=sbn.PROTOCOL_VERSION)


def _of_link(name: str, title: str) -> Layout:
    """Return a header of a link that is an add-on; one without fields where that is not installed."""
    layouts = (layout for link in table.links() if not link.wireshark for layout in link.layouts)
    return next((layout for layout in layouts if layout.name == name), Layout(name, title))


class RACS2(Packet):  # type: ignore[misc]
    """A message of RACS2 to ROS 2, as a WebSocket frame holds it, unmasked."""

    name = "RACS2 to ROS 2"
    fields_desc = fields(_of_link("racs2_topic", name))

    @classmethod
    def dispatch_hook(cls, raw: bytes | None = None, *_args: Any, **_values: Any) -> type[Packet]:
        """Choose the header to cFS where the first bytes can be a MsgId."""
        if cls is RACS2 and raw and raw[0] <= cfe.HIGHEST_MSG_ID >> 8:
            return RACS2Message
        return cls


class RACS2Message(RACS2):
    """A message of RACS2 to cFS."""

    name = "RACS2 to cFS"
    fields_desc = fields(_of_link("racs2_message", name))


_MESSAGES: Final[Mapping[int, tuple[type[Packet], Layout]]] = {
    sbn.MsgType.SUB: (SBNSubscriptions, sbn.SUBSCRIPTIONS),
    sbn.MsgType.UNSUB: (SBNSubscriptions, sbn.SUBSCRIPTIONS),
    sbn.MsgType.APP: (SpacePacket, ccsds.PRIMARY),
    sbn.MsgType.PROTO: (SBNProto, sbn.PROTO),
}


def _is_legacy(raw: bytes) -> bool:
    at = sbn.LEGACY_HEADER.size
    if len(raw) < at:
        return False
    head = sbn.LEGACY_HEADER.parse(raw)
    kind, size = head["msg_type"], len(raw) - at
    if head["msg_size"] != size or kind not in sbn.MSG_TYPE_NAMES:
        return False
    if kind == sbn.MsgType.APP:
        whole = size >= ccsds.PRIMARY.size
        return whole and ccsds.PRIMARY.parse(raw, at)["packet_data_length"] + ccsds.LENGTH_BIAS == size
    if kind == sbn.MsgType.PROTO:
        return size == sbn.PROTO.size
    if kind in {sbn.MsgType.SUB, sbn.MsgType.UNSUB}:
        return raw[at : at + 1] == b"$"
    return size == 0


def _bind(layers: Sequence[type[Packet]], **flags: int) -> None:
    """Set the primary header's bits when a cFE header is put on it."""
    for layer in layers:
        bind_top_down(SpacePacket, layer, secondary_header_flag=1, **flags)


@cache
def _first(link: LinkProtocol) -> type[Packet]:
    """Return the first layer of a link: its header, made from its layouts, or the space packet."""
    if not link.layouts or link.layouts[0] is sbn.HEADER:
        return SBN if link.layouts else SpacePacket
    following: type[Packet] = SpacePacket if link.packets else Raw
    for layout in reversed(link.layouts):
        made = {"name": layout.title, "fields_desc": fields(layout), "__module__": __name__}
        made["guess_payload_class"] = lambda _self, _payload, then=following: then
        following = type("".join(word.title() for word in layout.name.split("_")), (Packet,), made)
    return following


_bind((CommandHeader,), packet_type=ccsds.TELECOMMAND_TYPE)
_bind((TelemetryHeader, ShortTelemetryHeader), packet_type=ccsds.TELEMETRY_TYPE)
bind_top_down(SBN, SBNSubscriptions, msg_type=sbn.MsgType.SUB)
bind_top_down(SBN, SBNProto, msg_type=sbn.MsgType.PROTO)
bind_top_down(UDP, SpacePacket, sport=1235, dport=1234)
bind_top_down(UDP, SBN, sport=2236, dport=2234)
# Of TCP, a segment that begins with a message, as those in what these tools write.
for _port in next(link for link in _LINKS if link.peers).transport.ports:
    bind_bottom_up(TCP, SBN, dport=_port)
    bind_bottom_up(TCP, SBN, sport=_port)
# In front of all others: a source port that means something else elsewhere must not win.
UDP.payload_guess[:0] = [
    *(({"dport": port}, _first(link)) for link in reversed(_LINKS) for port in link.transport.ports),
    *(
        ({"sport": port}, _first(link))
        for link in _LINKS
        if link.sender_port
        for port in link.transport.ports
    ),
]
