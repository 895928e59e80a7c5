"""What went into cFS and did not come out again: message by message where the way out can be seen.

Rules:

1. A message that came out arrived. One that did not, so near the end that it may yet, waits.
2. What CI did not count was lost before it, whatever became of the rest (``ingest``).
3. What cFS refused (``refused``) is no loss on the way.
4. While the application was stopped, and until something comes out again, nothing arrives (``stops``).
5. What is left may be what the software bus counted (``bus``).
6. Then, of messages that an application takes in one round and of which the last went on, the others are
   superseded.
7. What remains is not accounted for, and said to be.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.cfs import names, sbn, telemetry_output
from edoras_tools.diagnosis.accounting.before_ci import BeforeCi
from edoras_tools.diagnosis.accounting.claims import POSSIBLE, settle_first, settle_known, settle_rest
from edoras_tools.diagnosis.accounting.doubt import doubt, hold_back, may_be_missed
from edoras_tools.diagnosis.accounting.fates import WAITS_NS, Fate, follow, loss_of
from edoras_tools.diagnosis.accounting.leftover import Leftover
from edoras_tools.diagnosis.accounting.losses import (
    COUNTERS,
    SBN_SOCKET,
    TAIL_NS,
    Among,
    Known,
    Loss,
)
from edoras_tools.diagnosis.accounting.pipes import LATE_NS, Pipes
from edoras_tools.diagnosis.accounting.ports import PORT_CLOSED
from edoras_tools.diagnosis.accounting.stops import Stops
from edoras_tools.links.table import among
from edoras_tools.model import NO_ROUTE, Finding
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.accounting.bus import Telemetry
    from edoras_tools.diagnosis.accounting.claims import Counts
    from edoras_tools.diagnosis.accounting.ingest import Ingest
    from edoras_tools.diagnosis.quality import Quality


_COUNTS: Final = 256
_WRAPPED: Final = 128
"""A counter of 8 bits that falls by more began again from 0, by itself."""


@dataclass(frozen=True, slots=True)
class Refused:
    """Messages that came to nothing by what they are: a verdict's figures, and whether types tell it."""

    rule: str
    link: str | None
    msg_id: int | None
    hop: str | None
    start_ns: int
    end_ns: int
    lost: int
    of: int | None
    by_type: bool = False


