"""Reads the bytes of a file or pipe, decompressed if needed, in windows."""

from __future__ import annotations

import select
import stat
import zlib
from os import fstat
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol

import numpy as np

from edoras_tools.errors import CaptureError, os_errors
from edoras_tools.wire.arrays import PADDING

if TYPE_CHECKING:
    import io
    from collections.abc import Callable

    from edoras_tools.wire.arrays import Octets

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
            if filled and not self.ready():
                break
            if not self._output and not self._inflate(len(view) - filled):
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
