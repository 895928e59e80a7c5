"""The other participants of the domain, by DDS's discovery, and the announcement of our node to them.

From Iron on an endpoint's user data has ``typehash=RIHS01_...;``: the hash of its type's definition. ``ros2
node list`` shows a participant whose entities are published on ``ros_discovery_info``.

A ``Session`` is a participant of ours in a domain, and the thread that waits for what it receives.
"""

from __future__ import annotations

from collections import defaultdict
from difflib import get_close_matches
from functools import cache
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
from cyclonedds.qos import Policy, Qos

from edoras_tools.addons.dds import domain as dds_domain
from edoras_tools.addons.dds.domain import configuration, hold, release
from edoras_tools.addons.dds.messages import ANY_STATE
from edoras_tools.errors import ConfigError
from edoras_tools.middleware import graph
from edoras_tools.middleware.graph import dds_name, ros_name
from edoras_tools.ros import TypeStore
from edoras_tools.ros.store import USUAL_DISTRO
from edoras_tools.ros.type_hash import HASH_VERSION, type_hash

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
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
        ready = self._own(ReadCondition(reader, ANY_STATE))
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
