"""Prepares the rows of a diagnosis: in order of time, each datagram once, and only the traffic of cFS.

Rules:

1. If the records of a file are out of order, they are sorted first. If the capture clock was set back, they
   are in order: then the times in cFS's packets still increase.
2. Conversations of other programs are left out. Datagrams of strangers that reached a cFS stay, as datagrams
   without a packet.
3. A datagram that was captured twice counts once. This includes captures in front of and behind a proxy or a
   relay, and on both sides of an address translation.
4. A damaged datagram is left out, because its receiver dropped it.
5. Only the 1,000 busiest senders on links from cFS are examined. The others are left out and counted.
"""

from __future__ import annotations

from operator import attrgetter
from typing import TYPE_CHECKING, Final

import numpy as np
from msgspec.structs import asdict, replace

from edoras_tools.decode.conversations import LEFT_OUT, ConversationKind, Flow
from edoras_tools.diagnosis.evidence import copies
from edoras_tools.diagnosis.evidence.fingerprint import latest_equal
from edoras_tools.diagnosis.evidence.relays import before_proxy, find_relayed, one_name
from edoras_tools.diagnosis.evidence.table import PRINTS, SCATTERED, Recorder, Rows, followed, number_hosts
from edoras_tools.links.table import carrying
from edoras_tools.model import NO_MSG_ID, NO_ROUTE, Endpoint, Finding
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire.arrays import MIX, Integers, Mask, Places, distinct, groups, numbered, perhaps_in

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.evidence.payloads import Payloads
    from edoras_tools.diagnosis.evidence.relays import LostInRelay, Proxied, RelayedWay, RouteWay

_MOST_SET: Final = 16
"""A clock is set back only a few times; if times go back more often, the records are out of order."""
_MOST_SENDERS: Final = 1000
_RUN: Final = 50
_READ_IN_A_SECOND: Final = 22
"""Datagrams, by the lab applications' Command Ingest."""
_DRAINS_NS: Final = 15 * SECOND
"""A datagram may wait this long in its socket."""
_PLACE: Final = {kind: place for place, kind in enumerate(ConversationKind)}


