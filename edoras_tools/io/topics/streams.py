"""The topics of a link's traffic, and the messages of each batch on them: the same for every sink."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.io.topics.cfe import event_messages, outage_messages, software_bus_messages
from edoras_tools.io.topics.clock import MissionClock
from edoras_tools.io.topics.datagrams import DatagramWriter, ros_messages, without_trailing
from edoras_tools.io.topics.faults import FAULTS_TOPIC, FAULTS_TYPE
from edoras_tools.io.topics.host import HOST_TOPIC, HOST_TYPE
from edoras_tools.io.topics.latched import LatchedTopics
from edoras_tools.io.topics.names import DATAGRAMS_TOPIC
from edoras_tools.io.topics.statistics import LinkStatistics
from edoras_tools.io.topics.structs import struct_messages
from edoras_tools.io.topics.transforms import TF_TOPIC, TF_TYPE, Transforms
from edoras_tools.structs import Structs, shipped_structs
from edoras_tools.wire.cfe import EVENT_MSG_ID, SOFTWARE_BUS_HOUSEKEEPING_MSG_ID

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from edoras_tools.io.topics.rows import Messages
    from edoras_tools.mission import Mission
    from edoras_tools.model import Columns, InterfaceOutage, PacketBatch, SourceStatistics
    from edoras_tools.ros import TypeStore
    from edoras_tools.structs.bound import Bound

EVENTS_TOPIC: Final = "/edoras/events"
_SOFTWARE_BUS: Final = "/edoras/software_bus"
STATISTICS_TOPIC: Final = "/edoras/link_statistics"


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic that messages are written to.

    Attributes:
        name: with a leading ``/``.
        type: ROS type name.
        metadata: further properties.
    """

    name: str
    type: str
    metadata: Mapping[str, str] = field(default_factory=dict)


OWN_TOPICS: Final = (
    Topic(DATAGRAMS_TOPIC, "edoras_msgs/msg/Datagram"),
    Topic(EVENTS_TOPIC, "rcl_interfaces/msg/Log"),
    Topic(_SOFTWARE_BUS, "edoras_msgs/msg/SoftwareBusHousekeeping"),
    Topic(STATISTICS_TOPIC, "edoras_msgs/msg/LinkStatistics"),
)
"""The topics of this package; those of the mission's routes follow."""
TRANSFORMS: Final = Topic(TF_TOPIC, TF_TYPE)
"""Poses as coordinate frames; only on request."""
FAULTS: Final = Topic(FAULTS_TOPIC, FAULTS_TYPE)
"""Injected faults; only if there are any."""
HOST_COUNTERS: Final = Topic(HOST_TOPIC, HOST_TYPE)
"""The kernel's counters of this host; only where datagrams are captured live."""


class Streams:
    """The topics of a mission, and the messages of batches on them.

    Args:
        mission: its routes become topics.
        types: has the message definitions.
        statistics: of the source, if link statistics include its kernel drops.
        datagrams: whether there is a topic with every whole datagram.
        structs: C structs in packets, each with a topic of its own; None for those of cFE itself.
        add: adds the topic of a struct when its first packet comes, and returns its channel id; None: such
            packets make no messages.
        transforms: whether ``/tf`` is made of the poses, and added in the same way.

    Attributes:
        topics: those of this package, then one for each route.
        definitions: complete ``ros2msg`` texts by type, of all these topics.
        structs: those without a route.
        clock: maps mission time to UTC.

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
    ) -> None:
        structs = structs or shipped_structs()
        claimed = {route.msg_id for route in mission.routes}
        # Messages of cFE itself have topics of this package.
        claimed |= {
            item for item in (EVENT_MSG_ID, SOFTWARE_BUS_HOUSEKEEPING_MSG_ID) if structs.is_shipped(item)
        }
        self.structs = structs.unclaimed(claimed)
        self._add = add
        self._transforms = Transforms(mission, types) if transforms and add else None
        self._types, self._mission = types, mission
        own = OWN_TOPICS if datagrams else OWN_TOPICS[1:]
        self.topics = (
            *own,
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
        self.clock = MissionClock()
        self._latched = LatchedTopics(mission)
        self._statistics = LinkStatistics(mission, statistics)
        self._own = len(own)
        self.number(range(len(self.topics)))

    def number(self, ids: Sequence[int]) -> None:
        """Set the channel ids of messages, one per topic; until then each topic's index is used."""
        own = dict(zip((topic.name for topic in self.topics[: self._own]), ids, strict=False))
        self._datagrams = DatagramWriter(own[DATAGRAMS_TOPIC]) if DATAGRAMS_TOPIC in own else None
        self._events, self._software_bus, self._statistics_id = (
            own[name] for name in (EVENTS_TOPIC, _SOFTWARE_BUS, STATISTICS_TOPIC)
        )
        self._routes = np.array(ids[self._own :], dtype=np.uint16)
        self._added: dict[str, int] = {}

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
            batch: the datagrams.
            columns: of the same rows.
            datagrams: whether the topic of whole datagrams is wanted now.
            statistics: whether link statistics are wanted, for this and every other batch.
            transforms: whether ``/tf`` is wanted now, if it is made at all.
        """
        published = self.clock.publish_times(batch.time_ns, columns)
        columns = without_trailing(batch, columns, self._types, self._mission.routes)
        streams = []
        if statistics:
            streams.append(self._statistics.messages(batch, columns, self._statistics_id))
        if self._datagrams and datagrams:
            streams.append(self._datagrams.messages(batch, columns, published))
        messages = ros_messages(batch, columns, self._routes, published)
        self._latched.keep(columns, messages)
        streams += [
            messages,
            event_messages(batch, columns, self._events, published),
            software_bus_messages(batch, columns, self._software_bus, published),
        ]
        if self._add:
            streams += struct_messages(batch, columns, self.structs, self._struct_id, published)
        if self._transforms and transforms and self._transforms.are_in(columns):
            streams += self._transforms.messages(batch, columns, self._place(TRANSFORMS))
        return streams

    def latched(self, time_ns: int) -> Messages:
        """Return the last message of each latched topic again, for a new file; all belong to row 0."""
        return self._latched.again(self._routes, time_ns)

    def outages(self, news: Sequence[InterfaceOutage]) -> Messages:
        """Return an event for each time that an interface went away or returned, each in its own row."""
        return outage_messages(news, self._events)

    def _struct_id(self, bound: Bound) -> int:
        return self._place(Topic(bound.topic, bound.type, bound.metadata))

    def _place(self, topic: Topic) -> int:
        """Return the channel of a topic that is added at first use."""
        if topic.name not in self._added:
            assert self._add is not None, "called only if topics can be added"
            self._added[topic.name] = self._add(topic)
        return self._added[topic.name]

    def finish(self) -> Messages:
        """Return the messages of the current second of statistics; all belong to row 0."""
        return self._statistics.finish(self._statistics_id)
