"""The growth of the software bus's loss counters, second by second, and who claims it.

A count belongs to the second between two samples of the counter, and to one message. Messages claim counts
rank after rank, and within each step as many of both are matched as can be. What may be of several kinds of
traffic is given to none of them.
"""

from __future__ import annotations

from collections import Counter
from enum import IntEnum
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.diagnosis.accounting.losses import COUNTERS, LEAD_NS, TAIL_NS
from edoras_tools.diagnosis.evidence.loss_reports import PipeKind, Track
from edoras_tools.units import SECOND
from edoras_tools.wire.arrays.order import Integers, Mask, Places, by_value, numbered

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence


class Rank(IntEnum):
    """Which claims are served first: those of messages that surely are missing, and have a cause."""

    NOT_TAKEN = -1
    """What was sent while nobody took it, where the capture may have missed what others lack."""
    PRESSED = 0
    """What surely is missing, where an event names it or its pipe was full."""
    ABSENT = 1
    """Other commands that surely did not come out."""
    CLOSED = 2
    """What is missing while nothing took it."""
    OWN_PACKETS = 3
    """The packets of cFS itself that are."""
    QUIET = 4
    """Commands that surely did not come out, where no event names them and no pipe was full by them."""
    INTO_STOP = 5
    """What was sent to an application that was stopped: its pipe may have been full before that."""
    MISSING = 6
    """What is missing where no pipe was full: it takes what nothing else that is missing explains."""
    POSSIBLE = 7
    """Ranks from here on are of messages of which it is not sure that they are missing."""


_APART_NS: Final = 3 * SECOND
"""What is missing, and what is counted within so long of it, are not two things."""
FAR_NS: Final = 10 * SECOND
"""Nor within so long where nothing else explains either: a cFS that stood still makes times wrong."""
_BOOTS_NS: Final = LEAD_NS + SECOND
"""A boot may count what was sent so short before it: when it was is known to a second."""
BEFORE: Final = -1
Place = tuple[int, PipeKind, int]
"""A count: of which instance, of which kind, and in which second of that counter; ``BEFORE`` its first."""


