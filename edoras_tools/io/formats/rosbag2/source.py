"""Reads recordings without datagrams as a ``Source``: its rows are messages, in order of time.

The rules that this file keeps:

1. Every message of every topic is a row, whatever its encoding: what cannot be read is still counted.
2. A row's bytes are the message's as recorded. There is no frame and no address; ``PacketBatch.recorded`` has
   what the recording says besides the time.
3. Rows of a file are in order of time. Chunks whose times overlap are held back until nothing earlier can
   come, up to ``_MOST_HELD`` bytes.
4. The files of a directory follow each other, in order of their first message.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import zstandard
from mcap.records import Channel, Schema

from edoras_tools.errors import CaptureError
from edoras_tools.io.formats.mcap.messages import (
    SelectedMessages,
    chunk_content,
    is_indexed,
    joined_messages,
    scanned,
)
from edoras_tools.io.formats.rosbag2.reader import query, readable, storage_of
from edoras_tools.mission.model import RecordedTopic
from edoras_tools.model import RECORDED, PacketBatch, SourceInfo, SourceStatistics
from edoras_tools.wire.arrays.window import PADDING, copy_rows, gather

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from mcap.summary import Summary

    from edoras_tools.io.formats.stream import SettledFile

_BATCH_BYTES: Final = 4 << 20
_ROWS: Final = 8192
"""Rows of a database that are read at once."""
_MOST_HELD: Final = 128 << 20
_LARGEST: Final = 256 << 20
"""Bytes of a message at the most that is compressed on its own."""
_ZSTD: Final = b"\x28\xb5\x2f\xfd"
_MOST_TOPICS: Final = 32767
"""A row's topic has 15 bits."""


class NumberedTopics:
    """The topics of several recordings, numbered: those that are alike have one number.

    Attributes:
        topics: by their number.
    """

    def __init__(self) -> None:
        self.topics: list[RecordedTopic] = []
        self._numbers: dict[tuple[str, str, str], int] = {}

    def number(self, topic: RecordedTopic, name: str) -> int:
        """Return a topic's number, a new one if it is new.

        Raises:
            CaptureError: there are too many in the recording of that name.
        """
        key = topic.topic, topic.type, topic.encoding
        if key not in self._numbers:
            if len(self.topics) == _MOST_TOPICS:
                raise CaptureError(f"{name}: has more than {_MOST_TOPICS:,} topics")
            self._numbers[key] = len(self.topics)
            self.topics.append(topic)
        return self._numbers[key]


class MessageSource:
    """Reads one recording; see the top of this file.

    Attributes:
        info: of kind ``topics``.
        statistics: ``datagrams`` counts the messages.

    Raises:
        CaptureError: a file cannot be read at all.
    """

    def __init__(self, name: str, files: Sequence[SettledFile], table: NumberedTopics) -> None:
        self.info = SourceInfo(name, "topics")
        self.statistics = SourceStatistics()
        opened: list[_TopicFile] = [
            _Database(item, table) if storage_of(item.path) == "db3" else _Mcap(item, table) for item in files
        ]
        self._files = sorted(opened, key=lambda item: item.start_ns)
        self.statistics.total_bytes = sum(item.size for item in opened)

    def batches(self) -> Iterator[PacketBatch]:
        """Yield all messages.

        Raises:
            CaptureError: a file is damaged or cut off; after all that could be read of all files.
        """
        failure: CaptureError | None = None
        number, done = 1, 0
        for file in self._files:
            try:
                for found in map(_unpacked, file.messages()):
                    batch = _batch(found, file.numbers, number)
                    number += len(batch)
                    self.statistics.datagrams += len(batch)
                    self.statistics.bytes += int(batch.length.sum())
                    self.statistics.position = done + min(file.position, file.size)
                    yield batch
            except CaptureError as error:
                failure = failure or error
            done += file.size
        self.statistics.position = done
        if failure is not None:
            raise failure

    def close(self) -> None:
        """Remove temporary copies."""
        for file in self._files:
            file.close()


