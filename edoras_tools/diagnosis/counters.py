"""The software bus's loss counters over time: wraps and resets taken out, one track a cFS instance."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import defaultdict
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from edoras_tools.diagnosis.instances import NOBODY

if TYPE_CHECKING:
    from edoras_tools.diagnosis.instances import Instances
    from edoras_tools.diagnosis.payloads import Housekeeping, Payloads
    from edoras_tools.diagnosis.table import Rows

_NAMES: Final = ("pipe_overflows", "msg_limits", "no_subscribers", "send_errors")
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
    totals: dict[str, list[int]] = field(default_factory=lambda: {name: [] for name in _NAMES})
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

    def covers(self, start_ns: int, end_ns: int) -> bool:
        """Tell whether samples span most of a time."""
        if not self.times:
            return False
        both = min(end_ns, self.times[-1]) - max(start_ns, self.times[0])
        return both >= 0 and 2 * both >= end_ns - start_ns

    def add(self, made_ns: int, sample: Housekeeping, last: Housekeeping | None) -> None:
        """Take the next sample."""
        self.times.append(made_ns)
        for name in _NAMES:
            value = getattr(sample, name)
            if last is None:
                self.older[name] = value
                self.totals[name].append(0)
                continue
            before, modulus = getattr(last, name), 1 << _WIDTHS[name]
            step = (value - before) % modulus
            if value < before and step > modulus // 2:
                # Down by a little is no wrap: the counters were reset. Eight bits wrap too soon to tell.
                self.resets += modulus > _BYTE
                step = value
            self.totals[name].append(self.totals[name][-1] + step)


def tracks(rows: Rows, payloads: Payloads, instances: Instances) -> dict[int, Track]:
    """Return a track for every instance whose 0x803 is here.

    An instance's housekeeping may arrive over several links; the one that brings the most is read.
    """
    ways: dict[int, dict[tuple[int, int], list[Housekeeping]]] = defaultdict(lambda: defaultdict(list))
    for item in payloads.housekeeping:
        instance = int(instances.of_row[item.row])
        if instance != NOBODY:
            way = int(rows.link[item.row]), int(rows.source[item.row])
            ways[instance][way].append(item)
    found = {}
    for instance, by_way in ways.items():
        offset = instances.items[instance].offset_ns
        for samples in sorted(by_way.values(), key=len, reverse=True):
            track = _track([(int(rows.mission_time_ns[item.row]) + offset, item) for item in samples])
            # Counters that step back again and again are those of two instances, and tell nothing.
            if track.resets <= 1 + len(track.times) // 10:
                found[instance] = track
                break
    return found


def _track(samples: list[tuple[int, Housekeeping]]) -> Track:
    track, last = Track(), None
    for time_ns, item in sorted(samples, key=lambda pair: pair[0]):
        if track.times and time_ns <= track.times[-1]:
            continue  # the same one again
        track.add(time_ns, item, last)
        last = item
    return track
