"""What the software bus counted in 0x803, told once: which messages each count is.

Rules:

1. A count belongs to the second between two samples of the counter, and to one message.
2. A message that is missing from a sequence count was published between its neighbours, in cFE's time. It can
   be one of the counts made meanwhile, where an event names its MsgId at that pipe, or the pipe was full.
3. Of commands whose way out can be seen, those that did not come out can be; of others, what events name, and
   then what was sent faster than a pipe takes.
4. All claims are settled together (``claims``), so that as many as possible are explained.
5. What nothing takes stays what it is: counted, and not known which.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.cfs import executive_services, telemetry_output
from edoras_tools.cfs.names import MSG_ID_NAMES
from edoras_tools.diagnosis.accounting.claims import (
    CLOSED,
    MISSING,
    OWN_PACKETS,
    POSSIBLE,
    PRESSED,
    Claim,
    Counts,
    claimed_alike,
)
from edoras_tools.diagnosis.accounting.closed import closed_at, silenced_at, silences_of, unled_silences
from edoras_tools.diagnosis.accounting.losses import (
    BEHIND,
    COUNTER_NAMES,
    COUNTERS,
    LEAD_NS,
    PIPE_EVENTS,
    TAIL_NS,
    Among,
    Loss,
    LossKind,
    PipeKind,
)
from edoras_tools.diagnosis.accounting.pipes import pressed
from edoras_tools.diagnosis.evidence.instances import NOBODY
from edoras_tools.diagnosis.matching.spans import Span
from edoras_tools.links.table import among
from edoras_tools.model import NO_ROUTE, Finding
from edoras_tools.sessions.sequence import MODULUS
from edoras_tools.units import MILLISECOND

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.diagnosis.accounting.losses import Known
    from edoras_tools.diagnosis.matching.streams import Stream
    from edoras_tools.diagnosis.verdict import Confidence
    from edoras_tools.model import Link

_SLACK_NS: Final = 50 * MILLISECOND
"""By so much the times of two packets of one cFS may be wrong."""
_MOSTLY: Final = 0.9
_LEAST_FRAGMENTED: Final = 6
"""So many in a row that never became whole were dropped, and not missed by the capture."""


@dataclass(slots=True)
class Part:
    """What is missing from one span of a telemetry stream.

    Attributes:
        stream: the stream.
        span: when.
        owner: the cFS whose pipe it comes out of.
        missing: how many.
        kinds: as what they may have been counted.
        taken: kind to how many were.
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
    taken: dict[PipeKind, int] = field(default_factory=dict)
    watched: bool = False
    outside: int = 0
    closed: bool = False
    silenced: bool = False
    unled: bool = False
    cause: tuple[LossKind, str, str] | None = None
    evidence: list[str] = field(default_factory=list)


