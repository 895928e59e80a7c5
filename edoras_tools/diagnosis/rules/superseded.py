"""An application that keeps only the newest command of each burst: the others never go on."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.diagnosis.verdict import Severity, Verdict

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "superseded"


def judge(case: Case) -> Iterator[Verdict]:
    """Count them apart from loss: this is how the two-robot application works."""
    for fate in case.commands.fates.values():
        if not fate.superseded:
            continue
        stream = fate.stream
        outs = " and ".join(case.name(hop.out.msg_id) for hop in fate.hops)
        yield Verdict(
            ID,
            Severity.HABIT,
            f"{fate.superseded:,} of {len(stream):,} messages on {case.name(stream.msg_id)} gave way to a "
            f"newer one before the application sent {outs}: it takes them in bursts, and the last goes on",
            msg_id=stream.msg_id,
            topic=case.topic(stream.msg_id),
            link=stream.link.label,
            hop="application",
            start_ns=int(case.rows.time_ns[stream.rows[0]]),
            end_ns=int(case.rows.time_ns[stream.rows[-1]]),
            evidence=(f"{int(fate.arrived.sum()):,} came out with the same values",),
            remedy="send at most 2 Hz for every command to go on, or count on the newest alone",
            confidence="medium",
        )
