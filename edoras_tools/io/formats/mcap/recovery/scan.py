"""Finds the records of a file that may be damaged anywhere, and checks each of them.

Rules that the search keeps:

1. Where a record ends, the next one must begin. If none does, or its checksum is wrong, the search continues
   to the next position where a record proves itself: a chunk by its checksum, every other record by being
   exactly one of its kind that is followed by another one.
2. A chunk with a damaged head is found by its compressed frame, if that has its own checksum.
3. Nothing inside a damaged chunk is accepted as a record of the file: messages outside of chunks count only
   in files that have no chunks.
4. A message whose content holds other messages, in sequence and of about its time, has a wrong length.
5. If a summary is intact, chunks after a damaged place must be in its index. Other data that looks like a
   chunk is part of something else: of a recording inside a message or an attachment.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
from mcap.opcode import Opcode

from edoras_tools.io.formats.mcap.chunks import COMPRESSIONS, Proof, frame_at, inflate, unpack_chunk
from edoras_tools.io.formats.mcap.file import (
    CHUNK_HEAD_BYTES,
    INDEX_ENTRY,
    INDEX_HEAD,
    MAX_CHUNK_BYTES,
    MESSAGE_HEAD,
    MOST_IDLE,
    RECORD_HEAD,
    ChunkHead,
    chunk_head,
)
from edoras_tools.io.formats.mcap.recovery.records import Entries, FileBytes, Walked, parse, walk
from edoras_tools.io.topics.messages import MAGIC
from edoras_tools.wire.arrays import crc32

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.io.formats.mcap.recovery.report import FoundSummary

_PLACES: Final = re.compile(
    rb"(?s)(?=[\x01-\x0f](?!\x00{8}[\x01-\x0f\x80-\xff]\x00{8}).{4}\x00{4}"
    rb"|\x89MCAP0\r\n|\x28\xb5\x2f\xfd|\x04\x00{3}zstd|\x03\x00{3}lz4)"
)
"""Places to test: a record's prefix, a magic, a zstd frame, a compression's name.

An empty record before another is excluded: only private ones can be empty, and a file may hold a million."""
_EMPTY: Final = re.compile(rb"(?:[\x80-\xff]\x00{8})+")
_RUN_BYTES: Final = 1 << 16
_FRAME: Final = b"\x28\xb5\x2f\xfd"
_NAMES: Final = (b"\x04\0\0\0zstd", b"\x03\0\0\0lz4")
_NAME_AT: Final = 28
"""Position of the compression's name in a chunk's content."""
_FRAME_BYTES: Final = (1 << 20, 1 << 26)
"""Bytes in which the end of a frame is searched; the smaller number is tried first."""
_LAST: Final = 0x0F
_PRIVATE: Final = 0x80
"""Opcodes from here on are private; readers skip them."""
_TRIES: Final = 2
"""Records that must follow each other if none has a checksum."""
_MESSAGES: Final = re.compile(rb"(?s)(?=\x05.{3}\x00{5})")
_INSIDE: Final = 3
"""Messages in sequence inside a record that prove that the record's length is wrong."""
_NEAR_NS: Final = 86400 * 10**9


class Piece(msgspec.Struct):
    """A range of the file that was identified.

    Attributes:
        opcode: opcode of the record; 0 for a magic, -1 for bytes that are not a record.
        start: offset of its first byte.
        end: offset after its last byte; a chunk's message index is included.
        record: parsed contents; the content of a message; None for a chunk.
        head: head of a chunk, intact or not, if it can be read.
        walked: messages of a chunk.
        proof: proof of a chunk, even of a damaged one; NONE if it was written without a checksum.
        record_end: end of a chunk's own record; 0 if its head is damaged.
        entries: contents of a chunk's message index.
        indexed: whether the message index matches the chunk, or there is none.
    """

    opcode: int
    start: int
    end: int
    record: Any = None
    head: ChunkHead | None = None
    walked: Walked | None = None
    proof: Proof = Proof.NONE
    record_end: int = 0
    entries: Entries = msgspec.field(default_factory=dict)
    indexed: bool = True


