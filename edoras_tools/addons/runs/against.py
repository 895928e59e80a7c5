"""Compares a capture with another one of the same traffic, or with bags of the ROS side."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from msgspec.structs import replace

from edoras_tools.addons.runs.comparison import CaptureComparison, compare_each, compare_messages
from edoras_tools.decode.spacecraft import FIRST_SPACECRAFT
from edoras_tools.diagnosis.balance import BridgeCount
from edoras_tools.diagnosis.evidence import fingerprint
from edoras_tools.diagnosis.evidence.preparation import prepare
from edoras_tools.diagnosis.evidence.table import Recorder, Rows
from edoras_tools.errors import CaptureError, ConfigError, WireError
from edoras_tools.io.formats.rosbag2.reader import RecordedBlock, Rosbag, open_rosbag
from edoras_tools.model import NO_MSG_ID, OTHER
from edoras_tools.pipelines.doctor.scope import Chosen, Scope
from edoras_tools.pipelines.reading import reading
from edoras_tools.ros.library import full_name
from edoras_tools.wire.arrays import by_value, of_bytes
from edoras_tools.words import listed

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from edoras_tools.io import Source
    from edoras_tools.mission import Mission, Route
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.render.terminal.text import Progress
    from edoras_tools.ros import TypeStore


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
    rows = prepare(recorders[FIRST_SPACECRAFT], {}).rows
    choice = choices.choice()
    comparisons = []
    for path in bags:
        bag = open_rosbag(path)
        topics_there = _topics(bag, {route.topic: route.type for route in bench.mission.routes})
        heard = _rows(bag, topics_there, bench.types)
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
        first_rows, right = _rows(bag, shared, types), _rows(other, theirs, types)
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


def _rows(bag: Rosbag, topics: Mapping[str, str], types: TypeStore) -> Rows:
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
