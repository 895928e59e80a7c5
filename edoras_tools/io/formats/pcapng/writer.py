"""Writes pcapng files batch by batch (draft-ietf-opsawg-pcapng): one interface for each link type."""

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

_ENHANCED_PACKET = 6
_HEAD_BYTES = 28
_TAIL_BYTES = 4


class PcapngSink(CaptureFileSink):
    """Writes the frames of batches to a pcapng file, bit for bit."""

    head = 28 + 32  # section and interface
    overhead = _HEAD_BYTES + _TAIL_BYTES + 3  # with the padding of a frame

    def __init__(
        self,
        path_or_file: str | Path | BinaryIO,
        *,
        nanosecond: bool = True,
        snap_length: int = 262144,
        comment: str = "",
    ) -> None:
        """Open the file and write the section header.

        Args:
            path_or_file: where to write; a file of the caller is not closed.
            nanosecond: write ns; otherwise us, rounded down.
            snap_length: the capture's maximum bytes of a frame.
            comment: comment of the section, for people and for ``PcapngSource``; empty for none.

        Raises:
            CaptureError: the file cannot be opened or written.
        """
        super().__init__(path_or_file)
        self._exponent, self._unit_ns = (9, 1) if nanosecond else (6, 1000)
        self._snap_length = snap_length
        self._interfaces: dict[int, int] = {}
        self._last_ticks = 0
        text = comment.encode()
        option = struct.pack(f"<HH{len(text)}s{-len(text) % 4}xI", 1, len(text), text, 0) if text else b""
        size = struct.pack("<I", 28 + len(option))
        self._put(b"\x0a\x0d\x0d\x0a" + size + struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1) + option + size)

    def _lay_out(self, batch: PacketBatch) -> Octets:
        if batch.time_ns.min() < 0:
            raise CaptureError(
                f"{self.name}: a time before 1970 does not fit pcapng; write an .mcap file instead"
            )
        ticks = batch.time_ns // self._unit_ns
        self._last_ticks = int(ticks[-1])
        padded = batch.frame_length.astype(np.int64) + 3 & ~3
        sizes = padded + (_HEAD_BYTES + _TAIL_BYTES)
        starts = np.cumsum(sizes) - sizes
        head = np.empty((len(batch), 7), dtype="<u4")
        head[:, 0] = _ENHANCED_PACKET
        head[:, 1] = sizes
        for link_type in np.unique(batch.link_type).tolist():
            head[batch.link_type == link_type, 2] = self._interface(link_type)
        head[:, 3] = ticks >> 32
        head[:, 4] = ticks & 0xFFFFFFFF
        head[:, 5] = batch.frame_length
        head[:, 6] = batch.original_length.view(np.uint32)
        out = np.empty(int(sizes.sum()), dtype=np.uint8)
        head_rows = head.view(f"V{_HEAD_BYTES}")[:, 0]
        put_rows(out, starts, head_rows)
        # First write zeros over the last word of the frame, so that padding needs no extra step.
        tail = np.zeros((len(batch), 2), dtype="<u4")
        tail[:, 1] = sizes
        put_rows(out, starts + sizes - 8, tail.view("V8")[:, 0])
        copy_rows(out, starts + _HEAD_BYTES, batch.data, batch.frame_offset, batch.frame_length)
        # An empty frame has no last word: the zeros overwrote its head.
        empty = batch.frame_length == 0
        if empty.any():
            put_rows(out, starts[empty], head_rows[empty])
        return out

    def _finish(self, statistics: SourceStatistics | None) -> None:
        """Write the number of lost frames, if the source knows it, as statistics of the first interface."""
        drops = statistics.kernel_drops if statistics else None
        if drops is not None and self._interfaces:
            time = self._last_ticks >> 32, self._last_ticks & 0xFFFFFFFF
            self._put(struct.pack("<5IHHQII", 5, 40, 0, *time, 5, 8, drops, 0, 40))

    def _interface(self, link_type: int) -> int:
        """Return the number of a link type's interface; a new one is described in the file."""
        if link_type not in self._interfaces:
            self._interfaces[link_type] = len(self._interfaces)
            resolution = struct.pack("<HHB3xI", 9, 1, self._exponent, 0)
            self._put(
                struct.pack("<IIHHI", 1, 32, link_type, 0, self._snap_length)
                + resolution
                + struct.pack("<I", 32)
            )
        return self._interfaces[link_type]
