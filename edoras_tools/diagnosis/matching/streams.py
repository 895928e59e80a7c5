"""Streams: the packets of one MsgId on one link, their gaps and their rates.

In: rows, and the cFS that each is from. Out: a ``Stream`` for each MsgId, with its spans; restarts of a cFS
whose clock went on; and the rounds in which messages arrive (``comb``).

Rules:

1. A stream has one MsgId, one link and one cFS instance. Commands to CI of all senders are one stream, as are
   packets of a Telemetry Output that changed its port.
2. ``sessions.sequence`` has the rules of sequence counts. A gap stands at the row in front of it.
3. A span is a part of a stream at one rate. It ends where the stream pauses or its rate changes.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.cfs.names import MSG_ID_NAMES
from edoras_tools.diagnosis.evidence.instances import NOBODY, Instances
from edoras_tools.diagnosis.evidence.preparation import handed_on
from edoras_tools.links import table
from edoras_tools.model import NO_MSG_ID, NO_ROUTE, Finding, Link, rate_hz
from edoras_tools.sessions.sequence import FORWARD, MODULUS
from edoras_tools.units import SECOND
from edoras_tools.wire.arrays import by_value, distinct, distinct_rows, groups, numbered, quantiles
from edoras_tools.wire.ccsds import VERSION_1

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.evidence.table import Rows
    from edoras_tools.wire.arrays import Integers, Mask, Places


_PAUSE_NS: Final = 2 * SECOND
_PAUSE_FACTOR: Final = 4
_LEAST_FELL: Final = 3
_LEAST_ONES: Final = 20
_MOST_MISSING: Final = 64


class PipeEnd(NamedTuple):
    """The way out of a pipe of cFS: Telemetry Output's, whatever receiver it has, or that of one SBN peer."""

    link: Link
    sender: int
    receiver: int


class Stream(msgspec.Struct, eq=False, dict=True):
    """The packets of one MsgId on one link, in order of time.

    Attributes:
        link: link that carries the packets.
        msg_id: cFE MsgId of the packets.
        sender: number of the endpoint that the first packet came from.
        receiver: number of the endpoint that the first packet went to.
        processor: SBN identity of the sender (spacecraft, processor); (0, 0) elsewhere.
        instance: index of the cFS instance that published the packets; ``NOBODY`` if unknown.
        route: index of the configured route, or ``NO_ROUTE``.
        rows: intp (rows,), indices into the table of datagrams.
        time_ns: i64 (rows,), capture times, ns since 1970.
        counted: whether the packets have a usable sequence count.
        missing: i64 (rows,), sequence counts missing between a row and the next one.
        pauses: bool (rows,), a pause follows: counts missing there may never have been sent this way.
        repeats: bool (rows,), the row is a duplicate of an earlier one.
        gaps: sequence counts missing in all, also before the first row; without those at a change of port.
        reordered: number of rows that came after a later one.
        restarts: number of times that the sequence count restarted.
        known_id: MsgId in message version 1, in which cFS facts are written.
    """

    link: Link
    msg_id: int
    sender: int
    receiver: int
    processor: tuple[int, int]
    instance: int
    route: int
    rows: Places
    time_ns: Integers
    counted: bool
    missing: Integers
    pauses: Mask
    repeats: Mask
    gaps: int = 0
    reordered: int = 0
    restarts: int = 0
    known_id: int = NO_MSG_ID

    @property
    def way(self) -> tuple[int, int, int, int]:
        """The path of the packets, whoever published them: code of the link, both endpoints, MsgId."""
        return self.link.code, self.sender, self.receiver, self.msg_id

    @property
    def pipe(self) -> PipeEnd:
        """The pipe of cFS that the packets come out of, if they are telemetry."""
        return PipeEnd(self.link, self.sender, NOBODY if self.link.only_from_cfs else self.receiver)

    @property
    def is_command(self) -> bool:
        """Whether its packets are commands."""
        return bool(VERSION_1.is_command(self.known_id))

    @property
    def is_housekeeping(self) -> bool:
        """Whether its MsgId is one of cFS itself, without a configured route."""
        return self.known_id in MSG_ID_NAMES and self.route == NO_ROUTE

    @property
    def duplicates(self) -> int:
        """Number of rows that are duplicates."""
        return int(self.repeats.sum())

    @property
    def counts(self) -> Integers:
        """Number of messages that each row stands for, i64 (rows,): itself and those missing behind it."""
        return np.append(self.missing[:-1], 0) + ~self.repeats

    @cached_property
    def spans(self) -> list[Span]:
        """The parts of the stream with one rate each, in order."""
        out: list[Span] = []
        bounds = [0, *(np.flatnonzero(self.pauses) + 1).tolist(), len(self)]
        for first, end in pairwise(bounds):
            cuts = _changes(self.time_ns[first:end], (self.missing + ~self.repeats)[first:end])
            edges = sorted({first, *(first + cut for cut in cuts), end})
            out += [self._span(low, high - 1) for low, high in pairwise(edges)]
        return out

    def _span(self, first: int, last: int) -> Span:
        own = slice(first, last + 1)
        once, missing = int((~self.repeats[own]).sum()), int(self.missing[own].sum())
        return Span(first, last, int(self.time_ns[first]), int(self.time_ns[last]), once, missing)

    def __len__(self) -> int:
        return len(self.rows)