class Prepared:
    """The prepared rows of a recorder, and the datagrams that were left out.

    Args:
        recorder: rows and payloads of the capture.
        proxied: (link, direction, MsgId) to the faults that a proxy injected.
        astray: time in ns, fingerprint and certainty of each datagram that was lost between two captures.
        shared: whether there are several captures, and a datagram that two of them have stands here once.

    Attributes:
        rows: table of the datagrams to examine, in order of time.
        payloads: contents of these rows.
        flows: all conversations, with their kinds.
        foreign: number of datagrams of other programs, left out.
        crowd: i64, number of datagrams of each sender beyond the busiest ones, left out.
        copies: number of datagrams that were captured twice, left out.
        relayed: number of datagrams captured in front of a proxy, left out: they count behind it.
        passed: losses, copies and delays at relays that were captured on both sides, by MsgId.
        duplicates: i64, indices of rows that the network doubled.
        damaged: one row for each damaged datagram, left out of ``rows``.
        doubled: rows that were either captured or sent twice, without evidence which; left out of ``rows``.
        perhaps_undelivered: bool (rows,), the datagram reached one capture, and the next one on its path
            perhaps only missed it.
        disordered: number of records that stood behind a later one.
        unsteady_ns: random error of the capture times, ns.
        translated: address to its other name on the inner side of an address translation.
    """

    def __init__(
        self,
        recorder: Recorder,
        proxied: Mapping[RouteWay, Proxied],
        astray: Sequence[tuple[int, int, bool]] = (),
        *,
        shared: bool = False,
    ) -> None:
        rows, payloads, self.disordered = in_time_order(recorder)
        self.rows = _of_output(rows)
        del rows  # so that memory never holds the table twice
        self.flows, endpoints = recorder.conversations.judge(), recorder.endpoints
        kind = _kinds(self.rows, payloads, self.flows, endpoints)
        count, source_of = len(self.rows), self.rows.source
        self._places = np.arange(count)
        """Index of each row in the table at the start."""
        self.foreign = self._keep(kind != _PLACE[ConversationKind.FOREIGN])
        self.crowd = self._leave_crowd()
        names = one_name(self.rows, endpoints)
        self._rename(names)
        pairs = enumerate(names.tolist())
        self.translated = {endpoints[at].address: endpoints[to].address for at, to in pairs if at != to}
        self.damaged = self._leave_damaged(number_hosts(endpoints), shared=shared)
        self.unsteady_ns = unsteadiness(self.rows)
        self.passed = self._leave_before(find_relayed(self.rows, endpoints, self.unsteady_ns))
        self.relayed = self._keep(~before_proxy(self.rows, proxied))
        sources = names[source_of[payloads.ingest["row"]]]
        copy, duplicate, perhaps, alone, behind_ns = _doubled(
            self.rows, payloads, sources, endpoints, proxied
        )
        self.doubled = self.rows.take(np.flatnonzero(perhaps))
        self.copies = int(copy.sum()) - len(self.doubled)
        single = np.flatnonzero(~copy)
        if behind_ns.any():
            self.rows = replace(self.rows, time_ns=self.rows.time_ns - behind_ns)
            single = single[np.argsort(self.rows.time_ns[single], kind="stable")]
            self.rows, self._places = followed(self.rows.take(single)), self._places[single]
        else:
            self._keep(~copy)
        self.duplicates = np.flatnonzero(duplicate[single])
        stranger = kind[self._places] == _PLACE[ConversationKind.STRANGER]
        if len(self._places) < count or stranger.any():
            payloads = payloads.over(np.where(stranger, -1, self._places), count)
        self.payloads = payloads.timed(self.rows.time_ns) if behind_ns.any() else payloads
        surely, perhaps_undelivered = _find_astray(self.rows, astray)
        self.perhaps_undelivered = perhaps_undelivered | alone[single]
        self.rows = replace(self.rows, undelivered=surely)
        if stranger.any():
            self.rows = _emptied(self.rows, stranger)

    def _keep(self, some: Mask) -> int:
        """Keep the rows that a mask selects; return the number of the others."""
        if gone := int(len(some) - np.count_nonzero(some)):
            # Masks copy runs of rows, which is faster if the runs are long.
            own, columns = some if gone * _RUN < len(some) else np.flatnonzero(some), asdict(self.rows)
            self.rows, self._places = self.rows.take(self._places[:0]), self._places[own]
            self.rows = Rows(**{name: columns.pop(name)[own] for name in list(columns)})
        return gone

    def _leave_crowd(self) -> Integers:
        """Leave out senders beyond the busiest ones (rule 5); return the number of rows of each."""
        rows = self.rows
        crowded, own = np.zeros(len(rows), bool), np.flatnonzero(rows.on(lambda link: link.from_cfs))
        first, which = numbered(rows.source[own], rows.spacecraft_id[own], rows.processor_id[own])
        counts = np.bincount(which, minlength=len(first))
        beyond = np.argsort(-counts, kind="stable")[_MOST_SENDERS:]
        crowded[own] = np.isin(which, beyond)
        self._keep(~crowded)
        return counts[beyond]

    def _rename(self, names: NDArray[np.int32]) -> None:
        """Give each endpoint one name (rule 3): ``names`` has that of each."""
        if (names != np.arange(len(names))).any():
            ends = {end: names[getattr(self.rows, end)] for end in ("source", "destination")}
            self.rows = followed(replace(self.rows, **ends))

    def _leave_damaged(self, hosts: NDArray[np.int32], *, shared: bool) -> Rows:
        """Leave out damaged datagrams (rule 4); return one row of each."""
        lost, standing = copies.find_damaged(self.rows, hosts, shared=shared)
        damaged = self.rows.take(standing)
        if self._keep(~lost):
            self.rows = followed(self.rows)
        return damaged

    def _leave_before(self, relays: Sequence[RelayedWay]) -> tuple[LostInRelay, ...]:
        """Leave out what was captured in front of relays (rule 3), and return what these lost.

        What is behind a relay has that sender. A damaged datagram behind it counts in front, as not sent on.
        """
        lost = tuple(loss for item in relays for loss in item.losses(self.rows))
        if relays:
            ways = self.rows.way(np.concatenate([item.behind for item in relays]))
            self.damaged = self.damaged.take(~np.isin(self.damaged.way(), ways))
            source, behind = self.rows.source.copy(), np.ones(len(self.rows), bool)
            for item in relays:
                source[item.behind] = item.sources(self.rows)
                behind[item.before] = False
            self.rows = replace(self.rows, source=source)
            self._keep(behind)
            self.rows = followed(self.rows)
        return lost


