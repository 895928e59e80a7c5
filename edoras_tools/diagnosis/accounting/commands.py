"""The fate of every message into cFS: message by message where the way out is captured.

In: the streams of the case, the accounts of CI (``ingest``), and the gaps of telemetry (``bus.Telemetry``).
Out: a ``Fate`` for each stream into cFS, and the losses, of telemetry too: its claims on counters are settled
here.

Each step gives a fate to messages that have none yet, so the order of the steps is part of the result:

1. A message that came out arrived. One that was sent so late that it may still come out is waiting.
2. Datagrams that CI did not count were lost before it (``ingest``).
3. Messages that cFS refused are no loss on the way.
4. While an application was stopped, and until something comes out of it again, nothing arrives (``closed``).
5. The others compete with missing telemetry for the counts of the software bus (``claims``, ``pipes``).
6. Of messages that an application takes in one round and of which it sends on the last, the others are
   superseded.
7. A message that nothing explains is unaccounted for.
8. A loss that no counter explains, and that the capture may only have missed, becomes uncertain
   (``make_uncertain``).
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Hashable
from functools import cached_property
from math import ceil
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.cfs import command_ingest, queues, telemetry_output
from edoras_tools.diagnosis.accounting import claims
from edoras_tools.diagnosis.accounting.closed import PORT_CLOSED, UDP_PORT, Stops, containing
from edoras_tools.diagnosis.accounting.ingest import BeforeCi
from edoras_tools.diagnosis.accounting.losses import (
    APP,
    BEFORE_CI,
    BEHIND,
    COUNTERS,
    LOST_AT,
    SBN_SOCKET,
    TAIL_NS,
    WAITS_NS,
    Among,
    Fate,
    Loss,
    follow,
    may_give_way,
)
from edoras_tools.diagnosis.accounting.pipes import Leftover, Pipes
from edoras_tools.diagnosis.evidence.instances import NOBODY
from edoras_tools.diagnosis.matching.streams import Stream, counted_gaps, full_rounds
from edoras_tools.diagnosis.quality import CONFIDENCE, FEW_RUNS, fewest_runs, least_runs, overlapping
from edoras_tools.diagnosis.verdict import Verdict
from edoras_tools.model import Finding
from edoras_tools.units import SECOND
from edoras_tools.wire.arrays import Integers, Mask, Places, by_key, distinct
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from edoras_tools.diagnosis.accounting.bus import Telemetry
    from edoras_tools.diagnosis.accounting.claims import Claim, Shared
    from edoras_tools.diagnosis.accounting.losses import LossKind
    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.evidence.relays import LostInRelay
    from edoras_tools.diagnosis.matching.crossing import Hop

_COUNTS: Final = 256
_WRAPPED: Final = 128
"""A counter of 8 bits that falls by more than this has wrapped."""
_LATE_NS: Final = 2 * SECOND
"""Longest time by which a network delays one message more than another."""
_UNEXPLAINED: Final = frozenset({"after", "unknown"})
_COUNTED: Final = frozenset({*COUNTERS, "unknown"})


class Commands:
    """What became of every message that went into cFS.

    Attributes:
        telemetry: losses of telemetry by sequence counts.
        fates: stream to the fates of its messages.
        losses: losses of messages into cFS.
        unplaced: refusal to the number of its messages that no stream has.
        placed: refusal to the number of its messages that a stream has.
        relayed: stream to the losses in a relay in front of cFS, both sides of which are captured.
        never_came: stream to the number of its sequence counts that the capture does not have.
        uncaptured: instance to the losses that it counted while the capturing interface was away, and that no
            captured message explains.
    """

    def __init__(self, case: Case, telemetry: Telemetry) -> None:
        self._case, self.telemetry = case, telemetry
        self.losses: list[Loss] = []
        self.unplaced, self.placed = Counter[Verdict](), Counter[Verdict]()
        self.relayed: dict[Stream, LostInRelay] = {}
        self.never_came: dict[Stream, int] = {}
        self.fates: dict[Stream | None, Fate] = {
            stream: follow(case, stream)
            for stream in case.streams
            if stream.link.only_to_cfs or (stream.link.peers and not stream.counted)
        }
        fates = list(self.fates.values())
        self._by_packet = by_key(fates, lambda fate: (fate.stream.link.label, fate.stream.msg_id))
        self._spans = {key: _spans(own) for key, own in self._by_packet.items()}
        self._before_ci, self._pipes = BeforeCi(case, fates, self.losses), Pipes(case, self.losses)
        self._lose_before_cfs(fates)
        self._stops = Stops(case, fates)
        for fate in fates:
            self._not_taken(fate)
            self._pass_on(fate)
            self._pipes.claim(fate)
        every = [*telemetry.claims, *self._pipes.claims]
        hold_back(case, every)
        leftover = Leftover(case, self.fates, self._pipes)
        shared = self._settle(every, leftover)
        self._tails = {item.flow: item.explained for item in every if item.rank == claims.Rank.POSSIBLE}
        """Stream to the number of messages behind its last one that counts explain."""
        # The counts become losses. What is still missing may be lost where no counter is, or before CI.
        self._pipes.make_losses()
        self._stops.make_losses()
        self.losses += self._stops.losses
        for fate in fates:
            self._over_limit(fate)
        for account in case.ingests:
            self._before_ci.rest(account)
            self._before_ci.wait(account)
        self._end(fates, shared)
        self._leave_rest(fates, every, leftover, shared)
        self.uncaptured = leftover.uncaptured
        # What concerns few messages: refusals, streams that can only be compared by number.
        self._take_back_refused()
        self._stops.make_uncounted(self.losses, telemetry.losses)
        self._mark_undecidable(fates)
        self._number(fates)
        self._relayed(fates)
        for fate in fates:
            if fate.stream.link.peers:
                self._before_sbn(fate)
            elif fate.stream.known_id == telemetry_output.COMMAND_MSG_ID:
                self._commanded(fate)

    def _lose_before_cfs(self, fates: Sequence[Fate]) -> None:
        """Make losses of what was lost before CI, and of what cFS refused (steps 2 and 3)."""
        for fate in fates:
            self._damaged(fate)
            self._count(fate)
        for stream in self._case.streams:
            self._astray(stream, self.fates.get(stream))
        self._refuse(counted=True)
        for account in self._case.ingests:
            self._before_ci.share(account)
        self._refuse(counted=False)

    def _settle(self, every: Sequence[Claim], leftover: Leftover) -> list[Shared]:
        """Settle all claims on the counters (step 5): first surely missing messages, then possible ones.

        Returns:
            The counts that several kinds of traffic share.
        """
        case, counts = self._case, self._case.loss_counts
        leftover.take_reported()
        if case.quality.lacks_answered:
            leftover.exclude_outages()
        shared = claims.settle_known(counts, every, leftover.rivals())
        if case.quality.lacks_answered:  # a missing message may be lost, or only missed by the capture
            shared += claims.share_open(counts, every)
        open_ = Counter[Hashable]()
        for claim in every:
            open_[claim.flow] += claim.open
        claims.settle_first(counts, every, most_missed(case, open_))
        return shared

    def _leave_rest(
        self, fates: Sequence[Fate], every: Sequence[Claim], leftover: Leftover, shared: Sequence[Shared]
    ) -> None:
        """Explain counts that are left, now that each message has a fate, by messages that are not captured.

        Then make uncertain what the capture may only have missed (step 8).
        """
        case, telemetry, counts = self._case, self.telemetry, self._case.loss_counts
        for account in case.ingests:
            self._before_ci.outnumbered(account)
        leftover.share(shared)
        claims.settle_rest(counts, every)
        claims.settle_perhaps_missed(counts, every)
        leftover.make_uncertain(telemetry.claims)
        telemetry.make_losses()
        self._before_ci.concede(telemetry.losses)
        self._name([item for item in case.refused if item.by_type])
        make_uncertain(case, telemetry, fates, self.losses)
        leftover.make_losses()

    def _damaged(self, fate: Fate) -> None:
        """Make losses of messages that came out damaged on their way to a robot.

        Each is one of the messages between those that came out before and after it.
        """
        case, sent = self._case, fate.stream.time_ns
        for hop in (hop for hop in fate.hops if hop.out.link.last_hop):
            out_ns, into = hop.out.time_ns[hop.out_rows], hop.in_rows
            for when in case.damaged[hop.out].time_ns.tolist():
                at = int(np.searchsorted(out_ns, when))
                inside = fate.open & (sent < when) & (sent > when - TAIL_NS)
                first, last = into[at - 1] if at else 0, into[at] if at < len(into) else len(sent)
                inside[:first] = inside[last:] = False
                if fate.claim(rows := np.flatnonzero(inside)[:1]):
                    text, to = "it came out damaged: its checksum is wrong", case.endpoints[hop.out.receiver]
                    self.losses.append(fate.loss("damaged", rows, [text], hop=f"{UDP_PORT} {to}"))

    def _count(self, fate: Fate) -> None:
        """Make losses of messages in front of CI that lack fragments, or are missing in a sender's counts.

        Those that CI counted beyond the captured ones were missed by the capture; without counts of CI, those
        that the capture may have missed.
        """
        case, stream = self._case, fate.stream
        if not stream.link.only_to_cfs:
            return
        way = "sequence count:" if stream.counted else "fragments of"
        missing = counted_gaps(case.rows, stream) if stream.counted else case.came_in_part(stream)
        times = np.append(stream.time_ns, stream.time_ns[-1])
        missing[overlapping(times[:-1], times[1:], case.all_holes)] = 0
        if not (number := int(missing.sum())):
            return
        at, accounts = np.flatnonzero(missing), case.ingests_at(stream.receiver)
        ends = times[[at[0], at[-1] + 1]].tolist()
        may = case.perhaps_missed(len(stream), number)
        if not stream.counted and any(own.not_captured for own in accounts):
            # The capture misses some, of each message any of two fragments.
            may = min(number, case.quality.may_have_missed(2 * (len(stream) + number), case.confidence))
        evidence = [f"{way} {number:,} of {len(stream) + number:,} never came"]
        counted = [own.not_captured for own in accounts if own.first_ns < ends[0] and ends[1] < own.last_ns]
        if counted and not accounts[0].lost:
            may = max(may * (not stream.counted), min(number, counted[0]))
            evidence.append(f"0x884: CI took {may:,} more than the capture shows")
        self.never_came[stream] = number
        fate.ends["crowded"] += may
        if number > may:
            loss = Loss("network", BEFORE_CI, number - may, ends[0], ends[1], "high", msg_id=stream.msg_id)
            loss.stream, loss.of, loss.evidence = stream, len(stream) + number, evidence
            loss.among = Among(stream, at, missing[at])
            self.losses.append(loss)

    def _astray(self, stream: Stream, fate: Fate | None) -> None:
        """Make losses of datagrams that one capture has and the next one on their way does not.

        Those that the next capture may only have missed become uncertain.
        """
        masks = self._case.rows.undelivered, self._case.prepared.perhaps_undelivered
        rows, perhaps = (np.flatnonzero(mask[stream.rows]) for mask in masks)
        if unheard := self._case.missed_by_peer(stream):
            rows, perhaps = (np.setdiff1d(own, unheard) for own in (rows, perhaps))
        if fate is None and len(perhaps) and self._is_lost_between:
            rows, perhaps = np.union1d(rows, perhaps), perhaps[:0]
        text = f"{plural(len(rows), 'datagram')} came to one capture, and not to the next on their way"
        if fate is not None:
            self._lose(fate, "network", rows, text)
            if stream.link.only_to_cfs and not self._case.ingests_at(stream.receiver):
                fate.ends["crowded"] += fate.claim(perhaps)
            return
        self.telemetry.ends[stream]["astray"] = len(perhaps)
        if len(rows):
            first_ns, last_ns = stream.time_ns[rows[[0, -1]]].tolist()
            loss = Loss("after", BEHIND, len(rows), first_ns, last_ns, "high", NOBODY, stream.msg_id, stream)
            loss.of, loss.evidence, loss.among = len(stream), [text], Among(stream, rows)
            self.losses.append(loss)

    @cached_property
    def _is_lost_between(self) -> bool:
        """Whether datagrams that only one of two capture points has were lost, and not missed by the other.

        That is so if CI's counts show exactly as many losses by a time as one capture point lacks by then.
        """
        alone, rows = self._case.prepared.perhaps_undelivered, self._case.rows
        up = rows.on(lambda link: link.only_to_cfs)
        last_ns = rows.time_ns[alone & up].max(initial=0)
        ends = [loss.end_ns for own in self._case.ingests for loss in own.losses if loss.end_ns >= last_ns]
        down = alone[rows.on(lambda link: link.only_from_cfs)]
        lost = sum(account.lost_by("network") for account in self._case.ingests)
        is_so = bool(ends) and int(alone[up].sum()) == lost == int(alone.sum() - down.sum())
        return is_so and (1 - down.sum() / max(1, len(down))) ** int((up & ~alone).sum()) < 1 - CONFIDENCE

    def _down(self, fate: Fate) -> None:
        """Make losses of messages over SBN to a cFS that was down: from its last packet to its next boot.

        They may be lost if nothing shows which cFS of several at its address they went to.
        """
        case, times = self._case, fate.stream.time_ns
        connection = case.network.crossing(fate.stream.sender, fate.stream.receiver)
        if connection and (connection.restarts or any(connection.silences(case.end_ns))):
            return  # the account of silent peers has them
        items, systems = case.instances.items, case.instances.systems
        said_ns = case.rows.time_ns[case.rows.source == fate.stream.receiver]
        sole = len({systems[at] for at in range(len(items)) if case.goes_to(fate.stream, at)}) == 1
        for index, later in enumerate(items):
            own = (item for item, system in zip(items, systems, strict=True) if system == systems[index])
            before = [item.last_ns for item in own if item.last_ns < later.first_ns]
            if before and case.goes_to(fate.stream, index):
                ended_ns, boot_ns = max(before), later.boot_ns(case.profile)
                if not ended_ns < boot_ns <= later.first_ns:  # its clock begins elsewhere
                    boot_ns = int(said_ns[said_ns > ended_ns].min(initial=later.first_ns))
                rows = np.flatnonzero(fate.open & (times > ended_ns) & (times < boot_ns))
                text = f"{plural(len(rows), 'message')} over SBN while it was not running"
                if not sole:
                    fate.ends["missed" if fate.seen else "earlier"] += fate.claim(rows)
                self._lose(fate, "down", rows, text)

    def _before_sbn(self, fate: Fate) -> None:
        """Make losses of messages over SBN that nothing in cFS explains: of bursts, or from another host.

        The application sends on what it gets, and the bus and the way out count what they lose: so they were
        lost in SBN's socket, which bursts fill, or on the network.
        """
        case, stream, number = self._case, fate.stream, fate.ends["unaccounted"] * fate.seen
        rows = np.flatnonzero(fate.open & ~fate.edge)
        counted = all(hop.out.counted and case.owner(hop.out) in case.loss_counts for hop in fate.hops)
        came_ns, sent_ns = case.arriving(stream.receiver), stream.time_ns[rows]
        numbers = [np.searchsorted(came_ns, sent_ns - ago) for ago in (0, case.profile.sbn_wake_ns)]
        full = np.count_nonzero(np.subtract(*numbers) >= case.profile.socket_queue) >= number
        if number and counted and (full or case.is_far(stream.receiver)) and fate.claim(rows):
            text = f"{int(fate.arrived.sum()):,} others came out, and 0x803 counts no loss of these"
            loss = fate.loss("sbn_socket" if full else "network", rows, [text], hop=SBN_SOCKET)
            loss.lost, loss.confidence, fate.ends["unaccounted"] = number, "medium", 0
            self.losses.append(loss)

    def _not_taken(self, fate: Fate) -> None:
        """Make losses of messages to a cFS or CI that did not run, or to a closed port."""
        case, stream = self._case, fate.stream
        if stream.link.peers:
            self._down(fate)
        elif fate.seen and stream.link.only_to_cfs:
            self._uncounted(fate)
        counted_ns = max((item.last_ns for item in case.ingests_at(stream.receiver)), default=0)
        behind = fate.open & (fate.seen | (stream.time_ns > counted_ns))
        errors, unheard = case.unreachable, case.missed_by_peer(stream)
        masks = (mask[stream.rows] for mask in (errors.closed, errors.uncertain))
        closed, perhaps = (np.setdiff1d(np.flatnonzero(behind & own), unheard) for own in masks)
        self._lose(fate, PORT_CLOSED, closed, "ICMP errors: port unreachable")
        if stream.link.only_to_cfs:
            fate.ends["crowded"] += fate.claim(perhaps)
        # Losses in front of the application are known now: it may have replaced others.
        fate.newer |= may_give_way(case, fate.hops, fate.open, stream.time_ns)

    def _uncounted(self, fate: Fate) -> None:
        """Mark messages that were sent while CI did not run, if no counts are around that.

        They may still claim counts of the bus: CI may have read some after the last one that came out.
        """
        case, times = self._case, fate.stream.time_ns
        spans = [(item.first_ns, item.last_ns) for item in case.ingests_at(fate.stream.receiver)]
        own = [item for item in case.outages if case.into_system(fate.stream, item.system)]
        for item in (item for item in own if item.app in command_ingest.NAMES):
            end_ns = case.end_ns if item.end_ns is None else item.end_ns
            by_ns, to_ns = min(item.ended_ns, end_ns - WAITS_NS), item.start_ns if item.end_ns else 0
            if any(first_ns < by_ns and last_ns > to_ns for first_ns, last_ns in spans):
                continue
            # What came out was read: CI did not run where nothing came out for the longest time.
            read = times[fate.arrived & (times > item.start_ns) & (times < end_ns)]
            bounds = np.concatenate(([item.start_ns], read, [end_ns]))
            hole = int(np.diff(bounds).argmax())
            inside = fate.open & ~fate.newer & (times > bounds[hole]) & (times < bounds[hole + 1])
            # It may have read these; also in its first round, of which the application kept the newest.
            late = (times > item.asked_ns) & (not item.restarted)
            late |= (times > bounds[hole + 1] - case.profile.ci_wake_ns) & fate.keeps_newest
            fate.end("crowded", inside & late)
            kind: LossKind = "restart" if item.restarted else "ci_stopped"
            self._stops.mark(fate, inside, kind, LOST_AT[kind], item.witness)

    def _over_limit(self, fate: Fate) -> None:
        """Make losses of messages missing behind full rounds only, where no counter was captured."""
        case, hops = self._case, fate.hops
        if len(hops) != 1 or not hops[0].out.link.last_hop or not fate.stream.link.only_to_cfs:
            return
        came, into = hops[0].out_rows, hops[0].in_rows
        missing = np.append(np.diff(into) - 1, 0)
        least = full_rounds(hops[0].out.time_ns[came], missing, case.profile.ci_wake_ns)
        times, socket = fate.stream.time_ns, queues.ci_socket(case.profile)
        ahead = np.arange(len(times)) - (times - times[0]) * (socket.reads / socket.round_ns)
        waiting = (ahead - np.minimum.accumulate(ahead)).max()
        if not least or (missing < 0).any() or waiting > socket.depth:
            return  # more datagrams wait for CI than its socket holds, or they came in another order
        counted_ns = [own.times[-1] for at, own in case.loss_counts.items() if case.goes_to(fate.stream, at)]
        inside = fate.open & (times > max(counted_ns, default=0))
        inside[: into[0]] = inside[into[-1] :] = False
        silent_ns = case.rows.time_ns[:-1][np.diff(case.rows.time_ns) > WAITS_NS]
        for at in np.unique(np.searchsorted(hops[0].out.time_ns[came], silent_ns, "right")).tolist():
            # CI reads several at once, and some would come out: the capture has a hole here.
            unseen = np.flatnonzero(inside & (np.searchsorted(into, np.arange(len(inside))) == at))
            if len(unseen) > case.profile.ci_datagrams_per_wake:
                fate.ends["missed"] += fate.claim(unseen)
                inside[unseen] = False
        if fate.claim(lacking := np.flatnonzero(inside)):
            text = f"they did not come out behind full rounds alone, of {least} or more"
            self.losses.append(fate.loss("limit", lacking, [text], hop=APP))

    def _relayed(self, fates: Sequence[Fate]) -> None:
        """Make losses of messages that went into a relay and did not come out of its other, captured side."""
        own = (fate.stream for fate in reversed(fates))
        streams = {(item.link.code, item.msg_id, item.receiver): item for item in own}
        is_command = self._case.context.msg_ids.is_command  # of telemetry sequence counts tell
        for item in (item for item in self._case.prepared.passed if is_command(item.msg_id)):
            stream = streams.get((item.link, item.msg_id, item.receiver))
            if stream is not None:
                self.relayed[stream] = item
            number = len(item.lost_ns)
            # Datagrams that CI counted without a sign of them came out of the relay too.
            unseen = sum(own.not_captured for own in self._case.ingests)
            number -= max(min(unseen, number), self._case.perhaps_missed(item.of, number)) if number else 0
            if number:
                span = int(item.lost_ns.min()), int(item.lost_ns.max())
                text = f"{number:,} of {item.of:,} went into {item.relay} and did not come out of it"
                loss = Loss("network", item.hop, number, *span, "high", msg_id=item.msg_id, stream=stream)
                loss.of, loss.evidence = item.of, [text]
                self.losses.append(loss)

    def _lose(self, fate: Fate, kind: LossKind, rows: Places, text: str) -> None:
        """Make a loss of messages that have no fate yet: before CI, or in SBN's socket."""
        if fate.claim(rows):
            self.losses.append(fate.loss(kind, rows, [text], SBN_SOCKET if fate.stream.link.peers else ""))

    def refusals(self, item: Verdict) -> int:
        """Return how many messages were lost by a refusal, and by nothing else."""
        return self.unplaced[item] + self.placed[item]

    def _alike(self, item: Verdict) -> Iterator[tuple[Fate, Mask]]:
        """Yield the streams that a refusal can be of, each with a mask of the messages in its span."""
        every = [key for key in self._spans if key[0] == item.link] if item.msg_id is None else ()
        for key in every or self._spans.keys() & {(item.link, item.msg_id)}:
            first_ns, last_ns = self._spans[key]
            for place in np.flatnonzero((first_ns <= item.end_ns) & (last_ns >= item.start_ns)).tolist():
                fate = self._by_packet[key][place]
                times = fate.stream.time_ns
                within = (times >= item.start_ns) & (times <= item.end_ns)
                if within.any():
                    yield fate, within

    def _place(self, item: Verdict, fate: Fate, inside: Places, most: int) -> int:
        """Assign messages of a stream to a refusal; return how many.

        Args:
            item: the refusal.
            fate: fates of the stream.
            inside: indices of the messages that may be refused.
            most: upper bound.
        """
        # The others of that time are lost elsewhere, any of them.
        spread = inside[np.arange(most) * len(inside) // most] if 0 < most < len(inside) else inside[:most]
        if number := fate.claim(spread):
            self.placed[item] += number
            fate.refused.append((item, number, Among(fate.stream, inside)))
        return number

    def _refuse(self, *, counted: bool) -> None:
        """Assign messages to refusals: shortest spans first, because they name their messages best.

        Args:
            counted: only refusals for want of a subscriber whose number a counter has; or only the others.
        """
        refused = [
            item
            for item in self._case.refused
            if not item.by_type and counted == (item.rule == "no_subscriber" and item.lost != item.of)
        ]
        # A refusal that names one datagram is that one; a refusal of many in a span comes later.
        for item in sorted(refused, key=lambda item: item.end_ns - item.start_ns):
            rest = item.lost or 0
            # The stream of another sender is one of which more came out.
            every = sorted(self._alike(item), key=lambda own: own[0].arrived[own[1]].mean()) if rest else []
            for fate, within in every if item.msg_id is None else ():
                rest -= self._place(item, fate, np.flatnonzero(fate.open & within), rest)
            if every and item.msg_id is not None:
                fate, within = every[0]
                if within.sum() == 1 and item.confidence == "high":
                    self._swap_refused(fate, np.flatnonzero(within & fate.arrived))
                rows = np.flatnonzero((fate.open | fate.blind) & within)
                if number := min(rest, len(rows)) if (fate.arrived & within).any() else 0:
                    rest = number - self._case.perhaps_missed(int(within.sum()), number)  # some come out
                self._place(item, fate, rows, rest)
                rest = 0  # the others arrived, or are in another verdict
            self.unplaced[item] += rest

    @staticmethod
    def _swap_refused(fate: Fate, rows: Places) -> None:
        """Swap a refused message that seems to have come out with an equal one, or one without values."""
        for row in rows.tolist() if len(fate.hops) == 1 else ():
            prints = fate.hops[0].prints
            if len(others := np.flatnonzero(fate.blind | (fate.open & (prints == prints[row])))):
                other = min(others.tolist(), key=lambda at: abs(at - row))
                fate.blind[other] = fate.arrived[row] = fate.open[other] = False
                fate.arrived[other] = fate.open[row] = True

    def _take_back_refused(self) -> None:
        """Take back refusals of messages that a full pipe lost, or may have, before they were refused."""
        unknown = [loss for loss in self.losses if loss.stream is None and loss.kind == "unknown"]
        for fate in (item for item in self.fates.values() if item.refused):
            placed = fate.refused
            when = fate.stream.time_ns[np.concatenate([ones.rows for *_, ones in placed])]
            near = (loss for loss in unknown if ((when >= loss.start_ns) & (when <= loss.end_ns)).any())
            over = sum(loss.lost for loss in near if self._case.goes_to(fate.stream, loss.instance))
            over *= not fate.unsubscribed  # what has no subscriber goes to no pipe
            fate.ends["shared"] += min(over, sum(number for _, number, _ in placed))
            if own := [loss for loss in self.losses if loss.stream is fate.stream and loss.kind in COUNTERS]:
                times = fate.stream.time_ns
                inside = times >= min(loss.start_ns for loss in own)
                inside &= times <= max(loss.end_ns for loss in own)
                over += sum(loss.lost for loss in own) - int(inside.sum())
                over += sum(min(number, int(inside[ones.rows].sum())) for _, number, ones in placed)
            for place, (item, number, ones) in enumerate(placed):
                part = max(0, min(over, number))
                over -= part
                placed[place] = item, number - part, ones
                self.placed[item] -= part

    def _name(self, refused: Sequence[Verdict]) -> None:
        """Give a cause to unaccounted messages that do not fit the types of the mission.

        The types are wrong if a message arrived that does not fit them.
        """
        every = ((item, *both) for item in refused for both in self._alike(item))
        verdicts = by_key(every, lambda one: one[1].stream)
        for fate in self.fates.values():
            own = verdicts.get(fate.stream, []) if fate.seen else []
            if any((item.lost or 0) > (within & ~fate.arrived).sum() for item, _, within in own):
                continue
            for item, _, within in own:
                most = min(item.lost or 0, fate.ends["unaccounted"])
                fate.ends["unaccounted"] -= self._place(item, fate, np.flatnonzero(fate.open & within), most)

    def _pass_on(self, fate: Fate) -> None:
        """Mark messages that the application may have sent on, and that were lost or changed behind it.

        An application sends on in order. Between two messages that came out it may have sent on as many
        others as came out with other values, or are missing there by sequence count. No sequence count shows
        those before the first and after the last: these are marked as ``edge``.
        """
        open_ = np.flatnonzero(fate.open & ~_never_sent(fate))
        for hop in fate.hops:
            fate.strange |= hop.perhaps
            for content in self._case.contents:
                places, sure = content.replaced.get((hop.into, hop.out), (open_[:0], open_[:0]))
                fate.strange[places], own = True, places[sure]
                fate.open[own], fate.blind[own] = fate.open[own] | fate.blind[own], False
                fate.passed[own[fate.open[own]]] = True
            if not (hop.rewritten and hop.out.counted):
                continue
            into, out = _in_order(hop)
            behind = np.searchsorted(into, open_)
            counts = self.telemetry.passed(hop.out)
            # Those that came out here, late copies and messages from another way in are none of these.
            of_other = [item.out_rows for item in self._case.hops if item.out is hop.out and item is not hop]
            counts[np.concatenate((np.flatnonzero((hop.again > 1) | (hop.origin >= 0)), *of_other)) - 1] -= 1
            passed = np.concatenate(([0], np.cumsum(counts)))[out]
            room = np.maximum(np.concatenate(([0], np.diff(passed), [0])), 0)
            # Of the messages in one place the first ones that were not superseded, as far as there is room.
            order = np.lexsort((open_, fate.newer[open_], behind))
            first = order[np.arange(len(behind)) - np.searchsorted(behind, behind) < room[behind]]
            fate.passed[open_[first]] = True
            # Where it sent as often as ever, the others there gave way.
            steps = np.diff(hop.out.time_ns[out], prepend=0, append=0) / (room + 1)
            steady = (room > 0) & (steps < 2 * np.median(steps)) & fate.keeps_newest
            fate.newer[open_[steady[behind] & ~fate.passed[open_]]] = True
            # Where another application publishes this MsgId too, some of these may be its messages.
            # While Telemetry Output sends nothing, its pipe may fill up with them.
            gone = fate.passed & (fate.stop < 0) & (not hop.out.link.peers)
            fate.no_pipe |= gone & (hop.origin[hop.out_rows[0] :] >= 0).all()
            # Out of order, or with wrong times, it may be another one, sent a little sooner or later.
            times = fate.stream.time_ns
            late_ns = (np.maximum.accumulate(times[hop.in_rows]) - times[hop.in_rows]).max(initial=0)
            far_ns = _LATE_NS * self._case.is_far(fate.stream.receiver)
            loose_ns = max(late_ns, self._case.unsteady_ns, far_ns)
            others = open_[~(fate.passed | fate.newer)[open_] & (loose_ns > 0)]
            spare = np.append(0, np.cumsum(room - np.bincount(behind[first], minlength=len(room))))
            ends = np.searchsorted(times[into], times[others] + loose_ns, "right") + 1
            near = spare[ends] > spare[np.searchsorted(times[into], times[others] - loose_ns)]
            fate.passed[others[near][: spare[-1]]] = True
            fate.edge[open_[(behind == 0) | (behind == len(into))]] = True

    def _mark_undecidable(self, fates: Sequence[Fate]) -> None:
        """Make messages unaccounted that were sent after their application stopped.

        Likewise if 0x803 may have counted all of them as messages without a subscriber, or if nothing comes
        from the address that they were sent to.
        """
        self._mark_silent_address([fate for fate in fates if fate.stream.link.only_to_cfs])
        refused = sum(fate.unsubscribed for fate in fates)
        for fate in fates:
            if fate.undecidable is None and fate.stream.link.only_to_cfs:
                self._mark_unsubscribed(fate, refused)
            if fate.undecidable is not None:
                open_ = max(0, int((fate.open & fate.undecidable).sum()) - fate.followed)
                fate.ends["unaccounted"] = min(open_, self._without_fate(fate))

    def _mark_unsubscribed(self, fate: Fate, refused: int) -> None:
        case, sent_ns = self._case, fate.stream.time_ns
        if fate.seen or fate.stream.is_housekeeping:
            return
        for track in [own for at, own in case.tracks.items() if case.goes_to(fate.stream, at)]:
            grown, spread = track.beyond_steady("no_subscribers", sent_ns, TAIL_NS)
            inside = fate.open & (sent_ns >= track.times[0]) & (sent_ns < track.times[-1])
            more = int(grown[-1] - grown[max(0, np.searchsorted(track.times, sent_ns[0]) - 1)])
            more -= refused
            if 2 * more <= 3 * inside.sum() <= 3 * more and inside.sum() > spread:
                fate.undecidable = fate.open.copy()
                fate.undecidable_since = f"0x803: {more:,} more messages without a subscriber meanwhile"

    def _mark_silent_address(self, fates: Sequence[Fate]) -> None:
        """Mark streams to an address from which nothing comes, while other addresses answer the sender."""
        places, answers = self._case.endpoints, defaultdict[int, set[str]](set)
        heard = {places[at].address for at in distinct(self._case.rows.source).tolist()}
        for stream in (fate.stream for fate in fates):
            answers[stream.sender] |= {places[stream.receiver].address} & heard
        for fate in fates:
            address, others = places[fate.stream.receiver].address, answers[fate.stream.sender]
            if others and address not in heard and not fate.seen and fate.undecidable is None:
                fate.undecidable, why = fate.open.copy(), " and ".join(sorted(others))
                fate.undecidable_since = f"nothing comes from {address}, as it does from {why}"

    def _without_fate(self, fate: Fate) -> int:
        """Return how many messages of a stream have no fate."""
        lost = sum(loss.lost for loss in self.losses if loss.stream is fate.stream)
        others = sum(number for _, number, _ in fate.refused)
        others += sum(fate.ends[how] for how in ("queued", "crowded", "late"))
        return max(0, len(fate.stream) - lost - others)

    def _number(self, fates: Sequence[Fate]) -> None:
        """Compare a stream of commands whose values the capture cut off with the number that the robot got.

        This needs a stream without which the robot cannot have got so many.
        """
        rows = self._case.rows
        robot = np.flatnonzero(rows.on(lambda item: item.last_hop))
        unseen = [fate for fate in fates if fate.stream.link.only_to_cfs and not fate.seen]
        unseen = [fate for fate in unseen if not fate.stream.is_housekeeping]
        total = sum(len(fate.stream) for fate in unseen)
        own = [fate for fate in unseen if total - len(fate.stream) < len(robot)]
        if len(own) != 1 or any(hop.out.link.last_hop for hop in self._case.hops):
            return
        (fate,) = own
        cut = rows.has(Finding.CAPTURE_CUT)
        if cut[robot].any() or cut[fate.stream.rows].any():
            rest = self._without_fate(fate) + fate.ends["queued"] + fate.ends["late"]
            fate.reached = min(rest, len(robot))
            rest -= fate.reached
            # CI had read what the robot got, counted or not.
            fate.ends["queued"] = min(fate.ends["queued"], rest)
            fate.ends["late"] = min(fate.ends["late"], rest - fate.ends["queued"])
            rest -= fate.ends["queued"] + fate.ends["late"]
            times = fate.stream.time_ns
            late = times > self._case.end_ns - WAITS_NS
            bare = rows.packet_length[fate.stream.rows] <= rows.header_length[fate.stream.rows]
            bare |= overlapping(times, times + WAITS_NS, self._case.all_holes)
            self._make_unaccounted(fate, rest - int((late | bare).sum()))
            # A command without a message reaches no robot, others one that nothing shows; some may be lost.
            fate.ends["elsewhere"] += min(int(bare.sum()), max(0, rest))

    def _make_unaccounted(self, fate: Fate, number: int) -> None:
        """Make ``number`` messages of a stream unaccounted, less those that may have another explanation.

        That is: losses of an unknown MsgId, losses of telemetry that would not have been sent anyway or that
        may lie after a stream's end, and messages that the capture may have missed.
        """
        losses = [item for item in [*self.losses, *self.telemetry.losses] if item.kind in _COUNTED]
        others = sum(item.lost for item in losses if item.stream is None or item.closed)
        others += self._case.perhaps_missed(len(fate.stream), max(0, number)) + sum(self._tails.values())
        fate.ends["unaccounted"] = max(0, number - others)
        fate.ends["elsewhere"] = max(0, number) - fate.ends["unaccounted"]

    def _commanded(self, fate: Fate) -> None:
        """Compare commands to Telemetry Output with its own counters in 0x880.

        It counted the commands sent between its first 0x880 and its last; the last may not count those sent
        just before it. Counters that were reset, of several cFS, or of a restarted cFS or TO show nothing.
        """
        case, samples = self._case, self._case.payloads.commanded
        senders = np.unique(case.rows.source[samples["row"]])
        if fate.seen or len(samples) < 2 or len(senders) != 1 or len(case.instances.items) != 1:
            return
        steps = np.stack([np.diff(samples[name]) for name in ("taken", "refused")])
        steps[steps < -_WRAPPED] += _COUNTS
        if case.payloads.outputs(telemetry_output.RESET) or (steps < 0).any():
            return
        fate.commanded = int(steps.sum())
        times, counted_ns = fate.stream.time_ns, samples["time_ns"]
        inside = int(((times > counted_ns[0]) & (times <= counted_ns[-1] - TAIL_NS)).sum())
        self._make_unaccounted(fate, inside - (len(times) - self._without_fate(fate)) - fate.commanded)

    def _end(self, fates: Sequence[Fate], shared: Sequence[Shared]) -> None:
        """Give a fate to the messages that are left (rules 6 and 7).

        Args:
            fates: fates of all streams.
            shared: counts that several kinds of traffic share.
        """
        rest, counts = [item.number for item in shared], self._case.loss_counts
        for fate in fates:
            own = [at for at, item in enumerate(shared) if fate.stream in item.flows]
            fate.ends["shared"] = sum(shared[at].number for at in own)
            if fate.seen:
                self._rest(fate)
                self._share(fate, own, rest)
                lost = (loss for loss in self.losses if loss.stream is fate.stream)
                to_end = fate.stream.spans[-1] in [loss.span for loss in lost if loss.kind in COUNTERS]
                together = ((shared[at].end_ns, counts[shared[at].instance].times[-1]) for at in own)
                to_end |= any(end_ns >= last_ns for end_ns, last_ns in together)
                fate.ends["uncertain"] = self._lost_last(fate, to_end=to_end)

    def _lost_last(self, fate: Fate, *, to_end: bool) -> int:
        """Return how many waiting messages are lost if a pipe that loses messages goes on to do so.

        That is the application's own pipe, or the one behind it.

        Args:
            fate: fates of the stream.
            to_end: the application's own pipe lost messages up to its last count.
        """
        profile, out = self._case.profile, {hop.out for hop in fate.hops}
        times = fate.stream.time_ns[fate.waits & ~fate.newer]
        pipe = queues.application_pipe(profile, over_network=fate.stream.link.peers)
        rounds = np.ptp(times) // pipe.round_ns if len(times) and fate.keeps_newest else 0
        lost = [fate.waiting - int(rounds) * pipe.usual_limit] if to_end else []
        for part in self.telemetry.parts:
            stream = part.stream
            if part.kinds and stream in out and part.span.last == len(stream) - 1 and len(times):
                next_ = self._case.queue_of(stream)
                passed = int(np.ptp(times) // next_.round_ns) * next_.limit(stream.msg_id)
                lost.append(len(times) - passed)
        return min(fate.waiting, max([0, *lost]))

    def _rest(self, fate: Fate) -> None:
        ends = fate.ends
        behind = sum(self._tails.get(hop.out, 0) for hop in fate.hops)
        fate.passed[np.flatnonzero(fate.open & fate.edge)[:behind]] = True
        ends["passed_on"] = int((fate.open & fate.passed).sum())
        fate.open &= ~fate.passed
        ends["superseded"] = int((fate.open & fate.newer).sum())
        fate.open &= ~fate.newer

        ends["beyond"] = int((fate.open & fate.edge).sum())
        unaccounted = int(fate.open.sum()) - ends["beyond"]
        # With wrong times a late message may be taken for another; so may one with other values.
        strange = fate.open & (~fate.edge if self._case.unsteady_ns else fate.strange | fate.unseen)
        ends["missed"] += (not_seen := min(int(strange.sum()), unaccounted))
        ends["unaccounted"] += unaccounted - not_seen

    @staticmethod
    def _share(fate: Fate, own: Sequence[int], rest: list[int]) -> None:
        """Move messages from unaccounted, superseded and passed on to ``shared`` counts.

        Args:
            fate: fates of the stream.
            own: indices of the counts that it shares with other traffic.
            rest: of each count, how many may still be messages that did not come out; reduced here.
        """
        ends = fate.ends
        for at in own:
            part = min(rest[at], ends["unaccounted"])
            rest[at] -= part
            ends["unaccounted"] -= part
            ends["elsewhere"] += part
            ends["shared"] -= part
        ends["shared"] = min(ends["shared"], ends["superseded"] + ends["passed_on"])
        superseded = min(ends["shared"], ends["superseded"])
        ends["superseded"] -= superseded
        ends["passed_on"] -= ends["shared"] - superseded


def _never_sent(fate: Fate) -> Mask:
    """Return which messages an application never sent on, by the counts of one way out: bool (rows,).

    It publishes once for all receivers of a MsgId: one that gets all shows what others miss.
    """
    never, msg_ids = np.zeros(len(fate.stream), bool), {hop.out.msg_id for hop in fate.hops}
    for hop in fate.hops if len(msg_ids) == 1 < len({hop.out.link for hop in fate.hops}) else ():
        if hop.rewritten and hop.out.counted:
            into, out = _in_order(hop)
            sent = np.concatenate(([0], np.cumsum(hop.out.missing[:-1] + 1)))[out]
            behind = np.searchsorted(into, np.arange(len(never)))
            never |= np.concatenate(([False], np.diff(sent) == 1, [False]))[behind]
    return never


def _in_order(hop: Hop) -> tuple[Places, Places]:
    """Return the rows of a hop that went in and came out, each in order, without pairs far out of order.

    Such pairs are equal messages that were matched with one another.
    """
    into = hop.in_rows
    near = np.abs(np.argsort(np.argsort(into)) - np.arange(len(into))) <= (np.diff(into) < 0).sum()
    return np.sort(into[near]), hop.out_rows[near]


def hold_back(case: Case, every: Sequence[Claim]) -> None:
    """Remove from claims the messages that the capture may have missed, and keep them as ``perhaps_missed``.

    This concerns gaps that no event names and where no pipe was full. If the capture surely missed frames,
    messages sent while nobody received them are served before all others, because they are lost in any case.
    """
    groups = by_key((item for item in every if item.rank == claims.Rank.MISSING), lambda item: item.flow)
    gaps = {flow: [item.number for item in own] for flow, own in groups.items()}
    missed = [*_missed(case, gaps)]
    for claim in every if missed or case.quality.lacks_answered else ():
        if claim.rank in {claims.Rank.CLOSED, claims.Rank.INTO_STOP}:
            claim.rank = claims.Rank.NOT_TAKEN
    for flow, shares in missed:
        for claim, share in zip(groups[flow], shares, strict=True):
            claim.number, claim.perhaps_missed = claim.number - share, claim.perhaps_missed + share


def _missed(case: Case, gaps: Mapping[Any, list[int]]) -> Iterator[tuple[Stream, list[int]]]:
    """Yield streams, and how many messages of each of their gaps the capture may have missed.

    Nothing is yielded if a capture that misses such a share of frames would have shown it elsewhere. That is
    not so for a few runs of frames: each is one miss, however many messages it took.
    """
    missing, streams = sum(map(sum, gaps.values())), [item for item in case.streams if gaps.get(item)]
    runs = least_runs(case, {item: sum(gaps[item]) for item in streams})
    few = 0 < runs <= FEW_RUNS and not case.quality.counts
    size = missing / runs if 0 < 2 * runs <= missing and not case.quality.counts else 1.0
    quality = case.quality.of_runs(size) if size > 1 else case.quality
    # In streams without sequence counts a frame missed by the capture leaves no gap.
    came = sum(len(item) for item in case.streams if item.counted and not item.link.only_to_cfs)
    excluded = not few and missing and quality.excludes(missing / (came + missing))
    for stream in () if excluded else streams:
        numbers, whole = gaps[stream], len(stream) + int(stream.missing.sum())
        # One missed frame is enough to lose a datagram.
        most = quality.may_have_missed(ceil(case.frames(stream) * whole / size), case.confidence)
        most = sum(numbers) if few else ceil(most * size)
        yield stream, claims.shares(min(sum(numbers), most), numbers)


def _spans(fates: Sequence[Fate]) -> Integers:
    """Return the first and last time of each stream: i64 (2, n), ns since 1970."""
    return np.array([[edge(fate.stream.time_ns) for fate in fates] for edge in (np.min, np.max)])


def most_missed(case: Case, lacking: Counter[Hashable]) -> dict[Hashable, int]:
    """Return how many missing messages of each stream the capture may have missed.

    Args:
        case: the capture.
        lacking: stream to its number of missing messages.
    """
    return {item: case.perhaps_missed(len(item), lacking[item]) for item in case.streams if item in lacking}


def make_uncertain(case: Case, telemetry: Telemetry, fates: Sequence[Fate], losses: Sequence[Loss]) -> None:
    """Make losses uncertain that the capture may only have missed.

    No loss becomes uncertain if a capture that misses such a share of frames would have shown it elsewhere;
    nor losses on TCP, where the byte stream itself shows what the capture missed.

    Args:
        case: the capture.
        telemetry: losses of telemetry; reduced here, and counted as uncertain.
        fates: fates of messages into cFS; their unaccounted messages are reduced too.
        losses: losses of messages into cFS.
    """
    streamed = case.rows.streamed
    # In holes nothing was checked: what they took makes no share of missing frames too large.
    _take_back_in_holes(case, telemetry)
    gaps: dict[Stream, list[tuple[Loss, int]]] = {}
    for loss in telemetry.losses:
        if (number := _not_proven(loss)) and loss.stream is not None and not streamed[loss.stream.rows[0]]:
            gaps.setdefault(loss.stream, []).append((loss, number))
    # Of those whose loss was counted, some may be others, because the capture missed these.
    lost = Counter[Hashable]()
    for loss in (*telemetry.losses, *losses) if case.quality.lacks_answered else ():
        if loss.kind in COUNTERS and loss.stream is not None:
            lost[loss.stream] += loss.lost
    spare = sum(most_missed(case, lost).values())
    # How much full pipes lost says nothing of the few gaps that nothing explains.
    every = {item: [many for _, many in own] for item, own in gaps.items()}
    unexplained = {item: [many * (x.kind in _UNEXPLAINED) for x, many in own] for item, own in gaps.items()}
    by_capture = dict([*_missed(case, unexplained), *_missed(case, every)])
    for stream, shares in by_capture.items():
        for (loss, number), share in zip(gaps[stream], shares, strict=True):
            _take_back(telemetry, loss, min(number, share + spare))
            spare -= min(spare, number - share)
    telemetry.losses[:] = [loss for loss in telemetry.losses if loss.lost]
    for fate in (fate for fate in fates if fate.seen and fate.ends["unaccounted"]):
        absent = fate.ends["unaccounted"]
        missed = _missed_outputs(case, fate, absent)
        more = min(spare, absent - missed)
        fate.ends["missed"] += missed + more
        fate.ends["unaccounted"] -= missed + more
        spare -= more


def _missed_outputs(case: Case, fate: Fate, number: int) -> int:
    """Return how many of a number of messages that did not come out the capture may have missed there.

    A run of frames that it missed is one miss, as in ``_missed``. It lies between two that came out. Where
    what comes out has sequence counts, these show what is missing there.
    """
    times, runs, hop = case.rows.time_ns, number, fate.hops[0]
    if len(fate.hops) == 1 and not hop.out.counted:
        (into, out), at = _in_order(hop), np.flatnonzero(hop.absent)
        left_ns, sent_ns = np.concatenate(([0], hop.out.time_ns[out], [case.end_ns])), fate.stream.time_ns[at]
        place = np.searchsorted(into, at)
        low = np.searchsorted(times, np.maximum(left_ns[place], sent_ns), "right") - 1
        high = np.searchsorted(times, np.minimum(left_ns[place + 1], sent_ns + hop.last_ns))
        runs = fewest_runs(low, np.maximum(high, low + 1), number)
    return case.perhaps_missed(len(fate.stream), number, runs)


def _take_back_in_holes(case: Case, telemetry: Telemetry) -> None:
    """Take back losses in intervals in which nothing at all was captured."""
    for loss in telemetry.losses if case.possible_holes else ():
        among, number = loss.among, _not_proven(loss)
        if number and among is not None and among.missing is not None:
            inside = containing(among.stream, among.rows, case.possible_holes)
            _take_back(telemetry, loss, min(number, int(among.missing[inside].sum())))


def _not_proven(loss: Loss) -> int:
    """Return how many messages of a loss only their sequence counts show."""
    return loss.lost if loss.kind in _UNEXPLAINED else loss.uncounted


def _take_back(telemetry: Telemetry, loss: Loss, number: int) -> None:
    loss.lost, loss.uncounted = loss.lost - number, max(0, loss.uncounted - number)
    telemetry.ends[loss.stream]["uncertain"] += number
