"""What pipes lost of the messages that went into cFS, by what came out again; and when a pipe was full."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.cfs import queues
from edoras_tools.cfs.software_bus import STOPS_AFTER
from edoras_tools.diagnosis.accounting.claims import (
    ABSENT,
    BEFORE,
    INTO_STOP,
    POSSIBLE,
    PRESSED,
    QUIET,
    Claim,
    Counts,
    claimed_alike,
)
from edoras_tools.diagnosis.accounting.losses import (
    APP,
    COUNTER_NAMES,
    COUNTERS,
    LEAD_NS,
    PIPE_EVENTS,
    TAIL_NS,
    Among,
    Loss,
    PipeKind,
)
from edoras_tools.diagnosis.evidence.instances import NOBODY
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.accounting.fates import Fate
    from edoras_tools.diagnosis.accounting.losses import Known
    from edoras_tools.diagnosis.evidence.loss_reports import LossEvents, ReportedLoss
    from edoras_tools.diagnosis.matching.spans import Span
    from edoras_tools.diagnosis.matching.streams import Stream

LATE_NS: Final = 2 * SECOND
"""A count is seen within so long of what it counts."""
_RANKS: Final = (ABSENT, POSSIBLE + 1, POSSIBLE + 3, POSSIBLE + 2, INTO_STOP, POSSIBLE + 2)
"""Ranks of the claims of ``_standing`` messages."""
_FIRST: Final = "; its first value already had some"
_MAY_WAIT: Final = 2
_BLIND: Final = 3
_OVER: Final = 1.02
_OFTEN: Final = 1
"""A size of rounds that is met more often shows how deep a pipe is."""
_FULL: Final = 0.3
"""Rounds of which so many are full show how many may wait."""


def _standing(fate: Fate) -> tuple[NDArray[np.bool_], ...]:
    """Return which messages lack, may have gone on, may yet come, nobody sees, were sent to nobody, end."""
    into_stop = fate.open & (fate.stop >= 0)
    others = fate.open & ~into_stop
    sure = others & ~fate.newer & ~fate.passed & ~fate.edge & fate.seen
    return sure, others & ~sure & ~fate.edge, fate.waits, fate.blind, into_stop, others & fate.edge


@dataclass(slots=True)
class _Own:
    """Messages of one span of a stream that can have been counted in the same seconds."""

    fate: Fate
    span: int
    rows: NDArray[np.intp]
    standing: int


class Pipes:
    """Tells what was lost at pipes, of messages whose way out can be seen.

    Args:
        counts: of each instance, less what was told of them.

    Attributes:
        claims: of messages that counters may have counted.
    """

    def __init__(self, known: Known, counts: Mapping[int, Counts], losses: list[Loss]) -> None:
        self._known, self._counts, self.losses = known, counts, losses
        self._indexed = 0
        self._same: dict[tuple[object, ...], Loss] = {}
        self.claims: list[Claim] = []
        self._whose: list[_Own] = []

    def claim(self, fate: Fate) -> None:
        """Claim counts for messages that did not come out, of each cFS that they may have gone to."""
        stream = fate.stream
        group = [
            instance
            for instance in self._counts
            if self._known.goes_to(stream, instance) and self._leaves(fate, instance)
        ]
        kinds = [
            kind for kind in COUNTERS if any(self._named(stream, kind, instance)[0] for instance in group)
        ]
        named = bool(kinds)
        # Of traffic that nobody can follow events tell that it has a part in what others' counts may be.
        if not group or not (fate.seen or (named and self._known.hops)):
            return
        kinds += [kind for kind in COUNTERS if kind not in kinds]
        low_ns, high_ns = self._times(fate)
        which = np.searchsorted([item.first for item in fate.spans], np.arange(len(stream)), "right") - 1
        counts = [self._counts[instance] for instance in group]
        for place, there in enumerate(_standing(fate)):
            if place == _BLIND and not named:
                continue
            rows, rank = np.flatnonzero(there), _RANKS[place]
            if named:
                rank = PRESSED if rank == ABSENT else rank
            elif not self._bursts(fate):
                rank = {ABSENT: QUIET, INTO_STOP: INTO_STOP}.get(rank, rank + len(_RANKS))
            if place == _MAY_WAIT:
                rows = rows[np.logical_or.reduce([own.often(low_ns[rows], high_ns[rows]) for own in counts])]
            for members in claimed_alike(counts, low_ns[rows], high_ns[rows], which[rows]):
                own = rows[members]
                span = int(low_ns[own[0]]), int(high_ns[own[0]])
                self.claims.append(
                    Claim(len(self._whose), *span, len(own), tuple(kinds), group, rank, id(stream))
                )
                self._whose.append(_Own(fate, int(which[own[0]]), own, place))

    def _bursts(self, fate: Fate) -> bool:
        """Tell whether more of a stream may come to its pipe in one round than that takes."""
        times, profile = self._known.captured(fate.stream), self._known.profile
        period = (
            profile.ci_wake_ns if fate.stream.link.only_to_cfs else profile.sbn_wake_ns * profile.sbn_polls
        )
        most = np.searchsorted(times, times + period) - np.arange(len(times))
        return bool(most.max() > profile.app_msg_limit)

    def _times(self, fate: Fate) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return from when and until when each message can have been counted: i64, capture time in ns.

        CI hands on in order: what it lost was handed on before the next one that came out did.
        """
        times = self._known.captured(fate.stream)
        delay = max((hop.last_ns for hop in fate.hops), default=0)
        low_ns = np.maximum(times - LEAD_NS, self._taken_since(fate, times))
        return low_ns, times + delay + LATE_NS

    def tell(self) -> None:
        """Make losses of what was given to the claims."""
        for claim in self.claims:
            own, at = self._whose[claim.key], 0
            cut = own.fate.spans[own.span]
            rows = np.arange(cut.first, cut.last + 1)
            among = rows[_standing(own.fate)[own.standing][rows]] if claim.taken else rows
            for (instance, kind), number in claim.by_kind().items():
                first = (instance, kind, BEFORE) in claim.taken
                self.lose(own.fate.stream, cut, kind, number, instance, among, first=first)
                chosen = own.rows[at : at + number]
                own.fate.open[chosen] = own.fate.waits[chosen] = own.fate.blind[chosen] = False
                at += number

    def _leaves(self, fate: Fate, instance: int) -> bool:
        """Tell whether an instance is the one that a stream into cFS goes to, where several are there."""
        owners = {self._known.owner(hop.out) for hop in fate.hops if not hop.out.link.last_hop}
        return not owners or instance in owners or NOBODY in owners

    def _taken_since(self, fate: Fate, times: NDArray[np.int64]) -> int:
        """Return from when on a stream was taken: CI first takes what waits from before the capture."""
        firsts = [hop.first for hop in fate.hops if hop.first is not None]
        if not firsts or not fate.stream.link.only_to_cfs:
            return 0
        out_ns, went_ns = min(firsts)
        profile = self._known.profile
        wakes = 1 + int(np.searchsorted(times, went_ns)) // profile.ci_datagrams_per_wake
        return out_ns - wakes * profile.ci_wake_ns - LEAD_NS

    def lose(
        self,
        stream: Stream,
        cut: Span,
        kind: PipeKind,
        number: int,
        instance: int,
        among: NDArray[np.intp],
        *,
        first: bool = False,
    ) -> None:
        """Add to the loss at a pipe of a span of a stream.

        Args:
            instance: the cFS that counted them.
            among: which they are, or are some of.
            first: some are of what the first 0x803 had counted already.
        """
        loss = self._known_loss(stream, kind, instance, cut)
        if loss is not None:
            loss.lost += number
            before = loss.among.rows if loss.among else among[:0]
            loss.among = Among(stream, np.union1d(before, among))
            return
        reported, said = self._named(stream, kind, instance)
        evidence = [f"0x803: {COUNTER_NAMES[kind]} counts them{_FIRST if first else ''}"]
        if said is not None:
            window = cut.start_ns - LEAD_NS, cut.end_ns + TAIL_NS
            events = said.within(*window)
            if events:
                evidence.insert(0, f"event CFE_SB {PIPE_EVENTS[kind]} x{events}: {said.records[0].message}")
            track = self._known.tracks[instance]
            if track.growth(COUNTERS[kind], said.last_ns + LEAD_NS) > 0 and said.count >= STOPS_AFTER - 2:
                evidence.append(f"cFS stops this event after {STOPS_AFTER}; the counter goes on")
        else:
            evidence.append("no event names it: suppressed, filtered, or lost itself")
        of, start_ns, end_ns = self._sent_to(stream, cut, instance)
        self.losses.append(
            Loss(
                kind=kind,
                instance=instance,
                hop=reported.pipe if reported else APP,
                msg_id=stream.msg_id,
                stream=stream,
                span=cut,
                lost=number,
                of=of,
                start_ns=start_ns,
                end_ns=end_ns,
                confidence="high" if reported else "medium",
                evidence=evidence,
                sender=reported.sender if reported else "",
                among=Among(stream, among),
            )
        )

    def _sent_to(self, stream: Stream, cut: Span, instance: int) -> tuple[int, int, int]:
        """Return how many of a span were sent in the life of one cFS, and from when to when."""
        items, systems = self._known.instances.items, self._known.instances.systems
        item, system = items[instance], systems[instance]
        own = [other.offset_ns for other, its in zip(items, systems, strict=True) if its == system]
        times = self._known.captured(stream)[cut.first : cut.last + 1]
        boot_ns = item.boot_ns(self._known.profile)
        inside = times[(times > (boot_ns if item.offset_ns > min(own) else 0))]
        inside = inside[inside <= item.last_ns] if item.offset_ns < max(own) else inside
        if not len(inside):
            return cut.count, cut.start_ns, cut.end_ns
        return len(inside), max(cut.start_ns, int(inside[0])), min(cut.end_ns, int(inside[-1]))

    def _known_loss(self, stream: Stream, kind: PipeKind, instance: int, cut: Span) -> Loss | None:
        """Return the loss of a span that an instance is known to have counted as a kind."""
        for loss in self.losses[self._indexed :]:
            self._same.setdefault((id(loss.stream), loss.kind, loss.instance, loss.span), loss)
        self._indexed = len(self.losses)
        return self._same.get((id(stream), kind, instance, cut))

    def _named(
        self, stream: Stream, kind: PipeKind, instance: int
    ) -> tuple[ReportedLoss | None, LossEvents | None]:
        for reported, said in self._known.reported_losses.items():
            if (reported.instance, reported.msg_id, reported.kind) == (instance, stream.msg_id, kind):
                return reported, said
        return None, None


