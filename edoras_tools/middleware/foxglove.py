"""Foxglove in the place of a ROS 2 graph: what a bridge publishes is shown, what clients publish is heard.

Options: ``host`` and ``port`` of the server; port 0 is any that is free, ``FoxgloveGraph.url`` says which;
``origins`` of web pages that may connect beside Foxglove's and this machine's.
A client that does not keep up loses messages, and holds up nobody; ``edoras live`` also counts them.
"""

from __future__ import annotations

import json
import logging
import threading
from collections import defaultdict
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, cast

from edoras_tools.errors import ConfigError, EdorasError
from edoras_tools.middleware.names import unknown_options
from edoras_tools.model import Endpoint
from edoras_tools.websocket import MOST, Door, Guard, Relay, secluded

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable, Mapping, Sequence

    from edoras_tools.middleware.graph import Qos
    from edoras_tools.ros import TypeStore

ENCODINGS: Final = ("cdr", "json")
"""What clients may publish."""
_OPTIONS: Final = {"host": "127.0.0.1", "port": "8765", "origins": ""}


def open_graph(
    store: TypeStore,
    node: str,
    *,
    domain: int = 0,  # noqa: ARG001  Foxglove has none
    options: Mapping[str, str] = {},
) -> FoxgloveGraph:
    """Serve a graph.

    Args:
        store: the types that are known.
        node: name of the server.
        domain: not looked at.
        options: ``host``, ``port``, and ``origins`` with commas between.

    Raises:
        ConfigError: an option is not known, or the address cannot be listened on.
        ImportError: the SDK is not installed.
    """
    if mistakes := unknown_options("foxglove", options, tuple(_OPTIONS)):
        raise ConfigError(*mistakes)
    given = {**_OPTIONS, **options}
    if not given["port"].isdecimal() or int(given["port"]) > 0xFFFF:
        raise ConfigError(f"--ros foxglove: port {given['port']!r} is no TCP port: 0 to 65535")
    origins = [item for item in given["origins"].split(",") if item]
    return FoxgloveGraph(store, node, Endpoint(given["host"], int(given["port"])), origins)


