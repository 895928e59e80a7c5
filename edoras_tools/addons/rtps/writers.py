"""What became of the samples of each DDS writer, from what a capture has of its sequence numbers.

The rules that this file keeps:

1. A sample is known by its writer and its sequence number, and counted once: copies (sent again, or to
   several readers) are counted apart. Endpoints that are built in are left out.
2. A writer is counted from the first sample that was captured on, up to the last that was captured or that a
   HEARTBEAT tells of. What a GAP takes out was never to come.
3. A number in between that never came is
   ``given_up``, if a reader asked for it in vain and went on when the writer did not have it any more (its
   HEARTBEATs began behind it, or a GAP took it out);
   ``unclear``, if a reader went on so without having asked;
   ``not_captured``, if a reader acknowledged it: it came on another way, or while nothing was captured;
   ``waiting``, if the writer is reliable and no reader has acknowledged it yet;
   ``missing``, if the writer is best effort: lost before the place of the capture, or not captured.
4. A sample that a reader asked for (ACKNACK) was lost at first: ``behind``, if it had been captured by then:
   between that place and the reader; else ``before``. If it was captured again it was sent again; if the
   reader went on without it, and the writer did not have it any more, it is ``given_up``.
5. Memory is bounded: writers, ranges of numbers and open questions are limited in number. Where the captured
   numbers of a writer are more than ``_MANY`` ranges, the older half is judged for good: what of it comes
   later is a copy.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from edoras_tools.addons.rtps.link import RTPS
from edoras_tools.addons.rtps.reader import UserSubmessages, user_submessages
from edoras_tools.addons.rtps.samples import READER
from edoras_tools.addons.rtps.wire.headers import SubmessageKind
from edoras_tools.addons.rtps.wire.messages import guid_text
from edoras_tools.addons.rtps.wire.parameters import Announcement
from edoras_tools.links.doors import LinkEvidence, SampleStream
from edoras_tools.links.site import MOST_ENDPOINTS, Endpoints
from edoras_tools.sessions.ranges import MOST_RANGES, KnownRanges

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.model import Columns, PacketBatch

PRESENCE: Final = "ros_discovery_info"
"""Topic on which each node of ROS tells of its topics."""
MOST_READERS: Final = 1 << 10
"""Of a writer; what others acknowledge is not followed."""
MOST_ASKED: Final = 1 << 14
"""Samples of a writer that a reader waits for; more are not followed."""
FATES: Final = ("given_up", "unclear", "not_captured", "waiting", "missing", "lost_behind")
_MANY: Final = MOST_RANGES // 2
"""With so many ranges of captured numbers, the older half is judged for good."""
_HIGHEST: Final = 1 << 62
"""Numbers above are no sound sequence numbers."""
_FARTHEST: Final = 1 << 32
"""A number so far ahead of the others is not believed."""


class SampleWriter(msgspec.Struct, eq=False):
    """One writer, and what became of its samples.

    Attributes:
        guid: of the writer.
        first_ns: time of its first captured sample; 0 before.
        last_ns: time of its last one that had not come before.
        longest_ns: longest time between two of these.
        first: the first number that was captured, which need not be the lowest; None before.
        last: the last number that is known to be written.
        sample_numbers: of samples that were captured whole.
        irrelevant: numbers that will not come, as GAPs say.
        copies: captured samples whose number had come before.
        available: the first number that the writer still has, as its HEARTBEATs say.
        reliable: whether it sends HEARTBEATs, or is sent ACKNACKs.
        acknowledged: by reader the number before which that one needs nothing.
        requested: numbers that readers asked for.
        behind: how many of these had been captured by then.
        open: reader and number of what was asked for and was not captured since; the answer is open.
        given_up: numbers that a reader asked for, and went on without.
        unclear: numbers that a reader went on without, and that it had not asked for.
        floor: the numbers below it are judged for good.
        settled: what became of these.
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

    def _judged(self, start: int, end: int) -> Counter[str]:
        """Count what became of a range of numbers: ``captured``, ``asked``, ``resent``, and ``fates``."""
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
        """Judge the older half of the numbers for good where they have become too many ranges."""
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
        """Samples from the first captured one on, without those that are irrelevant."""
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
        """Samples that a reader asked for, and that were captured or acknowledged then."""
        return self._total()["resent"] - len(self.open)

    def fates(self) -> dict[str, int]:
        """Return what became of what did not come (rule 3), and of what was captured: ``lost_behind``."""
        total = self._total()
        return {name: total[name] for name in FATES}


