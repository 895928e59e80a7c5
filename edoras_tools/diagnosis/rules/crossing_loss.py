"""Messages went into cFS on one link and never came out on the other, and no counter says why."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.diagnosis.verdict import Severity, Verdict

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.matching import Hop

ID = "crossing_loss"


def judge(case: Case) -> Iterator[Verdict]:
    """Count what no other loss explains."""
    for hop in case.hops:
        if not hop.rewritten and hop.out.counted:
            continue
        missing = len(hop.missing) - explained(case, hop)
        if missing <= max(1, hop.of // 200):
            continue
        into, out = case.name(hop.into.msg_id), case.name(hop.out.msg_id)
        visible = bool(case.tracks)
        evidence = [
            (
                f"{hop.of:,} went in as {into} on {hop.into.link.label.upper()}, {hop.matched:,} came out "
                f"as {out} on {hop.out.link.label.upper()} with the same values"
            ),
        ]
        if hop.superseded:
            evidence.append(f"{hop.superseded:,} more gave way to a newer one, and are not counted here")
        evidence.append(
            "the counters of 0x803 explain no more than that"
            if visible
            else "0x803 is not in the capture, so the software bus cannot be cleared or blamed"
        )
        yield Verdict(
            ID,
            Severity.ERROR,
            f"{missing:,} of {hop.of:,} messages that went into cFS on {into} never came out on {out}",
            msg_id=hop.into.msg_id,
            topic=case.topic(hop.into.msg_id),
            link=hop.into.link.label,
            hop="cFS application",
            lost=missing,
            of=hop.of,
            start_ns=int(hop.missing[0]),
            end_ns=int(hop.missing[-1]),
            evidence=(*evidence, *case.drops_text()),
            remedy="look at the application's own counters and console: it received them and did not pass "
            "them on, or its task was not there",
            confidence="medium" if visible else "low",
        )


def explained(case: Case, hop: Hop) -> int:
    """Return how many of a hop's messages other losses explain: at the way in, and at the way out."""
    total = 0
    for loss in case.losses:
        going_in = loss.stream is hop.into and loss.kind in {"limit", "overflow"} and loss.hop != ""
        coming_out = loss.stream is hop.out and hop.rewritten
        if going_in or coming_out:
            total += loss.lost
    return total
