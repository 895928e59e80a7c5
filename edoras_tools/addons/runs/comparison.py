"""Compares two records of the same traffic, taken at two points of its way: captures, or bags.

Rules:

1. The clock of the second record is set by packets and times that both contain (``evidence.clocks``); if
   these do not suffice, by equal packets.
2. Packets are the same if their bytes are equal; if most packets of a MsgId keep their IP identification,
   that must be equal too. Each is paired with the latest one that is not later, as on both sides of a relay
   in one capture (``evidence.relays``).
3. A host whose packets come later in the second record sends from the first point to the second; else the
   other way. A packet on the sender's side only is lost; one on the receiver's side only is extra; another
   copy of a packet is doubled.
4. Remaining packets on both sides are altered if their sequence counts or their values are equal.
5. Sequence counts missing in both records were lost in front of both points.

For a bag and a capture, or two bags, messages are compared. They are equal if the values of their CDR are,
including time stamps; each is paired with the latest equal one that is not later. The mission gives their
direction.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.cfs.names import message_name
from edoras_tools.decode.spacecraft import FIRST_SPACECRAFT
from edoras_tools.diagnosis.balance import BridgeCount
from edoras_tools.diagnosis.evidence import fingerprint
from edoras_tools.diagnosis.evidence.clocks.alignment import Alignment, Side, align, align_ways
from edoras_tools.diagnosis.evidence.clocks.lines import ClockLine
from edoras_tools.diagnosis.evidence.copies import find_echoes
from edoras_tools.diagnosis.evidence.preparation import Prepared
from edoras_tools.diagnosis.evidence.relays import LONGEST_NS, pair_up
from edoras_tools.diagnosis.evidence.table import Recorder, Rows
from edoras_tools.diagnosis.matching.crossing import Latency, latency_of
from edoras_tools.errors import CaptureError, ConfigError, WireError
from edoras_tools.io.formats.rosbag2.reader import RecordedBlock, Rosbag, open_rosbag
from edoras_tools.links import table
from edoras_tools.model import NO_MSG_ID, OTHER, Finding, Link
from edoras_tools.pipelines.doctor import Chosen, Scope
from edoras_tools.pipelines.reading import reading
from edoras_tools.ros.library import full_name
from edoras_tools.units import MILLISECOND
from edoras_tools.wire.arrays import MIX, Integers, Mask, Places, by_value, matches, of_bytes
from edoras_tools.words import listed

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.verdict import Choice
    from edoras_tools.io import Source
    from edoras_tools.mission import Mission, Route
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.render.terminal.text import Progress
    from edoras_tools.ros import TypeStore

_EARLY_NS: Final = MILLISECOND
"""Best accuracy of the alignment of two clocks."""
_FIGURES: Final = (
    *("first", "second", "same", "lost", "extra", "doubled", "altered", "late", "out_of_order"),
    "neither",
)
_FEW: Final = 0.01
"""Share of common packets up to which they may be equal by chance."""


class Difference(msgspec.Struct, frozen=True):
    """The differences of one MsgId on one link.

    Attributes:
        link: link.
        msg_id: cFE MsgId.
        topic: configured topic, or None.
        back: whether it goes from the second point to the first.
        first: number of packets in the first capture.
        second: number of packets in the second capture.
        same: number of packets in both.
        lost: packets on the sender's side only, while the other side was capturing.
        extra: packets on the receiver's side only.
        doubled: further copies of packets on the receiver's side.
        altered: packets whose bytes differ between the sides.
        late: packets in both that took more than 100 ms longer than the quickest.
        out_of_order: packets in both that came behind one that was sent later.
        neither: packets missing in both, by sequence count.
        latency: time between the points, if half of the shortest way there and back counts as 0.
        missed: packets not on the receiver's side that its recorder counted as missed; they are not lost.
        spacecraft: number of the spacecraft, if there are several.
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

    def as_json(self) -> dict[str, Any]:
        """Return the differences in the shape of ``doctor --against --json``."""
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
        """Return the differences if the recorder of the second side missed this many messages."""
        missed = 0 if self.back else min(missed, self.lost)
        return replace(self, lost=self.lost - missed, missed=missed)


