"""Finds clocks that were set during a capture, and corrects the times before anything is measured.

If capture times run back, the clock of the capture was set. If mission time and capture time separate while
the sequence counts continue, one of the two clocks was set: the capture's, if the traffic has a gap of that
length, else that of the cFS.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from msgspec.structs import replace

from edoras_tools.cfs import telemetry_output
from edoras_tools.diagnosis.evidence.instances import NOBODY, Instances
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire.arrays.order import Integers, Mask, Places, by_key, groups, numbered

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.diagnosis.evidence.payloads import EventRecord
    from edoras_tools.diagnosis.evidence.table import Rows
    from edoras_tools.model import Endpoint

_BACK_NS: Final = SECOND
_MOST: Final = 16
_CYCLE_NS: Final = 500 * MILLISECOND
_WINDOW_NS: Final = 2 * SECOND
_JITTER_NS: Final = 100 * MILLISECOND
"""A packet may be that much quicker than the level beside it."""
_BESIDE_NS: Final = 5 * SECOND
_SLIPS_NS: Final = 3600 * SECOND
"""A clock that was set further makes another instance."""
_SURE: Final = 4
"""Packets of a window of which one was hardly delayed."""
_ALIKE_NS: Final = 20 * MILLISECOND
"""Delays of one round differ by less; behind a peer that hands packets on, or a slow network, by more."""
_MODULUS: Final = 1 << 14
_FURTHEST_NS: Final = 1 << 62
"""No clock of 32 bits of seconds can be set by more: the times are garbled."""
_NEXT: Final = 16
_MOST_GO_ON: Final = 0.6


class Jump(NamedTuple):
    """A clock that was set.

    Attributes:
        clock: whose: ``capture``, or the name of a cFS.
        row: the first row after it.
        by_ns: by how much, forward positive.
    """

    clock: str
    row: int
    by_ns: int


def steadied(
    rows: Rows, events: Sequence[EventRecord], endpoints: Sequence[Endpoint]
) -> tuple[Rows, list[Jump], Instances]:
    """Return the rows as if no clock had been set, every jump that was taken out, and who made the rows."""
    rows, jumps = _forward_only(rows)
    instances = Instances(rows, events, endpoints)
    while len(jumps) < _MOST and (parted := _parted(rows, instances)) and abs(parted[0].by_ns) < _FURTHEST_NS:
        jump, before = parted
        rows = _without(rows, jump, instances.of_row == before)
        jumps.append(jump)
        instances = Instances(rows, events, endpoints)
    while len(jumps) < _MOST and (ahead := _set_ahead(rows, instances)):
        rows = _without(rows, ahead, np.zeros(len(rows), bool))
        jumps.append(ahead)
        instances = Instances(rows, events, endpoints)
    jumps.sort(key=lambda item: item.row)
    moved = _levelled(rows, instances, jumps)
    if moved.any():
        rows = replace(rows, mission_time_ns=rows.mission_time_ns + moved)
        instances = Instances(rows, events, endpoints)
    return rows, jumps, instances


def _levelled(rows: Rows, instances: Instances, jumps: list[Jump]) -> Integers:
    """Return by how much each row's mission time is to be moved: what a cFS's clock slipped or drifted by.

    The shortest delay in a window is less than the time between two wake-ups of Telemetry Output: where it is
    longer, the clock slipped. By how much, its housekeeping tells (``_by_output``), else what the shortest
    delay is longer than in the best window. With several cFS on a network nothing is levelled: two boots at
    nearly one time look alike, and a level may be the other one's.
    """
    moved = np.zeros(len(rows), np.int64)
    alone = not ((rows.processor_id != 0) & (rows.mission_time_ns > 0)).any()
    for index, instance in enumerate(instances.items if alone else ()):
        own = np.flatnonzero(instances.of_row == index)
        delay = rows.delay_ns(own) - instance.offset_ns
        window = (rows.time_ns[own] - rows.time_ns[own[0]]) // _WINDOW_NS
        edges = np.flatnonzero(np.diff(window, prepend=window[0] - 1))
        least = np.minimum.reduceat(delay, edges)
        sure = np.diff(np.append(edges, len(own))) >= _SURE
        if not sure.any() or least[sure].max() <= _CYCLE_NS:
            continue
        output = np.flatnonzero(rows.known_id[own] == telemetry_output.HOUSEKEEPING_MSG_ID)
        if len(output) >= _SURE and np.median(np.abs(np.diff(delay[output]))) < _ALIKE_NS:
            moved[own] = _by_output(delay, output)
            jumps += _slips(moved[own], own, instance.name)
            continue
        # A window with too few packets to tell is as the one before it; one that differs from both beside it
        # had packets that were kept waiting.
        level = least[np.maximum.accumulate(np.where(sure, np.arange(len(sure)), int(sure.argmax())))]
        level = _smoothed(level)
        beside = _neighbours(level)
        beside = np.where(np.abs(beside - level) > 2 * _CYCLE_NS, beside, level)
        # Where the clock slipped within a window, each packet goes by the level that it fits.
        windows = beside[:, np.repeat(np.arange(len(edges)), np.diff(np.append(edges, len(own))))]
        moved[own] = np.where(windows <= delay + _JITTER_NS, np.minimum(windows, delay), 0).max(axis=0)
        jumps += _slips(level, own[edges], instance.name)
    return moved


def _slips(level: Integers, rows: Places, name: str) -> list[Jump]:
    """Return where the level of delays steps for good: one that it comes back from, or to, is a slow network.

    Args:
        level: i64 (n,), ns.
        rows: (n,), the first row of each.
    """
    places = np.flatnonzero(np.abs(np.diff(level)) > 2 * _CYCLE_NS)[:_MOST].tolist()
    near = ((at, np.append(level[at + 2 :] - level[at], level[:at] - level[at + 1])) for at in places)
    lasting = [at for at, others in near if not (np.abs(others) < _CYCLE_NS).any()]
    return [Jump(name or "cFS", int(rows[at + 1]), int(level[at] - level[at + 1])) for at in lasting]


def _neighbours(values: Integers) -> Integers:
    """Return the value before, the value and the value behind each; at the ends the value itself."""
    return np.stack((np.append(values[:1], values[:-1]), values, np.append(values[1:], values[-1:])))


def _smoothed(values: Integers) -> Integers:
    """Return values, in which a single one that differs from both beside it is as these are."""
    return np.asarray(np.median(_neighbours(values), axis=0).astype(np.int64))


def _by_output(delay: Integers, output: Places) -> Integers:
    """Return what the clock slipped by at each packet of a cFS, by Telemetry Output's housekeeping.

    That is made right after a round and sent in the next one: it always waits for one round, and nothing
    waits for longer. What others make waits for a part of a round: another part after either restarts.

    Args:
        delay: i64 (n,), of each packet, ns; more than that of the quickest.
        output: which of them are that housekeeping.
    """
    waits = int(delay[output].min())
    late = delay[output] - waits
    late = _smoothed(late)  # a single one that differs from both beside it was kept waiting
    behind = np.searchsorted(output, np.arange(len(delay)))
    before, after = late[np.maximum(behind - 1, 0)], late[np.minimum(behind, len(late) - 1)]
    fits = (after <= delay) & (delay - after <= waits + _JITTER_NS)
    return np.minimum(np.where(fits, after, before), delay)


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


def _parted(rows: Rows, instances: Instances) -> tuple[Jump, int] | None:
    """Find an instance that goes on as another, its clock or the capture's set: the jump, and which it was.

    What was made before a clock was set may come in one round with what was made after it.
    """
    order = sorted(range(len(instances.items)), key=lambda index: instances.items[index].first_ns)
    members = dict(groups(instances.of_row, np.flatnonzero(instances.of_row != NOBODY)))
    counts = [_first_and_last(rows, members[index]) for index in range(len(order))]
    last = _places([counts[index][1] for index in order])
    # The last first: what goes by the clock of the one before it has times that this one had as well.
    for at, after in reversed(list(enumerate(order))):
        for place in _taken_up(last, counts[after][0], at)[::-1]:
            before = order[place]
            first, second = instances.items[before], instances.items[after]
            same = first.name == second.name or not (first.name and second.name)
            if not same or first.last_ns > second.first_ns + _CYCLE_NS + _JITTER_NS:
                continue
            own, other = members[before], members[after]
            low, high = int(own[-1]), int(other[0])
            # What either clock slipped by earlier or later is another jump.
            own = own[rows.time_ns[own] > rows.time_ns[low] - _BESIDE_NS]
            other = other[rows.time_ns[other] < rows.time_ns[high] + _BESIDE_NS]
            by = int(rows.delay_ns(other).min() - rows.delay_ns(own).min())
            steps = np.diff(rows.time_ns[low : high + 1])
            widest = int(steps.argmax()) if len(steps) else 0
            if by > 0 and len(steps) and abs(int(steps[widest]) - by) < SECOND + by // 10:
                return Jump("capture", low + widest + 1, by), before
            return Jump(second.name or first.name or "cFS", high, -by), before
    return None


def _set_ahead(rows: Rows, instances: Instances) -> Jump | None:
    """Find where mission time falls behind by a time without frames: the capture's clock was set."""
    times = rows.time_ns
    steps = np.diff(times)
    for at in np.flatnonzero((steps > 2 * _CYCLE_NS) & (steps < _SLIPS_NS)).tolist():
        low, high = np.searchsorted(times, (times[at] - _BESIDE_NS, times[at + 1] + _BESIDE_NS)).tolist()
        near = low + np.flatnonzero(rows.mission_time_ns[low:high] > 0)
        for index in np.unique(instances.of_row[near]).tolist():
            own = near[instances.of_row[near] == index]
            before, after = own[own <= at], own[own > at]
            if not (len(before) and len(after)):
                continue
            by = int(rows.delay_ns(after).min() - rows.delay_ns(before).min())
            if by > 2 * _CYCLE_NS and abs(by - int(steps[at])) < _CYCLE_NS:
                return Jump("capture", at + 1, by)
    return None


