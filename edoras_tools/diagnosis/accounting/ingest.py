"""What went to a CI against what it counted in 0x884: what the network or a full socket lost before it.

Rules:

1. CI counts every datagram that it reads, good or bad. At a sample, what was sent so far is what it took,
   what waits in its socket, and what was lost before it.
2. What was lost never becomes less, and what waits is not negative: a later sample bounds an earlier one.
3. A wake-up that reads fewer than CI can read empties the socket: what was sent before it does not wait.
4. A count that falls began anew: CI or cFS started again. Nobody counted what CI took last; it took what was
   sent until it was told to restart, or until its cFS fell silent. If it was told to reset its counters, it
   ran on.
5. Loss while more wait than two wake-ups read, or while it mostly reads all that it can, is its full
   socket; at a rate that it can read, the network.
6. CI takes datagrams in the order in which they came. What it takes before the first one of the capture
   comes out was sent before the capture began.
7. Within these bounds the smallest number is lost. The rest waits.
8. Datagrams and counts may be under way for long, as over a radio link: if that explains all that seem to be
   lost on the network, nothing is.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, field, replace
from itertools import pairwise
from math import ceil
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from edoras_tools.cfs import command_ingest, executive_services
from edoras_tools.diagnosis.evidence.instances import NOBODY
from edoras_tools.links.table import among
from edoras_tools.units import MILLISECOND, SECOND

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from numpy.typing import NDArray

    from edoras_tools.cfs.profile import SimProfile
    from edoras_tools.diagnosis.evidence.instances import Instances
    from edoras_tools.diagnosis.evidence.payloads import Payloads
    from edoras_tools.diagnosis.evidence.table import Rows
    from edoras_tools.diagnosis.matching.streams import Reset
    from edoras_tools.model import Endpoint

Cause = Literal["socket", "network", "down", "restart", "ci_stopped", "unknown"]
_SLACK_NS: Final = 100 * MILLISECOND
"""Tasks on a busy host wake up so late."""
_UNDER_WAY_NS: Final = 2 * SECOND
_LATE_NS: Final = 2 * SECOND
_ONE_NS: Final = 15 * SECOND
_ENDS_NS: Final = 750 * MILLISECOND
"""An application that is told to stop runs on for up to a second and a half."""
_NAMED: Final = re.compile(rf"\b(?:{'|'.join(map(re.escape, command_ingest.NAMES))})\b")
DRAINS_NS: Final = 15 * SECOND
"""So long after it was sent CI may read a datagram: what waits in its socket then."""
_MODULUS: Final = 1 << 32
_BUSY: Final = 0.9
"""Of what CI can read at the most; whoever reads so much may have left something."""
_MOSTLY: Final = 0.5
"""More than so many of the samples."""


@dataclass(frozen=True, slots=True)
class Before:
    """Datagrams that were lost before a CI in one span of time.

    Attributes:
        cause: why.
        lost: how many.
        start_ns: the first of them was sent after this.
        end_ns: and the last not after this.
        more: of those that may wait behind it, as many may have been lost with it: counts alone cannot tell.
        said: what cFS said of it.
    """

    cause: Cause
    lost: int
    start_ns: int
    end_ns: int
    more: int = 0
    said: str = ""

    @property
    def since_ns(self) -> int:
        """From when on what was lost was sent: a count is seen within so long of what it counts."""
        return self.start_ns - _LATE_NS * (self.cause in {"socket", "network"})


@dataclass(slots=True)
class Ingest:
    """The account of one CI.

    Attributes:
        endpoint: where it listens, as the table numbers endpoints.
        system: its cFS, as ``Instances.systems`` numbers them.
        rows: datagrams to it, in order of time.
        first_ns: from here on its count is known.
        last_ns: until here.
        taken: by how much its count grew, starts anew included.
        losses: what was lost before it.
        waiting: datagrams that were sent before ``last_ns`` and may be waiting in its socket then.
        more: of those, as many may have been lost with the last of ``losses``: counts alone cannot tell.
        not_captured: datagrams that it counted and the capture does not show.
        unsure: datagrams that may have been lost beside ``losses``: the capture begins amid datagrams, and
            its first count does not tell which of those just sent it has.
        older_until_ns: it read as fast as it can when the capture began: until then it may have read what was
            sent before.
        by_kernel: it has no count here; what its socket dropped, the kernel of its host counted.
    """

    endpoint: int
    system: int
    rows: NDArray[np.intp]
    first_ns: int
    last_ns: int
    taken: int = 0
    losses: list[Before] = field(default_factory=list)
    waiting: int = 0
    more: int = 0
    not_captured: int = 0
    unsure: int = 0
    older_until_ns: int = 0
    by_kernel: bool = False

    def add(self, loss: Before) -> None:
        """Take a loss; what the network goes on losing is one."""
        last = self.losses[-1] if self.losses else None
        if last and last.cause == loss.cause == "network" and loss.start_ns - last.end_ns < _ONE_NS:
            loss = Before("network", last.lost + loss.lost, last.start_ns, loss.end_ns)
            self.losses.pop()
        self.losses.append(loss)

    @property
    def lost_on_network(self) -> int:
        """What was lost on the network before it."""
        return sum(item.lost for item in self.losses if item.cause == "network")

    @property
    def lost(self) -> int:
        """All that was lost before it."""
        return sum(item.lost for item in self.losses)


@dataclass(frozen=True, slots=True)
class Sources:
    """What the accounts of CI are made from."""

    rows: Rows
    payloads: Payloads
    instances: Instances
    endpoints: Sequence[Endpoint]
    profile: SimProfile
    resets: Sequence[Reset]
    arrived_ns: Mapping[int, NDArray[np.int64]]
    """CI's endpoint to when commands to it were sent that came out of cFS again, in order."""
    first_out: Mapping[int, tuple[int, int]]
    """CI's endpoint to when the first of those came out, and when it had been sent."""


