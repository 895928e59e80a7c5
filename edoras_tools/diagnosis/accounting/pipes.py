"""Losses at pipes: commands that did not leave cFS again, and counts that no missing message explains.

In: the fates of streams into cFS, and the counters of 0x803. Out: claims, and once these are settled
(``claims``), losses. ``Pipes`` begins with messages and looks for counts; ``Leftover`` begins with counts
that are left.

Rules:

1. ``Pipes``: a message into cFS whose way out is captured and that did not come out may have been lost at its
   application's pipe. It claims counts of 0x803 (``claims``), but not if it surely came out and was lost
   behind the application.
2. A pipe can have lost messages only where it was full: its output comes in full rounds and messages are
   missing beside them, or more messages were sent in a round than the pipe holds (``pressed``).
3. ``Leftover``: a count that no missing message explains is of traffic whose way out is not captured. That is
   the traffic that events name, else traffic that is sent faster than a pipe holds.
4. If several kinds of traffic fit, they share the count. If none fits, it stays a loss of an unknown MsgId.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import Counter, defaultdict
from collections.abc import Hashable, Mapping
from math import ceil
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.cfs import command_ingest, executive_services, queues, sbn, telemetry_output
from edoras_tools.cfs.software_bus import STOPS_AFTER
from edoras_tools.diagnosis.accounting.claims import (
    BEFORE,
    Claim,
    CounterKey,
    Counts,
    Rank,
    Rival,
    Shared,
    claimed_alike,
    hand_on,
    settle,
    take_back,
)
from edoras_tools.diagnosis.accounting.ingest import DRAINS_NS
from edoras_tools.diagnosis.accounting.losses import (
    APP,
    BUS,
    COUNTER_NAMES,
    COUNTERS,
    LEAD_NS,
    TAIL_NS,
    WAITS_NS,
    Among,
    End,
    Fate,
    Loss,
    Outage,
)
from edoras_tools.diagnosis.evidence.instances import NOBODY
from edoras_tools.diagnosis.evidence.timeline.table import NEVER
from edoras_tools.diagnosis.matching.streams import Span, Stream, bursts
from edoras_tools.diagnosis.quality import overlapping
from edoras_tools.links.table import carrying
from edoras_tools.units import SECOND
from edoras_tools.wire.arrays import Integers, Mask, Places, by_key, by_value, distinct
from edoras_tools.wire.cfe import EVENT_MSG_ID

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.evidence.loss_reports import LossEvents, PipeKind, ReportedLoss
    from edoras_tools.diagnosis.matching.crossing import Hop
    from edoras_tools.diagnosis.verdict import Confidence


LATE_NS: Final = 2 * SECOND
"""A loss shows in the counter at most this much later."""
TICKS: Final[Mapping[str, int]] = {
    **dict.fromkeys(executive_services.SCHEDULERS, executive_services.TICK_MSG_ID),
    **dict.fromkeys(command_ingest.NAMES, command_ingest.REQUEST_MSG_ID),
    **dict.fromkeys(telemetry_output.NAMES, telemetry_output.REQUEST_MSG_ID),
    sbn.NAME: sbn.COMMAND_MSG_ID,
}
"""Application of cFS to the MsgId of the message that wakes it once a second."""
_RANKS: Final = Rank.ABSENT, *(Rank.POSSIBLE + more for more in (1, 3, 2)), Rank.INTO_STOP, Rank.POSSIBLE + 2
"""Rank of the claims for each mask of ``_standing``, in its order."""
_UNNAMED: Final[Mapping[int, int]] = {Rank.ABSENT: Rank.QUIET, Rank.INTO_STOP: Rank.INTO_STOP}
"""The rank instead, where no event names the MsgId and its stream is too slow to fill a pipe."""
_FIRST: Final = "; its first value already had some"
_LATE: Final = 1.5
"""A pipe that is read late may lose this many times as much as one that is read in time."""
_MAY_WAIT: Final = 2
_BLIND: Final = 3
_INTO_STOP: Final = 4
_OVER: Final = 1.02
_OFTEN: Final = 1
"""The largest round shows how deep a pipe is if it occurs more often than this."""
_FULL: Final = 0.3
"""If at least this share of the rounds is full, the size of a full one is the limit."""


def _standing(fate: Fate) -> tuple[Mask, ...]:
    """Return masks (rows,) of the messages that no loss explains yet, by what is known of each.

    In order: surely did not come out; may have come out unseen, given way or been lost behind; may still
    come out; have no values to be recognised by; were sent into a stop; lie before the first that came out
    or after the last.
    """
    into_stop = fate.open & (fate.stop >= 0) & ~fate.no_pipe
    others = fate.open & (fate.stop < 0)
    sure = others & ~fate.newer & ~fate.passed & ~fate.edge & ~fate.unseen & fate.seen
    may = others & ~(sure | fate.edge | fate.no_pipe)
    return sure, may, fate.waits, fate.blind, into_stop, others & fate.edge


class _Messages(msgspec.Struct):
    """Messages of one span of a stream that could have caused the same counts.

    Attributes:
        fate: what became of the stream's messages.
        span: index of the span.
        rows: indices into the stream's rows.
        standing: index into ``_standing``.
    """

    fate: Fate
    span: int
    rows: Places
    standing: int


class Pipes:
    """Losses at application pipes, of messages whose way out is captured.

    Attributes:
        claims: claims of these messages on the loss counters.
    """

    def __init__(self, case: Case, losses: list[Loss]) -> None:
        self._case, self._counts, self.losses = case, case.loss_counts, losses
        self._same: dict[tuple[Stream, PipeKind, int, Span], Loss] = {}
        self.claims: list[Claim] = []

    def claim(self, fate: Fate) -> None:
        """Add claims for the messages of a stream that did not come out, on each cFS that it may go to."""
        stream = fate.stream
        group = [at for at in self._counts if self._case.goes_to(stream, at) and self._leaves(fate, at)]
        kinds = [kind for kind in COUNTERS if any(self._from_events(stream, kind, at)[0] for at in group)]
        has_events = bool(kinds)
        # Traffic whose way out is not captured claims counts only if events name it.
        if not group or not (fate.seen or (has_events and self._case.hops)):
            return
        kinds += [kind for kind in COUNTERS if kind not in kinds]
        low_ns, high_ns = self._times(fate)
        which = np.searchsorted([item.first for item in stream.spans], np.arange(len(stream)), "right") - 1
        counts = [self._counts[instance] for instance in group]
        is_named = has_events or self._bursts(fate, group)
        for place, mask in enumerate(_standing(fate)):
            if place == _BLIND and not has_events:
                continue
            rows, rank = np.flatnonzero(mask), _RANKS[place]
            if has_events:
                rank = Rank.PRESSED if rank == Rank.ABSENT else rank
            elif not is_named:
                rank = _UNNAMED.get(rank, rank + Rank.UNNAMED - Rank.POSSIBLE)
            if place == _MAY_WAIT:
                rows = rows[np.logical_or.reduce([own.often(low_ns[rows], high_ns[rows]) for own in counts])]
            for members in claimed_alike(counts, low_ns[rows], high_ns[rows], which[rows]):
                own = rows[members]
                span = int(low_ns[own[0]]), int(high_ns[own[0]])
                messages = _Messages(fate, int(which[own[0]]), own, place)
                self.claims.append(Claim(messages, *span, len(own), tuple(kinds), group, rank, stream))

    def _bursts(self, fate: Fate, group: Sequence[int]) -> bool:
        """Return whether more messages of a stream may reach its pipe in one round than the pipe holds."""
        profile, polls = self._case.profile, not fate.stream.link.only_to_cfs
        period = profile.sbn_wake_ns * profile.sbn_polls if polls else profile.ci_wake_ns
        times, limit = fate.stream.time_ns, profile.app_msg_limit
        return any(_fills(self._case, fate, at, times, period, limit) for at in group)

    def _times(self, fate: Fate) -> tuple[Integers, Integers]:
        """Return the earliest and latest time at which each message can be counted: i64 (rows,), ns.

        CI hands on in order, so it handed on what was lost before the next message that came out.
        """
        times = fate.stream.time_ns
        delay = max((hop.last_ns for hop in fate.hops), default=0)
        return np.maximum(times - LEAD_NS, self._taken_since(fate, times)), times + delay + LATE_NS

    def make_losses(self) -> None:
        """Turn the counts that the claims got into losses."""
        groups = set[tuple[Hashable, ...]]()
        for claim in self.claims:
            own: _Messages = claim.messages
            at = 0
            if own.standing == _INTO_STOP:  # the stop is their cause: ``closed.Stops`` makes that loss
                own.fate.counted_in_stop[int(own.fate.stop[own.rows[0]])] += claim.explained
                continue
            cut = own.fate.stream.spans[own.span]
            for counter, number in claim.by_kind().items():
                first, rows = (*counter, BEFORE) in claim.assigned, own.rows[:0]
                group = own.fate.stream, own.span, own.standing, counter
                if group not in groups:  # its first claim shows the messages of all
                    rows = np.arange(cut.first, cut.last + 1)
                    rows = rows[_standing(own.fate)[own.standing][rows]]
                    groups.add(group)
                self.add_loss(Among(own.fate.stream, rows), cut, counter, number, first=first)
                places = own.rows[at : at + number]
                own.fate.open[places] = own.fate.waits[places] = own.fate.blind[places] = False
                at += number

    def _leaves(self, fate: Fate, instance: int) -> bool:
        """Return whether the messages of a stream may leave cFS from this instance."""
        owners = {self._case.owner(hop.out) for hop in fate.hops if not hop.out.link.last_hop}
        return not owners or instance in owners or NOBODY in owners

    def _taken_since(self, fate: Fate, times: Integers) -> int:
        """Return when CI began to read a stream: first it reads the backlog from before the capture."""
        if not fate.hops or not fate.stream.link.only_to_cfs:
            return 0
        out_ns, went_ns = min(hop.first for hop in fate.hops)
        profile = self._case.profile
        wakes = 1 + int(np.searchsorted(times, went_ns)) // profile.ci_datagrams_per_wake
        return out_ns - wakes * profile.ci_wake_ns - LEAD_NS

    def add_loss(self, among: Among, cut: Span, at: CounterKey, number: int, *, first: bool = False) -> None:
        """Add messages to the loss at a pipe in one span of a stream.

        Args:
            among: candidates: messages of the stream, of which they are some.
            cut: the span.
            at: counter that counted them.
            number: number of messages.
            first: the first 0x803 of the capture had already counted some of them.
        """
        stream, (instance, kind) = among.stream, at
        key = stream, kind, instance, cut
        if (loss := self._same.get(key)) is not None:
            loss.lost += number
            before = loss.among.rows if loss.among else among.rows[:0]
            if len(among.rows) and not np.array_equal(before, among.rows):
                loss.among = Among(stream, distinct(np.concatenate((before, among.rows))))
            return
        reported, report = self._from_events(stream, kind, instance)
        evidence = [f"0x803: {COUNTER_NAMES[kind]} counts them{_FIRST if first else ''}"]
        hop, sender = (reported.pipe, reported.sender) if reported else (APP, "")
        if report is not None:
            if events := report.within(cut.start_ns - LEAD_NS, cut.end_ns + TAIL_NS):
                evidence.insert(0, report.text(events))
            track = self._case.tracks[instance]
            if track.growth(COUNTERS[kind], report.last_ns + LEAD_NS) > 0 and report.count >= STOPS_AFTER - 2:
                evidence.append(f"cFS stops this event after {STOPS_AFTER}; the counter goes on")
        else:
            evidence.append("no event names it: suppressed, filtered, or lost itself")
        sure: Confidence = "high" if reported else "medium"
        loss = Loss(kind, hop, number, cut.start_ns, cut.end_ns, sure, instance, stream.msg_id, stream, cut)
        loss.of, loss.evidence, loss.sender, loss.among = cut.count, evidence, sender, among
        self._same[key] = loss
        self.losses.append(loss)

    def _from_events(
        self, stream: Stream, kind: PipeKind, instance: int
    ) -> tuple[ReportedLoss | None, LossEvents | None]:
        about = self._case.events_about(instance, stream.msg_id, kind)
        # Telemetry Output may subscribe to a command too: its pipe loses other copies than the application's.
        return next((own for own in about if not (stream.is_command and own[0].at_output)), (None, None))


def _fills(case: Case, fate: Fate, instance: int, times: Integers, round_ns: int, limit: int) -> bool:
    """Return whether more of a stream came in a round than its pipe holds, and no counter refutes that limit.

    It is refuted if it would lose far more than all that was counted. More than twice as much is usual,
    because the application reads between two that CI hands over; but another stream may have another limit.
    """
    track, profile = case.tracks[instance], case.profile
    if not more_at_once(times, round_ns, limit):
        return False
    times = times[fate.open & (times > track.times[0]) & (times < track.times[-1])]
    same = [own for own in case.streams if own.link is fate.stream.link and not own.is_housekeeping]
    most = 2 if len({own.msg_id for own in same if len(own) > limit}) > 1 else 3
    if _over(times, round_ns, limit) <= most * sum(track.growth(name) for name in COUNTERS.values()):
        return True
    # Where more came at once than CI reads, some are not at the pipe yet.
    came_ns = case.arriving(fate.stream.receiver)
    return more_at_once(came_ns, profile.ci_wake_ns, profile.ci_datagrams_per_wake)


def _over(times: Integers, round_ns: int, limit: int) -> int:
    """Return how many messages are more than may wait in each round."""
    return int(np.maximum(np.unique(times // round_ns, return_counts=True)[1] - limit, 0).sum())


def pressed(case: Case, stream: Stream, span: Span, kind: PipeKind, missing: Integers, *, full: bool) -> bool:
    """Return whether a pipe was so full that it can have lost the messages missing from a span of a stream.

    A full pipe is emptied in one burst, and its losses lie beside that burst. Or, on average, more messages
    of the MsgId are sent in a round than the pipe holds.

    Args:
        case: the capture.
        stream: telemetry stream behind the pipe.
        span: the span.
        kind: ``limit`` of the MsgId, or ``overflow`` of the whole pipe.
        missing: i64 (rows of the stream,), number of messages missing after each row.
        full: the whole pipe overflowed, so that bursts do not show the limit of one MsgId.
    """
    queue, output, own = case.queue_of(stream), stream.link.only_from_cfs, stream.time_ns
    period, limit = queue.round_ns, queue.limit(stream.msg_id)
    if case.unsteady_ns:  # with wrong times no round can be recognised, but what is rare fills none
        most = min(limit, case.commanded_limit(stream) or limit)
        return kind == "overflow" or more_at_once(own[span.rows], period + case.unsteady_ns, most - 1)
    at = np.arange(span.first, min(span.last + 1, len(own) - 1))
    at = at[missing[at] > 0]
    ends_ns = own[min(span.last + 1, len(own) - 1)]
    around = span.start_ns - period, ends_ns + 1
    if kind == "overflow":
        times = case.leaving(stream.pipe)
        times = times[slice(*np.searchsorted(times, around))]
        # Part of the pipe's traffic may not be captured: half its depth is taken as full.
        most_ns = _full(times, period, min(queue.depth // 2, case.measured_depth(stream.pipe, period)))
        return _beside(most_ns, own[at] - period // 2, own[at + 1], missing[at])
    rounds, clean, times = case.rounds(stream, span), limit, case.times(stream)
    times = times[slice(*np.searchsorted(times, around))]
    if not full and rounds.share >= _FULL and abs(rounds.period_ns - period) < period // 10:
        clean, limit = rounds.most, max(limit, rounds.most)
    limits = np.full(len(times), limit)  # and those that commands set, from then on
    system = case.instances.system(case.owner(stream))
    for change in case.timeline.entry(stream.msg_id, system) if output else ():
        limits[times > change.not_before_ns] = limit if change.limit is None else change.limit
    # Other senders may use the MsgId: their messages fill the pipe too.
    if _beside(_full(times, period, limits), own[at], own[at + 1], missing[at]):
        return True
    inside = own[span.rows]
    later = len(inside) - int(np.searchsorted(inside, inside[0] + period // 2))
    later += int(missing[span.first : span.last].sum())
    return later * period > _OVER * clean * (span.end_ns - span.start_ns) > 0


def more_at_once(times: Integers, period_ns: int, number: int) -> bool:
    """Return whether more than ``number`` of some times, in rising order, lie within one period."""
    late = times[number:]
    return bool((late - times[: len(late)] < period_ns).any())


def measured_depth(times: Integers, period: int) -> int:
    """Return the depth of a pipe: the size of its largest round, if that occurs often; else 2^63 - 1."""
    _, sizes = bursts(times, period // 2)
    most = int(sizes.max(initial=0))
    return most if (sizes == most).sum() > _OFTEN else int(np.iinfo(np.int64).max)


def _full(times: Integers, period: int, most: int | Integers) -> Integers:
    """Return those of some times at which a burst has reached ``most`` messages, of all times or of each."""
    return times[np.arange(1, len(times) + 1) - np.searchsorted(times, times - period // 2) >= most]


def _beside(times: Integers, starts: Integers, ends: Integers, missing: Integers) -> bool:
    """Return whether most missing messages lie in intervals that contain one of some times."""
    inside = np.searchsorted(times, ends) > np.searchsorted(times, starts)
    return int(missing[inside].sum()) * 2 > int(missing.sum())


class _Candidate(msgspec.Struct, frozen=True):
    """Traffic whose way out is not captured, and that may have caused counts.

    Attributes:
        msg_id: MsgId of the traffic.
        pipe: pipe that would lose it.
        stream: its stream into the pipe; None if that is not captured.
        lost_from: stream that the loss is reported for: ``stream``, or the one seen behind the pipe.
        spans: spans of time in which it was sent.
        since_ns: counts until this time may be of messages from before the capture.
        sender: sending application, as events name it.
        events: events that name it; None if there are none.
        sent_ns: i64, when its messages were sent; None if that is not captured.
        queue: model of the pipe; None if its size is not known.
        counted_ns: a loss is counted at most this long after its message was sent.
        has_named: whether it was given the counts of the events that name it.
    """

    msg_id: int
    pipe: str
    stream: Stream | None
    lost_from: Stream | None
    spans: Sequence[Span]
    since_ns: int
    sender: str = ""
    events: LossEvents | None = None
    sent_ns: Integers | None = None
    queue: queues.Queue | None = None
    counted_ns: int = DRAINS_NS
    has_named: bool = False

    def active(self, start_ns: int, end_ns: int) -> range:
        """Return the indices of the spans whose losses can be counted between two times."""
        if end_ns <= self.since_ns:
            return range(0)
        if not self.spans:
            return range(self.events is not None and self.events.first_ns - TAIL_NS <= end_ns)
        # A datagram may wait in a socket for long before it is delivered, and counted.
        first = bisect_left(self.spans, start_ns - self.counted_ns, key=lambda item: item.end_ns)
        return range(first, bisect_right(self.spans, end_ns + LEAD_NS, key=lambda item: item.start_ns))

    def named(self, start_ns: int, end_ns: int) -> int:
        """Return how many of the losses counted between two times events name."""
        return self.events.within(start_ns - LEAD_NS, end_ns) if self.events else 0

    def most(self, spans: range, *times: int) -> int:
        """Return the most messages of some spans that can be lost: those beyond the limit in each round.

        If events name more of them, the pipe was read more slowly. Those that have their counts are left out.
        """
        if not self.spans:
            return int(np.iinfo(np.int32).max)
        own = self.spans[spans.start : spans.stop]
        count = sum(item.count for item in own)
        if self.queue is None or self.sent_ns is None:
            return count
        sent = self.sent_ns[own[0].first : own[-1].last + 1]
        over = _over(sent - sent[0], self.queue.round_ns, self.queue.limit(self.msg_id))
        most = min(count, int(_LATE * over) + self.queue.limit(self.msg_id))
        events = self.named(min(times[0], own[0].start_ns), max(times[1], own[-1].end_ns + self.counted_ns))
        return max(0, (count if events > most else most) - events * self.has_named)

    def beyond(self, sent_ns: Integers, start_ns: int, end_ns: int) -> int:
        """Return how many messages sent between two times the pipe has no room for; may be negative."""
        number, queue = int(((sent_ns > start_ns) & (sent_ns <= end_ns)).sum()), self.queue
        rounds = round((end_ns - start_ns) / queue.round_ns) if queue else 0
        return number - rounds * queue.limit(self.msg_id) if queue else number

    @property
    def labels(self) -> tuple[str, int, str]:
        """Label of its link ("" if not captured), MsgId and pipe."""
        return self.stream.link.label if self.stream else "", self.msg_id, self.pipe


def _not_seen(item: _Candidate, hop: Hop) -> _Candidate:
    """Return a candidate less the messages whose fate is seen: between the first and last to leave."""
    times, out_ns = hop.into.time_ns, hop.out.time_ns
    return _only(item, times, hop.absent & ((times < out_ns[0]) | (times > out_ns[-1])))


def _only(item: _Candidate, times: Integers, rows: Mask) -> _Candidate:
    """Return a candidate with some of its messages; how its pipe was read is not known."""
    parts = [np.flatnonzero(rows[span.rows]) + span.first for span in item.spans]
    ends = [(part, *part[[0, -1]].tolist()) for part in parts if len(part)]
    spans = [Span(at, last, int(times[at]), int(times[last]), len(part), 0) for part, at, last in ends]
    return replace(item, spans=spans, queue=None)


class Leftover:
    """Explains counts that no missing message explains.

    Args:
        case: the capture.
        fates: stream to what became of its messages.
        pipes: losses at application pipes, which are added to.

    Attributes:
        uncaptured: instance to the losses that it counted while the capturing interface was away, and that no
            captured message explains.
    """

    def __init__(self, case: Case, fates: Mapping[Stream | None, Fate], pipes: Pipes) -> None:
        self._case, self._counts, self._fates = case, case.loss_counts, fates
        self._pipes, self._losses = pipes, pipes.losses
        self._older_ns = {item.endpoint: item.older_until_ns for item in case.ingests}
        self.uncaptured = Counter[int]()
        self._places: dict[tuple[object, ...], Loss] = {}
        self._came: dict[Stream, Integers] = {}
        self._named: set[Stream | None] = set()
        """The streams that were given counts of the events that name them."""
        self._stalls = [x for x in case.timeline.every("stalled") if x.change.subject.kind == "cfs"]
        self._at_others = frozenset(item for item in case.reported_losses if self._at_another(item))

    def share(self, shared: Sequence[Shared]) -> None:
        """Explain counts that are left: by traffic that events name, else by traffic too fast for its pipe.

        Args:
            shared: counts that several kinds of traffic share: each becomes a loss of its own.
        """
        for item in shared:
            self._together(item, {self._labels(flow) for flow in item.flows})
        self.exclude_outages()
        for instance, counts in self._counts.items():
            for kind, rest in counts.left.items():
                if rest.any() or counts.first.get(kind, 0):
                    self._leftover(instance, counts, kind)
                old = self._old(instance)
                counts.older += int(rest[old].sum())
                rest[old] = 0

    def exclude_outages(self) -> None:
        """Leave the counts that may be of messages sent while the capturing interface was away to these.

        Captured messages whose way out is not captured may have caused them, too.
        """
        for instance, counts in self._counts.items():
            away = self._away(counts)
            spans = [counts.span([second]) for second in np.flatnonzero(away).tolist()]
            for kind, rest in counts.left.items():
                self.uncaptured[instance] += (number := int(rest[away].sum()))
                rest[away] = 0
                for item, fate, sent_ns in self._unseen(instance, kind) if number else ():
                    inside = overlapping(sent_ns, sent_ns + item.counted_ns, spans)
                    fate.ends["earlier"] += min(number, int(inside.sum()))

    def _away(self, counts: Counts) -> Mask:
        """Return which seconds may count messages that were sent while the capturing interface was away.

        A message may have been sent up to a round of CI before it was counted.
        """
        return self._case.overlaps_outage(counts.times[:-1] - WAITS_NS - LEAD_NS, counts.times[1:])

    def _absent(self) -> Iterator[tuple[ReportedLoss, LossEvents, PipeKind]]:
        """Yield losses that events name and whose traffic is not captured, such as a scheduler's wake-ups."""
        for item, report in self._case.reported_losses.items():
            if item.at_pipe and not (self._seen_behind(item) or self._fed(item)):
                yield item, report, item.at_pipe

    def _at_another(self, item: ReportedLoss) -> bool:
        """Return whether a pipe is that of another subscriber: what it lost came out all the same."""
        fate = self._carried(item) if item.at_pipe and not (item.at_output or item.at_peer) else None
        ingests = self._case.ingests_at(fate.stream.receiver) if fate is not None and fate.seen else ()
        if fate is None or not ingests or any(own.older_until_ns or own.not_captured for own in ingests):
            return False
        report = self._case.reported_losses[item]
        start_ns, end_ns = report.first_ns - WAITS_NS, report.last_ns + WAITS_NS
        own = (claim for claim in self._pipes.claims if claim.flow == fate.stream)
        lacking = sum(claim.number for claim in own if claim.low_ns < end_ns and claim.high_ns > start_ns)
        return 2 * lacking < report.count

    def take_reported(self) -> None:
        """Assign one count to every loss event; make losses of those whose way out is not captured."""
        for item, report, kind in self._absent():
            self._lose_named(item, kind, self._from_events(item, report))
        for item, report in self._case.reported_losses.items():
            fate, at_pipe = self._fed(item), item.at_pipe
            if fate is None or not at_pipe or item.at_output or item.at_peer or fate.undecidable is not None:
                continue
            if not fate.seen:
                self._lose_named(item, at_pipe, self._candidate(fate.stream, item.pipe, item.sender, report))
            elif claims := self._settled(item, at_pipe):
                # They are among the messages that lack behind the pipe.
                own = [claim for claim in self._pipes.claims if claim.flow == fate.stream]
                hand_on(self._counts[item.instance], item.instance, at_pipe, claims, own)
                self._named |= {fate.stream} if any(claim.explained for claim in claims) else set()

    def _lose_named(self, item: ReportedLoss, kind: PipeKind, whose: _Candidate) -> None:
        """Make losses of what events name, unless it may be of messages from before the capture."""

        def place(claim: Claim) -> tuple[range, int]:
            ended = self._ended(item.instance, claim.low_ns, whose)
            return whose.active(claim.low_ns, claim.high_ns), id(ended)

        claims = (claim for claim in self._settled(item, kind, whose) if claim.explained)
        for (spans, _), own in by_key(claims, place).items():
            self._named.add(whose.stream)
            times = own[0].low_ns, own[-1].high_ns
            self._make_loss(whose, spans, (item.instance, kind), sum(x.explained for x in own), times)

    def _settled(self, item: ReportedLoss, kind: PipeKind, whose: _Candidate | None = None) -> list[Claim]:
        """Return a claim a second for the events of one loss, settled."""
        counts = self._counts.get(item.instance)
        if counts is None:
            return []
        report = self._case.reported_losses[item]
        times, claims = self._case.instances.made_ns[[record.row for record in report.records]], []
        for _, members in by_value(counts.seconds(times)):
            span, of = (int(times[members].min()), int(times[members].max())), (item.instance,)
            if whose is None or whose.active(*span):
                claims.append(Claim(report, *span, len(members), (kind,), of, Rank.PRESSED, item))
        for slack_ns in (0, WAITS_NS):
            settle({item.instance: counts}, claims, slack_ns)
        return claims

    def rivals(self) -> list[Rival]:
        """Return traffic that the capture does not show and that may be lost without an event.

        That is: traffic whose events cFS has stopped, wake-ups of an application that does not run, and
        messages after the last one of a stream.
        """
        events = Counter[tuple[int, str]]()
        for item, report in self._case.reported_losses.items():
            events[item.instance, item.kind] += report.count
        out = []
        for item, report, kind in self._absent():
            is_stopped = events[item.instance, kind] >= STOPS_AFTER - 2
            end_ns = NEVER if is_stopped else report.last_ns + TAIL_NS
            out.append(Rival(item, item.instance, kind, report.first_ns - TAIL_NS, end_ns))
        for outage in (item for item in self._case.outages if item.app in TICKS):
            # Its wake-ups, one a second, fill the pipe while nobody reads it.
            end_ns = self._case.end_ns if outage.end_ns is None else outage.end_ns
            most = ceil((end_ns - outage.start_ns) / SECOND) - self._case.profile.app_msg_limit
            own = [at for at in self._counts if self._case.instances.systems[at] == outage.system]
            when = outage.start_ns, end_ns
            out += [Rival(outage, at, "limit", *when, most, fills=False) for at in own if most > 0]
        for at in self._counts:
            for each, fate, _ in self._unseen(at, "limit"):
                for place, span in enumerate(each.spans):
                    times = span.start_ns - LEAD_NS, span.end_ns + each.counted_ns
                    most = min(each.most(range(place, place + 1), *times), int(fate.open[span.rows].sum()))
                    if most:
                        out.append(Rival(each.stream, at, "limit", *times, most))
        for stream in (item for item in self._case.streams if item.known_id == EVENT_MSG_ID):
            at, last_ns = self._case.owner(stream), int(stream.time_ns[-1])
            if at in self._counts and self._counts[at].left["overflow"].any() and not events[at, "overflow"]:
                # The events that say so may not fit into the full pipe themselves.
                out.append(Rival(stream, at, "overflow", last_ns, NEVER, STOPS_AFTER))
        return [*out, *self._behind_full()]

    def _behind_full(self) -> Iterator[Rival]:
        """Yield the streams whose last round is full: losses after it leave no gap."""
        case, same = self._case, Counter((item.sender, item.msg_id) for item in self._case.streams)
        for stream in (item for item in case.streams if item.counted and not item.link.only_to_cfs):
            at, last_ns = case.owner(stream), int(stream.time_ns[-1])
            pipe = case.queue_of(stream)
            limit = case.commanded_limit(stream) or pipe.limit(stream.msg_id)
            alone = at in self._counts and same[stream.sender, stream.msg_id] == 1
            if alone and len(_full(stream.time_ns[-limit:], pipe.round_ns, limit)):
                yield Rival(stream, at, "limit", last_ns, last_ns + LATE_NS)

    def make_uncertain(self, claims: Sequence[Claim]) -> None:
        """Count messages as uncertain that may have caused the counts which gaps were given.

        This is so where gaps show that telemetry was lost behind cFS, too: then a gap need not be a count.

        Args:
            claims: claims of gaps, settled.
        """
        behind = {at for own in claims if own.rank == Rank.MISSING and own.open for at in own.instances}
        astray = [own for own in claims if own.rank == Rank.MISSING and behind.intersection(own.instances)]
        others = self._pipes.claims if astray else []  # mostly there are none, and no tables are made
        for own, number in zip(others, take_back(self._counts, astray, others), strict=True):
            ends: Counter[End] = own.messages.fate.ends
            part = min(number, ends["superseded"])
            ends["superseded"] -= part
            ends["missed"] += part
        gaps: defaultdict[tuple[int, PipeKind, Any], Counter[int]] = defaultdict(Counter)
        pressed = (item for item in claims if item.rank == Rank.PRESSED)
        for own in (item for item in pressed if behind.issuperset(item.instances)):
            for (at, kind, second), number in own.assigned.items():
                gaps[at, kind, own.flow][second] += number
        for (at, kind), keys in by_key(gaps, lambda key: key[:2]).items():
            counts, both = self._counts[at], sum((gaps[key] for key in keys), Counter[int]())
            spans = [(counts.span([second]), most) for second, most in both.items() if second != BEFORE]
            room = sum(self._room(counts, kind, key[2], gaps[key]) for key in keys)
            for item, fate, sent in self._unseen(at, kind):
                came_ns = fate.stream.time_ns  # which of these were lost before CI is not known
                more = sum(max(0, min(most, item.beyond(came_ns, *span))) for span, most in spans)
                fate.ends["earlier"] = min(len(sent), fate.ends["earlier"] + min(more, room))

    def _room(self, counts: Counts, kind: PipeKind, stream: Stream, gaps: Counter[int]) -> int:
        """Return how many missing messages of a stream its pipe may have let through, to be lost behind cFS.

        In any time the pipe lets at most its limit through in each round, and once more.

        Args:
            counts: counters that the messages were assigned to.
            kind: counter.
            stream: telemetry stream behind the pipe.
            gaps: second of ``counts`` to the number of missing messages.
        """
        case = self._case
        if kind == "overflow" or not stream.link.only_from_cfs or case.unsteady_ns:
            return gaps.total()
        queue = queues.telemetry_pipe(case.profile)
        limits = queue.limit(stream.msg_id), case.commanded_limit(stream) or 0
        limit = max(*limits, *(case.rounds(stream, span).most for span in stream.spans))
        number = np.diff(np.searchsorted(np.sort(case.instances.made_ns[stream.rows]), counts.times))
        rooms = np.diff(counts.times) * limit / queue.round_ns - number
        most, since = float(gaps[BEFORE]), np.inf
        for second, room in enumerate(rooms.tolist()):
            since = min(since, most + limit) + room
            most = min(most + gaps[second], since)
        return max(0, ceil(most))

    def make_losses(self) -> None:
        """Make losses of an unknown MsgId of the counts that nothing explains."""
        for instance, counts in self._counts.items():
            away = self._away(counts).tolist()
            assigned: Counter[PipeKind] = Counter()
            for own in self._pipes.claims:
                for (at, kind, second), part in own.assigned.items():
                    assigned[kind] += part * (at == instance and second != BEFORE and away[second])
            for kind, rest in counts.left.items():
                # A captured message may have got the count of one that was not captured.
                spared = min(assigned[kind], int(rest.sum()))
                self.uncaptured[instance] += spared
                if number := int(rest.sum()) - spared:
                    span = counts.span(np.flatnonzero(rest))
                    text = f"0x803: {COUNTER_NAMES[kind]} +{number:,} that nothing else explains"
                    self._losses.append(Loss("unknown", BUS, number, *span, "low", instance, evidence=[text]))

    def _old(self, instance: int) -> Mask:
        """Return in which seconds counts may be of messages from before the capture: a mask (seconds,)."""
        system = self._case.instances.systems[instance]
        old_ns = [item.older_until_ns for item in self._case.ingests if item.system == system]
        return np.asarray(self._counts[instance].times[1:] <= max(old_ns, default=0))

    def _leftover(self, instance: int, counts: Counts, kind: PipeKind) -> None:
        candidates, rest, old = self._candidates(instance, kind), counts.left[kind], self._old(instance)
        self._leave_earlier(instance, kind, old)
        groups: dict[tuple[Outage | None, tuple[tuple[int, range], ...]], list[int]] = {}
        for second in np.flatnonzero(rest).tolist():
            times = counts.span([second])
            own = [(index, item) for index, item in enumerate(candidates) if item.events or not old[second]]
            active = tuple((index, spans) for index, item in own if (spans := item.active(*times)))
            ended = self._ended(instance, times[0], candidates[active[0][0]]) if len(active) == 1 else None
            groups.setdefault((ended, active), []).append(second)
        for (_, active_), seconds in groups.items():
            number, times = int(rest[seconds].sum()), counts.span(seconds)
            rivals = [candidates[index] for index, _ in active_]
            most = sum(item.most(spans, *times) for item, (_, spans) in zip(rivals, active_, strict=True))
            share = min(number, most)
            if len(rivals) == 1:
                if number > most:  # others lost some, too: nothing shows which are its own but events
                    share = rivals[0].named(*times) * (not rivals[0].has_named)
                    if (fate := self._fates.get(rivals[0].stream)) is not None:
                        fate.ends["shared"] += most - share
                if share:
                    self._make_loss(rivals[0], active_[0][1], (instance, kind), share, times)
            elif rivals:
                for item in rivals:
                    if (fate := self._fates.get(item.stream)) is not None:
                        fate.ends["shared"] += min(share, len(fate.stream))
                flows = frozenset(item.stream for item in rivals if item.stream is not None)
                self._together(Shared(instance, kind, flows, share, *times), {item.labels for item in rivals})
            rest[seconds] = np.diff(np.minimum(np.cumsum(rest[seconds]), number - share), prepend=0)

    def _leave_earlier(self, instance: int, kind: PipeKind, old: Mask) -> None:
        """Count messages as uncertain that a first sample, or one before a reset, may have counted.

        Args:
            old: mask of the seconds whose counts may be of messages from before the capture.
        """
        counts, rest = self._counts[instance], self._counts[instance].left[kind]
        older, first_ns = counts.first.get(kind, 0) + int(rest[old].sum()), counts.times[int(old.sum())]
        for item, fate, sent in self._unseen(instance, kind):
            fate.ends["earlier"] += min(older, int((sent < first_ns).sum()))
            for second in counts.set_back:
                fate.ends["earlier"] += max(0, item.beyond(sent, *counts.span([second])) - int(rest[second]))

    def _unseen(self, instance: int, kind: PipeKind) -> Iterator[tuple[_Candidate, Fate, Integers]]:
        """Yield captured traffic that may explain counts, its fate, and when those without one were sent."""
        for item in self._candidates(instance, kind):
            fate = self._fates.get(item.stream)
            if fate is not None and not fate.seen:
                yield item, fate, fate.stream.time_ns[fate.open]

    def _candidates(self, instance: int, kind: PipeKind) -> list[_Candidate]:
        """Return traffic that may explain counts: that which events name, else that which is too fast."""
        case, candidates = self._case, []
        for reported, report in case.reported_losses.items():
            # Without any traffic into cFS, others than those named by events may be lost as well.
            if not self._fates or (reported.instance, reported.kind) != (instance, kind):
                continue
            out = self._seen_behind(reported)
            # Losses at a pipe whose output is captured show as gaps there, except after its last message.
            if any(stream.time_ns[-1] > report.first_ns for stream in out):
                continue
            fate = self._fed(reported)
            if fate is None:
                candidates.append(self._from_events(reported, report))
            elif not fate.seen:
                candidates.append(self._candidate(fate.stream, reported.pipe, reported.sender, report))
        return candidates or (list(self._suspects(instance)) if kind == "limit" else [])

    def _from_events(self, reported: ReportedLoss, report: LossEvents) -> _Candidate:
        out = self._seen_behind(reported)
        lost_from = out[0] if len(out) == 1 else None
        return _Candidate(reported.msg_id, reported.pipe, None, lost_from, (), 0, reported.sender, report)

    def _seen_behind(self, reported: ReportedLoss) -> list[Stream]:
        """Return the streams of its MsgId behind the pipe that a reported loss was at."""
        leaves = reported.at_output or reported.at_peer
        own = (item for item in self._case.streams if leaves and item.msg_id == reported.msg_id)
        return [item for item in own if item.link.peers == reported.at_peer]

    def _candidate(
        self, stream: Stream, pipe: str, sender: str = "", report: LossEvents | None = None
    ) -> _Candidate:
        case, spans, since_ns = self._case, stream.spans, self._older_ns.get(stream.receiver, 0)
        ingests = case.ingests_at(stream.receiver)
        # The pipe's load is known only if CI read nothing else, its socket was never full (then many come at
        # once), and the application was running.
        full = any(loss.cause == "socket" for item in ingests for loss in item.losses)
        visible = stream.link.only_to_cfs and not (full or any(item.not_captured for item in ingests))
        fate = self._fates.get(stream)
        is_read = fate is None or fate.undecidable is None
        queue = queues.application_pipe(case.profile) if visible and is_read else None
        late = [item for item in ingests if item.waiting or item.older_until_ns]
        times, reads = self._came_ns(stream), case.profile.ci_datagrams_per_wake
        # Datagrams wait in CI's socket.
        crowded = more_at_once(case.arriving(stream.receiver), case.profile.ci_wake_ns, reads)
        counted_ns = DRAINS_NS if late or full or crowded or not ingests else LATE_NS
        own = sender, report, times, queue, counted_ns, stream in self._named
        return _Candidate(stream.msg_id, pipe, stream, stream, spans, since_ns, *own)

    def _fed(self, reported: ReportedLoss) -> Fate | None:
        """Return the fate of the captured traffic that a reported loss is of; None if there is none."""
        return None if reported in self._at_others else self._carried(reported)

    def _carried(self, reported: ReportedLoss) -> Fate | None:
        """Return the fate of the captured traffic with the MsgId of a reported loss, at whatever pipe."""
        link = carrying("flight" if reported.sender.startswith("SBN") else "ground", to_cfs=True)
        alike = (fate for fate in self._fates.values() if fate.stream.link is link)
        own = (fate for fate in alike if fate.stream.msg_id == reported.msg_id)
        return next((fate for fate in own if self._case.goes_to(fate.stream, reported.instance)), None)

    def _suspects(self, instance: int) -> Iterator[_Candidate]:
        case = self._case
        application, output = queues.application_pipe(case.profile), queues.telemetry_pipe(case.profile)
        leaving = [stream for stream in case.streams if stream.link.only_from_cfs]
        followed = {hop.into: hop for hop in map(case.upstream.get, leaving) if hop}
        msg_ids = {stream.msg_id for stream in leaving}
        for stream in (item for item in case.streams if item.link.only_to_cfs or not item.is_housekeeping):
            fate, times = self._fates.get(stream), self._came_ns(stream)
            if fate and stream.link.only_to_cfs and not (fate.seen or fate.unsubscribed):
                if _fills(case, fate, instance, times, application.round_ns, application.usual_limit):
                    yield self._candidate(stream, APP)
                elif fate.stops:  # its pipe fills while nobody reads it
                    stops = [(item.start_ns, item.ended_ns) for item in fate.stops]
                    yield _only(self._candidate(stream, APP), times, overlapping(times, times, stops))
            elif stream.link.peers and stream.msg_id in msg_ids and case.goes_to(stream, instance):
                over = more_at_once(times, output.round_ns, output.limit(stream.msg_id))
                if over and case.owner(stream) != instance:
                    item, hop = self._candidate(stream, telemetry_output.PIPE), followed.get(stream)
                    yield item if hop is None else _not_seen(item, hop)

    def _came_ns(self, stream: Stream) -> Integers:
        """Return when messages reached a pipe, i64 ns: those sent while cFS stood still, when it went on."""
        if stream not in self._came:
            self._came[stream] = times = stream.time_ns.copy()
            for span in self._stalls:
                if self._case.into_system(stream, span.change.system):
                    inside = (times > span.start_lo) & (times < span.end_hi)
                    times[inside] = min(span.end_hi, self._case.end_ns)
        return self._came[stream]

    def _labels(self, flow: Any) -> tuple[str, int, str]:
        """Return link label ("" if not captured), MsgId and pipe of traffic that shares a count."""
        if isinstance(flow, Stream):
            return flow.link.label, flow.msg_id, APP if flow in self._fates else self._case.pipe_of(flow)
        if isinstance(flow, Outage):
            return "", self._case.of_known(TICKS[flow.app]), f"pipe of {flow.app}"
        return "", flow.msg_id, flow.pipe

    def _together(self, item: Shared, rivals: set[tuple[str, int, str]]) -> None:
        """Make one loss without a MsgId of counts that several kinds of traffic share."""
        text = f"0x803: {COUNTER_NAMES[item.kind]} +{item.number:,}, which may be of any of these"
        pipes = {pipe for _, _, pipe in rivals}
        hop = pipes.pop() if len(pipes) == 1 else BUS
        loss = Loss(item.kind, hop, item.number, item.start_ns, item.end_ns, "high", item.instance)
        loss.evidence, loss.rivals = [text], tuple(sorted(rivals))
        self._losses.append(loss)

    def _ended(self, instance: int, time_ns: int, of: _Candidate) -> Outage | None:
        """Return the outage in whose time nobody read the pipe of a candidate, if there is one."""
        system, fate = self._case.instances.systems[instance], self._fates.get(of.stream)
        own = (item for item in self._case.outages if item.system == system)
        mine = (item for item in own if item.reads(of.pipe) or (fate is not None and item in fate.stops))
        return next((item for item in mine if item.start_ns <= time_ns < item.ended_ns), None)

    def _make_loss(
        self, item: _Candidate, spans: range, at: CounterKey, number: int, times: tuple[int, int]
    ) -> None:
        instance, kind = at
        cut = item.spans[spans[-1]] if item.spans else None
        among, ended = None, self._ended(instance, times[0], item) if cut is not None else None
        if cut is not None and item.stream is not None:  # the messages of the span without a fate
            rows, fate = np.arange(cut.first, cut.last + 1), self._fates.get(item.stream)
            if fate is not None and fate.undecidable is not None and len(spans) == 1:
                sent_ns = item.stream.time_ns[rows]
                rows = rows[(sent_ns > times[0] - item.counted_ns) & (sent_ns <= times[1])]
                fate.followed += max(0, number - int((~fate.undecidable[rows]).sum()))
            among = Among(item.stream, rows if fate is None else rows[fate.open[rows]])
            if item.events is not None and not ended:
                self._pipes.add_loss(among, cut, at, number)
                return
        text = f"0x803: {COUNTER_NAMES[kind]} +{number:,} that nothing else explains"
        evidence = [text, "no event names it: suppressed, filtered, or lost itself"]
        if item.events is not None:
            evidence = [item.events.text(item.events.count), text]
        start_ns, end_ns = (cut.start_ns, cut.end_ns) if cut and not ended else times
        loss = Loss(kind, item.pipe, number, start_ns, end_ns, "medium", instance, item.msg_id)
        if ended:
            evidence = [ended.witness, f"0x803 counted {number:,} of them: nobody read the pipe"]
            loss.kind, loss.hop = "stopped", ended.app
        loss.stream, loss.span, loss.of = item.lost_from, cut, cut.count if cut else None
        loss.evidence, loss.sender, loss.among = evidence, item.sender, among
        self._add(loss)

    def _add(self, loss: Loss) -> None:
        """Add a loss, or add it to the one of the same traffic, place and span."""
        key = loss.kind, loss.hop, loss.instance, loss.msg_id, loss.sender, loss.span
        before = self._places.setdefault(key, loss)
        if before is loss:
            self._losses.append(loss)
            return
        before.lost += loss.lost
        before.start_ns, before.end_ns = min(before.start_ns, loss.start_ns), max(before.end_ns, loss.end_ns)
        before.evidence += [line for line in loss.evidence if line not in before.evidence]