def _find_astray(rows: Rows, astray: Sequence[tuple[int, int, bool]]) -> tuple[Mask, Mask]:
    """Return the rows that certainly and those that perhaps did not reach the next capture: bool (rows,)."""
    sure = {(when, value): proven for when, value, proven in astray}
    near = np.flatnonzero(np.isin(rows.time_ns, [when for when, _ in sure]))
    keys = zip(rows.time_ns[near].tolist(), rows.bytes_print[near].tolist(), strict=True)
    astray_at = np.zeros((2, len(rows)), bool)
    for row, key in zip(near.tolist(), keys, strict=True):
        if key in sure:
            astray_at[int(not sure[key]), row] = True
    return astray_at[0], astray_at[1]


def _doubled(
    rows: Rows,
    payloads: Payloads,
    sources: NDArray[np.int32],
    endpoints: Sequence[Endpoint],
    proxied: Mapping[RouteWay, Proxied],
) -> tuple[Mask, Mask, Mask, Mask, Integers]:
    """Return masks (rows,): not to count, doubled by the network, undecided, and seen at one of two places.

    The last array is i64 (rows,), the clock difference of the latter in ns.

    Args:
        sources: i32, endpoint that sent each sample of CI's counts.
    """
    pairs = copies.find_copies(rows.time_ns, rows.identification, rows.way(), rows.tap, rows.bytes_print)
    pairs = pairs._replace(copy=pairs.copy & ~pairs.steady, duplicate=pairs.duplicate | pairs.steady)
    if not pairs.duplicate.any():  # mostly so
        return pairs.copy, pairs.duplicate, pairs.duplicate, *pairs[4:]
    who = copies.who_doubled(rows, pairs, payloads.ingest, sources, endpoints)
    if any(item.doubled for item in proxied.values()):
        # The proxy's log shows repeated datagrams.
        who[pairs.duplicate & ~pairs.steady & (who == 0)] = copies.BY_NETWORK
    who[pairs.steady & (who == 0)] = copies.BY_CAPTURE
    perhaps = pairs.duplicate & (who == 0)
    return pairs.copy | perhaps | (who == copies.BY_CAPTURE), who == copies.BY_NETWORK, perhaps, *pairs[4:]


def in_time_order(recorder: Recorder) -> tuple[Rows, Payloads, int]:
    """Return a recorder's rows and payloads in order of time, and how many records were out of order.

    If any were, the sequence counts are followed again, so that gaps are those of the link, not of the file.
    """
    rows, payloads = recorder.rows(), recorder.payloads.ordered()
    if disordered := _disordered(rows):
        order = np.argsort(rows.time_ns, kind="stable")
        rows, payloads = followed(rows.take(order)), payloads.over(order, len(rows))
    return rows, payloads, disordered


def _of_output(rows: Rows) -> Rows:
    """Return the rows with commands between Telemetry Output's endpoints moved to the link from cFS."""
    up, down = (rows.link == carrying("ground", to_cfs=to_cfs) for to_cfs in (True, False))
    way = rows.way()
    own = up & np.isin(way, distinct(way[down]))
    link = np.where(own, carrying("ground", to_cfs=False), rows.link).astype(np.uint8)
    return replace(rows, link=link) if own.any() else rows


def _kinds(
    rows: Rows, payloads: Payloads, flows: Sequence[Flow], endpoints: Sequence[Endpoint]
) -> NDArray[np.int8]:
    """Return the kind of each row's conversation, i8 (rows,): its index in ``ConversationKind`` (rule 2)."""
    out = np.full(len(rows), _PLACE[ConversationKind.CFS], np.int8)
    number = {endpoint: index for index, endpoint in enumerate(endpoints)}
    for flow in flows:
        if flow.kind in LEFT_OUT and flow.source in number and flow.destination in number:
            own = (rows.source == number[flow.source]) & (rows.destination == number[flow.destination])
            out[own] = _PLACE[flow.kind]
    strange = out == _PLACE[ConversationKind.STRANGER]
    if strange.any() and not _has_strangers(rows, payloads, out):
        # CI did not count these datagrams, so they did not reach it, whatever their ports.
        out[strange] = _PLACE[ConversationKind.FOREIGN]
    return out


