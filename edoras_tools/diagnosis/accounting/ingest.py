"""Datagrams lost before CI, on the network or in its socket: those sent to it against its count in 0x884.

In: the datagrams to each CI, and the samples of its count. Out: an ``Ingest`` for each CI, which knows
numbers and times, and no messages. ``BeforeCi`` then chooses the messages, in several steps of ``commands``.

Rules:

1. CI counts every datagram that it reads, good or bad. So at each sample of its count:
   sent until then = read + waiting in its socket + lost before it.
2. The number lost never falls and the number waiting is never negative. So later samples bound earlier ones.
3. If CI reads fewer datagrams at a wake-up than it can, its socket is empty afterwards: none sent before
   waits.
4. If the count falls, CI or its cFS started again. The datagrams that it read last were never counted: it
   read on until it was commanded to restart, or until its cFS fell silent. After a command to reset its
   counters it runs on.
5. A loss is in the full socket if as many datagrams can have waited as a socket usually holds; else it is on
   the network.
6. CI reads datagrams in their order. What it read before the first datagram of the capture came out of cFS
   was sent before the capture began.
7. Within these bounds the smallest number is lost; the rest waits.
8. On a slow link, such as a radio, datagrams and counts may be on their way for long. If that explains all
   losses on the network, there are none. Where nothing came for a while, it explains only a part.
9. A count may be made a round of Telemetry Output sooner than its time stamp says, where all packets are as
   late. This is assumed only where the counts contradict each other otherwise.
10. Copies made by a network hide losses in the count. If everything CI reads goes to a robot, at most as many
   messages were lost behind CI as it read and did not come out; the others were lost before it.
"""

from __future__ import annotations

from collections import Counter
from itertools import pairwise
from math import ceil
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.cfs import command_ingest, executive_services
from edoras_tools.decode.conversations import ConversationKind
from edoras_tools.diagnosis.accounting.claims import shares
from edoras_tools.diagnosis.accounting.losses import COUNTERS, LOST_AT, WAITS_NS, Fate, Loss, Outage
from edoras_tools.diagnosis.evidence.instances import NOBODY
from edoras_tools.diagnosis.quality import largest_share, overlapping
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire.arrays import Integers, Mask, Places, changes, distinct, groups

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Sequence

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.matching.crossing import Hop

    _May = tuple[Fate, Mask]
    """A stream's fate, and a mask (rows,) of its messages that may be lost."""

QUOTED: Final = "ICMP errors about "
"""Start of the evidence that counts messages which a router or a firewall rejected."""
Cause = Literal["socket", "network", "down", "restart", "ci_stopped"]
_OUTAGES: Final[tuple[Cause, ...]] = "down", "restart", "ci_stopped"
_SLACK_NS: Final = 100 * MILLISECOND
"""How late tasks wake up on a busy host."""
_UNDER_WAY_NS: Final = 2 * SECOND
_APART_NS: Final = SECOND // 4
"""How much the delay of a steady network varies."""
_LATE_NS: Final = 2 * SECOND
_ONE_NS: Final = 15 * SECOND
_ENDS_NS: Final = 750 * MILLISECOND
"""An application usually runs on for this long after it is commanded to stop."""
_HELD_NS: Final = 2 * SECOND
"""How long an application, and the link behind it, may keep a message that is not sent on at once."""
DRAINS_NS: Final = 15 * SECOND
"""A datagram may wait this long in CI's socket before it is read."""
_MODULUS: Final = 1 << 32
_BUSY: Final = 0.9
"""A CI that reads this share of the most it can read may have left datagrams in its socket."""


class IngestLoss(msgspec.Struct, frozen=True):
    """Datagrams that were lost before a CI in one span of time.

    Attributes:
        cause: why they were lost.
        lost: number of datagrams.
        start_ns: the first of them was sent after this time.
        end_ns: the last of them was sent at this time at the latest.
        more: number of later datagrams that may be lost too, or waiting; counts cannot distinguish these.
        proof: text of the event or command that shows it; empty if there is none.
    """

    cause: Cause
    lost: int
    start_ns: int
    end_ns: int
    more: int = 0
    proof: str = ""

    @property
    def since_ns(self) -> int:
        """Earliest time at which a lost datagram was sent: a count is captured later than its datagrams."""
        return self.start_ns - _LATE_NS * (self.cause in {"socket", "network"})


class Ingest(msgspec.Struct):
    """Datagrams sent to one CI: read, lost before it, waiting, or not captured.

    Attributes:
        endpoint: number of the endpoint where it listens, as in the table.
        system: number of its cFS, as in ``Instances.systems``.
        rows: intp, rows of the datagrams to it, in order of time.
        first_ns: time of its first count in the capture.
        last_ns: time of its last count.
        read_count: datagrams that it read between these two, all restarts included.
        losses: losses before it, in order of time.
        waiting: datagrams that were sent before ``last_ns`` and may be waiting in its socket then.
        unread: those of ``waiting`` that were sent before its last count was made.
        not_captured: datagrams that it counted and the capture does not show.
        unsure: datagrams that may be lost besides: where the capture begins amid traffic, nothing shows which
            of the datagrams just sent are in the first count.
        lacking: datagrams that its last counts before restarts lack: read later, or lost on a network that
            loses some.
        offset: datagrams that it had read and its first count lacks; negative: those that this count has from
            before the capture.
        older_until_ns: until this time it may have read datagrams from before the capture, because it read as
            fast as it can when the capture began; 0 if it did not.
        ended: intervals from the last packet of a cFS that went down to when the next would have come: it may
            have read the datagrams sent meanwhile.
        by_kernel: it has no count; the drops of its socket are from its host's kernel.
    """

    endpoint: int
    system: int
    rows: Places
    first_ns: int
    last_ns: int
    read_count: int = 0
    losses: list[IngestLoss] = msgspec.field(default_factory=list)
    waiting: int = 0
    unread: int = 0
    not_captured: int = 0
    unsure: int = 0
    lacking: int = 0
    offset: int = 0
    older_until_ns: int = 0
    ended: list[tuple[int, int]] = msgspec.field(default_factory=list)
    by_kernel: bool = False

    def add(self, loss: IngestLoss) -> None:
        """Append a loss; losses on the network that follow each other within 15 s become one."""
        last = self.losses[-1] if self.losses else None
        if last and last.cause == loss.cause == "network" and loss.start_ns - last.end_ns < _ONE_NS:
            loss = IngestLoss("network", last.lost + loss.lost, last.start_ns, loss.end_ns)
            self.losses.pop()
        self.losses.append(loss)

    def concede_copies(self, again_ns: Integers) -> None:
        """Make network losses uncertain that copies can explain, and take back those that came late.

        The capture may have doubled a datagram that was sent once: then one loss less is proven. And
        datagrams that CI counted without a sign of them may be those that seem lost.

        Args:
            again_ns: i64, times of the copies.
        """
        self.unsure += self._take_back(lambda end_ns: int((again_ns <= end_ns).sum()))
        later = self._take_back(lambda _: self.not_captured)
        self.read_count, self.not_captured = self.read_count + later, self.not_captured - later

    def _take_back(self, most: Callable[[int], int]) -> int:
        """Take back network losses; return how many.

        Args:
            most: the most that can be taken back of all losses up to a time.
        """
        spared = 0
        for at, loss in enumerate(self.losses):
            number = min(loss.lost, max(0, most(loss.end_ns) - spared)) * (loss.cause == "network")
            self.losses[at] = replace(loss, lost=loss.lost - number)
            spared += number
        self.losses = [loss for loss in self.losses if loss.lost]
        return spared

    def lost_by(self, *causes: Cause) -> int:
        """Return the number of datagrams lost by some causes."""
        return sum(item.lost for item in self.losses if item.cause in causes)

    @property
    def lost(self) -> int:
        """Number of all datagrams lost before it."""
        return sum(item.lost for item in self.losses)


