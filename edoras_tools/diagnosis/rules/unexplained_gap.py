"""Counts are missing, and nothing in the capture tells where they were lost."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.diagnosis.accounting.budget import limit
from edoras_tools.diagnosis.accounting.closed import one_sided
from edoras_tools.diagnosis.verdict import Severity, Verdict

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.matching.streams import Stream

ID = "unexplained_gap"


def judge(case: Case) -> Iterator[Verdict]:
    """Say which capture would tell."""
    for loss in case.losses:
        if loss.kind != "unknown" or loss.stream is None:
            continue
        clean, pipe, why = limit(loss.stream.link, loss.msg_id, case.profile, to_cfs=False)
        offered = loss.offered_hz
        evidence = list(loss.evidence)
        if offered > clean:
            evidence.append(
                f"published at {offered:.0f}/s; {why}: {clean:g}/s, so {pipe} is the likely place"
            )
        yield Verdict(
            ID,
            Severity.ERROR,
            f"{loss.lost:,} of {loss.of:,} messages on {case.name(loss.msg_id)} are missing behind the "
            "point where they were counted; where is not observable from here",
            msg_id=loss.msg_id,
            topic=case.topic(loss.msg_id),
            link=loss.stream.link.label,
            hop=pipe if offered > clean else None,
            lost=loss.lost,
            of=loss.of,
            start_ns=loss.start_ns,
            end_ns=loss.end_ns,
            evidence=(*evidence, *case.drops_text()),
            remedy="capture Telemetry Output's link with 0x803 and 0x808 in TO's table: its counters and "
            "events tell",
            confidence="low",
        )
    for stream in case.streams:
        if untold := case.telemetry.untold.get(id(stream), 0):
            yield Verdict(
                ID,
                Severity.WARNING,
                f"{untold:,} counts of {case.name(stream.msg_id)} are not accounted for: "
                f"{_why(case, stream)}",
                msg_id=stream.msg_id,
                topic=case.topic(stream.msg_id),
                link=stream.link.label,
                of=len(stream) + untold,
                start_ns=int(case.rows.time_ns[stream.rows[0]]),
                end_ns=int(case.rows.time_ns[stream.rows[-1]]),
                evidence=case.drops_text(),
                remedy=_remedy(case, stream),
                confidence="low",
            )


def _why(case: Case, stream: Stream) -> str:
    if not one_sided(case.known, stream):
        return (
            "the capture cut off when packets were made, so nothing tells whether they were lost, not sent, "
            "or are another cFS's"
        )
    if stream.link.peers:
        return (
            "SBN sent that peer no message at all then, and nothing that the peer sends is in the capture, "
            "so nothing tells whether they were lost or it was not connected"
        )
    return (
        "Telemetry Output sent nothing at all then, and no command to cFS is in the capture, so nothing "
        "tells whether they were lost or it was told not to send"
    )


def _remedy(case: Case, stream: Stream) -> str:
    if not one_sided(case.known, stream):
        return "capture whole frames, without -s or with -s 0"
    return "capture what the peer sends, too" if stream.link.peers else "capture what is sent to CI, too"
