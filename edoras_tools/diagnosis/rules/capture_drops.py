"""The capture itself lost packets: what it misses is not cFS's fault."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.diagnosis.verdict import Severity, Verdict

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "capture_drops"


def judge(case: Case) -> Iterator[Verdict]:
    """Say so before anything else is blamed."""
    drops = case.capture.drops
    if drops:
        yield Verdict(
            ID,
            Severity.ERROR,
            f"the capture itself lost {drops:,} frames before they were written: what is missing below may "
            "be among them",
            hop="capture",
            lost=drops,
            of=drops + len(case.rows),
            start_ns=case.start_ns,
            end_ns=case.end_ns,
            evidence=("the capture's own drop counter",),
            remedy="capture on a faster or quieter host, with a filter on the links' ports, or to a faster "
            "disk",
        )
