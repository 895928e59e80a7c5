"""Two records of the same traffic held against each other, taken at two points of its way.

1. The second's clock is set by the first's, by what both hold (``evidence.clocks``); where nothing tells,
   by equal packets.
2. Packets are the same by their bytes, and by their IP identification where most of a MsgId keep it: each is
   the latest that was not later, as on both sides of a relay in one capture (``evidence.relays``).
3. A host whose packets come later in the second capture sends from the first point to the second; else the
   other way. What the sender's side has and the other lacks is lost, what only the receiver's side has is
   extra; the same packet once more is doubled.
4. What is left on both sides is altered where its sequence count or its values say that it is the same.
5. Sequence counts that neither has were lost before both points.

Of a bag and a capture, or of two bags, messages are compared: equal by the values of their CDR, time stamps
among them, each paired with the latest equal one that was not later. The mission says which way they go.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.cfs.names import message_name
from edoras_tools.decode.spacecraft import FIRST_SPACECRAFT
from edoras_tools.diagnosis.evidence.clocks.alignment import Alignment, Side, align, align_ways
from edoras_tools.diagnosis.evidence.clocks.lines import ClockLine
from edoras_tools.diagnosis.evidence.copies import find_echoes
from edoras_tools.diagnosis.evidence.preparation import prepare
from edoras_tools.diagnosis.evidence.relays import LONGEST_NS, Segment, pair_up
from edoras_tools.diagnosis.evidence.table import Recorder, Rows
from edoras_tools.diagnosis.matching.crossing import Latency, latency_of
from edoras_tools.links import table
from edoras_tools.model import NO_MSG_ID, OTHER, Finding, Link
from edoras_tools.units import MILLISECOND
from edoras_tools.wire.arrays.fingerprint import MIX, matches

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.verdict import Choice
    from edoras_tools.mission import Mission
    from edoras_tools.wire.arrays.order import Integers, Mask, Places

_EARLY_NS: Final = MILLISECOND
"""Clocks of two records are aligned so well at the best."""
_FIGURES: Final = (
    *("first", "second", "same", "lost", "extra", "doubled", "altered", "late", "out_of_order"),
    "neither",
)
_FEW: Final = 0.01
"""A smaller part of the packets is the same by chance."""


class Difference(msgspec.Struct, frozen=True):
    """One MsgId on one link, in both captures.

    Attributes:
        link: the link.
        msg_id: cFE MsgId.
        topic: its configured topic, or None.
        back: it goes from the second point to the first.
        first: packets in the first capture.
        second: packets in the second.
        same: packets of both.
        lost: of the sender's side, not on the other, while the other was capturing.
        extra: of the receiver's side, never seen on the sender's.
        doubled: of the receiver's side, once more.
        altered: the same packet with other bytes.
        late: of the same, those that took more than 100 ms longer than the quickest.
        out_of_order: of the same, those that came behind one that was sent later.
        neither: missing by sequence count in both.
        latency: from one to the other, half the shortest way there and back taken as 0.
        missed: not on the receiver's side, and not lost: the recorder there counted that it missed them.
        spacecraft: whose packets they are, where there are several.
    """

    link: Link
    msg_id: int
    topic: str | None
    back: bool
    first: int
    second: int
    same: int
    lost: int
    extra: int
    doubled: int
    altered: int
    late: int
    out_of_order: int
    neither: int
    latency: Latency | None
    missed: int = 0
    spacecraft: int | None = None

    def turned(self, topic: str | None, *, back: bool) -> Difference:
        """Return it with its topic; with ``back`` its sender's side is the second."""
        first, second = (self.second, self.first) if back else (self.first, self.second)
        return replace(self, topic=topic, back=back, first=first, second=second)

    def as_json(self) -> dict[str, Any]:
        """Return it in the shape of ``doctor --against --json``."""
        packets = self.link is not OTHER
        return {
            "link": self.link.label if packets else None,
            "msg_id": f"0x{self.msg_id:04x}" if packets else None,
            "topic": self.topic,
            "name": message_name(self.msg_id) or None if packets else None,
            "direction": "second to first" if self.back else "first to second",
            **{name: getattr(self, name) for name in _FIGURES},
            "latency": self.latency.as_json() if self.latency else None,
            "missed": self.missed,
            **({} if self.spacecraft is None else {"spacecraft": self.spacecraft}),
        }

    def without(self, missed: int) -> Difference:
        """Return it where the recorder of the second side says that it missed so many messages."""
        missed = 0 if self.back else min(missed, self.lost)
        return replace(self, lost=self.lost - missed, missed=missed)


