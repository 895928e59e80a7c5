"""Which part of a capture is examined, and which part of the diagnosis is shown."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec
import numpy as np

from edoras_tools.decode.spacecraft import FIRST_SPACECRAFT
from edoras_tools.diagnosis.verdict import Choice
from edoras_tools.links import table
from edoras_tools.pipelines.selection import Period, Selection

if TYPE_CHECKING:
    from edoras_tools.links.protocol import LinkProtocol
    from edoras_tools.model import Columns, PacketBatch
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.wire.arrays import Integers


class Scope(msgspec.Struct, frozen=True):
    """The scope that the options of a command select.

    Attributes:
        selection: part that is shown; loss is counted from all traffic.
        period: part that is examined.
    """

    selection: Selection = msgspec.field(default_factory=Selection)
    period: Period = msgspec.field(default_factory=Period)


class Chosen:
    """Applies a selection to batches, and returns at the end which routes are shown.

    Args:
        selection: selection from the options.
        bench: mission and decoders.

    Raises:
        RouteError: the selection names a topic that is not configured.
        ConfigError: its filter has an error.
    """

    def __init__(self, selection: Selection, bench: Workbench) -> None:
        self._selection = selection.over(bench)
        self._mission = bench.mission
        self._endpoints = bench.columns.context.endpoints
        self._seen: set[tuple[int, str, int]] = set()
        self._sampling = [link for link in table.links() if link.samples]
        self._writers: set[tuple[LinkProtocol, bytes]] = set()

    def add(self, batch: PacketBatch, columns: Columns) -> None:
        """Add a batch; with a filter, a route is shown if one of its packets passes the filter."""
        if self._selection.where:
            rows = self.rows(batch, columns)
            key = np.stack([columns.spacecraft, columns.link, columns.msg_id & 0xFFFF])[:, rows]
            self._seen |= {
                (number, table.link(link).label, msg_id)
                for number, link, msg_id in np.unique(key, axis=1).T.tolist()
            }
            for link in self._sampling:
                own = rows[columns.link[rows] == link]
                self._writers |= {(link, guid) for guid in link.sample_reader().writers(batch, own)}

    def rows(self, batch: PacketBatch, columns: Columns) -> Integers:
        """Return which rows of a batch are selected."""
        return self._selection.rows(batch, columns)

    def choice(self) -> Choice | None:
        """Return the part that is shown; None for all."""
        return Choice(str(self._selection), self._takes) if self._selection else None

    def _takes(
        self, link: str | None, msg_id: int | None, topic: str = "", /, spacecraft: int = FIRST_SPACECRAFT
    ) -> bool:
        of_samples = topic if link in {item.label for item in self._sampling} else ""
        if not self._selection.about(link, msg_id, self._mission, of_samples, spacecraft):
            return False
        if not self._selection.where:
            return True
        if of_samples:
            return any(
                topic == item.sample_reader().topic_of(guid, self._endpoints) for item, guid in self._writers
            )
        return any(
            (number, msg_id) == (spacecraft, own) and link in {None, label}
            for number, label, own in self._seen
        )
