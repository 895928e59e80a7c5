"""How much a loss would have differed in another run of the same traffic, as the queue model tells.

1. The arrivals are those of the capture. When a queue is read is not known to the millisecond: the model is
   asked at ``_PHASES`` phases of its round.
2. Whether a reader takes the first of a burst while the rest still comes in is chance, so that less is lost
   than the model says: each loss that it names then happens with the share that was seen (binomial).
3. A model that explains less than what was lost, and what was lost without a queue, tells nothing: such
   losses are taken as independent of each other (Poisson).
"""

from __future__ import annotations

from math import sqrt
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.cfs import queues
from edoras_tools.diagnosis.advice import Arrivals, published_into, told_limit

if TYPE_CHECKING:
    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.matching.streams import Stream

_PHASES: Final = 16
_LEAST: Final = 1.0
"""Where anything is lost, what is lost at both ends of a run differs by so much."""
_FITS: Final = 1.2
"""So many times what the model loses may be lost, and it explains it."""


def loss_spreads(case: Case | None) -> dict[tuple[str, int], float]:
    """Return the standard deviation of the messages lost of each stream that lost any, by link and MsgId."""
    spreads: dict[tuple[str, int], float] = {}
    for stream in case.streams if case is not None else ():
        lost = sum(item.lost for item in case.losses_of(stream)) if case is not None else 0
        if case is None or not lost:
            continue
        key = stream.link.label, stream.msg_id
        variance = max(_LEAST, _variance(_model(case, stream), lost))
        spreads[key] = sqrt(spreads.get(key, 0.0) ** 2 + variance)
    return spreads


def _model(case: Case, stream: Stream) -> list[int]:
    """Return how many of a stream its queues lose at each phase."""
    profile = case.profile
    if stream.link.only_to_cfs:
        rows = np.flatnonzero((case.rows.link == stream.link) & (case.rows.destination == stream.receiver))
        arrivals = Arrivals(case.rows.time_ns[rows], case.rows.msg_id[rows].astype(np.int64))
        way = queues.ci_socket(profile), queues.application_pipe(profile)
        return arrivals.lost(way, stream.msg_id, _PHASES)
    if stream.link.only_from_cfs:
        limit = told_limit(case, stream)
        pipe = queues.telemetry_pipe(profile)
        return published_into(case, stream).lost(
            (pipe.with_limit(stream.msg_id, limit),), stream.msg_id, _PHASES
        )
    return []


def _variance(model: list[int], lost: int) -> float:
    most = max(model, default=0)
    if lost > _FITS * most:
        return float(lost)
    share = min(1.0, lost / most)
    return float(np.var(model)) * share * share + most * share * (1 - share)
