"""The common part of the pcap and pcapng sinks: a file opened here or by the caller, its errors, its end."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, ClassVar

from edoras_tools.errors import CaptureError
from edoras_tools.io import Sink
from edoras_tools.io.outputs import OutputFile, output_name

if TYPE_CHECKING:
    from edoras_tools.model import Columns, PacketBatch, SourceStatistics
    from edoras_tools.wire.arrays.order import Octets


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
