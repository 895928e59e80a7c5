"""What was seen of each MsgId on each link, what its sequence count says is missing, and its rates.

A stream is one MsgId of one sender on one link. ``sessions.sequence`` has the rules of the counts. A span is
a part of it in which it did one thing: it ends where the stream pauses or its rate changes.
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
from edoras_tools.wire.arrays.order import by_value, distinct, distinct_rows, groups, numbered, quantiles
from edoras_tools.wire.msg_id import VERSION_1

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.evidence.table import Rows
    from edoras_tools.wire.arrays.order import Integers


_PAUSE_NS: Final = 2 * SECOND
_PAUSE_FACTOR: Final = 4
_LEAST_FELL: Final = 3
_LEAST_ONES: Final = 20
_MOST_MISSING: Final = 64


class Stream(msgspec.Struct, eq=False, dict=True):
    """One MsgId of one sender on one link.

    Attributes:
        link: the link.
        msg_id: cFE MsgId.
        sender: endpoint it came from.
        receiver: endpoint it went to.
        processor: SBN identity of the sender, spacecraft and processor; (0, 0) elsewhere.
        instance: index of the cFS that made it, ``NOBODY`` where unknown.
        route: index of its configured route, or ``NO_ROUTE``.
        rows: of the table, in order.
        time_ns: i64 (rows,), their capture times, ns since 1970.
        counted: whether its sequence count counts.
        missing: i64 (rows,), counts that never came between a row and its next.
        pauses: bool (rows,), the next row came after a pause: what is missing may never have come this way.
        repeats: bool (rows,), the row repeats one that came before.
        gaps: counts that never came, before its first row and at pauses too; not at a change of port.
        reordered: rows that came late.
        restarts: times the count began anew.
        known_id: its MsgId as of version 1, as facts of cFS name it.
    """

    link: Link
    msg_id: int
    sender: int
    receiver: int
    processor: tuple[int, int]
    instance: int
    route: int
    rows: NDArray[np.intp]
    time_ns: NDArray[np.int64]
    counted: bool
    missing: NDArray[np.int64]
    pauses: NDArray[np.bool_]
    repeats: NDArray[np.bool_]
    gaps: int = 0
    reordered: int = 0
    restarts: int = 0
    known_id: int = NO_MSG_ID

    @property
    def way(self) -> tuple[int, int, int, int]:
        """What distinguishes it from others, whoever made its packets: link, both ends, MsgId."""
        return self.link.code, self.sender, self.receiver, self.msg_id

    @property
    def is_command(self) -> bool:
        """Whether its packets are commands."""
        return bool(VERSION_1.is_command(self.known_id))

    @property
    def is_housekeeping(self) -> bool:
        """Whether they are packets of cFS's own, and no topic of a mission."""
        return self.known_id in MSG_ID_NAMES and self.route == NO_ROUTE

    @property
    def duplicates(self) -> int:
        """Rows that repeat one."""
        return int(self.repeats.sum())

    @property
    def counts(self) -> NDArray[np.int64]:
        """How many messages each row stands for, i64: itself, and those behind it that never came."""
        return np.append(self.missing[:-1], 0) + ~self.repeats

    @cached_property
    def spans(self) -> list[Span]:
        """Its parts at one rate each."""
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
    """Return every stream of a capture."""
    instance = _whole(rows, instances)
    packets = np.flatnonzero(rows.msg_id != NO_MSG_ID)
    # Whoever commands does not count, and may use any number of ports.
    up = rows.on(lambda item: item.only_to_cfs, packets)
    down = rows.on(lambda item: item.only_from_cfs, packets)
    sender = np.where(up, -1, rows.source[packets])
    sources, _, which = distinct_rows(sender[down])
    sender[down] = np.array([*map(instances.output, sources.tolist())], np.int64)[which]
    receiver = np.where(down, -1, rows.destination[packets])
    packet = rows.processor_id[packets], rows.spacecraft_id[packets], rows.msg_id[packets]
    keys = rows.link[packets], sender, receiver, *packet, np.where(up, NOBODY, instance[packets])
    first, which = numbered(*keys)
    # In the order of their keys, whatever comes first in the capture.
    order = np.lexsort([key[first] for key in reversed(keys)])
    number = np.empty_like(order)
    number[order] = np.arange(len(order))
    behind = np.flatnonzero(rows.has(Finding.STREAM_GAP) & ~rows.has(Finding.FRAGMENT))
    return [_stream(rows, packets[members], instance, behind) for _, members in by_value(number[which])]


