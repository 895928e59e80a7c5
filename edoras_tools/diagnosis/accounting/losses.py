"""What was lost, where and why, and what became of each message that went into cFS.

A loss is messages of one route, lost at one place for one cause in one span of time. Every message that is
lost is in one loss and no more; the balance adds them up, and the rules explain them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence  # noqa: TC003  COUNTERS is annotated with it
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
    from edoras_tools.diagnosis.verdict import Confidence
    from edoras_tools.wire.arrays.order import Integers, Mask, Places

IngestKind = Literal["network", "socket", "down", "restart", "ci_stopped", "port_closed"]
AppKind = Literal["stopped", "restart_failed", "away", "unsubscribed", "disabled", "route"]
LossKind = PipeKind | IngestKind | AppKind | Literal["after", "unknown", "fragments", "damaged"]
"""Over a limit or out of a full pipe; behind cFS; on the way to CI; in CI's socket; while cFS or CI was down;
while the application was, or after it was started again and passed nothing on; while an SBN peer was away, or
had not subscribed to it; while Telemetry Output was not to send it; while its route was disabled; unknown:
nothing tells where, or of which MsgId; fragments: only the first fragments of it came; damaged: it left, and
its checksum is wrong; port_closed: nobody listened."""

LEAD_NS: Final = 700 * MILLISECOND
"""A loss may be counted so long before the next message of the stream is seen."""
TAIL_NS: Final = 2500 * MILLISECOND
"""Housekeeping that tells of it comes within a second, and Telemetry Output holds it for half of one."""
COUNTERS: Final[Mapping[PipeKind, str]] = {"limit": "msg_limits", "overflow": "pipe_overflows"}
"""The counter of 0x803 that a loss at a pipe raises."""
COUNTER_NAMES: Final[Mapping[PipeKind, str]] = {"limit": "MsgLimit", "overflow": "PipeOverflow"}
APP: Final = "application pipe"
CI_SOCKETS: Final = tuple(f"{name} socket" for name in command_ingest.NAMES)
CI_SOCKET: Final = CI_SOCKETS[0]
BEFORE_CI: Final = "network before CI"
SBN_SOCKET: Final = "SBN socket"
BUS: Final = "software bus"
BEHIND: Final = "between cFS and the capture"


class Among(NamedTuple):
    """The messages that a loss is some of, or all.

    Attributes:
        stream: where they are, or are missing.
        rows: indices into its rows: the messages themselves, or what came before those that are missing.
        missing: (rows,), how many behind each; None where the rows are the messages.
    """

    stream: Stream
    rows: Places
    missing: Integers | None = None

    @property
    def times_ns(self) -> tuple[int, int]:
        """When the first was, and the last; where they are missing, what came before and behind."""
        times, last = self.stream.time_ns, int(self.rows[-1]) + (self.missing is not None)
        return int(times[self.rows[0]]), int(times[min(last, len(times) - 1)])


class Loss(msgspec.Struct):
    """Messages of one route that were lost in one span of time.

    Attributes:
        kind: why.
        hop: where.
        lost: how many.
        start_ns: when it began.
        end_ns: when it ended.
        confidence: how sure that is.
        instance: the cFS that lost them.
        msg_id: which.
        stream: where they were seen, or missed; None where they are not in the capture.
        span: when; None for all of the capture.
        of: of how many sent; None where unknown.
        evidence: what was seen.
        sender: application that sent them, as an event names it.
        closed: Telemetry Output was not sending meanwhile: it would not have sent them either.
        among: the messages that it is, or is some of; None where nothing tells.
        rivals: link label, MsgId and hop of each traffic that may have lost them; empty where that is known.
        uncounted: of them, how many no counter has.
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
        """Whether SBN brought them to the pipe that lost them."""
        return self.sender.startswith(sbn.NAME) or (self.stream is not None and self.stream.link.peers)

    @property
    def offered_hz(self) -> float:
        """Messages sent a second, those that were lost included; 0 where that is not known."""
        seconds = (self.end_ns - self.start_ns) / SECOND
        return (self.of - 1) / seconds if self.of and seconds > 0 else 0.0


READY_NS: Final = 5 * SECOND
"""An application that was started may take so long until it does its work."""
WAITS_NS: Final = SECOND
"""What was sent so short before the end may still come out."""
_LAST: Final = 5
"""So many show how long a message takes at the end."""
_BURST_NS: Final = 50 * MILLISECOND
"""What is sent within so long is taken together."""