class CaptureComparison(msgspec.Struct, frozen=True):
    """All differences of two captures.

    Attributes:
        offset_ns: clock of the second minus clock of the first, at the start, ns.
        drift: growth of the offset, ns per ns; None if unknown.
        common: whether both contain the same traffic: at least one in a hundred packets is in both.
        routes: differences of every MsgId in either.
    """

    offset_ns: int
    drift: float | None
    common: bool
    routes: Sequence[Difference]

    def limited(self, choice: Choice) -> CaptureComparison:
        """Return the comparison with the chosen routes only."""
        own = {item.spacecraft: choice.of(item.spacecraft or FIRST_SPACECRAFT) for item in self.routes}
        routes = (item for item in self.routes if own[item.spacecraft].takes(item.link.label, item.msg_id))
        return replace(self, routes=[*routes])

    @property
    def lost(self) -> int:
        """Packets lost between the two points, in both directions."""
        return sum(item.lost for item in self.routes)

    def as_json(self) -> dict[str, Any]:
        """Return the comparison in the shape of ``doctor --against --json``."""
        return {
            "offset_ns": self.offset_ns,
            "drift_ppm": None if self.drift is None else round(self.drift * 1e6, 1),
            "common": self.common,
            "lost": self.lost,
            "routes": [item.as_json() for item in self.routes],
        }


class _Side(msgspec.Struct, frozen=True):
    """One capture: its rows, the sender of each, and the rows that the network doubled."""

    rows: Rows
    sender: NDArray[np.str_]
    doubled: Places

    def during(self, times: Integers) -> Mask:
        """Return which times, by its clock, are within the capture: bool (n,)."""
        if not len(self.rows):
            return np.zeros(len(times), bool)
        own = self.rows.time_ns
        return np.asarray((times >= own.min()) & (times <= own.max()))

    def again(self, rows: Places, paired: Places) -> Mask:
        """Return which rows are copies: doubled by the network, or equal to a paired packet with a count."""
        same = np.isin(self.rows.packet_print[rows], self.rows.packet_print[paired])
        return np.isin(rows, self.doubled) | (self.rows.counted[rows] & same)


def compare_each(
    first: Mapping[int, Recorder], second: Mapping[int, Recorder], mission: Mission
) -> CaptureComparison:
    """Compare two captures, each spacecraft by itself, by its number."""
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
    """Compare two captures of one spacecraft."""
    topics: dict[_Key, str] = {(route.link, route.msg_id): route.topic for route in mission.routes}
    sides = _side(first), _side(second)
    fit = align(Side(first), Side(second))
    line = _line(fit) if fit else ClockLine(0, _equal(*(side.rows for side in sides)))
    keys = sorted({key for side in sides for key in _keys(side.rows)})
    a, b = _identified(sides, keys)
    b = replace(b, rows=replace(b.rows, time_ns=line.set_back(b.rows.time_ns)))
    pairs = {key: _once(a.rows, b.rows, key) for key in keys}
    senders = _back(a, b, list(pairs.values()))
    back: dict[_Key, bool] = {}
    for key in keys:
        names = [side.sender[row] for side in (a, b) for row in _rows(side.rows, *key)[:1]]
        back[key] = senders.get(str(names[0]), False)
    return _compared(a, b, pairs, back, topics, line.offset_ns, fit)


