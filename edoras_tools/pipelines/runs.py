"""Decides whether files are one run or several.

Rules:

1. Files are one run if they overlap in time, or if each begins at most 2 s after the end of those before it.
2. A file that begins later is another run if a cFS in it and before it restarted in between: the difference
   of capture time and mission time changed. So the parts of one recording are one run.
3. Files that show no common cFS are one run.
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
"""Least difference between two boots; clocks of hosts differ by less."""
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
        """Add the source's last batch; return the number of its run, or of its clock, from 0."""
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
        """Return one line that there are several runs; empty for one run."""
        return [_NOTE.format(self._restarts + 1)] if self._restarts else []


def _boots(batch: PacketBatch, columns: Columns) -> dict[int, Integers]:
    """Return capture time minus mission time of packets with a time, rounded down to s, in ns, by sender."""
    sent = among(columns.link, lambda link: link.from_cfs and link.packets)
    rows = np.flatnonzero(sent & (columns.mission_time_ns > 0))
    offset = batch.time_ns[rows] - columns.mission_time_ns[rows]
    sender = batch.source_address[rows].astype(np.int64) << 20 ^ columns.processor_id[rows].astype(np.int64)
    return {key: np.unique(offset[at] // SECOND) * SECOND for key, at in by_value(sender)}
