"""Foxglove instead of a ROS 2 graph: a bridge publishes to clients, and receives their messages.

Options: ``host`` and ``port`` of the server, port 0 for any free one (``server.url`` has it); ``origins`` of
web pages that may connect, besides those of Foxglove and of this machine; ``token`` that clients must have
in the URL.
A client that does not keep up loses messages, and does not delay the others.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.addons.foxglove.server.page import OriginCheck
from edoras_tools.addons.foxglove.server.protocol import Publisher
from edoras_tools.addons.foxglove.server.server import FoxgloveServer, ServerOptions
from edoras_tools.errors import CaptureError, ConfigError
from edoras_tools.io.net.sockets import reach_note
from edoras_tools.io.topics.messages import Records
from edoras_tools.io.topics.streams import Topic
from edoras_tools.middleware.graph import Graph, Qos, unknown_options
from edoras_tools.model import Endpoint

if TYPE_CHECKING:
    from edoras_tools.ros import TypeStore

_OPTIONS: Final = {"host": "127.0.0.1", "port": "8765", "origins": "", "token": ""}


def open_graph(
    store: TypeStore,
    node: str,
    *,
    domain: int = 0,  # noqa: ARG001  Foxglove has none
    options: Mapping[str, str] = {},
) -> FoxgloveGraph:
    """Serve a graph.

    Args:
        domain: ignored.
        options: ``host``, ``port``, ``origins`` with commas between, and ``token``.

    Raises:
        ConfigError: an option is not known, the address cannot be listened on, or ``websockets`` is absent.
    """
    if mistakes := unknown_options("foxglove", options, tuple(_OPTIONS)):
        raise ConfigError(*mistakes)
    values = {**_OPTIONS, **options}
    if not values["port"].isdecimal() or int(values["port"]) > 0xFFFF:
        raise ConfigError(f"--ros foxglove: port {values['port']!r} is not a TCP port: 0 to 65535")
    origins = [item for item in values["origins"].split(",") if item]
    listen = Endpoint(values["host"], int(values["port"]))
    return FoxgloveGraph(store, node, listen, origins, values["token"])


class FoxgloveGraph(Graph):
    """A Foxglove server as a node's graph; there are no policies, and the server counts dropped messages.

    Args:
        listen: address and port; with port 0 the system chooses.
        origins: origins of further web pages that may connect; see ``OriginCheck``.
        token: token that clients must have; empty: none is needed.

    Attributes:
        server: the server.

    Raises:
        ConfigError: the address cannot be used, an origin is not valid, or ``websockets`` is not installed.
    """

    def __init__(
        self, store: TypeStore, node: str, listen: Endpoint, origins: Sequence[str] = (), token: str = ""
    ) -> None:
        self._store = store
        self._places: dict[str, int] = {}
        self._types: dict[str, str] = {}
        self._receivers: defaultdict[str, list[Callable[[bytes], None]]] = defaultdict(list)
        self._notes: list[str] = []
        self._publisher = Publisher(store, self._unknown)
        check = OriginCheck(tuple(origins), self._notes.append)
        options = ServerOptions(listen, check, self._publisher, token=token)
        try:
            self.server = FoxgloveServer(node, (), store.definition, options)
        except CaptureError as error:
            raise ConfigError(f"--ros-option port: {error}") from None
        query = "/?token=... with its token" if token else ""
        self._notes.append(f"Foxglove connects to {self.server.url}{query}")
        may = "watch, and publish what is bridged to cFS"
        if note := reach_note(self.server.endpoint, may, "" if token else "a token asks for a word first"):
            self._notes.append(note)

    def subscribe(self, topic: str, type_name: str, qos: Qos, heard: Callable[[bytes], None]) -> None:
        """See ``Graph``."""
        self._check(topic, type_name)
        self._receivers[topic].append(heard)

        def send(cdr: bytes) -> None:
            for receive in self._receivers[topic]:
                receive(cdr)

        self._publisher.accept(topic, type_name, send)

    def advertise(self, topic: str, type_name: str, qos: Qos) -> Callable[[bytes], None]:
        """See ``Graph``."""
        self._check(topic, type_name)
        if topic not in self._places:
            self._places[topic] = self.server.add(Topic(topic, type_name))
        channel_id = np.array([self._places[topic]], np.uint16)

        def publish(cdr: bytes) -> None:
            now = np.array([time.time_ns()], np.uint64)
            records = Records(channel_id, now, np.zeros(1, np.int64), np.array([len(cdr)]), bytes(cdr))
            self.server.publish(records)

        return publish

    def notes(self) -> list[str]:
        """Return once the address for clients, and notes on refused web pages; see ``Graph``."""
        return [self._notes.pop(0) for _ in range(len(self._notes))]

    def close(self) -> None:
        """See ``Graph``."""
        self.server.close()

    def _check(self, topic: str, type_name: str) -> None:
        wrong = self._store.check(type_name)
        if wrong is not None:
            raise ConfigError(wrong)
        existing = self._types.setdefault(topic, type_name)
        if existing != type_name:
            raise ConfigError(f"{topic} is {existing} in this graph, not {type_name}; name one type")

    def _unknown(self, topic: str) -> str:
        return f"{topic}: nobody listens; topics: {', '.join(self._publisher.topics) or 'none'}"
