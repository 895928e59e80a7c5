"""The common parts of capture files: sources that read record by record, and sinks that write frames.

``RecordSource`` is the base of the readers of pcap, pcapng and cFE files. ``CaptureFileSink`` is that of the
writers of pcap and pcapng: a file opened here or by the caller, or one file a part (``SplitCaptureSink``).

``ByteStream`` reads the bytes of a file or pipe, decompressed if needed, in windows.
"""

from __future__ import annotations

import select
import stat
import zlib
from abc import abstractmethod
from collections.abc import Callable, Iterator
from os import fstat
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, ClassVar, Final, NamedTuple, Protocol

import numpy as np

from edoras_tools.errors import CaptureError, os_errors
from edoras_tools.io import Sink
from edoras_tools.io.frames.linklayer import FrameSource
from edoras_tools.io.outputs import OutputFile, output_name, part_path
from edoras_tools.model import Columns, PacketBatch, SourceStatistics
from edoras_tools.wire.arrays import PADDING, Octets

if TYPE_CHECKING:
    import io

    from edoras_tools.io import RecordingOptions, Room
    from edoras_tools.io.frames.frame_batch import FrameBatch

FIRST = 256 << 10
"""Bytes of the first window: small, so that the first datagrams come at once."""
_SECOND_WINDOW = 2 << 20
"""Bytes of the second window; each next one doubles, so that other processes can start early."""
SLICE = 8 << 20
"""Most bytes of a window: large enough that numpy's cost per call does not matter."""
_LINGER_MS = 1
"""Time to wait for more bytes of a pipe before returning those that came, in ms."""


class ByteStream(Protocol):
    """A source of bytes.

    Attributes:
        name: name of the file, for messages.
        total_bytes: size of the file; 0 for a pipe.
    """

    name: str
    total_bytes: int

    @property
    def position(self) -> int:
        """Bytes of the file consumed; compressed bytes if it is compressed."""

    def ready(self) -> bool:
        """Return whether ``fill`` would return at once, without waiting for a writer."""

    def fill(self, view: memoryview) -> int:
        """Write bytes into ``view`` until it is full or no more are available now; return 0 at the end.

        Raises:
            CaptureError: the bytes cannot be read; raised after all that could be read.
        """

    def close(self) -> None:
        """Close the file."""


class FileStream:
    """A file or a pipe, not decompressed. It waits for a pipe only while it has no bytes to return."""

    def __init__(self, file: io.FileIO, name: str) -> None:
        self.name = name
        self.position = 0
        status = fstat(file.fileno())
        self.total_bytes = status.st_size if stat.S_ISREG(status.st_mode) else 0
        self._file = file
        self._poll: select.poll | None = None
        if not stat.S_ISREG(status.st_mode):
            self._poll = select.poll()
            self._poll.register(file, select.POLLIN)

    def ready(self) -> bool:
        """See ``ByteStream.ready``."""
        return self._poll is None or bool(self._poll.poll(_LINGER_MS))

    def fill(self, view: memoryview) -> int:
        """See ``ByteStream.fill``."""
        filled = 0
        while filled < len(view):
            if filled and not self.ready():
                break
            with os_errors(f"{self.name}: cannot be read"):
                count = self._file.readinto(view[filled:])
            if not count:
                break
            filled += count
        self.position += filled
        return filled

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class CompressedStream:
    """The decompressed bytes of a gzip or zstd stream; several members or frames are joined."""

    def __init__(self, inner: ByteStream, kind: str, head: bytes) -> None:
        """Open it.

        Args:
            inner: the compressed bytes, from after ``head``.
            kind: ``gzip`` or ``zstd``.
            head: compressed bytes that were already read.
        """
        self.name = inner.name
        self.total_bytes = inner.total_bytes
        self._inner = inner
        self._kind = kind
        self._input = head
        self._inflater: Any = None
        self._output = memoryview(b"")  # its rest is not copied: one call of zstd returns up to 128 MiB
        self._failure: CaptureError | None = None
        # Small: one call of zstd may return any amount, and an error loses all bytes of its call.
        self._buffer = memoryview(bytearray(1 << 12))

    @property
    def position(self) -> int:
        """Compressed bytes consumed."""
        return self._inner.position

    def ready(self) -> bool:
        """See ``ByteStream.ready``."""
        return bool(self._output or self._input) or self._inner.ready()

    def fill(self, view: memoryview) -> int:
        """See ``ByteStream.fill``."""
        filled = 0
        while filled < len(view):
            if (filled and not self.ready()) or not (self._output or self._inflate(len(view) - filled)):
                break
            count = min(len(view) - filled, len(self._output))
            view[filled : filled + count] = self._output[:count]
            self._output = self._output[count:]
            filled += count
        if not filled and self._failure is not None:
            raise self._failure
        return filled

    def close(self) -> None:
        """Close the file."""
        self._inner.close()

    def _inflate(self, room: int) -> bool:
        """Produce some output; False at the end or on a failure."""
        while not self._output and self._failure is None:
            if not self._input:
                count = self._inner.fill(self._buffer)
                if not count:
                    if self._inflater is not None:
                        self._fail("ends early; it was probably cut off while being written or copied")
                    return False
                self._input = bytes(self._buffer[:count])
            self._step(room)
        return bool(self._output)

    def _step(self, room: int) -> None:
        if self._inflater is None:
            if self._kind == "gzip":
                # Some tools pad files with zeros; gzip itself skips them too.
                self._input = self._input.lstrip(b"\0")
            if not self._input:
                return
            self._inflater = self._begin()
        size = len(self._buffer)
        try:
            if self._kind == "gzip":
                self._output = memoryview(self._inflater.decompress(self._input, room))
                # At the end of a member zlib also leaves these bytes in unused_data.
                rest = b"" if self._inflater.eof else self._inflater.unconsumed_tail
            else:
                self._output = memoryview(self._inflater.decompress(self._input[:size]))
                rest = self._input[size:]
        except _errors() as error:
            self._fail(f"is corrupt ({error}); copy or unpack it again")
            return
        self._input = rest
        if self._inflater.eof:
            self._input = self._inflater.unused_data + rest
            self._inflater = None

    def _begin(self) -> Any:
        if self._kind == "gzip":
            return zlib.decompressobj(wbits=31)
        import zstandard

        return zstandard.ZstdDecompressor().decompressobj()

    def _fail(self, problem: str) -> None:
        self._failure = CaptureError(f"{self.name}: the {self._kind} data {problem}")


