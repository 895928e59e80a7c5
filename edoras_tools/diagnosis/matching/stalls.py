"""Finds the times in which a whole cFS stood still: stopped by its host, starved, or stuck in one task.

One that is starved may run a little: then nothing that its scheduler asks for comes, and other packets do.

In: rows, streams and the other states. Out: the state "stalled" of the cFS, or of its scheduler, for the
timeline.

Rules, all of which must hold:

1. The capture has no packet of this cFS, or no housekeeping, in that time, although it sent steadily before
   and after.
2. Its streams miss few of the sequence counts that were due there, so it published nothing.
3. The first packets behind were made after that time, so no network delayed them.
4. Nothing else explains the silence of these streams: cFS did not boot, what sends them was not switched off,
   and the capture had no outage.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.cfs.executive_services import SCHEDULERS
from edoras_tools.diagnosis.evidence.instances import NOBODY, Instances
from edoras_tools.diagnosis.evidence.timeline.table import NOT_RUNNING, Change, StateOwner, Timeline, Way
from edoras_tools.units import SECOND
from edoras_tools.wire.cfe import EVENT_MSG_ID

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from edoras_tools.diagnosis.evidence.table import Rows
    from edoras_tools.diagnosis.matching.streams import Stream
    from edoras_tools.wire.arrays import Integers

_LEAST_NS: Final = SECOND
_FACTOR: Final = 2
"""A silence of this many of its longest usual pauses is a stall."""
_LEAST_STREAMS: Final = 3
_DUE: Final = 1.2
"""A stream was due in a pause that is this many times longer than its period."""
_FEW: Final = 4
"""Counts that miss are few if fewer than a quarter of those due in a pause do."""
_EDGE: Final = 8
"""The first and the last eighth of a pause may belong to the time around it."""
_BEHIND: Final = 8
"""Number of messages, from the last one before the pause on, whose mission times are checked."""
_CFS: Final = StateOwner("cfs")
_SCHEDULER: Final = StateOwner("app", "SCH")
"""One of ``SCHEDULERS``: nothing shows which of these is starved, and none is printed."""
_UNWOKEN: Final = "no housekeeping"
_WOKEN_NS: Final = 3 * SECOND
"""A scheduler may miss a tick or two."""


def stalls(
    rows: Rows, streams: Sequence[Stream], instances: Instances, timeline: Timeline
) -> Iterator[Change]:
    """Yield the beginning and the end of each stall of each cFS.

    Args:
        timeline: all other states of cFS, applications and capture.
    """
    whose = instances.system_of_row
    robot = rows.on(lambda link: link.last_hop)
    asleep = [item for item in timeline.every(*NOT_RUNNING) if item.change.subject.name in SCHEDULERS]
    counted = [item for item in streams if item.counted and item.instance != NOBODY]
    for system in sorted(set(instances.systems)):
        mine = [item for item in counted if instances.systems[item.instance] == system]
        woken = [item for item in mine if item.is_housekeeping and item.known_id != EVENT_MSG_ID]
        # Datagrams to a robot may come from any of the cFS.
        every = rows.time_ns[(whose == system) | robot]
        due_ns = np.sort(np.concatenate([every[:0], *(item.time_ns for item in woken)]))
        still = [(span.start_lo, span.end_hi) for span in asleep if span.change.system == system]
        subjects = (_CFS, "nothing", every, mine, _LEAST_NS), (_SCHEDULER, _UNWOKEN, due_ns, woken, _WOKEN_NS)
        for subject, absence, times, able, least_ns in subjects:
            for start_ns, end_ns, usual_ns in _pauses(times, least_ns):
                if any(first < end_ns and start_ns < last for first, last in still):
                    continue
                own = [
                    item
                    for item in able
                    if item.time_ns[0] <= start_ns < item.time_ns[-1]
                    if not timeline.blocking(Way(item.msg_id, item.link, system), start_ns, end_ns)
                ]
                if _published_nothing(instances, own, start_ns, end_ns, usual_ns):
                    still.append((start_ns, end_ns))
                    text = f"{absence} came of it for {(end_ns - start_ns) / SECOND:.1f} s"
                    text += ", no count is missing, and it went on as before"
                    yield Change(system, subject, "stalled", start_ns, start_ns + usual_ns, text)
                    yield Change(system, subject, "running", end_ns - usual_ns, end_ns, "it sends again")


def _pauses(times: Integers, least_ns: int) -> Iterator[tuple[int, int, int]]:
    """Yield the pauses of some times that are longer than usual: start, end and usual length, ns."""
    steps = np.diff(times)
    usual = steps[steps > SECOND // 20]
    usual_ns = int(np.quantile(usual, 0.9)) if len(usual) else 0
    for at in np.flatnonzero(steps > max(least_ns, _FACTOR * usual_ns)).tolist():
        yield int(times[at]), int(times[at + 1]), usual_ns


def _published_nothing(
    instances: Instances, streams: Sequence[Stream], start_ns: int, end_ns: int, round_ns: int
) -> bool:
    """Return whether several streams were due in a pause, few miss counts, and none was published in it.

    Packets of the last round before the pause wait in Telemetry Output's pipe and come out behind it.

    Args:
        start_ns: begin of the pause.
        end_ns: its end.
        round_ns: usual time between two packets, ns.
    """
    pause_ns = end_ns - start_ns
    edge_ns = max(SECOND // 4, pause_ns // _EDGE)
    first_ns, last_ns = start_ns + max(edge_ns, round_ns), end_ns - edge_ns
    due = lacking = 0
    for stream in streams:
        times = stream.time_ns
        at = int(np.searchsorted(times, start_ns, "right")) - 1
        if at < 0 or at + 2 > len(times) - 1:
            continue
        made_ns = instances.made_ns[stream.rows[at : at + _BEHIND]]
        if ((made_ns > first_ns) & (made_ns < last_ns)).any():
            return False
        # If the capture begins just before the pause, the packets behind it show the period.
        first, last = (max(0, at - 20), at) if at else (1, min(21, len(times) - 1))
        period_ns = (times[last] - times[first]) / (last - first)
        if period_ns * _DUE < pause_ns:
            due += 1
            # What cFS publishes at once when it goes on may be more than a pipe holds: some counts may miss.
            # The capture may lack the last packets before the pause.
            lacking += stream.missing[at] * period_ns * _FEW > pause_ns
    return due >= _LEAST_STREAMS and 3 * lacking <= due
