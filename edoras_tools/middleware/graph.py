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
    """

    def subscribe(self, topic: str, type_name: str, qos: Qos, heard: Callable[[bytes], None]) -> None:
        """Call ``heard(cdr)`` for each message, on a thread of the middleware: it must not block.

        Raises:
            ConfigError: the type is unknown, or the middleware refuses the topic.
        """

    def advertise(self, topic: str, type_name: str, qos: Qos) -> Callable[[bytes], None]:
        """Return a function that publishes a message of a topic; only one thread at a time may call it.

        Raises:
            ConfigError: the type is unknown, or the middleware refuses the topic.
        """

    def states(self) -> Mapping[str, TopicState]:
        """Return the state of topics by name; a topic without a state has its requested policies."""

    def dropped(self) -> int:
        """Return the datagrams that the kernel dropped before the middleware read them, as far as known."""

    def subscribers(self, topic: str) -> int | None:
        """Return the number of others' subscriptions to a topic that this node publishes; None: unknown."""

    def notes(self) -> list[str]:
        """Return new notes for the user, such as incompatible peers, or an address to connect to."""

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
