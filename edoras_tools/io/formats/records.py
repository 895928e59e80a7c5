"""The common part of capture file readers: windows of records to frames, frames to datagrams, counting."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, NamedTuple

from edoras_tools.errors import CaptureError
from edoras_tools.io.frames.linklayer import FrameSource
from edoras_tools.model import PacketBatch, SourceInfo, SourceStatistics

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from edoras_tools.io import Room
    from edoras_tools.io.formats.stream import Window
    from edoras_tools.io.frames.frame_batch import FrameBatch

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
    _info: SourceInfo

    def __init__(self, window: Window) -> None:
        super().__init__(SourceStatistics(total_bytes=window.stream.total_bytes))
        self._window = window
        self.left_out: list[LeftOut] = []
        self.keep: Callable[[memoryview], object] | None = None
        self._latest_ns: int | None = None
        self._at = 0
        """Position in the window of the first byte that is not yet in a frame."""

    @property
    def info(self) -> SourceInfo:
        """Information on the part of the source that has been read."""
        return self._info

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
            yield from self._batches()
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
        self.statistics.cut[:] = self._demux.beginnings()
        if self._demux.incomplete:
            self.statistics.warnings.append(
                f"{name}: {self._demux.incomplete} fragmented datagrams lack fragments in the capture"
            )

    def _error(self, at: int, problem: str) -> CaptureError:
        """Return the error for the record at ``at``; ``{}`` in ``problem`` is its number and place."""
        frames = self.statistics.frames
        place = f"{frames + 1} at byte {self._window.base + at}"
        read = (
            "no packet was read" if not frames else f"{frames} packet{'s' * (frames > 1)} before it were read"
        )
        return CaptureError(f"{self._window.stream.name}: {problem.format(place)}; {read}")
