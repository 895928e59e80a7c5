"""The two values of the accounting: a loss, and the fate of each message of a stream into cFS.

Rules:

1. A loss has messages of one route, lost at one place, for one cause, in one span of time.
2. Each lost message belongs to exactly one loss. The ledger adds losses up; the rules explain them.
3. A message of a stream is open until a loss claims it, or until it ends in another way (``End``).

Every step of ``commands`` takes fates and adds to the lists of losses. The ledger makes one entry of each
loss, and one of each end.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

import msgspec
import numpy as np

from edoras_tools.cfs import command_ingest, executive_services, sbn
from edoras_tools.diagnosis.evidence.instances import NOBODY
from edoras_tools.diagnosis.evidence.loss_reports import PipeKind
from edoras_tools.diagnosis.quality import overlapping
from edoras_tools.model import NO_MSG_ID
from edoras_tools.units import MILLISECOND, SECOND

if TYPE_CHECKING:
    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.matching.crossing import Hop
    from edoras_tools.diagnosis.matching.streams import Span, Stream
    from edoras_tools.diagnosis.verdict import Confidence, Verdict
    from edoras_tools.wire.arrays import Integers, Mask, Places

IngestKind = Literal["network", "socket", "sbn_socket", "down", "restart", "ci_stopped", "port_closed"]
AppKind = Literal["stopped", "restart_failed", "away", "unsubscribed", "disabled", "route", "beside"]
LossKind = PipeKind | IngestKind | AppKind | Literal["after", "unknown", "fragments", "damaged"]
"""Causes of a loss.

- At a pipe: ``limit`` of messages of one MsgId, ``overflow`` of the pipe.
- At CI: ``network`` in front of it, its full ``socket`` (``sbn_socket``: that of SBN), cFS ``down``,
  ``restart`` of CI, ``ci_stopped``, ``port_closed`` (no listener).
- Behind CI: application ``stopped``, ``restart_failed`` (it restarted and sent nothing more), SBN peer
  ``away`` or ``unsubscribed``, Telemetry Output ``disabled``, bus ``route`` disabled.
- Else: ``after`` cFS, ``fragments`` (only the first ones came), ``damaged`` (wrong checksum), ``unknown``
  (place or MsgId).
"""

LEAD_NS: Final = 700 * MILLISECOND
"""Longest time from the count of a loss to the next captured message of the stream."""
TAIL_NS: Final = 2500 * MILLISECOND
"""Longest time from a loss to the housekeeping that counts it: a period of 1 s, and 0.5 s in TO's pipe."""
COUNTERS: Final[Mapping[PipeKind, str]] = {"limit": "msg_limits", "overflow": "pipe_overflows"}
"""Kind of loss at a pipe to the counter in 0x803 that it raises, as ``Track`` names it."""
COUNTER_NAMES: Final[Mapping[PipeKind, str]] = {"limit": "MsgLimit", "overflow": "PipeOverflow"}
APP: Final = "application pipe"
CI_SOCKETS: Final = tuple(f"{name} socket" for name in command_ingest.NAMES)
CI_SOCKET: Final = CI_SOCKETS[0]
BEFORE_CI: Final = "network before CI"
SBN_SOCKET: Final = "SBN socket"
BUS: Final = "software bus"
BEHIND: Final = "between cFS and the capture"


class Among(NamedTuple):
    """The candidates of a loss: messages of which some or all are lost.

    Attributes:
        stream: stream that has the messages, or the gaps.
        rows: intp (n,), indices into its rows: the messages themselves, or the rows in front of gaps.
        missing: i64 (n,), missing messages behind each row; None if the rows are the messages.
    """

    stream: Stream
    rows: Places
    missing: Integers | None = None

    @property
    def times_ns(self) -> tuple[int, int]:
        """Times of the first and the last message, ns; for gaps, of the rows in front and behind."""
        times, last = self.stream.time_ns, int(self.rows[-1]) + (self.missing is not None)
        return int(times[self.rows[0]]), int(times[min(last, len(times) - 1)])


