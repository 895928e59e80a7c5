"""Reads recordings without datagrams as a ``Source`` whose rows are messages, in order of time.

A row contains the bytes of a message as recorded. It has no frame and no address; ``PacketBatch.recorded``
has the recording's other fields besides the time. The files of a directory follow each other in order of
their first message.
"""

from __future__ import annotations

from contextlib import ExitStack, closing
from itertools import chain
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from msgspec.structs import replace

from edoras_tools.errors import CaptureError, NoDatagramsError
from edoras_tools.io import Source, SourceDefaults
from edoras_tools.io.formats.merge import MergedSource
from edoras_tools.io.formats.rosbag2.reader import METADATA, files_of, open_topic_file, unpacked
from edoras_tools.model import RECORDED, HostCounters, PacketBatch, SourceInfo, SourceStatistics

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from edoras_tools.io.formats.capture_file import SettledFile
    from edoras_tools.io.formats.mcap.messages import SelectedMessages
    from edoras_tools.mission.model import RecordedTopic


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