def ingests(sources: Sources) -> list[Ingest]:
    """Return the account of every CI whose counter is in the capture and can be told from others'."""
    rows = sources.rows
    samples = _samples(sources)
    to_ci = np.flatnonzero(among(rows.link, lambda link: link.only_to_cfs) & (rows.length > 0))
    places: dict[int, int | None] = {}
    for system, own in samples.items():
        host = sources.instances.items[own[0].instance].host
        there = {
            sources.instances.systems[at]
            for at, item in enumerate(sources.instances.items)
            if item.host == host
        }
        places[system] = _endpoint(sources, to_ci, own, alone=len(samples) == 1, shared=len(there) > 1)
    taken = Counter(places.values())
    found = []
    for system, own in samples.items():
        endpoint = places[system]
        # Of two CIs at one address and port nothing tells which was meant.
        if endpoint is not None and taken[endpoint] == 1 and len(own) > 1:
            mine = to_ci[rows.destination[to_ci] == endpoint]
            mine = mine[np.argsort(rows.time_ns[mine], kind="stable")]
            account = _account(sources, endpoint, system, mine, own)
            if account.lost_on_network:
                late = _account(sources, endpoint, system, mine, own, _UNDER_WAY_NS)
                # What a slow network explains altogether is no loss: rule 8.
                account = account if late.lost_on_network else late
            found.append(account)
    return found


def kernel_accounts(sources: Sources, drops: Mapping[int, int], counted: Collection[int]) -> list[Ingest]:
    """Return the account of every CI without a count here, of whose socket the kernel counted drops.

    Args:
        drops: datagrams that full sockets dropped, by UDP port.
        counted: endpoints of the CIs that have a count.
    """
    rows = sources.rows
    to_ci = np.flatnonzero(among(rows.link, lambda link: link.only_to_cfs) & (rows.length > 0))
    places = np.unique(rows.destination[to_ci]).tolist()
    ports = Counter(sources.endpoints[item].port for item in places)
    found = []
    for endpoint in places:
        port = sources.endpoints[endpoint].port
        # Of two hosts' sockets nothing tells which one the counter is of.
        if endpoint in counted or ports[port] > 1 or not drops.get(port):
            continue
        mine = to_ci[rows.destination[to_ci] == endpoint]
        mine = mine[np.argsort(rows.time_ns[mine], kind="stable")]
        first_ns, last_ns = int(rows.time_ns[mine[0]]), int(rows.time_ns[mine[-1]])
        lost = min(drops[port], len(mine))
        before = Before("socket", lost, first_ns, last_ns)
        taken = len(mine) - lost
        found.append(Ingest(endpoint, NOBODY, mine, first_ns, last_ns, taken, [before], by_kernel=True))
    return found


