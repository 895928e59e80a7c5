"""Faults in the bytes of datagrams: each function returns the bytes with one fault.

A datagram without the field is returned unchanged, and nothing is reported.

Random numbers are repeatable: the n-th follows from the seed and n alone. They are a function of a counter
(the finaliser of SplitMix64), not a sequential generator: the result for a datagram does not depend on its
time or its neighbours, and a batch is decided at once.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from edoras_tools.wire import ccsds, cfe, envelope, sbn
from edoras_tools.wire.ccsds import VERSION_1

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from edoras_tools.model import Link
    from edoras_tools.wire.layout import Layout


class Altered(NamedTuple):
    """A datagram after a fault.

    Attributes:
        payload: bytes of the datagram; the same object if nothing was changed.
        detail: description of the change, e.g. ``packet_data_length 69 -> 70``.
    """

    payload: bytes
    detail: str


class Chance(NamedTuple):
    """Random bits for one datagram: see :func:`~edoras_tools.sessions.faults.bytes.draw`."""

    key: int
    number: int

    def bits(self, salt: int) -> int:
        """Return 64 random bits."""
        return draw(self.key, self.number, salt)


class Struck(NamedTuple):
    """The inputs of a fault besides the bytes.

    Attributes:
        link: link of the datagram.
        values: options of the rule.
        chance: random bits for this datagram.
        headers: headers of the cFE.
    """

    link: Link
    values: Mapping[str, Any]
    chance: Chance
    headers: cfe.Headers = cfe.STANDARD


def packet_offset(payload: bytes, link: Link) -> int:
    """Return the start of the space packet, -1 if there is none."""
    at = 0
    if link.peers:
        if len(payload) <= sbn.HEADER.size or payload[sbn.MSG_TYPE_AT] != sbn.MsgType.APP:
            return -1
        at = sbn.HEADER.size
    return at if len(payload) - at >= ccsds.PRIMARY.size else -1


def corrupt(payload: bytes, struck: Struck) -> Altered:
    """Invert bits, each at a different place if there are enough."""
    total = 8 * len(payload)
    places: dict[int, None] = {}
    salt = 0
    while len(places) < min(struck.values["bits"], total):
        salt += 1
        places[struck.chance.bits(salt) % total] = None
    data = bytearray(payload)
    for place in places:
        data[place // 8] ^= 0x80 >> place % 8
    listed = ", ".join(map(str, sorted(places)[:8])) + (" ..." if len(places) > 8 else "")
    return Altered(bytes(data), f"bit {listed} turned over") if places else Altered(payload, "")


def truncate(payload: bytes, struck: Struck) -> Altered:
    """Cut the datagram."""
    size = struck.values["bytes"]
    if len(payload) <= size:
        return Altered(payload, "")
    return Altered(payload[:size], f"cut from {len(payload)} to {size} bytes")


def pad(payload: bytes, struck: Struck) -> Altered:
    """Append zero bytes, up to the largest UDP payload."""
    added = min(struck.values["bytes"], _LARGEST - len(payload))
    return Altered(payload + bytes(added), f"{added} bytes added") if added > 0 else Altered(payload, "")


def break_checksum(payload: bytes, struck: Struck) -> Altered:
    """Write a wrong checksum."""
    at, headers = packet_offset(payload, struck.link), struck.headers
    if at < 0 or not VERSION_1.is_command(VERSION_1.of(payload, at)):
        return Altered(payload, "")
    if len(payload) - at < headers.command_bytes:
        return Altered(payload, "")
    place = at + headers.start + cfe.CHECKSUM_BYTE
    right = cfe.checksum(payload[at:place] + b"\0" + payload[place + 1 :])
    return _written(payload, place, bytes([right ^ 0xFF]), "checksum", payload[place], right ^ 0xFF, base=16)


def sequence_ahead(payload: bytes, link: Link, ahead: int) -> Altered:
    """Write a sequence count that is ``ahead`` too high."""
    at = packet_offset(payload, link)
    if at < 0 or not ahead:
        return Altered(payload, "")
    count = int(ccsds.PRIMARY.read(_SEQUENCE, payload, at))
    return _rewritten(payload, at, ccsds.PRIMARY, _SEQUENCE.field.name, (count + ahead) & _SEQUENCE.mask)


def _packet(payload: bytes, struck: Struck) -> tuple[int, Layout]:
    return packet_offset(payload, struck.link), ccsds.PRIMARY


def _network(payload: bytes, struck: Struck) -> tuple[int, Layout]:
    del payload
    return 0 if struck.link.peers else -1, sbn.HEADER


def _envelope(payload: bytes, struck: Struck) -> tuple[int, Layout]:
    """Return the place and layout of the envelope; its format is detected from the bytes."""
    at = packet_offset(payload, struck.link)
    if at < 0:
        return -1, envelope.DEFAULT.layout
    command = VERSION_1.is_command(VERSION_1.of(payload, at))
    at += struck.headers.command_bytes if command else struck.headers.telemetry_bytes
    form = envelope.detect(payload, at)
    return (-1, envelope.DEFAULT.layout) if form is None else (at, form.layout)


def _encapsulation(payload: bytes, struck: Struck) -> tuple[int, Layout]:
    at, layout = _envelope(payload, struck)
    return at + layout.size if at >= 0 else -1, envelope.ENCAPSULATION


def _wrong(
    header: Callable[[bytes, Struck], tuple[int, Layout]], name: str
) -> Callable[[bytes, Struck], Altered]:
    """Return the fault that changes one field.

    Args:
        header: returns the start of the header with the field, negative if there is none, and its layout.
    """

    def change(payload: bytes, struck: Struck) -> Altered:
        at, layout = header(payload, struck)
        if at < 0 or len(payload) - at < layout.size:
            return Altered(payload, "")
        slot = layout.by_name[name]
        value = struck.values["value"].apply(layout.read(slot, payload, at)) & slot.mask
        return _rewritten(payload, at, layout, name, value)

    return change


CONTENT: Final[Mapping[str, Callable[[bytes, Struck], Altered]]] = {
    "corrupt": corrupt,
    "truncate": truncate,
    "pad": pad,
    "checksum": break_checksum,
    "packet-length": _wrong(_packet, "packet_data_length"),
    "envelope-length": _wrong(_envelope, "buffer_length"),
    "envelope-capacity": _wrong(_envelope, "buffer_capacity"),
    "encapsulation": _wrong(_encapsulation, "representation"),
    "sbn-size": _wrong(_network, "msg_size"),
    "sbn-type": _wrong(_network, "msg_type"),
    "sbn-processor": _wrong(_network, "processor_id"),
    "sbn-spacecraft": _wrong(_network, "spacecraft_id"),
}
"""Functions that change bytes, by the name of the fault's kind."""