def _has_strangers(rows: Rows, payloads: Payloads, kind: NDArray[np.int8]) -> bool:
    """Return whether CI's counter includes the strangers' datagrams; True without samples.

    Only samples around them count, and none across a restart: there CI may have lost as many of the bridges'.
    """
    samples, strangers = payloads.ingest, rows.time_ns[kind == _PLACE[ConversationKind.STRANGER]]
    first, end = np.searchsorted(samples["time_ns"], [strangers.min(), strangers.max() + _DRAINS_NS])
    own = slice(max(0, first - 1), end + 1)
    counted_ns, packets, errors = (samples[name][own] for name in ("time_ns", "packets", "errors"))
    if len(counted_ns) < 2:
        return True
    steps = np.diff(packets)
    grown = int((steps + np.diff(errors))[steps >= 0].sum())
    between = np.pad(steps >= 0, 1)[np.searchsorted(counted_ns, rows.time_ns)]
    to_ci = between & rows.on(lambda link: link.to_cfs and not link.from_cfs)
    seconds = rows.time_ns[to_ci & (kind == _PLACE[ConversationKind.STRANGER])] // SECOND
    # Of a flood it reads a part, and its socket drops the rest.
    strange = int(np.minimum(np.unique(seconds, return_counts=True)[1], _READ_IN_A_SECOND).sum())
    # Of those of bridges, equal bytes and identification count once.
    bridges = to_ci & (kind == _PLACE[ConversationKind.CFS])
    same = np.flatnonzero(bridges & (rows.identification != 0))
    once, _ = numbered(rows.bytes_print[same], rows.identification[same])
    return bool(2 * (grown - int(bridges.sum()) + len(same) - len(once)) >= strange)


def _disordered(rows: Rows) -> int:
    """Return how many records stand behind a later one; 0 if a set clock explains them (rule 1)."""
    steps = np.diff(rows.time_ns)
    back = np.flatnonzero(steps < 0)
    far = back[steps[back] < -SECOND]
    seldom = len(back) * SCATTERED < len(rows)
    return 0 if seldom and 0 < len(far) <= _MOST_SET and not _mission_times_go_back(rows, far) else len(back)


def _mission_times_go_back(rows: Rows, far: Places) -> bool:
    """Return whether mission times also go back where capture times do: then no clock was set."""
    timed = np.flatnonzero((rows.mission_time_ns > 0) & rows.on(lambda link: link.from_cfs))
    offset, votes = rows.delay_ns(timed), 0
    for row in far[far < timed.max(initial=0)].tolist():
        at = int(np.searchsorted(timed, row, side="right"))
        # Only times of one sender are compared: clocks of two cFS differ.
        before = np.flatnonzero(rows.source[timed[:at]] == rows.source[timed[at]])
        if len(before):
            votes += 1 if abs(int(offset[at] - offset[before[-1]])) < SECOND else -1
    return votes > 0


def _emptied(rows: Rows, mask: Mask) -> Rows:
    """Return the rows with the packets of some of them removed."""
    none = {"msg_id": NO_MSG_ID, "route": NO_ROUTE}
    none |= dict.fromkeys(("function_code", "mission_time_ns", "sbn_msg_type"), -1)
    none |= dict.fromkeys(("packet_length", "cdr_length", "space", "claimed", "findings", *PRINTS[1:]), 0)
    return replace(rows, **{name: np.where(mask, value, getattr(rows, name)) for name, value in none.items()})


HANDED_ON_NS: Final = 2 * SECOND
"""Longest time from a packet on SBN until Telemetry Output forwards it."""


