"""Endpoints of a ROS 2 graph, their quality of service, and the mismatches between them.

A subscription matches a publisher that offers at least the requested policies (DDS 1.4, 2.2.3).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence  # noqa: TC003  of a NamedTuple
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol

import yaml

from edoras_tools import doors
from edoras_tools.errors import ConfigError
from edoras_tools.middleware.graph import Qos, middleware
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from edoras_tools.ros import TypeStore

    Heard = Callable[[bytes, int, int, int, str], None]
    """Function of a message's CDR, its times of receiving and publishing (ns since 1970), its number from
    the publisher,
        and the publisher's ``gid``. A value that the middleware does not give is 0, or empty."""

FOREVER_NS: Final = (1 << 63) - 1
DEPTH: Final = 1000
"""Messages that an observer keeps until its thread wakes up."""
_OFFERS: Final = {
    "Reliability": ("BEST_EFFORT", "RELIABLE"),
    "Durability": ("VOLATILE", "TRANSIENT_LOCAL", "TRANSIENT", "PERSISTENT"),
    "Liveliness": ("AUTOMATIC", "MANUAL_BY_PARTICIPANT", "MANUAL_BY_TOPIC"),
}
"""Policy to its values, in ascending order of the offer."""
_SPANS: Final = ("Deadline", "Liveliness lease duration")
_HISTORY: Final = "History (Depth)"
_ORDER: Final = ("Reliability", _HISTORY, "Durability", "Lifespan", "Deadline", "Liveliness", _SPANS[1])


def policies_text(policies: Mapping[str, Any]) -> str:
    """Return policies as ``ros2 topic info -v`` prints them."""
    texts = {name: "Infinite" if value == FOREVER_NS else value for name, value in policies.items()}
    return "\n".join(["QoS profile:", *(f"  {name}: {texts[name]}" for name in _ORDER if name in texts)])


class GraphEndpoint(NamedTuple):
    """A publisher or subscription.

    Attributes:
        topic: fully qualified name.
        type: ROS name.
        publishes: whether it is a publisher; else it is a subscription.
        gid: 16 bytes, as hexadecimal digits.
        node: node with its namespace; empty if unknown.
        policies: quality of service, by the names that ``ros2 topic info -v`` prints; times in ns.
        type_hash: type hash; empty if unknown.
        own: whether it belongs to the observer itself.
    """

    topic: str
    type: str
    publishes: bool
    gid: str
    node: str
    policies: Mapping[str, Any]
    type_hash: str
    own: bool

    def text(self) -> str:
        """Return the endpoint in the form of ``ros2 topic info -v``."""
        namespace, _, name = self.node.rpartition("/")
        lines = {
            "Node name": name or "_NODE_NAME_UNKNOWN_",
            "Node namespace": (namespace or "/") if name else "_NODE_NAMESPACE_UNKNOWN_",
            "Topic type": self.type,
            "Topic type hash": self.type_hash or "INVALID",
            "Endpoint type": "PUBLISHER" if self.publishes else "SUBSCRIPTION",
            "GID": bytes.fromhex(self.gid).hex("."),
        }
        texts = (f"{name}: {value}" for name, value in lines.items())
        return "\n".join([*texts, policies_text(self.policies)])

    def as_json(self) -> dict[str, Any]:
        """Return the endpoint in the shape of ``observe --json``."""
        base = {"node": self.node or None, "gid": self.gid, "type": self.type}
        ranked = {name.lower(): self.policies[name].lower() for name in _OFFERS}
        deadline_ns = self.policies["Deadline"]
        return {**base, **ranked, "deadline_ns": None if deadline_ns == FOREVER_NS else deadline_ns}


class GraphObserver(Protocol):
    """A node that observes a graph: its endpoints, and the metadata of each message."""

    def described(self) -> list[dict[str, Any]]:
        """Return the endpoints of all ROS topics, including its own: fields of ``GraphEndpoint``."""

    def observe(self, topic: str, type_name: str, qos: Qos, heard: Heard) -> None:
        """Call ``heard`` for each message of a topic, on a thread of the middleware: it must not block.

        Raises:
            ConfigError: the type is unknown, or the middleware refuses the topic.
        """

    def lost(self) -> Mapping[str, int]:
        """Return the number of messages that the middleware has counted as lost so far, by topic."""

    def close(self) -> None:
        """Leave the graph."""


