"""What was left out: traffic whose port nobody names, and times in which the interface was away."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.decode.conversations import unnamed
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "not_examined"
_REMEDY = "what spans it says nothing of the link: examine before and after, --start and --end"
AWAY = "is away: what has been sent since"


def judge(case: Case) -> Iterator[Verdict]:
    """Say so first: what is below is not the whole link."""
    for item in unnamed(case.prepared.flows):
        yield Verdict(
            ID,
            Severity.ERROR,
            item.told,
            hop="capture",
            start_ns=case.start_ns,
            end_ns=case.end_ns,
            evidence=("lengths, types and MsgIds in it agree as only that link's do",),
            remedy=item.remedy,
        )
    missing = sum(case.telemetry.away.values()) if len(case.rows) and case.away else 0
    counted = f"sequence counts: {plural(missing, 'message')} that span such a time are not captured"
    for outage in case.capture.outages:
        end_ns = outage.end_ns or max(case.end_ns, outage.start_ns)
        lasted = f"was away {(end_ns - outage.start_ns) / 1e9:.1f} s: what was sent then"
        yield Verdict(
            ID,
            Severity.WARNING,
            f"{outage.interface} {lasted if outage.end_ns else AWAY} is not examined",
            hop="capture",
            start_ns=outage.start_ns,
            end_ns=end_ns,
            evidence=(f"the recorder found it {outage.why}", *((counted,) if missing else ())),
            remedy=_REMEDY,
        )
    for start_ns, end_ns in case.holes if len(case.rows) else ():
        yield Verdict(
            ID,
            Severity.WARNING,
            f"the capture has a hole of {(end_ns - start_ns) / 1e9:.1f} s: traffic in it is not examined",
            hop="capture",
            start_ns=start_ns,
            end_ns=end_ns,
            evidence=(
                "it shows no datagram of anybody; all sent before and after, and cFS went on counting",
                *((counted,) if missing else ()),
            ),
            remedy=_REMEDY,
        )