class TopicWriter(msgspec.Struct, frozen=True):
    """A writer and its topic.

    Attributes:
        topic: its ROS name; the GUID of the writer where it was not announced.
        type: its ROS name; empty where it was not announced.
        writer: what became of its samples.
    """

    topic: str
    type: str
    writer: SampleWriter

    def as_json(self) -> dict[str, Any]:
        """Return it in the shape of ``info --json``."""
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
    """Return the parts of a range that are known."""
    parts, at = [], start
    for low, high in [*ranges.missing(start, end), (end, end)] if start < end else []:
        if at < low:
            parts.append((at, low))
        at = high
    return parts


class SampleFollower(LinkEvidence):
    """Follows the samples of every writer.

    Args:
        endpoints: what is announced, as far as it was decoded.

    Attributes:
        writers: by GUID, in order of what was first captured of them.
        datagrams: of RTPS, as they were captured.
        reassembled: rows that were put together from fragments.
        first_ns: time of the first datagram.
        last_ns: time of the last.
        left_out: submessages of writers beyond the limit.
    """

    def __init__(self, endpoints: Endpoints) -> None:
        self._endpoints = endpoints
        self.writers: dict[bytes, SampleWriter] = {}
        self.datagrams = self.reassembled = self.left_out = 0
        self.first_ns = self.last_ns = 0

    def topic_writers(self) -> tuple[TopicWriter, ...]:
        """Return the writers of which samples were captured, but those by which ROS tells of its nodes."""
        writers = []
        for guid, writer in self.writers.items():
            endpoint = self._endpoints.find(guid)
            if writer.first is not None and (endpoint is None or endpoint.topic != PRESENCE):
                topic = READER.topic_of(guid, self._endpoints)
                writers.append(TopicWriter(topic, endpoint.ros_type if endpoint else "", writer))
        return tuple(writers)

    def announcements(self) -> list[Announcement]:
        """Return what participants and endpoints said of themselves."""
        return [item for item, _ in self._endpoints.announced.values() if isinstance(item, Announcement)]

    def summary(self) -> dict[str, Any]:
        """Return the writers, and how many of their samples were captured."""
        return {"samples": [item.as_json() for item in self.topic_writers()]}

    def samples(self) -> list[SampleStream]:
        """Return the samples of each writer."""
        return [
            SampleStream(item.topic, own.captured, own.first_ns, own.last_ns, own.longest_ns)
            for item in self.topic_writers()
            for own in (item.writer,)
        ]

    def spans(self) -> list[tuple[int, int]]:
        """Return from when to when datagrams were captured."""
        return [(self.first_ns, self.last_ns)] if self.datagrams else []

    def add(self, batch: PacketBatch, columns: Columns) -> None:
        """Take a batch, with the samples that were put together from fragments."""
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

    def _follow(self, batch: PacketBatch, rows: NDArray[np.intp]) -> None:
        submessages = user_submessages(batch, rows)
        for index, guid in enumerate(submessages.writers):
            if guid not in self.writers and len(self.writers) >= MOST_ENDPOINTS:
                self.left_out += int(np.count_nonzero(submessages.writer == index))
                continue
            writer = self.writers.setdefault(guid, SampleWriter(guid))
            _Pass(writer, submessages.of(index)).run()