class Counts(msgspec.Struct):
    """The growth of one instance's loss counters, second by second, less what was told of it.

    Attributes:
        times: i64 (n + 1,), of the samples.
        left: kind to i64 (n,), counts between two samples that nothing has taken.
        first: kind to counts that the first sample had already, likewise.
        older: counts since, which may be of what was sent before the capture.
        boot_ns: all of these are of messages that were sent later.
        set_back: seconds in which the counters were: what they had last is in no count here.
    """

    times: Integers
    left: dict[PipeKind, Integers]
    first: dict[PipeKind, int] = msgspec.field(default_factory=dict)
    boot_ns: int = 0
    older: int = 0
    set_back: Sequence[int] = ()

    @classmethod
    def of(cls, track: Track, boot_ns: int, later: Mapping[PipeKind, Sequence[int]]) -> Counts:
        """Lay out a track of a cFS that began at a time.

        Args:
            later: kind to when events told of losses behind the last sample: each is a count.
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
        """Return which of the seconds each time is in: -1 before the first sample, n behind the last."""
        return np.asarray(np.searchsorted(self.times, times) - 1)

    def span(self, seconds: Sequence[int] | Places) -> tuple[int, int]:
        """Return the times of the samples around some seconds, which are in order."""
        return int(self.times[seconds[0]]), int(self.times[seconds[-1] + 1])

    def between(self, low_ns: Integers, high_ns: Integers) -> Integers:
        """Return how many counts of all kinds are left in the seconds that each of some times overlaps."""
        total = np.concatenate(([0], np.cumsum([*self.left.values()], axis=1).sum(axis=0)))
        first, last = self.seconds(low_ns), self.seconds(high_ns) + 1
        return np.asarray(total[np.clip(last, 0, len(total) - 1)] - total[np.clip(first, 0, len(total) - 1)])

    def often(self, low_ns: Integers, high_ns: Integers) -> Mask:
        """Tell in which times no two samples lie far apart: what is counted then was sent then."""
        rare = np.concatenate(([0], np.cumsum(np.diff(self.times) > TAIL_NS)))
        first = np.clip(self.seconds(low_ns), 0, len(rare) - 1)
        return np.asarray(rare[first] == rare[np.clip(self.seconds(high_ns) + 1, 0, len(rare) - 1)])


class Claim(msgspec.Struct):
    """Messages that are missing, or may be, and that a counter may have counted.

    Attributes:
        key: place of their owner in a list of the caller's.
        low_ns: capture time from which on they can have been counted.
        high_ns: capture time until which they can.
        number: number of messages.
        kinds: kinds of count, the likelier first.
        instances: cFS instances that may have counted them.
        rank: claims of a lower rank are served first.
        flow: traffic that they are of: id of its stream.
        taken: (instance, kind, second of that counter) to the counts that they were given.
        reserved: counts that they share with claims of other traffic.
        doubted: messages that are kept out of ``number``, because the capture itself may have missed them.
    """

    key: int
    low_ns: int
    high_ns: int
    number: int
    kinds: Sequence[PipeKind]
    instances: Sequence[int]
    rank: int = 0
    flow: int = 0
    taken: dict[Place, int] = msgspec.field(default_factory=dict)
    reserved: int = 0
    doubted: int = 0

    @property
    def open(self) -> int:
        """Messages that no count explains yet."""
        return self.number - sum(self.taken.values()) - self.reserved

    def give(self, place: Place, number: int) -> None:
        """Add counts to those that it was given, or take some back."""
        self.taken[place] = self.taken.get(place, 0) + number
        if not self.taken[place]:
            del self.taken[place]

    def by_kind(self) -> dict[tuple[int, PipeKind], int]:
        """Return how many of each kind each instance counted of them."""
        counts: dict[tuple[int, PipeKind], int] = {}
        for (instance, kind, _), number in self.taken.items():
            counts[instance, kind] = counts.get((instance, kind), 0) + number
        return counts


def settle(counts: Mapping[int, Counts], claims: Sequence[Claim], slack_ns: int = 0) -> None:
    """Give claims what was counted, rank after rank, and then as much as can be given at all.

    A count goes to the open claims whose time holds it, to each by how much of it is open. What is left then
    is given by moving others' counts (augmenting paths, as of a bipartite graph). The likelier kind of
    each is given first, as far as it goes; those that it has taken are not moved for the other kind.

    Args:
        counts: the counters of each instance; what is given is taken out of them.
        claims: of all of them together.
        slack_ns: by so much the time of a claim may be wrong, on either side.
    """
    ranks = sorted({claim.rank for claim in claims})
    for place in range(len(COUNTERS)):  # as much as can be is of the likelier kind
        tables = _tables(counts, claims, slack_ns, place + 1)
        for rank in ranks:
            for table in tables.values():
                table.serve([at for at in table.asking if table.prefers(at, rank, place)])
        _improve(tables, claims)


def _tables(
    counts: Mapping[int, Counts], claims: Sequence[Claim], slack_ns: int = 0, kinds: int = len(COUNTERS)
) -> dict[tuple[int, PipeKind], _Table]:
    """Return who may take the counts of each counter that has some left, or whose claims may go elsewhere."""
    several: set[int] = set()
    if len(counts) > 1:
        several.update(at for claim in claims if len(claim.instances) > 1 for at in claim.instances)
    return {
        (instance, kind): _Table((instance, kind), own, claims, slack_ns, kinds)
        for instance, own in counts.items()
        for kind in COUNTERS
        if own.left[kind].any() or instance in several
    }


class Rival(NamedTuple):
    """Traffic that is not in the capture, and that a counter may have counted.

    Attributes:
        flow: what distinguishes it from other traffic, as in ``Claim``.
        instance: cFS instance that may have counted it.
        kind: kind of count.
        start_ns: capture time from which on it may have been counted.
        end_ns: capture time until which it may.
        most: so many of it at most, each second anew.
    """

    flow: int
    instance: int
    kind: PipeKind
    start_ns: int
    end_ns: int
    most: int = 1 << 32


class Shared(msgspec.Struct):
    """Counts that are losses of several kinds of traffic together: nothing tells how many of each.

    Attributes:
        instance: cFS instance that counted them.
        kind: kind of count.
        flows: traffic that shares them, as in ``Claim`` and ``Rival``.
        number: counts.
        start_ns: time of the sample before the first of them.
        end_ns: time of the sample behind the last of them.
    """

    instance: int
    kind: PipeKind
    flows: frozenset[int]
    number: int
    start_ns: int
    end_ns: int

    def add(self, number: int, flows: Iterable[int], span: tuple[int, int]) -> None:
        """Add counts that some traffic shares, of a second."""
        self.number += number
        self.flows |= frozenset(flows)
        self.start_ns, self.end_ns = min(self.start_ns, span[0]), max(self.end_ns, span[1])


def settle_known(
    counts: Mapping[int, Counts], claims: Sequence[Claim], rivals: Sequence[Rival]
) -> list[Shared]:
    """Give counts to what surely is missing, then to what may be; see ``settle_possible``.

    Args:
        rivals: traffic that is not in the capture.
    """
    missing = {Rank.NOT_TAKEN, Rank.PRESSED, Rank.ABSENT, Rank.CLOSED}
    with_own, quiet = missing | {Rank.OWN_PACKETS}, {Rank.QUIET, Rank.INTO_STOP}
    for ranks, slack_ns in ((missing, _APART_NS), (with_own, 0), (quiet, 0)):
        sure = [claim for claim in claims if claim.rank in ranks]
        settle(counts, sure)
        settle(counts, sure, slack_ns)
    return settle_possible(counts, claims, rivals)


def hand_on(
    counts: Counts, instance: int, kind: PipeKind, givers: Sequence[Claim], claims: Sequence[Claim]
) -> None:
    """Hand what some claims were given on to others of the same traffic, what surely is missing first.

    What none of them can have been is left.

    Args:
        counts: of the instance, which counted all of it as of one kind.
        givers: claims that have it.
        claims: those that are to have it.
    """
    table = _Table((instance, kind), counts, claims, 0, len(COUNTERS))
    for place, number in (item for each in givers for item in each.taken.items()):
        rest = number
        for at in sorted(table.within(place[2]), key=lambda at: claims[at].rank):
            if part := min(rest, claims[at].open):
                claims[at].give(place, part)
                rest -= part
        table.left[place[2]] += rest


def settle_first(counts: Mapping[int, Counts], claims: Sequence[Claim], missed: dict[int, int]) -> None:
    """Give what a first sample had already to what surely is missing, was sent before it, and has a cause.

    Args:
        missed: id of a stream to how many of it the capture may have missed; they become fewer.
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


