"""A node in the graph of those ROS 2 nodes that run on DDS, over Cyclone DDS."""

from __future__ import annotations

from threading import Event, RLock, Thread, current_thread
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeVar

from cyclonedds.core import (
    DDSException,
    GuardCondition,
    ReadCondition,
    WaitSet,
)
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter, Publisher
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader, Subscriber
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from edoras_tools.errors import ConfigError, WireError
from edoras_tools.middleware import dds_cdr, dds_domain, dds_presence
from edoras_tools.middleware.dds_qos import BLOCKING_MS, reader_qos, writer_qos
from edoras_tools.middleware.dds_raw import ANY, taker_of, writer_of
from edoras_tools.middleware.dds_types import DdsTypes
from edoras_tools.middleware.names import check_name, dds_name

if TYPE_CHECKING:
    from collections.abc import Callable

    from cyclonedds.core import Entity

    from edoras_tools.middleware import graph
    from edoras_tools.middleware.dds_raw import Take
    from edoras_tools.ros import TypeStore

    Owned = TypeVar("Owned", bound=Entity)

_FOREVER: Final = duration(infinite=True)
_UNFIT: Final = {
    2: "the durability",
    11: "the reliability",
    23: "the data representation",
    24: "the definition of the type",
}
"""What keeps two apart, by DDS's number of the policy."""


def _loss(code: int) -> str:
    """Return why a write failed, in words."""
    if code == DDSException.DDS_RETCODE_TIMEOUT:
        return f"a reliable subscriber did not keep up for {BLOCKING_MS} ms"
    return str(DDSException(code, "while writing"))


class _Ear(NamedTuple):
    type_name: str
    take: Take
    heard: Callable[[bytes], None]


