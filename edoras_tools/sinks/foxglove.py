"""Traffic live in Foxglove: what a recording would hold, given to whoever is connected."""

from __future__ import annotations

from secrets import token_hex
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.model import Endpoint
from edoras_tools.sinks.foxglove_diagnostics import DIAGNOSTICS, Diagnostics
from edoras_tools.sinks.foxglove_offer import Offer
from edoras_tools.sinks.foxglove_server import FoxgloveServer
from edoras_tools.sinks.mcap_faults import fault_messages
from edoras_tools.sinks.mcap_rows import lay_out
from edoras_tools.sinks.streams import FAULTS, Streams, Topic
from edoras_tools.websocket import Guard

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from edoras_tools.mission import Mission
    from edoras_tools.model import Columns, Finding, PacketBatch, SourceInfo, SourceStatistics
    from edoras_tools.ros import TypeStore
    from edoras_tools.sessions.faults import Fault
    from edoras_tools.sinks.foxglove_offer import Player, Publisher
    from edoras_tools.structs import Structs

PORT: Final = 8765
"""Where Foxglove looks for a server unless told otherwise."""


class FoxgloveSink:
    """Serves batches over the Foxglove WebSocket protocol: a ``Sink`` that nobody can hold up.

    Topics, types and messages are those of a recording; ``/diagnostics`` comes on top. Only what somebody
    has subscribed to is worked out.

    Args:
        mission: its routes become topics.
        types: gives the schemas.
        info: of the source; names the server.
        listen: address and port; port 0 is the system's choice.
        levels: how bad each finding is, for the diagnostics: 0 fine, 1 warning, 2 error.
        statistics: the source's, for what the capture itself loses.
        publisher: takes what clients publish; None: they may not.
        player: plays a recording back; None: the traffic is live.
        structs: C structs that packets hold; None for those of cFE itself.
        guard: who may connect.

    Attributes:
        server: the server, listening from construction on.

    Raises:
        CaptureError: the address cannot be listened on.
        ConfigError: the SDK is not installed.
        RouteError: a route's type is not known.
    """

    def __init__(
        self,
        mission: Mission,
        types: TypeStore,
        info: SourceInfo,
        *,
        listen: Endpoint = Endpoint("127.0.0.1", PORT),  # noqa: B008  frozen
        levels: Mapping[Finding, int] | None = None,
        statistics: SourceStatistics | None = None,
        publisher: Publisher | None = None,
        player: Player | None = None,
        structs: Structs | None = None,
        guard: Guard = Guard(),  # noqa: B008  frozen
    ) -> None:
        self._mission, self._types, self._info = mission, types, info
        self._levels, self._counted = levels or {}, statistics
        self._faults, self._structs = -1, structs
        self._late: dict[str, int] = {}
        self._begin()
        topics = [*self._streams.topics, DIAGNOSTICS]
        definitions = {
            **self._streams.definitions,
            **{item.type: types.definition(item.type) for item in (DIAGNOSTICS, FAULTS)},
            **{
                item.type: self._streams.structs.types.definition(item.type)
                for item in self._streams.structs.all
            },
        }
        self._diagnostics_id = len(topics) - 1
        offer = Offer(f"edoras: {info.name}", definitions, publisher, player, token_hex(8), guard)
        self.server = FoxgloveServer(offer, topics, listen)

    def write(self, batch: PacketBatch, columns: Columns) -> None:
        """Give a batch to those who want it."""
        if not len(batch):
            return
        # Whole datagrams are the first topic, and the dearest.
        streams = self._streams.messages(batch, columns, datagrams=self.server.wanted(0))
        streams.append(self._diagnostics.messages(batch, columns, self._diagnostics_id))
        if self.server.visitors:
            self.server.publish(lay_out(streams, len(batch)))
            self.show_time(int(batch.time_ns[-1]))

    def write_faults(self, faults: Sequence[Fault]) -> None:
        """Take what was done on purpose, with times in ns since 1970; makes the topic where it is needed."""
        if self._faults < 0:
            self._faults = self.server.add(FAULTS)
        if self.server.visitors:
            self.server.publish(lay_out([fault_messages(faults, self._faults)], len(faults)))

    def show_time(self, time_ns: int) -> None:
        """Have the clock of clients show a time, ns since 1970."""
        self.server.tell_time(time_ns)

    def restart(self) -> None:
        """Forget what batches have been: what follows lies elsewhere in time."""
        self._begin()

    def flush(self) -> None:
        """Do nothing: nothing waits here."""

    def close(self, statistics: SourceStatistics) -> None:  # noqa: ARG002  a Sink is told
        """Say goodbye to all clients."""
        self.server.close()

    def summary(self) -> dict[str, Any]:
        """Return what became of it; see ``FoxgloveServer.summary``."""
        return self.server.summary()

    def _add_topic(self, topic: Topic) -> int:
        """Offer a topic of whose kind there may be none, once; return its place."""
        if topic.name not in self._late:
            self._late[topic.name] = self.server.add(topic)
        return self._late[topic.name]

    def _begin(self) -> None:
        self._streams = Streams(
            self._mission, self._types, self._counted, structs=self._structs, add=self._add_topic
        )
        self._diagnostics = Diagnostics(
            self._mission, self._types, self._info.name, self._levels, self._counted
        )
