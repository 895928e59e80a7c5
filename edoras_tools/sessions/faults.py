"""Faults on purpose: which datagrams are struck, and what becomes of them. No I/O; time is an argument.

A :class:`FaultPlan` is frozen: rules and a seed. A :class:`FaultMachine` is one run of it. Each rule counts
the datagrams in its scope, as they came in, whatever the other rules did to them; whether it strikes the n-th
follows from seed, rule and n alone. So the same seed strikes the same datagrams in every run, whenever they
come and however many are handed over at once, and one rule's chances do not hang on another rule.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from edoras_tools.errors import ConfigError
from edoras_tools.model import NO_MSG_ID, Link
from edoras_tools.sessions.fault_actors import Call, Item, actor_for
from edoras_tools.sessions.fault_bytes import Chance
from edoras_tools.sessions.fault_chance import draw, draws, key_of, threshold
from edoras_tools.sessions.fault_lanes import HEAD_BYTES, Entry, Heads, Lane, msg_id_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from edoras_tools.sessions.fault_lanes import Predicate
    from edoras_tools.sessions.fault_rules import Rule

__all__ = ["HEAD_BYTES", "HOLD_BYTES", "Delivery", "Fault", "FaultMachine", "FaultPlan"]

_INVOLVED: Final = 1
_STRUCK: Final = 2
_HOLDING_BYTES: Final = 256
"""About what holding back a datagram takes besides its bytes."""

HOLD_BYTES: Final = 256 << 20
"""What may be held back at once; a line that long delayed and that busy is more than a test needs."""


class Delivery(NamedTuple):
    """A datagram to send now.

    Attributes:
        payload: its bytes; the very object that came in where nothing was changed.
        due_ns: when it was to go, at the latest now.
        stream: as it was given with the datagram.
        to_cfs: likewise.
    """

    payload: bytes
    due_ns: int
    stream: int = 0
    to_cfs: bool = True


class Fault(NamedTuple):
    """One thing done to one datagram: goes into a recording as what it is.

    Attributes:
        time_ns: when the datagram came, on the caller's clock.
        kind: name of the fault: a kind's, or ``overflow``: more was held back than there is room for.
        detail: what was done.
        original: the datagram as it came.
        link: which link it was on.
        to_cfs: which way it went.
        msg_id: its MsgId; ``NO_MSG_ID`` where it has none.
        rule: the rule, as it was written.
        stream: as it was given with the datagram.
    """

    time_ns: int
    kind: str
    detail: str
    original: bytes
    link: Link
    to_cfs: bool
    msg_id: int = NO_MSG_ID
    rule: str = ""
    stream: int = 0


@dataclass(frozen=True, slots=True)
class FaultPlan:
    """What is to go wrong.

    Attributes:
        rules: the faults; they act in the order of their kinds' stages, then in this one.
        seed: all chances hang on it.
    """

    rules: tuple[Rule, ...] = ()
    seed: int = 0

    def __bool__(self) -> bool:
        return bool(self.rules)

    def start(
        self, now: int | None = None, *, where: Callable[[str], Predicate] | None = None
    ) -> FaultMachine:
        """Begin a run.

        Args:
            now: when it starts, which schedules count from; None: with the first datagram.
            where: compiles the filter expressions of scopes.

        Raises:
            ConfigError: a rule has a filter expression and nothing compiles it.
        """
        return FaultMachine(self, now, where)


class FaultMachine:
    """One run of a plan.

    Attributes:
        plan: what runs.
        rules: in the order in which they act.
        enabled: which are in force; see ``switch``.
        struck: how many datagrams each struck.
        held_bytes: bytes held back now, with what holding them takes.
        overflowed: datagrams lost because ``HOLD_BYTES`` were held back.
    """

    def __init__(
        self, plan: FaultPlan, now: int | None = None, where: Callable[[str], Predicate] | None = None
    ) -> None:
        self.plan = plan
        self.rules: Sequence[Rule] = sorted(plan.rules, key=attrgetter("kind.stage"))
        self.enabled = [rule.enabled for rule in self.rules]
        self.struck = [0] * len(self.rules)
        self.held_bytes = self.overflowed = 0
        self._start = now
        self._serial = 0
        self._heap: list[tuple[int, int, Item]] = []
        self._lanes: dict[tuple[int, bool, int], list[Lane]] = {}
        seen: dict[str, int] = {}
        self._entries: list[Entry] = []
        for index, rule in enumerate(self.rules):
            ordinal = seen[rule.kind.name] = seen.get(rule.kind.name, -1) + 1
            matches = None
            if rule.scope.where:
                if where is None:
                    raise ConfigError(f"fault {rule}: where is not available here; leave it out")
                matches = where(rule.scope.where)
            self._entries.append(Entry(index, rule, ordinal, matches, actor_for(rule)))

    @property
    def held(self) -> int:
        """Datagrams held back now."""
        return sum(not item.gone for _, _, item in list(self._heap))

    @property
    def next_ns(self) -> int | None:
        """When ``due`` has something to give; None while nothing is held back."""
        while self._heap and self._heap[0][2].gone:
            self._pop()
        return self._heap[0][0] if self._heap else None

    def switch(self, index: int, on: bool, *, now: int) -> None:
        """Put a rule in force, or out of it; what it held back still goes when it is due."""
        self.enabled[index] = on
        self._entries[index].actor.switched_ns = now if on else None

    def concerns(self, link: Link, *, to_cfs: bool) -> bool:
        """Tell whether any rule in force may look at datagrams of this link and direction."""
        return any(self.enabled[lane.entry.index] for lane in self._lanes_of(link, to_cfs=to_cfs, stream=0))

    def apply(
        self, payload: bytes, *, link: Link, to_cfs: bool, now: int, stream: int = 0
    ) -> tuple[list[Delivery], list[Fault]]:
        """Take one datagram.

        Args:
            payload: its bytes.
            link: which link it is on.
            to_cfs: which way it goes.
            now: the caller's clock, ns; never back.
            stream: whose it is, as a number: datagrams of one sender keep their order, and are counted, apart
                from those of others.

        Returns:
            what to send now, in this order, and what was done. What is held back comes out of ``due``.
        """
        verdicts = self._decide_one(payload, link, to_cfs, now, stream)
        if not verdicts:
            return [Delivery(payload, now, stream, to_cfs)], []
        return self._act(payload, link, to_cfs, now, stream, verdicts)

    def decide(
        self,
        heads: NDArray[np.uint8],
        length: NDArray[np.integer[Any]],
        payload: Callable[[int], bytes],
        *,
        link: Link,
        to_cfs: bool,
        now: int,
        stream: int = 0,
    ) -> NDArray[np.uint8] | None:
        """Decide a batch at once: which datagrams pass as they are, and which need ``strike``.

        Args:
            heads: u8 (n, ``HEAD_BYTES`` or more): the first bytes of each.
            length: (n,), bytes of each.
            payload: gives the bytes of one, for rules with a filter expression.
            link: as for ``apply``.
            to_cfs: as for ``apply``.
            now: as for ``apply``.
            stream: as for ``apply``.

        Returns:
            u8 (rules, n): 0 where a rule lets a datagram be; the column goes to ``strike``. None where all
            pass: no rule looks at this link and direction.
        """
        lanes = self._lanes_of(link, to_cfs=to_cfs, stream=stream)
        if not lanes:
            return None
        elapsed = self._elapsed(now)
        verdicts = np.zeros((len(self.rules), len(length)), np.uint8)
        seen = Heads(heads, length, link)
        for lane in lanes:
            entry = lane.entry
            inside = seen.inside(entry, payload)
            places = np.flatnonzero(inside)
            first, lane.count = lane.count, lane.count + len(places)
            if not len(places) or not self.enabled[entry.index]:
                continue
            actor, schedule = entry.actor, entry.rule.schedule
            row = verdicts[entry.index]
            if actor.watches(to_cfs, stream, now):
                row[places] = _INVOLVED
            if not actor.active(elapsed, now):
                continue
            hits = np.ones(len(places), bool)
            if schedule.probability < 1:
                hits &= draws(lane.key, first, len(places)) < np.uint64(lane.threshold)
            if schedule.every:
                hits &= (np.arange(first + 1, first + 1 + len(places)) % schedule.every) == 0
            if actor.lingers and hits.any():
                row[places[int(hits.argmax()) :]] = _INVOLVED
            row[places[hits]] = _STRUCK
            lane.first = first
            lane.places = places
        return verdicts

    def strike(
        self,
        payload: bytes,
        column: NDArray[np.uint8],
        row: int,
        *,
        link: Link,
        to_cfs: bool,
        now: int,
        stream: int = 0,
    ) -> tuple[list[Delivery], list[Fault]]:
        """Do to a datagram what ``decide`` decided, in the order of the batch.

        Args:
            payload: its bytes.
            column: its column of what ``decide`` returned.
            row: its place in the batch.
            link: as for ``apply``.
            to_cfs: as for ``apply``.
            now: as for ``apply``.
            stream: as for ``apply``.

        Returns:
            as ``apply``.
        """
        verdicts = []
        for lane in self._lanes_of(link, to_cfs=to_cfs, stream=stream):
            verdict = int(column[lane.entry.index])
            if verdict:
                number = lane.first + int(np.searchsorted(lane.places, row)) if verdict == _STRUCK else 0
                verdicts.append((lane, verdict == _STRUCK, number))
        return self._act(payload, link, to_cfs, now, stream, verdicts)

    def due(self, now: int) -> list[Delivery]:
        """Return what was held back up to now, in order of time."""
        deliveries = []
        while self._heap and self._heap[0][0] <= now:
            item = self._pop()
            if not item.gone:
                item.gone = True
                deliveries.append(Delivery(item.payload, item.due_ns, item.stream, item.to_cfs))
        return deliveries

    def _elapsed(self, now: int) -> int:
        if self._start is None:
            self._start = now
        return now - self._start

    def _lanes_of(self, link: Link, *, to_cfs: bool, stream: int) -> list[Lane]:
        key = (int(link), to_cfs, stream)
        lanes = self._lanes.get(key)
        if lanes is None:
            lanes = [
                Lane(
                    entry,
                    key_of(self.plan.seed, entry.rule.kind.name, entry.ordinal, *key),
                    threshold(min(entry.rule.schedule.probability, 1 - 2**-53)),
                )
                for entry in self._entries
                if entry.looks_at(link, to_cfs=to_cfs)
            ]
            self._lanes[key] = lanes
        return lanes

    def _decide_one(
        self, payload: bytes, link: Link, to_cfs: bool, now: int, stream: int
    ) -> list[tuple[Lane, bool, int]]:
        elapsed = self._elapsed(now)
        verdicts = []
        for lane in self._lanes_of(link, to_cfs=to_cfs, stream=stream):
            entry = lane.entry
            if not entry.inside(payload, link):
                continue
            number = lane.count
            lane.count += 1
            if not self.enabled[entry.index]:
                continue
            schedule, actor = entry.rule.schedule, entry.actor
            hit = (
                actor.active(elapsed, now)
                and (schedule.probability >= 1 or draw(lane.key, number) < lane.threshold)
                and (not schedule.every or (number + 1) % schedule.every == 0)
            )
            if hit or actor.watches(to_cfs, stream, now):
                verdicts.append((lane, hit, number))
        return verdicts

    def _act(
        self,
        payload: bytes,
        link: Link,
        to_cfs: bool,
        now: int,
        stream: int,
        verdicts: list[tuple[Lane, bool, int]],
    ) -> tuple[list[Delivery], list[Fault]]:
        msg_id = msg_id_of(payload, link)
        items = [Item(payload, now, stream, to_cfs)]
        faults = []
        for lane, hit, number in verdicts:
            entry = lane.entry
            call = Call(link, to_cfs, stream, msg_id, now, hit, Chance(lane.key, number))
            items, detail, lost = entry.actor.act(items, call)
            if detail:
                self.struck[entry.index] += 1
                original = payload if lost is None else lost
                about = (link, to_cfs, msg_id, entry.rule.text, stream)
                faults.append(Fault(now, entry.rule.kind.name, detail, original, *about))
        deliveries = []
        for item in items:
            if item.due_ns <= now:
                deliveries.append(Delivery(item.payload, item.due_ns, stream, to_cfs))
            elif not self._hold(item):
                self.overflowed += 1
                faults.append(
                    Fault(now, "overflow", "too much held back", payload, link, to_cfs, msg_id, "", stream)
                )
        return deliveries, faults

    def _hold(self, item: Item) -> bool:
        """Hold a datagram back; tell whether there was room."""
        item.room = len(item.payload) + _HOLDING_BYTES
        if self.held_bytes + item.room > HOLD_BYTES:
            return False
        self.held_bytes += item.room
        self._serial += 1
        heapq.heappush(self._heap, (item.due_ns, self._serial, item))
        return True

    def _pop(self) -> Item:
        item = heapq.heappop(self._heap)[2]
        self.held_bytes -= item.room
        return item
