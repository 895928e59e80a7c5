"""The topics and messages of a recording without datagrams; the counterpart of ``Streams``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.io.topics.rows import RECORD, Messages, bodies_of, whole_messages
from edoras_tools.io.topics.streams import LatchedTopics, PreparedBatch, Topic
from edoras_tools.structs import Structs

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from edoras_tools.mission import Mission, RecordedTopic
    from edoras_tools.model import Columns, InterfaceOutage, PacketBatch
    from edoras_tools.ros import TypeStore

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
