"""Finds the records of a file that may be damaged anywhere; reports the kept and the lost parts, with times.

A file that may be damaged, or may consist of several files, says in its summary sections what it held.

Rules that the search for records keeps:

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
from collections import Counter
from collections.abc import Iterator
from datetime import datetime
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Channel, ChunkIndex, Footer, MetadataIndex, Schema, Statistics

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
from edoras_tools.io.formats.mcap.recovery.records import Definitions, Entries, FileBytes, Walked, parse, walk
from edoras_tools.io.formats.mcap.writer import METADATA_NAME, OPENING_METADATA_NAME
from edoras_tools.io.topics.messages import MAGIC
from edoras_tools.mission.tree import printable
from edoras_tools.older import UTC
from edoras_tools.wire.arrays import crc32

_FOOTER: Final = re.compile(re.escape(b"\x02\x14" + bytes(7)))
_DATA_END: Final = re.compile(re.escape(b"\x0f\x04" + bytes(7)))
_FOOTER_BYTES: Final = RECORD_HEAD.size + 20
_DATA_END_BYTES: Final = RECORD_HEAD.size + 4
_CRC_BYTES: Final = 4
_FAR: Final = 256 << 20
"""Bytes before a footer in which its summary is searched for."""
ChunkKey = tuple[int, int, int, int]
"""Identity of a chunk: first and last log time, compressed and uncompressed size."""


class FoundSummary(msgspec.Struct, eq=False):
    """An intact summary, or a placeholder for one that is missing.

    Attributes:
        base: start of its file; offsets in the summary count from there.
        start: start of the summary.
        end: end of the summary, with footer and magic.
        proven: whether a file does begin at ``base``.
        complete: whether there is a summary.
        schemas: schemas by id.
        channels: channels by id.
        statistics: the Statistics record; None if there is none.
        names: names of the attachments and metadata records.
        chunks: chunk indexes by the identity of the chunk.
    """

    base: int = 0
    start: int = 0
    end: int = 0
    proven: bool = False
    complete: bool = False
    schemas: dict[int, Schema] = msgspec.field(default_factory=dict)
    channels: dict[int, Channel] = msgspec.field(default_factory=dict)
    statistics: Statistics | None = None
    names: Counter[str] = msgspec.field(default_factory=Counter)
    chunks: dict[ChunkKey, list[ChunkIndex]] = msgspec.field(default_factory=dict)

    def owns(self, place: int) -> bool:
        """Return whether a position is certainly in the file of this summary."""
        return self.proven and self.base <= place < self.end

    def may_hold(self, name: str) -> bool:
        """Return whether an attachment or metadata record of this name may belong to this file."""
        statistics = self.statistics
        if name in self.names or statistics is None:
            return True
        return self.names.total() != statistics.attachment_count + statistics.metadata_count

    def listed(self, walked: Walked, head: tuple[int, int] | None, packed: int) -> list[ChunkIndex]:
        """Return the index of a chunk, if this file lists it; several if chunks have the same identity.

        Args:
            walked: messages of the chunk.
            head: log times in its head; None if that cannot be read.
            packed: compressed bytes.
        """
        sizes = packed, len(walked.data)
        indexes = self.chunks.get((*head, *sizes), []) if head else []
        if not indexes and len(walked):
            indexes = self.chunks.get((int(walked.log_time.min()), int(walked.log_time.max()), *sizes), [])
        return indexes


def summaries(file: FileBytes) -> list[FoundSummary]:
    """Return the summaries with a correct checksum, and complete ones without a checksum; in order."""
    sections: list[FoundSummary] = []
    for place in file.find(_FOOTER, 0, file.size):
        footer = parse(Opcode.FOOTER, file.read(place + RECORD_HEAD.size, place + _FOOTER_BYTES))
        if isinstance(footer, Footer) and footer.summary_start:
            section = _summary(file, place, footer)
            if section is not None:
                # Summaries inside this one's file are part of a message or an attachment.
                sections = [item for item in sections if not section.owns(item.start)]
                sections.append(section)
    return sections


def _summary(file: FileBytes, place: int, footer: Footer) -> FoundSummary | None:
    ends = [at + _DATA_END_BYTES for at in file.find(_DATA_END, max(0, place - _FAR), place)]
    for start in (start for start in (footer.summary_start, *reversed(ends)) if start <= place):
        data = file.read(start, place + _FOOTER_BYTES - _CRC_BYTES)
        if footer.summary_crc and crc32(data) != footer.summary_crc:
            continue
        section = _read(data[: place - start])
        if section is None:
            continue
        section.base, section.start = start - footer.summary_start, start
        end = place + _FOOTER_BYTES
        section.end = end + len(MAGIC) * (file.read(end, end + len(MAGIC)) == MAGIC)
        section.proven = section.base == 0 or (
            section.base > 0 and file.read(section.base, section.base + len(MAGIC)) == MAGIC
        )
        return section
    return None


def _read(data: bytes) -> FoundSummary | None:
    """Read a summary; None if it does not consist only of records."""
    section = FoundSummary(complete=True)
    place = 0
    while place < len(data):
        if place + RECORD_HEAD.size > len(data):
            return None
        opcode, length = RECORD_HEAD.unpack_from(data, place)
        start = place + RECORD_HEAD.size
        place = start + length
        record = parse(opcode, data[start:place])
        if place > len(data) or (record is None and opcode < Opcode.DATA_END):
            return None
        if isinstance(record, Schema):
            section.schemas[record.id] = record
        elif isinstance(record, Channel):
            section.channels[record.id] = record
        elif isinstance(record, Statistics):
            section.statistics = record
        elif isinstance(record, AttachmentIndex | MetadataIndex):
            section.names[record.name] += 1
        elif isinstance(record, ChunkIndex):
            times = record.message_start_time, record.message_end_time
            sizes = record.compressed_size, record.uncompressed_size
            section.chunks.setdefault((*times, *sizes), []).append(record)
    return section


class FilePart(msgspec.Struct, eq=False):
    """The present knowledge about one file while it is read.

    Attributes:
        definitions: its schemas and channels.
        section: its summary, if that is intact.
        start: position where it begins.
        listed: number of messages kept from chunks that its summary lists.
        others: number of other messages kept.
        claimed: identities of the chunk indexes of its chunks.
        gaps: whether something in it is not kept.
        ended: whether its last data record was read.
        checked: whether a checksum over all of it is correct.
        gap_bytes: bytes that are not kept.
        names: names of the attachments and metadata records kept.
        loose: number of kept messages that are not in a chunk.
        last_ns: time of the last message kept.
    """

    definitions: Definitions
    section: FoundSummary | None = None
    start: int = 0
    listed: int = 0
    others: int = 0
    claimed: set[int] = msgspec.field(default_factory=set)
    gaps: bool = False
    ended: bool = False
    checked: bool = False
    gap_bytes: int = 0
    names: Counter[str] = msgspec.field(default_factory=Counter)
    loose: int = 0
    last_ns: int | None = None

    @property
    def missing(self) -> int | None:
        """Number of messages that are not kept; None if it is unknown."""
        statistics = self.section.statistics if self.section else None
        if statistics is None or self.section is None:
            return None if self.gaps or not self.ended else 0
        if self.section.base - self.start > self.gap_bytes:
            return None  # more bytes before it than were added: the rest of another file
        if self.section.chunks:
            # Chunks that it does not list are of another file, whose size is unknown.
            return None if self.gaps and self.others else statistics.message_count - self.listed
        return max(statistics.message_count - self.others, 0)

    @property
    def lost(self) -> bool:
        """Whether anything was not kept."""
        return self.missing != 0 or bool(self.missing_records)

    @property
    def missing_records(self) -> list[str]:
        """Names of attachments and metadata that are not kept; a later record repeats the opening one."""
        names = self.section.names - self.names if self.section else Counter[str]()
        return [name for name in names.elements() if name != OPENING_METADATA_NAME or METADATA_NAME in names]

    def absorb(self, start: FilePart) -> None:
        """Add another part that turned out to be the start of this file."""
        self.start = start.start
        self.gaps |= start.gaps
        self.ended |= start.ended
        self.checked |= start.checked
        self.listed += start.listed
        self.others += start.others
        self.loose += start.loose
        self.gap_bytes += start.gap_bytes
        self.names += start.names


_LONGEST = 10_000
"""Most characters of a line: a topic may be any length."""
_MOST = 12
"""Most losses that are listed."""


class LostStretch(NamedTuple):
    """A range of the file that is not kept.

    Attributes:
        start: offset of its first byte.
        bytes: number of bytes.
        reason: why it is not kept.
        messages: number of messages lost in it; None if it is unknown.
        start_ns: earliest time of these messages, ns since 1970; None if it is unknown.
        end_ns: latest time of these messages.
    """

    start: int
    bytes: int
    reason: str
    messages: int | None = None
    start_ns: int | None = None
    end_ns: int | None = None

    def __str__(self) -> str:
        count = "" if self.messages is None else f", {self.messages:,} messages"
        return f"byte {self.start:,}: {self.bytes:,} bytes{count}{_times(self)}: {self.reason}"


class Recovery(msgspec.Struct, frozen=True):
    """The report of a recovery.

    Attributes:
        whole: whether the recording was intact, so that nothing was written.
        messages: number of messages in the result, by topic.
        chunks: number of chunks in the result.
        salvaged: number of messages in the result from damaged or cut-off chunks.
        kept_bytes: bytes of the file that were kept.
        lost_bytes: bytes of the file that could not be kept, without those of a damaged summary.
        proved: number of messages in the result with a correct checksum.
        unproved: number of messages in the result without a checksum.
        left_out: number of readable messages of damaged chunks that were not kept, because nothing proves
            them.
        lost: whether something was lost.
        lost_messages: number of messages lost; None if it is unknown.
        losses: stretches that were lost.
        reasons: reasons why it is not intact, one line each.
        unit: unit that ``messages`` counts; packets have no topic.
    """

    whole: bool
    messages: dict[str, int] = msgspec.field(default_factory=dict)
    chunks: int = 0
    salvaged: int = 0
    kept_bytes: int = 0
    lost_bytes: int = 0
    proved: int = 0
    unproved: int = 0
    left_out: int = 0
    lost: bool = False
    lost_messages: int | None = 0
    losses: list[LostStretch] = msgspec.field(default_factory=list)
    reasons: list[str] = msgspec.field(default_factory=list)
    unit: str = "messages"

    def text(self, *, written: bool) -> str:
        """Return the report for the user.

        Args:
            written: whether a repaired file was written.
        """
        content = f"{sum(self.messages.values())} {self.unit}"
        if self.chunks:
            content += f" in {self.chunks} chunk{'s' * (self.chunks != 1)}"
        if self.whole:
            lines = [f"intact: {content}{'; nothing was written' * written}"]
        else:
            lines = [f"{'recovered' if written else 'damaged:'} {content}; {self._lost()}"]
        if self.unproved:
            lines.append(
                f"  {self.unproved} of them have no checksum: they can be read, but nothing proves them"
            )
        if self.salvaged:
            lines.append(f"  {self.salvaged} of these are from chunks that are damaged or cut off")
        if self.left_out:
            lines.append(
                f"  left out: {self.left_out} that can be read but not proved; --unproved keeps them"
            )
        lines += [f"  {reason}" for reason in self.reasons]
        lines += [f"  {loss}" for loss in self.losses[:_MOST]]
        if len(self.losses) > _MOST:
            lines.append(f"  and {len(self.losses) - _MOST} more places")
        if not self.whole and self.unit == "messages":
            lines += [f"  {count:>9}  {topic}" for topic, count in sorted(self.messages.items())]
        return "\n".join(printable(line, _LONGEST) for line in lines)

    def _lost(self) -> str:
        if not self.lost:
            return "nothing is lost"
        count = f"the number of lost {self.unit} is unknown"
        if self.lost_messages is not None:
            count = f"{self.lost_messages} {self.unit} are lost"
        return f"{count}, {self.lost_bytes} bytes could not be kept"


def _times(loss: LostStretch) -> str:
    texts = [_time(value) for value in (loss.start_ns, loss.end_ns)]
    return f", {texts[0] or 'the start'} to {texts[1] or 'the end'}" if any(texts) else ""


def _time(time_ns: int | None) -> str:
    if time_ns is None:
        return ""
    try:
        return f"{datetime.fromtimestamp(time_ns / 1e9, UTC):%Y-%m-%d %H:%M:%S.%f}"[:-3]
    except (OverflowError, ValueError, OSError):
        return f"{time_ns} ns"


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