@dataclass(frozen=True, slots=True)
class _Sample:
    """One 0x884: when it was seen and made, what CI had read in all, of which boot and from which address."""

    seen_ns: int
    made_ns: int
    count: int
    instance: int
    source: int


def _samples(sources: Sources) -> dict[int, list[_Sample]]:
    """Return the counts of each cFS, in order of time, all its boots together."""
    rows, instances = sources.rows, sources.instances
    samples = sources.payloads.ingest
    row, counts = samples["row"], (samples["packets"] + samples["errors"]) % _MODULUS
    found: dict[int, dict[int, _Sample]] = {}
    own = (instances.of_row[row] != NOBODY) & among(rows.link[row], lambda link: link.only_from_cfs)
    row = row[own]
    columns = instances.of_row[row], rows.source[row], samples["time_ns"][own], rows.mission_time_ns[row]
    for instance, source, seen, mission_ns, count in zip(
        *(column.tolist() for column in (*columns, counts[own])), strict=True
    ):
        if instance != instances.owner(source, seen):
            continue
        sample = _Sample(seen, mission_ns + instances.items[instance].offset_ns, count, instance, source)
        found.setdefault(instances.systems[instance], {}).setdefault(seen, sample)
    return {system: [of[when] for when in sorted(of)] for system, of in found.items()}


def _endpoint(
    sources: Sources, to_ci: NDArray[np.intp], own: Sequence[_Sample], *, alone: bool, shared: bool
) -> int | None:
    """Return where a cFS's CI listens: the only place, or that of its address and number.

    Args:
        to_ci: rows of datagrams to any CI.
        own: its counts.
        alone: no other cFS counts.
        shared: another cFS has its address.
    """
    places = np.unique(sources.rows.destination[to_ci]).tolist()
    if len(places) == 1 and alone:
        return int(places[0])
    address = sources.endpoints[own[0].source].address
    here = [place for place in places if sources.endpoints[place].address == address]
    if len(here) > 1 or shared:
        names = {sources.instances.items[sample.instance].name for sample in own} - {""}
        processor = max(names, default="").partition(":")[2]
        port = command_ingest.PORT + int(processor) - 1 if processor.isdecimal() else 0
        here = [place for place in here if sources.endpoints[place].port == port]
    return int(here[0]) if len(here) == 1 else None


