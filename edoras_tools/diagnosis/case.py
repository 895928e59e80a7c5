"""The evidence of one capture, which all rules share.

Steps of the accounting and rules ask the case for what others found. Its attributes stand in about the order
in which they follow from each other: rows, streams, counters, states, hops, then the accounting, and texts
for people at the end.

Rules:

1. The constructor prepares the rows: in order of time, without the capture's own copies, with set clocks
   corrected. Nothing changes them later.
2. Every result is computed when it is first asked for, and kept (``cached_property``, ``keep_results``).
   Only the verdicts grow.
3. Messages of a stream are indices into ``Stream.rows``, whose values index ``Case.rows``. Times are
   capture times in ns.
"""

from __future__ import annotations

import struct
from bisect import bisect_left, bisect_right
from collections import Counter, defaultdict
from functools import cached_property, wraps
from ipaddress import ip_address
from operator import attrgetter, itemgetter
from typing import TYPE_CHECKING, Any, Concatenate, Final, Literal, ParamSpec, TypeVar

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.cfs import command_ingest, queues, sbn, telemetry_output
from edoras_tools.cfs.commands import inject_line
from edoras_tools.cfs.names import SIZED_ENTRY_BYTES, message_name
from edoras_tools.decode.conversations import ConversationKind, Flow, Unnamed, unnamed
from edoras_tools.diagnosis.accounting import closed, ingest
from edoras_tools.diagnosis.accounting.bus import Telemetry
from edoras_tools.diagnosis.accounting.claims import Counts
from edoras_tools.diagnosis.accounting.commands import Commands
from edoras_tools.diagnosis.accounting.content import judge_contents
from edoras_tools.diagnosis.accounting.losses import TAIL_NS
from edoras_tools.diagnosis.accounting.pipes import measured_depth
from edoras_tools.diagnosis.constants import Constants
from edoras_tools.diagnosis.evidence.clocks.steady import without_steps
from edoras_tools.diagnosis.evidence.instances import NOBODY, Instances
from edoras_tools.diagnosis.evidence.loss_reports import reported_losses, tracks
from edoras_tools.diagnosis.evidence.peers import Network
from edoras_tools.diagnosis.evidence.preparation import Prepared
from edoras_tools.diagnosis.evidence.relays import UNTOUCHED, Proxied, RouteWay
from edoras_tools.diagnosis.evidence.table import Recorder, Rows, followed
from edoras_tools.diagnosis.evidence.timeline.changes import SoftwareChanges, capture_changes, network_changes
from edoras_tools.diagnosis.evidence.timeline.table import NEVER, Timeline
from edoras_tools.diagnosis.evidence.unreachable import Unreachable, count_lost
from edoras_tools.diagnosis.ledger import MessageLedger
from edoras_tools.diagnosis.matching.crossing import Hop, find_hops
from edoras_tools.diagnosis.matching.stalls import stalls
from edoras_tools.diagnosis.matching.streams import bursts, comb, find_resets, find_robots, find_streams
from edoras_tools.diagnosis.quality import (
    CONFIDENCE,
    HostDrops,
    assess_quality,
    find_holes,
    host_drops,
    overlapping,
)
from edoras_tools.model import NO_MSG_ID, NO_ROUTE, Endpoint, Finding, Link, Peer
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import cfe
from edoras_tools.wire.arrays import Integers, Mask, Places, by_key, by_value, distinct
from edoras_tools.wire.sbn import HEADER as SBN_HEADER

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence

    from edoras_tools.cfs.profile import SimProfile
    from edoras_tools.diagnosis.accounting.losses import Loss, Outage
    from edoras_tools.diagnosis.evidence.loss_reports import LossEvents, PipeKind, ReportedLoss, Track
    from edoras_tools.diagnosis.evidence.payloads import EventRecord, Payloads
    from edoras_tools.diagnosis.matching.streams import Comb, PipeEnd, Reset, Span, Stream
    from edoras_tools.diagnosis.verdict import Verdict
    from edoras_tools.links.doors import LinkEvidence, SampleStream, Unwrapper
    from edoras_tools.mission import Mission, Route
    from edoras_tools.model import CutDatagram, HostCounters, InterfaceOutage
    from edoras_tools.structs.bindings import Bound

    ProxyFaults = Mapping[RouteWay, Proxied]

_MOST: Final = 0.5
_SLACK_NS: Final = 50 * MILLISECOND
_FRAGMENT_BYTES: Final = 1480
"""IP payload bytes of one fragment on Ethernet."""
_CLEAN_NS: Final = 10 * SECOND
_HIGHER: Final = 1.1
_FULL: Final = 6
"""So many rounds that lost commands show a limit."""
_TIME: Final = attrgetter("time_ns")
OfLink = TypeVar("OfLink")
Of = ParamSpec("Of")
Result = TypeVar("Result")


def keep_results(find: Callable[Concatenate[Case, Of], Result]) -> Callable[Concatenate[Case, Of], Result]:
    """Let a function of a case be asked once for the same arguments: the case keeps its results."""

    @wraps(find)
    def ask(case: Case, /, *args: Of.args, **options: Of.kwargs) -> Result:
        results: dict[Any, Result] = case.results.setdefault(find, {})
        if (key := (*args, *options.items())) not in results:
            results[key] = find(case, *args, **options)
        return results[key]

    return ask


