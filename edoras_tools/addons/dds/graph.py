"""A node among those ROS 2 nodes that run on DDS (rmw_cyclonedds, rmw_fastrtps); see docs/dds.md.

ROS's quality of service is mapped to DDS policies as in rmw_cyclonedds.

Discovery shows the other participants of the domain; our node is announced to them. From Iron on an
endpoint's user data has ``typehash=RIHS01_...;``: the hash of its type's definition. ``ros2 node list`` shows
a participant whose entities are published on ``ros_discovery_info``.

A ``Session`` is a participant of ours in a domain, and the thread that waits for what it receives.
"""

from __future__ import annotations

import os
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from functools import cache, partial
from threading import Event, RLock, Thread, current_thread
from time import monotonic, sleep
from typing import TYPE_CHECKING, Any, Final, TypeVar

import msgspec
from cyclonedds.builtin import (
    BuiltinDataReader,
    BuiltinTopicDcpsPublication,
    BuiltinTopicDcpsSubscription,
    DcpsEndpoint,
)
from cyclonedds.core import DDSException, Entity, GuardCondition, InstanceState, ReadCondition, WaitSet
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter, Publisher
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader, Subscriber
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from edoras_tools.addons.dds import domain as dds_domain
from edoras_tools.addons.dds import endpoints
from edoras_tools.addons.dds.domain import configuration, hold, release
from edoras_tools.errors import ConfigError, WireError
from edoras_tools.middleware import graph
from edoras_tools.middleware.graph import TopicState, check_name, dds_name, node_name, ros_name
from edoras_tools.ros import TypeStore
from edoras_tools.ros.store import USUAL_DISTRO
from edoras_tools.ros.type_hash import HASH_VERSION, type_hash

if TYPE_CHECKING:
    from uuid import UUID

    Owned = TypeVar("Owned", bound=Entity)


PRESENCE_TOPIC: Final = "ros_discovery_info"
"""Name of a DDS topic: ROS puts no ``rt/`` in front of it."""
PRESENCE_TYPE: Final = "rmw_dds_common/msg/ParticipantEntitiesInfo"
_GID: Final = "rmw_dds_common/msg/Gid"
_NEWER: Final = 16
OLDER: Final = 24
OLDEST_DISTRO: Final = "humble"
"""Newest distribution whose nodes send no type hashes."""
_OF_SIZE: Final = {_NEWER: "iron", OLDER: OLDEST_DISTRO}
"""Size of an identifier to the distribution that introduced it, or was the last to use it."""
QOS: Final = graph.Qos(transient_local=True, depth=1)
ENCLAVE: Final = b"enclave=/;"
"""User data of a participant: its security enclave; ROS 2 ignores participants without it."""


def presence_types(gid_bytes: int) -> TypeStore:
    """Return the types of this message with identifiers of 16 or 24 bytes."""
    return TypeStore(_OF_SIZE[gid_bytes])


def gid_bytes_of(types: TypeStore) -> int:
    """Return the size of an identifier in a distribution, bytes; 16 if it does not have the message."""
    return types.fields(_GID)[0].size if types.has(_GID) else _NEWER


def gid_bytes_told(hash_told: str) -> int:
    """Return the size of an identifier for a type with this hash, bytes; older distributions send no hash."""
    return OLDER if hash_told in {"", _older_hash()} else _NEWER


@cache
def _older_hash() -> str:
    return type_hash(presence_types(OLDER), PRESENCE_TYPE)


def presence(
    types: TypeStore,
    node: tuple[str, str],
    participant: bytes,
    readers: Iterable[bytes],
    writers: Iterable[bytes],
) -> bytes:
    """Return the message that lists the entities of a participant.

    Args:
        types: types with ``PRESENCE_TYPE``; the size of an identifier depends on the distribution.
        node: namespace and name.
        participant: GUID, 16 bytes, like all that follow.
        readers: GUIDs of the readers of the node's topics.
        writers: GUIDs of the writers of the node's topics.
    """
    size = gid_bytes_of(types)

    def gid(guid: bytes) -> dict[str, Any]:
        return {"data": guid.ljust(size, b"\0")}

    entities = {
        "node_namespace": node[0],
        "node_name": node[1],
        "reader_gid_seq": [gid(item) for item in readers],
        "writer_gid_seq": [gid(item) for item in writers],
    }
    return types.encode(PRESENCE_TYPE, {"gid": gid(participant), "node_entities_info_seq": [entities]})


