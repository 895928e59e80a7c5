"""A node among those ROS 2 nodes that run on DDS (rmw_cyclonedds, rmw_fastrtps); see docs/dds.md.

ROS's quality of service is mapped to DDS policies as in rmw_cyclonedds.
"""

from __future__ import annotations

import os
import time
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from cyclonedds.core import DDSException, Entity, ReadCondition
from cyclonedds.pub import DataWriter, Publisher
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader, Subscriber
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from edoras_tools.addons.dds import domain as dds_domain
from edoras_tools.addons.dds import peers as dds_peers
from edoras_tools.addons.dds.endpoints import BLOCKING_MS, CountedWriter, TopicReaders, acknowledged, room_of
from edoras_tools.addons.dds.messages import DdsTypes, padded, trimmed, writer_of
from edoras_tools.addons.dds.peers import Discovered, OwnEndpoint, Session, user_data
from edoras_tools.errors import ConfigError, WireError
from edoras_tools.middleware.graph import TopicState, check_name, dds_name, node_name
from edoras_tools.ros.type_hash import type_hash

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from edoras_tools.middleware import graph
    from edoras_tools.ros import TypeStore

_FOREVER: Final = duration(infinite=True)
_STEP: Final = duration(milliseconds=50)
_UNFIT: Final = {
    2: ("the durability", "durability: volatile", "durability: transient_local"),
    11: ("the reliability", "reliability: best_effort", "reliability: reliable"),
    23: ("the data representation", "", ""),
    24: ("the definition of the type", "", ""),
}
"""Policies that may be incompatible, by their number in DDS: their names, and the values that our subscriber
or publisher needs for a match."""
_PATIENCE_S: Final = 5.0
"""Time after which a note reports that no other node was found, s."""
_UNLIMITED: Final = -1


def writer_qos(qos: graph.Qos, user_data: bytes = b"", room: int = 0) -> Qos:
    """Return the policies of a writer, with its user data for other participants.

    Args:
        room: number of samples that may wait for acknowledgement; by default as many as late subscribers get.
    """
    history = _history(qos.depth)
    service = Policy.DurabilityService(0, history, _UNLIMITED, _UNLIMITED, _UNLIMITED)
    lifecycle = Policy.WriterDataLifecycle(autodispose=False)
    durable = (service,) if qos.transient_local else ()
    waiting = _history(max(room, qos.depth)) if qos.depth else history
    return Qos(*_common(qos), waiting, lifecycle, *durable, Policy.Userdata(user_data))


def reader_qos(qos: graph.Qos, user_data: bytes = b"") -> Qos:
    """Return the policies of a reader, with its user data for other participants.

    ROS's depth limits how far a subscriber may be behind. Here it is behind only until a thread wakes up,
    and must not lose part of a burst: so no sample is overwritten.
    """
    return Qos(*_common(qos), Policy.History.KeepAll, Policy.Userdata(user_data))


def _common(qos: graph.Qos) -> tuple[Any, ...]:
    return (
        Policy.Reliability.Reliable(duration(milliseconds=BLOCKING_MS))
        if qos.reliable
        else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if qos.transient_local else Policy.Durability.Volatile,
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.IgnoreLocal.Participant,
    )


def _history(depth: int) -> Any:
    return Policy.History.KeepLast(depth) if depth else Policy.History.KeepAll


def _unfit(topic: str, status: Any, *, ours_writes: bool) -> str:
    """Return the reason why an endpoint of another participant does not match ours, and the remedy."""
    kind, as_subscriber, as_publisher = _UNFIT.get(status.last_policy_id, ("a policy", "", ""))
    line = as_publisher if ours_writes else as_subscriber
    remedy = f"; write qos: {{{line}}} for this topic in the mission file" if line else ""
    return f"{topic}: a {'subscriber' if ours_writes else 'publisher'} does not match: {kind} differs{remedy}"