EndAtCi = Literal["queued", "crowded", "late"]
"""``queued`` may wait in its socket, ``crowded`` only if that holds more than usual, or it may have read them
just before it went down, or before its first count; ``late`` were sent after its last count."""
EndOnBus = Literal["earlier", "shared", "elsewhere"]
"""``earlier`` may be some that its first count had already; ``shared`` is the most that may be among those
that a counter has of several traffics together, and ``elsewhere`` those that did not come out and may be
among these."""
EndAtApp = Literal["passed_on", "superseded", "unaccounted", "uncertain", "missed", "held", "beyond"]
"""``passed_on`` came out, and were lost behind that; ``superseded`` gave way to a newer one; of
``unaccounted`` nothing tells what became; ``uncertain`` may yet come out, and their pipe lost others to the
end; ``missed`` may have come out, and the capture may have missed them; ``held`` it may have taken just
before it was stopped, or when it was back, and they gave way; ``beyond`` were sent before the first that came
out or behind the last, by a way whose end may be behind the application."""
End = EndAtCi | EndOnBus | EndAtApp
"""How messages into cFS end that are in no loss: at CI, on the bus, or at the application."""


@dataclass(slots=True)
class Fate:
    """What became of each message of a stream into cFS.

    Attributes:
        stream: the stream.
        hops: where its messages come out; none where that cannot be seen.
        arrived: bool (rows,), it came out.
        newer: bool (rows,), it did not, and a newer one that may have been taken together with it did.
        open: bool (rows,), nothing has told yet what became of it.
        waits: bool (rows,), it may yet come out.
        blind: bool (rows,), it has no values by which it could be seen to come out.
        unseen: bool (rows,), it may have come out while nothing was captured.
        ends: messages by how they ended.
        refused: rule to messages that came to nothing by what they are.
        unfollowed: bool (rows,), it was sent when nothing here could show any more what became of it.
        unfollowed_since: what was said or asked from which on that is so.
        followed: of those, how many a counter has as lost, and none that was sent before them.
        reached: messages that came out by their number alone, where cut frames hide which; None elsewhere.
        commanded: commands to Telemetry Output that 0x880 counts; None where it does not tell.
        passed: bool (rows,), it may have come out of the application and have been lost behind it.
        strange: bool (rows,), likewise as another one that came out and that nothing here was sent as.
        edge: bool (rows,), likewise, where no count behind it would show that.
        unread: bool (rows,), SBN did not take it, from its socket or from the application: no pipe lost it.
        stop: i64 (rows,), place of the stop of an application that it was sent into; -1 for none.
        counted_in_stop: place of a stop to how many of those 0x803 counted: nobody read the pipe.
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
    refused: Counter[str] = field(default_factory=Counter)
    counted_in_stop: Counter[int] = field(default_factory=Counter)
    unfollowed: Mask | None = None
    unfollowed_since: str = ""
    followed: int = 0
    reached: int | None = None
    commanded: int | None = None
    passed: Mask = field(init=False)
    strange: Mask = field(init=False)
    edge: Mask = field(init=False)
    unread: Mask = field(init=False)
    stop: Integers = field(init=False)

    def __post_init__(self) -> None:
        self.passed, self.strange, self.edge, self.unread = np.zeros((4, len(self.stream)), bool)
        self.stop = np.full(len(self.stream), -1)

    @property
    def seen(self) -> bool:
        """Whether it can be seen what comes out."""
        return bool(self.hops)

    @property
    def keeps_newest(self) -> bool:
        """Whether the application sends only the newest of what it takes at once, over SBN."""
        return _keep_newest(self.hops)

    @property
    def waiting(self) -> int:
        """How many may yet come out, of those that CI has read."""
        return int((self.waits & ~self.unseen).sum())

    @property
    def doubled(self) -> int:
        """How many came out more than once."""
        return sum(hop.doubled for hop in self.hops)

    def claim(self, rows: Places) -> int:
        """Take messages that are open, or are blind; return how many."""
        own = rows[self.open[rows] | self.blind[rows]]
        self.open[own] = self.blind[own] = False
        return len(own)

    def loss(
        self, kind: LossKind, rows: Places, evidence: list[str], hop: str = "", among: Places | None = None
    ) -> Loss:
        """Return the loss of some of the messages.

        Args:
            rows: which, as indices into the stream's rows.
            hop: where; by default where that kind of loss is.
            among: which they may be as well; by default it is sure which they are.
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
    return any(hop.rewritten and hop.out.link.peers for hop in hops)


