"""Aligns the clocks of two captures of one system: how far one is ahead, and how it drifts.

The second clock minus the first is a line (``lines``). Its offset at the start and its drift are given
as intervals. They come from one of these, in this order:

1. Datagrams in both captures, recognised by bytes and IP identification, or by their ends where one has none,
   as behind an address translation. A datagram from the first host to
   the second is captured there later by the offset plus its delay; one in the other direction by the offset
   minus its delay. So the smallest step one way is an upper bound, and the largest step back a lower bound.
   Equal ones are paired in order, as far apart as those that are there once.
2. Streams of which each capture has a part: a packet with the next sequence count is captured later.
3. The mission time in the headers of one boot of one cFS, seen in both: capture time minus mission time is
   the same except for the shortest delay, which is below the wake-up period of the tasks that forward it.
   Where several boots fit, the one is meant of which both have packets, else the one that most pairs of
   boots agree with; if that leaves several, nothing is told.
4. Cause and effect: messages and answers of which each capture has one end. A peer's PROTO answers the first
   datagram of the other after a silence, usually at once. What leaves cFS entered it before: the same values,
   or the same packet forwarded from SBN. A packet that a cFS sends on two links was made once: it leaves on
   each within one wake-up. No answer comes before its question. Of many packets in one direction, the
   quickest waited less than a wake-up.

The first that exists is used, and the last narrows it. If the bounds are too wide to show a drift, none is
assumed. Only differences of times are used, so that a capture shifted by any time gives the same result.
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
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import sbn
from edoras_tools.wire.arrays.fingerprint import MIX, matches
from edoras_tools.wire.arrays.order import Integers, Mask, Places, Prints, by_value, groups
from edoras_tools.wire.msg_id import VERSION_1
from edoras_tools.words import seconds

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from typing_extensions import Self

    from edoras_tools.diagnosis.evidence.payloads import EventRecord

    _Pairs = tuple[Integers, Integers]
    """When causes were captured, and when their effects."""


_PROFILE: Final = SimProfile()
_SLACK_NS: Final = 100 * MILLISECOND
"""Tasks on a busy host wake up so late."""
_OUTPUT_NS: Final = _PROFILE.to_wake_ns + _SLACK_NS
_NETWORK_NS: Final = _PROFILE.sbn_wake_ns + _SLACK_NS
HANDED_NS: Final = _OUTPUT_NS + _NETWORK_NS
"""A packet that crosses SBN and leaves by Telemetry Output waits for both at the most."""
_THROUGH_NS: Final = HANDED_NS + _PROFILE.ci_wake_ns
_AT_ONCE_NS: Final = MILLISECOND
"""An answer of a task that waits for its question comes within so much."""
_NEAR_NS: Final = 2 * SECOND
_LEAST: Final = 3
_MANY: Final = 20
"""Messages of one way of which one was delayed hardly at all."""


class Side(msgspec.Struct, frozen=True, eq=False, dict=True):
    """What one of two captures is compared by."""

    rows: Rows
    events: Sequence[EventRecord]
    endpoints: Sequence[Endpoint]

    @classmethod
    def of(cls, recorder: Recorder) -> Self:
        """Return that of a recorder, which need not be kept.

        Messages of a stream have identifications of their own in each capture: here they have none.
        """
        rows = recorder.rows()
        rows = replace(rows, identification=np.where(rows.streamed, np.uint16(0), rows.identification))
        return cls(rows, recorder.payloads.events, recorder.endpoints)

    @cached_property
    def instances(self) -> Instances:
        """The cFS in it."""
        return Instances(self.rows, self.events, self.endpoints)

    @cached_property
    def local(self) -> set[tuple[Endpoint, Endpoint]]:
        """Source and destination of every conversation in it on loopback."""
        ways = np.unique(self.rows.way()).tolist()
        both = ((self.endpoints[way >> 32], self.endpoints[way & 0xFFFFFFFF]) for way in ways)
        return {way for way in both if way[0].address.startswith(("127.", "::1"))}

    @cached_property
    def span(self) -> tuple[int, int]:
        """Capture times of its first and its last datagram; of none, the end of time and its beginning."""
        times, ever = self.rows.time_ns, np.iinfo(np.int64)
        return int(times.min(initial=ever.max)), int(times.max(initial=ever.min))


def _related(cause: Side, effect: Side, about: ClockLine | None, *, back: bool) -> Iterator[Ordered]:
    """Yield pairs of what one capture holds and what in the other follows from it.

    Args:
        about: how the second's clock stands to the first's as far as that is known, which tells what belongs
            together; None where unknown.
        back: the causes are in the second capture.
    """

    def ordered(pairs: _Pairs, wait_ns: int, **more: Any) -> Ordered:
        first, second = pairs[::-1] if back else pairs
        return Ordered(first, second, back=back, wait_ns=wait_ns, **more)

    for pairs in _answers(cause, effect, about, back=back):
        # It may have been a later datagram that was heard: how late an answer can be, nothing tells.
        yield ordered(pairs, _NEAR_NS, at_once_ns=_AT_ONCE_NS)
    for pairs in _values(cause.rows, effect.rows, about, back=back):
        yield ordered(pairs, _THROUGH_NS, at_once_ns=_AT_ONCE_NS if len(pairs[0]) >= _MANY else None)
    for pairs, owner, maker in _packets(cause, effect, about, back=back):
        if owner == maker:
            yield ordered(pairs, _OUTPUT_NS, early_ns=_NETWORK_NS, each=True)
        else:
            yield ordered(pairs, HANDED_NS, early_ns=0 if owner else _NETWORK_NS)


def _near(pairs: _Pairs, about: ClockLine | None, *, back: bool, least: int = _LEAST) -> _Pairs:
    """Return those pairs of cause and effect that are of one offset; none where too few are."""
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
    """Yield when a peer sent its first datagram, and when a PROTO came that answered it."""
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
    """Return when something began after a silence that ends a connection."""
    silence = _PROFILE.sbn_timeout_s * SECOND
    return times[np.diff(times, prepend=-silence) >= silence] if len(times) else times


def _values(cause: Rows, effect: Rows, about: ClockLine | None, *, back: bool) -> Iterator[_Pairs]:
    """Yield when messages went into cFS and the same came out, read and written anew."""
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
    """Yield when SBN carried packets and a Telemetry Output sent them, whose, and who made them."""
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
"""The longest time between two wake-ups of a task that sends: Telemetry Output's."""
_MODULUS: Final = 1 << 14
_SAME_NS: Final = 2 * SECOND
"""Steps of one offset lie within so much of each other, the longest delays taken off."""
_LONG_NS: Final = 300 * SECOND
"""In so long some packet was handed on at once."""
_LOOSE_NS: Final = (0, 100_000, MILLISECOND, 10 * MILLISECOND, 100 * MILLISECOND)
"""By how much packets that overtake each other may contradict each other, tried one after the other."""
_TENTH_NS: Final = MILLISECOND // 10
MISSION_TIME: Final = "the mission time of one cFS in both"
_BOTH: Final = "packets that both captured"


