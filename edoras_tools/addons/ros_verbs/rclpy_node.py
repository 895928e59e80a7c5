"""An observer's node of an installed ROS 2, through ``rclpy``: metadata of messages and endpoints."""

from __future__ import annotations

import time
from collections.abc import Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.errors import ConfigError
from edoras_tools.middleware.graph import Qos, node_name, unknown_options
from edoras_tools.middleware.rclpy import RclpyGraph, qos_profile, rclpy_line

if TYPE_CHECKING:
    from edoras_tools.addons.ros_verbs.endpoints import Heard
    from edoras_tools.ros import TypeStore


_NOBODY: Final = ("_NODE_NAME_UNKNOWN_", "_CREATED_BY_BARE_DDS_APP_")
"""Names that ROS 2 gives to the node of an endpoint that no node has announced."""


class RclpyObserver(RclpyGraph):
    """A ``GraphObserver`` over one ``rclpy`` node."""

    def __init__(self, store: TypeStore, node: str, domain: int) -> None:
        super().__init__(store, node, domain)
        self._names = node_name(node)
        self._lost: dict[str, int] = {}

    def described(self) -> list[dict[str, Any]]:
        """See ``GraphObserver``."""
        node = self._node
        return [
            self._fields(topic, item)
            for topic, _ in node.get_topic_names_and_types()
            for listed in (node.get_publishers_info_by_topic, node.get_subscriptions_info_by_topic)
            for item in listed(topic)
        ]

    def observe(self, topic: str, type_name: str, qos: Qos, heard: Heard) -> None:
        """See ``GraphObserver``."""
        kind, events = self._type(topic, type_name), import_module("rclpy.event_handler")

        def receive(cdr: bytes, info: Any) -> None:
            if not self._closed:
                now_ns = _number(info.get("received_timestamp")) or time.time_ns()
                sequence = _number(info.get("publication_sequence_number"))
                gid = bytes((info.get("publisher_gid") or {}).get("data", b""))[:16].hex()
                heard(cdr, now_ns, _number(info.get("source_timestamp")), sequence, gid)

        def lose(status: Any) -> None:
            self._lost[topic] = status.total_count

        self._lost[topic] = 0
        callbacks = events.SubscriptionEventCallbacks(message_lost=lose, use_default_callbacks=False)
        try:
            self._node.create_subscription(
                kind, topic, receive, qos_profile(qos), event_callbacks=callbacks, raw=True
            )
        except Exception as error:  # rclpy raises RuntimeError, ValueError and classes of its own
            raise ConfigError(f"{topic}: refused by rclpy: {rclpy_line(error)}") from error

    def lost(self) -> Mapping[str, int]:
        """See ``GraphObserver``: the counts of rclpy's event ``message_lost``."""
        return dict(self._lost)

    def _fields(self, topic: str, item: Any) -> dict[str, Any]:
        qos, names = item.qos_profile, (item.node_namespace, item.node_name)
        history = qos.history.name
        policies = {
            "Reliability": qos.reliability.name,
            "History (Depth)": f"{history} ({qos.depth})" if history == "KEEP_LAST" else history,
            "Durability": qos.durability.name,
            "Lifespan": qos.lifespan.nanoseconds,
            "Deadline": qos.deadline.nanoseconds,
            "Liveliness": qos.liveliness.name,
            "Liveliness lease duration": qos.liveliness_lease_duration.nanoseconds,
        }
        return {
            "topic": topic,
            "type": item.topic_type,
            "publishes": item.endpoint_type.name == "PUBLISHER",
            "gid": bytes(item.endpoint_gid)[:16].hex(),
            "node": "" if names[1] in _NOBODY else f"{names[0].rstrip('/')}/{names[1]}",
            "policies": policies,
            "type_hash": str(getattr(item, "topic_type_hash", "")),
            "own": names == self._names,
        }


def _number(value: Any) -> int:
    """Return a number; 0 if the middleware gives none, as a negative number or all ones."""
    return value if isinstance(value, int) and 0 < value < (1 << 64) - 1 else 0


def rclpy_observer(
    store: TypeStore, node: str, *, domain: int = 0, options: Mapping[str, str] | None = None
) -> RclpyObserver:
    """Join the graph as a node that observes it.

    Raises:
        ConfigError: an option is given, or ``rclpy`` refuses.
        ImportError: no ROS 2 is sourced.
    """
    if mistakes := unknown_options("rclpy", options or (), ()):
        raise ConfigError(*mistakes)
    import_module("rclpy.event_handler")
    try:
        return RclpyObserver(store, node, domain)
    except ConfigError:
        raise
    except Exception as error:  # as in observe
        raise ConfigError(f"rclpy: no node {node!r} in domain {domain}: {rclpy_line(error)}") from error