class Telemetry:
    """What is missing from sequence counts, held against the counters.

    Attributes:
        losses: what was lost.
        closed: id of a stream to messages that were published while the way out was closed, and that no
            counter has.
        silenced: a stream, how many of it Telemetry Output took and did not send until it was enabled, and
            among which.
        away: id of a stream to those that are missing while the capturing interface was away.
        uncertain: id of a stream to counts that are missing, and that the capture itself may have missed.
        silences: sender of telemetry to the times in which that was so.
        proxied: id of a stream to messages that are missing because a proxy dropped them on purpose.
        untold: id of a stream to counts that are missing where cut frames do not tell whose they are, or
            nothing tells whether Telemetry Output was to send them.
    """

    def __init__(self, known: Known, counts: dict[int, Counts]) -> None:
        self._known = known
        self._counts = counts
        self.closed: dict[int, int] = {}
        self.proxied: dict[int, int] = {}
        self.untold: dict[int, int] = {}
        self._unled: dict[tuple[int, int], list[tuple[int, int]]] = {}
        self.silenced: list[tuple[Stream, int, Among]] = []
        self.away: dict[int, int] = {}
        self.uncertain: dict[int, int] = {}
        self.silences: dict[int, list[tuple[int, int]]] = {}
        self._spare: dict[int, int] = {}
        self.losses: list[Loss] = []
        self.parts: list[Part] = []
        self.claims: list[Claim] = []
        for stream in known.streams:
            if not stream.link.only_to_cfs:
                self._claim(stream)
        self._dropped_unseen()

    def passed(self, stream: Stream) -> NDArray[np.int64]:
        """Return how many of a stream are behind each row and its next, of what was meant for its receiver.

        The next one is one of them, and its counts that are missing; not what cFS publishes for others while
        an SBN peer is away.
        """
        found = stream.missing + 1
        for part in self.parts:
            if part.stream is stream and part.closed and stream.link.peers:
                found[part.span.first] = 1
        return found

    def tell(self) -> None:
        """Make losses of what is missing, once the claims have their counts."""
        for claim in self.claims:
            taken = self.parts[claim.key].taken
            for (_, kind), number in claim.by_kind().items():
                taken[kind] = taken.get(kind, 0) + number
            if claim.rank == POSSIBLE:  # behind the last message that came, where no gap shows it
                self.parts[claim.key].missing += sum(claim.taken.values())
        for part in self.parts:
            # Of those that may have been counted before or behind all samples, a count here may be another's.
            spare = part.outside - part.missing + sum(part.taken.values())
            self._spare[part.owner] = self._spare.get(part.owner, 0) + max(0, spare)
        for part in self.parts:
            if part.closed:
                self._tell_closed(part)
            else:
                self._tell(part)

    def _claim(self, stream: Stream) -> None:
        """Divide what is missing from a stream by spans and seconds."""
        parts = self.parts
        known = self._known
        hop = known.upstream(stream)
        if hop is None and not (stream.counted and stream.missing.any()):
            return
        own = stream.rows
        missing = stream.missing - self._dropped(stream)
        made = known.instances.made_ns[own] if stream.instance != NOBODY else known.rows.time_ns[own]
        if hop is not None:
            # What was lost further up is that link's loss: here counts what came in and did not go out.
            absent = np.flatnonzero(hop.absent)
            due = known.rows.time_ns[hop.into.rows[absent]]
            # What came just before the last that went out may have waited for the next round.
            until = known.rows.time_ns[own[-1]] - known.profile.sbn_wake_ns
            inside = (due >= known.rows.time_ns[own[0]]) & (due <= until)
            absent, due = absent[inside], due[inside]
            at = np.maximum(np.searchsorted(known.rows.time_ns[own], due, "right") - 1, 0)
            number = np.ones(len(due), np.int64)
            from_ns, until_ns = due - LEAD_NS, due + LEAD_NS
        else:
            at = absent = np.flatnonzero(missing[:-1])
            number = missing[at]
            from_ns, until_ns = made[at] - _SLACK_NS, made[at + 1] + _SLACK_NS
        if not len(at):
            return
        owner = known.owner(stream)
        counts = self._counts.get(owner)
        if stream.link.only_from_cfs and stream.sender not in self.silences:
            self.silences[stream.sender] = silences_of(known, stream.sender)
        silenced = silenced_at(known, stream, at, self.silences.get(stream.sender, ()))
        way = stream.sender, stream.receiver
        if way not in self._unled:
            self._unled[way] = unled_silences(known, stream)
        unled = silenced_at(known, stream, at, self._unled[way] if hop is None else ())
        behind = np.minimum(at + 1, len(stream) - 1)
        away = known.away(known.rows.time_ns[own[at]], known.rows.time_ns[own[behind]])
        if away.any():
            self.away[id(stream)] = int(number[away].sum())
        at, number, from_ns, until_ns = at[~away], number[~away], from_ns[~away], until_ns[~away]
        silenced, unled, absent = silenced[~away], unled[~away], absent[~away]

        def among(chosen: NDArray[Any]) -> Among:
            if hop is not None:
                return Among(hop.into, absent[chosen])
            return Among(stream, absent[chosen], number[chosen])

        closed = closed_at(known, stream, at)
        silenced &= ~closed
        unled &= ~(closed | silenced)
        closed |= silenced | unled
        for index in np.flatnonzero(closed).tolist():
            part = self._closed_part(
                stream, int(at[index]), owner, int(number[index]), among(np.array([index]))
            )
            part.silenced, part.unled = bool(silenced[index]), bool(unled[index])
            self._claim_closed(part, int(from_ns[index]), int(until_ns[index]))
        at, number, from_ns, until_ns = at[~closed], number[~closed], from_ns[~closed], until_ns[~closed]
        absent = absent[~closed]
        cut = known.spans(stream)
        which = np.searchsorted([item.first for item in cut], at, "right") - 1
        for index in np.unique(which).tolist():
            rows = np.flatnonzero(which == index)
            part = Part(stream, cut[index], owner, among(rows), int(number[rows].sum()))
            gaps = np.zeros(len(own), np.int64)
            np.add.at(gaps, at[rows], number[rows])
            part.kinds = self._kinds(part, gaps, via=hop is not None)
            if counts is not None:
                low, high = from_ns[rows], until_ns[rows]
                inside = (low > counts.times[0]) & (high <= counts.times[-1])
                part.outside = int(number[rows[~inside]].sum())
                part.watched = 2 * part.outside <= part.missing
                others = tuple(kind for kind in COUNTERS if kind not in part.kinds)
                for members in claimed_alike([counts], low, high):
                    total = int(number[rows[members]].sum())
                    span = int(low[members[0]]), int(high[members[0]])
                    key, rank = len(parts), PRESSED if part.kinds else MISSING
                    self.claims.append(
                        Claim(key, *span, total, (*part.kinds, *others), (owner,), rank, id(stream))
                    )
            parts.append(part)
            if counts is not None:
                self._tail(len(parts) - 1)

    def _dropped_unseen(self) -> None:
        """Add what a proxy dropped before a stream begins here, or behind its end: no gap shows it."""
        left: dict[int, int] = {}
        for stream in self._known.streams:
            done = self._known.done_to(stream)
            here = left.setdefault(id(done), len(done.dropped)) - self.proxied.get(id(stream), 0)
            left[id(done)] = here
        for stream in self._known.streams:
            if more := left.pop(id(self._known.done_to(stream)), 0):
                self.proxied[id(stream)] = self.proxied.get(id(stream), 0) + more

    def _dropped(self, stream: Stream) -> NDArray[np.int64]:
        """Return how many of what is missing behind each row a proxy dropped on purpose, by their counts."""
        found = np.zeros(len(stream), np.int64)
        counts = self._known.done_to(stream).counts(peers=stream.link.peers)
        if counts:
            before = self._known.rows.sequence_count[stream.rows].astype(np.int64)
            for count in counts:
                # Of gaps that a count fits into, where counts have wrapped, the first that has room.
                fits = (count - before - 1) % MODULUS < stream.missing
                at = np.flatnonzero(fits & (found < stream.missing))
                if len(at):
                    found[at[0]] += 1
            self.proxied[id(stream)] = int(found.sum())
        return found

    def _closed_part(self, stream: Stream, at: int, owner: int, number: int, among: Among) -> Part:
        """Return what is missing from a gap in which a stream's way out was closed."""
        behind = min(at + 1, len(stream) - 1)
        start_ns, end_ns = self._known.rows.time_ns[stream.rows[[at, behind]]].tolist()
        span = Span(at, behind, start_ns, end_ns, 0, number)
        return Part(stream, span, owner, among, number, closed=True)

    def _claim_closed(self, part: Part, low_ns: int, high_ns: int) -> None:
        """Claim counts of what is missing: a pipe that nobody empties fills up, and the bus counts that."""
        if not part.silenced and not part.unled:
            part.cause = self._cause(part)
        if part.owner in self._counts and part.stream.link.only_from_cfs:
            key, rank, kinds = len(self.parts), OWN_PACKETS if part.cause is None else CLOSED, tuple(COUNTERS)
            claim = Claim(key, low_ns, high_ns, part.missing, kinds, (part.owner,), rank, id(part.stream))
            self.claims.append(claim)
        self.parts.append(part)

    def _cause(self, part: Part) -> tuple[LossKind, str, str] | None:
        """Return what closed the way out of messages of the mission, unless a command took them off it."""
        known, stream, span = self._known, part.stream, part.span
        if stream.known_id in MSG_ID_NAMES and stream.route == NO_ROUTE:
            return None
        if not stream.link.only_from_cfs:
            return None
        enabled = [
            int(known.rows.time_ns[item.row])
            for item in known.payloads.output
            if item.function_code == telemetry_output.ENABLE
        ]
        for command in known.payloads.executive:
            when = int(known.rows.time_ns[command.row])
            stops = (
                command.function_code == executive_services.STOP_APP and command.app in telemetry_output.NAMES
            )
            # It starts without anybody to send to: who enabled it again must be here, or the capture missed
            # more than that.
            again = any(when < item < span.end_ns for item in enabled)
            if stops and again and span.start_ns - TAIL_NS < when < span.end_ns:
                text = f"packet {known.rows.number[command.row]} told ES to stop {command.app}"
                return "stopped", command.app, text
        return None

    def _tell_closed(self, part: Part) -> None:
        """Make losses of what was counted while the way out was closed; the rest nobody counts."""
        for kind, number in part.taken.items():
            pipe = self._known.hop(part.stream)
            part.evidence = [
                f"0x803: {COUNTER_NAMES[kind]} +{number:,} while nobody emptied {pipe}",
                "Telemetry Output was not sending then: it would not have sent them either",
            ]
            self.losses.append(self._loss(part, kind, number, part.missing, "medium"))
        rest = part.missing - sum(part.taken.values())
        if part.cause is not None and rest:
            kind_, hop, text = part.cause
            part.evidence = [text]
            self.losses.append(replace(self._loss(part, kind_, rest, part.missing, "high"), hop=hop))
            return
        if part.silenced:
            self.silenced.append((part.stream, rest, part.among))
            return
        where = self.untold if part.unled else self.closed
        where[id(part.stream)] = where.get(id(part.stream), 0) + rest

    def _kinds(self, part: Part, gaps: NDArray[np.int64], *, via: bool) -> tuple[PipeKind, ...]:
        """Tell as what the missing of a span may have been counted (rule 2), and collect what says so."""
        known, stream, span = self._known, part.stream, part.span
        output = stream.link.only_from_cfs
        came = f"{part.missing:,} of {span.count + part.missing:,}"
        part.evidence.append(
            f"{came} that came in on the SBN link did not go out"
            if via
            else f"sequence count: {came} never came"
        )
        window = span.start_ns - LEAD_NS, span.end_ns + TAIL_NS
        kinds: list[tuple[bool, PipeKind]] = []
        for kind in COUNTERS:
            events = known.named(part.owner, stream.msg_id, kind, output=output)
            names_it = bool(events and events.within(*window))
            if events:
                part.evidence.append(
                    f"event CFE_SB {PIPE_EVENTS[kind]} x{events.count}: {events.records[0].message}"
                )
            # Without its counter a full pipe proves nothing.
            if names_it or (self._grown(part, COUNTERS[kind]) and pressed(known, stream, span, kind, gaps)):
                kinds.append((not names_it, kind))
        return tuple(kind for _, kind in sorted(kinds, key=lambda item: item[0]))

    def _tail(self, key: int) -> None:
        """Claim counts of what was lost behind the last message that came: no gap shows it."""
        part, known = self.parts[key], self._known
        stream, span = part.stream, part.span
        if not part.kinds or span.last != len(stream) - 1:
            return
        made_ns = int(known.instances.made_ns[stream.rows[-1]])
        most = int(0.7 * span.offered_hz + 2)
        for hop in known.hops:
            if hop.out is stream and hop.matched > _MOSTLY * len(stream):
                # It was made of what went in: no more were than went in behind the last that came out.
                went_in = known.captured(hop.into)
                most = min(most, int((hop.absent & (went_in > went_in[hop.arrived].max())).sum()))
        if most > 0:
            self.claims.append(
                Claim(key, made_ns, made_ns + TAIL_NS, most, part.kinds, (part.owner,), POSSIBLE, id(stream))
            )

    def _tell(self, part: Part) -> None:
        """Make losses of what is missing from a span."""
        taken = sum(part.taken.values())
        rest = part.missing - taken
        likeliest = max(part.taken, key=lambda kind: part.taken[kind], default=None)
        more = max(0, min(rest, part.outside))
        if taken and likeliest is not None:
            # Where no count was seen, a pipe that was full before and after was full.
            part.taken[likeliest] += more
            rest -= more
        of = part.span.count + part.missing
        grown = {kind: self._grown(part, name) for kind, name in COUNTERS.items()}
        if part.owner in self._counts:
            part.evidence.append(
                f"0x803: MsgLimit +{grown['limit']:,}, PipeOverflow +{grown['overflow']:,} in this time"
            )
        else:
            part.evidence.append("0x803 of this cFS is not in the capture, so its counters cannot tell where")
        for counted, number in part.taken.items():
            if number:
                self.losses.append(self._loss(part, counted, number, of, "high"))
                self.losses[-1].uncounted = more if counted == likeliest else 0
        dropped, missed = self._never_whole(part)
        if rest > 0 and (cut := min(rest, dropped)):
            part.evidence.append(f"the first fragments of {cut:,} of them came, and no later ones")
            self.losses.append(self._loss(part, "fragments", cut, of, "high"))
            rest -= cut
        if rest > 0 and (number := min(rest, missed)):
            self.uncertain[id(part.stream)] = self.uncertain.get(id(part.stream), 0) + number
            rest -= number
        if rest <= 0:
            return
        if part.owner not in self._counts and part.kinds:
            self.losses.append(replace(self._loss(part, part.kinds[0], rest, of, "high"), uncounted=rest))
            return
        if part.owner not in self._counts and self._cut(part.stream):
            self.untold[id(part.stream)] = self.untold.get(id(part.stream), 0) + rest
            return
        kind: LossKind = "after" if part.watched else "unknown"
        if kind == "after" and taken and self._spare[part.owner]:
            part.evidence.append(
                "a sample of 0x803 outside the capture may have counted others told as counted"
            )
            kind = "unknown"
        handed_on = part.stream.link.only_from_cfs and part.stream.instance != part.owner
        if kind == "after" and self._known.peers_unseen:
            part.evidence.append(
                "several cFS are here, and what they send each other over SBN is not in the capture: it may "
                "have been lost there"
            )
            kind = "unknown"
        sender, receiver = part.stream.sender, part.stream.receiver
        if kind == "after" and part.stream.link.peers and not self._known.network.crossing(sender, receiver):
            part.evidence.append("too little that its peer sent is here to tell whether it was connected")
            kind = "unknown"
        if kind == "after" and handed_on and self._known.upstream(part.stream) is None:
            part.evidence.append(
                f"it came over SBN from {self._known.label(part.stream.instance)}, and that link is not in "
                "the capture: its peer pipe may have lost some of these"
            )
            kind = "unknown"
        if any(grown.values()) and kind == "after":
            part.evidence.append(
                f"what these count is others' loss, or told above: {self._known.hop(part.stream)} was not so "
                "full of this MsgId, and no event names it"
            )
        self.losses.append(self._loss(part, kind, rest, of, "medium" if kind == "after" else "low"))

    def _never_whole(self, part: Part) -> tuple[int, int]:
        """Return how many lost their later fragments on the way, and of how many the capture lacks some."""
        known, stream, span = self._known, part.stream, part.span
        last = stream.rows[min(span.last + 1, len(stream) - 1)]
        end_ns = max(span.end_ns, int(known.rows.time_ns[last]))
        own = [when for when in self._beginnings(stream) if span.start_ns < when < end_ns]
        dropped = sum(any(start <= when <= end for start, end in self._fragmented) for when in own)
        return dropped, len(own) - dropped

    def _beginnings(self, stream: Stream) -> list[int]:
        known = self._known
        if not known.never_whole:
            return []
        senders = np.unique(known.rows.source[stream.rows]).tolist()
        keys = ((known.endpoints[place], stream.msg_id) for place in senders)
        return [when for key in keys for when in known.never_whole.get(key, ())]

    @cached_property
    def _fragmented(self) -> list[tuple[int, int]]:
        """From when to when no later fragments came: what the capture missed stands between whole ones."""
        found = []
        for stream in self._known.streams:
            begun = np.sort(np.array(self._beginnings(stream), np.int64))
            times = self._known.captured(stream)
            for at in np.flatnonzero(stream.missing >= _LEAST_FRAGMENTED).tolist() if len(begun) else ():
                start_ns, end_ns = int(times[at]), int(times[min(at + 1, len(times) - 1)])
                inside = begun[(begun > start_ns) & (begun < end_ns)]
                if len(inside) >= _LEAST_FRAGMENTED:
                    found.append((int(inside[0]), int(inside[-1])))
        return found

    def _cut(self, stream: Stream) -> bool:
        """Tell whether the capture cut off when packets were made, without which two cFS are one."""
        rows = self._known.rows
        same = (rows.link == stream.link.code) & (rows.msg_id == stream.msg_id)
        bare = (rows.mission_time_ns[same] <= 0).any()
        return bool(bare and (rows.has(Finding.CAPTURE_CUT) & among(rows.link, _timed)).any())

    def _grown(self, part: Part, name: str) -> int:
        track = self._known.tracks.get(part.owner)
        return track.growth(name, part.span.start_ns - LEAD_NS, part.span.end_ns + TAIL_NS) if track else 0

    def _loss(self, part: Part, kind: LossKind, number: int, of: int, confidence: Confidence) -> Loss:
        return Loss(
            kind=kind,
            instance=part.owner,
            hop=self._known.hop(part.stream) if kind in COUNTERS else BEHIND,
            msg_id=part.stream.msg_id,
            stream=part.stream,
            span=part.span,
            lost=number,
            of=of,
            start_ns=part.span.start_ns,
            end_ns=part.span.end_ns,
            confidence=confidence,
            evidence=list(part.evidence),
            comb=self._known.rounds(part.stream, part.span),
            closed=part.closed,
            among=part.among,
        )


def _timed(link: Link) -> bool:
    return link.from_cfs and link.packets
