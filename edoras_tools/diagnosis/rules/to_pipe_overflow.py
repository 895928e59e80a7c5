"""Telemetry Output's own pipe overflowed: it loses whatever comes last, the events about it included."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.model import NO_ROUTE
from edoras_tools.sessions import telemetry_output
from edoras_tools.wire import cfe
from edoras_tools.wire.names import MSG_ID_NAMES

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.losses import Loss

ID = "to_pipe_overflow"


def judge(case: Case) -> Iterator[Verdict]:
    """Name the MsgId that fills the pipe, and what else went down with it."""
    routes, others = _divided(case)
    for loss in routes:
        yield _verdict(case, loss, [item for item in others if _together(item, loss)])


def aside(case: Case) -> int:
    """Return how many messages went down with those that verdicts are of."""
    return sum(item.lost for item in _divided(case)[1])


def _divided(case: Case) -> tuple[list[Loss], list[Loss]]:
    """Return the losses that have a verdict each, and the rest."""
    full = [item for item in case.losses if item.kind == "overflow" and item.hop == telemetry_output.PIPE]
    routes = [item for item in full if _is_route(item)]
    if not routes and full:
        routes = [max(full, key=lambda item: item.lost)]
    return routes, [item for item in full if item not in routes]


def _is_route(loss: Loss) -> bool:
    configured = loss.stream is not None and loss.stream.route != NO_ROUTE
    return configured or loss.msg_id not in MSG_ID_NAMES


def _together(loss: Loss, other: Loss) -> bool:
    return loss.instance == other.instance and loss.start_ns <= other.end_ns and other.start_ns <= loss.end_ns


def _verdict(case: Case, loss: Loss, beside: Sequence[Loss]) -> Verdict:
    profile = case.profile
    offered = f"published at {loss.offered_hz:.0f}/s, " if loss.offered_hz else ""
    of = f" of {loss.of:,}" if loss.of else ""
    room = profile.to_pipe_depth * 1e9 / profile.to_wake_ns
    reason = (
        f"{loss.lost:,}{of} messages on {case.name(loss.msg_id)} lost at {loss.hop}: {offered}and TO's pipe "
        f"of {profile.to_pipe_depth} is emptied every {profile.to_wake_ns // 1_000_000} ms: {room:.0f}/s of "
        "all telemetry together"
    )
    evidence = list(loss.evidence)
    if beside:
        listed = ", ".join(f"{case.name(item.msg_id)} {item.lost:,}" for item in beside)
        evidence.append(f"lost with it: {listed}")
    if any(item.msg_id == cfe.EVENT_MSG_ID for item in beside):
        evidence.append("events are among the lost: that none names the pipe proves nothing")
    return Verdict(
        ID,
        Severity.ERROR,
        reason,
        msg_id=loss.msg_id,
        topic=case.topic(loss.msg_id),
        link="to",
        hop=loss.hop,
        lost=loss.lost,
        of=loss.of,
        start_ns=loss.start_ns,
        end_ns=loss.end_ns,
        evidence=(*evidence, *case.drops_text()),
        remedy=f"publish less: {room:.0f}/s of everything, housekeeping included; a lower limit of this "
        "MsgId in TO's table keeps the others safe; or make TO's pipe deeper or its delay shorter",
        confidence=loss.confidence,
    )
