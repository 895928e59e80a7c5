"""Plays a recording to a ROS 2 graph: its messages, with their quality of service, at their own times.

The sending loop of ``replay`` keeps the times; the graph takes the place of its network. ``/clock`` is sent
with the messages, so the recording's time is as exact as they are.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence  # noqa: TC003  of a NamedTuple
from fnmatch import fnmatchcase
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from msgspec.structs import replace

from edoras_tools.addons.ros_verbs.endpoints import recorded_qos
from edoras_tools.addons.ros_verbs.messages import OWN_NAMES, TopicReader
from edoras_tools.errors import CaptureError, EdorasError
from edoras_tools.io.net.transmit import Arrival, HostClock, SendStatistics, precise_timing
from edoras_tools.io.topics.streams import QOS_METADATA, Topic
from edoras_tools.middleware.graph import Qos
from edoras_tools.model import OTHER, Endpoint
from edoras_tools.pipelines.bridge.plan import qos_of
from edoras_tools.pipelines.reading import Limits, reading
from edoras_tools.pipelines.selection import Period
from edoras_tools.pipelines.sending.loop import Sending, SendReport, SendSchedule, in_order
from edoras_tools.pipelines.sending.responses import Responses
from edoras_tools.sessions.outgoing import Outgoing
from edoras_tools.sessions.pacing import Pacing
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Callable

    from edoras_tools.io import Source
    from edoras_tools.middleware import Graph
    from edoras_tools.mission import Mission
    from edoras_tools.pipelines.reading import Keys
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.render.terminal.text import Watcher

CLOCK: Final = "/clock"
_CLOCK_TYPE: Final = "rosgraph_msgs/msg/Clock"
_MOST_BYTES: Final = 4 << 30
_LINGER_NS: Final = SECOND // 2
"""Time for the retransmissions that reliable subscribers request."""
_STEADY_NS: Final = SECOND // 2
_STEP_S: Final = 0.02


class PlayRequest(NamedTuple):
    """The played part of a recording, and the settings of playing.

    Attributes:
        topics: shell patterns of topics; empty: all.
        rename: a topic of the recording to its name in the graph.
        period: period of the recording.
        speed: factor of the recorded speed.
        clock_hz: rate of publishing the recording's time, Hz; 0: never.
        passes: number of passes; 0: until it is stopped.
        paused: whether to begin paused.
        delay_ns: maximum time to wait for subscriptions, ns.
    """

    topics: Sequence[str] = ()
    rename: Mapping[str, str] = MappingProxyType({})
    period: Period = Period()
    speed: float = 1.0
    clock_hz: float = 0.0
    passes: int = 1
    paused: bool = False
    delay_ns: int = 0


class PlayedTopic(NamedTuple):
    """A topic that is played.

    Attributes:
        topic: name in the graph.
        type: ROS name.
        qos: quality of service of its publisher.
    """

    topic: str
    type: str
    qos: Qos


class LoadedMessages(NamedTuple):
    """The messages to play.

    Attributes:
        out: messages; their route is an index into ``topics``.
        topics: topics in order of their first message.
        notes: notes for the user, one line each.
    """

    out: Outgoing
    topics: Sequence[PlayedTopic]
    notes: Sequence[str]


def load_messages(source: Source, bench: Workbench, request: PlayRequest) -> LoadedMessages:
    """Read all messages to play; the source is closed.

    Raises:
        CaptureError: the source is damaged, or has no message to play.
    """
    reader, played, notes = TopicReader(bench), dict[str, int](), dict[str, None]()
    messages, columns, size = list[bytes](), list[Any](), 0
    with reading(source, bench, limits=Limits(period=request.period)) as loop:
        for rows in loop:
            for block in reader.blocks(rows):
                if not _is_chosen(block.topic, request):
                    continue
                if why := bench.types.check(block.type):
                    notes[f"{block.topic} is left out: {why}"] = None
                    continue
                count = len(block.time_ns)
                messages += map(block.cdr, range(count))
                route = played.setdefault(block.topic, len(played))
                columns.append((block.time_ns, np.full(count, route, np.int16), block.offset + size))
            size += int(rows.batch.length.sum())
            if size > _MOST_BYTES:
                raise CaptureError(
                    f"{source.info.name}: more than 4 GiB to play; select less with --start, --end"
                )
    if not messages:
        reason = ", ".join(notes) or "it has no ROS message that was selected"
        raise CaptureError(f"{source.info.name}: {reason}")
    described, renamed = {topic.name: topic for topic in reader.topics.values()}, request.rename
    topics = [
        PlayedTopic(renamed.get(name, name), described[name].type, _qos(described[name], bench.mission))
        for name in played
    ]
    time_ns, routes, order = (np.concatenate(parts) for parts in zip(*columns, strict=True))
    if request.clock_hz:
        begin, step = int(time_ns.min()), request.speed * SECOND / request.clock_hz
        many = int((int(time_ns.max()) - begin) / step) + 1
        ticks = begin + np.rint(np.arange(many) * step).astype(np.int64)
        for tick in ticks.tolist():
            seconds, rest = divmod(tick, SECOND)
            messages.append(bench.types.encode(_CLOCK_TYPE, {"clock": {"sec": seconds, "nanosec": rest}}))
        time_ns, order = np.concatenate([ticks, time_ns]), np.append(np.full(many, -1), order)
        routes = np.append(np.full(many, len(topics), np.int16), routes)
        messages = messages[-many:] + messages[:-many]
        topics.append(PlayedTopic(CLOCK, _CLOCK_TYPE, Qos()))
    out = replace(Outgoing.bare(OTHER, messages, time_ns), route=routes)
    return LoadedMessages(out.take(np.lexsort((order, time_ns))), topics, [*notes])


def _is_chosen(topic: str, request: PlayRequest) -> bool:
    if topic in OWN_NAMES or topic.startswith("/edoras/") or (topic == CLOCK and request.clock_hz):
        return False  # there must be only one source of time
    return not request.topics or any(fnmatchcase(topic, pattern) for pattern in request.topics)


def _qos(topic: Topic, mission: Mission) -> Qos:
    """Return the quality of service of a topic: the recorded one, or that of the mission."""
    if text := topic.metadata.get(QOS_METADATA):
        return recorded_qos(text)
    route = next((item for item in mission.routes if item.topic == topic.name), None)
    if route is None or mission.recorded:
        return Qos()
    qos = qos_of(route)
    return Qos(qos.reliable is not False, bool(qos.transient_local), qos.depth)


class GraphWire(HostClock):
    """A graph as the sending loop's network: a ``Wire`` that publishes, and receives nothing.

    Args:
        publish: function for each route.
        watched: descriptors that end a wait, e.g. of a keyboard.
    """

    ends = Endpoint("", 0), Endpoint("", 0)

    def __init__(self, publish: Sequence[Callable[[bytes], None]], watched: Sequence[int] = ()) -> None:
        super().__init__(watched)
        self.statistics = SendStatistics()
        self._publish = publish

    def wait(self, until_ns: int) -> bool:
        """Sleep until just before a time, then spin; return early when a key is pressed."""
        if not self.sleep(until_ns):
            return False
        while self.now() < until_ns:
            pass
        return True

    def send(self, out: Outgoing, first: int, last: int) -> int:
        """Publish messages ``first`` up to ``last``, not included; return how many were published."""
        before, errors = self.statistics.sent, self.statistics.errors
        for index in range(first, last):
            try:
                self._publish[int(out.route[index])](out[index])
                self.statistics.sent += 1
            except EdorasError as error:
                errors[str(error)] = errors.get(str(error), 0) + 1
        return self.statistics.sent - before

    def put(self, payload: bytes) -> bool:
        """Publish nothing: there is no session."""
        return not payload

    def receive(self) -> list[Arrival]:
        """Return nothing: there is no subscription."""
        return []


def play(
    loaded: LoadedMessages,
    graph: Graph,
    request: PlayRequest,
    mission: Mission,
    *,
    name: str,
    keys: Keys | None = None,
    watcher: Watcher[SendReport] | None = None,
) -> SendReport:
    """Publish the loaded messages; the graph is closed.

    Args:
        name: name of the graph.

    Raises:
        ConfigError: the graph refuses a topic.
    """
    try:
        publish = [graph.advertise(*item) for item in loaded.topics]
        table = Pacing(speed=request.speed).timetable(loaded.out.time_ns)
        out, passes = in_order(loaded.out, table), request.passes
        total = len(out) * passes or None
        report = SendReport(Responses(mission), total, table.rate_hz, notes=[*loaded.notes])
        _await_subscriptions(graph, loaded.topics, request.delay_ns)
        schedule = SendSchedule(name, out, table, passes=passes, paused=request.paused, linger_ns=_LINGER_NS)
        wire = GraphWire(publish, [keys.fileno()] if keys else ())
        with precise_timing():
            Sending(wire, schedule, report, keys=keys, watcher=watcher).run()
        report.notes += graph.notes()
    finally:
        graph.close()
    return report


def _await_subscriptions(graph: Graph, topics: Sequence[PlayedTopic], most_ns: int) -> None:
    """Wait until subscriptions have matched the publishers, and no further ones come for some time."""
    now = began = since = time.monotonic_ns()
    before: list[int | None] = []
    while now - began < most_ns:
        counts = [graph.subscribers(item.topic) for item in topics]
        if counts != before:
            before, since = counts, now
        if any(counts) and now - since > _STEADY_NS:
            return
        time.sleep(_STEP_S)
        now = time.monotonic_ns()