class Loss(msgspec.Struct):
    """Messages of one route that were lost at one place in one span of time.

    Attributes:
        kind: cause of the loss.
        hop: name of the place.
        lost: number of lost messages.
        start_ns: begin of the span, ns.
        end_ns: end of the span, ns.
        confidence: certainty of the cause.
        instance: index of the instance that lost them; ``NOBODY`` if unknown.
        msg_id: MsgId of the messages; ``NO_MSG_ID`` if unknown.
        stream: stream that has the messages, or the gaps; None if the capture has none.
        span: span of the stream at one rate; None for the whole capture.
        of: number of messages sent in that time; None if unknown.
        evidence: facts that prove it, one sentence each.
        sender: name of the sending application, from an event; else empty.
        closed: whether Telemetry Output was not sending in that time, so it would not have sent them either.
        among: candidates of the loss; None if unknown.
        rivals: link label, MsgId and hop of each traffic that may own the loss; empty if one does.
        uncounted: number of these messages that no counter has.
    """

    kind: LossKind
    hop: str
    lost: int
    start_ns: int
    end_ns: int
    confidence: Confidence
    instance: int = NOBODY
    msg_id: int = NO_MSG_ID
    stream: Stream | None = None
    span: Span | None = None
    of: int | None = None
    evidence: list[str] = msgspec.field(default_factory=list)
    sender: str = ""
    closed: bool = False
    among: Among | None = None
    rivals: tuple[tuple[str, int, str], ...] = ()
    uncounted: int = 0

    @property
    def over_network(self) -> bool:
        """Whether SBN put the messages on the bus."""
        return self.sender.startswith(sbn.NAME) or (self.stream is not None and self.stream.link.peers)

    @property
    def offered_hz(self) -> float:
        """Messages sent per second, including the lost ones; 0 if unknown."""
        seconds = (self.end_ns - self.start_ns) / SECOND
        return (self.of - 1) / seconds if self.of and seconds > 0 else 0.0


READY_NS: Final = 5 * SECOND
"""Longest time from the start of an application until it processes messages."""
WAITS_NS: Final = SECOND
"""A message sent this shortly before the end may still come out."""
_NEARLY_ALL: Final = 0.9
_WOKEN_NS: Final = SECOND // 10
"""No scheduler wakes an application as often as this."""
_LAST: Final = 5
"""Number of messages at the end that show the present delay."""
_BURST_NS: Final = 50 * MILLISECOND
"""Messages sent within this time are read in one round."""


EndAtCi = Literal["queued", "crowded", "late"]
"""Ends at CI.

- ``queued``: the message may wait in CI's socket.
- ``crowded``: it may wait there only if the socket holds more than usual; or CI may have read it just before
  it went down, or before its first sample.
- ``late``: it was sent after CI's last sample.
"""
EndOnBus = Literal["earlier", "shared", "elsewhere"]
"""Ends on the software bus.

- ``earlier``: the message may be a loss that the first sample of 0x803 already had.
- ``shared``: upper bound of this traffic's part in a counter that several traffics raised.
- ``elsewhere``: the message did not come out, and may be part of such a counter.
"""
EndAtApp = Literal["passed_on", "superseded", "unaccounted", "uncertain", "missed", "held", "beyond"]
"""Ends at the application.

- ``passed_on``: the message came out, and was lost behind that.
- ``superseded``: a newer message replaced it.
- ``unaccounted``: nothing shows its fate.
- ``uncertain``: it may still come out, but its pipe lost messages to the end.
- ``missed``: it may have come out, and the capture may have missed it.
- ``held``: the application may have read it just before it was stopped, or when it was back, and replaced it.
- ``beyond``: it was sent before the first message that came out, or after the last one. It may have come out
  and been lost behind the application.
"""
End = EndAtCi | EndOnBus | EndAtApp
"""The ends of messages into cFS that belong to no loss: at CI, on the bus, or at the application."""