class Commands:
    """What became of everything that went into cFS.

    Attributes:
        telemetry: what is missing from sequence counts.
        fates: id of a stream to what became of its messages.
        losses: what was lost.
        unplaced: id of a refusal to how many of its messages no stream here has.
        placed: id of a refusal to how many of its messages are of a stream, and of which of that.
        uncaptured: instance to what it counted lost while the capturing interface was away, and is told of
            nothing that was captured.
    """

    def __init__(
        self,
        known: Known,
        counts: Mapping[int, Counts],
        accounts: Sequence[Ingest],
        refused: Sequence[Refused],
        telemetry: Telemetry,
        quality: Quality,
    ) -> None:
        self._known = known
        self.telemetry = telemetry
        self.losses: list[Loss] = []
        self.fates: dict[int, Fate] = {}
        self.unplaced: dict[int, int] = {}
        self.placed: dict[int, tuple[int, Among]] = {}
        for stream in known.streams:
            if stream.link.only_to_cfs or (stream.link.peers and not stream.counted):
                self.fates[id(stream)] = follow(known, stream)
        fates = list(self.fates.values())
        before_ci, pipes = BeforeCi(known, fates, self.losses), Pipes(known, counts, self.losses)
        for account in accounts:
            before_ci.share(account)
        self._refuse([item for item in refused if not item.by_type])
        stops = Stops(known, fates)
        for fate in fates:
            if fate.stream.link.peers:
                self._down(fate)
        for fate in fates:
            self._pass_on(fate)
            pipes.claim(fate)
        hold_back(known, telemetry, quality)
        claims = [*telemetry.claims, *pipes.claims]
        shared = settle_known(counts, claims)
        settle_first(counts, claims, may_be_missed(known, claims, quality))
        tails = {claim.flow: sum(claim.taken.values()) for claim in claims if claim.rank == POSSIBLE}
        pipes.tell()
        stops.tell()
        self.losses += stops.losses
        for account in accounts:
            before_ci.wait(account)
        among = {at: item.number for at, item in enumerate(shared)}
        counting = {item.endpoint for item in accounts}
        for fate in fates:
            if fate.seen or fate.stream.receiver not in counting:
                self._not_received(fate)
            own = [at for at, item in enumerate(shared) if id(fate.stream) in item.flows]
            fate.shared = sum(shared[at].number for at in own)
            self._rest(fate, tails, own, among)
        older_ns = {item.endpoint: item.older_until_ns for item in accounts}
        leftover = Leftover(known, counts, self.fates, pipes, older_ns)
        leftover.share(shared)
        settle_rest(counts, claims)
        telemetry.tell()
        self._name([item for item in refused if item.by_type])
        doubt(known, telemetry, fates, quality)
        leftover.tell(telemetry.losses)
        self.uncaptured = leftover.uncaptured
        self._finish(fates)

    def _finish(self, fates: Sequence[Fate]) -> None:
        """Count what nothing has told of yet."""
        for fate in fates:
            self._unfollowed(fate)
        self._number(fates)
        for fate in fates:
            if fate.stream.known_id == telemetry_output.COMMAND_MSG_ID and fate.stream.link.only_to_cfs:
                self._commanded(fate)

    def _down(self, fate: Fate) -> None:
        """Tell lost what came over SBN while its cFS was down: from its last packet to its next boot."""
        known, times = self._known, self._known.captured(fate.stream)
        if known.network.crossing(fate.stream.sender, fate.stream.receiver):
            return  # its silence as a peer tells of that
        items, systems = known.instances.items, known.instances.systems
        for index, later in enumerate(items):
            boot_ns = later.boot_ns(known.profile)
            before = [
                item.last_ns
                for item, system in zip(items, systems, strict=True)
                if system == systems[index] and item.last_ns < min(boot_ns, later.first_ns)
            ]
            if not before or not known.goes_to(fate.stream, index):
                continue
            chosen = np.flatnonzero(fate.open & (times > max(before)) & (times < boot_ns))
            if fate.claim(chosen):
                text = f"{plural(len(chosen), 'message')} over SBN while it was not running"
                self.losses.append(loss_of(known, fate, "down", chosen, [text], hop=SBN_SOCKET))

    def refusals(self, item: Refused) -> int:
        """Return how many messages of a refusal were lost by it, and by nothing else."""
        return self.unplaced[id(item)] + self.placed.get(id(item), (0, None))[0]

    def _refuse(self, refused: Sequence[Refused]) -> None:
        # One datagram that is named is that one; what many of a span may be comes after.
        for item in sorted(refused, key=lambda item: item.end_ns - item.start_ns):
            left = item.lost
            for fate in self.fates.values():
                if left and (item.link, item.msg_id) == (fate.stream.link.label, fate.stream.msg_id):
                    times = self._known.captured(fate.stream)
                    within = (times >= item.start_ns) & (times <= item.end_ns)
                    if not within.any():
                        continue  # another sender's of the same MsgId
                    inside = np.flatnonzero((fate.open | fate.blind) & within)
                    if number := fate.claim(inside[:left]):
                        fate.refused[item.rule] += number
                        self.placed[id(item)] = number, Among(fate.stream, inside)
                    left = 0  # what is not open arrived, or is told of by another verdict
            self.unplaced[id(item)] = left

    def _name(self, refused: Sequence[Refused]) -> None:
        """Give a cause to what is unaccounted for, where the types of a mission tell one.

        They are wrong where a message arrived that they refuse.
        """
        self.unplaced |= dict.fromkeys(map(id, refused), 0)
        for fate in self.fates.values() if refused else ():
            stream, times = fate.stream, self._known.captured(fate.stream)
            own = [
                (item, (times >= item.start_ns) & (times <= item.end_ns))
                for item in refused
                if fate.seen and (item.link, item.msg_id) == (stream.link.label, stream.msg_id)
            ]
            if any(item.lost > (within & ~fate.arrived).sum() for item, within in own if within.any()):
                continue
            for item, within in own:
                inside = np.flatnonzero(fate.open & within)
                number = fate.claim(inside[: min(item.lost, fate.unaccounted)])
                if number:
                    fate.unaccounted -= number
                    fate.refused[item.rule] += number
                    self.placed[id(item)] = number, Among(stream, inside)

    def _pass_on(self, fate: Fate) -> None:
        """Mark those that may have come out of the application, and are among what is missing behind it.

        An application passes on in order. Between two messages that came out as many of the absent ones may
        have been passed on as came out with other values, or are missing there by their counts. No count
        shows those before the first and behind the last.
        """
        open_ = np.flatnonzero(fate.open)
        for hop in fate.hops:
            if not (hop.rewritten and hop.out.counted):
                continue
            into, out = np.sort(hop.in_rows), np.sort(hop.out_rows)
            behind = np.searchsorted(into, open_)
            passed = np.concatenate(([0], np.cumsum(self.telemetry.passed(hop.out))))[out]
            room = np.concatenate(([0], np.diff(passed) - 1, [0]))
            # Of those in one place the first may be it, as far as there is room.
            nth = np.arange(len(behind)) - np.searchsorted(behind, behind)
            fate.passed[open_[nth < room[behind]]] = True
            fate.edge[open_[(behind == 0) | (behind == len(into))]] = True

    def _unfollowed(self, fate: Fate) -> None:
        """Count what nobody can follow, of what nothing else has told."""
        if fate.unfollowed is not None:
            fate.unaccounted = min(int((fate.open & fate.unfollowed).sum()), self._untold(fate))

    def _untold(self, fate: Fate) -> int:
        """Return of how many messages nothing has told what became of them."""
        told = sum(loss.lost for loss in self.losses if loss.stream is fate.stream)
        taken = sum(fate.refused.values()) + fate.queued + fate.late + fate.uncounted
        return max(0, len(fate.stream) - told - taken)

    def _number(self, fates: Sequence[Fate]) -> None:
        """Hold the one stream of commands whose values are cut off against the number that the robot got."""
        rows = self._known.rows
        there = np.flatnonzero(among(rows.link, lambda item: item.last_hop))
        unseen = [
            fate
            for fate in fates
            if fate.stream.link.only_to_cfs
            and not fate.seen
            and (fate.stream.known_id not in names.MSG_ID_NAMES or fate.stream.route != NO_ROUTE)
        ]
        if not len(there) or len(unseen) != 1 or any(hop.out.link.last_hop for hop in self._known.hops):
            return
        (fate,) = unseen
        cut = rows.has(Finding.CAPTURE_CUT)
        if cut[there].any() or cut[fate.stream.rows].any():
            left = self._untold(fate) + fate.queued + fate.late
            fate.reached = min(left, len(there))
            left -= fate.reached
            # What the robot got CI had read, counted or not.
            fate.queued = min(fate.queued, left)
            fate.late = min(fate.late, left - fate.queued)
            left -= fate.queued + fate.late
            late = self._known.captured(fate.stream) > self._known.end_ns - WAITS_NS
            fate.unaccounted = max(0, left - int(late.sum()))

    def _commanded(self, fate: Fate) -> None:
        """Hold commands to Telemetry Output against its own counters in 0x880.

        They were sent, and are counted, between its first 0x880 and its last; what was sent just before the
        last may not be in it yet. A counter that was set back tells nothing, nor those of
        several cFS, or of one that was started again, or whose Telemetry Output was.
        """
        known, samples = self._known, self._known.payloads.commanded
        senders = np.unique(known.rows.source[samples["row"]])
        if fate.seen or len(samples) < 2 or len(senders) != 1 or len(known.instances.items) != 1:
            return
        steps = np.stack([np.diff(samples[name]) for name in ("taken", "refused")])
        steps[steps < -_WRAPPED] += _COUNTS
        reset = any(item.function_code == telemetry_output.RESET for item in known.payloads.output)
        if reset or (steps < 0).any():
            return
        fate.commanded = int(steps.sum())
        times, counted_ns = known.captured(fate.stream), samples["time_ns"]
        inside = int(((times > counted_ns[0]) & (times <= counted_ns[-1] - TAIL_NS)).sum())
        fate.unaccounted = max(0, inside - (len(times) - self._untold(fate)) - fate.commanded)

    def _not_received(self, fate: Fate) -> None:
        """Tell lost what nothing else has told of and that came to a port that nobody listened on."""
        chosen = np.flatnonzero(fate.open & self._known.closed[fate.stream.rows])
        if fate.claim(chosen):
            hop = SBN_SOCKET if fate.stream.link.peers else ""
            text = "ICMP errors: port unreachable"
            self.losses.append(loss_of(self._known, fate, PORT_CLOSED, chosen, [text], hop=hop))

    def _rest(
        self, fate: Fate, tails: Mapping[int, int], shared: Sequence[int], among: dict[int, int]
    ) -> None:
        """Rules 6 and 7.

        Args:
            tails: id of a stream to what counters have of it behind its last message.
            shared: which counts it shares with other traffic.
            among: each of these to how many of them may still be messages that did not come out.
        """
        if not fate.seen:
            return
        edge = np.flatnonzero(fate.open & fate.edge)[: sum(tails.get(id(hop.out), 0) for hop in fate.hops)]
        fate.passed[edge] = True
        fate.passed_on = int((fate.open & fate.passed).sum())
        fate.open &= ~fate.passed
        newer = fate.open & fate.newer
        fate.superseded = int(newer.sum())
        fate.open &= ~newer
        times = self._known.captured(fate.stream)
        if fate.stream.link.peers:
            self._rushed(fate, times)
        fate.beyond = int((fate.open & fate.edge).sum())
        unaccounted = int(fate.open.sum()) - fate.beyond
        # One that came out and was lost behind that took others' place, too.
        more = min(unaccounted, fate.passed_on) if fate.newer.any() else 0
        fate.superseded += more
        fate.unaccounted = unaccounted - more
        # What counters have of several together may be some of these.
        for at in shared:
            part = min(among[at], fate.unaccounted)
            among[at] -= part
            fate.unaccounted -= part
            fate.elsewhere += part
            fate.shared -= part
        fate.shared = min(fate.shared, fate.superseded + fate.passed_on)
        superseded = min(fate.shared, fate.superseded)
        fate.superseded -= superseded
        fate.passed_on -= fate.shared - superseded
        last = [loss.span for loss in self.losses if loss.stream is fate.stream and loss.kind in COUNTERS]
        # What a pipe loses to the end may be among those that are last.
        fate.uncertain = fate.waiting if fate.spans[-1] in last else 0

    def _rushed(self, fate: Fate, times: NDArray[np.int64]) -> None:
        """Tell lost in SBN's socket what did not come out, and came when SBN had more than it reads."""
        rows, wake_ns = self._known.rows, self._known.profile.sbn_wake_ns
        there = np.sort(rows.time_ns[rows.destination == fate.stream.receiver])
        before = np.searchsorted(there, times, "right") - np.searchsorted(there, times - wake_ns, "right")
        beyond = times[before > sbn.DATAGRAMS_PER_WAKE]
        if not len(beyond):
            return
        # Others of that time may have been lost behind the application: which they were, no value tells.
        after = np.minimum(np.searchsorted(beyond, times), len(beyond) - 1)
        away = np.minimum(np.abs(times - beyond[after]), np.abs(times - beyond[np.maximum(after - 1, 0)]))
        chosen = np.flatnonzero(fate.open & (away <= LATE_NS))
        chosen = np.sort(chosen[np.argsort(away[chosen], kind="stable")][: len(beyond)])
        if len(chosen):
            fate.claim(chosen)
            text = (
                f"up to {int(before.max()):,} datagrams came to it within {wake_ns // 1_000_000} ms, and it "
                f"reads about {sbn.DATAGRAMS_PER_WAKE}; no counter has what its socket drops"
            )
            self.losses.append(loss_of(self._known, fate, "sbn_socket", chosen, [text], hop=SBN_SOCKET))
