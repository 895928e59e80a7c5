"""What a counter of the software bus counted and nothing that came out explains: shared out, or not known.

To what events name, else to what is sent faster than a pipe takes; what is left is lost, and not known which.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.cfs import names, queues, telemetry_output
from edoras_tools.diagnosis.accounting.claims import Counts, Shared
from edoras_tools.diagnosis.accounting.fates import WAITS_NS, Fate
from edoras_tools.diagnosis.accounting.ingest import DRAINS_NS
from edoras_tools.diagnosis.accounting.losses import (
    APP,
    COUNTER_NAMES,
    COUNTERS,
    LEAD_NS,
    PIPE_EVENTS,
    TAIL_NS,
    Among,
    Loss,
)
from edoras_tools.links.table import carrying
from edoras_tools.model import NO_ROUTE

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from edoras_tools.diagnosis.accounting.losses import Known, PipeKind
    from edoras_tools.diagnosis.accounting.pipes import Pipes
    from edoras_tools.diagnosis.evidence.loss_reports import LossEvents, ReportedLoss
    from edoras_tools.diagnosis.matching.spans import Span
    from edoras_tools.diagnosis.matching.streams import Stream


class Candidate:
    """What a counter may have counted.

    Attributes:
        instance: whose counter.
        kind: which.
        msg_id: of what.
        pipe: where it would be lost.
        stream: its traffic; None where that is not in the capture.
        lost_from: the stream that lacks them; that traffic, or what was seen behind the pipe.
        sender: who sends it, as an event names it.
        said: the events that name it.
        spans: its traffic in time.
        since_ns: until then what was counted may have been sent before the capture began.
    """

    def __init__(
        self,
        known: Known,
        instance: int,
        kind: PipeKind,
        msg_id: int,
        pipe: str,
        stream: Stream | None,
        sender: str = "",
        said: LossEvents | None = None,
    ) -> None:
        self.instance, self.kind, self.msg_id, self.pipe = instance, kind, msg_id, pipe
        self.stream, self.sender, self.said = stream, sender, said
        self.lost_from = stream
        self.spans = known.spans(stream) if stream is not None else []
        self.times = known.captured(stream) if stream is not None else np.zeros(0, np.int64)
        self.since_ns = 0

    def most_at_once(self, period_ns: int) -> int:
        """Return the most of its messages within a period of time."""
        ends = np.searchsorted(self.times, self.times + period_ns)
        return int((ends - np.arange(len(self.times))).max())

    def active(self, start_ns: int, end_ns: int) -> int | None:
        """Return which of its spans can be counted in a second; None where none can, or another may be."""
        if end_ns <= self.since_ns:
            return None
        if not self.spans:
            told = self.said is not None and self.said.first_ns - TAIL_NS <= end_ns
            return 0 if told else None
        before = [index for index, item in enumerate(self.spans) if item.start_ns - LEAD_NS <= end_ns]
        # What waits in a socket is delivered, and counted, long after it was sent.
        return before[-1] if before and start_ns - self.spans[before[-1]].end_ns <= DRAINS_NS else None

    def most(self, span: int) -> int:
        """Return how many of a span can have been lost."""
        return self.spans[span].count if self.spans else np.iinfo(np.int32).max


class Leftover:
    """Shares out what counters have left.

    Args:
        counts: of each instance, less what was told of them.
        fates: id of a stream to what became of its messages.
        older_ns: endpoint of a CI to until when it may have read what was sent before the capture.

    Attributes:
        uncaptured: instance to what it counted lost while the capturing interface was away, and is told of
            nothing that was captured.
    """

    def __init__(
        self,
        known: Known,
        counts: Mapping[int, Counts],
        fates: Mapping[int, Fate],
        pipes: Pipes,
        older_ns: Mapping[int, int],
    ) -> None:
        self._gaps: Sequence[Loss] = ()
        self._unplaced: dict[int, int] = {}
        self._known, self._counts, self.fates, self._pipes = known, counts, fates, pipes
        self._older_ns, self.losses = older_ns, pipes.losses
        self.uncaptured: dict[int, int] = {}

    def share(self, shared: Sequence[Shared]) -> None:
        """Share out what nothing has taken: to what events name, else to what is sent too fast for a pipe.

        Args:
            shared: counts that several kinds of traffic share: each is a loss of its own.
        """
        streams = {id(stream): stream for stream in self._known.streams}
        for item in shared:
            rivals = [streams[flow] for flow in item.flows]
            named = {(stream.link.label, stream.msg_id, self._pipe(stream)) for stream in rivals}
            self._together(item, named)
        for instance, counts in self._counts.items():
            # What is counted now was sent up to a round of CI before.
            away = self._known.away(counts.times[:-1] - WAITS_NS - LEAD_NS, counts.times[1:])
            for kind in COUNTERS:
                if number := int(counts.left[kind][away].sum()):
                    self.uncaptured[instance] = self.uncaptured.get(instance, 0) + number
                    counts.left[kind][away] = 0
                if counts.left[kind].any():
                    self._leftover(instance, counts, kind)

    def tell(self, gaps: Sequence[Loss]) -> None:
        """Make losses of what nothing explains.

        Args:
            gaps: losses behind cFS; another cFS may have counted those of which nothing tells where.
        """
        self._gaps = gaps
        self._unplaced = {at: loss.lost for at, loss in enumerate(gaps) if loss.kind == "unknown"}
        for instance, counts in self._counts.items():
            for kind, left in counts.left.items():
                seconds = np.flatnonzero(left).tolist()
                if seconds:
                    self._unknown(instance, kind, int(left.sum()), counts, seconds)

    def _leftover(self, instance: int, counts: Counts, kind: PipeKind) -> None:
        candidates = self._candidates(instance, kind)
        left = counts.left[kind]
        groups: dict[tuple[tuple[int, int], ...], list[int]] = {}
        for second in np.flatnonzero(left).tolist():
            start_ns, end_ns = int(counts.times[second]), int(counts.times[second + 1])
            active = tuple(
                (index, span)
                for index, item in enumerate(candidates)
                if (span := item.active(start_ns, end_ns)) is not None
            )
            groups.setdefault(active, []).append(second)
        for active, seconds in groups.items():
            number = int(left[seconds].sum())
            times = int(counts.times[seconds[0]]), int(counts.times[seconds[-1] + 1])
            most = sum(candidates[index].most(span) for index, span in active)
            share = min(number, most)
            if len(active) == 1:
                (((index, span),), number) = active, number - share
                self._blame(candidates[index], span, share, times)
            elif active:
                number -= share
                rivals = [candidates[index] for index, _ in active]
                flows = frozenset(id(item.stream) for item in rivals if item.stream is not None)
                for item in rivals:
                    fate = self.fates.get(id(item.stream))
                    if fate is not None:
                        fate.shared += min(share, len(fate.stream))
                self._together(
                    Shared(instance, kind, flows, share, *times),
                    {
                        (item.stream.link.label if item.stream else "", item.msg_id, item.pipe)
                        for item in rivals
                    },
                )
            for second in seconds:
                part = min(int(left[second]), number)
                number -= part
                left[second] = part

    def _candidates(self, instance: int, kind: PipeKind) -> list[Candidate]:
        """Return what may be counted: what events name, else what is sent faster than a pipe takes."""
        known = self._known
        found = []
        for reported, said in known.reported_losses.items():
            if (reported.instance, reported.kind) != (instance, kind):
                continue
            out = [
                stream
                for stream in known.streams
                if (reported.at_output or reported.at_peer)
                and stream.msg_id == reported.msg_id
                and stream.link.peers == reported.at_peer
            ]
            # What leaves by a pipe and is seen behind it has gaps, which are counted there; what is lost
            # behind the last message that was seen leaves none.
            if any(known.captured(stream)[-1] > said.first_ns for stream in out):
                continue
            fate = self._fed(reported, instance)
            if fate is None or not fate.seen:
                stream = fate.stream if fate else None
                item = Candidate(
                    known, instance, kind, reported.msg_id, reported.pipe, stream, reported.sender, said
                )
                if stream is None and len(out) == 1:
                    item.lost_from = out[0]
                found.append(item)
        if not found and kind == "limit":
            found = list(self._suspects(instance))
        for item in found:
            if item.stream is not None:
                item.since_ns = self._older_ns.get(item.stream.receiver, 0)
        return found

    def _fed(self, reported: ReportedLoss, instance: int) -> Fate | None:
        """Return the traffic that the messages of a reported loss came from, if the capture has it."""
        wanted = carrying("flight" if reported.sender.startswith("SBN") else "ground", to_cfs=True)
        return next(
            (
                fate
                for fate in self.fates.values()
                if fate.stream.msg_id == reported.msg_id
                and fate.stream.link is wanted
                and self._known.goes_to(fate.stream, instance)
            ),
            None,
        )

    def _suspects(self, instance: int) -> Iterator[Candidate]:
        known, profile = self._known, self._known.profile
        application, output = queues.application_pipe(profile), queues.telemetry_pipe(profile)
        leaving = {stream.msg_id for stream in known.streams if stream.link.only_from_cfs}
        for stream in known.streams:
            if stream.known_id in names.MSG_ID_NAMES and stream.route == NO_ROUTE:
                continue
            fate = self.fates.get(id(stream))
            if stream.link.only_to_cfs and not (fate and fate.seen):
                item = Candidate(known, instance, "limit", stream.msg_id, APP, stream)
                if item.most_at_once(application.round_ns) > application.usual_limit:
                    yield item
            elif stream.link.peers and stream.msg_id in leaving and known.goes_to(stream, instance):
                item = Candidate(known, instance, "limit", stream.msg_id, telemetry_output.PIPE, stream)
                limit = output.limit(stream.msg_id)
                if item.most_at_once(output.round_ns) > limit and known.owner(stream) != instance:
                    yield item

    def _pipe(self, stream: Stream) -> str:
        """Return the pipe that traffic goes into: an application's, Telemetry Output's or an SBN peer's."""
        return APP if id(stream) in self.fates else self._known.hop(stream)

    def _together(self, item: Shared, rivals: set[tuple[str, int, str]]) -> None:
        """Tell counts that several kinds of traffic share as one loss, of none of them."""
        text = f"0x803: {COUNTER_NAMES[item.kind]} +{item.number:,}, which may be of any of these"
        self.losses.append(
            Loss(
                kind=item.kind,
                instance=item.instance,
                hop="software bus",
                lost=item.number,
                start_ns=item.start_ns,
                end_ns=item.end_ns,
                confidence="high",
                evidence=[text],
                rivals=tuple(sorted(rivals)),
            )
        )

    def _blame(self, item: Candidate, span: int, number: int, times: tuple[int, int]) -> None:
        cut = item.spans[span] if item.spans else None
        among = self._among(item.stream, cut) if cut is not None and item.stream is not None else None
        if cut is not None and among is not None and item.said is not None:
            self._pipes.lose(among.stream, cut, item.kind, number, item.instance, among.rows)
            return
        start_ns, end_ns = (cut.start_ns, cut.end_ns) if cut else times
        text = f"0x803: {COUNTER_NAMES[item.kind]} +{number:,} that nothing else explains"
        evidence = [text, "no event names it: suppressed, filtered, or lost itself"]
        if item.said is not None:
            evidence = [
                f"event CFE_SB {PIPE_EVENTS[item.kind]} x{item.said.count}: {item.said.records[0].message}",
                text,
            ]
        self.losses.append(
            Loss(
                kind=item.kind,
                instance=item.instance,
                hop=item.pipe,
                msg_id=item.msg_id,
                stream=item.lost_from,
                span=cut,
                lost=number,
                of=cut.count if cut else None,
                start_ns=start_ns,
                end_ns=end_ns,
                confidence="medium",
                evidence=evidence,
                sender=item.sender,
                among=among,
            )
        )

    def _among(self, stream: Stream, cut: Span) -> Among:
        """Return the messages of a span of which nothing has told what became of them."""
        rows, fate = np.arange(cut.first, cut.last + 1), self.fates.get(id(stream))
        return Among(stream, rows if fate is None else rows[fate.open[rows]])

    def _unknown(
        self, instance: int, kind: PipeKind, number: int, counts: Counts, seconds: list[int]
    ) -> None:
        start_ns, end_ns = int(counts.times[seconds[0]]), int(counts.times[seconds[-1] + 1])
        number -= self._elsewhere(instance, kind, number, start_ns, end_ns)
        if not number:
            return
        self.losses.append(
            Loss(
                kind="unknown",
                instance=instance,
                hop="software bus",
                lost=number,
                start_ns=start_ns,
                end_ns=end_ns,
                confidence="low",
                evidence=[f"0x803: {COUNTER_NAMES[kind]} +{number:,} that nothing else explains"],
            )
        )

    def _elsewhere(self, instance: int, kind: PipeKind, number: int, start_ns: int, end_ns: int) -> int:
        """Return how many are missing behind another cFS at that time, which are told there.

        What one cFS loses on the way to another leaves a gap behind that one: one loss, not two.
        """
        told = 0
        for at, left in self._unplaced.items():
            gap = self._gaps[at]
            apart = gap.start_ns - LEAD_NS > end_ns or gap.end_ns + TAIL_NS < start_ns
            share = 0 if apart or gap.instance == instance else min(left, number - told)
            if share:
                self._unplaced[at] -= share
                told += share
                gap.evidence.append(
                    f"0x803 of {self._known.label(instance)}: {COUNTER_NAMES[kind]} +{share:,} that nothing "
                    "else explains, which may be these"
                )
        return told