def _account(
    sources: Sources,
    endpoint: int,
    system: int,
    mine: NDArray[np.intp],
    own: Sequence[_Sample],
    under_way_ns: int = 0,
) -> Ingest:
    """Hold what was sent to a CI against its counts, if that was under way for so long at the most."""
    sent_ns = sources.rows.time_ns[mine]
    seen = np.array([item.seen_ns for item in own])
    made = np.array([item.made_ns for item in own])
    count = np.array([item.count for item in own])
    account = Ingest(endpoint, system, mine, int(seen[0]), int(seen[-1]))
    sent = np.searchsorted(sent_ns, seen, "right")
    starts = [at for at in range(1, len(own)) if _anew(own[at - 1], own[at])]
    lost = before = last = 0
    for first, end in pairwise([0, *starts, len(own)]):
        part = slice(first, end)
        high = sent[part] - count[part]
        emptied_ns, busy = _emptied(sources.profile, seen[part], made[part], count[part])
        emptied_ns -= under_way_ns
        low = np.where(busy, -_MODULUS, np.searchsorted(sent_ns, emptied_ns, "right") - count[part])
        if first and _reset(sources, endpoint, own[first - 1], own[first]):
            # It ran on, and set its count to 0 by itself: nothing tells of a loss just then.
            begin: tuple[Cause, int] = ("network", own[first - 1].seen_ns)
            before = _older(low, high) - lost
        elif first:
            ended_ns = _ended_ns(sources, endpoint, own[first - 1], own[first])
            most_read = before + _most_read(sources.profile, own[last:first], ended_ns)
            before = int(np.searchsorted(sent_ns, ended_ns, "right")) - lost
            if before > most_read:
                # What waited in its socket is gone with it; where it could not keep up it was lost before.
                full = account.waiting > 2 * sources.profile.ci_datagrams_per_wake
                account.losses.append(
                    Before("socket" if full else "restart", before - most_read, own[last].seen_ns, ended_ns)
                )
                lost += before - most_read
                before = most_read
            down = own[first - 1].instance != own[first].instance or any(
                item.instance == own[first].instance
                and item.start_ns <= own[first].seen_ns
                and own[first - 1].seen_ns <= item.end_ns
                for item in sources.resets
            )
            begin = ("down" if down else "restart", ended_ns)
        else:
            begin = _first(sources, own[0], sent_ns)
            before = 0 if begin[0] == "down" else _older(low, high)
            if begin[0] != "down":
                before = min(before, _most_older(sources, endpoint, sent_ns, own[:end]))
            if busy[1:2].any():
                low[0] = -_MODULUS  # how much it had read before the first sample, nothing tells
                idle = np.flatnonzero(np.diff(count[part]) < sources.profile.ci_datagrams_per_wake)
                behind = int(seen[idle[0] + 1]) if len(idle) else int(seen[-1])
                if count[end - 1] != sent[end - 1]:  # else it read what was sent here, and nothing older
                    account.older_until_ns = min(behind, int(seen[0]) + DRAINS_NS)
        most = sources.profile.ci_datagrams_per_wake
        drained = np.diff(count[part], prepend=count[first]) < most
        unread = 0 if first else _unseen(sources, endpoint, sent_ns, own[0])
        # What was sent before the capture began may wait, and is not lost here.
        high = high - before if first else np.minimum(high - before, sent[part])
        run = _Run(seen[part], low - before, high, drained, busy, 2 * most, unread)
        told = account.losses[-1:]
        lost = _follow(account, run, lost, begin)
        account.more = account.losses[-1].more if account.losses[-1:] != told else 0
        if not first and before and unread is None and account.losses and not busy[1:2].any():
            least = _sent_until(sources, sent_ns, int(emptied_ns[0])) - own[0].count
            account.unsure = max(0, before - least)
        account.waiting = max(0, int(run.high[-1]) - lost)
        last = first
    account.taken = int(sent[-1]) - lost - account.waiting
    if stopped := _stopped(sources, own[-1]):
        said, since_ns = stopped
        if unread := int((sent_ns > since_ns).sum()):
            account.losses.append(Before("ci_stopped", unread, since_ns, int(sent_ns[-1]), said=said))
    return account


def _stopped(sources: Sources, last: _Sample) -> tuple[str, int] | None:
    """Return what said that a CI was stopped, and since when it read nothing; None where it started again."""
    found = None
    for record in sources.payloads.events:
        own = record.app == executive_services.NAME and sources.instances.saying(record) == last.instance
        if own and record.time_ns > last.seen_ns - _LATE_NS and _NAMED.search(record.message):
            told = _told_ns(sources, last.seen_ns - SECOND, record.time_ns)
            stops = record.event_id == executive_services.STOPPED
            found = (f"event {record}", max(told, default=record.time_ns)) if stops else None
    return found


def _told_ns(sources: Sources, start_ns: int, end_ns: int) -> list[int]:
    """Return until when CI may have read on after commands that end it, of those between two times."""
    told = [
        int(sources.rows.time_ns[item.row]) + _ENDS_NS
        for item in sources.payloads.executive
        if item.app in command_ingest.NAMES and item.function_code in executive_services.ENDS_APP
    ]
    return [when for when in told if start_ns < when < end_ns]


def _sent_until(sources: Sources, sent_ns: NDArray[np.int64], time_ns: int) -> int:
    """Return how many datagrams were sent until a time; before the capture as after its start, negative."""
    start_ns = int(sources.rows.time_ns[0])
    if time_ns >= start_ns:
        return int(np.searchsorted(sent_ns, time_ns, "right"))
    return -int(np.searchsorted(sent_ns, 2 * start_ns - time_ns, "right"))