_LARGEST: Final = 65507
"""Largest payload of UDP over IPv4."""
_SEQUENCE: Final = ccsds.PRIMARY.by_name["packet_sequence_count"]


def _rewritten(payload: bytes, at: int, layout: Layout, name: str, value: int) -> Altered:
    """Write the bits of one field."""
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
) -> Altered:
    if payload[start : start + len(data)] == data:
        return Altered(payload, "")
    texts = [f"0x{item:02x}" if base == 16 else str(item) for item in (before, after)]
    return Altered(payload[:start] + data + payload[start + len(data) :], f"{name} {texts[0]} -> {texts[1]}")


_MASK: Final = (1 << 64) - 1
_GOLDEN: Final = 0x9E3779B97F4A7C15
_FIRST: Final = 0xBF58476D1CE4E5B9
_SECOND: Final = 0x94D049BB133111EB


def key_of(*parts: object) -> int:
    """Return a 64-bit key of one sequence of random numbers, from what identifies it."""
    from hashlib import blake2b

    return int.from_bytes(blake2b("|".join(map(str, parts)).encode(), digest_size=8).digest(), "little")


def draw(key: int, number: int, salt: int = 0) -> int:
    """Return 64 bits that look random.

    Args:
        key: key of the sequence.
        number: place in the sequence, from 0.
        salt: number that distinguishes several draws for one place.
    """
    value = (key + (number + 1) * _GOLDEN + salt * _SECOND) & _MASK
    value = ((value ^ value >> 30) * _FIRST) & _MASK
    value = ((value ^ value >> 27) * _SECOND) & _MASK
    return value ^ value >> 31


def draws(key: int, first: int, count: int) -> NDArray[np.uint64]:
    """Return ``draw(key, first)`` to ``draw(key, first + count - 1)``, u64 (count,)."""
    start = (key + (first + 1) * _GOLDEN) & _MASK
    value = np.uint64(start) + np.arange(count, dtype=np.uint64) * np.uint64(_GOLDEN)
    value = (value ^ value >> np.uint64(30)) * np.uint64(_FIRST)
    value = (value ^ value >> np.uint64(27)) * np.uint64(_SECOND)
    return value ^ value >> np.uint64(31)


def threshold(probability: float) -> int:
    """Return the limit below which a draw strikes, for a probability below 1."""
    return int(probability * (1 << 64))


def fraction(bits: int) -> float:
    """Return a draw as a number from 0 up to 1."""
    return bits / (1 << 64)