class Alignment(NamedTuple):
    """How one capture's clock stands to another's.

    Attributes:
        line: the second clock minus the first, as near as can be told.
        low_ns: at the start of the second capture the offset is not less.
        high_ns: and not more.
        drift: not less than, and not more than, in ns per ns; None where it cannot be told.
        by: what it was told by.
        shared: i64, numbers of the second capture's frames that the first holds too.
        here: i64, the numbers of these in the first.
    """

    line: ClockLine
    low_ns: int
    high_ns: int
    drift: tuple[float, float] | None
    by: str
    shared: Integers
    here: Integers

    def told(self, other: str) -> str:
        """Return it in words; ``other`` is the first capture."""
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


class _Told(msgspec.Struct, frozen=True):
    """What pairs tell: the lines they leave, by what, where the offset is likely, what frames both hold."""

    pairs: Sequence[Ordered]
    lines: ClockLines
    by: str
    loose_ns: int = 0
    near: Sequence[int] = ()
    shared: Integers = msgspec.field(default_factory=lambda: np.zeros(0, np.int64))
    here: Integers = msgspec.field(default_factory=lambda: np.zeros(0, np.int64))

    @classmethod
    def of(cls, pairs: Sequence[Ordered], by: str, loose_ns: int = 0) -> _Told | None:
        lines = ClockLines.of(pairs, loose_ns)
        return cls(pairs, lines, by, loose_ns) if lines else None

    def narrowed(self, pairs: Sequence[Ordered], by: str = "") -> _Told:
        """Return what further pairs leave of it; itself where they contradict it."""
        lines = self.lines.within(pairs)
        if not pairs or not lines:
            return self
        text = ", and ".join(filter(None, (self.by, by)))
        return replace(self, pairs=[*self.pairs, *pairs], lines=lines, by=text)

    @property
    def line(self) -> ClockLine:
        """The line that is taken of all: one without a drift, where that agrees with all pairs."""
        begin, drift = self.lines.begin_ns, 0.0
        low, high = constant_offset(self.pairs)
        if low - high > 2 * self.loose_ns:
            drift = sum(self.lines.drift) / 2
            low, high = self.lines.drifting(drift)
        near = [*self.near, *(quickest_ahead(item, begin, drift) for item in self.pairs if item.at_once_ns)]
        likely = [value for value in near if min(low, high) <= value <= max(low, high)]
        return ClockLine(begin, int(np.median(likely)) if likely else (low + high) // 2, drift)

    def since(self, start_ns: int) -> Alignment:
        """Return the result, told for the time at which the second clock shows ``start_ns``."""
        line = self.line
        begin = line.set_back(np.array([start_ns]))
        line = ClockLine(int(begin[0]), int(line.ahead(begin)[0]), line.drift)
        drift = self.lines.drift if self.lines.drift_known or line.drift else None
        return Alignment(line, *self.lines.offset(line.begin_ns), drift, self.by, self.shared, self.here)


def align(first: Side, second: Side) -> Alignment | None:
    """Tell how the second capture's clock stands to the first's; None where nothing in them tells."""
    shift = _shared(first, second)
    if shift is None:
        sides = first, second
        coarse = _mission_times(*sides)
        shift = _by_counts(first, second, coarse) or coarse
        about = shift.line if shift else None
        pairs = [*_related(*sides, about, back=False), *_related(*sides[::-1], about, back=True)]
        ordered = _Told.of(pairs, "what came before what") if pairs else None
        if shift and ordered:
            shift = shift.narrowed(ordered.pairs, ordered.by)
        shift = shift or ordered
    return shift.since(int(second.rows.time_ns.min())) if shift else None


def boot_offsets(side: Side, name: str) -> list[int]:
    """Return capture time minus mission time, in ns, of each boot of a cFS in a capture.

    Args:
        name: of the cFS, as ``66:1``; a boot whose name nothing says may be its own.
    """
    return [item.offset_ns for item in side.instances.items if item.name in {name, ""}]


def align_ways(first_ns: Integers, second_ns: Integers, back: Mask) -> Alignment | None:
    """Tell it by messages that both recorded; None where there are none, or they contradict each other.

    Args:
        first_ns: i64 (n,), when the first recorded each.
        second_ns: i64 (n,), when the second did, by its own clock.
        back: bool (n,), it went from the second to the first.
    """
    if not len(first_ns):
        return None
    ways = [Ordered(first_ns[way], second_ns[way]) for way in (~back, back)]
    pairs = [ways[0], ways[1]._replace(back=True)]
    if back.all():
        swapped = one_way(second_ns, first_ns)
        pairs = [
            item._replace(first_ns=item.second_ns, second_ns=item.first_ns, back=True) for item in swapped
        ]
    elif not back.any():
        pairs = one_way(first_ns, second_ns)
    shift = next(filter(None, (_Told.of(pairs, _BOTH, loose_ns) for loose_ns in _LOOSE_NS)), None)
    return shift.since(int(second_ns.min())) if shift else None


def _shared(first: Side, second: Side) -> _Told | None:
    """Tell it by datagrams that both captured."""
    a, b = first.rows, second.rows
    one = _one(first, second)
    tried = []
    for bits in (np.uint16(0xFFFF), np.uint16(0)):  # an address translation may have left no identification
        prints = [rows.bytes_print ^ rows.identification & bits for rows in (a, b)]
        pairs = matches(*prints)
        same = one(*pairs)
        tried.append((prints, pairs[0][same], pairs[1][same]))
    prints, ours, theirs = max(tried, key=lambda item: len(item[1]))
    step = b.time_ns[theirs] - a.time_ns[ours]
    if len(step) < _LEAST:
        return None
    senders = np.array([first.endpoints[row].address for row in a.source[ours].tolist()])
    middles = {host: np.median(step[senders == host]) for host in set(senders.tolist())}
    apart = np.abs(step - [middles[host] for host in senders.tolist()])  # each way has its own delay
    near = apart < _SAME_NS + np.ptp(a.time_ns) * MOST_DRIFT
    if near.mean() < _MOSTLY:
        return None
    ours, theirs, senders = ours[near], theirs[near], senders[near]
    times = a.time_ns[ours], b.time_ns[theirs]
    best: _Told | None = None
    for host in sorted(set(senders.tolist())):
        sent = senders == host
        if sent.all():
            break
        out, back = (Ordered(times[0][way], times[1][way]) for way in (sent, ~sent))
        fit = _Told.of([out, back._replace(back=True)], _BOTH)
        if fit and (best is None or fit.lines.width < best.lines.width):
            best = fit
    if best is None:
        # All travel one way, or were captured at one place: delays are not more than they vary.
        best = _Told.of(one_way(*times), _BOTH)
    if best is None:
        return None
    then = best.line.set_back(b.time_ns)
    most_ns = int(np.abs(then[theirs] - times[0]).max())
    segment = pair_up(prints[0], a.time_ns, prints[1], then, most_ns)
    same = (segment.took_ns <= most_ns) & one(segment.into, segment.out)
    numbers = np.sort(a.number[segment.into[same]])
    return replace(best, shared=np.sort(b.number[segment.out[same]]), here=numbers)


def _ways_between(ours: Integers, theirs: Integers, took_ns: Integers) -> list[tuple[list[int], list[int]]]:
    """Return the ways of each of two places that lead to the other, and those that lead from it.

    Args:
        ours: the way of each datagram at the one place.
        theirs: the same at the other.
        took_ns: how much later it was there.
    """
    leads: list[tuple[list[int], list[int]]] = [([], []), ([], [])]
    for way, at in by_value(ours):
        for end, mask in enumerate((took_ns[at] > 0, took_ns[at] < 0)):
            if len(at) >= _MANY and mask.mean() > _MOSTLY:
                leads[0][end].append(way)
                leads[1][end].append(int(theirs[at[0]]))
    return leads


_BY_CHANCE: Final = 0.001
"""So seldom a capture that missed a share by chance would have missed none of those that surely passed it."""


def lost_between(first: Side, second: Side, shift: Alignment) -> tuple[tuple[Places, bool], ...]:
    """Return which rows of each capture came to its place and never to that of the other; and if it is sure.

    A way leads from one place to the other where what is in both is there later, and on the ways back
    earlier. What one lacks of the ways to it was lost between them, where it has all that the other got by
    the ways from it: it cannot have missed so large a share by chance. Else it may have missed them.
    """
    sides = first.rows, second.rows
    times = sides[0].time_ns, shift.line.set_back(sides[1].time_ns)
    both = [
        np.isin(rows.number, numbers) for rows, numbers in zip(sides, (shift.here, shift.shared), strict=True)
    ]
    shared = [np.flatnonzero(mask) for mask in both]
    none = np.zeros(0, np.intp)
    if len(shared[0]) != len(shared[1]) or any(rows.has(Finding.CAPTURE_CUT).any() for rows in sides):
        return (none, True), (none, True)
    # Equal ones are paired in order of time.
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
        lacking = to & ~both[side] & ~np.isin(prints[side], prints[1 - side])
        chance = (1 - lacking.sum() / max(to.sum(), 1)) ** back.sum()
        proven = both[side][back].all() and chance < _BY_CHANCE
        # Of a way of which it lacks most it was not to have all.
        out.append(
            (np.flatnonzero(lacking) if proven or 2 * lacking.sum() < to.sum() else none, bool(proven))
        )
    return tuple(out)


def _one(first: Side, second: Side) -> Callable[..., Mask]:
    """Return what tells which pairs of rows with equal bytes are one datagram, by identification and ends.

    Without an identification it keeps both its ends, lives shorter, or has an end with two names. What a
    relay sends is another one: it lives as long, and no end is the same.
    """
    a, b = first.rows, second.rows
    number = _moved(first, second)
    near, far = ([end.address for end in item.endpoints] or [""] for item in (first, second))
    ends = (a.source, b.source), (a.destination, b.destination)

    def common(ours: Places, theirs: Places) -> Integers:
        return np.asarray(np.sum([end[ours] == number[other[theirs]] for end, other in ends], axis=0))

    def renamed(ours: Places, theirs: Places) -> Mask:
        return np.asarray(a.on(lambda link: link.only_from_cfs, ours) & (common(ours, theirs) == 1))

    # Telemetry from one place, or to one, is one datagram: its other ends are two names of one host.
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
    """Return the number that each endpoint of the second has in the first; -1 for none."""
    number = {endpoint: index for index, endpoint in enumerate(first.endpoints)}
    return np.array([number.get(endpoint, -1) for endpoint in second.endpoints] or [-1])


def _by_counts(first: Side, second: Side, coarse: _Told | None) -> _Told | None:
    """Tell it by counts; ``coarse`` says which of the packets of a count are meant, where it can."""
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
        # As from one file to the next: a few counts go on.
        return coarse.narrowed([item for item in near if len(item.first_ns)]) if coarse else None
    if coarse is None and sum(len(item.first_ns) for item in near) < _MOSTLY * len(steps):
        return None
    by = "sequence counts that go on from one to the other"
    # Packets that overtake each other on their way make the bounds cross.
    return next(filter(None, (_Told.of(near, by, loose_ns) for loose_ns in _LOOSE_NS)), None)


def _key(rows: Rows, source: Integers, ahead: int) -> Prints:
    """Return what names a packet of a stream by its count, moved on; 0 where it is not counted."""
    count = (rows.sequence_count.astype(np.int64) + ahead) % _MODULUS
    key = np.zeros(len(rows), np.uint64)
    for part in (source, rows.link, rows.msg_id, rows.processor_id, rows.spacecraft_id, count):
        key = (key ^ part.astype(np.int64).view(np.uint64)) * MIX
        key ^= key >> np.uint64(29)
    valid = (rows.msg_id != NO_MSG_ID) & ~rows.has(Finding.SEQUENCE_UNSET) & (source >= 0)
    return np.where(valid, key | np.uint64(1), np.uint64(0))


def _mission_times(first: Side, second: Side) -> _Told | None:
    """Tell it by the mission time of one boot of one cFS, of whose packets both captured some."""
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
    # How many packets a boot has says nothing of which boot it is: that both hold the same ones does.
    same_packets = [_same_packets(first, second, pair) for pair in pairs]
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
    shift = _Told.of([_of_boot(first, second, pair) for pair in same], MISSION_TIME)
    alike = [step for pair in same for step in _same_ways(first, second, pair)]
    return replace(shift, near=[int(np.median(alike))]) if shift and alike else shift


def _one_boot(first: Side, second: Side, pair: tuple[int, int]) -> bool:
    """Tell whether boots of two captures may be one.

    They are not where both sent a MsgId on one link at the same mission times, and never the same packet.
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


def _same_packets(first: Side, second: Side, pair: tuple[int, int]) -> int:
    """Return how many packets of a boot both captured, whatever carried them."""
    ours, theirs = (side.rows.bytes_print[own] for side, own in _both_of(first, second, pair))
    return len(matches(ours, theirs)[0])


def _both_of(first: Side, second: Side, pair: tuple[int, int]) -> Iterator[tuple[Side, Places]]:
    """Yield both captures, each with its rows of a boot."""
    for side, index in zip((first, second), pair, strict=True):
        yield side, np.flatnonzero(side.instances.of_row == index)


def _of_boot(first: Side, second: Side, pair: tuple[int, int]) -> Ordered:
    """Return when each captured the quickest of a boot's packets of some minutes, as if made at one time."""
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
    """Return the offset that each way tells that one boot's packets took in both, by the shortest delays."""
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
