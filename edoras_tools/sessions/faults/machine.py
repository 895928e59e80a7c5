"""Fault injection: decides which datagrams a rule strikes, and applies its effect.

A ``FaultPlan`` is frozen: rules and a seed. A ``FaultMachine`` is one run of it. Rules that it keeps:

1. No I/O, no clock: time is an argument, and never goes back.
2. Each rule counts the datagrams in its scope as they came in, independent of the effects of other rules. It
   has separate counts for each sender (``stream``), link and direction.
3. Whether a rule strikes the n-th datagram follows from the seed, the rule and n alone. So the same seed
   strikes the same datagrams in every run, independent of times, of batches, and of other rules.
4. Rules act in the order of their stages (``kinds.Stage``), independent of the order in which they are
   written.
5. A datagram that nothing strikes is returned as the same object.
6. Held-back datagrams take at most ``HOLD_BYTES``; an excess one is lost, and reported as a fault.

``ActiveRule`` finds the datagrams in the scope of a rule, one at a time or a batch at once, and counts them.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Sequence
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
import numpy as np

from edoras_tools.errors import ConfigError
from edoras_tools.model import NO_MSG_ID, Link
from edoras_tools.sessions.faults import effects
from edoras_tools.sessions.faults.rules import Fault, Rule
from edoras_tools.wire import ccsds, sbn
from edoras_tools.wire.ccsds import MSG_ID_BYTES, VERSION_1, MsgIds
from edoras_tools.wire.cfe import STANDARD, Headers

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.wire.arrays import Integers, Mask, Octets

    Predicate = Callable[[bytes, Link], bool]
    _Verdict = tuple["StreamCounter", bool, int]
    """A rule's count for a stream, whether it strikes, and the number of the datagram in that count."""

HEAD_BYTES: Final = sbn.HEADER.size + MSG_ID_BYTES
"""First bytes of each datagram that ``BatchHeads`` needs: the SBN header and a MsgId."""


def datagram_msg_id(payload: bytes, link: Link, msg_ids: MsgIds = VERSION_1) -> int:
    """Return a datagram's MsgId, ``NO_MSG_ID`` if it has none."""
    at = effects.packet_offset(payload, link)
    return msg_ids.of(payload, at) if at >= 0 else NO_MSG_ID


class ActiveRule(msgspec.Struct):
    """A rule of this run.

    Attributes:
        index: place in the order in which rules act.
        rule: the rule as written.
        ordinal: number among the rules of its kind.
        matches: compiled filter expression; None if it has none.
        effect: effect of the rule, with its state.
        msg_ids: version of the MsgIds.
    """

    index: int
    rule: Rule
    ordinal: int
    matches: Predicate | None
    effect: effects.Effect
    msg_ids: MsgIds = VERSION_1

    def looks_at(self, link: Link, *, to_cfs: bool) -> bool:
        """Return whether datagrams of a link and direction may be in its scope."""
        scope = self.rule.scope
        return (not scope.links or link in scope.links) and scope.to_cfs in {None, to_cfs}

    def inside(self, payload: bytes, link: Link) -> bool:
        """Return whether a datagram of a link and direction that may be in scope is in scope."""
        scope = self.rule.scope
        if scope.msg_ids and datagram_msg_id(payload, link, self.msg_ids) not in scope.msg_ids:
            return False
        if scope.sbn_types and (
            not link.peers
            or len(payload) < sbn.HEADER.size
            or payload[sbn.MSG_TYPE_AT] not in scope.sbn_types
        ):
            return False
        return self.matches is None or self.matches(payload, link)


class StreamCounter(msgspec.Struct):
    """A rule's count of the datagrams of one stream, link and direction, and the key of its random choices.

    Attributes:
        active: the rule.
        key: key of the random choices.
        threshold: limit below which a draw strikes.
        count: number of datagrams so far.
        first: count before the last batch that was decided.
        places: rows of that batch that were in scope.
    """

    active: ActiveRule
    key: int
    threshold: int
    count: int = 0
    first: int = 0
    places: Integers = None  # type: ignore[assignment]  # there is none before the first batch


