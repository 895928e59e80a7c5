"""Reads recordings of other tools as ROS messages: rosbag2 directories, ``.db3`` files, and any MCAP.

The recorded CDR is not decoded: it goes into a space packet unchanged.
"""

from __future__ import annotations

import sqlite3
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from mcap.reader import make_reader
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from edoras_tools.errors import CaptureError
from edoras_tools.io.formats.mcap.messages import chunk_messages, is_indexed
from edoras_tools.io.topics.names import MAGIC
from edoras_tools.mission.report import printable

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from mcap.reader import McapReader
    from numpy.typing import NDArray

METADATA: Final = "metadata.yaml"
"""The file that every rosbag2 directory has."""
_SQLITE = b"SQLite format 3\0"
_ZSTD = b"\x28\xb5\x2f\xfd"
_CDR = "cdr"
_ROS2MSG = "ros2msg"
_ROWS = 16384
_BYTES = 4 << 20
"""Messages that are read one by one are put together up to one of these."""


class RecordedMessage(NamedTuple):
    """One ROS message of a recording.

    Attributes:
        time_ns: when it was recorded, ns since 1970.
        topic: with a leading slash.
        type: ROS type name.
        cdr: encapsulation and body.
    """

    time_ns: int
    topic: str
    type: str
    cdr: bytes


class RecordedBlock(NamedTuple):
    """Messages of one topic in columns, arrays one element a message.

    Attributes:
        topic: with a leading slash.
        time_ns: i64, when each was recorded, ns since 1970.
        data: u8, what ``offset`` points into.
        offset: i64, first byte of each, encapsulation included.
        length: i32, bytes of each.
    """

    topic: str
    time_ns: NDArray[np.int64]
    data: NDArray[np.uint8]
    offset: NDArray[np.int64]
    length: NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class Rosbag:
    """A recording made by any ROS 2 tool.

    Attributes:
        path: a rosbag2 directory, or one file of it.
        files: the files, in order.
    """

    path: Path
    files: tuple[Path, ...]

    def topics(self) -> dict[str, str]:
        """Return the topics that have CDR messages, with their types.

        Raises:
            CaptureError: a file cannot be read.
        """
        found: dict[str, str] = {}
        for file in self.files:
            found |= _database_topics(file) if storage_of(file) == "db3" else _mcap_topics(file)
        return found

    def definitions(self) -> dict[str, str]:
        """Return the complete ``ros2msg`` texts that the recording holds, by type.

        Raises:
            CaptureError: a file cannot be read.
        """
        found: dict[str, str] = {}
        for file in self.files:
            if storage_of(file) == "db3":
                found |= _database_definitions(file)
                continue
            with readable(file) as reader:
                summary = reader.get_summary()
                schemas = summary.schemas.values() if summary is not None else ()
                found |= {item.name: item.data.decode() for item in schemas if item.encoding == _ROS2MSG}
        return found

    def start_ns(self) -> int:
        """Return the time of the first message, ns since 1970; 0 if there is none.

        Raises:
            CaptureError: a file cannot be read.
        """
        return min((start for file in self.files if (start := _start_ns(file))), default=0)

    def messages(self, topics: Collection[str]) -> Iterator[RecordedMessage]:
        """Yield the messages of some topics, file by file, in order of time within each file.

        Raises:
            CaptureError: a file is damaged or cut off; after all messages before that place.
        """
        for file in self.files:
            yield from _database(file, topics) if storage_of(file) == "db3" else _mcap(file, topics)

    def blocks(self, topics: Collection[str]) -> Iterator[RecordedBlock]:
        """Yield the messages of some topics as ``messages``, many at a time; of MCAP in the file's order.

        Raises:
            CaptureError: as ``messages``.
        """
        for file in self.files:
            if storage_of(file) == "db3":
                yield from _gathered(_database(file, topics))
            else:
                yield from _mcap_blocks(file, topics)


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
    found = sorted((*folder.glob("*.mcap"), *folder.glob("*.db3"), *folder.glob("*.zstd")))
    if metadata.exists():
        try:
            said = YAML(typ="safe").load(metadata)["rosbag2_bagfile_information"]["relative_file_paths"]
            names = [str(name) for name in said]
        except (OSError, YAMLError, KeyError, TypeError, ValueError):
            return found
        listed = [folder / name for name in names if (folder / name).exists()]
        return listed or found
    return found


def storage_of(path: Path) -> str:
    """Return the kind of a file, from its first bytes: ``db3`` or ``mcap``.

    Raises:
        CaptureError: it is neither.
    """
    try:
        with path.open("rb") as file:
            head = file.read(len(_SQLITE))
    except OSError as error:
        raise CaptureError(f"{path}: cannot be opened: {error.strerror or error}") from None
    if head.startswith(_SQLITE):
        return "db3"
    if head.startswith(MAGIC):
        return "mcap"
    if head.startswith(_ZSTD):
        raise CaptureError(f"{path}: is compressed as a whole; unpack it first: zstd -d {path.name}")
    raise CaptureError(f"{path}: contains no ROS messages; give a rosbag2 directory, .db3 or .mcap file")


