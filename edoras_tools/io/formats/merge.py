"""Merges several sources in order of time, with one batch of each in memory."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from heapq import heappop, heappush
from itertools import chain
from typing import TYPE_CHECKING, Final

import numpy as np
from msgspec.structs import replace

from edoras_tools.errors import CaptureError
from edoras_tools.io import Source, SourceDefaults
from edoras_tools.model import HostCounters, PacketBatch, SourceInfo, SourceStatistics, concatenate
from edoras_tools.units import SECOND
from edoras_tools.wire.arrays import PADDING, Integers

if TYPE_CHECKING:
    from edoras_tools.links.doors import Framing
    from edoras_tools.sessions.faults.rules import Fault

SEAM_NS: Final = 2 * SECOND
"""Longest time between the end of a file and the beginning of one that continues it."""
_TOGETHER: Final = 512
"""Most small batches that are joined into one: each batch costs milliseconds, even with few rows."""


def merge_sources(sources: Sequence[Source]) -> Source:
    """Read several sources as one, in order of time.

    Every source keeps its own order: a datagram that is earlier than its predecessor is treated as if it had
    the same time. Of equal times, the source named first comes first. Datagrams are numbered from 1. If a
    source ends with an error, the others are read to their end before it is raised.

    Args:
        sources: at least one; a single one is returned as it is. They are files: a source that waits would
            make all of them wait.
    """
    return sources[0] if len(sources) == 1 else MergedSource(sources)


class MergedSource(SourceDefaults):
    """See ``merge_sources``."""

    section = 0

    def __init__(self, sources: Sequence[Source]) -> None:
        self._sources = list(sources)
        self._statistics = SourceStatistics()
        self._first, self._origin = 1, np.zeros(1, np.int64)

    @property
    def info(self) -> SourceInfo:
        """Information on all sources: all names, the finest resolution, the largest snap length."""
        infos = [source.info for source in self._sources]
        kinds = {info.kind for info in infos}
        return SourceInfo(
            name=", ".join(info.name for info in infos),
            kind=kinds.pop() if len(kinds) == 1 else "merged",
            time_resolution_ns=min(info.time_resolution_ns for info in infos),
            snap_length=max(info.snap_length for info in infos),
            attachments={name: data for info in reversed(infos) for name, data in info.attachments.items()},
            definitions={name: text for info in reversed(infos) for name, text in info.definitions.items()},
            read_with={name: text for info in reversed(infos) for name, text in info.read_with.items()},
            damage="; ".join(info.damage for info in infos if info.damage),
        )

    @property
    def statistics(self) -> SourceStatistics:
        """The sums of the sources' statistics; 0 drops become None if a source does not know its drops."""
        total = self._statistics
        for name in SourceStatistics.__struct_fields__:
            values = [getattr(source.statistics, name) for source in self._sources]
            if isinstance(values[0], list):
                setattr(total, name, [*chain(*values)])
            else:
                added = sum(value or 0 for value in values)
                setattr(total, name, None if None in values and not added else added)
        return total

    @property
    def files(self) -> Sequence[str]:
        """The names of the sources."""
        return [source.info.name for source in self._sources]

    def follow(self, framings: Mapping[int, Framing]) -> None:
        """Read the TCP streams of these ports, and no others; call it before the first batch."""
        for source in self._sources:
            source.follow(framings)

    def faults(self) -> list[Fault]:
        """Return the injected faults in all recordings."""
        return [fault for source in self._sources for fault in source.faults()]

    def host(self) -> list[HostCounters]:
        """Return the counters of the recording host's kernel, if exactly one recording has them."""
        counters = [item for source in self._sources if (item := source.host())]
        return counters[0] if len(counters) == 1 else []

    def origin(self, number: Integers) -> Integers:
        """Return the index of the source that each datagram of the last batch is from."""
        return self._origin[(number - self._first).clip(0, len(self._origin) - 1)]

    def batches(self) -> Iterator[PacketBatch]:
        """Yield all datagrams in order of time; see ``Source.batches``.

        Raises:
            CaptureError: a source raised it; it has the messages of all sources.
        """
        errors: list[str] = []
        heads = [_Head(source, errors) for source in self._sources]
        number, until, touched = 1, 1, [*range(len(heads))]
        waiting: list[tuple[PacketBatch, Integers]] = []
        ends: list[tuple[int, int]] = []
        begins: list[tuple[int, int]] = []
        reading: set[int] = set()
        while True:
            ended = bool(reading)
            for place in touched:
                if not heads[place].fill():
                    reading.discard(place)
                else:
                    heappush(ends, (heads[place].end, place))
                    heappush(begins, (int(heads[place].keys[0]), place))
            while ends and ends[0][0] != heads[ends[0][1]].end:  # an old end: rows were taken since
                heappop(ends)
            ended = ended and not reading and bool(begins) and begins[0][0] - until > SEAM_NS
            if waiting and (not ends or ended or max(len(waiting), len(waiting[-1][0])) >= _TOGETHER):
                batch = concatenate([_trim(part) for part, _ in waiting])
                self._first, self._origin = number, np.concatenate([origin for _, origin in waiting])
                yield replace(batch, number=np.arange(number, number + len(batch)))
                number += len(batch)
                waiting = []
            if not ends:
                break
            self.section += ended
            # The first source that ends at this time may deliver it completely: later ones hold it back.
            until, last = ends[0]
            touched = []
            while begins and begins[0] <= (until, last):
                touched.append(heappop(begins)[1])
            touched.sort()
            reading.update(touched)
            parts = [heads[place].take(until, whole=place <= last) for place in touched]
            waiting.append(_in_order(parts, touched))
        if errors:
            raise CaptureError("; ".join(errors))

    def close(self) -> None:
        """Close all sources."""
        for source in self._sources:
            source.close()


