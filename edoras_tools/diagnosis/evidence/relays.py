"""Hops between a sender and a receiver: proxies, relays, and address translation.

A proxy, or a replay, logs in the recording the faults that it injects on purpose (``/edoras/faults``):

1. A datagram that it dropped is lost at the proxy. It is not in the recording, and no later hop misses it.
2. If it sent a datagram several times, all but the first are duplicates of that hop.
3. A datagram that it delayed, changed or cut is counted, and goes on.

A proxy's recording has the datagrams that it sent on. A capture in front of the proxy also has those that it
dropped. Therefore:

4. A captured datagram that the proxy dropped was captured in front of the proxy.
5. If the capture has most of the dropped datagrams of one direction, the conversations with these are in
   front of the proxy. They are left out, and the dropped datagrams count once, at the proxy.
6. If the conversation has the same endpoints behind the proxy, only the dropped datagrams are left out. The
   others are copies, which count once anyway.
7. Bytes that are sent again and again prove nothing.

An address translation, as by a Docker host or a router, has the same datagrams on both sides:

8. A host that only forwards a datagram keeps its bytes and its IP identification, and lowers its time to
   live. A proxy sends it again and does not lower it: that is a hop of its own.
9. If nearly all datagrams of one conversation, at least eight, appear so within 20 ms in another one, the two
   are one conversation, and its endpoints have two names. For shorter conversations this holds if their
   addresses are already known as two names of one.
10. Each endpoint gets its name on the inner side: a source the one before translation, a destination the one
    behind it. Many endpoints may share the outer address.

A relay receives datagrams at its own address and sends them again. A capture of both sides has them twice:

11. A conversation is behind a relay if most of its datagrams, at least eight, went before to the address of
    its sender, or to an address that never sends anything. It is kept, with the original senders, and the
    datagrams in front of the relay are left out. If the relay has the address of its senders, it counts as a
    relay only if the opposite direction passes it too.
12. A datagram that went into the relay and did not come out is lost there. One that came out again is a copy.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec
import numpy as np

from edoras_tools.diagnosis.evidence.fingerprint import latest_equal, paired
from edoras_tools.diagnosis.evidence.table import Rows, number_hosts
from edoras_tools.sessions.sequence import MODULUS
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import sbn
from edoras_tools.wire.arrays import MIX, PADDING, by_key, by_value, distinct, numbered, of_bytes

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from edoras_tools.model import Endpoint
    from edoras_tools.sessions.faults.rules import Fault
    from edoras_tools.wire.arrays import Integers, Mask, Places, Prints


PROXY_HOP: Final = "proxy"
RELAY_HOP: Final = "relay"
_DROPPED: Final = "dropped"
_TIMES: Final = ("sent ", " times")
_OVERFLOW: Final = "overflow"


class Proxied(msgspec.Struct):
    """The faults that a proxy injected into one MsgId on one link in one direction.

    Attributes:
        dropped: time in ns and bytes of each dropped datagram.
        doubled: number of copies that it sent.
        others: kind of another fault to the number of datagrams with it.
        start_ns: time of the first fault.
        end_ns: time of the last fault.
        rules: texts of the rules that injected them, in order of first use.
    """

    dropped: list[tuple[int, bytes]] = msgspec.field(default_factory=list)
    doubled: int = 0
    others: Counter[str] = msgspec.field(default_factory=Counter)
    start_ns: int = 0
    end_ns: int = 0
    rules: dict[str, None] = msgspec.field(default_factory=dict)

    def counts(self, *, peers: bool) -> list[int]:
        """Return the sequence counts of the dropped datagrams.

        Args:
            peers: whether an SBN header stands in front of each packet.
        """
        at = (sbn.HEADER.size if peers else 0) + 2
        return [
            int.from_bytes(data[at : at + 2], "big") % MODULUS
            for _, data in self.dropped
            if len(data) >= at + 2
        ]


UNTOUCHED: Final = Proxied()
RouteWay = tuple[int, bool, int]
"""Code of the link, whether the direction is to cFS, and the MsgId."""


def proxied(faults: Sequence[Fault]) -> dict[RouteWay, Proxied]:
    """Return the logged faults by link, direction and MsgId."""
    result: dict[RouteWay, Proxied] = {}
    kinds: dict[tuple[int, int, bytes], Counter[str]] = {}
    for fault in faults:
        item = result.setdefault((fault.link.code, fault.to_cfs, fault.msg_id), Proxied())
        item.start_ns = min(item.start_ns or fault.time_ns, fault.time_ns)
        item.end_ns = max(item.end_ns, fault.time_ns)
        if fault.rule:
            item.rules[fault.rule] = None
        if fault.detail.startswith(_DROPPED) or fault.kind == _OVERFLOW:
            # If two rules drop one datagram, the log has both.
            same = kinds.setdefault((fault.time_ns, fault.stream, fault.original), Counter())
            before = max(same.values(), default=0)
            same[fault.rule] += 1
            if max(same.values()) > before:
                item.dropped.append((fault.time_ns, fault.original))
        elif fault.detail.startswith(_TIMES[0]) and fault.detail.endswith(_TIMES[1]):
            item.doubled += int(fault.detail[len(_TIMES[0]) : -len(_TIMES[1])]) - 1
        else:
            item.others[fault.kind] += 1
    return result


_WITHIN_NS: Final = 20 * MILLISECOND
_LEAST: Final = 0.8
"""Least share of the dropped datagrams that were captured, and that have different bytes."""


def before_proxy(rows: Rows, proxied: Mapping[RouteWay, Proxied]) -> Mask:
    """Return which rows were captured in front of a proxy, bool (rows,) (rules 4 to 7)."""
    out = np.zeros(len(rows), bool)
    way = rows.way()
    for (link, _, msg_id), item in proxied.items():
        own = np.flatnonzero((rows.link == link) & (rows.msg_id == msg_id))
        prints = _prints([data for _, data in item.dropped])
        if not len(own) or len(np.unique(prints)) < max(1, _LEAST * len(prints)):
            continue
        matches = _matching(rows, own, prints, np.array([when for when, _ in item.dropped], np.int64))
        if len(matches) < _LEAST * len(prints):
            continue
        in_front = np.isin(way, np.unique(way[matches])) & rows.on(lambda kind: kind.packets)
        if (~in_front[own]).any():
            out |= in_front
        else:
            out[matches] = True
    return out


def _matching(rows: Rows, own: Places, prints: Prints, times: Integers) -> Places:
    """Return those of the rows ``own`` whose bytes and time (within 20 ms) match one of some datagrams.

    Args:
        prints: u64, fingerprints of the datagrams.
        times: i64, their times, ns.
    """
    mine, when = rows.bytes_print[own], rows.time_ns[own]
    before = latest_equal(prints, times, mine, when)
    behind = latest_equal(prints, -times, mine, -when)
    near = (before >= 0) & (when - times[before] <= _WITHIN_NS)
    near |= (behind >= 0) & (times[behind] - when <= _WITHIN_NS)
    return own[near]


def _prints(datagrams: Sequence[bytes]) -> Prints:
    length = np.array([len(data) for data in datagrams], np.int64)
    data = np.frombuffer(b"".join(datagrams) + bytes(PADDING), np.uint8)
    return of_bytes(data, np.cumsum(length) - length, length)


_LEAST_DATAGRAMS: Final = 8
_NEARLY_ALL: Final = 0.8


def one_name(rows: Rows, endpoints: Sequence[Endpoint]) -> NDArray[np.int32]:
    """Return the number of the endpoint on the inner side for each endpoint, i32 (rules 8 to 10).

    Args:
        rows: table of datagrams, in order of time.
        endpoints: endpoints that ``source`` and ``destination`` of the rows index.
    """
    names = np.arange(len(endpoints), dtype=np.int32)
    same = _forwarded(rows, endpoints)
    outer = {other for _, other in same}

    changed = True
    while changed:
        changed = False
        for pair in same:
            best = min((int(names[at]) for at in pair), key=lambda at: (at in outer, endpoints[at]))
            for index in pair:
                changed |= bool(names[index] != best)
                names[index] = best
    return names


def _forwarded(rows: Rows, endpoints: Sequence[Endpoint]) -> set[tuple[int, int]]:
    """Return pairs of endpoints that are two names of one: the inner, then the outer."""
    if not len(rows) or rows.life.min() == rows.life.max():  # nothing was forwarded
        return set()
    way = rows.way()
    key = rows.bytes_print ^ rows.identification.astype(np.uint64) * MIX
    order = np.lexsort((rows.time_ns, key))
    near = (key[order][1:] == key[order][:-1]) & (np.diff(rows.time_ns[order]) <= _WITHIN_NS)
    early, late = order[:-1][near], order[1:][near]
    onward = (way[early] != way[late]) & (rows.life[late] < rows.life[early])
    if not onward.any():  # mostly so
        return set()
    ways, number = np.unique(np.stack((way[early], way[late]))[:, onward], axis=1, return_counts=True)
    values, sizes = np.unique(way, return_counts=True)
    size = dict(zip(values.tolist(), sizes.tolist(), strict=True))
    likely = [
        (count, _ends(one, other))
        for (one, other), count in zip(ways.T.tolist(), number.tolist(), strict=True)
        if count >= _NEARLY_ALL * min(size[one], size[other])
    ]
    pairs = {ends for count, both in likely if count >= _LEAST_DATAGRAMS for ends in both}
    addresses = {frozenset(endpoints[index].address for index in ends) for ends in pairs}
    for _, both in likely:
        if all(frozenset(endpoints[index].address for index in ends) in addresses for ends in both):
            pairs |= both
    return pairs


def _ends(one: int, other: int) -> set[tuple[int, int]]:
    """Return the endpoints that differ between two conversations: pairs of the inner, then the outer.

    A source is translated on its way out, a destination on its way in.
    """
    source, destination = (one >> 32, other >> 32), (other & 0xFFFFFFFF, one & 0xFFFFFFFF)
    return {ends for ends in (source, destination) if ends[0] != ends[1]}


_MOST_HOSTS: Final = 64
"""With more hosts, no relay is looked for that sends from another address."""
_CLOCKS_NS: Final = 50 * MILLISECOND
"""Largest difference between the clocks of the two captures at a relay."""
LONGEST_NS: Final = 10 * SECOND
"""Longest time under way between two points."""
_LATE_NS: Final = 100 * MILLISECOND
_MOSTLY: Final = 0.5
"""Least share of the datagrams behind a relay that were also captured in front of it."""


class Segment(NamedTuple):
    """The n datagrams that were captured at one point of a path and at the next one.

    Attributes:
        into: intp (n,), indices of datagrams at the first point.
        out: intp (n,), index at the second point of each of these, ascending.
        took_ns: i64 (n,), time from the first point to the second.
    """

    into: Places
    out: Places
    took_ns: Integers

    @property
    def late(self) -> int:
        """Number of datagrams that took over 100 ms longer than the quickest one."""
        return int((self.took_ns - self.took_ns.min(initial=0) > _LATE_NS).sum())

    @property
    def out_of_order(self) -> int:
        """Number of datagrams that came out behind one that had gone in later."""
        return int((self.into < np.maximum.accumulate(self.into)).sum())

    def take(self, some: Mask) -> Segment:
        """Return the pairs that a mask selects."""
        return Segment(self.into[some], self.out[some], self.took_ns[some])


def pair_up(into: Prints, into_ns: Integers, out: Prints, out_ns: Integers, early_ns: int) -> Segment:
    """Pair equal datagrams at two points: each with the latest one that was not later, each once.

    Args:
        into: u64, fingerprints at the first point, in order of time.
        into_ns: i64, capture times at the first point.
        out: u64, fingerprints at the second point.
        out_ns: i64, capture times at the second point.
        early_ns: largest time by which the second clock may be behind the first one.
    """
    origin = paired(into, into_ns, out, out_ns + early_ns)
    places = np.flatnonzero(origin >= 0)
    segment = Segment(origin[places], places, out_ns[places] - into_ns[origin[places]])
    return segment.take(segment.took_ns <= LONGEST_NS)


class LostInRelay(NamedTuple):
    """The losses and delays of one MsgId at a relay, for one receiver.

    Attributes:
        relay: endpoint at which the relay receives datagrams.
        link: code of the link.
        msg_id: cFE MsgId.
        receiver: number of the endpoint that the datagrams go to behind the relay.
        lost_ns: i64, capture time in front of the relay of each datagram that did not leave it.
        of: number of datagrams that reached the relay.
        figures: ``duplicated``, ``late`` and ``out_of_order``, as in ``ledger.Row``.
    """

    relay: Endpoint
    link: int
    msg_id: int
    receiver: int
    lost_ns: Integers
    of: int
    figures: Mapping[str, int]

    @property
    def hop(self) -> str:
        """Name of the relay's hop."""
        return f"{RELAY_HOP} {self.relay}"

    @property
    def more(self) -> int:
        """Number of datagrams that went in, minus those that came out."""
        return len(self.lost_ns) - self.figures["duplicated"]