class _Pass:
    """Takes what a batch has of one writer.

    Args:
        submessages: in the order they were captured.
    """

    def __init__(self, writer: SampleWriter, submessages: UserSubmessages) -> None:
        self._writer, self._submessages = writer, submessages

    def run(self) -> None:
        """Take all of it."""
        writer, submessages = self._writer, self._submessages
        sound = (submessages.first > 0) & (submessages.first < _HIGHEST) & (submessages.last < _HIGHEST)
        kind = np.where(sound | (submessages.kind == SubmessageKind.ACKNACK), submessages.kind, 0)
        data = np.flatnonzero(kind == SubmessageKind.DATA)
        beats = np.flatnonzero(kind == SubmessageKind.HEARTBEAT)
        gaps = np.flatnonzero(kind == SubmessageKind.GAP)
        acks = np.flatnonzero(kind == SubmessageKind.ACKNACK)
        if writer.first is None and len(data):  # what was said before the first sample is not counted
            beats, acks = beats[beats > data[0]], acks[acks > data[0]]
        numbers = submessages.first[data]
        before = writer.sample_numbers if not len(acks) else _copied(writer.sample_numbers)
        if len(data):
            self._samples(data, numbers)
        if writer.first is not None:
            ends = [writer.last, *submessages.last[beats].tolist()]
            writer.last = max(item for item in ends if item <= writer.last + _FARTHEST)
        writer.reliable = writer.reliable or bool(len(beats) or len(acks))
        for at in gaps.tolist():
            self._gap(at)
        had = writer.available
        offered = np.maximum.accumulate(submessages.first[beats]) if len(beats) else np.zeros(0, np.int64)
        if len(acks) and writer.first is not None:
            self._acknowledge(acks, before, (beats, offered, had))
        writer.available = max(had, int(offered[-1]) if len(offered) else 0)

    def _samples(self, data: NDArray[np.int64], numbers: NDArray[np.int64]) -> None:
        writer, times = self._writer, self._submessages.time_ns[data]
        if writer.first is None:
            writer.first = writer.floor = writer.last = int(numbers[0])
            writer.first_ns = writer.last_ns = int(times[0])
        for at in range(0, len(numbers), _MANY // 2):
            some = numbers[at : at + _MANY // 2]
            near = some <= writer.last + _FARTHEST
            some, moments = some[near], times[at : at + _MANY // 2][near]
            new = np.full(len(some), writer.floor == writer.first) | (some >= writer.floor)
            writer.copies += int(np.count_nonzero(~new))
            fresh = writer.sample_numbers.fresh(some[new])
            writer.copies += int(np.count_nonzero(~fresh))
            moments = np.append(writer.last_ns, moments[new][fresh])
            writer.longest_ns = max(writer.longest_ns, int(np.diff(moments).max(initial=0)))
            writer.last_ns = max(writer.last_ns, int(moments[-1]))
            writer.last = max(writer.last, int(some.max(initial=0)))
            writer.settle()
        if writer.open:
            for number in set(numbers.tolist()) & writer.open.keys():
                del writer.open[number]

    def _gap(self, at: int) -> None:
        submessages, writer = self._submessages, self._writer
        start, base = int(submessages.first[at]), int(submessages.last[at])
        if start < base:
            writer.irrelevant.add(start, base)
        for number in submessages.numbers(at):
            writer.irrelevant.add(number, number + 1)

    def _acknowledge(
        self,
        acks: NDArray[np.int64],
        before: KnownRanges,
        beats: tuple[NDArray[np.int64], NDArray[np.int64], int],
    ) -> None:
        """Take ACKNACKs in order: what a reader asks for, and what it needs no more.

        Args:
            acks: indices of the ACKNACKs.
            before: samples that were captured in earlier batches.
            beats: indices of the HEARTBEATs, from which number on each says that there are samples, and what
                those before said.
        """
        submessages, writer = self._submessages, self._writer
        first_at: dict[int, int] = {}
        last_at: dict[int, int] = {}
        for at in np.flatnonzero(submessages.kind == SubmessageKind.DATA).tolist():
            first_at.setdefault(int(submessages.first[at]), at)
            last_at[int(submessages.first[at])] = at
        places, offered, had = beats
        for at in acks.tolist():
            base, reader = int(submessages.first[at]), submessages.readers[int(submessages.reader[at])]
            low = writer.acknowledged.get(reader)
            if low is None and len(writer.acknowledged) >= MOST_READERS:
                continue
            if low is not None and low < base <= writer.last + 1:
                decided = int(np.searchsorted(places, at))
                self._went_on(reader, low, base, int(offered[decided - 1]) if decided else had)
            if base <= writer.last + 1:
                writer.acknowledged[reader] = max(base, low or 0)
            for number in submessages.numbers(at):
                if not writer.floor <= number <= writer.last:
                    continue
                captured = first_at.get(number, at) < at or not before.missing(number, number + 1)
                if writer.requested.fresh(np.array([number])).any():
                    writer.behind += captured
                if last_at.get(number, -1) < at and len(writer.open) < MOST_ASKED:
                    writer.open.setdefault(number, set()).add(reader)

    def _went_on(self, reader: bytes, low: int, base: int, available: int) -> None:
        """Note what a reader needs no more, from ``low`` up to ``base``."""
        writer = self._writer
        for number in [item for item, readers in writer.open.items() if item < base and reader in readers]:
            writer.open[number].discard(reader)
            if not writer.open[number]:
                del writer.open[number]
            if number < available or not writer.irrelevant.missing(number, number + 1):
                writer.given_up.add(number, number + 1)
        for start, end in writer.sample_numbers.missing(max(low, writer.floor), min(base, available)):
            for first, last in writer.irrelevant.missing(start, end):
                for one, other in writer.given_up.missing(first, last):
                    writer.unclear.add(one, other)


def _copied(ranges: KnownRanges) -> KnownRanges:
    """Return ranges that do not change when others do."""
    copy = KnownRanges()
    for start, end in ranges:
        copy.add(start, end)
    return copy