def follow(case: Case, stream: Stream) -> Fate:
    """Follow a stream to where it comes out, if that can be seen."""
    hops = [hop for hop in case.hops if hop.into is stream and not hop.is_copy]
    size, times = len(stream), stream.time_ns
    arrived, followed = (
        np.logical_or.reduce([np.zeros(size, bool), *masks])
        for masks in ([hop.arrived for hop in hops], [hop.known for hop in hops])
    )
    open_ = followed & ~arrived if hops else np.ones(size, bool)
    delay = max((_longest(hop.delays_ns) for hop in hops if len(hop.delays_ns)), default=0)
    last_ns = times[arrived][-1] if arrived.any() else 0
    since_ns = max(case.end_ns - delay - WAITS_NS, last_ns - 2 * WAITS_NS)
    waits = open_ & (times > since_ns) & ~case.unreachable.closed[stream.rows] & bool(hops)
    # What may have come out while nothing was captured did so unseen.
    leaving_ns = _leaving(hops, times, delay)
    unseen = overlapping(*leaving_ns, case.blind) & open_ & bool(hops)
    waits |= unseen & case.is_away(*leaving_ns)
    blind, newer = ~followed & ~arrived & bool(hops), _newer(case, hops, open_, times)
    return Fate(stream, hops, arrived, newer, open_ & ~waits, waits, blind, unseen)


def _leaving(hops: Sequence[Hop], times: Integers, delay: int) -> tuple[Integers, Integers]:
    """Return from when and until when each message would have come out: between those around it that did.

    Args:
        times: when each was sent.
        delay: so long it takes at the end, about.
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
    """Return how long a message takes at the end: as usual, or a little longer than the last ones did."""
    return min(int(np.quantile(delays_ns, 0.99)), 2 * int(delays_ns[-_LAST:].max()) + WAITS_NS)


def regroup(case: Case, fate: Fate) -> None:
    """Mark what may have given way as well, once it is told what was lost before it could be taken."""
    fate.newer |= _newer(case, fate.hops, fate.open, fate.stream.time_ns)


def _newer(case: Case, hops: list[Hop], absent: Mask, times: Integers) -> Mask:
    """Tell which messages may have given way to one that was sent some time later.

    An application that keeps the newest for SBN takes together what waited before it: for a few rounds where
    CI has more than it reads, and for all of a time in which cFS stood still or nobody woke applications.
    """
    out = np.zeros(len(times), bool)
    if not _keep_newest(hops):
        return out
    came = np.flatnonzero(np.logical_or.reduce([hop.arrived for hop in hops]))
    rows = np.flatnonzero(absent)
    behind = np.searchsorted(came, rows)
    rows, behind = rows[behind < len(came)], behind[behind < len(came)]
    _, first = np.unique(behind, return_index=True)
    first_ns = times[rows[np.repeat(first, np.diff(np.append(first, len(rows))))]]
    next_ns, out_ns = times[came[behind]], np.full(len(times), np.iinfo(np.int64).max)
    for hop in hops:
        out_ns[hop.in_rows] = hop.out.time_ns[hop.out_rows]
    # CI may have read together what was sent at other times: then little lies between what came out.
    apart_ns = out_ns[came[behind]] - out_ns[came[behind - 1]]
    out[rows] = (
        ((behind > 0) & (apart_ns >= 0) & (apart_ns <= 2 * WAITS_NS))
        | (next_ns - first_ns <= 2 * WAITS_NS)
        | (next_ns - times[rows] <= _BURST_NS)
    )
    left_ns = np.sort(np.concatenate([hop.out.time_ns for hop in hops]))
    for system, owner in case.timeline.subjects:
        sleeps = owner.kind == "app" and owner.name in executive_services.SCHEDULERS
        states = ("stopped", "restarting") if sleeps else ("stalled",)
        for span in (span for state in states for span in case.timeline.spans(owner, state, system)):
            until_ns = span.end_hi + SECOND
            if sleeps:  # it wakes applications when it is ready: the first one that sends shows it
                awake = left_ns[(left_ns > span.end_lo) & (left_ns <= span.end_hi + READY_NS)]
                until_ns = max([until_ns, *awake[:1].tolist()])
            out[rows] |= (times[rows] > span.start_lo - SECOND) & (next_ns <= until_ns)
    return out


LOST_AT: Final[Mapping[str, str]] = {
    **dict.fromkeys(("down", "restart", "ci_stopped", "port_closed"), command_ingest.NAME),
    "network": BEFORE_CI,
    "socket": CI_SOCKET,
}
"""Kind of a loss before CI to where it is."""