def settle_rest(counts: Mapping[int, Counts], claims: Sequence[Claim]) -> None:
    """Give what nothing else explains to what is missing for no reason that is seen."""
    settle(counts, [claim for claim in claims if claim.rank == Rank.MISSING], _APART_NS)


def settle_doubted(counts: Mapping[int, Counts], claims: Sequence[Claim]) -> None:
    """Give what is left at the very end to what the capture may have missed: it is lost, and not missed."""
    for claim in claims:
        claim.number, claim.doubted = claim.number + claim.doubted, 0
    settle_rest(counts, claims)
    settle(counts, [claim for claim in claims if claim.rank == Rank.MISSING], FAR_NS)


def settle_possible(
    counts: Mapping[int, Counts], claims: Sequence[Claim], rivals: Sequence[Rival] = ()
) -> list[Shared]:
    """Give claims of messages that may be lost what is left, rank after rank, where one traffic alone can be.

    What several share is theirs only as far as nothing that surely is missing can be it: a count that may be
    of such a message proves no other loss.

    Returns:
        what several share.
    """
    # What a gap shows is lost, and what may follow a stream's last message is not: that gets what is left.
    behind = {claim.flow for claim in claims if claim.rank == Rank.POSSIBLE}
    rivals = [*filter(lambda rival: rival.flow not in behind, rivals)]
    gaps = [item for item in claims if item.rank in (Rank.PRESSED, Rank.MISSING) and item.flow in behind]
    settle(counts, gaps, _APART_NS)
    tables = _tables(counts, claims).values()
    shared: dict[tuple[int, PipeKind, frozenset[int]], Shared] = {}
    has_rest = True
    for rank in sorted({claim.rank for claim in claims if claim.rank >= Rank.POSSIBLE}):
        for place in range(len(COUNTERS)):
            for table in tables:
                asking = {at for at in table.asking if table.prefers(at, rank, place)}
                for second in np.flatnonzero(table.left).tolist() if asking else ():
                    takers = [at for at in table.within(second) if at in asking and claims[at].open]
                    span = counts[table.instance].times[second : second + 2].tolist()
                    flows = table.sharers(second, takers, rivals, span)
                    if flows and has_rest:
                        settle_rest(counts, claims)
                        has_rest = False
                    table.give_surplus(second, takers, rivals, span)
                    number = table.give(second, takers, reserve=bool(flows))
                    if flows and number:
                        key = table.instance, table.kind, flows
                        item = shared.setdefault(key, Shared(*key, 0, *span))
                        item.number += number
                        item.end_ns = span[1]
    if not rivals:
        others = [claim for claim in claims if claim.rank != Rank.MISSING]
        _improve(_tables(counts, others), others, alone=True)
    return list(shared.values())


