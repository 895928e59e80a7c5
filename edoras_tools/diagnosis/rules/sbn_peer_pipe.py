"""The pipe of an SBN peer takes eight of one MsgId between two rounds of 200 ms; the rest is dropped."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.sessions.profile import SECOND

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.losses import Loss

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
    offered = f"published at {loss.offered_hz:.0f}/s, " if loss.offered_hz else ""
    of = f" of {loss.of:,}" if loss.of else ""
    return Verdict(
        ID,
        Severity.ERROR,
        f"{loss.lost:,}{of} messages on {case.name(loss.msg_id)} lost at {loss.hop}: {offered}{limit} of "
        f"one MsgId may wait and SBN serves the pipe every {period / 1e6:.0f} ms, so {rate:.0f}/s get "
        "through",
        msg_id=loss.msg_id,
        topic=case.topic(loss.msg_id),
        link="sbn",
        hop=loss.hop,
        lost=loss.lost,
        of=loss.of,
        start_ns=loss.start_ns,
        end_ns=loss.end_ns,
        evidence=(*evidence, *case.drops_text()),
        remedy=f"publish at most {rate:.0f} Hz on this MsgId towards the peer",
        confidence=loss.confidence,
    )
