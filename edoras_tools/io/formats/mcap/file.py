"""One MCAP file on disk: records in sequence, the indexes of its chunks, and the summary that completes it.

All records except messages, chunks and their indexes use the record classes of the ``mcap`` library. A
MessageIndex record has the positions of one channel's messages in a chunk; ``ChunkMessages`` makes them from
columns, ``MessageIndex`` reads them.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import chain, pairwise
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np
import zstandard
from mcap import records as mcap
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from msgspec.structs import replace

from edoras_tools import __version__
from edoras_tools.errors import CaptureError, OnFailure, os_errors
from edoras_tools.io.outputs import STDOUT, OutputFile, output_name
from edoras_tools.io.topics.messages import MAGIC, RECORD_PREFIX_BYTES
from edoras_tools.wire.arrays import Integers, Octets, by_value, crc32, put_rows

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    _Bytes = bytes | memoryview

RECORD_HEAD: Final = struct.Struct("<BQ")
"""Opcode and length of a record."""
MESSAGE_HEAD: Final = struct.Struct("<HIQQ")
"""Channel, sequence, log time and publish time of a Message record."""
CHUNK_HEAD: Final = struct.Struct("<QQQII")
"""Start time, end time, uncompressed size, CRC, length of the compression's name."""
INDEX_HEAD: Final = np.dtype([("opcode", "u1"), ("length", "<u8"), ("channel_id", "<u2"), ("bytes", "<u4")])
"""A MessageIndex record up to its entries."""
INDEX_ENTRY: Final = np.dtype([("log_time", "<u8"), ("offset", "<u8")])
INDEX_PLACE: Final = np.dtype([("channel_id", "<u2"), ("offset", "<u8")])
"""Entry of a ChunkIndex record: the position of a channel's MessageIndex record."""
CHUNK_INDEX: Final = np.dtype(
    [("start_ns", "<u8"), ("end_ns", "<u8"), ("position", "<u8"), ("length", "<u8"), ("places", "<u4")]
)
"""A ChunkIndex record up to its ``INDEX_PLACE`` entries; ``places`` is the number of bytes of these."""
MAX_CHUNK_BYTES: Final = 128 << 20
"""Largest chunk or other record that is read, in bytes: about three times its size is needed in memory."""
MOST_IDLE: Final = 1 << 18
"""Most records in a row without a message; reading stops after them. A decompression bomb has millions,
a recording at most 65,535 schemas, as many channels, and an index for each."""
CHUNK_HEAD_BYTES: Final = CHUNK_HEAD.size + 16 + 8
"""Bytes of a chunk's head with up to 16 letters for the compression."""
_LENGTH: Final = struct.Struct("<Q")


class ChunkHead(msgspec.Struct, frozen=True):
    """A chunk's record up to its data.

    Attributes:
        start_ns: smallest log time.
        end_ns: largest log time.
        size: uncompressed bytes of its records.
        crc: CRC-32 of the uncompressed records; 0 if the writer computed none.
        compression: "", "zstd", "lz4", or an unknown name.
        data: start of the compressed bytes, counted from the record's content.
        length: number of compressed bytes.
    """

    start_ns: int
    end_ns: int
    size: int
    crc: int
    compression: str
    data: int
    length: int


def chunk_head(content: bytes | memoryview) -> ChunkHead | None:
    """Read the head at the start of a chunk's content; None if it cannot be read."""
    with suppress(struct.error, UnicodeDecodeError):
        start_ns, end_ns, size, crc, name_bytes = CHUNK_HEAD.unpack_from(content)
        place = CHUNK_HEAD.size + name_bytes
        (length,) = _LENGTH.unpack_from(content, place)
        compression = bytes(content[CHUNK_HEAD.size : place]).decode()
        return ChunkHead(start_ns, end_ns, size, crc, compression, place + _LENGTH.size, length)
    return None


class ChunkMessages(msgspec.Struct, frozen=True, eq=False):
    """The messages of the chunks that a buffer was divided into; n chunks.

    Attributes:
        edges: start of each chunk in the buffer, and the end of the last one, i64 (n + 1).
        start_ns: smallest log time of each chunk, u64 (n); 0 if it has no message.
        end_ns: largest log time of each chunk, u64 (n).
        counts: number of messages of each channel in all chunks, in order of the channels.
        records: MessageIndex records, u8; those of one chunk are in sequence.
        record_edges: start of each chunk's MessageIndex records, and the end of the last ones, i64 (n + 1).
        places: start of each record, relative to the first one of its chunk, ``INDEX_PLACE``.
        place_edges: the same edges for ``places``, i64 (n + 1).
    """

    edges: Integers
    start_ns: NDArray[np.uint64]
    end_ns: NDArray[np.uint64]
    counts: dict[int, int]
    records: Octets
    record_edges: Integers
    places: NDArray[np.void]
    place_edges: Integers


