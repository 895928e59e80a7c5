"""What all verdicts on a loss have in common: which messages, where, when, and how many of how many."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.diagnosis.accounting.losses import COUNTERS, TAIL_NS
from edoras_tools.diagnosis.evidence.instances import NOBODY
from edoras_tools.diagnosis.evidence.timeline.table import StateOwner
from edoras_tools.diagnosis.verdict import Advice, Severity, Verdict

if TYPE_CHECKING:
    from collections.abc import Iterable

    from edoras_tools.diagnosis.accounting.losses import Loss
    from edoras_tools.diagnosis.case import Case


def lost_at(case: Case, loss: Loss, noun: str = "messages") -> str:
    """Return the start of the sentence: ``12 of 60 messages on 0x0827 (/pose) lost at TO_LAB_TLM_PIPE``."""
    of = f" of {loss.of:,}" if loss.of else ""
    told = noun.removesuffix("s") if loss.lost == 1 and not of else noun
    return f"{loss.lost:,}{of} {told} on {case.name(loss.msg_id)} lost at {loss.hop}"


def published(loss: Loss) -> str:
    """Return ``published at 20/s, ``; nothing where the rate is not known."""
    return f"published at {loss.offered_hz:.0f}/s, " if loss.offered_hz else ""


def stood_still(case: Case, loss: Loss) -> str:
    """Return that a whole cFS stood still and what had waited came at once; empty where it did not."""
    systems = case.instances.systems
    system = systems[loss.instance] if loss.instance != NOBODY else 0
    for span in case.timeline.spans(StateOwner("cfs"), "stalled", system):
        if span.overlaps(loss.start_ns - TAIL_NS, loss.end_ns):
            times = f"from {case.at(span.start_lo)} to {case.at(span.end_hi)}"
            return f"{case.label(loss.instance)} stood still {times}, and what had waited came at once"
    return ""


def loss_verdict(
    case: Case,
    loss: Loss,
    reason: str,
    *,
    link: str | None,
    remedy: str | Advice,
    evidence: Iterable[str] | None = None,
) -> Verdict:
    """Return the verdict on a loss, an error.

    Args:
        link: label of the link that it concerns.
        remedy: what to change.
        evidence: what was seen, in place of the loss' own lines.
    """
    still = stood_still(case, loss) if loss.kind in COUNTERS else ""
    return Verdict(
        Severity.ERROR,
        f"{reason}. {still}" if still else reason,
        msg_id=loss.msg_id,
        link=link,
        hop=loss.hop,
        lost=loss.lost,
        of=loss.of,
        span=(loss.start_ns, loss.end_ns),
        evidence=(*(loss.evidence if evidence is None else evidence), *case.drops_text()),
        remedy=remedy.remedy if isinstance(remedy, Advice) else remedy,
        advice=remedy if isinstance(remedy, Advice) else None,
        confidence=loss.confidence,
        cause=loss.kind,
    )
