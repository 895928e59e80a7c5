"""pcapng files: sections of blocks, either byte order (draft-ietf-opsawg-pcapng).

The reader takes section headers, interface descriptions, the three kinds of packet blocks, and the counts of
lost packets in interface statistics; it skips every other block. A simple packet block has no time: its
frames get 1970-01-01. The writer makes one section with one interface for each link type.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import TYPE_CHECKING, BinaryIO, Final, Literal, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.errors import CaptureError
from edoras_tools.io.formats import capture_file
from edoras_tools.io.frames.frame_batch import FrameBatch, walk_records
from edoras_tools.model import PacketBatch, SourceInfo, SourceStatistics
from edoras_tools.units import SECOND
from edoras_tools.wire.arrays import Integers, Mask, Octets, copy_rows, distinct, put_rows, read_at

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from edoras_tools.io.formats.capture_file import Window


class TimeScale(msgspec.Struct, frozen=True):
    """The unit and offset of an interface's timestamps.

    Attributes:
        exponent: a tick is ``base ** -exponent`` seconds; 0 to 127.
        base: 10 or 2.
        offset_s: seconds to add.
    """

    exponent: int = 6
    base: int = 10
    offset_s: int = 0

    @property
    def resolution_ns(self) -> int:
        """A tick in ns; 1 if it is shorter."""
        return max(1, SECOND // int(self.base**self.exponent))

    def to_ns(self, ticks: NDArray[np.uint64]) -> Integers:
        """Convert ticks to ns since 1970-01-01 UTC, rounded down; times past the year 2262 wrap."""
        if self.base == 10:
            if self.exponent <= 9:
                nanoseconds = ticks * np.uint64(10 ** (9 - self.exponent))
            elif self.exponent <= 28:
                nanoseconds = ticks // np.uint64(10 ** (self.exponent - 9))
            else:
                nanoseconds = np.zeros_like(ticks)
        else:
            nanoseconds = _from_binary(ticks, self.exponent)
        return nanoseconds.astype(np.int64) + np.int64(self.offset_s * SECOND)


def _from_binary(ticks: NDArray[np.uint64], exponent: int) -> NDArray[np.uint64]:
    """Return the floor of ``ticks * 10**9 / 2**exponent``, computed in two halves to stay within 64 bits."""
    if exponent >= 64:
        # Above 64 bits there are no whole seconds, and shifting the ticks changes the result by less than 1
        # ns.
        ticks = ticks >> np.uint64(min(exponent - 63, 63))
        exponent = 63
    shift = np.uint64(exponent)
    fraction = ticks & np.uint64((1 << exponent) - 1)
    low, high = fraction & np.uint64(0xFFFFFFFF), fraction >> np.uint64(32)
    if exponent <= 32:
        part = fraction * np.uint64(SECOND) >> shift
    else:
        part = (high * np.uint64(SECOND) + (low * np.uint64(SECOND) >> np.uint64(32))) >> np.uint64(
            exponent - 32
        )
    return (ticks >> shift) * np.uint64(SECOND) + part


SECTION_HEADER = 0x0A0D0D0A
INTERFACE_DESCRIPTION = 1
_OBSOLETE_PACKET = 2
"""Obsolete; like ``ENHANCED_PACKET``, with a 16-bit interface number."""
SIMPLE_PACKET = 3
_INTERFACE_STATISTICS = 5
ENHANCED_PACKET = 6
_BYTE_ORDER_MAGIC = 0x1A2B3C4D
_LARGEST_BLOCK = 16 << 20
_LEAST_BYTES = {
    SECTION_HEADER: 28,
    INTERFACE_DESCRIPTION: 20,
    _OBSOLETE_PACKET: 32,
    SIMPLE_PACKET: 16,
    ENHANCED_PACKET: 32,
}
_LEAST_STATISTICS = 24
_ORDERS: Final[dict[str, Literal["little", "big"]]] = {"<": "little", ">": "big"}
_OPT_COMMENT = 1
_IF_TSRESOL = 9
_IF_TSOFFSET = 14
_ISB_DROPS = {5, 7}
"""Options with packets lost by the interface, and by the system, since the capture began."""
_MULTIPLE_OF_4 = 0xFFFFFFFC
_STRIDE = 16 << 10
_SIGHT = 512
"""A seed is searched for in the first _SIGHT bytes of every _STRIDE."""


class _Interface(NamedTuple):
    """The contents of an interface description block."""

    link_type: int
    snap_length: int
    scale: TimeScale


class _Blocks(NamedTuple):
    """Complete blocks of one section: their positions, and their first seven words."""

    position: Integers
    words: NDArray[np.uint32]

    @property
    def type(self) -> NDArray[np.uint32]:
        return self.words[:, 0]

    @property
    def length(self) -> Integers:
        return self.words[:, 1].astype(np.int64)

    def take(self, rows: Integers | slice) -> _Blocks:
        return _Blocks(self.position[rows], self.words[rows])


class PcapngSource(capture_file.RecordSource):
    """The datagrams of a pcapng file, from all its sections and interfaces."""

    unit = "the block of record"

    def __init__(self, window: Window) -> None:
        """Read up to the first packet, so that ``info`` includes the interfaces before it.

        Args:
            window: the file from its first byte on.

        Raises:
            CaptureError: the first section header is damaged.
        """
        super().__init__(window)
        self._order = "<"
        self._interfaces: list[_Interface] = []
        self._lost: dict[tuple[int, int], int] = {}
        """Packets lost, by section and interface, from the latest statistics block of each."""
        self._section = 0
        self._seen: list[_Interface] = []
        self._read_with: dict[str, str] = {}
        if not window.holds(_LEAST_BYTES[SECTION_HEADER]):
            raise self._error(0, "the file ends inside its section header")
        self._begin_section(0)
        self._lead()

    @property
    def info(self) -> SourceInfo:
        """Information on the part read so far: its finest time resolution and largest snap length."""
        return SourceInfo(
            name=self._window.stream.name,
            kind="pcapng",
            time_resolution_ns=min((item.scale.resolution_ns for item in self._seen), default=1000),
            snap_length=max((item.snap_length for item in self._seen), default=0)
            or capture_file.LARGEST_FRAME,
            read_with=self._read_with,
        )

    def _lead(self) -> None:
        """Skip the complete blocks before the first packet."""
        window = self._window
        while window.end - self._at >= 12:
            kind, length = struct.unpack_from(f"{self._order}II", window.data.data, self._at)
            if kind in {_OBSOLETE_PACKET, SIMPLE_PACKET, ENHANCED_PACKET} or length < 12 or length % 4:
                return
            if self._at + length > window.end or (kind == SECTION_HEADER and self._at):
                return
            if kind == INTERFACE_DESCRIPTION and length >= _LEAST_BYTES[kind]:
                self._add_interface(self._at, length)
            elif kind == SECTION_HEADER:
                self._read_with = self._listened(self._at, length)
            elif kind == _INTERFACE_STATISTICS:
                self._count_lost(self._at, length)
            self._at += length

    def _frames(self) -> Iterator[FrameBatch]:
        window = self._window
        while window.end - self._at >= 16:
            start = self._at
            if window.data[start : start + 4].tobytes() == SECTION_HEADER.to_bytes(4, "big"):
                self._begin_section(start)
            blocks, self._at = self._blocks(start)
            sound = self._sound(blocks)
            if not sound.all():
                fault = int(sound.argmin())
                self._at = int(blocks.position[fault])
                blocks = blocks.take(slice(fault))
            frames = self._read_packets(blocks)
            if len(frames):
                yield frames
            if reason := self._refusal(self._at):
                raise self._error(
                    self._at, f"the block of record {{}} {reason}; the file is damaged from there on"
                )
            if self._at == start:
                return

    def _next_record(self, start: int, end: int) -> int | None:
        data, dtype = self._window.data, np.dtype(f"{self._order}u4")
        last = end - _LEAST_BYTES[ENHANCED_PACKET]
        for first in range(start, last + 1, capture_file.SEARCHED):
            places = np.arange(first, min(first + capture_file.SEARCHED, last + 1))
            words = read_at(data, places, np.dtype((dtype, 6)))
            length = words[:, 1].astype(np.int64)
            sound = (words[:, 0] == ENHANCED_PACKET) & (length & 3 == 0) & (places + length <= end)
            sound &= (length >= _LEAST_BYTES[ENHANCED_PACKET]) & (words[:, 5] <= length - 32)
            sound &= words[:, 2] < len(self._interfaces)
            places, length = places[sound], length[sound]
            sound = read_at(data, places + length - 4, dtype) == length
            if sound.any():
                return int(places[sound.argmax()])
        return None

    def _begin_section(self, at: int) -> None:
        data = self._window.data[at : at + 16].tobytes()
        orders = {_BYTE_ORDER_MAGIC.to_bytes(4, "little"): "<", _BYTE_ORDER_MAGIC.to_bytes(4, "big"): ">"}
        if data[8:12] not in orders:
            raise self._error(at, "the section header before record {} has no byte-order magic")
        self._order = orders[data[8:12]]
        major, minor = struct.unpack_from(f"{self._order}HH", data, 12)
        if major != 1:
            raise self._error(
                at, f"the section of record {{}} is pcapng {major}.{minor}, which is not supported"
            )
        self._interfaces = []
        self._section += 1

    def _listened(self, at: int, length: int) -> dict[str, str]:
        """Return the ports on which our recorder listened, from the section's comment; else empty."""
        for code, value in self._options(at + 24, at + length - 4):
            if code == _OPT_COMMENT and value.startswith(capture_file.LISTENED.encode()):
                return {"listened": value[len(capture_file.LISTENED) :].decode(errors="replace")}
        return {}

    def _options(self, at: int, end: int) -> Iterator[tuple[int, bytes]]:
        """Yield the code and the value of each option of a block."""
        body = self._window.data[at:end].tobytes()
        place = 0
        while place + 4 <= len(body):
            code, size = struct.unpack_from(f"{self._order}HH", body, place)
            yield code, body[place + 4 : place + 4 + size]
            place += 4 + (size + 3 & ~3)

    def _add_interface(self, at: int, length: int) -> None:
        link_type, _, snap_length = struct.unpack(
            f"{self._order}HHI", self._window.data[at + 8 : at + 16].tobytes()
        )
        scale = TimeScale()
        for code, value in self._options(at + 16, at + length - 4):
            if code == _IF_TSRESOL and len(value) == 1:
                scale = replace(scale, exponent=value[0] & 0x7F, base=2 if value[0] & 0x80 else 10)
            elif code == _IF_TSOFFSET and len(value) == 8:
                scale = replace(scale, offset_s=struct.unpack(f"{self._order}q", value)[0])
        self._interfaces.append(_Interface(link_type, snap_length, scale))
        self._seen.append(self._interfaces[-1])

    def _count_lost(self, at: int, length: int) -> None:
        """Read the counts of lost packets from an interface statistics block, if it has them."""
        if length < _LEAST_STATISTICS:
            return
        interface = int.from_bytes(self._window.data[at + 8 : at + 12].tobytes(), _ORDERS[self._order])
        counts = [
            int.from_bytes(value, _ORDERS[self._order])
            for code, value in self._options(at + 20, at + length - 4)
            if code in _ISB_DROPS and len(value) == 8
        ]
        if counts:
            self._lost[self._section, interface] = sum(counts)
            self.statistics.kernel_drops = sum(self._lost.values())

    def _blocks(self, start: int) -> tuple[_Blocks, int]:
        """Return the complete blocks of one section, and their end."""
        data, end = self._window.data, self._window.end
        dtype = np.dtype(f"{self._order}u4")
        length_at = np.ndarray((data.size - 7,), dtype="V4", buffer=data, offset=4, strides=(1,))
        unpack = struct.Struct(f"{self._order}I").unpack_from

        def successor(positions: Integers) -> Integers:
            return (length_at[positions].view(dtype) & np.uint32(_MULTIPLE_OF_4)) + positions

        def step(position: int) -> int:
            return position + (int(unpack(data.data, position + 4)[0]) & _MULTIPLE_OF_4)

        positions, stop = walk_records(start, end, self._seeds(start, end, dtype), successor, step)
        blocks = _Blocks(positions, read_at(data, positions, np.dtype((dtype, 7))))
        sections = np.flatnonzero(blocks.type[1:] == SECTION_HEADER)
        if len(sections):
            first = int(sections[0]) + 1
            return blocks.take(slice(first)), int(positions[first])
        return blocks, stop

    def _seeds(self, start: int, end: int, dtype: np.dtype[np.uint32]) -> Integers:
        """Return positions that look like a packet block, about one in every stride."""
        data = self._window.data
        count = (end - start) // _STRIDE - 1
        if count < 1:
            return np.empty(0, dtype=np.int64)
        base = start + _STRIDE
        sight = np.ndarray((count, _SIGHT // 4), dtype=dtype, buffer=data, offset=base, strides=(_STRIDE, 4))
        lane, place = np.divmod(np.flatnonzero(sight == ENHANCED_PACKET), _SIGHT // 4)
        positions: Integers = base + lane * _STRIDE + place * 4
        length = read_at(data, positions + 4, dtype).astype(np.int64)
        sound = (length >= _LEAST_BYTES[ENHANCED_PACKET]) & (length & 3 == 0) & (positions + length <= end)
        positions, lane, length = positions[sound], lane[sound], length[sound]
        sound = read_at(data, positions + length - 4, dtype) == length
        positions, lane = positions[sound], lane[sound]
        return positions[np.flatnonzero(np.diff(lane, prepend=-1))]

    def _sound(self, blocks: _Blocks) -> Mask:
        """Return which blocks are valid for their type and length; add the interfaces among them."""
        kind, length = blocks.type, blocks.length
        sound: Mask = (length >= 12) & (length & 3 == 0)
        tail = np.where(sound, blocks.position + length - 4, blocks.position + 4)
        sound &= read_at(self._window.data, tail, f"{self._order}u4") == blocks.words[:, 1]
        for of_kind, least in _LEAST_BYTES.items():
            alike = kind == of_kind
            if alike.any():
                sound &= ~alike | (length >= least)
        described = np.flatnonzero(sound & (kind == INTERFACE_DESCRIPTION))
        for row in described.tolist():
            self._add_interface(int(blocks.position[row]), int(length[row]))
        for row in np.flatnonzero(sound & (kind == _INTERFACE_STATISTICS)).tolist():
            self._count_lost(int(blocks.position[row]), int(length[row]))
        full = (kind == ENHANCED_PACKET) | (kind == _OBSOLETE_PACKET)
        sound &= ~full | (blocks.words[:, 5] <= length - 32)
        packet = full | (kind == SIMPLE_PACKET)
        sound &= ~packet | (self._interface_of(blocks) < len(self._interfaces))
        return sound

    def _refusal(self, at: int) -> str:
        """Return why the block at ``at`` cannot be read; empty if it is only incomplete so far."""
        data, end = self._window.data.data, self._window.end
        if end - at < 8:
            return ""
        kind, length = struct.unpack_from(f"{self._order}II", data, at)
        if kind == SECTION_HEADER:
            return ""
        if length > _LARGEST_BLOCK or length % 4 or length < _LEAST_BYTES.get(kind, 12):
            return f"claims a length of {length} bytes, which is impossible for its type"
        if at + length > end:
            return ""
        if struct.unpack_from(f"{self._order}I", data, at + length - 4)[0] != length:
            return "has two lengths that differ"
        if kind in {_OBSOLETE_PACKET, ENHANCED_PACKET}:
            captured = struct.unpack_from(f"{self._order}I", data, at + 20)[0]
            if captured > length - 32:
                return f"claims a frame of {captured} bytes, more than the block has"
        return "uses an interface that the section does not describe"

    def _interface_of(self, blocks: _Blocks) -> Integers:
        interface = blocks.words[:, 2].astype(np.int64)
        kind = blocks.type
        obsolete = kind == _OBSOLETE_PACKET
        if obsolete.any():
            half = interface >> 16 if self._order == ">" else interface & 0xFFFF
            interface = np.where(obsolete, half, interface)
        interface[kind == SIMPLE_PACKET] = 0
        return interface

    def _read_packets(self, blocks: _Blocks) -> FrameBatch:
        kind = blocks.type
        packets = (kind == ENHANCED_PACKET) | (kind == _OBSOLETE_PACKET) | (kind == SIMPLE_PACKET)
        if not packets.all():
            blocks = blocks.take(np.flatnonzero(packets))
        words = blocks.words
        simple = blocks.type == SIMPLE_PACKET
        captured, original, offset = words[:, 5], words[:, 6], blocks.position + 28
        if simple.any():
            snap_length = np.uint32(self._interfaces[0].snap_length or capture_file.LARGEST_FRAME)
            available = np.minimum(blocks.length - 16, snap_length)
            original = np.where(simple, words[:, 2], original)
            captured = np.where(simple, np.minimum(original, available), captured)
            offset = np.where(simple, blocks.position + 12, offset)
        ticks = words[:, 3].astype(np.uint64) << np.uint64(32) | words[:, 4]
        interface = self._interface_of(blocks)
        time_ns = np.empty(len(ticks), dtype=np.int64)
        link_type = np.empty(len(ticks), dtype=np.uint16)
        for number in distinct(interface).tolist():
            rows = interface == number
            time_ns[rows] = self._interfaces[number].scale.to_ns(ticks[rows])
            link_type[rows] = self._interfaces[number].link_type
        time_ns[simple] = 0
        first = self.statistics.frames + 1
        return FrameBatch(
            data=self._window.data,
            number=np.arange(first, first + len(ticks)),
            time_ns=time_ns,
            link_type=link_type,
            offset=offset,
            length=captured.astype(np.int32),
            original_length=original.astype(np.int32),
        )


_ENHANCED_PACKET = 6
_HEAD_BYTES = 28
_TAIL_BYTES = 4


class PcapngSink(capture_file.CaptureFileSink):
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
