"""A node in the graph of ROS 2 nodes that run on rmw_zenoh; see docs/zenoh.md."""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from itertools import count
from threading import Lock, RLock
from typing import TYPE_CHECKING, Any, Final

import zenoh
from msgspec.structs import replace
from zenoh import ext

from edoras_tools.addons.zenoh import identity
from edoras_tools.errors import ConfigError
from edoras_tools.middleware.graph import Graph, Qos, TopicState, check_name, unknown_options
from edoras_tools.ros.library import full_name
from edoras_tools.ros.type_hash import type_hash

if TYPE_CHECKING:
    from edoras_tools.ros import TypeStore


ROUTER: Final = "tcp/localhost:7447"
"""Endpoint where rmw_zenoh's nodes look for a router."""
_OPTIONS: Final = ("router", "mode", "listen", "config", "type_hash")
_CONFIG_FILE: Final = "ZENOH_SESSION_CONFIG_URI"
_OVERRIDES: Final = "ZENOH_CONFIG_OVERRIDE"
"""The environment variables that rmw_zenoh reads."""
_DEFAULTS: Final = {
    "mode": "peer",
    "connect/endpoints": [ROUTER],
    "listen/endpoints": ["tcp/localhost:0"],
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": True,
    "timestamping/enabled": True,  # a cache needs it
    "queries_default_timeout": 600_000,
    "transport/shared_memory/enabled": False,
}
"""Settings of rmw_zenoh's session configuration that differ from Zenoh's own."""
_PLACE: Final = re.compile(r"\s*at /[^\s\]\"]+")
_INNER: Final = re.compile(r'(?:msg: |Str\()"(.*?)"')
_KEYS: Final = {"router": "connect/endpoints", "listen": "listen/endpoints", "mode": "mode"}
_MODES: Final = ("peer", "client")
_PORT: Final = re.compile(r":[1-9]\d*(?=[?#]|$)")


def session_config(options: Mapping[str, str]) -> zenoh.Config:
    """Return a session's configuration.

    The later wins: rmw_zenoh's defaults, or the file of ``config`` or ``ZENOH_SESSION_CONFIG_URI`` in their
    place; ``ZENOH_CONFIG_OVERRIDE``; the options.

    Raises:
        ConfigError: an option, a file or a value that cannot be honoured.
    """
    mistakes = unknown_options("zenoh", options, _OPTIONS)
    mode = options.get("mode", _MODES[0])
    if mode not in _MODES:
        mistakes.append(f"zenoh: mode {mode!r} does not exist; write {' or '.join(_MODES)}")
    if mistakes:
        raise ConfigError(*mistakes)
    file = options.get("config") or os.environ.get(_CONFIG_FILE)
    with _zenoh_errors(f"{file}: no configuration of a Zenoh session"):
        config = zenoh.Config.from_file(file) if file else zenoh.Config()
    for source, key, value in _settings(options, defaults=not file):
        with _zenoh_errors(f"{source}: {key} cannot be {value}"):
            config.insert_json5(key, value)
    return config


def listen_beside(config: zenoh.Config, used: Collection[str]) -> list[str]:
    """Move a session away from endpoints where others of this process listen, and connect it to these.

    Instead it listens at a port that the system chooses; gossip announces that port to the other peers.

    Args:
        config: configuration of the session, changed in place.
        used: endpoints that are in use, in the form of ``listen``.

    Returns:
        the endpoints with a fixed port where this session itself will listen.
    """
    if _mode(config) == "client":
        return []  # listens nowhere
    places = _places(config, "listen")
    if shared := [place for place in places if place in used]:
        beside = [_PORT.sub(":0", place) if place in used else place for place in places]
        config.insert_json5("listen/endpoints", json.dumps(beside))
        config.insert_json5("connect/endpoints", json.dumps([*_places(config, "connect"), *shared]))
    return [place for place in places if place not in used and _PORT.search(place)]


def _places(config: zenoh.Config, group: str) -> list[str]:
    """Return the endpoints of ``listen`` or ``connect``: one list, or the list of the session's mode."""
    places = json.loads(config.get_json(f"{group}/endpoints"))
    if isinstance(places, dict):
        places = places.get(_mode(config))
    return [str(item) for item in places or []]


def _mode(config: zenoh.Config) -> str:
    return str(json.loads(config.get_json("mode")) or _MODES[0])


def _reported(error: zenoh.ZError, what: str, remedy: str = "") -> ConfigError:
    """Return an error of Zenoh in one line, without positions in its source files."""
    text = _PLACE.sub("", str(error))
    inner = _INNER.search(text)
    return ConfigError(f"{what}: {(inner[1] if inner else text).strip(' .!')}{remedy}")


@contextmanager
def _zenoh_errors(what: str, remedy: str = "") -> Iterator[None]:
    """Report an error of Zenoh, see ``_reported``."""
    try:
        yield
    except zenoh.ZError as error:
        raise _reported(error, what, remedy) from error


