"""A Foxglove WebSocket server: topics to any number of clients, none of which can hold up another or us."""

from __future__ import annotations

import logging
import threading
from collections import Counter, deque
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlencode

from edoras_tools.errors import ConfigError
from edoras_tools.sinks.foxglove_visitor import Visitor
from edoras_tools.websocket import MOST, Door

if TYPE_CHECKING:
    import socket
    from collections.abc import Sequence

    from edoras_tools.model import Endpoint
    from edoras_tools.sinks.foxglove_offer import Offer, PlaybackState
    from edoras_tools.sinks.mcap_rows import Records
    from edoras_tools.sinks.streams import Topic

_LISTED: Final = 256
"""Clients that have left and are told of one by one; those before are added up."""
_SUMS: Final = ("sent", "dropped", "published", "refused")


class FoxgloveServer:
    """Listens from construction on.

    Args:
        offer: what clients are offered.
        topics: what they may subscribe to, at least one; their places are the ids in what is published.
        listen: address and port; port 0 is the system's choice.

    Attributes:
        endpoint: what is listened on.

    Raises:
        CaptureError: the address cannot be listened on.
        ConfigError: the SDK is not installed.
    """

    def __init__(self, offer: Offer, topics: Sequence[Topic], listen: Endpoint) -> None:
        sdk()
        self._departed: deque[dict[str, Any]] = deque()
        self._before: Counter[str] = Counter()
        self._offer = offer
        self._topics = list(topics)
        self._visitors: tuple[Visitor, ...] = ()
        self._lock = threading.Lock()
        self._closed = False
        self._door = Door(listen, offer.guard, self._welcome)
        self.endpoint = self._door.endpoint

    @property
    def url(self) -> str:
        """Where clients connect to."""
        return self._door.url

    @property
    def app_url(self) -> str:
        """What opens Foxglove on it."""
        return "https://app.foxglove.dev/?" + urlencode(
            {"ds": "foxglove-websocket", "ds.url": self.url}, safe="/:"
        )

    @property
    def visitors(self) -> tuple[Visitor, ...]:
        """The clients there are."""
        return tuple(visitor for visitor in self._visitors if visitor.connected)

    def add(self, topic: Topic) -> int:
        """Offer another topic; return its place."""
        with self._lock:
            self._topics.append(topic)
            for visitor in self._visitors:
                visitor.add(topic)
            return len(self._topics) - 1

    def wanted(self, place: int) -> bool:
        """Tell whether any client has subscribed to a topic."""
        return any(visitor.wants(place) for visitor in self._visitors)

    def publish(self, records: Records) -> None:
        """Give messages to those who want them; never waits for anybody."""
        for visitor in self._visitors:
            visitor.give(records)

    def tell_time(self, time_ns: int) -> None:
        """Have the clock of clients show a time, ns since 1970."""
        for visitor in self._visitors:
            visitor.tell_time(time_ns)

    def tell_state(self, state: PlaybackState, *, newcomers: bool = False) -> None:
        """Tell clients where playback is: all, or those who have not been told yet."""
        for visitor in self._visitors:
            if not (newcomers and visitor.greeted):
                visitor.tell_state(state)

    def summary(self) -> dict[str, Any]:
        """Return what became of it, a row a client: the latest that left, then those that are there."""
        clients = [*self._departed, *(visitor.summary() for visitor in self._visitors)]
        sums = {key: self._before[key] + sum(item[key] for item in clients) for key in _SUMS}
        return {
            "url": self.url,
            "connections": self._before["clients"] + len(clients),
            "clients": clients,
            **sums,
        }

    def close(self) -> None:
        """Say goodbye to all clients, and listen no more; calling it again does nothing."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
        self._door.close()
        visitors = self._visitors
        for visitor in visitors:
            visitor.stop()
        for visitor in visitors:
            visitor.close()

    def _welcome(self, client: socket.socket, head: bytes) -> None:
        with self._lock:
            if self._closed or len(self._visitors) >= MOST:
                raise ConnectionRefusedError
            visitor = Visitor(client, head, self._offer, self._topics, self._left, self._steered)
            visitor.start()
            self._visitors = (*self._visitors, visitor)

    def _steered(self, by: Visitor, state: PlaybackState) -> None:
        for visitor in self._visitors:
            if visitor is not by:
                visitor.tell_state(state)

    def _left(self, visitor: Visitor) -> None:
        with self._lock:
            self._visitors = tuple(item for item in self._visitors if item is not visitor)
            if visitor.connected:
                self._departed.append(visitor.summary())
            if len(self._departed) > _LISTED:
                first = self._departed.popleft()
                self._before.update({"clients": 1, **{key: first[key] for key in _SUMS}})


def sdk() -> Any:
    """Return the SDK's module.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        import foxglove
    except ImportError:
        raise ConfigError(
            "Foxglove needs foxglove-sdk, which is not installed: pip install 'edoras-tools[live]'"
        ) from None
    logger = logging.getLogger("foxglove")
    if not logger.handlers:
        # Python prints the warnings of those who have no handler; a broken handshake is nobody's business.
        logger.addHandler(logging.NullHandler())
    return foxglove