class BatchHeads:
    """The header fields of a batch that scopes need, read once.

    Args:
        heads: first bytes of each datagram, u8 (n, ``HEAD_BYTES`` or more).
        length: bytes of each, (n,).
        link: link of all datagrams.
    """

    def __init__(self, heads: Octets, length: NDArray[np.integer[Any]], link: Link) -> None:
        self._heads, self._length, self._link = heads, length, link
        self._msg_id: NDArray[np.int32] | None = None

    def inside(self, active: ActiveRule, payload: Callable[[int], bytes]) -> Mask:
        """Return whether each datagram is in the scope of a rule that applies to this link; bool (n,)."""
        scope = active.rule.scope
        inside = np.ones(len(self._length), bool)
        if scope.msg_ids:
            inside &= np.isin(self._msg_ids(active.msg_ids), list(scope.msg_ids))
        if scope.sbn_types:
            inside &= np.isin(self._heads[:, sbn.MSG_TYPE_AT], list(scope.sbn_types))
            inside &= (self._length >= sbn.HEADER.size) & (self._link.peers)
        if active.matches is not None:
            for row in np.flatnonzero(inside).tolist():
                inside[row] = active.matches(payload(row), self._link)
        return inside

    def _msg_ids(self, msg_ids: MsgIds) -> NDArray[np.int32]:
        if self._msg_id is None:
            at = sbn.HEADER.size if self._link.peers else 0
            heads = self._heads
            numbers = msg_ids.column(heads[:, at:], self._length - at)
            whole = self._length >= at + ccsds.PRIMARY.size
            if self._link.peers:
                whole &= heads[:, sbn.MSG_TYPE_AT] == sbn.MsgType.APP
            self._msg_id = np.where(whole, numbers, NO_MSG_ID).astype(np.int32)
        return self._msg_id


_INVOLVED: Final = 1
_STRUCK: Final = 2
_HOLDING_BYTES: Final = 256
"""Approximate memory of a held datagram besides its bytes."""

HOLD_BYTES: Final = 256 << 20
"""Most bytes that are held back at once."""


class Delivery(NamedTuple):
    """A datagram to send now.

    Attributes:
        payload: its bytes; the same object that came in if nothing was changed.
        due_ns: time at which it was due; not later than now.
        stream: number of its sender.
        to_cfs: whether it goes to cFS.
    """

    payload: bytes
    due_ns: int
    stream: int = 0
    to_cfs: bool = True


class FaultPlan(msgspec.Struct, frozen=True):
    """The faults to inject.

    Attributes:
        rules: the faults; they act in the order of their kinds' stages, then in this order.
        seed: seed of all random choices.
    """

    rules: tuple[Rule, ...] = ()
    seed: int = 0

    def __bool__(self) -> bool:
        return bool(self.rules)

    def start(
        self,
        now: int | None = None,
        *,
        where: Callable[[str], Predicate] | None = None,
        headers: Headers = STANDARD,
    ) -> FaultMachine:
        """Begin a run.

        Args:
            now: time of its start, from which schedules count; None: the time of the first datagram.
            where: compiles the filter expressions of scopes.

        Raises:
            ConfigError: a rule has a filter expression and nothing compiles it.
        """
        return FaultMachine(self, now, where, headers)