def pressed(known: Known, stream: Stream, span: Span, kind: PipeKind, missing: NDArray[np.int64]) -> bool:
    """Tell whether so much came that a pipe can have lost what is missing from a span of a stream.

    Where a MsgId's limit or a whole pipe is full, what did get in comes out in one burst, and the loss lies
    beside it; or more of the MsgId is sent in a round, on the average, than the pipe takes.

    Args:
        kind: over the MsgId's limit, or out of a full pipe.
        missing: (rows of the stream,), what is missing behind each.
    """
    profile, output = known.profile, stream.link.only_from_cfs
    queue = queues.telemetry_pipe(profile) if output else queues.peer_pipe(profile)
    period, limit = queue.round_ns, queue.limit(stream.msg_id)
    own = known.captured(stream)
    at = np.arange(span.first, min(span.last + 1, len(own) - 1))
    at = at[missing[at] > 0]
    if kind == "overflow":
        sent = (known.rows.link == stream.link) & (known.rows.source == stream.sender)
        if not output:
            sent &= known.rows.destination == stream.receiver
        times = known.rows.time_ns[sent]
        # Some of what fills the pipe may not be here: half of it tells.
        full = _full(times, period, min(queue.depth // 2, measured_depth(times, period)))
        return _beside(full, own[at] - period, own[at + 1] + period, missing[at])
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


def measured_depth(times: NDArray[np.int64], period: int) -> int:
    """Return how deep a pipe is by the rounds that come out of it: a size often met and never passed."""
    if len(times) < 2:
        return int(np.iinfo(np.int64).max)
    begins = np.flatnonzero(np.diff(times, prepend=times[0] - period) > period // 2)
    sizes = np.diff(np.append(begins, len(times)))
    most = int(sizes.max())
    often = int((sizes == most).sum())
    return most if often > _OFTEN else int(np.iinfo(np.int64).max)


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
