"""The same message on two links: what crossed cFS, how long that took, and what never came out.

A packet that cFS only hands on is the same bytes on both; a message that an application reads and writes anew
has another MsgId and the same body. Only where no bodies are alike are values compared, as the types of a
mission have them: what the bytes tell holds with any mission.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from edoras_tools.diagnosis.evidence.fingerprint import paired
from edoras_tools.diagnosis.evidence.instances import NOBODY
from edoras_tools.model import Finding
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire.arrays.order import quantiles

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.evidence.table import Rows
    from edoras_tools.diagnosis.matching.streams import Stream

_LONGEST_NS: Final = 120 * SECOND
"""No message is under way for longer: a full socket at CI is read within a minute and a half."""
_NEWER_NS: Final = 550 * MILLISECOND
"""Messages that go in further apart are taken in two rounds of CI."""
_ROUND_NS: Final = 500 * MILLISECOND
_OFTENER: Final = 2
_BURST_NS: Final = 20 * MILLISECOND
_FEW_TOGETHER: Final = 0.1
_ALIKE: Final = 0.5
_LEAST_DIFFERENT: Final = 3
_NEARLY_ALL: Final = 0.9
_BODIES: Final = "body_print", "body_print"
_TO_ROBOT: Final = (
    _BODIES,
    ("value_print", "value_print"),
    ("value_print", "stamped_print"),
    ("shared_print", "shared_print"),
)
"""A robot is sent bare numbers, their bytes or values as the configured type has them, or a struct."""
_COMPARED: Final = (*_TO_ROBOT, ("stamped_print", "stamped_print"))
"""What streams of different MsgIds are compared by: fingerprints of what goes in and of what comes out."""


@dataclass(frozen=True, slots=True)
class Latency:
    """How long messages took, in ms."""

    count: int
    p50: float
    p99: float
    most: float

    def as_json(self) -> dict[str, Any]:
        """Return it in the shape of ``doctor --json``."""
        return {"count": self.count, "p50_ms": self.p50, "p99_ms": self.p99, "max_ms": self.most}


@dataclass(frozen=True, slots=True)
class Hop:
    """Messages of one stream that came out again as another.

    Attributes:
        into: where they go in.
        out: where they come out; the robot, where its link is ``OTHER``.
        rewritten: an application read them and wrote them anew; else they are the same packets.
        known: bool, a row of ``into`` each: it has a fingerprint, so it can be found again.
        arrived: bool, likewise: it came out.
        newer: bool, likewise: it did not, and a newer one of the same round did, where only the newest does.
        single: bool, one for each that is ``known``: no other of them has its fingerprint.
        origin: i64, a row of ``out`` each: the place in ``into`` that it came from, -1 where there is none.
        sole: bool, likewise: its fingerprint occurs once coming out, and not twice going in.
        doubled: how often one came out that already had.
        latency: of those whose values occur once.
        delays_ns: i64, the delay of each of those.
        out_ns: i64, and when each came out.
        last_ns: the longest that one took.
        first: when the first came out, and when it had gone in; None where none did.
        in_rows: intp, the messages that came out, as indices into the rows of ``into``.
        out_rows: intp, and what each is, as an index into those of ``out``.
    """

    into: Stream
    out: Stream
    rewritten: bool
    known: NDArray[np.bool_]
    arrived: NDArray[np.bool_]
    newer: NDArray[np.bool_]
    single: NDArray[np.bool_]
    origin: NDArray[np.intp]
    sole: NDArray[np.bool_]
    doubled: int
    latency: Latency | None
    delays_ns: NDArray[np.int64]
    out_ns: NDArray[np.int64]
    last_ns: int
    first: tuple[int, int] | None
    in_rows: NDArray[np.intp]
    out_rows: NDArray[np.intp]

    @property
    def of(self) -> int:
        """How many went in that can be found again."""
        return int(self.known.sum())

    @property
    def matched(self) -> int:
        """How many of those came out."""
        return int(self.arrived.sum())

    @property
    def absent(self) -> NDArray[np.bool_]:
        """Which of those did not."""
        return self.known & ~self.arrived


def find_hops(streams: Sequence[Stream], rows: Rows, follows: Callable[[Stream, Stream], bool]) -> list[Hop]:
    """Find every pair of streams of which one is the other, further on.

    Each way out has one way in, but for a robot's: several MsgIds may command it.

    Args:
        follows: tells whether one stream's receiver is the sender of another.
    """
    ways_in = [item for item in streams if item.link.to_cfs and item.link.packets]
    ways_out = [item for item in streams if item.link.from_cfs]
    known = _Prints(rows)
    hops: list[Hop] = []
    every = list(ways_out)  # each is looked up by its id
    while ways_out:
        best = _ways_in(ways_in, ways_out, rows, known, follows)
        rests = []
        for out in ways_out:
            if id(out) in best:
                _, into, came, went = best[id(out)]
                hops.append(_match(into, out, rows, came, went))
                other = ~np.isin(went, came)
                if out.link.last_hop and other.any():
                    rests.append(replace(out, rows=out.rows[other]))
        ways_out = rests
        every += rests
    return [hop for hop in hops if hop.matched]


def _ways_in(
    ways_in: Sequence[Stream],
    ways_out: Sequence[Stream],
    rows: Rows,
    known: _Prints,
    follows: Callable[[Stream, Stream], bool],
) -> dict[int, _Way]:
    """Return the likeliest way in of each way out, by its id."""
    best: dict[int, _Way] = {}
    begin_ns, end_ns = (
        np.array([rows.time_ns[item.rows[place]] for item in ways_out], np.int64) for place in (0, -1)
    )
    first_ns, last_ns = (
        np.array([rows.time_ns[item.rows[place]] for item in ways_in], np.int64) for place in (0, -1)
    )
    pairs = _alike(ways_in, ways_out, known)
    in_time = (end_ns[pairs[1]] >= first_ns[pairs[0]]) & (
        begin_ns[pairs[1]] <= last_ns[pairs[0]] + _LONGEST_NS
    )
    for place, at in pairs[:, in_time].T.tolist():
        into, out = ways_in[place], ways_out[at]
        if not _may_follow(into, out) or not follows(into, out):
            continue
        for kinds in _kinds(into, out, known):
            prints = known.of(into, kinds[0]), known.of(out, kinds[1])
            different = known.different(into, kinds[0]), known.different(out, kinds[1])
            score = _likeness(*prints, different, sure=out.link.last_hop)
            near = -abs((into.msg_id & 0xF) - (out.msg_id & 0xF))
            rank = kinds == _BODIES, score, near
            if score >= _ALIKE and (id(out) not in best or rank > best[id(out)].rank):
                best[id(out)] = _Way(rank, into, *prints)
    return best


def _alike(ways_in: Sequence[Stream], ways_out: Sequence[Stream], known: _Prints) -> NDArray[np.intp]:
    """Return which ways in have some fingerprint of which ways out: (2, pairs), places of both, in order."""
    ids, width = np.array([item.msg_id for item in ways_out]), len(ways_out)
    codes = [place * width + np.flatnonzero(ids == into.msg_id) for place, into in enumerate(ways_in)]
    for kinds in _COMPARED:
        (values, owner), (sought, seeker) = (
            known.all_of(streams, kind) for streams, kind in zip((ways_in, ways_out), kinds, strict=True)
        )
        low, high = (np.searchsorted(values, sought, side) for side in ("left", "right"))
        count = high - low
        at = np.repeat(low - np.concatenate(([0], np.cumsum(count)[:-1])), count) + np.arange(count.sum())
        codes.append(np.unique(owner[at] * width + np.repeat(seeker, count)))
    return np.stack(np.divmod(np.unique(np.concatenate(codes)), max(1, width)))


class _Way(NamedTuple):
    """What may have come out as a stream: how likely, by what is alike; fingerprints of both."""

    rank: tuple[bool, float, int]
    into: Stream
    came: NDArray[np.uint64]
    went: NDArray[np.uint64]


def _may_follow(into: Stream, out: Stream) -> bool:
    if out.link.last_hop:
        return into.is_command
    if into is out or (into.link.peers and out.link.peers and into.receiver != out.sender):
        return False
    if into.msg_id == out.msg_id:
        if into.link.peers and out.link.peers:
            return False  # SBN's pipes leave out what SBN itself has put on the bus
        return into.instance == out.instance or NOBODY in {into.instance, out.instance}
    return into.is_command != out.is_command


class _Prints:
    """The fingerprints of streams: each is compared with many others, and looked up once.

    A kind is a column of the table, or ``COUNT``: sequence counts, 0 where there is none. 0 tells nothing.
    """

    COUNT: Final = "count"

    def __init__(self, rows: Rows) -> None:
        self._rows = rows
        self._cut = rows.has(Finding.CAPTURE_CUT)
        self._of: dict[tuple[int, str], NDArray[np.uint64]] = {}
        self._different: dict[tuple[int, str], NDArray[np.uint64]] = {}
        self._cut_ones: dict[int, bool] = {}

    def of(self, stream: Stream, kind: str) -> NDArray[np.uint64]:
        """Return those of a stream's rows, u64."""
        key, rows = (id(stream), kind), self._rows
        if key not in self._of:
            if kind == self.COUNT:
                counts = rows.sequence_count[stream.rows].astype(np.uint64) + 1
                self._of[key] = np.where(rows.counted[stream.rows], counts, 0)
            else:
                self._of[key] = getattr(rows, kind)[stream.rows]
        return self._of[key]

    def different(self, stream: Stream, kind: str) -> NDArray[np.uint64]:
        """Return each of them once, in order, without 0."""
        key = id(stream), kind
        if key not in self._different:
            prints = self.of(stream, kind)
            self._different[key] = np.unique(prints[prints != 0])
        return self._different[key]

    def all_of(self, streams: Sequence[Stream], kind: str) -> tuple[NDArray[np.uint64], NDArray[np.intp]]:
        """Return those of all streams, in order, and the place of the stream that each is of."""
        parts = [self.different(stream, kind) for stream in streams]
        values = np.concatenate([np.zeros(0, np.uint64), *parts])
        order = np.argsort(values, kind="stable")
        return values[order], np.repeat(np.arange(len(parts)), [len(part) for part in parts])[order]

    def cut(self, stream: Stream) -> bool:
        """Tell whether the capture cut some packet of a stream."""
        key = id(stream)
        if key not in self._cut_ones:
            self._cut_ones[key] = bool(self._cut[stream.rows].any())
        return self._cut_ones[key]