class Capture(msgspec.Struct, frozen=True):
    """Facts about the capture itself, apart from its datagrams.

    Attributes:
        drops: frames that the kernel or a full queue lost before capture; None if the capture has no count.
        warnings: warnings of the source, one sentence each.
        zero_ns: time of the first datagram of the file, if the examined part begins later; else None.
        cut: number of datagrams outside the examined time.
        outages: spans in which the interface was away.
        host: counters of the recording host's kernel, oldest first.
        evidence: link to the evidence that it collects by itself.
        unwrappers: link to the object that unpacked packets from their carriers.
        lacking: datagrams that lack fragments.
        shared: number of datagrams left out because another capture, read beside this one, has them.
        astray: time in ns, fingerprint and certainty of each datagram that did not reach the place of the
            next capture on its path.
        begins: time at which the first capture with a conversation, by source and destination, begins, ns; of
            those that begin after another capture.
    """

    drops: int | None = None
    warnings: tuple[str, ...] = ()
    zero_ns: int | None = None
    cut: int = 0
    outages: tuple[InterfaceOutage, ...] = ()
    host: tuple[HostCounters, ...] = ()
    evidence: Mapping[Link, LinkEvidence] = msgspec.field(default_factory=dict)
    unwrappers: Mapping[Link, Unwrapper] = msgspec.field(default_factory=dict)
    lacking: tuple[CutDatagram, ...] = ()
    shared: int = 0
    astray: tuple[tuple[int, int, bool], ...] = ()
    begins: Mapping[tuple[Endpoint, Endpoint], int] = {}

    def evidence_of(self, link: Link, kind: type[OfLink]) -> OfLink | None:
        """Return a link's evidence, else its unwrapper, if it is an instance of ``kind``; else None."""
        state = self.evidence.get(link, self.unwrappers.get(link))
        return state if isinstance(state, kind) else None

    def samples(self) -> list[SampleStream]:
        """Return one entry for each writer whose samples a link collected by itself."""
        return [item for own in self.evidence.values() for item in own.samples()]

    def spans(self) -> list[tuple[int, int]]:
        """Return the spans (start, end), ns, in which links collected evidence by themselves."""
        return [span for own in self.evidence.values() for span in own.spans()]

    def rows(self) -> list[Any]:
        """Return the balance rows (``ledger.Row``) that links counted by themselves."""
        return [row for own in self.evidence.values() for row in own.rows(self.drops)]

    def missing(self) -> list[Any]:
        """Return the lost messages (``missing.Missing``) that links found by themselves."""
        return [item for own in self.evidence.values() for item in own.missing(self.drops)]

    @property
    def away(self) -> list[tuple[int, int]]:
        """Outages of the interface (start, end), ns; the end is ``NEVER`` if it did not come back."""
        return [(item.start_ns, item.end_ns or NEVER) for item in self.outages]


