"""Which cFS instance made a telemetry packet: instances on one host share addresses, but never a boot time.

Capture time minus mission time is the same for all packets of one boot, except for their delays (about a
second). If two offsets differ by more, they are from different boots, or a clock was set.

Two cFS may have the same processor number and may have started together. What is sent from two addresses is
from two cFS, whatever names they use. Two boots are of one cFS if address and name are the same, and one
follows the other; so do the ports of a Telemetry Output that restarts. Two that send at the same time are two
cFS.
"""

from __future__ import annotations

from collections import Counter
from functools import cached_property
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from edoras_tools.diagnosis.evidence.preparation import handed_on
from edoras_tools.diagnosis.evidence.table import Rows, number_hosts, peer_of
from edoras_tools.sessions.sequence import BOOT_APART_NS, MODULUS
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe
from edoras_tools.wire.arrays.order import by_value, distinct, distinct_rows, groups, numbered

if TYPE_CHECKING:
    from collections.abc import Hashable, Sequence

    from numpy.typing import NDArray

    from edoras_tools.cfs.profile import SimProfile
    from edoras_tools.diagnosis.evidence.payloads import EventRecord
    from edoras_tools.model import Endpoint
    from edoras_tools.wire.arrays.order import Integers, Mask, Places

_LEAST_ROWS: Final = 3
_BASELINE_NS: Final = 5 * SECOND
"""In so long some packet is quick, and no clock drifts much."""
NOBODY: Final = -1


class Instance(NamedTuple):
    """One boot of one cFS.

    Attributes:
        name: its spacecraft and processor, as ``66:1``; empty where nothing in the capture says.
        offset_ns: capture time minus mission time, less the shortest delay.
        first_ns: its first packet here.
        last_ns: its last packet here.
        host: the address that it sends from, as a number; all boots of one cFS have it.
    """

    name: str
    offset_ns: int
    first_ns: int
    last_ns: int
    host: int

    def boot_ns(self, profile: SimProfile) -> int:
        """Return when it began, in capture time: its clock starts at a time that the profile has."""
        return self.offset_ns + profile.boot_time_s * SECOND


