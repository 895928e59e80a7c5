"""Samples whose topic was announced and whose type is known, as messages on their topics."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.addons.rtps.link import RTPS
from edoras_tools.addons.rtps.samples import known_samples
from edoras_tools.io.topics.rows import APART, RECORD, Messages, whole_messages
from edoras_tools.links.doors import MOST_ENDPOINTS, Endpoints
from edoras_tools.sessions.ranges import MOST_RANGES, KnownRanges
from edoras_tools.wire.arrays.order import Integers, Mask, by_value
from edoras_tools.wire.arrays.window import PADDING, copy_rows

if TYPE_CHECKING:
    from edoras_tools.links.doors import KnownSamples, TopicSpace
    from edoras_tools.model import Columns, PacketBatch

MOST_SAMPLE_TOPICS: Final = 1 << 10
"""Most topics that are added; samples of further ones are left out."""
_METADATA: Final = {"link": RTPS.label}
_LOW: Final = (1 << 32) - 1


class SampleMessages:
    """Makes messages of samples; copies, and samples for several readers, make one message.

    Args:
        endpoints: endpoints announced so far.
    """

    def __init__(self, space: TopicSpace, endpoints: Endpoints) -> None:
        self._space, self._other_topics, self._endpoints = space, space.used_names(), endpoints
        self._announced = 0
        self._ranges: dict[bytes, KnownRanges] = {}
        self._floor: dict[bytes, int] = {}
        """Writer to the number below which a sample counts as a copy: older numbers are forgotten."""
        self._names: dict[tuple[str, str], str] = {}

    def messages(self, batch: PacketBatch, columns: Columns) -> list[Messages]:
        """Return the messages of the samples in a batch."""
        rows = np.flatnonzero(columns.link == RTPS)
        messages = (
            self._of(batch, item) for item in known_samples(self._space.types, self._endpoints, batch, rows)
        )
        return [item for item in messages if item is not None]

    def offer(self) -> None:
        """Add the announced topics of known types, before their first samples."""
        if len(self._endpoints.announced) == self._announced:
            return
        self._announced = len(self._endpoints.announced)
        for topic, type_name in self._endpoints.topics().items():
            if self._space.types.has(type_name) and (name := self._name(topic, type_name)):
                self._space.place(name, type_name, _METADATA)

    def _name(self, topic: str, type_name: str) -> str:
        """Return the name of the topic in the recording; empty if there are too many."""
        key = topic, type_name
        if key not in self._names and len(self._names) < MOST_SAMPLE_TOPICS:
            name = topic
            if name in self._other_topics:
                name = f"{APART}{name}"
            if name in self._names.values():
                name = f"{APART}/{type_name}{topic}"
            self._names[key] = name
        return self._names.get(key, "")

    def _new(self, item: KnownSamples) -> Mask:
        """Return which samples are new: bool (n,)."""
        new = np.ones(len(item.row), bool)
        for writer, at in by_value(item.writer):
            guid = item.writers[writer]
            if guid not in self._ranges and len(self._ranges) >= MOST_ENDPOINTS:
                continue
            ranges, floor = self._ranges.setdefault(guid, KnownRanges()), self._floor.get(guid, 0)
            new[at] = ranges.fresh(item.sequence_number[at]) & (item.sequence_number[at] >= floor)
            if ranges.count >= MOST_RANGES // 2:
                self._floor[guid] = ranges.start_of(ranges.count // 2)
                ranges.forget(self._floor[guid])
        return new

    def _of(self, batch: PacketBatch, item: KnownSamples) -> Messages | None:
        """Return the messages of one topic, with copied bytes: another process may write them."""
        trailing = self._space.types.trailing(item.type, batch.data, item.offset, item.length)
        whole = np.flatnonzero((trailing >= 0) & self._new(item))
        name = self._name(item.topic, item.type)
        if not len(whole) or not name:
            return None
        size = (item.length - trailing)[whole].astype(np.int32)
        start: Integers = np.cumsum(size, dtype=np.int64) - size
        data = np.zeros(int(size.sum()) + PADDING, np.uint8)
        copy_rows(data, start, batch.data, item.offset[whole], size)
        row, number = item.row[whole], self._space.place(name, item.type, _METADATA)
        log_ns = batch.time_ns[row]
        written_ns = np.where(item.written_ns[whole] >= 0, item.written_ns[whole], log_ns)
        heads = np.empty(len(whole), np.dtype(RECORD))
        sequence = item.sequence_number[whole] & _LOW
        return whole_messages(
            row, heads, number, sequence, log_ns, written_ns, (data, start, size), repeats=True
        )
