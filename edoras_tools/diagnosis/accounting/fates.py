"""What became of each message that went into cFS, as far as can be seen where it comes out."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.cfs import command_ingest, executive_services
from edoras_tools.diagnosis.accounting.losses import BEFORE_CI, CI_SOCKET, Among, Known, Loss, LossKind
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.matching.crossing import Hop
    from edoras_tools.diagnosis.matching.spans import Span
    from edoras_tools.diagnosis.matching.streams import Stream

WAITS_NS: Final = SECOND
"""What was sent so short before the end may still come out."""


@dataclass(slots=True)
class Fate:
    """What became of each message of a stream into cFS.

    Attributes:
        stream: the stream.
        hops: where its messages come out; none where that cannot be seen.
        arrived: bool (rows,), it came out.
        newer: bool (rows,), it did not, and a newer one that may have been taken together with it did.
        spans: its messages in time.
        open: bool (rows,), nothing has told yet what became of it.
        waits: bool (rows,), it may yet come out.
        blind: bool (rows,), it has no values by which it could be seen to come out.
        queued: messages that may wait in CI's socket: it has not counted them.
        refused: rule to messages that came to nothing by what they are.
        passed_on: messages that came out, and were lost behind that.
        superseded: messages that gave way to a newer one.
        unaccounted: messages of which nothing tells what became.
        unfollowed: bool (rows,), it was sent when nothing here could show any more what became of it.
        unfollowed_since: what was said or asked from which on that is so.
        unseen: bool (rows,), it may have come out while the capturing interface was away.
        reached: messages that came out by their number alone, where cut frames hide which; None elsewhere.
        commanded: commands to Telemetry Output that 0x880 counts; None where it does not tell.
        uncounted: messages that CI's first count does not have, and nothing tells why.
        late: messages that were sent so late that no count of their CI is here after them.
        unsure: messages of which the first counts of their CI do not tell whether it read them.
        doubled: messages that came out more than once.
        shared: the most messages that may be among those that a counter has of several traffics together.
        uncertain: of those that may yet come out, how many may be lost: their pipe lost others to the end.
        missed: messages that may have come out, and that the capture may have missed.
        elsewhere: messages that did not come out, and may be among those that a counter has of several.
        beyond: messages that were sent before the first that came out or behind the last, by a way whose end
            may be behind the application.
        passed: bool (rows,), it may have come out of the application and have been lost behind it.
        edge: bool (rows,), likewise, where no count behind it would show that.
        stop: i64 (rows,), place of the stop of an application that it was sent into; -1 for none.
    """

    stream: Stream
    hops: list[Hop]
    arrived: NDArray[np.bool_]
    newer: NDArray[np.bool_]
    spans: list[Span]
    open: NDArray[np.bool_]
    waits: NDArray[np.bool_]
    blind: NDArray[np.bool_]
    queued: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    passed_on: int = 0
    superseded: int = 0
    unaccounted: int = 0
    unfollowed: NDArray[np.bool_] | None = None
    unfollowed_since: str = ""
    unseen: NDArray[np.bool_] | None = None
    reached: int | None = None
    commanded: int | None = None
    uncounted: int = 0
    late: int = 0
    unsure: int = 0
    doubled: int = 0
    shared: int = 0
    uncertain: int = 0
    missed: int = 0
    elsewhere: int = 0
    beyond: int = 0
    passed: NDArray[np.bool_] = field(init=False)
    edge: NDArray[np.bool_] = field(init=False)
    stop: NDArray[np.int64] = field(init=False)

    def __post_init__(self) -> None:
        self.passed, self.edge = (np.zeros(len(self.stream), bool) for _ in range(2))
        self.stop = np.full(len(self.stream), -1)

    @property
    def seen(self) -> bool:
        """Whether it can be seen what comes out."""
        return bool(self.hops)

    @property
    def waiting(self) -> int:
        """How many may yet come out, of those that CI has read."""
        return int(self.waits.sum() if self.unseen is None else (self.waits & ~self.unseen).sum())

    @classmethod
    def nothing(cls, stream: Stream) -> Fate:
        """Return the fate of a stream of which nothing is followed."""
        none = np.zeros(len(stream), bool)
        return cls(stream, [], none, none, [], none, none, none)

    def claim(self, rows: NDArray[np.intp]) -> int:
        """Take messages that are open, or are blind; return how many."""
        own = rows[self.open[rows] | self.blind[rows]]
        self.open[own] = self.blind[own] = False
        return len(own)


def follow(known: Known, stream: Stream) -> Fate:
    """Follow a stream to where it comes out, if that can be seen."""
    hops = [hop for hop in known.hops if hop.into is stream]
    size = len(stream)
    arrived, followed = np.zeros(size, bool), np.zeros(size, bool)
    for hop in hops:
        arrived |= hop.arrived
        followed |= hop.known
    times = known.captured(stream)
    open_ = followed & ~arrived
    delay = max((int(np.quantile(hop.delays_ns, 0.99)) for hop in hops if len(hop.delays_ns)), default=0)
    last_ns = times[arrived][-1] if arrived.any() else 0
    since_ns = max(known.end_ns - delay - WAITS_NS, last_ns - 2 * WAITS_NS)
    waiting = open_ & (times > since_ns) & ~known.closed[stream.rows]
    if not hops:
        open_ = np.ones(size, bool)
        waiting = np.zeros(size, bool)
    # What may have come out while the capturing interface was away did so unseen.
    unseen = known.away(times, times + delay + WAITS_NS)
    unseen &= open_ & bool(hops)
    waiting |= unseen
    return Fate(
        stream=stream,
        hops=hops,
        arrived=arrived,
        newer=_newer(known, hops, open_, times),
        spans=known.spans(stream),
        open=open_ & ~waiting,
        waits=waiting,
        blind=~followed & ~arrived & bool(hops),
        unseen=unseen,
        doubled=sum(hop.doubled for hop in hops),
    )


def _newer(
    known: Known, hops: list[Hop], absent: NDArray[np.bool_], times: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Tell which messages may have given way to one that was sent some time later.

    An application that keeps the newest for SBN takes together what waited before it: for a few rounds where
    CI has more than it reads, and for all of a time in which cFS stood still or nobody woke applications.
    """
    out = np.zeros(len(times), bool)
    if not any(hop.rewritten and hop.out.link.peers for hop in hops):
        return out
    came = np.flatnonzero(~absent)
    behind = np.searchsorted(came, np.flatnonzero(absent))
    rows, behind = np.flatnonzero(absent)[behind < len(came)], behind[behind < len(came)]
    first = np.where(behind > 0, came[behind - 1] + 1, 0)
    next_ns = times[came[behind]]
    out[rows] = next_ns - times[first] <= 2 * WAITS_NS
    for system, owner in known.timeline.subjects:
        sleeps = owner.kind == "app" and owner.name in executive_services.SCHEDULERS
        states = ("stopped", "restarting") if sleeps else ("stalled",)
        for span in (span for state in states for span in known.timeline.spans(owner, state, system)):
            out[rows] |= (times[rows] > span.start_lo - SECOND) & (next_ns <= span.end_hi + SECOND)
    return out


