"""The summary sections of a file that may be damaged, or may consist of several files."""

from __future__ import annotations

import re
from collections import Counter
from typing import TYPE_CHECKING, Final

import msgspec
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Channel, ChunkIndex, Footer, MetadataIndex, Schema, Statistics

from edoras_tools.io.formats.mcap.file import RECORD_HEAD
from edoras_tools.io.formats.mcap.recovery.records import FileBytes, parse
from edoras_tools.io.topics.rows import MAGIC
from edoras_tools.wire.arrays.sums import crc32

if TYPE_CHECKING:
    from edoras_tools.io.formats.mcap.recovery.records import Walked

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
    for start in (footer.summary_start, *reversed(ends)):
        if start > place:
            continue
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