class FaultMachine:
    """One run of a plan.

    Attributes:
        plan: the plan of this run.
        rules: the rules in the order in which they act.
        enabled: whether each rule is in use; see ``switch``.
        struck: number of datagrams that each rule struck.
        held_bytes: memory of the datagrams held back now.
        overflowed: number of datagrams lost because ``HOLD_BYTES`` were held back.
    """

    def __init__(
        self,
        plan: FaultPlan,
        now: int | None = None,
        where: Callable[[str], Predicate] | None = None,
        headers: Headers = STANDARD,
    ) -> None:
        self.plan = plan
        self.rules: Sequence[Rule] = sorted(plan.rules, key=attrgetter("kind.stage"))
        self.enabled = [rule.enabled for rule in self.rules]
        self.struck = [0] * len(self.rules)
        self.held_bytes = self.overflowed = 0
        self._start = now
        self._msg_ids = headers.msg_ids
        self._serial = 0
        self._heap: list[tuple[int, int, effects.Pending]] = []
        self._counters: dict[tuple[int, bool, int], list[StreamCounter]] = {}
        ordinals: dict[str, int] = {}
        self._active: list[ActiveRule] = []
        for index, rule in enumerate(self.rules):
            ordinal = ordinals[rule.kind.name] = ordinals.get(rule.kind.name, -1) + 1
            matches = None
            if rule.scope.where:
                if where is None:
                    raise ConfigError(f"fault {rule}: where is not available here; leave it out")
                matches = where(rule.scope.where)
            effect = effects.effect_of(rule, headers)
            self._active.append(ActiveRule(index, rule, ordinal, matches, effect, headers.msg_ids))

    @property
    def waiting(self) -> int:
        """The number of datagrams held back now."""
        return sum(not item.sent for _, _, item in list(self._heap))

    @property
    def next_ns(self) -> int | None:
        """Time at which ``due`` returns something; None while nothing is held back."""
        while self._heap and self._heap[0][2].sent:
            self._pop()
        return self._heap[0][0] if self._heap else None

    def switch(self, index: int, on: bool, *, now: int) -> None:
        """Enable or disable a rule; datagrams that it held back are still sent when they are due."""
        self.enabled[index] = on
        self._active[index].effect.switched_ns = now if on else None

    def concerns(self, link: Link, *, to_cfs: bool) -> bool:
        """Return whether an enabled rule applies to datagrams of this link and direction."""
        return any(
            self.enabled[counter.active.index] for counter in self._counters_of(link, to_cfs=to_cfs, stream=0)
        )

    def apply(
        self, payload: bytes, *, link: Link, to_cfs: bool, now: int, stream: int = 0
    ) -> tuple[list[Delivery], list[Fault]]:
        """Take one datagram.

        Args:
            payload: bytes of the datagram.
            link: link of the datagram.
            to_cfs: whether it goes to cFS.
            now: time of the caller's clock, ns; it never goes back.
            stream: number of the sender, which has its own order and counts.

        Returns:
            The datagrams to send now, in this order, and the faults. ``due`` returns those held back.
        """
        verdicts = self._decide_one(payload, link, to_cfs, now, stream)
        if not verdicts:
            return [Delivery(payload, now, stream, to_cfs)], []
        return self._act(payload, link, to_cfs, now, stream, verdicts)

    def decide(
        self,
        heads: Octets,
        length: NDArray[np.integer[Any]],
        payload: Callable[[int], bytes],
        *,
        link: Link,
        to_cfs: bool,
        now: int,
        stream: int = 0,
    ) -> Octets | None:
        """Decide a batch at once: which datagrams pass unchanged, and which need ``strike``.

        Args:
            heads: first bytes of each datagram, u8 (n, ``HEAD_BYTES`` or more).
            length: bytes of each, (n,).
            payload: returns the bytes of one, for rules with a filter expression.
            link: as for ``apply``.
            to_cfs: as for ``apply``.
            now: as for ``apply``.
            stream: as for ``apply``.

        Returns:
            u8 (rules, n): 0 if a rule does nothing to a datagram; pass the datagram's column to ``strike``.
            None if no rule applies to this link and direction.
        """
        counters = self._counters_of(link, to_cfs=to_cfs, stream=stream)
        if not counters:
            return None
        elapsed = self._elapsed(now)
        verdicts = np.zeros((len(self.rules), len(length)), np.uint8)
        facts = BatchHeads(heads, length, link)
        for counter in counters:
            active = counter.active
            places = np.flatnonzero(facts.inside(active, payload))
            first, counter.count = counter.count, counter.count + len(places)
            if not len(places) or not self.enabled[active.index]:
                continue
            effect, schedule = active.effect, active.rule.schedule
            row = verdicts[active.index]
            if effect.watches(to_cfs, stream, now):
                row[places] = _INVOLVED
            if not effect.may_strike(elapsed, now):
                continue
            hits = np.ones(len(places), bool)
            if schedule.probability < 1:
                hits &= effects.draws(counter.key, first, len(places)) < np.uint64(counter.threshold)
            if schedule.every:
                hits &= (np.arange(first + 1, first + 1 + len(places)) % schedule.every) == 0
            if effect.outlasts and hits.any():
                row[places[int(hits.argmax()) :]] = _INVOLVED
            row[places[hits]] = _STRUCK
            counter.first = first
            counter.places = places
        return verdicts

    def strike(
        self, payload: bytes, column: Octets, row: int, *, link: Link, to_cfs: bool, now: int, stream: int = 0
    ) -> tuple[list[Delivery], list[Fault]]:
        """Apply the decisions of ``decide`` to a datagram, in the order of the batch.

        Args:
            payload: its bytes.
            column: column of the datagram in the result of ``decide``.
            row: place of the datagram in the batch.
            link: as for ``apply``.
            to_cfs: as for ``apply``.
            now: as for ``apply``.
            stream: as for ``apply``.

        Returns:
            As ``apply``.
        """
        verdicts = []
        for counter in self._counters_of(link, to_cfs=to_cfs, stream=stream):
            verdict = int(column[counter.active.index])
            if verdict:
                number = (
                    counter.first + int(np.searchsorted(counter.places, row)) if verdict == _STRUCK else 0
                )
                verdicts.append((counter, verdict == _STRUCK, number))
        return self._act(payload, link, to_cfs, now, stream, verdicts)

    def due(self, now: int) -> list[Delivery]:
        """Return the held-back datagrams that are due at ``now``, in order of time."""
        deliveries = []
        while self._heap and self._heap[0][0] <= now:
            item = self._pop()
            if not item.sent:
                item.sent = True
                deliveries.append(Delivery(item.payload, item.due_ns, item.stream, item.to_cfs))
        return deliveries

    def _elapsed(self, now: int) -> int:
        if self._start is None:
            self._start = now
        return now - self._start

    def _counters_of(self, link: Link, *, to_cfs: bool, stream: int) -> list[StreamCounter]:
        key = (int(link), to_cfs, stream)
        counters = self._counters.get(key)
        if counters is None:
            counters = [
                StreamCounter(
                    active,
                    effects.key_of(self.plan.seed, active.rule.kind.name, active.ordinal, *key),
                    effects.threshold(min(active.rule.schedule.probability, 1 - 2**-53)),
                )
                for active in self._active
                if active.looks_at(link, to_cfs=to_cfs)
            ]
            self._counters[key] = counters
        return counters

    def _decide_one(self, payload: bytes, link: Link, to_cfs: bool, now: int, stream: int) -> list[_Verdict]:
        elapsed = self._elapsed(now)
        verdicts = []
        for counter in self._counters_of(link, to_cfs=to_cfs, stream=stream):
            active = counter.active
            if not active.inside(payload, link):
                continue
            number = counter.count
            counter.count += 1
            if not self.enabled[active.index]:
                continue
            schedule, effect = active.rule.schedule, active.effect
            hit = (
                effect.may_strike(elapsed, now)
                and (schedule.probability >= 1 or effects.draw(counter.key, number) < counter.threshold)
                and (not schedule.every or (number + 1) % schedule.every == 0)
            )
            if hit or effect.watches(to_cfs, stream, now):
                verdicts.append((counter, hit, number))
        return verdicts

    def _act(
        self, payload: bytes, link: Link, to_cfs: bool, now: int, stream: int, verdicts: list[_Verdict]
    ) -> tuple[list[Delivery], list[Fault]]:
        msg_id = datagram_msg_id(payload, link, self._msg_ids)
        items = [effects.Pending(payload, now, stream, to_cfs)]
        faults = []
        for counter, hit, number in verdicts:
            active = counter.active
            received = effects.Received(
                link, to_cfs, stream, msg_id, now, hit, effects.Chance(counter.key, number)
            )
            items, detail, lost = active.effect.act(items, received)
            if detail:
                self.struck[active.index] += 1
                original = payload if lost is None else lost
                about = (link, to_cfs, msg_id, active.rule.text, stream)
                faults.append(Fault(now, active.rule.kind.name, detail, original, *about))
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

    def _hold(self, item: effects.Pending) -> bool:
        """Hold a datagram back; return whether there was room."""
        item.room = len(item.payload) + _HOLDING_BYTES
        if self.held_bytes + item.room > HOLD_BYTES:
            return False
        self.held_bytes += item.room
        self._serial += 1
        heapq.heappush(self._heap, (item.due_ns, self._serial, item))
        return True

    def _pop(self) -> effects.Pending:
        item = heapq.heappop(self._heap)[2]
        self.held_bytes -= item.room
        return item
