"""Observes a ROS 2 graph on DDS: the endpoints with their quality of service, and their messages.

Cyclone DDS gives no sequence number of a sample, but it counts the samples that its readers lost. The
observer is no
node: others see a participant without a name.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from cyclonedds.core import DDSException, InstanceState
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from edoras_tools.addons.dds import domain as dds_domain
from edoras_tools.addons.dds import graph as dds_peers
from edoras_tools.addons.dds.endpoints import DdsTypes, info_taker_of, trimmed
from edoras_tools.addons.dds.graph import Session, reader_qos
from edoras_tools.errors import ConfigError, WireError
from edoras_tools.middleware.graph import Qos, ros_name
from edoras_tools.ros.type_hash import type_hash

if TYPE_CHECKING:
    from cyclonedds.builtin import DcpsEndpoint
    from cyclonedds.qos import Qos as DdsQos

    from edoras_tools.addons.dds.endpoints import TakeWithInfo
    from edoras_tools.ros import TypeStore

_WORD: Final = re.compile(r"(?<=[a-z])(?=[A-Z])")
_FOREVER: Final = duration(infinite=True)
_ALL: Final = Qos(transient_local=True, depth=0)
"""Policies for announcements: all nodes of a participant are samples of one instance, so all must be kept."""


class _Observed(NamedTuple):
    type_name: str
    reader: DataReader[Any]
    take: TakeWithInfo
    heard: Callable[[bytes, int, int, int, str], None]


class DdsObserver(Session):
    """Observes a graph over one participant; a thread takes the samples of all topics.

    Args:
        types: types of all topics.
        domain: ``ROS_DOMAIN_ID``.
        config: configuration of the domain, as XML.

    Raises:
        ConfigError: Cyclone DDS refuses the domain or its configuration.
    """

    def __init__(self, types: TypeStore, domain: int, config: str) -> None:
        self._types, self._made = types, DdsTypes(types)
        self._observed: dict[str, _Observed] = {}
        self._seen: dict[Any, tuple[bool, DcpsEndpoint]] = {}
        self._nodes: dict[str, str] = {}
        self._gids: dict[int, str] = {}
        self._presence: tuple[TypeStore, TakeWithInfo] | None = None
        super().__init__(domain, config, "dds observer")

    def _join(self) -> None:
        self._everybody = dds_peers.discovery_readers(self._participant)
        self._entities += [reader for _, reader in self._everybody]

    def described(self) -> list[dict[str, Any]]:
        """Return the endpoints of all ROS topics, each as fields by name."""
        with self._lock:
            for publishes, item in dds_peers.announcements(self._everybody):
                self._note(item, publishes=publishes)
            if self._presence is not None:
                types, take = self._presence
                for cdr, _ in take():
                    with suppress(WireError):
                        self._note_nodes(types.decode(dds_peers.PRESENCE_TYPE, cdr))
            return [
                self._fields(item, publishes=publishes)
                for publishes, item in self._seen.values()
                if item.topic_name.startswith("rt/")
            ]

    def observe(self, topic: str, type_name: str, qos: Qos, heard: Any) -> None:
        """Call ``heard`` for each message, with times of receiving and publishing, 0, and its publisher.

        Raises:
            ConfigError: the type is unknown, or Cyclone DDS refuses the topic.
        """
        try:
            user_data = dds_peers.user_data(type_hash(self._types, type_name))
            reader = self._reader(f"rt{topic}", self._made, type_name, reader_qos(qos, user_data))
        except DDSException as error:
            raise ConfigError(f"{topic}: cannot be subscribed to: {error}") from error
        self._observed[topic] = _Observed(type_name, reader, info_taker_of(reader), heard)
        self._await(reader)

    def lost(self) -> Mapping[str, int]:
        """Return the number of samples that the readers lost so far, by topic."""
        statuses = {
            topic: item.reader.get_sample_lost_status()  # type: ignore[no-untyped-call]
            for topic, item in self._observed.items()
        }
        return {topic: int(status.total_count) for topic, status in statuses.items()}

    def _reader(self, topic: str, types: DdsTypes, type_name: str, qos: DdsQos) -> DataReader[Any]:
        on = self._own(Topic(self._participant, topic, types.of(type_name)))
        return self._own(DataReader(self._participant, on, qos))

    def _listen(self) -> None:
        while not self._closed.is_set():
            self._waitset.wait(_FOREVER)
            for item in tuple(self._observed.values()):
                samples, now_ns = item.take(), time.time_ns()
                for cdr, info in samples:
                    message, source_ns = trimmed(self._types, item.type_name, cdr), info.source_timestamp
                    gid = self._gid(item.reader, info.publication_handle)
                    item.heard(message, now_ns, max(source_ns, 0), 0, gid)

    def _gid(self, reader: DataReader[Any], handle: int) -> str:
        """Return the identifier of a writer; empty if it left before the query."""
        if handle not in self._gids:
            with suppress(DDSException, AttributeError):
                writer: Any = reader.get_matched_publication_data(handle)
                self._gids[handle] = writer.key.bytes.hex()
        return self._gids.get(handle, "")

    def _note(self, item: Any, *, publishes: bool) -> None:
        """Process an announcement of discovery: an endpoint that exists, or one that left."""
        if item.sample_info.instance_state != InstanceState.Alive:
            self._seen.pop(item.key, None)
        elif item.topic_name:
            self._seen[item.key] = publishes, item
            if self._presence is None and publishes and item.topic_name == dds_peers.PRESENCE_TOPIC:
                types = dds_peers.presence_types(dds_peers.gid_bytes_told(dds_peers.hash_of(item.qos)))
                names = dds_peers.PRESENCE_TOPIC, DdsTypes(types), dds_peers.PRESENCE_TYPE
                self._presence = types, info_taker_of(self._reader(*names, reader_qos(_ALL)))

    def _note_nodes(self, presence: Mapping[str, Any]) -> None:
        """Process the announcement of a participant's nodes: which endpoints belong to them."""
        for entry in presence["node_entities_info_seq"]:
            name = f"{entry['node_namespace'].rstrip('/')}/{entry['node_name']}"
            gids = (*entry["reader_gid_seq"], *entry["writer_gid_seq"])
            self._nodes |= {bytes(gid["data"])[:16].hex(): name for gid in gids}

    def _fields(self, item: DcpsEndpoint, *, publishes: bool) -> dict[str, Any]:
        policies = {policy.__scope__: policy for policy in item.qos}
        words = {name: _word(policies.get(name)) for name in ("Reliability", "Durability", "Liveliness")}
        spans = {
            "Lifespan": ("Lifespan", "lifespan"),
            "Deadline": ("Deadline", "deadline"),
            "Liveliness lease duration": ("Liveliness", "lease_duration"),
        }
        times = {key: getattr(policies.get(name), field, _FOREVER) for key, (name, field) in spans.items()}
        gid = item.key.bytes.hex()
        return {
            "topic": item.topic_name.removeprefix("rt"),
            "type": ros_name(item.type_name),
            "publishes": publishes,
            "gid": gid,
            "node": self._nodes.get(gid, ""),
            "policies": {**words, **times, "History (Depth)": "UNKNOWN"},
            "type_hash": dds_peers.hash_of(item.qos),
            "own": item.participant_key == self._participant.guid,
        }


def _word(policy: Any) -> str:
    """Return ROS's name of a policy's value: ``BEST_EFFORT`` for ``BestEffort``."""
    return _WORD.sub("_", str(policy).partition("(")[0].rpartition(".")[2]).upper()


def dds_observer(
    store: TypeStore, node: str, *, domain: int = 0, options: Mapping[str, str] | None = None
) -> DdsObserver:
    """Join the graph to observe it; see ``graph.open_graph``."""
    del node
    return DdsObserver(store, domain, dds_domain.configuration(options or {}))
