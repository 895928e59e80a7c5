"""pcap files, written a batch at a time (draft-ietf-opsawg-pcap); little-endian, one link type a file."""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from edoras_tools.errors import CaptureError
from edoras_tools.wire.window import copy_rows, put_rows

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.model import Columns, PacketBatch, SourceStatistics

_MICROSECONDS = 0xA1B2C3D4
_NANOSECONDS = 0xA1B23C4D
_ETHERNET = 1
_HEADER_BYTES = 16


class CaptureFile:
    """A file that a capture is written to, whatever its format; errors become ``CaptureError``."""

    def __init__(self, path_or_file: str | Path | BinaryIO) -> None:
        """Open it.

        Args:
            path_or_file: where to write; a file that is handed over is flushed, and not closed.

        Raises:
            CaptureError: it cannot be opened.
        """
        self._owned = isinstance(path_or_file, str | Path)
        self.name = str(path_or_file if self._owned else getattr(path_or_file, "name", "output"))
        try:
            # Closed by close(): a sink lives longer than a block.
            self._file = (
                Path(path_or_file).open("wb")  # noqa: SIM115  see above
                if isinstance(path_or_file, str | Path)
                else path_or_file
            )
        except (OSError, ValueError) as error:
            raise self._error("cannot be created", error) from error

    def write(self, data: bytes | NDArray[np.uint8]) -> None:
        """Append bytes."""
        try:
            self._file.write(data if isinstance(data, bytes) else data.data)
        except (OSError, ValueError) as error:
            raise self._error("cannot be written", error) from error

    def flush(self) -> None:
        """Hand everything to the operating system."""
        try:
            self._file.flush()
        except (OSError, ValueError) as error:
            raise self._error("cannot be written", error) from error

    def close(self) -> None:
        """Flush, and close what was opened here."""
        try:
            if self._owned:
                self._file.close()
            else:
                self._file.flush()
        except (OSError, ValueError) as error:
            raise self._error("cannot be written", error) from error

    def _error(self, what: str, error: Exception) -> CaptureError:
        reason = os.strerror(error.errno) if isinstance(error, OSError) and error.errno else str(error)
        return CaptureError(f"{self.name}: {what}: {reason}; name another file with -o or make room")


class PcapSink:
    """Writes the frames of batches to a pcap file, bit for bit."""

    def __init__(
        self, path_or_file: str | Path | BinaryIO, *, nanosecond: bool = False, snap_length: int = 262144
    ) -> None:
        """Open the file; its header is written with the first frame, whose link type it names.

        Args:
            path_or_file: where to write; a file that is handed over is not closed.
            nanosecond: write ns, else us, rounded down.
            snap_length: the capture's limit on a frame's bytes.

        Raises:
            CaptureError: it cannot be opened.
        """
        self._file = CaptureFile(path_or_file)
        self._magic, self._unit_ns = (_NANOSECONDS, 1) if nanosecond else (_MICROSECONDS, 1000)
        self._snap_length = snap_length
        self._link_type: int | None = None
        self._closed = False

    def write(self, batch: PacketBatch, columns: Columns | None = None) -> None:
        """Append the frames of a batch.

        Args:
            batch: its frames are written, in its order.
            columns: not needed.

        Raises:
            CaptureError: the file cannot be written, or cannot hold this link type or time.
        """
        del columns
        if not len(batch):
            return
        if self._link_type is None:
            self._begin(int(batch.link_type[0]))
        others = batch.link_type[batch.link_type != self._link_type]
        if len(others):
            raise CaptureError(
                f"{self._file.name}: a pcap file holds one link type, here {self._link_type}, and now comes "
                f"{int(others[0])}; write a .pcapng file instead"
            )
        seconds, rest = np.divmod(batch.time_ns, 1_000_000_000)
        if seconds.min() < 0 or seconds.max() > 0xFFFFFFFF:
            raise CaptureError(
                f"{self._file.name}: a time outside the years 1970 to 2106 does not fit a pcap file; "
                "write an .mcap file instead"
            )
        headers = np.empty((len(batch), 4), dtype="<u4")
        headers[:, 0] = seconds
        headers[:, 1] = rest // self._unit_ns
        headers[:, 2] = batch.frame_length
        headers[:, 3] = batch.original_length.view(np.uint32)
        sizes = batch.frame_length.astype(np.int64) + _HEADER_BYTES
        starts = np.cumsum(sizes) - sizes
        out = np.empty(int(sizes.sum()), dtype=np.uint8)
        put_rows(out, starts, headers.view(f"V{_HEADER_BYTES}")[:, 0])
        copy_rows(out, starts + _HEADER_BYTES, batch.data, batch.frame_offset, batch.frame_length)
        self._file.write(out)

    def flush(self) -> None:
        """Get everything taken so far to the file."""
        self._file.flush()

    def close(self, statistics: SourceStatistics | None = None) -> None:
        """Write the header if no frame came, and close the file.

        Args:
            statistics: not needed; the format has no place for it.
        """
        del statistics
        if self._closed:
            return
        self._closed = True
        if self._link_type is None:
            self._begin(_ETHERNET)
        self._file.close()

    def _begin(self, link_type: int) -> None:
        self._link_type = link_type
        self._file.write(struct.pack("<IHHiIII", self._magic, 2, 4, 0, 0, self._snap_length, link_type))
