"""Loss at applications' pipes: the counters say how many, the events which, the traffic of how many."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.diagnosis.events import STOPS_AFTER
from edoras_tools.diagnosis.instances import NOBODY
from edoras_tools.diagnosis.losses import COUNTERS, EVENTS, LEAD_NS, TAIL_NS, Loss, attributed, remainders
from edoras_tools.diagnosis.spans import spans
from edoras_tools.model import NO_MSG_ID, NO_ROUTE, Link
from edoras_tools.sessions import telemetry_output
from edoras_tools.sessions.profile import SECOND
from edoras_tools.wire import names

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from edoras_tools.diagnosis.counters import Track
    from edoras_tools.diagnosis.events import Culprit, Said
    from edoras_tools.diagnosis.losses import Known, PipeKind
    from edoras_tools.diagnosis.spans import Span
    from edoras_tools.diagnosis.streams import Stream
    from edoras_tools.diagnosis.verdict import Confidence

_NAMES: Final = {"limit": "MsgLimit", "overflow": "PipeOverflow"}
_APART_S: Final = 1.5
"""What is lost within so many seconds may be in the gaps and not yet in the counter, or the other way."""


def app_losses(known: Known, telemetry: Sequence[Loss]) -> list[Loss]:
    """Return every loss at a pipe that no gap shows.

    Args:
        known: what is known.
        telemetry: the losses that gaps show, whose share of the counters is taken.
    """
    seen = {(loss.instance, loss.msg_id, loss.kind) for loss in telemetry}
    found: list[Loss] = []
    for culprit, said in known.culprits.items():
        if not culprit.at_pipe:
            continue
        if (culprit.instance, culprit.msg_id, culprit.kind) in seen and (
            culprit.at_output or culprit.at_peer
        ):
            continue
        rivals = [
            (other, told)
            for other, told in known.culprits.items()
            if (other.instance, other.kind) == (culprit.instance, culprit.kind)
            and not (
                (other.instance, other.msg_id, other.kind) in seen and (other.at_output or other.at_peer)
            )
        ]
        found += _named(known, telemetry, culprit, said, rivals)
    found += _unnamed(known, [*telemetry, *found])
    return found


def _named(
    known: Known,
    telemetry: Sequence[Loss],
    culprit: Culprit,
    said: Said,
    rivals: Sequence[tuple[Culprit, Said]],
) -> Iterator[Loss]:
    """Count what events name, a span of its traffic at a time."""
    kind = _pipe_kind(culprit)
    counter, track = COUNTERS[kind], known.tracks.get(culprit.instance)
    stream = _input(known, culprit)
    share = _share(known, culprit, said, rivals)
    parts: list[Span | None] = list(spans(stream, known.rows)) if stream else [None]
    reached, until_ns = 0, None
    for index, span in enumerate(parts):
        if span is None:
            # Its traffic is not in the capture: whatever the counter counts from the first event on is its.
            start_ns, end_ns = said.first_ns, said.last_ns
            if track and track.growth(counter, end_ns + LEAD_NS):
                end_ns = track.times[-1]
            window = start_ns - TAIL_NS, end_ns + TAIL_NS
        else:
            start_ns, end_ns = span.start_ns, span.end_ns
            after = parts[index + 1] if index + 1 < len(parts) else None
            limit = after.start_ns if after else end_ns + TAIL_NS
            window = start_ns - LEAD_NS, min(end_ns + TAIL_NS, max(limit, end_ns))
        events = said.within(*window)
        evidence = [f"event CFE_SB {EVENTS[kind]} x{events}: {said.records[0].message}"] if events else []
        stopped = _stopped(track, kind, said, window)
        if track is None:
            if events:
                text = "0x803 is not in the capture: the events are counted, and they stop after 16"
                yield _loss(culprit, stream, span, events, start_ns, end_ns, [*evidence, text], "low")
            continue
        # The windows of neighbours overlap, for the counter is seen once a second: each count is told once.
        total = track.growth(counter, None, window[1])
        grown = total - max(total - track.growth(counter, *window), reached)
        begin_ns = window[0] if until_ns is None else max(window[0], min(until_ns, window[1]))
        left = grown - attributed(telemetry, culprit.instance, kind, begin_ns, window[1])
        lost = left if len(rivals) == 1 else round(left * share)
        reached, until_ns = max(total, reached), window[1]
        if span and lost > span.count:
            # More than there were: the rest is the next one's.
            reached -= lost - span.count
            lost = span.count
        if lost <= 0:
            continue
        evidence.append(f"0x803: {_NAMES[kind]} +{grown:,} in this time")
        if left < grown:
            evidence.append(f"{grown - left:,} of these are telemetry, which leaves gaps of its own")
        if len(rivals) > 1:
            others = ", ".join(
                f"0x{other.msg_id:04x} at {other.pipe}" for other, _ in rivals if other != culprit
            )
            evidence.append(f"events name {others} too: shared out by rates, or by events")
        if stopped:
            evidence.append(f"cFS stops this event after {STOPS_AFTER}, here {stopped}; the counter goes on")
        sure: Confidence = "high" if len(rivals) == 1 and (stream or lost <= events) else "medium"
        yield _loss(culprit, stream, span, lost, start_ns, end_ns, evidence, sure)


def _share(
    known: Known,
    culprit: Culprit,
    said: Said,
    rivals: Sequence[tuple[Culprit, Said]],
) -> float:
    """Return a culprit's share: by how far each is over what its pipe takes, where all can be seen."""
    over = {}
    for other, _ in rivals:
        stream = _input(known, other)
        seconds = _seconds(known, stream) if stream else 0.0
        if stream and seconds:
            burst = known.profile.app_msg_limit * SECOND / known.profile.ci_wake_ns
            over[other] = max(0.0, len(stream) / seconds - burst)
    if len(over) == len(rivals) and all(over.values()):
        return over[culprit] / sum(over.values())
    return said.count / sum(told.count for _, told in rivals)


