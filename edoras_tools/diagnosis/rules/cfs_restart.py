"""A cFS started anew while the capture ran: its clock, counts and counters began again."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.sessions.profile import SECOND

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "cfs_restart"


def judge(case: Case) -> Iterator[Verdict]:
    """Find boots of the same name, one after the other."""
    items = sorted(case.instances.items, key=lambda item: item.first_ns)
    for at, later in enumerate(items):
        earlier = next(
            (
                item
                for item in reversed(items[:at])
                if item.name == later.name and item.last_ns < later.first_ns
            ),
            None,
        )
        if earlier is None or not later.name:
            continue
        yield Verdict(
            ID,
            Severity.WARNING,
            f"{later.label} restarted between {case.at(earlier.last_ns)} and {case.at(later.first_ns)}: "
            "counts and counters begin again, nothing is called lost for that",
            hop="cFS",
            start_ns=earlier.last_ns,
            end_ns=later.first_ns,
            evidence=(
                (
                    "mission time against the capture's moved by "
                    f"{(later.offset_ns - earlier.offset_ns) / SECOND:.1f} s"
                ),
            ),
            remedy="commands sent in between reached nobody; Telemetry Output has to be enabled again",
        )