def _errors() -> tuple[type[Exception], ...]:
    import zstandard

    return zlib.error, zstandard.ZstdError


class Window:
    """The part of a stream that is being read: one buffer, and its position in the stream.

    Attributes:
        stream: the source of the bytes.
        data: u8, the buffer; ``PADDING`` zero bytes follow the used ones. It is not changed after
            ``advance``, unless ``room`` returns it again.
        room: returns a buffer of a given size for the next window; by default newly allocated.
        end: number of used bytes.
        base: position in the stream of the first byte of ``data``.
    """

    def __init__(self, stream: ByteStream, head: bytes = b"") -> None:
        """Start reading.

        Args:
            stream: the source of the bytes.
            head: bytes that were already read.
        """
        self.stream = stream
        self.base = 0
        self.end = len(head)
        self.data: Octets = np.frombuffer(head + bytes(PADDING), dtype=np.uint8)
        self._size = FIRST
        self.room: Callable[[int], Octets] = lambda size: np.empty(size, np.uint8)

    def holds(self, size: int) -> bool:
        """Return whether the stream's first ``size`` bytes are here; read on until they are.

        Raises:
            CaptureError: the stream cannot be read further.
        """
        while self.end < size and self.advance(0):
            pass
        return self.end >= size

    def advance(self, start: int) -> bool:
        """Move forward: keep the bytes from ``start`` on, and read more after them into another buffer.

        Returns:
            False when the stream has ended; then the window is unchanged.

        Raises:
            CaptureError: the stream cannot be read further.
        """
        rest = self.end - start
        data = self.room(rest + self._size + PADDING)
        count = self.stream.fill(memoryview(data.data)[rest : rest + self._size])
        if not count:
            return False
        data[:rest] = self.data[start : self.end]
        data[rest + count : rest + count + PADDING] = 0
        self.base += start
        self.data, self.end = data[: rest + count + PADDING], rest + count
        self._size = min(SLICE, max(_SECOND_WINDOW, 2 * self._size))
        return True


_COPIED_BYTES: Final = 1 << 20


class SettledFile(NamedTuple):
    """A regular file.

    Attributes:
        path: path of the file.
        name: name in messages.
        copy: temporary copy of a pipe or of a compressed file, which exists until it is closed; else None.
    """

    path: Path
    name: str
    copy: Any = None

    def close(self) -> None:
        """Remove the copy, if it is one."""
        if self.copy is not None:
            self.copy.close()


def settled_file(stream: ByteStream, path: Path, head: bytes) -> SettledFile:
    """Return the content of a stream as a regular file; the stream is closed.

    Args:
        stream: its bytes after ``head``.
        head: bytes already read; empty for a regular file, which is not copied.

    Raises:
        CaptureError: it cannot be copied.
    """
    copy = None
    if head:
        from tempfile import NamedTemporaryFile, gettempdir

        try:
            copy = NamedTemporaryFile(prefix="edoras-")  # noqa: SIM115  whoever reads it keeps it
            copy.write(head)
            buffer = memoryview(bytearray(_COPIED_BYTES))
            while count := stream.fill(buffer):
                copy.write(buffer[:count])
            copy.flush()
        except OSError as error:
            reason = error.strerror or error
            raise CaptureError(f"{stream.name}: cannot be copied to {gettempdir()}: {reason}") from error
    stream.close()
    return SettledFile(Path(copy.name) if copy else path, stream.name, copy)


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


LARGEST_FRAME = 262144
"""Captured bytes of a frame that every reader accepts, even if the file has a smaller snap length."""
_HEADERS = 256
"""Upper limit of the bytes of a record besides its frame, for the search of a record."""
SEARCHED = 64 << 10
"""Positions that are tested at once in the search of the next record after a damaged place."""
FROM_THERE = "; the file is damaged from there on"
_CUT = "ends inside {} {{}}; the capture was probably cut off while being written"


