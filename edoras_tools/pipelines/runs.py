"""Tells whether files are one run or several.

1. Files that overlap in time, or of which one begins at most 2 s behind the others, are one run.
2. Files of which one begins when all before it have ended are two runs where a cFS in both was started anew
   between them: capture time minus mission time is another one. So a recording in parts is one.
3. Where nothing shows a boot in both, they are one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.io.formats.merge import SEAM_NS
from edoras_tools.links.table import among
from edoras_tools.units import SECOND
from edoras_tools.wire.arrays.order import Integers, by_value

if TYPE_CHECKING:
    from edoras_tools.io import Source
    from edoras_tools.model import Columns, PacketBatch

APART_NS: Final = 5 * SECOND
"""Boots are further apart than this, clocks of hosts are not."""
_NOTE: Final = (
    "{} runs: between their files cFS was started anew and nothing was captured; each is counted and judged "
    "by itself, and rates leave out the time between"
)


class RunCounter:
    """Counts the runs of several files while they are read."""

    def __init__(self, source: Source) -> None:
        self._source, self._clock = source, source.part
        self._section = self._last_ns = self._part = self._restarts = 0
        self._seam = False
        self._boots: dict[int, Integers] = {}

    def add(self, batch: PacketBatch, columns: Columns) -> int:
        """Take the source's last batch; return the number of its run, or of its clock, from 0."""
        if not len(batch):
            return self._part
        if self._source.section != self._section:
            self._section = self._source.section
            self._seam = int(batch.time_ns.min()) - self._last_ns > SEAM_NS
        self._last_ns = max(self._last_ns, int(batch.time_ns.max()))
        boots = _boots(batch, columns)
        pairs = [(offsets, self._boots[key]) for key, offsets in boots.items() if key in self._boots]
        same = any((np.abs(new[:, None] - old) < APART_NS).any() for new, old in pairs)
        begins = self._seam and bool(pairs) and not same
        self._seam = self._seam and not pairs
        self._boots |= boots
        self._restarts += begins
        self._part += begins or self._source.part != self._clock
        self._clock = self._source.part
        return self._part

    def notes(self) -> list[str]:
        """Return that there are several runs, in a line."""
        return [_NOTE.format(self._restarts + 1)] if self._restarts else []


def _boots(batch: PacketBatch, columns: Columns) -> dict[int, Integers]:
    """Return capture time minus mission time, to the second, of what has a time, by who sent it."""
    sent = among(columns.link, lambda link: link.from_cfs and link.packets)
    rows = np.flatnonzero(sent & (columns.mission_time_ns > 0))
    offset = batch.time_ns[rows] - columns.mission_time_ns[rows]
    sender = batch.source_address[rows].astype(np.int64) << 20 ^ columns.processor_id[rows].astype(np.int64)
    return {key: np.unique(offset[at] // SECOND) * SECOND for key, at in by_value(sender)}