class Instances:
    """The instances of a capture.

    Args:
        endpoints: what ``source`` and ``destination`` of the rows index.

    Attributes:
        items: them, by offset.
        systems: a number each: boots of one cFS have the same.
        hosts: i32, endpoint to the number of its address.
        addresses: the address of each number.
        of_row: i32, the instance that made each row's packet; ``NOBODY`` where the packet has no time.
        made_ns: i64, when each row's packet was made, in capture time; of one without a time, when captured.
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
        for _, part in by_value(np.searchsorted(begins, offset, side="right")):
            for members in _publishers(rows, timed[part], says, self.hosts):
                if len(members) and (index := self._waited(rows, members)) != NOBODY:
                    self.of_row[members] = index
                elif len(members) >= _LEAST_ROWS:
                    self._add(rows, members, says)
        self.systems = self._find_systems()
        self._owners = self._find_owners(rows)
        self._first_output: dict[int, int] = {}
        for source, owners in self._owners.items():
            if len(mine := {index for _, index in owners}) == 1 and NOBODY not in mine:
                self._first_output.setdefault(mine.pop(), source)
        self.made_ns = self._when_made(rows)

    def _waited(self, rows: Rows, members: Places) -> int:
        """Return the instance that made packets, stood still, and then sent them; else ``NOBODY``."""
        first_ns, last_ns = int(rows.time_ns[members].min()), int(rows.time_ns[members].max())
        if last_ns - first_ns > BOOT_APART_NS:
            return NOBODY
        offset = int(rows.delay_ns(members).min())
        sources = np.unique(rows.source[members])
        for index, item in enumerate(self.items):
            if not item.first_ns < first_ns <= last_ns < item.last_ns:
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
        # Who hands on others' packets does so through Telemetry Output: on SBN everyone speaks for himself.
        own = members[rows.on(lambda link: link.peers, members)]
        if not len(own):
            events = members[rows.known_id[members] == cfe.EVENT_MSG_ID]
            own = np.array([row for row in events.tolist() if row in says], np.intp)
        host = int(np.bincount(self.hosts[rows.source[own if len(own) else members]]).argmax())
        self.items.append(Instance(name, offset, int(times.min()), int(times.max()), host))

    def _find_systems(self) -> list[int]:
        """Number the cFS: an address and a name, or an address alone where only one cFS has it."""
        names: dict[int, set[str]] = {}
        for item in self.items:
            names.setdefault(item.host, set()).add(item.name)
        whose = []
        for item in self.items:
            others = names[item.host] - {""}
            whose.append((item.host, item.name or (next(iter(others)) if len(others) == 1 else "")))
        followed = _in_turn(whose, [(item.first_ns, item.last_ns) for item in self.items])
        index: dict[tuple[int, str, int], int] = {}
        return [index.setdefault((*who, turn), len(index)) for who, turn in zip(whose, followed, strict=True)]

    def system(self, instance: int) -> int:
        """Return the number of the cFS of an instance; 0 for nobody."""
        return self.systems[instance] if instance != NOBODY else 0

    def label(self, instance: int) -> str:
        """Return an instance's name for the user, with address and port if another cFS has the same ones."""
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
        """The cFS that have a name at an address; None: at any."""
        systems: dict[tuple[str, int | None], set[int]] = {}
        for item, system in zip(self.items, self.systems, strict=True):
            systems.setdefault((item.name, item.host), set()).add(system)
            systems.setdefault((item.name, None), set()).add(system)
        return systems

    @staticmethod
    def _name(rows: Rows, members: Places, says: dict[int, str]) -> str:
        """Return an instance's own name: from its events, else as SBN sender."""
        events = members[rows.known_id[members] == cfe.EVENT_MSG_ID]
        names = Counter(says[row] for row in events.tolist() if row in says)
        if names:
            return names.most_common(1)[0][0]
        network = members[rows.on(lambda link: link.peers, members)]
        return rows.usual_sender(network)[0] if len(network) else ""

    def _when_made(self, rows: Rows) -> Integers:
        """Return when each packet was made, in capture time, by the quickest of its time: clocks drift."""
        made_ns = rows.time_ns.copy()
        for _, own in groups(self.of_row, np.flatnonzero(self.of_row != NOBODY)):
            delay = rows.delay_ns(own)
            window = (rows.time_ns[own] - rows.time_ns[own].min()) // _BASELINE_NS
            # Of the windows in which something came: times that are garbled may lie centuries apart.
            windows, _, window = distinct_rows(window)
            least = np.full(len(windows) + 2, np.iinfo(np.int64).max)
            np.minimum.at(least, window + 1, delay)
            apart = np.concatenate(([True], np.diff(windows) > 1, [True]))
            before = np.where(apart[:-1], least[1:-1], least[:-2])
            after = np.where(apart[1:], least[1:-1], least[2:])
            quickest = np.minimum(np.minimum(before, after), least[1:-1])
            made_ns[own] -= delay - quickest[window]
        return made_ns

    def _find_owners(self, rows: Rows) -> dict[int, list[tuple[int, int]]]:
        """Find the instance that owns each telemetry socket: events never come from another instance."""
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

    def output(self, source: int) -> int:
        """Return where Telemetry Output first sent from, if it restarted and has another port now."""
        mine = {index for _, index in self._owners.get(source, [])}
        return self._first_output.get(mine.pop(), source) if len(mine) == 1 else source

    def owner(self, source: int, time_ns: int) -> int:
        """Return the instance whose Telemetry Output sends from an endpoint at a time, or ``NOBODY``."""
        return int(self.owners(np.array([source]), np.array([time_ns]))[0])

    def owners(self, source: NDArray[np.int32], time_ns: NDArray[np.int64]) -> NDArray[np.int32]:
        """Return ``owner`` of many endpoints, each at a time."""
        out = np.full(len(source), NOBODY, np.int32)
        for place, rows in by_value(source):
            if owners := self._owners.get(place):
                starts, numbers = np.array(owners).T
                out[rows] = numbers[np.maximum(np.searchsorted(starts, time_ns[rows], side="right") - 1, 0)]
        return out

    def named(self, name: str, time_ns: int, source: int) -> int:
        """Return the instance of a name that was there at a time; the nearest where none was.

        Args:
            name: spacecraft and processor, as ``66:1``.
            source: the endpoint that speaks for it: of two of one name, the one of its address is meant.
        """
        fits = [index for index, item in enumerate(self.items) if item.name == name]
        return self._nearest(fits, source, time_ns) if fits else NOBODY

    def system_at(self, endpoint: int, time_ns: int) -> int:
        """Return the cFS that takes what is sent to an endpoint: of its address, nearest in time."""
        if len(set(self.systems)) < 2:
            return self.systems[0] if self.systems else 0
        return self.systems[self._nearest(range(len(self.items)), endpoint, time_ns)]

    def _nearest(self, fits: Sequence[int], endpoint: int, time_ns: int) -> int:
        """Return which of some instances is nearest in time: of those at an address, if any is there."""
        near = [index for index in fits if self.items[index].host == self.hosts[endpoint]]

        def away(index: int) -> int:
            item = self.items[index]
            return max(item.first_ns - time_ns, time_ns - item.last_ns, 0)

        return min(near or fits, key=away)

    def saying(self, event: EventRecord) -> int:
        """Return the instance that said something, by the packet's time, else by the name in it."""
        instance = int(self.of_row[event.row])
        if instance != NOBODY:
            return instance
        return self.named(event.sender, event.time_ns, int(self._source[event.row]))


