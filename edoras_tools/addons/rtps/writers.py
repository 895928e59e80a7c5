"""The fates of the samples of each DDS writer, from the captured sequence numbers.

Rules:

1. A sample is identified by its writer and its sequence number, and counted once. Copies (sent again, or to
   several readers) are counted separately. Built-in endpoints are ignored.
2. Counting starts with the first captured sample of a writer. It ends with the last number that was captured
   or announced in a HEARTBEAT. Numbers in a GAP do not count: they were never to come.
3. A number in between that was not captured is
   ``given_up``, if a reader asked for it in vain and went on when the writer no longer had it (its HEARTBEATs
   began behind it, or a GAP removed it);
   ``unclear``, if a reader went on in this way without having asked;
   ``not_captured``, if a reader acknowledged it: it came on another way, or while nothing was captured;
   ``waiting``, if the writer is reliable and no reader has acknowledged it yet;
   ``missing``, if the writer is best effort: it was lost in front of the capture, or not captured.
4. A sample that a reader asked for (ACKNACK) was lost at first. It is ``behind`` if it had been captured by
   then: it was lost between the capture and the reader; else ``before``. If it was captured again, it was
       sent again.
   If the reader went on without it, and the writer no longer had it, it is ``given_up``.
5. Memory is limited: so are the numbers of writers, ranges and open requests. If the captured numbers of a
   writer form more than ``_MANY`` ranges, the older half is judged finally: later samples in it are copies.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from edoras_tools.addons.rtps.link import RTPS
from edoras_tools.addons.rtps.reader import UserSubmessages, user_submessages
from edoras_tools.addons.rtps.samples import READER
from edoras_tools.addons.rtps.wire import Announcement, SubmessageKind, guid_text
from edoras_tools.links.doors import MOST_ENDPOINTS, Endpoints, LinkEvidence, SampleStream
from edoras_tools.sessions.ranges import MOST_RANGES, KnownRanges

if TYPE_CHECKING:
    from edoras_tools.model import Columns, PacketBatch
    from edoras_tools.wire.arrays import Integers, Places

PRESENCE: Final = "ros_discovery_info"
"""Topic on which each ROS node announces its topics."""
MOST_READERS: Final = 1 << 10
"""Most readers of a writer; acknowledgements of further ones are ignored."""
MOST_ASKED: Final = 1 << 14
"""Most requested samples of a writer that are followed."""
FATES: Final = ("given_up", "unclear", "not_captured", "waiting", "missing", "lost_behind")
_MANY: Final = MOST_RANGES // 2
"""Number of ranges of captured numbers from which the older half is judged finally."""
_HIGHEST: Final = 1 << 62
"""Highest sound sequence number."""
_FARTHEST: Final = 1 << 32
"""Largest plausible step of a sequence number."""


class SampleWriter(msgspec.Struct, eq=False):
    """One writer, and the fates of its samples.

    Attributes:
        guid: GUID of the writer.
        first_ns: time of its first captured sample, ns since 1970; 0 before.
        last_ns: time of its last sample that is no copy, ns since 1970.
        longest_ns: longest time between two such samples, ns.
        first: first captured number, which need not be the lowest; None before.
        last: last number that is known to be written.
        sample_numbers: numbers of samples that were captured whole.
        irrelevant: numbers that will not come, from GAPs.
        copies: number of captured copies.
        available: first number that the writer still has, from its HEARTBEATs.
        reliable: whether it sends HEARTBEATs, or receives ACKNACKs.
        acknowledged: reader to the number before which it needs nothing.
        requested: numbers that readers asked for.
        behind: number of requested samples that had been captured before.
        open: requested number, not captured since, to the readers that wait for it.
        given_up: numbers that a reader asked for, and went on without.
        unclear: numbers that a reader went on without, and had not asked for.
        floor: number below which all are judged finally.
        settled: counts of the numbers below ``floor`` by fate.
    """

    guid: bytes
    first_ns: int = 0
    last_ns: int = 0
    longest_ns: int = 0
    first: int | None = None
    last: int = 0
    sample_numbers: KnownRanges = msgspec.field(default_factory=KnownRanges)
    irrelevant: KnownRanges = msgspec.field(default_factory=KnownRanges)
    copies: int = 0
    available: int = 0
    reliable: bool = False
    acknowledged: dict[bytes, int] = msgspec.field(default_factory=dict)
    requested: KnownRanges = msgspec.field(default_factory=KnownRanges)
    behind: int = 0
    open: dict[int, set[bytes]] = msgspec.field(default_factory=dict)
    given_up: KnownRanges = msgspec.field(default_factory=KnownRanges)
    unclear: KnownRanges = msgspec.field(default_factory=KnownRanges)
    floor: int = 0
    settled: Counter[str] = msgspec.field(default_factory=Counter)

    def add(self, submessages: UserSubmessages) -> None:
        """Add the submessages of a batch about this writer, in order of the capture."""
        sound = (submessages.first > 0) & (submessages.first < _HIGHEST) & (submessages.last < _HIGHEST)
        kind = np.where(sound | (submessages.kind == SubmessageKind.ACKNACK), submessages.kind, 0)
        data = np.flatnonzero(kind == SubmessageKind.DATA)
        beats = np.flatnonzero(kind == SubmessageKind.HEARTBEAT)
        gaps = np.flatnonzero(kind == SubmessageKind.GAP)
        acks = np.flatnonzero(kind == SubmessageKind.ACKNACK)
        if self.first is None and len(data):  # HEARTBEATs and ACKNACKs before the first sample do not count
            beats, acks = beats[beats > data[0]], acks[acks > data[0]]
        numbers = submessages.first[data]
        before = self.sample_numbers if not len(acks) else _copied(self.sample_numbers)
        if len(data):
            self._add_samples(numbers, submessages.time_ns[data])
        if self.first is not None:
            ends = [self.last, *submessages.last[beats].tolist()]
            self.last = max(item for item in ends if item <= self.last + _FARTHEST)
        self.reliable = self.reliable or bool(len(beats) or len(acks))
        for at in gaps.tolist():
            self._gap(submessages, at)
        had = self.available
        offered = np.maximum.accumulate(submessages.first[beats]) if len(beats) else np.zeros(0, np.int64)
        if len(acks) and self.first is not None:
            self._acknowledge(submessages, acks, before, (beats, offered, had))
        self.available = max(had, int(offered[-1]) if len(offered) else 0)

    def _add_samples(self, numbers: Integers, times: Integers) -> None:
        if self.first is None:
            self.first = self.floor = self.last = int(numbers[0])
            self.first_ns = self.last_ns = int(times[0])
        for at in range(0, len(numbers), _MANY // 2):
            some = numbers[at : at + _MANY // 2]
            near = some <= self.last + _FARTHEST
            some, moments = some[near], times[at : at + _MANY // 2][near]
            new = np.full(len(some), self.floor == self.first) | (some >= self.floor)
            self.copies += int(np.count_nonzero(~new))
            fresh = self.sample_numbers.fresh(some[new])
            self.copies += int(np.count_nonzero(~fresh))
            moments = np.append(self.last_ns, moments[new][fresh])
            self.longest_ns = max(self.longest_ns, int(np.diff(moments).max(initial=0)))
            self.last_ns = max(self.last_ns, int(moments[-1]))
            self.last = max(self.last, int(some.max(initial=0)))
            self.settle()
        if self.open:
            for number in set(numbers.tolist()) & self.open.keys():
                del self.open[number]

    def _gap(self, submessages: UserSubmessages, at: int) -> None:
        start, base = int(submessages.first[at]), int(submessages.last[at])
        if start < base:
            self.irrelevant.add(start, base)
        for number in submessages.numbers(at):
            self.irrelevant.add(number, number + 1)

    def _acknowledge(
        self,
        submessages: UserSubmessages,
        acks: Integers,
        before: KnownRanges,
        beats: tuple[Integers, Integers, int],
    ) -> None:
        """Process ACKNACKs in order: numbers that a reader asks for, and numbers that it no longer needs.

        Args:
            acks: indices of the ACKNACKs.
            before: samples captured in earlier batches.
            beats: indices of the HEARTBEATs; first available number of each; first available number from
                earlier batches.
        """
        first_at: dict[int, int] = {}
        last_at: dict[int, int] = {}
        for at in np.flatnonzero(submessages.kind == SubmessageKind.DATA).tolist():
            first_at.setdefault(int(submessages.first[at]), at)
            last_at[int(submessages.first[at])] = at
        places, offered, had = beats
        for at in acks.tolist():
            base, reader = int(submessages.first[at]), submessages.readers[int(submessages.reader[at])]
            low = self.acknowledged.get(reader)
            if low is None and len(self.acknowledged) >= MOST_READERS:
                continue
            if low is not None and low < base <= self.last + 1:
                decided = int(np.searchsorted(places, at))
                self._went_on(reader, low, base, int(offered[decided - 1]) if decided else had)
            if base <= self.last + 1:
                self.acknowledged[reader] = max(base, low or 0)
            for number in submessages.numbers(at):
                if not self.floor <= number <= self.last:
                    continue
                captured = first_at.get(number, at) < at or not before.missing(number, number + 1)
                if self.requested.fresh(np.array([number])).any():
                    self.behind += captured
                if last_at.get(number, -1) < at and len(self.open) < MOST_ASKED:
                    self.open.setdefault(number, set()).add(reader)

    def _went_on(self, reader: bytes, low: int, base: int, available: int) -> None:
        """Record that a reader no longer needs the numbers from ``low`` up to ``base``, not included."""
        for number in [item for item, readers in self.open.items() if item < base and reader in readers]:
            self.open[number].discard(reader)
            if not self.open[number]:
                del self.open[number]
            if number < available or not self.irrelevant.missing(number, number + 1):
                self.given_up.add(number, number + 1)
        for start, end in self.sample_numbers.missing(max(low, self.floor), min(base, available)):
            for first, last in self.irrelevant.missing(start, end):
                for one, other in self.given_up.missing(first, last):
                    self.unclear.add(one, other)

    def _judged(self, start: int, end: int) -> Counter[str]:
        """Count a range of numbers by fate: ``captured``, ``asked``, ``resent``, and ``FATES``."""
        counts: Counter[str] = Counter()
        sure = max(self.acknowledged.values(), default=0)
        never = self.sample_numbers.missing(start, end)
        counts["captured"] = end - start - _size(never)
        for low, high in (part for hole in never for part in self.irrelevant.missing(*hole)):
            counts["given_up"] += _size(_within(self.given_up, low, high))
            for first, last in self.given_up.missing(low, high):
                counts["unclear"] += _size(_within(self.unclear, first, last))
                for one, other in self.unclear.missing(first, last):
                    decided = max(0, min(other, sure) - one)
                    counts["not_captured"] += decided
                    counts["waiting" if self.reliable else "missing"] += other - one - decided
        for low, high in _within(self.given_up, start, end):
            counts["lost_behind"] += _size(_within(self.sample_numbers, low, high))
        for low, high in _within(self.requested, start, end):
            counts["asked"] += high - low
            counts["resent"] += high - low - _size(_within(self.given_up, low, high))
        return counts

    def _total(self) -> Counter[str]:
        if self.first is None:
            return Counter()
        return self.settled + self._judged(self.floor, self.last + 1)

    def settle(self) -> None:
        """Judge the older half of the numbers finally if they form too many ranges."""
        if self.first is None or self.sample_numbers.count < _MANY:
            return
        cut = max(self.floor, self.sample_numbers.start_of(self.sample_numbers.count // 2))
        self.settled += self._judged(self.floor, cut)
        self.floor = cut
        for ranges in (self.sample_numbers, self.irrelevant, self.requested, self.given_up, self.unclear):
            ranges.forget(cut)
        for number in [item for item in self.open if item < cut]:
            del self.open[number]

    @property
    def written(self) -> int:
        """Samples from the first captured one on, without irrelevant numbers."""
        return self.captured + sum(number for fate, number in self.fates().items() if fate != "lost_behind")

    @property
    def captured(self) -> int:
        """Samples that were captured, from the first one on."""
        return self._total()["captured"]

    @property
    def asked_for(self) -> int:
        """Samples that a reader asked for."""
        return self._total()["asked"]

    @property
    def resent(self) -> int:
        """Samples that a reader asked for, and that were then captured or acknowledged."""
        return self._total()["resent"] - len(self.open)

    def fates(self) -> dict[str, int]:
        """Return the number of missing samples by fate (rule 3), and of captured ones as ``lost_behind``."""
        total = self._total()
        return {name: total[name] for name in FATES}


class TopicWriter(msgspec.Struct, frozen=True):
    """A writer and its topic.

    Attributes:
        topic: ROS name; GUID of the writer if the topic was not announced.
        type: ROS name; empty if it was not announced.
        writer: writer with its samples.
    """

    topic: str
    type: str
    writer: SampleWriter

    def as_json(self) -> dict[str, Any]:
        """Return the writer in the shape of ``info --json``."""
        writer = self.writer
        return {
            "topic": self.topic,
            "type": self.type or None,
            "writer": guid_text(writer.guid),
            "count": writer.captured,
            "missing": writer.written - writer.captured,
            "copies": writer.copies,
        }


def _size(ranges: list[tuple[int, int]]) -> int:
    return sum(end - start for start, end in ranges)


def _within(ranges: KnownRanges, start: int, end: int) -> list[tuple[int, int]]:
    """Return the parts of a range that are in ``ranges``."""
    parts, at = [], start
    for low, high in [*ranges.missing(start, end), (end, end)] if start < end else []:
        if at < low:
            parts.append((at, low))
        at = high
    return parts


class SampleFollower(LinkEvidence):
    """Follows the samples of every writer.

    Args:
        endpoints: announced endpoints, as far as they are decoded.

    Attributes:
        writers: writers by GUID, in order of their first captured submessage.
        datagrams: number of RTPS datagrams as captured.
        reassembled: number of rows reassembled from fragments.
        first_ns: time of the first datagram, ns since 1970.
        last_ns: time of the last datagram, ns since 1970.
        left_out: number of submessages of writers beyond the limit.
    """

    def __init__(self, endpoints: Endpoints) -> None:
        self._endpoints = endpoints
        self.writers: dict[bytes, SampleWriter] = {}
        self.datagrams = self.reassembled = self.left_out = 0
        self.first_ns = self.last_ns = 0

    def topic_writers(self) -> tuple[TopicWriter, ...]:
        """Return the writers with captured samples, except those by which ROS announces its nodes."""
        writers = []
        for guid, writer in self.writers.items():
            endpoint = self._endpoints.find(guid)
            if writer.first is not None and (endpoint is None or endpoint.topic != PRESENCE):
                topic = READER.topic_of(guid, self._endpoints)
                writers.append(TopicWriter(topic, endpoint.ros_type if endpoint else "", writer))
        return tuple(writers)

    def announcements(self) -> list[Announcement]:
        """Return the announcements of participants and endpoints."""
        return [item for item, _ in self._endpoints.announced.values() if isinstance(item, Announcement)]

    def summary(self) -> dict[str, Any]:
        """Return the writers, with the number of their captured samples."""
        return {"samples": [item.as_json() for item in self.topic_writers()]}

    def samples(self) -> list[SampleStream]:
        """Return the samples of each writer."""
        return [
            SampleStream(item.topic, own.captured, own.first_ns, own.last_ns, own.longest_ns)
            for item in self.topic_writers()
            for own in (item.writer,)
        ]

    def spans(self) -> list[tuple[int, int]]:
        """Return the begin and end of the captured datagrams."""
        return [(self.first_ns, self.last_ns)] if self.datagrams else []

    def add(self, batch: PacketBatch, columns: Columns) -> None:
        """Add a batch, with the samples reassembled from fragments."""
        rows = np.flatnonzero(columns.link == RTPS)
        if not len(rows):
            return
        times = batch.time_ns[rows]
        self.first_ns = min(self.first_ns, int(times.min())) if self.datagrams else int(times.min())
        self.last_ns = max(self.last_ns, int(times.max()))
        joined = int(np.count_nonzero(batch.original_length[rows] < 0))
        self.reassembled += joined
        self.datagrams += len(rows) - joined
        self._follow(batch, rows)

    def _follow(self, batch: PacketBatch, rows: Places) -> None:
        submessages = user_submessages(batch, rows)
        for index, guid in enumerate(submessages.writers):
            if guid not in self.writers and len(self.writers) >= MOST_ENDPOINTS:
                self.left_out += int(np.count_nonzero(submessages.writer == index))
                continue
            self.writers.setdefault(guid, SampleWriter(guid)).add(submessages.of(index))


def _copied(ranges: KnownRanges) -> KnownRanges:
    """Return a copy of ranges."""
    copy = KnownRanges()
    for start, end in ranges:
        copy.add(start, end)
    return copy
