"""What is lost at the pipes of the software bus."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.cfs import command_ingest, queues, telemetry_output
from edoras_tools.cfs.names import MSG_ID_NAMES
from edoras_tools.diagnosis.accounting.pipes import measured_depth
from edoras_tools.diagnosis.advice import (
    advise,
    clean_round,
    crowding_of,
    limit_command,
    loss_verdict,
    lost_at,
    published,
    stood_still,
)
from edoras_tools.diagnosis.verdict import Verdict, error
from edoras_tools.links.sbn import SBN
from edoras_tools.model import NO_ROUTE
from edoras_tools.wire import cfe
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from edoras_tools.diagnosis.accounting.losses import Loss
    from edoras_tools.diagnosis.case import Case


def app_pipe_limit(case: Case) -> Iterator[Verdict]:
    """Too many of one MsgId waited in an application's pipe: the software bus dropped the rest.

    Name the MsgId, the pipe and the rate that would be clean.
    """
    for loss in case.losses:
        at_app = loss.hop != telemetry_output.PIPE and not loss.hop.startswith("SBN")
        if loss.kind == "limit" and at_app and not loss.rivals:
            yield _over_app_limit(case, loss)


def _over_app_limit(case: Case, loss: Loss) -> Verdict:
    profile = case.profile
    over_network = loss.sender.startswith("SBN") or (loss.stream is not None and loss.stream.link is SBN)
    pipe = queues.application_pipe(profile, over_network=over_network)
    who, period, limit = "SBN" if over_network else "CI", pipe.round_ns, pipe.usual_limit
    clean = pipe.rate_hz(limit)
    least = "at least " if loss.instance not in case.tracks else ""
    if loss.sender and not loss.sender.startswith((*command_ingest.NAMES, "SBN")):
        return loss_verdict(
            case,
            loss,
            f"{least}{lost_at(case, loss)}: {loss.sender} sent more than may wait, or nobody read the pipe",
            link=None,
            remedy="see whether the application that reads this pipe runs",
        )
    every = f"{period // 1_000_000} ms"
    measured = not over_network and {"ci_wake_ns", "app_msg_limit"} <= case.constants.learned
    reason = (
        f"{least}{lost_at(case, loss, 'commands')}: more than {limit} of one MsgId waiting while {who} "
        f"delivers in {every} bursts ({'measured' if measured else 'assumed'})"
    )
    still = stood_still(case, loss)
    evidence = list(loss.evidence)
    if crowd := crowding_of(case, loss):
        reason += f". {crowd[0].upper()}{crowd[1:]}"
    if loss.span is not None and loss.stream is not None and loss.span.rate_hz:
        times = case.captured(loss.stream)[loss.span.first : loss.span.last + 1]
        most = int((np.searchsorted(times, times + period) - np.arange(len(times))).max())
        sent = f"sent at {loss.span.rate_hz:.1f} Hz"
        if loss.span.rate_hz > clean and times[-1] - times[0] > period:
            evidence.append(
                f"{sent}; up to {clean:g} Hz get through ({'measured' if measured else 'assumed'})"
            )
        elif most > limit:
            evidence.append(f"up to {most:,} were sent within {every}; {limit} are clean")
        elif still:
            evidence.append(f"{sent}, at most {most} within {every}, which is clean while cFS runs")
        else:
            evidence.append(
                f"{sent}, at most {most} within {every}, which is clean where the pipe is read at once: "
                f"{who} or the application came to it later than that"
            )
    return loss_verdict(
        case, loss, reason, link="sbn" if over_network else "ci", evidence=evidence, remedy=advise(case, loss)
    )


def app_pipe_overflow(case: Case) -> Iterator[Verdict]:
    """An application's pipe was full: its task does not keep up with all that it subscribes to.

    Name the MsgId and the pipe.
    """
    for loss in case.losses:
        elsewhere = loss.hop == telemetry_output.PIPE or loss.hop.startswith("SBN")
        if loss.kind != "overflow" or elsewhere or loss.rivals:
            continue
        yield loss_verdict(
            case,
            loss,
            f"{lost_at(case, loss)}: the pipe was full",
            link=loss.stream.link.label if loss.stream else None,
            remedy="send less of everything that this pipe takes, make it deeper (CFE_SB_CreatePipe), or "
            "have its task run more often",
        )


def to_message_limit(case: Case) -> Iterator[Verdict]:
    """Telemetry Output's table lets so many of a MsgId wait between two of its rounds; the rest is dropped.

    Name the MsgId, and the rate that gets through, as measured where it can be.
    """
    for loss in case.losses:
        if loss.kind == "limit" and loss.hop == telemetry_output.PIPE and not loss.closed:
            yield _over_output_limit(case, loss)


def _over_output_limit(case: Case, loss: Loss) -> Verdict:
    queue, limit, measured = clean_round(case, loss)
    period, rate = queue.round_ns, queue.rate_hz(limit)
    reason = (
        f"{lost_at(case, loss)}: {published(loss)}{limit} of this MsgId may wait{_set_by(case, loss)} and "
        f"TO sends every {period / 1e6:.0f} ms, so {rate:.1f}/s get through"
        f"{'' if 'to_wake_ns' in case.constants.learned else ' (assumed)'}"
    )
    evidence = list(loss.evidence)
    if measured:
        evidence.append(
            f"at most {limit} came in one round, every {period / 1e6:.1f} ms: {rate:.1f} Hz is clean"
        )
    return loss_verdict(case, loss, reason, link="to", evidence=evidence, remedy=advise(case, loss))


def _set_by(case: Case, loss: Loss) -> str:
    command = limit_command(case, loss)
    return f" (set by a command at {case.at(command.not_before_ns)})" if command else ""


def to_pipe_overflow(case: Case) -> Iterator[Verdict]:
    """Telemetry Output's own pipe overflowed: it loses whatever comes last, the events about it included.

    Name the MsgId that fills the pipe, and what else went down with it.
    """
    routes, others = _divided(case)
    for loss in routes:
        yield _output_overflow(case, loss, [item for item in others if _together(item, loss)])
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
    return error(
        f"{plural(lost.total(), 'message')} of cFS itself lost at {telemetry_output.PIPE}, of "
        f"{plural(len(lost), 'MsgId')}: a pipe that is full takes nothing, whoever filled it",
        ", ".join(f"{case.name(msg_id)} {number:,}" for msg_id, number in lost.items()),
        link="to",
        hop=telemetry_output.PIPE,
        lost=lost.total(),
        span=(min(item.start_ns for item in others), max(item.end_ns for item in others)),
        remedy="as for the MsgId that fills it",
        confidence=min((item.confidence for item in others), key=("low", "medium", "high").index),
        cause="overflow",
    )


def _output_overflow(case: Case, loss: Loss, beside: Sequence[Loss]) -> Verdict:
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
        loss,
        reason,
        link="to",
        evidence=evidence,
        remedy=f"publish less: {room:.0f}/s of everything, housekeeping included; a lower limit of this "
        "MsgId in TO's table keeps the others safe; or make TO's pipe deeper or its delay shorter",
    )


def sbn_peer_pipe(case: Case) -> Iterator[Verdict]:
    """The pipe of an SBN peer takes eight of one MsgId between two rounds of 200 ms; the rest is dropped.

    Name the MsgId, and the rate that gets through, as measured where it can be.
    """
    for loss in case.losses:
        if loss.kind in {"limit", "overflow"} and loss.hop.startswith("SBN"):
            yield _over_peer_limit(case, loss)


def _over_peer_limit(case: Case, loss: Loss) -> Verdict:
    pipe, limit, measured = clean_round(case, loss)
    period, rate = pipe.round_ns, pipe.rate_hz(limit)
    evidence = list(loss.evidence)
    if measured:
        evidence.append(f"at most {limit} came in one round, every {period / 1e6:.1f} ms")
    return loss_verdict(
        case,
        loss,
        f"{lost_at(case, loss)}: {published(loss)}{limit} of one MsgId may wait and SBN serves "
        f"the pipe every {period / 1e6:.0f} ms, so {rate:.0f}/s get through",
        link="sbn",
        evidence=evidence,
        remedy=advise(case, loss),
    )
