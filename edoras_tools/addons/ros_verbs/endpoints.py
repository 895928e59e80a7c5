"""Endpoints of a ROS 2 graph, their quality of service, and the mismatches between them.

A subscription matches a publisher that offers at least the requested policies (DDS 1.4, 2.2.3).

A ROS 2 graph is also a live source: its rows are messages, like those of a recording without datagrams.
Rules:

1. A topic is subscribed to with the strongest policies that all its publishers offer: no publisher is left
   out, and none is delayed by more than it offered.
2. A publisher numbers its messages. Numbers missing between two of its messages were published and not
   received here. If the middleware does not give the publisher of a message, it is the topic's only
   publisher; messages of several such publishers are counted together, without numbers.
3. Once a second a separate row has the counts of each endpoint, on ``/edoras/graph``.
"""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from threading import Event
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol

import msgspec
import numpy as np
import yaml

from edoras_tools import doors
from edoras_tools.errors import ConfigError, OnFailure
from edoras_tools.io import SourceDefaults
from edoras_tools.io.formats.mcap.messages import SelectedMessages
from edoras_tools.io.formats.rosbag2.reader import message_batch
from edoras_tools.io.topics.streams import QOS_METADATA
from edoras_tools.middleware.graph import Qos, middleware
from edoras_tools.mission.model import RecordedTopic
from edoras_tools.model import PacketBatch, SourceInfo, SourceStatistics
from edoras_tools.pipelines.messages import message_bench
from edoras_tools.ros import TypeStore
from edoras_tools.sessions.pacing import Lateness
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from edoras_tools.pipelines.workbench import Settings, Workbench

    Heard = Callable[[bytes, int, int, int, str], None]
    """Function of a message's CDR, its times of receiving and publishing (ns since 1970), its number from
    the publisher,
        and the publisher's ``gid``. A value that the middleware does not give is 0, or empty."""


FOREVER_NS: Final = (1 << 63) - 1
DEPTH: Final = 1000
"""Messages that an observer keeps until its thread wakes up."""
_OFFERS: Final = {
    "Reliability": ("BEST_EFFORT", "RELIABLE"),
    "Durability": ("VOLATILE", "TRANSIENT_LOCAL", "TRANSIENT", "PERSISTENT"),
    "Liveliness": ("AUTOMATIC", "MANUAL_BY_PARTICIPANT", "MANUAL_BY_TOPIC"),
}
"""Policy to its values, in ascending order of the offer."""
_SPANS: Final = ("Deadline", "Liveliness lease duration")
_HISTORY: Final = "History (Depth)"
_ORDER: Final = ("Reliability", _HISTORY, "Durability", "Lifespan", "Deadline", "Liveliness", _SPANS[1])


def policies_text(policies: Mapping[str, Any]) -> str:
    """Return policies as ``ros2 topic info -v`` prints them."""
    texts = {name: "Infinite" if value == FOREVER_NS else value for name, value in policies.items()}
    return "\n".join(["QoS profile:", *(f"  {name}: {texts[name]}" for name in _ORDER if name in texts)])