class LeftOut(NamedTuple):
    """Bytes of a file in which no record can be read.

    Attributes:
        start: offset of the first byte, in the uncompressed file.
        end: offset after the last byte.
        reason: text of the problem, with the number and place of the record.
        before_ns: time of the frame before these bytes, ns since 1970; None if there is none.
        after_ns: time of the frame after them; None if there is none yet.
    """

    start: int
    end: int
    reason: str
    before_ns: int | None
    after_ns: int | None = None


class RecordSource(FrameSource):
    """A source that reads records from windows of a stream.

    A format implements how records become frames, and sets ``_info``.

    Attributes:
        statistics: the counts so far.
        left_out: stretches that could not be read so far.
        keep: takes the bytes of all records that are read, piece by piece; None: not needed.
    """

    unit = "record"
    """The format's name for its records."""

    def __init__(self, window: Window) -> None:
        super().__init__(SourceStatistics(total_bytes=window.stream.total_bytes))
        self._window = window
        self.left_out: list[LeftOut] = []
        self.keep: Callable[[memoryview], object] | None = None
        self._latest_ns: int | None = None
        self._at = 0
        """Position in the window of the first byte that is not yet in a frame."""

    @abstractmethod
    def _frames(self) -> Iterator[FrameBatch]:
        """Read the complete records of the window from ``_at`` on, and move ``_at`` after them.

        Raises:
            CaptureError: a record is damaged; raised after all records before it.
        """

    def _next_record(self, start: int, end: int) -> int | None:
        """Return the first position in a range of the window where a record surely begins, or None."""
        return None

    def batches(self) -> Iterator[PacketBatch]:
        """Yield all datagrams; see ``Source.batches``."""
        try:
            yield from super().batches()
        finally:
            self._warn()
            self.close()

    def borrow(self, room: Room) -> None:
        """Read into memory from ``room(size)``, u8, instead of newly allocated memory."""
        self._window.room = room

    def close(self) -> None:
        """Close the file."""
        self._window.stream.close()

    def _batches(self) -> Iterator[PacketBatch]:
        window = self._window
        failure: CaptureError | None = None
        before = start = 0
        searching = False
        while True:
            damage = None
            try:
                for frames in self._frames() if not searching else ():
                    batch = self._count(frames)
                    if len(batch):
                        yield batch
            except CaptureError as error:
                damage = error
            if self.keep and not searching:
                self.keep(window.data[start : self._at].data)
            ended = False
            if not searching and damage is None:
                ended = not window.advance(self._at)
                if not ended:
                    self._at = start = 0
                    continue
                if self._at == window.end:
                    break
                damage = self._error(self._at, _CUT.format(self.unit))
            if failure is None:
                failure, before = damage, self.statistics.frames
            place = window.base + self._at
            begin = self._next_record(self._at + 1, window.end)
            searching = begin is None
            if begin is None:
                begin = max(self._at, window.end - LARGEST_FRAME - _HEADERS)
                ended = ended or not window.advance(begin)
                begin = window.end if ended else 0
            self._at = start = begin
            self._leave_out(place, window.base + begin, damage)
            if searching and ended:
                break
        yield from self._rest()
        if failure is not None:
            after = self.statistics.frames - before
            if not after:
                raise failure
            left_out = sum(item.end - item.start for item in self.left_out)
            text = str(failure).replace(FROM_THERE, "")
            raise CaptureError(f"{text}, and {after:,} after it; {left_out:,} bytes were left out")

    def _leave_out(self, start: int, end: int, damage: CaptureError | None) -> None:
        if self.left_out and self.left_out[-1].end == start:
            self.left_out[-1] = self.left_out[-1]._replace(end=end)
        else:
            reason = str(damage).removeprefix(f"{self._window.stream.name}: ").replace(FROM_THERE, "")
            self.left_out.append(LeftOut(start, end, reason.rpartition("; ")[0], self._latest_ns))

    def _count(self, frames: FrameBatch) -> PacketBatch:
        batch = self._demuxed(frames)
        if len(frames):
            if self.left_out and self.left_out[-1].after_ns is None:
                self.left_out[-1] = self.left_out[-1]._replace(after_ns=int(frames.time_ns[0]))
            self._latest_ns = int(frames.time_ns[-1])
        self.statistics.position = self._window.stream.position
        return batch

    def _warn(self) -> None:
        name = self._window.stream.name
        for link_type in sorted(self._demux.unknown_link_types):
            self.statistics.warnings.append(
                f"{name}: frames of link type {link_type} are not supported; skipped"
            )

    def _error(self, at: int, problem: str) -> CaptureError:
        """Return the error for the record at ``at``; ``{}`` in ``problem`` is its number and place."""
        frames = self.statistics.frames
        place = f"{frames + 1} at byte {self._window.base + at}"
        read = (
            "no packet was read" if not frames else f"{frames} packet{'s' * (frames > 1)} before it were read"
        )
        return CaptureError(f"{self._window.stream.name}: {problem.format(place)}; {read}")
