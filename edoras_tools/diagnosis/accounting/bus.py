"""Telemetry that is missing by its sequence counts, and where it was lost.

In: the streams that cFS publishes. Out: a ``Part`` for the gaps of each span, their claims on counters, and
once these are settled (``claims``), losses and the ends of what is not lost (``GapEnd``).

Rules:

1. A message that is missing from a sequence count was published between its neighbours, in cFE's time. It can
   have caused a count of 0x803 that was made meanwhile (``claims``).
2. It surely competes for counts if an event names its MsgId at that pipe, or the pipe was full (``pressed``).
3. Messages that are missing while their way out was closed (``closed``) were not sent, and are no loss,
   unless the pipe that nobody emptied lost them.
4. After the last message of a stream that was losing messages at a pipe, as many more can be lost as one
   round loses; if the source of the stream is captured, no more than went into it since.
5. A message that no count explains was lost behind cFS if the counters were watched, else at a place that the
   capture does not show. If SBN brought it to cFS, it may have been lost on that way.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

import msgspec
import numpy as np

from edoras_tools.cfs import queues
from edoras_tools.diagnosis.accounting.claims import FAR_NS, Claim, Rank, claimed_alike, settle
from edoras_tools.diagnosis.accounting.closed import (
    closed_at,
    containing,
    perhaps_removed,
    routes_cut,
    unexplained_silences,
)
from edoras_tools.diagnosis.accounting.losses import (
    BEHIND,
    COUNTER_NAMES,
    COUNTERS,
    LEAD_NS,
    TAIL_NS,
    Among,
    Loss,
    LossKind,
)
from edoras_tools.diagnosis.accounting.pipes import pressed
from edoras_tools.diagnosis.evidence.instances import NOBODY
from edoras_tools.diagnosis.evidence.timeline.table import Way, reason_text
from edoras_tools.diagnosis.matching.streams import Span, Stream, full_rounds
from edoras_tools.diagnosis.quality import overlapping
from edoras_tools.model import Finding
from edoras_tools.sessions.sequence import MODULUS
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire.arrays import Integers, Places, by_value, distinct

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.evidence.loss_reports import LossEvents, PipeKind
    from edoras_tools.diagnosis.matching.crossing import Hop
    from edoras_tools.diagnosis.verdict import Confidence

_SLACK_NS: Final = 50 * MILLISECOND
"""Error of the times of two packets of one cFS."""
_MOSTLY: Final = 0.9
_FEW_ROUNDS: Final = 3
"""This many rounds with losses show the most that a round loses."""
_AROUND: Final = 8
"""A stream with no gap within this many rows on either side is over no limit."""
_SOON: Final = 1.2
"""A stream goes on as before if the next message comes within this many of its longest steps."""
_STEADY: Final = 1.1
"""A steady rate varies by less than this factor."""
_LEAST_FRAGMENTED: Final = 6
"""If this many datagrams in a row never became whole, their fragments were dropped on the way."""
_FIRST_ONLY: Final = "the first fragments of {:,} of them came, and no later ones"


class Part(msgspec.Struct):
    """The messages missing from one span of a telemetry stream.

    Attributes:
        stream: the stream.
        span: span of time.
        owner: cFS instance whose pipe the stream comes out of.
        missing: number of missing messages.
        kinds: counters that surely compete for them (rule 2), the likelier first.
        assigned: counts that were assigned to them, by counter.
        shared: messages of them that may be among counts of several kinds of traffic.
        watched: whether the counters were captured most of the time, and show whose losses they counted.
        outside: messages missing before the first sample of the counters or after the last.
        closed: whether the way out was closed, so that they would not have been sent.
        silenced: whether Telemetry Output sent nothing at all until it was enabled.
        unexplained: whether nothing at all came, and the commands that would explain it are not captured.
        away: whether nothing could be captured then.
        cause: kind of loss, place and evidence, if a closed way out lost them; else None.
        among: the missing messages.
        evidence: lines that show the loss.
    """

    stream: Stream
    span: Span
    owner: int
    among: Among
    missing: int = 0
    kinds: tuple[PipeKind, ...] = ()
    assigned: Counter[PipeKind] = msgspec.field(default_factory=Counter)
    shared: int = 0
    watched: bool = False
    outside: int = 0
    closed: bool = False
    silenced: bool = False
    unexplained: bool = False
    away: bool = False
    cause: tuple[LossKind, str, str] | None = None
    evidence: list[str] = msgspec.field(default_factory=list)


GapEnd = Literal["closed", "proxied", "damaged", "undecided", "away", "uncertain", "astray", "shared"]
"""The fate of a missing message that is in no loss.

