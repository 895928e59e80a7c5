"""Access to an MCAP file that may be damaged: its bytes, single records, and the records inside a chunk.

Also schemas and channels in a recovery: those read, those assumed, and their numbers in the new file.
"""

from __future__ import annotations

import os
import struct
from array import array
from collections.abc import Container, Hashable, Iterator, Mapping
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from functools import cached_property
from io import BytesIO
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from edoras_tools.errors import RouteError, os_errors
from edoras_tools.io.formats.mcap import file
from edoras_tools.io.topics.messages import OPCODE_MESSAGE, RECORD, RECORD_BYTES
from edoras_tools.io.topics.streams import Streams
from edoras_tools.mission import Mission
from edoras_tools.ros import TypeStore
from edoras_tools.wire.arrays import Integers, Mask, Octets, copy_rows, crc32, read_at

if TYPE_CHECKING:
    import re
    from pathlib import Path

    from numpy.typing import NDArray


_HEAD: Final = np.dtype(RECORD)
_CHANNEL_AT: Final = file.RECORD_HEAD.size
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
        for name in file.INDEX_ENTRY.names or ():
            indexed[name] = np.concatenate([np.zeros(0, "<u8"), *(item[name] for item in entries.values())])
        mine = np.empty(len(self), _ENTRY)
        mine["channel"], mine["log_time"], mine["offset"] = self.channel, self.log_time, self.start
        indexed = indexed[np.argsort(indexed["offset"], kind="stable")]
        if np.array_equal(indexed, mine):
            return np.ones(len(self), bool)
        wide = f"V{_ENTRY.itemsize}"
        return np.isin(mine.view(wide), indexed.view(wide))

    def index(self) -> file.ChunkMessages:
        """Return the message index, as one chunk."""
        index = file.MessageIndex()
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


_ENTRY: Final = np.dtype([("channel", "<u2"), *file.INDEX_ENTRY.descr])


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
        or (length < file.MESSAGE_HEAD.size).any()
    ):
        return None
    ends = starts + length.astype(np.int64) + file.RECORD_HEAD.size
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
    while place + file.RECORD_HEAD.size <= len(data):
        opcode, length = file.RECORD_HEAD.unpack_from(view, place)
        start, end = place + file.RECORD_HEAD.size, place + file.RECORD_HEAD.size + length
        if end > len(data) or opcode == 0:
            break
        if opcode == Opcode.MESSAGE and length >= file.MESSAGE_HEAD.size:
            channel_id, _, log_time, _ = file.MESSAGE_HEAD.unpack_from(view, start)
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
                return record if int.from_bytes(content[-4:], "little") in {0, crc32(content[:-4])} else None
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
        with os_errors(f"{path}: cannot be read"):
            self._file = path.open("rb")
        self._number = self._file.fileno()
        self.size = os.fstat(self._number).st_size

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def read(self, start: int, end: int) -> bytes:
        """Return the bytes from ``start`` up to ``end``; fewer at the end of the file."""
        end = min(end, self.size)
        pieces = []
        with os_errors(f"{self.path}: cannot be read"):
            while start < end and (piece := os.pread(self._number, end - start, start)):
                pieces.append(piece)
                start += len(piece)
        return pieces[0] if len(pieces) == 1 else b"".join(pieces)

    def prefix(self, place: int) -> tuple[int, int, int] | None:
        """Return opcode, start and end of the content of the record at ``place``, complete or not."""
        prefix = self.read(place, place + file.RECORD_HEAD.size) if place >= 0 else b""
        if len(prefix) < file.RECORD_HEAD.size:
            return None
        opcode, length = file.RECORD_HEAD.unpack(prefix)
        return opcode, place + file.RECORD_HEAD.size, place + file.RECORD_HEAD.size + length

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


RecordId = tuple[type, int]
"""The kind of a record, ``Schema`` or ``Channel``, and its number."""


