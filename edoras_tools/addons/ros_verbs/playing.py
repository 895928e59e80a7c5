"""Plays a recording to a ROS 2 graph: its messages, with their quality of service, at their own times.

The sending loop of ``replay`` keeps the times; the graph takes the place of its network. ``/clock`` is sent
with the messages, so the recording's time is as exact as they are.

Messages are those of any source, by topic, as a recording of it would contain them. They have figures, too.

Figures are rate, bandwidth and delay of a topic over its last messages, printed as by ``ros2 topic``.
Times between messages are those of receiving, or of the capture. Bandwidth is the size of all messages of
the window except the first, divided by the time from the first to the last. So no figure depends on the time
of the query.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

import numpy as np
from msgspec.structs import replace

from edoras_tools.addons.ros_verbs.endpoints import recorded_qos
from edoras_tools.errors import CaptureError, ConfigError, EdorasError, RouteError
from edoras_tools.io.net.transmit import Arrival, HostClock, SendStatistics, precise_timing
from edoras_tools.io.topics.messages import RECORD, RECORD_BYTES, lay_out
from edoras_tools.io.topics.streams import OWN_TOPICS, QOS_METADATA, RecordedStreams, Streams, Topic
from edoras_tools.middleware.graph import Qos
from edoras_tools.model import OTHER, Endpoint
from edoras_tools.pipelines.bridge.plan import qos_of
from edoras_tools.pipelines.reading import Keys, Limits, reading
from edoras_tools.pipelines.selection import Period, Selection
from edoras_tools.pipelines.sending.loop import Sending, SendReport, SendSchedule, in_order
from edoras_tools.pipelines.sending.responses import Responses
from edoras_tools.sessions.outgoing import Outgoing
from edoras_tools.sessions.pacing import Pacing
from edoras_tools.units import SECOND
from edoras_tools.wire.arrays import gather
from edoras_tools.words import did_you_mean, listed

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.decode.filters.rows import ColumnRows
    from edoras_tools.io import Source
    from edoras_tools.middleware import Graph
    from edoras_tools.mission import Mission
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.render.terminal.text import Watcher
    from edoras_tools.ros import TypeStore

    Kind = Literal["hz", "bw", "delay"]


OWN_NAMES: Final = frozenset(item.name for item in OWN_TOPICS)
"""Topics about a capture, which are no topics of a graph."""


class MessageBlock(NamedTuple):
    """Messages of one topic in columns with one element for each message.

    Attributes:
        topic: name of the topic.
        type: ROS name.
        time_ns: i64 (n,), time of receiving or capture, ns since 1970.
        published_ns: i64 (n,), time of publishing, if the source has it; else as ``time_ns``.
        sequence: u32 (n,), publisher's number of the message; 0 for none.
        data: u8, buffer of the messages.
        offset: i64 (n,), first byte, encapsulation included.
        length: i64 (n,), size in bytes.
    """

    topic: str
    type: str
    time_ns: NDArray[np.int64]
    published_ns: NDArray[np.int64]
    sequence: NDArray[np.uint32]
    data: NDArray[np.uint8]
    offset: NDArray[np.int64]
    length: NDArray[np.int64]

    def cdr(self, index: int) -> bytes:
        """Return one message."""
        start = int(self.offset[index])
        return self.data[start : start + int(self.length[index])].tobytes()

    def stamps(self, types: TypeStore) -> NDArray[np.int64] | None:
        """Return the time in each message's header, ns since 1970; None if the type begins with no header."""
        fields = types.fields(self.type) if types.has(self.type) else ()
        if not fields or fields[0].type != "std_msgs/msg/Header":
            return None
        parts = gather(self.data, self.offset + 4, 8).copy().view("<u4")  # behind the encapsulation
        big = self.data[self.offset + 1] % 2 == 0
        seconds, rest = np.where(big[:, None], parts.byteswap(), parts).astype(np.int64).T
        return seconds * SECOND + rest


