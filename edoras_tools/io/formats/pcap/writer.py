"""Writes pcap files batch by batch (draft-ietf-opsawg-pcap); little-endian, one link type per file."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from edoras_tools.errors import CaptureError
from edoras_tools.io.formats.capture_file import CaptureFileSink
from edoras_tools.wire.arrays.window import copy_rows, put_rows

if TYPE_CHECKING:
    from pathlib import Path

    from edoras_tools.model import PacketBatch, SourceStatistics
    from edoras_tools.wire.arrays.order import Octets

_MICROSECONDS = 0xA1B2C3D4
_NANOSECONDS = 0xA1B23C4D
_ETHERNET = 1
_HEADER_BYTES = 16


class PcapSink(CaptureFileSink):
    """Writes the frames of batches to a pcap file, bit for bit."""

    head = 24
    overhead = _HEADER_BYTES

    def __init__(
        self, path_or_file: str | Path | BinaryIO, *, nanosecond: bool = False, snap_length: int = 262144
    ) -> None:
        """Open the file; its header is written with the first frame, because it contains the link type.

        Args:
            path_or_file: where to write; a file of the caller is not closed.
            nanosecond: write ns; otherwise us, rounded down.
            snap_length: the capture's maximum bytes of a frame.

        Raises:
            CaptureError: the file cannot be opened.
        """
        super().__init__(path_or_file)
        self._magic, self._unit_ns = (_NANOSECONDS, 1) if nanosecond else (_MICROSECONDS, 1000)
        self._snap_length = snap_length
        self._link_type: int | None = None

    def _lay_out(self, batch: PacketBatch) -> Octets:
        if self._link_type is None:
            self._begin(int(batch.link_type[0]))
        others = batch.link_type[batch.link_type != self._link_type]
        if len(others):
            raise CaptureError(
                f"{self.name}: a pcap file has one link type, here {self._link_type}, but a frame has "
                f"{int(others[0])}; write a .pcapng file instead"
            )
        seconds, rest = np.divmod(batch.time_ns, 1_000_000_000)
        if seconds.min() < 0 or seconds.max() > 0xFFFFFFFF:
            raise CaptureError(
                f"{self.name}: a time outside the years 1970 to 2106 does not fit a pcap file; "
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
        return out

    def _finish(self, statistics: SourceStatistics | None) -> None:
        """Write the header, if there was no frame."""
        if self._link_type is None:
            self._begin(_ETHERNET)

    def _begin(self, link_type: int) -> None:
        self._link_type = link_type
        self._put(struct.pack("<IHHiIII", self._magic, 2, 4, 0, 0, self._snap_length, link_type))
