"""Event Services squelched an application: it said more than 32 things at once, or 15 a second."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.cfs.event_services import SQUELCHED
from edoras_tools.diagnosis.verdict import Severity, Verdict

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "event_squelch"


def judge(case: Case) -> Iterator[Verdict]:
    """Name the application whose events are not all here."""
    seen = set()
    for record in case.said(case.start_ns, case.end_ns, SQUELCHED.app, [SQUELCHED.event_id]):
        found = SQUELCHED.pattern.search(record.message)
        app = found["app"] if found else record.message
        if (record.sender, app) in seen:
            continue
        seen.add((record.sender, app))
        yield Verdict(
            ID,
            Severity.NOTE,
            f"events of {app} on cFS {record.sender} are squelched: it says more than Event Services lets "
            "through",
            hop="event services",
            start_ns=record.time_ns,
            end_ns=record.time_ns,
            evidence=(f"packet {record.number}, {case.at(record.time_ns)}: {record}",),
            remedy=f"do not conclude from silence of {app}; its counters go on",
        )