def compare_messages(
    first: Rows, second: Rows, topics: Mapping[_Key, str], ways: Mapping[_Key, bool]
) -> CaptureComparison:
    """Compare the messages of two records.

    Args:
        first: first record; its rows without a MsgId only show its duration. ``packet_print`` identifies
            messages.
        topics: link and MsgId to the topic of a message.
        ways: link and MsgId to whether the message goes from the second record to the first; by default it
            comes from the record with more such messages, or, if both have the same number, with earlier
            ones.
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
    """Compare two sides, the second with times on the clock of the first, in the directions of their packets.

    Args:
        pairs: packets that each side has once; they bound the remaining difference of the clocks.
    """
    took = [np.zeros(1, np.int64)]
    for key, (ours, theirs) in pairs.items():
        step = second.rows.time_ns[theirs] - first.rows.time_ns[ours]
        took.append(-step if back[key] else step)
    early = np.concatenate(took)
    early_ns = max(_EARLY_NS, -int(early[early >= -LONGEST_NS].min()))
    sides = first, second
    routes = [_difference(sides, key, topics.get(key), early_ns, back=turned) for key, turned in back.items()]
    same, both = sum(item.same for item in routes), min(_within(first, second), _within(second, first))
    drift = fit.line.drift if fit is not None and fit.drift is not None else None
    return CaptureComparison(offset_ns, drift, same > _FEW * both, routes)


def _line(fit: Alignment) -> ClockLine:
    """Return the line of the second clock over the first; clocks that may be equal are taken as equal."""
    return ClockLine(0, 0) if fit.low_ns <= 0 <= fit.high_ns else fit.line


def _once(a: Rows, b: Rows, key: _Key) -> _Pair:
    """Return the messages that both records have once."""
    ours, theirs = _rows(a, *key), _rows(b, *key)
    in_a, in_b = matches(a.packet_print[ours], b.packet_print[theirs])
    return ours[in_a], theirs[in_b]


def _likely_back(a: Rows, b: Rows, key: _Key, pair: _Pair) -> bool:
    """Return whether messages come from the second record: it has more, or the same number but earlier."""
    more = len(_rows(b, *key)) - len(_rows(a, *key))
    earlier = (a.time_ns[pair[0]] - b.time_ns[pair[1]]).sum() > 0
    return more > 0 or (not more and bool(earlier))


def _identified(sides: tuple[_Side, _Side], keys: Sequence[_Key]) -> list[_Side]:
    """Return both sides, with the IP identification in fingerprints if it is kept on the way."""
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
    prepared = Prepared(recorder, {})
    names = np.array([item.address for item in recorder.endpoints] or [""])
    return _Side(prepared.rows, names[prepared.rows.source], prepared.duplicates)


def _within(side: _Side, other: _Side) -> int:
    """Count the packets of one side while the other was capturing."""
    packets = side.rows.msg_id != NO_MSG_ID
    return int(other.during(side.rows.time_ns[packets]).sum())


def _equal(first: Rows, second: Rows) -> int:
    """Return the offset by packets that both records have once, ns; 0 if there are none."""
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
"""Rows of the first side, and the rows of the second side with the same packets."""


def _back(first: _Side, second: _Side, pairs: Sequence[_Pair]) -> dict[str, bool]:
    """Return for each sender whether its packets go from the second point to the first."""
    if not pairs:
        return {}
    ours, theirs = (np.concatenate([pair[side] for pair in pairs]) for side in (0, 1))
    steps = second.rows.time_ns[theirs] - first.rows.time_ns[ours]
    senders = first.sender[ours]
    return {name: float(np.median(steps[senders == name])) < 0 for name in np.unique(senders).tolist()}


def _difference(
    sides: tuple[_Side, _Side], key: _Key, topic: str | None, early_ns: int, *, back: bool
) -> Difference:
    """Count the differences of one MsgId between the sides; packets with equal copies are not timed."""
    near, far = sides[::-1] if back else sides
    sent, came = _rows(near.rows, *key), _rows(far.rows, *key)
    prints = near.rows.packet_print[sent], far.rows.packet_print[came]
    segment = pair_up(prints[0], near.rows.time_ns[sent], prints[1], far.rows.time_ns[came], early_ns)
    ours, theirs = sent[segment.into], came[segment.out]
    # A packet is not lost if the far capture had ended. It covers everything between two packets that it has.
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
        topic=topic,
        back=back,
        first=len(came if back else sent),
        second=len(sent if back else came),
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
    """Return which packets on the receiver's side only came shortly after an equal one: bool (n,)."""
    echo = came[find_echoes(far, came)]
    likely = np.flatnonzero(np.isin(far.packet_print[extra], far.packet_print[echo]))
    out = np.zeros(len(extra), np.bool_)
    out[likely[: max(0, len(echo) - int(find_echoes(near, sent).sum()))]] = True
    return out


