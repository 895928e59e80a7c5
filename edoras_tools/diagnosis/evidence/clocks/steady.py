"""Finds clocks that were set during a capture, and corrects the times before anything is measured.

Rules:

1. If capture times run back, the capture clock was set.
2. If mission time and capture time separate while the sequence counts go on, one of the two clocks was set.
   It was the capture clock if the traffic has a gap of that length; else it was the clock of the cFS.
3. If the capture has no SBN packets, smaller steps and the drift of a cFS's clock are taken out too.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from msgspec.structs import replace

from edoras_tools.cfs import telemetry_output
from edoras_tools.diagnosis.evidence.instances import NOBODY, Instances
from edoras_tools.sessions.sequence import MODULUS
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire.arrays import Integers, Mask, Places, by_key, groups, numbered

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
"""Largest time by which a packet may be quicker than the level of delays around it."""
_BESIDE_NS: Final = 5 * SECOND
_SLIPS_NS: Final = 3600 * SECOND
"""A larger step makes another instance."""
_SURE: Final = 4
"""Least number of packets in a window so that one of them had almost no delay."""
_ALIKE_NS: Final = 20 * MILLISECOND
"""Delays of housekeeping differ by less, unless a peer forwards it or the network is slow."""
_FURTHEST_NS: Final = 1 << 62
"""A clock with 32 bits of seconds cannot be set by more: then the times are garbled."""
_NEXT: Final = 16
_MOST_GO_ON: Final = 0.6


class Jump(NamedTuple):
    """A step of a clock that was set.

    Attributes:
        clock: ``capture``, or the name of the cFS.
        row: first row after the step.
        by_ns: size of the step in ns, positive if forward.
    """

    clock: str
    row: int
    by_ns: int


def without_steps(
    rows: Rows, events: Sequence[EventRecord], endpoints: Sequence[Endpoint]
) -> tuple[Rows, list[Jump], Instances]:
    """Return the rows with corrected times, the steps that were taken out, and the instances of cFS.

    Args:
        rows: table of datagrams, in order of capture.
        events: events in these rows.
        endpoints: endpoints that the rows index.
    """
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
    """Return the correction of each row's mission time, i64 ns: steps and drift of a cFS's clock.

    The shortest delay in a window is less than one cycle of Telemetry Output. If it is longer, the clock
    slipped. The size of the slip comes from TO's housekeeping (``_by_output``), else from the surplus of the
    shortest delay over that of the best window. If there are SBN packets, nothing is corrected: two cFS that
    booted at nearly the same time look alike, and the level may belong to the other one.
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
        # A window with too few packets gets the level of the one before it. In a window that differs from
        # both its neighbours, all packets were delayed.
        level = least[np.maximum.accumulate(np.where(sure, np.arange(len(sure)), int(sure.argmax())))]
        level = _smoothed(level)
        beside = _neighbours(level)
        beside = np.where(np.abs(beside - level) > 2 * _CYCLE_NS, beside, level)
        # If the clock slipped within a window, each packet uses the level that it fits.
        windows = beside[:, np.repeat(np.arange(len(edges)), np.diff(np.append(edges, len(own))))]
        moved[own] = np.where(windows <= delay + _JITTER_NS, np.minimum(windows, delay), 0).max(axis=0)
        jumps += _slips(level, own[edges], instance.name)
    return moved


def _slips(level: Integers, rows: Places, name: str) -> list[Jump]:
    """Return the lasting steps in the level of delays; a level that comes back means a slow network.

    Args:
        level: i64 (n,), level of each window, ns.
        rows: intp (n,), first row of each window.
        name: name of the cFS.
    """
    places = np.flatnonzero(np.abs(np.diff(level)) > 2 * _CYCLE_NS)[:_MOST].tolist()
    near = ((at, np.append(level[at + 2 :] - level[at], level[:at] - level[at + 1])) for at in places)
    lasting = [at for at, others in near if not (np.abs(others) < _CYCLE_NS).any()]
    return [Jump(name or "cFS", int(rows[at + 1]), int(level[at] - level[at + 1])) for at in lasting]


def _neighbours(values: Integers) -> Integers:
    """Return the values before, at and behind each place, i64 (3, n); at the ends the value itself."""
    return np.stack((np.append(values[:1], values[:-1]), values, np.append(values[1:], values[-1:])))


def _smoothed(values: Integers) -> Integers:
    """Return the values with single outliers removed, by the median of three."""
    return np.asarray(np.median(_neighbours(values), axis=0).astype(np.int64))


def _by_output(delay: Integers, output: Places) -> Integers:
    """Return the slip of the clock at each packet of a cFS, i64 (n,), by Telemetry Output's housekeeping.

    Housekeeping is made right after a round and sent in the next one. So it always waits for one round, and
    no packet waits longer. Other packets wait for a part of a round, which a restart changes.

    Args:
        delay: i64 (n,), delay of each packet beyond that of the quickest, ns.
        output: intp, indices of the housekeeping packets.
    """
    waits = int(delay[output].min())
    late = delay[output] - waits
    late = _smoothed(late)  # a single outlier was delayed
    if late[0] - late[1] > 2 * _CYCLE_NS:  # so was the first one
        late[0] = late[1]
    behind = np.searchsorted(output, np.arange(len(delay)))
    before, after = late[np.maximum(behind - 1, 0)], late[np.minimum(behind, len(late) - 1)]
    fits = (after <= delay) & (delay - after <= waits + _JITTER_NS)
    return np.minimum(np.where(fits, after, before), delay)