def find_robots(rows: Rows) -> list[Stream]:
    """Return what was sent to each robot: bare numbers, no MsgId and no count."""
    own = np.flatnonzero(rows.on(lambda item: item.last_hop))
    nobody, none = np.full(len(rows), NOBODY, np.int32), own[:0]
    streams = [_stream(rows, members, nobody, none) for _, members in groups(rows.way(), own)]
    return [replace(item, pauses=np.zeros(len(item), np.bool_)) for item in streams]


class Reset(NamedTuple):
    """A cFS started again and its clock went on, as after a processor reset: between two times."""

    instance: int
    start_ns: int
    end_ns: int


def find_resets(rows: Rows, streams: Sequence[Stream]) -> list[Reset]:
    """Return every restart of a cFS whose clock went on.

    Telemetry Output speaks from another port, and most MsgIds count from lower on: if it alone had started
    again, they would go on. Each MsgId tells a time before and one after; those that overlap are one restart.
    """
    spans: dict[int, list[tuple[int, int, bool]]] = {}
    for stream in streams:
        if stream.link.only_from_cfs and stream.counted:
            count = rows.sequence_count[stream.rows].astype(np.int64)
            for at in np.flatnonzero(np.diff(rows.source[stream.rows])).tolist():
                start, end = stream.time_ns[at : at + 2].tolist()
                if start < end:
                    fell = (count[at + 1] - count[at]) % MODULUS >= FORWARD
                    spans.setdefault(stream.instance, []).append((end, start, fell))
    resets = []
    for instance, members in spans.items():
        rest = sorted(members)
        while rest:
            first_end = rest[0][0]
            same = [item for item in rest if item[1] < first_end]
            fell = [(start, end) for end, start, down in same if down]
            if len(fell) >= _LEAST_FELL and len(fell) * 2 > len(same):
                resets.append(Reset(instance, max(start for start, _ in fell), min(end for _, end in fell)))
            rest = [item for item in rest if item[1] >= first_end]
    return resets


def _whole(rows: Rows, instances: Instances) -> NDArray[np.int32]:
    """Give packets without a time of their own (wake-ups) the instance whose count they continue."""
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
        # Behind TO several instances share a MsgId; an SBN sender is one instance at a time.
        key += [rows.msg_id.astype(np.int64)] * (mask is output)
        both = np.concatenate((lost, timed))
        which = numbered(*(column[both] for column in key))[1]
        places = dict(by_value(which[len(lost) :]))
        for who, at in by_value(which[: len(lost)]):
            if who in places:
                rest, same = lost[at], timed[places[who]]
                out[rest] = _nearest(rows, rest, same, instances.of_row, by_count=mask is output)
    return out


def _handed_on(rows: Rows, lost: NDArray[np.intp], out: NDArray[np.int32]) -> NDArray[np.intp]:
    """Give packets from Telemetry Output the instance that sent the same ones over SBN; return the others."""
    network = np.flatnonzero(rows.on(lambda link: link.peers) & np.isin(rows.msg_id, rows.msg_id[lost]))
    both = np.concatenate((network, lost))
    cut = rows.msg_id[both[rows.has(Finding.CAPTURE_CUT)[both]]]
    rest = []
    # Cut packets are compared otherwise: a MsgId that has one apart from those that have none.
    for some in (True, False):
        mine, theirs = (item[np.isin(rows.msg_id[item], cut) == some] for item in (lost, network))
        from_ = handed_on(rows, theirs, mine)
        same = from_ >= 0
        out[mine[same]] = out[theirs[from_[same]]]
        rest.append(mine[~same])
    return np.sort(np.concatenate(rest))