class RelayedWay(NamedTuple):
    """The datagrams of one direction through a relay that was captured on both sides.

    Attributes:
        relay: endpoint at which the relay receives datagrams.
        before: rows in front of the relay.
        behind: rows behind the relay, in order of time.
        made_of: intp (behind,), index in ``before`` of the latest equal one; -1 if none fits.
        segment: pairs of one datagram in front and behind; other ones behind the relay are copies.
    """

    relay: Endpoint
    before: Places
    behind: Places
    made_of: Places
    segment: Segment

    def sources(self, rows: Rows) -> NDArray[np.int32]:
        """Return the original sender of each row behind, i32; without a match that of the row before it."""
        last = np.maximum.accumulate(np.where(self.made_of >= 0, np.arange(len(self.behind)), -1))
        last[last < 0] = int(np.flatnonzero(self.made_of >= 0)[0])
        return np.asarray(rows.source[self.before[self.made_of[last]]])

    def delay_ns(self, rows: Rows) -> float:
        """Return the median time through the relay, ns."""
        valid = self.made_of >= 0
        return float(np.median((rows.time_ns[self.behind] - rows.time_ns[self.before[self.made_of]])[valid]))

    def losses(self, rows: Rows) -> Iterator[LostInRelay]:
        """Yield the losses and delays of each MsgId that has any."""
        lost, doubled = np.delete(self.before, self.segment.into), np.delete(self.behind, self.segment.out)
        # Datagrams that are twice in front of the relay need to come out only once.
        every = np.concatenate((self.before[self.segment.into], lost))
        number = rows.identification[every]
        once = numbered(rows.bytes_print[every], number, np.where(number, 0, every))[0]
        lost = lost[np.isin(lost, every[once])]
        receiver, link = int(rows.destination[self.behind[0]]), int(rows.link[self.before[0]])
        for msg_id, own in by_value(rows.msg_id[self.before]):
            lost_ns = rows.time_ns[lost[rows.msg_id[lost] == msg_id]]
            more = int((rows.msg_id[doubled] == msg_id).sum())
            passed = self.segment.take(rows.msg_id[self.before[self.segment.into]] == msg_id)
            figures = {"duplicated": more, "late": passed.late, "out_of_order": passed.out_of_order}
            if len(lost_ns) or any(figures.values()):
                yield LostInRelay(self.relay, link, msg_id, receiver, lost_ns, len(own), figures)