def _seconds(known: Known, stream: Stream) -> float:
    times = known.rows.time_ns[stream.rows]
    return float(times[-1] - times[0]) / SECOND


def _loss(
    culprit: Culprit,
    stream: Stream | None,
    span: Span | None,
    lost: int,
    start_ns: int,
    end_ns: int,
    evidence: list[str],
    confidence: Confidence,
) -> Loss:
    return Loss(
        kind=_pipe_kind(culprit),
        instance=culprit.instance,
        hop=culprit.pipe,
        msg_id=culprit.msg_id,
        stream=stream,
        span=span,
        lost=lost,
        of=span.count if span else None,
        start_ns=start_ns,
        end_ns=end_ns,
        confidence=confidence,
        evidence=evidence,
        sender=culprit.sender,
    )


def _stopped(track: Track | None, kind: PipeKind, said: Said, window: tuple[int, int]) -> str:
    """Return when the events fell silent while their counter went on; empty where they did not."""
    if track is None or track.growth(COUNTERS[kind], said.last_ns + LEAD_NS, window[1]) < 1:
        return ""
    first = track.times[0]
    return (
        f"{(said.last_ns - first) / SECOND:.0f} s after the first 0x803" if said.last_ns > first else "before"
    )


def _pipe_kind(culprit: Culprit) -> PipeKind:
    return "limit" if culprit.kind == "limit" else "overflow"


def _input(known: Known, culprit: Culprit) -> Stream | None:
    """Return the traffic that a culprit's messages came from, if the capture has it."""
    wanted = Link.SBN if culprit.sender.startswith("SBN") else Link.CI
    return next(
        (
            stream
            for stream in known.streams
            if stream.msg_id == culprit.msg_id
            and stream.link is wanted
            and (stream.link is Link.CI or _goes_to(known, stream, culprit.instance))
        ),
        None,
    )


