"""The topics of a link's traffic, and the messages of each batch on them: the same for every sink.

Mission time becomes UTC by the clock of the capture. ``RecordedStreams`` is the counterpart of ``Streams``
for a recording without datagrams.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from itertools import chain, pairwise
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.decode.spacecraft import FIRST_SPACECRAFT
from edoras_tools.io.topics import edoras
from edoras_tools.io.topics.edoras import HOST_TOPIC, HOST_TYPE, LinkStatistics
from edoras_tools.io.topics.messages import (
    DATAGRAMS_TOPIC,
    RECORD,
    TF_TOPIC,
    TF_TYPE,
    DatagramWriter,
    Messages,
    Transforms,
    bodies_of,
    log_messages,
    ros_messages,
    struct_messages,
    whole_messages,
    without_trailing,
)
from edoras_tools.links import table
from edoras_tools.links.table import RESETS
from edoras_tools.structs import Structs, shipped_structs
from edoras_tools.structs.bindings import payloads
from edoras_tools.wire.arrays import Integers, Mask, Octets, by_value, order_by
from edoras_tools.wire.cfe import EVENT_MSG_ID, SOFTWARE_BUS_HOUSEKEEPING_MSG_ID

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.links.doors import Endpoints
    from edoras_tools.mission import Mission, RecordedTopic
    from edoras_tools.model import Columns, InterfaceOutage, PacketBatch, SourceStatistics
    from edoras_tools.ros import TypeStore
    from edoras_tools.sessions.sequence import SequenceCounts
    from edoras_tools.structs.shapes import Key

_JUMP_NS = 5_000_000_000
"""Change of a sender's offset, in ns, that only a restart or a clock that was set can explain."""
_MAX_SENDERS = 4096
"""Most senders that are remembered; corrupt packets could name any number. The oldest are forgotten."""
_FEW = 128
"""Most segments of senders and jumps in a batch for which one call each is faster."""


class MissionClock:
    """Offset of each sender's mission clock from UTC: the smallest (capture time - mission time) so far.

    Delays only increase that difference, so the smallest is the best estimate. A sender is a (link,
    ProcessorID). When the offset changes by more than 5 s, the sender's clock was reset, and the estimate
    starts again.
    """

    def __init__(self) -> None:
        self._link = np.zeros(0, dtype=np.uint8)
        self._processor = np.zeros(0, dtype=np.uint32)
        self._least = np.zeros(0, dtype=np.int64)
        self._last = np.zeros(0, dtype=np.int64)

    def publish_times(self, time_ns: Integers, columns: Columns) -> Integers:
        """Return the time in each packet, ns since 1970 UTC; its capture time if it has none.

        A mission time of 0 is no time: cFS counts from a start offset, and senders without a clock write 0.

        Args:
            time_ns: capture time, i64.
        """
        rows = np.flatnonzero(columns.mission_time_ns > 0)
        published = time_ns.copy()
        if len(rows) == 0:
            return published
        mission = columns.mission_time_ns[rows]
        # Each sender's state is put before the batch as two rows: its smallest and its last offset.
        earlier = len(self._link)
        link = np.concatenate((self._link, self._link, columns.link[rows]))
        processor = np.concatenate((self._processor, self._processor, columns.processor_id[rows]))
        offset = np.concatenate((self._least, self._last, time_ns[rows] - mission))
        order = order_by(link, processor)
        least = np.empty_like(offset)
        least[order], ends = _running_least(link[order], processor[order], offset[order], order < 2 * earlier)
        published[rows] = mission + least[2 * earlier :]
        last = order[ends]
        if len(last) > _MAX_SENDERS:
            last = np.sort(last)[-_MAX_SENDERS:]
        self._link, self._processor = link[last], processor[last]
        self._least, self._last = least[last], offset[last]
        return published

    def offsets(self) -> dict[str, int]:
        """Return the offset of each sender in ns, named ``LINK/PROCESSOR``, e.g. ``to/0``."""
        senders = zip(self._link.tolist(), self._processor.tolist(), self._least.tolist(), strict=True)
        return {f"{table.link(link).label}/{processor}": least for link, processor, least in senders}