class _Head:
    """The datagrams of a source that wait to be merged.

    Attributes:
        keys: sort key of each waiting datagram, i64: the largest time up to it.
    """

    def __init__(self, source: Source, errors: list[str]) -> None:
        self._batches = source.batches()
        self._errors = errors
        self._rest: PacketBatch | None = None
        self._latest = np.iinfo(np.int64).min
        self.keys: Integers = np.empty(0, dtype=np.int64)

    @property
    def end(self) -> int:
        """The key of the last waiting datagram; the smallest i64 if none waits."""
        return int(self.keys[-1]) if len(self.keys) else np.iinfo(np.int64).min

    def fill(self) -> bool:
        """Read until a datagram waits; return False at the end of the source."""
        while not len(self.keys):
            try:
                self._rest = next(self._batches, None)
            except CaptureError as error:
                self._errors.append(str(error))
                return False
            if self._rest is None:
                return False
            self.keys = np.maximum.accumulate(np.maximum(self._rest.time_ns, self._latest))
        return True

    def take(self, until: int, *, whole: bool) -> tuple[PacketBatch, Integers]:
        """Return the waiting datagrams before a time, and their keys; ``whole`` includes those of that time.

        At least one must qualify.
        """
        count = int(np.searchsorted(self.keys, until, side="right" if whole else "left"))
        assert self._rest is not None
        part, keys = self._rest, self.keys
        self._latest = int(keys[count - 1])
        self.keys = keys[count:]
        if len(self.keys):
            part, self._rest = part.take(slice(count)), part.take(slice(count, None))
        return part, keys[:count]


def _in_order(parts: list[tuple[PacketBatch, Integers]], places: list[int]) -> tuple[PacketBatch, Integers]:
    """Interleave batches by key; of equal keys the first batch comes first. Return each row's place, too."""
    origin = np.repeat(places, [len(keys) for _, keys in parts])
    if len(parts) == 1:
        return parts[0][0], origin
    order = np.argsort(np.concatenate([keys for _, keys in parts]), kind="stable")
    return concatenate([_trim(batch) for batch, _ in parts]).take(order), origin[order]


def _trim(batch: PacketBatch) -> PacketBatch:
    """Drop the bytes before and after those that the rows use, so that they are not copied."""
    at = int(min(batch.frame_offset.min(), batch.offset.min()))
    ends = (batch.frame_offset + batch.frame_length).max(), (batch.offset + batch.length).max()
    data = batch.data[at : int(max(ends)) + PADDING]
    return replace(batch, data=data, frame_offset=batch.frame_offset - at, offset=batch.offset - at)
