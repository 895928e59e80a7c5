"""What was lost, where and why: the values that the accounts are made of.

A loss is messages of one route, lost at one place for one cause in one span of time. Every message that is
lost is in one loss and no more; the balance adds them up, and the rules explain them.
"""

from __future__ import annotations

from collections.abc import Mapping  # noqa: TC003  COUNTERS is annotated with it
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from edoras_tools.cfs import command_ingest, sbn, telemetry_output
from edoras_tools.diagnosis.evidence.instances import NOBODY, Instances
from edoras_tools.diagnosis.evidence.relays.proxied import UNTOUCHED, Proxied, RouteWay
from edoras_tools.diagnosis.matching.spans import Comb, Span, comb, spans
from edoras_tools.links.table import among
from edoras_tools.model import NO_MSG_ID, Endpoint, Peer
from edoras_tools.units import MILLISECOND, SECOND

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from edoras_tools.cfs.profile import SimProfile
    from edoras_tools.diagnosis.evidence.loss_reports import LossEvents, ReportedLoss, Track
    from edoras_tools.diagnosis.evidence.payloads import Payloads
    from edoras_tools.diagnosis.evidence.peers import Network
    from edoras_tools.diagnosis.evidence.table import Rows
    from edoras_tools.diagnosis.evidence.timeline.table import Timeline
    from edoras_tools.diagnosis.matching.crossing import Hop
    from edoras_tools.diagnosis.matching.streams import Stream
    from edoras_tools.diagnosis.verdict import Confidence

PipeKind = Literal["limit", "overflow"]
LossKind = (
    PipeKind
    | Literal[
        "after",
        "unknown",
        "network",
        "socket",
        "down",
        "restart",
        "ci_stopped",
        "stopped",
        "restart_failed",
        "away",
        "unsubscribed",
        "disabled",
        "sbn_socket",
        "fragments",
        "port_closed",
    ]
)
"""Over a limit or out of a full pipe; behind cFS; on the way to CI; in CI's socket; while cFS or CI was down;
while the application was, or after it was started again and passed nothing on; while an SBN peer was away, or
had not subscribed to it; while Telemetry Output was not to send it; unknown: nothing tells where, or of which
MsgId; fragments: only the first fragments of it came; port_closed: nobody listened."""

LEAD_NS: Final = 700 * MILLISECOND
"""A loss may be counted so long before the next message of the stream is seen."""
TAIL_NS: Final = 2500 * MILLISECOND
"""Housekeeping that tells of it comes within a second, and Telemetry Output holds it for half of one."""
COUNTERS: Final[Mapping[PipeKind, str]] = {"limit": "msg_limits", "overflow": "pipe_overflows"}
"""The counter of 0x803 that a loss at a pipe raises."""
COUNTER_NAMES: Final[Mapping[PipeKind, str]] = {"limit": "MsgLimit", "overflow": "PipeOverflow"}
PIPE_EVENTS: Final[Mapping[PipeKind, int]] = {"limit": 17, "overflow": 25}
"""The event of CFE_SB that names it."""
APP: Final = "application pipe"
CI_SOCKETS: Final = tuple(f"{name} socket" for name in command_ingest.NAMES)
CI_SOCKET: Final = CI_SOCKETS[0]
BEFORE_CI: Final = "network before CI"
SBN_SOCKET: Final = "SBN socket"
BEHIND: Final = "between cFS and the capture"


@dataclass(frozen=True, slots=True)
class Among:
    """The messages that a loss is some of, or all.

    Attributes:
        stream: where they are, or are missing.
        rows: indices into its rows: the messages themselves, or what came before those that are missing.
        missing: (rows,), how many behind each; None where the rows are the messages.
    """

    stream: Stream
    rows: NDArray[np.intp]
    missing: NDArray[np.int64] | None = None


@dataclass(slots=True)
class Loss:
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
        comb: the rounds in which the stream arrives.
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
    evidence: list[str] = field(default_factory=list)
    comb: Comb | None = None
    sender: str = ""
    closed: bool = False
    among: Among | None = None
    rivals: tuple[tuple[str, int, str], ...] = ()
    uncounted: int = 0

    @property
    def offered_hz(self) -> float:
        """Messages sent a second, those that were lost included; 0 where that is not known."""
        seconds = (self.end_ns - self.start_ns) / SECOND
        return (self.of - 1) / seconds if self.of and seconds > 0 else 0.0


