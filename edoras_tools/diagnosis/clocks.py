"""Clocks that were set while the capture ran, found and taken out before anything is measured.

Time that runs back is the capture's own doing. When a cFS's mission time and the capture's part ways while
its sequence counts go on, one of the two clocks was set: the capture's where the traffic shows a hole of that
length, else the cFS's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.diagnosis.instances import Instances
from edoras_tools.model import Link
from edoras_tools.sessions.profile import SECOND

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.diagnosis.payloads import EventRecord
    from edoras_tools.diagnosis.table import Rows

_BACK_NS: Final = SECOND
_MOST: Final = 16
_MODULUS: Final = 1 << 14
_NEXT: Final = 16
_MOST_GO_ON: Final = 0.6


@dataclass(frozen=True, slots=True)
class Jump:
    """A clock that was set.

    Attributes:
        clock: whose: ``capture``, or the name of a cFS.
        row: the first row after it.
        by_ns: by how much, forward positive.
    """

    clock: str
    row: int
    by_ns: int


def steadied(rows: Rows, events: Sequence[EventRecord]) -> tuple[Rows, list[Jump]]:
    """Return the rows as if no clock had been set, and every jump that was taken out."""
    rows, jumps = _forward_only(rows)
    while len(jumps) < _MOST:
        jump = _parted(rows, Instances(rows, events))
        if jump is None:
            break
        rows = _without(rows, jump)
        jumps.append(jump)
    return rows, jumps


def _forward_only(rows: Rows) -> tuple[Rows, list[Jump]]:
    """Take out jumps back of the capture's clock."""
    steps = np.diff(rows.time_ns)
    back = np.flatnonzero(steps < -_BACK_NS)
    if not len(back):
        return rows, []
    usual = int(np.median(steps[steps >= 0])) if (steps >= 0).any() else 0
    moved = np.zeros(len(rows), np.int64)
    moved[back + 1] = usual - steps[back]
    jumps = [Jump("capture", at + 1, int(steps[at])) for at in back[:_MOST].tolist()]
    return replace(rows, time_ns=rows.time_ns + np.cumsum(moved)), jumps


def _parted(rows: Rows, instances: Instances) -> Jump | None:
    """Find an instance that goes on as another, its clock or the capture's set."""
    order = sorted(range(len(instances.items)), key=lambda index: instances.items[index].first_ns)
    for at, after in enumerate(order):
        for before in order[:at]:
            first, second = instances.items[before], instances.items[after]
            named = first.name == second.name or not (first.name and second.name)
            if not named or first.last_ns > second.first_ns or not _goes_on(rows, instances, before, after):
                continue
            by = second.offset_ns - first.offset_ns
            low = int(np.flatnonzero(instances.of_row == before)[-1])
            high = int(np.flatnonzero(instances.of_row == after)[0])
            steps = np.diff(rows.time_ns[low : high + 1])
            widest = int(steps.argmax())
            if by > 0 and abs(int(steps[widest]) - by) < SECOND + by // 10:
                return Jump("capture", low + widest + 1, by)
            return Jump(second.name or first.name or "cFS", high, -by)
    return None


def _goes_on(rows: Rows, instances: Instances, before: int, after: int) -> bool:
    """Tell whether most counts of one instance are taken up by another."""
    first, second = (np.flatnonzero(instances.of_row == index) for index in (before, after))

    def key(row: int) -> tuple[int, int, int]:
        return int(rows.link[row]), int(rows.source[row]), int(rows.msg_id[row])

    last = {key(row): int(rows.sequence_count[row]) for row in first.tolist()}
    begin = {key(row): int(rows.sequence_count[row]) for row in reversed(second.tolist())}
    steps = [(begin[item] - last[item]) % _MODULUS for item in begin if item in last]
    return len(steps) > 2 and float(np.mean([0 < step <= _NEXT for step in steps])) > _MOST_GO_ON


def _without(rows: Rows, jump: Jump) -> Rows:
    later = np.arange(len(rows)) >= jump.row
    if jump.clock == "capture":
        return replace(rows, time_ns=rows.time_ns - later * jump.by_ns)
    timed = later & (rows.mission_time_ns > 0) & np.isin(rows.link, (Link.TO, Link.SBN))
    return replace(rows, mission_time_ns=rows.mission_time_ns - timed * jump.by_ns)