class GraphEndpoint(NamedTuple):
    """A publisher or subscription.

    Attributes:
        topic: fully qualified name.
        type: ROS name.
        publishes: whether it is a publisher; else it is a subscription.
        gid: 16 bytes, as hexadecimal digits.
        node: node with its namespace; empty if unknown.
        policies: quality of service, by the names that ``ros2 topic info -v`` prints; times in ns.
        type_hash: type hash; empty if unknown.
        own: whether it belongs to the observer itself.
    """

    topic: str
    type: str
    publishes: bool
    gid: str
    node: str
    policies: Mapping[str, Any]
    type_hash: str
    own: bool

    def text(self) -> str:
        """Return the endpoint in the form of ``ros2 topic info -v``."""
        namespace, _, name = self.node.rpartition("/")
        lines = {
            "Node name": name or "_NODE_NAME_UNKNOWN_",
            "Node namespace": (namespace or "/") if name else "_NODE_NAMESPACE_UNKNOWN_",
            "Topic type": self.type,
            "Topic type hash": self.type_hash or "INVALID",
            "Endpoint type": "PUBLISHER" if self.publishes else "SUBSCRIPTION",
            "GID": bytes.fromhex(self.gid).hex("."),
        }
        texts = (f"{name}: {value}" for name, value in lines.items())
        return "\n".join([*texts, policies_text(self.policies)])

    def as_json(self) -> dict[str, Any]:
        """Return the endpoint in the shape of ``observe --json``."""
        base = {"node": self.node or None, "gid": self.gid, "type": self.type}
        ranked = {name.lower(): self.policies[name].lower() for name in _OFFERS}
        deadline_ns = self.policies["Deadline"]
        return {**base, **ranked, "deadline_ns": None if deadline_ns == FOREVER_NS else deadline_ns}


class GraphObserver(Protocol):
    """A node that observes a graph: its endpoints, and the metadata of each message."""

    def described(self) -> list[dict[str, Any]]:
        """Return the endpoints of all ROS topics, including its own: fields of ``GraphEndpoint``."""

    def observe(self, topic: str, type_name: str, qos: Qos, heard: Heard) -> None:
        """Call ``heard`` for each message of a topic, on a thread of the middleware: it must not block.

        Raises:
            ConfigError: the type is unknown, or the middleware refuses the topic.
        """

    def lost(self) -> Mapping[str, int]:
        """Return the number of messages that the middleware has counted as lost so far, by topic."""

    def close(self) -> None:
        """Leave the graph."""


def open_observer(
    ros: str, types: TypeStore, node: str, domain: int, options: Mapping[str, str]
) -> GraphObserver:
    """Join a graph to observe it.

    Raises:
        ConfigError: there is no observer for this middleware, its library is not installed, or it refuses.
    """
    if ros not in {"dds", "rclpy"}:
        raise ConfigError(f"--ros {ros} tells nothing of endpoints; there are dds and rclpy")
    own = f"{__package__}.rclpy_node:rclpy_observer"
    try:
        make = doors.part("dds_observer") if ros == "dds" else doors.imported(own)
        observer: GraphObserver = make(types, node, domain=domain, options=options)
    except ImportError as error:
        why = str(error).partition("\n")[0]
        raise ConfigError(f"--ros {ros} needs {middleware(ros).needs.format(why=why)}") from error
    return observer


def endpoints_of(observer: GraphObserver) -> list[GraphEndpoint]:
    """Return the endpoints that an observer sees, by topic."""
    items = (GraphEndpoint(**item) for item in observer.described())
    return sorted(items, key=lambda item: (item.topic, not item.publishes, item.node, item.gid))


def fitting_qos(publishers: Iterable[GraphEndpoint], depth: int = DEPTH) -> Qos:
    """Return the strongest quality of service with which a subscription matches all publishers of a topic."""
    offers = [item.policies for item in publishers]
    reliable = all(item["Reliability"] == "RELIABLE" for item in offers)
    return Qos(reliable, all(item["Durability"] != "VOLATILE" for item in offers), depth)


def mismatches(endpoints: Sequence[GraphEndpoint]) -> list[tuple[GraphEndpoint, GraphEndpoint, list[str]]]:
    """Return the pairs of publishers and subscriptions of one topic that do not match, with the policies."""
    pairs = (
        (publisher, subscription, _refused(publisher.policies, subscription.policies))
        for publisher in endpoints
        if publisher.publishes
        for subscription in endpoints
        if not subscription.publishes
    )
    return [pair for pair in pairs if pair[2]]


def _refused(offer: Mapping[str, Any], wish: Mapping[str, Any]) -> list[str]:
    """Return the policies of which a subscription requests more than a publisher offers."""

    def less(name: str) -> bool:
        order = _OFFERS[name]
        return order.index(offer[name]) < order.index(wish[name])

    ranked = (name for name in _OFFERS if {offer[name], wish[name]} <= {*_OFFERS[name]})
    names = [*filter(less, ranked), *(name for name in _SPANS if offer[name] > wish[name])]
    return [name.lower() for name in names]


