"""Files that can be read at any place, as often as needed: those that cannot are copied first."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.errors import CaptureError

if TYPE_CHECKING:
    from edoras_tools.io.formats.stream import ByteStream

_COPIED_BYTES: Final = 1 << 20


@dataclass(frozen=True, slots=True)
class SettledFile:
    """A regular file.

    Attributes:
        path: where it is.
        name: what it is called in messages.
        copy: of a pipe, or of a file that is packed, the temporary copy; it is there until it is closed.
    """

    path: Path
    name: str
    copy: Any = None

    def close(self) -> None:
        """Remove the copy, if it is one."""
        if self.copy is not None:
            self.copy.close()


def settled_file(stream: ByteStream, path: Path, head: bytes) -> SettledFile:
    """Return the content of a stream as a file; the stream is closed.

    Args:
        stream: as far as it was read, ``head``.
        head: empty for a file that is there as it is.

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
