"""Loss, and where it happened: gaps, counters and events put together.

Telemetry is counted when it is published, so what is lost behind that leaves a gap: at Telemetry Output's
pipe, at an SBN peer's pipe, or on the way to the capture. The counters of 0x803 tell which. Commands are
never counted; for them the counters say how many, and the events say which.
"""

from __future__ import annotations

from collections.abc import Mapping  # noqa: TC003  COUNTERS is annotated with it
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from edoras_tools.diagnosis.instances import NOBODY
from edoras_tools.diagnosis.spans import Comb, Span, comb, spans
from edoras_tools.model import Link
from edoras_tools.sessions import telemetry_output
from edoras_tools.sessions.profile import MILLISECOND, SECOND

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.counters import Track
    from edoras_tools.diagnosis.events import Culprit, Said
    from edoras_tools.diagnosis.instances import Instances
    from edoras_tools.diagnosis.matching import Hop
    from edoras_tools.diagnosis.peers import Network
    from edoras_tools.diagnosis.streams import Stream
    from edoras_tools.diagnosis.table import Rows
    from edoras_tools.diagnosis.verdict import Confidence
    from edoras_tools.sessions.profile import SimProfile

PipeKind = Literal["limit", "overflow"]
Kind = PipeKind | Literal["after", "unknown"]

LEAD_NS: Final = 700 * MILLISECOND
"""A loss may be counted so long before the next message of the stream is seen."""
TAIL_NS: Final = 2500 * MILLISECOND
"""Housekeeping that tells of it comes within a second, and Telemetry Output holds it for half of one."""
_FULL: Final = 0.3
"""Rounds of which so many are full show how many may wait."""
_OVER: Final = 1.02
COUNTERS: Final[Mapping[PipeKind, str]] = {"limit": "msg_limits", "overflow": "pipe_overflows"}
"""The counter of 0x803 that a loss at a pipe raises."""
EVENTS: Final[Mapping[PipeKind, int]] = {"limit": 17, "overflow": 25}
"""The event of CFE_SB that names it."""


@dataclass(slots=True)
class Loss:
    """Messages of one route that were lost in one span of time.

    Attributes:
        kind: over a limit, out of a full pipe, after cFS, or unknown.
        instance: the cFS that lost them.
        hop: where.
        msg_id: which.
        stream: where they were seen, or missed; None where they are not in the capture.
        span: when; None for all of the capture.
        lost: how many.
        of: of how many sent; None where unknown.
        start_ns: when it began.
        end_ns: when it ended.
        confidence: how sure that is.
        evidence: what was seen.
        comb: the rounds in which the stream arrives.
        sender: application that sent them, as an event names it.
        grown: by how much the counter of this kind of loss grew meanwhile, whoever's losses it counts.
    """

    kind: Kind
    instance: int
    hop: str
    msg_id: int
    stream: Stream | None
    span: Span | None
    lost: int
    of: int | None
    start_ns: int
    end_ns: int
    confidence: Confidence
    evidence: list[str] = field(default_factory=list)
    comb: Comb | None = None
    sender: str = ""
    grown: int = 0

    @property
    def time(self) -> tuple[int, int]:
        """When it began and ended."""
        return self.start_ns, self.end_ns

    def overlaps(self, other: Loss) -> bool:
        """Tell whether another loss is of the same kind, on the same cFS, at the same time."""
        same = (self.instance, self.kind) == (other.instance, other.kind)
        return same and self.start_ns <= other.end_ns and other.start_ns <= self.end_ns

    @property
    def offered_hz(self) -> float:
        """Messages sent a second, those that were lost included; 0 where that is not known."""
        seconds = (self.end_ns - self.start_ns) / SECOND
        return (self.of - 1) / seconds if self.of and seconds > 0 else 0.0


