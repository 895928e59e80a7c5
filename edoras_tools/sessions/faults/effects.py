"""The effect of each kind of fault on a datagram, with its state between datagrams.

A fault in the bytes of a datagram is a function, which returns the bytes with the fault. A datagram without
the field is returned unchanged, and nothing is reported.

Random numbers are repeatable: the n-th follows from the seed and n alone. They are a function of a counter
(the finaliser of SplitMix64), not a sequential generator: the result for a datagram does not depend on its
time or its neighbours, and a batch is decided at once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
import numpy as np

from edoras_tools.sessions.sequence import MODULUS
from edoras_tools.wire import ccsds, cfe, envelope, sbn
from edoras_tools.wire.ccsds import VERSION_1

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.model import Link
    from edoras_tools.sessions.faults.rules import Rule
    from edoras_tools.wire.cfe import Headers
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


_HEADERS: Final = 28
"""Bytes of the IPv4 and UDP headers, which a line carries, too."""
_SALT_JITTER: Final = 1


class Pending(msgspec.Struct, eq=False):
    """A datagram while it passes through the rules.

    Attributes:
        payload: present bytes.
        due_ns: time at which it is to be sent.
        stream: number of its sender.
        to_cfs: whether it goes to cFS.
        room: memory in bytes that it takes while it is held back; 0 otherwise.
        sent: whether it was already sent.
    """

    payload: bytes
    due_ns: int
    stream: int
    to_cfs: bool
    room: int = 0
    sent: bool = False


class Received(NamedTuple):
    """A datagram and the circumstances in which an effect gets it.

    Attributes:
        link: link of the datagram.
        to_cfs: whether it goes to cFS.
        stream: number of its sender.
        msg_id: its MsgId, or ``NO_MSG_ID``.
        now: present time, ns.
        struck: whether the rule strikes it; if not, the effect has state from an earlier datagram.
        chance: random bits for the datagram.
    """

    link: Link
    to_cfs: bool
    stream: int
    msg_id: int
    now: int
    struck: bool
    chance: Chance


class Outcome(NamedTuple):
    """The result of an effect.

    Attributes:
        items: datagrams that continue.
        detail: description of the change; empty if there is none.
        lost: the datagram that was changed, if it is an earlier one.
    """

    items: list[Pending]
    detail: str = ""
    lost: bytes | None = None


class Effect:
    """The effect of one rule in one run.

    Attributes:
        outlasts: whether a strike may also change later datagrams.
        switched_ns: time at which it was last enabled by hand.
    """

    outlasts = False

    def __init__(self, rule: Rule) -> None:
        self.schedule = rule.schedule
        self.values: Mapping[str, Any] = rule.values
        self.switched_ns: int | None = None

    def may_strike(self, elapsed: int, now: int) -> bool:
        """Return whether the rule may strike now."""
        return self.schedule.active(elapsed)

    def watches(self, to_cfs: bool, stream: int, now: int) -> bool:
        """Return whether it also acts on datagrams that it does not strike."""
        return False

    def act(self, items: list[Pending], received: Received) -> Outcome:
        """Apply the rule to a datagram."""
        raise NotImplementedError


class _Drop(Effect):
    def act(self, items: list[Pending], received: Received) -> Outcome:
        return Outcome([], "dropped")


class _Silence(Effect):
    """Each strike begins a silence if a probability or a count is set; otherwise the schedule does."""

    def __init__(self, rule: Rule) -> None:
        super().__init__(rule)
        self._begun_by_strikes = self.schedule.probability < 1 or bool(self.schedule.every)
        self.outlasts = self._begun_by_strikes
        self._until = -1

    def may_strike(self, elapsed: int, now: int) -> bool:
        if self._begun_by_strikes:
            return self.schedule.active(elapsed)
        schedule = self.schedule
        if self.switched_ns is not None and not schedule.from_ns:
            since = now - self.switched_ns
        else:
            since = elapsed - schedule.from_ns
        if schedule.period_ns and since >= 0:
            since %= schedule.period_ns
        return 0 <= since < int(self.values["time"])

    def watches(self, to_cfs: bool, stream: int, now: int) -> bool:
        return now < self._until

    def act(self, items: list[Pending], received: Received) -> Outcome:
        if received.struck and self._begun_by_strikes:
            self._until = max(self._until, received.now + self.values["time"])
        if received.struck or received.now < self._until:
            return Outcome([], "dropped in a silence")
        return Outcome(items)


class _Content(Effect):
    def __init__(self, rule: Rule, headers: Headers) -> None:
        super().__init__(rule)
        self._wrong = CONTENT[rule.kind.name]
        self._headers = headers

    def act(self, items: list[Pending], received: Received) -> Outcome:
        detail = ""
        struck = Struck(received.link, self.values, received.chance, self._headers)
        for item in items:
            item.payload, detail = self._wrong(item.payload, struck)
        return Outcome(items, detail)


class _Sequence(Effect):
    outlasts = True

    def __init__(self, rule: Rule) -> None:
        super().__init__(rule)
        self._ahead: dict[tuple[bool, int, int], int] = {}

    def watches(self, to_cfs: bool, stream: int, now: int) -> bool:
        return bool(self._ahead)

    def act(self, items: list[Pending], received: Received) -> Outcome:
        key = (received.to_cfs, received.stream, received.msg_id)
        if received.struck and received.msg_id >= 0:
            self._ahead[key] = (self._ahead.get(key, 0) + self.values["by"]) % MODULUS
        detail = ""
        for item in items:
            item.payload, detail = sequence_ahead(item.payload, received.link, self._ahead.get(key, 0))
        return Outcome(items, detail if received.struck else "")


class _Duplicate(Effect):
    def act(self, items: list[Pending], received: Received) -> Outcome:
        copies = self.values["copies"]
        more = [
            Pending(item.payload, item.due_ns, received.stream, received.to_cfs)
            for item in items
            for _ in range(copies)
        ]
        return Outcome(items + more, f"sent {copies + 1} times" if items else "")


class _Rate(Effect):
    """One datagram each ``1 / hz``; an excess one waits for the next slot (latest) or is dropped (first)."""

    def __init__(self, rule: Rule) -> None:
        super().__init__(rule)
        self._period = int(1e9 / self.values["hz"])
        self._next: dict[tuple[bool, int], int] = {}
        self._waiting: dict[tuple[bool, int], Pending] = {}

    def act(self, items: list[Pending], received: Received) -> Outcome:
        if not items:
            return Outcome(items)
        (item,) = items  # copies are made later
        key = (received.to_cfs, received.msg_id if self.values["per"] == "msg_id" else -1)
        limit = f"over {self.values['hz']:g} Hz"
        due = self._next.get(key, received.now)
        if received.now >= due:
            # Slots stay on their time grid while datagrams keep coming; missed slots are not used later.
            begins = due if received.now < due + self._period else received.now
            self._next[key] = begins + self._period
            return Outcome(items)
        if self.values["keep"] == "first":
            return Outcome([], f"dropped: {limit}")
        waiting = self._waiting.get(key)
        if waiting is not None and waiting.room and not waiting.sent:
            lost, waiting.payload = waiting.payload, item.payload
            return Outcome([], f"dropped for a later one: {limit}", lost)
        item.due_ns = due
        self._waiting[key] = item
        self._next[key] = due + self._period
        return Outcome(items, f"held back: {limit}")


class _Burst(Effect):
    """Time is divided into intervals; datagrams that arrive in one are sent at its end."""

    def act(self, items: list[Pending], received: Received) -> Outcome:
        piece = max(self.values["time"], 1)
        for item in items:
            item.due_ns = max(item.due_ns, (received.now // piece + 1) * piece)
        return Outcome(items, "held back for a burst" if items else "")


class _Reorder(Effect):
    outlasts = True

    def __init__(self, rule: Rule) -> None:
        super().__init__(rule)
        self._waiting: dict[tuple[bool, int], list[tuple[Pending, list[int]]]] = {}

    def watches(self, to_cfs: bool, stream: int, now: int) -> bool:
        return bool(self._waiting.get((to_cfs, stream)))

    def act(self, items: list[Pending], received: Received) -> Outcome:
        waiting = self._waiting.setdefault((received.to_cfs, received.stream), [])
        if received.struck and items:
            for item in items:
                item.due_ns = received.now + self.values["within"]
                waiting.append((item, [self.values["by"]]))
            return Outcome(items, f"held back until {self.values['by']} overtook it")
        if items:
            for item, countdown in list(waiting):
                countdown[0] -= 1
                if item.sent or not countdown[0]:
                    waiting.remove((item, countdown))
                    if not item.sent:
                        item.sent = True
                        items.append(Pending(item.payload, received.now, received.stream, received.to_cfs))
        return Outcome(items)


class _Bandwidth(Effect):
    """A line that carries one datagram at a time in each direction, with a queue before it."""

    def __init__(self, rule: Rule) -> None:
        super().__init__(rule)
        self._free: dict[bool, int] = {}

    def act(self, items: list[Pending], received: Received) -> Outcome:
        rate, queue = self.values["rate"], self.values["queue"]
        passed, detail = [], ""
        for item in items:
            begins = max(item.due_ns, self._free.get(received.to_cfs, 0))
            waiting = (begins - item.due_ns) * rate / 8e9
            if waiting > queue:
                detail = f"dropped: over {queue} bytes wait for the line"
                continue
            ends = begins + int((len(item.payload) + _HEADERS) * 8e9 / rate)
            detail = detail or f"{(ends - item.due_ns) / 1e6:.3f} ms on the line"
            self._free[received.to_cfs] = item.due_ns = ends
            passed.append(item)
        return Outcome(passed, detail)


class _Delay(Effect):
    def act(self, items: list[Pending], received: Received) -> Outcome:
        for item in items:
            item.due_ns += self.values["time"]
        return Outcome(items, f"{self.values['time'] / 1e6:g} ms late" if items else "")


class _Jitter(Effect):
    def __init__(self, rule: Rule) -> None:
        super().__init__(rule)
        self._last: dict[tuple[bool, int], int] = {}

    def act(self, items: list[Pending], received: Received) -> Outcome:
        key = (received.to_cfs, received.stream)
        late = int(self.values["time"] * fraction(received.chance.bits(_SALT_JITTER)))
        for item in items:
            self._last[key] = item.due_ns = max(item.due_ns + late, self._last.get(key, 0))
        return Outcome(items, f"{late / 1e6:.3f} ms late" if items else "")


_EFFECTS: Final[Mapping[str, type[Effect]]] = {
    "drop": _Drop,
    "silence": _Silence,
    "sequence": _Sequence,
    "duplicate": _Duplicate,
    "rate": _Rate,
    "burst": _Burst,
    "reorder": _Reorder,
    "bandwidth": _Bandwidth,
    "delay": _Delay,
    "jitter": _Jitter,
}


def effect_of(rule: Rule, headers: Headers) -> Effect:
    """Return the effect of a rule for one run, on packets with these headers."""
    effect = _EFFECTS.get(rule.kind.name)
    return _Content(rule, headers) if effect is None else effect(rule)