def recorded_text(policies: Mapping[str, Any]) -> str:
    """Return the quality of service of a publisher in rosbag2's notation."""
    history, _, depth = policies[_HISTORY].lower().partition(" (")
    values = {"history": history, "depth": int(depth.rstrip(")") or 0)}
    values |= {name.lower(): policies[name].lower() for name in _OFFERS}
    for name in ("Lifespan", *_SPANS):
        seconds, rest = divmod(policies[name], SECOND)
        values[name.lower().replace(" ", "_")] = {"sec": seconds, "nsec": rest}
    return yaml.safe_dump([{**values, "avoid_ros_namespace_conventions": False}], sort_keys=False)


def recorded_policies(text: str) -> list[dict[str, str]]:
    """Return the policies of a topic's publishers from rosbag2's notation, by name or by number."""

    def read(item: Mapping[str, Any], name: str, *values: str) -> str:
        value = item.get(name, 1)
        return values[value - 1] if value in range(1, len(values) + 1) else str(value).upper()

    try:
        return [
            {
                "Reliability": read(item, "reliability", "RELIABLE", "BEST_EFFORT"),
                _HISTORY: f"{read(item, 'history', 'KEEP_LAST', 'KEEP_ALL')} ({int(item.get('depth', 0))})",
                "Durability": read(item, "durability", "TRANSIENT_LOCAL", "VOLATILE"),
            }
            for item in yaml.safe_load(text) or ()
        ]
    except (yaml.YAMLError, AttributeError, TypeError, ValueError):
        return []


def recorded_qos(text: str) -> Qos:
    """Return the quality of service of a topic's publishers; see ``recorded_policies``."""
    offers = recorded_policies(text)
    kinds = [item[_HISTORY].partition(" (") for item in offers]
    depth = max([int(depth.rstrip(")")) for _, _, depth in kinds], default=0) or Qos().depth
    return Qos(
        all(item["Reliability"] != "BEST_EFFORT" for item in offers),
        any(item["Durability"] == "TRANSIENT_LOCAL" for item in offers),
        0 if any(kind == "KEEP_ALL" for kind, _, _ in kinds) else depth,
    )


GRAPH_TOPIC: Final = "/edoras/graph"
_GRAPH_TYPE: Final = "edoras_msgs/msg/GraphEndpoints"
NODE: Final = f"_edoras_{os.getpid()}"
"""Hidden name of the node, like that of a tool of ros2cli."""
_DISCOVERY_S: Final = 1.5
"""Time for discovery by multicast, which takes some tenths of a second, s."""
_STEP_S: Final = 0.05
_GATHER_S: Final = 0.06
_OWN_TOPICS: Final = ("/rosout", "/parameter_events")
"""Topics of every ROS 2 node; they are observed only if they are named."""

_ENTRY: Final[Mapping[str, Any]] = {
    **dict.fromkeys(("node", "gid", "reliability", "durability"), ""),
    **dict.fromkeys(("received", "first_sequence", "last_sequence", "missed"), 0),
    "observer": False,
    "incompatible": [],
}
"""Fields of ``edoras_msgs/msg/GraphEndpoint`` that describe an endpoint, with their default values."""
_Row = tuple[int, bytes, int, int, int, str]