@dataclass(frozen=True, slots=True)
class Known:
    """What losses are told from."""

    rows: Rows
    streams: Sequence[Stream]
    instances: Instances
    tracks: Mapping[int, Track]
    culprits: Mapping[Culprit, Said]
    network: Network
    upstream: Mapping[int, Hop]
    """id of a stream to the hop by which its packets came unchanged."""
    profile: SimProfile

    def owner(self, stream: Stream) -> int:
        """Return the instance whose pipe a telemetry stream comes out of."""
        start_ns = int(self.rows.time_ns[stream.rows[0]])
        if stream.link is Link.TO:
            return self.instances.owner(stream.sender, start_ns)
        if stream.instance != NOBODY:
            return stream.instance
        return self.instances.named(self.network.identity_of.get(stream.sender, ""), start_ns)

    def label(self, instance: int) -> str:
        """Return how people are told of an instance."""
        return "a cFS" if instance == NOBODY else self.instances.items[instance].label

    def times(self, stream: Stream) -> NDArray[np.int64]:
        """Return when a stream's MsgId comes out of its pipe, whoever made it: they share what may wait."""
        times = np.concatenate(
            [
                self.rows.time_ns[item.rows]
                for item in self.streams
                if (item.link, item.sender, item.receiver, item.msg_id)
                == (stream.link, stream.sender, stream.receiver, stream.msg_id)
                or (item.link, item.sender, item.msg_id) == (Link.TO, stream.sender, stream.msg_id)
            ]
        )
        return np.sort(times)

    def rounds(self, stream: Stream, span: Span) -> Comb:
        """Return the rounds in which a stream's MsgId comes meanwhile."""
        times = self.times(stream)
        return comb(times[(times >= span.start_ns) & (times <= span.end_ns)])

    def hop(self, stream: Stream) -> str:
        """Return the name of the pipe that a telemetry stream comes out of."""
        if stream.link is Link.TO:
            return telemetry_output.PIPE
        spacecraft, _, processor = self.network.identity_of.get(stream.receiver, "").partition(":")
        return f"SBN_{processor}_{spacecraft}_Pipe" if processor else "SBN peer pipe"

    def named(self, instance: int, msg_id: int, kind: str, *, output: bool) -> Said | None:
        """Return the events that name a MsgId at Telemetry Output's pipe, or at a peer's."""
        for culprit, said in self.culprits.items():
            if (culprit.instance, culprit.msg_id, culprit.kind) == (instance, msg_id, kind) and (
                culprit.at_output if output else culprit.at_peer
            ):
                return said
        return None


def telemetry_losses(known: Known) -> list[Loss]:
    """Return every loss that leaves gaps on Telemetry Output's link or between SBN peers."""
    found = []
    for stream in known.streams:
        if stream.link is Link.CI:
            continue
        if id(stream) in known.upstream or (stream.counted and stream.missing.any()):
            parts = spans(stream, known.rows)
            for index, span in enumerate(parts):
                following = parts[index + 1].start_ns if index + 1 < len(parts) else None
                loss = _telemetry_loss(known, stream, span, following)
                if loss is not None:
                    found.append(loss)
    return _with_tails(known, found)


def _with_tails(known: Known, losses: list[Loss]) -> list[Loss]:
    """Add what was lost behind the last message that came: no gap shows it, only the counter does."""
    tails = [_tail(loss, losses) for loss in losses]
    # All together they are no more than was counted.
    left: dict[tuple[int, Kind], int] = {
        (instance, kind): track.growth(name)
        for instance, track in known.tracks.items()
        for kind, name in COUNTERS.items()
    }
    for loss in losses:
        key = loss.instance, loss.kind
        left[key] = left.get(key, 0) - loss.lost
    for loss, tail in sorted(zip(losses, tails, strict=True), key=lambda pair: -pair[0].lost):
        key = loss.instance, loss.kind
        added = max(0, min(tail, left[key]))
        left[key] -= added
        loss.lost += added
        loss.of = loss.of + added if loss.of is not None else None
    return losses


def _tail(loss: Loss, losses: Sequence[Loss]) -> int:
    """Return what a counter's growth about a loss leaves for what followed it."""
    if loss.span is None or loss.stream is None or not _ends(loss.stream, loss.span):
        return 0
    rest = [item for item in losses if item is not loss and item.overlaps(loss)]
    tail = loss.grown - attributed(rest, loss.instance, loss.kind, *loss.time) - loss.lost
    believed = 0 < tail <= 0.7 * loss.span.offered_hz + 2
    return tail if believed and loss.lost >= max((item.lost for item in rest), default=0) else 0


def _ends(stream: Stream, span: Span) -> bool:
    """Tell whether nothing follows a span at once, whose gap in front would show what was lost between."""
    return span.last == len(stream) - 1 or bool(stream.pauses[span.last])