def find_streams(rows: Rows, instances: Instances) -> list[Stream]:
    """Return all streams of a capture, in the order of link, endpoints and MsgId."""
    instance = _whole(rows, instances)
    packets = np.flatnonzero(rows.msg_id != NO_MSG_ID)
    # Senders of commands have no common count, and may use any number of ports.
    up = rows.on(lambda item: item.only_to_cfs, packets)
    down = rows.on(lambda item: item.only_from_cfs, packets)
    sender = np.where(up, -1, rows.source[packets])
    sources, _, which = distinct_rows(sender[down])
    sender[down] = np.array([*map(instances.output, sources.tolist())], np.int64)[which]
    receiver = np.where(down, -1, rows.destination[packets])
    packet = rows.processor_id[packets], rows.spacecraft_id[packets], rows.msg_id[packets]
    keys = rows.link[packets], sender, receiver, *packet, np.where(up, NOBODY, instance[packets])
    first, which = numbered(*keys)
    # The order of the keys does not depend on the order of the capture.
    order = np.lexsort([key[first] for key in reversed(keys)])
    number = np.empty_like(order)
    number[order] = np.arange(len(order))
    behind = np.flatnonzero(rows.has(Finding.STREAM_GAP) & ~rows.has(Finding.FRAGMENT))
    return [_stream(rows, packets[members], instance, behind) for _, members in by_value(number[which])]


def find_robots(rows: Rows) -> list[Stream]:
    """Return one stream for each pair of endpoints of robot links; these have no MsgId and no count."""
    own = np.flatnonzero(rows.on(lambda item: item.last_hop))
    nobody, none = np.full(len(rows), NOBODY, np.int32), own[:0]
    streams = [_stream(rows, members, nobody, none) for _, members in groups(rows.way(), own)]
    return [replace(item, pauses=np.zeros(len(item), np.bool_)) for item in streams]


class Reset(NamedTuple):
    """A restart of a cFS, between two times in ns, after which its clock went on (processor reset)."""

    instance: int
    start_ns: int
    end_ns: int


