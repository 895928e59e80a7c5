"""Access to an MCAP file that may be damaged: its bytes, and single records."""

from __future__ import annotations

import os
import struct
from contextlib import AbstractContextManager, suppress
from io import BytesIO
from typing import TYPE_CHECKING, Any, Final

from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from edoras_tools.errors import CaptureError
from edoras_tools.io.formats.mcap.index import RECORD_HEAD
from edoras_tools.wire.arrays.crc import crc32

if TYPE_CHECKING:
    import re
    from collections.abc import Iterator
    from pathlib import Path


_KINDS: Final[dict[int, Any]] = {
    Opcode.HEADER: records.Header,
    Opcode.FOOTER: records.Footer,
    Opcode.SCHEMA: records.Schema,
    Opcode.CHANNEL: records.Channel,
    Opcode.ATTACHMENT: records.Attachment,
    Opcode.METADATA: records.Metadata,
    Opcode.STATISTICS: records.Statistics,
    Opcode.CHUNK_INDEX: records.ChunkIndex,
    Opcode.ATTACHMENT_INDEX: records.AttachmentIndex,
    Opcode.METADATA_INDEX: records.MetadataIndex,
    Opcode.SUMMARY_OFFSET: records.SummaryOffset,
    Opcode.DATA_END: records.DataEnd,
}
_WINDOW: Final = 1 << 20
_OVERLAP: Final = 64
"""Bytes by which windows overlap; more than any pattern that is searched for."""


def parse(opcode: int, content: bytes) -> Any:
    """Return a record; None if the bytes are not exactly one record of this kind.

    An attachment's own checksum must be correct, if it has one.
    """
    # mcap silently reads fewer bytes than needed: one added byte at the end reveals reading too far.
    stream = BytesIO(content + b"\0")
    with suppress(McapError, struct.error, ValueError, OverflowError, MemoryError):
        if opcode in _KINDS:
            record = _KINDS[opcode].read(ReadDataStream(stream))
            if stream.tell() != len(content):
                return None
            if opcode == Opcode.ATTACHMENT:
                crc = int.from_bytes(content[-4:], "little")
                return record if crc in {0, crc32(content[:-4])} else None
            return record
    return None


class FileBytes(AbstractContextManager["FileBytes"]):
    """Random access to a file whose size must not change meanwhile.

    Attributes:
        path: path of the file.
        size: bytes of the file when it was opened.

    Raises:
        CaptureError: from every method: the file cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._file = path.open("rb")
        except OSError as error:
            raise self._failure(error) from error
        self._number = self._file.fileno()
        self.size = os.fstat(self._number).st_size

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def read(self, start: int, end: int) -> bytes:
        """Return the bytes from ``start`` up to ``end``; fewer at the end of the file."""
        end = min(end, self.size)
        pieces = []
        try:
            while start < end and (piece := os.pread(self._number, end - start, start)):
                pieces.append(piece)
                start += len(piece)
        except OSError as error:
            raise self._failure(error) from error
        return pieces[0] if len(pieces) == 1 else b"".join(pieces)

    def prefix(self, place: int) -> tuple[int, int, int] | None:
        """Return opcode, start and end of the content of the record at ``place``, complete or not."""
        prefix = self.read(place, place + RECORD_HEAD.size) if place >= 0 else b""
        if len(prefix) < RECORD_HEAD.size:
            return None
        opcode, length = RECORD_HEAD.unpack(prefix)
        return opcode, place + RECORD_HEAD.size, place + RECORD_HEAD.size + length

    def find(self, pattern: re.Pattern[bytes], start: int, end: int) -> Iterator[int]:
        """Yield every position from ``start`` up to ``end`` where a short pattern matches."""
        window = 1 << 12  # most searches end soon
        while start < min(end, self.size):
            stop = min(start + window, end)
            data = self.read(start, stop + _OVERLAP)
            # A hole may be large.
            for match in pattern.finditer(data if data.count(0) < len(data) else b""):
                if start + match.start() < stop:
                    yield start + match.start()
            start, window = stop, min(2 * window, _WINDOW)

    def crc(self, start: int, end: int) -> int:
        """Return the CRC-32 of a range of bytes."""
        value = 0
        for first in range(start, end, _WINDOW):
            value = crc32(self.read(first, min(first + _WINDOW, end)), value)
        return value

    def _failure(self, error: OSError) -> CaptureError:
        missing = isinstance(error, FileNotFoundError)
        why = (
            "there is no such file; check the name"
            if missing
            else f"cannot be read: {error.strerror or error}"
        )
        return CaptureError(f"{self.path}: {why}")