class EndpointCount(msgspec.Struct):
    """The messages received from one publisher.

    Attributes:
        first: number of the first message; 0 for none.
        last: number of the last message.
        missed: missing numbers between the two.
        delay: time from publishing to receiving, by the clocks of both hosts.
    """

    received: int = 0
    first: int = 0
    last: int = 0
    missed: int = 0
    delay: Lateness = msgspec.field(default_factory=Lateness)

    def add(self, sequence: int, delay_ns: int | None) -> None:
        """Count a message: its number, 0 for none, and its delay."""
        self.received += 1
        if delay_ns is not None:
            self.delay.add(delay_ns)
        if sequence:
            self.missed += sequence - self.last - 1 if self.last else 0
            self.first, self.last = self.first or sequence, sequence

    def as_json(self) -> dict[str, Any]:
        """Return the counts in the shape of ``observe --json``; without numbers if messages have none."""
        numbers = (self.first, self.last, self.missed) if self.first else (None, None, None)
        names = ("first_sequence", "last_sequence", "missed")
        delay = {"delay_us": self.delay.summary()}
        return {"received": self.received, **dict(zip(names, numbers, strict=True)), **delay}


class GraphSource(SourceDefaults):
    """Observes topics of a graph.

    Args:
        topics: observed topics, with their types.
        qos: quality of service by topic.
        name: name of the graph.

    Attributes:
        info: info of kind ``topics``.
        statistics: statistics; ``datagrams`` counts the messages.
        counts: counts by topic and publisher's ``gid``; an unknown ``gid`` is empty.
        endpoints: endpoints of the observed topics in the last second.
        publishers: all publishers so far, by ``gid``.
        lost: lost messages by topic, as far as the middleware counts them.
        topics: observed topics, with their types.
    """

    def __init__(
        self,
        observer: GraphObserver,
        types: TypeStore,
        topics: Mapping[str, str],
        qos: Mapping[str, Qos],
        name: str,
    ) -> None:
        self.info, self.statistics = SourceInfo(name, "topics"), SourceStatistics()
        self.counts: dict[tuple[str, str], EndpointCount] = {}
        self.endpoints: list[GraphEndpoint] = []
        self.publishers: dict[str, GraphEndpoint] = {}
        self.lost: Mapping[str, int] = {}
        self.topics = topics
        self._observer, self._types, self._names = observer, types, list(topics)
        self._rows: deque[_Row] = deque()
        self._only: dict[str, str] = {}
        self._stopping, self._number = Event(), 1
        self._look()
        for number, (topic, type_name) in enumerate(topics.items()):
            observer.observe(topic, type_name, qos[topic], self._slot(number))

    @property
    def live(self) -> bool:
        """Always true: a graph has no end."""
        return True

    def stop(self) -> None:
        """Let the batches end after the arrived messages."""
        self._stopping.set()

    def batches(self) -> Iterator[PacketBatch]:
        """Yield the messages as they come."""
        due, ends = time.monotonic_ns() + SECOND, False
        while not ends:
            ends = self._stopping.wait(_GATHER_S)
            rows = [self._rows.popleft() for _ in range(len(self._rows))]
            for row in rows:
                self._count(row)
            if ends or time.monotonic_ns() >= due:
                due += SECOND
                self._look()
                rows.append(self._report())
            yield self._batch(rows)

    def close(self) -> None:
        """Leave the graph."""
        self._observer.close()

    def _slot(self, number: int) -> Callable[[bytes, int, int, int, str], None]:
        rows = self._rows
        return lambda *arrival: rows.append((number, *arrival))

    def _count(self, row: _Row) -> None:
        number, cdr, time_ns, source_ns, sequence, gid = row
        topic = self._names[number]
        gid = gid or self._only.get(topic, "")
        count = self.counts.setdefault((topic, gid), EndpointCount())
        count.add(sequence if gid else 0, time_ns - source_ns if source_ns else None)
        self.statistics.datagrams += 1
        self.statistics.bytes += len(cdr)

    def _look(self) -> None:
        """Read the endpoints, and the middleware's counts of lost messages."""
        self.endpoints = [item for item in endpoints_of(self._observer) if item.topic in self.topics]
        self.lost = self._observer.lost()
        publishers = [item for item in self.endpoints if item.publishes and not item.own]
        self.publishers |= {item.gid: item for item in publishers}
        topics = [item.topic for item in self.publishers.values()]
        self._only = {item.topic: item.gid for item in publishers if topics.count(item.topic) == 1}

    def _report(self) -> _Row:
        """Return the message with the counts of each endpoint."""
        now_ns = time.time_ns()
        seconds, rest = divmod(now_ns, SECOND)
        entries = [
            {"topic": topic["topic"], "type": topic["type"], "publishes": kind == "publishers"}
            | {name: item.get(name) or usual for name, usual in _ENTRY.items()}
            | {"lost": topic["lost"] or 0 if item.get("observer") else 0}
            for topic in self.summaries()
            for kind in ("publishers", "subscriptions")
            for item in topic[kind]
        ]
        values = {"stamp": {"sec": seconds, "nanosec": rest}, "endpoints": entries}
        return len(self.topics), self._types.encode(_GRAPH_TYPE, values), now_ns, now_ns, 0, ""

    def summaries(self) -> list[dict[str, Any]]:
        """Return the topics in the shape of ``observe --json``."""
        return [self._summary(name, kind) for name, kind in self.topics.items()]

    def _summary(self, name: str, kind: str) -> dict[str, Any]:
        endpoints = [item for item in self.endpoints if item.topic == name]
        publishers = {item.gid: item.as_json() for item in self.publishers.values() if item.topic == name}
        counts = {gid: count for (topic, gid), count in self.counts.items() if topic == name}
        present, pairs = {item.gid for item in endpoints}, mismatches(endpoints)
        return {
            "topic": name,
            "type": kind,
            "lost": self.lost.get(name),
            "publishers": [
                {
                    **publishers.get(gid, {"node": None, "gid": gid or None}),
                    **counts.get(gid, EndpointCount()).as_json(),
                    "left": gid not in present,
                }
                for gid in dict.fromkeys([*publishers, *counts])
            ],
            "subscriptions": [
                {
                    **item.as_json(),
                    "observer": item.own,
                    "incompatible": [
                        f"{publisher.node or publisher.gid}: {', '.join(policies)}"
                        for publisher, subscription, policies in pairs
                        if subscription == item
                    ],
                }
                for item in endpoints
                if not item.publishes
            ],
        }

    def _batch(self, rows: Sequence[_Row]) -> PacketBatch:
        length = np.array([len(row[1]) for row in rows], np.int64)
        times, published, sequence = (np.array([row[at] for row in rows], np.int64) for at in (2, 3, 4))
        messages = SelectedMessages(
            channel_id=np.array([row[0] for row in rows], np.uint16),
            log_time=times,
            data=np.frombuffer(b"".join(row[1] for row in rows), np.uint8),
            offset=np.cumsum(length) - length,
            length=length,
            sequence=sequence.astype(np.uint32),
            publish_time=np.where(published > 0, published, times),
        )
        first, self._number = self._number, self._number + len(rows)
        return message_batch(messages, {place: place for place in range(len(self.topics) + 1)}, first)