def _kinds(into: Stream, out: Stream, known: _Prints) -> list[tuple[str, str]]:
    """Return which fingerprints of each to compare, the strictest first."""
    if into.msg_id == out.msg_id:
        if into.instance == out.instance != NOBODY and (known.cut(into) or known.cut(out)):
            # What is left of a packet differs with the headers before it; one cFS gives a count once.
            return [(known.COUNT, known.COUNT)]
        return [("packet_print", "packet_print")]
    if out.link.last_hop:
        return list(_TO_ROBOT)
    return [
        (kind, kind)
        for kind in (_BODIES[0], "stamped_print", "value_print")
        if len(known.different(into, kind)) and len(known.different(out, kind))
    ]


def _likeness(
    came: NDArray[np.uint64],
    went: NDArray[np.uint64],
    differing: tuple[NDArray[np.uint64], NDArray[np.uint64]],
    *,
    sure: bool,
) -> float:
    """Return what part of the messages that come out went in: 0 where too few differ to tell.

    Args:
        came: fingerprints of what goes in.
        went: of what comes out.
        differing: each of both once, in order, without 0.
        sure: the same value is no chance, however few there are.
    """
    known, different = differing
    if not len(different) or (len(different) < _LEAST_DIFFERENT and not sure):
        return 0.0
    alike = float(_among(different, known).mean())
    if sure and alike < _ALIKE:
        # What comes out first may have gone in before the capture began; what follows did not.
        there = np.flatnonzero(np.isin(went, came) & (went != 0))
        behind = np.unique(went[there[0] :][went[there[0] :] != 0]) if len(there) else different[:0]
        there_too = _among(behind, known)
        if there_too.sum() >= _LEAST_DIFFERENT and there_too.mean() > _NEARLY_ALL:
            return _ALIKE
    return alike


