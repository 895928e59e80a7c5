"""A node of an installed ROS 2, with any middleware, through ``rclpy``; see docs/zenoh.md."""

from __future__ import annotations

import time
from collections import defaultdict, deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from importlib import import_module
from threading import Lock, Thread, current_thread
from typing import TYPE_CHECKING, Any, Final

from msgspec.structs import replace

from edoras_tools.errors import ConfigError
from edoras_tools.middleware.graph import Graph, Qos, TopicState, check_name, node_name, unknown_options
from edoras_tools.ros.library import full_name

if TYPE_CHECKING:
    from edoras_tools.ros import TypeStore

_MODULES: Final = ("rclpy", "rclpy.context", "rclpy.event_handler", "rclpy.executors", "rclpy.qos")
_ECHO_SECONDS: Final = 1.0
_MOST_ECHOES: Final = 10_000
_FOLLOW_S: Final = 0.25
_LEAST_WAITING: Final = 1000
"""Least number of messages that may wait for the reading thread, whatever the depth."""


class RclpyGraph(Graph):
    """A ``Graph`` over one ``rclpy`` node, in its own context, spun by a thread.

    It has no notes: ROS 2 itself logs incompatible peers.

    Args:
        node: name of the node, or ``/namespace/name``.
        domain: ``ROS_DOMAIN_ID``.
    """

    def __init__(self, store: TypeStore, node: str, domain: int) -> None:
        namespace, name = node_name(node)
        rclpy, executors = import_module("rclpy"), import_module("rclpy.executors")
        self._store = store
        self._closing = Lock()
        self._closed = False
        self._echoes: defaultdict[str, list[_Echoes]] = defaultdict(list)
        self._listeners: list[_Listener] = []
        self._publishers: dict[str, Any] = {}
        self._context = import_module("rclpy.context").Context()
        rclpy.init(args=[], context=self._context, domain_id=domain)
        try:
            self._node = rclpy.create_node(
                name,
                context=self._context,
                namespace=namespace,
                use_global_arguments=False,
                start_parameter_services=False,
            )
        except Exception:
            self._context.try_shutdown()
            raise
        self._executor = executors.SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        shut_down = executors.ExternalShutdownException
        self._thread = Thread(target=self._spin, args=(shut_down,), daemon=True, name=name)
        self._thread.start()

    def subscribe(self, topic: str, type_name: str, qos: Qos, heard: Callable[[bytes], None]) -> None:
        """Call ``heard(cdr)`` for each message of a topic; see ``Graph``."""
        kind = self._type(topic, type_name)
        echoes = _Echoes()

        def receive(cdr: bytes) -> None:
            if not self._closed and not echoes.take(cdr):
                heard(cdr)

        self._echoes[topic].append(echoes)
        try:
            listener = _Listener(self._node, kind, topic, qos, receive)
            self._listeners.append(listener)
            if None in (qos.reliable, qos.transient_local):
                self._node.create_timer(_FOLLOW_S, listener.follow)
        except Exception as error:  # rclpy raises RuntimeError, ValueError and classes of its own
            raise ConfigError(f"{topic}: refused by rclpy: {rclpy_line(error)}") from error

    def advertise(self, topic: str, type_name: str, qos: Qos) -> Callable[[bytes], None]:
        """Return a function that publishes on a topic; see ``Graph``. After ``close`` it does nothing."""
        kind = self._type(topic, type_name)
        listening = self._echoes[topic]
        try:
            publisher = self._node.create_publisher(kind, topic, qos_profile(qos))
        except Exception as error:  # as in subscribe
            raise ConfigError(f"{topic}: refused by rclpy: {rclpy_line(error)}") from error

        self._publishers[topic] = publisher

        def publish(cdr: bytes) -> None:
            with self._closing:
                if self._closed:
                    return
                for echoes in listening:
                    echoes.expect(cdr)
                publisher.publish(cdr)

        return publish

    def states(self) -> Mapping[str, TopicState]:
        """See ``Graph``: ``missed`` is the count of rclpy's event ``message_lost``."""
        return {item.topic: TopicState((item.asked,), item.missed) for item in self._listeners}

    def subscribers(self, topic: str) -> int:
        """See ``Graph``."""
        return int(self._publishers[topic].get_subscription_count())

    def close(self) -> None:
        """Leave the graph; see ``Graph``."""
        with self._closing:
            if self._closed:
                return
            self._closed = True
        self._context.try_shutdown()
        if current_thread() is not self._thread:
            self._thread.join()
        self._executor.shutdown()
        self._node.destroy_node()

    def _spin(self, shut_down: type[Exception]) -> None:
        try:
            with suppress(shut_down):
                self._executor.spin()
        except Exception:
            if not self._closed:  # a context destroyed during the wait raises several kinds of errors
                raise

    def _type(self, topic: str, type_name: str) -> Any:
        check_name(topic, "topic")
        if why := self._store.check(type_name):
            raise ConfigError(f"{topic}: {why}")
        package, kind, name = full_name(type_name).split("/")
        try:
            return getattr(import_module(f"{package}.{kind}"), name)
        except (AttributeError, ImportError) as error:
            raise ConfigError(
                f"{topic}: this ROS 2 has no {full_name(type_name)}: {rclpy_line(error)}; "
                "source the workspace that has it, or install its package"
            ) from error


