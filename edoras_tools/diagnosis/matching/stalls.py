"""Times in which a whole cFS stood still: stopped by its host, starved, or stuck in one task.

Nothing at all came of it, although it sent steadily before and after; no sequence count is missing, so it
published nothing; and what came first behind was made then, so no network held it back. An output that was
switched off, a boot, or a capture that saw nothing is no such time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.cfs import executive_services, telemetry_output
from edoras_tools.diagnosis.evidence.instances import NOBODY, Instances
from edoras_tools.diagnosis.evidence.timeline.table import EVERY, Change, StateOwner, Timeline
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from edoras_tools.diagnosis.evidence.table import Rows
    from edoras_tools.diagnosis.matching.streams import Stream

_LEAST_NS: Final = SECOND
_FACTOR: Final = 2
"""Nothing for so many of the longest of its usual pauses: it stood still."""
_LEAST_STREAMS: Final = 3
_DUE: Final = 1.2
"""What comes more often than a pause is long was due in it."""
_EDGE: Final = 8
"""The first and the last of so many parts of a pause may be of the time around it."""
_BEHIND: Final = 8
"""So many messages of a stream show when what waited was made."""
_CFS: Final = StateOwner("cfs")
_OFF: Final = (
    (StateOwner("output"), ("disabled", "suppressed")),
    (StateOwner("entry"), ("unsubscribed", "as at the start")),
    (_CFS, ("down",)),
    *(
        (StateOwner("app", name), ("stopped", "restarting", "failed"))
        for name in (*telemetry_output.NAMES, *executive_services.SCHEDULERS)
    ),
)


def stalls(
    rows: Rows, streams: Sequence[Stream], instances: Instances, timeline: Timeline
) -> Iterator[Change]:
    """Yield when each cFS stood still, and when it went on.

    Args:
        timeline: what else is known of it.
    """
    whose = np.array([*instances.systems, NOBODY])[instances.of_row]
    robot = rows.on(lambda link: link.last_hop)
    for system in sorted(set(instances.systems)):
        # What goes to a robot comes of the only cFS, or may come of any.
        times = rows.time_ns[(whose == system) | robot]
        steps = np.diff(times)
        if len(steps) < _LEAST_STREAMS:
            continue
        pauses = steps[steps > SECOND // 20]
        usual_ns = int(np.quantile(pauses, 0.9)) if len(pauses) else 0
        for at in np.flatnonzero(steps > max(_LEAST_NS, _FACTOR * usual_ns)).tolist():
            start_ns, end_ns = times[at : at + 2].tolist()
            if _switched_off(timeline, system, start_ns, end_ns):
                continue
            own = [
                item
                for item in streams
                if item.instance != NOBODY and instances.systems[item.instance] == system and item.counted
            ]
            if _published_nothing(instances, own, (start_ns, end_ns), usual_ns):
                text = f"nothing came of it for {(end_ns - start_ns) / SECOND:.1f} s"
                text += ", no count is missing, and it went on as before"
                yield Change(system, _CFS, "stalled", start_ns, start_ns + usual_ns, text)
                yield Change(system, _CFS, "running", end_ns - usual_ns, end_ns, "it sends again")


def _switched_off(timeline: Timeline, system: int, start_ns: int, end_ns: int) -> bool:
    away = timeline.spans(StateOwner("capture"), "away", EVERY)
    spans = [
        span for owner, states in _OFF for state in states for span in timeline.spans(owner, state, system)
    ]
    return any(span.overlaps(start_ns, end_ns) for span in (*spans, *away))


def _published_nothing(
    instances: Instances, streams: Sequence[Stream], pause: tuple[int, int], round_ns: int
) -> bool:
    """Tell whether several steady streams were due, few of them lack any, and none was made meanwhile.

    What was made in the last round before waits in Telemetry Output's pipe, and comes out when all goes on.
    """
    start_ns, end_ns = pause
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
        # Where the capture begins just before the pause, what came behind it tells how often.
        first, last = (max(0, at - 20), at) if at else (1, min(21, len(times) - 1))
        if (times[last] - times[first]) * _DUE < pause_ns * (last - first):
            due += 1
            # What it makes up for at once when it goes on may be more than a pipe takes.
            lacking += bool(stream.missing[at])
    return due >= _LEAST_STREAMS and 3 * lacking <= due