class GraphRequest(msgspec.Struct, frozen=True):
    """A graph, and its observed topics.

    Attributes:
        ros: name of a middleware.
        domain: ROS 2 domain.
        options: options of the middleware.
        topics: topics to observe, which are waited for; empty: all that are published within the time of
            discovery.
        qos: function from the publishers to the quality of service of a subscription.
        on_note: called with each note for the user.
        duration_ns: longest time to wait for the topics, ns; None: without end.
    """

    ros: str
    domain: int
    options: Mapping[str, str] = msgspec.field(default_factory=dict)
    topics: Sequence[str] = ()
    qos: Callable[[Sequence[GraphEndpoint]], Qos] = fitting_qos
    on_note: Callable[[str], None] = lambda _: None
    duration_ns: int | None = None

    @property
    def name(self) -> str:
        """Name for users."""
        return f"{self.ros}, domain {self.domain}"


def discovered(request: GraphRequest, observer: GraphObserver) -> list[GraphEndpoint]:
    """Return the endpoints once the requested topics are published, or after the time of discovery.

    Raises:
        ConfigError: a topic is not published in time.
    """
    began, note_due = time.monotonic(), True
    while True:
        endpoints = endpoints_of(observer)
        published = {item.topic for item in endpoints if item.publishes}
        missing = [topic for topic in request.topics if topic not in published]
        elapsed_s = time.monotonic() - began
        if not missing and (request.topics or elapsed_s > _DISCOVERY_S):
            return endpoints
        if missing and request.duration_ns and elapsed_s * 1e9 > request.duration_ns:
            raise ConfigError(f"not published within --duration: {', '.join(missing)}")
        if note_due and elapsed_s > _DISCOVERY_S:
            note_due = False
            request.on_note(f"not published yet, waiting: {', '.join(missing)}; Ctrl-C ends")
        time.sleep(_STEP_S)


