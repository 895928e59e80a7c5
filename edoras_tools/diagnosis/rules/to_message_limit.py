"""Telemetry Output's table lets so many of a MsgId wait between two of its rounds; the rest is dropped."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.cfs import telemetry_output
from edoras_tools.diagnosis.loss_verdict import loss_verdict, lost_at, published
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.accounting.losses import Loss
    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.verdict import Verdict

ID = "to_message_limit"
_FULL = 0.3


def judge(case: Case) -> Iterator[Verdict]:
    """Name the MsgId, and the rate that gets through, as measured where it can be."""
    for loss in case.losses:
        if loss.kind == "limit" and loss.hop == telemetry_output.PIPE and not loss.closed:
            yield _verdict(case, loss)


def _verdict(case: Case, loss: Loss) -> Verdict:
    limit, period, measured = clean_round(case, loss)
    rate = limit * SECOND / period
    reason = (
        f"{lost_at(case, loss)}: {published(loss)}{limit} of this MsgId may wait and TO sends every "
        f"{period / 1e6:.0f} ms, so {rate:.1f}/s get through"
    )
    evidence = list(loss.evidence)
    if measured:
        evidence.append(
            f"at most {limit} came in one round, every {period / 1e6:.1f} ms: {rate:.1f} Hz is clean"
        )
    return loss_verdict(
        case,
        ID,
        loss,
        reason,
        link="to",
        evidence=evidence,
        remedy=f"publish at most {rate:.0f} Hz, or raise the MsgId's limit in TO's table (to_lab_sub), and "
        f"until TO restarts: {_raised(case, loss.msg_id, 2 * limit)}",
    )


def _raised(case: Case, msg_id: int, limit: int) -> str:
    """Return what to type so that more of a MsgId may wait: a MsgId that is there already keeps its limit."""
    more = str(min(255, limit))
    remove = case.inject("to-remove", f"0x{msg_id:04x}")
    return f"{remove}; {case.inject('to-add', f'0x{msg_id:04x}', '--limit', more)}"


def clean_round(case: Case, loss: Loss) -> tuple[int, int, bool]:
    """Return how many get through a round, how long a round is, and whether that was measured."""
    rounds, period = loss.comb, case.profile.to_wake_ns
    if rounds and rounds.share >= _FULL and abs(rounds.period_ns - period) < period // 10:
        return rounds.most, rounds.period_ns, True
    return case.profile.to_limits.get(loss.msg_id, case.profile.to_default_limit), period, False
