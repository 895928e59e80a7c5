"""Reads the files of recordings of other tools: rosbag2 directories, ``.db3`` files, and any MCAP.

The rules that this file keeps:

1. Every message of every topic is read, whatever its encoding. Its bytes are not decoded; those that rosbag2
   compressed one by one are unpacked.
2. Messages of a file are in order of time. Chunks whose times overlap are held back until nothing earlier can
   come, up to ``_MOST_HELD`` bytes; a file without an index keeps its own order.
3. An error of damage is raised after all readable messages.

Recordings without datagrams become a ``Source`` whose rows are messages. A row contains the bytes of a
message as recorded. It has no frame and no address; ``PacketBatch.recorded`` has the recording's other fields
besides the time. The files of a directory follow each other in order of their first message.
"""

from __future__ import annotations

import sqlite3
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import zstandard
from mcap.reader import McapReader, make_reader
from mcap.records import Channel, Schema
from msgspec.structs import replace
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from edoras_tools.errors import CaptureError, NoDatagramsError, os_errors
from edoras_tools.io import Source, SourceDefaults
from edoras_tools.io.formats.capture_file import SettledFile
from edoras_tools.io.formats.mcap.messages import (
    SelectedMessages,
    chunk_content,
    is_indexed,
    joined_messages,
    scanned,
)
from edoras_tools.io.formats.merge import MergedSource
from edoras_tools.io.topics.messages import MAGIC
from edoras_tools.mission.model import RecordedTopic
from edoras_tools.mission.tree import printable
from edoras_tools.model import RECORDED, HostCounters, PacketBatch, SourceInfo, SourceStatistics
from edoras_tools.wire.arrays import PADDING, Integers, Octets, copy_rows, gather

if TYPE_CHECKING:
    from mcap.summary import Summary
    from numpy.typing import NDArray


class FolderSource(MergedSource):
    """A rosbag2 directory.

    Args:
        path: the directory.
        parts: the sources of its files, in order.
    """

    def __init__(self, path: Path, parts: Sequence[Source]) -> None:
        super().__init__(parts)
        self._path = path

    files = ()  # it is one recording

    @property
    def info(self) -> SourceInfo:
        """Information on all parts, under the name of the directory."""
        return replace(super().info, name=str(self._path), kind="rosbag2")

    def host(self) -> list[HostCounters]:
        """Return the counters of the recording host's kernel in all parts."""
        return [*chain.from_iterable(source.host() for source in self._sources)]


def open_folder(path: Path, open_part: Callable[[Path], Source]) -> Source | None:
    """Open a directory; None if it is not one recording: it has no metadata, or no files.

    Args:
        open_part: opens one of its files.

    Raises:
        CaptureError: a file cannot be read.
        NoDatagramsError: another tool recorded it, and it has topics only.
    """
    files = files_of(path)
    whole = (path / METADATA).exists()
    if not files or not (whole or len(files) == 1):
        return None
    with ExitStack() as opened:
        parts = [opened.enter_context(closing(part)) for part in _parts(path, files, open_part)]
        if not whole:
            return None
        opened.pop_all()
    return FolderSource(path, parts)


def _parts(path: Path, files: Sequence[Path], open_part: Callable[[Path], Source]) -> Iterator[Source]:
    """Open the files of a directory; either all contain datagrams, or all contain topics only."""
    topics: list[Any] = []
    reasons: list[str] = []
    for number, file in enumerate(files):
        try:
            part = open_part(file)
        except NoDatagramsError as error:
            topics += error.files
            reasons.append(str(error))
            part = None
        if part is not None:
            yield part
        if len(reasons) not in {0, number + 1}:
            raise CaptureError(
                f"{path}: some files hold datagrams and others topics only; name them one by one"
            )
    if reasons:
        refusal = NoDatagramsError(reasons[0])
        refusal.files = topics
        raise refusal


_MOST_ROWS: Final = 1 << 18
_MOST_TOPICS: Final = 32767
"""Most topics: the field of a row has 15 bits."""


