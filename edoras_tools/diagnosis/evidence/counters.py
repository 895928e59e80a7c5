"""The loss counters of the software bus over time, without wraps and resets: a track for each instance."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.diagnosis.evidence.instances import NOBODY
from edoras_tools.wire.arrays.order import numbered

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray
    from typing_extensions import Self

    from edoras_tools.diagnosis.evidence.instances import Instances
    from edoras_tools.diagnosis.evidence.payloads import Payloads, Samples
    from edoras_tools.diagnosis.evidence.table import Rows

_BYTE: Final = 1 << 8
_WIDTHS: Final = {"pipe_overflows": 16, "msg_limits": 16, "no_subscribers": 8, "send_errors": 8}


@dataclass(slots=True)
class Track:
    """The counters of one instance, growing from 0 at its first 0x803 here.

    Attributes:
        times: when each sample was made, capture time.
        totals: counter to its growth up to each sample.
        older: counter to what the first sample already showed: lost before it.
        resets: times that a counter was set back.
    """

    times: list[int] = field(default_factory=list)
    totals: dict[str, list[int]] = field(default_factory=dict)
    older: dict[str, int] = field(default_factory=dict)
    resets: int = 0

    def growth(self, name: str, start_ns: int | None = None, end_ns: int | None = None) -> int:
        """Return by how much a counter grew between two times.

        Counted from the last sample before ``start_ns`` to the first after ``end_ns``: what happened in
        between is in it.
        """
        if not self.times:
            return 0
        low = 0 if start_ns is None else max(bisect_right(self.times, start_ns) - 1, 0)
        high = (
            len(self.times) - 1
            if end_ns is None
            else min(bisect_left(self.times, end_ns), len(self.times) - 1)
        )
        totals = self.totals[name]
        return max(0, totals[high] - totals[low])

    def watches(self, time_ns: int) -> bool:
        """Tell whether samples lie on both sides of a time."""
        return bool(self.times) and self.times[0] <= time_ns <= self.times[-1]

    @classmethod
    def of(cls, made_ns: NDArray[np.int64], counters: Mapping[str, NDArray[np.int64]]) -> Self:
        """Follow samples of the counters, each made at another time and later than the one before."""
        track = cls(made_ns.tolist())
        for name, values in counters.items():
            modulus = 1 << _WIDTHS[name]
            steps = np.diff(values) % modulus
            # Down by a little is no wrap: the counters were reset. Eight bits wrap too soon to tell.
            reset = (np.diff(values) < 0) & (steps > modulus // 2)
            track.resets += int(reset.sum()) * (modulus > _BYTE)
            grown = np.cumsum(np.where(reset, values[1:], steps))
            track.older[name] = int(values[0])
            track.totals[name] = [0, *grown.tolist()]
        return track


def tracks(rows: Rows, payloads: Payloads, instances: Instances) -> dict[int, Track]:
    """Return a track for every instance whose 0x803 is here.

    An instance's housekeeping may arrive over several links; the one that brings the most is read.
    """
    samples = payloads.housekeeping
    instance = instances.of_row[samples["row"]]
    source = rows.source[samples["row"]]
    for port in np.unique(source).tolist():
        source[source == port] = instances.output(port)
    way = rows.link[samples["row"]].astype(np.int64) << 32 | source
    found = {}
    for index in np.unique(instance[instance != NOBODY]).tolist():
        own = np.flatnonzero(instance == index)
        first, which = numbered(way[own])
        sizes = np.bincount(which, minlength=len(first))
        for number in np.argsort(-sizes, kind="stable").tolist():
            track = _track(samples, own[which == number], instances)
            # Counters that step back again and again are those of two instances, and tell nothing.
            if track.resets <= 1 + len(track.times) // 10:
                found[index] = track
                break
    return found


def _track(samples: Samples, chosen: NDArray[np.intp], instances: Instances) -> Track:
    made_ns = instances.made_ns[samples["row"][chosen]]
    order = np.argsort(made_ns, kind="stable")
    # Of one time there is one sample: what comes again is the same.
    order = order[np.diff(made_ns[order], prepend=-1) > 0]
    return Track.of(made_ns[order], {name: samples[name][chosen[order]] for name in _WIDTHS})