class TopicReader:
    """Returns the messages of a source by topic, batch by batch.

    Attributes:
        topics: topics of the source so far, by their channel.
    """

    def __init__(self, bench: Workbench) -> None:
        mission, context = bench.mission, bench.columns.context
        self._recorded = RecordedStreams(mission, bench.types) if mission.recorded else None
        if self._recorded is None:
            more = {"structs": context.structs, "add": self._add}
            self._streams = Streams(mission, bench.types, datagrams=False, **more)  # type: ignore[arg-type]
            self._streams.endpoints = context.endpoints
        topics = self._recorded.topics if self._recorded else self._streams.topics
        self.topics: dict[int, Topic] = dict(enumerate(topics))

    def blocks(self, rows: ColumnRows, topics: Sequence[str] = ()) -> Iterator[MessageBlock]:
        """Yield the messages of a batch; only those of some topics, if these are named."""
        if not len(rows):
            return
        batch, columns = rows.alone()
        if self._recorded is not None:
            messages = self._recorded.prepared_messages(batch)
        else:
            messages = self._streams.messages(batch, columns, statistics=False)
        records = lay_out(messages, len(batch))
        data = np.frombuffer(records.data, np.uint8)
        for channel in np.unique(records.channel_id).tolist():
            topic = self.topics[channel]
            if topics and topic.name not in topics:
                continue
            own = np.flatnonzero(records.channel_id == channel)
            start, time_ns = records.start[own], records.log_time[own].astype(np.int64)
            heads = gather(data, start - RECORD_BYTES, RECORD_BYTES).copy().view(np.dtype(RECORD))[:, 0]
            published, length = heads["publish_time"].astype(np.int64), records.end[own] - start
            sequence = heads["sequence"]
            yield MessageBlock(topic.name, topic.type, time_ns, published, sequence, data, start, length)

    def check(self, topics: Sequence[str]) -> None:
        """Check at the end that all of some topics had messages.

        Raises:
            RouteError: a topic had none.
        """
        names = [item.name for item in self.topics.values()]
        for topic in topics:
            if topic not in names:
                existing = [name for name in names if name not in OWN_NAMES] or names
                hint = did_you_mean(topic, names, 1) or f"there are {listed(sorted(existing), 12)}"
                raise RouteError(f"no topic is called {topic!r}; {hint}")

    def _add(self, topic: Topic) -> int:
        self.topics[len(self.topics)] = topic
        return len(self.topics) - 1


def read_topics(
    source: Source, bench: Workbench, topics: Sequence[str], where: str = "", duration_ns: int = 0
) -> Iterator[list[MessageBlock]]:
    """Yield the messages of some topics as they arrive, one list for each batch; the source is closed.

    Args:
        where: filter that messages must pass.
        duration_ns: duration of reading a live source, ns; 0: to its end.

    Raises:
        RouteError: a topic is not in the source.
    """
    reader = TopicReader(bench)
    with reading(source, bench, Selection(where=where), Limits(duration_ns=duration_ns)) as loop:
        for rows in loop:
            yield list(reader.blocks(rows, topics))
    reader.check(topics)


def topics_in(source: Source, bench: Workbench, duration_ns: int = 0) -> list[tuple[Topic, str, bool]]:
    """Return the topics of a file or a link; the source is closed.

    Returns:
        Each topic with its publishers' quality of service in rosbag2's notation, and whether it had a
        message.
    """
    reader, published = TopicReader(bench), set[str]()
    with reading(source, bench, limits=Limits(duration_ns=duration_ns)) as loop:
        for rows in loop:
            published |= {block.topic for block in reader.blocks(rows)}
    return [
        (topic, topic.metadata.get(QOS_METADATA, ""), topic.name in published)
        for topic in sorted(reader.topics.values(), key=lambda item: item.name)
        if topic.name in published or topic.name not in OWN_NAMES
    ]


USUAL_WINDOWS: Final = {"hz": 10_000, "bw": 100, "delay": 10_000}
"""Default numbers of messages, as in ``ros2 topic``."""
_UNITS: Final = ((1_000_000, "MB", 2), (1_000, "KB", 2), (1, "B", 0))
_HEAD: Final = ("topic", "rate", "min_delta", "max_delta", "std_dev", "window")


