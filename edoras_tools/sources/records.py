"""What capture file formats share: windows of records to frames, frames to datagrams, counting, ending."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

from edoras_tools.errors import CaptureError
from edoras_tools.model import SourceStatistics
from edoras_tools.sources.linklayer import Demux

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import numpy as np
    from numpy.typing import NDArray

    from edoras_tools.model import PacketBatch, SourceInfo
    from edoras_tools.sources.linklayer import FrameBatch
    from edoras_tools.sources.stream import Window

LARGEST_FRAME = 262144
"""Captured bytes of a frame that every reader accepts, whatever snap length the file names."""


class RecordSource(ABC):
    """A source that reads records out of windows of a stream.

    A format says how its records become frames; everything else is here.

    Attributes:
        statistics: what was counted so far.
    """

    unit = "record"
    """What the format calls its records."""

    def __init__(self, window: Window) -> None:
        self.statistics = SourceStatistics(total_bytes=window.stream.total_bytes)
        self._window = window
        self._demux = Demux()
        self._at = 0
        """Place in the window of the first byte that no frame was made of yet."""

    @property
    @abstractmethod
    def info(self) -> SourceInfo:
        """What the source is, as far as it was read."""

    @abstractmethod
    def _frames(self) -> Iterator[FrameBatch]:
        """Read the whole records that the window holds from ``_at`` on, and move ``_at`` behind them.

        Raises:
            CaptureError: a record is not sound; after all before it.
        """

    def batches(self) -> Iterator[PacketBatch]:
        """Hand over all datagrams; see ``Source.batches``."""
        try:
            yield from self._batches()
        finally:
            self._warn()
            self.close()

    def borrow(self, room: Callable[[int], NDArray[np.uint8]]) -> None:
        """Read into what ``room`` gives, u8 of so many bytes, instead of into fresh memory.

        It must not give memory again that batches are still read from, nor that it gave last.
        """
        self._window.room = room

    def close(self) -> None:
        """Close the file."""
        self._window.stream.close()

    def _batches(self) -> Iterator[PacketBatch]:
        window = self._window
        while True:
            for frames in self._frames():
                batch = self._count(frames)
                if len(batch):
                    yield batch
            if not window.advance(self._at):
                break
            self._at = 0
        if self._at < window.end:
            raise self._error(
                self._at,
                f"ends inside {self.unit} {{}}; the capture was probably cut off while being written",
            )

    def _count(self, frames: FrameBatch) -> PacketBatch:
        statistics = self.statistics
        batch = self._demux.demux(frames)
        statistics.frames += len(frames)
        statistics.bytes += int(frames.length.sum())
        statistics.datagrams += len(batch)
        statistics.skipped = self._demux.skipped
        statistics.position = self._window.stream.position
        return batch

    def _warn(self) -> None:
        name = self._window.stream.name
        for link_type in sorted(self._demux.unknown_link_types):
            self.statistics.warnings.append(
                f"{name}: frames of link type {link_type} cannot be read; skipped"
            )
        if self._demux.incomplete:
            self.statistics.warnings.append(
                f"{name}: {self._demux.incomplete} fragmented datagrams lack fragments in the capture"
            )

    def _error(self, at: int, what: str) -> CaptureError:
        """Say what is wrong with the record at ``at``; ``{}`` in ``what`` becomes its number and place."""
        frames = self.statistics.frames
        place = f"{frames + 1} at byte {self._window.base + at}"
        read = (
            "no packet was read" if not frames else f"{frames} packet{'s' * (frames > 1)} before it were read"
        )
        return CaptureError(f"{self._window.stream.name}: {what.format(place)}; {read}")
