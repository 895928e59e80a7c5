"""Finds the cFS instance that made each telemetry packet. An instance is one boot of one cFS.

Rules:

1. The offset of a packet is its capture time minus its mission time. All packets of one boot have the same
   offset, except for delays of about a second. If offsets differ by more, the boots differ, or a clock was
   set.
2. Instances on one host share its address, but rarely a boot time. Two cFS may have the same processor
   number, and may have started together.
3. Packets from two addresses are from two cFS, whatever their names.
4. Two boots belong to one cFS (a system) if address and name are the same, and one follows the other. Two
   that send at the same time are two systems. The same holds for ports of a Telemetry Output that restarts.
"""

from __future__ import annotations

from collections import Counter
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from edoras_tools.cfs import command_ingest
from edoras_tools.diagnosis.evidence.preparation import handed_on
from edoras_tools.diagnosis.evidence.table import Rows, number_hosts, peer_of
from edoras_tools.sessions.sequence import BOOT_APART_NS, MODULUS
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe
from edoras_tools.wire.arrays import by_key, by_value, distinct, distinct_rows, groups, numbered

if TYPE_CHECKING:
    from collections.abc import Hashable, Sequence

    from numpy.typing import NDArray

    from edoras_tools.cfs.profile import SimProfile
    from edoras_tools.diagnosis.evidence.payloads import EventRecord
    from edoras_tools.model import Endpoint
    from edoras_tools.wire.arrays import Integers, Mask, Places

_LEAST_ROWS: Final = 3
_BASELINE_NS: Final = 5 * SECOND
"""Window in which at least one packet has a short delay, and no clock drifts much."""
_SAMPLE: Final = 10_000
NOBODY: Final = -1
_HOUSEKEEPING: Final = 0x0800, 0x0801, 0x0803, 0x0804, 0x0805
"""Packets that each cFE makes once in a second, or less often: no sequence count comes again soon."""


class Instance(NamedTuple):
    """One boot of one cFS.

    Attributes:
        name: spacecraft and processor, as ``66:1``; empty if the capture does not show it.
        offset_ns: smallest offset (capture time minus mission time) of its packets.
        first_ns: capture time of its first packet.
        last_ns: capture time of its last packet.
        host: number of the address that it sends from; equal for all boots of one cFS.
    """

    name: str
    offset_ns: int
    first_ns: int
    last_ns: int
    host: int

    def boot_ns(self, profile: SimProfile) -> int:
        """Return the capture time of its boot, ns; the profile has the mission time at a boot."""
        return self.offset_ns + (profile.boot_met_s + profile.epoch_offset_s) * SECOND


