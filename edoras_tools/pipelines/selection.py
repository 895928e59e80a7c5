"""Which datagrams a command reads: by link, MsgId, topic and filter, over columns.

A name of the tables stands for packets too: a topic, C struct, MsgId, or message of a link.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from datetime import date, datetime, time, timedelta, tzinfo
from fnmatch import fnmatchcase, translate
from functools import cache, lru_cache, partial
from typing import TYPE_CHECKING, Final, overload

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.cfs.names import MSG_ID_NAMES
from edoras_tools.decode.spacecraft import FIRST_SPACECRAFT, split_topic
from edoras_tools.errors import CaptureError, ConfigError, RouteError
from edoras_tools.io.topics.messages import APART
from edoras_tools.links import table
from edoras_tools.model import NO_MSG_ID, Columns, Link, PacketBatch
from edoras_tools.older import UTC
from edoras_tools.structs.shapes import Key
from edoras_tools.units import SECOND
from edoras_tools.words import did_you_mean, listed

if TYPE_CHECKING:
    from edoras_tools.decode.context import Context
    from edoras_tools.decode.filters.filter import Where
    from edoras_tools.io import Choice
    from edoras_tools.links.doors import Endpoints
    from edoras_tools.mission import Mission
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.wire.arrays import Integers, Mask

_BEFORE_NS: Final = 3600 * SECOND
"""Longest time that a clock time without a date may be before the capture, or an end before the start; an
earlier clock time is one of the next day."""


class ClockTime(msgspec.Struct, frozen=True):
    """A clock time from the command line.

    Attributes:
        text: text as it was written.
        clock_ns: time since midnight, ns.
        day: date; None for the first such time of a capture.
        zone: time zone; None for this machine's zone.
    """

    text: str
    clock_ns: int
    day: date | None = None
    zone: tzinfo | None = UTC

    def first(self, earliest_ns: int) -> int:
        """Return the time, ns since 1970; without a date, the first such time not before ``earliest_ns``.

        Raises:
            ConfigError: the time cannot be given a date.
        """
        try:
            day = self.day or datetime.fromtimestamp(earliest_ns // SECOND, self.zone).date()
            time_ns = self._on(day)
            late = self.day is not None or time_ns >= earliest_ns
            return time_ns if late else self._on(day + timedelta(days=1))
        except (OverflowError, ValueError, OSError):
            raise ConfigError(
                f"{self.text}: the capture's times are no dates; give seconds after its start"
            ) from None

    def _on(self, day: date) -> int:
        seconds, rest = divmod(self.clock_ns, SECOND)
        clock = datetime.combine(day, time()) + timedelta(seconds=seconds)
        return int(clock.replace(tzinfo=self.zone).timestamp()) * SECOND + rest


class Period(msgspec.Struct, frozen=True):
    """The datagrams between two times; by default all.

    Attributes:
        start_ns: start in ns after the first datagram. With 0, datagrams with an earlier time than the first
            one are included.
        end_ns: end in ns after the first datagram, not included; 0 for none.
        start: clock time that replaces ``start_ns``; :meth:`since` resolves it.
        end: clock time that replaces ``end_ns``; :meth:`since` resolves it.
        length_ns: length of the period, in place of an end, ns; 0 for none.

    Raises:
        ConfigError: the end is not after the start.
    """

    start_ns: int = 0
    end_ns: int = 0
    start: ClockTime | None = None
    end: ClockTime | None = None
    length_ns: int = 0

    def __post_init__(self) -> None:
        if not (self.start or self.end) and self.end_ns and self.end_ns <= self.start_ns:
            raise ConfigError(
                "--end is not after --start; both count from the start of the capture, or are clock times"
            )

    def __bool__(self) -> bool:
        return bool(self.start_ns or self.end_ns or self.length_ns or self.start or self.end)

    def since(self, begin_ns: int) -> Period:
        """Return the period in ns after a capture's first datagram.

        The search for a clock time without a date begins one hour before the first datagram; for an end, one
        hour before the start.

        Raises:
            ConfigError: the end is not after the start, or not after the first datagram.
        """
        start_ns, end_ns = self.start_ns, self.end_ns
        if self.start:
            start_ns = max(0, self.start.first(begin_ns - _BEFORE_NS) - begin_ns)
        if self.length_ns:
            end_ns = start_ns + self.length_ns
        elif self.end:
            end_ns = self.end.first(begin_ns + start_ns - _BEFORE_NS) - begin_ns
            if end_ns <= 0:
                raise ConfigError(
                    f"--end {self.end.text} is before the capture, which begins at {_began(begin_ns)}"
                )
        return Period(start_ns, end_ns)

    @overload
    def holds(self, since_ns: int) -> bool: ...
    @overload
    def holds(self, since_ns: Integers) -> Mask: ...
    def holds(self, since_ns: int | Integers) -> bool | Mask:
        """Return which times, in ns after the first datagram, are in a period that ``since`` returned."""
        assert self.start is self.end is None, "since() knows when the clock shows these times"
        after = (since_ns >= self.start_ns) | (not self.start_ns)
        return after & ((since_ns < self.end_ns) | (not self.end_ns))


def outside(name: str, begin_ns: int, end_ns: int) -> CaptureError:
    """Return the error that a capture has no datagram in the chosen time."""
    lasts = f"its times go from 0 to {(end_ns - begin_ns) / SECOND:.3f} s, and 0 is {_began(begin_ns)}"
    return CaptureError(f"{name}: nothing between --start and --end; {lasts}")


def _began(begin_ns: int) -> str:
    try:
        return f"{datetime.fromtimestamp(begin_ns // SECOND, UTC):%Y-%m-%d %H:%M:%S} UTC"
    except (OverflowError, ValueError, OSError):
        return f"{begin_ns / SECOND:.3f} s after 1970"


class Selection(msgspec.Struct, frozen=True):
    """A selection of datagrams; an empty one selects all.

    Attributes:
        links: only these links.
        msg_ids: only these MsgIds, or names that tables show.
        topics: only these topics, shell patterns, or names that tables show.
        notable: only datagrams with one of these finding bits.
        where: only datagrams that pass this filter; the result of :meth:`over` applies it.
        announced: also the datagrams that announce selected DDS topics: a recording needs them to name the
            topics.
    """

    links: Sequence[Link] = ()
    msg_ids: Sequence[int | str] = ()
    topics: Sequence[str] = ()
    notable: int = 0
    where: str = ""
    announced: bool = False
    _filter: Where | None = None
    _packets_by_craft: Callable[[int], Sequence[PacketKinds]] | None = None

    def __bool__(self) -> bool:
        return bool(self.links or self.msg_ids or self.topics or self.notable or self.where)

    def __str__(self) -> str:
        words = [f"link={link.label}" for link in self.links]
        words += [f"msg_id={f'0x{item:04x}' if isinstance(item, int) else item}" for item in self.msg_ids]
        words += [f"topic={item}" for item in self.topics]
        words += ["findings"] * bool(self.notable)
        return " ".join(words + [f"where={self.where}"] * bool(self.where))

    def over(self, bench: Workbench) -> Selection:
        """Return the selection prepared for a workbench; errors in it are raised here.

        Raises:
            RouteError: a topic pattern or a name matches nothing.
            ConfigError: the filter has an error.
        """
        context = bench.columns.context
        if context.mission.recorded and (self.links or self.msg_ids):
            raise ConfigError(
                "--link and --msg-id select datagrams, and the recording has only messages: use --topic, "
                "--where, --start and --end"
            )
        by_craft = cache(partial(self._packets_named, context))
        by_craft(FIRST_SPACECRAFT)  # raises the errors that every spacecraft would raise
        selection = replace(self, _packets_by_craft=by_craft)
        if not self.where:
            return selection
        from edoras_tools.decode.filters.filter import Where

        return replace(selection, _filter=Where(self.where, context))

    def _packets_named(self, context: Context, spacecraft: int) -> Sequence[PacketKinds]:
        """Return the packets that the names stand for on a spacecraft: each spacecraft has its own topics."""
        groups = [[hex(item) if isinstance(item, int) else item for item in self.msg_ids], self.topics]
        packets = [
            PacketKinds.any(packets_of(name, context, spacecraft) for name in names)
            for names in groups
            if names
        ]
        return [item.with_announcements() for item in packets] if self.announced else packets

    @property
    def _packets(self) -> Sequence[PacketKinds]:
        return self.packets_of(FIRST_SPACECRAFT)

    def packets_of(self, spacecraft: int) -> Sequence[PacketKinds]:
        """Return the named packets of a spacecraft; only the result of :meth:`over` has them."""
        return self._packets_by_craft(spacecraft) if self._packets_by_craft else ()

    def mask(self, batch: PacketBatch, columns: Columns) -> Mask:
        """Return which rows are selected, without applying the filter: bool (rows,)."""
        mask = np.ones(len(columns), bool)
        if self.links:
            mask &= np.isin(columns.link, [int(link) for link in self.links])
        for number in np.flatnonzero(np.bincount(columns.spacecraft)).tolist() if self._packets else ():
            others = columns.spacecraft != number
            for packets in self.packets_of(number):
                mask &= others | packets.mask(batch, columns)
        if self.notable:
            mask &= (columns.findings & np.uint32(self.notable)) != 0
        return mask

    def by_heads(self, mission: Mission) -> Choice | None:
        """Return a function that says by link and MsgId which datagrams may be selected; None if all may be.

        Only the result of :meth:`over` has it. DDS samples cannot be selected this way.
        """
        if not (self.links or self._packets) or any(key.port for item in self._packets for key in item.keys):
            return None
        links = np.zeros(256, bool)
        links[[int(link) for link in self.links] if self.links else slice(None)] = True
        groups = [
            np.array([*item.msg_ids(mission), *[NO_MSG_ID] * bool(item.kinds)], np.int32)
            for item in self._packets
        ]
        return lambda link, msg_id: np.logical_and.reduce(
            [links[link], *(np.isin(msg_id, ids) for ids in groups)]
        )

    def places(self) -> frozenset[int] | None:
        """Return the indices of the named routes, None without names; for a result of :meth:`over`."""
        return frozenset.intersection(*(item.routes for item in self._packets)) if self._packets else None

    def about(
        self,
        link: str | None,
        msg_id: int | None,
        mission: Mission,
        samples: str = "",
        spacecraft: int = FIRST_SPACECRAFT,
    ) -> bool:
        """Return whether a link's label and a MsgId are selected, without applying the filter.

        Args:
            link: label of the link; None for anything that is not about a single link.
            msg_id: MsgId; None for anything that is not about a single MsgId.
            samples: topic of DDS samples, which have no MsgId; else empty.
            spacecraft: number of the spacecraft.
        """
        if self.links and link not in {item.label for item in self.links}:
            return False
        if samples:
            return all(packets.has_sample_topic(samples) for packets in self._packets)
        return all(msg_id in packets.msg_ids(mission) for packets in self.packets_of(spacecraft))

    def rows(self, batch: PacketBatch, columns: Columns) -> Integers:
        """Return the indices of the selected rows; for a result of :meth:`over`, or an empty selection."""
        assert self._packets_by_craft or not self, "over() finds what names stand for, and the filter"
        rows = np.flatnonzero(self.mask(batch, columns))
        return rows if self._filter is None else rows[self._filter.mask(batch, columns, rows)]

    def apply(self, batch: PacketBatch, columns: Columns) -> tuple[PacketBatch, Columns]:
        """Return the selected rows of a batch and of its columns."""
        if not self:
            return batch, columns
        rows = self.rows(batch, columns)
        return batch.take(rows), columns.take(rows)


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