def handed_on(rows: Rows, network: Places, output: Places) -> Places:
    """Return which packet on SBN each packet of Telemetry Output is, as an index in ``network``; -1 for none.

    Equal packets have equal bytes. If frames are cut, MsgId, sequence count and time are compared instead.

    Args:
        rows: table of datagrams.
        network: rows on SBN, in order of time.
        output: rows that Telemetry Output sent, in order of time.
    """
    prints = rows.packet_print
    if rows.has(Finding.CAPTURE_CUT)[np.concatenate((network, output))].any():
        count = (rows.msg_id.astype(np.uint64) << np.uint64(14)) + rows.sequence_count + np.uint64(1)
        prints = np.where(rows.counted, count ^ rows.mission_time_ns.astype(np.uint64) * MIX, 0)
    from_ = latest_equal(prints[network], rows.time_ns[network], prints[output], rows.time_ns[output])
    late = from_ >= 0
    late[late] = rows.time_ns[output[late]] - rows.time_ns[network[from_[late]]] >= HANDED_ON_NS
    return np.where(late, -1, from_)


_TOGETHER_NS: Final = 20 * MILLISECOND
_HALF_ROUND_NS: Final = 250 * MILLISECOND
_UNSTEADY: Final = 0.2
_LEAST_PAIRS: Final = 20
_LEAST_EARLY: Final = 3
_NEVER: Final = 1 << 62
_TAIL: Final = 1.5
"""Largest delay divided by the 90 % quantile of the difference of two random delays, about."""


def unsteadiness(rows: Rows) -> int:
    """Return the random error of the capture times, ns; 0 if there is none.

    Packets that a cFS makes at nearly the same time leave in one round and in that order. If capture times
    often contradict this, by less than half a round, they are wrong. They are also wrong if several messages
    come out before they went in.
    """
    at = np.flatnonzero(rows.on(lambda link: link.only_from_cfs) & (rows.mission_time_ns > 0))
    each = (own[np.argsort(rows.mission_time_ns[own], kind="stable")] for _, own in groups(rows.source, at))
    at = np.concatenate((at[:0], *each))
    same = (np.diff(rows.source[at]) == 0) & (np.diff(rows.mission_time_ns[at]) < _TOGETHER_NS)
    steps = np.diff(rows.time_ns[at])[same]
    steps = steps[np.abs(steps) < _HALF_ROUND_NS]
    back = -steps[steps < -MILLISECOND // 2]
    if len(steps) < _LEAST_PAIRS or len(back) < _UNSTEADY * len(steps):
        back = back[:0]
    return max((int(_TAIL * np.quantile(own, 0.9)) for own in (back, _early(rows)) if len(own)), default=0)


def _early(rows: Rows) -> Integers:
    """Return the times, ns, by which messages seem to come out before they went in; empty if none do.

    A value that comes out more often than it went in is ignored: the capture may have missed its origin.
    """
    prints, out = rows.body_print, [np.zeros(0, np.int64)]
    peers = rows.on(lambda link: link.peers)
    came = np.flatnonzero((prints != 0) & (rows.on(lambda link: link.only_to_cfs) | peers & ~rows.counted))
    robot, from_cfs = (rows.on(attrgetter(kind)) for kind in ("last_hop", "only_from_cfs"))
    for side in (robot, peers & rows.counted, from_cfs):
        went = np.flatnonzero(side & (prints != 0))
        went = went[perhaps_in(prints[went], prints[came])]
        own = np.concatenate((came, went))
        # Even keys are a value that goes in, odd keys the same value that comes out.
        key = 2 * numbered(prints[own])[1] + (np.arange(len(own)) >= len(came))
        number, first_ns = np.bincount(key, minlength=2 * len(own)), np.full(2 * len(own), _NEVER)
        np.minimum.at(first_ns, key, rows.time_ns[own])
        ahead, enough = first_ns[::2] - first_ns[1::2], number[::2] >= number[1::2]
        early = (ahead > _TOGETHER_NS) & (ahead < SECOND)
        late = (ahead < 0) & (ahead > -SECOND)  # none where telemetry is only sent back as a command
        if late.any() and (early & enough).sum() >= max(_LEAST_EARLY, (early & ~enough).sum()):
            out.append(ahead[early & enough])
    return np.concatenate(out)
