"""Finds the packets that a name of the tables stands for: a topic, C struct, MsgId, or message of a link."""

from __future__ import annotations

import re
from fnmatch import fnmatchcase, translate
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.cfs.names import MSG_ID_NAMES
from edoras_tools.decode.spacecraft import FIRST_SPACECRAFT, split_topic
from edoras_tools.errors import RouteError
from edoras_tools.io.topics.rows import APART
from edoras_tools.links import table
from edoras_tools.model import NO_MSG_ID, Columns, PacketBatch
from edoras_tools.structs.shapes import Key
from edoras_tools.words import did_you_mean, listed

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from edoras_tools.decode.context import Context
    from edoras_tools.links.site import Endpoints
    from edoras_tools.mission import Mission
    from edoras_tools.wire.arrays.order import Mask

PATTERN_SIGNS: Final = frozenset("*?[")
"""Characters that make a name a shell pattern."""


class SampleTopics(msgspec.Struct, frozen=True):
    """Samples on some announced topics, whether their types are known or not.

    Attributes:
        pattern: shell pattern of the topics' names, as recordings have them.
        used: names of the mission's topics.
        endpoints: endpoints announced so far.
        announced: whether the datagrams that first announced these topics also belong to them.
    """

    pattern: str
    used: frozenset[str]
    endpoints: Endpoints
    announced: bool = False

    @classmethod
    def of(cls, topic: str, context: Context) -> SampleTopics:
        """Return the samples of one announced topic."""
        used = frozenset(route.topic for route in context.mission.routes)
        return cls(_recorded_as(topic, used), used, context.endpoints)

    def holds(self, topic: str) -> bool:
        """Return whether an announced topic is one of them."""
        return fits_topic(_recorded_as(topic, self.used), self.pattern)

    def mask(self, batch: PacketBatch, columns: Columns) -> Mask:
        """Return which rows of a batch have such a sample: bool (rows,)."""
        rows_on = np.zeros(len(batch), bool)
        for link in (item for item in table.links() if item.samples):
            rows = np.flatnonzero(columns.link == link)
            if len(rows):
                rows_on[link.sample_reader().rows_on(batch, rows, self.endpoints, self.holds)] = True
            if len(rows) and self.announced:
                announced = self.endpoints.announced.values()
                numbers = [number for item, number in announced if item.topic and self.holds(item.ros_topic)]
                rows_on[rows[np.isin(batch.number[rows], numbers)]] = True
        return rows_on


class PacketKinds(msgspec.Struct, frozen=True):
    """A set of packets, as the union of the attributes.

    Attributes:
        routes: indices of configured routes.
        keys: MsgIds, with function codes for commands.
        kinds: pairs of a link's code and its own message type, as ``links.table.message_kinds`` has it.
        samples: samples on announced topics.
    """

    routes: frozenset[int] = frozenset()
    keys: frozenset[Key] = frozenset()
    kinds: frozenset[tuple[int, int]] = frozenset()
    samples: tuple[SampleTopics, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.routes or self.keys or self.kinds or self.samples)

    @property
    def only_samples(self) -> bool:
        """Whether the set has samples on announced topics, and nothing else."""
        return bool(self.samples) and not (self.routes or self.keys or self.kinds)

    def with_announcements(self) -> PacketKinds:
        """Return the set with the datagrams that announce its topics."""
        return replace(self, samples=tuple(replace(item, announced=True) for item in self.samples))

    @classmethod
    def any(cls, several: Iterable[PacketKinds]) -> PacketKinds:
        """Return the union of several sets."""
        kinds = list(several)
        return cls(
            frozenset().union(*(item.routes for item in kinds)),
            frozenset().union(*(item.keys for item in kinds)),
            frozenset().union(*(item.kinds for item in kinds)),
            tuple(own for item in kinds for own in item.samples),
        )

    def mask(self, batch: PacketBatch, columns: Columns) -> Mask:
        """Return which rows of a batch are in the set: bool (rows,)."""
        mask = np.isin(columns.route, list(self.routes))
        mask |= np.isin(columns.msg_id, [key.msg_id for key in self.keys if key.function_code is None])
        for key in self.keys:
            if key.port is not None:
                at_port = table.among(columns.link, lambda link: link.last_hop)
                at_port &= batch.destination_port == key.port
                mask |= at_port & ((batch.length == key.function_code) | (key.function_code is None))
            elif key.function_code is not None:
                mask |= (columns.msg_id == key.msg_id) & (columns.function_code == key.function_code)
        if self.kinds:
            own = table.message_kinds(columns, batch.length)
            for code, kind in self.kinds:
                mask |= (columns.link == code) & (own == kind) & (columns.msg_id == NO_MSG_ID)
        for item in self.samples:
            mask |= item.mask(batch, columns)
        return mask

    def has_sample_topic(self, topic: str) -> bool:
        """Return whether samples on an announced topic are in the set."""
        return any(item.holds(topic) for item in self.samples)

    def shares_samples(self, other: PacketKinds) -> bool:
        """Return whether both sets have samples on a common announced topic."""
        topics = {name for item in self.samples for name in item.endpoints.topics()}
        return any(self.has_sample_topic(name) and other.has_sample_topic(name) for name in topics)

    def types(self, mission: Mission) -> set[str]:
        """Return the types of all messages; empty if some have no type in the mission."""
        routed = not (self.keys or self.kinds or self.samples)
        return {mission.routes[index].type for index in self.routes} if routed else set()

    def msg_ids(self, mission: Mission) -> set[int]:
        """Return the MsgIds of the set."""
        return {mission.routes[index].msg_id for index in self.routes} | {key.msg_id for key in self.keys}