class DdsGraph:
    """A ``Graph`` over one participant.

    One thread sleeps until any topic hears something, and hands it on. Nothing here runs on Cyclone DDS's own
    threads: while ``heard`` takes its time, samples wait in their readers.

    Args:
        types: knows the types of all topics.
        node: its namespace and its name.
        domain: ``ROS_DOMAIN_ID``.
        config: of the domain, as XML.

    Raises:
        ConfigError: Cyclone DDS refuses the domain or its configuration.
    """

    def __init__(self, types: TypeStore, node: tuple[str, str], domain: int, config: str) -> None:
        self._types = types
        self._node = node
        self._domain = domain
        self._made = DdsTypes(types)
        self._lock = RLock()
        self._closed = Event()
        self._told: set[str] = set()
        self._ears: list[_Ear] = []
        self._topics: dict[str, Topic[Any]] = {}
        self._readers: list[tuple[str, DataReader[Any]]] = []
        self._writers: list[tuple[str, DataWriter[Any]]] = []
        self._entities: list[Entity] = []
        dds_domain.hold(domain, config)
        try:
            self._join()
        except DDSException as error:
            self._leave()
            raise ConfigError(f"dds: no participant in domain {domain}: {error}") from error
        self._thread = Thread(target=self._listen, name=f"dds {node[1]}", daemon=True)
        self._thread.start()

    def subscribe(self, topic: str, type_name: str, qos: graph.Qos, heard: Callable[[bytes], None]) -> None:
        """Call ``heard(cdr)`` for each message of a topic; see ``Graph``."""
        with self._lock:
            on = self._topic(topic, type_name)
            try:
                reader = self._own(DataReader(self._subscriber, on, reader_qos(qos)))
                ready = self._own(ReadCondition(reader, ANY))
                self._readers.append((topic, reader))
                self._ears.append(_Ear(type_name, taker_of(reader), heard))
                self._waitset.attach(ready)
            except DDSException as error:
                raise ConfigError(f"{topic}: cannot be subscribed to: {error}") from error
            self._announce()

    def advertise(self, topic: str, type_name: str, qos: graph.Qos) -> Callable[[bytes], None]:
        """Return what publishes one message of a topic; see ``Graph``. Once closed, it does nothing.

        It raises ``WireError`` where the message is not valid, or is lost because a reliable subscriber has
        been behind for ``BLOCKING_MS``. That can only happen where all samples are kept, or large ones.
        """
        with self._lock:
            on = self._topic(topic, type_name)
            try:
                writer = self._own(DataWriter(self._publisher, on, writer_qos(qos)))
            except DDSException as error:
                raise ConfigError(f"{topic}: cannot be published on: {error}") from error
            self._writers.append((topic, writer))
            self._announce()
        types, write, refused = self._types, writer_of(writer), DDSException.DDS_RETCODE_BAD_PARAMETER

        def publish(cdr: bytes) -> None:
            code = write(dds_cdr.padded(cdr)) if dds_cdr.is_little_endian(cdr) else refused
            if code == refused and not self._closed.is_set():
                code = write(dds_cdr.padded(dds_cdr.rewritten(types, type_name, cdr)))
            if code and not self._closed.is_set():
                raise WireError(f"{topic}: a message of {type_name} is lost: {_loss(code)}")

        return publish

    def notes(self) -> list[str]:
        """Tell once of each topic with somebody who cannot be heard, or hear, and why; see ``Graph``."""
        with self._lock:
            if self._closed.is_set():
                return []
            found: list[tuple[str, str, Any]] = [
                (topic, "a publisher", reader.get_requested_incompatible_qos_status())  # type: ignore[no-untyped-call]
                for topic, reader in self._readers
            ]
            found += [
                (topic, "a subscriber", writer.get_offered_incompatible_qos_status())  # type: ignore[no-untyped-call]
                for topic, writer in self._writers
            ]
        unfit = dict.fromkeys(
            f"{topic}: {who} does not match: {_UNFIT.get(status.last_policy_id, 'a policy')} differs"
            for topic, who, status in found
            if status.total_count
        )
        new = [note for note in unfit if note not in self._told]
        self._told.update(new)
        return new

    def close(self) -> None:
        """Leave the graph; see ``Graph``."""
        with self._lock:
            if self._closed.is_set():
                return
            self._closed.set()
        self._stop.set(True)
        if current_thread() is not self._thread:
            self._thread.join()
        self._leave()

    def _join(self) -> None:
        """Become a participant, and a node where the distribution's types say how."""
        user_data = Qos(Policy.Userdata(dds_presence.ENCLAVE))
        self._participant = self._own(DomainParticipant(self._domain, user_data))
        self._publisher = self._own(Publisher(self._participant))
        self._subscriber = self._own(Subscriber(self._participant))
        self._waitset = self._own(WaitSet(self._participant))
        self._stop = self._own(GuardCondition(self._participant))
        self._waitset.attach(self._stop)
        self._tell: Callable[[bytes], int] | None = None
        if self._types.has(dds_presence.TYPE):
            on = self._own(Topic(self._participant, dds_presence.TOPIC, self._made.of(dds_presence.TYPE)))
            writer = self._own(DataWriter(self._publisher, on, writer_qos(dds_presence.QOS)))
            self._tell = writer_of(writer)
            self._announce()

    def _announce(self) -> None:
        """Tell the graph what this node consists of."""
        if self._tell is not None:
            readers, writers = (
                [entity.guid.bytes for _, entity in entities] for entities in (self._readers, self._writers)
            )
            guid = self._participant.guid.bytes
            self._tell(dds_cdr.padded(dds_presence.presence(self._types, self._node, guid, readers, writers)))

    def _topic(self, topic: str, type_name: str) -> Topic[Any]:
        """Return a topic, the same one for the same name."""
        if self._closed.is_set():
            raise ConfigError(f"{topic}: the node {self._node[1]} has left the graph")
        check_name(topic, "topic")
        if why := self._types.check(type_name):
            raise ConfigError(f"{topic}: {why}")
        try:
            made = self._made.of(type_name)
            if topic not in self._topics:
                self._topics[topic] = self._own(Topic(self._participant, f"rt{topic}", made))
        except ConfigError as error:
            raise ConfigError(*(f"{topic}: {mistake}" for mistake in error.mistakes)) from error
        except DDSException as error:
            raise ConfigError(f"{topic}: refused by Cyclone DDS: {error}") from error
        found = self._topics[topic]
        if found.data_type is not made:
            raise ConfigError(
                f"{topic}: is of type {found.typename} here, and cannot be {dds_name(type_name)} too"
            )
        return found

    def _listen(self) -> None:
        while not self._closed.is_set():
            self._waitset.wait(_FOREVER)
            for ear in tuple(self._ears):
                for cdr in ear.take():
                    if self._closed.is_set():
                        return
                    ear.heard(dds_cdr.trimmed(self._types, ear.type_name, cdr))

    def _own(self, entity: Owned) -> Owned:
        self._entities.append(entity)
        return entity

    def _leave(self) -> None:
        """Delete every entity, the last first; cyclonedds deletes only what nobody refers to any more."""
        for entity in reversed(self._entities):
            entity.__del__()
        self._entities.clear()
        dds_domain.release(self._domain)