def _among(values: NDArray[np.uint64], known: NDArray[np.uint64]) -> NDArray[np.bool_]:
    """Return which values are in some others, which are in order."""
    if not len(known):
        return np.zeros(len(values), bool)
    return np.asarray(known[np.minimum(np.searchsorted(known, values), len(known) - 1)] == values)


def _match(into: Stream, out: Stream, rows: Rows, came: NDArray[np.uint64], went: NDArray[np.uint64]) -> Hop:
    """Give every message that came out the latest equal one that had gone in and not come out yet."""
    in_ns, out_ns = rows.time_ns[into.rows], rows.time_ns[out.rows]
    from_ = paired(came, in_ns, went, out_ns)
    from_[out_ns - in_ns[from_] > _LONGEST_NS] = -1
    goes_row = np.flatnonzero(from_ >= 0)
    from_row = from_[goes_row]
    delay = out_ns[goes_row] - in_ns[from_row]

    arrived = np.zeros(len(came), bool)
    arrived[from_row] = True
    rewritten = out.link.last_hop or into.msg_id != out.msg_id
    newer = np.zeros(len(came), bool)
    if rewritten and _newest_only(out_ns[goes_row]):
        # Taken in one round: not before the one that came out last, and close to the one that does.
        never = np.iinfo(np.int64).max
        next_ns = np.minimum.accumulate(np.where(arrived, in_ns, never)[::-1])[::-1]
        newer = ~arrived & (next_ns < never) & (came != 0)
        newer[newer] = next_ns[newer] - in_ns[newer] <= _NEWER_NS
        # Of two that are half a round apart every other pair is taken in one; where more lack, they are lost.
        together = np.clip(1 - np.diff(in_ns) / _ROUND_NS, 0, None).sum()
        newer &= bool(newer.sum() <= _OFTENER * together + _LEAST_DIFFERENT)
    often, out_often = _occurrences(came), _occurrences(went)
    single = often[from_row] == 1
    by_time = np.argsort(out_ns[goes_row][single], kind="stable")
    return Hop(
        into=into,
        out=out,
        rewritten=rewritten,
        known=came != 0,
        arrived=arrived,
        newer=newer,
        single=often[came != 0] == 1,
        origin=from_,
        sole=(went != 0) & (out_often == 1) & ~np.isin(went, came[often > 1]),
        doubled=int(np.isin(went, came[arrived]).sum()) - len(goes_row),
        latency=latency_of(delay[single]),
        delays_ns=delay[single][by_time],
        out_ns=out_ns[goes_row][single][by_time],
        last_ns=int(delay.max()) if len(delay) else 0,
        first=min(zip(out_ns[goes_row].tolist(), in_ns[from_row].tolist(), strict=True), default=None),
        in_rows=from_row,
        out_rows=goes_row,
    )


def _occurrences(values: NDArray[np.uint64]) -> NDArray[np.intp]:
    """Return how often each value occurs."""
    _, which, counts = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray(counts[which])


def _newest_only(out_ns: NDArray[np.int64]) -> bool:
    """Tell whether messages come out one by one, as those of an application that keeps the newest do."""
    if len(out_ns) < _LEAST_DIFFERENT:
        return False
    return float((np.diff(np.sort(out_ns)) < _BURST_NS).mean()) < _FEW_TOGETHER


def latency_of(delay_ns: NDArray[np.int64]) -> Latency | None:
    """Return the figures of some delays; None where there are none."""
    if not len(delay_ns):
        return None
    p50, p99, most = (round(value / 1e6, 3) for value in quantiles(delay_ns, 0.5, 0.99, 1.0))
    return Latency(len(delay_ns), p50, p99, most)
