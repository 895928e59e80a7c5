"""A Foxglove WebSocket server: topics to any number of clients, none of which can hold up another or us."""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import threading
import time
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlencode

from edoras_tools.errors import CaptureError, ConfigError
from edoras_tools.model import Endpoint
from edoras_tools.sinks.foxglove_visitor import Visitor

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.sinks.foxglove_offer import Offer, PlaybackState
    from edoras_tools.sinks.mcap_rows import Records
    from edoras_tools.sinks.streams import Topic

_MOST: Final = 64
"""Clients at a time; each has threads and buffers of its own."""
_PAUSE_S: Final = 0.05


class FoxgloveServer:
    """Listens from construction on.

    Args:
        offer: what clients are offered.
        topics: what they may subscribe to, at least one; their places are the ids in what is published.
        listen: address and port; port 0 is the system's choice.

    Attributes:
        endpoint: what is listened on.
        departed: summaries of clients that have left.

    Raises:
        CaptureError: the address cannot be listened on.
        ConfigError: the SDK is not installed.
    """

    def __init__(self, offer: Offer, topics: Sequence[Topic], listen: Endpoint) -> None:
        sdk()
        self.departed: list[dict[str, Any]] = []
        self._offer = offer
        self._topics = list(topics)
        self._visitors: tuple[Visitor, ...] = ()
        self._lock = threading.Lock()
        self._closed = False
        self._door = _listen(listen)
        self.endpoint = Endpoint(*self._door.getsockname()[:2])
        self._thread = threading.Thread(target=self._receive, name="foxglove door", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """Where clients connect to."""
        host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(self.endpoint.address, self.endpoint.address)  # noqa: S104
        return f"ws://{Endpoint(host, self.endpoint.port)}"

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
        """Return what became of it, a row a client: those that left, then those that are there."""
        clients = [*self.departed, *(visitor.summary() for visitor in self._visitors)]
        return {
            "url": self.url,
            "clients": clients,
            "sent": sum(item["sent"] for item in clients),
            "dropped": sum(item["dropped"] for item in clients),
            "published": sum(item["published"] for item in clients),
            "refused": sum(item["refused"] for item in clients),
        }

    def close(self) -> None:
        """Say goodbye to all clients, and listen no more; calling it again does nothing."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
        with contextlib.suppress(OSError):
            self._door.shutdown(socket.SHUT_RDWR)  # wakes the thread
        self._thread.join()
        self._door.close()
        visitors = self._visitors
        for visitor in visitors:
            visitor.stop()
        for visitor in visitors:
            visitor.close()

    def _receive(self) -> None:
        while True:
            try:
                client, _ = self._door.accept()
            except OSError:
                if self._closed:
                    return
                time.sleep(_PAUSE_S)  # whoever came has gone, or there are no descriptors for more
                continue
            if len(self._visitors) >= _MOST:
                client.close()
                continue
            try:
                self._welcome(client)
            except (OSError, RuntimeError):  # it is gone already, or the system has no more of something
                client.close()

    def _welcome(self, client: socket.socket) -> None:
        with self._lock:
            if self._closed:
                client.close()
                return
            visitor = Visitor(client, self._offer, self._topics, self._left, self._steered)
            self._visitors = (*self._visitors, visitor)
            visitor.start()

    def _steered(self, by: Visitor, state: PlaybackState) -> None:
        for visitor in self._visitors:
            if visitor is not by:
                visitor.tell_state(state)

    def _left(self, visitor: Visitor) -> None:
        with self._lock:
            self._visitors = tuple(item for item in self._visitors if item is not visitor)
            if visitor.connected:
                self.departed.append(visitor.summary())


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


def _listen(endpoint: Endpoint) -> socket.socket:
    try:
        family, *_, address = socket.getaddrinfo(endpoint.address, endpoint.port, type=socket.SOCK_STREAM)[0]
        return socket.create_server(address[:2], family=family)
    except (OSError, UnicodeError, OverflowError) as error:
        number = getattr(error, "errno", None) or 0
        why = os.strerror(number) if number > 0 else getattr(error, "strerror", None) or str(error)
        raise CaptureError(
            f"{endpoint}: cannot be listened on: {why}; name another port (0: any that is free) or address"
        ) from None