class _Listener:
    """A subscription; if it follows its publishers, it requests the policies that all offer, as rosbag2 does.

    It is replaced when these change. The old one stays for some time; a message that both receive counts
    once.

    Attributes:
        topic: name of the topic.
        asked: policies that it requests.
        missed: lost messages as counted by rclpy.
    """

    def __init__(self, node: Any, kind: Any, topic: str, qos: Qos, receive: Callable[[bytes], None]) -> None:
        self.topic, self.missed = topic, 0
        self._node, self._kind, self._qos, self._receive = node, kind, qos, receive
        self._recent: dict[tuple[int, int], None] = {}
        self.asked = self._adapted()
        self._subscriptions = [self._create()]

    def follow(self) -> None:
        """Request the policies that the publishers offer now."""
        for old in self._subscriptions[:-1]:
            self._node.destroy_subscription(old)
        del self._subscriptions[:-1]
        if (now := self._adapted()) != self.asked:
            self.asked = now
            self._subscriptions.append(self._create())

    def _adapted(self) -> Qos:
        names, own = import_module("rclpy.qos"), (self._node.get_name(), self._node.get_namespace())
        offers = [
            item.qos_profile
            for item in self._node.get_publishers_info_by_topic(self.topic)
            if (item.node_name, item.node_namespace) != own
        ]
        reliable = all(item.reliability == names.ReliabilityPolicy.RELIABLE for item in offers)
        lasting = all(item.durability == names.DurabilityPolicy.TRANSIENT_LOCAL for item in offers)
        return replace(
            self._qos,
            reliable=reliable if self._qos.reliable is None else self._qos.reliable,
            transient_local=(bool(offers) and lasting)
            if self._qos.transient_local is None
            else self._qos.transient_local,
        )

    def _create(self) -> Any:
        depth = self.asked.depth
        deep = depth if self.asked.transient_local or not depth else max(depth, _LEAST_WAITING)
        profile = qos_profile(replace(self.asked, depth=deep))
        lost_before = self.missed

        def lost(status: Any) -> None:
            self.missed = lost_before + status.total_count

        handlers = import_module("rclpy.event_handler")
        make = partial(self._node.create_subscription, self._kind, self.topic, self._hear, profile, raw=True)
        try:
            return make(event_callbacks=handlers.SubscriptionEventCallbacks(message_lost=lost))
        except handlers.UnsupportedEventTypeError:  # a middleware may not count
            return make()

    def _hear(self, cdr: bytes, info: Mapping[str, int]) -> None:
        key = info["source_timestamp"], info.get("publication_sequence_number", 0)
        if key in self._recent:
            return
        self._recent[key] = None
        if len(self._recent) > _LEAST_WAITING:
            del self._recent[next(iter(self._recent))]
        self._receive(cdr)


class _Echoes:
    """Messages of its own node that a subscription will receive: rclpy cannot exclude them.

    The bytes identify an echo. If another node sends the same bytes, it does not matter which of the two
    messages is left out.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._expected: deque[tuple[float, bytes]] = deque(maxlen=_MOST_ECHOES)

    def expect(self, cdr: bytes) -> None:
        """Record a message that is about to be published."""
        with self._lock:
            self._expected.append((time.monotonic(), cdr))

    def take(self, cdr: bytes) -> bool:
        """Return whether a received message is an echo; then one echo fewer is expected."""
        with self._lock:
            oldest = time.monotonic() - _ECHO_SECONDS
            while self._expected and self._expected[0][0] < oldest:
                self._expected.popleft()
            for place, (_, expected) in enumerate(self._expected):
                if expected == cdr:
                    del self._expected[place]
                    return True
        return False


def open_graph(
    store: TypeStore, node: str, *, domain: int = 0, options: Mapping[str, str] | None = None
) -> RclpyGraph:
    """Join the graph as a node.

    Args:
        node: name of the node, or ``/namespace/name``.
        domain: ``ROS_DOMAIN_ID``.
        options: must be empty.

    Raises:
        ConfigError: an option is given, or ``rclpy`` refuses.
        ImportError: no ROS 2 is sourced.
    """
    if mistakes := unknown_options("rclpy", options or (), ()):
        raise ConfigError(*mistakes)
    for module in _MODULES:
        import_module(module)
    try:
        return RclpyGraph(store, node, domain)
    except ConfigError:
        raise
    except Exception as error:  # as in subscribe
        raise ConfigError(f"rclpy: no node {node!r} in domain {domain}: {rclpy_line(error)}") from error


def qos_profile(qos: Qos) -> Any:
    """Return a quality of service as a profile of rclpy."""
    names = import_module("rclpy.qos")
    reliability, durability = names.ReliabilityPolicy, names.DurabilityPolicy
    history = names.HistoryPolicy
    return names.QoSProfile(
        history=history.KEEP_LAST if qos.depth else history.KEEP_ALL,
        depth=qos.depth,
        reliability=reliability.RELIABLE if qos.reliable else reliability.BEST_EFFORT,
        durability=durability.TRANSIENT_LOCAL if qos.transient_local else durability.VOLATILE,
    )


def rclpy_line(error: Exception) -> str:
    """Return the text of an rclpy error in one line."""
    return (str(error).strip() or type(error).__name__).partition("\n")[0]