def find_resets(rows: Rows, streams: Sequence[Stream]) -> list[Reset]:
    """Return every restart of a cFS after which its clock went on.

    Most sequence counts fall then, where Telemetry Output sends from another port, or on SBN. If only
    Telemetry Output had restarted, the counts would go on. Each MsgId gives an interval; overlapping ones are
    one restart. No cFS restarts within a burst: what falls there came out of order. If the capture has fewer
    than three MsgIds, all must fall.
    """
    spans: dict[int, list[tuple[int, int, bool]]] = {}
    counted = [item for item in streams if item.counted and not item.link.only_to_cfs]
    for stream in counted:
        count = rows.sequence_count[stream.rows].astype(np.int64)
        began = (np.diff(rows.source[stream.rows]) != 0) | (rows.restarts[stream.rows[1:]] > 0)
        for at in np.flatnonzero(began).tolist():
            start, end = stream.time_ns[at : at + 2].tolist()
            if start + _BURST_NS < end:
                fell = (count[at + 1] - count[at]) % MODULUS >= FORWARD
                spans.setdefault(stream.instance, []).append((end, start, fell))
    resets = []
    for instance, members in spans.items():
        rest, able = sorted(members), sum(item.instance == instance for item in counted)
        while rest:
            first_end = rest[0][0]
            same = [item for item in rest if item[1] < first_end]
            fell = [(start, end) for end, start, down in same if down]
            if len(fell) >= min(_LEAST_FELL, able) and len(fell) * 2 > len(same):
                resets.append(Reset(instance, max(start for start, _ in fell), min(end for _, end in fell)))
            rest = [item for item in rest if item[1] >= first_end]
    return resets


def _whole(rows: Rows, instances: Instances) -> NDArray[np.int32]:
    """Return the instance of each row, i32: packets without a time get the one whose count they continue."""
    out = instances.of_row.copy()
    network = rows.on(lambda link: link.peers)
    output = rows.on(lambda link: link.only_from_cfs)
    cases = ((network, rows.processor_id.astype(np.int64)), (output, rows.source.astype(np.int64)))
    for mask, sender in cases:
        lost = np.flatnonzero(mask & (out == NOBODY) & (rows.msg_id != NO_MSG_ID))
        timed = np.flatnonzero(mask & (instances.of_row != NOBODY))
        key = [sender]
        if mask is output and len(lost):
            lost = _handed_on(rows, lost, out)
        # Several instances may send one MsgId through TO; an SBN sender is one instance at a time.
        key += [rows.msg_id.astype(np.int64)] * (mask is output)
        both = np.concatenate((lost, timed))
        which = numbered(*(column[both] for column in key))[1]
        places = dict(by_value(which[len(lost) :]))
        for who, at in by_value(which[: len(lost)]):
            if who in places:
                rest, same = lost[at], timed[places[who]]
                out[rest] = _nearest(rows, rest, same, instances.of_row, by_count=mask is output)
    return out


def _handed_on(rows: Rows, lost: Places, out: NDArray[np.int32]) -> Places:
    """Assign packets of Telemetry Output to the instance that sent equal ones over SBN; return the rest.

    Args:
        lost: rows without an instance.
        out: i32, instance of each row; changed in place.
    """
    network = np.flatnonzero(rows.on(lambda link: link.peers) & np.isin(rows.msg_id, rows.msg_id[lost]))
    both = np.concatenate((network, lost))
    cut = rows.msg_id[both[rows.has(Finding.CAPTURE_CUT)[both]]]
    rest = []
    # Cut packets are compared by count, whole ones by their bytes: so MsgIds with cut packets go apart.
    for some in (True, False):
        mine, theirs = (item[np.isin(rows.msg_id[item], cut) == some] for item in (lost, network))
        from_ = handed_on(rows, theirs, mine)
        same = from_ >= 0
        out[mine[same]] = out[theirs[from_[same]]]
        rest.append(mine[~same])
    return np.sort(np.concatenate(rest))