def _running_least(
    link: Octets, processor: NDArray[np.uint32], offset: Integers, earlier: Mask
) -> tuple[Integers, Integers]:
    """Return the running minimum of each sender's offsets, reset at jumps, and each sender's last state."""
    changes = (link[1:] != link[:-1]) | (processor[1:] != processor[:-1])
    # There is no jump between a sender's stored smallest and last offset: the offset changed slowly.
    jumps = (np.abs(np.diff(offset)) > _JUMP_NS) & ~(earlier[1:] & earlier[:-1])
    starts = np.concatenate(([0], np.flatnonzero(changes | jumps) + 1))
    if len(starts) <= _FEW:
        least = np.empty_like(offset)
        for first, end in pairwise([*starts.tolist(), len(offset)]):
            np.minimum.accumulate(offset[first:end], out=least[first:end])
        return least, np.append(np.flatnonzero(changes), len(offset) - 1)
    segment = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(offset))))
    # One accumulate for all segments: each is shifted down so far that no earlier value can be smaller.
    step = (1 << 62) // (len(starts) + 1)
    base = offset[starts][segment]
    moved = np.clip(offset - base, -(step // 2) + 1, step // 2 - 1) - segment * step
    least = np.minimum.accumulate(moved) + segment * step + base
    return least, np.append(np.flatnonzero(changes), len(offset) - 1)


LATCHED_NAMES: Final = ("tf_static", "robot_description")
"""Last parts of the names of topics that ROS latches; other topics need ``durability: transient_local``."""


class LatchedTopics:
    """The last message of each latched topic.

    Attributes:
        routes: indices in ``Mission.routes`` of these topics.
    """

    def __init__(self, mission: Mission) -> None:
        self.routes = [
            index
            for index, route in enumerate(mission.routes)
            if route.handling.transient_local or route.topic.rpartition("/")[2] in LATCHED_NAMES
        ]
        self._last: dict[int, tuple[bytes, int, int]] = {}

    def keep(self, columns: Columns, messages: Messages) -> None:
        """Keep the last messages of a batch."""
        routes = columns.route[messages.rows]
        for route in self.routes:
            for at in np.flatnonzero(routes == route)[-1:].tolist():
                start = int(messages.offset[at])
                head = messages.heads(slice(at, at + 1))[0]
                data = messages.data[start : start + int(messages.length[at])].tobytes()
                self._last[route] = data, int(head["sequence"]), int(head["publish_time"])

    def again(self, channel_ids: NDArray[np.uint16], time_ns: int) -> Messages:
        """Return the last message of each topic with a new log time; all belong to row 0.

        Args:
            channel_ids: MCAP channel of each of ``Mission.routes``.
            time_ns: log time, ns since 1970.
        """
        messages = list(self._last.values())
        length = np.array([len(data) for data, _, _ in messages], np.int64)
        heads = np.empty(len(messages), np.dtype(RECORD))
        channels = channel_ids[list(self._last)] if messages else np.zeros(0, np.uint16)
        sequence, published = (np.array([item[at] for item in messages], np.int64) for at in (1, 2))
        log_time = np.full(len(messages), time_ns, np.int64)
        rest = (
            np.frombuffer(b"".join(data for data, _, _ in messages), np.uint8),
            np.cumsum(length) - length,
            length,
        )
        rows = np.zeros(len(messages), np.int64)
        return whole_messages(rows, heads, channels, sequence, log_time, published, rest, repeats=True)


EVENTS_TOPIC: Final = "/edoras/events"
_SOFTWARE_BUS: Final = "/edoras/software_bus"
STATISTICS_TOPIC: Final = "/edoras/link_statistics"


class Topic(msgspec.Struct, frozen=True):
    """A topic that messages are written to.

    Attributes:
        name: name with a leading ``/``.
        type: ROS type name.
        metadata: further properties.
        encoding: encoding of the messages.
        schema: encoding and bytes of a recorded schema; None for the definition of the type.
    """

    name: str
    type: str
    metadata: Mapping[str, str] = msgspec.field(default_factory=dict)
    encoding: str = "cdr"
    schema: tuple[str, bytes] | None = None


OWN_TOPICS: Final = (
    Topic(DATAGRAMS_TOPIC, "edoras_msgs/msg/Datagram"),
    Topic(EVENTS_TOPIC, "rcl_interfaces/msg/Log"),
    Topic(_SOFTWARE_BUS, "edoras_msgs/msg/SoftwareBusHousekeeping"),
    Topic(STATISTICS_TOPIC, "edoras_msgs/msg/LinkStatistics"),
)
"""The topics of this package; those of the mission's routes follow."""
_OF_EACH: Final = OWN_TOPICS[1:3]
"""The topics that each spacecraft has."""
TRANSFORMS: Final = Topic(TF_TOPIC, TF_TYPE)
"""Poses as coordinate frames; only on request."""
FAULTS: Final = Topic(edoras.FAULTS_TOPIC, edoras.FAULTS_TYPE)
"""Injected faults; only if there are any."""
HOST_COUNTERS: Final = Topic(HOST_TOPIC, HOST_TYPE)
"""The kernel's counters of this host; only where datagrams are captured live."""


class PreparedBatch(msgspec.Struct, frozen=True, eq=False):
    """Results for a batch that depend on earlier batches; everything else follows from the batch itself.

    Attributes:
        published: publish time of each row, i64, ns since 1970.
        statistics: messages of the ended seconds of link statistics, and the links' own messages.
        added: channel ids of the topics that were added so far, by name.
    """

    published: Integers
    statistics: list[Messages]
    added: Mapping[str, int]


class Streams:
    """The topics of a mission, and the messages of batches on them.

    Args:
        mission: mission whose routes become topics.
        statistics: counts of the source, if link statistics include its kernel drops.
        datagrams: whether there is a topic with every whole datagram.
        structs: C structs in packets, each with its own topic; None for those of cFE itself.
        add: adds the topic of a struct at its first packet, and returns its channel id; None: such
            packets make no messages.
        transforms: whether ``/tf`` is made from the poses; it is added in the same way.
        sequences: sequence counts shared with other users of the same batches; by default own ones.

    Attributes:
        topics: the topics of this package, then one for each route.
        added: channel ids of the topics that were added, by name.
        definitions: complete ``ros2msg`` texts of all these topics, by type.
        structs: structs whose MsgId has no route.
        all_wanted: whether to make messages besides statistics and events.
        clock: clock that maps mission time to UTC.
        endpoints: DDS endpoints that the decoder discovers; None: DDS samples make no messages.

    Raises:
        RouteError: a route's type is unknown.
    """

    def __init__(
        self,
        mission: Mission,
        types: TypeStore,
        statistics: SourceStatistics | None = None,
        *,
        datagrams: bool = True,
        structs: Structs | None = None,
        add: Callable[[Topic], int] | None = None,
        transforms: bool = False,
        sequences: SequenceCounts | None = None,
    ) -> None:
        structs = structs or shipped_structs()
        claimed = {route.msg_id for route in mission.routes}
        # Messages of cFE itself have topics of this package.
        own_ids = map(structs.msg_ids.of_known, (EVENT_MSG_ID, SOFTWARE_BUS_HOUSEKEEPING_MSG_ID))
        claimed |= set(filter(structs.is_shipped, own_ids))
        self.structs = structs.unclaimed(claimed)
        self._add = add
        self._transforms = Transforms(mission, types) if transforms and add else None
        self.types, self.mission = types, mission
        own: tuple[Topic, ...] = OWN_TOPICS if datagrams else OWN_TOPICS[1:]
        own = own if mission.number == FIRST_SPACECRAFT else _OF_EACH
        prefix = mission.prefix(mission.number)
        self._own_names = [topic.name for topic in own]
        self.topics = (
            *(replace(topic, name=prefix + topic.name) if topic in _OF_EACH else topic for topic in own),
            *(
                Topic(
                    route.topic,
                    route.type,
                    {
                        "link": route.link.label,
                        "msg_id": f"0x{route.msg_id:04x}",
                        "direction": route.direction,
                    },
                )
                for route in mission.routes
            ),
        )
        names = [*(topic.type for topic in OWN_TOPICS), *(topic.type for topic in self.topics)]
        self.definitions = {name: types.definition(name) for name in dict.fromkeys(names)}
        self.all_wanted = True
        self.clock = MissionClock()
        self.endpoints: Endpoints | None = None
        self._latched = LatchedTopics(mission)
        self._own_topics = table.LinkStates(lambda link: link.topics(self))
        self._statistics = LinkStatistics(mission, statistics, sequences, self.structs)
        self._others: dict[int, Streams] = {}
        """The topics of other spacecraft than the first, by number."""
        self.number(range(len(self.topics)))

    def number(self, ids: Sequence[int]) -> None:
        """Set the channel ids of messages, one per topic; until then each topic's index is used."""
        own = dict(zip(self._own_names, ids, strict=False))
        self._datagrams = DatagramWriter(own[DATAGRAMS_TOPIC]) if DATAGRAMS_TOPIC in own else None
        self._events, self._software_bus = own[EVENTS_TOPIC], own[_SOFTWARE_BUS]
        self._statistics_id = own.get(STATISTICS_TOPIC, 0)
        self._routes = np.array(ids[len(own) :], dtype=np.uint16)
        self.added: dict[str, int] = {}
        self._new = self.structs
        """Structs whose topic is not added yet, except those in ``_placed``."""
        self._placed: set[Key] = set()

    def messages(
        self,
        batch: PacketBatch,
        columns: Columns,
        *,
        datagrams: bool = True,
        statistics: bool = True,
        transforms: bool = True,
    ) -> list[Messages]:
        """Return the messages of a batch of at least one row, in their order within a row.

        Args:
            datagrams: whether to write the topic of whole datagrams now.
            statistics: whether to make link statistics; the same for every batch.
            transforms: whether to write ``/tf`` now, if it is made at all.
        """
        prepared = self.prepare(batch, columns, statistics=statistics, transforms=transforms)
        return self.prepared_messages(batch, columns, prepared, datagrams=datagrams, transforms=transforms)

    def prepare(
        self,
        batch: PacketBatch,
        columns: Columns,
        published: Integers | None = None,
        *,
        statistics: bool = True,
        transforms: bool = True,
    ) -> PreparedBatch:
        """Process a batch, in the order of the capture, and add the topics that appear in it first.

        Args:
            batch: see ``messages``.
            columns: see ``messages``.
            published: publish times, i64, ns since 1970; None: they follow from these batches.
            statistics: see ``messages``.
            transforms: see ``messages``.
        """
        messages = [self._statistics.messages(batch, columns, self._statistics_id)] if statistics else []
        for topics in self._own_topics.of(columns) if self._add else ():
            messages += topics.messages(batch, columns)
        if not self._several(columns):
            published = self.prepare_part(batch, columns, published, transforms=transforms)
            return PreparedBatch(published, messages, self.added)
        whole = np.zeros(len(batch), np.int64)
        for number, rows in by_value(columns.spacecraft):
            streams = self._of(number, self._place)
            streams.added = self.added
            times = None if published is None else published[rows]
            whole[rows] = streams.prepare_part(
                batch.take(rows), columns.take(rows), times, transforms=transforms
            )
        return PreparedBatch(whole, messages, self.added)

    def _several(self, columns: Columns) -> bool:
        """Return whether rows are of another spacecraft than the first, whose topics can be added."""
        return self._add is not None and bool((columns.spacecraft != FIRST_SPACECRAFT).any())

    def _of(self, number: int, channel: Callable[[Topic], int]) -> Streams:
        """Return the topics of a spacecraft; if it is not the first, ``channel`` returns their channels."""
        if number == FIRST_SPACECRAFT:
            return self
        if number not in self._others:
            self._others[number] = Streams(
                self.mission.of(number),
                self.types,
                structs=self.structs.under(self.mission.prefix(number)),
                add=self._add,
                transforms=self._transforms is not None,
            )
        other = self._others[number]
        other.all_wanted = self.all_wanted
        other.number([channel(topic) for topic in other.topics])
        return other

    def prepare_part(
        self, batch: PacketBatch, columns: Columns, published: Integers | None, *, transforms: bool
    ) -> Integers:
        """Process a batch of one spacecraft; return its publish times."""
        if published is None:
            published = self.clock.publish_times(batch.time_ns, columns)
        if self._latched.routes:
            rows = np.flatnonzero(np.isin(columns.route, self._latched.routes))
            own_rows, own = batch.take(rows), columns.take(rows)
            self._latched.keep(
                own, ros_messages(own_rows, self._trimmed(own_rows, own), self._routes, published[rows])
            )
        if self._add:
            self._place_structs(batch, columns)
            if self._transforms and transforms and self._transforms.are_in(columns):
                self._place(TRANSFORMS)
        return published

    def prepared_messages(
        self,
        batch: PacketBatch,
        columns: Columns,
        prepared: PreparedBatch,
        *,
        datagrams: bool = True,
        transforms: bool = True,
    ) -> list[Messages]:
        """Return the messages of a prepared batch; callable in any order, and in any process.

        Args:
            batch: see ``messages``.
            columns: see ``messages``.
            prepared: result of ``prepare``.
            datagrams: see ``messages``.
            transforms: see ``messages``.
        """
        columns = self._trimmed(batch, columns) if self.all_wanted else columns
        streams = [*prepared.statistics]
        if self._datagrams and datagrams:
            streams.append(self._datagrams.messages(batch, columns, prepared.published))
        if not self._several(columns):
            return streams + self.part_messages(batch, columns, prepared, transforms=transforms)
        for number, rows in by_value(columns.spacecraft):
            other = self._of(number, lambda topic: prepared.added[topic.name])
            part = replace(prepared, published=prepared.published[rows])
            own = other.part_messages(batch.take(rows), columns.take(rows), part, transforms=transforms)
            streams += [replace(item, rows=rows[item.rows]) for item in own]
        return streams

    def part_messages(
        self, batch: PacketBatch, columns: Columns, prepared: PreparedBatch, *, transforms: bool
    ) -> list[Messages]:
        """Return the messages of one spacecraft's datagrams."""
        published, added, big_endian = prepared.published, prepared.added, self.structs.big_endian
        streams = [edoras.event_messages(batch, columns, self._events, published, big_endian=big_endian)]
        if self.all_wanted:
            bus = self._software_bus
            streams.insert(0, ros_messages(batch, columns, self._routes, published))
            streams.append(
                edoras.software_bus_messages(batch, columns, bus, published, big_endian=big_endian)
            )
        if (columns.link == RESETS).any():
            streams.append(edoras.reset_messages(batch, columns, self._events))
        if self.structs.dictionary is not None:
            streams.append(log_messages(batch, columns, self.structs, self.types, self._events))
        if self._add and self.all_wanted:
            streams += struct_messages(batch, columns, self.structs, added, published)
        if self._transforms and transforms and self._transforms.are_in(columns):
            streams += self._transforms.messages(batch, columns, added[TF_TOPIC])
        return streams

    def _trimmed(self, batch: PacketBatch, columns: Columns) -> Columns:
        return without_trailing(batch, columns, self.types, self.mission.routes)

    def latched(self, time_ns: int) -> list[Messages]:
        """Return the last message of each latched topic, for the start of a new file; all belong to row 0."""
        others = (self._of(number, self._place).latched(time_ns) for number in self._others)
        return [self._latched.again(self._routes, time_ns), *chain.from_iterable(others)]

    def outages(self, news: Sequence[InterfaceOutage]) -> Messages:
        """Return an event for each time that an interface went away or returned, each in its own row."""
        return edoras.outage_messages(news, self._events)

    def _place_structs(self, batch: PacketBatch, columns: Columns) -> None:
        """Add the topics of structs that appear for the first time."""
        samples = payloads(self._new, partial(getattr, columns), partial(getattr, batch), batch.data)
        for bound, _, fits in self._new.split(samples, self._placed):
            if fits.any():
                self._place(Topic(bound.topic, bound.type, bound.metadata))
                self._placed.add(bound.key)
        self._new = self._new.unclaimed(key.msg_id for key in self._placed if self._new.is_one(key.msg_id))

    @property
    def flows(self) -> dict[str, int]:
        """The number of datagrams of each link and MsgId in the statistics messages returned so far."""
        return self._statistics.flows

    def used_names(self) -> set[str]:
        """Return the topic names that other messages have, or may get."""
        used = {item.name for item in (*self.topics, TRANSFORMS, FAULTS, HOST_COUNTERS)}
        return (
            used
            | {item.topic for item in self.mission.stored_topics}
            | {item.topic for item in self.structs.all}
        )

    def offer(self) -> None:
        """Add the topics that links know already, before their first messages."""
        if self.endpoints is not None and self.endpoints.announced:
            self._own_topics.begin(link for link in table.links() if link.samples)
        for topics in self._own_topics.by_link.values():
            topics.offer()

    def place(self, name: str, type_name: str, metadata: Mapping[str, str]) -> int:
        """Return the channel of a topic: of a route that has its name and type, else added at first use."""
        for index, route in enumerate(self.mission.routes):
            if (route.topic, route.type) == (name, type_name):
                return int(self._routes[index])
        return self._place(Topic(name, type_name, metadata))

    def _place(self, topic: Topic) -> int:
        """Return the channel of a topic that is added at first use."""
        if topic.name not in self.added:
            assert self._add is not None, "called only if topics can be added"
            self.added[topic.name] = self._add(topic)
        return self.added[topic.name]

    def finish(self) -> Messages:
        """Return the messages of the current second of statistics; all belong to row 0."""
        return self._statistics.finish(self._statistics_id)


QOS_METADATA: Final = "offered_qos_profiles"
"""Metadata of a topic: the quality of service of its publishers, as rosbag2 writes it."""


class RecordedStreams:
    """The topics of a recording without datagrams, and its messages, as they were recorded.

    Sinks use it in place of ``Streams`` for such recordings.

    Args:
        types: type definitions that the recording may not hold.
        places: indices of the topics to write; None: all.
    """

    def __init__(self, mission: Mission, types: TypeStore, places: Collection[int] | None = None) -> None:
        every = range(len(mission.recorded))
        self._places = [place for place in every if places is None or place in places]
        self._ids = np.zeros(len(every), np.uint16)
        self.topics = tuple(_recorded_topic(mission.recorded[place], types) for place in self._places)
        self.structs = Structs()
        self._latched = LatchedTopics(mission)
        self.number(range(len(self.topics)))

    def number(self, ids: Sequence[int]) -> None:
        """Set the channel ids of messages, one per topic; until then each topic's index is used."""
        self._ids[self._places] = ids

    def prepare(self, batch: PacketBatch, columns: Columns) -> PreparedBatch:
        """Process a batch, in the order of the recording; keep the last messages of latched topics."""
        assert batch.recorded is not None, "they are messages of a recording"
        published = batch.recorded["publish_ns"]
        if self._latched.routes:
            rows = np.flatnonzero(np.isin(columns.route, self._latched.routes))
            self._latched.keep(columns.take(rows), self._messages(batch.take(rows)))
        return PreparedBatch(published, [], {})

    def prepared_messages(self, batch: PacketBatch, *_: Any) -> list[Messages]:
        """Return the messages of a batch; callable in any order, and in any process."""
        return [self._messages(batch)]

    def _messages(self, batch: PacketBatch) -> Messages:
        assert batch.recorded is not None, "they are messages of a recording"
        heads = np.empty(len(batch), np.dtype(RECORD))
        recorded = batch.recorded
        channels = self._ids[recorded["topic"]]
        rest = batch.data, batch.offset, batch.length
        times = batch.time_ns, recorded["publish_ns"]
        return whole_messages(np.arange(len(batch)), heads, channels, recorded["sequence"], *times, rest)

    def latched(self, time_ns: int) -> list[Messages]:
        """Return the last message of each latched topic, for the start of a new file; all belong to row 0."""
        return [self._latched.again(self._ids, time_ns)]

    def finish(self) -> Messages:
        """Return no message: a recording that is copied gets no statistics."""
        return bodies_of([], [], 0)

    def outages(self, news: Sequence[InterfaceOutage]) -> Messages:
        """Return no message: no interface is captured."""
        return bodies_of([], [], 0)


def _recorded_topic(topic: RecordedTopic, types: TypeStore) -> Topic:
    """Return a topic as it is written: with its own schema, or with that of its type if it has none."""
    schema = topic.schema_encoding, topic.schema
    if not topic.schema and not topic.unread:
        schema = "ros2msg", types.definition(topic.type).encode()
    return Topic(topic.topic, topic.type, topic.metadata, topic.encoding, schema)