def _nearest(
    rows: Rows,
    lost: NDArray[np.intp],
    timed: NDArray[np.intp],
    instance: NDArray[np.int32],
    *,
    by_count: bool,
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


def _stream(
    rows: Rows, members: NDArray[np.intp], instance: NDArray[np.int32], behind: NDArray[np.intp]
) -> Stream:
    """Account for some rows; ``behind`` are all those behind bytes that the capture lacks."""
    first = int(members[0])
    routes = rows.route[members]
    own = routes[routes != NO_ROUTE]
    missing, time_ns = rows.missing[members], rows.time_ns[members]
    gaps = int(missing.sum())  # as info has them, which knows of no restart: what follows is for judging
    link = table.link(rows.link[first])
    if link.only_from_cfs:
        _count_moves(rows, members, missing)
    if len(behind) and link.transport.tcp:
        same = (rows.source[behind] == rows.source[first]) & (
            rows.destination[behind] == rows.destination[first]
        )
        passed = np.searchsorted(behind[same], members, side="right")
        missing[np.diff(passed, prepend=0) > 0] = 0  # TCP delivered them, the capture lacks them
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
        # Another cFS counts anew; that is no restart of this one's count.
        restarts=max(0, int(rows.restarts[members[1:]].sum())),
        known_id=int(rows.known_id[first]),
    )


def _count_moves(rows: Rows, members: NDArray[np.intp], missing: NDArray[np.int32]) -> None:
    """Put into ``missing`` what is missing where a stream moves to another port.

    Each port has a count of its own to follow; that of a Telemetry Output that restarted goes on.
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
        ahead[step] -= len(np.unique(late[late < ahead[step]]))  # the first one overtook them
    # A step back is no wrap: whoever publishes it started again too.
    missing[moved] = np.where(rows.counted[members[moved]] & (ahead < FORWARD), ahead, 0)


def counted_gaps(rows: Rows, stream: Stream) -> Integers:
    """Return how many counts of its one sender are missing behind each row, i64; 0 where that does not count.

    Most of its steps are by one. What that sender counts together with other MsgIds is not missing.
    """
    own = stream.rows
    count, source = rows.sequence_count[own].astype(np.int64), rows.source[own]
    ones = int((np.diff(count) % MODULUS == 1).sum())
    if ones < _LEAST_ONES or 2 * ones < len(own) or (source != source[0]).any():
        return np.zeros(len(own), np.int64)
    missing = np.where(stream.missing <= _MOST_MISSING, stream.missing, 0)
    others = np.flatnonzero((rows.source == source[0]) & (rows.msg_id != stream.msg_id))
    for at in np.flatnonzero(missing).tolist() if len(others) else ():
        near = others[slice(*np.searchsorted(rows.time_ns[others], stream.time_ns[at : at + 2]))]
        ahead = (rows.sequence_count[near].astype(np.int64) - count[at]) % MODULUS
        missing[at] -= len(np.unique(ahead[(ahead > 0) & (ahead <= missing[at])]))
    return missing


def _pauses(times: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Tell after which rows a stream paused: so long as it never does while it runs."""
    steps = np.diff(times)
    out = np.zeros(len(times), bool)
    if len(steps) > 2:
        out[:-1] = steps > max(_PAUSE_NS, _PAUSE_FACTOR * quantiles(steps, 0.9)[0])
    return out


_CHANGE: Final = 1.6
"""A rate that differs by this factor for two seconds is another rate."""
_USUAL: Final = 600
"""The usual rate is the median of so many seconds at most,"""
_SILENT: Final = 10
"""and of a silence only so many seconds count."""
_LEAST_HZ: Final = 4.0
_LEAST_FULL: Final = 3
_LEAST_ROUNDS: Final = 5
_BY_CHANCE: Final = 0.001
"""So many full rounds show a limit."""
_BURST_NS: Final = 60_000_000
_FEW: Final = 4
_WINDOW_NS: Final = 2 * SECOND
_WINDOWS: Final = 3
_STEADY: Final = 0.9
"""Of windows of time that have as many messages as the others."""