class NumberedTopics:
    """The topics of several recordings, numbered; equal topics have the same number.

    Attributes:
        topics: the topics; the index is the number.
    """

    def __init__(self) -> None:
        self.topics: list[RecordedTopic] = []
        self._numbers: dict[tuple[str, str, str], int] = {}

    def number(self, topic: RecordedTopic, name: str) -> int:
        """Return the number of a topic; a new topic gets the next number.

        Raises:
            CaptureError: the recording ``name`` has too many topics.
        """
        key = topic.topic, topic.type, topic.encoding
        if key not in self._numbers:
            if len(self.topics) == _MOST_TOPICS:
                raise CaptureError(f"{name}: has more than {_MOST_TOPICS:,} topics")
            self._numbers[key] = len(self.topics)
            self.topics.append(topic)
        return self._numbers[key]


class MessageSource(SourceDefaults):
    """Reads one recording.

    Attributes:
        info: information on the source, of kind ``topics``.
        statistics: ``datagrams`` counts the messages.

    Raises:
        CaptureError: a file cannot be read at all.
    """

    def __init__(self, name: str, files: Sequence[SettledFile], table: NumberedTopics) -> None:
        opened = [open_topic_file(item) for item in files]
        damage = "; ".join(str(file.failure) for file in opened if file.failure)
        self.info = SourceInfo(name, "topics", damage=damage)
        self.statistics = SourceStatistics()
        numbers = [
            {channel: table.number(topic, item.name) for channel, topic in file.topics.items()}
            for item, file in zip(files, opened, strict=True)
        ]
        self._files = sorted(zip(opened, numbers, strict=True), key=lambda pair: pair[0].start_ns)
        self.statistics.total_bytes = sum(file.size for file in opened)

    def batches(self) -> Iterator[PacketBatch]:
        """Yield all messages.

        Raises:
            CaptureError: a file is damaged or cut off; after all that could be read of all files.
        """
        failure: CaptureError | None = None
        number, position = 1, 0
        for file, numbers in self._files:
            try:
                for messages in _in_parts(map(unpacked, file.messages())):
                    batch = message_batch(messages, numbers, number)
                    number += len(batch)
                    self.statistics.datagrams += len(batch)
                    self.statistics.bytes += int(batch.length.sum())
                    self.statistics.position = position + min(file.position, file.size)
                    yield batch
            except CaptureError as error:
                failure = failure or error
            position += file.size
        self.statistics.position = position
        if failure is not None:
            raise failure

    def close(self) -> None:
        """Remove temporary copies."""
        for file, _ in self._files:
            file.close()


def _in_parts(every: Iterable[SelectedMessages]) -> Iterator[SelectedMessages]:
    """Yield at most ``_MOST_ROWS`` at once: a chunk may have millions of messages without bytes."""
    for messages in every:
        for first in range(0, len(messages.log_time), _MOST_ROWS):
            yield messages.take(slice(first, first + _MOST_ROWS))


def message_batch(messages: SelectedMessages, numbers: Mapping[int, int], first: int) -> PacketBatch:
    """Return messages as rows of a batch.

    Args:
        numbers: number of the topic of each channel.
        first: number of the first message.
    """
    count = len(messages.log_time)
    recorded = np.zeros(count, RECORDED)
    channels, places = np.unique(messages.channel_id, return_inverse=True)
    recorded["topic"] = np.array([numbers[channel] for channel in channels.tolist()], np.uint16)[
        places.reshape(-1)
    ]
    recorded["sequence"], recorded["publish_ns"] = messages.sequence, messages.publish_time
    length = messages.length.astype(np.int32)
    none, nobody = np.zeros(count, np.uint16), np.zeros(count, np.uint32)
    return PacketBatch(
        data=messages.data,
        number=np.arange(first, first + count),
        time_ns=messages.log_time,
        frame_offset=messages.offset,
        frame_length=length,
        offset=messages.offset,
        length=length,
        original_length=np.full(count, -1, np.int32),
        link_type=none,
        source_address=nobody,
        source_port=none,
        destination_address=nobody,
        destination_port=none,
        ip_version=np.full(count, 4, np.uint8),
        capture_findings=nobody,
        recorded=recorded,
    )


