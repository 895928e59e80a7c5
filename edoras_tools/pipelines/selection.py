"""Which datagrams a command reads: by link, MsgId, topic and filter, over columns."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, overload

import numpy as np

from edoras_tools.cfs.names import MSG_ID_NAMES
from edoras_tools.errors import ConfigError, RouteError
from edoras_tools.structs.shapes import Key

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from edoras_tools.decode.filters.filter import Where
    from edoras_tools.mission import Mission
    from edoras_tools.model import Columns, Link, PacketBatch
    from edoras_tools.pipelines.workbench import Workbench


@dataclass(frozen=True, slots=True)
class Period:
    """The datagrams between two times, in ns after the first datagram; by default all.

    Attributes:
        start_ns: earlier ones are left out; with 0 also those are in that are older than the first one.
        end_ns: those from this time on are left out; 0 for none.

    Raises:
        ConfigError: the end is not after the start.
    """

    start_ns: int = 0
    end_ns: int = 0

    def __post_init__(self) -> None:
        if self.end_ns and self.end_ns <= self.start_ns:
            raise ConfigError("--end is not after --start; both count from the start of the capture")

    def __bool__(self) -> bool:
        return bool(self.start_ns or self.end_ns)

    @overload
    def holds(self, since_ns: int) -> bool: ...
    @overload
    def holds(self, since_ns: NDArray[np.int64]) -> NDArray[np.bool_]: ...
    def holds(self, since_ns: int | NDArray[np.int64]) -> bool | NDArray[np.bool_]:
        """Return which times after the first datagram are in the period."""
        after = (since_ns >= self.start_ns) | (not self.start_ns)
        return after & ((since_ns < self.end_ns) | (not self.end_ns))


@dataclass(frozen=True, slots=True)
class Selection:
    """A selection of datagrams; an empty one selects all.

    Attributes:
        links: only these links.
        msg_ids: only these MsgIds.
        topics: only these topics; shell patterns are allowed.
        notable: only datagrams with one of these finding bits.
        where: only datagrams that pass this filter; it is applied by what :meth:`over` returns.
    """

    links: Sequence[Link] = ()
    msg_ids: Sequence[int] = ()
    topics: Sequence[str] = ()
    notable: int = 0
    where: str = ""
    _filter: Where | None = field(default=None, repr=False, compare=False)
    _structs: Mapping[str, Sequence[Key]] = field(default_factory=dict, repr=False, compare=False)

    def __bool__(self) -> bool:
        return bool(self.links or self.msg_ids or self.topics or self.notable or self.where)

    def __str__(self) -> str:
        words = [f"link={link.label}" for link in self.links]
        words += [f"msg_id=0x{item:04x}" for item in self.msg_ids]
        words += [f"topic={item}" for item in self.topics]
        words += ["findings"] * bool(self.notable)
        return " ".join(words + [f"where={self.where}"] * bool(self.where))

    def over(self, bench: Workbench) -> Selection:
        """Return the selection prepared for a workbench; errors in it are raised here.

        Raises:
            RouteError: a topic pattern matches no configured topic.
            ConfigError: the filter has an error.
        """
        context, chosen = bench.columns.context, self
        if self.topics:
            structs = {
                pattern: [item.key for item in context.structs.all if fits_topic(item.topic, pattern)]
                + [Key(value) for value, name in MSG_ID_NAMES.items() if fnmatchcase(name, pattern)]
                for pattern in self.topics
            }
            chosen = replace(self, _structs=structs)
        chosen.check(bench.mission)
        if not self.where:
            return chosen
        from edoras_tools.decode.filters.filter import Where

        return replace(chosen, _filter=Where(self.where, context))

    def check(self, mission: Mission) -> None:
        """Check early whether a mission has the selected topics.

        Raises:
            RouteError: a topic pattern matches no configured topic.
        """
        self._routes(mission)

    def mask(self, columns: Columns, mission: Mission) -> NDArray[np.bool_]:
        """Return which rows are selected, without regard to the filter.

        Raises:
            RouteError: a topic pattern matches no configured topic.
        """
        chosen = np.ones(len(columns), bool)
        if self.links:
            chosen &= np.isin(columns.link, [int(link) for link in self.links])
        if self.msg_ids:
            chosen &= np.isin(columns.msg_id, list(self.msg_ids))
        if self.topics:
            on_topic = np.isin(columns.route, self._routes(mission))
            for key in (key for keys in self._structs.values() for key in keys):
                code = key.function_code
                on_topic |= (columns.msg_id == key.msg_id) & (code is None or columns.function_code == code)
            chosen &= on_topic
        if self.notable:
            chosen &= (columns.findings & np.uint32(self.notable)) != 0
        return chosen

    def about(self, link: str | None, msg_id: int | None, mission: Mission) -> bool:
        """Return whether a link's label and a MsgId are selected, without regard to the filter.

        Args:
            link: None if it is not about a single link.
            msg_id: None if it is not about a single MsgId.
            mission: for the topics.

        Raises:
            RouteError: a topic pattern matches no configured topic.
        """
        if self.links and link not in {item.label for item in self.links}:
            return False
        if self.msg_ids and msg_id not in self.msg_ids:
            return False
        if not self.topics:
            return True
        ids = {mission.routes[index].msg_id for index in self._routes(mission)}
        return msg_id in ids | {key.msg_id for keys in self._structs.values() for key in keys}

    def rows(self, batch: PacketBatch, columns: Columns, mission: Mission) -> NDArray[np.int64]:
        """Return the indices of the selected rows."""
        rows = np.flatnonzero(self.mask(columns, mission))
        assert not self.where or self._filter is not None, "only what over() returns applies the filter"
        return rows if self._filter is None else rows[self._filter.mask(batch, columns, rows)]

    def apply(self, batch: PacketBatch, columns: Columns, mission: Mission) -> tuple[PacketBatch, Columns]:
        """Return the selected rows of both."""
        if not self:
            return batch, columns
        rows = self.rows(batch, columns, mission)
        return batch.take(rows), columns.take(rows)

    def _routes(self, mission: Mission) -> list[int]:
        routes = []
        for pattern in self.topics:
            fits = [index for index, route in enumerate(mission.routes) if fits_topic(route.topic, pattern)]
            if not fits and not self._structs.get(pattern):
                there = ", ".join(route.topic for route in mission.routes) or "none; name a mission with -c"
                raise RouteError(f"no configured topic matches {pattern!r}; there are: {there}")
            routes += fits
        return routes


def fits_topic(topic: str, pattern: str) -> bool:
    """Return whether a topic matches a shell pattern, with or without its leading slash."""
    wanted = pattern if pattern.startswith(("/", "*")) else f"/{pattern}"
    return fnmatchcase(topic, wanted)