TYPE_HASH: Final = "typehash="
_ROS_TOPIC: Final = "rt"
"""Prefix of ROS topics in DDS."""
_AT_ONCE: Final = 256
_HASH_LENGTH: Final = len(HASH_VERSION) + 64
_ALIKE: Final = 0.8
DISCOVERY_S: Final = 1.5
"""Time for discovery by multicast, which takes some tenths of a second, s."""
_STEP_S: Final = 0.05


class PeerEndpoint(msgspec.Struct, frozen=True):
    """A reader or writer of another participant.

    Attributes:
        topic: DDS topic, as ``rt/cmd_vel``.
        type_name: DDS type.
        writes: whether it is a writer.
        type_hash: type hash as sent; empty if there is none, as from Humble.
    """

    topic: str
    type_name: str
    writes: bool
    type_hash: str


class OwnEndpoint(msgspec.Struct, frozen=True):
    """A reader or writer of ours.

    Attributes:
        topic: ROS topic, as ``/cmd_vel``.
        type_name: ROS type.
        writes: whether it is a writer.
        type_hash: hash of its type.
        matched: whether it has a partner.
    """

    topic: str
    type_name: str
    writes: bool
    type_hash: str
    matched: bool


def discovery_readers(participant: DomainParticipant) -> list[tuple[bool, BuiltinDataReader]]:
    """Return the readers of what participants announce: whether of writers, and the reader."""
    topics = (True, BuiltinTopicDcpsPublication), (False, BuiltinTopicDcpsSubscription)
    return [(writes, BuiltinDataReader(participant, topic)) for writes, topic in topics]


def announcements(readers: Iterable[tuple[bool, BuiltinDataReader]]) -> Iterator[tuple[bool, DcpsEndpoint]]:
    """Take the announcements that wait: whether each is of a writer, and the endpoint."""
    for writes, reader in readers:
        while samples := reader.take(_AT_ONCE):
            yield from ((writes, item) for item in samples if isinstance(item, DcpsEndpoint))


class Discovered:
    """Collects the endpoints of other participants, and keeps them for ever.

    Args:
        participant: our participant.

    Attributes:
        found: endpoints of the others, by identifier.
        offers: offers of writers, by their handle in Cyclone DDS.
        alive: handles of the present writers.
        writers: identifiers and offers of the present writers, by DDS topic.
        entities: readers for discovery that this object has made.
    """

    def __init__(self, participant: DomainParticipant) -> None:
        self._own = participant.guid
        self._readers = discovery_readers(participant)
        self.entities: list[BuiltinDataReader] = [reader for _, reader in self._readers]
        self.found: dict[UUID, PeerEndpoint] = {}
        self.offers: dict[int, graph.Qos] = {}
        self.alive: set[int] = set()
        self.writers: defaultdict[str, dict[UUID, graph.Qos]] = defaultdict(dict)

    def update(self) -> bool:
        """Process the announcements since the last call; return whether writers came or went."""
        changed = False
        for writes, item in announcements(self._readers):
            if item.topic_name and item.participant_key != self._own:
                hashed = hash_of(item.qos)
                self.found[item.key] = PeerEndpoint(item.topic_name, item.type_name, writes, hashed)
            if writes and item.key in self.found:
                changed = True
                self._note_writer(item)
        return changed

    def _note_writer(self, item: DcpsEndpoint) -> None:
        """Process an announcement of a writer: its offer, its end, or both at once."""
        info: Any = item.sample_info  # type: ignore[attr-defined]
        writers = self.writers[self.found[item.key].topic]
        if item.topic_name:
            self.offers[info.instance_handle] = writers[item.key] = _offer(item.qos)
            self.alive.add(info.instance_handle)
        if info.instance_state != InstanceState.Alive:
            writers.pop(item.key, None)
            self.alive.discard(info.instance_handle)

    @property
    def gid_bytes(self) -> int | None:
        """Size of an identifier in the announcements of other nodes, bytes; None if there are none."""
        hashes = {item.type_hash for item in self.found.values() if item.topic == PRESENCE_TOPIC}
        return min(map(gid_bytes_told, hashes), default=None)

    @property
    def distro(self) -> str | None:
        """Distribution of the other nodes, by their type hashes; None if there are no nodes.

        Every type that bridges carry has one hash from Iron on; nodes of Humble send none.
        """
        size = self.gid_bytes
        return None if size is None else OLDEST_DISTRO if size == OLDER else USUAL_DISTRO

    def notes(self, own: Sequence[OwnEndpoint], *, late: bool) -> Iterator[str]:
        """Yield reasons why our endpoints and those of others do not match, and differences of definitions.

        Args:
            own: all our endpoints.
            late: whether the time of discovery is over, so that an endpoint without a partner is reported.
        """
        mine = {item.topic for item in own}
        others = [item for item in self.found.values() if item.topic.startswith(_ROS_TOPIC + "/")]
        for ours in own:
            partners = [item for item in others if item.writes != ours.writes]
            same = [item for item in partners if item.topic == _ROS_TOPIC + ours.topic]
            for item in same:
                if note := _difference(ours, item):
                    yield note
            names = {item.topic.removeprefix(_ROS_TOPIC) for item in partners} - mine
            if late and not same and not ours.matched and (near := _nearest(ours.topic, sorted(names))):
                does = "subscribes to" if ours.writes else "publishes"
                yield f"{ours.topic}: nobody {does} it, but {near}; if it is that, write topic: {near}"