def _settings(options: Mapping[str, str], *, defaults: bool) -> Iterator[tuple[str, str, str]]:
    """Yield the origin of a setting, its key, and its value in JSON5."""
    if defaults:
        for key, value in _DEFAULTS.items():
            yield "zenoh", key, json.dumps(value)
    for pair in filter(None, os.environ.get(_OVERRIDES, "").split(";")):
        key, _, text = pair.partition("=")
        yield _OVERRIDES, key.strip(), text
    for name, key in _KEYS.items():
        if name in options:
            words = options[name]
            places = [item.strip() for item in words.split(",") if item.strip()]
            yield f"zenoh: {name}", key, json.dumps(words if name == "mode" else places)


_WITHOUT_HASH: Final = frozenset({"dashing", "eloquent", "foxy", "galactic", "humble"})
"""Distributions without type hashes."""
_HASHES: Final = {"rihs01": True, "none": False}
_LONELY_S: Final = 3.0
"""Seconds without any peer after which a note says so."""
_LONELY: Final = "no Zenoh router or other peer answers; start a router: ros2 run rmw_zenoh_cpp rmw_zenohd"
_HEARTBEAT: Final = 0.5
"""Seconds after which a subscription learns of a last message that it missed, as in rmw_zenoh."""
_TAKEN: Final[set[str]] = set()
"""Endpoints with a fixed port where sessions of this process listen; each has only one listener."""


class ZenohGraph(Graph):
    """A ``Graph`` over one Zenoh session.

    Args:
        session: open session; the graph closes it.
        node: node that others see.
        hashed: put hashes of types into keys, as all distributions since Iron do.
        places: endpoints with a fixed port where the session listens.
    """

    def __init__(
        self,
        session: zenoh.Session,
        node: identity.NodeTokens,
        types: TypeStore,
        *,
        hashed: bool,
        places: Collection[str] = (),
    ) -> None:
        self._session = session
        self._node = node
        self._types = types
        self._hashed = hashed
        self._places = places
        _TAKEN.update(places)
        self._ids = count(1)
        self._listening: list[_Listener] = []
        self._own: set[bytes] = set()
        self._states: dict[str, Callable[[], TopicState]] = {}
        self._closing = Lock()
        self._closed = False
        self._lonely_at: float | None = time.monotonic() + _LONELY_S
        self._tokens = [session.liveliness().declare_token(node.token)]
        self._entities: list[Any] = []

    @property
    def connected(self) -> bool:
        """Whether a router or another peer is connected."""
        info = self._session.info
        return bool(info.routers_zid() or info.peers_zid())

    def subscribe(self, topic: str, type_name: str, qos: Qos, heard: Callable[[bytes], None]) -> None:
        """Call ``heard(cdr)`` for each message of a topic; see ``Graph``.

        A policy that adapts to the publishers requests the most: in Zenoh, weaker publishers are received,
        too.
        """
        topic_ = self._topic(topic, type_name)
        qos = replace(
            qos, reliable=qos.reliable is not False, transient_local=qos.transient_local is not False
        )
        listener = _Listener(heard, self._own if qos.transient_local else frozenset())
        self._states[topic] = lambda: TopicState((qos,), listener.missed)
        declare: Callable[..., Any] = self._session.declare_subscriber
        more: dict[str, Any] = {}
        if qos.transient_local:
            declare = partial(ext.declare_advanced_subscriber, self._session)
            recovery = ext.RecoveryConfig(periodic_queries=None, heartbeat=True) if qos.reliable else None
            history = ext.HistoryConfig(detect_late_publishers=True, max_samples=identity.depth(qos))
            more = {"history": history, "recovery": recovery, "subscriber_detection": True}
        with _zenoh_errors(f"{topic}: refused by Zenoh"):
            key = topic_.key(self._node.domain)
            entity = declare(key, listener, allowed_origin=zenoh.Locality.REMOTE, **more)
        self._listening.append(listener)
        self._announce(entity, identity.TokenKind.SUBSCRIPTION, topic_, qos)

    def advertise(self, topic: str, type_name: str, qos: Qos) -> Callable[[bytes], None]:
        """Return a function that publishes a message of a topic, until the graph is closed; see ``Graph``."""
        topic_ = self._topic(topic, type_name)
        all_kept = qos.reliable and not qos.depth
        options: dict[str, Any] = {
            "congestion_control": zenoh.CongestionControl.BLOCK if all_kept else zenoh.CongestionControl.DROP,
            "reliability": zenoh.Reliability.RELIABLE if qos.reliable else zenoh.Reliability.BEST_EFFORT,
            "allowed_destination": zenoh.Locality.REMOTE,
        }
        declare: Callable[..., Any] = self._session.declare_publisher
        if qos.transient_local:
            declare = partial(ext.declare_advanced_publisher, self._session)
            detection = ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=_HEARTBEAT)
            options["cache"] = ext.CacheConfig(identity.depth(qos))
            options["sample_miss_detection"] = detection if qos.reliable else None
            options["publisher_detection"] = True
        with _zenoh_errors(f"{topic}: refused by Zenoh"):
            publisher = declare(topic_.key(self._node.domain), **options)
        self._states.setdefault(topic, lambda: TopicState((qos,)))
        source = identity.gid(self._announce(publisher, identity.TokenKind.PUBLISHER, topic_, qos))
        self._own.add(source)
        put, attach, now, numbers = publisher.put, identity.ATTACHMENT.pack, time.time_ns, count(1)

        def publish(cdr: bytes) -> None:
            try:
                put(cdr, attachment=attach(next(numbers), now(), identity.GID, source))
            except zenoh.ZError as error:
                if not self._closed:
                    raise _reported(error, f"{topic}: cannot be published on") from error

        return publish

    def states(self) -> Mapping[str, TopicState]:
        """See ``Graph``: gaps in the sequence numbers of publishers count as missed."""
        return {topic: state() for topic, state in self._states.items()}

    def notes(self) -> list[str]:
        """Return a note, once, that no peer is there; see ``Graph``."""
        if self._lonely_at is None or time.monotonic() < self._lonely_at:
            return []
        self._lonely_at = None
        return [] if self.connected else [_LONELY]

    def close(self) -> None:
        """Leave the graph; see ``Graph``."""
        with self._closing:
            if self._closed:
                return
            self._closed = True
        for listener in self._listening:
            listener.stop()
        for thing in (*self._tokens, *self._entities):
            thing.undeclare()
        self._session.close()  # type: ignore[no-untyped-call]
        _TAKEN.difference_update(self._places)

    def _topic(self, topic: str, type_name: str) -> identity.KeyedTopic:
        name = check_name(topic, "topic")
        if why := self._types.check(type_name):
            raise ConfigError(f"{topic}: {why}")
        digest = type_hash(self._types, type_name) if self._hashed else identity.NO_TYPE_HASH
        return identity.KeyedTopic(name, full_name(type_name), digest)

    def _announce(self, entity: Any, kind: identity.TokenKind, topic: identity.KeyedTopic, qos: Qos) -> str:
        """Announce an entity in the graph; return its token."""
        token = self._node.entity_token(kind, next(self._ids), topic, qos)
        self._entities.append(entity)
        self._tokens.append(self._session.liveliness().declare_token(token))
        return token


