"""The same message on two links: what crossed cFS, how long that took, and what never came out.

A packet that cFS only hands on is the same bytes on both; a message that an application reads and writes anew
has another MsgId and another encoding, and the same values.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.diagnosis.fingerprint import latest_equal
from edoras_tools.diagnosis.instances import NOBODY
from edoras_tools.model import Link
from edoras_tools.sessions.profile import SECOND

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.streams import Stream
    from edoras_tools.diagnosis.table import Rows

_LONGEST_NS: Final = 120 * SECOND
"""No message is under way for longer: a full socket at CI is read within a minute and a half."""
_NEWER_NS: Final = SECOND
"""Messages that go in so close together reach an application that keeps the newest in one burst."""
_ALIKE: Final = 0.5
_LEAST_DIFFERENT: Final = 3


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
        out: where they come out.
        rewritten: an application read them and wrote them anew; else they are the same packets.
        of: messages that went in while the way out could be seen.
        matched: of those, how many came out.
        superseded: how many did not, a newer one having taken their place.
        missing: i64, capture times of those that neither came out nor were superseded.
        latency: of those whose values occur once.
        delays_ns: i64, the delay of each of those.
        out_ns: i64, and when each came out.
    """

    into: Stream
    out: Stream
    rewritten: bool
    of: int
    matched: int
    superseded: int
    missing: NDArray[np.int64]
    latency: Latency | None
    delays_ns: NDArray[np.int64]
    out_ns: NDArray[np.int64]


def find_hops(streams: Sequence[Stream], rows: Rows, follows: Callable[[Stream, Stream], bool]) -> list[Hop]:
    """Find every pair of streams of which one is the other, further on; each way out has one way in.

    Args:
        streams: all of them.
        rows: the table.
        follows: tells whether one stream's receiver is the sender of another.
    """
    ways_in = [item for item in streams if item.link in {Link.CI, Link.SBN}]
    ways_out = [item for item in streams if item.link in {Link.TO, Link.SBN}]
    best: dict[int, tuple[float, int, Stream, NDArray[np.uint64], NDArray[np.uint64]]] = {}
    for into, out in product(ways_in, ways_out):
        if not _may_follow(into, out) or not follows(into, out):
            continue
        for prints in _prints(into, out, rows):
            score = _likeness(*prints)
            near = -abs((into.msg_id & 0xF) - (out.msg_id & 0xF))
            if score >= _ALIKE and (score, near) > best.get(id(out), (0.0, 0))[:2]:
                best[id(out)] = (score, near, into, *prints)
    hops = []
    for out in ways_out:
        if id(out) in best:
            _, _, into, came, went = best[id(out)]
            hops.append(_match(into, out, rows, came, went))
    return [hop for hop in hops if hop.matched]


def _may_follow(into: Stream, out: Stream) -> bool:
    if into is out or (into.link is Link.SBN and out.link is Link.SBN and into.receiver != out.sender):
        return False
    if into.msg_id == out.msg_id:
        return into.instance == out.instance or NOBODY in {into.instance, out.instance}
    return bool(into.msg_id & 0x1000) != bool(out.msg_id & 0x1000)


def _prints(into: Stream, out: Stream, rows: Rows) -> list[tuple[NDArray[np.uint64], NDArray[np.uint64]]]:
    """Return the fingerprints to compare, the strictest first."""
    if into.msg_id == out.msg_id:
        return [(rows.packet_print[into.rows], rows.packet_print[out.rows])]
    kinds = (rows.stamped_print, rows.value_print)
    return [
        (kind[into.rows], kind[out.rows]) for kind in kinds if kind[into.rows].any() and kind[out.rows].any()
    ]


def _likeness(came: NDArray[np.uint64], went: NDArray[np.uint64]) -> float:
    """Return what part of the messages that come out went in: 0 where too few differ to tell."""
    different = np.unique(went[went != 0])
    if len(different) < _LEAST_DIFFERENT:
        return 0.0
    return float(np.isin(different, came).mean())


def _match(into: Stream, out: Stream, rows: Rows, came: NDArray[np.uint64], went: NDArray[np.uint64]) -> Hop:
    """Give every message that came out the latest equal one that had gone in."""
    in_ns, out_ns = rows.time_ns[into.rows], rows.time_ns[out.rows]
    from_ = latest_equal(came, in_ns, went, out_ns)
    goes_row = np.flatnonzero(from_ >= 0)
    from_row = from_[goes_row]
    delay = out_ns[goes_row] - in_ns[from_row]
    sound = delay <= _LONGEST_NS
    goes_row, from_row, delay = goes_row[sound], from_row[sound], delay[sound]

    matched = np.zeros(len(came), bool)
    matched[from_row] = True
    seen = came != 0
    if len(from_row):
        # Before the first and after the last that came out, the way out may not have been there.
        seen &= (in_ns >= in_ns[from_row.min()]) & (in_ns <= in_ns[from_row.max()])
    # An application that rewrites may keep the newest only: of a burst, the last goes on.
    never = np.iinfo(np.int64).max
    next_ns = np.minimum.accumulate(np.where(matched, in_ns, never)[::-1])[::-1]
    taken = ~matched & (next_ns < never) & (into.msg_id != out.msg_id)
    taken[taken] = next_ns[taken] - in_ns[taken] <= _NEWER_NS
    values, counts = np.unique(came, return_counts=True)
    single = np.isin(came[from_row], values[counts == 1])
    delay, when = delay[single], out_ns[goes_row][single]
    by_time = np.argsort(when, kind="stable")
    return Hop(
        into=into,
        out=out,
        rewritten=into.msg_id != out.msg_id,
        of=int(seen.sum()),
        matched=int((seen & matched).sum()),
        superseded=int((seen & taken).sum()),
        missing=in_ns[seen & ~matched & ~taken],
        latency=summary(delay),
        delays_ns=delay[by_time],
        out_ns=when[by_time],
    )


def summary(delay_ns: NDArray[np.int64]) -> Latency | None:
    """Return the figures of some delays; None where there are none."""
    if not len(delay_ns):
        return None
    p50, p99, most = (round(float(value) / 1e6, 3) for value in np.quantile(delay_ns, (0.5, 0.99, 1.0)))
    return Latency(len(delay_ns), p50, p99, most)
