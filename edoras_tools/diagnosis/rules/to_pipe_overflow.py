"""Telemetry Output's own pipe overflowed: it loses whatever comes last, the events about it included."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from edoras_tools.cfs import telemetry_output
from edoras_tools.cfs.names import MSG_ID_NAMES
from edoras_tools.diagnosis.accounting.pipes import measured_depth
from edoras_tools.diagnosis.loss_verdict import loss_verdict, lost_at, published
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.model import NO_ROUTE
from edoras_tools.wire import cfe
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from edoras_tools.diagnosis.accounting.losses import Loss
    from edoras_tools.diagnosis.case import Case

ID = "to_pipe_overflow"


def judge(case: Case) -> Iterator[Verdict]:
    """Name the MsgId that fills the pipe, and what else went down with it."""
    routes, others = _divided(case)
    for loss in routes:
        yield _verdict(case, loss, [item for item in others if _together(item, loss)])
    for instance in dict.fromkeys(item.instance for item in others):
        yield _with_them(case, [item for item in others if item.instance == instance])


def _divided(case: Case) -> tuple[list[Loss], list[Loss]]:
    """Return the losses that have a verdict each, and the rest."""
    full = [
        item
        for item in case.losses
        if item.kind == "overflow" and item.hop == telemetry_output.PIPE and not item.closed
    ]
    routes = [item for item in full if _is_route(item)]
    if not routes and full:
        routes = [max(full, key=lambda item: item.lost)]
    return routes, [item for item in full if item not in routes]


def _is_route(loss: Loss) -> bool:
    configured = loss.stream is not None and loss.stream.route != NO_ROUTE
    return configured or loss.msg_id not in MSG_ID_NAMES


def _together(loss: Loss, other: Loss) -> bool:
    return loss.instance == other.instance and loss.start_ns <= other.end_ns and other.start_ns <= loss.end_ns


def _with_them(case: Case, others: Sequence[Loss]) -> Verdict:
    """Return the verdict on what did not fill the pipe and was lost at it."""
    lost: Counter[int] = Counter()
    for item in others:
        lost[item.msg_id] += item.lost
    return Verdict(
        ID,
        Severity.ERROR,
        f"{plural(lost.total(), 'message')} of cFS itself lost at {telemetry_output.PIPE}, of "
        f"{plural(len(lost), 'MsgId')}: a pipe that is full takes nothing, whoever filled it",
        link="to",
        hop=telemetry_output.PIPE,
        lost=lost.total(),
        start_ns=min(item.start_ns for item in others),
        end_ns=max(item.end_ns for item in others),
        evidence=(", ".join(f"{case.name(msg_id)} {number:,}" for msg_id, number in lost.items()),),
        remedy="as for the MsgId that fills it",
        confidence=min((item.confidence for item in others), key=("low", "medium", "high").index),
    )


def _verdict(case: Case, loss: Loss, beside: Sequence[Loss]) -> Verdict:
    profile = case.profile
    depth, told = profile.to_pipe_depth, ""
    if loss.stream is not None:
        own = (case.rows.link == loss.stream.link) & (case.rows.source == loss.stream.sender)
        measured = measured_depth(case.rows.time_ns[own], profile.to_wake_ns)
        if measured < depth:
            depth = measured
            told = f"rounds of {measured} came often, and none was larger (is fs.mqueue.msg_max {measured}?)"
    room = depth * 1e9 / profile.to_wake_ns
    reason = (
        f"{lost_at(case, loss)}: {published(loss)}and TO's pipe of {depth} is "
        f"emptied every {profile.to_wake_ns // 1_000_000} ms: {room:.0f}/s of all telemetry together"
    )
    evidence = [*loss.evidence, *([told] if told else ())]
    if beside:
        listed = ", ".join(f"{case.name(item.msg_id)} {item.lost:,}" for item in beside)
        evidence.append(f"lost with it: {listed}")
    if any(item.msg_id == case.of_known(cfe.EVENT_MSG_ID) for item in beside):
        evidence.append("events are among the lost: that none names the pipe proves nothing")
    return loss_verdict(
        case,
        ID,
        loss,
        reason,
        link="to",
        evidence=evidence,
        remedy=f"publish less: {room:.0f}/s of everything, housekeeping included; a lower limit of this "
        "MsgId in TO's table keeps the others safe; or make TO's pipe deeper or its delay shorter",
    )