def _altered(first: Rows, second: Rows, missing: Places, extra: Places) -> int:
    """Return the number of packets with equal count, or equal values, on both sides, but different bytes."""
    if not len(missing) or not len(extra):
        return 0
    valid = ~first.has(Finding.SEQUENCE_UNSET)[missing]
    also = ~second.has(Finding.SEQUENCE_UNSET)[extra]
    by_count = len(np.intersect1d(first.sequence_count[missing[valid]], second.sequence_count[extra[also]]))
    values = first.value_print[missing[~valid]], second.value_print[extra[~also]]
    by_value = len(np.intersect1d(*(item[item != 0] for item in values)))
    return by_count + by_value


def diff(
    first: Source,
    second: Source,
    bench: Workbench,
    scope: Scope | None = None,
    progress: Progress | None = None,
) -> CaptureComparison:
    """Read two sources to their ends and compare them.

    Args:
        first: the capture at one point.
        second: the capture at the other point.
        bench: workbench that decodes both.
        scope: period of the first capture that is compared, and routes that are shown.
        progress: shows the progress of reading.

    Raises:
        CaptureError: one of them cannot be read to its end.
        RouteError: the scope names a topic that is not configured.
        ConfigError: its filter has an error.
    """
    scope = scope or Scope()
    choices = Chosen(scope.selection, bench)
    recorders = (
        read_capture(first, bench, scope, choices, progress),
        read_capture(second, bench, Scope(), choices, progress),
    )
    comparison, choice = compare_each(*recorders, bench.mission), choices.choice()
    return comparison if choice is None else comparison.limited(choice)


def read_capture(
    source: Source, bench: Workbench, scope: Scope, choices: Chosen, progress: Progress | None
) -> dict[int, Recorder]:
    """Read a source to its end; return one recorder for each spacecraft, by its number; see ``diff``."""
    context = bench.columns.context
    recorders = {FIRST_SPACECRAFT: Recorder(context)}
    with reading(source, bench, examined=scope.period) as loop:
        for rows in loop:
            for number, own in by_value(rows.columns.spacecraft):
                batch, columns = rows.batch, rows.columns
                if len(own) < len(batch):
                    batch, columns = batch.take(own), columns.take(own)
                if number not in recorders:
                    recorders[number] = Recorder(context.of(number))
                recorders[number].add(batch, columns)
            choices.add(rows.batch, rows.columns)
            if progress is not None:
                progress.read(source)
    return recorders


_ENCAPSULATION: Final = 4
_ALIKE: Final = 0.5
_OBSERVED: Final = "edoras_msgs/msg/GraphEndpoints"
_EVENTS: Final = "rosbag2_interfaces/msg/MessagesLostEvent"


class BagComparison(NamedTuple):
    """The comparison of a bag with a capture, or with the first bag.

    Attributes:
        bag: path of the bag.
        comparison: differences; the bag is the second of the two.
        left_out: number of messages that do not fit their type, so are not compared.
    """

    bag: Path
    comparison: CaptureComparison
    left_out: int

    def as_json(self) -> dict[str, Any]:
        """Return the comparison in the shape of ``doctor --bag --json``."""
        return {"bag": str(self.bag), **self.comparison.as_json(), "left_out": self.left_out}