def share_open(counts: Mapping[int, Counts], claims: Sequence[Claim]) -> list[Shared]:
    """Take from each traffic what messages of others may have been counted as, which no count explains.

    Where all others have what they can, the rest of a counter's growth is its own.

    Args:
        claims: of all; what several of those that surely are missing share is no longer open.

    Returns:
        what several share.
    """
    claims = [claim for claim in claims if claim.rank in (Rank.PRESSED, Rank.ABSENT)]
    open_ = {claim.flow for claim in claims if claim.open}
    flows = dict.fromkeys(claim.flow for claim in claims if claim.taken and open_ - {claim.flow})
    trials = [(flow, *_others(counts, claims, flow)) for flow in flows]
    shared: dict[tuple[int, PipeKind], Shared] = {}
    for flow, places, takers in trials:
        for item in (item for item in claims if item.flow == flow):
            for place in [place for place in item.taken if place in places]:
                number = min(item.taken[place], places[place])
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
    counts: Mapping[int, Counts], claims: Sequence[Claim], flow: int
) -> tuple[Counter[Place], list[tuple[Claim, int]]]:
    """Return which counts of a traffic others may have, and which claims are so much less open then."""
    rest = {
        at: replace(item, left={kind: number.copy() for kind, number in item.left.items()})
        for at, item in counts.items()
    }
    others, places = [item for item in claims if item.flow != flow], Counter[Place]()
    for item in claims:
        if item.flow == flow:
            places.update({place: number for place, number in item.taken.items() if place[2] != BEFORE})
    for (at, kind, second), number in places.items():
        rest[at].left[kind][second] += number
        places[at, kind, second] = int(rest[at].left[kind][second])
    copies = [replace(item, taken=dict(item.taken)) for item in others]
    # Those with nothing left, too: counts may be moved through them.
    tables = {
        (at, kind): _Table((at, kind), own, copies, 0, len(COUNTERS))
        for at, own in rest.items()
        for kind in COUNTERS
    }
    _improve(tables, copies)
    for at, kind, second in places:
        places[at, kind, second] -= int(rest[at].left[kind][second])
    takers = zip(others, copies, strict=True)
    return +places, [(item, item.open - copy.open) for item, copy in takers if item.open > copy.open]


