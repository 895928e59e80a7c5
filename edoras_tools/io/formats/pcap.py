"""pcap files: a 24-byte header, then records of a 16-byte header and a frame (draft-ietf-opsawg-pcap).

Both byte orders and both units of time are read, also from damaged files; written files are little-endian,
with one link type each.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from edoras_tools.errors import CaptureError
from edoras_tools.io.formats.capture_file import (
    FROM_THERE,
    LARGEST_FRAME,
    SEARCHED,
    CaptureFileSink,
    RecordSource,
    Window,
)
from edoras_tools.io.frames.frame_batch import FrameBatch, walk_records
from edoras_tools.model import PacketBatch, SourceInfo, SourceStatistics
from edoras_tools.wire.arrays import Integers, Mask, Octets, copy_rows, put_rows, read_at

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray


FILE_HEADER_BYTES = 24
RECORD_HEADER_BYTES = 16
MAGICS = {
    b"\xd4\xc3\xb2\xa1": ("<", 1000),
    b"\xa1\xb2\xc3\xd4": (">", 1000),
    b"\x4d\x3c\xb2\xa1": ("<", 1),
    b"\xa1\xb2\x3c\x4d": (">", 1),
}
"""Byte order, and the unit of the timestamps' second half in ns."""
_LARGEST_SNAP_LENGTH = 16 << 20
"""A larger snap length is not trusted; Wireshark's own limit is far below."""
_LOOKED_BACK = 8
"""Records before a damaged place that are checked: one may claim a length that covers later records."""
_FAR_S = 86400
"""Largest plausible step of time between two records of a damaged file, in s."""
_FAR_RECORDS = 5
"""Records that must follow a record at a distant time to prove it: another capture may begin there."""
_STRIDE = 16 << 10
_SIGHT = 512
"""A seed is searched for in the first _SIGHT bytes of every _STRIDE."""


