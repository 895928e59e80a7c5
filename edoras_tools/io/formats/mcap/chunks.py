"""Lays out messages as chunks, compresses, indexes and writes them in order; decompresses and checks chunks.

The rules that this file keeps:

1. Rows of a batch are laid out in a buffer: a row's records follow each other in the order of the streams. A
   row that is larger than a buffer gets a buffer of its own.
2. A full buffer is divided between messages into chunks of about ``CHUNK_BYTES``, each with a CRC.
3. A stream with many messages is copied with ``spill_rows``, which also writes beyond the end of each
   message. It is copied first; every other stream, and every head, is written afterwards.
4. A record's head is written after its body, because ``spill_rows`` may overwrite it.
5. Messages are indexed while they go into the buffer; the indexes of all its chunks are made at once.
6. A large batch gets chunks of its own, so that any process can make them, and the file is always the same.

One wrong byte costs a whole chunk, and a reader has to read a whole chunk for one message. Small chunks
compress worse, and each has an index of its own: ``docs/recover.md`` has the figures.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from enum import Enum
from typing import Any, Final, cast

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard

from edoras_tools.errors import CaptureError
from edoras_tools.io.formats.mcap.file import (
    CHUNK_HEAD_BYTES,
    LEVEL,
    MAX_CHUNK_BYTES,
    ChunkHead,
    McapFile,
    MessageIndex,
    PackedChunks,
    chunk_head,
    pack_chunks,
)
from edoras_tools.io.processes import InOrder, Workers
from edoras_tools.io.topics.messages import Messages, within_rows
from edoras_tools.wire.arrays import Integers, Octets, copy_rows, crc32, put_rows, spill_rows

CHUNK_BYTES = 128 << 10
"""Uncompressed bytes of a full chunk; more by at most one message."""
_BUFFER_BYTES = 8 << 20
"""Bytes of messages that are laid out at once, and then divided into chunks."""
_ENOUGH = 16 << 20
"""Bytes that compressing a buffer may need. If memory runs out inside ``multi_compress_to_buffer``,
zstandard 0.25 frees some of it twice and the process aborts; allocated before, it is a ``MemoryError``."""
_HEADS = 4096
"""Heads that are made and copied together: few enough to stay in the processor's cache."""
_MOST_MADE = 8
"""Most batches whose chunks wait for those of earlier batches: a limit of memory."""


class ChunkPress:
    """Makes chunks of messages."""

    def __init__(self) -> None:
        self._compressor = zstandard.ZstdCompressor(level=LEVEL, write_checksum=True)
        self._buffer = _blank()
        self._index = MessageIndex()
        self.used = 0
        """Bytes of messages in the buffer that are not yet in a chunk."""

    def append(self, streams: Sequence[Messages], rows: int) -> Iterator[PackedChunks]:
        """Append messages of a batch, row by row, in each row in the order of ``streams``.

        Yields:
            The chunks of each full buffer; the caller must take all of them.
        """
        streams = [stream for stream in streams if len(stream)]
        if not streams:
            return
        total = np.zeros(rows, dtype=np.int64)
        within = [within_rows(stream, total) for stream in streams]
        ends = np.cumsum(total)
        starts = ends - total
        # The stream with the most messages first, because the others overwrite what it spills.
        laid = sorted(zip(streams, within, strict=True), key=lambda pair: -len(pair[0]))
        parts = [
            _Part(stream, starts[stream.rows] + inside, copy_rows if index else spill_rows)
            for index, (stream, inside) in enumerate(laid)
        ]
        first = 0
        while first < rows:
            base = int(starts[first])
            last = int(np.searchsorted(ends, base + len(self._buffer) - self.used, side="right"))
            if last == first:
                if self.used:
                    yield from self.finish()
                    continue
                self._buffer = np.empty(int(total[first]), dtype=np.uint8)
                last = first + 1
            for part in parts:
                part.put(last, self._buffer, self.used - base, self._index)
            self.used += int(ends[last - 1]) - base
            first = last

    def finish(self) -> Iterator[PackedChunks]:
        """Yield the chunks of the messages in the buffer, if there are any."""
        if not self.used:
            return
        raw = self._buffer[: self.used].data
        messages = self._index.divide(self.used, CHUNK_BYTES)
        chunks = pack_chunks(raw, self._packed(raw, messages.edges), messages)
        self.used, self._index = 0, MessageIndex()
        if len(self._buffer) != _BUFFER_BYTES:
            self._buffer = _blank()
        yield chunks

    def _packed(self, raw: memoryview, edges: Integers) -> list[memoryview]:
        """Return the compressed chunks of a buffer; a single one is compressed alone, which is faster."""
        if len(raw) <= CHUNK_BYTES:
            return [memoryview(self._compressor.compress(raw))]
        segments = np.stack([edges[:-1], np.diff(edges)], axis=1).astype(np.uint64)
        np.empty(self.used + _ENOUGH, np.uint8)  # allocated and freed at once, see _ENOUGH
        packed = self._compressor.multi_compress_to_buffer(
            zstandard.BufferWithSegments(raw, segments.tobytes())
        )
        return [memoryview(cast("Any", packed[place])) for place in range(len(packed))]


