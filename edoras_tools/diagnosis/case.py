"""Everything that the rules judge by, worked out once from what was recorded."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import Counter, defaultdict
from functools import cached_property
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final, Literal, TypeVar

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.cfs import command_ingest, sbn, telemetry_output
from edoras_tools.cfs.commands import inject_line
from edoras_tools.cfs.names import message_name
from edoras_tools.decode.conversations import ConversationKind, Flow, Unnamed, unnamed
from edoras_tools.diagnosis.accounting import closed, ingest
from edoras_tools.diagnosis.accounting.bus import Telemetry
from edoras_tools.diagnosis.accounting.claims import Counts
from edoras_tools.diagnosis.accounting.commands import Commands
from edoras_tools.diagnosis.accounting.content import judge_contents
from edoras_tools.diagnosis.constants import Constants, learn_constants
from edoras_tools.diagnosis.evidence.clocks.steady import steadied
from edoras_tools.diagnosis.evidence.instances import NOBODY, Instances
from edoras_tools.diagnosis.evidence.loss_reports import (
    LossEvents,
    PipeKind,
    ReportedLoss,
    Track,
    reported_losses,
    tracks,
)
from edoras_tools.diagnosis.evidence.peers import Network
from edoras_tools.diagnosis.evidence.preparation import prepare
from edoras_tools.diagnosis.evidence.relays import UNTOUCHED, Proxied, RouteWay
from edoras_tools.diagnosis.evidence.table import Recorder, Rows, followed
from edoras_tools.diagnosis.evidence.timeline.changes import SoftwareChanges, capture_changes, network_changes
from edoras_tools.diagnosis.evidence.timeline.table import NEVER, Timeline
from edoras_tools.diagnosis.evidence.unreachable import Unreachable, count_shut, find_unreachable
from edoras_tools.diagnosis.ledger import MessageLedger
from edoras_tools.diagnosis.matching.crossing import Hop, find_hops
from edoras_tools.diagnosis.matching.stalls import stalls
from edoras_tools.diagnosis.matching.streams import (
    Comb,
    Reset,
    Span,
    Stream,
    comb,
    find_resets,
    find_robots,
    find_streams,
)
from edoras_tools.diagnosis.quality import (
    CONFIDENCE,
    Evidence,
    HostDrops,
    Quality,
    assess_quality,
    find_holes,
    host_drops,
    overlapping,
)
from edoras_tools.model import (
    NO_MSG_ID,
    NO_ROUTE,
    Endpoint,
    Finding,
    HostCounters,
    InterfaceOutage,
    Link,
    Peer,
)
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import cfe
from edoras_tools.wire.arrays.order import Integers, Mask, Places, by_key, by_value
from edoras_tools.wire.sbn import HEADER as SBN_HEADER

if TYPE_CHECKING:
    from collections.abc import Hashable, Iterable, Mapping, Sequence

    from edoras_tools.cfs.profile import SimProfile
    from edoras_tools.diagnosis.accounting.losses import Loss
    from edoras_tools.diagnosis.evidence.payloads import EventRecord, Payloads
    from edoras_tools.diagnosis.verdict import Advice, Verdict
    from edoras_tools.links.doors import LinkEvidence, SampleStream, Unwrapper
    from edoras_tools.mission import Mission, Route
    from edoras_tools.model import CutDatagram
    from edoras_tools.structs.bound import Bound

_MOST: Final = 0.5
_SLACK_NS: Final = 50 * MILLISECOND
_FRAGMENT_BYTES: Final = 1480
"""What a fragment holds on Ethernet."""
_CLEAN_NS: Final = 10 * SECOND
_HIGHER: Final = 1.1
_TIME: Final = attrgetter("time_ns")
OfLink = TypeVar("OfLink")


class Capture(msgspec.Struct, frozen=True):
    """What is known of the capture itself.

    Attributes:
        drops: frames that the kernel or a full queue lost before they were captured; None where the capture
            does not tell.
        warnings: what its source has to say.
        zero_ns: its first datagram, where what is judged begins later; None where that is the first.
        cut: datagrams that were left out for their time.
        outages: when the interface was away.
        host: what the kernel of the recording host counted, oldest first.
        evidence: what links saw in it themselves.
        unwrappers: what took packets out of what carried them, and what its counts say.
        lacking: datagrams of which the first fragment is in it, and no later one.
        shared: datagrams that were left out, for another capture read with this one has them.
        astray: time (ns) and fingerprint of each that never came to the place of another capture on its way,
            and whether that is sure.
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

    def evidence_of(self, link: Link, kind: type[OfLink]) -> OfLink | None:
        """Return what a link saw in it, or took packets out with; None where that is of no such kind."""
        state = self.evidence.get(link, self.unwrappers.get(link))
        return state if isinstance(state, kind) else None

    def samples(self) -> list[SampleStream]:
        """Return the samples of each writer that announces its topic."""
        return [item for own in self.evidence.values() for item in own.samples()]

    def spans(self) -> list[tuple[int, int]]:
        """Return from when to when links saw something themselves."""
        return [span for own in self.evidence.values() for span in own.spans()]

    def rows(self) -> list[Any]:
        """Return what links saw themselves, each a ``ledger.Row``."""
        return [row for own in self.evidence.values() for row in own.rows(self.drops)]

    def missing(self) -> list[Any]:
        """Return what links themselves saw to be lost, each a ``missing.Missing``."""
        return [item for own in self.evidence.values() for item in own.missing(self.drops)]

    @property
    def away(self) -> list[tuple[int, int]]:
        """From when to when the interface was away; the largest time where it was not back."""
        return [(item.start_ns, item.end_ns or NEVER) for item in self.outages]


