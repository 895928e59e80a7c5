"""The report of a recovery: the kept and the lost parts of each file, with their times.

A file that may be damaged, or may consist of several files, says in its summary sections what it held.
"""

from __future__ import annotations

import re
from collections import Counter
from datetime import datetime
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Channel, ChunkIndex, Footer, MetadataIndex, Schema, Statistics

from edoras_tools.io.formats.mcap.file import RECORD_HEAD
from edoras_tools.io.formats.mcap.recovery.records import FileBytes, Walked, parse
from edoras_tools.io.formats.mcap.writer import METADATA_NAME, OPENING_METADATA_NAME
from edoras_tools.io.topics.messages import MAGIC
from edoras_tools.mission.tree import printable
from edoras_tools.older import UTC
from edoras_tools.wire.arrays import crc32

if TYPE_CHECKING:
    from edoras_tools.io.formats.mcap.recovery.records import Definitions

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
