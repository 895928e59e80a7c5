"""Reads the records inside a chunk."""

from __future__ import annotations

from array import array
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from edoras_tools.io.formats.mcap.index import (
    INDEX_ENTRY,
    MESSAGE_HEAD,
    RECORD_HEAD,
    ChunkMessages,
    MessageIndex,
)
from edoras_tools.io.formats.mcap.recovery.records import parse
from edoras_tools.io.topics.rows import OPCODE_MESSAGE, RECORD
from edoras_tools.wire.arrays.window import copy_rows, read_at

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from edoras_tools.wire.arrays.order import Integers, Mask, Octets


_HEAD: Final = np.dtype(RECORD)
_CHANNEL_AT: Final = RECORD_HEAD.size
"""Position of the channel's id in a Message record, u16."""
Entries = dict[int, "NDArray[np.void]"]
"""Contents of a message index: log times and offsets of each channel's messages, ``INDEX_ENTRY``."""


class Walked(msgspec.Struct, frozen=True):
    """Consecutive records of a chunk.

    Attributes:
        data: bytes of the chunk, u8.
        channel: channel of each message, u16.
        log_time: log time of each message, u64.
        start: start of each message's record, i64.
        end: end of each message's record, i64.
        others: schemas and channels, parsed.
        places: start of each of these.
        used: bytes that contain complete records; the rest, if any, is not a record.
    """

    data: Octets
    channel: NDArray[np.uint16]
    log_time: NDArray[np.uint64]
    start: Integers
    end: Integers
    others: list[Any]
    places: list[int]
    used: int

    def __len__(self) -> int:
        return len(self.channel)

    @property
    def whole(self) -> bool:
        """Whether the chunk contains only complete records."""
        return self.used == len(self.data)

    def take(self, rows: Mask) -> Walked:
        """Return some of the messages, without the other records."""
        fields = (self.channel[rows], self.log_time[rows], self.start[rows], self.end[rows])
        return Walked(self.data, *fields, [], [], self.used)

    def first(self, channel: int) -> int:
        """Return the start of the first message of a channel, which must have one."""
        return int(self.start[np.argmax(self.channel == channel)])

    def agree(self, entries: Entries) -> Mask:
        """Return for each message whether an index contains it, with channel, log time and position."""
        indexed = np.empty(sum(map(len, entries.values())), _ENTRY)
        indexed["channel"] = np.repeat([*entries], [len(item) for item in entries.values()])
        for name in INDEX_ENTRY.names or ():
            indexed[name] = np.concatenate([np.zeros(0, "<u8"), *(item[name] for item in entries.values())])
        mine = np.empty(len(self), _ENTRY)
        mine["channel"], mine["log_time"], mine["offset"] = self.channel, self.log_time, self.start
        indexed = indexed[np.argsort(indexed["offset"], kind="stable")]
        if np.array_equal(indexed, mine):
            return np.ones(len(self), bool)
        wide = f"V{_ENTRY.itemsize}"
        return np.isin(mine.view(wide), indexed.view(wide))

    def index(self) -> ChunkMessages:
        """Return the message index, as one chunk."""
        index = MessageIndex()
        if len(self):
            index.add(self.channel, self.log_time, self.start)
        return index.divide(len(self.data), len(self.data) or 1)

    def rebuilt(self, ids: Mapping[int, int]) -> Walked:
        """Return only the messages, joined, with new channel ids."""
        length = self.end - self.start
        ends = np.cumsum(length)
        starts = ends - length
        data = np.empty(int(ends[-1]) if len(self) else 0, np.uint8)
        copy_rows(data, starts, self.data, self.start, length)
        channel = self.channel.copy()
        for old, new in ids.items():
            channel[self.channel == old] = new
        for shift in (0, 8):
            data[starts + _CHANNEL_AT + shift // 8] = (channel >> shift).astype(np.uint8)
        return Walked(data, channel, self.log_time, starts, ends, [], [], len(data))


_ENTRY: Final = np.dtype([("channel", "<u2"), *INDEX_ENTRY.descr])


def walk(raw: bytes | memoryview, entries: Entries | None = None) -> Walked:
    """Return the records of a chunk.

    Args:
        raw: the chunk, uncompressed.
        entries: its message index; if it is correct, Python does not handle messages one by one.
    """
    data = np.frombuffer(raw, np.uint8)
    if entries:
        records = _at(
            data, np.sort(np.concatenate([item["offset"] for item in entries.values()]).astype(np.int64))
        )
        if records is not None:
            return records
    return _one_by_one(data)


def _at(data: Octets, starts: Integers) -> Walked | None:
    """Return the records, if messages start at these positions; otherwise None."""
    if not len(starts) or starts[0] < 0 or starts[-1] + _HEAD.itemsize > len(data):
        return None
    heads = read_at(data, starts, _HEAD)
    length = heads["record_length"]
    if (
        (heads["opcode"] != OPCODE_MESSAGE).any()
        or (length > len(data)).any()
        or (length < MESSAGE_HEAD.size).any()
    ):
        return None
    ends = starts + length.astype(np.int64) + RECORD_HEAD.size
    befores = np.concatenate([[0], ends])
    afters = np.concatenate([starts, [len(data)]])
    if (befores > afters).any():
        return None
    others: list[Any] = []
    places: list[int] = []
    for gap in np.flatnonzero(befores != afters).tolist():
        part = _one_by_one(data[befores[gap] : afters[gap]])
        if len(part) or not part.whole:
            return None
        others += part.others
        places += [int(befores[gap]) + place for place in part.places]
    fields = (heads["channel_id"].copy(), heads["log_time"].copy(), starts, ends)
    return Walked(data, *fields, others, places, len(data))


def _one_by_one(data: Octets) -> Walked:
    view = data.data
    rows = array("Q")  # four numbers a message: as objects, they could take a gigabyte for one chunk
    others: list[Any] = []
    places: list[int] = []
    place = 0
    while place + RECORD_HEAD.size <= len(data):
        opcode, length = RECORD_HEAD.unpack_from(view, place)
        start, end = place + RECORD_HEAD.size, place + RECORD_HEAD.size + length
        if end > len(data) or opcode == 0:
            break
        if opcode == Opcode.MESSAGE and length >= MESSAGE_HEAD.size:
            channel_id, _, log_time, _ = MESSAGE_HEAD.unpack_from(view, start)
            rows.extend((channel_id, log_time, place, end))
        else:
            record = parse(opcode, bytes(view[start:end]))
            if record is None:
                break
            if isinstance(record, (Schema, Channel)):  # a damaged chunk may hold any record
                others.append(record)
                places.append(place)
        place = end
    columns = np.frombuffer(rows, np.uint64).reshape(-1, 4).T
    starts, ends = columns[2:].astype(np.int64, "C")
    return Walked(data, columns[0].astype(np.uint16), columns[1].copy(), starts, ends, others, places, place)
