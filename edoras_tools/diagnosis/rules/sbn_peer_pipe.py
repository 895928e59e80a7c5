"""The pipe of an SBN peer takes eight of one MsgId between two rounds of 200 ms; the rest is dropped."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.diagnosis.loss_verdict import loss_verdict, lost_at, published
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.accounting.losses import Loss
    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.verdict import Verdict

ID = "sbn_peer_pipe"
_FULL = 0.3


def judge(case: Case) -> Iterator[Verdict]:
    """Name the MsgId, and the rate that gets through, as measured where it can be."""
    for loss in case.losses:
        if loss.kind in {"limit", "overflow"} and loss.hop.startswith("SBN"):
            yield _verdict(case, loss)


def _verdict(case: Case, loss: Loss) -> Verdict:
    limit, period = case.profile.sbn_msg_limit, case.profile.sbn_wake_ns
    rounds = loss.comb
    evidence = list(loss.evidence)
    if rounds and rounds.share >= _FULL and abs(rounds.period_ns - period) < period // 5:
        limit, period = rounds.most, rounds.period_ns
        evidence.append(f"at most {limit} came in one round, every {period / 1e6:.1f} ms")
    rate = limit * SECOND / period
    return loss_verdict(
        case,
        ID,
        loss,
        f"{lost_at(case, loss)}: {published(loss)}{limit} of one MsgId may wait and SBN serves "
        f"the pipe every {period / 1e6:.0f} ms, so {rate:.0f}/s get through",
        link="sbn",
        evidence=evidence,
        remedy=f"publish at most {rate:.0f} Hz on this MsgId towards the peer",
    )
