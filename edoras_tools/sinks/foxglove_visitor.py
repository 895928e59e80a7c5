"""One client of a Foxglove server: what it wants, what it was given, and what it was too slow for."""

from __future__ import annotations

import contextlib
import threading
import time
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np

from edoras_tools.model import Endpoint
from edoras_tools.sinks.foxglove_offer import PlaybackRequest
from edoras_tools.websocket import Relay, secluded

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from edoras_tools.sinks.foxglove_offer import Offer, PlaybackState
    from edoras_tools.sinks.mcap_rows import Records
    from edoras_tools.sinks.streams import Topic

ROOM: Final = 8192
"""Messages that may wait for a client."""
ROOM_BYTES: Final = 8 << 20
"""Bytes of messages that may wait for a client; one message may always."""
_TIMES: Final = 2
"""Times of the clock that may wait; a client that is behind needs no more of them."""
_CLOCK_NS: Final = 20_000_000
"""Times of the clock that are nearer than this are one."""
_SETTLED_S: Final = 0.25
"""What was given so long ago, and the server has nothing more to send: it has all come out."""
_ENCODINGS: Final = ("cdr", "json")


class Visitor:
    """A client, with a server of the SDK's all its own behind a relay.

    Args:
        client: an accepted connection.
        head: what it has sent already.
        offer: what all clients are offered.
        topics: what it may subscribe to.
        left: told when it has gone.
        steered: told when it has had the player obey, and where that is now.

    Attributes:
        greeted: it has been told where playback is.
        dropped: messages that it was too slow for.
        published: messages that were taken from it.
        refused: messages that were not.

    Raises:
        OSError: it is gone already.
    """

    def __init__(
        self,
        client: socket.socket,
        head: bytes,
        offer: Offer,
        topics: Sequence[Topic],
        left: Callable[[Visitor], None],
        steered: Callable[[Visitor, PlaybackState], None],
    ) -> None:
        import foxglove
        from foxglove.websocket import Capability

        self.dropped = self.published = self.refused = 0
        self._given = self._given_bytes = self._times = 0
        self._last_s = 0.0
        self._shown_ns = -_CLOCK_NS
        self._stopping = threading.Lock()
        self._offer = offer
        self._left, self._steered = left, steered
        self.greeted = False
        self._context = foxglove.Context()
        self._channels: list[Any] = []
        self._advertised: dict[int, Any] = {}
        for topic in topics:
            self.add(topic)
        capabilities = [Capability.Time]
        if offer.publisher is not None:
            capabilities.append(Capability.ClientPublish)
        address = secluded()
        self._server = foxglove.start_server(
            name=offer.name,
            host=address,
            port=0,
            capabilities=capabilities,
            server_listener=cast("Any", self),
            supported_encodings=list(_ENCODINGS) if offer.publisher is not None else None,
            context=self._context,
            session_id=offer.session or None,
            playback_time_range=offer.player.range_ns if offer.player is not None else None,
            # Twice what is ever in it: what is dropped is dropped here, and counted.
            message_backlog_size=2 * ROOM,
        )
        try:
            self._relay = Relay(client, head, Endpoint(address, self._server.port), self._gone)
        except OSError:
            self._server.stop()
            raise

    @property
    def connected(self) -> bool:
        """Whether it speaks the protocol."""
        return self._relay.accepted

    def start(self) -> None:
        """Let the client in."""
        self._relay.start()

    def stop(self) -> None:
        """Say goodbye; calling it again does nothing."""
        with self._stopping:  # the SDK's own may not be called twice at a time
            self._server.stop()

    def close(self) -> None:
        """Wait until it has gone."""
        self._relay.close()

    def add(self, topic: Topic) -> None:
        """Offer a topic."""
        import foxglove

        self._channels.append(
            # foxglove.Channel would be kept in a table of the SDK's for good.
            self._context._create_channel(  # noqa: SLF001
                topic.name,
                message_encoding="cdr",
                schema=foxglove.Schema(
                    name=topic.type, encoding="ros2msg", data=self._offer.definitions[topic.type].encode()
                ),
                metadata=dict(topic.metadata),
            )
        )

    def wants(self, place: int) -> bool:
        """Tell whether it has subscribed to a topic."""
        return bool(self._channels[place].has_sinks())

    def give(self, records: Records) -> None:
        """Give it messages of topics that it wants: the latest of them, where it has no room for all."""
        self._settle()
        subscribed = np.array([channel.has_sinks() for channel in self._channels])
        rows = np.flatnonzero(subscribed[records.channel_id])
        if not len(rows):
            return
        kept = self._fitting(records.end[rows] - records.start[rows])
        self.dropped += len(rows) - kept
        rows = rows[len(rows) - kept :]
        data, channels = records.data, self._channels
        for place, time_ns, start, end in zip(
            records.channel_id[rows].tolist(),
            records.log_time[rows].tolist(),
            records.start[rows].tolist(),
            records.end[rows].tolist(),
            strict=True,
        ):
            if channels[place].has_sinks():  # it may have thought better of it
                channels[place].log(data[start:end], time_ns)
                self._given += 1
                self._given_bytes += end - start
        self._last_s = time.monotonic()

    def tell_time(self, time_ns: int) -> None:
        """Have its clock show a time, unless it shows one about as late, or it is behind anyway."""
        self._settle()
        recent = 0 <= time_ns - self._shown_ns < _CLOCK_NS
        if self.connected and not recent and self._times - self._relay.passed.times < _TIMES:
            self._tell(self._server.broadcast_time, time_ns)
            self._shown_ns = time_ns
            self._times += 1
            self._last_s = time.monotonic()

    def tell_state(self, state: PlaybackState) -> None:
        """Tell it where playback is."""
        if self.connected:
            self.greeted = True
            self._tell(self._server.broadcast_playback_state, _state(state))

    def summary(self) -> dict[str, Any]:
        """Return what became of the messages that it wanted: sent, dropped, or waiting still."""
        return {
            "address": str(self._relay.client),
            "sent": self._relay.passed.messages,
            "bytes": self._relay.passed.octets,
            "dropped": self.dropped,
            "waiting": max(self._given - self._relay.passed.messages, 0),
            "published": self.published,
            "refused": self.refused,
        }

    def _fitting(self, length: NDArray[np.int64]) -> int:
        """Return how many of the last messages there is room for."""
        waiting = self._given - self._relay.passed.messages
        room = ROOM_BYTES - (self._given_bytes - self._relay.passed.octets)
        latest = np.cumsum(length[::-1][: max(ROOM - waiting, 0)])
        fits = int(np.searchsorted(latest, room, side="right"))
        return max(fits, 1) if waiting <= 0 else fits

    def _settle(self) -> None:
        """Put right what is thought to wait.

        A message may have been given just when the client unsubscribed, and never come out.
        """
        passed, idle_s = self._relay.passed, self._relay.idle_s
        if idle_s and time.monotonic() - max(idle_s, self._last_s) > _SETTLED_S:
            self._given, self._given_bytes, self._times = passed.messages, passed.octets, passed.times
        elif self._given < passed.messages:
            self._given, self._given_bytes = passed.messages, passed.octets

    def _gone(self) -> None:
        self.stop()
        for channel in self._channels:
            channel.close()
        self._left(self)

    def _say(self, text: str, about: str) -> None:
        """Have the client show a problem."""
        from foxglove import StatusLevel

        self._tell(self._server.publish_status, text, StatusLevel.Error, about)

    @staticmethod
    def _tell(say: Callable[..., None], *words: Any) -> None:
        # The SDK's server lets nobody in while it is being stopped; that is when the client has gone.
        with contextlib.suppress(RuntimeError):
            say(*words)

    # What the SDK calls, on threads of its own: these are the names of its ServerListener.

    def on_subscribe(self, _client: Any, _channel: Any) -> None:
        """Take note of nothing: what it wants is asked when there is something."""

    def on_unsubscribe(self, _client: Any, _channel: Any) -> None:
        """Take note of nothing."""

    def on_client_advertise(self, _client: Any, channel: Any) -> None:
        """Take the channel, or tell why nothing will be taken on it."""
        assert self._offer.publisher is not None
        self._advertised[channel.id] = channel
        encoding = channel.encoding
        why = self._offer.publisher.refusal(channel.topic, channel.schema_name, encoding)
        if why:
            self._say(why, channel.topic)

    def on_client_unadvertise(self, _client: Any, channel_id: int) -> None:
        """Forget the channel."""
        self._advertised.pop(channel_id, None)

    def on_message_data(self, _client: Any, channel_id: int, data: bytes) -> None:
        """Take a message, or tell why not."""
        channel = self._advertised.get(channel_id)
        if channel is None or self._offer.publisher is None:
            return
        why = self._offer.publisher.publish(channel.topic, channel.schema_name, channel.encoding, data)
        if why:
            self.refused += 1
            self._say(why, channel.topic)
        else:
            self.published += 1

    def on_playback_control_request(self, request: Any) -> Any:
        """Have the player obey."""
        from foxglove.websocket import PlaybackCommand

        assert self._offer.player is not None
        playing = request.playback_command == PlaybackCommand.Play
        wanted = PlaybackRequest(playing, request.playback_speed, request.seek_time)
        state = self._offer.player.control(wanted)
        self._steered(self, state)
        return _state(state, request.request_id)


def _state(state: PlaybackState, request_id: str | None = None) -> Any:
    from foxglove import websocket

    return websocket.PlaybackState(
        status=getattr(websocket.PlaybackStatus, state.status),
        current_time=state.time_ns,
        playback_speed=state.speed,
        did_seek=state.seeked,
        request_id=request_id,
    )