class _TopicFile(ABC):
    """One file of a recording.

    Attributes:
        numbers: of its topics, by channel.
        start_ns: time of its first message; 0 if it has none.
        size: in bytes.
        position: how much of it was read.
    """

    def __init__(self, file: SettledFile, table: NumberedTopics) -> None:
        self._file = file
        self._table = table
        self.numbers: dict[int, int] = {}
        self.start_ns = self.position = 0
        self.size = file.path.stat().st_size

    @abstractmethod
    def messages(self) -> Iterator[SelectedMessages]:
        """Yield its messages, in order of time as far as they fit into memory.

        Raises:
            CaptureError: it is damaged or cut off; after all that could be read.
        """

    def close(self) -> None:
        """Remove the temporary copy, if it is one."""
        self._file.close()

    def _learn(self, channel: int, topic: RecordedTopic) -> None:
        self.numbers[channel] = self._table.number(topic, self._file.name)


class _Mcap(_TopicFile):
    def __init__(self, file: SettledFile, table: NumberedTopics) -> None:
        super().__init__(file, table)
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
        schemas: dict[int, Schema] = {}
        times = []
        with suppress(CaptureError):  # said when the messages are read
            for found in scanned(file.path, file.name):
                if isinstance(found, Schema):
                    schemas[found.id] = found
                elif isinstance(found, Channel):
                    self._learn_channel(found, schemas)
                else:
                    times.append(int(found.log_time.min()))
        self.start_ns = min(times, default=0)

    def _learn_channel(self, channel: Channel, schemas: Mapping[int, Schema]) -> None:
        schema = schemas.get(channel.schema_id)
        self._learn(
            channel.id,
            RecordedTopic(
                channel.topic,
                schema.name if schema else "",
                channel.message_encoding,
                schema.encoding if schema else "",
                schema.data if schema else b"",
                dict(channel.metadata),
            ),
        )

    def messages(self) -> Iterator[SelectedMessages]:
        return self._scanned() if self._summary is None else self._indexed(self._summary)

    def _scanned(self) -> Iterator[SelectedMessages]:
        for found in scanned(self._file.path, self._file.name):
            if isinstance(found, SelectedMessages):
                self.position += len(found.data)
                known = np.isin(found.channel_id, list(self.numbers))
                ready, _ = _released([found.take(known)], None)
                if ready is not None:
                    yield ready
                if not known.all():
                    raise CaptureError(
                        f"{self._file.name}: is damaged: a message of no channel; all before was read"
                    )

    def _indexed(self, summary: Summary) -> Iterator[SelectedMessages]:
        indexes = sorted(
            summary.chunk_indexes, key=lambda item: (item.message_start_time, item.chunk_start_offset)
        )
        held: list[SelectedMessages] = []
        failure: CaptureError | None = None
        with readable(self._file.path), self._file.path.open("rb") as file:
            for place, index in enumerate(indexes, 1):
                try:
                    held.append(chunk_content(file, self._file.name, index, self.numbers))
                except CaptureError as error:
                    failure = failure or error
                self.position += index.chunk_length
                size = sum(len(part.data) for part in held)
                if size < _BATCH_BYTES and place < len(indexes):
                    continue
                until = indexes[place].message_start_time if place < len(indexes) else None
                ready, held = _released(held, None if size > _MOST_HELD else until)
                if ready is not None:
                    yield ready
        if failure is not None:
            raise failure


