"""A participant of ours in a domain, and the thread that waits for what it receives."""

from __future__ import annotations

from threading import Event, RLock, Thread, current_thread
from typing import TYPE_CHECKING, Any, TypeVar

from cyclonedds.core import DDSException, GuardCondition, ReadCondition, WaitSet
from cyclonedds.domain import DomainParticipant
from cyclonedds.qos import Policy, Qos

from edoras_tools.addons.dds import domain as dds_domain
from edoras_tools.addons.dds.messages import ANY_STATE
from edoras_tools.addons.dds.peers import ENCLAVE
from edoras_tools.errors import ConfigError

if TYPE_CHECKING:
    from cyclonedds.core import Entity

    Owned = TypeVar("Owned", bound=Entity)


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