METADATA: Final = "metadata.yaml"
"""The file that every rosbag2 directory has."""
_SQLITE: Final = b"SQLite format 3\0"
_ZSTD: Final = b"\x28\xb5\x2f\xfd"
_BATCH_BYTES: Final = 4 << 20
_ROWS: Final = 8192
"""Rows of a database that are read at once."""
_MOST_HELD: Final = 128 << 20
_LARGEST: Final = 256 << 20
"""Most bytes of a message that is compressed on its own."""


class RecordedMessage(NamedTuple):
    """One ROS message of a recording.

    Attributes:
        time_ns: time of recording, ns since 1970.
        topic: with a leading slash.
        type: ROS type name.
        cdr: the bytes, encapsulation and body.
    """

    time_ns: int
    topic: str
    type: str
    cdr: bytes


class RecordedBlock(NamedTuple):
    """Messages of one topic as columns; each array has one element for each message.

    Attributes:
        topic: with a leading slash.
        time_ns: time of recording, i64, ns since 1970.
        data: buffer that ``offset`` points into, u8.
        offset: offset of the first byte in ``data``, i64, encapsulation included.
        length: number of bytes, i32.
    """

    topic: str
    time_ns: Integers
    data: Octets
    offset: Integers
    length: NDArray[np.int32]


class Rosbag:
    """The ROS messages of a recording that are CDR and have a named type.

    Attributes:
        path: a rosbag2 directory, or one file of it.
        files: the files, in order.
    """

    def __init__(self, path: Path, files: Sequence[Path]) -> None:
        self.path, self.files = path, files

    @cached_property
    def _opened(self) -> list[tuple[TopicFile, dict[int, RecordedTopic]]]:
        """The files, each with its selected topics by channel.

        Raises:
            CaptureError: a file cannot be read, or not completely.
        """
        opened = [open_topic_file(SettledFile(file, str(file))) for file in self.files]
        for failure in filter(None, (file.failure for file in opened)):
            raise CaptureError(str(failure).removesuffix("; all before was read")) from failure
        return [
            (file, {at: item for at, item in file.topics.items() if item.encoding == "cdr" and item.type})
            for file in opened
        ]

    def topics(self) -> dict[str, str]:
        """Return the type of each topic.

        Raises:
            CaptureError: a file cannot be read.
        """
        return {item.topic: item.type for _, topics in self._opened for item in topics.values()}

    def messages(self, topics: Collection[str]) -> Iterator[RecordedMessage]:
        """Yield the messages of some topics, file by file, in order of time within each file.

        Raises:
            CaptureError: a file is damaged or cut off; after all messages before that place.
        """
        for file, channels in self._opened:
            selection = {at: item for at, item in channels.items() if item.topic in topics}
            parts = map(unpacked, file.messages(selection))
            for messages in parts if file.ordered else _all_sorted(parts):
                columns = (messages.channel_id, messages.log_time, messages.offset, messages.length)
                for channel, time_ns, start, size in zip(*(item.tolist() for item in columns), strict=True):
                    cdr = messages.data[start : start + size].tobytes()
                    yield RecordedMessage(time_ns, selection[channel].topic, selection[channel].type, cdr)

    def blocks(self, topics: Collection[str]) -> Iterator[RecordedBlock]:
        """Yield the messages of some topics in blocks.

        Raises:
            CaptureError: as ``messages``.
        """
        for file, channels in self._opened:
            selection = {at: item.topic for at, item in channels.items() if item.topic in topics}
            for messages in map(unpacked, file.messages(selection)):
                for channel in np.unique(messages.channel_id).tolist():
                    own = messages.take(messages.channel_id == channel)
                    length = own.length.astype(np.int32)
                    yield RecordedBlock(selection[channel], own.log_time, own.data, own.offset, length)


def open_rosbag(path: str | Path) -> Rosbag:
    """Open a rosbag2 directory, a ``.db3`` or an MCAP file.

    Raises:
        CaptureError: ``path`` is not readable as such.
    """
    path = Path(path)
    if not path.is_dir():
        storage_of(path)
        return Rosbag(path, (path,))
    files = tuple(file for file in files_of(path) if storage_of(file))
    if not files:
        raise CaptureError(f"{path}: is not a rosbag2 directory: it contains no .mcap and no .db3 file")
    return Rosbag(path, files)