class _Table:
    """Who may take the counts of one counter.

    Attributes:
        asking: places of the claims that may.
        left: i64 (n,), its counts that nothing has taken.
    """

    def __init__(
        self, of: tuple[int, PipeKind], own: Counts, claims: Sequence[Claim], slack_ns: int, kinds: int
    ) -> None:
        self.instance, self.kind = of
        self.left, self._claims = own.left[self.kind], claims
        asking = (at for at, claim in enumerate(claims) if self.kind in claim.kinds[:kinds])
        self.asking = [at for at in asking if self.instance in claims[at].instances]
        low = np.array([claims[at].low_ns for at in self.asking], np.int64)
        high = np.array([claims[at].high_ns for at in self.asking], np.int64)
        self._first = np.maximum(own.seconds(low - slack_ns), 0)
        self._last = np.minimum(own.seconds(high + slack_ns), len(own.times) - 2)
        # What was lost before the first sample or behind the last is in no count here.
        self._last[(high <= own.times[0]) | (low >= own.times[-1])] = -1
        self._place = {at: place for place, at in enumerate(self.asking)}
        self._within: dict[int, list[int]] = {}

    def prefers(self, at: int, rank: int, place: int) -> bool:
        """Tell whether a claim is of a rank, is open, and names this kind at a place."""
        claim = self._claims[at]
        return claim.rank == rank and claim.kinds[place:][:1] == (self.kind,) and claim.open > 0

    def within(self, second: int) -> list[int]:
        """Return the claims whose time holds a second."""
        if (own := self._within.get(second)) is None:
            places = np.flatnonzero((self._first <= second) & (self._last >= second))
            own = self._within[second] = [self.asking[place] for place in places.tolist()]
        return own

    def sharers(
        self, second: int, takers: Sequence[int], rivals: Sequence[Rival], span: Sequence[int]
    ) -> frozenset[int]:
        """Return which traffic shares the counts of a second; none where each has its own.

        Args:
            takers: claims that may take them.
            span: when the second begins and ends, ns.
        """
        unseen = {rival.flow for rival in self._unseen(second, rivals, span)}
        flows = frozenset(self._claims[at].flow for at in takers) | unseen
        is_all = not unseen and int(self.left[second]) >= sum(self._claims[at].open for at in takers)
        return frozenset() if is_all or len(flows) == 1 else flows

    def _unseen(self, second: int, rivals: Sequence[Rival], span: Sequence[int]) -> list[Rival]:
        own = [rival for rival in rivals if (rival.instance, rival.kind) == (self.instance, self.kind)]
        doubted = (claim for claim in map(self._claims.__getitem__, self.within(second)) if claim.doubted)
        at = self.instance, self.kind, span[0], span[1]
        own += [Rival(item.flow, *at, item.doubted) for item in doubted]
        return [rival for rival in own if rival.start_ns <= span[1] and span[0] <= rival.end_ns]

    def give_surplus(
        self, second: int, takers: Sequence[int], rivals: Sequence[Rival], span: Sequence[int]
    ) -> None:
        """Give each traffic the counts of a second that all others together cannot have; see ``sharers``."""
        unseen = sum(rival.most for rival in self._unseen(second, rivals, span))
        open_ = Counter[int]()
        for at in takers:
            open_[self._claims[at].flow] += self._claims[at].open
        beyond = int(self.left[second]) - open_.total() - unseen
        for flow, own in open_.items():
            if (most := min(own, beyond + own)) > 0:
                self.give(second, [at for at in takers if self._claims[at].flow == flow], most=most)

    def serve(self, asking: Sequence[int]) -> None:
        """Give counts to claims: to all whose time holds a count, by how much of each is open."""
        first = {at: int(self._first[self._place[at]]) for at in asking}
        order, takers, next_ = sorted(asking, key=first.__getitem__), list[int](), 0
        for second in np.flatnonzero(self.left).tolist():
            while next_ < len(order) and first[order[next_]] <= second:
                takers.append(order[next_])
                next_ += 1
            takers = [at for at in takers if self._last[self._place[at]] >= second and self._claims[at].open]
            self.give(second, takers)

    def give(self, second: int, takers: Sequence[int], *, reserve: bool = False, most: int = 1 << 32) -> int:
        """Give so many counts of a second at most to claims, or reserve them for these; return how many."""
        turn = second % max(1, len(takers))  # what does not divide goes to another one each time
        takers = [*takers[turn:], *takers[:turn]]
        before, opened = int(self.left[second]), [self._claims[at].open for at in takers]
        for at, share in zip(takers, shares(min(before, most), opened, opened), strict=True):
            if share and reserve:
                self._claims[at].reserved += share
            elif share:
                self._claims[at].give((self.instance, self.kind, second), share)
            self.left[second] -= share
        return before - int(self.left[second])


