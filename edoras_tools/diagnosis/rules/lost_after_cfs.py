"""Counts are missing while the software bus lost nothing: it happened between cFS and the capture."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.cfs.names import MSG_ID_NAMES
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.model import NO_ROUTE

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.accounting.losses import Loss
    from edoras_tools.diagnosis.case import Case

ID = "lost_after_cfs"


def judge(case: Case) -> Iterator[Verdict]:
    """Say that the counters clear cFS: a verdict a topic, and one for all housekeeping of a sender."""
    after = [loss for loss in case.losses if loss.kind == "after" and loss.stream is not None]
    groups: dict[tuple[object, ...], list[Loss]] = {}
    for loss in after:
        assert loss.stream is not None
        known = loss.msg_id in MSG_ID_NAMES and loss.stream.route == NO_ROUTE
        key = (loss.stream.sender, loss.stream.link) if known else (id(loss),)
        groups.setdefault(key, []).append(loss)
    for members in groups.values():
        yield _verdict(case, members)


def _verdict(case: Case, members: list[Loss]) -> Verdict:
    first = members[0]
    assert first.stream is not None
    lost, of = (sum(getattr(loss, name) or 0 for loss in members) for name in ("lost", "of"))
    names = list(dict.fromkeys(case.name(loss.msg_id) for loss in members))
    one = len(names) == 1
    evidence = (
        list(first.evidence) if one else [f"{case.name(loss.msg_id)}: {loss.lost:,}" for loss in members]
    )
    if not one:
        # What the counters say of each is the same; of how many counts, each has its own.
        evidence += [line for line in first.evidence[1:] if all(line in loss.evidence for loss in members)]
    return Verdict(
        ID,
        Severity.ERROR,
        f"{lost:,} of {of:,} messages on {names[0] if one else f'{len(names)} MsgIds'} are missing, and the "
        "software bus lost none of them: they were lost between cFS and the capture, or by the capture",
        msg_id=first.msg_id if one else None,
        topic=case.topic(first.msg_id) if one else None,
        link=first.stream.link.label,
        hop=first.hop,
        lost=lost,
        of=of,
        start_ns=min(loss.start_ns for loss in members),
        end_ns=max(loss.end_ns for loss in members),
        evidence=(*evidence, *case.drops_text()),
        remedy="capture on the cFS host itself: what is there and not here, the network lost",
        confidence="low" if case.capture.drops else first.confidence,
    )
