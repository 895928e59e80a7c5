"""Recordings of other tools as ROS messages: rosbag2 directories, their ``.db3`` files, and any MCAP.

What is read is the CDR that was recorded, not decoded: it goes into a space packet as it is.
"""

from __future__ import annotations

import sqlite3
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from edoras_tools.errors import CaptureError
from edoras_tools.wire.mcap import MAGIC

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    from mcap.reader import McapReader

_SQLITE = b"SQLite format 3\0"
_ZSTD = b"\x28\xb5\x2f\xfd"
_CDR = "cdr"


class RecordedMessage(NamedTuple):
    """One ROS message of a recording.

    Attributes:
        time_ns: when it was recorded, ns since 1970.
        topic: with a leading slash, as ROS writes it.
        type: ROS type name.
        cdr: encapsulation and body.
    """

    time_ns: int
    topic: str
    type: str
    cdr: bytes


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
        """Return the topics that hold CDR messages, with their types.

        Raises:
            CaptureError: a file cannot be read.
        """
        found: dict[str, str] = {}
        for file in self.files:
            found |= _database_topics(file) if _kind(file) == "db3" else _mcap_topics(file)
        return found

    def messages(self, topics: Collection[str]) -> Iterator[RecordedMessage]:
        """Yield the messages of some topics, file by file, in order of time within each.

        Raises:
            CaptureError: a file is damaged or cut off; after all messages before that place.
        """
        for file in self.files:
            yield from _database(file, topics) if _kind(file) == "db3" else _mcap(file, topics)


def open_rosbag(path: str | Path) -> Rosbag:
    """Open a rosbag2 directory, a ``.db3`` or an MCAP file.

    Raises:
        CaptureError: there is nothing that can be read.
    """
    path = Path(path)
    if not path.is_dir():
        _kind(path)
        return Rosbag(path, (path,))
    files = tuple(file for file in _listed(path) if _kind(file))
    if not files:
        raise CaptureError(f"{path}: is no rosbag2 directory: it holds no .mcap and no .db3 file")
    return Rosbag(path, files)


def _listed(folder: Path) -> list[Path]:
    """Return the files of a rosbag2 directory in the order that its metadata gives."""
    found = sorted((*folder.glob("*.mcap"), *folder.glob("*.db3"), *folder.glob("*.zstd")))
    metadata = folder / "metadata.yaml"
    if metadata.exists():
        from ruamel.yaml import YAML
        from ruamel.yaml.error import YAMLError

        try:
            said = YAML(typ="safe").load(metadata)["rosbag2_bagfile_information"]["relative_file_paths"]
            names = [str(name) for name in said]
        except (OSError, YAMLError, KeyError, TypeError, ValueError):
            return found
        listed = [folder / name for name in names if (folder / name).exists()]
        return listed or found
    return found


def _kind(path: Path) -> str:
    """Tell what a file is by its first bytes."""
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
    raise CaptureError(f"{path}: holds no ROS messages: rosbag2 directories, .db3 and .mcap files do")


def _mcap_topics(path: Path) -> dict[str, str]:
    with _readable(path) as reader:
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
    with _readable(path) as reader:
        for schema, channel, message in reader.iter_messages(topics):
            if channel.message_encoding == _CDR and schema is not None:
                yield RecordedMessage(message.log_time, channel.topic, schema.name, message.data)


@contextmanager
def _readable(path: Path) -> Iterator[McapReader]:
    """Give a reader; what it stumbles over becomes one clear line."""
    from mcap.reader import make_reader

    try:
        with path.open("rb") as file:
            yield make_reader(file)
    except Exception as error:  # noqa: BLE001  damage comes out of that reader as anything, MemoryError included
        raise CaptureError(f"{path}: is damaged or cut off: {str(error) or type(error).__name__}") from None


def _database_topics(path: Path) -> dict[str, str]:
    rows = _query(path, "SELECT name, type FROM topics WHERE serialization_format = ?", (_CDR,))
    return dict(rows)


def _database(path: Path, topics: Collection[str]) -> Iterator[RecordedMessage]:
    chosen = list(topics)
    marks = ",".join("?" * len(chosen))
    query = (
        "SELECT messages.timestamp, topics.name, topics.type, messages.data FROM messages "  # noqa: S608  only question marks are put in
        "JOIN topics ON topics.id = messages.topic_id "
        f"WHERE topics.serialization_format = ? AND topics.name IN ({marks}) ORDER BY messages.timestamp"
    )
    for time_ns, topic, kind, data in _query(path, query, (_CDR, *chosen)):
        yield RecordedMessage(time_ns, topic, kind, bytes(data))


def _query(path: Path, query: str, values: tuple[str, ...]) -> Iterator[Any]:
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as database:
            yield from database.execute(query, values)
    except sqlite3.Error as error:
        raise CaptureError(f"{path}: is no readable rosbag2 database: {error}") from None