def _telemetry_loss(known: Known, stream: Stream, span: Span, following: int | None) -> Loss | None:
    owner = known.owner(stream)
    track = known.tracks.get(owner)
    end_ns = span.end_ns + TAIL_NS
    if following is not None:
        end_ns = min(end_ns, max(following - LEAD_NS, span.end_ns))
    window = span.start_ns - LEAD_NS, end_ns
    grown: dict[Kind, int] = {
        kind: track.growth(name, *window) if track else 0 for kind, name in COUNTERS.items()
    }
    hop = known.upstream.get(id(stream))
    ended_ns, missing = span.end_ns, stream.missing
    if hop is not None:
        # What was lost further up is that link's loss: here counts what came in and did not go out.
        due = hop.missing + int(hop.latency.p50 * MILLISECOND if hop.latency else 0)
        until = following if following is not None else span.end_ns + 1
        due = due[(due >= span.start_ns) & (due < until)]
        lost = len(due)
        behind_row = np.searchsorted(known.rows.time_ns[stream.rows], due, "right") - 1
        missing = np.bincount(np.maximum(behind_row, 0), minlength=len(stream))
        came = f"the {hop.into.link.label.upper()} link"
        evidence = [f"{lost:,} of {span.count + lost:,} that came in on {came} did not go out"]
    else:
        paused = int(stream.missing[span.last]) if stream.pauses[span.last] else 0
        lost = span.missing - paused - _not_routed(known, stream, span)
        behind = _behind_pause(known, stream, span, track, paused) if paused else 0
        if behind:
            resumed = int(known.rows.time_ns[stream.rows[span.last + 1]])
            pace = span.seconds / max(1, span.count + span.missing - paused - 1)
            # A few fit between the last round and the end; many say that the loss went on.
            if behind * pace * SECOND > TAIL_NS:
                ended_ns = min(resumed, span.end_ns + round(behind * pace * SECOND))
        lost += behind
        # Late arrivals filled some gaps.
        lost -= min(lost, stream.reordered)
        evidence = [f"sequence count: {lost:,} of {span.count + lost:,} never came"]
    if lost <= 0:
        return None
    kind, confidence = _judge(known, stream, span, window, grown, missing, lost, evidence)
    return Loss(
        kind=kind,
        instance=owner,
        hop=known.hop(stream) if kind in COUNTERS else "between cFS and the capture",
        msg_id=stream.msg_id,
        stream=stream,
        span=span,
        lost=lost,
        of=span.count + lost,
        start_ns=span.start_ns,
        end_ns=ended_ns,
        confidence=confidence,
        evidence=evidence,
        comb=known.rounds(stream, span),
        grown=grown.get(kind, 0),
    )


def _not_routed(known: Known, stream: Stream, span: Span) -> int:
    """Return counts that went on while the way out was closed: the peer was gone, or the MsgId not wanted."""
    if stream.link is not Link.SBN:
        return 0
    connection = known.network.crossing(stream.sender, stream.receiver)
    closed = 0
    for at in stream.missing[span.first : span.last].nonzero()[0].tolist():
        row = span.first + at
        start, end = (int(known.rows.time_ns[stream.rows[item]]) for item in (row, row + 1))
        if (connection and connection.broken_within(start, end)) or known.network.unsubscribed_within(
            stream.msg_id, start, end
        ):
            closed += int(stream.missing[row])
    return closed


def _behind_pause(known: Known, stream: Stream, span: Span, track: Track | None, paused: int) -> int:
    """Return how many of the counts missing behind a pause were lost, not just never sent this way."""
    resumed = int(known.rows.time_ns[stream.rows[span.last + 1]])
    connection = known.network.crossing(stream.sender, stream.receiver) if stream.link is Link.SBN else None
    if track is None or (connection and connection.broken_within(span.end_ns, resumed)):
        return 0
    grown = max(track.growth(name, span.end_ns - LEAD_NS, resumed) for name in COUNTERS.values())
    return min(paused, grown)


def _judge(
    known: Known,
    stream: Stream,
    span: Span,
    window: tuple[int, int],
    grown: Mapping[Kind, int],
    missing: NDArray[np.int64],
    lost: int,
    evidence: list[str],
) -> tuple[Kind, Confidence]:
    """Tell by counters, events and what the pipe can take why messages are missing.

    A counter says that something was lost, not what: it counts for this stream only where an event names the
    stream, or where so much of it came that the pipe was full.
    """
    owner, output = known.owner(stream), stream.link is Link.TO
    track = known.tracks.get(owner)
    said: dict[PipeKind, bool] = {}
    for kind in COUNTERS:
        events = known.named(owner, stream.msg_id, kind, output=output)
        said[kind] = bool(events and events.within(*window))
        if events:
            evidence.append(f"event CFE_SB {EVENTS[kind]} x{events.count}: {events.records[0].message}")
    if track is None:
        named = [kind for kind in COUNTERS if said[kind]]
        if named:
            return named[0], "high"
        evidence.append("0x803 of this cFS is not in the capture, so its counters cannot tell where")
        return "unknown", "low"
    evidence.append(f"0x803: MsgLimit +{grown['limit']:,}, PipeOverflow +{grown['overflow']:,} in this time")
    possible = [
        kind
        for kind in COUNTERS
        if said[kind] or (grown[kind] and _pressed(known, stream, span, kind, missing))
    ]
    if not possible:
        if not any(grown.values()):
            covered = track.covers(span.start_ns, span.end_ns)
            return ("after", "medium") if covered else ("unknown", "low")
        evidence.append(
            f"what these count is others' loss: {known.hop(stream)} was never so full of this MsgId, and no "
            "event names it"
        )
        return _elsewhere(known, stream, owner, evidence) or ("after", "medium")
    kind = max(possible, key=lambda item: (grown[item], item == "overflow"))
    if said["limit"] and not said["overflow"] and grown["limit"]:
        kind = "limit"
    if grown[kind] < lost:
        elsewhere = _elsewhere(known, stream, owner, evidence)
        if elsewhere:
            return elsewhere
    if said[kind] or grown[kind] >= 0.5 * lost:
        return kind, "high"
    evidence.append("the counters explain only part of it")
    return "unknown", "low"