def _goes_to(known: Known, stream: Stream, instance: int) -> bool:
    if instance == NOBODY:
        return True
    name = known.instances.items[instance].name
    return not name or known.network.identity_of.get(stream.receiver, name) == name


def _unnamed(known: Known, losses: Sequence[Loss]) -> list[Loss]:
    """Find what counters count and no event names: by which traffic is more than a pipe takes."""
    found = []
    for instance, kind, left, total in remainders(known, losses):
        suspects = list(_suspects(known, instance, kind))
        track = known.tracks[instance]
        if left <= total // 20:
            # So little may be the gaps' own error, unless commands that make none are too many.
            suspects = [suspect for suspect in suspects if suspect[0].link is Link.CI]
            seconds = (track.times[-1] - track.times[0]) / SECOND
            if not suspects or left * seconds <= total * _APART_S:
                continue
        evidence = [
            f"0x803: {_NAMES[kind]} +{total:,} in the capture, {left:,} of them not explained otherwise"
        ]
        excess = [most - limit for _, _, most, limit in suspects]
        for (stream, hop, most, limit), over in zip(suspects, excess, strict=True):
            share = round(left * over / sum(excess))
            text = f"up to {most} of 0x{stream.msg_id:04x} came in one round, and {limit} may wait"
            times = known.rows.time_ns[stream.rows]
            times = times[(times >= track.times[0] - TAIL_NS) & (times <= track.times[-1])]
            start_ns, end_ns = (
                (int(times[0]), int(times[-1])) if len(times) else (track.times[0], track.times[-1])
            )
            why = [text, "no event names it: suppressed, filtered, or lost itself"]
            if len(suspects) > 1:
                why.append("others are suspect too: shared out by how far each is over its limit")
            found.append(
                Loss(
                    kind=kind,
                    instance=instance,
                    hop=hop,
                    msg_id=stream.msg_id,
                    stream=stream,
                    span=None,
                    lost=share,
                    of=len(times) if len(times) >= share else None,
                    start_ns=start_ns,
                    end_ns=end_ns,
                    confidence="medium" if len(suspects) == 1 else "low",
                    evidence=[*evidence, *why],
                )
            )
        if not suspects:
            found.append(
                Loss(
                    kind="unknown",
                    instance=instance,
                    hop="",
                    msg_id=NO_MSG_ID,
                    stream=None,
                    span=None,
                    lost=left,
                    of=None,
                    start_ns=track.times[0],
                    end_ns=track.times[-1],
                    confidence="low",
                    evidence=evidence,
                )
            )
    return found


def _suspects(known: Known, instance: int, kind: PipeKind) -> Iterator[tuple[Stream, str, int, int]]:
    """Yield traffic into an instance that is more than a pipe takes: where, how many at once, of how many."""
    if kind != "limit":
        return
    profile = known.profile
    leaving = {stream.msg_id for stream in known.streams if stream.link is Link.TO}
    for stream in known.streams:
        if stream.msg_id in names.MSG_ID_NAMES and stream.route == NO_ROUTE:
            continue
        if stream.link is Link.CI:
            most = _most_within(known, stream, profile.ci_wake_ns)
            if most > profile.app_msg_limit:
                yield stream, "application pipe", most, profile.app_msg_limit
        elif stream.link is Link.SBN and stream.msg_id in leaving and _goes_to(known, stream, instance):
            most = _most_within(known, stream, profile.to_wake_ns)
            limit = profile.to_limits.get(stream.msg_id, profile.to_default_limit)
            if most > limit and known.owner(stream) != instance:
                yield stream, telemetry_output.PIPE, most, limit


def _most_within(known: Known, stream: Stream, period_ns: int) -> int:
    """Return the most messages of a stream that lie within a period of time."""
    times = known.rows.time_ns[stream.rows]
    ends = np.searchsorted(times, times + period_ns)
    return int((ends - np.arange(len(times))).max())
