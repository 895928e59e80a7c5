"""The interface of a ROS 2 middleware for a bridge: subscribe and publish, as CDR only."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple, Protocol

import msgspec

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

_AUTOMATIC: Final = "automatic"


class Qos(msgspec.Struct, frozen=True):
    """Quality of service of one topic, by ROS's names (https://design.ros2.org/articles/qos.html).

    Attributes:
        reliable: lost samples are sent again; False is ``best_effort``. None, of a subscription: what each
            publisher offers.
        transient_local: late subscribers get the last samples; False is ``volatile``. None as above.
        depth: samples kept (``keep_last``); 0 is ``keep_all``.
    """

    reliable: bool | None = True
    transient_local: bool | None = False
    depth: int = 10

    def words(self) -> dict[str, str | int]:
        """Return the policies by ROS's names; ``automatic`` is what each publisher offers."""
        reliability = {True: "reliable", False: "best_effort", None: _AUTOMATIC}[self.reliable]
        durability = {True: "transient_local", False: "volatile", None: _AUTOMATIC}[self.transient_local]
        return {"reliability": reliability, "durability": durability, "depth": self.depth}


class TopicState(NamedTuple):
    """How a topic of a node is connected now, and what was lost on it so far.

    Attributes:
        qos: in force; of a subscription that follows its publishers one for each kind of them.
        missed: messages that a publisher's history or the network lost before they came here; None where the
            middleware does not tell.
        overwritten: messages overwritten in a history of ours, at the most.
    """

    qos: tuple[Qos, ...]
    missed: int | None = 0
    overwritten: int = 0


class Graph(Protocol):
    """One node in a ROS 2 graph.

    Topics are fully qualified (``/cmd_vel``), types ROS names (``geometry_msgs/msg/Twist``). A message is its
    CDR with the four bytes of encapsulation, never decoded. A node does not receive its own messages.
    """

    def subscribe(self, topic: str, type_name: str, qos: Qos, heard: Callable[[bytes], None]) -> None:
        """Call ``heard(cdr)`` for each message, on a thread of the middleware's: it must not block.

        Raises:
            ConfigError: the type is unknown, or the middleware refuses the topic.
        """

    def advertise(self, topic: str, type_name: str, qos: Qos) -> Callable[[bytes], None]:
        """Return what publishes one message of a topic; it may be called from any one thread at a time.

        Raises:
            ConfigError: the type is unknown, or the middleware refuses the topic.
        """

    def states(self) -> Mapping[str, TopicState]:
        """Return the state of each topic by name; those without are as they were asked for."""

    def dropped(self) -> int:
        """Return the datagrams that the kernel dropped before the middleware read them, where it is known."""

    def subscribers(self, topic: str) -> int | None:
        """Return how many subscriptions of others a topic has that is published on here; None: not known."""

    def notes(self) -> list[str]:
        """Return new notes for the user: incompatible peers, where to connect to."""

    def close(self) -> None:
        """Leave the graph. Nothing is heard after this returns; calling it again does nothing."""


class Middleware(NamedTuple):
    """A way to join a ROS 2 graph; nothing of it is imported before somebody joins.

    Attributes:
        place: of its ``open_graph(store, node, *, domain, options)``, which returns a ``Graph``, as
            ``module:function``.
        needs: what an error says that it needs, and how to get it, where its library cannot be imported;
            ``{why}`` becomes the reason.
        implementation: value of ``RMW_IMPLEMENTATION`` that means it; empty if none does.
        usual: whether it is meant where that variable names no other.
        open: whether every node of its domain's network can publish.
        peers: place of a function that takes domain and options, and returns the ROS 2 distribution of other
            nodes, or None; empty if they do not tell.
    """

    place: str
    needs: str = "its library ({why})"
    implementation: str = ""
    usual: bool = False
    open: bool = False
    peers: str = ""