class Outage(NamedTuple):
    """A time in which an application did not run. Capture times in ns.

    Attributes:
        app: its name.
        start_ns: the command to stop it, or the event that it stopped.
        end_ns: the event that it started again; None if there is none.
        ended_ns: from this time on it surely received nothing.
        asked_ns: until this time it surely received nothing: then it was commanded to start; else ``NEVER``.
        witness: commands and events that show it.
        system: number of its cFS.
        restarted: whether it was restarted; else it was stopped.
    """

    app: str
    start_ns: int
    end_ns: int | None
    ended_ns: int
    asked_ns: int
    witness: str
    system: int
    restarted: bool = False

    def reads(self, pipe: str) -> bool:
        """Return whether a pipe is the application's, by its name, as EDORAS_APP_PIPE."""
        return pipe.startswith(f"{self.app}_")


@dataclass(slots=True)
class Fate:
    """The fates of all messages of one stream into cFS.

    A message is ``open`` until ``claim`` or ``end`` decides it. One that waits is opened again if nobody will
    ever read it. The other masks say why a message may be no loss.

    Attributes:
        stream: stream into cFS.
        hops: pairs of this stream with those that its messages leave as; empty if the capture shows none.

        Set by ``follow``, from the output; ``newer`` also when losses in front are known:

        arrived: bool (rows,), the message came out.
        newer: bool (rows,), it did not, but a newer message that may have replaced it did.
        open: bool (rows,), its fate is not decided yet.
        waits: bool (rows,), it may still come out.
        blind: bool (rows,), it has no fingerprint by which its output could be recognised.
        unseen: bool (rows,), it may have come out while nothing was captured.

        Set by ``Commands``, from what is missing behind the application; ``no_pipe`` also by ``Stops``:

        passed: bool (rows,), it may have come out of the application and been lost behind it.
        strange: bool (rows,), it may be a message that came out without a match: equal, or with other values.
        edge: bool (rows,), it may have come out and been lost where no later count would show that.
        no_pipe: bool (rows,), no pipe lost it: SBN did not read it, or by sequence counts as many came out.

        Set by ``Stops``, from stopped applications and closed ways, and by the last steps of ``Commands``:

        stop: i64 (rows,), index of the stop of an application in which it was sent; -1 for none.
        counted_in_stop: index of a stop to the messages that 0x803 counted, because nobody read the pipe.
        stops: outages of the application that surely reads them, if its way out is not captured.
        undecidable: bool (rows,), it was sent after the capture could no longer show its fate; None for none.
        undecidable_since: fact from which on that is so, as text.
        followed: number of those that a counter has as lost, and none that was sent before them.

        Numbers:

        ends: number of messages by their end, for messages in no loss.
        refused: messages that cFS refused for what they contain: verdict, number, and candidates.
        reached: number of messages that came out, if cut frames hide which ones; else None.
        commanded: number of commands to Telemetry Output that 0x880 counts; None if unknown.
    """

    stream: Stream
    hops: list[Hop]
    arrived: Mask
    newer: Mask
    open: Mask
    waits: Mask
    blind: Mask
    unseen: Mask
    ends: Counter[End] = field(default_factory=Counter)
    refused: list[tuple[Verdict, int, Among]] = field(default_factory=list)
    counted_in_stop: Counter[int] = field(default_factory=Counter)
    undecidable: Mask | None = None
    undecidable_since: str = ""
    stops: Sequence[Outage] = ()
    followed: int = 0
    reached: int | None = None
    commanded: int | None = None
    passed: Mask = field(init=False)
    strange: Mask = field(init=False)
    edge: Mask = field(init=False)
    no_pipe: Mask = field(init=False)
    stop: Integers = field(init=False)

    def __post_init__(self) -> None:
        self.passed, self.strange, self.edge, self.no_pipe = np.zeros((4, len(self.stream)), bool)
        self.stop = np.full(len(self.stream), -1)

    @property
    def unsubscribed(self) -> int:
        """Number of its messages that nobody subscribes to."""
        return sum(number for verdict, number, _ in self.refused if verdict.rule == "no_subscriber")

    @property
    def seen(self) -> bool:
        """Whether the capture shows which messages come out."""
        return bool(self.hops)

    @property
    def keeps_newest(self) -> bool:
        """Whether the application sends, over SBN, only the newest of the messages that it reads at once."""
        return _keep_newest(self.hops)

    @property
    def waiting(self) -> int:
        """Number of messages that may still come out, without those that came out unseen."""
        return int((self.waits & ~self.unseen).sum())

    @property
    def doubled(self) -> int:
        """Number of messages that came out again after an equal one."""
        return sum(int(np.count_nonzero(hop.again)) for hop in self.hops)

    def claim(self, rows: Places) -> int:
        """Mark those of some messages as decided that are open or blind; return their number."""
        own = rows[self.open[rows] | self.blind[rows]]
        self.open[own] = self.blind[own] = False
        return len(own)

    def end(self, how: End, some: Mask) -> int:
        """End those of some messages in one way that are open or blind; return their number."""
        number = self.claim(np.flatnonzero(some))
        self.ends[how] += number
        return number

    def loss(
        self, kind: LossKind, rows: Places, evidence: list[str], hop: str = "", among: Places | None = None
    ) -> Loss:
        """Return a loss of some of the messages.

        Args:
            kind: cause of the loss.
            rows: lost messages, as indices into the stream's rows; at least one.
            evidence: facts that prove it, one sentence each.
            hop: place of the loss; by default that of its kind.
            among: candidates, if it is not certain which messages are lost; by default ``rows``.
        """
        stream, own = self.stream, self.stream.time_ns
        start_ns, end_ns = int(own[rows].min()), int(own[rows].max())
        sure: Confidence = "high" if self.seen else "medium"
        loss = Loss(kind, hop or LOST_AT[kind], len(rows), start_ns, end_ns, sure, stream=stream)
        loss.msg_id, loss.evidence = stream.msg_id, evidence
        loss.of = int(((own >= start_ns) & (own <= end_ns)).sum())
        loss.among = Among(stream, rows if among is None else among)
        return loss


