"""The software bus counts losses that neither an event nor the traffic seen here explains."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.cfs.commands import ENABLE_OUTPUT
from edoras_tools.cfs.software_bus import NAME
from edoras_tools.diagnosis.verdict import Severity, Verdict

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "unattributed_loss"


def judge(case: Case) -> Iterator[Verdict]:
    """Say how many, and what would tell which."""
    for loss in case.losses:
        if loss.kind == "unknown" and loss.stream is None:
            yield Verdict(
                ID,
                Severity.ERROR,
                f"{loss.lost:,} messages lost on the software bus of {case.label(loss.instance)}; which "
                "ones is not observable from here",
                hop="software bus",
                lost=loss.lost,
                start_ns=loss.start_ns,
                end_ns=loss.end_ns,
                evidence=tuple(loss.evidence),
                remedy=f"before the traffic starts: {case.inject(ENABLE_OUTPUT)}; "
                f"{case.inject('evs-reset-filters', NAME)}; and capture CI, TO and SBN together: the "
                "events then name MsgId, pipe and sender",
                confidence="low",
            )