class Scan:
    """Identifies the contents of a file."""

    def __init__(self, file: FileBytes, sections: list[FoundSummary]) -> None:
        self._file = file
        self._sections = sections
        self._chunks = self._checked = self._broken = False
        """For the current file: whether it has chunks, chunks with a checksum, and a damaged place."""
        self._largest = self._idle = 0
        """Bytes of the largest message outside of chunks; number of records in a row that hold no message."""
        self._next: Piece | None = None
        """The result of the last search."""

    def pieces(self) -> Iterator[Piece]:
        """Yield all pieces in order, without gaps between them."""
        place = 0
        while place < self._file.size:
            piece = (
                self._next if self._next and self._next.start == place else self._at(place, searched=False)
            )
            if piece is None:
                piece = Piece(-1, place, self._search(place + 1, self._file.size))
            self._broken |= piece.opcode < 0
            self._idle = 0 if piece.opcode in {Opcode.CHUNK, Opcode.MESSAGE} else self._idle + 1
            yield piece
            place = piece.end

    @property
    def of_ros2(self) -> bool:
        """Whether a summary has ROS 2's schemas."""
        return any(
            item.encoding.startswith("ros2") for part in self._sections for item in part.schemas.values()
        )

    def section(self, place: int) -> FoundSummary | None:
        """Return the summary at or after a position."""
        return next((item for item in self._sections if item.end > place), None)

    def _at(self, place: int, *, searched: bool) -> Piece | None:
        """Return the piece at a position; None if nothing there proves itself.

        Args:
            place: the position.
            searched: whether a search led here; if not, a record must begin here.
        """
        file = self._file
        for section in self._sections:
            if place == section.start:
                return Piece(Opcode.FOOTER, place, section.end, section)
        if file.read(place, place + len(MAGIC)) == MAGIC:
            return self._magic(place, searched=searched)
        prefix = file.prefix(place)
        if prefix is None:
            return None
        opcode, start, end = prefix
        if opcode == Opcode.CHUNK and end > start:
            return self._chunk(place, start, end, searched=searched)
        piece = self._record(place, opcode, start, end, searched=searched) if end <= file.size else None
        if piece is None and not searched:  # a chunk of which only the first bytes are damaged?
            piece = self._chunk(place, start, None, searched=True)
        return piece

    def _magic(self, place: int, *, searched: bool) -> Piece | None:
        end = place + len(MAGIC)
        section = self.section(place)
        if searched and section is not None and section.owns(place) and place > section.base:
            return None
        opens = self._opens(end)
        if not opens and searched:
            return None
        if opens:
            self._chunks = self._checked = self._broken = False
        return Piece(0, place, end, opens)

    def _opens(self, place: int) -> bool:
        prefix = self._file.prefix(place)
        if prefix is None or prefix[0] != Opcode.HEADER or prefix[2] > self._file.size:
            return False
        return parse(Opcode.HEADER, self._file.read(*prefix[1:])) is not None

    def _record(self, place: int, opcode: int, start: int, end: int, *, searched: bool) -> Piece | None:
        """Return a record that is not a chunk and is completely in the file."""
        if end - start > MAX_CHUNK_BYTES:
            return None
        if opcode == Opcode.MESSAGE:
            if end - start < MESSAGE_HEAD.size or (self._chunks and (searched or self._broken)):
                return None
            if searched and not self._follows(end, _TRIES):
                return None
            if (end - start > self._largest or not self._follows(end, 1)) and self._swallows(start, end):
                return None
            self._largest = max(self._largest, end - start)
            return Piece(opcode, place, end, self._file.read(start, end))
        if opcode == Opcode.MESSAGE_INDEX:
            entries, after = self._indexes(place)
            return Piece(opcode, place, after, entries=entries) if entries else None
        private = opcode >= _PRIVATE
        if self._idle > MOST_IDLE or (private and (searched or not self._follows(end, 1))):
            return None
        if private:
            if run := _EMPTY.match(self._file.read(place, place + _RUN_BYTES)):
                self._idle += run.end() // RECORD_HEAD.size - 1
                return Piece(opcode, place, place + run.end())
            return self._chunk(place, start, end, searched=True) or Piece(opcode, place, end)
        record = parse(opcode, self._file.read(start, end))
        if record is None or (searched and not self._follows(end, _TRIES)):
            return None
        return Piece(opcode, place, end, record)

    def _swallows(self, start: int, end: int) -> bool:
        """Return whether a message's length is wrong, because it covers later messages."""
        time_ns = MESSAGE_HEAD.unpack(self._file.read(start, start + MESSAGE_HEAD.size))[2]
        for place in self._file.find(_MESSAGES, start + MESSAGE_HEAD.size, end):
            at = place
            for _ in range(_INSIDE):
                head = self._file.read(at, at + RECORD_HEAD.size + MESSAGE_HEAD.size)
                if len(head) < RECORD_HEAD.size + MESSAGE_HEAD.size or at >= end:
                    break
                opcode, length = RECORD_HEAD.unpack_from(head)
                near = abs(MESSAGE_HEAD.unpack_from(head, RECORD_HEAD.size)[2] - time_ns) < _NEAR_NS
                if opcode != Opcode.MESSAGE or not near or not MESSAGE_HEAD.size <= length <= MAX_CHUNK_BYTES:
                    break
                at += RECORD_HEAD.size + length
            else:
                return True
        return False

    def _follows(self, place: int, count: int) -> bool:
        """Return whether ``count`` records follow, or the file ends."""
        for _ in range(count):
            if place == self._file.size or self._file.read(place, place + len(MAGIC)) == MAGIC:
                return True
            prefix = self._file.prefix(place)
            if prefix is None or not (1 <= prefix[0] <= _LAST or prefix[0] >= _PRIVATE):
                return False
            if prefix[2] > self._file.size and prefix[0] != Opcode.CHUNK:
                return False
            place = prefix[2]
        return True

    def _chunk(self, place: int, start: int, end: int | None, *, searched: bool) -> Piece | None:
        """Return a chunk and its message index; a damaged one only where a chunk must begin."""
        file = self._file
        head = chunk_head(file.read(start, start + CHUNK_HEAD_BYTES)) if start >= 0 else None
        if head is None or (
            searched and (head.compression not in COMPRESSIONS or not (head.crc or head.compression))
        ):
            return None
        data = start + head.data
        for stop in dict.fromkeys((data + head.length, end or 0)):
            if not data <= stop <= file.size or stop - data > MAX_CHUNK_BYTES:
                continue
            raw, proof = unpack_chunk(head, file.read(data, stop))
            if proof is Proof.FAILED or (
                proof is Proof.NONE and (searched or (self._checked and self._broken))
            ):
                continue
            piece = self._sound(Piece(Opcode.CHUNK, place, stop, head=head, proof=proof), raw, stop)
            sane = stop == end == data + head.length and len(raw) == head.size
            piece.record_end = stop if sane and (not head.crc or crc32(raw) == head.crc) else 0
            if (searched or self._broken) and not self._claimed(piece, stop - data):
                return None
            self._chunks = True
            self._checked |= bool(head.crc)
            return piece
        return None if searched or end is None else self._damaged(place, data, end, head)

    def _sound(self, piece: Piece, raw: bytes | memoryview, stop: int) -> Piece:
        """Complete a chunk that ends at ``stop``: its contents and its message index."""
        piece.entries, piece.end = self._indexes(stop)
        walked = walk(raw, piece.entries)
        piece.walked = walked
        if piece.entries:
            count = sum(map(len, piece.entries.values()))
            agree = walked.agree(piece.entries)
            piece.indexed = bool(agree.all()) and count == len(walked)
            if piece.proof is Proof.NONE and not walked.whole:
                piece.walked = walked.take(agree)
        return piece

    def _claimed(self, piece: Piece, packed: int) -> bool:
        """Return whether a chunk after a damaged place belongs to the file, not to something inside it."""
        section = self.section(piece.start)
        if section is None or not section.chunks or not section.owns(piece.start) or piece.walked is None:
            return True
        times = (piece.head.start_ns, piece.head.end_ns) if piece.head else None
        return bool(section.listed(piece.walked, times, packed))

    def _damaged(self, place: int, data: int, end: int, head: ChunkHead) -> Piece:
        """Return a chunk that nothing proves, with its message index."""
        file = self._file
        self._chunks = self._broken = True
        self._checked |= bool(head.crc)
        ends = (end, data + head.length)
        stop = next(
            (item for item in ends if place < item <= file.size and self._follows(item, _TRIES)), None
        )
        if stop is None or head.compression != "":
            stop = self._search(place + 1, stop or file.size)
        after = stop
        entries: Entries = {}
        if any(stop == item for item in ends):
            entries, after = self._indexes(stop)
        raw = inflate(head, file.read(data, min(max(data, stop), data + MAX_CHUNK_BYTES)))
        proof = Proof.FAILED if head.compression or self._checked else Proof.NONE
        return Piece(-1, place, after, head=head, walked=walk(raw), proof=proof, entries=entries)

    def _indexes(self, place: int) -> tuple[Entries, int]:
        """Read consecutive message indexes; return them and their end."""
        file, indexes = self._file, {}
        while (prefix := file.prefix(place)) is not None and prefix[0] == Opcode.MESSAGE_INDEX:
            _, start, end = prefix
            size = end - start - (INDEX_HEAD.itemsize - RECORD_HEAD.size)
            if size < 0 or size % INDEX_ENTRY.itemsize or end > file.size or size > MAX_CHUNK_BYTES:
                break
            content = file.read(start, end)
            if int.from_bytes(content[2:6], "little") != size:
                break
            entries = np.frombuffer(content[6:], INDEX_ENTRY)
            if (entries["offset"] > MAX_CHUNK_BYTES).any():
                break  # bytes are missing in it, so its length covers a part of the next record
            indexes[int.from_bytes(content[:2], "little")] = entries
            place = end
        return indexes, place

    def _search(self, start: int, stop: int) -> int:
        """Return the next position where something proves itself; ``stop`` if there is none."""
        for place in self._file.find(_PLACES, start, stop):
            piece = self._at(place, searched=True) or self._hidden(place)
            if piece is not None and piece.start >= start:
                self._next = piece
                return piece.start
        return stop

    def _hidden(self, place: int) -> Piece | None:
        """Return a chunk that proves itself, although the record's prefix or its head is damaged.

        Args:
            place: position of the compression's name, or of the zstd frame.
        """
        file = self._file
        data = file.read(place, place + len(_NAMES[0]))
        if data.startswith(_NAMES):
            return self._chunk(place - _NAME_AT, place - _NAME_AT, None, searched=True)
        if not data.startswith(_FRAME):
            return None
        for size in _FRAME_BYTES:
            frame = frame_at(file.read(place, place + size))
            if frame is not None:
                raw, length = frame
                piece = Piece(Opcode.CHUNK, place, place + length, proof=Proof.CHECKSUM)
                piece = self._sound(piece, raw, place + length)
                sound = piece.walked is not None and piece.walked.whole and len(piece.walked)
                return piece if sound and self._claimed(piece, length) else None
        return None
