"""A Foxglove WebSocket server: topics to many clients, none of which can delay another or the caller.

The publishing thread also sends as much as the sockets accept at once, because on a busy machine the server's
thread may not run for some time. The server's thread sends the rest, and does everything else. A lock
protects the connections; no thread waits while holding it, and publisher and player are called without it.
"""

from __future__ import annotations

import hmac
import math
import os
import re
import secrets
import selectors
import socket
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlencode

import msgspec
import numpy as np
from msgspec.structs import asdict

from edoras_tools.addons.foxglove.server import page, protocol
from edoras_tools.addons.foxglove.server.page import OriginCheck
from edoras_tools.errors import CaptureError, ConfigError
from edoras_tools.model import Endpoint

if TYPE_CHECKING:
    from edoras_tools.addons.foxglove.server.client import FoxgloveClient, SharedFrames
    from edoras_tools.addons.foxglove.server.protocol import PlaybackState, Player, Publisher
    from edoras_tools.io.topics.messages import Records
    from edoras_tools.io.topics.streams import Topic

HERE: Final = Endpoint("127.0.0.1", 8765)
"""Foxglove's default address of a server; other machines cannot reach it."""
MOST_CLIENTS: Final = 64
"""Maximum clients, and maximum connections that are not yet clients. If there are more of those, the oldest
one of the address with the most is closed."""
_BACKLOG: Final = 4096
"""Connections that the kernel keeps until they are accepted; it drops the request of a further one, and that
client tries again only after 1, 3 and 7 s."""
_AT_ONCE: Final = 256
"""Connections accepted before the others are served."""
PATIENCE_S: Final = 5.0
"""Maximum time until a connection must become a client, s."""
_GOODBYE_S: Final = 1.0
_PAUSE_S: Final = 0.05
_BUFFER_BYTES: Final = 1 << 18
"""Bytes that the kernel may hold for a client; they can no longer be dropped."""
_MOST_LISTED: Final = 256
"""Clients that have left and are listed individually; earlier ones are summed up."""
_MOST_TOLD: Final = 8
"""Maximum number of different refusals that are reported, because there can be any number of them."""
_MOST_TEXT: Final = 160
"""Maximum characters of a reason that are reported."""
_SUMS: Final = ("sent", "dropped", "published", "refused")


@dataclass(frozen=True, slots=True)
class ServerOptions:
    """Settings of the server.

    Attributes:
        listen: address and port; with port 0 the system chooses.
        origins: web pages that may connect.
        publisher: handles messages that clients publish; None: they may not publish.
        player: plays a recording; None: the traffic is live.
        token: clients must give it in the URL, ``?token=...``; empty: no token is needed.
    """

    listen: Endpoint = HERE
    origins: OriginCheck = field(default_factory=OriginCheck)
    publisher: Publisher | None = None
    player: Player | None = None
    token: str = field(default="", repr=False)


class _Connection(msgspec.Struct, eq=False):
    """A socket and its client.

    Attributes:
        until: time when it is closed at the latest, monotonic, s.
        stuck: whether the server's thread waits until the socket accepts more.
    """

    socket: socket.socket
    client: FoxgloveClient
    until: float
    stuck: bool = False

    def send(self) -> bool:
        """Send as much as the socket accepts; return whether anything remains.

        Raises:
            OSError: the other end has closed.
        """
        pieces = self.client.to_send()
        if pieces:
            with suppress(BlockingIOError):
                self.client.advance(self.socket.sendmsg(pieces))
        return bool(self.client.to_send())


