"""Datagrams made wrong on purpose: each function takes the bytes and returns them with one thing wrong.

Where a datagram does not have the field, it comes back as it was, and nothing is reported.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

from edoras_tools.model import Link
from edoras_tools.sessions.fault_chance import draw
from edoras_tools.wire import ccsds, cdr, cfe, envelope, sbn

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from edoras_tools.sessions.fault_values import Change
    from edoras_tools.wire.layout import Layout


class Wronged(NamedTuple):
    """What became of a datagram.

    Attributes:
        payload: its bytes; the very same object where nothing could be done.
        detail: what was changed, as ``packet_data_length 69 -> 70``.
    """

    payload: bytes
    detail: str


class Chance(NamedTuple):
    """Random bits for one datagram: see :func:`~edoras_tools.sessions.fault_chance.draw`."""

    key: int
    number: int

    def bits(self, salt: int) -> int:
        """Return 64 of them."""
        return draw(self.key, self.number, salt)


def packet_offset(payload: bytes, link: Link) -> int:
    """Return where the space packet starts, -1 where there is none."""
    at = 0
    if link is Link.SBN:
        if len(payload) <= sbn.HEADER.size or payload[2] != sbn.MsgType.APP:
            return -1
        at = sbn.HEADER.size
    return at if len(payload) - at >= ccsds.PRIMARY.size else -1


def corrupt(payload: bytes, link: Link, values: Mapping[str, Any], chance: Chance) -> Wronged:
    """Turn bits over, each at another place as long as there are so many."""
    del link
    total = 8 * len(payload)
    places: dict[int, None] = {}
    salt = 0
    while len(places) < min(values["bits"], total):
        salt += 1
        places[chance.bits(salt) % total] = None
    data = bytearray(payload)
    for place in places:
        data[place // 8] ^= 0x80 >> place % 8
    shown = ", ".join(map(str, sorted(places)[:8])) + (" ..." if len(places) > 8 else "")
    return Wronged(bytes(data), f"bit {shown} turned over") if places else Wronged(payload, "")


def truncate(payload: bytes, link: Link, values: Mapping[str, Any], chance: Chance) -> Wronged:
    """Cut the datagram."""
    del link, chance
    left = values["bytes"]
    if len(payload) <= left:
        return Wronged(payload, "")
    return Wronged(payload[:left], f"cut from {len(payload)} to {left} bytes")


def pad(payload: bytes, link: Link, values: Mapping[str, Any], chance: Chance) -> Wronged:
    """Put zero bytes behind the datagram, up to the most that UDP carries."""
    del link, chance
    added = min(values["bytes"], _LARGEST - len(payload))
    return Wronged(payload + bytes(added), f"{added} bytes added") if added > 0 else Wronged(payload, "")


def checksum(payload: bytes, link: Link, values: Mapping[str, Any], chance: Chance) -> Wronged:
    """Write a checksum that the packet does not have."""
    del values, chance
    at = packet_offset(payload, link)
    if at < 0 or not cfe.is_command(int.from_bytes(payload[at : at + 2], "big")):
        return Wronged(payload, "")
    if len(payload) - at < cfe.COMMAND_HEADER_BYTES:
        return Wronged(payload, "")
    place = at + cfe.COMMAND_HEADER_BYTES - 1
    right = cfe.checksum(payload[at:place] + b"\0" + payload[place + 1 :])
    return _written(payload, place, bytes([right ^ 0xFF]), "checksum", payload[place], right ^ 0xFF, base=16)


def sequence_ahead(payload: bytes, link: Link, ahead: int) -> Wronged:
    """Write a sequence count that is so many ahead."""
    at = packet_offset(payload, link)
    if at < 0 or not ahead:
        return Wronged(payload, "")
    count = int(ccsds.PRIMARY.read(_SEQUENCE, payload, at))
    return _rewritten(payload, at, ccsds.PRIMARY, _SEQUENCE.field.name, (count + ahead) & _SEQUENCE.mask)


def _of_packet(layout: Layout, name: str) -> Callable[[bytes, Link, Mapping[str, Any], Chance], Wronged]:
    def wrong(payload: bytes, link: Link, values: Mapping[str, Any], chance: Chance) -> Wronged:
        del chance
        return _changed(payload, packet_offset(payload, link), layout, name, values["value"])

    return wrong


def _of_network(name: str) -> Callable[[bytes, Link, Mapping[str, Any], Chance], Wronged]:
    def wrong(payload: bytes, link: Link, values: Mapping[str, Any], chance: Chance) -> Wronged:
        del chance
        return _changed(payload, 0 if link is Link.SBN else -1, sbn.HEADER, name, values["value"])

    return wrong


def _of_envelope(name: str) -> Callable[[bytes, Link, Mapping[str, Any], Chance], Wronged]:
    def wrong(payload: bytes, link: Link, values: Mapping[str, Any], chance: Chance) -> Wronged:
        del chance
        at, found = _envelope(payload, link)
        return _changed(payload, at, found.layout, name, values["value"])

    return wrong


def _encapsulation(payload: bytes, link: Link, values: Mapping[str, Any], chance: Chance) -> Wronged:
    del chance
    at, found = _envelope(payload, link)
    at = at + found.size if at >= 0 else -1
    return _changed(payload, at, cdr.ENCAPSULATION, "representation", values["value"])


CONTENT: Final[Mapping[str, Callable[[bytes, Link, Mapping[str, Any], Chance], Wronged]]] = {
    "corrupt": corrupt,
    "truncate": truncate,
    "pad": pad,
    "checksum": checksum,
    "packet-length": _of_packet(ccsds.PRIMARY, "packet_data_length"),
    "envelope-length": _of_envelope("buffer_length"),
    "envelope-capacity": _of_envelope("buffer_capacity"),
    "encapsulation": _encapsulation,
    "sbn-size": _of_network("msg_size"),
    "sbn-type": _of_network("msg_type"),
    "sbn-processor": _of_network("processor_id"),
    "sbn-spacecraft": _of_network("spacecraft_id"),
}
"""By the name of the kind."""

_LARGEST: Final = 65507
"""Bytes that UDP over IPv4 carries."""
_SEQUENCE: Final = ccsds.PRIMARY.by_name["packet_sequence_count"]


def _envelope(payload: bytes, link: Link) -> tuple[int, envelope.EnvelopeFormat]:
    """Return where the envelope starts, -1 where there is none, and its format, told from the bytes."""
    at = packet_offset(payload, link)
    if at < 0:
        return -1, envelope.DEFAULT
    command = cfe.is_command(int.from_bytes(payload[at : at + 2], "big"))
    at += cfe.COMMAND_HEADER_BYTES if command else cfe.TELEMETRY_HEADER_BYTES
    found = envelope.detect(payload, at)
    return (-1, envelope.DEFAULT) if found is None else (at, found)


def _changed(payload: bytes, at: int, layout: Layout, name: str, change: Change) -> Wronged:
    """Change one field of a header at ``at``; negative: there is none."""
    if at < 0 or len(payload) - at < layout.size:
        return Wronged(payload, "")
    slot = layout.by_name[name]
    value = change.apply(layout.read(slot, payload, at)) & slot.mask
    return _rewritten(payload, at, layout, name, value)


def _rewritten(payload: bytes, at: int, layout: Layout, name: str, value: int) -> Wronged:
    """Write one field, its bits alone."""
    slot = layout.by_name[name]
    before = layout.read(slot, payload, at)
    start, end = at + slot.start, at + slot.end
    word = int.from_bytes(payload[start:end], layout.byte_order)
    word = word & ~(slot.mask << slot.shift) | (value & slot.mask) << slot.shift
    data = word.to_bytes(end - start, layout.byte_order)
    now = layout.read(slot, data.rjust(slot.end, b"\0"), 0) if slot.start == 0 else value
    return _written(payload, start, data, name, before, now, base=slot.field.base)


def _written(
    payload: bytes, start: int, data: bytes, name: str, before: int, after: int, *, base: int
) -> Wronged:
    if payload[start : start + len(data)] == data:
        return Wronged(payload, "")
    shown = [f"0x{item:02x}" if base == 16 else str(item) for item in (before, after)]
    return Wronged(payload[:start] + data + payload[start + len(data) :], f"{name} {shown[0]} -> {shown[1]}")
