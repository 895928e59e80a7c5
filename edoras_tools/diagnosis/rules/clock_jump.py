"""A clock was set while the capture ran."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.units import SECOND
from edoras_tools.words import seconds

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "clock_jump"


def judge(case: Case) -> Iterator[Verdict]:
    """Name every clock that was set; all times of this diagnosis are as if it had not been."""
    for jump in case.jumps:
        when = int(case.rows.time_ns[jump.row])
        own = jump.clock == "capture"
        whose = "the capture's own clock" if own else f"the clock of cFS {jump.clock}, and not the capture's,"
        way = "back" if jump.by_ns < 0 else "ahead"
        yield Verdict(
            ID,
            Severity.WARNING,
            f"{whose} was set {way} by {seconds(abs(jump.by_ns) / SECOND)} at packet "
            f"{case.rows.number[jump.row]}: times here are given as if it had not",
            hop="capture" if own else "cFS",
            start_ns=when,
            end_ns=when,
            evidence=(
                "time runs back from one packet to the next"
                if jump.by_ns < 0 and own
                else "mission time and the capture's part ways here, and sequence counts go on: no restart",
            ),
            remedy="discipline the clock (chrony), and do not set it while capturing"
            if own
            else "see who sends TIME commands (0x1805); mission times before and after do not compare",
            confidence="high" if own and jump.by_ns < 0 else "medium",
        )
