"""Access to an MCAP file that may be damaged: its bytes, single records, and the records inside a chunk."""

from __future__ import annotations

import os
import struct
from array import array
from contextlib import AbstractContextManager, suppress
from io import BytesIO
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from edoras_tools.errors import CaptureError
from edoras_tools.io.formats.mcap.file import (
    INDEX_ENTRY,
    MESSAGE_HEAD,
    RECORD_HEAD,
    ChunkMessages,
    MessageIndex,
)
from edoras_tools.io.topics.messages import OPCODE_MESSAGE, RECORD
from edoras_tools.wire.arrays import copy_rows, crc32, read_at

if TYPE_CHECKING:
    import re
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from edoras_tools.wire.arrays import Integers, Mask, Octets

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


_KINDS: Final[dict[int, Any]] = {
    Opcode.HEADER: records.Header,
    Opcode.FOOTER: records.Footer,
    Opcode.SCHEMA: records.Schema,
    Opcode.CHANNEL: records.Channel,
    Opcode.ATTACHMENT: records.Attachment,
    Opcode.METADATA: records.Metadata,
    Opcode.STATISTICS: records.Statistics,
    Opcode.CHUNK_INDEX: records.ChunkIndex,
    Opcode.ATTACHMENT_INDEX: records.AttachmentIndex,
    Opcode.METADATA_INDEX: records.MetadataIndex,
    Opcode.SUMMARY_OFFSET: records.SummaryOffset,
    Opcode.DATA_END: records.DataEnd,
}
_WINDOW: Final = 1 << 20
_OVERLAP: Final = 64
"""Bytes by which windows overlap; more than any pattern that is searched for."""


def parse(opcode: int, content: bytes) -> Any:
    """Return a record; None if the bytes are not exactly one record of this kind.

    An attachment's own checksum must be correct, if it has one.
    """
    # mcap silently reads fewer bytes than needed: one added byte at the end reveals reading too far.
    stream = BytesIO(content + b"\0")
    with suppress(McapError, struct.error, ValueError, OverflowError, MemoryError):
        if opcode in _KINDS:
            record = _KINDS[opcode].read(ReadDataStream(stream))
            if stream.tell() != len(content):
                return None
            if opcode == Opcode.ATTACHMENT:
                crc = int.from_bytes(content[-4:], "little")
                return record if crc in {0, crc32(content[:-4])} else None
            return record
    return None


class FileBytes(AbstractContextManager["FileBytes"]):
    """Random access to a file whose size must not change meanwhile.

    Attributes:
        path: path of the file.
        size: bytes of the file when it was opened.

    Raises:
        CaptureError: from every method: the file cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._file = path.open("rb")
        except OSError as error:
            raise self._failure(error) from error
        self._number = self._file.fileno()
        self.size = os.fstat(self._number).st_size

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def read(self, start: int, end: int) -> bytes:
        """Return the bytes from ``start`` up to ``end``; fewer at the end of the file."""
        end = min(end, self.size)
        pieces = []
        try:
            while start < end and (piece := os.pread(self._number, end - start, start)):
                pieces.append(piece)
                start += len(piece)
        except OSError as error:
            raise self._failure(error) from error
        return pieces[0] if len(pieces) == 1 else b"".join(pieces)

    def prefix(self, place: int) -> tuple[int, int, int] | None:
        """Return opcode, start and end of the content of the record at ``place``, complete or not."""
        prefix = self.read(place, place + RECORD_HEAD.size) if place >= 0 else b""
        if len(prefix) < RECORD_HEAD.size:
            return None
        opcode, length = RECORD_HEAD.unpack(prefix)
        return opcode, place + RECORD_HEAD.size, place + RECORD_HEAD.size + length

    def find(self, pattern: re.Pattern[bytes], start: int, end: int) -> Iterator[int]:
        """Yield every position from ``start`` up to ``end`` where a short pattern matches."""
        window = 1 << 12  # most searches end soon
        while start < min(end, self.size):
            stop = min(start + window, end)
            data = self.read(start, stop + _OVERLAP)
            # A hole may be large.
            for match in pattern.finditer(data if data.count(0) < len(data) else b""):
                if start + match.start() < stop:
                    yield start + match.start()
            start, window = stop, min(2 * window, _WINDOW)

    def crc(self, start: int, end: int) -> int:
        """Return the CRC-32 of a range of bytes."""
        value = 0
        for first in range(start, end, _WINDOW):
            value = crc32(self.read(first, min(first + _WINDOW, end)), value)
        return value

    def _failure(self, error: OSError) -> CaptureError:
        missing = isinstance(error, FileNotFoundError)
        why = (
            "there is no such file; check the name"
            if missing
            else f"cannot be read: {error.strerror or error}"
        )
        return CaptureError(f"{self.path}: {why}")