@dataclass(frozen=True, slots=True)
class Known:
    """What losses are told from."""

    rows: Rows
    payloads: Payloads
    endpoints: Sequence[Endpoint]
    streams: Sequence[Stream]
    instances: Instances
    tracks: Mapping[int, Track]
    reported_losses: Mapping[ReportedLoss, LossEvents]
    network: Network
    hops: Sequence[Hop]
    profile: SimProfile
    listeners: Mapping[int, int]
    """Endpoint of a CI to the number of its cFS, where its counts tell."""
    proxied: Mapping[RouteWay, Proxied]
    """What a proxy did on purpose to the datagrams of a MsgId, on a link, one way."""
    timeline: Timeline
    """What state everything was in, over time."""
    at: Callable[[int], str]
    """Writes a time for people."""
    never_whole: Mapping[tuple[Endpoint, int], list[int]]
    """Sender and MsgId to the times, ns, of datagrams of which later fragments never came."""
    closed: NDArray[np.bool_]
    """(rows,), which datagrams went to a closed port."""
    outages: Sequence[tuple[int, int]] = ()
    """From when to when the capturing interface was away."""
    quiet: Sequence[tuple[int, int]] = ()
    """From when to when nothing at all was captured, and nothing tells why."""
    _unseen: list[bool] = field(default_factory=list)
    _spans: dict[int, list[Span]] = field(default_factory=dict)
    _captured: dict[int, NDArray[np.int64]] = field(default_factory=dict)
    _times: dict[tuple[Any, ...], NDArray[np.int64]] = field(default_factory=dict)

    def spans(self, stream: Stream) -> list[Span]:
        """Return the spans of a stream at one rate; worked out once."""
        if id(stream) not in self._spans:
            self._spans[id(stream)] = spans(stream, self.rows)
        return self._spans[id(stream)]

    def captured(self, stream: Stream) -> NDArray[np.int64]:
        """Return the capture times of a stream's packets: i64, ns since 1970; looked up once."""
        if id(stream) not in self._captured:
            self._captured[id(stream)] = self.rows.time_ns[stream.rows]
        return self._captured[id(stream)]

    @property
    def end_ns(self) -> int:
        """The last datagram."""
        return int(self.rows.time_ns.max())

    def away(self, starts: NDArray[np.int64], ends: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Tell which spans of time hold some of an outage of the capturing interface."""
        out = np.zeros(len(starts), bool)
        for start_ns, end_ns in self.outages:
            out |= (starts < end_ns) & (ends > start_ns)
        return out

    def done_to(self, stream: Stream) -> Proxied:
        """Return what a proxy did on purpose to the datagrams of a stream."""
        to_cfs = stream.link.only_to_cfs or (stream.link.peers and not stream.counted)
        return self.proxied.get((stream.link.code, to_cfs, stream.msg_id), UNTOUCHED)

    @property
    def peers_unseen(self) -> bool:
        """Whether a cFS hands on what another one made, and how that came to it was not captured."""
        if not self._unseen:
            on_sbn = among(self.rows.link, lambda link: link.peers).any()
            handed_on = (
                stream.link.only_from_cfs and stream.instance not in {NOBODY, self.owner(stream)}
                for stream in self.streams
            )
            self._unseen.append(not on_sbn and any(handed_on))
        return self._unseen[0]

    def upstream(self, stream: Stream) -> Hop | None:
        """Return the hop by which a stream's packets came unchanged, if they did."""
        return next((hop for hop in self.hops if hop.out is stream and not hop.rewritten), None)

    def owner(self, stream: Stream) -> int:
        """Return the instance whose pipe a telemetry stream comes out of."""
        start_ns = int(self.rows.time_ns[stream.rows[0]])
        if stream.link.only_from_cfs:
            return self.instances.owner(stream.sender, start_ns)
        if stream.instance != NOBODY:
            return stream.instance
        name = self.network.identity_of.get(stream.sender, "")
        return self.instances.named(name, start_ns, stream.sender)

    def label(self, instance: int) -> str:
        """Return how people are told of an instance."""
        return "a cFS" if instance == NOBODY else self.instances.label(instance)

    def times(self, stream: Stream) -> NDArray[np.int64]:
        """Return when a stream's MsgId comes out of its pipe, whoever made it: they share what may wait."""
        key = stream.link, stream.sender, stream.receiver, stream.msg_id
        if key not in self._times:
            alike = [
                self.rows.time_ns[item.rows]
                for item in self.streams
                if (item.link, item.sender, item.receiver, item.msg_id) == key
                or (item.link.only_from_cfs and (item.sender, item.msg_id) == (stream.sender, stream.msg_id))
            ]
            self._times[key] = np.sort(np.concatenate(alike))
        return self._times[key]

    def rounds(self, stream: Stream, span: Span) -> Comb:
        """Return the rounds in which a stream's MsgId comes meanwhile."""
        times = self.times(stream)
        return comb(times[(times >= span.start_ns) & (times <= span.end_ns)])

    def hop(self, stream: Stream) -> str:
        """Return the name of the pipe that a telemetry stream comes out of."""
        if stream.link.only_from_cfs:
            return telemetry_output.PIPE
        spacecraft, _, processor = self.network.identity_of.get(stream.receiver, "").partition(":")
        return sbn.peer_pipe(Peer(int(spacecraft), int(processor))) if processor else "pipe of an SBN peer"

    def named(self, instance: int, msg_id: int, kind: str, *, output: bool) -> LossEvents | None:
        """Return the events that name a MsgId at Telemetry Output's pipe, or at a peer's."""
        for reported, said in self.reported_losses.items():
            if (reported.instance, reported.msg_id, reported.kind) == (instance, msg_id, kind) and (
                reported.at_output if output else reported.at_peer
            ):
                return said
        return None

    def into_system(self, stream: Stream, system: int) -> bool:
        """Tell whether a stream into cFS arrives at a system, as far as that is known."""
        members = [at for at, other in enumerate(self.instances.systems) if other == system]
        return not members or any(self.goes_to(stream, at) for at in members)

    def system(self, stream: Stream) -> int:
        """Return the number of the system that a stream into cFS arrives at; 0 where that is not known."""
        return next((item for item in self.instances.systems if self.into_system(stream, item)), 0)

    def goes_to(self, stream: Stream, instance: int) -> bool:
        """Tell whether a stream into cFS arrives at an instance, as far as that is known."""
        if instance == NOBODY:
            return True
        item, system = self.instances.items[instance], self.instances.systems[instance]
        if stream.link.only_to_cfs:
            known = self.listeners.get(stream.receiver)
            return known == system if known is not None else system not in self.listeners.values()
        if item.name and self.network.identity_of.get(stream.receiver, item.name) != item.name:
            return False
        here = int(self.instances.hosts[stream.receiver]) == item.host
        return here or not self.instances.others_named(instance)
