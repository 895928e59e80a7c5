"""Shows a recording without datagrams in Foxglove: its topics, with the schemas that it has."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from edoras_tools.io.foxglove.server import FoxgloveServer, ServerOptions
from edoras_tools.io.topics.recorded import RecordedStreams
from edoras_tools.io.topics.rows import lay_out

if TYPE_CHECKING:
    from edoras_tools.mission import Mission
    from edoras_tools.model import Columns, PacketBatch, SourceInfo, SourceStatistics
    from edoras_tools.ros import TypeStore


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
