"""Which datagrams a command looks at: by link, MsgId, topic and filter, over columns."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.errors import RouteError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from edoras_tools.decode.where import Where
    from edoras_tools.mission import Mission
    from edoras_tools.model import Columns, Link, PacketBatch
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.structs.shapes import Key


@dataclass(frozen=True, slots=True)
class Selection:
    """A choice of datagrams; an empty choice is all of them.

    Attributes:
        links: of these links.
        msg_ids: with these MsgIds.
        topics: of these topics; shell patterns hold.
        notable: with one of these finding bits.
        where: that this filter lets pass; it takes effect in what :meth:`over` returns.
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
        """Return the choice made ready for a workbench, or find out early what is wrong with it.

        Raises:
            RouteError: a topic pattern fits no configured topic.
            ConfigError: the filter has a mistake.
        """
        context, chosen = bench.columns.context, self
        if self.topics:
            structs = {
                pattern: [item.key for item in context.structs.all if _fits(item.topic, pattern)]
                for pattern in self.topics
            }
            chosen = replace(self, _structs=structs)
        chosen.check(bench.mission)
        if not self.where:
            return chosen
        from edoras_tools.decode.where import Where

        return replace(chosen, _filter=Where(self.where, context))

    def check(self, mission: Mission) -> None:
        """Find out early whether a mission has what is chosen.

        Raises:
            RouteError: a topic pattern fits no configured topic.
        """
        self._routes(mission)

    def mask(self, columns: Columns, mission: Mission) -> NDArray[np.bool_]:
        """Return which rows are chosen by anything but the filter.

        Raises:
            RouteError: a topic pattern fits no configured topic.
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

    def rows(self, batch: PacketBatch, columns: Columns, mission: Mission) -> NDArray[np.int64]:
        """Return the indices of the chosen rows."""
        rows = np.flatnonzero(self.mask(columns, mission))
        assert not self.where or self._filter is not None, "a filter takes effect in what over() returns"
        return rows if self._filter is None else rows[self._filter.mask(batch, columns, rows)]

    def apply(self, batch: PacketBatch, columns: Columns, mission: Mission) -> tuple[PacketBatch, Columns]:
        """Return the chosen rows of both."""
        if not self:
            return batch, columns
        rows = self.rows(batch, columns, mission)
        return batch.take(rows), columns.take(rows)

    def _routes(self, mission: Mission) -> list[int]:
        routes = []
        for pattern in self.topics:
            fits = [index for index, route in enumerate(mission.routes) if _fits(route.topic, pattern)]
            if not fits and not self._structs.get(pattern):
                there = ", ".join(route.topic for route in mission.routes) or "none; name a mission with -c"
                raise RouteError(f"no configured topic fits {pattern!r}; there are: {there}")
            routes += fits
        return routes


def _fits(topic: str, pattern: str) -> bool:
    wanted = pattern if pattern.startswith(("/", "*")) else f"/{pattern}"
    return fnmatchcase(topic, wanted)