class FoxgloveServer:
    """A server that listens from construction on.

    Args:
        name: name shown by clients.
        topics: topics to offer; their indices are the channel ids of published messages.
        definition: returns the complete ``ros2msg`` text of a topic's type.

    Attributes:
        endpoint: the address that it listens on.
        link_state: returns the state of a link for its page; None: the page counts the topics' messages.

    Raises:
        CaptureError: the address cannot be used.
        ConfigError: ``websockets`` is not installed.
    """

    def __init__(
        self,
        name: str,
        topics: Sequence[Topic],
        definition: Callable[[str], str],
        options: ServerOptions = ServerOptions(),
    ) -> None:
        if find_spec("websockets") is None:
            raise ConfigError(
                "Foxglove needs websockets, which is not installed: pip install 'edoras-tools[live]'"
            )
        self._name, self._definition, self._options = name, definition, options
        self._channels = [
            protocol.channel(place, topic, definition(topic.type)) for place, topic in enumerate(topics)
        ]
        self._counts = np.zeros(len(topics), np.int64)
        self.link_state: Callable[[], dict[str, Any]] | None = None
        self._shared = page.SharedState(self._page_state, time.monotonic)
        self._session = secrets.token_hex(8)
        self._lock = threading.Lock()
        self._connections: dict[socket.socket, _Connection] = {}
        self._open: tuple[_Connection, ...] = ()
        self._departed: deque[dict[str, Any]] = deque()
        self._before: Counter[str] = Counter()
        self._warnings: set[str] = set()
        self._closing = self._woken = False
        self._listener = _listen(options.listen)
        self.endpoint = Endpoint(*self._listener.getsockname()[:2])
        self._wake_end, self._waker = socket.socketpair()
        self._selector = selectors.DefaultSelector()
        for opened in (self._listener, self._wake_end, self._waker):
            opened.setblocking(False)
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._selector.register(self._wake_end, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._run, name="foxglove", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """The URL that clients connect to."""
        host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(self.endpoint.address, self.endpoint.address)  # noqa: S104
        return f"ws://{Endpoint(host, self.endpoint.port)}"

    @property
    def asks_token(self) -> bool:
        """Whether clients must give a token."""
        return bool(self._options.token)

    @property
    def page_url(self) -> str:
        """The URL of the server's own page."""
        return f"http{self.url.removeprefix('ws')}/"

    @property
    def app_url(self) -> str:
        """The URL that opens Foxglove with this server, without the token, because its site would see it."""
        query = urlencode({"ds": "foxglove-websocket", "ds.url": self.url}, safe="/:")
        return f"https://app.foxglove.dev/?{query}"

    @property
    def clients(self) -> tuple[FoxgloveClient, ...]:
        """The connected clients."""
        return tuple(connection.client for connection in self._open)

    def add(self, topic: Topic) -> int:
        """Offer another topic; return its index."""
        definition = self._definition(topic.type)
        with self._lock:
            place = len(self._channels)
            self._channels.append(protocol.channel(place, topic, definition))
            self._counts = np.append(self._counts, 0)
            for client in self.clients:
                client.add_topic()
                client.tell(protocol.advertise(self._channels[place:]))
        self._wake()
        return place

    def has_subscribers(self, place: int) -> bool:
        """Return whether any client has subscribed to a topic."""
        return any(client.wants(place) for client in self.clients)

    @property
    def subscriptions(self) -> int:
        """Total number of the clients' subscriptions."""
        return sum(client.subscriptions for client in self.clients)

    def publish(self, records: Records) -> None:
        """Queue messages for their subscribers; never waits for a client."""
        counts = np.bincount(records.channel_id)
        with self._lock:
            self._counts[: len(counts)] += counts
        shared: dict[tuple[bytes, int], SharedFrames] = {}
        self._each(lambda client: client.give(records, shared))

    def changed(self) -> None:
        """Show browsers the present result of ``link_state``."""
        self._shared.changed()

    def tell_time(self, time_ns: int) -> None:
        """Send a time for the clients' clocks, ns since 1970."""
        self._each(lambda client: client.tell_time(time_ns))

    def tell_state(self, state: PlaybackState) -> None:
        """Send the state of playback to clients; each also gets it when it connects."""
        text = protocol.playback_state(state)
        self._each(lambda client: client.tell(text) if client.plays else None)

    def summary(self) -> dict[str, Any]:
        """Return counts, one row for each client: those that left last, then the connected ones."""
        with self._lock:
            clients = [*self._departed, *(client.summary() for client in self.clients)]
            sums = {key: self._before[key] + sum(item[key] for item in clients) for key in _SUMS}
            connections = self._before["clients"] + len(clients)
        return {"url": self.url, "connections": connections, "clients": clients, **sums}

    def close(self) -> None:
        """Close all clients and stop listening; calling it again does nothing."""
        self._closing = True
        self._wake()
        self._thread.join()
        for opened in (self._wake_end, self._waker):
            opened.close()
        self._selector.close()

    def _each(self, act: Callable[[FoxgloveClient], None]) -> None:
        with self._lock:
            remains = False
            for connection in self._open:
                act(connection.client)
                with suppress(OSError):  # it has closed; the server's thread notices this too
                    remains |= connection.send() or connection.client.failed
        if remains:
            self._wake()

    def _wake(self) -> None:
        if not self._woken:
            self._woken = True
            with suppress(OSError):  # it is already awake, or closed
                self._waker.send(b"\0")

    # The following runs on the server's thread.

    def _run(self) -> None:
        closing = False
        while not closing or self._connections:
            until = min((item.until for item in self._connections.values()), default=math.inf)
            wait = None if until == math.inf else max(until - time.monotonic(), 0)
            for key, _ in self._selector.select(wait):
                if key.fileobj is self._listener:
                    self._accept_all()
                elif key.fileobj is self._wake_end:
                    self._wake_end.recv(4096)
                elif key.fileobj in self._connections:
                    self._receive(key.data)
            self._woken = False  # first, so that later calls wake it again
            if self._closing and not closing:
                closing = True
                self._end()
            now = time.monotonic()
            for connection in tuple(self._connections.values()):
                due = connection.stuck or connection.until <= now or connection.client.due
                if due and not self._send(connection, now):
                    if connection.client.failed:
                        address = connection.client.address.address
                        self._tell(f"a client at {address} was disconnected: it does not read its answers")
                    self._remove(connection)

    def _accept_all(self) -> None:
        """Accept waiting connections and read their requests at once, so that few are closed without one."""
        strangers = {item: None for item in self._connections.values() if not item.client.opened}
        for _ in range(_AT_ONCE):
            try:
                connection = self._accept()
            except BlockingIOError:
                return
            except OSError:
                time.sleep(_PAUSE_S)  # the other end has closed, or there are no more file descriptors
                return
            self._receive(connection)
            if not connection.client.opened:
                strangers[connection] = None
            if len(strangers) > MOST_CLIENTS:
                addresses = Counter(item.client.address.address for item in strangers)
                most = addresses.most_common(1)[0][0]
                oldest = next(item for item in strangers if item.client.address.address == most)
                del strangers[oldest]
                self._remove(oldest)

    def _accept(self) -> _Connection:
        # ``websockets`` takes 30 ms to import.
        from edoras_tools.addons.foxglove.server.client import FoxgloveClient

        accepted, address = self._listener.accept()
        accepted.setblocking(False)
        accepted.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        accepted.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)
        publishes, controls = self._options.publisher is not None, self._options.player is not None
        client = FoxgloveClient(Endpoint(*address[:2]), publishes=publishes, controls=controls)
        connection = _Connection(accepted, client, time.monotonic() + PATIENCE_S)
        self._connections[accepted] = connection
        self._selector.register(accepted, selectors.EVENT_READ, connection)
        return connection

    def _receive(self, connection: _Connection) -> None:
        try:
            data = connection.socket.recv(_BUFFER_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        with self._lock:
            events = connection.client.receive(data)
        for event in events:
            self._answer(connection, event)
        if not data:
            connection.until = 0

    def _answer(self, connection: _Connection, event: protocol.ClientEvent) -> None:
        client, publisher, player = connection.client, self._options.publisher, self._options.player
        match event:
            case protocol.Published(channel, data) if publisher is not None:
                why = publisher.publish(*channel[1:], data)
                with self._lock:
                    client.answer(channel, why)
            case protocol.Control(request, request_id) if player is not None:
                state = player.control(request)
                with self._lock:
                    for other in self.clients:
                        if other.plays:
                            text = protocol.playback_state(state, request_id if other is client else "")
                            other.tell(text)
            case protocol.RequestRefused(why):
                self._tell(f"a client at {client.address.address} was refused: {_readable(why)}")
            case protocol.Opening():
                self._admit(connection, event)

    def _admit(self, connection: _Connection, opening: protocol.Opening) -> None:
        origin, token, host, path = opening
        options, client, player = self._options, connection.client, self._options.player
        state = [] if player is None else [protocol.playback_state(player.state)]
        refusal, warning = f"a client at {client.address.address} was refused", ""
        with self._lock:
            if origin is not None and not options.origins.admits(origin):
                client.refuse(403, "Pages of this origin may not connect; --allow-origin allows them.")
                name = _readable(origin, "!")[:100]
                warning = f"a web page of {name} was refused as a client; --allow-origin {name} allows it"
            elif options.token and not _same(token, options.token):
                client.refuse(401, "A token is required: connect to this address with ?token=... at its end.")
                wrong = "wrong" if token else "missing"
                warning = f"{refusal}: its token is {wrong}; give ?token=... in the address"
            elif path and not options.origins.admits_host(host):
                client.refuse(403, "Open this page by the server's address; --allow-origin allows this name.")
                name = f"http://{_readable(host, '!')[:100]}"
                warning = f"a page of {name} was refused; --allow-origin {name} allows that name"
            elif path:
                client.serve(page.answer(path, self._shared))
                connection.until = time.monotonic() + PATIENCE_S
            elif len(self._open) >= MOST_CLIENTS:
                client.refuse(503, f"{MOST_CLIENTS} clients are connected, which is the maximum.")
                warning = f"{refusal}: {MOST_CLIENTS} clients are connected, which is the maximum"
            else:
                publish = options.publisher is not None
                range_ns = player.range_ns if player is not None and client.plays else None
                info = protocol.server_info(self._name, self._session, publish=publish, range_ns=range_ns)
                answers = [info, protocol.advertise(self._channels), *(state if client.plays else ())]
                client.accept(len(self._channels), answers)
                self._open = (*self._open, connection)
                connection.until = math.inf
        if warning:
            self._tell(warning)

    def _page_state(self) -> dict[str, Any]:
        """Return the state for the page."""
        player, clients = self._options.player, [client.summary() for client in self.clients]
        playback = None
        if player is not None:
            times = dict(zip(("start_ns", "end_ns"), player.range_ns, strict=True))
            playback = {**asdict(player.state), **times, "waiting": player.waiting}
        topics = zip(self._channels, self._counts.tolist(), strict=False)
        return {
            "schema": 1,
            "name": self._name,
            "url": self.url,
            "app_url": self.app_url,
            "clients": len(clients),
            **{name: sum(item[name] for item in clients) for name in _SUMS},
            "playback": playback,
            "link": self.link_state() if self.link_state else None,
            "topics": [
                {"topic": item["topic"], "type": item["schemaName"], "messages": count}
                for item, count in topics
            ],
        }

    def _tell(self, warning: str) -> None:
        tell = self._options.origins.tell
        if tell is not None and warning not in self._warnings and len(self._warnings) < _MOST_TOLD:
            self._warnings.add(warning)
            tell(warning)

    def _send(self, connection: _Connection, now: float) -> bool:
        """Send as much as a socket accepts; return whether to keep the connection."""
        opened, client = connection.socket, connection.client
        try:
            with self._lock:
                remains = connection.send()
            if client.ending and not remains:
                opened.shutdown(socket.SHUT_WR)
        except OSError:
            return False
        if client.ending:
            connection.until = min(connection.until, now + _GOODBYE_S)
        if remains != connection.stuck:
            connection.stuck = remains
            events = selectors.EVENT_READ | (selectors.EVENT_WRITE if remains else 0)
            self._selector.modify(opened, events, connection)
        return connection.until > now and not client.failed

    def _remove(self, connection: _Connection) -> None:
        opened, client = connection.socket, connection.client
        self._selector.unregister(opened)
        del self._connections[opened]
        with self._lock:  # no other thread may be sending on it
            with suppress(OSError):
                opened.shutdown(socket.SHUT_RDWR)
            opened.close()
            if client.opened:
                self._open = tuple(item for item in self._open if item is not connection)
                self._departed.append(client.summary())
                if len(self._departed) > _MOST_LISTED:
                    first = self._departed.popleft()
                    self._before.update({"clients": 1, **{key: first[key] for key in _SUMS}})

    def _end(self) -> None:
        self._selector.unregister(self._listener)
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        until = time.monotonic() + _GOODBYE_S
        with self._lock:
            for connection in self._connections.values():
                connection.until = until if connection.client.opened else 0
                connection.client.close()


def _readable(text: str, first: str = " ") -> str:
    """Return a client's text with ``?`` for characters outside ``first`` to ``~``, cut to ``_MOST_TEXT``."""
    return re.sub(rf"[^{first}-~]", "?", text)[:_MOST_TEXT]


def _same(offered: str, token: str) -> bool:
    """Compare tokens in constant time, so that the time does not show how much is correct."""
    return hmac.compare_digest(offered.encode(errors="surrogatepass"), token.encode(errors="surrogatepass"))


def _listen(endpoint: Endpoint) -> socket.socket:
    try:
        family, *_, address = socket.getaddrinfo(endpoint.address, endpoint.port, type=socket.SOCK_STREAM)[0]
        return socket.create_server(address[:2], family=family, backlog=_BACKLOG)
    except (OSError, UnicodeError, OverflowError) as error:
        number = getattr(error, "errno", None) or 0
        why = os.strerror(number) if number > 0 else getattr(error, "strerror", None) or str(error)
        raise CaptureError(
            f"{endpoint}: cannot listen: {why}; name another port (--live, 0: any free one) or address"
        ) from None