def _nearest(topic: str, names: Sequence[str]) -> str:
    """Return the topic with the same last part, or else a similar name; empty if there is none."""
    last = topic.rpartition("/")[2]
    alike = [name for name in names if name.rpartition("/")[2] == last]
    return next(iter(alike or get_close_matches(topic, names, 1, _ALIKE)), "")


def user_data(type_hash: str) -> bytes:
    """Return the user data of an endpoint of a type, as ROS writes it from Iron on."""
    return f"{TYPE_HASH}{type_hash};".encode()


def _offer(qos: Qos) -> graph.Qos:
    """Return the offer of a writer: reliability and durability."""
    policies = list(qos)
    lasting = (Policy.Durability.TransientLocal, Policy.Durability.Transient, Policy.Durability.Persistent)
    return graph.Qos(
        reliable=Policy.Reliability.BestEffort not in policies,
        transient_local=any(item in lasting for item in policies),
    )


def hash_of(qos: Qos) -> str:
    """Return the type hash in the user data of an endpoint; empty where there is none."""
    data: bytes = next((item.data for item in qos if isinstance(item, Policy.Userdata)), b"")
    for pair in data.decode("ascii", "replace").strip("\0").split(";"):
        if pair.startswith(TYPE_HASH):
            return pair.removeprefix(TYPE_HASH)
    return ""


def distro_seen(domain: int, options: Mapping[str, str]) -> str | None:
    """Return the distribution of the nodes in a domain; None if no node is found in a short time.

    Raises:
        ConfigError: an option cannot be applied, or Cyclone DDS refuses the domain.
    """
    hold(domain, configuration(options))
    try:
        participant = DomainParticipant(domain)
        peers = Discovered(participant)
        end = monotonic() + DISCOVERY_S
        while peers.distro is None and monotonic() < end:
            sleep(_STEP_S)
            peers.update()
        for entity in (*peers.entities, participant):  # as the graph does: cyclonedds deletes nothing else
            entity.__del__()
    except DDSException as error:
        raise ConfigError(f"dds: no participant in domain {domain}: {error}") from error
    finally:
        release(domain)
    return peers.distro


def _difference(ours: OwnEndpoint, item: PeerEndpoint) -> str:
    """Return the difference between endpoints of one topic; empty if there is none."""
    who = "a publisher" if item.writes else "a subscriber"
    if item.type_name != dds_name(ours.type_name):
        theirs = ros_name(item.type_name)
        return f"{ours.topic}: {who} has type {theirs}, not {ours.type_name}; write type: {theirs}"
    if not item.type_hash or item.type_hash == ours.type_hash:
        return ""
    if not item.type_hash.startswith(HASH_VERSION) or len(item.type_hash) != _HASH_LENGTH:
        return f"{ours.topic}: {who} has an invalid type hash, {item.type_hash[:_HASH_LENGTH]!r}; continuing"
    return (
        f"{ours.topic}: {who} has another definition of {ours.type_name} ({item.type_hash[:19]}..., not "
        f"{ours.type_hash[:19]}...); give theirs with --set msg-path or distro"
    )


