"""Lays out messages as chunks, compresses and indexes them, and writes them in order.

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

from typing import TYPE_CHECKING, Any, cast

import numpy as np
import zstandard

from edoras_tools.io.formats.mcap.file import LEVEL, McapFile, MessageIndex, PackedChunks, pack_chunks
from edoras_tools.io.processes import InOrder, Workers
from edoras_tools.io.topics.rows import Messages, within_rows
from edoras_tools.wire.arrays.window import copy_rows, put_rows, spill_rows

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from edoras_tools.wire.arrays.order import Integers, Octets


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