class CaptureComparison(msgspec.Struct, frozen=True):
    """All differences of two captures.

    Attributes:
        offset_ns: the second's clock minus the first's, at the start.
        drift: by how much more after each ns, in ns; None where that cannot be told.
        common: whether they hold the same traffic: at least one in a hundred packets is the same.
        routes: a row for every MsgId of either.
    """

    offset_ns: int
    drift: float | None
    common: bool
    routes: Sequence[Difference]

    def limited(self, choice: Choice) -> CaptureComparison:
        """Return the routes that are chosen."""
        own = {item.spacecraft: choice.of(item.spacecraft or FIRST_SPACECRAFT) for item in self.routes}
        routes = (item for item in self.routes if own[item.spacecraft].takes(item.link.label, item.msg_id))
        return replace(self, routes=[*routes])

    @property
    def lost(self) -> int:
        """Packets that were lost between the two, both ways."""
        return sum(item.lost for item in self.routes)

    def as_json(self) -> dict[str, Any]:
        """Return it in the shape of ``doctor --against --json``."""
        return {
            "offset_ns": self.offset_ns,
            "drift_ppm": None if self.drift is None else round(self.drift * 1e6, 1),
            "common": self.common,
            "lost": self.lost,
            "routes": [item.as_json() for item in self.routes],
        }


class _Side(msgspec.Struct, frozen=True):
    """One capture: its rows, who sent each, and which of them the network doubled."""

    rows: Rows
    sender: NDArray[np.str_]
    doubled: Places

    def during(self, times: Integers) -> Mask:
        """Tell which times, by its clock, it was capturing at."""
        if not len(self.rows):
            return np.zeros(len(times), bool)
        own = self.rows.time_ns
        return np.asarray((times >= own.min()) & (times <= own.max()))

    def again(self, rows: Places, paired: Places) -> Mask:
        """Tell which rows are doubles: by the network, or of a packet with a count that is paired."""
        same = np.isin(self.rows.packet_print[rows], self.rows.packet_print[paired])
        return np.isin(rows, self.doubled) | (self.rows.counted[rows] & same)


def compare_each(
    first: Mapping[int, Recorder], second: Mapping[int, Recorder], mission: Mission
) -> CaptureComparison:
    """Hold two captures against each other, spacecraft by spacecraft: each has its number."""
    nothing = Recorder(first[FIRST_SPACECRAFT].context)
    results = {
        number: compare_captures(first.get(number, nothing), second.get(number, nothing), mission.of(number))
        for number in sorted({*first, *second})
    }
    if len(results) == 1:
        return results[FIRST_SPACECRAFT]
    best = next((item for item in results.values() if item.common), results[FIRST_SPACECRAFT])
    rows = [replace(row, spacecraft=number) for number, item in results.items() for row in item.routes]
    return replace(best, routes=rows)


def compare_captures(first: Recorder, second: Recorder, mission: Mission) -> CaptureComparison:
    """Hold two captures of one spacecraft against each other."""
    topics: dict[_Key, str] = {(route.link, route.msg_id): route.topic for route in mission.routes}
    sides = _side(first), _side(second)
    fit = align(Side.of(first), Side.of(second))
    line = _line(fit) if fit else ClockLine(0, _equal(*(side.rows for side in sides)))
    keys = sorted({key for side in sides for key in _keys(side.rows)})
    a, b = _identified(sides, keys)
    b = replace(b, rows=replace(b.rows, time_ns=line.set_back(b.rows.time_ns)))
    pairs = {key: _once(a.rows, b.rows, key) for key in keys}
    senders = _back(a, b, list(pairs.values()))
    back = {key: _turned(a, b, key, senders) for key in keys}
    return _compared(a, b, pairs, back, topics, line.offset_ns, fit)


def compare_messages(
    first: Rows, second: Rows, topics: Mapping[_Key, str], ways: Mapping[_Key, bool]
) -> CaptureComparison:
    """Hold the messages of two records against each other.

    Args:
        first: one record; its rows without a MsgId only tell how long it is. ``packet_print`` are messages.
        topics: by link and MsgId the topic of each message.
        ways: of each of these, whether it goes from the second record to the first; by default it comes from
            the record that has more of it, or of equally many has it earlier.
    """
    nobody, nothing = np.zeros(0, np.str_), np.zeros(0, np.intp)
    pairs = {key: _once(first, second, key) for key in topics}
    back = {key: ways.get(key, _likely_back(first, second, key, pair)) for key, pair in pairs.items()}
    which = [np.full(len(pair[0]), back[key]) for key, pair in pairs.items()]
    ours, theirs = (np.concatenate([nothing, *(pair[side] for pair in pairs.values())]) for side in (0, 1))
    turned = np.concatenate([np.zeros(0, np.bool_), *which])
    fit = align_ways(first.time_ns[ours], second.time_ns[theirs], turned)
    line = _line(fit) if fit else ClockLine(0, 0)
    moved = replace(second, time_ns=line.set_back(second.time_ns))
    sides = _Side(first, nobody, nothing), _Side(moved, nobody, nothing)
    return _compared(*sides, pairs, back, topics, line.offset_ns, fit)