class ChunkWriter:
    """Appends messages to a file in chunks.

    Args:
        press: makes chunks; its buffer must be empty.
        work: makes the chunks of a large batch, see ``append_batch``.
        workers: processes that run ``work`` too; None: none.

    Raises:
        CaptureError: from every method: the file cannot be written, or a worker was killed.
    """

    def __init__(
        self,
        file: McapFile,
        press: ChunkPress,
        work: Callable[..., Iterable[PackedChunks]],
        workers: Workers | None = None,
    ) -> None:
        self._file, self._press = file, press
        self._packed = InOrder(work, workers)
        """The chunks of the batches not yet written."""

    @property
    def size_bound(self) -> int:
        """Upper limit of the size of the file with all appended messages, without its summary."""
        return self._file.size + self._press.used

    def append(self, streams: Sequence[Messages], rows: int) -> None:
        """Append messages of a batch; see ``ChunkPress.append``."""
        for chunks in self._press.append(streams, rows):
            self._put_packed(0)
            self._file.add_chunks(chunks)

    def append_batch(self, *batch: object, last: bool = False) -> None:
        """Append the chunks that ``work(*batch)`` returns; they hold only messages of this batch.

        Those of the last batch are made in this process, which has nothing else to do.
        """
        if self._press.used:
            self.flush()
        self._put_packed()
        self._packed.add(*batch, alone=last)
        self._put_packed(_MOST_MADE)

    def flush(self) -> None:
        """End the current chunk, and return when the operating system has all chunks."""
        self._put_packed(0)
        self._put(self._press.finish())

    def _put_packed(self, most: int | None = None) -> None:
        """Write finished chunks of batches; wait while more than ``most`` batches are unfinished."""
        for packed in self._packed.results(most):
            self._put(packed)

    def _put(self, packed: Iterable[PackedChunks]) -> None:
        for chunks in packed:
            self._file.add_chunks(chunks)


def _blank() -> Octets:
    return np.empty(_BUFFER_BYTES, dtype=np.uint8)


class _Part:
    """The messages of one stream while they are put into chunks.

    Args:
        positions: start of each message, i64, relative to the first message of the batch.
        copy: copies the bytes after the heads.
    """

    def __init__(self, messages: Messages, positions: Integers, copy: Callable[..., None]) -> None:
        self._messages = messages
        self._positions = positions
        self._copy = copy if messages.length.any() else None
        self._done = 0

    def put(self, last: int, buffer: Octets, shift: int, index: MessageIndex) -> None:
        """Write the remaining messages of the rows before ``last``.

        Args:
            last: a row of the batch.
            buffer: memory to write to, u8.
            shift: position in the buffer of the batch's first message.
        """
        messages = self._messages
        ready = slice(self._done, int(np.searchsorted(messages.rows, last)))
        if ready.start == ready.stop:
            return
        self._done = ready.stop
        positions = self._positions[ready] + shift
        if self._copy is not None:
            self._copy(
                buffer,
                positions + messages.head_bytes,
                messages.data,
                messages.offset[ready],
                messages.length[ready],
            )
        for first in range(ready.start, ready.stop, _HEADS):
            some = slice(first, min(first + _HEADS, ready.stop))
            put_rows(buffer, self._positions[some] + shift, messages.heads(some))
        channel = messages.channel_id
        index.add(
            channel if isinstance(channel, int) else channel[ready], messages.log_time[ready], positions
        )


COMPRESSIONS = ("", "zstd", "lz4")
_PIECE_BYTES = 1 << 9
"""Bytes given to a decompressor at once; few, because zstd may make up to 16 MiB of them."""
_INFLATERS: Final[dict[str, Callable[[], Any]]] = {
    "zstd": lambda: zstandard.ZstdDecompressor().decompressobj(),
    "lz4": lz4.frame.LZ4FrameDecompressor,
}
_UNKNOWN_SIZE = (zstandard.CONTENTSIZE_UNKNOWN, zstandard.CONTENTSIZE_ERROR)


class Proof(Enum):
    """Evidence that a chunk's bytes are those that were written."""

    CHECKSUM = "its checksum is right"
    NONE = "it has no checksum"
    FAILED = "its checksum or its compression is wrong"