def _keep_newest(hops: Sequence[Hop]) -> bool:
    return any(hop.rewritten and hop.out.link.peers and not _sends_each(hop) for hop in hops)


def _sends_each(hop: Hop) -> bool:
    """Return whether nearly all messages come out, though they came faster than any task is woken."""
    fast = np.ptp(hop.into.time_ns) < _WOKEN_NS * (len(hop.into) - 1)
    return bool(fast and hop.matched > _NEARLY_ALL * hop.of)


def follow(case: Case, stream: Stream) -> Fate:
    """Return the fates of a stream, as far as its output in the capture decides them."""
    hops = [hop for hop in case.hops if hop.into is stream and not hop.is_copy]
    size, times = len(stream), stream.time_ns
    arrived, followed = np.zeros((2, size), bool)
    for hop in hops:
        arrived |= hop.arrived
        followed |= hop.known
    open_ = followed & ~arrived if hops else np.ones(size, bool)
    delay = max((_longest(hop.delays_ns) for hop in hops if len(hop.delays_ns)), default=0)
    last_ns = times[arrived][-1] if arrived.any() else 0
    since_ns = max(case.end_ns - delay - WAITS_NS, last_ns - 2 * WAITS_NS)
    waits = open_ & (times > since_ns) & ~case.unreachable.closed[stream.rows] & bool(hops)
    # A message that may have come out while nothing was captured is ``unseen``.
    leaving_ns = _leaving(hops, times, delay)
    unseen = overlapping(*leaving_ns, case.blind_spans(hops)) & open_ & bool(hops)
    waits |= unseen & case.overlaps_outage(*leaving_ns)
    blind, newer = ~followed & ~arrived & bool(hops), may_give_way(case, hops, open_, times)
    return Fate(stream, hops, arrived, newer, open_ & ~waits, waits, blind, unseen)


