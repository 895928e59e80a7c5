"""A ROS 2 graph inside one process, for tests and demos: a message is delivered during the publishing call.

Quality of service is matched as DDS does: a subscription that asks for more than is offered receives nothing.
"""

from __future__ import annotations

import threading
from collections import defaultdict, deque
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Final

import msgspec

from edoras_tools.errors import ConfigError
from edoras_tools.middleware.graph import Graph, Qos, TopicState, unknown_options

if TYPE_CHECKING:
    from edoras_tools.ros import TypeStore


class _Subscription(msgspec.Struct, frozen=True, eq=False):
    node: LocalGraph
    qos: Qos
    heard: Callable[[bytes], None]


class _Publisher(msgspec.Struct, frozen=True, eq=False):
    node: LocalGraph
    qos: Qos
    last: deque[bytes]


class _Topic(msgspec.Struct, eq=False):
    type_name: str = ""
    subscriptions: tuple[_Subscription, ...] = ()
    publishers: tuple[_Publisher, ...] = ()


class _Domain(msgspec.Struct, eq=False):
    topics: dict[str, _Topic] = msgspec.field(default_factory=lambda: defaultdict(_Topic))
    lock: threading.RLock = msgspec.field(default_factory=threading.RLock)


_DOMAINS: Final[dict[int, _Domain]] = defaultdict(_Domain)


def open_graph(
    store: TypeStore, node: str, *, domain: int = 0, options: Mapping[str, str] = {}
) -> LocalGraph:
    """Join the graph of this process.

    Args:
        domain: ROS 2 domain; nodes of different domains are not connected.
        options: must be empty.

    Raises:
        ConfigError: an option is given.
    """
    if mistakes := unknown_options("local", options, ()):
        raise ConfigError(*mistakes)
    return LocalGraph(store, node, domain)


class LocalGraph(Graph):
    """A node of the graph.

    Attributes:
        node: name of the node.
    """

    def __init__(self, store: TypeStore, node: str, domain: int) -> None:
        self.node = node
        self._store = store
        self._domain = _DOMAINS[domain]
        self._closed = False

    def subscribe(self, topic: str, type_name: str, qos: Qos, heard: Callable[[bytes], None]) -> None:
        """See ``Graph``."""
        subscription = _Subscription(self, qos, heard)
        with self._domain.lock:
            topic_ = self._topic(topic, type_name)
            topic_.subscriptions += (subscription,)
            late = [
                cdr
                for publisher in topic_.publishers
                if qos.transient_local is not False
                and publisher.qos.transient_local
                and publisher.node is not self
                and _match(publisher.qos, qos)
                for cdr in publisher.last
            ]
        for cdr in late:
            heard(cdr)

    def advertise(self, topic: str, type_name: str, qos: Qos) -> Callable[[bytes], None]:
        """See ``Graph``."""
        publisher = _Publisher(self, qos, deque(maxlen=qos.depth or None))
        with self._domain.lock:
            topic_ = self._topic(topic, type_name)
            topic_.publishers += (publisher,)

        def publish(cdr: bytes) -> None:
            if self._closed:
                return
            with self._domain.lock:
                if qos.transient_local:
                    publisher.last.append(cdr)
                subscriptions = topic_.subscriptions
            for item in subscriptions:
                if item.node is not self and _match(qos, item.qos):
                    item.heard(cdr)

        return publish

    def states(self) -> Mapping[str, TopicState]:
        """See ``Graph``: a subscription that follows its publishers has their policies; nothing is lost."""
        with self._domain.lock:
            return {
                name: TopicState(tuple(dict.fromkeys(item.qos for item in topic.publishers)))
                for name, topic in self._domain.topics.items()
                if topic.publishers
            }

    def subscribers(self, topic: str) -> int:
        """See ``Graph``."""
        return sum(item.node is not self for item in self._domain.topics[topic].subscriptions)

    def close(self) -> None:
        """See ``Graph``."""
        with self._domain.lock:
            self._closed = True
            for name, topic in list(self._domain.topics.items()):
                topic.subscriptions = tuple(item for item in topic.subscriptions if item.node is not self)
                topic.publishers = tuple(item for item in topic.publishers if item.node is not self)
                if not topic.subscriptions and not topic.publishers:
                    del self._domain.topics[name]

    def _topic(self, name: str, type_name: str) -> _Topic:
        wrong = self._store.check(type_name)
        if wrong is not None:
            raise ConfigError(wrong)
        topic = self._domain.topics[name]
        if topic.type_name not in {"", type_name}:
            raise ConfigError(f"{name} is {topic.type_name} in this graph, not {type_name}; name one type")
        topic.type_name = type_name
        return topic


def _match(offered: Qos, requested: Qos) -> bool:
    """Return whether a publisher offers all requested policies; a followed policy is not requested."""
    pairs = (offered.reliable, requested.reliable), (offered.transient_local, requested.transient_local)
    return all(offer or not request for offer, request in pairs)
