"""An event about loss stops after 16; the loss goes on."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.diagnosis.events import STOPS_AFTER
from edoras_tools.diagnosis.losses import LEAD_NS
from edoras_tools.diagnosis.verdict import Severity, Verdict

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
                for culprit, told in case.culprits.items()
                if culprit.instance == instance and culprit.kind == kind
            ]
            last_ns = max((told.last_ns for told in said), default=0)
            events = sum(told.count for told in said)
            if not said or track.growth(name, last_ns + LEAD_NS) < 2 or track.growth(name) <= events:
                continue
            yield Verdict(
                ID,
                Severity.NOTE,
                f"CFE_SB {number} was reported {events:,} times and then no more, while its counter grew by "
                f"{track.growth(name):,}: cFS stops this event after {STOPS_AFTER}",
                hop="event services",
                start_ns=last_ns,
                end_ns=track.times[-1],
                evidence=(
                    (
                        f"last event at {case.at(last_ns)}, then +{track.growth(name, last_ns + LEAD_NS):,} "
                        "in 0x803"
                    ),
                ),
                remedy="trust the counter; reset the filter of CFE_SB with 0x1801, code 14, to hear of it "
                "again",
            )