def against_capture(
    source: Source, bags: Sequence[Path], bench: Workbench, scope: Scope, progress: Progress | None = None
) -> list[BagComparison]:
    """Compare bags with a capture, by the topics of a mission.

    Args:
        source: capture; it is read to its end.
        bags: rosbag2 folders, ``.db3`` files or any MCAP.
        bench: decodes the capture; routes of its mission are compared, with several spacecraft those of the
            first.
        scope: period of the capture that is compared, and routes that are shown.
        progress: shows the progress of reading.

    Raises:
        ConfigError: the mission has no routes.
        CaptureError: a bag cannot be read, or has nothing that can be compared.
    """
    if not bench.mission.routes:
        source.close()
        raise ConfigError(
            "--bag needs a mission that says which topic is which packet: name its files with -c"
        )
    choices = Chosen(scope.selection, bench)
    recorders = read_capture(source, bench, scope, choices, progress)
    rows = Prepared(recorders[FIRST_SPACECRAFT], {}).rows
    choice = choices.choice()
    comparisons = []
    for path in bags:
        bag = open_rosbag(path)
        topics_there = _topics(bag, {route.topic: route.type for route in bench.mission.routes})
        heard = _message_rows(bag, topics_there, bench.types)
        routes = [
            _carried(rows, heard, bench.mission, place, topic) for place, topic in enumerate(topics_there)
        ]
        keys = [(int(route.link), route.msg_id) for route in routes]
        link, msg_id = (np.array(column)[heard.msg_id] for column in zip(*keys, strict=True))
        typed = heard.msg_id != NO_MSG_ID
        heard = replace(heard, link=link, msg_id=np.where(typed, msg_id, NO_MSG_ID))
        routed = np.any([_of(rows, *key) for key in keys], axis=0)
        message = routed & (rows.stamped_print != 0)
        sent = replace(
            rows,
            msg_id=np.where(message, rows.msg_id, NO_MSG_ID),
            packet_print=rows.stamped_print,
            missing=np.zeros_like(rows.missing),
        )
        ways = {key: route.to_cfs for key, route in zip(keys, routes, strict=True)}
        compared = compare_messages(sent, heard, dict(zip(keys, topics_there, strict=True)), ways)
        left_out = int((~typed).sum()) + int((routed & ~message).sum())
        missed = missed_by(bag, bench.types)
        differences = [item.without(missed.get(item.topic or "", 0)) for item in compared.routes]
        item = BagComparison(path, replace(compared, routes=differences), left_out)
        _has_something_in_common(item, source.info.name)
        comparisons.append(item._replace(comparison=item.comparison.limited(choice)) if choice else item)
    return comparisons


def missed_by(bag: Rosbag, types: TypeStore) -> dict[str, int]:
    """Return the number of messages of each topic that a bag's recorder reports as missed.

    ``edoras observe`` reports it on its own topic; rosbag2 reports it in events, each since the previous one.
    """
    missed: dict[str, int] = {}
    latest: Sequence[Mapping[str, Any]] = ()
    topics = {topic: kind for topic, kind in bag.topics().items() if kind in {_OBSERVED, _EVENTS}}
    for message in bag.messages(topics):
        with suppress(WireError):
            values = types.decode(message.type, message.cdr)
            latest = values.get("endpoints", latest)
            for item in values.get("messages_lost_statistics", ()):
                number = item["messages_lost_in_transport"] + item["messages_lost_in_recorder"]
                missed[item["topic_name"]] = missed.get(item["topic_name"], 0) + number
    for topic in {item["topic"] for item in latest}:  # losses of its middleware are among the missing numbers
        own = [item for item in latest if item["topic"] == topic]
        missed[topic] = max(sum(item[name] for item in own) for name in ("missed", "lost"))
    return missed


def bridge_counts(comparisons: Iterable[BagComparison]) -> dict[tuple[str, int], BridgeCount]:
    """Return the counts inside the bridges from bags, by link label and MsgId; the first bag that has one."""
    counts: dict[tuple[str, int], BridgeCount] = {}
    for item in comparisons:
        for route in item.comparison.routes:
            came = route.same + route.lost + route.missed
            count = BridgeCount(came, route.lost, str(item.bag), route.missed)
            counts.setdefault((route.link.label, route.msg_id), count)
    return counts


def _carried(rows: Rows, heard: Rows, mission: Mission, place: int, topic: str) -> Route:
    """Return the route of a topic; of several, the one whose messages are most similar to a bag's."""
    own = np.unique(heard.packet_print[heard.msg_id == place])
    routes = [route for route in mission.routes if route.topic == topic]

    def alike(route: Route) -> float:
        crossed = np.unique(rows.stamped_print[_of(rows, int(route.link), route.msg_id)])
        common = np.isin(own, crossed).sum()
        return float(common / max(len(own) + len(crossed) - common, 1))

    return max(routes, key=alike)


def _of(rows: Rows, link: int, msg_id: int) -> NDArray[np.bool_]:
    return np.asarray((rows.link == link) & (rows.msg_id == msg_id))