def _improve(
    tables: Mapping[tuple[int, PipeKind], _Table], claims: Sequence[Claim], *, alone: bool = False
) -> None:
    """Give what is left by moving counts between claims; what leads to no open claim is looked at once.

    Args:
        alone: only where one traffic alone can have lost more.
    """
    dead: set[int] = set()
    if not any(claim.open for claim in claims):
        return
    for (instance, kind), table in tables.items():
        for second in np.flatnonzero(table.left).tolist():
            place = instance, kind, second
            if alone:
                ways = _ways_from(tables, claims, place, set())
                may = (claims[at] for _, _, fresh in ways for at in fresh)
                if len({claim.flow for claim in may if claim.open or claim.doubted}) != 1:
                    continue
            while table.left[second] and (path := _path(tables, claims, place, dead)):
                _shift(table, claims, path)


def _shift(table: _Table, claims: Sequence[Claim], path: Sequence[tuple[Place, int]]) -> None:
    """Give counts of a table along a path: each claim gives up its own for those of the one before it."""
    second = path[0][0][2]
    moved = min(int(table.left[second]), claims[path[-1][1]].open)
    for (place, _), (_, before) in zip(path[1:], path, strict=False):
        moved = min(moved, claims[before].taken[place])
    for place, at in path:
        claims[at].give(place, moved)
    for (place, _), (_, before) in zip(path[1:], path, strict=False):
        claims[before].give(place, -moved)
    table.left[second] -= moved


def _path(
    tables: Mapping[tuple[int, PipeKind], _Table], claims: Sequence[Claim], start: Place, dead: set[int]
) -> list[tuple[Place, int]] | None:
    """Return which counts go to which claims instead, from some that are left to a claim that is open.

    Args:
        dead: claims that lead nowhere; added to where there is no path.
    """
    from_: dict[int, tuple[Place, int | None]] = {}
    for place, giver, fresh in _ways_from(tables, claims, start, dead):
        for at in fresh:
            from_[at] = place, giver
            if claims[at].open:
                path, before = [(place, at)], giver
                while before is not None:
                    path.append((from_[before][0], before))
                    before = from_[before][1]
                return path[::-1]
    dead.update(from_)
    return None


def _ways_from(
    tables: Mapping[tuple[int, PipeKind], _Table], claims: Sequence[Claim], start: Place, dead: set[int]
) -> Iterator[tuple[Place, int | None, list[int]]]:
    """Yield where some counts can go to, by moving those of others.

    Each is a place, the claim that has its counts, None where nobody does, and the claims that may get them,
    each once.

    Args:
        dead: claims that are passed over.
    """
    todo: list[tuple[Place, int | None]] = [(start, None)]
    places, reached = set[Place](), set[int]()
    while todo:
        place, giver = todo.pop()
        if place not in places:
            places.add(place)
            within = tables[place[0], place[1]].within(place[2])
            fresh = [at for at in within if at not in reached and at not in dead]
            reached.update(fresh)
            yield place, giver, fresh
            todo += [
                (other, at) for at in fresh for other in claims[at].taken if (other[0], other[1]) in tables
            ]


def shares(number: int, weights: Sequence[float], most: Sequence[int]) -> list[int]:
    """Divide a number by weights into whole parts, none above its most; what does not fit is left."""
    out, rest = [0] * len(weights), number
    while rest > 0:
        free = [at for at in range(len(out)) if out[at] < most[at] and weights[at] > 0]
        if not free:
            break
        total = sum(weights[at] for at in free)
        exact = [rest * weights[at] / total for at in free]
        parts = [min(int(value), most[at] - out[at]) for value, at in zip(exact, free, strict=True)]
        if not any(parts):  # what does not divide: one each, as far as it goes
            parts = (np.argsort(np.argsort(-np.array(exact), kind="stable")) < rest).astype(int).tolist()
        for at, part in zip(free, parts, strict=True):
            out[at] += part
        rest = number - sum(out)
    return out


def claimed_alike(
    counts: Sequence[Counts], low_ns: Integers, high_ns: Integers, *keys: Places
) -> list[Places]:
    """Return groups of messages that the same counts may hold, as indices: one claim can speak for each.

    Args:
        counts: of the instances that may have counted them.
        low_ns: from when on each can have been counted.
        high_ns: and until when.
        keys: what else those of a group have in common.
    """
    _, which = numbered(*[own.seconds(times) for own in counts for times in (low_ns, high_ns)], *keys)
    return [members for _, members in by_value(which)]