def files_of(folder: Path) -> list[Path]:
    """Return the recordings in a directory, in the order that its metadata gives if it has some."""
    metadata = folder / METADATA
    files = sorted((*folder.glob("*.mcap"), *folder.glob("*.db3"), *folder.glob("*.zstd")))
    if metadata.exists():
        try:
            entries = YAML(typ="safe").load(metadata)["rosbag2_bagfile_information"]["relative_file_paths"]
            listed = [folder / str(name) for name in entries if (folder / str(name)).exists()]
        except (OSError, YAMLError, KeyError, TypeError, ValueError):
            return files
        return listed or files
    return files


def storage_of(path: Path) -> str:
    """Return the storage kind of a file, from its first bytes: ``db3`` or ``mcap``.

    Raises:
        CaptureError: it is neither.
    """
    with os_errors(f"{path}: cannot be opened"), path.open("rb") as file:
        head = file.read(len(_SQLITE))
    if head.startswith(_SQLITE):
        return "db3"
    if head.startswith(MAGIC):
        return "mcap"
    if head.startswith(_ZSTD):
        raise CaptureError(f"{path}: is compressed as a whole; unpack it first: zstd -d {path.name}")
    raise CaptureError(f"{path}: contains no ROS messages; give a rosbag2 directory, .db3 or .mcap file")


class TopicFile(ABC):
    """One file of a recording.

    Attributes:
        topics: topics by channel number.
        ordered: whether ``messages`` yields them in order of time.
        failure: the error if not all topics could be read; raised again when the messages are read.
        start_ns: time of the first message; 0 if there is none.
        size: bytes of the file.
        position: bytes read so far.
    """

    def __init__(self, file: SettledFile) -> None:
        self._file = file
        self.topics: dict[int, RecordedTopic] = {}
        self.ordered = True
        self.failure: CaptureError | None = None
        self.start_ns = self.position = 0
        self.size = file.path.stat().st_size

    @abstractmethod
    def messages(self, channels: Collection[int] | None = None) -> Iterator[SelectedMessages]:
        """Yield the messages of some channels, in order of time as far as they fit into memory.

        Args:
            channels: channel numbers, keys of ``topics``; None: all.

        Raises:
            CaptureError: it is damaged or cut off; after all that could be read.
        """

    def close(self) -> None:
        """Remove the temporary copy, if it is one."""
        self._file.close()


class _Mcap(TopicFile):
    def __init__(self, file: SettledFile) -> None:
        super().__init__(file)
        self._summary: Summary | None = None
        with suppress(CaptureError), readable(file.path) as reader:
            summary = reader.get_summary()
            self._summary = summary if is_indexed(summary) else None
        if self._summary is not None:
            assert self._summary.statistics is not None, "it is indexed"
            self.start_ns = self._summary.statistics.message_start_time
            for channel in self._summary.channels.values():
                self._learn_channel(channel, self._summary.schemas)
            return
        self.ordered = False
        schemas: dict[int, Schema] = {}
        times = []
        try:
            for record in scanned(file.path, file.name):
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    self._learn_channel(record, schemas)
                else:
                    times.append(int(record.log_time.min()))
        except CaptureError as error:
            self.failure = error
        self.start_ns = min(times, default=0)

    def _learn_channel(self, channel: Channel, schemas: Mapping[int, Schema]) -> None:
        schema = schemas.get(channel.schema_id)
        self.topics[channel.id] = RecordedTopic(
            channel.topic,
            schema.name if schema else "",
            channel.message_encoding,
            schema.encoding if schema else "",
            schema.data if schema else b"",
            dict(channel.metadata),
        )

    def messages(self, channels: Collection[int] | None = None) -> Iterator[SelectedMessages]:
        selection = self.topics if channels is None else channels
        return self._scanned(selection) if self._summary is None else self._indexed(self._summary, selection)

    def _scanned(self, selection: Collection[int]) -> Iterator[SelectedMessages]:
        for record in scanned(self._file.path, self._file.name):
            if isinstance(record, SelectedMessages):
                self.position += len(record.data)
                described = np.isin(record.channel_id, list(self.topics))
                yield from _all_sorted([record.take(np.isin(record.channel_id, list(selection)))])
                if not described.all():
                    raise CaptureError(
                        f"{self._file.name}: is damaged: a message of no channel; all before was read"
                    )

    def _indexed(self, summary: Summary, selection: Collection[int]) -> Iterator[SelectedMessages]:
        indexes = sorted(
            (
                item
                for item in summary.chunk_indexes
                if not item.message_index_offsets.keys().isdisjoint(selection)
            ),
            key=lambda item: (item.message_start_time, item.chunk_start_offset),
        )
        parts: list[SelectedMessages] = []
        size = 0
        failure: CaptureError | None = None
        with readable(self._file.path), self._file.path.open("rb") as file:
            for place, index in enumerate(indexes, 1):
                try:
                    parts.append(chunk_content(file, self._file.name, index, selection))
                    size += len(parts[-1].data)
                except CaptureError as error:
                    failure = failure or error
                self.position += index.chunk_length
                if size < _BATCH_BYTES and place < len(indexes):
                    continue
                until = indexes[place].message_start_time if place < len(indexes) else None
                ready, parts = _released(parts, None if size > _MOST_HELD else until)
                size = sum(len(part.data) for part in parts)
                if ready is not None:
                    yield ready
        if failure is not None:
            raise failure


