"""Too many of one MsgId waited in an application's pipe: the software bus dropped the rest."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.cfs import command_ingest, telemetry_output
from edoras_tools.diagnosis.loss_verdict import loss_verdict, lost_at
from edoras_tools.links.sbn import SBN
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.accounting.losses import Loss
    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.verdict import Verdict

ID = "app_pipe_limit"


def judge(case: Case) -> Iterator[Verdict]:
    """Name the MsgId, the pipe and the rate that would be clean."""
    for loss in case.losses:
        at_app = loss.hop != telemetry_output.PIPE and not loss.hop.startswith("SBN")
        if loss.kind == "limit" and at_app:
            yield _verdict(case, loss)


def _verdict(case: Case, loss: Loss) -> Verdict:
    profile = case.profile
    over_network = loss.sender.startswith("SBN") or (loss.stream is not None and loss.stream.link is SBN)
    who, period = ("SBN", profile.sbn_wake_ns) if over_network else ("CI", profile.ci_wake_ns)
    limit = profile.app_msg_limit
    clean = limit * SECOND / period
    least = "at least " if loss.instance not in case.tracks else ""
    if loss.sender and not loss.sender.startswith((command_ingest.NAME, "SBN")):
        return loss_verdict(
            case,
            ID,
            loss,
            f"{least}{lost_at(case, loss)}: {loss.sender} sent more than may wait, or nobody read the pipe",
            link=None,
            remedy="see whether the application that reads this pipe runs",
        )
    reason = (
        f"{least}{lost_at(case, loss, 'commands')}: more than {limit} of one MsgId waiting while {who} "
        f"delivers in {period // 1_000_000} ms bursts"
    )
    evidence = list(loss.evidence)
    if loss.span is not None and loss.span.rate_hz:
        evidence.append(f"sent at {loss.span.rate_hz:.1f} Hz; {clean:g} Hz is the highest clean rate")
    return loss_verdict(
        case,
        ID,
        loss,
        reason,
        link="sbn" if over_network else "ci",
        evidence=evidence,
        remedy=f"send at most {clean:g} Hz ({limit} every {period // 1_000_000} ms), or have the application "
        "subscribe with a higher message limit (CFE_SB_SubscribeEx)",
    )
