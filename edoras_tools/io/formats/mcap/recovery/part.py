"""One of the files in a file that may consist of several: what of it is kept, and what is lost."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from edoras_tools.io.formats.mcap.writer import METADATA_NAME, OPENING_METADATA_NAME

if TYPE_CHECKING:
    from edoras_tools.io.formats.mcap.recovery.numbering import Definitions
    from edoras_tools.io.formats.mcap.recovery.summaries import FoundSummary


@dataclass(eq=False, slots=True)
class FilePart:
    """What is known about one file while it is read.

    Attributes:
        definitions: its channels.
        section: its summary, if that is intact.
        start: where it begins.
        listed: messages kept from chunks that its summary lists.
        others: other messages kept.
        claimed: the chunk indexes of its chunks, by identity.
        gaps: whether something in it is not kept.
        ended: whether its last data record was found.
        checked: whether a checksum over all of it is correct.
        gap_bytes: bytes that are not kept.
        names: names of the attachments and metadata records kept.
        loose: messages kept that are not in a chunk.
        last_ns: time of the last message kept.
    """

    definitions: Definitions
    section: FoundSummary | None = None
    start: int = 0
    listed: int = 0
    others: int = 0
    claimed: set[int] = field(default_factory=set)
    gaps: bool = False
    ended: bool = False
    checked: bool = False
    gap_bytes: int = 0
    names: list[str] = field(default_factory=list)
    loose: int = 0
    last_ns: int | None = None

    @property
    def missing(self) -> int | None:
        """Messages that are not kept; None if that is unknown."""
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
        names = [*self.section.names] if self.section else []
        for name in self.names:
            if name in names:
                names.remove(name)
        return [name for name in names if name != OPENING_METADATA_NAME or METADATA_NAME in names]

    def absorb(self, start: FilePart) -> None:
        """Add what was read before it was known to belong to this file."""
        self.start = start.start
        self.gaps |= start.gaps
        self.ended |= start.ended
        self.checked |= start.checked
        self.listed += start.listed
        self.others += start.others
        self.loose += start.loose
        self.gap_bytes += start.gap_bytes
        self.names += start.names