class Span(msgspec.Struct, frozen=True):
    """Part of a stream.

    Attributes:
        first: its first row, as an index into the stream's rows.
        last: its last row.
        start_ns: time of the first row.
        end_ns: time of the last row.
        count: rows, without those that repeat one.
        missing: counts that never came, those behind its last row included.
    """

    first: int
    last: int
    start_ns: int
    end_ns: int
    count: int
    missing: int

    @property
    def rows(self) -> slice:
        """Where its rows are among the stream's."""
        return slice(self.first, self.last + 1)

    @property
    def rate_hz(self) -> float:
        """Rows a second."""
        return rate_hz(self.count, self.end_ns - self.start_ns)

    @property
    def offered_hz(self) -> float:
        """Rows and missing counts a second."""
        return rate_hz(self.count + self.missing, self.end_ns - self.start_ns)


def _changes(times: NDArray[np.int64], counts: NDArray[np.int64]) -> list[int]:
    """Return the rows at which another rate begins, by whole seconds; each stands for so many messages."""
    if len(times) < _FEW:
        return []
    # A clock that jumps may leave centuries between two rows, or lead back.
    second = np.cumsum(np.clip(np.diff((times - times[0]) // SECOND, prepend=0), 0, _SILENT))
    offered = np.bincount(second, weights=counts)
    if len(offered) < _FEW or offered.max() - offered.min() <= _LEAST_HZ:
        return []
    rates, cuts, begin = offered.tolist(), [], 0
    window: list[float] = []  # in order, so that the median needs no sorting
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


def steady_rate(times: NDArray[np.int64], missing: int = 0) -> float | None:
    """Return at what rate messages came, in Hz, if they came steadily; else None.

    Args:
        times: when each came.
        missing: counts that never came between them: they are of the rate too.
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
    """How a stream arrives in rounds.

    Attributes:
        period_ns: from round to round; 0 where it does not come in rounds.
        most: messages in a full round.
        share: of rounds that were full.
    """

    period_ns: int
    most: int
    share: float


def bursts(times: NDArray[np.int64], pause_ns: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the first message and the size of each burst: between two of them is more than a pause."""
    begins = np.flatnonzero(np.diff(times, prepend=times[:1] - 2 * pause_ns) > pause_ns)
    return begins, np.diff(np.append(begins, len(times)))


def comb(times: NDArray[np.int64]) -> Comb:
    """Tell whether messages come in rounds, as what a task that wakes up now and then sends does."""
    if len(times) < 2 * _FEW:
        return Comb(0, 1, 0.0)
    begins, sizes = bursts(times, _BURST_NS)
    most = int(quantiles(sizes, 0.98)[0])
    period = int(quantiles(np.diff(times[begins]), 0.5)[0]) if len(begins) > 2 else 0
    return Comb(period, max(most, 1), np.count_nonzero(sizes >= most) / max(len(sizes), 1))


def full_where_lacking(times: NDArray[np.int64], missing: NDArray[np.int64], most: int) -> bool:
    """Tell whether rounds behind which messages are missing are full: else fewer came, and more may wait.

    None is larger then, but for what came while it was sent.

    Args:
        times: i64 (n,), ns, of at least one message.
        missing: (n,), how many are missing behind each.
        most: how many a full round has.
    """
    begins, sizes = bursts(times, _BURST_NS)
    lacking = np.flatnonzero(np.add.reduceat(missing, begins))
    is_most = sizes.max() <= most + max(1, most // 4)
    return bool(is_most and len(lacking) >= _LEAST_FULL and np.median(sizes[lacking]) >= most)


def full_rounds(times: NDArray[np.int64], missing: NDArray[np.int64], period_ns: int) -> int:
    """Return how many of a round came before any was missing, where that is no chance; else 0.

    So a limit shows without its counter: a network, or the capture, would lack some of other rounds, too.

    Args:
        times: i64 (n,), ns, when messages came.
        missing: (n,), how many are missing behind each.
        period_ns: of the rounds.
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