class Definitions:
    """The schemas and channels of one file.

    Args:
        schemas: proved schemas by id.
        channels: proved channels by id.

    Attributes:
        altered: whether a record differed from a proved one.
        late: records that later chunks prove, by type and id; None where two of them differ.
    """

    def __init__(self, schemas: dict[int, Schema], channels: dict[int, Channel]) -> None:
        self._proved = {*((Schema, key) for key in schemas), *((Channel, key) for key in channels)}
        self._known: dict[RecordId, Schema | Channel | None] = {}
        self._known |= {(Schema, key): item for key, item in schemas.items()}
        self._known |= {(Channel, key): item for key, item in channels.items()}
        self.altered = False
        self.late: Mapping[RecordId, Schema | Channel | None] = {}

    @property
    def complete(self) -> bool:
        """Whether a summary lists the channels."""
        return any(kind is Channel for kind, _ in self._proved)

    def _record(self, kind: type, number: int) -> Schema | Channel | None:
        key = kind, number
        return self._known.get(key) if key in self._proved else self.late.get(key) or self._known.get(key)

    def learn(self, record: Schema | Channel) -> None:
        """Add a record. Proved records are never replaced; of two that differ, neither is used."""
        key = type(record), record.id
        if key not in self._known and any(kind is type(record) for kind, _ in self._proved):
            return  # it belongs to a recording inside an attachment, not to this file
        if key in self._known and self._known[key] != record:
            self.altered = True
            if key not in self._proved:
                self._known[key] = None
            return
        self._known.setdefault(key, record)

    def agrees(self, record: Schema | Channel) -> bool:
        """Return whether a record equals the one in use, or is the only one of its kind and number."""
        return (self._record(type(record), record.id) or record) == record

    def channel(self, channel_id: int) -> tuple[Channel, Schema | None] | None:
        """Return a channel and its schema (None if unknown); None if the channel is unknown."""
        channel = self._record(Channel, channel_id)
        return (channel, self.schema(channel.schema_id)) if isinstance(channel, Channel) else None

    def below(self, record: Schema | Channel) -> Schema | None:
        """Return the schema of a channel; None if it is unknown, or if the record is a schema."""
        return self.schema(record.schema_id) if isinstance(record, Channel) else None

    def schema(self, schema_id: int) -> Schema | None:
        """Return a schema; None if it is unknown."""
        schema = self._record(Schema, schema_id)
        return schema if isinstance(schema, Schema) else None


class Stretch(msgspec.Struct):
    """The results of one reading for a stretch of the file without damage, for the next reading.

    Attributes:
        proved: schemas and channels in chunks whose checksum is right; None where two of them differ.
        fits: whether all messages of a channel without a record could be of our recorder, by channel.
    """

    proved: dict[RecordId, Schema | Channel | None] = msgspec.field(default_factory=dict)
    fits: dict[int, bool] = msgspec.field(default_factory=dict)

    def learn(self, record: Schema | Channel) -> None:
        """Add a record of a chunk whose checksum is right."""
        key = type(record), record.id
        self.proved[key] = record if self.proved.get(key, record) == record else None


class KnownTopics:
    """The channels of a recording of ours, with their usual numbers: the project's, then the mission's."""

    def __init__(self, mission: Mission | None = None, types: TypeStore | None = None) -> None:
        self._mission, self._types = mission or Mission(), types or TypeStore()

    @cached_property
    def _channels(self) -> list[tuple[Channel, Schema]]:
        streams = Streams(self._mission, self._types)
        schemas = {
            name: Schema(id=number, name=name, encoding="ros2msg", data=text.encode())
            for number, (name, text) in enumerate(streams.definitions.items(), 1)
        }
        return [
            (
                Channel(
                    id=number,
                    topic=topic.name,
                    message_encoding=topic.encoding,
                    metadata={"offered_qos_profiles": "", **topic.metadata},
                    schema_id=schemas[topic.type].id,
                ),
                schemas[topic.type],
            )
            for number, topic in enumerate(streams.topics, 1)
        ]

    def fits(self, number: int, walked: Walked) -> bool:
        """Return whether all messages of a channel in a chunk are valid for our channel of that number."""
        if not 0 < number <= len(self._channels):
            return False
        rows = walked.channel == number
        offset = walked.start[rows] + RECORD_BYTES
        length = (walked.end[rows] - offset).astype(np.int32)
        name = self._channels[number - 1][1].name
        behind = self._types.trailing(name, walked.data, offset, length)
        return bool(((behind >= 0) & (behind <= self._types.most_trailing(name))).all())

    def channel(self, number: int, stretch: Stretch) -> tuple[Channel, Schema] | None:
        """Return our channel and its schema; None if the stretch is not of our recorder (no datagrams)."""
        return self._channels[number - 1] if stretch.fits.get(1) and stretch.fits.get(number) else None

    def definition(self, name: str) -> str:
        """Return the definition of a type; empty if it is unknown."""
        with suppress(RouteError):
            return self._types.definition(name)
        return ""

    def schema(self, topic: str) -> Schema | None:
        """Return the schema of a topic whose own record is lost; None if the topic is unknown."""
        return next((schema for channel, schema in self._channels if channel.topic == topic), None)