class Instances:
    """The instances of a capture.

    Args:
        rows: table of datagrams.
        events: events in these rows; they name their instance.
        endpoints: endpoints that ``source`` and ``destination`` of the rows index.

    Attributes:
        items: instances, in the order of their offsets.
        systems: number of the cFS of each instance; equal for boots of one cFS.
        hosts: i32, number of the address of each endpoint.
        addresses: address of each number.
        of_row: i32 (rows,), index of the instance that made the packet; ``NOBODY`` if unknown.
        made_ns: i64 (rows,), capture time at which the packet was made; the time of capture if unknown.
    """

    def __init__(self, rows: Rows, events: Sequence[EventRecord], endpoints: Sequence[Endpoint]) -> None:
        self.hosts = number_hosts(endpoints)
        self.addresses = list(dict.fromkeys(item.address for item in endpoints))
        self._ports = [item.port for item in endpoints]
        self.of_row = np.full(len(rows), NOBODY, np.int32)
        self.items: list[Instance] = []
        self._source = rows.source
        timed = np.flatnonzero(rows.timed)
        offset = rows.delay_ns(timed)
        ranked = np.sort(offset)
        begins = ranked[1:][np.diff(ranked) > BOOT_APART_NS]
        says = {event.row: event.sender for event in events}
        group = _part_returns(rows, timed, np.searchsorted(begins, offset, side="right"), self.hosts)
        for _, part in by_value(group):
            for members in _publishers(rows, timed[part], says, self.hosts):
                if len(members) and (index := self._waited(rows, members)) != NOBODY:
                    self.of_row[members] = index
                elif len(members) >= _LEAST_ROWS:
                    self._add(rows, members, says)
        self.systems = self._find_systems()
        self._owners = self._find_owners(rows)
        self._first_output = self._find_outputs(rows)
        self.made_ns = self._when_made(rows)

    def _waited(self, rows: Rows, members: Places) -> int:
        """Return the instance that sent these packets late, after it had stood still; else ``NOBODY``."""
        first_ns, last_ns = int(rows.time_ns[members].min()), int(rows.time_ns[members].max())
        if last_ns - first_ns > BOOT_APART_NS:
            return NOBODY
        offset = int(rows.delay_ns(members).min())
        sources = np.unique(rows.source[members])
        for index, item in enumerate(self.items):
            if not item.first_ns - BOOT_APART_NS < first_ns <= last_ns < item.last_ns:
                continue
            alike = (self.of_row == index) & np.isin(rows.source, sources)
            since_ns = first_ns - (offset - item.offset_ns) + BOOT_APART_NS
            if alike.any() and not (alike & (rows.time_ns > since_ns) & (rows.time_ns < first_ns)).any():
                return index
        return NOBODY

    def _add(self, rows: Rows, members: Places, says: dict[int, str]) -> None:
        self.of_row[members] = len(self.items)
        times = rows.time_ns[members]
        offset = int(rows.delay_ns(members).min())
        name = self._name(rows, members, says)
        # Telemetry Output also forwards packets of other cFS; on SBN each cFS sends only its own.
        own = members[rows.on(lambda link: link.peers, members)]
        if not len(own):
            events = members[rows.known_id[members] == cfe.EVENT_MSG_ID]
            own = np.array([row for row in events.tolist() if row in says], np.intp)
        host = int(np.bincount(self.hosts[rows.source[own if len(own) else members]]).argmax())
        self.items.append(Instance(name, offset, int(times.min()), int(times.max()), host))

    def _find_systems(self) -> list[int]:
        """Return the number of the cFS of each instance, by address and name (rule 4)."""
        hosts = by_key(self.items, lambda item: item.host).items()
        names = {host: {item.name for item in own} - {""} for host, own in hosts}
        sole = {host: max(own) if len(own) == 1 else "" for host, own in names.items()}
        whose = [(item.host, item.name or sole[item.host]) for item in self.items]
        followed = _in_turn(whose, [(item.first_ns, item.last_ns) for item in self.items])
        index: dict[tuple[int, str, int], int] = {}
        return [index.setdefault((*who, turn), len(index)) for who, turn in zip(whose, followed, strict=True)]

    @cached_property
    def system_of_row(self) -> Integers:
        """The number of the cFS that made each row: i64 (rows,); ``NOBODY`` if unknown."""
        return np.array([*self.systems, NOBODY])[self.of_row]

    def system(self, instance: int) -> int:
        """Return the number of the cFS of an instance; 0 for ``NOBODY``."""
        return self.systems[instance] if instance != NOBODY else 0

    def label(self, instance: int) -> str:
        """Return the label of an instance for people, with address and ports if the name is not unique."""
        item, where = self.items[instance], ""
        if self.others_named(instance):
            where = f" at {self.addresses[item.host]}"
            if len(self._systems_at[item.name, item.host]) > 1:
                ports = {
                    self._ports[source]
                    for source, owners in self._owners.items()
                    if any(self.systems[one] == self.systems[instance] for _, one in owners if one != NOBODY)
                }
                where += f", which sends from {' and '.join(map(str, sorted(ports)))}" if ports else ""
        return (f"cFS {item.name}" if item.name else "cFS") + where

    def others_named(self, instance: int) -> bool:
        """Return whether another cFS has the name of an instance."""
        return len(self._systems_at[self.items[instance].name, None]) > 1

    @cached_property
    def _systems_at(self) -> dict[tuple[str, int | None], set[int]]:
        """(name, number of the address, or None for any) to the numbers of the cFS."""
        systems: dict[tuple[str, int | None], set[int]] = {}
        for item, system in zip(self.items, self.systems, strict=True):
            systems.setdefault((item.name, item.host), set()).add(system)
            systems.setdefault((item.name, None), set()).add(system)
        return systems

    @staticmethod
    def _name(rows: Rows, members: Places, says: dict[int, str]) -> str:
        """Return an instance's name: from its events, else from its SBN headers."""
        events = members[rows.known_id[members] == cfe.EVENT_MSG_ID]
        if names := Counter(says[row] for row in events.tolist() if row in says):
            return names.most_common(1)[0][0]
        network = members[rows.on(lambda link: link.peers, members)]
        return rows.usual_sender(network)[0] if len(network) else ""

    def _when_made(self, rows: Rows) -> Integers:
        """Return ``made_ns``: delays are measured from the quickest packet nearby, because clocks drift.

        If a clock goes back though sequence counts go on, packets are taken to be made when they come.
        """
        made_ns = rows.time_ns.copy()
        every = groups(self.of_row, np.flatnonzero(self.of_row != NOBODY))
        for own in (own for _, own in every if not _clock_goes_back(rows, own)):
            delay = rows.delay_ns(own)
            window = (rows.time_ns[own] - rows.time_ns[own].min()) // _BASELINE_NS
            # Only windows with packets: garbled times may lie centuries apart.
            windows, _, window = distinct_rows(window)
            least = np.full(len(windows) + 2, np.iinfo(np.int64).max)
            np.minimum.at(least, window + 1, delay)
            apart = np.concatenate(([True], np.diff(windows) > 1, [True]))
            before = np.where(apart[:-1], least[1:-1], least[:-2])
            after = np.where(apart[1:], least[1:-1], least[2:])
            made_ns[own] -= delay - np.min((before, after, least[1:-1]), axis=0)[window]
        return made_ns

    def _find_owners(self, rows: Rows) -> dict[int, list[tuple[int, int]]]:
        """Return endpoint to (time in ns, instance) of its owners: a TO sends events only of its own cFS."""
        owners: dict[int, list[tuple[int, int]]] = {}
        telemetry = rows.on(lambda link: link.only_from_cfs) & (self.of_row != NOBODY)
        for source, own in groups(rows.source, np.flatnonzero(telemetry)):
            events = own[rows.known_id[own] == cfe.EVENT_MSG_ID]
            publishers = self.of_row[events if len(events) else own]
            values, first, counts = np.unique(publishers, return_index=True, return_counts=True)
            if len(events):
                times = rows.time_ns[events[first]]
                owners[source] = sorted(zip(times.tolist(), values.tolist(), strict=True))
            else:
                owners[source] = [(0, int(values[counts.argmax()]))]
        return owners

    def _find_outputs(self, rows: Rows) -> dict[int, int]:
        """Return endpoint to the first endpoint of its Telemetry Output; two that send at once are two."""
        alone = {source: own[0][1] for source, own in self._owners.items() if len({at for _, at in own}) == 1}
        members = dict(by_value(rows.source))
        times = [rows.time_ns[members[source]] for source in alone]
        turns = _in_turn([*alone.values()], [(int(own.min()), int(own.max())) for own in times])
        first: dict[tuple[int, int], int] = {}
        pairs = zip(alone.items(), turns, strict=True)
        return {source: first.setdefault((index, turn), source) for (source, index), turn in pairs}

    def output(self, source: int) -> int:
        """Return the first endpoint of a Telemetry Output that restarted and changed its port."""
        return self._first_output.get(source, source)

    def owner(self, source: int, time_ns: int) -> int:
        """Return the instance whose Telemetry Output sends from an endpoint at a time, or ``NOBODY``."""
        return int(self.owners(np.array([source]), np.array([time_ns]))[0])

    def owners(self, source: NDArray[np.int32], time_ns: NDArray[np.int64]) -> NDArray[np.int32]:
        """Return ``owner`` of n endpoints, each at a time: i32 (n,)."""
        out = np.full(len(source), NOBODY, np.int32)
        for place, rows in by_value(source):
            if owners := self._owners.get(place):
                starts, numbers = np.array(owners).T
                out[rows] = numbers[np.maximum(np.searchsorted(starts, time_ns[rows], side="right") - 1, 0)]
        return out

    def named(self, name: str, time_ns: int, source: int) -> int:
        """Return the instance with a name that is nearest to a time; ``NOBODY`` if none has the name.

        Args:
            name: spacecraft and processor, as ``66:1``.
            time_ns: capture time.
            source: endpoint of its sender, which decides between two instances of one name.
        """
        fits = [index for index, item in enumerate(self.items) if item.name == name]
        return self._nearest(fits, source, time_ns) if fits else NOBODY

    def system_at(self, endpoint: int, time_ns: int) -> int:
        """Return the number of the cFS that receives at an endpoint: by address, then nearest in time."""
        if len(set(self.systems)) < 2:
            return self.systems[0] if self.systems else 0
        return self.systems[self._nearest(range(len(self.items)), endpoint, time_ns)]

    def _nearest(self, fits: Sequence[int], endpoint: int, time_ns: int) -> int:
        """Return the instance nearest in time, among those at the endpoint's address if there are any."""
        near = [index for index in fits if self.items[index].host == self.hosts[endpoint]]
        # Each processor of the lab has a port of its own for its CI.
        processor = f":{self._ports[endpoint] - command_ingest.PORT + 1}"

        def away(index: int) -> tuple[int, bool]:
            item = self.items[index]
            away_ns = max(item.first_ns - time_ns, time_ns - item.last_ns, 0)
            return away_ns, not item.name.endswith(processor)

        return min(near or fits, key=away)

    def saying(self, event: EventRecord) -> int:
        """Return the instance that sent an event, by the packet's time, else by the name in it."""
        instance = int(self.of_row[event.row])
        if instance != NOBODY:
            return instance
        return self.named(event.sender, event.time_ns, int(self._source[event.row]))


