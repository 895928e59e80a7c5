"""Reads the messages of any MCAP file as columns: by its index, or without one from start to end."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from itertools import pairwise
from typing import IO, TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Schema

from edoras_tools.errors import CaptureError
from edoras_tools.io.formats.mcap.chunks import chunk_records
from edoras_tools.io.formats.mcap.file import (
    INDEX_ENTRY,
    INDEX_HEAD,
    MAX_CHUNK_BYTES,
    MESSAGE_HEAD,
    MOST_IDLE,
    RECORD_HEAD,
)
from edoras_tools.io.formats.mcap.recovery.records import FileBytes, parse, walk
from edoras_tools.io.topics.messages import MAGIC, RECORD, RECORD_BYTES, RECORD_PREFIX_BYTES
from edoras_tools.wire.arrays import Integers, Octets, read_at

if TYPE_CHECKING:
    from pathlib import Path

    from mcap.summary import Summary
    from numpy.typing import NDArray


_BATCH_BYTES: Final = 4 << 20
"""Bytes up to which chunks are joined."""
_BEFORE: Final = "; all before was read"


class SelectedMessages(NamedTuple):
    """The messages of some channels in a few chunks; each array has one element a message.

    Attributes:
        channel_id: channel, u16.
        log_time: log time, i64, ns since 1970.
        data: the chunks' records, u8.
        offset: first byte of the message data in ``data``, i64.
        length: bytes of the message data, i64.
        sequence: sequence number, u32.
        publish_time: publish time, i64, ns since 1970.
    """

    channel_id: NDArray[np.uint16]
    log_time: Integers
    data: Octets
    offset: Integers
    length: Integers
    sequence: NDArray[np.uint32]
    publish_time: Integers

    def take(self, rows: NDArray[Any] | slice) -> SelectedMessages:
        """Return the messages that an index array, a mask or a slice selects, over the same buffer."""
        parts = {name: value if name == "data" else value[rows] for name, value in self._asdict().items()}
        return SelectedMessages(**parts)


def is_indexed(summary: Summary | None) -> bool:
    """Return whether indexes lead to every message of a file, so that ``chunk_content`` can read all."""
    if summary is None or summary.statistics is None or not summary.chunk_indexes:
        return False
    every = len(summary.chunk_indexes) == summary.statistics.chunk_count
    return every and all(item.message_index_offsets for item in summary.chunk_indexes)


def chunk_content(
    file: IO[bytes], name: str, index: ChunkIndex, channels: Collection[int]
) -> SelectedMessages:
    """Return the messages of some channels in one chunk, in the order of the file.

    Raises:
        CaptureError: it is damaged.
    """
    numbers = [channel for channel in index.message_index_offsets if channel in channels]
    offset = np.sort(
        np.concatenate([np.zeros(0, np.int64), *(_offsets(file, index, item) for item in numbers)])
    )
    return _messages(_unpacked(file, name, index), offset, name, index)


def scanned(path: Path, name: str) -> Iterator[SelectedMessages | Schema | Channel]:
    """Yield the records of a file in their order; the messages of a chunk come together.

    It needs no index.

    Raises:
        CaptureError: the file is cut off or damaged; raised after all records before that place.
    """
    with FileBytes(path) as file:
        place, loose, opcode, idle = len(MAGIC), bytearray(), 0, 0
        while idle < MOST_IDLE and (record := file.prefix(place)) is not None:
            opcode, start, end = record
            if opcode in {0, Opcode.DATA_END} or end > file.size:  # no record has opcode 0
                break
            empty = opcode not in {Opcode.CHUNK, Opcode.MESSAGE} or end - start < MESSAGE_HEAD.size
            idle = idle + 1 if empty else 0
            if opcode not in {Opcode.CHUNK, Opcode.ATTACHMENT} and end - start > MAX_CHUNK_BYTES:
                raise CaptureError(f"{name}: the record at byte {place} is too large{_BEFORE}")
            if opcode == Opcode.MESSAGE:
                loose += file.read(place, end)
            elif opcode in {Opcode.CHUNK, Opcode.SCHEMA, Opcode.CHANNEL}:
                if loose:
                    yield from _walked(loose)
                    loose = bytearray()
                if opcode == Opcode.CHUNK:
                    yield from _walked(
                        chunk_records(name, place, end - start, lambda: file.read(start, end), _BEFORE)  # noqa: B023
                    )
                elif (content := parse(opcode, file.read(start, end))) is not None:
                    yield content
            if len(loose) >= _BATCH_BYTES:
                yield from _walked(loose)
                loose = bytearray()
            place = end
        if loose:
            yield from _walked(loose)
        if opcode != Opcode.DATA_END:
            raise CaptureError(f"{name}: is cut off at byte {place} of {file.size}; all before was read")


def _walked(raw: bytes | bytearray | memoryview) -> Iterator[SelectedMessages | Schema | Channel]:
    """Yield the schemas and channels among some records, then the messages, in parts of ``_BATCH_BYTES``."""
    records = walk(bytes(raw))
    yield from (item for item in records.others if isinstance(item, (Schema, Channel)))
    edges = np.searchsorted(records.start, np.arange(0, len(records.data) + _BATCH_BYTES, _BATCH_BYTES))
    for first, last in pairwise(edges.tolist()):
        if first < last:
            start, stop = records.start[first:last], int(records.end[last - 1])
            data = records.data[int(start[0]) : stop]
            start = start - start[0]
            yield _selected(read_at(data, start, np.dtype(RECORD)), data, start + RECORD_BYTES)


def joined_messages(parts: Sequence[SelectedMessages]) -> SelectedMessages:
    """Join the messages of several chunks: work on few messages costs about as much as on many."""
    if len(parts) == 1:
        return parts[0]
    ends = np.cumsum([len(part.data) for part in parts])
    offsets = [part.offset + (end - len(part.data)) for part, end in zip(parts, ends.tolist(), strict=True)]
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    return SelectedMessages(*columns)._replace(offset=np.concatenate(offsets))


def _offsets(file: IO[bytes], index: ChunkIndex, channel: int) -> Integers:
    """Return the positions of a channel's Message records in a chunk."""
    file.seek(index.message_index_offsets[channel])
    _, length = RECORD_HEAD.unpack(file.read(RECORD_HEAD.size))
    entries = file.read(min(length, index.message_index_length))[INDEX_HEAD.itemsize - RECORD_HEAD.size :]
    listed = np.frombuffer(entries, INDEX_ENTRY, len(entries) // INDEX_ENTRY.itemsize)
    return listed["offset"].astype(np.int64)


def _unpacked(file: IO[bytes], name: str, index: ChunkIndex) -> Octets:
    def content() -> bytes:
        file.seek(index.chunk_start_offset + RECORD_HEAD.size)
        return file.read(index.chunk_length - RECORD_HEAD.size)

    place, size = index.chunk_start_offset, index.chunk_length - RECORD_HEAD.size
    return np.frombuffer(chunk_records(name, place, size, content, _BEFORE), np.uint8)


def _messages(data: Octets, offset: Integers, name: str, index: ChunkIndex) -> SelectedMessages:
    if len(offset) and (int(offset[0]) < 0 or int(offset[-1]) + RECORD_BYTES > len(data)):
        raise _damaged(name, index)
    heads = read_at(data, offset, np.dtype(RECORD))
    start = offset + RECORD_BYTES
    length = heads["record_length"].astype(np.int64) - (RECORD_BYTES - RECORD_PREFIX_BYTES)
    if not ((heads["opcode"] == Opcode.MESSAGE) & (length >= 0) & (length <= len(data) - start)).all():
        raise _damaged(name, index)
    return _selected(heads, data, start)


def _selected(heads: NDArray[Any], data: Octets, start: Integers) -> SelectedMessages:
    length = heads["record_length"].astype(np.int64) - (RECORD_BYTES - RECORD_PREFIX_BYTES)
    log_time, published = (heads[name].astype(np.int64) for name in ("log_time", "publish_time"))
    return SelectedMessages(heads["channel_id"], log_time, data, start, length, heads["sequence"], published)


def _damaged(name: str, index: ChunkIndex) -> CaptureError:
    return CaptureError(f"{name}: the chunk at byte {index.chunk_start_offset} is damaged{_BEFORE}")