class TopicFigures:
    """The figures of one topic.

    Args:
        kind: kind of figures.
        topic: name of the topic.
        window: number of messages; for rates, number of intervals.
    """

    def __init__(self, kind: Kind, topic: str, window: int) -> None:
        self.kind, self.topic = kind, topic
        self._messages, self._window = 0, window + (kind == "hz")
        self._times = self._values = np.zeros(0, np.int64)

    def add(self, block: MessageBlock, types: TypeStore) -> None:
        """Add messages of the topic.

        Raises:
            ConfigError: the delay is requested, and the messages have no header.
        """
        values = block.length
        if self.kind == "delay":
            stamps = block.stamps(types)
            if stamps is None:
                raise ConfigError(f"{block.topic}: {block.type} has no header: nothing says when it was made")
            values = block.time_ns - stamps
        self._messages += len(values)
        self._times = np.concatenate([self._times, block.time_ns])[-self._window :]
        self._values = np.concatenate([self._values, values])[-self._window :]

    def as_json(self) -> dict[str, Any]:
        """Return the figures in the shape of ``topic.schema.json``."""
        gaps = np.diff(self._times)
        row: dict[str, Any] = {"topic": self.topic, "messages": self._messages}
        if self.kind == "bw":
            size, span_ns = self._values, int(gaps.sum())
            rate = float(size[1:].sum()) * SECOND / span_ns if span_ns > 0 else None
            spread = _spread(size, "bytes")
            del spread["std_dev_bytes"]
            return row | {"window": len(size), "bytes_per_s": rate} | spread
        seconds = (gaps if self.kind == "hz" else self._values) / SECOND
        row |= {"window": len(seconds)} | _spread(seconds, "s")
        if self.kind == "hz":
            row["rate_hz"] = 1 / row["mean_s"] if row["mean_s"] else None
        return row

    def text(self) -> str:
        """Return the output of ``ros2 topic``; empty if there is none yet."""
        row = self.as_json()
        if len(self._values) < (1 if self.kind == "delay" else 2):
            return ""
        if self.kind == "bw":
            rate = row["bytes_per_s"] or 0.0
            size, unit, digits = next((item for item in _UNITS if rate >= item[0]), _UNITS[-1])
            mean, least, most, rate = (
                f"{value / size:.{digits}f} {unit}"
                for value in (row["mean_bytes"], row["min_bytes"], row["max_bytes"], rate)
            )
            start = f"{rate}/s from {row['window']} messages"
            return f"{start}\n\tMessage size mean: {mean} min: {least} max: {most}"
        name, value = ("rate", row["rate_hz"] or 0.0) if self.kind == "hz" else ("delay", row["mean_s"])
        return (
            f"average {name}: {value:.3f}\n\tmin: {row['min_s']:.3f}s max: {row['max_s']:.3f}s "
            f"std dev: {row['std_dev_s']:.5f}s window: {row['window']}"
        )


def _spread(values: NDArray[Any], unit: str) -> dict[str, Any]:
    """Return mean, minimum, maximum and standard deviation; None for no values."""
    names = (f"{name}_{unit}" for name in ("mean", "min", "max", "std_dev"))
    stats = (values.mean(), values.min(), values.max(), values.std()) if len(values) else (None,) * 4
    return {name: None if item is None else float(item) for name, item in zip(names, stats, strict=True)}


def rate_table(figures: Sequence[TopicFigures]) -> str:
    """Return the rates of several topics in the form of ``ros2 topic hz``; empty if there are none."""
    rows = []
    for item in figures:
        entry = item.as_json()
        if item.text():
            parts = (f"{entry[name] or 0:.3f}" for name in ("rate_hz", "min_s", "max_s"))
            rows.append([item.topic, *parts, f"{entry['std_dev_s']:.5f}", str(entry["window"])])
    width = [max(len(row[at]) for row in (_HEAD, *rows)) for at in range(len(_HEAD))]
    head = "   ".join(name.center(size) for name, size in zip(_HEAD, width, strict=True))
    body = ["   ".join(cell.ljust(size) for cell, size in zip(row, width, strict=True)) for row in rows]
    return "\n".join([head, "=" * len(head), *body, ""]) if rows else ""


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
