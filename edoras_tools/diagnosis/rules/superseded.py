"""An application that keeps only the newest command of each burst: the others never go on."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.diagnosis.rules.crossing_loss import explained
from edoras_tools.diagnosis.verdict import Severity, Verdict

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "superseded"


def judge(case: Case) -> Iterator[Verdict]:
    """Count them apart from loss: this is how the two-robot application works."""
    for hop in case.hops:
        count = hop.superseded - max(0, explained(case, hop) - len(hop.missing))
        if not hop.rewritten or count <= 0:
            continue
        yield Verdict(
            ID,
            Severity.HABIT,
            f"{count:,} of {hop.of:,} messages on {case.name(hop.into.msg_id)} gave way to a newer one "
            f"before the application sent {case.name(hop.out.msg_id)}: CI delivers in bursts, and of a "
            "burst the last goes on",
            msg_id=hop.into.msg_id,
            topic=case.topic(hop.into.msg_id),
            link=hop.into.link.label,
            hop="cFS application",
            start_ns=int(case.rows.time_ns[hop.into.rows[0]]),
            end_ns=int(case.rows.time_ns[hop.into.rows[-1]]),
            evidence=(f"{hop.matched:,} came out with the same values",),
            remedy="send at most 2 Hz for every command to go on, or count on the newest alone",
            confidence="medium",
        )
