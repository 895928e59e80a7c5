"""Many RTPS messages in columns: their submessages, and the samples in these.

All messages of a batch are read in parallel: each step reads the next submessage of every message. At most
``MOST_SUBMESSAGES`` are read of a message, and ``MOST_PARAMETERS`` of inline QoS.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from edoras_tools.addons.rtps.wire import headers as rtps
from edoras_tools.units import SECOND
from edoras_tools.wire.arrays import gather

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.wire.arrays import Integers, Mask, Octets

MOST_SUBMESSAGES: Final = 1 << 10
MOST_PARAMETERS: Final = 1 << 6
NO_TIME: Final = -1
NOWHERE: Final = -1
"""A position that does not exist."""
_HEAD: Final = rtps.SUBMESSAGE.little.size
_SENTINEL: Final = 1
_STAMP: Final = rtps.SUBMESSAGE_LAYOUTS[rtps.SubmessageKind.INFO_TS]
_PREFIX_AT: Final = rtps.RTPS_HEADER.by_name["guid_prefix"].start
_SOURCE_AT: Final = rtps.SUBMESSAGE_LAYOUTS[rtps.SubmessageKind.INFO_SRC].little.by_name["guid_prefix"].start
_DESTINATION_AT: Final = (
    rtps.SUBMESSAGE_LAYOUTS[rtps.SubmessageKind.INFO_DST].little.by_name["guid_prefix"].start
)


class Submessages(NamedTuple):
    """Submessages of some messages, in order; columns of one length.

    Attributes:
        row: i64 (n,), index of the message.
        start: i64 (n,), first byte in the data.
        end: i64 (n,), one past the last byte that exists.
        kind: u8 (n,), a ``SubmessageKind``, or another number.
        flags: u8 (n,), ``SubmessageFlag``.
        source: i64 (n,), position of the sending participant's GUID prefix.
        destination: i64 (n,), position of the receiving participant's GUID prefix; ``NOWHERE``: for all.
        time_ns: i64 (n,), time of writing, ns since 1970; ``NO_TIME`` if it is not given.
        whole: bool (n,), whether all its bytes exist.
    """

    row: Integers
    start: Integers
    end: Integers
    kind: Octets
    flags: Octets
    source: Integers
    destination: Integers
    time_ns: Integers
    whole: Mask

    def take(self, mask: NDArray[Any]) -> Submessages:
        """Return the submessages that a mask or indices select."""
        return Submessages(*(column[mask] for column in self))

    @property
    def little(self) -> Mask:
        """Whether each is little-endian: bool (n,)."""
        return np.asarray((self.flags & rtps.SubmessageFlag.LITTLE_ENDIAN) != 0)


class RtpsMessages(NamedTuple):
    """The contents of some messages.

    Attributes:
        submessages: all submessages.
        truncated: bool (n,), whether bytes of a message are missing.
        odd: bool (n,), whether a message has more submessages than are read.
    """

    submessages: Submessages
    truncated: Mask
    odd: Mask


def read_messages(data: Octets, offset: Integers, length: NDArray[np.integer[Any]]) -> RtpsMessages:
    """Read many messages; no contents can raise an error.

    Args:
        data: u8, contiguous buffer.
        offset: i64 (n,), first byte of each message.
        length: (n,), number of bytes that exist.
    """
    count = len(offset)
    end = offset + length
    truncated = length < rtps.RTPS_HEADER.size
    source, destination = offset + _PREFIX_AT, np.full(count, NOWHERE, np.int64)
    time_ns = np.full(count, NO_TIME, np.int64)
    place = offset + rtps.RTPS_HEADER.size
    active = np.flatnonzero(~truncated & (place < end))
    steps: list[tuple[NDArray[Any], ...]] = []
    while len(active) and len(steps) < MOST_SUBMESSAGES:
        room = end[active] - place[active] >= _HEAD
        truncated[active[~room]] = True
        active = active[room]
        at = place[active]
        head = gather(data, at, _HEAD)
        kind, flags = head[:, 0], head[:, 1]
        little = (flags & rtps.SubmessageFlag.LITTLE_ENDIAN) != 0
        size = _number(rtps.SUBMESSAGE, "octets_to_next_header", head, little)
        stop = at + _HEAD + size
        to_end = (size == 0) & ~_MAY_BE_EMPTY[kind]
        stop[to_end] = end[active[to_end]]
        whole = (stop <= end[active]) & (stop - at >= LEAST_BYTES[kind])
        no_time = (kind == rtps.SubmessageKind.INFO_TS) & ((flags & rtps.SubmessageFlag.NO_TIMESTAMP) != 0)
        whole |= no_time & (stop <= end[active])
        truncated[active[~whole]] = True
        stop = np.minimum(stop, end[active])
        for standard, target, inside in (
            (rtps.SubmessageKind.INFO_SRC, source, _SOURCE_AT),
            (rtps.SubmessageKind.INFO_DST, destination, _DESTINATION_AT),
        ):
            some = (kind == standard) & whole
            target[active[some]] = at[some] + inside
        some = np.flatnonzero((kind == rtps.SubmessageKind.INFO_TS) & whole & ~no_time)
        if len(some):
            stamps = gather(data, at[some], _STAMP.little.size)
            seconds, fraction = (
                _number(_STAMP, name, stamps, little[some]) for name in ("seconds", "fraction")
            )
            time_ns[active[some]] = seconds * SECOND + (fraction * SECOND >> 32)
        time_ns[active[no_time]] = NO_TIME
        steps.append(
            (active, at, stop, kind, flags, source[active], destination[active], time_ns[active], whole)
        )
        place[active] = stop
        active = active[place[active] < end[active]]
    odd = np.zeros(count, bool)
    odd[active] = True
    return RtpsMessages(_joined(steps), truncated, odd)


def _joined(steps: list[tuple[NDArray[Any], ...]]) -> Submessages:
    if not steps:
        none = np.zeros(0, np.int64)
        octets = np.zeros(0, np.uint8)
        return Submessages(none, none, none, octets, octets, none, none, none, np.zeros(0, bool))
    joined = Submessages(*(np.concatenate(column) for column in zip(*steps, strict=True)))
    return joined if len(steps) == 1 else joined.take(np.argsort(joined.row, kind="stable"))


def _least() -> Integers:
    least = np.full(256, _HEAD, np.int64)
    for kind, orders in rtps.SUBMESSAGE_LAYOUTS.items():
        least[kind] = orders.little.size
    return least


LEAST_BYTES: Final = _least()
"""Least size of a submessage of each kind, bytes."""
_MAY_BE_EMPTY: Final = np.isin(np.arange(256), rtps.EMPTY_KINDS)


def _number(orders: rtps.Orders, name: str, head: Octets, little: Mask) -> Integers:
    """Read a number from headers of both byte orders, i64 (n,)."""
    if little.all():
        return orders.little.column(name, head).astype(np.int64)
    return np.where(little, orders.little.column(name, head), orders.big.column(name, head)).astype(np.int64)


class SubmessageFields:
    """The fields of submessages of one kind.

    Args:
        data: u8, buffer of the submessages.
        submessages: submessages of that kind, all complete.
        kind: kind.
    """

    def __init__(self, data: Octets, submessages: Submessages, kind: rtps.SubmessageKind) -> None:
        self._orders, self._little = rtps.SUBMESSAGE_LAYOUTS[kind], submessages.little
        self._data, self._submessages = data, submessages
        self._head = gather(data, submessages.start, self._orders.little.size)

    def number(self, name: str) -> Integers:
        """Return a number, i64 (n,)."""
        return _number(self._orders, name, self._head, self._little)

    def sequence_number(self, name: str) -> Integers:
        """Return a sequence number, i64 (n,)."""
        return (self.number(f"{name}_high") << 32) + self.number(f"{name}_low")

    def guid(self, name: str) -> NDArray[np.void]:
        """Return the GUID of an endpoint, V16 (n,): ``writer_id`` at the source, ``reader_id`` at the target.

        If the destination is not given, the prefix is zero.
        """
        prefix = self._submessages.source if name == "writer_id" else self._submessages.destination
        # Reversed in an ACKNACK: it goes from the reader to the writer.
        if self._orders in _FROM_READERS:
            prefix = self._submessages.destination if name == "writer_id" else self._submessages.source
        slot = self._orders.little.by_name[name]
        out = np.zeros((len(prefix), rtps.GUID_BYTES), np.uint8)
        named_source = prefix != NOWHERE
        out[named_source, : rtps.PREFIX_BYTES] = gather(self._data, prefix[named_source], rtps.PREFIX_BYTES)
        out[:, rtps.PREFIX_BYTES :] = self._head[:, slot.start : slot.start + rtps.ENTITY_BYTES]
        return out.view(f"V{rtps.GUID_BYTES}")[:, 0]


_FROM_READERS: Final = (
    rtps.SUBMESSAGE_LAYOUTS[rtps.SubmessageKind.ACKNACK],
    rtps.SUBMESSAGE_LAYOUTS[rtps.SubmessageKind.NACK_FRAG],
)


class SampleData(NamedTuple):
    """The data in DATA and DATA_FRAG; columns of one length.

    Attributes:
        which: i64 (n,), index of the submessage.
        start: i64 (n,), first byte of the data in its encapsulation; for a fragment, of its part.
        end: i64 (n,), one past the last byte.
        fits: bool (n,), whether the header and the inline QoS are sound.
    """

    which: Integers
    start: Integers
    end: Integers
    fits: Mask

    def take(self, mask: NDArray[Any]) -> SampleData:
        """Return the data that a mask or indices select."""
        return SampleData(*(column[mask] for column in self))


def read_samples(data: Octets, submessages: Submessages, kind: rtps.SubmessageKind) -> SampleData:
    """Find the data of submessages, behind inline QoS.

    Args:
        data: u8, buffer of the submessages.
        submessages: all submessages of some messages.
        kind: ``DATA`` or ``DATA_FRAG``; cut submessages, and DATA without data, are left out.
    """
    members = (submessages.kind == kind) & submessages.whole
    if kind == rtps.SubmessageKind.DATA:
        members &= (submessages.flags & (rtps.SubmessageFlag.DATA | rtps.SubmessageFlag.KEY)) != 0
    which = np.flatnonzero(members)
    some = submessages.take(which)
    inline = SubmessageFields(data, some, kind).number("octets_to_inline_qos")
    start = some.start + rtps.INLINE_AT + inline
    # 8.3.7.2: a later version may add fields in between; fewer bytes than in this version are an error.
    least = some.start + rtps.SUBMESSAGE_LAYOUTS[kind].little.size
    fits = (start >= least) & (start <= some.end)
    start = np.where(fits, start, some.end)
    active = np.flatnonzero(fits & ((some.flags & rtps.SubmessageFlag.INLINE_QOS) != 0))
    fits[active] = False
    little = some.little
    for _ in range(MOST_PARAMETERS):
        active = active[start[active] + _HEAD <= some.end[active]]
        if not len(active):
            break
        head = gather(data, start[active], _HEAD)
        words = np.where(little[active, None], head.view("<u2"), head.view(">u2")).astype(np.int64)
        over = words[:, 0] == _SENTINEL
        start[active] += _HEAD + np.where(over, 0, words[:, 1])
        fits[active[over]] = True
        active = active[~over]
    start = np.where(fits, start, some.end)
    return SampleData(which, start, some.end, fits)


def sequence_set(data: bytes, at: int, end: int, *, little: bool, base: int, bits: int) -> list[int]:
    """Return the numbers of a sequence number set, or of a set of fragments (9.4.2.6, 9.4.2.8).

    Args:
        data: bytes that contain the set.
        at: position behind ``num_bits``.
        end: one past the submessage.
        little: whether the byte order is little-endian.
        base: number of the first bit.
        bits: number of bits; bits in missing words are ignored.
    """
    bits = min(bits, MOST_BITS, (end - at) // 4 * 32)
    order = "<u4" if little else ">u4"
    words = np.frombuffer(data, order, (bits + 31) // 32, at) if bits > 0 else np.zeros(0, order)
    set_bits = np.unpackbits(words.astype(">u4").view(np.uint8))[: max(bits, 0)]
    return [base + int(bit) for bit in np.flatnonzero(set_bits)]


MOST_BITS: Final = 256
"""Most bits of a valid set (8.3.5.5)."""


def guid_text(guid: bytes) -> str:
    """Return a GUID in the usual text form: ``0110..35.00000403``: prefix, entity id, in hex."""
    return f"{guid[: rtps.PREFIX_BYTES].hex()}.{guid[rtps.PREFIX_BYTES :].hex()}"