class PcapSource(RecordSource):
    """The datagrams of a pcap file, with micro- or nanoseconds, in either byte order."""

    def __init__(self, window: Window) -> None:
        """Read the file header.

        Args:
            window: the file from its first byte on, including the magic number.

        Raises:
            CaptureError: the header is incomplete, or its version is not supported.
        """
        super().__init__(window)
        name = window.stream.name
        if not window.holds(FILE_HEADER_BYTES):
            raise CaptureError(f"{name}: ends inside the pcap file header, at byte {window.end} of 24")
        header = window.data[:FILE_HEADER_BYTES].tobytes()
        self._order, self._unit_ns = MAGICS[header[:4]]
        major, minor, _, _, snap_length, network = struct.unpack(f"{self._order}HHiIII", header[4:])
        if major != 2:
            raise CaptureError(f"{name}: pcap version {major}.{minor} is not supported; 2.4 is")
        # The upper half contains whether each frame ends with a frame check sequence, and its length.
        self._link_type = network & 0xFFFF
        self._limit = max(LARGEST_FRAME, snap_length if snap_length <= _LARGEST_SNAP_LENGTH else 0)
        self._info = SourceInfo(name, "pcap", self._unit_ns, snap_length or LARGEST_FRAME)
        self._at = FILE_HEADER_BYTES
        self._latest_s = 0

    def _frames(self) -> Iterator[FrameBatch]:
        data, start, end = self._window.data, self._at, self._window.end
        captured_at = np.ndarray((data.size - 11,), dtype="V4", buffer=data.data, offset=8, strides=(1,))
        dtype = f"{self._order}u4"
        unpack = struct.Struct(f"{self._order}I").unpack_from

        def successor(positions: Integers) -> Integers:
            after: Integers = captured_at[positions].view(dtype) + positions
            after += RECORD_HEADER_BYTES
            return after

        def step(position: int) -> int:
            return position + RECORD_HEADER_BYTES + int(unpack(data.data, position + 8)[0])

        positions, stop = walk_records(start, end, self._seeds(data, start, end), successor, step)
        headers = read_at(data, positions, np.dtype((dtype, 4)))
        captured = headers[:, 2].astype(np.int64)
        seconds = headers[:, 0].astype(np.int64)
        far = abs(np.diff(seconds, prepend=self._latest_s or seconds[:1])) > _FAR_S
        absurd = captured > self._limit
        empty = np.flatnonzero(captured == 0)
        absurd[empty[~headers[empty].any(axis=1)]] = True  # zeros are no record
        absurd |= far & (headers[:, 3] < captured)  # the bytes of records, read from a wrong place
        if absurd.any():
            first = int(absurd.argmax())
            stop = int(positions[first])
            positions, headers, captured = positions[:first], headers[:first], captured[:first]
        latest_s = self._latest_s
        if len(positions):
            self._latest_s = int(seconds[len(positions) - 1])
        problem = self._problem(stop, end)
        self._latest_s = latest_s
        damaged = bool(problem or self.left_out)  # in a sound file any bytes may look like records
        rows = {*np.flatnonzero(far[: len(positions)])[: _LOOKED_BACK * damaged].tolist()}
        rows |= {*range(max(0, len(positions) - _LOOKED_BACK), len(positions) * bool(problem))}
        for row in sorted(rows):
            self._latest_s = int(seconds[row - 1]) if row else self._latest_s
            if self._is_wrong(int(positions[row]), int(captured[row]), end, far=bool(far[row])):
                inside = "in which others begin" if captured[row] else "at another time"
                problem = f"record {{}} claims a frame of {captured[row]} bytes, {inside}"
                stop = int(positions[row])
                positions, headers, captured = positions[:row], headers[:row], captured[:row]
                break
        self._at = stop
        if len(positions):
            yield self._batch(data, positions, headers, captured)
        if problem:
            raise self._error(stop, f"{problem}{FROM_THERE}")

    def _problem(self, at: int, end: int) -> str:
        """Return why no record begins at a position; empty if one does, or it is not known yet."""
        header = self._window.data[at : at + RECORD_HEADER_BYTES]
        if at + RECORD_HEADER_BYTES > end:
            return ""
        if not header.any():
            return "zeros are where record {} begins"
        seconds, _, claimed, original = map(int, header.view(f"{self._order}u4"))
        if claimed <= self._limit:
            far = self._latest_s and abs(seconds - self._latest_s) > _FAR_S
            return "record {} has an impossible time and length" if far and original < claimed else ""
        return f"record {{}} claims a frame of {claimed} bytes, but the maximum is {self._limit}"

    def _is_wrong(self, place: int, captured: int, end: int, *, far: bool) -> bool:
        """Return whether the length of a record is wrong, because another record begins inside its frame."""
        edge = place + RECORD_HEADER_BYTES + captured
        if not far:
            return self._next_record(place + RECORD_HEADER_BYTES, edge) is not None
        next_place = self._search(place + 1, min(end, edge + SEARCHED), near=True)
        return not captured or (next_place is not None and next_place < edge)

    def _next_record(self, start: int, end: int) -> int | None:
        place = self._search(start, end, near=True)
        return self._search(start, end, near=False) if place is None and self._latest_s else place

    def _search(self, start: int, end: int, *, near: bool) -> int | None:
        """Return the position of a record.

        With ``near``, its time is near that of the last record; else many records follow it.
        """
        data = self._window.data
        while start < end:
            if not data[start]:  # there may be gigabytes of zeros, of which three begin a header at most
                filled = data[start:end] != 0
                start = max(start, start + int(filled.argmax()) - 11 if filled.any() else end)
            places = np.arange(start, min(start + SEARCHED, end - RECORD_HEADER_BYTES))
            sound, after = self._look(data, places, end + 1)
            if near and self._latest_s:
                seconds = read_at(data, places, np.dtype(f"{self._order}u4")).astype(np.int64)
                sound &= abs(seconds - self._latest_s) < _FAR_S
            places, after = places[sound], after[sound]
            sound = np.ones(len(places), bool)
            for _ in range(1 if near else _FAR_RECORDS):
                behind = np.minimum(after, end - RECORD_HEADER_BYTES)
                follows, further = self._look(data, behind, end + 1)
                sound &= (after == end) | follows
                after = np.where(after == end, end, further)
            if sound.any():
                return int(places[sound.argmax()])
            start += SEARCHED
        return None

    def _batch(
        self, data: Octets, positions: Integers, headers: NDArray[np.uint32], captured: Integers
    ) -> FrameBatch:
        time_ns = headers[:, 0].astype(np.int64)
        self._latest_s = int(time_ns[-1])
        time_ns *= 1_000_000_000
        time_ns += headers[:, 1].astype(np.int64) * self._unit_ns
        first = self.statistics.frames + 1
        return FrameBatch(
            data=data,
            number=np.arange(first, first + len(positions)),
            time_ns=time_ns,
            link_type=np.full(len(positions), self._link_type, dtype=np.uint16),
            offset=positions + RECORD_HEADER_BYTES,
            length=captured.astype(np.int32),
            original_length=headers[:, 3].astype(np.int32),
        )

    def _seeds(self, data: Octets, start: int, end: int) -> Integers:
        """Return positions that look like two consecutive records, about one in every stride."""
        count = (end - start) // _STRIDE - 1
        if count < 1:
            return np.empty(0, dtype=np.int64)
        # A cheap first test: few bytes equal the first byte of the current record's time.
        base = start + _STRIDE
        first = 0 if self._order == ">" else 3
        sight = np.ndarray(
            (count, _SIGHT), dtype=np.uint8, buffer=data.data, offset=base + first, strides=(_STRIDE, 1)
        )
        lane, place = np.divmod(np.flatnonzero(sight == data[start + first]), _SIGHT)
        positions: Integers = base + lane * _STRIDE + place
        sound, after = self._look(data, positions, end)
        sound[sound] = self._look(data, after[sound], end)[0]
        lane, positions = lane[sound], positions[sound]
        return positions[np.flatnonzero(np.diff(lane, prepend=-1))]

    def _look(self, data: Octets, positions: Integers, end: int) -> tuple[Mask, Integers]:
        """Return which positions have a plausible record header, and the position of the next record."""
        header = read_at(data, positions, np.dtype((f"{self._order}u4", 4)))
        captured = header[:, 2].astype(np.int64)
        sound = (header[:, 1] < 1_000_000_000 // self._unit_ns) & (captured > 0) & (captured <= LARGEST_FRAME)
        after = positions + RECORD_HEADER_BYTES + captured
        return sound & (header[:, 3] >= captured) & (after < end), np.minimum(after, end)


_MICROSECONDS = 0xA1B2C3D4
_NANOSECONDS = 0xA1B23C4D
_ETHERNET = 1


class PcapSink(CaptureFileSink):
    """Writes the frames of batches to a pcap file, bit for bit."""

    head = 24
    overhead = RECORD_HEADER_BYTES

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
        sizes = batch.frame_length.astype(np.int64) + RECORD_HEADER_BYTES
        starts = np.cumsum(sizes) - sizes
        out = np.empty(int(sizes.sum()), dtype=np.uint8)
        put_rows(out, starts, headers.view(f"V{RECORD_HEADER_BYTES}")[:, 0])
        copy_rows(out, starts + RECORD_HEADER_BYTES, batch.data, batch.frame_offset, batch.frame_length)
        return out

    def _finish(self, statistics: SourceStatistics | None) -> None:
        """Write the header, if there was no frame."""
        if self._link_type is None:
            self._begin(_ETHERNET)

    def _begin(self, link_type: int) -> None:
        self._link_type = link_type
        self._put(struct.pack("<IHHiIII", self._magic, 2, 4, 0, 0, self._snap_length, link_type))
