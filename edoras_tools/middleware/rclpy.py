"""A node of an installed ROS 2, whatever its middleware, through ``rclpy``; see docs/zenoh.md."""

from __future__ import annotations

import time
from collections import defaultdict, deque
from contextlib import suppress
from importlib import import_module
from threading import Lock, Thread, current_thread
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.errors import ConfigError
from edoras_tools.middleware.names import check_name, node_name, unknown_options
from edoras_tools.ros.types.schema import full_name

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from edoras_tools.middleware.graph import Qos
    from edoras_tools.ros import TypeStore

_MODULES: Final = (
    "rclpy",
    "rclpy.context",
    "rclpy.executors",
    "rclpy.qos",
)
_ECHO_SECONDS: Final = 1.0
_MOST_ECHOES: Final = 10_000


class RclpyGraph:
    """A ``Graph`` over one ``rclpy`` node, in a context of its own, spun by a thread.

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
            self._node.create_subscription(kind, topic, receive, _profile(qos), raw=True)
        except Exception as error:  # rclpy raises RuntimeError, ValueError and classes of its own
            raise ConfigError(f"{topic}: refused by rclpy: {_line(error)}") from error

    def advertise(self, topic: str, type_name: str, qos: Qos) -> Callable[[bytes], None]:
        """Return what publishes one message of a topic; see ``Graph``. Once closed, it does nothing."""
        kind = self._type(topic, type_name)
        listening = self._echoes[topic]
        try:
            publisher = self._node.create_publisher(kind, topic, _profile(qos))
        except Exception as error:  # as in subscribe
            raise ConfigError(f"{topic}: refused by rclpy: {_line(error)}") from error

        def publish(cdr: bytes) -> None:
            with self._closing:
                if self._closed:
                    return
                for echoes in listening:
                    echoes.expect(cdr)
                publisher.publish(cdr)

        return publish

    def notes(self) -> list[str]:
        """See ``Graph``: ROS 2 itself logs incompatible peers."""
        return []

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
            if not self._closed:  # a context that goes away while it is waited for makes more than one
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
                f"{topic}: this ROS 2 has no {full_name(type_name)}: {_line(error)}; "
                "source the workspace that has it, or install its package"
            ) from error


class _Echoes:
    """Messages of its own node that a subscription is going to receive: rclpy cannot exclude them.

    An echo is told by its bytes. Where another node says just the same, it does not matter which of the two
    is left out.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._expected: deque[tuple[float, bytes]] = deque(maxlen=_MOST_ECHOES)

    def expect(self, cdr: bytes) -> None:
        """Note what is about to be published."""
        with self._lock:
            self._expected.append((time.monotonic(), cdr))

    def take(self, cdr: bytes) -> bool:
        """Tell whether what was heard is an echo; it is expected once less."""
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
        options: there are none.

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
        raise ConfigError(f"rclpy: no node {node!r} in domain {domain}: {_line(error)}") from error


def _profile(qos: Qos) -> Any:
    names = import_module("rclpy.qos")
    reliability, durability = names.ReliabilityPolicy, names.DurabilityPolicy
    history = names.HistoryPolicy
    return names.QoSProfile(
        history=history.KEEP_LAST if qos.depth else history.KEEP_ALL,
        depth=qos.depth,
        reliability=reliability.RELIABLE if qos.reliable else reliability.BEST_EFFORT,
        durability=durability.TRANSIENT_LOCAL if qos.transient_local else durability.VOLATILE,
    )


def _line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).partition("\n")[0]