class _Database(TopicFile):
    def __init__(self, file: SettledFile) -> None:
        super().__init__(file)
        path = file.path
        first = next(query(path, "SELECT min(timestamp) FROM messages", ()))[0]
        self.start_ns = first if isinstance(first, int) else 0
        texts: dict[str, tuple[str, str]] = {}
        if list(query(path, "SELECT name FROM sqlite_master WHERE name = 'message_definitions'", ())):
            descriptions = query(
                path, "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions", ()
            )
            texts = {str(kind): (str(encoding), str(text)) for kind, encoding, text in descriptions}
        columns = [row[1] for row in query(path, "PRAGMA table_info(topics)", ())]
        offered = "offered_qos_profiles" if "offered_qos_profiles" in columns else "''"
        rows = query(path, f"SELECT id, name, type, serialization_format, {offered} FROM topics", ())  # noqa: S608  a name of ours
        for number, name, kind, encoding, qos in rows:
            if not all(isinstance(word, str) for word in (name, kind, encoding)):
                raise CaptureError(
                    f"{path}: is not a readable rosbag2 database: the name or type of a topic is not text"
                )
            schema_encoding, text = texts.get(kind, ("", ""))
            metadata = {"offered_qos_profiles": str(qos)} if qos else {}
            self.topics[number] = RecordedTopic(
                name, kind, encoding, schema_encoding, text.encode(), metadata
            )

    def messages(self, channels: Collection[int] | None = None) -> Iterator[SelectedMessages]:
        rows: list[tuple[int, int, bytes]] = []
        size = 0
        condition = "" if channels is None else f"WHERE topic_id IN ({','.join('?' * len(channels))})"
        text = f"SELECT topic_id, timestamp, data FROM messages {condition} ORDER BY timestamp, id"  # noqa: S608  only question marks are put in
        failure: CaptureError | None = None
        try:
            for topic, time_ns, data in query(self._file.path, text, tuple(channels or ())):
                rows.append(self._checked(topic, time_ns, data))
                size += len(data)
                if len(rows) >= _ROWS or size >= _BATCH_BYTES:
                    self.position += size
                    yield _of_rows(rows)
                    rows, size = [], 0
        except CaptureError as error:
            failure = error
        if rows:
            yield _of_rows(rows)
        if failure is not None:
            raise failure

    def _checked(self, topic: Any, time_ns: Any, data: Any) -> tuple[int, int, bytes]:
        """Return a row if its values have the right types, which SQLite does not enforce.

        Raises:
            CaptureError: the row is not a message.
        """
        if topic in self.topics and isinstance(time_ns, int) and isinstance(data, bytes):
            return topic, time_ns, data
        raise CaptureError(
            f"{self._file.name}: is not a readable rosbag2 database: a message has no bytes, time or topic"
        )


def open_topic_file(file: SettledFile) -> TopicFile:
    """Open one file of a recording.

    Raises:
        CaptureError: it cannot be read at all.
    """
    return _Database(file) if storage_of(file.path) == "db3" else _Mcap(file)


