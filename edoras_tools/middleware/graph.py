"""The interface of a ROS 2 middleware for a bridge: subscribe and publish, as CDR only.

A middleware is chosen by name, and the others are not imported. Also names of nodes and topics in ROS, names
of types in DDS, and names of a middleware's options. The rules:
https://design.ros2.org/articles/topic_and_service_names.html
"""

from __future__ import annotations

import os
import re
import sys
from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol

import msgspec

from edoras_tools import doors
from edoras_tools.errors import ConfigError
from edoras_tools.middleware import MOST_DOMAIN
from edoras_tools.ros.library import full_name

if TYPE_CHECKING:
    from edoras_tools.ros import TypeStore

_AUTOMATIC: Final = "automatic"


class Qos(msgspec.Struct, frozen=True):
    """Quality of service of one topic, by ROS's names (https://design.ros2.org/articles/qos.html).

    Attributes:
        reliable: True: lost samples are sent again; False: ``best_effort``; None, for a subscription: the
            policy that each publisher offers.
        transient_local: True: late subscribers get the last samples; False: ``volatile``; None as for
            ``reliable``.
        depth: number of samples kept (``keep_last``); 0 is ``keep_all``.
    """

    reliable: bool | None = True
    transient_local: bool | None = False
    depth: int = 10

    def words(self) -> dict[str, str | int]:
        """Return the policies by ROS's names; ``automatic`` stands for the offer of each publisher."""
        reliability = {True: "reliable", False: "best_effort", None: _AUTOMATIC}[self.reliable]
        durability = {True: "transient_local", False: "volatile", None: _AUTOMATIC}[self.transient_local]
        return {"reliability": reliability, "durability": durability, "depth": self.depth}


class TopicState(NamedTuple):
    """The connection of a topic of a node, and its losses so far.

    Attributes:
        qos: policies in force; for a subscription that follows its publishers, one for each kind of
            publisher.
        missed: messages that a publisher's history or the network lost before they arrived; None if the
            middleware does not count them.
        overwritten: upper bound of the messages overwritten in our own history.
    """

    qos: tuple[Qos, ...]
    missed: int | None = 0
    overwritten: int = 0


class Graph(Protocol):
    """One node in a ROS 2 graph.

    Topics are fully qualified (``/cmd_vel``), types ROS names (``geometry_msgs/msg/Twist``). A message is its
    CDR with the four bytes of encapsulation, never decoded. A node does not receive its own messages.

    A class that inherits gets the answers of a middleware that does not know.
    """

    @abstractmethod
    def subscribe(self, topic: str, type_name: str, qos: Qos, heard: Callable[[bytes], None]) -> None:
        """Call ``heard(cdr)`` for each message, on a thread of the middleware: it must not block.

        Raises:
            ConfigError: the type is unknown, or the middleware refuses the topic.
        """

    @abstractmethod
    def advertise(self, topic: str, type_name: str, qos: Qos) -> Callable[[bytes], None]:
        """Return a function that publishes a message of a topic; only one thread at a time may call it.

        Raises:
            ConfigError: the type is unknown, or the middleware refuses the topic.
        """

    def states(self) -> Mapping[str, TopicState]:
        """Return the state of topics by name; a topic without a state has its requested policies."""
        return {}

    def dropped(self) -> int:
        """Return the datagrams that the kernel dropped before the middleware read them, as far as known."""
        return 0

    def subscribers(self, topic: str) -> int | None:
        """Return the number of others' subscriptions to a topic that this node publishes; None: unknown."""
        return None

    def notes(self) -> list[str]:
        """Return new notes for the user, such as incompatible peers, or an address to connect to."""
        return []

    @abstractmethod
    def close(self) -> None:
        """Leave the graph. No message is received after this returns; a second call does nothing."""


class Middleware(NamedTuple):
    """A way to join a ROS 2 graph; its modules are imported only then.

    Attributes:
        place: ``module:function`` of its ``open_graph(store, node, *, domain, options)``, which returns a
            ``Graph``.
        needs: text of the error if its library cannot be imported: the requirement, and how to get it;
            ``{why}`` is replaced by the reason.
        implementation: value of ``RMW_IMPLEMENTATION`` that selects it; empty if none does.
        usual: whether it is selected if that variable selects no other.
        open: whether every node of its domain's network can publish.
        peers: ``module:function`` that takes domain and options, and returns the ROS 2 distribution of other
            nodes, or None; empty if they do not announce it.
    """

    place: str
    needs: str = "its library ({why})"
    implementation: str = ""
    usual: bool = False
    open: bool = False
    peers: str = ""


_NAME: Final = re.compile(r"(?:/[A-Za-z_][A-Za-z0-9_]*)+")


def check_name(name: str, noun: str) -> str:
    """Return a fully qualified ROS name.

    Args:
        noun: noun for errors, ``topic`` or ``node``.

    Raises:
        ConfigError: it is not a valid name.
    """
    if not _NAME.fullmatch(name):
        raise ConfigError(
            f"{noun} {name!r} is not a ROS name; write /NAME/NAME, of letters, digits and _, no digit first"
        )
    return name


