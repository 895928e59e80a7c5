"""Missing packets told from sequence counts, a batch at a time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.model import Finding
from edoras_tools.sinks.mcap_clock import sender_order

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.model import Columns

_MODULUS = 1 << 14
"""CCSDS 133.0-B 4.1.3.4.3: the packet sequence count has 14 bits."""
_MAX_FLOWS = 65536
"""Garbage could name any number of flows; the longest unseen are forgotten beyond this."""


class SequenceGaps:
    """Counts the sequence counts that are missing before each packet of the same link, sender and MsgId.

    A count that steps back, by less than half the 14 bits, is a late or repeated packet and no gap.
    """

    def __init__(self) -> None:
        self._flows = tuple(np.zeros(0, dtype=kind) for kind in (np.uint8, np.uint16, np.uint32))
        self._count = np.zeros(0, dtype=np.int32)

    def missing(self, columns: Columns) -> NDArray[np.int64]:
        """Return for each row how many packets are missing right before it; 0 where the count is not set."""
        missing = np.zeros(len(columns), dtype=np.int64)
        rows = np.flatnonzero(
            (columns.msg_id >= 0) & (columns.findings & np.uint32(Finding.SEQUENCE_UNSET) == 0)
        )
        if len(rows) == 0:
            return missing
        # The last packet of each known flow walks in front of the batch.
        known = len(self._count)
        latest = (columns.link[rows], columns.msg_id[rows].astype(np.uint16), columns.processor_id[rows])
        flows = tuple(np.concatenate(pair) for pair in zip(self._flows, latest, strict=True))
        count = np.concatenate((self._count, columns.sequence_count[rows].astype(np.int32)))
        order = sender_order(*flows)
        same = np.ones(len(order) - 1, dtype=np.bool_)
        for key in flows:
            ordered = key[order]
            same &= ordered[1:] == ordered[:-1]
        step = np.diff(count[order]) % _MODULUS
        gap = np.zeros(len(order), dtype=np.int64)
        gap[order[1:]] = np.where(same & (step > 1) & (step < _MODULUS // 2), step - 1, 0)
        missing[rows] = gap[known:]
        last = order[np.append(np.flatnonzero(~same), len(order) - 1)]
        if len(last) > _MAX_FLOWS:
            last = np.sort(last)[-_MAX_FLOWS:]
        self._flows = tuple(key[last] for key in flows)
        self._count = count[last]
        return missing
