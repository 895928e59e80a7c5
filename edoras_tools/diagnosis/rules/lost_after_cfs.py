"""Counts are missing while the software bus lost nothing: it happened between cFS and the capture."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.diagnosis.verdict import Severity, Verdict

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "lost_after_cfs"


def judge(case: Case) -> Iterator[Verdict]:
    """Say that the counters clear cFS."""
    for loss in case.losses:
        if loss.kind != "after" or loss.stream is None:
            continue
        yield Verdict(
            ID,
            Severity.ERROR,
            f"{loss.lost:,} of {loss.of:,} messages on {case.name(loss.msg_id)} are missing, and the "
            "software bus lost none: they were lost between cFS and the capture, or by the capture",
            msg_id=loss.msg_id,
            topic=case.topic(loss.msg_id),
            link=loss.stream.link.label,
            hop=loss.hop,
            lost=loss.lost,
            of=loss.of,
            start_ns=loss.start_ns,
            end_ns=loss.end_ns,
            evidence=(*loss.evidence, *case.drops_text()),
            remedy="capture on the cFS host itself: what is there and not here, the network lost",
            confidence="low" if case.capture.drops else loss.confidence,
        )
