"""The common part of the pcap and pcapng sinks: a file opened here or by the caller, or one file a part."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, ClassVar, Final

import numpy as np

from edoras_tools.errors import CaptureError
from edoras_tools.io import Sink
from edoras_tools.io.outputs import OutputFile, output_name, part_path

if TYPE_CHECKING:
    from collections.abc import Callable

    from edoras_tools.io import RecordingOptions
    from edoras_tools.model import Columns, PacketBatch, SourceStatistics
    from edoras_tools.wire.arrays.order import Octets


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


LISTENED: Final = "edoras record --listen "
"""Beginning of the comment of a pcapng section with the ports on which our recorder was set to listen."""


class CaptureFileSink(Sink):
    """Writes the frames of batches to a file; the formats implement ``_lay_out`` and ``_finish``.

    Attributes:
        head: number of bytes before the first frame.
        overhead: most bytes that a record has besides its frame.
        name: name of the file, for messages.
        datagrams: number of frames written.
        output: the file, if it was opened here; None if the caller opened it.
    """

    head: ClassVar[int]
    overhead: ClassVar[int]

    def __init__(self, path_or_file: str | Path | BinaryIO) -> None:
        """Open the file.

        Args:
            path_or_file: where to write; a file of the caller is flushed, but not closed.

        Raises:
            CaptureError: the file cannot be opened.
        """
        self.datagrams = 0
        self.output: OutputFile | None = None
        self._lent: BinaryIO | None = None
        self._closed = False
        if isinstance(path_or_file, str | Path):
            self.name = output_name(Path(path_or_file))
            try:
                self.output = OutputFile(Path(path_or_file))
            except (OSError, ValueError) as error:
                raise self._error("cannot be created", error) from error
        else:
            self.name = str(getattr(path_or_file, "name", "output"))
            self._lent = path_or_file

    def write(self, batch: PacketBatch, columns: Columns | None = None) -> None:
        """Append the frames of a batch.

        Args:
            batch: its frames are written in order.

        Raises:
            CaptureError: the file cannot be written, or its format cannot hold a frame.
        """
        batch = batch.captured
        self.datagrams += len(batch)
        if len(batch):
            self._put(self._lay_out(batch))

    @property
    def paths(self) -> list[Path]:
        """The file written, if it was opened here."""
        return [self.output.path] if self.output else []

    @property
    def complete(self) -> list[tuple[OutputFile, int]]:
        """The file once it is complete, and the number of datagrams in it."""
        return [(self.output, self.datagrams)] if self.output and self._closed else []

    def forget(self, output: OutputFile) -> None:
        """Do nothing: the only file is complete at the end."""

    def abandon(self) -> None:
        """Close the file in its present state; nothing more is written."""
        self._closed = True
        self.flush()
        if self.output:
            self.output.close()

    def flush(self) -> None:
        """Write everything received so far to the operating system."""
        try:
            if self._lent:
                self._lent.flush()
        except (OSError, ValueError) as error:
            raise self._error("cannot be written", error) from error

    def close(self, statistics: SourceStatistics | None = None) -> None:
        """Write the end of the format, and close the file if it was opened here.

        Args:
            statistics: counts of the source; pcapng stores the number of lost frames.
        """
        if not self._closed:
            self._closed = True
            self._finish(statistics)
            self.flush()
            try:
                if self.output:
                    self.output.finish()
            except OSError as error:
                raise self._error("cannot be written", error) from error

    def _lay_out(self, batch: PacketBatch) -> Octets:
        """Return the bytes of a batch of at least one frame: u8."""
        raise NotImplementedError

    def _finish(self, statistics: SourceStatistics | None) -> None:
        """Write what the format needs after the last frame."""

    def _put(self, data: bytes | Octets) -> None:
        piece = data if isinstance(data, bytes) else data.data
        try:
            if self.output:
                self.output.write(piece)
            elif self._lent:
                self._lent.write(piece)
        except (OSError, ValueError) as error:
            self._closed = True
            if self.output:
                self.output.close()
            raise self._error("cannot be written", error) from error

    def _error(self, failure: str, error: Exception) -> CaptureError:
        reason = getattr(error, "strerror", None) or str(error)
        return CaptureError(f"{self.name}: {failure}: {reason}; name another file with -o or make room")
