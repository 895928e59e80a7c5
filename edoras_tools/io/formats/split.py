"""Options of recordings, and pcap and pcapng files written in parts, by size, time or number of datagrams."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from edoras_tools.io import Sink

if TYPE_CHECKING:
    from collections.abc import Callable, Collection
    from pathlib import Path

    from edoras_tools.io.formats.capture_file import CaptureFileSink
    from edoras_tools.io.outputs import OutputFile
    from edoras_tools.links.site import Endpoints
    from edoras_tools.model import Columns, PacketBatch, SourceStatistics
    from edoras_tools.sessions.sequence import SequenceCounts
    from edoras_tools.structs import Structs


class RecordingOptions(msgspec.Struct, frozen=True):
    """Contents of a recording, and when a new file starts.

    Attributes:
        filter: expression that selected the datagrams, for the metadata record.
        split_bytes: approximate size of a file at which a new one starts; 0: never.
        split_ns: capture time in one file at which a new one starts; 0: never.
        split_count: number of datagrams in one file after which a new one starts; 0: never.
        datagrams: whether to write ``/edoras/datagrams``.
        structs: C structs in packets; None: only cFE's own.
        transforms: whether to write ``/tf``, made from the poses.
        jobs: most processes that share the work; more than one only for MCAP that is not split by size.
        yields: whether to share the work only while a processor is free, for the sake of other recorders.
        sequences: sequence counts shared with other consumers of the same batches; None: own ones.
        endpoints: DDS endpoints discovered so far; None: DDS samples have no topics.
        topics: of a recording without datagrams: numbers of the topics to write; None: all.
        offered: quality of service of every topic, as the YAML of ``ros2 bag``; empty if unknown.
        apart: a ``pipelines.reading.Independence``, which takes all batches; None: not recorded.
    """

    filter: str = ""
    split_bytes: int = 0
    split_ns: int = 0
    split_count: int = 0
    datagrams: bool = True
    structs: Structs | None = None
    offered: str = ""
    transforms: bool = False
    jobs: int = 1
    yields: bool = False
    sequences: SequenceCounts | None = None
    endpoints: Endpoints | None = None
    topics: Collection[int] | None = None
    apart: Any = None

    @property
    def is_part(self) -> bool:
        """Whether a file may contain only a part of the datagrams."""
        return self.splits or bool(self.filter)

    @property
    def splits(self) -> bool:
        """Whether the recording is written in parts."""
        return bool(self.split_bytes or self.split_ns or self.split_count)


class SplitCaptureSink(Sink):
    """Writes the frames of batches to ``NAME_0.pcap``, ``NAME_1.pcap`` and so on, each complete.

    Args:
        path: name of the parts, without their numbers.
        options: limits at which a new part starts.
        begin: opens the sink of a part.

    Attributes:
        parts: the sinks of the files that were written.

    Raises:
        CaptureError: from every method: a file cannot be written.
    """

    def __init__(
        self, path: Path, options: RecordingOptions, begin: Callable[[Path], CaptureFileSink]
    ) -> None:
        self._path, self._options, self._begin = path, options, begin
        self._number = self._start_ns = 0
        self.parts: list[CaptureFileSink] = []
        self._next()

    @property
    def paths(self) -> list[Path]:
        """The files written."""
        return [path for part in self.parts for path in part.paths]

    @property
    def output(self) -> OutputFile | None:
        """The file being written."""
        return self.parts[-1].output

    @property
    def datagrams(self) -> int:
        """Number of datagrams in the present file."""
        return self.parts[-1].datagrams

    @property
    def complete(self) -> list[tuple[OutputFile, int]]:
        """The complete files, with the number of datagrams in each."""
        return [item for part in self.parts for item in part.complete]

    def forget(self, output: OutputFile) -> None:
        """Leave a complete file out of ``paths`` and ``complete``."""
        self.parts = [part for part in self.parts if part.output is not output]

    def write(self, batch: PacketBatch, columns: Columns | None = None) -> None:
        """Append the frames of a batch."""
        first = 0
        while first < len(batch):
            fitting = self._fitting(batch, first)
            if not fitting and self.datagrams:
                self.parts[-1].close()
                self._next()
                continue
            if not self.datagrams:
                self._start_ns = int(batch.time_ns[first])
            last = first + max(fitting, 1)
            self.parts[-1].write(batch.take(slice(first, last)))
            first = last

    def flush(self) -> None:
        """Write everything received so far to the operating system."""
        self.parts[-1].flush()

    def close(self, statistics: SourceStatistics | None = None) -> None:
        """Complete the last file."""
        self.parts[-1].close(statistics)

    def abandon(self) -> None:
        """Close the file in its present state; nothing more is written."""
        self.parts[-1].abandon()

    def _next(self) -> None:
        self.parts.append(self._begin(part_path(self._path, self._number)))
        self._number += 1

    def _fitting(self, batch: PacketBatch, first: int) -> int:
        """Return the number of rows from ``first`` on that fit into the present file."""
        options, part, fitting = self._options, self.parts[-1], len(batch) - first
        if options.split_count:
            fitting = min(fitting, options.split_count - part.datagrams)
        if options.split_ns:
            times = batch.time_ns[first:]
            late = times - (self._start_ns if part.datagrams else times[0]) >= options.split_ns
            fitting = min(fitting, int(late.argmax())) if late.any() else fitting
        if options.split_bytes and part.output:
            sizes = np.cumsum(batch.frame_length[first:].astype(np.int64) + part.overhead)
            room = options.split_bytes - max(part.output.size, part.head)
            fitting = min(fitting, int(np.searchsorted(sizes, room, "right")))
        return fitting


def part_path(path: Path, number: int) -> Path:
    """Return the file of a part: ``NAME_0.mcap`` and so on."""
    return path.with_name(f"{path.stem}_{number}{path.suffix}")