def _nearest(
    rows: Rows, lost: Places, timed: Places, instance: NDArray[np.int32], *, by_count: bool
) -> NDArray[np.int32]:
    best = np.full(len(lost), np.iinfo(np.int64).max)
    out = np.full(len(lost), NOBODY, np.int32)
    for index in distinct(instance[timed]).tolist():
        own = timed[instance[timed] == index]
        at = np.searchsorted(rows.time_ns[own], rows.time_ns[lost])
        for side in (np.maximum(at - 1, 0), np.minimum(at, len(own) - 1)):
            near = own[side]
            if by_count:
                step = rows.sequence_count[lost].astype(np.int64) - rows.sequence_count[near]
                away = np.abs((step + MODULUS // 2) % MODULUS - MODULUS // 2)
            else:
                away = np.abs(rows.time_ns[lost] - rows.time_ns[near])
            closer = away < best
            best[closer], out[closer] = away[closer], index
    return out


def _stream(rows: Rows, members: Places, instance: NDArray[np.int32], behind: Places) -> Stream:
    """Return the stream of some rows.

    Args:
        members: rows of the stream, in order of time.
        instance: i32, instance of each row of the table.
        behind: rows of the table in front of which the capture lacks bytes of a TCP stream.
    """
    first = int(members[0])
    routes = rows.route[members]
    own = routes[routes != NO_ROUTE]
    missing, time_ns = rows.missing[members], rows.time_ns[members]
    gaps = int(missing.sum())  # ``info`` prints these; the corrections below are for the diagnosis only
    link = table.link(rows.link[first])
    if link.only_from_cfs:
        _count_moves(rows, members, missing)
    if len(behind) and link.transport.tcp:
        same = rows.source[behind] == rows.source[first]
        same &= rows.destination[behind] == rows.destination[first]
        passed = np.searchsorted(behind[same], members, side="right")
        missing[np.diff(passed, prepend=0) > 0] = 0  # TCP delivered these packets, the capture missed them
    return Stream(
        link=link,
        msg_id=int(rows.msg_id[first]),
        sender=int(rows.source[first]),
        receiver=int(rows.destination[first]),
        processor=(int(rows.spacecraft_id[first]), int(rows.processor_id[first])),
        instance=int(instance[first]) if not link.only_to_cfs else NOBODY,
        route=int(own[0]) if len(own) else NO_ROUTE,
        rows=members,
        time_ns=time_ns,
        counted=bool(rows.counted[members].any()),
        missing=np.append(missing[1:], 0),
        pauses=_pauses(time_ns),
        repeats=rows.duplicates[members] > 0,
        gaps=gaps,
        reordered=int(rows.reordered[members].sum()),
        # At the first row another cFS may have ended: that is no restart of this count.
        restarts=max(0, int(rows.restarts[members[1:]].sum())),
        known_id=int(rows.known_id[first]),
    )


def _count_moves(rows: Rows, members: Places, missing: NDArray[np.int32]) -> None:
    """Set ``missing`` at the rows where a stream moves to another port.

    Sequence counts are followed for each port. When Telemetry Output restarts, the counts go on elsewhere.
    """
    moved = np.flatnonzero(np.diff(rows.source[members])) + 1
    if not len(moved):
        return
    count, in_turn = rows.sequence_count[members].astype(np.int64), rows.reordered[members] == 0
    newest = np.maximum.accumulate(np.where(in_turn, np.arange(len(members)), 0))
    before = count[newest[moved - 1]]
    ahead = (count[moved] - before - 1) % MODULUS
    for step, (at, end) in enumerate(pairwise([*moved.tolist(), len(members)])):
        late = (count[at:end][~in_turn[at:end]] - before[step] - 1) % MODULUS
        ahead[step] -= len(np.unique(late[late < ahead[step]]))  # late packets are not missing
    # A step back is no wrap: the publisher restarted too.
    missing[moved] = np.where(rows.counted[members[moved]] & (ahead < FORWARD), ahead, 0)


def counted_gaps(rows: Rows, stream: Stream) -> Integers:
    """Return the sequence counts missing behind each row of a stream of commands, i64 (rows,).

    All are 0 unless the stream has one sender, which may go on from another port, and most of its counts step
    by one. A count that the sender used for another MsgId is not missing.
    """
    own = stream.rows
    count, source = rows.sequence_count[own].astype(np.int64), rows.source[own]
    ones = int((np.diff(count) % MODULUS == 1).sum())
    moves = np.append(np.diff(source) != 0, False)
    if ones < _LEAST_ONES or 2 * ones < len(own) or moves.sum() >= len(distinct(source)):
        return np.zeros(len(own), np.int64)
    missing = np.where((stream.missing <= _MOST_MISSING) & ~moves, stream.missing, 0)
    others = np.flatnonzero(np.isin(rows.source, source) & (rows.msg_id != stream.msg_id))
    for at in np.flatnonzero(missing).tolist() if len(others) else ():
        near = others[slice(*np.searchsorted(rows.time_ns[others], stream.time_ns[at : at + 2]))]
        ahead = (rows.sequence_count[near].astype(np.int64) - count[at]) % MODULUS
        missing[at] -= len(np.unique(ahead[(ahead > 0) & (ahead <= missing[at])]))
    return missing


def _pauses(times: Integers) -> Mask:
    """Return after which rows a stream paused, bool (rows,): for far longer than its usual steps."""
    steps = np.diff(times)
    out = np.zeros(len(times), bool)
    if len(steps) > 2:
        out[:-1] = steps > max(_PAUSE_NS, _PAUSE_FACTOR * quantiles(steps, 0.9)[0])
    return out


_CHANGE: Final = 1.6
"""A rate that differs by this factor for two seconds begins a new span."""
_USUAL: Final = 600
"""The usual rate is the median of at most this many seconds."""
_SILENT: Final = 10
"""A silence counts as at most this many seconds."""
_LEAST_HZ: Final = 4.0
_LEAST_FULL: Final = 3
_LEAST_ROUNDS: Final = 5
_BY_CHANCE: Final = 0.001
"""Full rounds show a limit only if chance has a lower probability than this."""
_BURST_NS: Final = 60_000_000
_FEW: Final = 4
_WINDOW_NS: Final = 2 * SECOND
_WINDOWS: Final = 3
_STEADY: Final = 0.9
"""Share of windows with the usual number of messages, from which on a rate is steady."""


class Span(msgspec.Struct, frozen=True):
    """A part of a stream with one rate.

    Attributes:
        first: index of the first row in the stream's rows.
        last: index of the last row in the stream's rows.
        start_ns: capture time of the first row.
        end_ns: capture time of the last row.
        count: number of rows without duplicates.
        missing: number of missing sequence counts, including those behind the last row.
    """

    first: int
    last: int
    start_ns: int
    end_ns: int
    count: int
    missing: int

    @property
    def rows(self) -> slice:
        """The slice of its rows in the stream's rows."""
        return slice(self.first, self.last + 1)

    @property
    def rate_hz(self) -> float:
        """Received messages per second."""
        return rate_hz(self.count, self.end_ns - self.start_ns)

    @property
    def offered_hz(self) -> float:
        """Received and missing messages per second."""
        return rate_hz(self.count + self.missing, self.end_ns - self.start_ns)


def _changes(times: Integers, counts: Integers) -> list[int]:
    """Return the rows at which another rate begins, judged by whole seconds.

    Args:
        times: i64 (n,), ns.
        counts: i64 (n,), number of messages that each row stands for.
    """
    if len(times) < _FEW:
        return []
    # A set clock may put centuries between two rows, or go back.
    second = np.cumsum(np.clip(np.diff((times - times[0]) // SECOND, prepend=0), 0, _SILENT))
    offered = np.bincount(second, weights=counts)
    if len(offered) < _FEW or offered.max() - offered.min() <= _LEAST_HZ:
        return []
    rates, cuts, begin = offered.tolist(), [], 0
    window: list[float] = []  # sorted, so that the median needs no sorting
    for at in range(1, len(rates) - 1):
        insort(window, rates[at - 1])
        if len(window) > _USUAL:
            del window[bisect_left(window, rates[at - 1 - _USUAL])]
        if at - begin < 2:
            continue
        usual = (window[(len(window) - 1) // 2] + window[len(window) // 2]) / 2
        low, high = sorted(rates[at : at + 2])
        other = low > usual * _CHANGE or high * _CHANGE < usual
        if other and max(usual, high) - min(usual, low) > _LEAST_HZ:
            cuts.append(int(np.searchsorted(second, at)))
            begin = at
            window.clear()
    return [cut for cut in cuts if 0 < cut < len(times)]


def steady_rate(times: Integers, missing: int = 0) -> float | None:
    """Return the rate of messages in Hz if it is steady; else None.

    Args:
        times: i64 (n,), ns, times of arrival.
        missing: number of missing messages between them, which the rate includes.
    """
    length = int(times[-1] - times[0]) if len(times) else 0
    if len(times) <= _FEW or not length:
        return None
    window = max(_WINDOW_NS, _FEW * length // (len(times) - 1))
    number = length // window
    if number < _WINDOWS:
        return None
    came = np.bincount((times - times[0]) // window)[:number]
    usual = float(np.median(came))
    near = np.abs(came - usual) <= max(1.0, usual / 4)
    return (len(times) - 1 + missing) * SECOND / length if near.mean() >= _STEADY else None


class Comb(NamedTuple):
    """The rounds in which messages arrive, as from a task that wakes up periodically.

    Attributes:
        period_ns: time from round to round; 0 if there are fewer than three rounds.
        most: number of messages in a full round.
        share: share of the rounds that are full, 0 to 1.
    """

    period_ns: int
    most: int
    share: float


def bursts(times: Integers, pause_ns: int) -> tuple[Places, Places]:
    """Return the first message and the size of each burst, both intp; a longer pause separates two bursts."""
    begins = np.flatnonzero(np.diff(times, prepend=times[:1] - 2 * pause_ns) > pause_ns)
    return begins, np.diff(np.append(begins, len(times)))


def comb(times: Integers) -> Comb:
    """Return the rounds in which messages arrive.

    Args:
        times: i64 (n,), ns, in order.
    """
    if len(times) < 2 * _FEW:
        return Comb(0, 1, 0.0)
    begins, sizes = bursts(times, _BURST_NS)
    most = int(quantiles(sizes, 0.98)[0])
    period = int(quantiles(np.diff(times[begins]), 0.5)[0]) if len(begins) > 2 else 0
    return Comb(period, max(most, 1), np.count_nonzero(sizes >= most) / max(len(sizes), 1))


def full_where_lacking(times: Integers, missing: Integers, most: int) -> bool:
    """Return whether the rounds with missing messages are full, as a limit on waiting messages makes them.

    No round may be larger than a full one, except for the few messages that arrived during it.

    Args:
        times: i64 (n,), ns, of at least one message.
        missing: i64 (n,), number missing behind each.
        most: number of messages in a full round.
    """
    begins, sizes = bursts(times, _BURST_NS)
    lacking = np.flatnonzero(np.add.reduceat(missing, begins))
    is_most = sizes.max() <= most + max(1, most // 4)
    return bool(is_most and len(lacking) >= _LEAST_FULL and np.median(sizes[lacking]) >= most)


def full_rounds(times: Integers, missing: Integers, period_ns: int) -> int:
    """Return the number of messages in a round before the first missing one; 0 if that may be chance.

    This shows a limit without its counter: a network or the capture would lose messages anywhere in a round.

    Args:
        times: i64 (n,), ns, times of arrival.
        missing: i64 (n,), number missing behind each.
        period_ns: period of the rounds.
    """
    begins, sizes = bursts(times, period_ns // 4)
    if len(begins) < _LEAST_ROUNDS or abs(np.median(np.diff(times[begins])) - period_ns) > period_ns // 10:
        return 0
    rank = np.arange(1, len(times) + 1) - np.repeat(begins, sizes)
    behind = rank[missing > 0]
    if len(behind) < _LEAST_ROUNDS:
        return 0
    least = int(behind.min())
    return least if float((rank >= least).mean()) ** len(behind) < _BY_CHANCE else 0