def node_name(node: str) -> tuple[str, str]:
    """Return the namespace, ``/`` or ``/robot``, and the name of a node from ``NAME`` or ``/robot/NAME``.

    Raises:
        ConfigError: it is not a valid name of a node.
    """
    full = check_name(node if node.startswith("/") else "/" + node, "node")
    namespace, _, name = full.rpartition("/")
    return namespace or "/", name


def dds_name(type_name: str) -> str:
    """Return the DDS name of a ROS type: ``geometry_msgs::msg::dds_::Twist_``."""
    package, kind, name = full_name(type_name).split("/")
    return f"{package}::{kind}::dds_::{name}_"


def ros_name(dds_type: str) -> str:
    """Return the ROS name of a DDS type; the DDS name itself if it is not a ROS type."""
    parts = dds_type.split("::")
    is_ros = len(parts) == 4 and parts[2] == "dds_" and parts[3].endswith("_")
    return f"{parts[0]}/{parts[1]}/{parts[3].removesuffix('_')}" if is_ros else dds_type


def unknown_options(ros: str, options: Iterable[str], existing: Sequence[str]) -> list[str]:
    """Return a line for each option that a middleware does not have.

    Args:
        options: names of the given options.
        existing: names of the options that exist.
    """
    hint = f"there are {', '.join(existing)}" if existing else "leave it out"
    return [f"--ros {ros} has no option {name!r}; {hint}" for name in options if name not in existing]


_HERE: Final = "edoras_tools.middleware"
_PYTHON: Final = f"{sys.version_info.major}.{sys.version_info.minor}"
_OF_THE_CORE: Final = {
    "rclpy": Middleware(
        f"{_HERE}.rclpy:open_graph",
        f"a ROS 2 of Python {_PYTHON} ({{why}}); source its setup.bash, or: "
        "pip install ros-rclpy ros-rmw-fastrtps-cpp",
        open=True,
    )
}


def names() -> list[str]:
    """Return the names of all middlewares that ship."""
    return sorted([*doors.shipped("middleware"), *_OF_THE_CORE])


def middleware(ros: str) -> Middleware:
    """Return the middleware with a name.

    Raises:
        ConfigError: there is no such name, or its add-on was deleted.
    """
    if ros in _OF_THE_CORE:
        return _OF_THE_CORE[ros]
    item = doors.find("middleware", ros)
    if item is None:
        existing = [*names(), *(item.name for item in doors.installed("middleware"))]
        raise ConfigError(f"--ros {ros!r} is not known; there are {', '.join(existing)}")
    loaded = item.load()
    if not isinstance(loaded, Middleware):
        raise item.error(f"{item.place} is not an object of Middleware")
    return loaded


def usual(environ: Mapping[str, str] | None = None) -> str:
    """Return the middleware that the environment selects: DDS unless it names Zenoh.

    Raises:
        ConfigError: this installation does not have it.
    """
    rmw = (os.environ if environ is None else environ).get("RMW_IMPLEMENTATION", "")
    installed = {name: item.load() for name, item in doors.shipped("middleware").items() if not item.absent}
    for name, item in installed.items():
        if rmw and item.implementation == rmw:
            return name
    for name, item in installed.items():
        if item.usual:
            return name
    raise ConfigError(f"no middleware is usual in this installation; choose with --ros: {', '.join(names())}")


def usual_domain(environ: Mapping[str, str] | None = None) -> int:
    """Return ``ROS_DOMAIN_ID``, 0 if it is not set.

    Raises:
        ConfigError: it is not a number of a domain.
    """
    text = (os.environ if environ is None else environ).get("ROS_DOMAIN_ID", "").strip() or "0"
    if not text.isascii() or not text.isdecimal() or int(text) > MOST_DOMAIN:
        raise ConfigError(f"ROS_DOMAIN_ID {text!r} is not a domain; 0 to {MOST_DOMAIN}")
    return int(text)


def open_graph(
    ros: str, store: TypeStore, node: str, *, domain: int = 0, options: Mapping[str, str] = {}
) -> Graph:
    """Join a graph.

    Args:
        ros: name of a middleware.
        domain: ROS 2 domain.
        options: options of the middleware, by name.

    Raises:
        ConfigError: there is no such middleware, its library is not installed, or it refuses.
    """
    way = middleware(ros)
    try:
        graph: Graph = _imported(ros, way.place)(store, node, domain=domain, options=options)
    except ImportError as error:
        why = str(error).partition("\n")[0]
        raise ConfigError(f"--ros {ros} needs {way.needs.format(why=why)}") from error
    return graph


def distro_of_peers(ros: str, domain: int, options: Mapping[str, str] = {}) -> str | None:
    """Return the ROS 2 distribution that other nodes announce; None if no node does: only DDS can show it.

    Errors are ignored here: joining the graph reports them.
    """
    place = middleware(ros).peers
    if not place:
        return None
    try:
        distro: str | None = _imported(ros, place)(domain, options)
    except (ImportError, ConfigError):
        return None
    return distro


def _imported(ros: str, place: str) -> Any:
    """Import the object of a place.

    Raises:
        ConfigError: its library is installed, but does not load.
        ImportError: its library is not installed.
    """
    try:
        return doors.imported(place)
    except ImportError:
        raise
    except Exception as error:  # a library may raise anything while it looks for its own
        raise ConfigError(f"--ros {ros}: its library does not load: {error}") from error
