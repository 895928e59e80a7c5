"""What each kind of fault does to a datagram, and what it keeps in mind from one to the next."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from edoras_tools.sessions.fault_bytes import CONTENT, Chance, sequence_ahead
from edoras_tools.sessions.fault_chance import fraction
from edoras_tools.sessions.sequence import MODULUS

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from edoras_tools.model import Link
    from edoras_tools.sessions.fault_rules import Rule

_HEADERS: Final = 28
"""Bytes of IPv4 and UDP headers, which a line carries too."""
_SALT_JITTER: Final = 1


@dataclass(slots=True, eq=False)
class Item:
    """A datagram under way through the rules.

    Attributes:
        payload: its bytes, as they are now.
        due_ns: when it is to go.
        stream: whose it is.
        to_cfs: which way it goes.
        room: bytes that it takes in the queue of what is held back; 0 while it is not in it.
        gone: it has gone already.
    """

    payload: bytes
    due_ns: int
    stream: int
    to_cfs: bool
    room: int = 0
    gone: bool = False


class Call(NamedTuple):
    """What an actor is told of a datagram.

    Attributes:
        link: which link it is on.
        to_cfs: which way it goes.
        stream: whose it is.
        msg_id: its MsgId, or ``NO_MSG_ID``.
        now: the time, ns.
        struck: the rule strikes it; else it is shown because the actor watches.
        chance: its random bits.
    """

    link: Link
    to_cfs: bool
    stream: int
    msg_id: int
    now: int
    struck: bool
    chance: Chance


class Acted(NamedTuple):
    """What an actor did.

    Attributes:
        items: what is left of the datagram.
        detail: what was done; empty where nothing was.
        lost: the datagram it was done to, where that is an earlier one.
    """

    items: list[Item]
    detail: str = ""
    lost: bytes | None = None


class Actor:
    """One rule at work.

    Attributes:
        lingers: after a strike, it may have to see the datagrams that follow.
        switched_ns: when it was last put in force by hand.
    """

    lingers = False

    def __init__(self, rule: Rule) -> None:
        self.schedule = rule.schedule
        self.values: Mapping[str, Any] = rule.values
        self.switched_ns: int | None = None

    def active(self, elapsed: int, now: int) -> bool:
        """Tell whether the rule may strike now."""
        del now
        return self.schedule.active(elapsed)

    def watches(self, to_cfs: bool, stream: int, now: int) -> bool:
        """Tell whether it must see what it does not strike."""
        del to_cfs, stream, now
        return False

    def act(self, items: list[Item], call: Call) -> Acted:
        """Do what the rule does."""
        raise NotImplementedError


class _Drop(Actor):
    def act(self, items: list[Item], call: Call) -> Acted:
        del items, call
        return Acted([], "dropped")


class _Silence(Actor):
    """With a probability or a count each strike begins a silence; else one begins with the schedule."""

    def __init__(self, rule: Rule) -> None:
        super().__init__(rule)
        self._begun_by_strikes = self.schedule.probability < 1 or bool(self.schedule.every)
        self.lingers = self._begun_by_strikes
        self._until = -1

    def active(self, elapsed: int, now: int) -> bool:
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
        del to_cfs, stream
        return now < self._until

    def act(self, items: list[Item], call: Call) -> Acted:
        if call.struck and self._begun_by_strikes:
            self._until = max(self._until, call.now + self.values["time"])
        if call.struck or call.now < self._until:
            return Acted([], "dropped in a silence")
        return Acted(items)


class _Content(Actor):
    def __init__(self, rule: Rule) -> None:
        super().__init__(rule)
        self._wrong: Callable[..., Any] = CONTENT[rule.kind.name]

    def act(self, items: list[Item], call: Call) -> Acted:
        detail = ""
        for item in items:
            item.payload, detail = self._wrong(item.payload, call.link, self.values, call.chance)
        return Acted(items, detail)


class _Sequence(Actor):
    lingers = True

    def __init__(self, rule: Rule) -> None:
        super().__init__(rule)
        self._ahead: dict[tuple[bool, int, int], int] = {}

    def watches(self, to_cfs: bool, stream: int, now: int) -> bool:
        del to_cfs, stream, now
        return bool(self._ahead)

    def act(self, items: list[Item], call: Call) -> Acted:
        key = (call.to_cfs, call.stream, call.msg_id)
        if call.struck and call.msg_id >= 0:
            self._ahead[key] = (self._ahead.get(key, 0) + self.values["by"]) % MODULUS
        detail = ""
        for item in items:
            item.payload, detail = sequence_ahead(item.payload, call.link, self._ahead.get(key, 0))
        return Acted(items, detail if call.struck else "")


class _Duplicate(Actor):
    def act(self, items: list[Item], call: Call) -> Acted:
        copies = self.values["copies"]
        more = [
            Item(item.payload, item.due_ns, call.stream, call.to_cfs) for item in items for _ in range(copies)
        ]
        return Acted(items + more, f"sent {copies + 1} times" if items else "")


class _Rate(Actor):
    """A slot each ``1 / hz``; what comes when the slot is taken waits for the next (latest) or is gone."""

    def __init__(self, rule: Rule) -> None:
        super().__init__(rule)
        self._period = int(1e9 / self.values["hz"])
        self._next: dict[tuple[bool, int], int] = {}
        self._waiting: dict[tuple[bool, int], Item] = {}

    def act(self, items: list[Item], call: Call) -> Acted:
        if not items:
            return Acted(items)
        (item,) = items  # copies are made later
        key = (call.to_cfs, call.msg_id if self.values["per"] == "msg_id" else -1)
        limit = f"over {self.values['hz']:g} Hz"
        due = self._next.get(key, call.now)
        if call.now >= due:
            # The rhythm is kept as long as nothing pauses; a slot that was missed is not made up for.
            begins = due if call.now < due + self._period else call.now
            self._next[key] = begins + self._period
            return Acted(items)
        if self.values["keep"] == "first":
            return Acted([], f"dropped: {limit}")
        waiting = self._waiting.get(key)
        if waiting is not None and waiting.room and not waiting.gone:
            lost, waiting.payload = waiting.payload, item.payload
            return Acted([], f"dropped for a later one: {limit}", lost)
        item.due_ns = due
        self._waiting[key] = item
        self._next[key] = due + self._period
        return Acted(items, f"held back: {limit}")


class _Burst(Actor):
    """Time is cut into pieces; what comes in one goes at its end."""

    def act(self, items: list[Item], call: Call) -> Acted:
        piece = max(self.values["time"], 1)
        for item in items:
            item.due_ns = max(item.due_ns, (call.now // piece + 1) * piece)
        return Acted(items, "held back for a burst" if items else "")


class _Reorder(Actor):
    lingers = True

    def __init__(self, rule: Rule) -> None:
        super().__init__(rule)
        self._waiting: dict[tuple[bool, int], list[tuple[Item, list[int]]]] = {}

    def watches(self, to_cfs: bool, stream: int, now: int) -> bool:
        del now
        return bool(self._waiting.get((to_cfs, stream)))

    def act(self, items: list[Item], call: Call) -> Acted:
        waiting = self._waiting.setdefault((call.to_cfs, call.stream), [])
        if call.struck and items:
            for item in items:
                item.due_ns = call.now + self.values["within"]
                waiting.append((item, [self.values["by"]]))
            return Acted(items, f"held back until {self.values['by']} overtook it")
        if items:
            for item, left in list(waiting):
                left[0] -= 1
                if item.gone or not left[0]:
                    waiting.remove((item, left))
                    if not item.gone:
                        item.gone = True
                        items.append(Item(item.payload, call.now, call.stream, call.to_cfs))
        return Acted(items)


class _Bandwidth(Actor):
    """A line that carries one datagram after the other, each way, and a queue before it."""

    def __init__(self, rule: Rule) -> None:
        super().__init__(rule)
        self._free: dict[bool, int] = {}

    def act(self, items: list[Item], call: Call) -> Acted:
        rate, queue = self.values["rate"], self.values["queue"]
        kept, detail = [], ""
        for item in items:
            begins = max(item.due_ns, self._free.get(call.to_cfs, 0))
            waiting = (begins - item.due_ns) * rate / 8e9
            if waiting > queue:
                detail = f"dropped: over {queue} bytes wait for the line"
                continue
            ends = begins + int((len(item.payload) + _HEADERS) * 8e9 / rate)
            detail = detail or f"{(ends - item.due_ns) / 1e6:.3f} ms on the line"
            self._free[call.to_cfs] = item.due_ns = ends
            kept.append(item)
        return Acted(kept, detail)


class _Delay(Actor):
    def act(self, items: list[Item], call: Call) -> Acted:
        del call
        for item in items:
            item.due_ns += self.values["time"]
        return Acted(items, f"{self.values['time'] / 1e6:g} ms late" if items else "")


class _Jitter(Actor):
    def __init__(self, rule: Rule) -> None:
        super().__init__(rule)
        self._last: dict[tuple[bool, int], int] = {}

    def act(self, items: list[Item], call: Call) -> Acted:
        key = (call.to_cfs, call.stream)
        late = int(self.values["time"] * fraction(call.chance.bits(_SALT_JITTER)))
        for item in items:
            self._last[key] = item.due_ns = max(item.due_ns + late, self._last.get(key, 0))
        return Acted(items, f"{late / 1e6:.3f} ms late" if items else "")


_ACTORS: Final[Mapping[str, type[Actor]]] = {
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


def actor_for(rule: Rule) -> Actor:
    """Return what does a rule's work in one run."""
    return _ACTORS.get(rule.kind.name, _Content)(rule)