def find_relayed(rows: Rows, endpoints: Sequence[Endpoint], unsteady_ns: int = 0) -> list[RelayedWay]:
    """Return each direction through each relay that was captured on both sides (rule 11).

    Args:
        rows: table of datagrams, in order of time.
        endpoints: endpoints that ``source`` and ``destination`` of the rows index.
        unsteady_ns: random error of the capture times, ns.
    """
    early_ns, host = max(_CLOCKS_NS, unsteady_ns), number_hosts(endpoints)
    if len(distinct(host[rows.source])) < 2:  # as on loopback
        return []
    leaving = by_key((own for _, own in by_value(rows.way())), lambda own: int(host[rows.source[own[0]]]))
    every = [item for own in leaving.values() for item in own] if len(leaving) <= _MOST_HOSTS else []
    relayed = []
    for relay, before in by_value(rows.destination):
        senders, at = set(rows.source[before].tolist()), int(host[relay])
        if len(before) < _LEAST_DATAGRAMS:
            continue
        # If nobody, or only its own senders, send from this address, the relay may send from another one.
        apart = at not in leaving or at in host[list(senders)]
        relayed += [
            item
            for behind in (every if apart else leaving[at])
            if rows.link[behind[0]] == rows.link[before[0]]
            and not senders & {int(rows.source[behind[0]]), int(rows.destination[behind[0]])}
            and int(host[rows.destination[behind[0]]]) != at
            and int(host[rows.destination[behind[0]]]) in leaving
            and (item := _relayed(rows, endpoints[relay], before, behind, early_ns)) is not None
        ]

    # Within the error of two clocks, either side may seem to be behind: the later one is. If times have
    # random errors, it is the side whose datagrams the other side has more completely.
    def rank(item: RelayedWay) -> float:
        return float((item.made_of >= 0).mean()) if unsteady_ns else item.delay_ns(rows)

    by_first = {(int(item.before[0]), int(item.behind[0])): item for item in _both_ways(rows, host, relayed)}
    return [
        item
        for (before, behind), item in by_first.items()
        if (behind, before) not in by_first or rank(item) > rank(by_first[behind, before])
    ]


