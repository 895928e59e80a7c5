"""An event about loss stops after 16; the loss goes on."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.cfs.software_bus import NAME, STOPS_AFTER
from edoras_tools.diagnosis.accounting.losses import LEAD_NS
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "event_suppression"
_COUNTERS = {"limit": ("msg_limits", 17), "overflow": ("pipe_overflows", 25)}


def judge(case: Case) -> Iterator[Verdict]:
    """Compare events with counters."""
    for instance, track in case.tracks.items():
        for kind, (name, number) in _COUNTERS.items():
            said = [
                told
                for reported, told in case.reported_losses.items()
                if reported.instance == instance and reported.kind == kind
            ]
            last_ns = max((told.last_ns for told in said), default=0)
            events = sum(told.count for told in said)
            if not said or track.growth(name, last_ns + LEAD_NS) < 2 or track.growth(name) <= events:
                continue
            yield Verdict(
                ID,
                Severity.NOTE,
                f"{plural(events, 'event')} CFE_SB {number} came, the last at {case.at(last_ns)}, while "
                f"its counter grew by {track.growth(name):,}: cFS stops this event after {STOPS_AFTER}, "
                "until its filter is reset, and events may be lost themselves",
                hop="event services",
                start_ns=last_ns,
                end_ns=track.times[-1],
                evidence=((f"after the last of them +{track.growth(name, last_ns + LEAD_NS):,} in 0x803"),),
                remedy=f"trust the counter; to hear of it again: {case.inject('evs-reset-filters', NAME)}",
            )
