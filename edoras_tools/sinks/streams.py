"""Which topics a link's traffic becomes, and what each batch puts on them: the same in every sink."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.sinks.mcap_cfe import event_messages, software_bus_messages
from edoras_tools.sinks.mcap_clock import MissionClock
from edoras_tools.sinks.mcap_datagrams import DatagramWriter, ros_messages
from edoras_tools.sinks.mcap_faults import FAULTS_TOPIC, FAULTS_TYPE
from edoras_tools.sinks.mcap_statistics import LinkStatistics
from edoras_tools.sinks.mcap_structs import struct_messages
from edoras_tools.structs import Structs, shipped
from edoras_tools.wire.cfe import EVENT_MSG_ID, SOFTWARE_BUS_HOUSEKEEPING_MSG_ID

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from edoras_tools.mission import Mission
    from edoras_tools.model import Columns, PacketBatch, SourceStatistics
    from edoras_tools.ros import TypeStore
    from edoras_tools.sinks.mcap_rows import Messages
    from edoras_tools.structs.bound import Bound

_DATAGRAMS: Final = "/edoras/datagrams"
_EVENTS: Final = "/edoras/events"
_SOFTWARE_BUS: Final = "/edoras/software_bus"
_STATISTICS: Final = "/edoras/link_statistics"


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic that messages are written to.

    Attributes:
        name: with a leading ``/``.
        type: ROS type name.
        metadata: what is told of it beside that.
    """

    name: str
    type: str
    metadata: Mapping[str, str] = field(default_factory=dict)


OWN_TOPICS: Final = (
    Topic(_DATAGRAMS, "edoras_msgs/msg/Datagram"),
    Topic(_EVENTS, "rcl_interfaces/msg/Log"),
    Topic(_SOFTWARE_BUS, "edoras_msgs/msg/SoftwareBusHousekeeping"),
    Topic(_STATISTICS, "edoras_msgs/msg/LinkStatistics"),
)
"""Topics of this package's own; those of the mission's routes follow."""
FAULTS: Final = Topic(FAULTS_TOPIC, FAULTS_TYPE)
"""What was done on purpose; only where something was."""


class Streams:
    """The topics of a mission, and what batches put on them.

    Args:
        mission: its routes become topics.
        types: gives the definitions.
        statistics: the source's, if link statistics are to show its kernel drops as they happen.
        datagrams: whether there is a topic of every datagram whole.
        structs: C structs that packets hold, each a topic of its own; None for those of cFE itself.
        add: makes the topic of a struct when the first one comes, and returns its channel id; None: such
            packets make no messages.

    Attributes:
        topics: this package's own, then one a route.
        definitions: complete ``ros2msg`` texts by type, of all these topics.
        structs: those that no route claims.
        clock: maps mission time to UTC.

    Raises:
        RouteError: a route's type is not known.
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
    ) -> None:
        structs = structs or shipped()
        claimed = {route.msg_id for route in mission.routes}
        # What cFE itself says there is on topics of ours.
        claimed |= {
            item for item in (EVENT_MSG_ID, SOFTWARE_BUS_HOUSEKEEPING_MSG_ID) if structs.is_shipped(item)
        }
        self.structs = structs.unclaimed(claimed)
        self._add = add
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
        self._statistics = LinkStatistics(mission, statistics)
        self._own = len(own)
        self.number(range(len(self.topics)))

    def number(self, ids: Sequence[int]) -> None:
        """Have messages bear these channel ids, one a topic; until then each bears its topic's place."""
        own = dict(zip((topic.name for topic in self.topics[: self._own]), ids, strict=False))
        self._datagrams = DatagramWriter(own[_DATAGRAMS]) if _DATAGRAMS in own else None
        self._events, self._software_bus, self._statistics_id = (
            own[name] for name in (_EVENTS, _SOFTWARE_BUS, _STATISTICS)
        )
        self._routes = np.array(ids[self._own :], dtype=np.uint16)
        self._struct_ids: dict[str, int] = {}

    def messages(self, batch: PacketBatch, columns: Columns, *, datagrams: bool = True) -> list[Messages]:
        """Return what a batch of at least one row puts on the topics, in the order within a row.

        Args:
            batch: the datagrams.
            columns: of the same rows.
            datagrams: whether their own topic is wanted now.
        """
        published = self.clock.publish_times(batch.time_ns, columns)
        streams = [self._statistics.messages(batch, columns, self._statistics_id)]
        if self._datagrams and datagrams:
            streams.append(self._datagrams.messages(batch, columns, published))
        streams += [
            ros_messages(batch, columns, self._routes, published),
            event_messages(batch, columns, self._events, published),
            software_bus_messages(batch, columns, self._software_bus, published),
        ]
        rows = np.flatnonzero(self.structs.has[columns.msg_id])
        if len(rows) and self._add:
            streams += struct_messages(batch, columns, rows, self.structs, self._struct_id, published)
        return streams

    def _struct_id(self, bound: Bound) -> int:
        """Return the channel of a struct's topic, which is made when it is first needed."""
        if bound.topic not in self._struct_ids:
            assert self._add is not None, "asked for only where topics can be made"
            told = {"msg_id": f"0x{bound.key.msg_id:04x}", "struct": bound.struct.name}
            self._struct_ids[bound.topic] = self._add(Topic(bound.topic, bound.type, told))
        return self._struct_ids[bound.topic]

    def finish(self) -> Messages:
        """Return what the second of statistics under way amounts to; all belong to row 0."""
        return self._statistics.finish(self._statistics_id)
