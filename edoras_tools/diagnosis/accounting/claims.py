"""Share the growth of cFE's loss counters out to the messages that may have caused it.

0x803, the software bus's housekeeping, counts lost messages (MsgLimit, PipeOverflow) without their MsgId.
Its growth is a supply of counts; messages that did not arrive are a demand for them.

In: the ``Counts`` of each cFS (``Case.loss_counts``), and the claims of ``bus`` and ``pipes``. Out: the
counts that each ``Claim`` got, the counts that several kinds of traffic share (``Shared``), and what is left
in ``Counts``. ``Commands`` calls ``settle_known``, ``settle_first``, ``settle_rest`` and then
``settle_perhaps_missed``.

Rules:

1. A count lies in the second between two samples of its counter, and is caused by exactly one message.
2. A ``Claim`` is a group of messages that could have caused the same counts. Claims are served in the order
   of their ``Rank``: first messages that are surely missing and have a known cause.
3. Within a rank as many messages and counts are matched as possible (augmenting paths in a bipartite graph).
4. Where messages of different traffic could have caused a count, no traffic gets it: it is ``Shared``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable
from enum import IntEnum
from itertools import product
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.diagnosis.accounting.losses import COUNTERS, LEAD_NS, TAIL_NS
from edoras_tools.diagnosis.evidence.loss_reports import PipeKind, Track
from edoras_tools.units import SECOND
from edoras_tools.wire.arrays import Integers, Mask, Places, by_value, numbered

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    Counters = Mapping[int, "Counts"]
    """cFS instance to its counters."""


class Rank(IntEnum):
    """The order in which claims are served. A lower rank has better evidence for its messages."""

    NOT_TAKEN = -1
    """Sent while nobody received it, in a capture that surely misses frames."""
    PRESSED = 0
    """Surely missing, and either an event names its MsgId or its pipe was full."""
    ABSENT = 1
    """A command that surely did not leave cFS again; its stream was fast enough to fill a pipe."""
    CLOSED = 2
    """Missing while its way out was closed."""
    OWN_PACKETS = 3
    """Missing while its way out was closed, and published by cFS itself."""
    NOT_CAPTURED = 4
    """Missing while nothing could be captured: counts of that time are not of those that were."""
    QUIET = 5
    """A command that surely did not leave cFS again, with no event and a stream too slow to fill a pipe."""
    INTO_STOP = 6
    """Sent to an application that was stopped; its pipe may have filled up."""
    MISSING = 7
    """Missing by its sequence count, but no pipe was full: it gets counts that nothing above explains."""
    POSSIBLE = 8
    """From this rank on the messages may also have arrived."""
    UNNAMED = 14
    """From this rank on, too, and no event names them: their stream is too slow to fill a pipe."""


_APART_NS: Final = 3 * SECOND
"""A gap and a count that are at most this far apart are the same loss."""
FAR_NS: Final = 10 * SECOND
"""The same where nothing else explains either of them: if cFS stood still, its times are wrong."""
_BOOTS_NS: Final = LEAD_NS + SECOND
"""The time of a boot is known to about a second: it may count messages sent this long before it."""
BEFORE: Final = -1
CounterKey = tuple[int, PipeKind]
"""A counter: cFS instance, and kind."""
Place = tuple[int, PipeKind, int]
"""Place of a count: cFS instance, counter, index of the second; ``BEFORE`` for the first sample."""


class Counts(msgspec.Struct):
    """The growth of one cFS instance's loss counters that no message explains yet.

    Attributes:
        times: i64 (n + 1,), capture times of the samples, ns.
        left: kind to i64 (n,), unexplained growth between each two samples.
        first: kind to the unexplained value of the first sample.
        older: unexplained growth that may be caused by messages from before the capture.
        boot_ns: boot of the instance; every count is of a message sent later.
        set_back: indices of seconds in which the counters were reset, so that their last growth is unknown.
    """

    times: Integers
    left: dict[PipeKind, Integers]
    first: dict[PipeKind, int] = msgspec.field(default_factory=dict)
    boot_ns: int = 0
    older: int = 0
    set_back: Sequence[int] = ()

    @classmethod
    def of(cls, track: Track, boot_ns: int, later: Mapping[PipeKind, Sequence[int]]) -> Counts:
        """Build it from the samples of an instance.

        Args:
            track: samples of its counters.
            boot_ns: when it booted, capture time.
            later: kind to times of loss events after the last sample; each event is one more count.
        """
        last = [max(times) for times in later.values() if times]
        grown = {
            kind: [*np.diff(track.totals[name]).tolist(), *([len(later.get(kind, ()))] * bool(last))]
            for kind, name in COUNTERS.items()
        }
        return cls(
            np.array([*track.times, *([max(last)] if last else ())], np.int64),
            {kind: np.array(number, np.int64) for kind, number in grown.items()},
            {kind: track.older.get(name, 0) for kind, name in COUNTERS.items()},
            boot_ns,
            set_back=track.set_back,
        )

    def seconds(self, times: Integers) -> Places:
        """Return the second that each time lies in: -1 before the first sample, n after the last."""
        return np.asarray(np.searchsorted(self.times, times) - 1)

    def span(self, seconds: Sequence[int] | Places) -> tuple[int, int]:
        """Return the times of the samples before and after some seconds, which are in rising order."""
        return int(self.times[seconds[0]]), int(self.times[seconds[-1] + 1])

    def between(self, low_ns: Integers, high_ns: Integers) -> Integers:
        """Return the unexplained counts of all kinds in the seconds that each interval overlaps, i64 (n,)."""
        total = np.concatenate(([0], np.cumsum([*self.left.values()], axis=1).sum(axis=0)))
        first, last = self.seconds(low_ns), self.seconds(high_ns) + 1
        return np.asarray(total[np.clip(last, 0, len(total) - 1)] - total[np.clip(first, 0, len(total) - 1)])

    def often(self, low_ns: Integers, high_ns: Integers) -> Mask:
        """Return in which intervals the samples are close together, so that counts have exact times."""
        rare = np.concatenate(([0], np.cumsum(np.diff(self.times) > TAIL_NS)))
        first = np.clip(self.seconds(low_ns), 0, len(rare) - 1)
        return np.asarray(rare[first] == rare[np.clip(self.seconds(high_ns) + 1, 0, len(rare) - 1)])


class Claim(msgspec.Struct):
    """A group of messages that did not arrive, or may not have, and that could have caused the same counts.

    Attributes:
        messages: the group itself, as whoever claims holds it; nothing here reads it.
        low_ns: earliest capture time at which they can have been counted.
        high_ns: latest such time.
        number: number of messages.
        kinds: counters that may have counted them, the likelier first.
        instances: cFS instances that may have counted them.
        rank: order of service, lowest first.
        flow: their stream, or whatever else identifies their traffic.
        assigned: counts that were assigned to them, by place; only ``give`` changes them.
        explained: messages that they explain, as many as there are such counts.
        reserved: counts that they share with claims of other traffic.
        doubtful: whether it lost counts that other messages may have caused: nothing shows whose they are.
        perhaps_missed: messages that are not in ``number``, because the capture may have missed them.
    """

    messages: Any
    low_ns: int
    high_ns: int
    number: int
    kinds: Sequence[PipeKind]
    instances: Sequence[int]
    rank: int = 0
    flow: Hashable = None
    assigned: dict[Place, int] = msgspec.field(default_factory=dict)
    explained: int = 0
    reserved: int = 0
    doubtful: bool = False
    perhaps_missed: int = 0

    @property
    def open(self) -> int:
        """Number of messages that no count explains yet."""
        return self.number - self.explained - self.reserved

    def give(self, place: Place, number: int) -> None:
        """Assign counts, or take some back if ``number`` is negative."""
        self.explained += number
        self.assigned[place] = self.assigned.get(place, 0) + number
        if not self.assigned[place]:
            del self.assigned[place]

    def by_kind(self) -> dict[CounterKey, int]:
        """Return the assigned counts by instance and kind."""
        counts: dict[CounterKey, int] = {}
        for (instance, kind, _), number in self.assigned.items():
            counts[instance, kind] = counts.get((instance, kind), 0) + number
        return counts


def settle(counts: Counters, claims: Sequence[Claim], slack_ns: int = 0) -> None:
    """Assign counts to claims, rank after rank, until no more can be assigned.

    Each count goes to the open claims whose interval contains it, in proportion to what is open. Then counts
    that are left are assigned by moving others along augmenting paths. The likelier kind of every claim is
    assigned first; counts assigned then are not moved for the other kind, so the result is the maximum for
    each kind in turn, not for both together.

    Args:
        counts: counters by instance; assigned counts are subtracted from them.
        claims: claims on all of these counters.
        slack_ns: the interval of each claim is widened by this on both sides.
    """
    ranks = sorted({claim.rank for claim in claims})
    for place in range(len(COUNTERS)):  # as much as can be is of the likelier kind
        market = _Market(counts, claims, slack_ns, place + 1)
        for rank in ranks:
            for table in market.tables.values():
                table.serve(table.preferring(rank, place))
        market.improve()


class Rival(NamedTuple):
    """Traffic that the capture does not show, and that a counter may have counted too.

    Attributes:
        flow: identity of the traffic, as in ``Claim``.
        instance: cFS instance that may have counted it.
        kind: counter.
        start_ns: earliest capture time at which it can have been counted.
        end_ns: latest such time.
        most: upper bound of its counts in each second.
        fills: whether it is fast enough to fill a pipe that is read.
    """

    flow: Hashable
    instance: int
    kind: PipeKind
    start_ns: int
    end_ns: int
    most: int = 1 << 32
    fills: bool = True


class Shared(msgspec.Struct):
    """Counts that several kinds of traffic may have caused; nothing shows how many are of each.

    Attributes:
        instance: cFS instance that counted them.
        kind: counter.
        flows: traffic that may have caused them, as in ``Claim`` and ``Rival``.
        number: number of counts.
        start_ns: time of the sample before the first of them.
        end_ns: time of the sample after the last of them.
    """

    instance: int
    kind: PipeKind
    flows: frozenset[Hashable]
    number: int
    start_ns: int
    end_ns: int

    def add(self, number: int, flows: Iterable[Hashable], span: tuple[int, int]) -> None:
        """Add counts of one second, and the traffic that may have caused them."""
        self.number += number
        self.flows |= frozenset(flows)
        self.start_ns, self.end_ns = min(self.start_ns, span[0]), max(self.end_ns, span[1])


def settle_known(counts: Counters, claims: Sequence[Claim], rivals: Sequence[Rival]) -> list[Shared]:
    """Assign counts to messages that are surely missing, then to messages that may be.

    Args:
        rivals: traffic that the capture does not show.

    Returns:
        The counts that several kinds of traffic share.
    """
    last = (Rank.CLOSED, _APART_NS), (Rank.OWN_PACKETS, 0), (Rank.QUIET, 0), (Rank.INTO_STOP, 0)
    for rank, slack_ns in last:
        sure = [claim for claim in claims if claim.rank <= rank]
        settle(counts, sure)
        settle(counts, sure, slack_ns)
    return settle_possible(counts, claims, rivals)


def hand_on(
    counts: Counts, instance: int, kind: PipeKind, givers: Sequence[Claim], claims: Sequence[Claim]
) -> None:
    """Pass the counts of some claims on to other claims of the same traffic, lowest rank first.

    Counts that fit none of these go back to the counter.

    Args:
        counts: the counters of the instance.
        kind: counter that the counts are from.
        givers: claims that the counts were assigned to.
        claims: claims that receive them.
    """
    asking = [at for at, each in enumerate(claims) if kind in each.kinds and instance in each.instances]
    table = _Table((instance, kind), counts, claims, 0, asking)
    for place, number in (item for each in givers for item in each.assigned.items()):
        rest = number
        for at in sorted(table.within(place[2]), key=lambda at: claims[at].rank):
            if part := min(rest, claims[at].open):
                claims[at].give(place, part)
                rest -= part
        table.left[place[2]] += rest


def settle_first(counts: Counters, claims: Sequence[Claim], missed: dict[Hashable, int]) -> None:
    """Assign the value of a first sample to messages that were sent before it, and are surely lost at a pipe.

    Args:
        missed: stream to the messages of it that the capture may have missed; reduced here.
    """
    for claim in claims:
        low_ns, own = claim.low_ns, [(at, counts[at]) for at in claim.instances]
        watched = any(item.times[0] <= low_ns <= item.times[-1] for _, item in own)
        may = [at for at, item in own if item.boot_ns - _BOOTS_NS < low_ns < item.times[0] and not watched]
        if claim.rank not in (Rank.PRESSED, Rank.ABSENT) or len(may) != 1:
            continue
        spared = min(claim.open, missed[claim.flow])
        missed[claim.flow] -= spared
        first = counts[may[0]].first
        for kind in claim.kinds:
            if number := min(claim.open - spared, first.get(kind, 0)):
                claim.give((may[0], kind, BEFORE), number)
                first[kind] -= number


def settle_rest(counts: Counters, claims: Sequence[Claim]) -> None:
    """Assign what is left to messages that are missing by their sequence count, with no full pipe."""
    settle(counts, [claim for claim in claims if claim.rank == Rank.MISSING], _APART_NS)


def settle_perhaps_missed(counts: Counters, claims: Sequence[Claim]) -> None:
    """Assign what is left to messages that the capture may have missed: a count proves them lost."""
    for claim in claims:
        claim.number, claim.perhaps_missed = claim.number + claim.perhaps_missed, 0
    settle_rest(counts, claims)
    settle(counts, [claim for claim in claims if claim.rank == Rank.MISSING], FAR_NS)


def settle_possible(counts: Counters, claims: Sequence[Claim], rivals: Sequence[Rival] = ()) -> list[Shared]:
    """Assign what is left to messages that may be lost, where only one kind of traffic can have caused it.

    A count that a surely missing message may have caused proves no other loss, so those are served before
    anything is shared, or goes to messages that no pipe need have lost.

    Returns:
        The counts that several kinds of traffic share.
    """
    # A gap proves a loss; messages after a stream's last one are only a possibility, so gaps come first.
    behind = {claim.flow for claim in claims if claim.rank == Rank.POSSIBLE}
    rivals = [_as_far_as_moved(rival, claims) for rival in rivals if rival.flow not in behind]
    gaps = [item for item in claims if item.rank in (Rank.PRESSED, Rank.MISSING) and item.flow in behind]
    settle(counts, gaps, _APART_NS)
    tables = _Market(counts, claims).tables.values()
    shared: dict[tuple[int, PipeKind, frozenset[Hashable]], Shared] = {}
    others = [] if rivals else [claim for claim in claims if claim.rank != Rank.MISSING]
    ranks = sorted({claim.rank for claim in claims if claim.rank >= Rank.POSSIBLE})
    has_rest = True
    for rank, place in product(ranks, range(len(COUNTERS))):
        for table in tables:
            for second, asking in table.seconds(rank, place):
                span = counts[table.instance].span([second])
                unseen = table.unseen(second, rivals, span)
                slow = rank >= Rank.UNNAMED and any(rival.fills for rival in unseen)
                takers = [] if slow else asking  # too slow to fill a pipe beside others that can
                flows = table.sharers(second, takers, unseen)
                if has_rest and (flows or rank >= Rank.UNNAMED):
                    settle_rest(counts, claims)
                    has_rest = False
                table.give_surplus(second, takers, unseen)
                if (number := table.give(second, takers, reserve=bool(flows))) and flows:
                    key = table.instance, table.kind, flows
                    shared.setdefault(key, Shared(*key, 0, *span)).add(number, flows, span)
        # What the likelier counter of one traffic may hold is not left to another's second choice.
        _Market(counts, others, kinds=place + 1).improve(alone=True)
    return list(shared.values())


def _as_far_as_moved(rival: Rival, claims: Sequence[Claim]) -> Rival:
    """Return wake-ups of an application that did not run, up to the last count that may be theirs in turn.

    Surely missing messages may have got the counts of these, and later messages theirs.
    """
    end_ns = rival.end_ns
    for claim in () if rival.fills else sorted(claims, key=lambda claim: claim.low_ns):
        if claim.assigned and rival.start_ns <= claim.high_ns and claim.low_ns <= end_ns:
            end_ns = max(end_ns, claim.high_ns)
    return rival._replace(end_ns=end_ns)


def take_back(counts: Counters, claims: Sequence[Claim], others: Sequence[Claim]) -> list[int]:
    """Take counts from claims that other messages may have caused as well.

    Args:
        counts: the counters; they do not get the counts back.
        claims: claims on them, of gaps.
        others: claims of messages that may also have arrived.

    Returns:
        How many of these counts each of ``others`` may have caused.
    """
    tables, numbers = _Market(counts, [*claims, *others]).tables, [0] * len(others)
    for claim in claims:
        for place in [*claim.assigned]:
            for at in tables[place[:2]].within(place[2]):
                other = at - len(claims)
                if other < 0 or others[other].rank < Rank.POSSIBLE:
                    continue
                if part := min(claim.assigned.get(place, 0), others[other].open - numbers[other]):
                    numbers[other] += part
                    claim.give(place, -part)
                    claim.doubtful = True
    return numbers


def share_open(counts: Counters, claims: Sequence[Claim]) -> list[Shared]:
    """Take back from each traffic those counts that unexplained messages of other traffic may have caused.

    A traffic keeps only the counts that all others together cannot have caused.

    Args:
        claims: all claims; messages that get a shared count are no longer open.

    Returns:
        The counts that several kinds of traffic share.
    """
    claims = [claim for claim in claims if claim.rank in (Rank.PRESSED, Rank.ABSENT)]
    open_ = {claim.flow for claim in claims if claim.open}
    flows = dict.fromkeys(claim.flow for claim in claims if claim.assigned and open_ - {claim.flow})
    trials = [(flow, *_others(counts, claims, flow)) for flow in flows]
    shared: dict[CounterKey, Shared] = {}
    for flow, places, takers in trials:
        for item in (item for item in claims if item.flow == flow):
            for place in [place for place in item.assigned if place in places]:
                number = min(item.assigned[place], places[place])
                places[place] -= number
                item.give(place, -number)
                item.reserved += number
                span = counts[place[0]].span([place[2]])
                row = shared.setdefault(place[:2], Shared(*place[:2], frozenset(), 0, *span))
                row.add(number, {flow, *(taker.flow for taker, _ in takers)}, span)
        for item, number in takers:
            item.reserved += min(number, item.open)
    return list(shared.values())


def _others(
    counts: Counters, claims: Sequence[Claim], flow: Hashable
) -> tuple[Counter[Place], list[tuple[Claim, int]]]:
    """Return the counts of one traffic that others may have caused, and the claims that would take them."""
    rest = {
        at: replace(item, left={kind: number.copy() for kind, number in item.left.items()})
        for at, item in counts.items()
    }
    others = [item for item in claims if item.flow != flow]
    places = sum((Counter(item.assigned) for item in claims if item.flow == flow), Counter[Place]())
    for (at, kind, second), number in places.items():
        rest[at].left[kind][second] += number
        places[at, kind, second] = int(rest[at].left[kind][second])
    copies = [replace(item, assigned=dict(item.assigned)) for item in others]
    _Market(rest, copies).improve()
    for at, kind, second in places:
        places[at, kind, second] -= int(rest[at].left[kind][second])
    takers = zip(others, copies, strict=True)
    return +places, [(item, item.open - copy.open) for item, copy in takers if item.open > copy.open]


class _Table:
    """The claims on one counter.

    Attributes:
        asking: indices of its claims.
        left: i64 (n,), unexplained counts of each second.
    """

    def __init__(
        self, of: CounterKey, own: Counts, claims: Sequence[Claim], slack_ns: int, asking: list[int]
    ) -> None:
        self.instance, self.kind = of
        self.left, self._claims, self.asking = own.left[self.kind], claims, asking
        low = np.array([claims[at].low_ns for at in self.asking], np.int64)
        high = np.array([claims[at].high_ns for at in self.asking], np.int64)
        self._first = np.maximum(own.seconds(low - slack_ns), 0)
        self._last = np.minimum(own.seconds(high + slack_ns), len(own.times) - 2)
        # No second here counts a loss before the first sample or after the last.
        self._last[(high <= own.times[0]) | (low >= own.times[-1])] = -1
        self._place = {at: place for place, at in enumerate(self.asking)}
        self._within: dict[int, list[int]] = {}

    def preferring(self, rank: int, place: int) -> list[int]:
        """Return the open claims of a rank that have this counter as their ``place``-th kind."""
        own = (at for at in self.asking if self._claims[at].kinds[place : place + 1] == (self.kind,))
        return [at for at in own if self._claims[at].rank == rank and self._claims[at].open > 0]

    def seconds(self, rank: int, place: int) -> Iterator[tuple[int, list[int]]]:
        """Yield the seconds with counts left, each with those ``preferring`` claims that are still open."""
        asking = set(self.preferring(rank, place))
        for second in np.flatnonzero(self.left).tolist() if asking else ():
            yield second, [at for at in self.within(second) if at in asking and self._claims[at].open]

    def within(self, second: int) -> list[int]:
        """Return the indices of the claims whose interval contains a second."""
        if (own := self._within.get(second)) is None:
            places = np.flatnonzero((self._first <= second) & (self._last >= second))
            own = self._within[second] = [self.asking[place] for place in places.tolist()]
        return own

    def sharers(self, second: int, takers: Sequence[int], unseen: Sequence[Rival]) -> frozenset[Hashable]:
        """Return the traffic that shares the counts of a second; empty if they are one's own or are enough.

        Args:
            takers: indices of the claims that may get them.
            unseen: traffic that the capture does not show, and that may have caused them.
        """
        flows = frozenset(self._claims[at].flow for at in takers) | {rival.flow for rival in unseen}
        is_all = not unseen and int(self.left[second]) >= sum(self._claims[at].open for at in takers)
        return frozenset() if is_all or len(flows) == 1 else flows

    def unseen(self, second: int, rivals: Sequence[Rival], span: Sequence[int]) -> list[Rival]:
        """Return who else may have caused the counts of a second, which is between the times of ``span``."""
        own = [rival for rival in rivals if (rival.instance, rival.kind) == (self.instance, self.kind)]
        more = (claim for claim in map(self._claims.__getitem__, self.within(second)) if claim.perhaps_missed)
        at = self.instance, self.kind, span[0], span[1]
        own += [Rival(item.flow, *at, item.perhaps_missed, fills=False) for item in more]
        return [rival for rival in own if rival.start_ns <= span[1] and span[0] <= rival.end_ns]

    def give_surplus(self, second: int, takers: Sequence[int], unseen: Sequence[Rival]) -> None:
        """Assign each traffic the counts of a second that all others together cannot have caused."""
        open_ = Counter[Hashable]()
        for at in takers:
            open_[self._claims[at].flow] += self._claims[at].open
        beyond = int(self.left[second]) - open_.total() - sum(rival.most for rival in unseen)
        for flow, own in open_.items():
            if (most := min(own, beyond + own)) > 0:
                self.give(second, [at for at in takers if self._claims[at].flow == flow], most=most)

    def serve(self, asking: Sequence[int]) -> None:
        """Assign every count to the claims whose interval contains it, in proportion to what is open."""
        first = {at: int(self._first[self._place[at]]) for at in asking}
        order, takers, next_ = sorted(asking, key=first.__getitem__), list[int](), 0
        for second in np.flatnonzero(self.left).tolist():
            while next_ < len(order) and first[order[next_]] <= second:
                takers.append(order[next_])
                next_ += 1
            takers = [at for at in takers if self._last[self._place[at]] >= second and self._claims[at].open]
            self.give(second, takers)

    def give(self, second: int, takers: Sequence[int], *, reserve: bool = False, most: int = 1 << 32) -> int:
        """Assign counts of a second to claims, or reserve them as shared; return how many.

        Args:
            takers: indices of the claims.
            reserve: the claims share the counts, and none gets them.
            most: upper bound.
        """
        turn = second % max(1, len(takers))  # a remainder goes to another claim each time
        takers = [*takers[turn:], *takers[:turn]]
        before, opened = int(self.left[second]), [self._claims[at].open for at in takers]
        for at, share in zip(takers, shares(min(before, most), opened), strict=True):
            if share and reserve:
                self._claims[at].reserved += share
            elif share:
                self._claims[at].give((self.instance, self.kind, second), share)
            self.left[second] -= share
        return before - int(self.left[second])


class _Market:
    """Counters and claims, and the ways on which counts can move from one claim to another.

    Args:
        counts: counters by instance.
        claims: claims on them.
        slack_ns: the interval of each claim is widened by this on both sides.
        kinds: number of kinds of each claim that are asked for, the likelier first.

    Attributes:
        tables: instance and kind to the claims on each counter that has counts left, or through which counts
            may move.
    """

    def __init__(
        self, counts: Counters, claims: Sequence[Claim], slack_ns: int = 0, kinds: int = len(COUNTERS)
    ) -> None:
        self._claims = claims
        self.tables: dict[CounterKey, _Table] = {}
        used = {place[:2] for claim in claims for place in claim.assigned}
        low, high = np.array([(claim.low_ns, claim.high_ns) for claim in claims], np.int64).reshape(-1, 2).T
        for at, own in counts.items():
            within = (high + slack_ns >= own.times[0]) & (low - slack_ns <= own.times[-1])
            near = [place for place in np.flatnonzero(within).tolist() if at in claims[place].instances]
            for kind in COUNTERS:
                if own.left[kind].any() or (at, kind) in used:
                    asking = [place for place in near if kind in claims[place].kinds[:kinds]]
                    self.tables[at, kind] = _Table((at, kind), own, claims, slack_ns, asking)

    def improve(self, *, alone: bool = False) -> None:
        """Assign what is left by moving counts between claims along augmenting paths.

        Args:
            alone: only where a single kind of traffic has open claims that can be reached.
        """
        dead: set[int] = set()
        if not any(claim.open for claim in self._claims):
            return
        for (instance, kind), table in self.tables.items():
            for second in np.flatnonzero(table.left).tolist():
                place = instance, kind, second
                if alone:
                    may = (self._claims[at] for _, _, fresh in self._ways_from(place, set()) for at in fresh)
                    if len({claim.flow for claim in may if claim.open or claim.perhaps_missed}) != 1:
                        continue
                while table.left[second] and (path := self._path(place, dead)):
                    self._shift(table, path)

    def _shift(self, table: _Table, path: Sequence[tuple[Place, int]]) -> None:
        """Move counts along a path: each claim gives its count to the next and takes the one before it."""
        claims, second = self._claims, path[0][0][2]
        moved = min(int(table.left[second]), claims[path[-1][1]].open)
        for (place, _), (_, before) in zip(path[1:], path, strict=False):
            moved = min(moved, claims[before].assigned[place])
        for place, at in path:
            claims[at].give(place, moved)
        for (place, _), (_, before) in zip(path[1:], path, strict=False):
            claims[before].give(place, -moved)
        table.left[second] -= moved

    def _path(self, start: Place, dead: set[int]) -> list[tuple[Place, int]] | None:
        """Return the moves that lead from counts that are left to an open claim; None if there is no path.

        Args:
            start: place of the counts.
            dead: claims that lead to no open one; extended if there is no path.
        """
        from_: dict[int, tuple[Place, int | None]] = {}
        for place, giver, fresh in self._ways_from(start, dead):
            for at in fresh:
                from_[at] = place, giver
                if self._claims[at].open:
                    path, before = [(place, at)], giver
                    while before is not None:
                        path.append((from_[before][0], before))
                        before = from_[before][1]
                    return path[::-1]
        dead.update(from_)
        return None

    def _ways_from(self, start: Place, dead: set[int]) -> Iterator[tuple[Place, int | None, list[int]]]:
        """Yield the steps that counts can take, the latest claim first.

        Each step is a place, the claim that holds its counts (None for counts that are left), and the claims
        that may get them; each claim is yielded once.

        Args:
            dead: claims that are skipped.
        """
        todo: list[tuple[Place, int | None]] = [(start, None)]
        places, reached = set[Place](), set[int]()
        while todo:
            place, giver = todo.pop()
            if place not in places:
                places.add(place)
                within = self.tables[place[:2]].within(place[2])
                fresh = [at for at in within if at not in reached and at not in dead]
                reached.update(fresh)
                yield place, giver, fresh
                moves = ((other, at) for at in fresh for other in self._claims[at].assigned)
                todo += [(other, at) for other, at in moves if other[:2] in self.tables]


def shares(number: int, most: Sequence[int]) -> list[int]:
    """Divide a number into whole parts, in proportion to the most of each; what does not fit is dropped."""
    if len(most) < 2 or number >= sum(most):  # mostly so: arrays are slow for these
        return [max(0, min(number, part)) for part in most]
    out, rest, limit = np.zeros(len(most), np.int64), number, np.array(most)
    while rest > 0 and len(free := np.flatnonzero(out < limit)):
        exact = rest * limit[free] / limit[free].sum()
        parts = np.minimum(exact.astype(np.int64), limit[free] - out[free])
        if not parts.any():  # the remainder: one each, to the largest first
            parts = np.argsort(np.argsort(-exact, kind="stable")) < rest
        out[free] += parts
        rest = number - int(out.sum())
    return [int(part) for part in out]


def claimed_alike(
    counts: Sequence[Counts], low_ns: Integers, high_ns: Integers, *keys: Places
) -> list[Places]:
    """Group messages that could have caused the same counts, so that one claim can stand for each group.

    Args:
        counts: counters of the instances that may have counted them.
        low_ns: i64 (n,), earliest time at which each message can have been counted.
        high_ns: i64 (n,), latest such time.
        keys: further columns that are equal within a group.

    Returns:
        Indices of the messages, an array a group.
    """
    _, which = numbered(*[own.seconds(times) for own in counts for times in (low_ns, high_ns)], *keys)
    return [members for _, members in by_value(which)]
