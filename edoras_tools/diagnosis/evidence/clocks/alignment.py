"""Aligns the clocks of two captures of one system: how far one is ahead, and how it drifts.

The second clock minus the first is a line (``lines``). Its offset at the start and its drift are intervals.
The evidence for them is one of these, in this order:

1. Datagrams in both captures, recognised by bytes and IP identification, or by their endpoints if one capture
   has no identification (address translation). The second capture has a datagram from the first host later by
   the offset plus its delay, and one to the first host by the offset minus its delay. So the smallest step
   one way is an upper bound, and the largest step the other way is a lower bound. Equal datagrams are paired
   in order, with the time difference that unique datagrams have. Of copies with one identification the first
   counts. What the network changed is recognised by sender, identification and length.
2. Streams of which each capture has a part: a packet with the next sequence count is captured later.
3. Mission times of one boot of one cFS in both captures. Capture time minus mission time is equal for all its
   packets, except for delays; the shortest delay is below the cycle of the tasks that forward the packet. If
   several boots fit, the one with common packets counts, else the one that most pairs of boots agree with. If
   several are still equal, there is no result.
4. Causes in one capture and effects in the other. A peer's PROTO answers the first datagram after a silence,
   usually at once. A message that leaves cFS entered it before: with the same values, or as the same packet
   from SBN. A packet that a cFS sends on two links leaves on each within one cycle. Of many packets in one
   direction, the quickest waited less than a cycle.

The first evidence that exists is used, and the last one narrows it, unless datagrams are in both captures. If
the bounds are too wide to show a drift, the drift is 0. Only differences of times are used, so a shift of one
capture does not change the result.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.cfs.profile import SimProfile
from edoras_tools.diagnosis.evidence.clocks.lines import (
    MOST_DRIFT,
    ClockLine,
    ClockLines,
    Ordered,
    constant_offset,
    least_of_each,
    one_way,
    quickest_ahead,
)
from edoras_tools.diagnosis.evidence.instances import Instances
from edoras_tools.diagnosis.evidence.relays import pair_up
from edoras_tools.diagnosis.evidence.table import Recorder, Rows, peer_of
from edoras_tools.model import NO_MSG_ID, Endpoint, Finding
from edoras_tools.sessions.sequence import MODULUS
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import sbn
from edoras_tools.wire.arrays import MIX, Integers, Mask, Places, Prints, by_value, groups, matches
from edoras_tools.wire.ccsds import VERSION_1
from edoras_tools.words import seconds

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    _Pairs = tuple[Integers, Integers]
    """Capture times of causes, and of their effects: i64 (n,) each, ns."""


_PROFILE: Final = SimProfile()
_SLACK_NS: Final = 100 * MILLISECOND
"""Largest delay of a wake-up on a busy host."""
_OUTPUT_NS: Final = _PROFILE.to_wake_ns + _SLACK_NS
_NETWORK_NS: Final = _PROFILE.sbn_wake_ns + _SLACK_NS
HANDED_NS: Final = _OUTPUT_NS + _NETWORK_NS
"""Longest time of a packet that crosses SBN and leaves by Telemetry Output: it waits for both."""
_THROUGH_NS: Final = HANDED_NS + _PROFILE.ci_wake_ns
_AT_ONCE_NS: Final = MILLISECOND
"""Longest time of an answer from a task that is blocked on its question."""
_NEAR_NS: Final = 2 * SECOND
_LEAST: Final = 3
_MANY: Final = 20
"""Least number of messages of one direction so that one of them had almost no delay."""


class Side:
    """One of two captures, as far as it is needed for the comparison: rows, events and endpoints.

    Messages of TCP streams were numbered in each capture alone, so their identifications are set to 0.

    Args:
        recorder: recorder of the capture, not needed afterwards.
    """

    def __init__(self, recorder: Recorder) -> None:
        rows = recorder.rows()
        self.rows = replace(rows, identification=np.where(rows.streamed, np.uint16(0), rows.identification))
        self.events, self.endpoints = recorder.payloads.events, recorder.endpoints

    @cached_property
    def instances(self) -> Instances:
        """The instances of cFS in the capture."""
        return Instances(self.rows, self.events, self.endpoints)

    @cached_property
    def ways(self) -> set[tuple[Endpoint, Endpoint]]:
        """Source and destination of every conversation."""
        ways = np.unique(self.rows.way()).tolist()
        return {(self.endpoints[way >> 32], self.endpoints[way & 0xFFFFFFFF]) for way in ways}

    @property
    def local(self) -> set[tuple[Endpoint, Endpoint]]:
        """Source and destination of every conversation on loopback."""
        return {way for way in self.ways if way[0].address.startswith(("127.", "::1"))}

    @cached_property
    def span(self) -> tuple[int, int]:
        """Earliest and latest capture time, ns; the largest and the smallest i64 without any datagram."""
        times, ever = self.rows.time_ns, np.iinfo(np.int64)
        return int(times.min(initial=ever.max)), int(times.max(initial=ever.min))


def _related(cause: Side, effect: Side, about: ClockLine | None, *, back: bool) -> Iterator[Ordered]:
    """Yield pairs of causes in one capture and their effects in the other (evidence 4).

    Args:
        cause: capture with the causes.
        effect: capture with the effects.
        about: approximate difference of the clocks, which decides what belongs together; None if unknown.
        back: whether the causes are in the second capture.
    """

    def ordered(pairs: _Pairs, wait_ns: int, **more: Any) -> Ordered:
        first, second = pairs[::-1] if back else pairs
        return Ordered(first, second, back=back, wait_ns=wait_ns, **more)

    for pairs in _answers(cause, effect, about, back=back):
        # The peer may have heard only a later datagram, so the delay of an answer has no strict bound.
        yield ordered(pairs, _NEAR_NS, at_once_ns=_AT_ONCE_NS)
    for pairs in _values(cause.rows, effect.rows, about, back=back):
        yield ordered(pairs, _THROUGH_NS, at_once_ns=_AT_ONCE_NS if len(pairs[0]) >= _MANY else None)
    for pairs, owner, maker in _packets(cause, effect, about, back=back):
        if owner == maker:
            yield ordered(pairs, _OUTPUT_NS, early_ns=_NETWORK_NS, each=True)
        else:
            yield ordered(pairs, HANDED_NS, early_ns=0 if owner else _NETWORK_NS)


def _near(pairs: _Pairs, about: ClockLine | None, *, back: bool, least: int = _LEAST) -> _Pairs:
    """Return the pairs of cause and effect with nearly one offset; none if there are fewer than ``least``."""
    first, second = pairs[::-1] if back else pairs
    ahead = second - first
    if not len(ahead):
        return pairs
    middle = int(np.median(ahead)) if about is None else about.ahead(first)
    near = np.abs(ahead - middle) < _NEAR_NS
    if near.sum() < least:
        near[:] = False
    return pairs[0][near], pairs[1][near]


def _answers(cause: Side, effect: Side, about: ClockLine | None, *, back: bool) -> Iterator[_Pairs]:
    """Yield times of first datagrams of SBN peers after a silence, and of the PROTO messages that answer."""
    if about is None:
        return
    causes, effects = cause.rows, effect.rows
    asking = np.flatnonzero(causes.sbn_msg_type >= 0)
    proto = np.flatnonzero(effects.sbn_msg_type == sbn.MsgType.PROTO)
    for way, members in groups(effects.way(), proto):
        ends = [effect.endpoints[end] for end in (way & 0xFFFFFFFF, way >> 32)]
        if any(end not in cause.endpoints for end in ends):
            continue
        source, target = (cause.endpoints.index(end) for end in ends)
        own = asking[(causes.source[asking] == source) & (causes.destination[asking] == target)]
        sessions = _begins(causes.time_ns[own])
        answers = _begins(effects.time_ns[members])
        if len(sessions) and len(answers):
            every = np.repeat(sessions, len(answers)), np.tile(answers, len(sessions))
            pairs = _near(every, about, back=back, least=1)
            if len(pairs[0]):
                yield pairs


def _begins(times: Integers) -> Integers:
    """Return the times behind a silence that ends a connection: i64, ns."""
    silence = _PROFILE.sbn_timeout_s * SECOND
    return times[np.diff(times, prepend=-silence) >= silence] if len(times) else times


def _values(cause: Rows, effect: Rows, about: ClockLine | None, *, back: bool) -> Iterator[_Pairs]:
    """Yield times of commands into cFS, and of messages with the same values out of it."""
    into = np.flatnonzero((cause.msg_id != NO_MSG_ID) & VERSION_1.is_command(cause.known_id))
    into = into[(cause.body_print[into] != 0) | (cause.value_print[into] != 0)]
    robot = effect.on(lambda item: item.last_hop)
    out = np.flatnonzero(robot | ((effect.msg_id != NO_MSG_ID) & ~VERSION_1.is_command(effect.known_id)))
    for came, went in (
        (cause.body_print, effect.body_print),
        (cause.value_print, effect.value_print),
        (cause.value_print, effect.stamped_print),
    ):
        ours, theirs = matches(came[into], went[out])
        pairs = _near((cause.time_ns[into[ours]], effect.time_ns[out[theirs]]), about, back=back)
        if len(pairs[0]):
            yield pairs
            return


def _packets(
    cause: Side, effect: Side, about: ClockLine | None, *, back: bool
) -> Iterator[tuple[_Pairs, str, str]]:
    """Yield times of packets on SBN and at a Telemetry Output, with the names of its cFS and the sender."""
    network = np.flatnonzero(cause.rows.on(lambda link: link.peers) & (cause.rows.msg_id != NO_MSG_ID))
    output = np.flatnonzero(effect.rows.on(lambda link: link.only_from_cfs))
    ours, theirs = matches(cause.rows.packet_print[network], effect.rows.packet_print[output])
    ours, theirs = network[ours], output[theirs]
    maker = cause.rows.sbn_sender(ours)
    for source, at in by_value(effect.rows.source[theirs].astype(np.int64)):
        for who, some in by_value(maker[at]):
            rows = at[some]
            times = effect.rows.time_ns[theirs[rows]]
            owner = effect.instances.owner(source, int(times[0]))
            name = effect.instances.items[owner].name if owner >= 0 else ""
            pairs = _near((cause.rows.time_ns[ours[rows]], times), about, back=back)
            if len(pairs[0]):
                yield pairs, name, str(peer_of(who))


_MOSTLY: Final = 0.9
_WAKE_NS: Final = 500 * MILLISECOND
"""Longest cycle of a task that sends packets: Telemetry Output's."""
_SAME_NS: Final = 2 * SECOND
"""Largest difference between two steps of one offset, except for the longest delays."""
_LONG_NS: Final = 300 * SECOND
"""In a window of this length some packet is forwarded at once."""
_LOOSE_NS: Final = (0, 100_000, MILLISECOND, 10 * MILLISECOND, 100 * MILLISECOND)
"""Errors, tried in this order, by which packets that overtake each other may contradict each other."""
_TENTH_NS: Final = MILLISECOND // 10
MISSION_TIME: Final = "the mission time of one cFS in both"
_BOTH: Final = "packets that both captured"