class Case:
    """A capture, laid out for judgement.

    Attributes:
        prepared: what was left out, put in order or counted once before anything was judged.
        rows: a row a datagram.
        jumps: clocks that were set meanwhile; times are as if they had not been.
        instances: the cFS instances.
        unsteady_ns: by how much capture times are wrong in no order.
        payloads: counters, events, subscriptions, TO commands.
        endpoints: what ``source`` and ``destination`` of the rows index.
        samples: (link, MsgId) to some CDR messages by length.
        passed_states: states of robots that left cFS.
        context: mission, types and options.
        assumed: the constants of cFS that were given: its usual ones where nobody said others.
        capture: what is known of the capture itself.
        proxied: what a proxy did on purpose.
        verdicts: what the rules have said so far.
        refused: messages that came to nothing by what they are, each judged by itself.
        advice: what helps against losses at queues, once it was asked for; see ``diagnosis.advice``.
        ingests: the account of every CI.
        outages: every stop and restart of an application that is sure, or shows.
        unheard: what was sent to SBN peers that were silent, by the id of its stream.
        unreached: what went to ports that were closed, or that could not be reached.
        contents: what arrived as something else than was sent.
        ledger: what became of all traffic, once the rules about single messages were asked.
    """

    ingests = cached_property(ingest.ingests)
    outages = cached_property(closed.outages)
    unheard = cached_property(closed.unheard)
    unreached = cached_property(closed.unreached)
    contents = cached_property(judge_contents)
    ledger = cached_property(MessageLedger)

    def __init__(
        self,
        recorder: Recorder,
        profile: SimProfile,
        capture: Capture,
        proxied: Mapping[RouteWay, Proxied] | None = None,
    ) -> None:
        self.proxied: Mapping[RouteWay, Proxied] = proxied or {}
        self.prepared = prepare(recorder, self.proxied, capture.astray, shared=capture.shared > 0)
        payloads = self.prepared.payloads
        rows, self.jumps, self.instances = steadied(self.prepared.rows, payloads.events, recorder.endpoints)
        if self.jumps:  # what seemed to begin anew went on
            rows, payloads = followed(rows), payloads.timed(rows.time_ns)
        if (np.diff(rows.time_ns) < 0).any():  # a few ms out of order, beside a clock that was set
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
        self.advice: dict[tuple[object, ...], Advice] = {}
        self._silences: dict[int, list[tuple[int, int]]] = {}
        self._times: dict[tuple[int, ...], Integers] = {}
        self._events: dict[tuple[tuple[str, ...], frozenset[int]], list[EventRecord]] = {}

    @cached_property
    def constants(self) -> Constants:
        """The constants of cFS, and which of them the capture shows."""
        overflows = any(track.growth("pipe_overflows") for track in self.tracks.values())
        return learn_constants(
            self.assumed, self.rows, self.streams, self.hops, self.reported_losses, overflows=overflows
        )

    @property
    def profile(self) -> SimProfile:
        """The constants of cFS: learned from the capture, else assumed."""
        return self.constants.profile

    def origin(self, *names: str | int) -> Literal["told", "assumed"]:
        """Return what constants rest on that the capture does not show: told by a mission or an option."""
        return "told" if self.assumed.stated.issuperset(names) else "assumed"

    @property
    def mission(self) -> Mission:
        """The mission; it may say nothing."""
        return self.context.mission

    @cached_property
    def start_ns(self) -> int:
        """The first datagram."""
        return int(self.rows.time_ns.min()) if len(self.rows) else 0

    @property
    def zero_ns(self) -> int:
        """What times that people are told count from."""
        return self.start_ns if self.capture.zero_ns is None else self.capture.zero_ns

    @cached_property
    def end_ns(self) -> int:
        """The last datagram."""
        return int(self.rows.time_ns.max()) if len(self.rows) else 0

    @cached_property
    def streams(self) -> list[Stream]:
        """What was seen of each MsgId on each link."""
        return find_streams(self.rows, self.instances)

    @cached_property
    def resets(self) -> list[Reset]:
        """Restarts of a cFS whose clock went on."""
        return find_resets(self.rows, self.streams)

    @cached_property
    def tracks(self) -> dict[int, Track]:
        """The counters of each instance."""
        return tracks(self.rows, self.payloads, self.instances)

    @cached_property
    def reported_losses(self) -> dict[ReportedLoss, LossEvents]:
        """Whom events about loss name."""
        return reported_losses(self.payloads.events, self.instances)

    def events_about(
        self, instance: int, msg_id: int, kind: PipeKind
    ) -> list[tuple[ReportedLoss, LossEvents]]:
        """Return what events say of losses of a MsgId at pipes of an instance."""
        about, every = (instance, msg_id, kind), self.reported_losses.items()
        return [(item, events) for item, events in every if (item.instance, item.msg_id, item.kind) == about]

    @cached_property
    def holes(self) -> list[tuple[int, int]]:
        """From when to when nothing was captured though all went on sending and the interface was there."""
        return self._holes[0]

    @cached_property
    def _holes(self) -> tuple[list[tuple[int, int]], ...]:
        """Holes that are sure, and those that may be."""
        away = self.capture.away
        return tuple(
            [item for item in holes if not any(start < item[1] and item[0] < end for start, end in away)]
            for holes in find_holes(self.rows)
        )

    @property
    def away(self) -> list[tuple[int, int]]:
        """From when to when nothing could be captured."""
        return sorted([*self.capture.away, *self.holes])

    @cached_property
    def quality(self) -> Quality:
        """What bounds the datagrams that the capture missed."""
        evidence = self.rows, self.payloads, self.instances, self.streams, self.hops, self.tracks
        quality = assess_quality(*evidence, self.blind, self.capture.drops)
        # Where frames are cut, no answer tells what was missed; what CI counts more does.
        cut = self.rows.has(Finding.CAPTURE_CUT).any() and not quality.lacks_answered
        own = [item for item in self.ingests if item.not_captured and cut]
        counts = ((item.endpoint, item.taken + item.not_captured, item.not_captured) for item in own)
        more = [Evidence("ci_counts", *item) for item in counts]
        once = len(self.rows) - (twice := self.prepared.copies)
        if once < twice and not self.prepared.perhaps_astray.any():  # as of two that count the same
            more.append(Evidence("copies", NOBODY, twice, once**2 // (4 * twice)))
        return replace(quality, evidence=(*quality.evidence, *more))

    @cached_property
    def confidence(self) -> float:
        """The confidence for one of many streams: that one lacks more than by itself is no wonder."""
        return 1 - (1 - CONFIDENCE) / len(self.streams)

    def frames(self, stream: Stream) -> int:
        """Return how many frames the longest datagram of a stream came in; 1 if none came in fragments."""
        pieces = stream.rows[self.rows.has(Finding.FRAGMENT, stream.rows)]
        return max(1, -(-int(self.rows.length[pieces].max(initial=0)) // _FRAGMENT_BYTES))

    def may_lack(self, size: int, number: int) -> int:
        """Return how many of so many that a stream of a size lacks the capture may have missed."""
        excluded = self.quality.excludes(number / size)
        return 0 if excluded else min(number, self.quality.may_have_missed(size, self.confidence))

    @cached_property
    def shut(self) -> list[tuple[Flow, int, int]]:
        """What looks like a link's on ports that nobody named; how much of it reached nobody, or may."""
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
        shut = []
        for item, own in both:
            came = voices.get(number[item.source] << 32 | number[item.destination], times[:0])
            shut.append((item, *count_shut(item, came, list(own.values()))))
        return shut

    @property
    def unnamed(self) -> list[Unnamed]:
        """The same, where errors do not say that it reached nobody."""
        closed = {id(flow) for flow, number, more in self.shut if number + more >= flow.datagrams}
        return unnamed(flow for flow in self.prepared.flows if id(flow) not in closed)

    @cached_property
    def unreachable(self) -> Unreachable:
        """What ICMP errors say of datagrams that reached nobody."""
        return find_unreachable(self.rows, self._errors, self.endpoints, self.prepared.translated)

    @cached_property
    def network(self) -> Network:
        """The Software Bus Network."""
        return Network(self.rows, self.instances, self.assumed, self.blind)

    @cached_property
    def timeline(self) -> Timeline:
        """The states of everything over time."""
        software = SoftwareChanges(self.rows, self.payloads, self.instances, self.jumps, self.resets)
        changes = list(software.changes())
        # What commands and events tell of an application is not told by its peers again.
        subjects = {(item.system, item.subject) for item in changes}
        network = network_changes(self.rows, self.payloads, self.instances, self.network)
        changes += [item for item in network if (item.system, item.subject) not in subjects]
        changes += capture_changes(self.away)
        return Timeline([*changes, *stalls(self.rows, self.streams, self.instances, Timeline(changes))])

    @cached_property
    def robots(self) -> list[Stream]:
        """What was sent to each robot."""
        return find_robots(self.rows)

    @cached_property
    def hops(self) -> list[Hop]:
        """Streams that come out again as others."""
        return find_hops([*self.streams, *self.robots], self.rows, self)

    @cached_property
    def damaged(self) -> dict[int, Rows]:
        """Datagrams that the network damaged, by the id of the stream that lacks them; 0: of no stream."""
        rows, hosts = self.prepared.damaged, self.instances.hosts
        places: dict[int, list[int]] = {}
        for place, when in enumerate(rows.time_ns.tolist()):
            own = [
                (max(int(item.time_ns[0]) - when, when - int(item.time_ns[-1]), 0), id(item))
                for item in [*self.streams, *self.robots]
                if (item.link, item.msg_id) == (rows.link[place], rows.msg_id[place])
                and item.receiver == rows.destination[place]
                and hosts[item.sender] == hosts[rows.source[place]]
            ]
            places.setdefault(min(own, default=(0, 0))[1], []).append(place)
        none = rows.take(slice(0))
        return defaultdict(lambda: none, {key: rows.take(np.array(own)) for key, own in places.items()})

    def damaged_of(self, stream: Stream | None) -> Rows:
        """Return the datagrams of a stream, or of none, that the network damaged."""
        return self.damaged[0 if stream is None else id(stream)]

    def arrival(self, stream: Stream) -> Hashable:
        """Return all that decides what may come out of a stream; None where nobody took it."""
        is_taken = stream.msg_id not in self._not_taken
        return (stream.link.code, stream.receiver, stream.processor) if is_taken else None

    def departure(self, stream: Stream) -> Hashable:
        """Return all that decides what a stream may have been before."""
        return stream.link.code, stream.sender, self._leaves(stream)

    def _leaves(self, out: Stream) -> str:
        """Return the name of the cFS that a stream leaves."""
        if not out.link.only_from_cfs:
            return self.network.identity_of.get(out.sender, "")
        owner = self.instances.owner(out.sender, int(out.time_ns[0]))
        return self.instances.items[owner].name if owner != NOBODY else ""

    def follows(self, into: Stream, out: Stream) -> bool:
        """Tell whether what arrives as one stream may leave as another: of the same cFS, not its sibling."""
        if self._of_another(into, out):
            return False
        if into.link.only_to_cfs or out.link.last_hop:
            return True
        arrives, leaves = self.network.identity_of.get(into.receiver, ""), self._leaves(out)
        if arrives and leaves:
            return arrives == leaves
        return f"{into.processor[0]}:{into.processor[1]}" != leaves

    @cached_property
    def _not_taken(self) -> set[int]:
        """MsgIds of what CI or SBN handed to the software bus, and that nobody had subscribed to."""
        return {
            item.msg_id
            for item in self.reported_losses
            if item.kind == "no_subscriber" and item.sender.startswith((*command_ingest.NAMES, "SBN"))
        }

    def _of_another(self, into: Stream, out: Stream) -> bool:
        """Tell whether one goes to an address, and the other leaves one with a receiver of its own."""
        hosts, name = self.instances.hosts, self.network.identity_of.get
        return (
            hosts[into.receiver] != hosts[out.sender]
            and (into.link, name(into.receiver), int(hosts[out.sender])) in self._receiving
        )

    @cached_property
    def _receiving(self) -> set[tuple[Link, str | None, int]]:
        """Link, SBN identity and address of each receiver."""
        hosts, name = self.instances.hosts, self.network.identity_of.get
        return {(item.link, name(item.receiver), int(hosts[item.receiver])) for item in self.streams}

    @cached_property
    def never_whole(self) -> dict[tuple[Endpoint, int], list[int]]:
        """Sender and MsgId to the times of telemetry of which later fragments never came."""
        times: dict[tuple[Endpoint, int], list[int]] = {}
        for item in self.capture.lacking:
            for start in (0, SBN_HEADER.size):
                if len(item.head) > start + cfe.COMMAND_HEADER_BYTES:
                    msg_id = self.context.msg_ids.of(item.head, start)
                    times.setdefault((item.source, msg_id), []).append(item.time_ns)
        return times

    def ingests_at(self, endpoint: int) -> list[ingest.Ingest]:
        """Return the account of the CI at an endpoint, if it is counted."""
        return [item for item in self.ingests if item.endpoint == endpoint]

    @cached_property
    def listeners(self) -> dict[int, int]:
        """Endpoint of a CI to the number of its cFS, where its counts tell."""
        return {item.endpoint: item.system for item in self.ingests if not item.by_kernel}

    @property
    def quiet(self) -> list[tuple[int, int]]:
        """From when to when nothing at all was captured, and nothing tells why."""
        return self._holes[1]

    @property
    def blind(self) -> list[tuple[int, int]]:
        """From when to when nothing was captured, for whatever reason."""
        return sorted([*self.away, *self.quiet])

    def is_away(self, starts: Integers, ends: Integers) -> Mask:
        """Tell which spans of time hold some of an outage of the capturing interface."""
        return overlapping(starts, ends, self.away)

    def rounds(self, stream: Stream, span: Span) -> Comb:
        """Return the rounds in which a stream's MsgId comes meanwhile."""
        times = self.times(stream)
        return comb(times[(times >= span.start_ns) & (times <= span.end_ns)])

    def times(self, stream: Stream) -> Integers:
        """Return when a stream's MsgId comes out of its pipe, whoever made it: they share what may wait."""
        if stream.way not in self._times:
            own = stream.sender, stream.msg_id
            alike = [
                item.time_ns
                for item in self.streams
                if item.way == stream.way or (item.link.only_from_cfs and (item.sender, item.msg_id) == own)
            ]
            self._times[stream.way] = np.sort(np.concatenate(alike))
        return self._times[stream.way]

    def done_to(self, stream: Stream) -> Proxied:
        """Return what a proxy did on purpose to the datagrams of a stream."""
        to_cfs = stream.link.only_to_cfs or (stream.link.peers and not stream.counted)
        return self.proxied.get((stream.link.code, to_cfs, stream.msg_id), UNTOUCHED)

    @cached_property
    def peers_unseen(self) -> bool:
        """Whether a cFS hands on what another one made, and how that came to it was not captured."""
        on_sbn = self.rows.on(lambda link: link.peers).any()
        return not on_sbn and any(
            stream.link.only_from_cfs and stream.instance not in {NOBODY, self.owner(stream)}
            for stream in self.streams
        )

    def upstream(self, stream: Stream) -> Hop | None:
        """Return the hop by which a stream's packets came unchanged, if they did."""
        return next((hop for hop in self.hops if hop.out is stream and not hop.rewritten), None)

    def owner(self, stream: Stream) -> int:
        """Return the instance whose pipe a telemetry stream comes out of."""
        start_ns = int(stream.time_ns[0])
        if stream.link.only_from_cfs:
            return self.instances.owner(stream.sender, start_ns)
        if stream.instance != NOBODY:
            return stream.instance
        name = self.network.identity_of.get(stream.sender, "")
        return self.instances.named(name, start_ns, stream.sender)

    def pipe_of(self, stream: Stream) -> str:
        """Return the name of the pipe that a telemetry stream comes out of."""
        if stream.link.only_from_cfs:
            return telemetry_output.PIPE
        spacecraft, _, processor = self.network.identity_of.get(stream.receiver, "").partition(":")
        return sbn.peer_pipe(Peer(int(spacecraft), int(processor))) if processor else "pipe of an SBN peer"

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
            owner = self.listeners.get(stream.receiver)
            return owner == system if owner is not None else system not in self.listeners.values()
        if item.name and self.network.identity_of.get(stream.receiver, item.name) != item.name:
            return False
        same = int(self.instances.hosts[stream.receiver]) == item.host
        return same or not self.instances.others_named(instance)

    @cached_property
    def telemetry(self) -> Telemetry:
        """What is missing from sequence counts."""
        return self.commands.telemetry

    @cached_property
    def commands(self) -> Commands:
        """What became of everything that went into cFS."""
        return Commands(self, Telemetry(self))

    @cached_property
    def loss_counts(self) -> dict[int, Counts]:
        """The growth of each instance's loss counters, less what has been told of it."""
        items, profile = self.instances.items, self.profile
        return {
            at: Counts.of(track, items[at].boot_ns(profile), self._told_later(at, track.times[-1]))
            for at, track in self.tracks.items()
            if len(track.times) > 1
        }

    def _told_later(self, instance: int, last_ns: int) -> dict[PipeKind, list[int]]:
        """Return when events told of losses at pipes, by kind, behind an instance's last 0x803."""
        times: dict[PipeKind, list[int]] = {}
        for item, events in self.reported_losses.items():
            if item.at_pipe and item.instance == instance:
                made_ns = self.instances.made_ns[[record.row for record in events.records]]
                times.setdefault(item.at_pipe, []).extend(made_ns[made_ns > last_ns + _SLACK_NS].tolist())
        return times

    @cached_property
    def losses(self) -> list[Loss]:
        """All that was lost, each message in one of them."""
        return [*self.telemetry.losses, *self.commands.losses]

    def unheard_of(self, stream: Stream) -> list[int]:
        """Return what of a stream surely was not heard, as indices into its rows."""
        silent = self.unheard.get(id(stream))
        return silent.unheard if silent else []

    def losses_of(self, stream: Stream) -> list[Loss]:
        """Return what was lost of a stream."""
        return self._losses_of.get(id(stream), [])

    def shown_hz(self, stream: Stream, assumed_hz: float) -> float:
        """Return the highest rate, Hz, at which a stream lost nothing for ten seconds; 0 if it is not higher.

        Where it is, the constants are others than the assumed ones; not if it lost some at no higher rate.
        """
        lost = [(item.start_ns, item.end_ns) for item in self.losses_of(stream)]
        rates: tuple[list[float], list[float]] = [], []
        for span in stream.spans:
            lossy = any(span.start_ns <= end_ns and start_ns <= span.end_ns for start_ns, end_ns in lost)
            if lossy or span.end_ns - span.start_ns >= _CLEAN_NS:
                rates[lossy].append(span.offered_hz)
        most = min(rates[True], default=np.inf) / _HIGHER
        clean = [rate for rate in rates[False] if rate < most]
        return max((rate for rate in clean if rate > _HIGHER * assumed_hz), default=0.0)

    @cached_property
    def _losses_of(self) -> dict[int, list[Loss]]:
        return by_key(self.losses, lambda loss: id(loss.stream))

    @cached_property
    def has_telemetry(self) -> bool:
        """Whether anything that a cFS sends is in the capture."""
        return bool(self.instances.items or self.rows.on(lambda link: link.only_from_cfs).any())

    @cached_property
    def perhaps_doubled(self) -> Counter[tuple[int, int, int]]:
        """How many messages into cFS came twice, or were captured twice, by link, receiver and MsgId."""
        rows = self.prepared.doubled
        return Counter(zip(rows.link.tolist(), rows.destination.tolist(), rows.msg_id.tolist(), strict=True))

    def route(self, msg_id: int, link: Link | None = None) -> Route | None:
        """Return the configured route of a MsgId, on a link or on any."""
        table = self.context.any_route_of if link is None else self.context.routes_on(link)
        index = int(table[msg_id]) if 0 <= msg_id < len(table) else NO_ROUTE
        return self.mission.routes[index] if index != NO_ROUTE else None

    def topic(self, msg_id: int) -> str | None:
        """Return the topic of a MsgId: a configured one, or that of its struct; None of several or none."""
        owner = self.route(msg_id) or self.own_struct(msg_id)
        return owner.topic if owner else None

    def own_struct(self, msg_id: int) -> Bound | None:
        """Return the struct of a layout that packets of a MsgId hold; None where each holds its own."""
        own = self.context.structs.own(msg_id)
        return own[0] if len(own) == 1 else None

    def name(self, msg_id: int) -> str:
        """Return how people are told of a MsgId: ``0x1827 (/cmd_vel)``."""
        if msg_id == NO_MSG_ID:
            return "an unknown MsgId"
        text = self.topic(msg_id) or self.packet_name(msg_id)
        return f"0x{msg_id:04x} ({text})" if text else f"0x{msg_id:04x}"

    def packet_name(self, msg_id: int) -> str:
        """Return cFE's name for a MsgId, or its structs' of a layout; nothing where it has neither."""
        name = message_name(self.mission.msg_ids.standard(msg_id))
        return name or ", ".join(item.name for item in self.context.structs.own(msg_id))

    def of_known(self, msg_id: int) -> int:
        """Return what a MsgId of version 1 that facts of cFS name is here."""
        return self.mission.msg_ids.of_known(msg_id)

    def said(
        self, start_ns: int, end_ns: int, *apps: str, event_ids: Iterable[int] = ()
    ) -> list[EventRecord]:
        """Return the events of applications, or of all, in a span of time."""
        ids = frozenset(event_ids)
        if (own := self._events.get((apps, ids))) is None:
            own = [item for item in self.payloads.events if not apps or item.app in apps]
            own = self._events[apps, ids] = [item for item in own if not ids or item.event_id in ids]
        return own[bisect_left(own, start_ns, key=_TIME) : bisect_right(own, end_ns, key=_TIME)]

    @cached_property
    def _names(self) -> dict[str, str]:
        """Names that applications have elsewhere to those that this cFS gives them in its events."""
        heard = {item.app for item in self.payloads.events}
        both = command_ingest.NAMES, telemetry_output.NAMES
        return {usual: other for usual, other in both if other in heard and usual not in heard}

    def called(self, text: str) -> str:
        """Return a text with applications named as this cFS does."""
        for usual, other in self._names.items():
            text = text.replace(usual, other)
        return text

    def suppressed(self, span: tuple[int, int]) -> EventRecord | None:
        """Return the event by which Telemetry Output says that its socket failed, and it sends no more."""
        events = self.said(span[0] - SECOND, span[1] + SECOND, *telemetry_output.NAMES)
        return next((item for item in events if telemetry_output.SUPPRESSED.phrase in item.message), None)

    def silences_of(self, sender: int) -> list[tuple[int, int]]:
        """Return when the Telemetry Output behind an endpoint sent nothing, until it was enabled."""
        if sender not in self._silences:
            self._silences[sender] = closed.silences_of(self, sender)
        return self._silences[sender]

    def span(self, rows: Sequence[int] | Places) -> tuple[int, int]:
        """Return the capture times of the first and of the last of some rows, which are in order of time."""
        return int(self.rows.time_ns[rows[0]]), int(self.rows.time_ns[rows[-1]])

    def at(self, time_ns: int) -> str:
        """Return a time as people are told of it: seconds into the capture."""
        return f"{max(0, time_ns - self.zero_ns) / SECOND:.1f} s"

    @cached_property
    def _target(self) -> str:
        """``--target`` for the only CI of the capture, unless it is the usual one here; and its headers."""
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
        """Return what to type to send a named command to the CI of the capture."""
        return inject_line(name, *arguments) + self._target

    def label(self, instance: int) -> str:
        """Return how people are told of an instance."""
        return "cFS" if instance == NOBODY else self.instances.label(instance)

    def receiver_label(self, stream: Stream) -> str | None:
        """Return how people are told of the cFS that a stream goes into; None where there is but one."""
        systems = self.instances.systems
        into = [index for index in range(len(systems)) if self.goes_to(stream, index)]
        if len(set(systems)) < 2 or len({systems[index] for index in into}) != 1:
            return None
        return self.label(into[0])

    @cached_property
    def host(self) -> HostDrops:
        """What the kernel of the recording host dropped while the capture ran."""
        return host_drops(self.capture.host, self.start_ns, self.end_ns)

    def drops_text(self) -> tuple[str, ...]:
        """Return what has to be said before cFS is blamed."""
        if not self.capture.drops:
            return ()
        return (f"the capture itself lost {self.capture.drops:,} frames: some of this may be its own",)