class Numbering:
    """Assigns a unique number to each channel and schema; it keeps its own number if that is free.

    Args:
        out: the file to write them to; None to write nothing.

    Attributes:
        topics: topic of each channel, by number.
    """

    def __init__(self, out: file.McapFile | None) -> None:
        self._out = out
        self._numbers: dict[Hashable, int] = {}
        self._records: dict[RecordId, Schema | Channel] = {}
        self._written: set[RecordId] = set()
        self._last: dict[tuple[int, int], tuple[int, Channel, Schema | None]] = {}
        """Numbers already assigned, by the identity of the objects, which are kept alive here."""
        self.topics: dict[int, str] = {}

    def schema(self, schema: Schema, *, write: bool = True, inside: Container[RecordId] = ()) -> int:
        """Number a schema, and write it if it is new; see ``channel``."""
        key = (schema.id, schema.name, schema.encoding, bytes(schema.data))
        return self._put(key, schema, write=write, inside=inside)

    def keeps(self, record: Schema | Channel, schema: Schema | None) -> bool:
        """Return whether a record, and the schema of a channel, keep their numbers; nothing is written."""
        if isinstance(record, Schema):
            return self.schema(record, write=False) == record.id
        number = self.channel(record, schema, write=False)
        return number == record.id and self._records[Channel, number] == record

    def channel(
        self, channel: Channel, schema: Schema | None, *, write: bool = True, inside: Container[RecordId] = ()
    ) -> int:
        """Number a channel, and write it and its schema if they are new.

        Args:
            schema: its schema, or None.
            inside: kinds and numbers of records in the chunk itself, which are not written again.
        """
        last = self._last.get((id(channel), id(schema)))
        if last is not None:
            return last[0]
        below = 0 if schema is None else self.schema(schema, write=write, inside=inside)
        meta = tuple(sorted(channel.metadata.items()))
        number = self._put(
            (channel.id, channel.topic, channel.message_encoding, meta, below),
            replace(channel, schema_id=below),
            write=write,
            inside=inside,
        )
        self.topics[number] = channel.topic
        if write:
            self._last[id(channel), id(schema)] = number, channel, schema
        return number

    def _put(
        self, key: Hashable, record: Schema | Channel, *, write: bool, inside: Container[RecordId]
    ) -> int:
        kind = type(record)
        if key not in self._numbers:
            number = record.id
            while (kind, number) in self._records:
                number = number % 0xFFFF + 1
            self._numbers[key] = number
            self._records[kind, number] = replace(record, id=number)
        number = self._numbers[key]
        if write and (kind, number) not in self._written:
            self._written.add((kind, number))
            self._write(self._records[kind, number], inside=(kind, number) in inside)
        return number

    def _write(self, record: Schema | Channel, *, inside: bool) -> None:
        if self._out is None:
            return
        if isinstance(record, Schema):
            self._out.summary.schemas[record.id] = record
        else:
            self._out.summary.channels[record.id] = record
        if not inside:
            self._out.add_bytes(file.record_bytes(record))


def renumbered(message: bytes, channel_id: int) -> bytes:
    """Return a message's content with another channel id."""
    return struct.pack("<H", channel_id) + message[2:]