def _forward_only(rows: Rows) -> tuple[Rows, list[Jump]]:
    """Return the rows without backward steps of the capture clock, and these steps (rule 1)."""
    steps = np.diff(rows.time_ns)
    back = np.flatnonzero(steps < -_BACK_NS)
    usual = int(np.median(steps[steps >= 0])) if (steps >= 0).any() else 0
    moved = np.zeros(len(rows), np.int64)
    moved[back + 1] = usual - steps[back]
    jumps = [Jump("capture", at + 1, int(steps[at])) for at in back[:_MOST].tolist()]
    return replace(rows, time_ns=rows.time_ns + np.cumsum(moved)), jumps


def _parted(rows: Rows, instances: Instances) -> tuple[Jump, int] | None:
    """Return a step that split one instance in two, and the index of the first; None without one (rule 2).

    Packets made before and after the step may arrive in one round.
    """
    order = sorted(range(len(instances.items)), key=lambda index: instances.items[index].first_ns)
    members = dict(groups(instances.of_row, np.flatnonzero(instances.of_row != NOBODY)))
    counts = [_first_and_last(rows, members[index]) for index in range(len(order))]
    last = _places([counts[index][1] for index in order])
    # The last instance first: with its step taken out, it has the times of the one before.
    for at, after in reversed(list(enumerate(order))):
        for place in _taken_up(last, counts[after][0], at)[::-1]:
            before = order[place]
            first, second = instances.items[before], instances.items[after]
            same = first.name == second.name or not (first.name and second.name)
            if not same or first.last_ns > second.first_ns + _CYCLE_NS + _JITTER_NS:
                continue
            own, other = members[before], members[after]
            low, high = int(own[-1]), int(other[0])
            # Only packets near the step count: slips further away are other steps.
            own = own[rows.time_ns[own] > rows.time_ns[low] - _BESIDE_NS]
            other = other[rows.time_ns[other] < rows.time_ns[high] + _BESIDE_NS]
            by = int(rows.delay_ns(other).min() - rows.delay_ns(own).min())
            if abs(by) < _JITTER_NS:
                continue  # something else parts them
            steps = np.diff(rows.time_ns[low : high + 1])
            widest = int(steps.argmax()) if len(steps) else 0
            if by > 0 and len(steps) and abs(int(steps[widest]) - by) < SECOND + by // 10:
                return Jump("capture", low + widest + 1, by), before
            return Jump(second.name or first.name or "cFS", high, -by), before
    return None


def _set_ahead(rows: Rows, instances: Instances) -> Jump | None:
    """Return a forward step of the capture clock: the delay grows by the length of a gap in the traffic."""
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
    """Return two dicts, (link, endpoint, MsgId) to the first count, and to the last one."""
    ends: list[dict[tuple[int, ...], int]] = []
    for order in (own, own[::-1]):
        at = order[numbered(rows.link[order], rows.source[order], rows.msg_id[order])[0]]
        keys = zip(rows.link[at].tolist(), rows.source[at].tolist(), rows.msg_id[at].tolist(), strict=True)
        ends.append(dict(zip(keys, rows.sequence_count[at].tolist(), strict=True)))
    return ends


def _places(last: list[dict[tuple[int, ...], int]]) -> dict[tuple[int, ...], Integers]:
    """Return (link, endpoint, MsgId) to the instances that have it, and their last counts: i64 (2, n)."""
    each = ((key, place, count) for place, counts in enumerate(last) for key, count in counts.items())
    streams = by_key(each, lambda item: item[0])
    return {key: np.array([item[1:] for item in own], np.int64).T for key, own in streams.items()}


def _taken_up(
    last: dict[tuple[int, ...], Integers], begin: dict[tuple[int, ...], int], end: int
) -> list[int]:
    """Return the earlier instances whose sequence counts an instance mostly continues.

    Two counts or one must both go on, from higher than a boot begins.

    Args:
        last: result of ``_places``.
        begin: first counts of the instance.
        end: place of the instance in time.
    """
    common, matches, high = (np.zeros(end, np.intp) for _ in range(3))
    for item, count in begin.items():
        if item in last:
            places, lasts = last[item]
            places = places[: np.searchsorted(places, end)]
            step = (count - lasts[: len(places)]) % MODULUS
            common[places] += 1
            goes_on = (step > 0) & (step <= _NEXT)
            matches[places] += goes_on
            high[places] += goes_on & (count > _NEXT)
    enough = (common > 2) | ((common > 0) & (high == common))
    return np.flatnonzero(enough & (matches > _MOST_GO_ON * common)).tolist()


def _without(rows: Rows, jump: Jump, before: Mask) -> Rows:
    """Return the rows without a step; ``before`` marks packets made before it: bool (rows,)."""
    later = np.arange(len(rows)) >= jump.row
    if jump.clock == "capture":
        return replace(rows, time_ns=rows.time_ns - later * jump.by_ns)
    return replace(rows, mission_time_ns=rows.mission_time_ns - (later & ~before & rows.timed) * jump.by_ns)