class Case:
    """One capture with all that follows from it.

    Attributes:
        prepared: the rows of the capture as it was recorded, and counts of the datagrams that were left out.
        rows: table with one row for each datagram.
        jumps: steps of clocks that were set during the capture; the times of the rows have none of them.
        instances: boots of cFS that the packets come from.
        unsteady_ns: random error of the capture times, ns.
        payloads: counters, events, subscriptions and commands that the packets hold.
        endpoints: endpoints that ``source`` and ``destination`` of the rows index.
        samples: (link, MsgId) to some CDR messages by length.
        passed_states: robot states that left cFS as telemetry.
        context: mission, types and options.
        assumed: constants of cFS from the mission and the options, else the defaults.
        capture: facts about the capture itself.
        proxied: (link, direction, MsgId) to the faults that a proxy injected.
        verdicts: verdicts of the rules that ran so far.
        refused: verdicts about messages that cFS refused because of what they contain.
        results: function to its results by arguments, of those with ``keep_results``.
        constants: constants of cFS, with those that were learned from the capture.
        quality: upper bounds of the share of datagrams that the capture missed.
        ingests: accounts of CI, one for each CI.
        outages: stops and restarts of applications that are certain, or visible in the traffic.
        unheard: stream to its messages that were sent to a silent SBN peer.
        unreached: messages to ports that were closed or not reachable.
        contents: messages that arrived with another content than they were sent with.
        ledger: fates of all messages; the rules about single messages have to run before.
    """

    constants = cached_property(Constants)
    quality = cached_property(assess_quality)
    ingests = cached_property(ingest.ingests)
    outages = cached_property(closed.outages)
    unheard = cached_property(closed.unheard)
    unreached = cached_property(closed.unreached)
    contents = cached_property(judge_contents)
    ledger = cached_property(MessageLedger)
    silences_of = keep_results(closed.silences_of)

    def __init__(
        self, recorder: Recorder, profile: SimProfile, capture: Capture, proxied: ProxyFaults | None = None
    ) -> None:
        self.proxied: ProxyFaults = proxied or {}
        self.prepared = Prepared(recorder, self.proxied, capture.astray, shared=capture.shared > 0)
        payloads = self.prepared.payloads
        rows, self.jumps, self.instances = without_steps(
            self.prepared.rows, payloads.events, recorder.endpoints
        )
        if self.jumps:  # a step of a clock looked like a restart: follow the sequence counts again
            rows, payloads = followed(rows), payloads.timed(rows.time_ns)
        if (np.diff(rows.time_ns) < 0).any():  # a few ms out of order near a set clock
            order = np.argsort(rows.time_ns, kind="stable")
            rows, payloads = rows.take(order), payloads.over(order, len(rows))
            self.instances = Instances(rows, payloads.events, recorder.endpoints)
        self.rows: Rows = rows
        self.payloads: Payloads = payloads
        self.unsteady_ns = self.prepared.unsteady_ns
        self.endpoints: Sequence[Endpoint] = recorder.endpoints
        self._errors = recorder.errors
        self.samples = recorder.samples
        self.passed_states = list(recorder.states.passed())
        self.context = recorder.context
        msg_ids = recorder.context.msg_ids
        limits = {msg_ids.of_known(item): limit for item, limit in profile.to_limits.items()}
        stated = {msg_ids.of_known(item) if isinstance(item, int) else item for item in profile.stated}
        self.assumed = replace(profile, to_limits=limits, stated=frozenset(stated))
        self.capture = capture
        self.refused: list[Verdict] = []
        self.verdicts: list[Verdict] = []
        self.results: dict[Any, dict[Any, Any]] = {}

    @property
    def profile(self) -> SimProfile:
        """The constants of cFS to calculate with: learned from the capture, else assumed."""
        return self.constants.profile

    def origin(self, *names: str | int) -> Literal["told", "assumed"]:
        """Return the origin of constants that the capture does not show.

        Args:
            names: names of constants, or MsgIds.

        Returns:
            ``told`` if the mission or an option sets all of them, else ``assumed``.
        """
        return "told" if self.assumed.stated.issuperset(names) else "assumed"

    @property
    def mission(self) -> Mission:
        """The mission; it may be empty."""
        return self.context.mission

    @cached_property
    def start_ns(self) -> int:
        """Capture time of the first datagram, ns; 0 without datagrams."""
        return int(self.rows.time_ns.min()) if len(self.rows) else 0

    @property
    def zero_ns(self) -> int:
        """The zero, in ns, of all times that people read."""
        return self.start_ns if self.capture.zero_ns is None else self.capture.zero_ns

    @cached_property
    def end_ns(self) -> int:
        """Capture time of the last datagram, ns; 0 without datagrams."""
        return int(self.rows.time_ns.max()) if len(self.rows) else 0

    @cached_property
    def streams(self) -> list[Stream]:
        """The streams: packets of one MsgId on one link, to one CI, from one cFS, or between SBN peers."""
        return find_streams(self.rows, self.instances)

    @cached_property
    def resets(self) -> list[Reset]:
        """Restarts of a cFS whose clock did not restart."""
        return find_resets(self.rows, self.streams)

    @cached_property
    def tracks(self) -> dict[int, Track]:
        """Instance to the history of its software bus counters (0x803)."""
        return tracks(self.rows, self.payloads, self.instances, self.resets)

    @cached_property
    def reported_losses(self) -> dict[ReportedLoss, LossEvents]:
        """Losses that events report (MsgId, pipe, sender), with these events."""
        once = (item for item in self.payloads.events if self.rows.duplicates[item.row] <= 0)
        return reported_losses(once, self.instances)

    def events_about(
        self, instance: int, msg_id: int, kind: PipeKind
    ) -> list[tuple[ReportedLoss, LossEvents]]:
        """Return the losses of a MsgId at pipes of an instance that events report."""
        about, every = (instance, msg_id, kind), self.reported_losses.items()
        return [(item, events) for item, events in every if (item.instance, item.msg_id, item.kind) == about]

    @cached_property
    def holes(self) -> list[tuple[int, int]]:
        """Spans (start, end), ns, without a datagram, though the senders and the interface were running."""
        return self._holes[0]

    @cached_property
    def _holes(self) -> tuple[list[tuple[int, int]], ...]:
        """The certain holes, then the possible ones; a time in which robots were captured is none."""
        away, other_ns = self.capture.away, np.sort(self._errors.voices()[0])

        def is_empty(begin: int, stop: int) -> bool:
            inside = other_ns[slice(*np.searchsorted(other_ns, (begin, stop)))]
            half = 2 * int(np.diff(inside, prepend=begin, append=stop).max()) > stop - begin
            return half and not any(start < stop and begin < end for start, end in away)

        return tuple([item for item in holes if is_empty(*item)] for holes in find_holes(self.rows))

    @property
    def away(self) -> list[tuple[int, int]]:
        """Spans (start, end), ns, in which the capture could not record: outages and certain holes."""
        return sorted([*self.capture.away, *self.holes])

    @cached_property
    def confidence(self) -> float:
        """The confidence for one stream of many (Bonferroni): among many, one outlier is no surprise."""
        return 1 - (1 - CONFIDENCE) / len(self.streams)

    def frames(self, stream: Stream) -> int:
        """Return how many frames the longest datagram of a stream takes; 1 if none was fragmented."""
        pieces = stream.rows[self.rows.has(Finding.FRAGMENT, stream.rows)]
        return max(1, -(-int(self.rows.length[pieces].max(initial=0)) // _FRAGMENT_BYTES))

    def perhaps_missed(self, size: int, number: int, runs: int | None = None) -> int:
        """Return how many missing messages of a stream the capture itself may have missed, at most.

        Args:
            size: number of messages in the stream.
            number: number of messages that are missing.
            runs: in how many runs of frames it can have missed them; None: each for itself.
        """
        return self.quality.perhaps_missed(size, number, number if runs is None else runs, self.confidence)

    @cached_property
    def unreached_flows(self) -> list[tuple[Flow, int, int]]:
        """Flows to ports that no option names, if ICMP errors report these ports closed.

        Each has two numbers: datagrams that certainly reached nobody, and those that perhaps did not.
        """
        errors = self._errors.errors()
        errors = errors.take(errors.closed)
        which = np.where(errors.identification != 0, errors.identification, errors.time_ns)
        columns = (errors.source, errors.destination, which, errors.time_ns)
        quoted: dict[tuple[Endpoint, Endpoint], dict[int, int]] = {}
        for a, b, at, when in zip(*(column.tolist() for column in columns), strict=True):
            quoted.setdefault((self.endpoints[a], self.endpoints[b]), {})[at] = when
        flows = [item for item in self.prepared.flows if item.kind is ConversationKind.UNNAMED]
        both = [(item, own) for item in flows if (own := quoted.get((item.source, item.destination)))]
        number = {endpoint: at for at, endpoint in enumerate(self.endpoints)}
        times, source, destination = self._errors.voices()
        voices = {way: np.sort(times[at]) for way, at in by_value(source << 32 | destination)}
        unreached = []
        for item, own in both:
            came = voices.get(number[item.source] << 32 | number[item.destination], times[:0])
            unreached.append((item, *count_lost(item, came, list(own.values()))))
        return unreached

    @property
    def unnamed(self) -> list[Unnamed]:
        """Ports that no option names, with a link's traffic, it seems, but for wholly unreached ones."""
        closed = {id(flow) for flow, number, more in self.unreached_flows if number + more >= flow.datagrams}
        return unnamed(flow for flow in self.prepared.flows if id(flow) not in closed)

    @cached_property
    def unreachable(self) -> Unreachable:
        """The datagrams that reached nobody, as ICMP errors show."""
        unreached = Unreachable(self.rows, self._errors, self.endpoints, self.prepared.translated)
        if all(item.clock != "capture" for item in self.jumps):  # else robots' times are as captured
            unreached.add_silent(self.rows, self._errors, self.endpoints)
        return unreached

    @cached_property
    def network(self) -> Network:
        """The peers of the Software Bus Network and their connections."""
        return Network(self.rows, self.instances, self.assumed, self.all_holes)

    @cached_property
    def timeline(self) -> Timeline:
        """The states of each cFS, application, link, peer and of the capture over time."""
        software = SoftwareChanges(self.rows, self.payloads, self.instances, self.jumps, self.resets)
        changes = list(software.changes())
        changes += network_changes(self.rows, self.payloads, self.instances, self.network, changes)
        changes += capture_changes(self.away)
        return Timeline([*changes, *stalls(self.rows, self.streams, self.instances, Timeline(changes))])

    @cached_property
    def robots(self) -> list[Stream]:
        """The streams to robots."""
        return find_robots(self.rows)

    @cached_property
    def hops(self) -> list[Hop]:
        """Pairs of streams: the messages of the first leave cFS again as messages of the second."""
        return find_hops([*self.streams, *self.robots], self.rows, self)

    @cached_property
    def damaged(self) -> dict[Stream | None, Rows]:
        """Stream to its datagrams with a wrong checksum; None to those that belong to no stream."""
        rows, hosts = self.prepared.damaged, self.instances.hosts
        places: dict[Stream | None, list[int]] = {}
        for place, when in enumerate(rows.time_ns.tolist()):
            own = [
                (max(int(item.time_ns[0]) - when, when - int(item.time_ns[-1]), 0), item)
                for item in [*self.streams, *self.robots]
                if (item.link, item.msg_id) == (rows.link[place], rows.msg_id[place])
                and item.receiver == rows.destination[place]
                and hosts[item.sender] == hosts[rows.source[place]]
            ]
            places.setdefault(min(own, key=itemgetter(0), default=(0, None))[1], []).append(place)
        none = rows.take(slice(0))
        return defaultdict(lambda: none, {key: rows.take(np.array(own)) for key, own in places.items()})

    def arrival(self, stream: Stream) -> Hashable:
        """Return a key for ``follows``: equal for streams that enter at one place; None if unsubscribed."""
        is_taken = stream.msg_id not in self._not_taken
        return (stream.link.code, stream.receiver, stream.processor) if is_taken else None

    def departure(self, stream: Stream) -> Hashable:
        """Return a key for ``follows``: equal for streams that leave at one place."""
        return stream.link.code, stream.sender, self._leaves(stream)

    def _leaves(self, out: Stream) -> str:
        """Return the name of the cFS that a stream leaves, as ``66:1``; empty if unknown."""
        if not out.link.only_from_cfs:
            return self.network.identity_of.get(out.sender, "")
        owner = self.instances.owner(out.sender, int(out.time_ns[0]))
        return self.instances.items[owner].name if owner != NOBODY else ""

    def follows(self, into: Stream, out: Stream) -> bool:
        """Return whether the cFS that receives ``into`` may be the one that sends ``out``."""
        hosts, arrives = self.instances.hosts, self.network.identity_of.get(into.receiver, "")
        far = hosts[into.receiver] != hosts[out.sender]
        if far and (into.link, arrives, int(hosts[out.sender])) in self._receiving:
            return False  # it leaves from another address, which has a receiver like this one
        if into.link.only_to_cfs or out.link.last_hop:
            return True
        leaves = self._leaves(out)
        if arrives and leaves:
            return arrives == leaves
        return f"{into.processor[0]}:{into.processor[1]}" != leaves

    @cached_property
    def _not_taken(self) -> set[int]:
        """MsgIds that CI or SBN put on the software bus without any subscriber."""
        return {
            item.msg_id
            for item in self.reported_losses
            if item.kind == "no_subscriber" and item.sender.startswith((*command_ingest.NAMES, "SBN"))
        }

    @cached_property
    def _receiving(self) -> set[tuple[Link, str, int]]:
        """Link, SBN identity and number of the address of each receiver."""
        hosts, name = self.instances.hosts, self.network.identity_of.get
        return {(item.link, name(item.receiver, ""), int(hosts[item.receiver])) for item in self.streams}

    @cached_property
    def incomplete_ns(self) -> dict[tuple[Endpoint, int], list[int]]:
        """Sender and MsgId to the times, ns, of datagrams whose later fragments never came.

        It is empty if the capture's clock was set: only the rows' times have no such step.
        """
        if any(item.clock == "capture" for item in self.jumps):
            return {}
        start_of: dict[Endpoint, int] = {}
        for stream in self.streams if self.capture.lacking else ():
            ends = distinct(self.rows.source[stream.rows]) if not stream.link.only_to_cfs else ()
            start_of |= {self.endpoints[at]: SBN_HEADER.size * stream.link.peers for at in ends}
        times: dict[tuple[Endpoint, int], list[int]] = {}
        for item in self.capture.lacking:
            start = start_of.get(item.source, len(item.head))
            if len(item.head) > start + cfe.COMMAND_HEADER_BYTES:
                msg_id = self.context.msg_ids.of(item.head, start)
                times.setdefault((item.source, msg_id), []).append(item.time_ns)
        return times

    def came_in_part(self, stream: Stream) -> Integers:
        """Return how many messages to a CI lack fragments behind each row, less what it counted: i64 (rows,).

        They are of this stream if no other one to a CI has fragments; most do not show their MsgId.
        """
        numbers, receiver = np.zeros(len(stream), np.int64), self.endpoints[stream.receiver]
        senders = {self.endpoints[at].address for at in np.unique(self.rows.source[stream.rows]).tolist()}
        ways = (item for item in self.capture.lacking if item.source.address in senders)
        parts = [item for item in ways if item.destination.address == receiver.address]
        # Without its first fragment a datagram does not show its port.
        ports = {item.destination.port for item in parts} | {receiver.port}
        own = {0, receiver.port} if ports <= {0, receiver.port} else {receiver.port}
        parts_ns = sorted(item.time_ns for item in parts if item.destination.port in own)
        accounts = self.ingests_at(stream.receiver)
        number = len(parts_ns) - sum(own.not_captured for own in accounts)
        into = [item for item in self.streams if item.link.only_to_cfs] if accounts and number > 0 else []
        if [item for item in into if self.rows.has(Finding.FRAGMENT, item.rows).any()] == [stream]:
            after = np.searchsorted(stream.time_ns, parts_ns[-number:]) - 1
            np.add.at(numbers, np.maximum(after, 0), 1)
        return numbers

    @cached_property
    def to_ci(self) -> Places:
        """Rows of the datagrams that a CI may have counted: it does not read empty ones."""
        came = self.rows.on(lambda link: link.only_to_cfs) & ~self.rows.undelivered & (self.rows.length > 0)
        return np.flatnonzero(came)

    def ingests_at(self, endpoint: int) -> list[ingest.Ingest]:
        """Return the accounts of the CI at an endpoint; none if nothing counts there."""
        return [item for item in self.ingests if item.endpoint == endpoint]

    @cached_property
    def listeners(self) -> dict[int, int]:
        """Endpoint of a CI to the number of its cFS, for each CI whose own counts are here."""
        return {item.endpoint: item.system for item in self.ingests if not item.by_kernel}

    @property
    def possible_holes(self) -> list[tuple[int, int]]:
        """Spans (start, end), ns, without any datagram, for no visible reason: possible holes."""
        return self._holes[1]

    @property
    def all_holes(self) -> list[tuple[int, int]]:
        """Spans (start, end), ns, without any datagram, for whatever reason."""
        return sorted([*self.away, *self.possible_holes])

    def blind_spans(self, hops: Sequence[Hop]) -> list[tuple[int, int]]:
        """Return spans (start, end), ns, in which the capture cannot show what leaves by some hops."""
        ways = ((self.endpoints[hop.out.sender], self.endpoints[hop.out.receiver]) for hop in hops)
        late_ns = (self.capture.begins.get(way, 0) for way in ways)
        return [*self.all_holes, (0, max(late_ns, default=0))]

    def overlaps_outage(self, starts: Integers, ends: Integers) -> Mask:
        """Return which spans overlap a time in which the capture could not record: bool (n,)."""
        return overlapping(starts, ends, self.away)

    def rounds(self, stream: Stream, span: Span) -> Comb:
        """Return the rounds in which a stream's MsgId arrives during a span."""
        times = self.times(stream)
        return comb(times[(times >= span.start_ns) & (times <= span.end_ns)])

    @keep_results
    def times(self, stream: Stream) -> Integers:
        """Return when a stream's MsgId left its pipe, i64 ns, of all publishers: they share its limit."""
        own = stream.sender, stream.msg_id
        alike = [
            item.time_ns
            for item in self.streams
            if item.way == stream.way or (item.link.only_from_cfs and (item.sender, item.msg_id) == own)
        ]
        return np.sort(np.concatenate(alike))

    @keep_results
    def leaving(self, pipe: PipeEnd) -> Integers:
        """Return when packets of any MsgId left a pipe, i64 ns."""
        own = (self.rows.link == pipe.link) & (self.rows.source == pipe.sender)
        own &= (pipe.receiver == NOBODY) | (self.rows.destination == pipe.receiver)
        return self.rows.time_ns[own]

    @keep_results
    def arriving(self, receiver: int) -> Integers:
        """Return when datagrams were sent to an endpoint, i64 ns, in order."""
        return np.sort(self.rows.time_ns[self.rows.destination == receiver])

    @keep_results
    def measured_depth(self, pipe: PipeEnd, period_ns: int) -> int:
        """Return the depth of a pipe, as its largest round shows it."""
        return measured_depth(self.leaving(pipe), period_ns)

    def faults_on(self, stream: Stream) -> Proxied:
        """Return the faults that a proxy injected into a stream's MsgId on its link."""
        to_cfs = stream.link.only_to_cfs or (stream.link.peers and not stream.counted)
        return self.proxied.get((stream.link.code, to_cfs, stream.msg_id), UNTOUCHED)

    @cached_property
    def peers_unseen(self) -> bool:
        """Whether Telemetry Output forwards packets of another cFS, and the capture has no SBN datagrams."""
        on_sbn = self.rows.on(lambda link: link.peers).any()
        return not on_sbn and any(
            stream.link.only_from_cfs and stream.instance not in {NOBODY, self.owner(stream)}
            for stream in self.streams
        )

    @cached_property
    def upstream(self) -> dict[Stream, Hop]:
        """Stream to the hop that feeds it with unchanged packets, if there is one."""
        return {hop.out: hop for hop in reversed(self.hops) if not hop.rewritten}

    @keep_results
    def owner(self, stream: Stream) -> int:
        """Return the instance whose pipe a telemetry stream comes out of; ``NOBODY`` if unknown."""
        start_ns = int(stream.time_ns[0])
        if stream.link.only_from_cfs:
            return self.instances.owner(stream.sender, start_ns)
        if stream.instance != NOBODY:
            return stream.instance
        return self.instances.named(self.network.identity_of.get(stream.sender, ""), start_ns, stream.sender)

    def commanded_limit(self, stream: Stream) -> int | None:
        """Return the limit of a stream at Telemetry Output, if the last command on its entry set one."""
        system = self.instances.system(self.owner(stream))
        changes = self.timeline.entry(stream.msg_id, system) if stream.link.only_from_cfs else []
        return changes[-1].limit if changes else None

    def queue_of(self, stream: Stream) -> queues.Queue:
        """Return the model of the pipe that a telemetry stream comes out of."""
        return (queues.telemetry_pipe if stream.link.only_from_cfs else queues.peer_pipe)(self.profile)

    def pipe_of(self, stream: Stream) -> str:
        """Return the name of the pipe that a telemetry stream comes out of."""
        if stream.link.only_from_cfs:
            return telemetry_output.PIPE
        spacecraft, _, processor = self.network.identity_of.get(stream.receiver, "").partition(":")
        return sbn.peer_pipe(Peer(int(spacecraft), int(processor))) if processor else "pipe of an SBN peer"

    @keep_results
    def into_system(self, stream: Stream, system: int) -> bool:
        """Return whether a stream into cFS may arrive at a system; True if nothing is known of it."""
        members = [at for at, other in enumerate(self.instances.systems) if other == system]
        return not members or any(self.goes_to(stream, at) for at in members)

    def system(self, stream: Stream) -> int:
        """Return the number of the system that a stream into cFS arrives at; 0 if unknown."""
        return next((item for item in self.instances.systems if self.into_system(stream, item)), 0)

    def goes_to(self, stream: Stream, instance: int) -> bool:
        """Return whether a stream into cFS may arrive at an instance."""
        if instance == NOBODY:
            return True
        item, system = self.instances.items[instance], self.instances.systems[instance]
        if stream.link.only_to_cfs:
            owner = self.listeners.get(stream.receiver)
            return owner == system if owner is not None else system not in self.listeners.values()
        if item.name and self.network.identity_of.get(stream.receiver, item.name) != item.name:
            return False
        same = int(self.instances.hosts[stream.receiver]) == item.host
        return same or not self.instances.others_named(instance)

    @cached_property
    def telemetry(self) -> Telemetry:
        """The gaps in the sequence counts of telemetry, with their fates."""
        return self.commands.telemetry

    @cached_property
    def commands(self) -> Commands:
        """The fates of all messages that went into cFS."""
        return Commands(self, Telemetry(self))

    def is_far(self, endpoint: int) -> bool:
        """Tell whether a network may lie between the capture and an endpoint, of which it does not tell."""
        at_host = any(item.by_kernel for item in self.ingests_at(endpoint)) or self.capture.shared
        return not (at_host or ip_address(self.endpoints[endpoint].address).is_loopback)

    @cached_property
    def loss_counts(self) -> dict[int, Counts]:
        """Instance to the growth of its loss counters; each loss takes its share out of it."""
        items, profile = self.instances.items, self.profile
        return {
            at: Counts.of(track, items[at].boot_ns(profile), self._later_events(at, track.times[-1]))
            for at, track in self.tracks.items()
            if len(track.times) > 1
        }

    def _later_events(self, instance: int, last_ns: int) -> dict[PipeKind, list[int]]:
        """Return kind of loss at a pipe to the times, ns, of events after an instance's last 0x803."""
        times: dict[PipeKind, list[int]] = {}
        for item, events in self.reported_losses.items():
            if item.at_pipe and item.instance == instance:
                made_ns = self.instances.made_ns[[record.row for record in events.records]]
                times.setdefault(item.at_pipe, []).extend(made_ns[made_ns > last_ns + _SLACK_NS].tolist())
        return times

    @cached_property
    def losses(self) -> list[Loss]:
        """All losses; each lost message belongs to exactly one."""
        return [*self.telemetry.losses, *self.commands.losses]

    def missed_by_peer(self, stream: Stream) -> list[int]:
        """Return the messages of a stream that a silent SBN peer certainly missed, as indices of its rows.

        No other rule counts them.
        """
        silent = self.unheard.get(stream)
        return [*silent.lost, *silent.restarted] if silent else []

    def losses_of(self, stream: Stream) -> list[Loss]:
        """Return the losses of a stream."""
        return self._losses_of.get(stream, [])

    def application_pipe(self, loss: Loss) -> tuple[queues.Queue, str]:
        """Return the pipe of an application, and whether its limit was measured, told or assumed.

        The rounds at the robot behind which commands are missing show another limit than the assumed one, if
        none comes late. While Command Ingest hands over, the application may read one.
        """
        pipe = queues.application_pipe(self.profile, over_network=loss.over_network)
        near_ns, cut = pipe.round_ns // 5, loss.span.rows if loss.span else slice(0, 0)
        for hop in (hop for hop in self.hops if hop.into is loss.stream and hop.out.link.last_hop):
            own = (hop.in_rows >= cut.start) & (hop.in_rows < cut.stop)
            times, missing = hop.out.time_ns[hop.out_rows[own]], np.append(np.diff(hop.in_rows[own]) - 1, 0)
            begins, sizes = bursts(times, near_ns)
            full = sizes[np.add.reduceat(missing, begins) > 0] if len(begins) else sizes
            late = np.sum(hop.delays_ns > pipe.round_ns + near_ns) > len(times) / 4
            if late or len(full) < _FULL or abs(np.median(np.diff(times[begins])) - pipe.round_ns) > near_ns:
                continue
            least, usual = np.quantile(full, (0.1, 0.5)).astype(int).tolist()
            # Where a network lost some, too, other rounds are larger; an application may read twice in one.
            alike = least == usual == np.median(sizes) and sizes.max() <= 2 * least
            if least > pipe.usual_limit + 1 or (alike and least < pipe.usual_limit):
                return replace(pipe, usual_limit=least), "measured"
        if not loss.over_network and self.profile.app_msg_limit != self.assumed.app_msg_limit:
            return pipe, "measured"
        return pipe, self.origin("sbn_wake_ns" if loss.over_network else "ci_wake_ns", "app_msg_limit")

    def lossless_hz(self, stream: Stream, assumed_hz: float) -> float:
        """Return the highest rate, Hz, at which a stream lost nothing for 10 s; 0 if none counts.

        A rate counts if it is above the assumed rate and below every rate at which the stream lost some.
        """
        lost = self.losses_of(stream)
        starts, ends = sorted(item.start_ns for item in lost), sorted(item.end_ns for item in lost)
        rates: tuple[list[float], list[float]] = [], []
        for span in stream.spans:
            lossy = bisect_right(starts, span.end_ns) > bisect_left(ends, span.start_ns)
            if lossy or span.end_ns - span.start_ns >= _CLEAN_NS:
                rates[lossy].append(span.offered_hz)
        most = min(rates[True], default=np.inf) / _HIGHER
        clean = [rate for rate in rates[False] if rate < most]
        return max((rate for rate in clean if rate > _HIGHER * assumed_hz), default=0.0)

    @cached_property
    def _losses_of(self) -> dict[Stream | None, list[Loss]]:
        return by_key(self.losses, lambda loss: loss.stream)

    @cached_property
    def has_telemetry(self) -> bool:
        """Whether the capture has any packet that a cFS sent."""
        return bool(self.instances.items or self.rows.on(lambda link: link.only_from_cfs).any())

    @cached_property
    def perhaps_doubled(self) -> Counter[tuple[int, int, int]]:
        """(link code, receiver, MsgId) to messages into cFS that were sent twice, or captured twice."""
        rows = self.prepared.doubled
        return Counter(zip(rows.link.tolist(), rows.destination.tolist(), rows.msg_id.tolist(), strict=True))

    def route(self, msg_id: int) -> Route | None:
        """Return the configured route of a MsgId on any link; None without one."""
        table = self.context.any_route_of
        index = int(table[msg_id]) if 0 <= msg_id < len(table) else NO_ROUTE
        return self.mission.routes[index] if index != NO_ROUTE else None

    def topic(self, msg_id: int) -> str | None:
        """Return the topic of a MsgId: of its route, else of its struct; None if neither or not unique."""
        owner = self.route(msg_id) or self.own_struct(msg_id)
        return owner.topic if owner else None

    def own_struct(self, msg_id: int) -> Bound | None:
        """Return the struct that all packets of a MsgId hold; None if none or several are configured."""
        own = self.context.structs.own(msg_id)
        return own[0] if len(own) == 1 else None

    def name(self, msg_id: int) -> str:
        """Return the text for a MsgId: ``0x1827 (/cmd_vel)``."""
        if msg_id == NO_MSG_ID:
            return "an unknown MsgId"
        text = self.topic(msg_id) or self.packet_name(msg_id)
        return f"0x{msg_id:04x} ({text})" if text else f"0x{msg_id:04x}"

    def packet_name(self, msg_id: int) -> str:
        """Return cFE's name of a MsgId, else the names of its structs; empty without any."""
        name = message_name(self.mission.msg_ids.standard(msg_id))
        return name or ", ".join(item.name for item in self.context.structs.own(msg_id))

    def of_known(self, msg_id: int) -> int:
        """Return the MsgId of this mission for one of message version 1, in which cFS facts are written."""
        return self.mission.msg_ids.of_known(msg_id)

    def events_between(
        self, start_ns: int, end_ns: int, *apps: str, event_ids: Iterable[int] = ()
    ) -> list[EventRecord]:
        """Return the events in a span of time, in order.

        Args:
            start_ns: earliest capture time.
            end_ns: latest capture time.
            apps: names of applications; none for all.
            event_ids: numbers of events; none for all.
        """
        own = self._events_of(apps, frozenset(event_ids))
        return own[bisect_left(own, start_ns, key=_TIME) : bisect_right(own, end_ns, key=_TIME)]

    @keep_results
    def _events_of(self, apps: tuple[str, ...], ids: frozenset[int]) -> list[EventRecord]:
        """Return the events of some applications with some numbers; empty ones mean all."""
        own = (item for item in self.payloads.events if not apps or item.app in apps)
        return [item for item in own if not ids or item.event_id in ids]

    @cached_property
    def _names(self) -> dict[str, str]:
        """Usual name of an application to its name in the events of this cFS, where they differ."""
        heard = {item.app for item in self.payloads.events}
        both = command_ingest.NAMES, telemetry_output.NAMES
        return {usual: other for usual, other in both if other in heard and usual not in heard}

    def called(self, text: str) -> str:
        """Return a text with the usual names of applications replaced by those of this cFS."""
        for usual, other in self._names.items():
            text = text.replace(usual, other)
        return text

    def end_of(self, item: Outage) -> str:
        """Return when an application ended: ``at 2.0 s``, or between which times where no command tells."""
        start, end = self.at(item.start_ns), self.at(item.ended_ns)
        return f"between {start} and {end}" if item.witness.startswith("event") else f"at {start}"

    def socket_failure(self, span: tuple[int, int]) -> str:
        """Return what shows that Telemetry Output's socket failed in a silence; empty if nothing does.

        That is its event, or its own count of commands: where it counted only those that ended the silence,
        no command had sent it elsewhere.
        """
        events = self.events_between(span[0] - SECOND, span[1] + SECOND, *telemetry_output.NAMES)
        own = (f"event {item}" for item in events if telemetry_output.SUPPRESSED.phrase in item.message)
        samples, rows, text = self.payloads.commanded, self.rows, next(own, "")
        at = np.searchsorted(samples["time_ns"], (span[0], span[1] + TAIL_NS), "right") - 1
        if text or not 0 <= at[0] < at[1] or len(self.instances.items) > 1:
            return text
        since_ns, until_ns = samples["time_ns"][at].tolist()
        sent = rows.on(lambda link: link.only_to_cfs) & (rows.known_id == telemetry_output.COMMAND_MSG_ID)
        sent_ns = rows.time_ns[sent & (rows.time_ns > since_ns) & (rows.time_ns <= until_ns)]
        grown = sum(int(np.diff(samples[name][at])[0]) % 256 for name in ("taken", "refused"))
        alone = grown == len(sent_ns) and sent_ns.min(initial=NEVER) > span[1] - TAIL_NS
        return f"0x880: it took no command from {self.at(since_ns)} until it was enabled" if alone else ""

    def span(self, rows: Sequence[int] | Places) -> tuple[int, int]:
        """Return the capture times, ns, of the first and the last of some rows; they are in order of time."""
        return int(self.rows.time_ns[rows[0]]), int(self.rows.time_ns[rows[-1]])

    def at(self, time_ns: int) -> str:
        """Return the text of a time: seconds into the capture."""
        return f"{max(0, time_ns - self.zero_ns) / SECOND:.1f} s"

    @cached_property
    def _target(self) -> str:
        """Options of ``inject`` for the only CI of the capture: address and headers, where not the usual."""
        to_ci = self.rows.on(lambda link: link.only_to_cfs)
        places = {self.endpoints[item] for item in np.unique(self.rows.destination[to_ci]).tolist()}
        usual = Endpoint("127.0.0.1", command_ingest.PORT)
        target = f" --target {next(iter(places))}" if len(places) == 1 and places != {usual} else ""
        lengths = self.rows.header_length[to_ci & (self.rows.function_code >= 0)]  # telemetry's are as long
        extended = bool(len(lengths)) and bool((lengths == cfe.WITH_EXTENDED.command_bytes).mean() > _MOST)
        version = self.mission.msg_ids.version
        headers = " --set extended-header=yes" * extended
        return f"{target}{headers}" + f" --set msg-id-version={version}" * (version != 1)

    def inject(self, name: str, *arguments: str) -> str:
        """Return the command line that sends a named command to the CI of the capture."""
        return inject_line(name, *arguments) + self._target

    def add_line(self, msg_id: int, *limit: int) -> str:
        """Return the command line that has Telemetry Output send a MsgId, with a limit or the usual one."""
        if not self._has_sized_entries:
            return self.inject("to-add", f"0x{msg_id:04x}", *(f"--limit {number}" for number in limit))
        entry = struct.pack("<I4xB3x", msg_id, *(limit or (telemetry_output.USUAL_LIMIT,)))
        code, words = telemetry_output.ADD_PACKET, f"0x{telemetry_output.COMMAND_MSG_ID:04x}"
        return f"edoras inject --command {words} {code} --hex {entry.hex()}" + self._target

    @cached_property
    def _has_sized_entries(self) -> bool:
        """Whether a packet size stands before the limit of an entry, as in TO_LAB up to v2.5.0-rc4."""
        texts = (telemetry_output.ADDED.pattern.fullmatch(item.message) for item in self.payloads.events)
        entries = {(int(it["msg_id"], 16), int(it["priority"]), int(it["limit"])) for it in texts if it}
        commands = self.payloads.outputs(telemetry_output.ADD_PACKET)
        length = {(it.entry, it.values.get("limit")): self.rows.packet_length[it.row] for it in commands}
        long = {entry for entry, number in length.items() if number == SIZED_ENTRY_BYTES}
        # Without a size in the command, its limit is read as the priority.
        short = length.keys() & {
            (msg_id, priority) for msg_id, priority, limit in entries if priority != limit
        }
        return bool(short or long & {(msg_id, limit) for msg_id, _, limit in entries})

    def label(self, instance: int) -> str:
        """Return the label of an instance for people; ``cFS`` for ``NOBODY``."""
        return "cFS" if instance == NOBODY else self.instances.label(instance)

    def receiver_label(self, stream: Stream) -> str | None:
        """Return the label of the cFS that a stream goes into; None if it is the only one, or unknown."""
        systems = self.instances.systems
        into = [index for index in range(len(systems)) if self.goes_to(stream, index)]
        if len(set(systems)) < 2 or len({systems[index] for index in into}) != 1:
            return None
        return self.label(into[0])

    @cached_property
    def host(self) -> HostDrops:
        """Drops that the kernel of the recording host counted during the capture."""
        return host_drops(self.capture.host, self.start_ns, self.end_ns)

    def drops_text(self) -> tuple[str, ...]:
        """Return the caveat, if any, that the capture itself lost frames."""
        if not self.capture.drops:
            return ()
        return (f"the capture itself lost {self.capture.drops:,} frames: some of this may be its own",)
