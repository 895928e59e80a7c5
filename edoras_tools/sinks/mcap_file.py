"""One MCAP file on disk: records one after the other, and the summary that makes it whole.

Everything but messages and their index goes through the record classes of the ``mcap`` library.
"""

from __future__ import annotations

import os
import struct
import zlib
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from edoras_tools import __version__
from edoras_tools.errors import CaptureError
from edoras_tools.wire.mcap import MAGIC, RECORD_PREFIX_BYTES

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from edoras_tools.sinks.mcap_index import MessageIndex

_PIECES = 1024
"""Most that one call may write, Linux's IOV_MAX."""
_FOOTER_BYTES_IN_CRC = 9 + 8 + 8
"""The summary's CRC covers the footer record up to the CRC itself."""


@dataclass(slots=True)
class Summary:
    """What the data section holds; becomes the summary section.

    Attributes:
        counts: messages of each channel.
        start_ns: log time of the first message in time; None before there is one.
        end_ns: log time of the last.
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)
    attachments: list[AttachmentIndex] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)
    start_ns: int | None = None
    end_ns: int = 0

    def add_messages(self, counts: Mapping[int, int], start_ns: int, end_ns: int) -> None:
        """Count messages, by channel, whose log times are from ``start_ns`` to ``end_ns``."""
        for channel_id, count in counts.items():
            self.counts[channel_id] = self.counts.get(channel_id, 0) + count
        self.start_ns = start_ns if self.start_ns is None else min(self.start_ns, start_ns)
        self.end_ns = max(self.end_ns, end_ns)

    @property
    def statistics(self) -> Statistics:
        """The Statistics record."""
        return Statistics(
            attachment_count=len(self.attachments),
            channel_count=len(self.channels),
            channel_message_counts=self.counts,
            chunk_count=len(self.chunks),
            message_count=sum(self.counts.values()),
            message_end_time=self.end_ns,
            message_start_time=self.start_ns or 0,
            metadata_count=len(self.metadata),
            schema_count=len(self.schemas),
        )

    def tail(self, position: int) -> bytes:
        """Return all that follows the data section: DataEnd, summary with its CRC, footer, magic.

        Args:
            position: where the data section ends in the file.
        """
        end = _encode(DataEnd(0))
        start = position + len(end)
        builder = RecordBuilder()
        offsets: list[SummaryOffset] = []
        groups: list[tuple[Opcode, list[McapRecord]]] = [
            (Opcode.SCHEMA, [*self.schemas.values()]),
            (Opcode.CHANNEL, [*self.channels.values()]),
            (Opcode.STATISTICS, [self.statistics]),
            (Opcode.CHUNK_INDEX, [*self.chunks]),
            (Opcode.ATTACHMENT_INDEX, [*self.attachments]),
            (Opcode.METADATA_INDEX, [*self.metadata]),
        ]
        for opcode, records in groups:
            before = builder.count
            for record in records:
                record.write(builder)
            if records:
                offsets.append(SummaryOffset(opcode, start + before, builder.count - before))
        offset_start = start + builder.count
        for offset in offsets:
            offset.write(builder)
        summary = _built(builder)
        unsigned = _encode(Footer(start, offset_start, 0))[:_FOOTER_BYTES_IN_CRC]
        footer = Footer(start, offset_start, zlib.crc32(unsigned, zlib.crc32(summary)))
        return end + summary + _encode(footer) + MAGIC


class McapFile:
    """An MCAP file being written, front to back; no method may run while another does.

    Args:
        path: the file; an existing one is replaced.
        header: what it starts with; magic and a header record of the ``ros2`` profile by default.

    Raises:
        CaptureError: from every method: the file cannot be written.
    """

    def __init__(self, path: Path, header: bytes | None = None) -> None:
        self.path = path
        self.summary = Summary()
        self.size = 0
        try:
            self._file = path.open("wb", buffering=0)
        except OSError as error:
            raise CaptureError(f"{path}: cannot be created: {error.strerror or error}") from error
        try:
            self.add_bytes(_opening() if header is None else header)
        except CaptureError:
            self.abandon()
            raise

    def add_schema(self, name: str, definition: str) -> int:
        """Write a ``ros2msg`` schema; return its id."""
        schema = Schema(
            id=len(self.summary.schemas) + 1, data=definition.encode(), encoding="ros2msg", name=name
        )
        self.summary.schemas[schema.id] = schema
        self.add_bytes(_encode(schema))
        return schema.id

    def add_channel(self, topic: str, schema_id: int, metadata: Mapping[str, str]) -> int:
        """Write a channel of CDR messages; return its id."""
        # The ros2 profile of the MCAP registry requires the key; unknown is an empty string.
        channel = Channel(
            id=len(self.summary.channels) + 1,
            topic=topic,
            message_encoding="cdr",
            metadata={"offered_qos_profiles": "", **metadata},
            schema_id=schema_id,
        )
        self.summary.channels[channel.id] = channel
        self.add_bytes(_encode(channel))
        return channel.id

    def add_attachment(self, name: str, media_type: str, data: bytes, time_ns: int) -> None:
        """Write an attachment, logged at ``time_ns``."""
        name = _text(name)
        record = _encode(Attachment(0, time_ns, name, media_type, data))
        index = AttachmentIndex(self.size, len(record), time_ns, 0, len(data), name, media_type)
        self.add_bytes(record)
        self.summary.attachments.append(index)

    def add_metadata(self, name: str, values: dict[str, str]) -> None:
        """Write a metadata record."""
        record = _encode(Metadata(name, {key: _text(value) for key, value in values.items()}))
        index = MetadataIndex(self.size, len(record), name)
        self.add_bytes(record)
        self.summary.metadata.append(index)

    def add_chunk(self, record: Chunk, index: MessageIndex) -> None:
        """Write a chunk and its message index, and get them out of the process."""
        head = _chunk_head(record)
        pieces, places = index.records()
        start, length = self.size, len(head) + len(record.data)
        self.add_bytes(head, record.data, *pieces)
        index_start = start + length
        self.summary.chunks.append(
            ChunkIndex(
                chunk_length=length,
                chunk_start_offset=start,
                compression=record.compression,
                compressed_size=len(record.data),
                message_end_time=record.message_end_time,
                message_index_length=self.size - index_start,
                message_index_offsets={key: index_start + place for key, place in places.items()},
                message_start_time=record.message_start_time,
                uncompressed_size=record.uncompressed_size,
            )
        )
        self.summary.add_messages(index.counts, record.message_start_time, record.message_end_time)

    def finish(self) -> None:
        """Write the summary and close the file."""
        self.add_bytes(self.summary.tail(self.size))
        self.abandon()

    def abandon(self) -> None:
        """Close the file as it is."""
        self._file.close()

    def add_bytes(self, *pieces: bytes | memoryview) -> None:
        """Write bytes that need no entry in the summary; they are out of the process when this returns."""
        rest = [memoryview(piece) for piece in pieces]
        done = 0
        try:
            while done < len(rest):
                count = os.writev(self._file.fileno(), rest[done : done + _PIECES])
                self.size += count
                while done < len(rest) and count >= len(rest[done]):
                    count -= len(rest[done])
                    done += 1
                if count:
                    rest[done] = rest[done][count:]
        except OSError as error:
            raise self._failure(error) from error

    def _failure(self, error: OSError) -> CaptureError:
        return CaptureError(
            f"{self.path}: cannot be written: {error.strerror or error}; "
            f"`edoras recover {self.path}` makes whole what is there"
        )


def _text(name: str) -> str:
    """Escape what UTF-8 cannot hold: file names may hold bytes that are no text."""
    return name.encode(errors="backslashreplace").decode()


def _opening() -> bytes:
    return MAGIC + _encode(Header("ros2", f"edoras-tools {__version__}"))


def _encode(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return _built(builder)


def _chunk_head(record: Chunk) -> bytes:
    """Return a chunk's record up to its data, which is not copied."""
    head = bytearray(_encode(replace(record, data=b"")))
    struct.pack_into("<Q", head, 1, len(head) - RECORD_PREFIX_BYTES + len(record.data))
    struct.pack_into("<Q", head, len(head) - 8, len(record.data))
    return bytes(head)


def _built(builder: RecordBuilder) -> bytes:
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data
