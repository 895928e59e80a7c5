"""Capture times that are wrong in no order: of frames that waited in turn for a busy or a virtual host."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.links.table import among
from edoras_tools.units import MILLISECOND

if TYPE_CHECKING:
    from edoras_tools.diagnosis.evidence.table import Rows

_TOGETHER_NS: Final = 20 * MILLISECOND
_HALF_ROUND_NS: Final = 250 * MILLISECOND
_UNSTEADY: Final = 0.2
_LEAST_PAIRS: Final = 20
_TAIL: Final = 1.5
"""Of two times that are late by up to some time, one of ten differs by less than two thirds of that."""


def unsteadiness(rows: Rows) -> int:
    """Return by how much capture times are wrong in no order, ns; 0 where they are not.

    What a cFS makes at nearly one time leaves in one round and in that order: capture times that often say
    otherwise, by less than half a round, are not those at which it left.
    """
    at = np.flatnonzero(among(rows.link, lambda link: link.only_from_cfs) & (rows.mission_time_ns > 0))
    at = at[np.lexsort((rows.mission_time_ns[at], rows.source[at]))]
    same = (np.diff(rows.source[at]) == 0) & (np.diff(rows.mission_time_ns[at]) < _TOGETHER_NS)
    steps = np.diff(rows.time_ns[at])[same]
    steps = steps[np.abs(steps) < _HALF_ROUND_NS]
    back = -steps[steps < -MILLISECOND // 2]
    if len(steps) < _LEAST_PAIRS or len(back) < _UNSTEADY * len(steps):
        return 0
    return int(_TAIL * np.quantile(back, 0.9))