``closed``: published while the way out was closed, and not counted. ``proxied``: a proxy dropped it on
purpose. ``damaged``: it came with a wrong checksum. ``undecided``: cut frames hide which cFS it is of, or
nothing shows whether Telemetry Output was to send it. ``away``: missing while the capturing interface was
away. ``uncertain``: the capture may have missed it. ``astray``: it is captured here, and the next capture on
its way may have missed it. ``shared``: it may be among counts of several kinds of traffic."""


class _Gaps(NamedTuple):
    """The gaps of a stream, an element a gap.

    Attributes:
        of: stream that ``rows`` belong to: the stream itself, or the captured stream that it is made of.
        at: intp, row of the stream before the gap.
        rows: intp, rows of ``of``: the missing messages themselves, or the row before them.
        number: i64, number of missing messages.
        low_ns: i64, earliest time at which they can have been counted.
        high_ns: i64, latest such time.
    """

    of: Stream
    at: Places
    rows: Places
    number: Integers
    low_ns: Integers
    high_ns: Integers

    def take(self, rows: NDArray[Any]) -> _Gaps:
        """Return some of the gaps."""
        columns = self.at, self.rows, self.number, self.low_ns, self.high_ns
        return _Gaps(self.of, *(column[rows] for column in columns))

    def among(self, stream: Stream) -> Among:
        """Return the missing messages of a stream."""
        return Among(self.of, self.rows, self.number if self.of is stream else None)


class Telemetry:
    """Losses of telemetry by its sequence counts.

    Attributes:
        losses: losses.
        ends: stream to the fates of missing messages that are in no loss.
        silenced: streams, each with the number of messages that Telemetry Output took and did not send until
            it was enabled, and the messages that they are some of.
        in_part: MsgId to how many first fragments came if all else of it may have been left out by a filter.
        parts: missing messages by stream and span.
        claims: their claims on the loss counters; ``Claim.messages`` is the part.
    """

    def __init__(self, case: Case) -> None:
        self._case, self._counts = case, case.loss_counts
        self.in_part = Counter[int]()
        # A filter by port, as of tcpdump, leaves out all later fragments: they have none.
        whole = case.rows.has(Finding.FRAGMENT) & ~case.rows.streamed
        self._keeps = bool(whole.any()) or not all(item.head for item in case.capture.lacking)
        self.ends: defaultdict[Stream | None, Counter[GapEnd]] = defaultdict(Counter)
        self._silent_ways: dict[tuple[int, int], tuple[list[tuple[int, int]], ...]] = {}
        self.silenced: list[tuple[Stream, int, Among]] = []
        self.losses: list[Loss] = []
        self.parts: list[Part] = []
        self.claims: list[Claim] = []
        self._lose_types()
        for stream in case.streams:
            if not stream.link.only_to_cfs:
                self._claim(stream)
                # Damaged packets before the first good one or after the last lie in no gap.
                times, when = stream.time_ns, case.damaged[stream].time_ns
                outside = (when < times[0]) | (when > times[-1]) | (not stream.counted)
                self.ends[stream]["damaged"] += int(outside.sum())
        # A proxy may have dropped some before a stream's first message or after its last.
        for faults in self._case.proxied.values():
            if streams := [stream for stream in self._case.streams if self._case.faults_on(stream) is faults]:
                in_gaps = sum(self.ends[stream]["proxied"] for stream in streams)
                self.ends[streams[0]]["proxied"] += len(faults.dropped) - in_gaps

    def passed(self, stream: Stream) -> Integers:
        """Return how many messages were sent to the receiver between each row and the next, i64 (rows,).

        The next message and those missing before it count; not those that cFS published for others while this
        SBN peer was away. Where the capture lacks what the peer sent, nothing shows that it was away.
        """
        counts = stream.missing + 1
        for part in self.parts:
            away = not part.unexplained and (part.cause is None or part.cause[0] != "route")
            if part.stream is stream and part.closed and stream.link.peers and away:
                counts[part.span.first] = 1
        return counts

    def make_losses(self) -> None:
        """Turn the missing messages into losses, once the claims are settled.

        Messages that SBN brought from another cFS, on a way that is not captured, may also be among the
        counts of that other cFS.
        """
        missing = [claim for claim in self.claims if claim.rank in (Rank.PRESSED, Rank.MISSING)]
        handed_on = [claim for claim in missing if self._handed_on(claim.messages)]
        for claim in handed_on:
            claim.instances = (*claim.instances, claim.messages.stream.instance)
        settle(self._counts, missing if handed_on else (), FAR_NS)
        for claim in self.claims:
            part: Part = claim.messages
            for (at, kind), number in claim.by_kind().items():
                if at == part.owner:
                    part.assigned[kind] += number
            if claim.rank == Rank.POSSIBLE:  # behind the last message that came, where no gap shows it
                part.missing += claim.explained
            else:
                part.shared += claim.reserved
                part.watched &= not claim.doubtful
        for part in self.parts:
            if part.closed:
                self._make_closed_losses(part)
            else:
                self._make_open_losses(part)

    def _claim(self, stream: Stream) -> None:
        """Divide the missing messages of a stream into parts, and add their claims."""
        case = self._case
        hop = case.upstream.get(stream)
        gaps = self._missing(stream) if hop is None else self._not_handed_on(stream, hop)
        if hop is None and not (stream.counted and len(gaps.at)):
            return
        owner, times = case.owner(stream), stream.time_ns
        away = case.overlaps_outage(times[gaps.at], times[np.minimum(gaps.at + 1, len(stream) - 1)])
        for index in np.flatnonzero(away).tolist():
            # What the bus lost meanwhile is not captured either, and its counts are of no other message.
            part, own = self._closed_part(stream, owner, gaps, index)
            part.away = part.unexplained = True
            self._claim_closed(part, own, gaps)
        gaps = gaps.take(~away)
        closed = closed_at(case, stream, gaps.at)
        way = stream.sender, stream.receiver
        if hop is None and way not in self._silent_ways:
            self._silent_ways[way] = unexplained_silences(case, stream)
        unexplained_ns, shrunk_ns = self._silent_ways[way] if hop is None else ([], [])
        closed |= containing(stream, gaps.at, shrunk_ns)
        silences = case.silences_of(stream.sender) if stream.link.only_from_cfs else ()
        silenced = containing(stream, gaps.at, silences) & ~closed
        taken_off = perhaps_removed(case, stream, gaps.number) if hop is None else np.zeros_like(closed)
        if owner in self._counts:
            taken_off &= self._counts[owner].between(gaps.low_ns, gaps.high_ns) < gaps.number
        unexplained = (containing(stream, gaps.at, unexplained_ns) | taken_off) & ~(closed | silenced)
        closed |= silenced | unexplained
        for index in np.flatnonzero(closed).tolist():
            part, own = self._closed_part(stream, owner, gaps, index)
            part.silenced, part.unexplained = bool(silenced[index]), bool(unexplained[index])
            self._claim_closed(part, own, gaps.take(~closed))
        gaps, spans = gaps.take(~closed), stream.spans
        which = np.searchsorted([item.first for item in spans], gaps.at, "right") - 1
        for index in np.unique(which).tolist():
            own = gaps.take(which == index)
            part = Part(stream, spans[index], owner, own.among(stream), int(own.number.sum()))
            behind = np.zeros(len(stream), np.int64)
            np.add.at(behind, own.at, own.number)
            part.kinds = self._kinds(part, behind, via=hop is not None)
            self.parts.append(part)
            if owner in self._counts:
                self._claim_open(part, own)
        if len(gaps.at) and owner in self._counts:
            self._tail(self.parts[-1])

    def _closed_part(self, stream: Stream, owner: int, gaps: _Gaps, index: int) -> tuple[Part, _Gaps]:
        """Return a part that is one gap while the way out was closed, and the gap."""
        own, times = gaps.take(np.array([index])), stream.time_ns
        first, number = int(own.at[0]), int(own.number[0])
        last = min(first + 1, len(stream) - 1)
        span = Span(first, last, int(times[first]), int(times[last]), 0, number)
        return Part(stream, span, owner, own.among(stream), number, closed=True), own

    def _missing(self, stream: Stream) -> _Gaps:
        """Return the gaps of a stream, with an empty one after its end if events name later losses."""
        case, missing = self._case, stream.missing - self._dropped(stream)
        missing -= self._never_whole(stream, missing)
        made_ns = case.instances.made_ns[stream.rows] if stream.instance != NOBODY else stream.time_ns
        events = (self._naming(stream, kind) for kind in COUNTERS)
        later = any(own.last_ns >= stream.time_ns[-1] for own in events if own)
        at = np.flatnonzero(np.append(missing[:-1], later))
        made_ns = np.append(made_ns, made_ns[-1])
        return _Gaps(stream, at, at, missing[at], made_ns[at] - _SLACK_NS, made_ns[at + 1] + _SLACK_NS)

    def _not_handed_on(self, stream: Stream, hop: Hop) -> _Gaps:
        """Return the messages of the stream behind this one that did not go out, as gaps.

        Losses further up are losses of that other link.
        """
        self._dropped(stream)
        whose = np.full(len(hop.into), -1)
        for own in self._case.hops:
            if own.into is hop.into and own.out.sender == stream.sender:
                whose[own.in_rows] = own is hop
        came, absent = np.flatnonzero(whose >= 0), np.flatnonzero(hop.known & (whose < 0))
        # If wrong times split one stream into several, the next message that came out shows whose gap it is.
        absent = absent[whose[np.append(came, came[-1:])[np.searchsorted(came, absent)]] == 1]
        out, due = stream.time_ns, hop.into.time_ns[absent]
        # A message that came just before the last one to go out may have waited for the next round.
        inside = (due >= out[0]) & (due <= out[-1] - self._case.profile.sbn_wake_ns)
        absent, due = absent[inside], due[inside]
        at = np.maximum(np.searchsorted(out, due, "right") - 1, 0)
        return _Gaps(hop.into, at, absent, np.ones(len(due), np.int64), due - LEAD_NS, due + LEAD_NS)

    def _claim_open(self, part: Part, gaps: _Gaps) -> None:
        """Add the claims of messages missing from a span of a stream whose way out was open."""
        counts, low, high = self._counts[part.owner], gaps.low_ns, gaps.high_ns
        part.outside = int(gaps.number[(low <= counts.times[0]) | (high > counts.times[-1])].sum())
        part.watched = 2 * part.outside <= part.missing
        round_s = queues.telemetry_pipe(self._case.profile).round_ns / SECOND
        # At most every second round had a message: that is over no limit of its MsgId.
        rare = part.stream.link.only_from_cfs and 2 * part.span.offered_hz * round_s < _STEADY
        others = ("overflow",) if rare else (*COUNTERS,)[::-1]
        if part.kinds:
            # All that was in a peer's pipe is captured: if it was not full, it overflowed nothing.
            others = ("limit",) if part.stream.link.peers else (*COUNTERS,)[::-1]
        kinds = tuple(dict.fromkeys((*part.kinds, *others)))
        rank, flow = Rank.PRESSED if part.kinds else Rank.MISSING, part.stream
        for members in claimed_alike([counts], low, high):
            span, number = (int(low[members[0]]), int(high[members[0]])), int(gaps.number[members].sum())
            self.claims.append(Claim(part, *span, number, kinds, (part.owner,), rank, flow))

    def _dropped(self, stream: Stream) -> Integers:
        """Return how many missing messages after each row a proxy or damage explains, i64 (rows,).

        They are counted in ``ends`` too.
        """
        numbers = np.zeros(len(stream), np.int64)
        dropped = self._case.faults_on(stream).counts(peers=stream.link.peers)
        damaged = self._case.damaged[stream].sequence_count.astype(np.int64).tolist()
        before = self._case.rows.sequence_count[stream.rows].astype(np.int64)
        both: tuple[tuple[GapEnd, list[int]], ...] = ("proxied", dropped), ("damaged", damaged)
        for ending, counts in both:
            for count in counts:
                # Sequence counts wrap, so several gaps may fit: the first one with room is taken.
                fits = (count - before - 1) % MODULUS < stream.missing
                at = np.flatnonzero(fits & (numbers < stream.missing))
                if len(at):
                    numbers[at[0]] += 1
                    self.ends[stream][ending] += 1
        return numbers

    def _claim_closed(self, part: Part, gap: _Gaps, gaps: _Gaps) -> None:
        """Add the claim of one gap while the way out was closed: a pipe that nobody empties loses messages.

        Args:
            part: the missing messages.
            gap: the gap.
            gaps: all gaps of the stream.
        """
        if not part.silenced and not part.unexplained:
            part.cause = self._cause(part)
        # What went into cFS and did not come out to a peer is told there.
        alone = part.cause is None and all(hop.out is not part.stream for hop in self._case.hops)
        if part.owner in self._counts and (part.stream.link.only_from_cfs or alone):
            rank = Rank.OWN_PACKETS if part.cause is None else Rank.CLOSED
            span, number = (int(gap.low_ns[0]), int(gap.high_ns[0])), self._countable(part, gaps)
            if part.away:
                rank, number = Rank.NOT_CAPTURED, part.missing
            of = part, *span, number, tuple(COUNTERS), (part.owner,), rank, part.stream
            self.claims.append(Claim(*of))
        self.parts.append(part)

    def _countable(self, part: Part, gaps: _Gaps) -> int:
        """Return how many messages of a closed part the bus can have counted at the pipe."""
        stream, span = part.stream, part.span
        before, behind = self._case.rows.source[stream.rows[[span.first, span.last]]]
        if before != behind:  # Telemetry Output did not read its pipe, and some waited in it
            waited = queues.telemetry_pipe(self._case.profile).limit(stream.msg_id)
            full = self._grown(part, COUNTERS["overflow"])
            return part.missing if full else max(0, part.missing - waited)
        # Removed from TO's table and added again: it lost messages at its limit if it did so around that,
        # too.
        near = np.abs(gaps.at - span.first) <= _AROUND
        return part.missing if near.any() else 0

    def _cause(self, part: Part) -> tuple[LossKind, str, str] | None:
        """Return why the way out of mission data was closed; None if a command removed it from TO's table."""
        case, stream, span = self._case, part.stream, part.span
        for cut in routes_cut(case, stream):
            if cut.overlaps(span.start_ns, span.end_ns):
                return "route", case.pipe_of(stream), cut.change.witness
        followed = stream in case.upstream or any(hop.out is stream for hop in case.hops)
        own = stream.link.only_from_cfs and not stream.is_housekeeping
        alone = not followed if stream.link.peers else own
        way = Way(stream.msg_id, stream.link, case.system(stream))
        for stop in case.timeline.blocking(way, span.start_ns, span.end_ns) if alone else ():
            owner, state = stop.change.subject, stop.change.state
            # After a restart Telemetry Output is silent until it is enabled: that is told by itself.
            if owner.kind == "app" and (stream.link.peers or state == "stopped"):
                return "stopped", owner.name, reason_text(stop, case.at)
        return None

    def _make_closed_losses(self, part: Part) -> None:
        """Turn a closed part into losses: all of it if the closing lost it, else those that were counted."""
        if part.away:
            self.ends[part.stream]["away"] += part.missing
            return
        pipe = self._case.pipe_of(part.stream)
        texts = {
            kind: f"0x803: {COUNTER_NAMES[kind]} +{number:,} while nobody emptied {pipe}"
            for kind, number in part.assigned.items()
        }
        if part.cause is not None:
            kind_, hop, text = part.cause
            part.evidence = [text, *texts.values()]
            at_pipe = part.assigned if kind_ == "route" else Counter()  # these had reached the pipe
            for kind, number in at_pipe.items():
                self._lose(part, kind, number, part.missing, "high")
            if rest := part.missing - at_pipe.total():
                self._lose(part, kind_, rest, part.missing, "high").hop = hop
            return
        idle = "its way out was closed then: it would not have come out in any case"
        for kind, number in part.assigned.items():
            part.evidence = [texts[kind], idle]
            self._lose(part, kind, number, part.missing, "medium")
        rest = part.missing - part.assigned.total()
        if part.silenced:
            self.silenced.append((part.stream, rest, part.among))
        else:
            self.ends[part.stream]["undecided" if part.unexplained else "closed"] += rest

    def _kinds(self, part: Part, gaps: Integers, *, via: bool) -> tuple[PipeKind, ...]:
        """Return the counters that surely compete for a part's messages (rule 2); adds to its evidence."""
        case, stream, span = self._case, part.stream, part.span
        came = f"{part.missing:,} of {span.count + part.missing:,}"
        text = f"{came} that came in did not go out" if via else f"sequence count: {came} never came"
        part.evidence += [text] if part.missing else []
        window = span.start_ns - LEAD_NS, span.end_ns + TAIL_NS
        kinds: list[tuple[int, PipeKind]] = []
        queue = case.queue_of(stream)
        rounds, limit = case.rounds(stream, span), case.commanded_limit(stream) or queue.limit(stream.msg_id)
        larger = rounds.most > limit and rounds.share < _MOSTLY
        grown = {kind: self._growth(part, kind) > 0 for kind in COUNTERS}
        for kind in COUNTERS:
            events = self._naming(stream, kind)
            is_named = bool(events and events.within(*window))
            if events and is_named:
                part.evidence.append(events.text(events.within(*window)))
            # A full pipe proves nothing if its counter did not grow.
            if is_named or (grown[kind] and pressed(case, stream, span, kind, gaps, full=grown["overflow"])):
                # Rounds larger than the limit make a full pipe likelier, if most are not alike.
                kinds.append((2 * (not is_named) + (larger and kind == "limit"), kind))
        may = not (kinds or via) and (grown["limit"] or part.owner not in self._counts)
        if may and (least := full_rounds(stream.time_ns[span.rows], gaps[span.rows], queue.round_ns)):
            part.evidence.append(f"they are missing behind full rounds alone, of {least} or more")
            kinds += [(1, kind) for kind in COUNTERS if kind == "limit" or grown[kind]]
        return tuple(kind for _, kind in sorted(kinds, key=lambda item: item[0]))

    def _naming(self, stream: Stream, kind: PipeKind) -> LossEvents | None:
        """Return the events that name a MsgId at Telemetry Output's pipe, or at a peer's."""
        output = stream.link.only_from_cfs
        about = self._case.events_about(self._case.owner(stream), stream.msg_id, kind)
        return next((events for item, events in about if (item.at_output if output else item.at_peer)), None)

    def _tail(self, part: Part) -> None:
        """Add a claim for messages that may be lost after the last one of a stream (rule 4)."""
        case, stream, of = self._case, part.stream, (part.owner,)
        if not (part.kinds and self._ends(part) and case.rows.on(lambda link: link.to_cfs).any()):
            return  # without the commands, the counts may be theirs
        # One round more may be lost, as many as one loses.
        gaps = stream.missing[:-1][part.span.rows]
        most = int(gaps.max(initial=0))
        if (gaps > 0).sum() < _FEW_ROUNDS:
            most = max(most, int(0.7 * part.span.offered_hz + 2))
        for hop in case.hops:
            if hop.out is stream and hop.matched > _MOSTLY * len(stream):
                # The stream is made of another one: no more are lost than went in after the last to come out.
                went_in = hop.into.time_ns
                most = min(most, int((hop.absent & (went_in > went_in[hop.arrived].max())).sum()))
        if most > 0:
            made_ns = int(case.instances.made_ns[stream.rows[-1]])
            # All of them were published by then if they went on at the same rate.
            until_ns = made_ns + LEAD_NS + int(most * SECOND / max(part.span.offered_hz, 1))
            self.claims.append(Claim(part, made_ns, until_ns, most, part.kinds, of, Rank.POSSIBLE, stream))

    def _ends(self, part: Part) -> bool:
        """Return whether a stream ends with a part, or one complete round after it."""
        times, span = part.stream.time_ns, part.span
        if span.last == len(times) - 1:
            return True
        steps, next_ns = np.diff(times[span.rows]), times[span.last + 1]
        soon = next_ns - times[span.last] <= _SOON * steps.max(initial=0)
        return bool(soon and times[-1] - next_ns < self._case.profile.to_wake_ns)

    def _make_open_losses(self, part: Part) -> None:
        """Turn an open part into losses, by where its messages were lost."""
        rest = part.missing - part.assigned.total() - part.shared
        self.ends[part.stream]["shared"] += part.shared
        likeliest = max(part.assigned, key=lambda kind: part.assigned[kind], default=None)
        more = max(0, min(rest, part.outside)) if part.kinds and likeliest is not None else 0
        if likeliest is not None:  # outside the samples: a pipe that was full before and after was full then
            part.assigned[likeliest] += more
        rest -= more
        of = part.span.count + part.missing
        grown = [self._grown(part, name) for name in COUNTERS.values()]
        part.evidence.append(
            "0x803: MsgLimit +{:,}, PipeOverflow +{:,} in this time".format(*grown)
            if part.owner in self._counts
            else "0x803 of this cFS is not in the capture, so its counters cannot tell where"
        )
        for cause, number in part.assigned.items():
            if number:
                self._lose(part, cause, number, of, "high").uncounted = more * (cause == likeliest)
        hop = self._case.upstream.get(part.stream)
        if rest <= 0 or (hop is not None and hop.is_copy):  # a copy of a command may be lost before the bus
            return
        is_counted = part.owner in self._counts
        if part.kinds and not is_counted:
            self._lose(part, part.kinds[0], rest, of, "high").uncounted = rest
        elif not is_counted and self._cut(part.stream):
            # What is missing at Telemetry Output may be the same messages.
            at_output = (item for item in self._case.streams if item.link.only_from_cfs)
            also = sum(int(item.missing.sum()) for item in at_output if item.msg_id == part.stream.msg_id)
            ends, twice = self.ends[part.stream], min(rest, also * part.stream.link.peers)
            ends["uncertain"] += twice
            ends["undecided"] += rest - twice
        else:
            self._unexplained(part, rest, of, grown=any(grown))

    def _unexplained(self, part: Part, number: int, of: int, *, grown: bool) -> None:
        """Make a loss of messages that no counter explains: behind cFS if nothing else can have lost them."""
        why = next(self._doubts(part), "") if part.watched else ""
        behind = part.watched and not why
        if behind and grown:
            why = (
                f"these counts seem to be of other losses: {self._case.pipe_of(part.stream)} was not "
                "so full of this MsgId, and no event names it"
            )
        part.evidence += [why] if why else []
        self._lose(part, "after" if behind else "unknown", number, of, "medium" if behind else "low")

    def _handed_on(self, part: Part) -> bool:
        """Return whether SBN brought the messages to the sending cFS on a way that is not captured."""
        handed_on = part.stream.link.only_from_cfs and part.stream.instance != part.owner
        return handed_on and part.stream not in self._case.upstream

    def _doubts(self, part: Part) -> Iterator[str]:
        """Yield reasons why missing messages may not have been lost behind cFS."""
        case, stream = self._case, part.stream
        if case.peers_unseen:
            yield "what several cFS send each other over SBN is not in the capture: it may be lost there"
        if stream.link.peers and not case.network.crossing(stream.sender, stream.receiver):
            yield "too little that its peer sent is here to tell whether it was connected"
        if self._handed_on(part):
            whom = "a cFS" if stream.instance == NOBODY else case.label(stream.instance)
            yield f"it came from {whom} over SBN, which is not captured: some may be lost at that pipe"

    def _lose_types(self) -> None:
        """Make losses of messages that lost their later fragments, if none of their MsgId ever came whole."""
        case, ends = self._case, self._case.endpoints
        streams = case.streams if case.incomplete_ns else ()
        whole = {(ends[at], x.msg_id) for x in streams for at in distinct(case.rows.source[x.rows])}
        for (sender, msg_id), every in case.incomplete_ns.items():
            times = np.sort(every)
            times = times if len(times) >= _LEAST_FRAGMENTED else self._dropped_of(times)
            if (sender, msg_id) not in whole and not self._keeps:
                self.in_part[msg_id] += len(every)
            elif (sender, msg_id) not in whole and (number := len(times)):
                start_ns, end_ns = np.maximum(times[[0, -1]], case.rows.time_ns[0]).tolist()
                loss = Loss("fragments", BEHIND, number, start_ns, end_ns, "high", msg_id=msg_id, of=number)
                loss.evidence = [_FIRST_ONLY.format(number)]
                self.losses.append(loss)

    def _dropped_of(self, times: Integers) -> Integers:
        """Return which of some times of first fragments, i64, lie where no later fragments came."""
        return times[overlapping(times - 1, times + 1, self._fragmented)] if self._keeps else times

    def _never_whole(self, stream: Stream, missing: Integers) -> Integers:
        """Make losses of the missing messages that lost their later fragments on the way: cFS sent them.

        Args:
            missing: missing messages after each row, i64 (rows,).

        Returns:
            How many of them these are, i64 (rows,).
        """
        every = self._dropped_of(np.sort(np.array(self._beginnings(stream), np.int64)))
        at = np.searchsorted(stream.time_ns, every) - 1
        # Those before the first row or after the last lie in no gap.
        room = np.append(missing[:-1], len(every))
        numbers = np.minimum(np.bincount(at[at >= 0], minlength=len(stream)), room)
        self.ends[stream]["uncertain"] += 0 if self._keeps else int(numbers.sum() + (at < 0).sum())
        for span in stream.spans if self._keeps else ():
            rows = np.flatnonzero(numbers[span.rows]) + span.first
            own = every[(np.maximum(at, 0) >= span.first) & (at <= span.last)]
            early = int((at < 0).sum()) if span.first == 0 else 0
            if number := int(numbers[rows].sum()) + early:
                among = Among(stream, rows if len(rows) else np.array([0]), numbers[rows])
                part = Part(stream, span, self._case.owner(stream), among)
                part.evidence.append(_FIRST_ONLY.format(number))
                of = span.count + max(number, int(missing[span.rows].sum()))
                loss = self._lose(part, "fragments", number, of, "high")
                loss.start_ns, loss.end_ns = np.maximum(own[[0, -1]], self._case.rows.time_ns[0]).tolist()
                loss.among = None if early else among
        return np.minimum(numbers, missing)

    def _beginnings(self, stream: Stream) -> list[int]:
        case = self._case
        if not case.incomplete_ns:
            return []
        senders = np.unique(case.rows.source[stream.rows]).tolist()
        keys = ((case.endpoints[place], stream.msg_id) for place in senders)
        return [when for key in keys for when in case.incomplete_ns.get(key, ())]

    @cached_property
    def _fragmented(self) -> list[tuple[int, int]]:
        """Intervals without later fragments: those that the capture missed lie between whole datagrams."""
        none = np.zeros(0, np.int64)
        cut = [stream.time_ns for stream in self._case.streams if self._beginnings(stream)]
        whole_ns = np.sort(np.concatenate([none, *cut]))
        starts = np.sort(np.concatenate([none, *self._case.incomplete_ns.values()]))
        groups = [starts[own] for _, own in by_value(np.searchsorted(whole_ns, starts))]
        return [(int(own[0]), int(own[-1])) for own in groups if len(own) >= _LEAST_FRAGMENTED]

    def _cut(self, stream: Stream) -> bool:
        """Return whether packets lack their time stamps, which the capture cut off: two cFS look like one."""
        rows = self._case.rows
        same = (rows.link == stream.link.code) & (rows.msg_id == stream.msg_id)
        bare = (rows.mission_time_ns[same] <= 0).any()
        timed = rows.on(lambda link: link.from_cfs and link.packets)
        return bool(bare and (rows.has(Finding.CAPTURE_CUT) & timed).any())

    def _grown(self, part: Part, name: str) -> int:
        track, end_ns = self._case.tracks.get(part.owner), max(part.span.end_ns, part.among.times_ns[1])
        return track.growth(name, part.span.start_ns - LEAD_NS, end_ns + TAIL_NS) if track else 0

    def _growth(self, part: Part, kind: PipeKind) -> int:
        """Return how far a counter grew in a part, with its first value if the part begins before that."""
        counts, more = self._counts.get(part.owner), self._grown(part, COUNTERS[kind])
        return more + counts.first[kind] if counts and part.span.start_ns < counts.times[0] else more

    def _lose(self, part: Part, kind: LossKind, number: int, of: int, confidence: Confidence) -> Loss:
        """Add a loss of messages of a part, and return it."""
        stream, span = part.stream, part.span
        hop = self._case.pipe_of(stream) if kind in COUNTERS else BEHIND
        # A loss at a pipe is of the whole span, because its rate is the cause; another is where its gaps are.
        times = part.among.times_ns
        if kind in COUNTERS and times[0] < span.end_ns:
            times = span.start_ns, span.end_ns
        loss = Loss(kind, hop, number, *times, confidence, part.owner, stream.msg_id, stream, span, of)
        loss.evidence, loss.closed, loss.among = list(part.evidence), part.closed, part.among
        self.losses.append(loss)
        return loss
