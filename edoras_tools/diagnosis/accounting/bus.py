"""What the software bus counted in 0x803, told once: which messages each count is.

Rules:

1. A count belongs to the second between two samples of the counter, and to one message.
2. A message that is missing from a sequence count was published between its neighbours, in cFE's time. It can
   be one of the counts made meanwhile, where an event names its MsgId at that pipe, or the pipe was full.
3. Of commands whose way out can be seen, those that did not come out can be; of others, what events name, and
   then what was sent faster than a pipe takes.
4. All claims are settled together (``claims``), so that as many as possible are explained.
5. Behind the last message of a stream that lost some at a pipe, as many more can be lost as one round loses;
   where it is seen what the stream was made of, no more than went in since.
6. What nothing takes stays what it is: counted, and not known which.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

import msgspec
import numpy as np

from edoras_tools.cfs import executive_services, queues, sbn, telemetry_output
from edoras_tools.diagnosis.accounting.claims import FAR_NS, Claim, Rank, claimed_alike, settle
from edoras_tools.diagnosis.accounting.closed import (
    closed_at,
    enables_ns,
    perhaps_taken_off,
    routes_cut,
    silenced_at,
    unled_silences,
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
from edoras_tools.diagnosis.evidence.timeline.table import StateOwner, Way, reasons_for
from edoras_tools.diagnosis.matching.streams import Span, Stream, full_rounds
from edoras_tools.diagnosis.quality import overlapping
from edoras_tools.model import Finding
from edoras_tools.sessions.sequence import MODULUS
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire.arrays.order import Integers, Places, by_value

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.evidence.loss_reports import LossEvents, PipeKind
    from edoras_tools.diagnosis.matching.crossing import Hop
    from edoras_tools.diagnosis.verdict import Confidence

_SLACK_NS: Final = 50 * MILLISECOND
"""By so much the times of two packets of one cFS may be wrong."""
_MOSTLY: Final = 0.9
_FEW_ROUNDS: Final = 3
"""So many rounds show the most that one loses."""
_AROUND: Final = 8
"""A stream of which none of so many is missing on either side is over no limit."""
_SOON: Final = 1.2
"""What comes behind no more than so many of the longest usual steps goes on as before."""
_LEAST_FRAGMENTED: Final = 6
"""So many in a row that never became whole were dropped, and not missed by the capture."""


class Part(msgspec.Struct):
    """What is missing from one span of a telemetry stream.

    Attributes:
        stream: the stream.
        span: when.
        owner: the cFS whose pipe it comes out of.
        missing: how many.
        kinds: as what they may have been counted.
        taken: kind to how many were.
        shared: how many may be among what counters have of several together.
        watched: whether the counters were seen most of the time.
        outside: how many may be missing before the first count or behind the last.
        closed: whether the way out was closed: nobody would have sent them.
        silenced: whether Telemetry Output as a whole was silent until it was enabled.
        unled: whether it was silent as a whole, and what it was told is not in the capture.
        cause: why the way out was closed, where that lost them: kind of the loss, place, evidence.
        among: which they are.
    """

    stream: Stream
    span: Span
    owner: int
    among: Among
    missing: int = 0
    kinds: tuple[PipeKind, ...] = ()
    taken: Counter[PipeKind] = msgspec.field(default_factory=Counter)
    shared: int = 0
    watched: bool = False
    outside: int = 0
    closed: bool = False
    silenced: bool = False
    unled: bool = False
    cause: tuple[LossKind, str, str] | None = None
    evidence: list[str] = msgspec.field(default_factory=list)


GapEnd = Literal["closed", "proxied", "damaged", "untold", "away", "uncertain", "astray", "shared"]
"""How counts end that are missing and in no loss.