class MessageIndex:
    """The messages of a buffer that becomes one or several chunks, added while they go into it."""

    def __init__(self) -> None:
        self._noted: dict[int, list[tuple[NDArray[np.uint64], Integers]]] = {}

    def add(
        self,
        channel_id: NDArray[np.uint16] | int,
        log_time: NDArray[np.int64 | np.uint64],
        position: Integers,
    ) -> None:
        """Add at least one message; those of a channel must come in order of their positions.

        Args:
            channel_id: channel of each message, or one for all of them.
            log_time: log times, i64 or u64, ns since 1970; copied.
            position: start of each message's record in the buffer, i64; not copied.
        """
        times = log_time.view(np.uint64)
        if isinstance(channel_id, int):
            self._noted.setdefault(channel_id, []).append((times.copy(), position))
            return
        for value, rows in by_value(channel_id):
            self._noted.setdefault(value, []).append((times[rows], position[rows]))

    def divide(self, size: int, limit: int) -> ChunkMessages:
        """Divide the buffer between messages, into as few chunks of about ``limit`` bytes as possible.

        Args:
            size: bytes of the buffer in use.
            limit: a chunk exceeds this by at most one message.
        """
        if not self._noted:
            nothing, never = np.zeros(2, np.int64), np.zeros(1, np.uint64)
            edges = np.array([0, size])
            records = np.empty(0, np.uint8)
            return ChunkMessages(edges, never, never, {}, records, nothing, np.empty(0, INDEX_PLACE), nothing)
        channels = np.array(sorted(self._noted))
        noted = [self._noted[key] for key in channels.tolist()]
        times = np.concatenate([pair[0] for pairs in noted for pair in pairs])
        positions = np.concatenate([pair[1] for pairs in noted for pair in pairs])
        # Shift each channel by the buffer's size, so that one sorted column holds all channels.
        base = np.arange(len(channels))[:, None] * size
        positions += np.repeat(base[:, 0], [sum(len(pair[1]) for pair in pairs) for pairs in noted])
        edges = _edges(positions, base, size, limit)
        # (channels, chunks): index of the first message of each channel in each chunk, and number of
        # messages.
        bounds = np.searchsorted(positions, base + edges)
        first, counts = bounds[:, :-1], np.diff(bounds, axis=1)
        entries = np.empty(len(positions), INDEX_ENTRY)
        entries["log_time"] = times
        entries["offset"] = positions - np.repeat((base + edges[:-1]).ravel(), counts.ravel())
        sizes = np.where(counts > 0, counts * INDEX_ENTRY.itemsize + INDEX_HEAD.itemsize, 0)
        # Entries are ordered by channel, then by chunk; records by chunk, then by channel.
        record_end = np.cumsum(sizes.T).reshape(sizes.T.shape).T
        record_start = record_end - sizes
        shift = record_start + INDEX_HEAD.itemsize - first * INDEX_ENTRY.itemsize
        data = np.empty(int(record_end[-1, -1]), np.uint8)
        put_rows(
            data,
            np.repeat(shift.ravel(), counts.ravel()) + np.arange(len(entries)) * INDEX_ENTRY.itemsize,
            entries,
        )
        chunk, channel = np.nonzero(counts.T)
        heads = np.empty(len(chunk), INDEX_HEAD)
        heads["opcode"] = Opcode.MESSAGE_INDEX
        heads["length"] = sizes[channel, chunk] - RECORD_PREFIX_BYTES
        heads["channel_id"] = channels[channel]
        heads["bytes"] = counts[channel, chunk] * INDEX_ENTRY.itemsize
        put_rows(data, record_start[channel, chunk], heads)
        places = np.empty(len(chunk), INDEX_PLACE)
        places["channel_id"] = channels[channel]
        places["offset"] = record_start[channel, chunk] - record_start[0, chunk]
        return ChunkMessages(
            edges,
            *_times(times, first, counts),
            dict(zip(channels.tolist(), counts.sum(axis=1).tolist(), strict=True)),
            data,
            np.append(record_start[0], record_end[-1, -1]),
            places,
            np.concatenate([[0], np.cumsum(np.count_nonzero(counts, axis=0))]),
        )