class Session:
    """A participant with its entities. A class derived from it listens to what the wait set reports.

    Args:
        domain: ``ROS_DOMAIN_ID``.
        config: configuration of the domain, as XML.
        name: name of the thread.

    Raises:
        ConfigError: Cyclone DDS refuses the domain or its configuration.
    """

    def __init__(self, domain: int, config: str, name: str) -> None:
        self._domain, self._lock, self._closed = domain, RLock(), Event()
        self._entities: list[Entity] = []
        dds_domain.hold(domain, config)
        try:
            self._participant = self._own(DomainParticipant(domain, Qos(Policy.Userdata(ENCLAVE))))
            self._waitset = self._own(WaitSet(self._participant))
            self._stop = self._own(GuardCondition(self._participant))
            self._waitset.attach(self._stop)
            self._join()
        except DDSException as error:
            self._leave()
            raise ConfigError(f"dds: no participant in domain {domain}: {error}") from error
        self._thread = Thread(target=self._listen, name=name, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Leave the graph; calling it again does nothing."""
        with self._lock:
            if self._closed.is_set():
                return
            self._closed.set()
        self._stop.set(True)
        if current_thread() is not self._thread:
            self._thread.join()
        self._leave()

    def _join(self) -> None:
        """Create what belongs to the participant from the beginning."""

    def _listen(self) -> None:
        """Take what comes until the session is closed; runs on the thread."""
        raise NotImplementedError

    def _own(self, entity: Owned) -> Owned:
        self._entities.append(entity)
        return entity

    def _await(self, reader: Any) -> ReadCondition:
        """Let the wait set report the samples of a reader."""
        ready = self._own(ReadCondition(reader, endpoints.ANY_STATE))
        self._waitset.attach(ready)
        return ready

    def _delete(self, *entities: Entity) -> None:
        """Delete entities; cyclonedds itself deletes only what is no longer referenced."""
        for entity in entities:
            self._entities.remove(entity)
            entity.__del__()

    def _leave(self) -> None:
        """Delete every entity, the last first."""
        self._delete(*reversed(self._entities))
        dds_domain.release(self._domain)


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
        Policy.Reliability.Reliable(duration(milliseconds=endpoints.BLOCKING_MS))
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
        self._made = endpoints.DdsTypes(types)
        self._told: set[str] = set()
        self._subscriptions: list[endpoints.TopicReaders] = []
        self._publications: list[endpoints.CountedWriter] = []
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
                subscription = endpoints.TopicReaders(
                    topic, type_name, qos, heard, make, partial(self._drop, topic)
                )
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
            room = endpoints.room_of(qos, self._types.fixed_size(type_name))
            policies = writer_qos(qos, self._user_data(type_name), room)
            try:
                writer = self._own(DataWriter(self._publisher, on, policies))
            except DDSException as error:
                raise ConfigError(f"{topic}: cannot be published on: {error}") from error
            self._writers.append((topic, writer))
            self._types_of[topic] = type_name
            self._publications.append(
                endpoints.CountedWriter(topic, type_name, qos, room, writer, self._types)
            )
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
        return all(endpoints.acknowledged(writer) for _, writer in self._writers)

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
        self._present(gid_bytes_of(self._types))

    def _present(self, gid_bytes: int | None) -> None:
        """Announce the node with identifiers of a size in bytes, if that is new."""
        if gid_bytes is None or gid_bytes == self._gid_bytes:
            return
        self._delete(*self._presence)  # a topic has one type, and a writer is deleted before its topic
        self._gid_bytes = gid_bytes
        types = self._presence_types = presence_types(gid_bytes)
        name = PRESENCE_TYPE
        on = self._own(Topic(self._participant, PRESENCE_TOPIC, endpoints.DdsTypes(types).of(name)))
        qos = writer_qos(QOS, user_data(type_hash(types, name)))
        writer = self._own(DataWriter(self._publisher, on, qos))
        self._presence = [writer, on]
        self._tell = endpoints.writer_of(writer)
        self._announce()

    def _announce(self) -> None:
        """Publish the entities of this node to the graph."""
        readers, writers = (
            [entity.guid.bytes for _, entity in entities] for entities in (self._readers, self._writers)
        )
        guid = self._participant.guid.bytes
        message = presence(self._presence_types, self._node, guid, readers, writers)
        self._tell(endpoints.padded(message))

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
            if not self._settled and time.monotonic() - self._since > DISCOVERY_S:
                self._settled = self._changed = True
            leftover = self._follow()
            for subscription in tuple(self._subscriptions):
                leftover += [(subscription, cdr) for cdr in subscription.take(self._offer_of)]
                for item, cdr in leftover:
                    if self._closed.is_set():
                        return
                    item.heard(endpoints.trimmed(self._types, item.type_name, cdr))
                leftover.clear()

    def _follow(self) -> list[tuple[endpoints.TopicReaders, bytes]]:
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