def _compared(
    first: _Side,
    second: _Side,
    pairs: Mapping[_Key, _Pair],
    back: Mapping[_Key, bool],
    topics: Mapping[_Key, str],
    offset_ns: int,
    fit: Alignment | None,
) -> CaptureComparison:
    """Join two sides, the second with the times of the first, by the ways that their packets go.

    Args:
        pairs: packets that are there once in each, which tell how far the clocks may be apart still.
    """
    took = [np.zeros(1, np.int64)]
    for key, (ours, theirs) in pairs.items():
        step = second.rows.time_ns[theirs] - first.rows.time_ns[ours]
        took.append(-step if back[key] else step)
    early = np.concatenate(took)
    early_ns = max(_EARLY_NS, -int(early[early >= -LONGEST_NS].min()))
    routes, same = [], 0
    for key, turned in back.items():
        near, far = (second, first) if turned else (first, second)
        sent, came = _rows(near.rows, *key), _rows(far.rows, *key)
        prints = near.rows.packet_print[sent], far.rows.packet_print[came]
        segment = pair_up(prints[0], near.rows.time_ns[sent], prints[1], far.rows.time_ns[came], early_ns)
        same += len(segment.out)
        item = _difference(near, far, key, sent, came, segment)
        routes.append(item.turned(topics.get(key), back=turned))
    both = min(_within(first, second), _within(second, first))
    drift = fit.line.drift if fit is not None and fit.drift is not None else None
    return CaptureComparison(offset_ns, drift, same > _FEW * both, routes)


def _line(fit: Alignment) -> ClockLine:
    """Return how the second clock stands to the first; clocks that may be equal are taken as equal."""
    return ClockLine(0, 0) if fit.low_ns <= 0 <= fit.high_ns else fit.line


def _once(a: Rows, b: Rows, key: _Key) -> _Pair:
    """Return the messages that are there once in each."""
    ours, theirs = _rows(a, *key), _rows(b, *key)
    in_a, in_b = matches(a.packet_print[ours], b.packet_print[theirs])
    return ours[in_a], theirs[in_b]


def _likely_back(a: Rows, b: Rows, key: _Key, pair: _Pair) -> bool:
    """Tell whether messages come from the second, which has more of them, or of equally many earlier."""
    more = len(_rows(b, *key)) - len(_rows(a, *key))
    earlier = (a.time_ns[pair[0]] - b.time_ns[pair[1]]).sum() > 0
    return more > 0 or (not more and bool(earlier))


def _identified(sides: tuple[_Side, _Side], keys: Sequence[_Key]) -> list[_Side]:
    """Return both sides, with the IP identification in fingerprints where it is kept on the way."""
    rows = [side.rows for side in sides]
    plain = [item.packet_print.copy() for item in rows]
    marked = [item.packet_print ^ item.identification * MIX for item in rows]
    for key in keys:
        ours, theirs = (_rows(item, *key) for item in rows)
        alike, unchanged = (np.isin(a[ours], b[theirs]).sum() for a, b in (plain, marked))
        if 2 * unchanged >= alike:
            plain[0][ours], plain[1][theirs] = marked[0][ours], marked[1][theirs]
    return [
        replace(side, rows=replace(item, packet_print=prints))
        for side, item, prints in zip(sides, rows, plain, strict=True)
    ]


def _side(recorder: Recorder) -> _Side:
    prepared = prepare(recorder, {})
    names = np.array([item.address for item in recorder.endpoints] or [""])
    return _Side(prepared.rows, names[prepared.rows.source], prepared.duplicates)


def _within(side: _Side, other: _Side) -> int:
    """Count the packets of one side while the other was capturing."""
    packets = side.rows.msg_id != NO_MSG_ID
    return int(other.during(side.rows.time_ns[packets]).sum())


def _equal(first: Rows, second: Rows) -> int:
    """Return the offset by packets that are there once in each; 0 where there are none."""
    _, ours, theirs = np.intersect1d(first.packet_print, second.packet_print, return_indices=True)
    steps = (second.time_ns[theirs] - first.time_ns[ours])[first.msg_id[ours] != NO_MSG_ID]
    return int(np.median(steps)) if len(steps) else 0