Those that were published while the way out was ``closed``, and are in no counter; that a proxy dropped on
purpose; ``damaged``: they came with a wrong checksum; ``untold``: cut frames do not tell whose they are, or
nothing tells whether Telemetry Output was to send them; that are missing while the capturing interface was
``away``; ``uncertain``: the capture itself may have missed them; ``astray``: they are here, and the next
capture on their way may have missed them; ``shared``: they may be among what counters have of several."""


class _Gaps(NamedTuple):
    """What is missing from a stream, an element each.

    Attributes:
        of: the stream that has ``rows``: it itself, or what went in where its packets came from.
        at: intp, the row of the stream that is before each.
        rows: intp, the messages that are missing, or what came before them, as indices into those of ``of``.
        number: i64, how many are missing there.
        low_ns: i64, from when on they can have been counted,
        high_ns: i64, and until when.
    """

    of: Stream
    at: Places
    rows: Places
    number: Integers
    low_ns: Integers
    high_ns: Integers

    def take(self, rows: NDArray[Any]) -> _Gaps:
        """Return some of them."""
        columns = self.at, self.rows, self.number, self.low_ns, self.high_ns
        return _Gaps(self.of, *(column[rows] for column in columns))

    def among(self, stream: Stream) -> Among:
        """Return the messages that they are, of a stream that lacks them."""
        return Among(self.of, self.rows, self.number if self.of is stream else None)


class Telemetry:
    """What is missing from sequence counts, held against the counters.

    Attributes:
        losses: what was lost.
        ends: id of a stream to counts that are missing, and how they ended, where that is in no loss.
        silenced: a stream, how many of it Telemetry Output took and did not send until it was enabled, and
            among which.
    """

    def __init__(self, case: Case) -> None:
        self._case, self._counts = case, case.loss_counts
        self.ends: defaultdict[int, Counter[GapEnd]] = defaultdict(Counter)
        self._unled: dict[tuple[int, int], tuple[list[tuple[int, int]], ...]] = {}
        self.silenced: list[tuple[Stream, int, Among]] = []
        self.losses: list[Loss] = []
        self.parts: list[Part] = []
        self.claims: list[Claim] = []
        for stream in case.streams:
            if not stream.link.only_to_cfs:
                self._claim(stream)
                # Before the first that came and behind the last no gap shows them.
                times, when = stream.time_ns, case.damaged_of(stream).time_ns
                outside = (when < times[0]) | (when > times[-1]) | (not stream.counted)
                self.ends[id(stream)]["damaged"] += int(outside.sum())
        self._dropped_unseen()

    def ended(self, stream: Stream, how: GapEnd) -> int:
        """Return how many counts of a stream are missing and ended so."""
        return self.ends[id(stream)][how]

    def passed(self, stream: Stream) -> Integers:
        """Return how many of a stream are behind each row and its next, of what was meant for its receiver.

        The next one is one of them, and its counts that are missing; not what cFS publishes for others while
        an SBN peer is away.
        """
        counts = stream.missing + 1
        for part in self.parts:
            routed = part.cause is None or part.cause[0] != "route"
            if part.stream is stream and part.closed and stream.link.peers and routed:
                counts[part.span.first] = 1
        return counts

    def tell(self) -> None:
        """Make losses of what is missing, once the claims have their counts.

        What a bus counted before SBN, which is not here, may be what lacks behind: that is told once.
        """
        missing = [claim for claim in self.claims if claim.rank in (Rank.PRESSED, Rank.MISSING)]
        handed_on = [claim for claim in missing if self._handed_on(self.parts[claim.key])]
        for claim in handed_on:
            claim.instances = (*claim.instances, self.parts[claim.key].stream.instance)
        settle(self._counts, missing if handed_on else (), FAR_NS)
        for claim in self.claims:
            part = self.parts[claim.key]
            for (at, kind), number in claim.by_kind().items():
                if at == part.owner:
                    part.taken[kind] += number
            if claim.rank == Rank.POSSIBLE:  # behind the last message that came, where no gap shows it
                part.missing += sum(claim.taken.values())
            else:
                part.shared += claim.reserved
        for part in self.parts:
            if part.closed:
                self._tell_closed(part)
            else:
                self._tell(part)

    def _claim(self, stream: Stream) -> None:
        """Divide what is missing from a stream by spans and seconds."""
        case = self._case
        hop = case.upstream(stream)
        gaps = self._missing(stream) if hop is None else self._not_handed_on(stream, hop)
        if hop is None and not (stream.counted and len(gaps.at)):
            return
        owner, times = case.owner(stream), stream.time_ns
        away = case.is_away(times[gaps.at], times[np.minimum(gaps.at + 1, len(stream) - 1)])
        self.ends[id(stream)]["away"] = int(gaps.number[away].sum())
        gaps = gaps.take(~away)
        closed = closed_at(case, stream, gaps.at)
        way = stream.sender, stream.receiver
        if hop is None and way not in self._unled:
            self._unled[way] = unled_silences(case, stream)
        unled_ns, retold_ns = self._unled[way] if hop is None else ([], [])
        closed |= silenced_at(stream, gaps.at, retold_ns)
        silences = case.silences_of(stream.sender) if stream.link.only_from_cfs else ()
        silenced = silenced_at(stream, gaps.at, silences) & ~closed
        taken_off = perhaps_taken_off(case, stream, gaps.number) if hop is None else np.zeros_like(closed)
        if owner in self._counts:
            taken_off &= self._counts[owner].between(gaps.low_ns, gaps.high_ns) < gaps.number
        unled = (silenced_at(stream, gaps.at, unled_ns) | taken_off) & ~(closed | silenced)
        closed |= silenced | unled
        for index in np.flatnonzero(closed).tolist():
            own = gaps.take(np.array([index]))
            first, number = int(own.at[0]), int(own.number[0])
            last = min(first + 1, len(stream) - 1)
            span = Span(first, last, int(times[first]), int(times[last]), 0, number)
            part = Part(stream, span, owner, own.among(stream), number, closed=True)
            part.silenced, part.unled = bool(silenced[index]), bool(unled[index])
            self._claim_closed(part, own, gaps)
        gaps, spans = gaps.take(~closed), stream.spans
        which = np.searchsorted([item.first for item in spans], gaps.at, "right") - 1
        for index in np.unique(which).tolist():
            own = gaps.take(which == index)
            part = Part(stream, spans[index], owner, own.among(stream), int(own.number.sum()))
            behind = np.zeros(len(stream), np.int64)
            np.add.at(behind, own.at, own.number)
            part.kinds = self._kinds(part, behind, via=hop is not None)
            if owner in self._counts:
                self._claim_open(part, own)
            else:
                self.parts.append(part)
        if len(gaps.at) and owner in self._counts:
            self._tail(len(self.parts) - 1)

    def _missing(self, stream: Stream) -> _Gaps:
        """Return what is missing by sequence counts, and 0 behind the last message where events name more."""
        case, missing = self._case, stream.missing - self._dropped(stream)
        made_ns = case.instances.made_ns[stream.rows] if stream.instance != NOBODY else stream.time_ns
        at = np.flatnonzero(np.append(missing[:-1], self._named_behind(stream)))
        made_ns = np.append(made_ns, made_ns[-1])
        return _Gaps(stream, at, at, missing[at], made_ns[at] - _SLACK_NS, made_ns[at + 1] + _SLACK_NS)

    def _not_handed_on(self, stream: Stream, hop: Hop) -> _Gaps:
        """Return what came in and did not go out: what was lost further up is that link's loss."""
        self._dropped(stream)
        whose = np.full(len(hop.into), -1)
        for own in self._case.hops:
            if own.into is hop.into and own.out.sender == stream.sender:
                whose[own.in_rows] = own is hop
        came, absent = np.flatnonzero(whose >= 0), np.flatnonzero(hop.known & (whose < 0))
        # Where wrong times make several streams of one, what came out behind it tells of which it is missing.
        absent = absent[whose[np.append(came, came[-1:])[np.searchsorted(came, absent)]] == 1]
        out, due = stream.time_ns, hop.into.time_ns[absent]
        # What came just before the last that went out may have waited for the next round.
        inside = (due >= out[0]) & (due <= out[-1] - self._case.profile.sbn_wake_ns)
        absent, due = absent[inside], due[inside]
        at = np.maximum(np.searchsorted(out, due, "right") - 1, 0)
        return _Gaps(hop.into, at, absent, np.ones(len(due), np.int64), due - LEAD_NS, due + LEAD_NS)

    def _claim_open(self, part: Part, gaps: _Gaps) -> None:
        """Claim counts of what is missing from a span of a stream whose way out was open."""
        counts, key = self._counts[part.owner], len(self.parts)
        low, high = gaps.low_ns, gaps.high_ns
        part.outside = int(gaps.number[(low <= counts.times[0]) | (high > counts.times[-1])].sum())
        part.watched = 2 * part.outside <= part.missing
        kinds = (*part.kinds, *(kind for kind in [*COUNTERS][::-1] if kind not in part.kinds))
        rank, flow = Rank.PRESSED if part.kinds else Rank.MISSING, id(part.stream)
        for members in claimed_alike([counts], low, high):
            span, number = (int(low[members[0]]), int(high[members[0]])), int(gaps.number[members].sum())
            self.claims.append(Claim(key, *span, number, kinds, (part.owner,), rank, flow))
        self.parts.append(part)

    def _dropped_unseen(self) -> None:
        """Add what a proxy dropped before a stream begins here, or behind its end: no gap shows it."""
        rest: dict[int, int] = {}
        for stream in self._case.streams:
            faults = self._case.done_to(stream)
            rest[id(faults)] = rest.get(id(faults), len(faults.dropped)) - self.ended(stream, "proxied")
        for stream in self._case.streams:
            if more := rest.pop(id(self._case.done_to(stream)), 0):
                self.ends[id(stream)]["proxied"] += more

    def _dropped(self, stream: Stream) -> Integers:
        """Return how many are missing behind each row that others tell of, by their counts.

        A proxy dropped them on purpose, or they came damaged.
        """
        numbers = np.zeros(len(stream), np.int64)
        dropped = self._case.done_to(stream).counts(peers=stream.link.peers)
        damaged = self._case.damaged_of(stream).sequence_count.astype(np.int64).tolist()
        before = self._case.rows.sequence_count[stream.rows].astype(np.int64)
        both: tuple[tuple[GapEnd, list[int]], ...] = ("proxied", dropped), ("damaged", damaged)
        for ending, counts in both:
            for count in counts:
                # Of gaps that a count fits into, where counts have wrapped, the first that has room.
                fits = (count - before - 1) % MODULUS < stream.missing
                at = np.flatnonzero(fits & (numbers < stream.missing))
                if len(at):
                    numbers[at[0]] += 1
                    self.ends[id(stream)][ending] += 1
        return numbers

    def _claim_closed(self, part: Part, gap: _Gaps, gaps: _Gaps) -> None:
        """Claim counts of what is missing: a pipe that nobody empties fills up, and the bus counts that.

        Args:
            gaps: all that is missing from the stream.
        """
        if not part.silenced and not part.unled:
            part.cause = self._cause(part)
        if part.owner in self._counts and part.stream.link.only_from_cfs:
            rank, kinds = Rank.OWN_PACKETS if part.cause is None else Rank.CLOSED, tuple(COUNTERS)
            span, number = (int(gap.low_ns[0]), int(gap.high_ns[0])), self._countable(part, gaps)
            of = len(self.parts), *span, number, kinds, (part.owner,), rank, id(part.stream)
            self.claims.append(Claim(*of))
        self.parts.append(part)

    def _countable(self, part: Part, gaps: _Gaps) -> int:
        """Return how many of what is missing while its way out was closed a pipe can have counted."""
        stream, span = part.stream, part.span
        before, behind = self._case.rows.source[stream.rows[[span.first, span.last]]]
        if part.silenced or before != behind:  # Telemetry Output did not read its pipe: some waited there
            waited = queues.telemetry_pipe(self._case.profile).limit(stream.msg_id)
            full = self._grown(part, COUNTERS["overflow"])
            return part.missing if full else max(0, part.missing - waited)
        # Taken off the table and put there again: over a limit where it was around that, too.
        near = (gaps.at != span.first) & (np.abs(gaps.at - span.first) <= _AROUND)
        return part.missing if near.any() else 0

    def _cause(self, part: Part) -> tuple[LossKind, str, str] | None:
        """Return what closed the way out of messages of the mission, unless a command took them off it."""
        case, stream, span = self._case, part.stream, part.span
        for cut in routes_cut(case, stream):
            if cut.overlaps(span.start_ns, span.end_ns):
                return "route", case.pipe_of(stream), cut.change.witness
        if stream.link.peers:
            return self._ended_with_sbn(part)
        if stream.is_housekeeping or not stream.link.only_from_cfs:
            return None
        for command in case.payloads.about_apps(executive_services.STOP_APP):
            if command.app not in telemetry_output.NAMES or command.time_ns <= span.start_ns - TAIL_NS:
                continue
            # It starts without anybody to send to: who enabled it again must be here, or the capture missed
            # more than that.
            if any(command.time_ns < enabled_ns < span.end_ns for enabled_ns in enables_ns(case)):
                text = f"packet {case.rows.number[command.row]} told ES to stop {command.app}"
                return "stopped", command.app, text
        return None

    def _ended_with_sbn(self, part: Part) -> tuple[LossKind, str, str] | None:
        """Return that SBN was stopped when a peer was to get messages that nothing else here follows."""
        case, span = self._case, part.span
        if case.upstream(part.stream) is None and not any(hop.out is part.stream for hop in case.hops):
            way = Way(part.stream.msg_id, part.stream.link, case.system(part.stream))
            for stop, text in reasons_for(case.timeline, way, span.start_ns, span.end_ns, case.at):
                if stop.change.subject == StateOwner("app", sbn.NAME):
                    return "stopped", sbn.NAME, text
        return None

    def _tell_closed(self, part: Part) -> None:
        """Make losses of what is missing while the way out was closed, of what was counted at least."""
        pipe = self._case.pipe_of(part.stream)
        texts = {
            kind: f"0x803: {COUNTER_NAMES[kind]} +{number:,} while nobody emptied {pipe}"
            for kind, number in part.taken.items()
        }
        if part.cause is not None:
            kind_, hop, text = part.cause
            part.evidence = [text, *texts.values()]
            at_pipe = part.taken if kind_ == "route" else Counter()  # that came to its pipe
            for kind, number in at_pipe.items():
                self._lose(part, kind, number, part.missing, "high")
            if rest := part.missing - at_pipe.total():
                self._lose(part, kind_, rest, part.missing, "high").hop = hop
            return
        idle = "Telemetry Output was not sending then: it would not have sent them either"
        for kind, number in part.taken.items():
            part.evidence = [texts[kind], idle]
            self._lose(part, kind, number, part.missing, "medium")
        rest = part.missing - part.taken.total()
        if part.silenced:
            self.silenced.append((part.stream, rest, part.among))
        else:
            self.ends[id(part.stream)]["untold" if part.unled else "closed"] += rest

    def _kinds(self, part: Part, gaps: Integers, *, via: bool) -> tuple[PipeKind, ...]:
        """Tell as what the missing of a span may have been counted (rule 2), and collect what says so."""
        case, stream, span = self._case, part.stream, part.span
        came = f"{part.missing:,} of {span.count + part.missing:,}"
        text = f"{came} that came in did not go out" if via else f"sequence count: {came} never came"
        part.evidence += [text] if part.missing else []
        window = span.start_ns - LEAD_NS, span.end_ns + TAIL_NS
        kinds: list[tuple[bool, PipeKind]] = []
        grown = {kind: self._grown(part, name) > 0 for kind, name in COUNTERS.items()}
        for kind in COUNTERS:
            events = self._naming(stream, kind)
            is_named = bool(events and events.within(*window))
            if events and is_named:
                part.evidence.append(events.text(events.within(*window)))
            # Without its counter a full pipe proves nothing.
            if is_named or (grown[kind] and pressed(case, stream, span, kind, gaps, full=grown["overflow"])):
                kinds.append((not is_named, kind))
        if not kinds and part.owner not in self._counts and stream.link.only_from_cfs and not via:
            period_ns = queues.telemetry_pipe(case.profile).round_ns
            if least := full_rounds(stream.time_ns[span.rows], gaps[span.rows], period_ns):
                part.evidence.append(f"they are missing behind full rounds alone, of {least} or more")
                kinds.append((True, "limit"))
        return tuple(kind for _, kind in sorted(kinds, key=lambda item: item[0]))

    def _naming(self, stream: Stream, kind: PipeKind) -> LossEvents | None:
        """Return the events that name a MsgId at Telemetry Output's pipe, or at a peer's."""
        output = stream.link.only_from_cfs
        about = self._case.events_about(self._case.owner(stream), stream.msg_id, kind)
        return next((events for item, events in about if (item.at_output if output else item.at_peer)), None)

    def _tail(self, key: int) -> None:
        """Claim counts of what was lost behind the last message that came: no gap shows it."""
        part, case = self.parts[key], self._case
        stream = part.stream
        into = case.rows.on(lambda link: link.to_cfs)
        if not part.kinds or not self._ends(part) or not into.any():
            return  # commands that are not here may be counted as well
        most = self._most_behind(part)
        for hop in case.hops:
            if hop.out is stream and hop.matched > _MOSTLY * len(stream):
                # It was made of what went in: no more were than went in behind the last that came out.
                went_in = hop.into.time_ns
                most = min(most, int((hop.absent & (went_in > went_in[hop.arrived].max())).sum()))
        if most > 0:
            made_ns = int(case.instances.made_ns[stream.rows[-1]])
            # So many were published by then, if they went on as before.
            until_ns = made_ns + LEAD_NS + int(most * SECOND / max(part.span.offered_hz, 1))
            of = (part.owner,)
            self.claims.append(Claim(key, made_ns, until_ns, most, part.kinds, of, Rank.POSSIBLE, id(stream)))

    def _named_behind(self, stream: Stream) -> bool:
        """Tell whether events name a loss behind the last message of a stream, which no gap shows."""
        last_ns, every = stream.time_ns[-1], (self._naming(stream, kind) for kind in COUNTERS)
        return any(events.last_ns >= last_ns for events in every if events)

    def _ends(self, part: Part) -> bool:
        """Tell whether a stream ends with a part, or with one round behind it that lacks none."""
        times, span = part.stream.time_ns, part.span
        if span.last == len(times) - 1:
            return True
        steps, next_ns = np.diff(times[span.rows]), times[span.last + 1]
        soon = next_ns - times[span.last] <= _SOON * steps.max(initial=0)
        return bool(soon and times[-1] - next_ns < self._case.profile.to_wake_ns)

    def _most_behind(self, part: Part) -> int:
        """Return how many can be missing behind a stream's last message: what a round loses."""
        gaps = part.stream.missing[:-1][part.span.rows]
        most = int(gaps.max(initial=0))
        return most if (gaps > 0).sum() >= _FEW_ROUNDS else max(most, int(0.7 * part.span.offered_hz + 2))

    def _tell(self, part: Part) -> None:
        """Make losses of what is missing from a span."""
        rest = part.missing - part.taken.total() - part.shared
        self.ends[id(part.stream)]["shared"] += part.shared
        likeliest = max(part.taken, key=lambda kind: part.taken[kind], default=None)
        more = max(0, min(rest, part.outside)) if part.kinds and likeliest is not None else 0
        if likeliest is not None:  # where no count was seen, a pipe that was full before and after was full
            part.taken[likeliest] += more
        rest -= more
        of = part.span.count + part.missing
        grown = [self._grown(part, name) for name in COUNTERS.values()]
        part.evidence.append(
            "0x803: MsgLimit +{:,}, PipeOverflow +{:,} in this time".format(*grown)
            if part.owner in self._counts
            else "0x803 of this cFS is not in the capture, so its counters cannot tell where"
        )
        for cause, number in part.taken.items():
            if number:
                self._lose(part, cause, number, of, "high").uncounted = more * (cause == likeliest)
        dropped = self._never_whole(part)
        if rest > 0 and (cut := min(rest, dropped)):
            part.evidence.append(f"the first fragments of {cut:,} of them came, and no later ones")
            self._lose(part, "fragments", cut, of, "high")
            rest -= cut
        hop = self._case.upstream(part.stream)
        if rest <= 0 or (hop is not None and hop.is_copy):  # a command may be lost before the bus, too
            return
        is_counted = part.owner in self._counts
        if part.kinds and not is_counted:
            self._lose(part, part.kinds[0], rest, of, "high").uncounted = rest
        elif not is_counted and self._cut(part.stream):
            ends, twice = self.ends[id(part.stream)], min(rest, self._missing_at_output(part.stream))
            ends["uncertain"] += twice
            ends["untold"] += rest - twice
        else:
            self._unexplained(part, rest, of, grown=any(grown))

    def _missing_at_output(self, stream: Stream) -> int:
        """Return how many of what SBN brings are missing behind Telemetry Output: the same may be missing."""
        alike = (item for item in self._case.streams if item.link.only_from_cfs and stream.link.peers)
        return sum(int(item.missing.sum()) for item in alike if item.msg_id == stream.msg_id)

    def _unexplained(self, part: Part, number: int, of: int, *, grown: bool) -> None:
        """Make a loss of what no counter has: behind cFS, where nothing else can have lost it."""
        why = next(self._doubts(part), "") if part.watched else ""
        behind = part.watched and not why
        if behind and grown:
            why = (
                f"what these count is others' loss, or told above: {self._case.pipe_of(part.stream)} was not "
                "so full of this MsgId, and no event names it"
            )
        part.evidence += [why] if why else []
        self._lose(part, "after" if behind else "unknown", number, of, "medium" if behind else "low")

    def _handed_on(self, part: Part) -> bool:
        """Tell whether it came over SBN to the cFS that sends it, and how it did is not in the capture."""
        handed_on = part.stream.link.only_from_cfs and part.stream.instance != part.owner
        return handed_on and self._case.upstream(part.stream) is None

    def _doubts(self, part: Part) -> Iterator[str]:
        """Yield why what is missing may not have been lost behind cFS."""
        case, stream = self._case, part.stream
        if case.peers_unseen:
            yield "what several cFS send each other over SBN is not in the capture: it may be lost there"
        if stream.link.peers and not case.network.crossing(stream.sender, stream.receiver):
            yield "too little that its peer sent is here to tell whether it was connected"
        if self._handed_on(part):
            whom = "a cFS" if stream.instance == NOBODY else case.label(stream.instance)
            yield f"it came from {whom} over SBN, which is not captured: some may be lost at that pipe"

    def _never_whole(self, part: Part) -> int:
        """Return how many lost their later fragments on the way."""
        stream, span = part.stream, part.span
        every = np.array(self._beginnings(stream), np.int64)
        at = np.searchsorted(stream.time_ns, every[overlapping(every - 1, every + 1, self._fragmented)]) - 1
        numbers = np.bincount(at[(at >= span.first) & (at <= span.last)], minlength=len(stream))
        return int(np.minimum(numbers, stream.missing).sum())

    def _beginnings(self, stream: Stream) -> list[int]:
        case = self._case
        if not case.never_whole:
            return []
        senders = np.unique(case.rows.source[stream.rows]).tolist()
        keys = ((case.endpoints[place], stream.msg_id) for place in senders)
        return [when for key in keys for when in case.never_whole.get(key, ())]

    @cached_property
    def _fragmented(self) -> list[tuple[int, int]]:
        """From when to when no later fragments came: what the capture missed stands between whole ones."""
        cut = [(stream, own) for stream in self._case.streams if (own := self._beginnings(stream))]
        none = np.zeros(0, np.int64)
        whole_ns = np.sort(np.concatenate([none, *(stream.time_ns for stream, _ in cut)]))
        starts = np.sort(np.concatenate([none, *(own for _, own in cut)]))
        groups = [starts[own] for _, own in by_value(np.searchsorted(whole_ns, starts))]
        return [(int(own[0]), int(own[-1])) for own in groups if len(own) >= _LEAST_FRAGMENTED]

    def _cut(self, stream: Stream) -> bool:
        """Tell whether the capture cut off when packets were made, without which two cFS are one."""
        rows = self._case.rows
        same = (rows.link == stream.link.code) & (rows.msg_id == stream.msg_id)
        bare = (rows.mission_time_ns[same] <= 0).any()
        timed = rows.on(lambda link: link.from_cfs and link.packets)
        return bool(bare and (rows.has(Finding.CAPTURE_CUT) & timed).any())

    def _grown(self, part: Part, name: str) -> int:
        track = self._case.tracks.get(part.owner)
        return track.growth(name, part.span.start_ns - LEAD_NS, part.span.end_ns + TAIL_NS) if track else 0

    def _lose(self, part: Part, kind: LossKind, number: int, of: int, confidence: Confidence) -> Loss:
        """Add a loss of what is missing from a span, and return it."""
        stream, span = part.stream, part.span
        hop = self._case.pipe_of(stream) if kind in COUNTERS else BEHIND
        # Of a pipe the rate counts, of other places when they are missing.
        times = part.among.times_ns
        if kind in COUNTERS and times[0] < span.end_ns:
            times = span.start_ns, span.end_ns
        loss = Loss(kind, hop, number, *times, confidence, part.owner, stream.msg_id)
        loss.stream, loss.span, loss.of, loss.among = stream, span, of, part.among
        loss.evidence, loss.closed = list(part.evidence), part.closed
        self.losses.append(loss)
        return loss