def _edges(positions: Integers, base: Integers, size: int, limit: int) -> Integers:
    """Return the start of each chunk of a buffer, and the end of the last one.

    Args:
        positions: starts of the messages, for each channel plus its ``base``; increasing.
        base: offset of each channel in ``positions``, (channels, 1).
        size: bytes of the buffer in use.
        limit: bytes of a full chunk.
    """
    if size <= limit:
        return np.array([0, size])
    count = -(-size // limit)
    targets = np.arange(1, count) * size // count
    last = np.searchsorted(positions, base + targets, side="right") - 1
    # If a channel has no message before a target, the index points to another channel, or is -1.
    starts = np.where(last < 0, 0, np.maximum(positions[last] - base, 0)).max(axis=0)
    edges = np.concatenate([[0], starts, [size]])
    return edges[np.diff(edges, prepend=-1) > 0]


def _times(
    times: NDArray[np.uint64], first: Integers, counts: Integers
) -> tuple[NDArray[np.uint64], NDArray[np.uint64]]:
    """Return the smallest and the largest time of each chunk, u64, from those of its channels."""
    filled = np.nonzero(counts)
    starts = first[filled]
    begins = np.zeros(len(times), bool)
    begins[starts] = True
    if (begins[1:] | (times[1:] >= times[:-1])).all():  # nearly always
        least, most = times[starts], times[starts + counts[filled] - 1]
    else:
        least, most = np.minimum.reduceat(times, starts), np.maximum.reduceat(times, starts)
    low = np.full(counts.shape, np.iinfo(np.uint64).max, np.uint64)
    high = np.zeros(counts.shape, np.uint64)
    low[filled], high[filled] = least, most
    return low.min(axis=0), high.max(axis=0)


_FOOTER_BYTES_IN_CRC = 9 + 8 + 8
"""The summary's CRC covers the footer record up to the CRC itself."""
_REPEATED = 200
"""Factor of the schemas' and channels' size after whose bytes they are repeated in the file."""
_MOST_BEGUN = 32 << 20
"""Largest chunk that gets repeated records, in bytes: about four times its size is needed in memory."""
LEVEL = -1
"""zstd level: an eighth faster than 1 for a twentieth more bytes; still faster levels compress much worse."""


class Summary(msgspec.Struct, eq=False):
    """The contents of the data section, for the summary section.

    Attributes:
        schemas: the schemas by id.
        channels: the channels by id.
        chunks: number of chunks.
        chunk_bytes: uncompressed bytes of all chunks.
        chunk_indexes: ChunkIndex records as bytes; as objects they would need too much memory in a long
            recording.
        attachments: AttachmentIndex records.
        metadata: MetadataIndex records.
        counts: number of messages of each channel.
        start_ns: smallest log time; None if there is no message.
        end_ns: largest log time.
    """

    schemas: dict[int, mcap.Schema] = msgspec.field(default_factory=dict)
    channels: dict[int, mcap.Channel] = msgspec.field(default_factory=dict)
    chunks: int = 0
    chunk_bytes: int = 0
    chunk_indexes: bytearray = msgspec.field(default_factory=bytearray)
    attachments: list[mcap.AttachmentIndex] = msgspec.field(default_factory=list)
    metadata: list[mcap.MetadataIndex] = msgspec.field(default_factory=list)
    counts: dict[int, int] = msgspec.field(default_factory=dict)
    start_ns: int | None = None
    end_ns: int = 0

    def add_chunk(self, head: ChunkHead, place: tuple[int, int], records: bytes, length: int) -> None:
        """Count a chunk, and keep its ChunkIndex record.

        Args:
            place: position and length of the chunk in the file.
            records: positions of its MessageIndex records, ``INDEX_PLACE``.
            length: bytes of the MessageIndex records.
        """
        name = head.compression.encode()
        index = b"".join(
            [
                struct.pack("<QQQQI", head.start_ns, head.end_ns, *place, len(records)),
                records,
                struct.pack("<QI", length, len(name)) + name,
                struct.pack("<QQ", head.length, head.size),
            ]
        )
        self.chunks += 1
        self.chunk_bytes += head.size
        self.chunk_indexes += RECORD_HEAD.pack(Opcode.CHUNK_INDEX, len(index)) + index

    def add_messages(self, counts: Mapping[int, int], start_ns: int, end_ns: int) -> None:
        """Count messages by channel, with log times from ``start_ns`` to ``end_ns``."""
        for channel_id, count in counts.items():
            self.counts[channel_id] = self.counts.get(channel_id, 0) + count
        self.start_ns = start_ns if self.start_ns is None else min(self.start_ns, start_ns)
        self.end_ns = max(self.end_ns, end_ns)

    @property
    def statistics(self) -> mcap.Statistics:
        """The Statistics record."""
        return mcap.Statistics(
            attachment_count=len(self.attachments),
            channel_count=len(self.channels),
            channel_message_counts=self.counts,
            chunk_count=self.chunks,
            message_count=sum(self.counts.values()),
            message_end_time=self.end_ns,
            message_start_time=self.start_ns or 0,
            metadata_count=len(self.metadata),
            schema_count=len(self.schemas),
        )

    def tail(self, position: int, checksum: int) -> bytes:
        """Return everything after the data section: DataEnd, summary with its CRC, footer, magic.

        Args:
            position: end of the data section in the file.
            checksum: CRC-32 of all bytes before that position.
        """
        end = record_bytes(mcap.DataEnd(checksum))
        start = position + len(end)
        groups: list[tuple[Opcode, bytes]] = [
            (Opcode.SCHEMA, record_bytes(*self.schemas.values())),
            (Opcode.CHANNEL, record_bytes(*self.channels.values())),
            (Opcode.STATISTICS, record_bytes(self.statistics)),
            (Opcode.CHUNK_INDEX, bytes(self.chunk_indexes)),
            (Opcode.ATTACHMENT_INDEX, record_bytes(*self.attachments)),
            (Opcode.METADATA_INDEX, record_bytes(*self.metadata)),
        ]
        offsets: list[mcap.McapRecord] = []
        summary = b""
        for opcode, records in groups:
            if records:
                offsets.append(mcap.SummaryOffset(opcode, start + len(summary), len(records)))
            summary += records
        offset_start = start + len(summary)
        summary += record_bytes(*offsets)
        unsigned = record_bytes(mcap.Footer(start, offset_start, 0))[:_FOOTER_BYTES_IN_CRC]
        footer = mcap.Footer(start, offset_start, crc32(unsigned, crc32(summary)))
        return end + summary + record_bytes(footer) + MAGIC


class PackedChunks(msgspec.Struct, frozen=True, eq=False):
    """Chunks, each followed by its message indexes, as in a file; n chunks.

    Attributes:
        data: bytes of the records, u8.
        heads: heads of the chunks.
        sizes: bytes of each chunk, and of its indexes.
        places: positions of the indexes in ``data``, ``INDEX_PLACE``.
        place_edges: first index in ``places`` of each chunk, and the end of the last one, i64 (n + 1).
        counts: number of messages of each channel.
        start_ns: smallest log time.
        end_ns: largest log time.
    """

    data: Octets
    heads: Sequence[ChunkHead]
    sizes: Sequence[tuple[int, int]]
    places: NDArray[np.void]
    place_edges: Integers
    counts: Mapping[int, int]
    start_ns: int
    end_ns: int


def pack_chunks(
    raw: memoryview, packed: Sequence[_Bytes], messages: ChunkMessages, *, proved: bool = True
) -> PackedChunks:
    """Join chunks and their message indexes.

    Args:
        raw: the records of all chunks.
        packed: the records of each chunk, compressed with zstd.
        messages: the messages of the chunks.
        proved: add checksums; False for records that may already be wrong.
    """
    edges = pairwise(messages.edges.tolist())
    times = zip(messages.start_ns.tolist(), messages.end_ns.tolist(), strict=True)
    heads = [
        ChunkHead(*around, end - start, crc32(raw[start:end]) if proved else 0, "zstd", 0, len(data))
        for data, (start, end), around in zip(packed, edges, times, strict=True)
    ]
    return join_chunks(
        [(_chunk_start(head), data) for head, data in zip(heads, packed, strict=True)], heads, messages
    )


def join_chunks(
    chunks: Sequence[Sequence[_Bytes]], heads: Sequence[ChunkHead], messages: ChunkMessages
) -> PackedChunks:
    """Join chunk records, each given in pieces, and their message indexes."""
    places, indexes = messages.places.copy(), messages.records.data
    spans = pairwise(messages.record_edges.tolist()), pairwise(messages.place_edges.tolist())
    pieces: list[_Bytes] = []
    sizes: list[tuple[int, int]] = []
    at = 0
    for chunk, (start, end), (first, last) in zip(chunks, *spans, strict=True):
        pieces += *chunk, indexes[start:end]
        sizes.append((sum(map(len, chunk)), end - start))
        at += sizes[-1][0]
        places["offset"][first:last] += np.uint64(at)
        at += end - start
    times = int(messages.start_ns.min()), int(messages.end_ns.max())
    data = np.frombuffer(b"".join(pieces), np.uint8)
    return PackedChunks(data, heads, sizes, places, messages.place_edges, messages.counts, *times)


class McapFile:
    """An MCAP file that is written from start to end; its methods must not run concurrently.

    Args:
        path: the file; an existing one is replaced when this one is complete.
        header: first bytes of the file; by default magic and a header record of the ``ros2`` profile.
        offered: quality of service of every topic, as the YAML of ``ros2 bag``; empty if unknown.

    Attributes:
        output: the file itself.
        checksum: CRC-32 of all bytes written so far.

    Raises:
        CaptureError: from every method: the file cannot be written.
    """

    def __init__(self, path: Path, header: bytes | None = None, offered: str = "") -> None:
        self._offered = offered
        self.summary = Summary()
        self.checksum = 0
        self._again = 0
        """Size of the file at which the next chunk begins with all schemas and channels."""
        self._described: tuple[list[bytes], list[bytes]] = [], []
        """Records of all schemas, and of all channels."""
        self._news: list[bytes] = []
        """Records that no chunk contains yet; the second chunk after them gets them."""
        self._news_from = 0
        with os_errors(f"{path}: cannot be created"):
            self.output = OutputFile(path)
        with OnFailure(self.abandon):
            usual = MAGIC + record_bytes(mcap.Header("ros2", f"edoras-tools {__version__}"))
            self.add_bytes(usual if header is None else header)

    @property
    def path(self) -> Path:
        """Path of the file; see ``OutputFile``."""
        return self.output.path

    @property
    def size(self) -> int:
        """Bytes written so far."""
        return self.output.size

    def add_schema(self, name: str, definition: str | bytes, encoding: str = "ros2msg") -> int:
        """Write a schema; return its id."""
        data = definition.encode() if isinstance(definition, str) else definition
        schema = mcap.Schema(id=len(self.summary.schemas) + 1, data=data, encoding=encoding, name=name)
        self.summary.schemas[schema.id] = schema
        self._describe(schema)
        return schema.id

    def add_channel(
        self, topic: str, schema_id: int, metadata: Mapping[str, str], encoding: str = "cdr"
    ) -> int:
        """Write a channel of messages; return its id."""
        # The ros2 profile of the MCAP registry requires the key; unknown is an empty string.
        channel = mcap.Channel(
            id=len(self.summary.channels) + 1,
            topic=topic,
            message_encoding=encoding,
            metadata={"offered_qos_profiles": self._offered, **metadata},
            schema_id=schema_id,
        )
        self.summary.channels[channel.id] = channel
        self._describe(channel)
        return channel.id

    def _describe(self, record: mcap.Schema | mcap.Channel) -> None:
        """Write a record before its first use, and repeat it in the second chunk from here on."""
        data = record_bytes(record)
        self.add_bytes(data)
        self._described[isinstance(record, mcap.Channel)].append(data)
        self._news.append(data)
        self._news_from = self.summary.chunks + 1

    def add_attachment(self, name: str, media_type: str, data: bytes, time_ns: int) -> None:
        """Write an attachment, logged at ``time_ns``."""
        name = _text(name)
        record = record_bytes(mcap.Attachment(0, time_ns, name, media_type, data))
        index = mcap.AttachmentIndex(self.size, len(record), time_ns, 0, len(data), name, media_type)
        self.add_bytes(record)
        self.summary.attachments.append(index)

    def add_metadata(self, name: str, values: dict[str, str]) -> None:
        """Write a metadata record."""
        record = record_bytes(mcap.Metadata(name, {key: _text(value) for key, value in values.items()}))
        index = mcap.MetadataIndex(self.size, len(record), name)
        self.add_bytes(record)
        self.summary.metadata.append(index)

    def add_chunks(self, chunks: PackedChunks) -> None:
        """Write chunks and their message indexes to the operating system, in one call.

        Some chunks begin with repeated schemas and channels, so that a damaged beginning of the file makes no
        later chunk unreadable.
        """
        places = chunks.places.copy()
        places["offset"] += np.uint64(self.size)
        at, start, written = self.size, 0, 0
        pieces: list[_Bytes] = []
        spans = pairwise(chunks.place_edges.tolist())
        for head, (length, after), (first, last) in zip(chunks.heads, chunks.sizes, spans, strict=True):
            size = length
            if head.size <= _MOST_BEGUN and (records := self._due(at)):
                stretch = chunks.data[start : start + length + after]
                head, piece, index = _beginning_with(records, head, stretch)  # noqa: PLW2901  what is written
                pieces += chunks.data[written:start].data, piece, index
                written = start + length + after
                size = len(piece)
                places["offset"][first:] += np.uint64(size - length)
            self.summary.add_chunk(head, (at, size), places[first:last].tobytes(), after)
            at += size + after
            start += length + after
        self.add_bytes(*pieces, chunks.data[written:].data)
        if chunks.counts:
            self.summary.add_messages(chunks.counts, chunks.start_ns, chunks.end_ns)

    def _due(self, size: int) -> bytes:
        """Return the schemas and channels with which the chunk at position ``size`` begins; mostly none."""
        whole = bool(self._again and size >= self._again)
        if not whole and not (self._news and self.summary.chunks >= self._news_from):
            return b""
        every = [*chain(*self._described)]
        records = b"".join(every if whole else self._news)
        if whole or len(self._news) == len(every):
            self._again = size + _REPEATED * len(records)
        self._news = []
        return records

    def finish(self) -> None:
        """Write the summary and close the file; it then replaces an existing file."""
        self.add_bytes(self.summary.tail(self.size, self.checksum))
        try:
            self.output.finish()
        except OSError as error:
            raise self._failure(error) from error

    def abandon(self) -> None:
        """Close the file in its present state."""
        self.output.close()

    def add_bytes(self, *pieces: bytes | memoryview) -> None:
        """Write bytes that need no entry in the summary; on return, the operating system has them."""
        for piece in pieces:
            self.checksum = crc32(piece, self.checksum)
        try:
            self.output.write(*pieces)
        except OSError as error:
            raise self._failure(error) from error

    def _failure(self, error: OSError) -> CaptureError:
        repair = f"`edoras recover {self.path}` repairs the file"
        if self.path == STDOUT:
            repair = "what was written can be read"
        advice = repair if self.size else "name another file with -o or make room"
        return CaptureError(
            f"{output_name(self.path)}: cannot be written: {error.strerror or error}; {advice}"
        )


def _beginning_with(records: bytes, head: ChunkHead, stretch: Octets) -> tuple[ChunkHead, bytes, memoryview]:
    """Put records before those of a chunk, compressed with zstd.

    Args:
        stretch: the chunk's record and its message indexes, u8.

    Returns:
        The new head, chunk record and message indexes.
    """
    data = len(_chunk_start(head))
    end = data + head.length
    raw = records + zstandard.ZstdDecompressor().decompress(stretch[data:end].data, head.size)
    packed = zstandard.ZstdCompressor(level=LEVEL, write_checksum=True).compress(raw)
    head = replace(head, size=len(raw), crc=crc32(raw), length=len(packed))
    index, at = stretch[end:].copy(), 0
    while at < len(index):
        entries = at + INDEX_HEAD.itemsize
        at = entries + int(index[at : at + INDEX_HEAD.itemsize].view(INDEX_HEAD)["bytes"][0])
        index[entries:at].view(INDEX_ENTRY)["offset"] += np.uint64(len(records))
    return head, _chunk_start(head) + packed, index.data


def _chunk_start(head: ChunkHead) -> bytes:
    """Return a chunk's record up to its data."""
    name = head.compression.encode()
    start = CHUNK_HEAD.pack(head.start_ns, head.end_ns, head.size, head.crc, len(name)) + name
    length = len(start) + 8 + head.length
    return RECORD_HEAD.pack(Opcode.CHUNK, length) + start + head.length.to_bytes(8, "little")


def _text(name: str) -> str:
    """Escape characters that UTF-8 cannot encode: file names may contain bytes that are not text."""
    return name.encode(errors="backslashreplace").decode()


def record_bytes(*records: mcap.McapRecord) -> bytes:
    """Return the bytes of records, as in a file."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return builder.end()  # type: ignore[no-untyped-call]