def _leaving(hops: Sequence[Hop], times: Integers, delay: int) -> tuple[Integers, Integers]:
    """Return the earliest and the latest time, i64 (rows,) each, at which each message would have come out.

    The messages around it that came out give the interval.

    Args:
        hops: pairs of the stream with those that its messages leave as.
        times: i64 (rows,), time at which each was sent.
        delay: delay of a message at the end of the capture, ns, about.
    """
    none = np.iinfo(np.int64).max
    out_ns = np.full(len(times) + 1, none)
    for hop in hops:
        out_ns[hop.in_rows] = hop.out.time_ns[hop.out_rows]
    came = np.flatnonzero(out_ns < none)
    place = np.searchsorted(came, np.arange(len(times)))
    before, behind = np.append(times[:1], out_ns[came])[place], out_ns[np.append(came, len(times))[place]]
    behind = np.where(behind < none, behind, times + delay + WAITS_NS)
    return np.minimum(np.maximum(before, times), behind), np.maximum(before, behind)


def _longest(delays_ns: Integers) -> int:
    """Return the largest delay of a message at the end, ns: the usual one, or less if the last are quick."""
    return min(int(np.quantile(delays_ns, 0.99)), 2 * int(delays_ns[-_LAST:].max()) + WAITS_NS)


def may_give_way(case: Case, hops: list[Hop], absent: Mask, times: Integers) -> Mask:
    """Return which messages a later one may have replaced: bool (rows,).

    An application that keeps the newest message for SBN reads all that wait in one round. These may be the
    messages of a few rounds, if CI gets more than it reads, or all of a time in which cFS stood still or no
    scheduler woke applications.

    Args:
        hops: pairs of the stream with those that its messages leave as.
        absent: bool (rows,), messages that did not come out.
        times: i64 (rows,), time at which each was sent.
    """
    out = np.zeros(len(times), bool)
    if not _keep_newest(hops):
        return out
    # Messages of another link may replace these: the application has one handler for a MsgId.
    outs, msg_id = {hop.out for hop in hops}, hops[0].into.msg_id
    hops = [hop for hop in case.hops if hop.out in outs and hop.into.msg_id == msg_id]
    came_ns = np.concatenate([hop.into.time_ns[hop.in_rows] for hop in hops])
    order, rows = np.argsort(came_ns, kind="stable"), np.flatnonzero(absent)
    came_ns, out_ns = came_ns[order], np.concatenate([hop.out.time_ns[hop.out_rows] for hop in hops])[order]
    behind = np.searchsorted(came_ns, times[rows])
    rows, behind = rows[behind < len(order)], behind[behind < len(order)]
    _, first = np.unique(behind, return_index=True)
    first_ns = times[rows[np.repeat(first, np.diff(np.append(first, len(rows))))]]
    # CI may have read messages of different times in one round: then they came out close together.
    next_ns, apart_ns = came_ns[behind], out_ns[behind] - out_ns[behind - 1]
    out[rows] = (
        ((behind > 0) & (apart_ns >= 0) & (apart_ns <= 2 * WAITS_NS))
        | (next_ns - first_ns <= 2 * WAITS_NS)
        | (next_ns - times[rows] <= _BURST_NS)
    )
    left_ns = np.sort(np.concatenate([hop.out.time_ns for hop in hops]))
    for system, owner in case.timeline.subjects:
        sleeps = owner.kind == "app" and owner.name in executive_services.SCHEDULERS
        states = ("stopped", "restarting", "stalled") if sleeps else ("stalled",)
        for span in (span for state in states for span in case.timeline.spans(owner, state, system)):
            since_ns, until_ns = span.start_lo - SECOND, span.end_hi + SECOND
            if sleeps:  # the messages around the stop show when the scheduler works
                awake = left_ns[(left_ns > span.start_lo - READY_NS) & (left_ns <= span.end_hi + READY_NS)]
                since_ns = min([since_ns, *awake[awake < span.start_lo][-1:].tolist()])
                until_ns = max([until_ns, *awake[awake > span.end_lo][:1].tolist()])
            out[rows] |= (times[rows] > since_ns) & (next_ns <= until_ns)
    return out


LOST_AT: Final[Mapping[str, str]] = {
    **dict.fromkeys(("down", "restart", "ci_stopped", "port_closed"), command_ingest.NAME),
    "network": BEFORE_CI,
    "socket": CI_SOCKET,
}
"""Kind of a loss in front of CI to its place."""