def _recorded_as(topic: str, used: frozenset[str]) -> str:
    return f"{APART}{topic}" if topic in used else topic


def fits_topic(topic: str, pattern: str) -> bool:
    """Return whether a topic matches a shell pattern, with or without its leading slash."""
    return bool(_matcher(pattern)(topic))


def _fitting(topics: Iterable[str], pattern: str) -> frozenset[int]:
    """Return the indices of the topics that match a shell pattern."""
    fits = _matcher(pattern)
    return frozenset(place for place, topic in enumerate(topics) if fits(topic))


@lru_cache
def _matcher(pattern: str) -> Callable[[str], object]:
    full = pattern if pattern.startswith(("/", "*")) else f"/{pattern}"
    return full.__eq__ if PATTERN_SIGNS.isdisjoint(full) else re.compile(translate(full)).match


def find_packets(pattern: str, context: Context) -> PacketKinds:
    """Return the packets of a name: a topic, a MsgId, or a name that tables show, e.g. ``SBN_HEARTBEAT``.

    Args:
        pattern: topics and names may be shell patterns.
        context: has the mission and the C structs.

    Raises:
        RouteError: the name has no packets; the text suggests a similar name.
    """
    name, routes = pattern.upper(), context.mission.routes
    if context.mission.recorded:
        return _recorded(pattern, [route.topic for route in routes])
    structs = [item for item in context.structs.all if fits_topic(item.topic, pattern)]
    keys = [item.key for item in structs if item.key.port != 0]
    own = [item.name.upper() for item in structs if item.key.port == 0]  # names of the robot link
    of_known = context.msg_ids.of_known
    keys += [Key(of_known(value)) for value, label in MSG_ID_NAMES.items() if fnmatchcase(label, name)]
    if (value := _number(pattern)) is not None:
        keys.append(Key(value))
    kinds_found = PacketKinds(
        _fitting((route.topic for route in routes), pattern),
        frozenset(keys),
        frozenset(kind for label, kind in _own_names() if label in own or fnmatchcase(label, name)),
    )
    samples = SampleTopics(pattern, frozenset([route.topic for route in routes]), context.endpoints)
    announced = [] if kinds_found else [*filter(samples.holds, context.announced_topics())]
    if kinds_found or announced or (context.awaits_samples and pattern[:1] == "/"):
        return replace(kinds_found, samples=(samples,))
    raise _no_packet(pattern, context)


def packets_of(pattern: str, context: Context, spacecraft: int) -> PacketKinds:
    """Return the packets of a name on one spacecraft; none if it is a topic of another spacecraft.

    Raises:
        RouteError: the name has no packets at all.
    """
    name = split_topic(pattern)[0]
    own = context.mission.number_of(name) if name else spacecraft
    try:
        kinds = find_packets(pattern, context.of(own or spacecraft))
    except RouteError:
        if spacecraft == FIRST_SPACECRAFT:
            raise
        return PacketKinds()
    return kinds if own == spacecraft else PacketKinds()


def _no_packet(pattern: str, context: Context) -> RouteError:
    configured = [*(route.topic for route in context.mission.routes), *context.announced_topics()]
    topics = [*configured, *(item.topic for item in context.structs.all)]
    names = [*MSG_ID_NAMES.values(), *(label for label, _ in _own_names() if "0X" not in label)]
    near = did_you_mean(f"/{pattern.removeprefix('/')}", topics, 1, 0.8)
    near = near or (did_you_mean(pattern, names, 1, 0.8) if pattern[:1] != "/" else "")
    existing = listed(list(dict.fromkeys(configured)), 12)
    hint = f"there are: {existing}" if configured else "name a mission with -c"
    return RouteError(f"no configured topic matches {pattern!r}; {near or hint}")


def _recorded(pattern: str, topics: Sequence[str]) -> PacketKinds:
    """Return the topics of a recording without datagrams that match a name.

    Raises:
        RouteError: there is none.
    """
    places = _fitting(topics, pattern)
    if not places:
        near = did_you_mean(f"/{pattern.removeprefix('/')}", topics, 1)
        hint = f"there are {listed(sorted(set(topics)), 12)}"
        raise RouteError(f"no topic of the recording matches {pattern!r}; {near or hint}")
    return PacketKinds(places)


def _number(text: str) -> int | None:
    try:
        value = int(text, 0)
    except ValueError:
        return None
    return value if 0 <= value <= 0xFFFF else None


@cache
def _own_names() -> tuple[tuple[str, tuple[int, int]], ...]:
    """Return the names of the links' own messages, each with its link's code and type."""
    kinds = ((item.message_name(kind), (int(item), kind)) for item in table.links() for kind in range(256))
    return tuple((name.upper(), kind) for name, kind in kinds if name)