def loss_of(
    known: Known,
    fate: Fate,
    kind: LossKind,
    rows: NDArray[np.intp],
    evidence: list[str],
    hop: str = "",
    among: NDArray[np.intp] | None = None,
) -> Loss:
    """Return the loss of some messages of a stream.

    Args:
        rows: which, as indices into the stream's rows.
        hop: where; by default where that kind of loss is.
        among: which they may be as well; by default it is sure which they are.
    """
    own = known.captured(fate.stream)
    start_ns, end_ns = int(own[rows].min()), int(own[rows].max())
    return Loss(
        kind=kind,
        hop=hop or LOST_AT[kind],
        msg_id=fate.stream.msg_id,
        stream=fate.stream,
        lost=len(rows),
        of=int(((own >= start_ns) & (own <= end_ns)).sum()),
        start_ns=start_ns,
        end_ns=end_ns,
        confidence="high" if fate.seen else "medium",
        evidence=evidence,
        among=Among(fate.stream, rows if among is None else among),
    )


LOST_AT: Final[Mapping[str, str]] = {
    "network": BEFORE_CI,
    "socket": CI_SOCKET,
    "down": command_ingest.NAME,
    "restart": command_ingest.NAME,
    "ci_stopped": command_ingest.NAME,
    "port_closed": command_ingest.NAME,
}
"""Kind of a loss before CI to where it is."""