def _in_turn(whose: Sequence[Hashable], spans: Sequence[tuple[int, int]]) -> list[int]:
    """Number those that speak for one at the same time: of those that do so in turn each has 0.

    Args:
        whose: for whom each speaks.
        spans: from when to when.
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
    """Divide the rows of one boot time by instance, if two instances have this boot time."""
    output = members[rows.on(lambda link: link.only_from_cfs, members)]
    places = distinct(hosts[rows.source[output]])
    network = members[rows.on(lambda link: link.peers, members)]
    sender = rows.sbn_sender(network)
    if max(len(places), len(distinct(sender))) < 2 and not _conflict(rows, members):
        return [members]
    first, who = numbered(hosts[rows.source[network]], sender)
    places = hosts[rows.source[network[first]]]
    names = list(zip(places.tolist(), [str(peer_of(item)) for item in sender[first].tolist()], strict=True))
    # What a Telemetry Output sends is its own, or was handed on and crossed SBN before.
    from_ = handed_on(rows, network, output)
    events = output[rows.known_id[output] == cfe.EVENT_MSG_ID]
    owner = {int(rows.source[row]): says[row] for row in events.tolist() if row in says}
    first, port = numbered(rows.source[output])
    peers = tuple(names)
    quickest = np.array([rows.delay_ns(network[who == at]).min() for at in range(len(peers))])
    senders = []
    for source in rows.source[output[first]].tolist():
        near = {name for host, name in peers if host == hosts[source]}
        # Where two are in what it sends, it hands on what the one on SBN made.
        alone = len(near) == 1 and not _conflict(rows, output[rows.source[output] == source])
        mine = rows.delay_ns(output[(rows.source[output] == source) & (from_ < 0)])
        if len(near) > 1 and len(mine):  # the one whose clock it goes by
            away = np.abs(quickest - mine.min())
            nearest = np.argsort(away)
            if alone := bool(away[nearest[1]] - away[nearest[0]] > SECOND):
                near = {peers[nearest[0]][1]}
        name = owner.get(source) or (near.pop() if alone else f"from {source}")
        senders.append((int(hosts[source]), name))
    times = [rows.time_ns[output[port == at]] for at in range(len(first))]
    turns = _in_turn(senders, [(int(item.min()), int(item.max())) for item in times])
    names += [
        (host, f"{name} {turn}" if turn else name) for (host, name), turn in zip(senders, turns, strict=True)
    ]
    label = np.concatenate((who, len(peers) + port))
    label[len(who) :][from_ >= 0] = who[from_[from_ >= 0]]
    _hand_on_unseen(rows, output, label[len(who) :], from_ >= 0)
    rows_of = np.concatenate((network, output))
    order = {name: at for at, name in enumerate(sorted(set(names)))}
    of_name = np.array([order[name] for name in names])[label]
    return [np.sort(rows_of[of_name == index]) for index in distinct(of_name).tolist()]


def _hand_on_unseen(rows: Rows, output: Places, label: Places, on_sbn: Mask) -> None:
    """Give what the capture lacks on SBN to the peer whose counts leave room for it, and not its sender's.

    Args:
        output: rows that a Telemetry Output sent.
        label: who made each; those of a peer that were not seen before become its own.
        on_sbn: which were seen on SBN before.
    """
    made_ns, count = rows.mission_time_ns[output], rows.sequence_count[output].astype(np.int64)
    _, kind = numbered(rows.source[output], rows.msg_id[output])

    def astray(some: Places, of: Places) -> NDArray[np.float64]:
        """Return how far the counts of some are from those around them in time; without end where beyond."""
        own = of[np.argsort(made_ns[of], kind="stable")]
        first, last = (np.searchsorted(made_ns[own], made_ns[some], side) for side in ("left", "right"))
        before, behind = own[np.maximum(first - 1, 0)], own[np.minimum(last, len(own) - 1)]
        ahead, step = ((count[at] - count[before]) % MODULUS for at in (some, behind))
        share = (made_ns[some] - made_ns[before]) / np.maximum(1, made_ns[behind] - made_ns[before])
        fits = (first > 0) & (last < len(own)) & (ahead > 0) & (ahead < step) & (step < MODULUS // 2)
        return np.where(fits, np.abs(ahead - share * step), np.inf)

    for _, pair in groups(kind * (int(label.max(initial=0)) + 1) + label, np.flatnonzero(on_sbn)):
        for most in (1, np.inf):  # those first of which it is sure: they stand among its sender's
            other = np.flatnonzero(~on_sbn & (kind == kind[pair[0]]) & (label != label[pair[0]]))
            far = astray(other, pair)
            own = np.isfinite(far) & (far <= most) & (far <= astray(other, other) + 1)
            label[other[own]] = label[pair[0]]


def _conflict(rows: Rows, members: Places) -> bool:
    """Tell whether 0x803 comes with one count and different contents: two instances make it.

    Where frames are cut, less is left of it on one link than on another, and that is no other content.
    """
    counters = members[rows.known_id[members] == cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID]
    _, content = numbered(rows.sequence_count[counters], rows.packet_length[counters])
    different, _ = numbered(content, rows.packet_print[counters])
    counts = np.bincount(content[different])
    return int((counts > 1).sum()) > int((counts > 0).sum()) // 4