def ingests(case: Case) -> list[Ingest]:
    """Return an account of every CI that has counts: its own, or those of the recording host's kernel."""
    rows, to_ci, samples = case.rows, case.to_ci, _samples(case)
    every = distinct(rows.destination[to_ci]).tolist()
    places = {system: _endpoint(case, every, own) for system, own in samples.items()}
    uses = Counter(places.values())
    accounts = []
    for system, own in samples.items():
        endpoint = places[system]
        # If two CIs share an address and port, nothing shows which one a datagram was for.
        if endpoint is not None and uses[endpoint] == 1 and len(own) > 1:
            mine = to_ci[rows.destination[to_ci] == endpoint]
            account = _Counted(case, endpoint, system, mine, own).best()
            account.concede_copies(rows.time_ns[np.intersect1d(account.rows, case.prepared.duplicates)])
            accounts.append(account)
    return [*accounts, *_by_kernel(case, every, {item.endpoint for item in accounts})]


def _by_kernel(case: Case, places: Sequence[int], others: Collection[int]) -> Iterator[Ingest]:
    """Yield an account of each CI but some others, if the kernel counted the drops of its socket."""
    ports = Counter(case.endpoints[item].port for item in places)
    for endpoint in places:
        port = case.endpoints[endpoint].port
        # If two hosts use the port, nothing shows whose socket the counter is of.
        if endpoint not in others and ports[port] == 1 and (drops := case.host.by_port.get(port)):
            mine = case.to_ci[case.rows.destination[case.to_ci] == endpoint]
            span, lost = case.span(mine), min(drops, len(mine))
            loss, number = IngestLoss("socket", lost, *span), len(mine) - lost
            yield Ingest(endpoint, NOBODY, mine, *span, number, [loss], by_kernel=True)


class _Sample(msgspec.Struct, frozen=True):
    """One 0x884.

    Attributes:
        seen_ns: capture time.
        made_ns: its own time stamp, as capture time.
        count: datagrams that CI had read, good and bad, modulo 2^32.
        instance: boot of cFS that it is from.
        source: number of the endpoint that sent it.
    """

    seen_ns: int
    made_ns: int
    count: int
    instance: int
    source: int


def _samples(case: Case) -> dict[int, list[_Sample]]:
    """Return the samples by cFS, all its boots together, in order of time."""
    rows, instances = case.rows, case.instances
    samples = case.payloads.ingest
    row, counts = samples["row"], (samples["packets"] + samples["errors"]) % _MODULUS
    own = (instances.of_row[row] != NOBODY) & rows.on(lambda link: link.only_from_cfs, row)
    # A count that was overtaken by a newer one is no restart; captures of two places are out of order anyway.
    # Nor is one that came twice a count of a CI that read nothing in between.
    own &= ((rows.reordered[row] == 0) | (case.prepared.copies > 0)) & (rows.duplicates[row] <= 0)
    own &= instances.owners(rows.source[row], samples["time_ns"]) == instances.of_row[row]
    row, seen_ns, instance = row[own], samples["time_ns"][own], instances.of_row[row[own]]
    offsets = np.array([item.offset_ns for item in instances.items], np.int64)
    made_ns = rows.mission_time_ns[row] + offsets[instance]
    system = np.array(instances.systems, np.int64)[instance]
    order = np.lexsort((seen_ns, system))
    order = order[changes(order, system, seen_ns)]
    columns = seen_ns, made_ns, counts[own], instance, rows.source[row]
    return {
        key: list(map(_Sample, *(column[at].tolist() for column in columns)))
        for key, at in groups(system, order)
    }


def _endpoint(case: Case, places: Sequence[int], own: Sequence[_Sample]) -> int | None:
    """Return the endpoint of a cFS's CI; None if several fit.

    Args:
        case: the capture.
        places: endpoints that datagrams to any CI went to.
        own: samples of this cFS.
    """
    if len(places) == len(set(case.instances.systems)) == 1:
        return places[0]
    items = case.instances.items
    host, address = items[own[0].instance].host, case.endpoints[own[0].source].address
    pairs = zip(items, case.instances.systems, strict=True)
    shared = len({system for item, system in pairs if item.host == host}) > 1
    fits = [place for place in places if case.endpoints[place].address == address]
    if len(fits) > 1 or shared:
        names = {items[sample.instance].name for sample in own} - {""}
        processor = max(names, default="").partition(":")[2]
        port = command_ingest.PORT + int(processor) - 1 if processor.isdecimal() else 0
        fits = [place for place in fits if case.endpoints[place].port == port]
    return fits[0] if len(fits) == 1 else None


class _Past(msgspec.Struct):
    """What the runs of a CI so far have shown: from one restart to the next.

    Attributes:
        first: index of the first sample of the latest run.
        lost: number of datagrams lost.
        offset: number of datagrams that it read and its present count lacks: of earlier runs.
        room: number of datagrams that may be lost besides.
        lag_ns: shortest time from sending a datagram to the first count that has it, in the latest run.
        idle_ns: time of the last sample at which it had read fewer than it can.
        crowded: whether it had read as many as it can at the latest sample.
    """

    first: int = 0
    lost: int = 0
    offset: int = 0
    room: int = 0
    lag_ns: int = 0
    idle_ns: int = 0
    crowded: bool = False