def against_bag(first: Path, others: Sequence[Path], types: TypeStore) -> list[BagComparison]:
    """Compare bags with a first one: by topics of one name, else of one type with the same messages.

    Raises:
        CaptureError: a bag cannot be read, or has nothing that can be compared.
    """
    bag, comparisons = open_rosbag(first), []
    ours = bag.topics()
    for path in others:
        other = open_rosbag(path)
        theirs = {topic: kind for topic, kind in other.topics().items() if kind in ours.values()}
        shared = {topic: kind for topic, kind in ours.items() if kind in theirs.values()}
        if not shared:
            raise CaptureError(f"{path}: has no topic of a type that {first} has, as {_some(ours.values())}")
        first_rows, right = _message_rows(bag, shared, types), _message_rows(other, theirs, types)
        names: dict[tuple[int, int], str] = {}
        moved = np.full(len(right), NO_MSG_ID)
        for number, (topic, kind) in enumerate(theirs.items()):
            alike = {item: place for place, (item, own) in enumerate(shared.items()) if own == kind}
            same = topic if topic in alike else _most_alike(first_rows, right, alike, number)
            if same and (key := (int(OTHER), alike[same])) not in names:
                names[key] = topic if same == topic else f"{same}, {topic}"
                moved[right.msg_id == number] = key[1]
        compared = compare_messages(first_rows, replace(right, msg_id=moved), names, {})
        left_out = sum(int((side.msg_id == NO_MSG_ID).sum()) for side in (first_rows, right))
        item = BagComparison(path, compared, left_out)
        _has_something_in_common(item, str(first))
        comparisons.append(item)
    return comparisons


def _most_alike(ours: Rows, right: Rows, topics: Mapping[str, int], number: int) -> str | None:
    """Return the first bag's topic that has most messages of a topic of the second, at least half of them."""
    own = np.unique(right.packet_print[right.msg_id == number])
    share = {
        topic: float(np.isin(own, ours.packet_print[ours.msg_id == place]).sum() / max(len(own), 1))
        for topic, place in topics.items()
    }
    best = max(share, key=share.__getitem__)
    return best if share[best] >= _ALIKE else None


def _topics(bag: Rosbag, selection: Mapping[str, str]) -> dict[str, str]:
    """Return the requested topics of a bag, with their types.

    Raises:
        CaptureError: there is none, or its type differs.
    """
    topics = bag.topics()
    matches = {topic: kind for topic, kind in topics.items() if topic in selection}
    if not matches:
        has = f"it has {_some(topics)}" if topics else "it is empty"
        raise CaptureError(f"{bag.path}: has none of the topics {_some(selection)}; {has}")
    for topic, kind in matches.items():
        if full_name(kind) != full_name(selection[topic]):
            raise CaptureError(f"{bag.path}: {topic} is {kind}, and {selection[topic]} is wanted there")
    return matches


def _message_rows(bag: Rosbag, topics: Mapping[str, str], types: TypeStore) -> Rows:
    """Return the messages of some topics in the order of recording, without a link.

    MsgIds are indices into ``topics``; a message that does not fit its type has none.

    Raises:
        CaptureError: the bag is damaged, or has no message on the topics.
    """
    parts: list[tuple[NDArray[Any], ...]] = []
    places = {topic: place for place, topic in enumerate(topics)}
    for block in bag.blocks(topics):
        plain, stamped = _fingerprints(block, topics[block.topic], types)
        parts.append((block.time_ns, np.where(stamped, places[block.topic], NO_MSG_ID), stamped, plain))
    if not parts:
        raise CaptureError(f"{bag.path}: has no message on its topics {_some(topics)}")
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    order = np.argsort(columns[0], kind="stable")
    time_ns, msg_id, packet_print, value_print = (column[order] for column in columns)
    return Rows.of_messages(
        time_ns=time_ns, msg_id=msg_id, packet_print=packet_print, value_print=value_print
    )


def _fingerprints(block: RecordedBlock, kind: str, types: TypeStore) -> tuple[Any, Any]:
    """Return the fingerprints that ``Recorder`` computes for the same messages in packets."""
    if types.has(kind):
        return fingerprint.of_values(types, kind, block.data, block.offset, block.length)
    body = of_bytes(block.data, block.offset + _ENCAPSULATION, np.maximum(block.length - _ENCAPSULATION, 0))
    return body, body


def _some(names: Iterable[str]) -> str:
    return listed(sorted(set(names)))


def _has_something_in_common(item: BagComparison, other: str) -> None:
    if not item.comparison.common:
        raise CaptureError(
            f"{item.bag}: no message in common with {other}; name a bag that was recorded beside it"
        )