class Alignment(NamedTuple):
    """The difference between the clocks of two captures.

    Attributes:
        line: best estimate of the second clock minus the first.
        low_ns: smallest possible offset at the start of the second capture.
        high_ns: largest possible offset there.
        drift: smallest and largest possible drift, ns per ns; None if unknown.
        by: evidence, for people.
        shared: i64, frame numbers in the second capture of datagrams that both have.
        here: i64, frame numbers in the first capture of datagrams that both have.
        changed: i64 (2, n), frame numbers in both of those that the network changed from the first to the
            second: that of the second arrived.
    """

    line: ClockLine
    low_ns: int
    high_ns: int
    drift: tuple[float, float] | None
    by: str
    shared: Integers
    here: Integers
    changed: Integers

    def sentence(self, other: str) -> str:
        """Return the difference as a sentence; ``other`` is the name of the first capture."""
        low, high = math.floor(self.low_ns / _TENTH_NS) / 10_000, math.ceil(self.high_ns / _TENTH_NS) / 10_000
        offset, way = self.line.offset_ns / SECOND, f"ahead of that of {other}"
        if offset < 0:
            offset, low, high, way = -offset, -high, -low, f"behind that of {other}"
        drift = f"its drift is unknown (less than {MOST_DRIFT * 1e6:.0f} ppm)"
        if self.drift is not None:
            least, most = math.floor(self.drift[0] * 1e7) / 10, math.ceil(self.drift[1] * 1e7) / 10
            drift = (
                f"and drifts by {self.line.drift * 1e6:+.1f} ppm, between {least:+.1f} and {most:+.1f} ppm"
            )
        return f"{way} by {seconds(offset, 3)}, {low:.4f} to {high:.4f} s, {drift}, measured by {self.by}"