def open_source(request: GraphRequest, settings: Settings) -> tuple[GraphSource, Workbench]:
    """Join a graph, find the topics, and subscribe to them.

    Raises:
        ConfigError: the graph cannot be joined, or has nothing to observe.
    """
    types = TypeStore(settings.distro, settings.msg_paths)
    observer = open_observer(request.ros, types, NODE, request.domain, request.options)
    with OnFailure(observer.close):
        publishers = [item for item in discovered(request, observer) if item.publishes and not item.own]
        topics = _topics(request, publishers, types)
        offers = {topic: [item for item in publishers if item.topic == topic] for topic in topics}
        recorded = [_recorded(topic, kind, offers[topic], types) for topic, kind in topics.items()]
        bench = message_bench([*recorded, _recorded(GRAPH_TOPIC, _GRAPH_TYPE, [], types)], settings)
        qos = {topic: request.qos(offers[topic]) for topic in topics}
        return GraphSource(observer, types, topics, qos, request.name), bench


def _topics(request: GraphRequest, publishers: Sequence[GraphEndpoint], types: TypeStore) -> dict[str, str]:
    """Return the topics to observe, with their types.

    Raises:
        ConfigError: there is none.
    """
    kinds: dict[str, str] = {}
    for item in publishers:
        if item.topic in (request.topics or {item.topic}.difference(_OWN_TOPICS)):
            kinds.setdefault(item.topic, item.type)
    usable = {topic: kind for topic, kind in kinds.items() if types.has(kind)}
    for topic in kinds.keys() - usable.keys():
        request.on_note(f"{topic} is left out: {types.check(kinds[topic])}")
    if not usable:
        raise ConfigError(
            f"{request.name}: no topic is published that can be observed; is ROS_DOMAIN_ID the same as there?"
        )
    return usable


def _recorded(topic: str, type_name: str, offers: Sequence[GraphEndpoint], types: TypeStore) -> RecordedTopic:
    """Return a topic as rosbag2 records it, with its publishers' offers."""
    profiles = "".join(recorded_text(item.policies) for item in offers)
    metadata = {QOS_METADATA: profiles} if offers else {}
    schema = types.definition(type_name).encode()
    return RecordedTopic(topic, type_name, "cdr", "ros2msg", schema, metadata)


def topics_of_graph(request: GraphRequest, settings: Settings) -> list[dict[str, Any]]:
    """Return the topics of a graph, each with its type, the number of its endpoints, and their descriptions.

    Raises:
        ConfigError: the graph cannot be joined.
    """
    types = TypeStore(settings.distro, settings.msg_paths)
    observer = open_observer(request.ros, types, NODE, request.domain, request.options)
    try:
        endpoints = [item for item in discovered(request, observer) if not item.own]
    finally:
        observer.close()
    rows = []
    for name, kind in {item.topic: item.type for item in endpoints}.items():
        own = [item for item in endpoints if item.topic == name]
        details = {
            "publishers": [item.text() for item in own if item.publishes],
            "subscriptions": [item.text() for item in own if not item.publishes],
        }
        counts = {noun: len(texts) for noun, texts in details.items()}
        rows.append({"topic": name, "type": kind, **counts, "details": details})
    return rows