def _emptied(
    profile: SimProfile, seen: NDArray[np.int64], made: NDArray[np.int64], count: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return until when each sample's CI surely had read all there was, and where it read all that it can.

    A sample is older than its datagram by up to a round of Telemetry Output, or as its clock says, and CI
    read up to a wake-up before.
    """
    most, wake_ns = profile.ci_datagrams_per_wake, profile.ci_wake_ns
    read = np.diff(count, prepend=count[0])
    steps = np.diff(seen, prepend=seen[0])
    busy = read > _BUSY * most * np.maximum(1.0, steps / wake_ns)
    # Fewer than one wake-up can read: it was empty after the last. Else after an earlier one, or never.
    oldest = np.minimum(seen - profile.to_wake_ns, made) - wake_ns - _SLACK_NS
    return oldest - np.where(read < most, 0, steps), busy


def _anew(before: _Sample, after: _Sample) -> bool:
    """Tell whether a count began anew between two samples."""
    return before.instance != after.instance or after.count < before.count


def _reset(sources: Sources, endpoint: int, before: _Sample, after: _Sample) -> bool:
    """Tell whether a CI was told to set its counters to 0 between two samples of one boot."""
    rows = sources.rows
    told = (rows.destination == endpoint) & (rows.known_id == command_ingest.COMMAND_MSG_ID)
    told &= rows.function_code == command_ingest.RESET_COUNTERS
    told &= (rows.time_ns > before.seen_ns - _LATE_NS) & (rows.time_ns < after.seen_ns)
    return before.instance == after.instance and bool(told.any())


def _older(low: NDArray[np.int64], high: NDArray[np.int64]) -> int:
    """Return how many fewer a first count has than were sent: 0 where all it counts can be in the capture."""
    if low[0] <= 0 <= high.min():
        return 0
    later = np.flatnonzero(np.maximum.accumulate(low) > np.minimum.accumulate(high))
    return int(high[: later[0] if len(later) else None].min())


def _most_older(sources: Sources, endpoint: int, sent_ns: NDArray[np.int64], own: Sequence[_Sample]) -> int:
    """Return the most that a first count can have fewer than were sent: CI takes one after the other.

    Until a first sample it took no more than it can read in that time. Until the first command of the capture
    came out it took none that was sent later: what it read was sent before the capture began.
    """
    profile, first = sources.profile, own[0]
    since_ns = int(sent_ns[0]) if len(sent_ns) else first.seen_ns
    wakes = 2 + (first.seen_ns - since_ns) // profile.ci_wake_ns
    most = profile.ci_datagrams_per_wake * max(0, wakes) - first.count
    out_ns, went_ns = sources.first_out.get(endpoint, (0, 0))
    until = [item for item in own if item.seen_ns <= out_ns]
    if until:
        most = min(most, int(np.searchsorted(sent_ns, went_ns, "right")) - until[-1].count)
    return most


def _first(sources: Sources, sample: _Sample, sent_ns: NDArray[np.int64]) -> tuple[Cause, int]:
    """Return what lost datagrams that were sent before a first count and that it does not have, from when on.

    Mission time begins at a known value, which gives the moment of boot: before it nobody listened.
    """
    since_ns = int(sent_ns[0]) - 1 if len(sent_ns) else sample.seen_ns
    boot_ns = sources.instances.items[sample.instance].boot_ns(sources.profile)
    return ("down" if since_ns < boot_ns < sample.seen_ns else "network"), since_ns


def _unseen(sources: Sources, endpoint: int, sent_ns: NDArray[np.int64], sample: _Sample) -> int | None:
    """Return how many datagrams were sent before a first count and did not come out; None where unknown."""
    arrived = sources.arrived_ns.get(endpoint)
    if arrived is None:
        return None
    sent, came = (int(np.searchsorted(times, sample.seen_ns, "right")) for times in (sent_ns, arrived))
    return sent - came


def _ended_ns(sources: Sources, endpoint: int, last: _Sample, first: _Sample) -> int:
    """Return until when a CI read that then started again."""
    if last.instance != first.instance:
        ended_ns = max(last.seen_ns, sources.instances.items[last.instance].last_ns)
    else:
        between = _told_ns(sources, last.seen_ns - SECOND, first.seen_ns)
        ended_ns = max(between, default=last.seen_ns)
    arrived = sources.arrived_ns.get(endpoint)
    if arrived is None:
        return ended_ns
    # What came out again was read: it ended where nothing does for the longest time.
    begin_ns = last.seen_ns - SECOND
    inside = arrived[(arrived > begin_ns) & (arrived < first.seen_ns)]
    bounds = np.concatenate(([begin_ns], inside, [first.seen_ns]))
    hole = int(np.diff(bounds).argmax())
    return int(bounds[hole]) if hole else min(ended_ns, int(bounds[1]))


def _most_read(profile: SimProfile, own: Sequence[_Sample], until_ns: int) -> int:
    """Return how many datagrams a CI can have read until a time: what it counted, and its best rate."""
    seconds = max(0, until_ns - own[-1].made_ns) / SECOND
    rates = [profile.ci_datagrams_per_wake * SECOND / profile.ci_wake_ns]
    rates += [
        (later.count - sooner.count) * SECOND / max(1, later.made_ns - sooner.made_ns)
        for sooner, later in pairwise(own)
    ]
    return own[-1].count + ceil(seconds * max(rates)) + 2 * profile.ci_datagrams_per_wake


@dataclass(frozen=True, slots=True)
class _Run:
    """Samples of one count: when seen, and the least and most that was lost until then (rules 1 to 3).

    ``drained`` tells which read fewer than a wake-up can, ``busy`` which read nearly all that they can; more
    than ``many`` wait in a socket that gets full.
    ``unread`` were sent before the first count and did not come out: lost, or a CI read them that restarted;
    None where nothing shows what comes out.
    """

    seen: NDArray[np.int64]
    low: NDArray[np.int64]
    high: NDArray[np.int64]
    drained: NDArray[np.bool_]
    busy: NDArray[np.bool_]
    many: int
    unread: int | None


@dataclass(slots=True)
class _Level:
    """Samples in a row that one number of lost datagrams fits: at least ``low``, at most ``high``."""

    first: int
    low: int
    high: int


def _levels(run: _Run, lost: int, most: int) -> tuple[list[_Level], int]:
    """Divide a run into as few levels as fit, and count what CI read and the capture does not show."""
    shown_less = 0
    levels = [_Level(0, int(run.low[0]), min(int(run.high[0]), most))]
    for at in range(len(run.low)):
        level = levels[-1]
        least, high = max(level.low, lost), int(run.high[at])
        shown_less = max(shown_less, least - high)
        low, high = int(run.low[at]) + shown_less, high + shown_less
        if low > level.high:
            levels.append(_Level(at, low, high))
        else:
            level.low, level.high = max(level.low, low), min(level.high, high)
    return levels, shown_less


def _follow(account: Ingest, run: _Run, lost: int, begin: tuple[Cause, int]) -> int:
    """Go through a run, add what is lost in it to the account; return all that is lost until its end."""
    # What a first count does not have is older than the capture.
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
                # Rule 5: a socket that is full held many before.
                since = slice(last, level.first + 1)
                full = int(run.high[since].max()) - number > run.many
                cause = "socket" if full or run.busy[since].mean() > _MOSTLY else "network"
                since_ns = int(run.seen[last])
                missing_first = int(run.high[: level.first].min())
                if not account.losses and run.unread is not None:
                    # As far as its counts tell, these were missing at the first of them already.
                    lost += max(0, min(run.unread, number - lost, missing_first))
                elif not account.losses and {cause, begin[0]} == {"network"} and missing_first >= number:
                    cause, since_ns = "unknown", begin[1]
            until_ns = int(run.seen[level.first])
            if number > lost:
                account.add(Before(cause, number - lost, min(since_ns, until_ns), until_ns))
        lost = number
    if account.losses[-1:] != before:
        account.losses[-1] = replace(account.losses[-1], more=max(0, levels[-1].high - lost))
    return lost
