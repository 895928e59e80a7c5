"""Recordings: MCAP files that open in Foxglove, with rosbags and with any other reader as they are."""

from __future__ import annotations

import json
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from edoras_tools import __version__
from edoras_tools.errors import CaptureError
from edoras_tools.model import Finding
from edoras_tools.sinks.mcap_chunks import ChunkWriter
from edoras_tools.sinks.mcap_faults import fault_messages
from edoras_tools.sinks.mcap_file import McapFile
from edoras_tools.sinks.streams import FAULTS, Streams, Topic

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from edoras_tools.mission import Mission
    from edoras_tools.model import Columns, PacketBatch, SourceInfo, SourceStatistics
    from edoras_tools.ros import TypeStore
    from edoras_tools.sessions.faults import Fault
    from edoras_tools.structs import Structs

METADATA_NAME = "edoras"
"""The metadata record of a whole recording."""
OPENING_METADATA_NAME = "edoras_opening"
"""What is known of it when it is opened, so that a cut-off recording says it too."""

_STEPS = 8
"""When files are split by size, it is looked at so many times on the way to that size."""
_ROW_BYTES = 200
"""About what a datagram's messages take besides its frame."""


class McapSink:
    """Writes batches to an MCAP file, or to several where it is to be split.

    Messages lie in the order of the batches: of each datagram itself, whole, then the message inside it.
    ``log_time`` is the capture time, ``publish_time`` the packet's own time mapped to UTC (``MissionClock``),
    ``sequence`` the packet sequence count.

    Args:
        path: the file, replaced if it exists; when split ``NAME_0.mcap``, ``NAME_1.mcap`` and so on.
        mission: its routes become channels, its files attachments.
        types: gives the schemas.
        info: of the source, for the metadata record.
        filter: the filter that chose the datagrams, for the metadata record.
        split_bytes: begin a new file before one grows larger than about this; 0 never.
        split_ns: begin a new file when one covers this much capture time; 0 never.
        datagrams: whether to write ``/edoras/datagrams``.
        statistics: the source's, if ``/edoras/link_statistics`` is to show its kernel drops as they happen.
        structs: C structs that packets hold; None for those of cFE itself.

    Attributes:
        files: what was written, one a file, with its summary.

    Raises:
        CaptureError: from every method: the file cannot be written.
        RouteError: a route's type is not known.
    """

    def __init__(
        self,
        path: str | Path,
        mission: Mission,
        types: TypeStore,
        info: SourceInfo,
        *,
        filter: str = "",  # noqa: A002  what the option is called everywhere
        split_bytes: int = 0,
        split_ns: int = 0,
        datagrams: bool = True,
        statistics: SourceStatistics | None = None,
        structs: Structs | None = None,
    ) -> None:
        self._path = Path(path)
        self._mission = mission
        self._types = types
        self._info = info
        self._filter = filter
        self._split_bytes = split_bytes
        self._split_ns = split_ns
        self._live = statistics
        self._streams = Streams(
            mission, types, statistics, datagrams=datagrams, structs=structs, add=self._add_topic
        )
        self._faults_id = 0
        self._count = 0
        self._start_ns = 0
        self._state: Literal["open", "failed", "closed"] = "open"
        self.files: list[McapFile] = []
        self._chunks = self._open_file()

    @property
    def paths(self) -> list[Path]:
        """The files written."""
        return [file.path for file in self.files]

    def write(self, batch: PacketBatch, columns: Columns) -> None:
        """Take a batch and what was read from it."""
        first = 0
        while first < len(batch):
            last = self._make_room(batch, first)
            rows = slice(first, last)
            whole = last - first == len(batch)
            with self._failing():
                self._append(*(batch, columns) if whole else (batch.take(rows), columns.take(rows)))
            first = last

    def write_faults(self, faults: Sequence[Fault]) -> None:
        """Take what was done on purpose, with times in ns since 1970; makes the topic where it is needed."""
        with self._failing():
            if not self._faults_id:
                self._faults_id = self._add_topic(FAULTS)
            self._chunks.append([fault_messages(faults, self._faults_id)], len(faults))

    def flush(self) -> None:
        """End the chunk under way and get it out of the process: killed later, it loses what came after."""
        with self._failing():
            self._chunks.flush()

    def close(self, statistics: SourceStatistics) -> None:
        """Write what is left, the metadata and the summary; after a failed write only close the file."""
        if self._state == "open":
            with self._failing():
                self._chunks.append([self._streams.finish()], 1)
                self._close_file(statistics)
            self._state = "closed"

    def abandon(self) -> None:
        """Close the file as it is; nothing more is written."""
        self._state = "failed"
        self._chunks.abandon()
        self.files[-1].abandon()

    def _add_topic(self, topic: Topic) -> int:
        """Make a topic of whose kind there may be none; return its channel."""
        self._chunks.flush()  # until then the file belongs to the thread
        structs = self._streams.structs
        types = structs.types if topic.type in structs.definitions else self._types
        file = self.files[-1]
        return file.add_channel(
            topic.name, file.add_schema(topic.type, types.definition(topic.type)), topic.metadata
        )

    def _append(self, batch: PacketBatch, columns: Columns) -> None:
        self._attach(int(batch.time_ns[0]))
        self._chunks.append(self._streams.messages(batch, columns), len(batch))
        self._count += len(batch)

    def _make_room(self, batch: PacketBatch, first: int) -> int:
        """Begin a new file if row ``first`` needs one; return how far the batch may go into the file."""
        last = len(batch)
        now = int(batch.time_ns[first])
        if self._split_ns and self._count and now - self._start_ns >= self._split_ns:
            self._next_file()
        if self._split_bytes and self._count and self._chunks.size_bound >= self._split_bytes:
            self.flush()
            if self.files[-1].size >= self._split_bytes * (1 - 1 / _STEPS):
                self._next_file()
        if self._count == 0:
            self._start_ns = now
        if self._split_ns:
            late = np.flatnonzero(batch.time_ns[first:] - self._start_ns >= self._split_ns)
            last = first + int(late[0]) if len(late) else last
        if self._split_bytes:
            filled = np.cumsum(batch.frame_length[first:last].astype(np.int64) + _ROW_BYTES)
            step = int(np.searchsorted(filled, self._split_bytes // _STEPS))
            last = min(last, first + max(step, 1))
        return last

    def _next_file(self) -> None:
        with self._failing():
            self._close_file(self._live)
            self._chunks = self._open_file()

    def _open_file(self) -> ChunkWriter:
        path = self._path
        if self._split_bytes or self._split_ns:
            path = path.with_name(f"{path.stem}_{len(self.files)}{path.suffix}")
        file = McapFile(path)
        self.files.append(file)
        try:
            self._begin(file)
        except CaptureError:
            file.abandon()
            raise
        return ChunkWriter(file)

    def _begin(self, file: McapFile) -> None:
        """Write what comes before the messages."""
        self._count = self._faults_id = 0
        streams = self._streams
        schemas = {name: file.add_schema(name, text) for name, text in streams.definitions.items()}
        streams.number(
            [file.add_channel(topic.name, schemas[topic.type], topic.metadata) for topic in streams.topics]
        )
        file.add_metadata(OPENING_METADATA_NAME, self._opening())

    def _close_file(self, statistics: SourceStatistics | None) -> None:
        file = self.files[-1]
        self._chunks.close()
        self._attach(0)
        counted = (
            {}
            if statistics is None
            else {"kernel_drops": statistics.kernel_drops, "skipped": statistics.skipped}
        )
        file.add_metadata(
            METADATA_NAME,
            {
                **self._opening(),
                "datagrams": str(self._count),
                "clock_offset_ns": json.dumps(self._streams.clock.offsets()),
                **{key: str(value) for key, value in counted.items()},
            },
        )
        file.finish()

    def _attach(self, time_ns: int) -> None:
        """Write the mission files before the first chunk of a file, so that a cut-off recording has them."""
        file = self.files[-1]
        if self._count == 0 and not file.summary.attachments:
            for name, data in self._mission.files.items():
                file.add_attachment(name, "application/yaml", data, max(time_ns, 0))

    def _opening(self) -> dict[str, str]:
        return {
            "tool": "edoras-tools",
            "version": __version__,
            "source": self._info.name,
            "source_kind": self._info.kind,
            "filter": self._filter,
            "time_resolution_ns": str(self._info.time_resolution_ns),
            "snap_length": str(self._info.snap_length),
            "findings": json.dumps({bit.label: int(bit) for bit in Finding}),
        }

    @contextmanager
    def _failing(self) -> Iterator[None]:
        """After the first failed write the file is closed as it is: closing the sink must not fail again."""
        if self._state != "open":
            raise CaptureError(f"{self.files[-1].path}: the recording is {self._state}")
        try:
            yield
        except CaptureError:
            self.abandon()
            raise