class _Counted:
    """The datagrams sent to one CI, and its counts.

    Args:
        case: the capture.
        endpoint: number of its endpoint.
        system: number of its cFS.
        rows: rows of the datagrams, in order of time.
        own: samples of its count, in order of time.
    """

    def __init__(self, case: Case, endpoint: int, system: int, rows: Places, own: Sequence[_Sample]) -> None:
        self._case, self._profile = case, case.profile
        self._endpoint, self._system, self._rows, self._own = endpoint, system, rows, own
        self._most = self._profile.ci_datagrams_per_wake
        self._sent_ns = case.rows.time_ns[rows]
        self._seen, self._made, self._count, instance = (
            np.array([getattr(item, name) for item in own])
            for name in ("seen_ns", "made_ns", "count", "instance")
        )
        begins = np.diff(instance) != 0
        for item in case.resets:  # a reset of cFS whose clock went on
            within = (item.start_ns < self._seen[1:]) & (self._seen[:-1] < item.end_ns)
            begins |= within & (instance[1:] == item.instance)
        self._restarts = np.append(False, begins)
        """Mask (samples,): cFS was started again since the sample before."""
        table, code = case.rows, command_ingest.RESET_COUNTERS
        resets = (table.known_id == command_ingest.COMMAND_MSG_ID) & (table.function_code == code)
        before_ns, resets_ns = self._seen[:-1], table.time_ns[resets & (table.destination == endpoint)]
        sent = np.searchsorted(resets_ns, [before_ns - DRAINS_NS, before_ns - WAITS_NS, self._seen[1:]])
        self._resets = np.append(False, (sent[2] > sent[0]) & (np.diff(instance) == 0))
        """Mask (samples,): a command may have reset its counters since the sample before."""
        # Or CI alone was, or its count was reset, which need not show if it had been reset just before: if it
        # has no more than CI reads between two samples.
        most = self._most * np.rint(np.diff(self._made) / self._profile.ci_wake_ns)
        begins |= (np.diff(self._count) < 0) | ((sent[2] > sent[1]) & (self._count[1:] <= most))
        self._starts = (np.flatnonzero(begins) + 1).tolist()
        hops = [hop for hop in case.hops if hop.into.link.only_to_cfs and hop.into.receiver == endpoint]
        self._read = []
        for hop in hops:
            wait_ns = 0 if hop.out.link.last_hop else _HELD_NS
            self._read.append((hop.into.time_ns[hop.in_rows], hop.out.time_ns[hop.out_rows] - wait_ns))
        """For each way out of cFS: when commands were sent, and a time at which CI had surely not read them
        yet.

        A robot gets a command at once; on other ways the application and the link may keep it for a while.
        """
        self._arrived = np.sort(np.concatenate([sent for sent, _ in self._read])) if hops else None
        self._all_out = all(hop.out.link.last_hop for hop in hops)
        """Whether everything read comes out: on other ways newer messages may supersede older ones."""
        self._read_ns = _read_by(hops)
        self._first_out = min(((int(out[0]), int(sent[0])) for sent, out in self._read), default=(0, 0))
        """Of the first command that came out: a time at which CI had not read it, and when it was sent."""
        self._sooner_ns = 0
        """How much sooner each count may be made than its time stamp says."""
        self._stood = bool((np.diff(self._sent_until(self._seen))[np.diff(self._count) == 0] > 2).any())
        """Whether CI read nothing between two samples though datagrams were sent, as on a stalled network."""

    def best(self) -> Ingest:
        """Return the account that explains most, of a network with or without delay (rules 8 and 9)."""
        account = self.account()
        if account.not_captured and account.losses:
            self._sooner_ns = self._profile.to_wake_ns
            sooner = self.account()
            self._sooner_ns *= not sooner.not_captured
            account = sooner if self._sooner_ns else account
        lost = account.lost_by("network")
        if not (lost or (account.lost and account.not_captured)):
            return account
        late = self.account(_UNDER_WAY_NS)
        more = lost - late.lost_by("network")
        # What a slow network explains is neither a loss nor a copy.
        is_less = more >= min(account.not_captured, lost) - late.not_captured
        if is_less and (more == lost > 0 or late.not_captured < account.not_captured):
            even = late if self._stood or self._arrived is not None else self._of_steady_delay(account)
            # How many waited when CI ended depends on the delay.
            waited = max(0, account.lost_by(*_OUTAGES) - late.lost_by(*_OUTAGES))
            more = min(more, late.waiting) * (self._arrived is None)  # under way, or lost
            late = replace(late, waiting=late.waiting - more, unread=max(0, late.unread - more))
            late.unsure = account.unsure + waited + more
            return even if even.lost_by("network") and not even.not_captured else late
        return replace(late, unsure=account.unsure + more) if self._stood and more > 0 else account

    def _of_steady_delay(self, account: Ingest) -> Ingest:
        """Return the best account for any constant delay of the network up to 2 s.

        No count came too early for it, if possible; then it has the fewest counts and losses unexplained.

        Args:
            account: the account for a network without delay.
        """
        every = [self.account(ns + _APART_NS, ns) for ns in range(0, _UNDER_WAY_NS, _APART_NS)]
        least = min(every, key=lambda item: (item.offset > 0, item.not_captured, item.lost_by("network")))
        return replace(least, unsure=least.unsure + max(0, account.lost - least.lost))

    def account(self, under_way_ns: int = 0, least_ns: int = 0) -> Ingest:
        """Compare the datagrams sent with the counts.

        Args:
            under_way_ns: longest delay of the network.
            least_ns: shortest delay.
        """
        own, count, most = self._own, self._count, self._most
        account = Ingest(self._endpoint, self._system, self._rows, own[0].seen_ns, own[-1].seen_ns)
        unsteady_ns = self._case.unsteady_ns
        sent = np.searchsorted(self._sent_ns, self._seen + unsteady_ns - least_ns, "right")
        past = _Past()
        for first, end in pairwise([0, *self._starts, len(own)]):
            part = slice(first, end)
            high = sent[part] - count[part]
            emptied_ns, busy = self._emptied(part)
            emptied_ns -= under_way_ns + unsteady_ns
            low = np.where(emptied_ns <= 0, -_MODULUS, self._sent_until(emptied_ns) - count[part])
            if self._resets[first]:
                low[0] = -_MODULUS  # datagrams may have waited then
                begin = self._reset(account, past, first, _fewer(low, high))
            elif first:
                begin = self._restarted(account, past, first)
            else:
                begin = self._first_count()
                if busy[1:2].any() or ((sent[part][1:2] == 0) & (np.diff(count[part][:2]) > 0)).any():
                    low[0] = -_MODULUS  # nothing shows how many it had read before the first sample
                    account.older_until_ns = self._older_until(end, is_all=count[end - 1] == sent[end - 1])
                exact = low[0] <= 0 == high.min() == high[-1]  # in all it read just what the capture shows
                # It is 0 if all that the first count has can be in the capture.
                older = 0 if low[0] <= 0 <= high.min() else _fewer(low, high)
                past.offset = min(older, self._most_older(end)) * (begin[0] != "down" and not exact)
                account.offset = past.offset
                low[0] = min(low[0], max(past.offset, high.min()))  # a datagram counted later was not lost
            drained = np.diff(count[part], prepend=count[first]) < most
            blind = not first and self._arrived is None
            # Datagrams from before the capture may wait too; they are no losses of this capture.
            high = high - past.offset if first else np.minimum(high - past.offset, sent[part])
            # Those from before the capture that it reads until then.
            until = int(np.searchsorted(self._seen[part], account.older_until_ns, "right"))
            older = np.maximum(0, count[part][max(0, until - 1)] - count[part])
            beyond = high + older + 2 * most - self._profile.socket_queue
            run = _Run(self._seen[part], low - past.offset, high, drained, beyond, blind)
            last_read = np.clip(past.lost + past.offset + count[part], 1, len(self._sent_ns)) - 1
            past.lag_ns = int((self._seen[part] - self._sent_ns[last_read]).min())
            past.lost = _follow(account, run, past.lost, begin, past.room)
            if blind and past.offset and not busy[1:2].any():
                self._doubt_first(account, int(emptied_ns[0]))
            account.waiting = max(0, int(run.high[-1]) - past.lost)
            past.first, past.crowded = first, bool(busy[-1])
            idle = np.flatnonzero(drained[1:])
            past.idle_ns = int(self._seen[first + 1 + idle[-1]]) if len(idle) else past.idle_ns
        if account.older_until_ns and account.offset < 0 and not account.losses:
            self._end_backlog(account, int(sent[-1]))
        account.read_count = int(sent[-1]) - past.lost - account.waiting
        account.unread = max(0, account.waiting - int(sent[-1] - self._sent_until(own[-1].made_ns)))
        self._stop(account)
        return account

    def _older_until(self, end: int, *, is_all: bool) -> int:
        """Return until when it may have read datagrams from before the capture; 0 if it surely read none.

        Args:
            end: index of the sample behind the first run.
            is_all: it read just what the capture shows.
        """
        own, most, idle = self._own, self._most, np.flatnonzero(np.diff(self._count[:end]) < self._most)
        behind = int(self._seen[idle[0] + 1 if len(idle) else -1])
        wakes = (own[0].made_ns - self._case.start_ns) // self._profile.ci_wake_ns
        if is_all or own[0].count < most * (wakes - 1):  # or fewer than a busy CI reads
            return 0
        return min(behind, self._first_out[0] or own[0].seen_ns + DRAINS_NS)

    def _doubt_first(self, account: Ingest, emptied_ns: int) -> None:
        """Add the datagrams that the first count lacks: lost, or counted before a reset that is not captured.

        Args:
            account: the account.
            emptied_ns: time until which CI had read everything at its first sample.
        """
        # Before the capture the rate at its start is assumed, and the number sent is negative.
        ahead_ns = emptied_ns - self._case.start_ns
        surely = np.sign(ahead_ns) * self._sent_until(self._case.start_ns + abs(ahead_ns))
        unsure = max(0, account.offset, account.offset - int(surely) + self._own[0].count)
        account.unsure += unsure * bool(account.losses)
        account.lacking += max(0, account.offset) * (not account.losses)

    def _end_backlog(self, account: Ingest, sent: int) -> None:
        """Let the backlog from before the capture end once CI has read as many as its first count has of it.

        It reads in order: these come first, and as many more as it has lost of the others by then.
        """
        rest = self._sent_until(account.older_until_ns)
        more = ceil(largest_share(max(1, sent - int(rest)), 0) * int(rest))
        end = min([*self._starts, int(np.searchsorted(self._seen, account.older_until_ns))])
        until = int(np.searchsorted(self._count[:end], more - account.offset))
        if until < end:
            account.older_until_ns = int(self._seen[until])

    def _reset(self, account: Ingest, past: _Past, first: int, fewer: int) -> tuple[Cause, int]:
        """Return cause and begin of the losses at a reset of its counters: it ran on.

        Until then it read at most what it can.

        Args:
            account: the account.
            past: the runs before.
            first: index of the first sample after it.
            fewer: by how many the counts of this run are below the numbers sent.
        """
        own = self._own
        most_read = past.offset + self._most_read(past.first, first, own[first].made_ns)
        if self._arrived is None:
            account.lacking += self._lacking(first, past)
        least = past.offset + own[first - 1].count
        past.offset = min(fewer - past.lost, most_read - own[first].count)
        past.room += max(0, past.offset - least)
        return ("socket" if past.crowded else "network"), past.idle_ns

    def _restarted(self, account: Ingest, past: _Past, first: int) -> tuple[Cause, int]:
        """Return cause and begin of the losses by a restart.

        Args:
            account: the account; datagrams lost with the closed socket are added to it.
            past: the runs before; what was lost and read until the restart is set here.
            first: index of the first sample after it.
        """
        sooner, later = self._own[first - 1], self._own[first]
        offset, since_ns = past.offset, self._own[past.first].seen_ns
        ended_ns = self._ended_ns(sooner, later)
        blind = (end for start, end in self._case.all_holes if start < later.seen_ns and sooner.seen_ns < end)
        ended_ns = max([ended_ns, *blind])  # it may have read on while nothing was captured
        # A datagram sent by then that came out later had waited in the socket.
        read_ns = max([ended_ns, *(int(out[sent <= ended_ns].max(initial=0)) for sent, out in self._read)])
        commands = self._commanded_ns(sooner.seen_ns - SECOND, later.seen_ns)
        stops = (item for item in self._outages() if not item.restarted and item.start_ns < later.seen_ns)
        alone: Cause = "ci_stopped" if any((one.end_ns or 0) > sooner.seen_ns for one in stops) else "restart"
        cause: Cause = "down" if self._restarts[first] else alone
        read = self._most_read(past.first, first, read_ns)
        if not commands and self._arrived is None and sooner.instance == later.instance:
            # Nothing shows when it ended: it may have read on until it started again.
            surely = offset + read
            read = self._most_read(past.first, first, later.made_ns)
            by_then = int(self._sent_until(ended_ns)) - past.lost
            account.unsure += max(0, min(by_then, offset + read) - surely)
        if self._arrived is None:
            account.lacking += self._lacking(first, past)
        past.offset = int(self._sent_until(ended_ns)) - past.lost
        if (waited := past.offset - offset - read) > 0:
            # The datagrams that waited in its socket are lost with it.
            account.losses.append(IngestLoss(cause, waited, since_ns, ended_ns, more=read - sooner.count))
            past.lost, past.offset = past.lost + waited, offset + read
        if commands and (self._arrived is None or not self._all_out):  # it may have ended at once
            by_then = int(self._sent_until(min(commands)[1])) - past.lost
            account.unsure += max(0, past.offset - max(offset + sooner.count, by_then))
        if cause == "down" and self._arrived is None:
            until_ns = min(self._next_sign_ns(sooner.instance, ended_ns), later.made_ns)
            if restarts := self._restarts_ns(ended_ns - self._profile.ci_wake_ns, until_ns):
                ended_ns = max(ended_ns, restarts[0])  # it may have read what came with the command
                past.offset = int(self._sent_until(ended_ns)) - past.lost
                until_ns = ended_ns + self._profile.ci_wake_ns
            account.ended.append((ended_ns, until_ns))
            past.offset += int(self._sent_until(until_ns) - self._sent_until(ended_ns))
            ended_ns = until_ns
        return cause, ended_ns

    def _lacking(self, first: int, past: _Past) -> int:
        """Return how many sent until the last count before a restart that count, and those before, lack."""
        sooner = self._own[first - 1]
        sent = int(self._sent_until(sooner.seen_ns - past.lag_ns))
        return max(0, sent - past.lost - past.offset - sooner.count)

    def _restarts_ns(self, start_ns: int, end_ns: int) -> list[int]:
        """Return the times of commands between two times that restart its cFS."""
        restarts = self._case.payloads.about_apps(executive_services.RESTART)
        mine = [item for item in restarts if self._case.rows.destination[item.row] == self._endpoint]
        return [item.time_ns for item in mine if start_ns < item.time_ns <= end_ns]

    def _next_sign_ns(self, instance: int, ended_ns: int) -> int:
        """Return when a cFS whose last packet is known would have sent the next one."""
        times = self._case.rows.time_ns[self._case.instances.of_row == instance]
        steps = np.diff(times[times <= ended_ns])
        steps = steps[steps > self._profile.to_wake_ns // 2]
        return ended_ns + (int(np.quantile(steps, 0.9)) if len(steps) else 0)

    def _stop(self, account: Ingest) -> None:
        """Add the datagrams sent after CI was stopped, if it was not started again."""
        for item in self._outages():
            if item.end_ns is None:
                stops_ns = self._commanded_ns(self._own[-1].seen_ns - SECOND, item.ended_ns)
                since_ns = max(stops_ns, default=(item.ended_ns, 0))[0]
                if stops_ns and (self._arrived is None or not self._all_out):
                    surely_ns = min(since_ns + 2 * self._profile.ci_wake_ns, item.ended_ns)
                    account.unsure += int(self._sent_until(surely_ns) - self._sent_until(since_ns))
                    since_ns = surely_ns
                if unread := int((self._sent_ns > since_ns).sum()):
                    span = since_ns, int(self._sent_ns[-1])
                    account.losses.append(IngestLoss("ci_stopped", unread, *span, proof=item.witness))

    def _outages(self) -> list[Outage]:
        """Return the outages of this CI."""
        names, system = command_ingest.NAMES, self._system
        return [item for item in self._case.outages if item.app in names and item.system == system]

    def _commanded_ns(self, start_ns: int, end_ns: int) -> list[tuple[int, int]]:
        """Return for each command that ends CI until when CI may have read, and when it was sent."""
        about = self._case.payloads.about_apps(*executive_services.ENDS_APP)
        times = [item.time_ns for item in about if item.app in command_ingest.NAMES]
        ends = {item.start_ns: item.ended_ns for item in self._outages()}
        # Where nothing shows what it still received, two wake-ups are the most.
        runs_ns = 2 * self._profile.ci_wake_ns if self._arrived is None else _ENDS_NS
        until = ((min(when + runs_ns, ends.get(when, end_ns)), when) for when in times)
        return [item for item in until if start_ns < item[0] < end_ns]

    def _sent_until(self, time_ns: Any) -> Places:
        return np.asarray(np.searchsorted(self._sent_ns, time_ns, "right"))

    def _emptied(self, part: slice) -> tuple[Integers, Mask]:
        """Return for each sample a time until which CI had read everything, i64 ns, and whether CI was busy.

        A sample is older than its datagram by up to a round of Telemetry Output, or by what its time stamp
        says, and CI read up to a wake-up before that.
        """
        seen_ns, count, wake_ns = self._seen[part], self._count[part], self._profile.ci_wake_ns
        read = np.diff(count, prepend=count[0])
        steps, own_steps = (np.diff(times, prepend=times[0]) for times in (seen_ns, self._made[part]))
        least = np.minimum(steps, own_steps)  # a count may come late, and a clock may be set
        busy = read > _BUSY * self._most * np.maximum(1.0, least / wake_ns)
        # If it read fewer than one wake-up can, the socket was empty after the last wake-up. Else it read as
        # many as it can at each since it was empty; if the count comes later than usual, it may have stood
        # still.
        oldest = np.minimum(seen_ns - self._profile.to_wake_ns, self._made[part]) - wake_ns - _SLACK_NS
        waited_ns = read // self._most * wake_ns + np.maximum(0, steps - np.median(steps).astype(np.int64))
        oldest -= np.where(read < self._most, 0, np.minimum(waited_ns, steps))
        out_ns, sent_ns = self._read_ns
        # A busy CI has read the datagrams that came out, and perhaps no others; a count may be made a round
        # of Telemetry Output sooner than its time stamp says.
        late_ns = _SLACK_NS + np.maximum(self._profile.to_wake_ns * busy, self._sooner_ns)
        last = np.searchsorted(out_ns, self._made[part] - late_ns) - 1
        return np.maximum(np.where(busy, 0, oldest), sent_ns[np.maximum(last, 0)]), busy

    def _most_older(self, end: int) -> int:
        """Return the most datagrams sent before the first count that can be missing in it.

        Until the first sample CI read no more than it can in that time. Until the first command of the
        capture came out, or until its socket was empty, CI read only datagrams from before the capture,
        because it reads in order.
        """
        own, first = self._own[:end], self._own[0]
        since_ns = int(self._sent_ns[0]) if len(self._sent_ns) else first.seen_ns
        most = self._most_read(0, end, own[-1].made_ns + first.seen_ns - since_ns)
        most -= own[-1].count + first.count
        out_ns, went_ns = self._first_out
        idle = np.append(np.flatnonzero(np.diff(self._count[:end]) < self._most), end)
        until = [item for item in own[: idle[0] + 1] if item.seen_ns <= out_ns]
        most = min(most, int(self._sent_until(went_ns)) - until[-1].count) if until else most
        # A cFS that booted with the capture has read nothing older.
        return max(0, most) if self._boot_ns(first) > since_ns - SECOND else most

    def _first_count(self) -> tuple[Cause, int]:
        """Return why datagrams sent before the first count are not in it, and since when.

        Mission time starts at a known value, which gives the time of boot: before that nobody listened.
        """
        sample = self._own[0]
        since_ns = int(self._sent_ns[0]) - 1 if len(self._sent_ns) else sample.seen_ns
        return ("down" if since_ns < self._boot_ns(sample) < sample.seen_ns else "network"), since_ns

    def _boot_ns(self, sample: _Sample) -> int:
        return self._case.instances.items[sample.instance].boot_ns(self._profile)

    def _ended_ns(self, last: _Sample, first: _Sample) -> int:
        """Return until when CI read before it started again."""
        if last.instance != first.instance:
            ended_ns = max(last.seen_ns, self._case.instances.items[last.instance].last_ns)
        else:
            between = self._commanded_ns(last.seen_ns - SECOND, first.seen_ns)
            ended_ns = max(between, default=(last.seen_ns, 0))[0]
        if self._arrived is None:
            return ended_ns
        # What came out was read: it ended where nothing came out for the longest time.
        begin_ns, arrived = last.seen_ns - SECOND, self._arrived
        inside = arrived[(arrived > begin_ns) & (arrived < first.seen_ns)]
        bounds = np.concatenate(([begin_ns], inside, [first.seen_ns]))
        hole = int(np.diff(bounds).argmax())
        if not self._all_out:
            return max(ended_ns, int(bounds[hole]))
        # The command to restart was read too, though it does not come out.
        restarts = self._restarts_ns(int(bounds[hole]), first.seen_ns)[:1]
        return max([int(bounds[hole]), *restarts]) if hole else min(ended_ns, int(bounds[1]))

    def _most_read(self, first: int, end: int, until_ns: int) -> int:
        """Return the most datagrams that CI can have read until a time, by a count and the best rate."""
        count, made_ns = self._count[first:end], self._made[first:end]
        rates = np.diff(count, prepend=0) * SECOND
        rates = rates / np.maximum(1, np.diff(made_ns, prepend=self._boot_ns(self._own[first])))
        fastest_hz = rates.max(initial=self._most * SECOND / self._profile.ci_wake_ns)
        seconds = max(0, until_ns - int(made_ns[-1])) / SECOND
        return int(count[-1]) + ceil(seconds * fastest_hz) + 2 * self._most


def _read_by(hops: Sequence[Hop]) -> tuple[Integers, Integers]:
    """Return when unique messages came out, and up to which time of sending CI had then read everything.

    CI reads in order. Ways on which a network reordered messages are left out.
    """
    out, sent = [np.full(1, np.iinfo(np.int64).min)], [np.zeros(1, np.int64)]
    for hop in hops:
        sole = hop.sole[hop.out_rows]
        sent_ns = hop.into.time_ns[hop.in_rows[sole]]
        if (np.diff(sent_ns) >= 0).all():
            out.append(hop.out.time_ns[hop.out_rows[sole]])
            sent.append(sent_ns)
    every, until = np.concatenate(out), np.concatenate(sent)
    order = np.argsort(every, kind="stable")
    return every[order], np.maximum.accumulate(until[order])


def _fewer(low: Integers, high: Integers) -> int:
    """Return the most by which counts can be below the numbers sent, over the first samples that agree."""
    later = np.flatnonzero(np.maximum.accumulate(low) > np.minimum.accumulate(high))
    return int(high[: later[0] if len(later) else None].min())


class _Run(NamedTuple):
    """Samples of one count between two restarts, and bounds of the number lost by then (rules 1 to 3).

    Attributes:
        seen: i64 (n,), capture times, ns.
        low: i64 (n,), least number of datagrams lost until each sample.
        high: i64 (n,), greatest such number.
        drained: (n,), CI read fewer than it can at a wake-up.
        beyond: i64 (n,), by how many more than a socket usually holds can have waited, if none were lost; two
            wake-ups are allowed for.
        blind: it is the first run, and the way out is not captured: CI may have read what its first count
            lacks, and have restarted since.
    """

    seen: Integers
    low: Integers
    high: Integers
    drained: Mask
    beyond: Integers
    blind: bool


class _Level(msgspec.Struct):
    """Consecutive samples that agree on the number of datagrams lost.

    Attributes:
        first: index of the first of them.
        last: index of the first of them that shows ``low``.
        low: least number that fits all of them.
        high: greatest such number.
    """

    first: int
    last: int
    low: int
    high: int


def _levels(run: _Run, lost: int, most: int) -> tuple[list[_Level], int]:
    """Divide a run into as few levels as possible; return them, and how many datagrams are not captured."""
    shown_less = 0
    levels = [_Level(0, 0, int(run.low[0]), min(int(run.high[0]), most))]
    for at in range(len(run.low)):
        level = levels[-1]
        least, high = max(level.low, lost), int(run.high[at])
        shown_less = max(shown_less, least - high)
        low, high = int(run.low[at]) + shown_less, high + shown_less
        if low > level.high:
            levels.append(_Level(at, at, low, high))
        else:
            level.last = at if low > level.low else level.last
            level.low, level.high = max(level.low, low), min(level.high, high)
    return levels, shown_less


def _follow(account: Ingest, run: _Run, lost: int, begin: tuple[Cause, int], room: int) -> int:
    """Add the losses of a run to the account.

    Args:
        account: the account.
        run: samples between two restarts.
        lost: number of datagrams lost before the run.
        begin: cause and begin of losses at its first sample.
        room: datagrams that may be lost at its end besides.

    Returns:
        The number of datagrams lost until its end.
    """
    # What the first count lacks may be older than the capture.
    before = account.losses[-1:]
    levels, shown_less = _levels(run, lost, 0 if begin[0] == "network" else _MODULUS)
    account.not_captured += shown_less
    for level in levels:
        number = max(level.low, lost)
        if number > lost:
            cause, since_ns = begin
            if level.first:
                empty = np.flatnonzero(run.drained[: level.first])
                last = int(empty[-1]) if len(empty) else 0
                full = int(run.beyond[last : level.last + 1].max()) + shown_less > number
                early = not account.losses and run.blind and run.high[: level.first].min() >= number
                cause = "socket" if full else "network"
                since_ns = int(run.seen[last])
                if early and {cause, begin[0]} == {"network"}:
                    account.unsure += number - lost  # or CI read them, and has restarted since
                    lost = number
            # By then an idle CI lacks all of them.
            part = slice(level.first, level.last + 1)
            lacks = run.drained[part] & (run.high[part] + shown_less >= number)
            until_ns = int(run.seen[level.first + lacks.argmax() if lacks.any() else level.last])
            if number > lost:
                account.add(IngestLoss(cause, number - lost, min(since_ns, until_ns), until_ns))
        lost = number
    if account.losses[-1:] != before:
        account.losses[-1] = replace(account.losses[-1], more=max(0, levels[-1].high - lost) + room)
    return lost


def _spread_evenly(rows: Places, number: int) -> Places:
    """Return ``number`` of some rows, evenly spread over them."""
    return rows[np.linspace(0, len(rows) - 1, number).round().astype(np.intp)]


_LONG: Final = 3
"""If no ICMP error comes for this many times the usual interval, somebody listens."""
_SCARCE_NS: Final = 2500 * MILLISECOND
"""But for longer than this: a host may send one error a second, and the network lose it."""


class BeforeCi:
    """Assigns the losses before CI to the messages that were sent to it.

    Args:
        case: the capture.
        fates: what became of the messages of each stream, so far.
        losses: losses so far; extended here.
    """

    def __init__(self, case: Case, fates: Sequence[Fate], losses: list[Loss]) -> None:
        self._case, self._fates, self.losses = case, fates, losses

    def share(self, account: Ingest) -> None:
        """Assign the losses before a CI, and the datagrams that may be lost besides."""
        fates = self._to(account)
        for start_ns, end_ns in account.ended:
            for fate in fates:
                times = fate.stream.time_ns
                fate.end("crowded", fate.open & (times > start_ns) & (times <= end_ns))
        for loss in account.losses:
            self._assign(account, loss)
        outages = [item for item in self._case.outages if item.app in command_ingest.NAMES]
        if any(item.start_ns < account.first_ns for item in outages) and not any(item.seen for item in fates):
            # Sent while it was restarted, or just before.
            account.unsure = max(account.unsure, account.offset)
        self._make_uncertain([(fate, fate.open) for fate in fates], account.unsure)

    def concede(self, telemetry: Sequence[Loss]) -> None:
        """Make datagrams uncertain that counts lack, if the network loses some, either way.

        Copies that a CI counted hide losses: as large a share as of the telemetry, where nothing shows what
        came out.
        """
        accounts, quality = self._case.ingests, self._case.quality
        behind = sum(item.lost for item in telemetry if item.kind == "after")
        if behind or any(item.lost_by("network") for item in accounts):
            sent = behind + sum(len(item) for item in self._case.streams if item.link.only_from_cfs)
            share = largest_share(sent, behind) if behind else 0.0
            for account in accounts:
                fates, copied = self._to(account), account.not_captured
                if any(item.seen for item in fates) or not quality.excludes(copied / len(account.rows)):
                    copied = 0  # what came out tells; or the capture missed them
                more = account.lacking + min(copied, ceil(share * len(account.rows)))
                self._make_uncertain([(fate, fate.open) for fate in fates], more)

    @staticmethod
    def _make_uncertain(may: Sequence[_May], number: int) -> None:
        """Make the first ``number`` of messages that may be lost uncertain."""
        for fate, inside, share in _divided(number, may):
            fate.ends["crowded"] += fate.claim(inside[:share])

    def _to(self, account: Ingest) -> list[Fate]:
        """Return the fates of the streams to a CI."""
        own = (fate for fate in self._fates if fate.stream.link.only_to_cfs)
        return [fate for fate in own if fate.stream.receiver == account.endpoint]

    def _assign(self, account: Ingest, loss: IngestLoss) -> None:
        """Assign one loss: to messages that did not come out, else to streams in proportion to their size."""
        rest, fates = loss.lost, self._to(account)
        # Streams of which it is known how many CI read: by a counter, or because all that it reads comes out.
        seen = [fate for fate in fates if fate.refused or (fate.seen and not fate.keeps_newest)]
        evidence = _evidence(account, loss)
        bounded = loss.proof or loss.cause in _OUTAGES
        # A counter has all messages without a subscriber that CI read.
        surely = self._open([fate for fate in fates if fate.unsubscribed], loss, loss.since_ns)
        if loss.cause in _OUTAGES:
            closed, may = self._case.unreachable.closed, self._open(fates, loss, loss.since_ns)
            rest = max(rest, sum(int((own & closed[fate.stream.rows]).sum()) for fate, own in may))
            surely = self._in_outage(account, loss, fates)
            rest -= self._answered(surely)
        if loss.proof:
            surely = []
            for fate in fates:  # CI was stopped: what waits will never be read
                never = fate.waits & (fate.stream.time_ns > loss.since_ns)
                fate.open |= never
                fate.waits &= ~never
        # First messages that did not come out; the first loss may have been before the first count.
        spans = [(seen, loss.since_ns), (fates, loss.since_ns), (fates, 0)][: 2 if bounded else None]
        if loss is account.losses[0] and not bounded:
            spans.insert(1, (seen, 0))
        # A message that an ICMP error quotes is surely lost.
        errors = self._case.unreachable.closed | (self._case.unreachable.refused > 0)
        may = self._open(fates, loss, loss.since_ns)
        may = [(fate, own & errors[fate.stream.rows]) for fate, own in may]
        quoted = self._spread(may, loss, rest, evidence)
        rest -= quoted
        if quoted and loss.cause == "network":
            evidence.append(f"{QUOTED}{quoted:,} of them came back")
        if not bounded and (theirs := min(rest, self._strange(account, loss))):
            rest -= theirs
            at = account.losses.index(loss)
            account.losses[at] = loss = replace(loss, more=loss.more + theirs)
        surely = [(fate, own & fate.open) for fate, own in surely]
        rest -= self._spread(surely, loss, rest, evidence)
        for those, since_ns in spans:
            rest -= self._spread(self._open(those, loss, since_ns), loss, rest, evidence)
        # Datagrams of no stream, such as those without a MsgId. Others that are left were read by another
        # cFS.
        others = np.setdiff1d(account.rows, np.concatenate([fate.stream.rows for fate in fates]))
        if rest := min(rest, int((self._case.rows.time_ns[others] <= loss.end_ns).sum())):
            span = loss.start_ns, loss.end_ns
            hop = LOST_AT[loss.cause]
            self.losses.append(Loss(loss.cause, hop, rest, *span, "medium", evidence=evidence))

    def _in_outage(self, account: Ingest, loss: IngestLoss, fates: Sequence[Fate]) -> list[_May]:
        """Return which messages a CI lost that ended: it reads in order, so one end of what was sent."""
        sent_ns = self._case.rows.time_ns[account.rows]
        sent_ns = sent_ns[(sent_ns > loss.since_ns) & (sent_ns <= loss.end_ns)]
        # The latest of what waited when it ended is lost, and the first sent later.
        waited = any(item.start_ns == loss.end_ns for item in account.losses)
        lost_ns = sent_ns[-loss.lost :] if waited else sent_ns[: loss.lost]
        until = replace(loss, end_ns=int(lost_ns.max(initial=0)))
        return self._open(fates, until, int(lost_ns.min(initial=loss.end_ns)) - 1)

    def _strange(self, account: Ingest, loss: IngestLoss) -> int:
        """Return how many datagrams of programs that are no bridges came to a CI while it lost some."""
        case, rows = self._case, account.rows
        strange = {flow.source for flow in case.prepared.flows if flow.kind is ConversationKind.STRANGER}
        places = [at for at, item in enumerate(case.endpoints if strange else ()) if item in strange]
        sent_ns = case.rows.time_ns[rows[np.isin(case.rows.source[rows], places)]]
        return int(((sent_ns > loss.since_ns) & (sent_ns <= loss.end_ns)).sum())

    def _answered(self, may: Sequence[_May]) -> int:
        """Make messages uncertain that were sent while no ICMP error came for long; return how many."""
        closed, number = self._case.unreachable.closed, 0
        quoted = [fate.stream.time_ns[closed[fate.stream.rows]] for fate, _ in may]
        errors_ns = np.sort(np.concatenate([np.zeros(0, np.int64), *quoted]))
        long_ns = max(_LONG * int(np.median(np.diff(errors_ns))), _SCARCE_NS) if len(errors_ns) > 1 else 0
        both = (item for item in pairwise(errors_ns.tolist()) if item[1] - item[0] > 2 * long_ns)
        spans = [(start + long_ns, end - long_ns) for start, end in both]
        for fate, own in (item for item in may if not item[0].seen):  # of others CI read what came out
            number += fate.end("crowded", own & overlapping(fate.stream.time_ns, fate.stream.time_ns, spans))
        return number

    def _open(self, fates: Sequence[Fate], loss: IngestLoss, since_ns: int) -> list[_May]:
        """Return the messages without a fate that were sent between a time and the end of a loss."""
        times = [fate.stream.time_ns for fate in fates]
        inside = ((sent_ns > since_ns) & (sent_ns <= loss.end_ns) for sent_ns in times)
        return [(fate, fate.open & own) for fate, own in zip(fates, inside, strict=True)]

    def _spread(self, may: Sequence[_May], loss: IngestLoss, number: int, evidence: list[str]) -> int:
        """Make at most ``number`` messages of some streams a loss before CI; return how many.

        Args:
            may: streams, and which messages may be lost.
            loss: the loss.
            number: upper bound.
            evidence: lines that show it.
        """
        total = 0
        for fate, inside, share in _divided(number, may):
            # Messages after the last one that came out cannot have been superseded.
            last = int(np.flatnonzero(fate.arrived)[-1]) if fate.arrived.any() else inside[-1]
            sure = inside[(inside > last) | (fate.keeps_newest & ~fate.newer[inside])][:share]
            rows = np.union1d(sure, _spread_evenly(np.setdiff1d(inside, sure), share - len(sure)))
            fate.claim(rows)
            self.losses.append(fate.loss(loss.cause, rows, evidence, among=inside))
            total += share
        return total

    def outnumbered(self, account: Ingest) -> None:
        """Make losses before CI of messages that did not come out and that CI cannot have read (rule 10)."""
        fates = [fate for fate in self._to(account) if fate.seen]
        outs = {hop.out: hop.out for fate in fates for hop in fate.hops}.values()
        all_out = all(out.link.last_hop for out in outs)
        if not account.not_captured or not all_out or self._case.quality.best[1]:
            return  # datagrams that CI counted beyond these may be those that the capture missed
        until_ns = account.last_ns - _HELD_NS  # its last count has all that came out by then
        came_out = sum(int((out.time_ns <= until_ns).sum()) for out in outs)
        read, streams = account.read_count + account.not_captured, [fate.stream for fate in fates]
        on_bus = sum(loss.lost for loss in self.losses if loss.stream in streams and loss.kind in COUNTERS)
        text = f"CI read {read:,}, of which {came_out:,} came out of the application: so many others did not"
        for fate in fates:
            inside = np.flatnonzero(fate.open & (fate.stream.time_ns <= until_ns))
            number = fate.ends["unaccounted"] - max(0, read - came_out - on_bus)
            if (number := min(number, len(inside))) > 0:
                rows = _spread_evenly(inside, number)
                fate.ends["unaccounted"] -= fate.claim(rows)
                self.losses.append(fate.loss("network", rows, [text], among=inside))

    def rest(self, account: Ingest) -> None:
        """Make losses before CI of messages that did not come out and that no pipe lost, if counts allow it.

        Messages that the capture may have missed are left out; and without 0x803 nothing is lost so, because
        nothing shows what pipes lost.
        """
        # Where an application keeps only the newest, messages that did not come out need not be lost.
        all_out = [fate for fate in self._to(account) if fate.seen and not fate.keeps_newest]
        size, quality = sum(len(fate.stream) for fate in all_out), self._case.quality
        # If the capture surely missed some frames, no share is excluded.
        shows = any(item.missing for item in quality.evidence if item.kind != "periods")
        for loss in account.losses if size and self._case.loss_counts else ():
            may = self._open(all_out, loss, loss.since_ns)
            number = sum(int((own & ~fate.unseen).sum()) for fate, own in may)
            missed = quality.may_have_missed(size) if shows else self._case.perhaps_missed(size, number)
            text = "so many did not come out, and its counts leave room for them"
            self._spread(may, loss, min(max(0, number - missed), loss.more), [text])
        for loss in account.losses:
            may = self._open(self._to(account), loss, loss.since_ns)
            self._make_uncertain(may, min(loss.more, self._strange(account, loss)))

    def wait(self, account: Ingest) -> None:
        """Mark the latest messages without a fate as waiting in CI's socket at its last count.

        CI reads in order: a message sent before one that came out does not wait.
        """
        number = account.waiting
        rows, fates = self._case.rows, self._to(account)
        free, read_ns = np.ones(len(rows), bool), -1
        for fate in fates:
            free[fate.stream.rows] = fate.open | fate.waits
            read_ns = max(read_ns, int(fate.stream.time_ns[fate.arrived].max(initial=-1)))
        times = rows.time_ns[account.rows]
        own = account.rows[(times > read_ns) & (times <= account.last_ns) & free[account.rows]]
        late = own[len(own) - min(number, len(own)) :]
        for fate in fates:
            if not fate.seen:
                fate.end("late", fate.open & (fate.stream.time_ns > account.last_ns))
            waiting = np.isin(fate.stream.rows, late)
            # More than a socket usually holds can wait only if it was given more room.
            beyond = int(np.isin(fate.stream.rows, late[: -self._case.profile.socket_queue]).sum())
            fate.ends["queued"] += int(waiting.sum()) - beyond
            fate.ends["crowded"] += beyond
            fate.open &= ~waiting
            fate.waits &= ~waiting


def _divided(number: int, may: Sequence[_May]) -> Iterator[tuple[Fate, Places, int]]:
    """Yield streams with the messages that may be lost, and how many of ``number`` are of each: not 0."""
    windows = [np.flatnonzero(own) for _, own in may]
    parts = shares(number, [len(inside) for inside in windows])
    yield from ((fate, own, part) for (fate, _), own, part in zip(may, windows, parts, strict=True) if part)


def _evidence(account: Ingest, loss: IngestLoss) -> list[str]:
    if loss.proof:
        return [loss.proof]
    if account.by_kernel:
        of = f"{loss.lost:,} of {len(account.rows):,} datagrams"
        return [f"/edoras/host: {of} dropped in its socket (the kernel's counter)"]
    sent = account.read_count + account.lost + account.waiting
    of = f"{account.read_count:,} of {sent:,} datagrams sent to it"
    return [f"0x884: CI took {of}", f"{loss.lost:,} of them lost between two of its counts"]