class _Database(_TopicFile):
    def __init__(self, file: SettledFile, table: NumberedTopics) -> None:
        super().__init__(file, table)
        path = file.path
        first = next(query(path, "SELECT min(timestamp) FROM messages", ()))[0]
        self.start_ns = first if isinstance(first, int) else 0
        texts: dict[str, tuple[str, str]] = {}
        if list(query(path, "SELECT name FROM sqlite_master WHERE name = 'message_definitions'", ())):
            found = query(
                path, "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions", ()
            )
            texts = {str(kind): (str(encoding), str(text)) for kind, encoding, text in found}
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
            self._learn(number, RecordedTopic(name, kind, encoding, schema_encoding, text.encode(), metadata))

    def messages(self) -> Iterator[SelectedMessages]:
        rows: list[tuple[int, int, bytes]] = []
        size = 0
        text = "SELECT topic_id, timestamp, data FROM messages ORDER BY timestamp, id"
        failure: CaptureError | None = None
        try:
            for topic, time_ns, data in query(self._file.path, text, ()):
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
        """Return a row; SQLite does not enforce types.

        Raises:
            CaptureError: it is no message.
        """
        if topic in self.numbers and isinstance(time_ns, int) and isinstance(data, bytes):
            return topic, time_ns, data
        raise CaptureError(
            f"{self._file.name}: is not a readable rosbag2 database: a message has no bytes, time or topic"
        )


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
    held: Sequence[SelectedMessages], until: int | None
) -> tuple[SelectedMessages | None, list[SelectedMessages]]:
    """Return messages before a time, in order of time, and the others; None for all."""
    if not held:
        return None, []
    joined = joined_messages(held)
    order = np.argsort(joined.log_time, kind="stable")
    count = len(order) if until is None else int(np.searchsorted(joined.log_time[order], until, "left"))
    rest = order[count:]
    ready = joined.take(order[:count]) if count else None
    return ready, [_compact(joined.take(rest))] if len(rest) else []


def _compact(found: SelectedMessages) -> SelectedMessages:
    """Return messages over a buffer that holds them alone."""
    offset = np.cumsum(found.length) - found.length
    data = np.zeros(int(found.length.sum()) + PADDING, np.uint8)
    copy_rows(data, offset, found.data, found.offset, found.length)
    return found._replace(data=data, offset=offset)


def _unpacked(found: SelectedMessages) -> SelectedMessages:
    """Unpack the messages that rosbag2 compressed one by one: CDR never begins as they do.

    Raises:
        CaptureError: one is damaged.
    """
    head = gather(found.data, found.offset, len(_ZSTD)).view("<u4").reshape(-1)
    packed = np.flatnonzero((head == int.from_bytes(_ZSTD, "little")) & (found.length > len(_ZSTD)))
    if not len(packed):
        return found
    unpacker, messages = zstandard.ZstdDecompressor(), []
    for row in packed.tolist():
        start = int(found.offset[row])
        try:
            data = found.data[start : start + int(found.length[row])].tobytes()
            messages.append(unpacker.decompress(data, max_output_size=_LARGEST))
        except zstandard.ZstdError as error:
            raise CaptureError(f"a message that is compressed on its own is damaged: {error}") from None
    offset, length = found.offset.copy(), found.length.copy()
    length[packed] = [len(data) for data in messages]
    offset[packed] = len(found.data) + np.cumsum(length[packed]) - length[packed]
    added = np.frombuffer(b"".join((*messages, bytes(PADDING))), np.uint8)
    return found._replace(data=np.concatenate([found.data, added]), offset=offset, length=length)


def _batch(found: SelectedMessages, numbers: Mapping[int, int], first: int) -> PacketBatch:
    count = len(found.log_time)
    recorded = np.zeros(count, RECORDED)
    channels, places = np.unique(found.channel_id, return_inverse=True)
    recorded["topic"] = np.array([numbers[channel] for channel in channels.tolist()], np.uint16)[
        places.reshape(-1)
    ]
    recorded["sequence"], recorded["publish_ns"] = found.sequence, found.publish_time
    length = found.length.astype(np.int32)
    none, nobody = np.zeros(count, np.uint16), np.zeros(count, np.uint32)
    return PacketBatch(
        data=found.data,
        number=np.arange(first, first + count),
        time_ns=found.log_time,
        frame_offset=found.offset,
        frame_length=length,
        offset=found.offset,
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
