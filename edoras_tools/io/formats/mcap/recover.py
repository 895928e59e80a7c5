"""Repairs damaged recordings: keeps what can be proved, and rebuilds the indexes that readers need.

``scan`` finds the records. The rules for keeping them:

1. A chunk with a correct checksum is kept, with channels of the file that it belongs to: those of the summary
   that lists the chunk, else those of a chunk near it whose checksum is right, else those that came before.
2. A chunk with a wrong checksum, or a cut-off one, is not kept: one wrong bit often decompresses without an
   error to other bytes. Its readable messages are counted, and kept only on request.
3. Data that never had a checksum is kept as far as it can be read: there is no way to check it.
4. A channel whose record is lost is taken for a channel of our recorder if that could have written all its
   messages; else its topic is ``/unknown/N``. If a summary lists the channels, no other channel is kept.

The records that describe a chunk may be after it, so a damaged file is read a second time with the results
of the first reading. The result is read through its own index, and by the ``mcap`` library, before it gets
its name.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Container, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    DataEnd,
    Header,
    Message,
    Metadata,
    MetadataIndex,
    Schema,
)
from mcap.stream_reader import breakup_chunk
from msgspec.structs import replace

from edoras_tools import __version__
from edoras_tools.errors import CaptureError, os_errors
from edoras_tools.io.formats.mcap.chunks import CHUNK_BYTES, Proof
from edoras_tools.io.formats.mcap.file import (
    MESSAGE_HEAD,
    RECORD_HEAD,
    McapFile,
    join_chunks,
    pack_chunks,
    record_bytes,
)
from edoras_tools.io.formats.mcap.messages import chunk_content
from edoras_tools.io.formats.mcap.recovery.records import (
    Definitions,
    FileBytes,
    KnownTopics,
    Numbering,
    RecordId,
    Stretch,
    Walked,
    renumbered,
    walk,
)
from edoras_tools.io.formats.mcap.recovery.report import (
    FilePart,
    FoundSummary,
    LostStretch,
    Piece,
    Recovery,
    Scan,
    summaries,
)
from edoras_tools.io.formats.mcap.writer import METADATA_NAME, OPENING_METADATA_NAME
from edoras_tools.io.topics.messages import MAGIC

if TYPE_CHECKING:
    from pathlib import Path

    from edoras_tools.io.outputs import NewFile

_BY_LIBRARY: Final = 20_000
"""Approximate number of messages to read with the ``mcap`` library too: it takes some 40 us for each."""
_COPY_BYTES = 1 << 20


class Recording:
    """A damaged or cut-off MCAP file, or several in sequence, written by any program.

    Intact chunks are kept byte for byte. Message index, chunk index, statistics and summary are rebuilt.

    Args:
        topics: topics of a recording of ours whose channel records are lost.
        unproved: also keep readable messages of damaged and cut-off chunks.
    """

    def __init__(self, path: Path, topics: KnownTopics, unproved: bool) -> None:
        self._path, self._topics, self._unproved = path, topics, unproved
        self._stretches: Sequence[Stretch] = ()
        """What a further reading needs."""

    def report(self, progress: Callable[[int, int], None]) -> Recovery:
        """Read the whole file, and check every checksum; a second time, if that may find more.

        Raises:
            CaptureError: the file cannot be read, is not MCAP, or has no message that could be kept.
        """
        with FileBytes(self._path) as file:
            first = self._assembly(file, None)
            report = first.run(progress)
            if first.doubtful and any(item.proved or item.fits for item in first.stretches):
                self._stretches = first.stretches
                report = self._assembly(file, None).run(progress)
            if not report.whole and not sum(report.messages.values()):
                damaged = any(loss.messages for loss in report.losses) or report.left_out
                if not damaged and file.read(0, len(MAGIC)) != MAGIC:
                    raise CaptureError(
                        f"{file.path}: is not an MCAP file, or one without any complete record"
                    )
                why = f": {report.losses[0].reason}" if report.losses else ""
                raise CaptureError(f"{file.path}: it contains nothing to recover{why}")
        return report

    def write(self, new: NewFile, progress: Callable[[int, int], None]) -> Recovery:
        """Read the whole file again, write what can be kept, and check the result by reading it."""
        with FileBytes(self._path) as file:
            report = self._assembly(file, McapFile(new.place, header=b"")).run(progress)
        return read_again(new.place, report) if new.regular else report

    def _assembly(self, file: FileBytes, out: McapFile | None) -> _Assembly:
        return _Assembly(file, out, self._topics, self._stretches, unproved=self._unproved)


def read_again(path: Path, report: Recovery) -> Recovery:
    """Return the report of a recovery, with a reason added if readers do not find all messages.

    Every message is read along the index, and whole chunks, evenly spread, by the ``mcap`` library.

    Raises:
        CaptureError: the file cannot be opened.
    """
    expected, read, refusal = Counter(report.messages), Counter[str](), ""
    with os_errors(f"{path}: cannot be read"), path.open("rb") as file:
        try:
            summary = make_reader(file).get_summary()
            assert summary is not None, "it has just been written"
            step = 1 + expected.total() // _BY_LIBRARY
            for number, index in enumerate(summary.chunk_indexes):
                counts = Counter(chunk_content(file, path.name, index, summary.channels).channel_id.tolist())
                for channel, count in counts.items():
                    read[summary.channels[channel].topic] += count
                if number % step == 0 and counts.total() <= _BY_LIBRARY:
                    file.seek(index.chunk_start_offset + RECORD_HEAD.size)
                    records = breakup_chunk(Chunk.read(ReadDataStream(file)), validate_crc=True)
                    again = Counter(item.channel_id for item in records if isinstance(item, Message))
                    refusal = refusal if again == counts else "the mcap library finds other messages in it"
        except (CaptureError, McapError, EOFError, ValueError) as error:
            refusal = str(error)
    if read != expected and not refusal:
        refusal = f"its index leads to {read.total():,} of {expected.total():,} messages"
    if not refusal:
        return report
    return replace(report, lost=True, reasons=[*report.reasons, f"of the result: {refusal}"])


def add_chunk(out: McapFile, walked: Walked, *, proved: bool) -> None:
    """Write records as a chunk; with a checksum if they are ``proved``."""
    raw = walked.data.data
    packed = zstandard.ZstdCompressor(write_checksum=proved).compress(raw)
    out.add_chunks(pack_chunks(raw, [packed], walked.index(), proved=proved))


class _Assembly:
    """Assembles the pieces of a scan into a file; if ``out`` is None, it only counts them.

    Args:
        known: stretches of an earlier reading.
    """

    def __init__(
        self,
        file: FileBytes,
        out: McapFile | None,
        topics: KnownTopics,
        stretches: Sequence[Stretch],
        *,
        unproved: bool,
    ) -> None:
        self._topics, self._known = topics, stretches
        self.stretches: list[Stretch] = []
        self.doubtful = False
        """Whether another reading that uses ``stretches`` may find more."""
        self._unknown: set[int] = set()
        self._loose = bytearray()
        self._file = file
        self._out = out
        self._unproved = unproved
        self._scan = Scan(file, summaries(file))
        self._numbering = Numbering(out)
        self._parts: list[FilePart] = []
        self._of: dict[FoundSummary, FilePart] = {}
        self._current = self._new(0)
        self._metadata: dict[str, dict[str, str]] = {}
        self._counts: dict[int, int] = {}
        self._losses: list[LostStretch] = []
        self._reasons: dict[str, None] = {}
        self._headed = False
        self._open_loss = False
        self._pieces = self._chunks = self._salvaged = self._proved = self._free = self._left_out = (
            self._lost_bytes
        ) = 0

    def run(self, progress: Callable[[int, int], None]) -> Recovery:
        """Process the whole file, write the end of the result, and return the report."""
        for piece in self._scan.pieces():
            self._take(piece)
            progress(piece.end, self._file.size)
        self._put_loose()
        self.doubtful |= any(part.definitions.altered for part in self._parts)
        self._parts = [part for part in self._parts if part.ended or part.gaps or part.listed or part.others]
        whole = self._whole()
        if self._out is not None:
            opening = self._metadata.get(OPENING_METADATA_NAME)
            if opening is not None and METADATA_NAME not in self._metadata:
                self._out.add_metadata(METADATA_NAME, {**opening, "recovered": "true"})
            self._out.finish()
        missing = [part.missing for part in self._parts]
        messages = Counter[str]()
        for number, count in self._counts.items():
            messages[self._numbering.topics[number]] += count
        return Recovery(
            whole=whole,
            messages=dict(messages),
            chunks=self._pieces if whole else self._chunks,
            salvaged=self._salvaged,
            kept_bytes=self._file.size - self._lost_bytes,
            lost_bytes=self._lost_bytes,
            proved=self._proved,
            unproved=self._free,
            left_out=self._left_out,
            lost=bool(self._unknown) or any(part.lost for part in self._parts),
            lost_messages=None if None in missing else sum(item or 0 for item in missing),
            losses=self._losses,
            reasons=[] if whole else list(self._reasons),
        )

    def _take(self, piece: Piece) -> None:
        if piece.opcode < 0:
            self._gap(piece)
        elif piece.opcode == 0:
            if piece.record:
                self._current = self._of_place(piece.start) or self._new(piece.start)
        elif piece.opcode == Opcode.CHUNK:
            self._chunk(piece)
        elif piece.opcode == Opcode.MESSAGE_INDEX:
            self._orphan(piece)
        else:
            self._record(piece)
        self._open_loss = piece.opcode < 0 or (self._open_loss and piece.opcode == Opcode.MESSAGE_INDEX)

    def _new(self, start: int, section: FoundSummary | None = None) -> FilePart:
        definitions = (section.schemas, section.channels) if section else ({}, {})
        part = FilePart(Definitions(*definitions), section, start)
        self._parts.append(part)
        self.stretches.append(Stretch())
        if section is not None:
            self._of[section] = part
        return part

    @property
    def _stretch(self) -> Stretch:
        """The results of an earlier reading for the present stretch."""
        place = len(self.stretches) - 1
        return self._known[place] if place < len(self._known) else Stretch()

    def _definition(self, part: FilePart, number: int) -> tuple[Channel, Schema | None] | None:
        """Return a channel and its schema; None if the file cannot have it."""
        part.definitions.late = self._stretch.proved
        definition = part.definitions.channel(number)
        if definition is None and part.definitions.complete:
            return None
        if definition is not None and (definition[1] or not definition[0].schema_id):
            return definition
        self.doubtful = True
        if definition is not None:
            return definition[0], self._topics.schema(definition[0].topic)
        if definition := self._topics.channel(number, self._stretch):
            return definition
        self._unknown.add(number)
        return Channel(number, f"/unknown/{number}", "", {}, 0), None

    def _of_place(self, place: int) -> FilePart | None:
        """Return the part that certainly contains a position; None if it is unknown."""
        section = self._scan.section(place)
        if section is None or not section.owns(place):
            return None
        return self._of.get(section) or self._new(section.base, section)

    def _part(self, place: int) -> FilePart:
        return self._of_place(place) or self._current

    def _gap(self, piece: Piece) -> None:
        part = self._part(piece.start)
        if part.ended:  # its summary, which is built new
            self._reasons["its summary is damaged or cut off"] = None
            return
        self.stretches.append(Stretch())
        size = piece.end - piece.start
        part.gaps = True
        part.gap_bytes += size
        count = sum(map(len, piece.entries.values())) if piece.entries else None
        reason = "no record can be read"
        times: tuple[int | None, int | None] = (part.last_ns, None)
        if piece.head is not None and piece.walked is not None:
            cut = piece.end == self._file.size and not piece.entries
            reason = "a chunk is cut off" if cut else "a chunk is damaged"
            if piece.head.start_ns <= piece.head.end_ns and piece.head.end_ns:
                times = piece.head.start_ns, piece.head.end_ns
            self._salvage(part, piece, piece.walked)
        elif not any(self._file.read(piece.start, min(piece.end, piece.start + _COPY_BYTES))):
            reason = (
                "zeros; the file was truncated while it was written, or its blocks never reached the disk"
            )
        self._lost_bytes += size
        if self._open_loss and self._losses and piece.end == self._file.size:
            # Its message index is cut off too, so the index does not list all messages.
            last = self._losses.pop()
            piece_start, size, reason = last.start, last.bytes + size, last.reason
            self._losses.append(LostStretch(piece_start, size, reason, None, last.start_ns, last.end_ns))
            return
        self._losses.append(LostStretch(piece.start, size, reason, count, *times))

    def _salvage(self, part: FilePart, piece: Piece, walked: Walked) -> None:
        """Keep the readable messages of a damaged chunk, if requested; otherwise count them."""
        rows = walked.agree(piece.entries) if piece.entries else np.ones(len(walked), bool)
        others, walked = walked.others, walked.take(rows)
        if piece.proof is not Proof.NONE and not self._unproved:
            self._left_out += len(walked)
            return
        for record in others:
            if isinstance(record, Schema | Channel):
                part.definitions.learn(record)
        before = self._total
        self._keep(part, walked, None)
        self._salvaged += self._total - before
        self._free += self._total - before
        part.others += self._total - before

    def _orphan(self, piece: Piece) -> None:
        """Use a message index without its chunk: it lists messages that are lost."""
        if self._open_loss and self._losses and (last := self._losses[-1]).messages is None:
            count = sum(map(len, piece.entries.values()))
            size = last.bytes + piece.end - piece.start
            times = np.concatenate([item["log_time"] for item in piece.entries.values()])
            times_ns = (int(times.min()), int(times.max())) if len(times) else (last.start_ns, last.end_ns)
            self._losses[-1] = LostStretch(last.start, size, last.reason, count, *times_ns)
            self._lost_bytes += piece.end - piece.start
        else:
            self._reasons["a message index belongs to no chunk"] = None

    def _chunk(self, piece: Piece) -> None:
        self._pieces += 1
        walked = piece.walked
        assert walked is not None
        part, listed = self._claim(piece, walked)
        if not piece.indexed:
            self._reasons["a message index does not match its chunk"] = None
        if not piece.record_end:
            self._reasons["the head of a chunk is damaged"] = None
        before = self._total
        self._keep(part, walked, piece)
        count = self._total - before
        if piece.proof is Proof.CHECKSUM:
            self._proved += count
        else:
            self._free += count
        if listed:
            part.listed += count
        else:
            part.others += count
        missing = len(walked) - count
        if missing or not walked.whole:
            part.gaps = True
            reason = "messages of channels without a description" if missing else "a chunk is damaged"
            span = piece.end - piece.start
            self._losses.append(LostStretch(piece.start, span, reason, missing or None, *_span(walked)))
            self._lost_bytes += span if not count else 0

    def _claim(self, piece: Piece, walked: Walked) -> tuple[FilePart, bool]:
        """Return the part that a chunk belongs to, and whether its summary lists the chunk."""
        part = self._part(piece.start)
        section = self._scan.section(piece.start)
        if section is None:
            return part, False
        packed = (piece.record_end or piece.end) - piece.start
        if piece.head is not None:
            packed = piece.head.length
        times = (piece.head.start_ns, piece.head.end_ns) if piece.head else None
        fitting = section.listed(walked, times, packed)
        if fitting:
            part = self._of.get(section) or self._new(section.base, section)
        free = [index for index in fitting if id(index) not in part.claimed]
        own = [index for index in free if index.chunk_start_offset + part.start == piece.start] or free[:1]
        part.claimed |= set(map(id, own))
        if section.chunks and not (own and own[0].chunk_start_offset + section.base == piece.start):
            self._reasons["its chunks are not at the positions in its index"] = None
        return part, bool(own)

    @property
    def _total(self) -> int:
        return sum(self._counts.values())

    def _keep(self, part: FilePart, walked: Walked, piece: Piece | None) -> None:
        """Write the messages of a chunk whose channels are known; an intact chunk is copied unchanged."""
        self._begin()
        definitions = [record for record in walked.others if isinstance(record, Schema | Channel)]
        ids = np.unique(walked.channel).tolist()
        self._learn(part, definitions, walked, proved=piece is not None and piece.proof is Proof.CHECKSUM)
        channels = {key: definition for key in ids if (definition := self._definition(part, key)) is not None}
        number = partial(self._numbering.channel, write=False)
        numbers = {key: number(*definition) for key, definition in channels.items()}
        stands = (
            piece is not None
            and piece.record_end > 0
            and walked.whole
            and all(numbers.get(key) == key for key in ids)
            and self._stand(part, definitions)
        )
        inside = _before_use(walked, channels) if stands else set()
        for record in walked.others:
            self._define(part, record, inside)
        for channel, schema in channels.values():
            self._numbering.channel(channel, schema, inside=inside)
        if not stands:
            walked = walked.take(np.isin(walked.channel, list(channels))).rebuilt(numbers)
        if not stands and not len(walked):
            return
        self._put_loose()
        self._chunks += 1
        for number in np.unique(walked.channel).tolist():
            count = int(np.count_nonzero(walked.channel == number))
            self._counts[number] = self._counts.get(number, 0) + count
        if len(walked):
            part.last_ns = int(walked.log_time.max())
        if self._out is not None:
            self._write(self._out, walked, piece, stands=stands)

    def _learn(
        self, part: FilePart, definitions: Sequence[Schema | Channel], walked: Walked, *, proved: bool
    ) -> None:
        """Learn the schemas and channels in a chunk, and which undescribed channels may be our recorder's."""
        for record in definitions:
            part.definitions.learn(record)
            if proved:
                self.stretches[-1].learn(record)
        if proved and not self._known and not part.definitions.complete:
            fits = self.stretches[-1].fits
            for key in np.unique(walked.channel).tolist():
                if part.definitions.channel(key) is None:
                    fits[key] = fits.get(key, True) and self._topics.fits(key, walked)

    def _put_loose(self) -> None:
        """Put the messages outside of chunks into a chunk: indexes lead only to chunks."""
        if self._loose:
            walked, self._loose = walk(bytes(self._loose)), bytearray()
            self._chunks += 1
            if self._out is not None:
                self._write(self._out, walked, None, stands=False)

    def _stand(self, part: FilePart, definitions: Sequence[Schema | Channel]) -> bool:
        """Return whether these definitions are those of the part, and keep their numbers."""
        return all(
            part.definitions.agrees(item) and self._numbering.keeps(item, part.definitions.below(item))
            for item in definitions
        )

    def _write(self, out: McapFile, walked: Walked, piece: Piece | None, *, stands: bool) -> None:
        if stands and piece is not None and piece.head is not None:
            stretch = self._file.read(piece.start, piece.record_end)
            out.add_chunks(join_chunks([(stretch,)], [piece.head], walked.index()))
        else:
            add_chunk(out, walked, proved=piece is not None and piece.proof is Proof.CHECKSUM)

    def _record(self, piece: Piece) -> None:
        part, record = self._part(piece.start), piece.record
        if piece.opcode == Opcode.MESSAGE:
            self._message(part, piece)
        elif isinstance(record, FoundSummary):
            self._close(record)
        elif isinstance(record, Schema | Channel):
            if not part.ended:  # records of a damaged summary prove nothing
                part.definitions.learn(record)
                self._define(part, record)
        elif isinstance(record, DataEnd):
            part.ended = True
            crc = record.data_section_crc
            if crc and not part.gaps:
                part.checked = self._file.crc(part.start, piece.start) == crc
                if not part.checked:
                    self._reasons["a record that has no checksum of its own was altered"] = None
        elif isinstance(record, Header):
            self._begin(record)
        elif isinstance(record, Metadata | Attachment) or piece.opcode > Opcode.DATA_END:
            self._extra(part, piece)

    def _begin(self, header: Header | None = None) -> None:
        """Write the beginning of the file once; without ``header``, with a header record of our own."""
        if self._headed:
            return
        self._headed = True
        if self._out is not None:
            profile = "ros2" if self._scan.of_ros2 else ""
            self._out.add_bytes(
                MAGIC + record_bytes(header or Header(profile, f"edoras-tools {__version__}"))
            )

    def _define(self, part: FilePart, record: Schema | Channel, inside: Container[RecordId] = ()) -> None:
        """Write a new schema or channel at this place; those ``inside`` are in the chunk itself."""
        self._begin()
        if isinstance(record, Schema):
            schema = part.definitions.schema(record.id)
            if schema is not None:
                self._numbering.schema(schema, inside=inside)
        elif (definition := part.definitions.channel(record.id)) is not None:
            self._numbering.channel(*definition, inside=inside)

    def _message(self, part: FilePart, piece: Piece) -> None:
        channel_id, _, log_time, _ = MESSAGE_HEAD.unpack_from(piece.record)
        definition = self._definition(part, channel_id)
        if definition is None:
            part.gaps = True
            span, reason = piece.end - piece.start, "a message of a channel without a description"
            self._losses.append(LostStretch(piece.start, span, reason, 1, log_time, log_time))
            self._lost_bytes += span
            return
        self._begin()
        number = self._numbering.channel(*definition)
        self._counts[number] = self._counts.get(number, 0) + 1
        part.others += 1
        part.loose += 1
        part.last_ns = log_time
        content = renumbered(piece.record, number)
        self._loose += RECORD_HEAD.pack(Opcode.MESSAGE, len(content)) + content
        if len(self._loose) >= CHUNK_BYTES:
            self._put_loose()

    def _extra(self, part: FilePart, piece: Piece) -> None:
        """Copy a metadata record, an attachment, or a private record."""
        if piece.record and part.section and not part.section.may_hold(piece.record.name):
            return
        self._begin()
        record, length = piece.record, piece.end - piece.start
        if record is not None:
            part.names[record.name] += 1
        if isinstance(record, Metadata):
            self._metadata[record.name] = record.metadata
        if self._out is None:
            return
        summary, place = self._out.summary, self._out.size
        if isinstance(record, Metadata):
            summary.metadata.append(MetadataIndex(place, length, record.name))
        elif isinstance(record, Attachment):
            times, size = (record.log_time, record.create_time), len(record.data)
            summary.attachments.append(
                AttachmentIndex(place, length, *times, size, record.name, record.media_type)
            )
        for start in range(piece.start, piece.end, _COPY_BYTES):
            self._out.add_bytes(self._file.read(start, min(start + _COPY_BYTES, piece.end)))

    def _close(self, section: FoundSummary) -> None:
        """Note the end of a file; what was read before belongs to it, even if its start is unknown."""
        part, current = self._of.get(section) or self._new(section.base, section), self._current
        if current is not part and current.section is None:
            part.absorb(current)
            self._parts.remove(current)
        part.ended = True
        self._current = part

    def _whole(self) -> bool:
        """Return whether the file is intact; if not, add the reasons."""
        part = self._parts[0] if self._parts else self._current
        section = part.section
        why = {
            "it consists of several files": len(self._parts) > 1,
            "it ends without its last records: what followed is unknown": not part.ended,
            "it has no intact summary": section is None or section.statistics is None,
            "a schema or a channel differs from that in its summary": part.definitions.altered,
            "messages stand beside its chunks, where no index leads": self._pieces and part.loose,
            f"the description of {len(self._unknown)} channels is lost: /unknown/N has their messages": (
                self._unknown
            ),
        }
        if section is not None and section.statistics is not None:
            ends = section.base == 0 and section.end == self._file.size
            why["it does not begin or end like an MCAP file"] = (
                not ends
                or self._file.read(0, len(MAGIC)) != MAGIC
                or self._file.read(section.end - len(MAGIC), section.end) != MAGIC
            )
            why["its statistics do not match its messages"] = section.statistics.message_count != self._total
            why["its summary has another number of chunks"] = section.statistics.chunk_count != self._pieces
        for part in self._parts:
            if part.checked:
                self._proved += part.loose
                self._free -= part.loose
        self._free += sum(part.loose for part in self._parts)
        for name in {name: None for part in self._parts for name in part.missing_records}:
            why[f"its record {name} is lost"] = True
        self._reasons |= {reason: None for reason, holds in why.items() if holds}
        return not self._reasons and not self._losses


def _before_use(walked: Walked, channels: Mapping[int, tuple[Channel, Schema | None]]) -> set[RecordId]:
    """Return the schemas and channels that stand in a chunk before the messages that need them.

    The others must be written before the chunk, for readers that read a file from its beginning.
    """
    places: dict[RecordId, int] = {}
    for item, place in zip(walked.others, walked.places, strict=True):
        places.setdefault((type(item), item.id), place)
    inside = {*places}
    for key, (_, schema) in channels.items() if inside else ():
        needed = {(Channel, key), *([(Schema, schema.id)] if schema else [])}
        if max(places.get(item, len(walked.data)) for item in needed) > walked.first(key):
            inside -= needed
    return inside


def _span(walked: Walked) -> tuple[int, int] | tuple[None, None]:
    return (int(walked.log_time.min()), int(walked.log_time.max())) if len(walked) else (None, None)
