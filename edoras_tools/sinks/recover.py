"""Cut-off recordings made whole: everything that is there is kept, and what a reader needs is built anew."""

from __future__ import annotations

import os
import struct
import zlib
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
)

from edoras_tools.errors import CaptureError
from edoras_tools.sinks.mcap import METADATA_NAME, OPENING_METADATA_NAME
from edoras_tools.sinks.mcap_file import McapFile, Summary
from edoras_tools.sinks.mcap_index import MessageIndex
from edoras_tools.wire.mcap import MAGIC

if TYPE_CHECKING:
    from collections.abc import Iterator

_PREFIX = struct.Struct("<BQ")
"""Opcode and length of a record."""
_MESSAGE = struct.Struct("<HIQQ")
"""Channel, sequence, log time and publish time of a Message record."""
_CHUNK = struct.Struct("<QQQII")
"""Start time, end time, uncompressed size, CRC, length of the compression's name."""
_RECORDS: dict[int, Any] = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.ATTACHMENT: Attachment,
    Opcode.METADATA: Metadata,
}
"""What may stand among the data besides messages and chunks."""
_PRIVATE = 0x80
"""Opcodes from here on are anybody's own; readers pass over them."""
_COPY_BYTES = 1 << 20
_MAX_CHUNK_BYTES = 1 << 30
"""No chunk is larger; a length beyond it is a damaged one."""


@dataclass(frozen=True, slots=True)
class Recovery:
    """What a recovery found.

    Attributes:
        whole: the recording was whole already; nothing was written.
        messages: messages in the result, by topic.
        chunks: chunks in the result.
        salvaged: messages of these that were taken out of a chunk cut off.
        kept_bytes: bytes of the file that were kept.
        lost_bytes: bytes of the file that could not be kept, those of a summary cut off not counted.
    """

    whole: bool
    messages: dict[str, int] = field(default_factory=dict)
    chunks: int = 0
    salvaged: int = 0
    kept_bytes: int = 0
    lost_bytes: int = 0

    def __str__(self) -> str:
        total = sum(self.messages.values())
        if self.whole:
            return f"whole already: {total} messages in {self.chunks} chunks; nothing was written"
        chunks = f"{self.chunks} chunk{'s' * (self.chunks != 1)}"
        salvaged = f", {self.salvaged} of them out of a chunk cut off" if self.salvaged else ""
        lost = f"{self.lost_bytes} bytes could not be read"
        lines = [f"recovered {total} messages in {chunks}{salvaged}; {lost}"]
        lines += [f"  {count:>9}  {topic}" for topic, count in sorted(self.messages.items())]
        return "\n".join(lines)


def recover(source: str | Path, target: str | Path) -> Recovery:
    """Make a cut-off MCAP file whole, whoever wrote it.

    Whole records are kept byte for byte. Of a chunk that is cut off the messages that can still be
    decompressed are kept; one that is damaged is left out, as is every record that no reader could read.
    Message index, chunk index, statistics and summary are built anew.

    Args:
        source: the file that was cut off; it is only read.
        target: the file to write; nothing is written where ``source`` is whole.

    Returns:
        What was found.

    Raises:
        CaptureError: ``source`` cannot be read or is no MCAP file, or ``target`` cannot be written.
    """
    source, target = Path(source), Path(target)
    try:
        with source.open("rb") as file:
            reader = _Reader(source, file)
            if (whole := reader.whole()) is not None:
                return whole
            first = reader.prefix(len(MAGIC))
            if first is None or first[0] != Opcode.HEADER or first[2] > reader.size:
                raise CaptureError(f"{source}: is cut off in its first record; there is nothing to recover")
            if _parsed(Opcode.HEADER, reader.bytes(*first[1:])) is None:
                raise CaptureError(f"{source}: is damaged in its first record; no reader would open the rest")
            if target.exists() and target.samefile(source):
                raise CaptureError(f"{target}: is the recording itself; name another file to write")
            return _Rebuild(reader, target).run()
    except OSError as error:
        raise CaptureError(f"{source}: cannot be read: {error.strerror or error}") from error