def _both_ways(rows: Rows, host: NDArray[np.int32], relayed: list[RelayedWay]) -> list[RelayedWay]:
    """Return the candidates that are relays: one at the address of its senders needs both directions."""
    ends = [(int(rows.destination[item.before[0]]), int(rows.source[item.behind[0]])) for item in relayed]
    later = {pair for item, pair in zip(relayed, ends, strict=True) if item.delay_ns(rows) > 0}
    return [
        item
        for item, pair in zip(relayed, ends, strict=True)
        if host[pair[0]] != host[rows.source[item.before[0]]] or {pair, pair[::-1]} <= later
    ]


def _relayed(rows: Rows, relay: Endpoint, before: Places, behind: Places, early_ns: int) -> RelayedWay | None:
    """Return the direction through a possible relay; None if too few datagrams are equal on both sides."""
    into, out = ((rows.bytes_print[own], rows.time_ns[own]) for own in (before, behind))
    made_of = latest_equal(*into, out[0], out[1] + early_ns)
    made_of[out[1] - into[1][made_of] > LONGEST_NS] = -1
    if (made_of >= 0).sum() < max(_LEAST_DATAGRAMS, _MOSTLY * len(behind)):
        return None
    return RelayedWay(relay, before, behind, made_of, pair_up(*into, *out, early_ns))
