"""Shows live traffic or a recording in Foxglove: sends its topics to connected clients."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from edoras_tools.io.foxglove.diagnostics import DIAGNOSTICS, Diagnostics
from edoras_tools.io.foxglove.link_state import LinkState
from edoras_tools.io.foxglove.server import FoxgloveServer, ServerOptions
from edoras_tools.io.topics.faults import fault_messages
from edoras_tools.io.topics.recorded import RecordedStreams
from edoras_tools.io.topics.rows import Messages, lay_out
from edoras_tools.io.topics.streams import EVENTS_TOPIC, FAULTS, STATISTICS_TOPIC, TRANSFORMS, Streams, Topic

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from edoras_tools.links.protocol import Endpoints
    from edoras_tools.mission import Mission
    from edoras_tools.model import Columns, Finding, PacketBatch, SourceInfo, SourceStatistics
    from edoras_tools.ros import TypeStore
    from edoras_tools.sessions.faults.fault import Fault
    from edoras_tools.structs import Structs


class ServedSink:
    """What is shown, or played, over the Foxglove WebSocket protocol: a ``Sink`` that clients cannot delay.

    Attributes:
        server: the server; it listens from construction on.
    """

    server: FoxgloveServer

    def write(self, batch: PacketBatch, columns: Columns) -> None:
        """Send a batch to clients."""
        raise NotImplementedError

    def show_time(self, time_ns: int) -> None:
        """Send a time for the clients' clocks, ns since 1970."""
        self.server.tell_time(time_ns)

    def restart(self) -> None:
        """Reset the statistics, if there are any, because the following messages have other times."""

    def flush(self) -> None:
        """Do nothing: there is no buffer."""

    def close(self, statistics: SourceStatistics) -> None:  # noqa: ARG002  required by Sink
        """Close all clients."""
        self.server.close()

    def summary(self) -> dict[str, Any]:
        """Return counts of the messages; see ``FoxgloveServer.summary``."""
        return self.server.summary()


class RecordedSink(ServedSink):
    """Serves the messages of a recording.

    Args:
        types: provides the schemas that the recording does not hold.

    Raises:
        CaptureError: the address cannot be used.
        ConfigError: ``websockets`` is not installed.
    """

    def __init__(self, mission: Mission, types: TypeStore, info: SourceInfo, options: ServerOptions) -> None:
        self._streams = RecordedStreams(mission, types)
        self.server = FoxgloveServer(f"edoras: {info.name}", self._streams.topics, lambda _: "", options)

    def write(self, batch: PacketBatch, columns: Columns) -> None:
        """Send a batch to clients."""
        if len(batch) and self.server.clients:
            prepared = self._streams.prepare(batch, columns)
            self.server.publish(lay_out(self._streams.made(batch, columns, prepared), len(batch)))
            self.show_time(int(batch.time_ns[-1]))


class FoxgloveSink(ServedSink):
    """Serves batches over the Foxglove WebSocket protocol: a ``Sink`` that clients cannot delay.

    Topics, types and messages are those of a recording, plus ``/diagnostics`` and ``/tf``. All are
    offered from the start, also those that a recording has only with their first message, and those of DDS
    once they are announced: who subscribes to what is offered misses nothing. Whole datagrams and ``/tf`` are
    only made for clients that subscribed.

    Args:
        mission: its routes become topics.
        info: of the source; gives the server its name.
        levels: the level of each finding in the diagnostics: 0 OK, 1 warning, 2 error.
        statistics: the source's, for losses of the capture itself.
        structs: C structs in packets; None: only cFE's own.
        endpoints: of DDS, as the decoder learns them; None: their samples are not sent.

    Raises:
        CaptureError: the address cannot be used.
        ConfigError: ``websockets`` is not installed.
        RouteError: a route's type is unknown.
    """

    def __init__(
        self,
        mission: Mission,
        types: TypeStore,
        info: SourceInfo,
        options: ServerOptions = ServerOptions(),  # noqa: B008  frozen
        *,
        levels: Mapping[Finding, int] | None = None,
        statistics: SourceStatistics | None = None,
        structs: Structs | None = None,
        endpoints: Endpoints | None = None,
    ) -> None:
        self._mission, self._types, self._info = mission, types, info
        self._levels, self._counted = levels or {}, statistics
        self._structs, self._endpoints = structs, endpoints
        self._begin()
        bound = [Topic(item.topic, item.type, item.metadata) for item in self._streams.structs.all]
        own = [DIAGNOSTICS, FAULTS]
        if all(topic.name != TRANSFORMS.name for topic in self._streams.topics):
            own.append(TRANSFORMS)
        topics = [*self._streams.topics, *own, *bound]
        self._places = {topic.name: place for place, topic in enumerate(topics)}
        definitions = {
            **self._streams.definitions,
            **{item.type: types.definition(item.type) for item in (DIAGNOSTICS, FAULTS, TRANSFORMS)},
            **{
                item.type: self._streams.structs.types.definition(item.type)
                for item in self._streams.structs.all
            },
        }
        self.server = FoxgloveServer(
            f"edoras: {info.name}",
            topics,
            lambda name: definitions.get(name) or types.definition(name),
            options,
        )
        self._streams.offer_announced()
        self.server.link_state = lambda: self._link.summary()  # noqa: PLW0108  there is a new one after a jump

    def write(self, batch: PacketBatch, columns: Columns) -> None:
        """Send a batch to clients."""
        if not len(batch):
            return
        self._streams.offer_announced()
        # Whole datagrams are the first topic, and the most expensive.
        streams = self._streams.messages(
            batch,
            columns,
            datagrams=self.server.wanted(0),
            transforms=self.server.wanted(self._places[TRANSFORMS.name]),
        )
        own: dict[int, list[Messages]] = {}
        for item in streams:
            if isinstance(item.channel_id, int):
                own.setdefault(item.channel_id, []).append(item)
        streams.append(self._diagnostics.messages(batch, columns, self._places[DIAGNOSTICS.name]))
        counts, events = (own[self._places[name]] for name in (STATISTICS_TOPIC, EVENTS_TOPIC))
        self._link.add(batch, counts[-1], events, self._diagnostics.latest)
        if self.server.clients:
            self.server.publish(lay_out(streams, len(batch)))
            self.show_time(int(batch.time_ns[-1]))

    def write_faults(self, faults: Sequence[Fault]) -> None:
        """Send injected faults, with times in ns since 1970."""
        if self.server.clients:
            self.server.publish(lay_out([fault_messages(faults, self._places[FAULTS.name])], len(faults)))

    def restart(self) -> None:
        """Reset the statistics, because the following messages have other times."""
        self._begin()

    def _offer(self, topic: Topic) -> int:
        """Return the place of a topic; of one that only the content names, after it is offered to clients."""
        if topic.name not in self._places:
            self._places[topic.name] = self.server.add(topic)
        return self._places[topic.name]

    def _begin(self) -> None:
        self._streams = Streams(
            self._mission,
            self._types,
            self._counted,
            structs=self._structs,
            add=self._offer,
            transforms=True,
        )
        self._streams.endpoints = self._endpoints
        self._link = LinkState(self._types, self._counted)
        self._diagnostics = Diagnostics(
            self._mission, self._types, self._info.name, self._levels, self._counted
        )
