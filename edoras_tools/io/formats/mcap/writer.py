"""Recordings: MCAP files that Foxglove, rosbags and any other reader can open."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from edoras_tools import __version__
from edoras_tools.errors import CaptureError, OnFailure
from edoras_tools.io import RecordingOptions, Sink
from edoras_tools.io.formats.mcap.chunks import ChunkPress, ChunkWriter
from edoras_tools.io.formats.mcap.file import McapFile, PackedChunks
from edoras_tools.io.outputs import OutputFile, part_path
from edoras_tools.io.processes import Workers, writer_killed
from edoras_tools.io.topics.edoras import fault_messages, host_messages
from edoras_tools.io.topics.messages import COUNTS_METADATA_NAME, OUTAGE_METADATA_NAME
from edoras_tools.io.topics.streams import (
    FAULTS,
    HOST_COUNTERS,
    PreparedBatch,
    RecordedStreams,
    Streams,
    Topic,
)
from edoras_tools.links import table
from edoras_tools.model import Finding, InterfaceOutage

if TYPE_CHECKING:
    from edoras_tools.io import Room
    from edoras_tools.mission import Mission
    from edoras_tools.model import Columns, HostCounters, PacketBatch, SourceInfo, SourceStatistics
    from edoras_tools.ros import TypeStore
    from edoras_tools.sessions.faults.rules import Fault

METADATA_NAME = "edoras"
"""The metadata record of a complete recording."""
OPENING_METADATA_NAME = "edoras_opening"
"""The values that exist at the start, so that a cut-off recording has them too."""

_STEPS = 8
"""When files are split by size, the size is checked this many times per file."""
_STEP_ROWS = 64
"""The fewest datagrams between two checks: each takes 1-2 ms, and a recorder that is behind loses frames."""
_LARGE = 1 << 20
"""A batch with frames of this many bytes is compressed on its own."""
_ROW_BYTES = 200
"""Approximate bytes of a datagram's messages besides its frame."""