class _Reader:
    """The records of a file, as far as they are whole."""

    def __init__(self, path: Path, file: Any) -> None:
        self.path = path
        self._file = file
        self.size = os.fstat(file.fileno()).st_size
        if self.bytes(0, len(MAGIC)) != MAGIC:
            raise CaptureError(f"{path}: is no MCAP file, or one without even its first 8 bytes")

    def bytes(self, start: int, end: int) -> bytes:
        self._file.seek(max(start, 0))
        data: bytes = self._file.read(max(end - start, 0))
        return data

    def prefix(self, position: int) -> tuple[int, int, int] | None:
        """Return opcode, start and end of the content of the record at ``position``, whole or not."""
        prefix = self.bytes(position, position + _PREFIX.size)
        if len(prefix) < _PREFIX.size:
            return None
        opcode, length = _PREFIX.unpack(prefix)
        return opcode, position + _PREFIX.size, position + _PREFIX.size + length

    def whole(self) -> Recovery | None:
        """Return the report of a file that needs nothing; None of any other."""
        from mcap.reader import make_reader

        if self.bytes(self.size - len(MAGIC), self.size) != MAGIC:
            return None
        self._file.seek(0)
        with suppress(McapError, struct.error, OSError, ValueError, OverflowError, MemoryError):
            summary = make_reader(self._file, validate_crcs=True).get_summary()
            if summary is not None and summary.statistics is not None:
                counts = summary.statistics.channel_message_counts
                return Recovery(
                    whole=True,
                    messages=_by_topic(summary.channels, counts),
                    chunks=len(summary.chunk_indexes),
                    kept_bytes=self.size,
                )
        return None


class _Rebuild:
    """One recovery under way."""

    def __init__(self, reader: _Reader, target: Path) -> None:
        self._reader = reader
        self._file = McapFile(target, header=b"")
        self._summary: Summary = self._file.summary
        self._metadata: dict[str, dict[str, str]] = {}
        self._salvaged = 0
        self._lost = 0

    def run(self) -> Recovery:
        """Copy record after record, then write the end."""
        try:
            self._copy(0, len(MAGIC))
            self._records()
            opening = self._metadata.get(OPENING_METADATA_NAME)
            if opening is not None and METADATA_NAME not in self._metadata:
                self._file.add_metadata(METADATA_NAME, {**opening, "recovered": "true"})
            self._file.finish()
        except BaseException:
            self._file.abandon()
            raise
        return Recovery(
            whole=False,
            messages=_by_topic(self._summary.channels, self._summary.counts),
            chunks=len(self._summary.chunks),
            salvaged=self._salvaged,
            kept_bytes=self._reader.size - self._lost,
            lost_bytes=self._lost,
        )

    def _records(self) -> None:
        reader = self._reader
        position = len(MAGIC)
        while (record := reader.prefix(position)) is not None:
            opcode, start, end = record
            past = end > reader.size and opcode != Opcode.CHUNK
            if opcode in {0, Opcode.DATA_END, Opcode.FOOTER} or past:
                break
            if opcode == Opcode.CHUNK:
                position = self._chunk(position, start, end)
                continue
            if opcode != Opcode.MESSAGE_INDEX:
                if self._note(opcode, start, end):
                    self._copy(position, end)
                else:
                    self._lost += end - position
            position = end
        if record is None or record[0] not in {Opcode.DATA_END, Opcode.FOOTER}:
            self._lost += max(reader.size - position, 0)

    def _chunk(self, position: int, start: int, end: int) -> int:
        """Take a chunk over, with the message index behind it; return where the next record is."""
        reader = self._reader
        content = reader.bytes(start, min(end, reader.size, start + _MAX_CHUNK_BYTES))
        raw, sound = _unpack(content)
        after = min(end, reader.size)
        while (record := reader.prefix(after)) is not None and record[0] == Opcode.MESSAGE_INDEX:
            if record[2] > reader.size:
                self._lost += reader.size - after
                after = reader.size
                break
            after = record[2]
        whole = end <= reader.size
        index, used = self._index(raw) if sound or not whole else (MessageIndex(), 0)
        readable = index.counts.keys() <= self._summary.channels.keys()
        if not readable or (whole and used < len(raw)) or (whole and not sound):
            # Nothing tells which of its bytes are wrong.
            self._lost += after - position
            return after
        if whole:
            chunk = Chunk.read(ReadDataStream(BytesIO(content)))
        else:
            self._lost += len(content) + (start - position)
            self._salvaged += sum(index.counts.values())
            raw = raw[:used]
            chunk = Chunk(
                compression="zstd",
                data=zstandard.ZstdCompressor().compress(raw),
                message_start_time=index.start_ns,
                message_end_time=index.end_ns,
                uncompressed_crc=zlib.crc32(raw),
                uncompressed_size=used,
            )
        if used:
            self._file.add_chunk(chunk, index)
        return after

    def _index(self, raw: bytes) -> tuple[MessageIndex, int]:
        """Walk the records of a chunk: build its message index, note its schemas and channels.

        Returns:
            The index; how many bytes hold whole records.
        """
        channels: list[int] = []
        log_times: list[int] = []
        positions: list[int] = []
        position = 0
        while position + _PREFIX.size <= len(raw):
            opcode, length = _PREFIX.unpack_from(raw, position)
            start = position + _PREFIX.size
            if start + length > len(raw) or opcode == 0:
                break
            if opcode == Opcode.MESSAGE and length >= _MESSAGE.size:
                channel_id, _, log_time, _ = _MESSAGE.unpack_from(raw, start)
                channels.append(channel_id)
                log_times.append(log_time)
                positions.append(position)
            elif not self._learn(_parsed(opcode, raw[start : start + length])):
                break
            position = start + length
        index = MessageIndex()
        if channels:
            index.add(
                np.array(channels, dtype=np.uint16),
                np.array(log_times, dtype=np.uint64),
                np.array(positions, dtype=np.int64),
            )
        return index, position

    def _note(self, opcode: int, start: int, end: int) -> bool:
        """Note a record that may be copied to where the target ends; False where no reader could read it."""
        place, length = self._file.size, end - start + _PREFIX.size
        content = self._reader.bytes(start, end)
        if opcode == Opcode.MESSAGE:
            if len(content) < _MESSAGE.size:
                return False
            channel_id, _, log_time, _ = _MESSAGE.unpack_from(content)
            known = channel_id in self._summary.channels
            if known:
                self._summary.add_messages({channel_id: 1}, log_time, log_time)
            return known
        record = _parsed(opcode, content)
        if isinstance(record, Metadata):
            self._metadata[record.name] = record.metadata
            self._summary.metadata.append(MetadataIndex(place, length, record.name))
        elif isinstance(record, Attachment):
            times, size = (record.log_time, record.create_time), len(record.data)
            self._summary.attachments.append(
                AttachmentIndex(place, length, *times, size, record.name, record.media_type)
            )
        return self._learn(record) or opcode >= _PRIVATE

    def _learn(self, record: Any) -> bool:
        """Note a schema or a channel; False where a reader could make nothing of the record."""
        if isinstance(record, Schema):
            self._summary.schemas[record.id] = record
        elif isinstance(record, Channel):
            if record.schema_id and record.schema_id not in self._summary.schemas:
                return False
            self._summary.channels[record.id] = record
        return record is not None

    def _copy(self, start: int, end: int) -> None:
        for here in range(start, end, _COPY_BYTES):
            self._file.add_bytes(self._reader.bytes(here, min(here + _COPY_BYTES, end)))