def unpack_chunk(head: ChunkHead, packed: bytes | memoryview) -> tuple[bytes | memoryview, Proof]:
    """Decompress a chunk and return the proof of it; the bytes of a damaged one are empty.

    A zstd or lz4 frame may have its own checksum. It proves the records even if the head is damaged.
    """
    try:
        raw, checked = _decompress(head, packed)
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError, ValueError):
        return b"", Proof.FAILED
    if checked or (head.crc and crc32(raw) == head.crc):
        return raw, Proof.CHECKSUM
    if head.crc or len(raw) != head.size:
        return b"", Proof.FAILED
    return raw, Proof.NONE


def chunk_records(
    name: str, place: int, size: int, read: Callable[[], bytes], ending: str
) -> bytes | memoryview:
    """Return the records of a chunk.

    Args:
        name: name of the file, for messages.
        place: position of the chunk, for messages.
        size: bytes of its content in the file.
        read: returns its content; not called if ``size`` is too large.
        ending: what the reader does with the rest of the file, for messages.

    Raises:
        CaptureError: the chunk is too large, damaged, or has an unsupported compression.
    """
    content = memoryview(read() if size <= MAX_CHUNK_BYTES + CHUNK_HEAD_BYTES else b"")
    head = chunk_head(content)
    if not content or (head is not None and head.size > MAX_CHUNK_BYTES):
        most = MAX_CHUNK_BYTES >> 20
        raise CaptureError(f"{name}: the chunk at byte {place} holds more than {most} MiB{ending}")
    if head is not None and head.compression not in COMPRESSIONS:
        raise CaptureError(
            f"{name}: the chunk at byte {place} is compressed with {head.compression!r}, "
            "which is not supported; zstd and lz4 are"
        )
    raw, proof = unpack_chunk(head, content[head.data :]) if head is not None else (b"", Proof.FAILED)
    if proof is Proof.FAILED:
        raise CaptureError(f"{name}: the chunk at byte {place} is damaged{ending}")
    return raw


def _decompress(head: ChunkHead, packed: bytes | memoryview) -> tuple[bytes | memoryview, bool]:
    """Return a chunk's records, and whether the compression's own checksum proved them.

    Raises:
        ValueError: the records have more than ``MAX_CHUNK_BYTES``, or the compression is unknown.
    """
    if head.size > MAX_CHUNK_BYTES:
        raise ValueError(head.size)
    if head.compression == "":
        return packed, False
    if head.compression == "zstd":
        frame = zstandard.get_frame_parameters(packed)
        size = head.size if frame.content_size in _UNKNOWN_SIZE else frame.content_size
        if size > MAX_CHUNK_BYTES:
            raise ValueError(size)
        raw = zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)
        if len(raw) < head.size <= MAX_CHUNK_BYTES:  # several frames in sequence
            with zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True) as reader:
                return reader.read(head.size), False
        return raw, frame.has_checksum
    if head.compression != "lz4":
        raise ValueError(head.compression)
    checked = lz4.frame.get_frame_info(packed)["content_checksum"]
    decompressor = lz4.frame.LZ4FrameDecompressor()
    raw = decompressor.decompress(packed, max_length=min(head.size, MAX_CHUNK_BYTES) + 1)
    if not decompressor.eof:  # other readers refuse a frame without its end, even if all records are there
        raise EOFError
    return raw, checked


def inflate(head: ChunkHead, packed: bytes) -> bytes:
    """Decompress a damaged or cut-off chunk as far as possible; nothing proves the result."""
    return b"".join(_inflate(packed, head.compression, min(head.size, MAX_CHUNK_BYTES)))


def frame_at(data: bytes) -> tuple[bytes, int] | None:
    """Read a zstd frame that has a checksum.

    Args:
        data: starts with the frame.

    Returns:
        The contents and the length of the frame; None if there is none at the start.
    """
    with suppress(zstandard.ZstdError):
        if not zstandard.get_frame_parameters(data).has_checksum:
            return None
        inflater = zstandard.ZstdDecompressor().decompressobj()
        pieces, filled = [], 0
        for start in range(0, len(data), _PIECE_BYTES):
            pieces.append(inflater.decompress(data[start : start + _PIECE_BYTES]))
            filled += len(pieces[-1])
            if inflater.eof:
                end = min(start + _PIECE_BYTES, len(data)) - len(inflater.unused_data)
                return b"".join(pieces), end
            if filled > MAX_CHUNK_BYTES:
                break
    return None


def _inflate(packed: bytes, compression: str, size: int) -> Iterator[bytes]:
    if compression == "":
        yield packed
    if compression not in _INFLATERS:
        return
    with suppress(zstandard.ZstdError, RuntimeError, EOFError):
        inflater: Any = _INFLATERS[compression]()
        # In small pieces, to get everything before a damaged place.
        filled = 0
        for start in range(0, len(packed), _PIECE_BYTES):
            piece = inflater.decompress(packed[start : start + _PIECE_BYTES])
            filled += len(piece)
            if filled > size:
                return
            yield piece