class _Estimate(msgspec.Struct, frozen=True):
    """The result of one kind of evidence.

    Attributes:
        pairs: pairs of causes and effects.
        lines: lines that agree with all pairs.
        by: kind of evidence, for people.
        loose_ns: error by which the bounds may contradict each other.
        near: likely offsets, ns.
        shared: as in ``Alignment``.
        here: as in ``Alignment``.
        changed: as in ``Alignment``.
    """

    pairs: Sequence[Ordered]
    lines: ClockLines
    by: str
    loose_ns: int = 0
    near: Sequence[int] = ()
    shared: Integers = msgspec.field(default_factory=lambda: np.zeros(0, np.int64))
    here: Integers = msgspec.field(default_factory=lambda: np.zeros(0, np.int64))
    changed: Integers = msgspec.field(default_factory=lambda: np.zeros((2, 0), np.int64))

    @classmethod
    def of(cls, pairs: Sequence[Ordered], by: str, loose_ns: int = 0) -> _Estimate | None:
        lines = ClockLines.of(pairs, loose_ns)
        return cls(pairs, lines, by, loose_ns) if lines else None

    def narrowed(self, pairs: Sequence[Ordered], by: str = "") -> _Estimate:
        """Return the result with further pairs; the same result if they contradict it."""
        lines = self.lines.within(pairs)
        if not pairs or not lines:
            return self
        text = ", and ".join(filter(None, (self.by, by)))
        return replace(self, pairs=[*self.pairs, *pairs], lines=lines, by=text)

    @property
    def line(self) -> ClockLine:
        """The best line: without drift if that agrees with all pairs, else with the middle drift."""
        begin, drift = self.lines.begin_ns, 0.0
        low, high = constant_offset(self.pairs)
        if low - high > 2 * self.loose_ns:
            drift = sum(self.lines.drift) / 2
            low, high = self.lines.drifting(drift)
        near = [*self.near, *(quickest_ahead(item, begin, drift) for item in self.pairs if item.at_once_ns)]
        likely = [value for value in near if min(low, high) <= value <= max(low, high)]
        return ClockLine(begin, int(np.median(likely)) if likely else (low + high) // 2, drift)

    def since(self, start_ns: int) -> Alignment:
        """Return the alignment, with its offset at the time at which the second clock shows ``start_ns``."""
        line = self.line
        begin = line.set_back(np.array([start_ns]))
        line = ClockLine(int(begin[0]), int(line.ahead(begin)[0]), line.drift)
        drift = self.lines.drift if self.lines.drift_known or line.drift else None
        low, high = self.lines.offset(line.begin_ns)
        return Alignment(line, low, high, drift, self.by, self.shared, self.here, self.changed)


def align(first: Side, second: Side) -> Alignment | None:
    """Return the difference between the clocks of two captures; None without evidence."""
    shift = _shared(first, second)
    if shift is None:
        sides = first, second
        coarse = _mission_times(*sides)
        shift = _by_counts(first, second, coarse) or coarse
        about = shift.line if shift else None
        pairs = [*_related(*sides, about, back=False), *_related(*sides[::-1], about, back=True)]
        ordered = _Estimate.of(pairs, "what came before what") if pairs else None
        if shift and ordered:
            shift = shift.narrowed(ordered.pairs, ordered.by)
        shift = shift or ordered
    return shift.since(int(second.rows.time_ns.min())) if shift else None


def boot_offsets(side: Side, name: str) -> list[int]:
    """Return capture time minus mission time, in ns, of each boot of a cFS in a capture.

    Args:
        side: capture.
        name: name of the cFS, as ``66:1``; boots without a name are included.
    """
    return [item.offset_ns for item in side.instances.items if item.name in {name, ""}]


def align_ways(first_ns: Integers, second_ns: Integers, back: Mask) -> Alignment | None:
    """Return the difference between two clocks from messages that both recorded.

    Args:
        first_ns: i64 (n,), time of each message at the first recorder.
        second_ns: i64 (n,), time of each message at the second recorder, by its own clock.
        back: bool (n,), whether the message went from the second to the first.

    Returns:
        None if there are no messages, or if they contradict each other.
    """
    if not len(first_ns):
        return None
    pairs = [Ordered(first_ns[~back], second_ns[~back]), Ordered(first_ns[back], second_ns[back], back=True)]
    if back.all() or not back.any():
        pairs = one_way(first_ns, second_ns, back=bool(back.all()))
    shift = next(filter(None, (_Estimate.of(pairs, _BOTH, loose_ns) for loose_ns in _LOOSE_NS)), None)
    return shift.since(int(second_ns.min())) if shift else None


def _shared(first: Side, second: Side) -> _Estimate | None:
    """Return the result from datagrams in both captures (evidence 1); None if too few, or inconsistent."""
    a, b = first.rows, second.rows
    one = _one(first, second)
    tried = []
    for bits in (np.uint16(0xFFFF), np.uint16(0)):  # an address translation may clear identifications
        prints = [rows.bytes_print ^ rows.identification & bits for rows in (a, b)]
        # Of copies with one identification the first is compared.
        firsts = [
            np.union1d(np.flatnonzero(rows.identification == 0), np.unique(own, return_index=True)[1])
            for rows, own in zip((a, b), prints, strict=True)
        ]
        pairs = matches(*(own[at] for own, at in zip(prints, firsts, strict=True)))
        ours, theirs = firsts[0][pairs[0]], firsts[1][pairs[1]]
        same = one(ours, theirs)
        tried.append((prints, ours[same], theirs[same]))
    prints, ours, theirs = max(tried, key=lambda item: len(item[1]))
    step = b.time_ns[theirs] - a.time_ns[ours]
    if len(step) < _LEAST:
        return None
    senders = np.array([first.endpoints[row].address for row in a.source[ours].tolist()])
    middles = {host: np.median(step[senders == host]) for host in set(senders.tolist())}
    apart = np.abs(step - [middles[host] for host in senders.tolist()])  # each sender has its own delay
    near = apart < _SAME_NS + np.ptp(a.time_ns) * MOST_DRIFT
    if near.mean() < _MOSTLY:
        return None
    ours, theirs, senders = ours[near], theirs[near], senders[near]
    times = a.time_ns[ours], b.time_ns[theirs]
    fits = []
    for sent in (senders == host for host in sorted(set(senders.tolist()))):
        out, back = (Ordered(times[0][way], times[1][way]) for way in (sent, ~sent))
        if not sent.all():
            fits.append(_Estimate.of([out, back._replace(back=True)], _BOTH))
    # If all go one way, or both captures are at one place, delays are assumed no longer than they vary.
    best = min(filter(None, fits), key=lambda item: item.lines.width, default=None)
    best = best or _Estimate.of(one_way(*times), _BOTH)
    if best is None:
        return None
    then = best.line.set_back(b.time_ns)
    most_ns = int(np.abs(then[theirs] - times[0]).max())
    segment = pair_up(prints[0], a.time_ns, prints[1], then, most_ns)
    same = (segment.took_ns <= most_ns) & one(segment.into, segment.out)
    pairs = segment.into[same], segment.out[same]
    # What the network changed keeps its identification, its length and its sender.
    free, marks = [], []
    for rows, own in zip((a, b), pairs, strict=True):
        free.append(np.setdiff1d(np.flatnonzero((rows.identification != 0) & ~rows.undelivered), own))
        marks.append(rows.length[free[-1]].astype(np.uint64) * MIX ^ rows.identification[free[-1]])
    rest = pair_up(marks[0], a.time_ns[free[0]], marks[1], then[free[1]], most_ns)
    others = free[0][rest.into], free[1][rest.out]
    near = (rest.took_ns <= most_ns) & (a.source[others[0]] == _moved(first, second)[b.source[others[1]]])
    others = others[0][near], others[1][near]
    numbers = [
        np.sort(rows.number[np.append(own, other)])
        for rows, own, other in zip((a, b), pairs, others, strict=True)
    ]
    later = then[others[1]] > a.time_ns[others[0]]
    changed = np.stack((a.number[others[0][later]], b.number[others[1][later]]))
    return replace(best, shared=numbers[1], here=numbers[0], changed=changed)


def _ways_between(ours: Integers, theirs: Integers, took_ns: Integers) -> list[tuple[list[int], list[int]]]:
    """Return, for each of two captures, the conversations towards the second place, and those back.

    Args:
        ours: i64 (n,), conversation of each datagram in the first capture.
        theirs: i64 (n,), conversation of each datagram in the second capture.
        took_ns: i64 (n,), time from the first place to the second; negative on the way back.
    """
    leads: list[tuple[list[int], list[int]]] = [([], []), ([], [])]
    for way, at in by_value(ours):
        for end, mask in enumerate((took_ns[at] > 0, took_ns[at] < 0)):
            if len(at) >= _MANY and mask.mean() > _MOSTLY:
                leads[0][end].append(way)
                leads[1][end].append(int(theirs[at[0]]))
    return leads


_BY_CHANCE: Final = 0.001
"""Largest probability of a coincidence that still counts as proof."""


def lost_between(first: Side, second: Side, shift: Alignment) -> tuple[tuple[Places, bool], ...]:
    """Return, for each capture, its rows that did not reach the place of the other, and whether that is sure.

    Common datagrams of a conversation towards the other place are captured there later. If the other capture
    does not have a datagram of such a conversation, it was lost between the places, or the capture missed it.
    A loss is sure if the other capture has all datagrams of the opposite direction, and would have missed one
    of these (probability 0.999) if it missed so large a share at random.

    Args:
        first: first capture.
        second: second capture.
        shift: difference between their clocks.
    """
    sides = first.rows, second.rows
    times = sides[0].time_ns, shift.line.set_back(sides[1].time_ns)
    both = [np.isin(rows.number, own) for rows, own in zip(sides, (shift.here, shift.shared), strict=True)]
    shared = [np.flatnonzero(mask) for mask in both]
    if len(shared[0]) != len(shared[1]) or any(rows.has(Finding.CAPTURE_CUT).any() for rows in sides):
        return ((np.zeros(0, np.intp), True),) * 2
    # Equal datagrams are paired in order of time.
    ours, theirs = (
        own[np.lexsort((when[own], rows.bytes_print[own]))]
        for own, when, rows in zip(shared, times, sides, strict=True)
    )
    leads = _ways_between(sides[0].way(ours), sides[1].way(theirs), times[1][theirs] - times[0][ours])
    numbers = [rows.identification[own] for rows, own in zip(sides, (ours, theirs), strict=True)]
    bits = np.uint16(0xFFFF * bool((numbers[0] == numbers[1]).all()))
    prints = [rows.bytes_print ^ rows.identification & bits for rows in sides]
    begin_ns, end_ns = max(when.min() for when in times), min(when.max() for when in times)
    out = []
    for side, rows in enumerate(sides):
        inside = (times[side] > begin_ns + SECOND) & (times[side] < end_ns - SECOND)
        inside &= ~rows.streamed & ~rows.undelivered
        to, back = (inside & np.isin(rows.way(), leads[side][end]) for end in (side, 1 - side))
        missed = ~both[side] & ~np.isin(prints[side], prints[1 - side])  # and not a copy by the network
        lacking = to & missed
        chance = (1 - lacking.sum() / max(to.sum(), 1)) ** back.sum()
        proven = not missed[back].any() and chance < _BY_CHANCE
        # If most datagrams are missing, the other capture was not meant to have them all.
        lacking &= proven or 2 * lacking.sum() < to.sum()
        out.append((np.flatnonzero(lacking), bool(proven)))
    return tuple(out)


def _one(first: Side, second: Side) -> Callable[..., Mask]:
    """Return a function that decides which pairs of rows with equal bytes are one datagram: bool (pairs,).

    With identifications these have to be equal. Without, one datagram has equal endpoints, another time to
    live, or an endpoint with two names. A datagram that a relay sends again has none of these.
    """
    a, b = first.rows, second.rows
    number = _moved(first, second)
    near, far = ([end.address for end in item.endpoints] or [""] for item in (first, second))
    ends = (a.source, b.source), (a.destination, b.destination)

    def common(ours: Places, theirs: Places) -> Integers:
        return np.asarray(np.sum([end[ours] == number[other[theirs]] for end, other in ends], axis=0))

    def renamed(ours: Places, theirs: Places) -> Mask:
        return np.asarray(a.on(lambda link: link.only_from_cfs, ours) & (common(ours, theirs) == 1))

    # Telemetry with one equal endpoint is one datagram: its other endpoints are two names of one host.
    ours, theirs = matches(a.bytes_print, b.bytes_print)
    same = renamed(ours, theirs)
    pairs = {pair for end, other in ends for pair in zip(end[ours[same]], other[theirs[same]], strict=True)}
    names = {far[other]: near[end] for end, other in pairs if far[other] != near[end]}
    address, other_name = np.array(near), np.array([names.get(item, "") for item in far])

    def one(ours: Places, theirs: Places) -> Mask:
        numbers = a.identification[ours], b.identification[theirs]
        bare = (common(ours, theirs) == 2) | (a.life[ours] != b.life[theirs]) | renamed(ours, theirs)
        for end, other in ends:
            bare |= address[end[ours]] == other_name[other[theirs]]
        return np.asarray(np.where(np.minimum(*numbers) == 0, bare, numbers[0] == numbers[1]))

    return one


def _moved(first: Side, second: Side) -> Integers:
    """Return the number in the first capture of each endpoint of the second, i64; -1 for none."""
    number = {endpoint: index for index, endpoint in enumerate(first.endpoints)}
    return np.array([number.get(endpoint, -1) for endpoint in second.endpoints] or [-1])


def _by_counts(first: Side, second: Side, coarse: _Estimate | None) -> _Estimate | None:
    """Return the result from sequence counts that go on in the other capture (evidence 2); None without any.

    Args:
        first: first capture.
        second: second capture.
        coarse: result from mission times, which decides between packets with one count; None if unknown.
    """
    a, b = first.rows, second.rows
    theirs = _key(b, _moved(first, second)[b.source].astype(np.int64), 0)
    every = []
    for ahead in (1, -1):
        rows = matches(_key(a, a.source.astype(np.int64), ahead), theirs)
        every.append(Ordered(a.time_ns[rows[0]], b.time_ns[rows[1]], back=ahead < 0))
    steps = np.concatenate([item.second_ns - item.first_ns for item in every])
    if not len(steps):
        return None
    line = coarse.line if coarse else ClockLine(int(a.time_ns.min()), int(np.median(steps)))
    room = _SAME_NS + (0 if coarse else np.ptp(a.time_ns) * MOST_DRIFT)
    near = []
    for item in every:
        same = np.abs(item.second_ns - item.first_ns - line.ahead(item.first_ns)) < room
        near.append(item._replace(first_ns=item.first_ns[same], second_ns=item.second_ns[same]))
    if min(len(item.first_ns) for item in near) < _LEAST:
        # As with consecutive files: only a few counts go on.
        return coarse.narrowed([item for item in near if len(item.first_ns)]) if coarse else None
    if coarse is None and sum(len(item.first_ns) for item in near) < _MOSTLY * len(steps):
        return None
    by = "sequence counts that go on from one to the other"
    # Packets that overtake each other contradict strict bounds.
    return next(filter(None, (_Estimate.of(near, by, loose_ns) for loose_ns in _LOOSE_NS)), None)


def _key(rows: Rows, source: Integers, ahead: int) -> Prints:
    """Return a key of each packet, u64 (rows,), from stream and count plus ``ahead``; 0 without a count."""
    count = (rows.sequence_count.astype(np.int64) + ahead) % MODULUS
    key = np.zeros(len(rows), np.uint64)
    for part in (source, rows.link, rows.msg_id, rows.processor_id, rows.spacecraft_id, count):
        key = (key ^ part.astype(np.int64).view(np.uint64)) * MIX
        key ^= key >> np.uint64(29)
    valid = (rows.msg_id != NO_MSG_ID) & ~rows.has(Finding.SEQUENCE_UNSET) & (source >= 0)
    return np.where(valid, key | np.uint64(1), np.uint64(0))


def _mission_times(first: Side, second: Side) -> _Estimate | None:
    """Return the result from mission times of common boots (evidence 3); None if there are none, or a tie."""
    ours, theirs = first.instances, second.instances
    pairs = [
        (i, j)
        for i, one in enumerate(ours.items)
        for j, other in enumerate(theirs.items)
        if one.name == other.name or not (one.name and other.name)
    ]
    if not pairs:
        return None
    steps = np.array([theirs.items[j].offset_ns - ours.items[i].offset_ns for i, j in pairs])
    # Common packets prove a common boot; the number of its packets does not.
    both = ([side.rows.bytes_print[own] for side, own in _both_of(first, second, pair)] for pair in pairs)
    same_packets = [len(matches(ours, theirs)[0]) for ours, theirs in both]
    if not any(same_packets) and not all(_one_boot(first, second, pair) for pair in pairs):
        return None
    weights = same_packets if any(same_packets) else [1] * len(pairs)
    order = np.argsort(steps, kind="stable")
    group = np.concatenate(([0], np.cumsum(np.diff(steps[order]) > 2 * _WAKE_NS)))
    votes = np.bincount(group, np.array(weights)[order])
    if (votes == votes.max()).sum() > 1:
        return None  # several boots fit equally
    # Boots of one cFS follow each other: only pairs of the same boot agree with each other.
    same = [pairs[at] for at in order[group == int(votes.argmax())].tolist()]
    shift = _Estimate.of([_of_boot(first, second, pair) for pair in same], MISSION_TIME)
    alike = [step for pair in same for step in _same_ways(first, second, pair)]
    return replace(shift, near=[int(np.median(alike))]) if shift and alike else shift


def _one_boot(first: Side, second: Side, pair: tuple[int, int]) -> bool:
    """Return whether boots of two captures may be one.

    They are not if both sent a MsgId on one link in the same mission time, and never at equal mission times.
    """
    ours, theirs = (side.rows.take(own) for side, own in _both_of(first, second, pair))
    if np.isin(ours.mission_time_ns, theirs.mission_time_ns).any():
        return True
    kinds = [rows.link.astype(np.int64) << 32 | rows.msg_id for rows in (ours, theirs)]
    for kind in np.intersect1d(kinds[0], kinds[1]).tolist():
        times = ours.mission_time_ns[kinds[0] == kind], theirs.mission_time_ns[kinds[1] == kind]
        begin, end = max(item.min() for item in times), min(item.max() for item in times)
        if min(((item >= begin) & (item <= end)).sum() for item in times) >= _LEAST:
            return False
    return True


def _both_of(first: Side, second: Side, pair: tuple[int, int]) -> Iterator[tuple[Side, Places]]:
    """Yield both captures, each with its rows of a boot."""
    for side, index in zip((first, second), pair, strict=True):
        yield side, np.flatnonzero(side.instances.of_row == index)


def _of_boot(first: Side, second: Side, pair: tuple[int, int]) -> Ordered:
    """Return pairs of the quickest packets of a boot, one for each 5 minutes, as if made at the same time."""
    both = _both_of(first, second, pair)
    boots = [(side.rows.mission_time_ns[own], side.rows.time_ns[own]) for side, own in both]
    begin = max(int(made_ns.min()) for made_ns, _ in boots)
    windows = [(made_ns - begin) // _LONG_NS for made_ns, _ in boots]
    common = np.intersect1d(windows[0], windows[1])
    quickest = []
    for (made_ns, captured), window in zip(boots, windows, strict=True):
        places = np.flatnonzero(np.isin(window, common)) if len(common) else np.arange(len(made_ns))
        place = window[places] if len(common) else np.zeros(len(places), np.int64)
        at = places[least_of_each(place - place.min(), captured[places] - made_ns[places])]
        quickest.append((made_ns[at], captured[at]))
    (made_ns, captured), (other, then) = quickest
    apart = int(np.abs(other - made_ns).max())
    moved = then - (other - made_ns)
    return Ordered(captured, moved, early_ns=HANDED_NS, wait_ns=HANDED_NS, each=True, apart_ns=apart)


def _same_ways(first: Side, second: Side, pair: tuple[int, int]) -> list[int]:
    """Return the offset, ns, by the shortest delays of each conversation with a boot's packets in both."""
    offsets: list[dict[tuple[Endpoint, Endpoint], int]] = []
    for side, own in _both_of(first, second, pair):
        delay, ends = side.rows.delay_ns(own), side.endpoints
        offsets.append(
            {
                (ends[value >> 32], ends[value & 0xFFFFFFFF]): int(delay[members].min())
                for value, members in by_value(side.rows.way(own))
                if len(members) >= _MANY
            }
        )
    return [offsets[1][way] - least for way, least in offsets[0].items() if way in offsets[1]]
