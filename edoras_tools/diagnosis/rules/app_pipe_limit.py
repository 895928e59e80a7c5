"""Too many of one MsgId waited in an application's pipe: the software bus dropped the rest."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.model import Link
from edoras_tools.sessions import telemetry_output
from edoras_tools.sessions.profile import SECOND

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.losses import Loss

ID = "app_pipe_limit"


def judge(case: Case) -> Iterator[Verdict]:
    """Name the MsgId, the pipe and the rate that would be clean."""
    for loss in case.losses:
        at_app = loss.hop != telemetry_output.PIPE and not loss.hop.startswith("SBN")
        if loss.kind == "limit" and at_app:
            yield _verdict(case, loss)


def _verdict(case: Case, loss: Loss) -> Verdict:
    profile = case.profile
    over_network = loss.sender.startswith("SBN") or (loss.stream is not None and loss.stream.link is Link.SBN)
    who, period = ("SBN", profile.sbn_wake_ns) if over_network else ("CI", profile.ci_wake_ns)
    limit = profile.app_msg_limit
    clean = limit * SECOND / period
    of = f" of {loss.of:,}" if loss.of else ""
    least = "at least " if loss.instance not in case.tracks else ""
    reason = (
        f"{least}{loss.lost:,}{of} commands on {case.name(loss.msg_id)} lost at {loss.hop}: more than "
        f"{limit} of "
        f"one MsgId waiting while {who} delivers in {period // 1_000_000} ms bursts"
    )
    evidence = list(loss.evidence)
    if loss.span is not None and loss.span.rate_hz:
        evidence.append(f"sent at {loss.span.rate_hz:.1f} Hz; {clean:g} Hz is the highest clean rate")
    return Verdict(
        ID,
        Severity.ERROR,
        reason,
        msg_id=loss.msg_id,
        topic=case.topic(loss.msg_id),
        link="sbn" if over_network else "ci",
        hop=loss.hop,
        lost=loss.lost,
        of=loss.of,
        start_ns=loss.start_ns,
        end_ns=loss.end_ns,
        evidence=(*evidence, *case.drops_text()),
        remedy=f"send at most {clean:g} Hz ({limit} every {period // 1_000_000} ms), or have the application "
        "subscribe with a higher message limit (CFE_SB_SubscribeEx)",
        confidence=loss.confidence,
    )