def _mcap_topics(path: Path) -> dict[str, str]:
    with readable(path) as reader:
        summary = reader.get_summary()
        if summary is not None and summary.channels:
            pairs = [
                (summary.schemas.get(channel.schema_id), channel) for channel in summary.channels.values()
            ]
        else:
            pairs = [(schema, channel) for schema, channel, _ in reader.iter_messages()]
        return {
            channel.topic: schema.name
            for schema, channel in pairs
            if channel.message_encoding == _CDR and schema is not None
        }


def _mcap(path: Path, topics: Collection[str]) -> Iterator[RecordedMessage]:
    with readable(path) as reader:
        for schema, channel, message in reader.iter_messages(topics):
            if channel.message_encoding == _CDR and schema is not None:
                yield RecordedMessage(message.log_time, channel.topic, schema.name, message.data)


def _start_ns(path: Path) -> int:
    if storage_of(path) == "db3":
        first = next(query(path, "SELECT min(timestamp) FROM messages", ()))[0]
        return first if isinstance(first, int) else 0
    with readable(path) as reader:
        summary = reader.get_summary()
        if summary is not None and summary.statistics is not None:
            return summary.statistics.message_start_time
        return min((message.log_time for _, _, message in reader.iter_messages()), default=0)


def _mcap_blocks(path: Path, topics: Collection[str]) -> Iterator[RecordedBlock]:
    with readable(path) as reader:
        summary = reader.get_summary()
    if summary is None or not is_indexed(summary):
        yield from _gathered(_mcap(path, topics))
        return
    channels = {
        item.id: item.topic
        for item in summary.channels.values()
        if item.topic in topics and item.message_encoding == _CDR
    }
    with readable(path), path.open("rb") as file:
        for found in chunk_messages(file, str(path), summary, channels):
            for channel in np.unique(found.channel_id).tolist():
                rows = np.flatnonzero(found.channel_id == channel)
                length = found.length[rows].astype(np.int32)
                yield RecordedBlock(
                    channels[channel], found.log_time[rows], found.data, found.offset[rows], length
                )


def _gathered(messages: Iterator[RecordedMessage]) -> Iterator[RecordedBlock]:
    """Put messages together by topic; what came before a failure is yielded before it is raised."""
    waiting: dict[str, list[RecordedMessage]] = {}
    size: dict[str, int] = {}
    failure: CaptureError | None = None
    try:
        for message in messages:
            topic = message.topic
            waiting.setdefault(topic, []).append(message)
            size[topic] = size.get(topic, 0) + len(message.cdr)
            if len(waiting[topic]) >= _ROWS or size[topic] >= _BYTES:
                size[topic] = 0
                yield _joined_messages(waiting.pop(topic))
    except CaptureError as error:
        failure = error
    for rest in waiting.values():
        yield _joined_messages(rest)
    if failure is not None:
        raise failure


def _joined_messages(messages: Sequence[RecordedMessage]) -> RecordedBlock:
    length = np.array([len(message.cdr) for message in messages], np.int32)
    offset = np.cumsum(length, dtype=np.int64) - length
    data = np.frombuffer(b"".join(message.cdr for message in messages), np.uint8)
    time_ns = np.array([message.time_ns for message in messages], np.int64)
    return RecordedBlock(messages[0].topic, time_ns, data, offset, length)


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


def _database_topics(path: Path) -> dict[str, str]:
    rows = list(query(path, "SELECT name, type FROM topics WHERE serialization_format = ?", (_CDR,)))
    if not all(isinstance(word, str) for row in rows for word in row):
        raise CaptureError(
            f"{path}: is not a readable rosbag2 database: the name or type of a topic is not text"
        )
    return dict(rows)


def _database_definitions(path: Path) -> dict[str, str]:
    """Return what databases hold from ROS 2 Iron on."""
    if not list(query(path, "SELECT name FROM sqlite_master WHERE name = 'message_definitions'", ())):
        return {}
    text = "SELECT topic_type, encoded_message_definition FROM message_definitions WHERE encoding = ?"
    rows = query(path, text, (_ROS2MSG,))
    return {kind: said for kind, said in rows if isinstance(kind, str) and isinstance(said, str)}


def _database(path: Path, topics: Collection[str]) -> Iterator[RecordedMessage]:
    chosen = list(topics)
    marks = ",".join("?" * len(chosen))
    text = (
        "SELECT messages.timestamp, topics.name, topics.type, messages.data FROM messages "  # noqa: S608  only question marks are put in
        "JOIN topics ON topics.id = messages.topic_id "
        f"WHERE topics.serialization_format = ? AND topics.name IN ({marks}) ORDER BY messages.timestamp"
    )
    for time_ns, topic, kind, data in query(path, text, (_CDR, *chosen)):
        if not isinstance(time_ns, int) or not isinstance(data, bytes):  # SQLite does not enforce types
            raise CaptureError(
                f"{path}: is not a readable rosbag2 database: {topic} has a message without bytes"
            )
        yield RecordedMessage(time_ns, topic, kind, data)


def query(path: Path, text: str, values: tuple[str, ...]) -> Iterator[Any]:
    """Yield the rows that a query of a database gives.

    Raises:
        CaptureError: it is not a readable rosbag2 database.
    """
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as database:
            yield from database.execute(text, values)
    except (sqlite3.Error, UnicodeDecodeError) as error:  # SQLite's message may not be valid text
        why = "damaged" if isinstance(error, UnicodeDecodeError) else printable(str(error))
        raise CaptureError(f"{path}: is not a readable rosbag2 database: {why}") from None