def _first_and_last(rows: Rows, own: Places) -> list[dict[tuple[int, ...], int]]:
    """Return the first and the last count of each MsgId from each endpoint, by link, endpoint and MsgId."""
    ends: list[dict[tuple[int, ...], int]] = []
    for order in (own, own[::-1]):
        at = order[numbered(rows.link[order], rows.source[order], rows.msg_id[order])[0]]
        keys = zip(rows.link[at].tolist(), rows.source[at].tolist(), rows.msg_id[at].tolist(), strict=True)
        ends.append(dict(zip(keys, rows.sequence_count[at].tolist(), strict=True)))
    return ends


def _places(last: list[dict[tuple[int, ...], int]]) -> dict[tuple[int, ...], Integers]:
    """Return of each stream which instances have it, and their last counts of it: i64 (2, n)."""
    each = ((key, place, count) for place, counts in enumerate(last) for key, count in counts.items())
    streams = by_key(each, lambda item: item[0])
    return {key: np.array([item[1:] for item in own], np.int64).T for key, own in streams.items()}


def _taken_up(
    last: dict[tuple[int, ...], Integers], begin: dict[tuple[int, ...], int], end: int
) -> list[int]:
    """Return of which instances before one it takes up most counts.

    Args:
        last: as ``_places`` returns them.
        begin: its own first counts.
        end: its place.
    """
    common, matches = (np.zeros(end, np.intp) for _ in range(2))
    for item, count in begin.items():
        if item in last:
            places, lasts = last[item]
            places = places[: np.searchsorted(places, end)]
            step = (count - lasts[: len(places)]) % _MODULUS
            common[places] += 1
            matches[places] += (step > 0) & (step <= _NEXT)
    return np.flatnonzero((common > 2) & (matches > _MOST_GO_ON * common)).tolist()


def _without(rows: Rows, jump: Jump, before: Mask) -> Rows:
    """Return rows as if a clock had not been set; ``before`` are those whose packets were made before it."""
    later = np.arange(len(rows)) >= jump.row
    if jump.clock == "capture":
        return replace(rows, time_ns=rows.time_ns - later * jump.by_ns)
    moved = later & ~before & rows.timed
    return replace(rows, mission_time_ns=rows.mission_time_ns - moved * jump.by_ns)