class _Listener:
    """Passes on samples until it is stopped; then nothing more, not even waiting ones.

    Args:
        heard: called with each message.
        ignored: ids of publishers to ignore: caches of the own session answer in spite of the locality.

    Attributes:
        missed: messages that were lost according to the sequence numbers of their publishers.
    """

    def __init__(self, heard: Callable[[bytes], None], ignored: Collection[bytes]) -> None:
        self.missed = 0
        self._heard: Callable[[bytes], None] | None = heard
        self._ignored = ignored
        self._speaking = RLock()
        self._last: dict[bytes, int] = {}

    def __call__(self, sample: zenoh.Sample) -> None:
        attachment = sample.attachment.to_bytes() if sample.attachment else b""
        if attachment[-identity.GID :] in self._ignored:
            return
        with self._speaking:
            if len(attachment) == identity.ATTACHMENT.size:
                self._count(attachment)
            if self._heard is not None:
                self._heard(sample.payload.to_bytes())

    def _count(self, attachment: bytes) -> None:
        number, _, _, source = identity.ATTACHMENT.unpack(attachment)
        last = self._last.setdefault(source, number - 1)
        self._last[source] = max(number, last)
        # A message that arrives after a later one was counted as missed before.
        self.missed = max(self.missed + (number - last - 1 if number > last else -1), 0)

    def stop(self) -> None:
        """Stop; return once a message that is being passed on is done."""
        with self._speaking:
            self._heard = None


def open_graph(
    store: TypeStore, node: str, *, domain: int = 0, options: Mapping[str, str] | None = None
) -> ZenohGraph:
    """Join the graph as a node.

    Args:
        store: types of all topics; its distribution decides whether keys hold hashes of types.
        node: name of the node, or ``/namespace/name``.
        domain: ``ROS_DOMAIN_ID``.
        options: see docs/zenoh.md: ``router``, ``mode``, ``listen``, ``config``, ``type_hash``.

    Raises:
        ConfigError: an option is not valid, or the session cannot be opened.
        ImportError: Zenoh is not installed.
    """
    options = options or {}
    if domain < 0:
        raise ConfigError(f"zenoh: domain {domain} does not exist; they count from 0")
    hash_kind = options.get("type_hash", "none" if store.distro in _WITHOUT_HASH else "rihs01")
    if hash_kind not in _HASHES:
        raise ConfigError(f"zenoh: type_hash {hash_kind!r} does not exist; write {' or '.join(_HASHES)}")
    identity.NodeTokens.of_node(node, domain, "")  # a wrong name is reported before a session is opened
    config = session_config(options)
    places = listen_beside(config, _TAKEN)
    router = "start a router there: ros2 run rmw_zenoh_cpp rmw_zenohd"
    remedy = router if options.get("mode") == "client" else "listen somewhere else"
    with _zenoh_errors("zenoh: no session", f"; {remedy}"):
        session = zenoh.open(config)
    tokens = identity.NodeTokens.of_node(node, domain, str(session.zid()))
    return ZenohGraph(session, tokens, store, hashed=_HASHES[hash_kind], places=places)
