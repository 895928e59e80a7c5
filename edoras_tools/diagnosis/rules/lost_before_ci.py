"""Commands that were sent and that CI never counted, at a rate that it can read: lost on the network."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.cfs import command_ingest
from edoras_tools.diagnosis.loss_verdict import loss_verdict, lost_at
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "lost_before_ci"


def judge(case: Case) -> Iterator[Verdict]:
    """Name the route; and what CI counted that is not in the capture."""
    for loss in case.losses:
        if loss.kind == "network":
            yield loss_verdict(
                case,
                ID,
                loss,
                f"{lost_at(case, loss, 'commands')}: CI counted fewer than were sent, and it reads so many",
                link="ci",
                remedy="look at the uplink: a capture on the cFS host shows which of them arrive there",
            )
    for fate in case.commands.fates.values():
        if fate.uncounted:
            stream = fate.stream
            start_ns = int(case.rows.time_ns[stream.rows[0]])
            counted = (item.first_ns for item in case.ingests if item.endpoint == stream.receiver)
            yield Verdict(
                ID,
                Severity.WARNING,
                f"{fate.uncounted:,} of {len(stream):,} commands on {case.name(stream.msg_id)} are not "
                "accounted for: CI's first count has fewer than were sent before it",
                msg_id=stream.msg_id,
                topic=case.topic(stream.msg_id),
                link="ci",
                hop=command_ingest.NAME,
                of=len(stream),
                start_ns=start_ns,
                end_ns=max(start_ns, *counted),
                evidence=("lost on the way, or read by a CI that started again since: no count tells",),
                remedy="capture from before the commands, and have Telemetry Output enabled first",
                confidence="medium",
            )
    for account in case.ingests:
        if account.not_captured:
            yield Verdict(
                ID,
                Severity.NOTE,
                f"CI counted {plural(account.not_captured, 'datagram')} more than the capture shows: the "
                "capture missed some, or another sender's do not pass here",
                link="ci",
                hop="capture",
                start_ns=account.first_ns,
                end_ns=account.last_ns,
                evidence=(f"0x884: CI took {account.taken + account.not_captured:,}",),
                remedy="capture on the cFS host",
                confidence="medium",
            )