class DdsGraph(Session):
    """A ``Graph`` over one participant.

    One thread waits for samples of all topics and calls ``heard``. Nothing runs on Cyclone DDS's own threads:
    while ``heard`` is busy, samples wait in their readers.

    Args:
        types: types of all topics.
        node: namespace and name.
        domain: ``ROS_DOMAIN_ID``.
        config: configuration of the domain, as XML.

    Raises:
        ConfigError: Cyclone DDS refuses the domain or its configuration.
    """

    def __init__(self, types: TypeStore, node: tuple[str, str], domain: int, config: str) -> None:
        self._types = types
        self._node = node
        self._made = DdsTypes(types)
        self._told: set[str] = set()
        self._subscriptions: list[TopicReaders] = []
        self._publications: list[CountedWriter] = []
        self._conditions: dict[DataReader[Any], ReadCondition] = {}
        self._changed = self._settled = False
        self._topics: dict[str, Topic[Any]] = {}
        self._types_of: dict[str, str] = {}
        self._readers: list[tuple[str, DataReader[Any]]] = []
        self._writers: list[tuple[str, DataWriter[Any]]] = []
        self._gid_bytes = 0
        self._presence: list[Entity] = []
        self._hashes: dict[str, str] = {}
        self._since = time.monotonic()
        super().__init__(domain, config, f"dds {node[1]}")

    def subscribe(self, topic: str, type_name: str, qos: graph.Qos, heard: Callable[[bytes], None]) -> None:
        """Call ``heard(cdr)`` for each message of a topic; see ``Graph``."""
        with self._lock:
            on = self._topic(topic, type_name)

            def make(request: graph.Qos) -> DataReader[Any]:
                return self._reader(topic, type_name, on, request)

            try:
                subscription = TopicReaders(topic, type_name, qos, heard, make, partial(self._drop, topic))
                offers = self._peers.writers[f"rt{topic}"].values()
                subscription.follow(offers, self._offer_of, settled=self._settled)
                self._subscriptions.append(subscription)
            except DDSException as error:
                raise ConfigError(f"{topic}: cannot be subscribed to: {error}") from error
            self._announce()

    def advertise(self, topic: str, type_name: str, qos: graph.Qos) -> Callable[[bytes], None]:
        """Return a function that publishes on a topic; see ``Graph``. After ``close`` it does nothing.

        It raises ``WireError`` like ``CountedWriter.publish``.
        """
        with self._lock:
            on = self._topic(topic, type_name)
            room = room_of(qos, self._types.fixed_size(type_name))
            policies = writer_qos(qos, self._user_data(type_name), room)
            try:
                writer = self._own(DataWriter(self._publisher, on, policies))
            except DDSException as error:
                raise ConfigError(f"{topic}: cannot be published on: {error}") from error
            self._writers.append((topic, writer))
            self._types_of[topic] = type_name
            self._publications.append(CountedWriter(topic, type_name, qos, room, writer, self._types))
            self._announce()
        write, closed = self._publications[-1].publish, self._closed

        def publish(cdr: bytes) -> None:
            try:
                write(cdr)
            except WireError:
                if not closed.is_set():
                    raise

        return publish

    def states(self) -> Mapping[str, TopicState]:
        """See ``Graph``: for a topic with both directions, the state of the subscription."""
        with self._lock:
            if self._closed.is_set():
                return {}
            published = {item.topic: item.state() for item in self._publications}
            return published | {item.topic: item.state() for item in self._subscriptions}

    def subscribers(self, topic: str) -> int:
        """Return the number of other participants' readers of a topic that this node publishes."""
        return max(
            (len(writer.get_matched_subscriptions()) for name, writer in self._writers if name == topic),
            default=0,
        )

    def acknowledged(self) -> bool:
        """Return whether reliable subscribers have acknowledged everything published."""
        return all(acknowledged(writer) for _, writer in self._writers)

    def dropped(self) -> int:
        """See ``Graph``: the drops of all nodes of this domain in this process."""
        return dds_domain.dropped(self._domain)

    def notes(self) -> list[str]:
        """Return one line for each topic with an incompatible peer, once, with the reason; see ``Graph``.

        Lines also report another type or definition at a peer, a topic with a similar name, and, after some
        seconds, that no other node was found.
        """
        with self._lock:
            if self._closed.is_set():
                return []
            self._present(self._peers.gid_bytes)
            ours: list[tuple[str, Any, bool]] = [(*item, False) for item in self._readers]
            ours += [(*item, True) for item in self._writers]
            notes, own = [], []
            for topic, entity, writes in ours:
                status = (
                    entity.get_offered_incompatible_qos_status()
                    if writes
                    else entity.get_requested_incompatible_qos_status()
                )
                if status.total_count:
                    notes.append(_unfit(topic, status, ours_writes=writes))
                type_name = self._types_of[topic]
                matched = bool(entity.matched_sub if writes else entity.matched_pub)
                own.append(OwnEndpoint(topic, type_name, writes, self._hash(type_name), matched))
        late = time.monotonic() - self._since > _PATIENCE_S
        notes += self._peers.notes(own, late=late)
        if late and not self._peers.found:
            notes.append(
                f"no other node was found in domain {self._domain} for {_PATIENCE_S:.0f} s; "
                + dds_domain.missing_hint(os.environ)
            )
        new = [note for note in dict.fromkeys(notes) if note not in self._told]
        self._told.update(new)
        return new

    def _join(self) -> None:
        """Announce the node if the distribution has the types for it."""
        self._publisher = self._own(Publisher(self._participant))
        self._subscriber = self._own(Subscriber(self._participant))
        self._peers = Discovered(self._participant)
        for reader in self._peers.entities:
            self._await(self._own(reader))
        self._present(dds_peers.gid_bytes_of(self._types))

    def _present(self, gid_bytes: int | None) -> None:
        """Announce the node with identifiers of a size in bytes, if that is new."""
        if gid_bytes is None or gid_bytes == self._gid_bytes:
            return
        self._delete(*self._presence)  # a topic has one type, and a writer is deleted before its topic
        self._gid_bytes = gid_bytes
        types = self._presence_types = dds_peers.presence_types(gid_bytes)
        name = dds_peers.PRESENCE_TYPE
        on = self._own(Topic(self._participant, dds_peers.PRESENCE_TOPIC, DdsTypes(types).of(name)))
        qos = writer_qos(dds_peers.QOS, user_data(type_hash(types, name)))
        writer = self._own(DataWriter(self._publisher, on, qos))
        self._presence = [writer, on]
        self._tell = writer_of(writer)
        self._announce()

    def _announce(self) -> None:
        """Publish the entities of this node to the graph."""
        readers, writers = (
            [entity.guid.bytes for _, entity in entities] for entities in (self._readers, self._writers)
        )
        guid = self._participant.guid.bytes
        message = dds_peers.presence(self._presence_types, self._node, guid, readers, writers)
        self._tell(padded(message))

    def _hash(self, type_name: str) -> str:
        """Return the hash of a type, computed once."""
        if type_name not in self._hashes:
            self._hashes[type_name] = type_hash(self._types, type_name)
        return self._hashes[type_name]

    def _user_data(self, type_name: str) -> bytes:
        return user_data(self._hash(type_name))

    def _topic(self, topic: str, type_name: str) -> Topic[Any]:
        """Return a topic, the same one for the same name."""
        if self._closed.is_set():
            raise ConfigError(f"{topic}: the node {self._node[1]} has left the graph")
        check_name(topic, "topic")
        if why := self._types.check(type_name):
            raise ConfigError(f"{topic}: {why}")
        try:
            data_type = self._made.of(type_name)
            if topic not in self._topics:
                self._topics[topic] = self._own(Topic(self._participant, f"rt{topic}", data_type))
        except ConfigError as error:
            raise ConfigError(*(f"{topic}: {mistake}" for mistake in error.mistakes)) from error
        except DDSException as error:
            raise ConfigError(f"{topic}: refused by Cyclone DDS: {error}") from error
        topic_ = self._topics[topic]
        if topic_.data_type is not data_type:
            raise ConfigError(
                f"{topic}: is of type {topic_.typename} here, and cannot be {dds_name(type_name)} too"
            )
        return topic_

    def _listen(self) -> None:
        while not self._closed.is_set():
            if not self._changed:
                self._waitset.wait(_FOREVER if self._settled else _STEP)
            if not self._settled and time.monotonic() - self._since > dds_peers.DISCOVERY_S:
                self._settled = self._changed = True
            leftover = self._follow()
            for subscription in tuple(self._subscriptions):
                leftover += [(subscription, cdr) for cdr in subscription.take(self._offer_of)]
                for item, cdr in leftover:
                    if self._closed.is_set():
                        return
                    item.heard(trimmed(self._types, item.type_name, cdr))
                leftover.clear()

    def _follow(self) -> list[tuple[TopicReaders, bytes]]:
        """Make the readers that the topics' publishers need; return the messages left in deleted readers."""
        with self._lock:
            if self._closed.is_set() or not (self._peers.update() or self._changed):
                return []
            self._changed = False
            leftover = []
            before = [*self._readers]
            for item in self._subscriptions:
                offers = self._peers.writers[f"rt{item.topic}"].values()
                late = item.follow(offers, self._offer_of, settled=self._settled)
                leftover += [(item, cdr) for cdr in late]
            if before != self._readers:
                self._announce()
            return leftover

    def _offer_of(self, handle: int) -> tuple[graph.Qos, bool] | None:
        """Return a writer's offer: discovery shows the writer before its first sample, perhaps just now."""
        peers = self._peers
        if handle not in peers.offers:
            with self._lock:
                self._changed |= peers.update()
        offer = peers.offers.get(handle)
        return None if offer is None else (offer, handle in peers.alive)

    def _reader(self, topic: str, type_name: str, on: Topic[Any], qos: graph.Qos) -> DataReader[Any]:
        """Make a reader, and wait for its samples."""
        reader = self._own(DataReader(self._subscriber, on, reader_qos(qos, self._user_data(type_name))))
        self._conditions[reader] = self._await(reader)
        self._readers.append((topic, reader))
        self._types_of[topic] = type_name
        return reader

    def _drop(self, topic: str, reader: DataReader[Any]) -> None:
        """Delete a reader."""
        ready = self._conditions.pop(reader)
        self._waitset.detach(ready)
        self._readers.remove((topic, reader))
        self._delete(ready, reader)


def open_graph(
    store: TypeStore, node: str, *, domain: int = 0, options: Mapping[str, str] | None = None
) -> DdsGraph:
    """Join the graph as a node.

    Args:
        store: types of all topics.
        node: name of the node, or ``/namespace/name``.
        domain: ``ROS_DOMAIN_ID``.
        options: see docs/dds.md: ``interface``, ``peers``, ``multicast``.

    Raises:
        ConfigError: an option cannot be applied, or Cyclone DDS refuses the domain.
        ImportError: cyclonedds is not installed.
    """
    return DdsGraph(store, node_name(node), domain, dds_domain.configuration(options or {}))
