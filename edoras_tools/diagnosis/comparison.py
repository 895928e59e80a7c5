"""Two captures of the same traffic held against each other: at two points, or before and after a change.

Packets are the same by their bytes. What is left is altered where its sequence count, or its place between
two that are the same, says that it is the same packet; else it is lost in one and extra in the other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.diagnosis.matching import Latency, summary
from edoras_tools.model import NO_MSG_ID, Finding, Link
from edoras_tools.sessions.profile import MILLISECOND
from edoras_tools.wire.names import message_name

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.table import Rows
    from edoras_tools.mission import Mission

_LATE_NS: Final = 100 * MILLISECOND


@dataclass(frozen=True, slots=True)
class Difference:
    """One MsgId on one link, in both captures.

    Attributes:
        link: the link.
        msg_id: cFE MsgId.
        topic: its configured topic, or None.
        first: packets in the first capture.
        second: packets in the second.
        same: packets of both.
        lost: of the first, not in the second, while the second was capturing.
        extra: of the second, not in the first.
        altered: the same packet with other bytes.
        late: of the same, those more than 100 ms later than the quickest.
        latency: from the first to the second, the quickest packet of all taken as 0.
    """

    link: Link
    msg_id: int
    topic: str | None
    first: int
    second: int
    same: int
    lost: int
    extra: int
    altered: int
    late: int
    latency: Latency | None

    def as_json(self) -> dict[str, Any]:
        """Return it in the shape of ``doctor --against --json``."""
        return {
            "link": self.link.label,
            "msg_id": f"0x{self.msg_id:04x}",
            "topic": self.topic,
            "name": message_name(self.msg_id) or None,
            "first": self.first,
            "second": self.second,
            "same": self.same,
            "lost": self.lost,
            "extra": self.extra,
            "altered": self.altered,
            "late": self.late,
            "latency": self.latency.as_json() if self.latency else None,
        }


@dataclass(frozen=True, slots=True)
class Comparison:
    """All differences of two captures.

    Attributes:
        offset_ns: the second's clock minus the first's, the quickest packet's time on the way included.
        routes: a row for every MsgId of either.
    """

    offset_ns: int
    routes: Sequence[Difference]

    @property
    def lost(self) -> int:
        """Packets of the first that the second lacks."""
        return sum(item.lost for item in self.routes)

    def as_json(self) -> dict[str, Any]:
        """Return it in the shape of ``doctor --against --json``."""
        return {
            "offset_ns": self.offset_ns,
            "lost": self.lost,
            "routes": [item.as_json() for item in self.routes],
        }


def compare(first: Rows, second: Rows, mission: Mission) -> Comparison:
    """Hold two captures against each other."""
    topics = {(route.link, route.msg_id): route.topic for route in mission.routes}
    keys = sorted({key for rows in (first, second) for key in _keys(rows)})
    pairs = {key: _pair(first, second, _rows(first, *key), _rows(second, *key)) for key in keys}
    steps = [second.time_ns[theirs] - first.time_ns[ours] for ours, theirs in pairs.values() if len(ours)]
    offset = int(np.concatenate(steps).min()) if steps else 0
    return Comparison(
        offset,
        [
            _difference(first, second, key, *pairs[key], offset, topics.get((Link(key[0]), key[1])))
            for key in keys
        ],
    )


def _keys(rows: Rows) -> list[tuple[int, int]]:
    packets = rows.msg_id != NO_MSG_ID
    both = np.unique(np.stack((rows.link[packets].astype(np.int64), rows.msg_id[packets])), axis=1)
    return [(int(link), int(msg_id)) for link, msg_id in both.T]


def _rows(rows: Rows, link: int, msg_id: int) -> NDArray[np.intp]:
    return np.flatnonzero((rows.link == link) & (rows.msg_id == msg_id))


def _pair(
    first: Rows, second: Rows, ours: NDArray[np.intp], theirs: NDArray[np.intp]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pair equal packets, the n-th of one with the n-th of the other."""

    def numbered(prints: NDArray[np.uint64]) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
        order = np.argsort(prints, kind="stable")
        begins = np.flatnonzero(np.append(True, prints[order][1:] != prints[order][:-1]))
        nth = np.arange(len(order)) - np.repeat(begins, np.diff(np.append(begins, len(order))))
        return order, nth

    if not len(ours) or not len(theirs):
        return ours[:0], theirs[:0]
    (a, a_nth), (b, b_nth) = (
        numbered(rows.packet_print[own]) for rows, own in ((first, ours), (second, theirs))
    )
    kind = np.dtype([("print", "u8"), ("nth", "i8")])
    left, right = np.empty(len(a), kind), np.empty(len(b), kind)
    left["print"], left["nth"] = first.packet_print[ours][a], a_nth
    right["print"], right["nth"] = second.packet_print[theirs][b], b_nth
    _, in_a, in_b = np.intersect1d(left, right, return_indices=True)
    return ours[a[in_a]], theirs[b[in_b]]


def _difference(
    first: Rows,
    second: Rows,
    key: tuple[int, int],
    ours: NDArray[np.intp],
    theirs: NDArray[np.intp],
    offset: int,
    topic: str | None,
) -> Difference:
    all_ours, all_theirs = _rows(first, *key), _rows(second, *key)
    missing = np.setdiff1d(all_ours, ours)
    extra = np.setdiff1d(all_theirs, theirs)
    # What one capture did not live to see is not lost.
    missing = missing[_during(first.time_ns[missing] + offset, second)]
    extra = extra[_during(second.time_ns[extra] - offset, first)]
    altered = _altered(first, second, missing, extra)
    delay = second.time_ns[theirs] - first.time_ns[ours] - offset
    return Difference(
        link=Link(key[0]),
        msg_id=key[1],
        topic=topic,
        first=len(all_ours),
        second=len(all_theirs),
        same=len(ours),
        lost=len(missing) - altered,
        extra=len(extra) - altered,
        altered=altered,
        late=int((delay > _LATE_NS).sum()),
        latency=summary(delay),
    )


def _during(times: NDArray[np.int64], rows: Rows) -> NDArray[np.bool_]:
    if not len(rows):
        return np.ones(len(times), bool)
    return np.asarray((times >= int(rows.time_ns.min())) & (times <= int(rows.time_ns.max())))


def _altered(first: Rows, second: Rows, missing: NDArray[np.intp], extra: NDArray[np.intp]) -> int:
    """Count packets whose count, or whose values, are in both and whose bytes differ."""
    if not len(missing) or not len(extra):
        return 0
    counted = ~first.has(Finding.SEQUENCE_UNSET)[missing]
    also = ~second.has(Finding.SEQUENCE_UNSET)[extra]
    by_count = len(np.intersect1d(first.sequence_count[missing[counted]], second.sequence_count[extra[also]]))
    values = first.value_print[missing[~counted]], second.value_print[extra[~also]]
    by_value = len(np.intersect1d(*(item[item != 0] for item in values)))
    return by_count + by_value
