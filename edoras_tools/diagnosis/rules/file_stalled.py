"""A file that CFDP transferred stood still for a while."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links.cfdp import CFDP
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "file_stalled"
_LONG_NS: Final = 10 * SECOND
"""Twice the usual interval of the timers for ACK and NAK."""


def judge(case: Case) -> Iterator[Verdict]:
    """Name each transaction in which neither side said anything for long, and that went on then."""
    for item in case.capture.files:
        if item.silence_ns > _LONG_NS:
            yield Verdict(
                ID,
                Severity.WARNING,
                f"the transfer of {item.title} stood still for {item.silence_ns / SECOND:.1f} s, and went on",
                link=CFDP.label,
                hop=item.hop,
                start_ns=item.first_ns,
                end_ns=item.last_ns,
                evidence=("the longest time between two of its PDUs",),
                remedy="look for an outage of the link, or a suspended entity",
            )