def _of_rows(rows: Sequence[tuple[int, int, bytes]]) -> SelectedMessages:
    topics, times, messages = zip(*rows, strict=True)
    length = np.array([len(data) for data in messages], np.int64)
    time_ns = np.array(times, np.int64)
    data = np.frombuffer(b"".join((*messages, bytes(PADDING))), np.uint8)
    none = np.zeros(len(rows), np.uint32)
    return SelectedMessages(
        np.array(topics), time_ns, data, np.cumsum(length) - length, length, none, time_ns
    )


def _released(
    parts: Sequence[SelectedMessages], until: int | None
) -> tuple[SelectedMessages | None, list[SelectedMessages]]:
    """Return the messages before a time (None: all), in order of time, and the remaining ones."""
    if not parts:
        return None, []
    joined = joined_messages(parts)
    if until is None and (joined.log_time[1:] >= joined.log_time[:-1]).all():
        return joined, []
    order = np.argsort(joined.log_time, kind="stable")
    count = len(order) if until is None else int(np.searchsorted(joined.log_time[order], until, "left"))
    rest = order[count:]
    ready = joined.take(order[:count]) if count else None
    return ready, [_compact(joined.take(rest))] if len(rest) else []


def _compact(messages: SelectedMessages) -> SelectedMessages:
    """Return the messages over a new buffer that holds nothing else."""
    offset = np.cumsum(messages.length) - messages.length
    data = np.zeros(int(messages.length.sum()) + PADDING, np.uint8)
    copy_rows(data, offset, messages.data, messages.offset, messages.length)
    return messages._replace(data=data, offset=offset)


def unpacked(part: SelectedMessages) -> SelectedMessages:
    """Unpack the messages that rosbag2 compressed one by one; CDR never begins with zstd's magic number.

    Raises:
        CaptureError: a compressed message is damaged.
    """
    head = gather(part.data, part.offset, len(_ZSTD)).view("<u4").reshape(-1)
    packed = np.flatnonzero((head == int.from_bytes(_ZSTD, "little")) & (part.length > len(_ZSTD)))
    if not len(packed):
        return part
    unpacker, messages = zstandard.ZstdDecompressor(), []
    for row in packed.tolist():
        start = int(part.offset[row])
        try:
            data = part.data[start : start + int(part.length[row])].tobytes()
            messages.append(unpacker.decompress(data, max_output_size=_LARGEST))
        except zstandard.ZstdError as error:
            raise CaptureError(f"a message that is compressed on its own is damaged: {error}") from None
    offset, length = part.offset.copy(), part.length.copy()
    length[packed] = [len(data) for data in messages]
    offset[packed] = len(part.data) + np.cumsum(length[packed]) - length[packed]
    added = np.frombuffer(b"".join((*messages, bytes(PADDING))), np.uint8)
    return part._replace(data=np.concatenate([part.data, added]), offset=offset, length=length)


def _all_sorted(parts: Iterable[SelectedMessages]) -> list[SelectedMessages]:
    """Return all messages in order of time, as one part; empty if there is none."""
    ready, _ = _released([*parts], None)
    return [] if ready is None else [ready]


@contextmanager
def readable(path: Path) -> Iterator[McapReader]:
    """Yield a reader of an MCAP file; its errors become one clear line.

    Raises:
        CaptureError: the file is damaged or cut off.
    """
    try:
        with path.open("rb") as file:
            yield make_reader(file)
    except CaptureError:
        raise
    except Exception as error:  # noqa: BLE001  on damaged files the reader raises anything, even MemoryError
        raise CaptureError(f"{path}: is damaged or cut off: {str(error) or type(error).__name__}") from None


def query(path: Path, text: str, values: tuple[Any, ...]) -> Iterator[Any]:
    """Yield the rows of a database query.

    Raises:
        CaptureError: it is not a readable rosbag2 database.
    """
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as database:
            yield from database.execute(text, values)
    except (sqlite3.Error, UnicodeDecodeError, MemoryError) as error:  # the message may not be valid text
        why = printable(str(error)) if isinstance(error, sqlite3.Error) else "damaged"
        raise CaptureError(f"{path}: is not a readable rosbag2 database: {why}") from None