class FoxgloveGraph:
    """A Foxglove WebSocket server as a node's graph.

    Args:
        store: the types that are known.
        node: name of the server.
        listen: address and port; port 0 is the system's choice.
        origins: of further web pages that may connect; see ``Guard``.

    Attributes:
        url: where clients connect to.
        refused: messages that were not what their topic takes.

    Raises:
        ConfigError: the address cannot be listened on, or an origin is none.
        ImportError: the SDK is not installed.
    """

    def __init__(self, store: TypeStore, node: str, listen: Endpoint, origins: Sequence[str] = ()) -> None:
        import foxglove
        from foxglove.websocket import Capability

        logging.getLogger("foxglove").addHandler(logging.NullHandler())
        self._store = store
        self._context = foxglove.Context()
        self._channels: dict[str, Any] = {}
        self._types: dict[str, str] = {}
        self._heard: defaultdict[str, list[Callable[[bytes], None]]] = defaultdict(list)
        self._advertised: dict[tuple[int, int], Any] = {}
        self._lock = threading.Lock()
        self._closed = False
        self.refused = 0
        address = secluded()
        self._server = foxglove.start_server(
            name=node,
            host=address,
            port=0,
            capabilities=[Capability.ClientPublish],
            server_listener=cast("Any", self),
            supported_encodings=list(ENCODINGS),
            context=self._context,
        )
        self._inner = Endpoint(address, self._server.port)
        self._relays: set[Relay] = set()
        self._notes: list[str] = []
        try:
            self._door = Door(listen, Guard(tuple(origins), self._notes.append), self._welcome)
        except EdorasError as error:
            self._server.stop()
            raise ConfigError(f"--ros-option port: {error}") from None
        self.url = self._door.url
        self._notes.append(f"Foxglove connects to {self.url}")

    def subscribe(
        self,
        topic: str,
        type_name: str,
        qos: Qos,  # noqa: ARG002  there is one way only
        heard: Callable[[bytes], None],
    ) -> None:
        """See ``Graph``."""
        self._know(topic, type_name)
        with self._lock:
            self._heard[topic].append(heard)

    def advertise(self, topic: str, type_name: str, qos: Qos) -> Callable[[bytes], None]:  # noqa: ARG002
        """See ``Graph``."""
        import foxglove

        self._know(topic, type_name)
        with self._lock:
            if topic not in self._channels:
                text = self._store.definition(type_name).encode()
                schema = foxglove.Schema(name=type_name, encoding="ros2msg", data=text)
                channel = foxglove.Channel(
                    topic, message_encoding="cdr", schema=schema, context=self._context
                )
                self._channels[topic] = channel.base
        log = self._channels[topic].log

        def publish(cdr: bytes) -> None:
            if not self._closed:
                log(bytes(cdr))

        return publish

    def notes(self) -> list[str]:
        """Say once where clients connect to, and which web pages were kept out; see ``Graph``."""
        return [self._notes.pop(0) for _ in range(len(self._notes))]

    def close(self) -> None:
        """See ``Graph``."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            self._heard.clear()
        self._door.close()
        self._server.stop()
        for relay in tuple(self._relays):
            relay.close()
        for channel in self._channels.values():
            channel.close()

    def _welcome(self, client: socket.socket, head: bytes) -> None:
        with self._lock:
            if self._closed or len(self._relays) >= MOST:
                raise ConnectionRefusedError
            relay = Relay(client, head, self._inner, lambda: self._relays.discard(relay))
            self._relays.add(relay)
            relay.start()

    def _know(self, topic: str, type_name: str) -> None:
        wrong = self._store.check(type_name)
        if wrong is not None:
            raise ConfigError(wrong)
        known = self._types.setdefault(topic, type_name)
        if known != type_name:
            raise ConfigError(f"{topic} is {known} in this graph, not {type_name}; name one type")

    def _say(self, text: str, about: str) -> None:
        from foxglove import StatusLevel

        with suppress(RuntimeError):  # it is being stopped
            self._server.publish_status(text, StatusLevel.Error, about)

    def _refusal(self, channel: Any) -> str:
        wanted = self._types.get(channel.topic)
        if wanted is None or not self._heard.get(channel.topic):
            return f"{channel.topic}: nobody listens; topics: {', '.join(sorted(self._heard)) or 'none'}"
        if full_type(channel.schema_name) != wanted:
            return f"{channel.topic} takes {wanted}, not {channel.schema_name or 'a type without name'}"
        if channel.encoding not in ENCODINGS:
            return f"{channel.topic}: {channel.encoding} is not understood; publish {' or '.join(ENCODINGS)}"
        return ""

    # What the SDK calls, on threads of its own: these are the names of its ServerListener.

    def on_subscribe(self, _client: Any, _channel: Any) -> None:
        """Take note of nothing."""

    def on_unsubscribe(self, _client: Any, _channel: Any) -> None:
        """Take note of nothing."""

    def on_client_advertise(self, client: Any, channel: Any) -> None:
        """Take the channel, or tell why nothing will be heard on it."""
        self._advertised[client.id, channel.id] = channel
        why = self._refusal(channel)
        if why:
            self._say(why, channel.topic)

    def on_client_unadvertise(self, client: Any, channel_id: int) -> None:
        """Forget the channel."""
        self._advertised.pop((client.id, channel_id), None)

    def on_message_data(self, client: Any, channel_id: int, data: bytes) -> None:
        """Hand a message to those who listen, or tell why not."""
        channel = self._advertised.get((client.id, channel_id))
        if channel is None or self._closed:
            return
        why = self._refusal(channel)
        if not why:
            try:
                cdr = as_cdr(self._store, self._types[channel.topic], channel.encoding, bytes(data))
            except EdorasError as error:
                why = f"{channel.topic}: {error}"
        if why:
            self.refused += 1
            self._say(why, channel.topic)
            return
        with self._lock:
            for heard in self._heard[channel.topic]:
                heard(cdr)


def full_type(name: str) -> str:
    """Return ``PACKAGE/msg/NAME`` also of ROS 1's short form, which clients may write."""
    package, _, last = name.rpartition("/")
    return f"{package.removesuffix('/msg')}/msg/{last}"


def as_cdr(store: TypeStore, type_name: str, encoding: str, data: bytes) -> bytes:
    """Return what a client published as CDR.

    Args:
        store: knows the type.
        type_name: of the message.
        encoding: one of ``ENCODINGS``.
        data: the message.

    Raises:
        EdorasError: it is no such message.
    """
    if encoding == "cdr":
        store.decode(type_name, data)
        return data
    try:
        values = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"is no JSON: {error}") from None
    if not isinstance(values, dict):
        raise ConfigError("a message is a JSON object")
    return store.encode(type_name, values)