class McapSink(Sink):
    """Writes batches to an MCAP file, or to several if it is split.

    Messages are in the order of the batches: for each datagram the complete datagram, then the message inside
    it. ``log_time`` is the capture time, ``publish_time`` the packet's own time mapped to UTC
    (``MissionClock``), ``sequence`` the packet sequence count.

    Args:
        path: the file, replaced if it exists; when split ``NAME_0.mcap``, ``NAME_1.mcap`` and so on.
        mission: its routes become channels, its files attachments.
        info: information on the source, for the metadata record.
        options: the contents, and how files are split.
        statistics: the source's, if ``/edoras/link_statistics`` is to show its kernel drops live.

    Attributes:
        files: the files written, with their summaries.
        complete: the complete ones, with the number of datagrams in each.
        datagrams: number of datagrams in the file being written.

    Raises:
        CaptureError: from every method: the file cannot be written.
        RouteError: a route's type is unknown.
    """

    def __init__(
        self,
        path: str | Path,
        mission: Mission,
        types: TypeStore,
        info: SourceInfo,
        options: RecordingOptions = RecordingOptions(),  # noqa: B008  frozen
        *,
        statistics: SourceStatistics | None = None,
    ) -> None:
        self._path = Path(path)
        self._mission = mission
        self._types = types
        self._info = info
        self._options = options
        self._live = statistics
        self._streams: Streams | RecordedStreams
        if mission.recorded:
            self._streams = RecordedStreams(mission, types, options.topics)
        else:
            self._streams = Streams(
                mission,
                types,
                statistics,
                datagrams=options.datagrams,
                structs=options.structs,
                add=self._add_topic,
                transforms=options.transforms,
                sequences=None if options.splits else options.sequences,  # parts of a batch are other batches
            )
            self._streams.endpoints = options.endpoints
        self._extras: dict[str, int] = {}
        self._noted: list[InterfaceOutage] = []
        self.datagrams = self._captured = 0
        self._number = 0
        self._start_ns = 0
        self._state: Literal["open", "failed", "closed"] = "open"
        self.files: list[McapFile] = []
        self.complete: list[tuple[OutputFile, int]] = []
        self._press = ChunkPress()
        self._workers: Workers | None = None
        self._chunks = self._open_file()
        # To split files by size, the size of what was appended has to be known.
        if options.jobs > 1 and not options.split_bytes:
            with suppress(OSError):  # without them it takes longer
                self._workers = Workers(
                    options.jobs - 1, self._packed, writer_killed(self._path), yields=options.yields
                )
                self._chunks = self._chunk_writer()

    @property
    def room(self) -> Room | None:
        """Returns memory for the source to read into, if that saves copying it; see ``Workers.lend``."""
        return self._workers.lend if self._workers else None

    @property
    def paths(self) -> list[Path]:
        """The files written."""
        return [file.path for file in self.files]

    @property
    def output(self) -> OutputFile:
        """The file being written."""
        return self.files[-1].output

    def write(self, batch: PacketBatch, columns: Columns) -> None:
        """Write a batch and its columns."""
        first = 0
        while first < len(batch):
            last = self._make_room(batch, first)
            rows = slice(first, last)
            whole = last - first == len(batch)
            with self._failing():
                self._append(*(batch, columns) if whole else (batch.take(rows), columns.take(rows)))
            first = last

    def write_faults(self, faults: Sequence[Fault]) -> None:
        """Write injected faults, with times in ns since 1970; creates the topic if it does not exist."""
        with self._failing():
            self._chunks.append([fault_messages(faults, self._extra(FAULTS))], len(faults))

    def write_host(self, host: HostCounters) -> None:
        """Write the present counters of this host's kernel; creates the topic if it does not exist."""
        with self._failing():
            self._attach(host.time_ns)
            self._chunks.append([host_messages(host, self._extra(HOST_COUNTERS), self._types)], 1)

    def _extra(self, topic: Topic) -> int:
        """Return the channel of an optional topic of ours."""
        if topic.name not in self._extras:
            self._extras[topic.name] = self._add_topic(topic)
        return self._extras[topic.name]

    def flush(self) -> None:
        """End and write the current chunk: if the process is killed, only later messages are lost."""
        with self._failing():
            self._note_outages()
            self._chunks.flush()

    def close(self, statistics: SourceStatistics) -> None:
        """Write the rest, the metadata and the summary; after a failed write only close the file."""
        if self._state == "open":
            with self._failing():
                self._chunks.append([self._streams.finish()], 1)
                self._chunks.flush()
                if self._workers:
                    self._workers.dismiss()
                self._close_file(statistics)
            self._state = "closed"
            self._end_workers()

    def forget(self, output: OutputFile) -> None:
        """Leave a complete file out of ``files`` and ``complete``."""
        self.files = [file for file in self.files if file.output is not output]
        self.complete = [item for item in self.complete if item[0] is not output]

    def abandon(self) -> None:
        """Close the file in its present state; nothing more is written."""
        self._fail()

    def _fail(self) -> None:
        self._state = "failed"
        self._end_workers()
        self.files[-1].abandon()

    def _end_workers(self) -> None:
        if self._workers:
            self._workers.close()

    def _add_topic(self, topic: Topic) -> int:
        """Create an optional topic; return its channel."""
        self._chunks.flush()  # so that its place in the file does not depend on the workers
        text = self._streams.structs.text(topic.type)
        if text is None:  # an empty text is that of an empty message
            text = self._types.definition(topic.type)
        file = self.files[-1]
        return file.add_channel(topic.name, file.add_schema(topic.type, text), topic.metadata)

    def _append(self, batch: PacketBatch, columns: Columns) -> None:
        self._attach(int(batch.time_ns[0]))
        if not self.datagrams and any(map(len, latched := self._streams.latched(int(batch.time_ns[0])))):
            self._chunks.append(latched, 1)
        prepared = self._streams.prepare(batch, columns)
        self._links.update(np.flatnonzero(np.bincount(columns.link)).tolist())
        if self._options.apart is not None:
            self._options.apart.add(batch, columns)
        if int(batch.frame_length.sum()) >= _LARGE:
            last = self._live is not None and self._live.ended
            self._chunks.append_batch(batch, columns, prepared, last=last)
        else:
            self._chunks.append(self._streams.prepared_messages(batch, columns, prepared), len(batch))
        self.datagrams += len(batch)
        self._captured += int(np.count_nonzero((batch.original_length >= 0) | (batch.recorded is not None)))

    def _packed(self, batch: PacketBatch, columns: Columns, prepared: PreparedBatch) -> list[PackedChunks]:
        """Return the chunks of a batch; a worker has this sink as it was when the first file was opened."""
        messages = self._streams.prepared_messages(batch, columns, prepared)
        return [*self._press.append(messages, len(batch)), *self._press.finish()]

    def _make_room(self, batch: PacketBatch, first: int) -> int:
        """Start a new file if row ``first`` needs one; return the end of the rows that fit into the file."""
        options, last = self._options, len(batch)
        now = int(batch.time_ns[first])
        if options.split_count and self.datagrams >= options.split_count:
            self._next_file()
        if options.split_ns and self.datagrams and now - self._start_ns >= options.split_ns:
            self._next_file()
        if options.split_bytes and self.datagrams and self._chunks.size_bound >= options.split_bytes:
            self.flush()
            if self.files[-1].size >= options.split_bytes * (1 - 1 / _STEPS):
                self._next_file()
        if self.datagrams == 0:
            self._start_ns = now
        if options.split_count:
            last = min(last, first + options.split_count - self.datagrams)
        if options.split_ns:
            late = np.flatnonzero(batch.time_ns[first:last] - self._start_ns >= options.split_ns)
            last = first + int(late[0]) if len(late) else last
        if options.split_bytes:
            filled = np.cumsum(batch.frame_length[first:last].astype(np.int64) + _ROW_BYTES)
            step = int(np.searchsorted(filled, options.split_bytes // _STEPS))
            last = min(last, first + max(step, _STEP_ROWS))
        return last

    def _next_file(self) -> None:
        with self._failing():
            self._close_file(self._live)
            self._chunks = self._open_file()

    def _open_file(self) -> ChunkWriter:
        path = part_path(self._path, self._number) if self._options.splits else self._path
        self._number += 1
        file = McapFile(path, offered=self._options.offered)
        self.files.append(file)
        with OnFailure(file.abandon):
            self._begin(file)
        return self._chunk_writer()

    def _chunk_writer(self) -> ChunkWriter:
        return ChunkWriter(self.files[-1], self._press, self._packed, self._workers)

    def _begin(self, file: McapFile) -> None:
        """Write what precedes the messages."""
        self.datagrams = self._captured = 0
        self._extras = {}
        self._links: set[int] = set()
        streams = self._streams
        schemas: dict[object, int] = {}
        if isinstance(streams, Streams):
            schemas = {name: file.add_schema(name, text) for name, text in streams.definitions.items()}
        channels = []
        for topic in streams.topics:
            key = topic.type if topic.schema is None else (topic.type, *topic.schema)
            if topic.schema is not None and key not in schemas:
                encoding, data = topic.schema
                # Without a type there is no schema, and 0 says so.
                schemas[key] = file.add_schema(topic.type, data, encoding) if topic.type else 0
            channels.append(file.add_channel(topic.name, schemas[key], topic.metadata, topic.encoding))
        streams.number(channels)
        file.add_metadata(OPENING_METADATA_NAME, self._opening())

    def _close_file(self, statistics: SourceStatistics | None) -> None:
        file = self.files[-1]
        self._note_outages()
        self._chunks.flush()
        self._attach(0)
        metadata: dict[str, int | None] = {}
        if statistics is not None:
            metadata = {"kernel_drops": statistics.kernel_drops, "skipped": statistics.skipped}
        file.add_metadata(
            METADATA_NAME,
            {
                **self._opening(),
                **self._counts(),
                **{key: str(value) for key, value in metadata.items() if value is not None},
            },
        )
        if self._options.apart and (answers := self._options.apart.answers()):
            covers = {"covers": str(file.size), "crc": str(file.checksum)}
            file.add_metadata(COUNTS_METADATA_NAME, {"version": __version__, **covers, "counts": answers})
        file.finish()
        self.complete.append((file.output, self._captured))

    def _counts(self) -> dict[str, str]:
        if isinstance(self._streams, RecordedStreams):
            return {"datagrams": "0", "messages": str(self._captured)}
        offsets = json.dumps(self._streams.clock.offsets())
        labels = sorted(table.link(code).label for code in self._links)
        return {
            "datagrams": str(self._captured),
            "clock_offset_ns": offsets,
            "links": json.dumps(labels),
            **self._standing(self._streams),
        }

    def _standing(self, streams: Streams) -> dict[str, str]:
        """Return the metadata that lets readers skip datagrams, with the number of datagrams of each kind."""
        options = self._options
        is_whole = not (options.splits or options.filter)  # else the file may contain only a part
        apart = options.apart.metadata() if options.apart and is_whole else {}
        return {**apart, "flows": json.dumps(streams.flows)} if apart else {}

    def _note_outages(self) -> None:
        """Write outages of the source's interface since the last call: as messages and as metadata."""
        outages = list(self._live.outages) if self._live else []
        news = [outage for place, outage in enumerate(outages) if [outage] != self._noted[place : place + 1]]
        if waits := self.output.waits:  # what came meanwhile was captured, or is counted as dropped
            self.output.waits = []
            full = [InterfaceOutage(f"the disk of {self.output.path.name}", "full", *span) for span in waits]
            self._chunks.append([self._streams.outages(full)], len(full))
        if not news:
            return
        self._noted = outages
        self._chunks.append([self._streams.outages(news)], len(news))
        for outage in news:
            values = {key: str(value or 0) for key, value in outage.as_json().items()}
            self.files[-1].add_metadata(OUTAGE_METADATA_NAME, values)

    def _attach(self, time_ns: int) -> None:
        """Write the mission files before the first chunk of a file, so that a cut-off recording has them."""
        file = self.files[-1]
        if self.datagrams == 0 and not file.summary.attachments:
            for name, data in self._mission.files.items():
                file.add_attachment(name, "application/yaml", data, max(time_ns, 0))

    def _opening(self) -> dict[str, str]:
        return {
            "tool": "edoras-tools",
            "version": __version__,
            "source": self._info.name,
            "source_kind": self._info.kind,
            "filter": self._options.filter,
            "time_resolution_ns": str(self._info.time_resolution_ns),
            "snap_length": str(self._info.snap_length),
            "read_with": json.dumps(dict(self._info.read_with)),
            "findings": json.dumps({bit.label: int(bit) for bit in Finding}),
        }

    @contextmanager
    def _failing(self) -> Iterator[None]:
        """After the first failed write, close the file as it is: closing the sink must not fail again."""
        if self._state != "open":
            raise CaptureError(f"{self.files[-1].path}: the recording is {self._state}")
        try:
            yield
        except CaptureError:
            self._fail()
            raise