def _elsewhere(
    known: Known, stream: Stream, owner: int, evidence: list[str]
) -> tuple[Kind, Confidence] | None:
    """Say of what another cFS handed on that it may have been lost there; None where that is not so."""
    handed_on = stream.link is Link.TO and stream.instance != owner
    if not handed_on or id(stream) in known.upstream:
        return None
    evidence.append(
        f"it came over SBN from {known.label(stream.instance)}, and that link is not in the capture: its "
        "peer pipe may have lost some of these"
    )
    return "unknown", "low"


def _pressed(known: Known, stream: Stream, span: Span, kind: PipeKind, missing: NDArray[np.int64]) -> bool:
    """Tell whether so much came that a pipe can have lost what is missing from a span of a stream.

    Where a MsgId's limit or a whole pipe is full, what did get in comes out in one burst, and the loss lies
    beside it; or more of the MsgId is sent in a round, on the average, than the pipe takes.

    Args:
        known: what is known.
        stream: of what.
        span: when.
        kind: over the MsgId's limit, or out of a full pipe.
        missing: (rows of the stream,), what is missing behind each.
    """
    profile, output = known.profile, stream.link is Link.TO
    period = profile.to_wake_ns if output else profile.sbn_wake_ns
    own = known.rows.time_ns[stream.rows]
    at = np.arange(span.first, min(span.last + 1, len(own) - 1))
    at = at[missing[at] > 0]
    if kind == "overflow":
        sent = (known.rows.link == stream.link) & (known.rows.source == stream.sender)
        if not output:
            sent &= known.rows.destination == stream.receiver
        depth = profile.to_pipe_depth if output else profile.sbn_pipe_depth
        # Some of what fills the pipe may not be here: half of it tells.
        full = _full(known.rows.time_ns[sent], period, depth // 2)
        return _beside(full, own[at] - period, own[at + 1] + period, missing[at])
    limit = (
        profile.to_limits.get(stream.msg_id, profile.to_default_limit) if output else profile.sbn_msg_limit
    )
    rounds, clean = known.rounds(stream, span), limit
    if rounds.share >= _FULL and abs(rounds.period_ns - period) < period // 10:
        clean, limit = rounds.most, max(limit, rounds.most)
    # Others may share the MsgId: the round that was full need not have brought one of this stream's.
    if _beside(_full(known.times(stream), period, limit), own[at], own[at + 1], missing[at]):
        return True
    inside = own[span.first : span.last + 1]
    later = len(inside) - int(np.searchsorted(inside, inside[0] + period // 2))
    later += int(missing[span.first : span.last].sum())
    return later * period > _OVER * clean * (span.end_ns - span.start_ns) > 0


def _full(times: NDArray[np.int64], period: int, most: int) -> NDArray[np.int64]:
    """Return those of some times at which so many have come in one burst."""
    burst = np.arange(1, len(times) + 1) - np.searchsorted(times, times - period // 2)
    return times[burst >= most]


def _beside(
    times: NDArray[np.int64],
    starts: NDArray[np.int64],
    ends: NDArray[np.int64],
    missing: NDArray[np.int64],
) -> bool:
    """Tell whether most of what is missing is missing where one of some times lies."""
    there = np.searchsorted(times, ends) > np.searchsorted(times, starts)
    return int(missing[there].sum()) * 2 > int(missing.sum())


def attributed(losses: Sequence[Loss], instance: int, kind: str, start_ns: int, end_ns: int) -> int:
    """Return how much of a counter's growth in a span of time known losses explain."""
    total = 0.0
    for loss in losses:
        if loss.instance != instance or loss.kind != kind:
            continue
        low, high = max(loss.start_ns, start_ns), min(loss.end_ns, end_ns)
        length = loss.end_ns - loss.start_ns
        if high >= low:
            total += loss.lost * ((high - low) / length if length > 0 else 1.0)
    return round(total)


def remainders(known: Known, losses: Sequence[Loss]) -> Iterator[tuple[int, PipeKind, int, int]]:
    """Yield what counters say that no loss explains: instance, kind, how many, out of how many."""
    for instance, track in known.tracks.items():
        for kind, name in COUNTERS.items():
            total = track.growth(name)
            told = sum(loss.lost for loss in losses if loss.instance == instance and loss.kind == kind)
            left = total - told
            if left > 2:
                yield instance, kind, left, total