def _parsed(opcode: int, content: bytes) -> Any:
    """Return a record; None where the bytes are not exactly one of its kind: readers lose their way then."""
    # mcap takes less than it asked for in silence: with a byte behind the record, taking too much shows.
    stream = BytesIO(content + b"\0")
    with suppress(McapError, struct.error, ValueError, OverflowError):
        if opcode in _RECORDS:
            record = _RECORDS[opcode].read(ReadDataStream(stream))
            return record if stream.tell() == len(content) else None
    return None


def _unpack(content: bytes) -> tuple[bytes, bool]:
    """Decompress a chunk's content as far as it goes; tell whether it is whole and right."""
    try:
        _, _, size, crc, named = _CHUNK.unpack_from(content)
    except struct.error:
        return b"", False
    data = _CHUNK.size + named + 8
    compression = content[_CHUNK.size : data - 8].decode(errors="replace")
    packed = content[data:]
    raw = b"".join(_inflate(packed, compression, min(size, _MAX_CHUNK_BYTES)))
    fits = int.from_bytes(content[data - 8 : data], "little") == len(packed)
    return raw, fits and len(raw) == size and (not crc or zlib.crc32(raw) == crc)


def _inflate(packed: bytes, compression: str, size: int) -> Iterator[bytes]:
    if compression == "":
        yield packed
        return
    inflater: Any
    failures: tuple[type[Exception], ...]
    if compression == "zstd":
        inflater, failures = zstandard.ZstdDecompressor().decompressobj(), (zstandard.ZstdError,)
    elif compression == "lz4":
        import lz4.frame  # type: ignore[import-untyped]

        inflater, failures = lz4.frame.LZ4FrameDecompressor(), (RuntimeError, EOFError)
    else:
        return
    with suppress(*failures):
        # In small pieces: what comes before a damaged place is kept.
        filled = 0
        for start in range(0, len(packed), 1 << 12):
            piece = inflater.decompress(packed[start : start + (1 << 12)])
            filled += len(piece)
            if filled > size:
                return
            yield piece


def _by_topic(channels: dict[int, Channel], counts: dict[int, int]) -> dict[str, int]:
    topics: dict[str, int] = {}
    for channel_id, count in counts.items():
        topic = channels[channel_id].topic if channel_id in channels else f"channel {channel_id}"
        topics[topic] = topics.get(topic, 0) + count
    return topics