def _keys(rows: Rows) -> list[_Key]:
    packets = rows.msg_id != NO_MSG_ID
    both = np.unique(np.stack((rows.link[packets].astype(np.int64), rows.msg_id[packets])), axis=1)
    return [(int(link), int(msg_id)) for link, msg_id in both.T]


def _rows(rows: Rows, link: int, msg_id: int) -> Places:
    return np.flatnonzero((rows.link == link) & (rows.msg_id == msg_id))


_Key = tuple[int, int]
"""Link and MsgId."""
_Pair = tuple["Places", "Places"]
"""Rows of the first, and the rows of the second that are the same packets."""


def _back(first: _Side, second: _Side, pairs: Sequence[_Pair]) -> dict[str, bool]:
    """Return of each sender whether its packets go from the second point to the first."""
    if not pairs:
        return {}
    ours, theirs = (np.concatenate([pair[side] for pair in pairs]) for side in (0, 1))
    steps = second.rows.time_ns[theirs] - first.rows.time_ns[ours]
    senders = first.sender[ours]
    return {name: float(np.median(steps[senders == name])) < 0 for name in np.unique(senders).tolist()}


def _turned(first: _Side, second: _Side, key: _Key, back: dict[str, bool]) -> bool:
    """Tell whether the packets of a MsgId go from the second point to the first."""
    names = np.concatenate([side.sender[_rows(side.rows, *key)] for side in (first, second)])
    return back.get(str(names[0]), False)


def _difference(
    near: _Side, far: _Side, key: _Key, sent: Places, came: Places, segment: Segment
) -> Difference:
    """Count one MsgId, from the sender's side to the receiver's; equal ones are not timed."""
    ours, theirs = sent[segment.into], came[segment.out]
    # What one capture did not live to see is not lost; it lived to see what is between two that it has.
    longest = max(int(segment.took_ns.max(initial=0)), 0)
    missing = np.setdiff1d(sent, ours)
    sent_ns = near.rows.time_ns[missing]
    visible = far.during(sent_ns) & far.during(sent_ns + longest)
    visible |= np.isin(missing, sent[slice(*np.searchsorted(sent, ours[[0, -1]]))]) if len(ours) else False
    missing = missing[visible & ~near.again(missing, ours)]
    extra = np.setdiff1d(came, theirs)
    extra = extra[near.during(far.rows.time_ns[extra])]
    again = far.again(extra, theirs) | _echoed(near.rows, far.rows, sent, came, extra)
    altered = _altered(near.rows, far.rows, missing, extra[~again])
    values, counts = np.unique(near.rows.packet_print[ours], return_counts=True)
    single = np.isin(near.rows.packet_print[ours], values[counts == 1])
    timed = segment.take(single) if single.any() else segment
    lost, added = len(missing) - altered, int((~again).sum()) - altered
    absent = [int(side.rows.missing[own].sum()) for side, own in ((near, sent), (far, came))]
    return Difference(
        link=table.link(key[0]),
        msg_id=key[1],
        topic=None,
        back=False,
        first=len(sent),
        second=len(came),
        same=len(ours),
        lost=lost,
        extra=added,
        doubled=int(again.sum()),
        altered=altered,
        late=timed.late,
        out_of_order=timed.out_of_order,
        neither=max(0, min(absent[0] - added, absent[1] - lost)),
        latency=latency_of(np.maximum(timed.took_ns, 0)),
    )


def _echoed(near: Rows, far: Rows, sent: Places, came: Places, extra: Places) -> Mask:
    """Tell which of what only the receiver's side has came a short time after an equal one."""
    echo = came[find_echoes(far, came)]
    likely = np.flatnonzero(np.isin(far.packet_print[extra], far.packet_print[echo]))
    out = np.zeros(len(extra), np.bool_)
    out[likely[: max(0, len(echo) - int(find_echoes(near, sent).sum()))]] = True
    return out


def _altered(first: Rows, second: Rows, missing: Places, extra: Places) -> int:
    """Count packets whose count, or whose values, are in both and whose bytes differ."""
    if not len(missing) or not len(extra):
        return 0
    valid = ~first.has(Finding.SEQUENCE_UNSET)[missing]
    also = ~second.has(Finding.SEQUENCE_UNSET)[extra]
    by_count = len(np.intersect1d(first.sequence_count[missing[valid]], second.sequence_count[extra[also]]))
    values = first.value_print[missing[~valid]], second.value_print[extra[~also]]
    by_value = len(np.intersect1d(*(item[item != 0] for item in values)))
    return by_count + by_value