def _part_returns(rows: Rows, timed: Places, group: Places, hosts: NDArray[np.int32]) -> Places:
    """Return the groups of rows, with a group parted where another one took its place for a time.

    Then a clock was set, and set back: two cFS would send at the same time.

    Args:
        rows: table of datagrams.
        timed: rows with a mission time.
        group: number of the group of each of these, by offset.
        hosts: number of the address of each endpoint.
    """
    for _, own in by_value(hosts[rows.source[timed]] if group.any() else timed[:0]):
        begin, times = np.flatnonzero(np.diff(group[own], prepend=-1)), rows.time_ns[timed[own]]
        end_ns = np.append(times[begin[1:]], times[-1])
        is_long = times[np.append(begin[1:], len(own)) - 1] - times[begin] > BOOT_APART_NS
        begin, end_ns = begin[is_long], end_ns[is_long]
        at_once = times[begin[1:]] - end_ns[:-1] < BOOT_APART_NS  # else two cFS sent in turns meanwhile
        past = set[int]()
        for (before, after), follows in zip(pairwise(begin.tolist()), at_once.tolist(), strict=True):
            past = {*past, int(group[own[before]])} if follows else set()
            again = int(group[own[after]])
            if again != group[own[before]] and again in past:
                later = own[(before + after) // 2 :]
                group[later[group[later] == again]] = group.max() + 1
    return group


def _in_turn(whose: Sequence[Hashable], spans: Sequence[tuple[int, int]]) -> list[int]:
    """Return numbers that distinguish members of one owner with overlapping spans.

    Members that follow each other have the same number: 0 unless another one overlaps.

    Args:
        whose: owner of each member.
        spans: first and last time of each member, ns.
    """
    ends: dict[Hashable, list[int]] = {}
    turns = [0] * len(spans)
    for at in sorted(range(len(spans)), key=lambda item: spans[item]):
        before = ends.setdefault(whose[at], [])
        free = [turn for turn, end_ns in enumerate(before) if spans[at][0] > end_ns - BOOT_APART_NS]
        turns[at] = free[0] if free else len(before)
        before[turns[at] : turns[at] + 1] = [spans[at][1]]
    return turns


def _publishers(rows: Rows, members: Places, says: dict[int, str], hosts: NDArray[np.int32]) -> list[Places]:
    """Return the rows of each instance that has this boot time; mostly it is one with all rows."""
    output = members[rows.on(lambda link: link.only_from_cfs, members)]
    network = members[rows.on(lambda link: link.peers, members)]
    sender = rows.sbn_sender(network)
    events = output[rows.known_id[output] == cfe.EVENT_MSG_ID]
    owner = {int(rows.source[row]): says[row] for row in events.tolist() if row in says}
    every = {*owner.values(), *(str(peer_of(item)) for item in distinct(sender).tolist())}
    if max(len(distinct(hosts[rows.source[output]])), len(every)) < 2 and not _conflict(rows, members):
        return [members]
    first, who = numbered(hosts[rows.source[network]], sender)
    places = hosts[rows.source[network[first]]]
    names = list(zip(places.tolist(), [str(peer_of(item)) for item in sender[first].tolist()], strict=True))
    # Telemetry Output sends packets of its own cFS, or forwards packets that crossed SBN before.
    from_, nameless = handed_on(rows, network, output), output[~np.isin(rows.source[output], [*owner])]
    ahead = handed_on(rows, nameless, network)
    crossed = np.flatnonzero(ahead >= 0)
    first, port = numbered(rows.source[output])
    for source, own in by_value(rows.source[nameless[ahead[crossed]]]):
        # What it sent before that crossed SBN is of its own cFS.
        owner[source] = names[np.bincount(who[crossed[own]]).argmax()][1]
    quickest = np.array([rows.delay_ns(network[who == at]).min() for at in range(len(names))])
    senders = []
    for source in rows.source[output[first]].tolist():
        near = {name for host, name in names if host == hosts[source]}
        # If two instances are among its packets, it forwards those of the instance on SBN.
        alone = len(near) == 1 and not _conflict(rows, output[rows.source[output] == source])
        mine = rows.delay_ns(output[(rows.source[output] == source) & (from_ < 0)])
        if len(near) > 1 and len(mine):  # its clock decides
            away = np.abs(quickest - mine.min())
            nearest = np.argsort(away)
            if alone := bool(away[nearest[1]] - away[nearest[0]] > SECOND):
                near = {names[nearest[0]][1]}
        name = owner.get(source) or (near.pop() if alone else f"from {source}")
        senders.append((int(hosts[source]), name))
    times = [rows.time_ns[output[port == at]] for at in range(len(first))]
    turns = _in_turn(senders, [(int(item.min()), int(item.max())) for item in times])
    label = np.concatenate((who, len(names) + port))
    names += [
        (host, f"{name} {turn}" if turn else name) for (host, name), turn in zip(senders, turns, strict=True)
    ]
    label[len(who) :][from_ >= 0] = who[from_[from_ >= 0]]
    _hand_on_unseen(rows, output, label[len(who) :], from_ >= 0)
    of_name = np.array([sorted(set(names)).index(name) for name in names])[label]
    rows_of = np.concatenate((network, output))
    return [np.sort(rows_of[of_name == index]) for index in distinct(of_name).tolist()]


def _hand_on_unseen(rows: Rows, output: Places, label: Places, on_sbn: Mask) -> None:
    """Assign forwarded packets, whose SBN datagrams were not captured, to the peer whose counts they fit.

    Args:
        output: rows that a Telemetry Output sent.
        label: number of the publisher of each row; changed in place.
        on_sbn: bool, the packet was also captured on SBN.
    """
    made_ns, count = rows.mission_time_ns[output], rows.sequence_count[output].astype(np.int64)
    _, kind = numbered(rows.source[output], rows.msg_id[output])

    def astray(some: Places, of: Places) -> NDArray[np.float64]:
        """Return how far counts are from those of neighbours in time; inf if they do not fit between."""
        own = of[np.argsort(made_ns[of], kind="stable")]
        first, last = (np.searchsorted(made_ns[own], made_ns[some], side) for side in ("left", "right"))
        before, behind = own[np.maximum(first - 1, 0)], own[np.minimum(last, len(own) - 1)]
        ahead, step = ((count[at] - count[before]) % MODULUS for at in (some, behind))
        share = (made_ns[some] - made_ns[before]) / np.maximum(1, made_ns[behind] - made_ns[before])
        fits = (first > 0) & (last < len(own)) & (ahead > 0) & (ahead < step) & (step < MODULUS // 2)
        return np.where(fits, np.abs(ahead - share * step), np.inf)

    for _, pair in groups(kind * (int(label.max(initial=0)) + 1) + label, np.flatnonzero(on_sbn)):
        for most in (1, np.inf):  # the clear cases first: the others are judged beside them
            other = np.flatnonzero(~on_sbn & (kind == kind[pair[0]]) & (label != label[pair[0]]))
            far = astray(other, pair)
            own = np.isfinite(far) & (far <= most) & (far <= astray(other, other) + 1)
            label[other[own]] = label[pair[0]]


def _conflict(rows: Rows, members: Places) -> bool:
    """Return whether housekeeping of one count has different contents: then two instances make it.

    Only packets of one length are compared, because cut frames leave parts of different length.
    """
    own = members[np.isin(rows.known_id[members], _HOUSEKEEPING)]
    every = len(own) // _SAMPLE + 1  # of very many some counts say as much
    own = own[rows.sequence_count[own] % every == 0]
    for _, packets in groups(rows.known_id, own):
        _, content = numbered(rows.sequence_count[packets], rows.packet_length[packets])
        different, _ = numbered(content, rows.packet_print[packets])
        counts = np.bincount(content[different])
        if int((counts > 1).sum()) > int((counts > 0).sum()) // 4:
            return True
    return False


def _clock_goes_back(rows: Rows, own: Places) -> bool:
    """Return whether a 0x803 of an instance has an earlier mission time than one with a lower sequence count.

    Events do not show that: two tasks that report at once may be counted in the other order.
    """
    for _, part in groups(rows.source, own[rows.known_id[own] == cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID]):
        count, when = rows.sequence_count[part].astype(np.int64), rows.mission_time_ns[part]
        steps, back = (count[1:] - count[:-1]) % MODULUS, when[1:] < when[:-1] - SECOND // 10
        if (back & (steps > 0) & (steps < MODULUS // 2)).any():
            return True
    return False
