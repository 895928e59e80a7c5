"""The effect of each kind of fault on a datagram, with its state between datagrams."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from edoras_tools.sessions.faults.bytes import CONTENT, Chance, Struck, fraction, sequence_ahead
from edoras_tools.sessions.sequence import MODULUS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from edoras_tools.model import Link
    from edoras_tools.sessions.faults.rules import Rule
    from edoras_tools.wire.cfe import Headers

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