def open_observer(
    ros: str, types: TypeStore, node: str, domain: int, options: Mapping[str, str]
) -> GraphObserver:
    """Join a graph to observe it.

    Raises:
        ConfigError: there is no observer for this middleware, its library is not installed, or it refuses.
    """
    if ros not in {"dds", "rclpy"}:
        raise ConfigError(f"--ros {ros} tells nothing of endpoints; there are dds and rclpy")
    own = f"{__package__}.rclpy_node:rclpy_observer"
    try:
        make = doors.part("dds_observer") if ros == "dds" else doors.imported(own)
        observer: GraphObserver = make(types, node, domain=domain, options=options)
    except ImportError as error:
        why = str(error).partition("\n")[0]
        raise ConfigError(f"--ros {ros} needs {middleware(ros).needs.format(why=why)}") from error
    return observer


def endpoints_of(observer: GraphObserver) -> list[GraphEndpoint]:
    """Return the endpoints that an observer sees, by topic."""
    items = (GraphEndpoint(**item) for item in observer.described())
    return sorted(items, key=lambda item: (item.topic, not item.publishes, item.node, item.gid))


def fitting_qos(publishers: Iterable[GraphEndpoint], depth: int = DEPTH) -> Qos:
    """Return the strongest quality of service with which a subscription matches all publishers of a topic."""
    offers = [item.policies for item in publishers]
    reliable = all(item["Reliability"] == "RELIABLE" for item in offers)
    return Qos(reliable, all(item["Durability"] != "VOLATILE" for item in offers), depth)


def mismatches(endpoints: Sequence[GraphEndpoint]) -> list[tuple[GraphEndpoint, GraphEndpoint, list[str]]]:
    """Return the pairs of publishers and subscriptions of one topic that do not match, with the policies."""
    pairs = (
        (publisher, subscription, _refused(publisher.policies, subscription.policies))
        for publisher in endpoints
        if publisher.publishes
        for subscription in endpoints
        if not subscription.publishes
    )
    return [pair for pair in pairs if pair[2]]


def _refused(offer: Mapping[str, Any], wish: Mapping[str, Any]) -> list[str]:
    """Return the policies of which a subscription requests more than a publisher offers."""

    def less(name: str) -> bool:
        order = _OFFERS[name]
        return order.index(offer[name]) < order.index(wish[name])

    ranked = (name for name in _OFFERS if {offer[name], wish[name]} <= {*_OFFERS[name]})
    names = [*filter(less, ranked), *(name for name in _SPANS if offer[name] > wish[name])]
    return [name.lower() for name in names]


def recorded_text(policies: Mapping[str, Any]) -> str:
    """Return the quality of service of a publisher in rosbag2's notation."""
    history, _, depth = policies[_HISTORY].lower().partition(" (")
    values = {"history": history, "depth": int(depth.rstrip(")") or 0)}
    values |= {name.lower(): policies[name].lower() for name in _OFFERS}
    for name in ("Lifespan", *_SPANS):
        seconds, rest = divmod(policies[name], SECOND)
        values[name.lower().replace(" ", "_")] = {"sec": seconds, "nsec": rest}
    return yaml.safe_dump([{**values, "avoid_ros_namespace_conventions": False}], sort_keys=False)


def recorded_policies(text: str) -> list[dict[str, str]]:
    """Return the policies of a topic's publishers from rosbag2's notation, by name or by number."""

    def read(item: Mapping[str, Any], name: str, *values: str) -> str:
        value = item.get(name, 1)
        return values[value - 1] if value in range(1, len(values) + 1) else str(value).upper()

    try:
        return [
            {
                "Reliability": read(item, "reliability", "RELIABLE", "BEST_EFFORT"),
                _HISTORY: f"{read(item, 'history', 'KEEP_LAST', 'KEEP_ALL')} ({int(item.get('depth', 0))})",
                "Durability": read(item, "durability", "TRANSIENT_LOCAL", "VOLATILE"),
            }
            for item in yaml.safe_load(text) or ()
        ]
    except (yaml.YAMLError, AttributeError, TypeError, ValueError):
        return []


def recorded_qos(text: str) -> Qos:
    """Return the quality of service of a topic's publishers; see ``recorded_policies``."""
    offers = recorded_policies(text)
    kinds = [item[_HISTORY].partition(" (") for item in offers]
    depth = max([int(depth.rstrip(")")) for _, _, depth in kinds], default=0) or Qos().depth
    return Qos(
        all(item["Reliability"] != "BEST_EFFORT" for item in offers),
        any(item["Durability"] == "TRANSIENT_LOCAL" for item in offers),
        0 if any(kind == "KEEP_ALL" for kind, _, _ in kinds) else depth,
    )
