"""Writes messages as chunks: laid out by numpy, compressed, indexed and written.

The rules that this file keeps:

1. Rows of a batch are laid out in a buffer: a row's records follow each other in the order of the streams. A
   row that is larger than a buffer gets a buffer of its own.
2. The thread divides a buffer between messages into chunks of about ``CHUNK_BYTES``, each with a CRC.
3. A stream with many messages is copied with ``spill_rows``, which also writes beyond the end of each
   message. It is copied first; every other stream, and every head, is written afterwards.
4. A record's head is written after its body, for the same reason.
5. Messages are indexed while they go into the buffer; the indexes of its chunks are made from that at once.
6. The file belongs to the thread from the first full buffer until ``flush`` returns. At most ``_IN_FLIGHT``
   buffers wait for it; then the caller waits. Errors in the thread are raised by a later call.
7. Buffers of full size are reused; Python frees the others.

One wrong byte costs a whole chunk, and a reader has to read a whole chunk for one message. Small chunks
compress worse, and each has an index of its own: ``docs/recover.md`` has the figures.
"""

from __future__ import annotations

from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np
import zstandard

from edoras_tools.io.formats.mcap.index import MessageIndex
from edoras_tools.io.topics.rows import within_rows
from edoras_tools.wire.window import copy_rows, put_rows, spill_rows

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from edoras_tools.io.formats.mcap.file import McapFile
    from edoras_tools.io.topics.rows import Messages

CHUNK_BYTES = 128 << 10
"""Uncompressed bytes of a full chunk; more by at most one message."""
_BUFFER_BYTES = 4 << 20
"""Bytes that are laid out at once, and then divided into chunks."""
_LEVEL = -1
"""zstd level: an eighth faster than 1 for a twentieth more bytes; still faster levels compress much worse."""
_ENOUGH = 16 << 20
"""Bytes that compressing a buffer may need. Where memory runs out inside ``multi_compress_to_buffer``,
zstandard 0.25 frees some of it twice and the process aborts; asked for before, it is a ``MemoryError``."""
_IN_FLIGHT = 3
"""Buffers that may wait for the thread: limits memory; the caller waits if it is faster."""


class ChunkWriter:
    """Appends messages to a file in chunks; a thread of its own compresses and writes the full ones.

    Compression does not hold Python's lock, so it runs while the caller continues with the next chunk.

    Args:
        file: where the chunks go; until ``flush`` returns it belongs to the thread.

    Raises:
        CaptureError: from every method: the file cannot be written. Errors in the thread are raised by a
        later
            call.
    """

    def __init__(self, file: McapFile) -> None:
        self._file = file
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="edoras-mcap")
        self._pending: deque[Future[NDArray[np.uint8]]] = deque()
        self._compressor = zstandard.ZstdCompressor(level=_LEVEL, write_checksum=True)
        self._buffer = _blank()
        self._used = 0
        self._index = MessageIndex()
        self._appended = 0

    @property
    def size_bound(self) -> int:
        """Maximum size of the file once everything appended is written, without its summary."""
        waiting = self._appended - self._file.summary.chunk_bytes
        return self._file.size + waiting

    def append(self, streams: Sequence[Messages], rows: int) -> None:
        """Append messages of a batch, row by row, in each row in the order of ``streams``.

        Args:
            streams: the messages.
            rows: rows of the batch.
        """
        streams = [stream for stream in streams if len(stream)]
        self._appended += sum(
            len(stream) * stream.head_bytes + int(stream.length.sum()) for stream in streams
        )
        if streams:
            self._lay_out(streams, rows)

    def flush(self) -> None:
        """End the current chunk, and return when all chunks are written to the operating system."""
        while self._pending:
            self._pending.popleft().result()
        if self._used:  # here, because switching to the thread and back is slow on a busy machine
            self._buffer = self._press(self._buffer, self._used, self._index)
            self._used, self._index = 0, MessageIndex()

    def close(self) -> None:
        """Flush, and end the thread."""
        try:
            self.flush()
        finally:
            self.abandon()

    def abandon(self) -> None:
        """End the thread, and discard what it has not begun to write."""
        self._thread.shutdown(cancel_futures=True)

    def _lay_out(self, streams: Sequence[Messages], rows: int) -> None:
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
            last = int(np.searchsorted(ends, base + len(self._buffer) - self._used, side="right"))
            if last == first:
                if self._used:
                    self._store()
                    continue
                self._buffer = np.empty(int(total[first]), dtype=np.uint8)
                last = first + 1
            for part in parts:
                part.put(last, self._buffer, self._used - base, self._index)
            self._used += int(ends[last - 1]) - base
            first = last

    def _store(self) -> None:
        """Hand the current chunk to the thread, and begin another."""
        if not self._used:
            return
        self._pending.append(self._thread.submit(self._press, self._buffer, self._used, self._index))
        self._buffer = self._pending.popleft().result() if len(self._pending) > _IN_FLIGHT else _blank()
        self._used = 0
        self._index = MessageIndex()

    def _press(self, buffer: NDArray[np.uint8], used: int, index: MessageIndex) -> NDArray[np.uint8]:
        """Compress and write a buffer's chunks; return a buffer that is free."""
        chunks = index.divide(used, CHUNK_BYTES)
        segments = np.stack([chunks.edges[:-1], np.diff(chunks.edges)], axis=1).astype(np.uint64)
        np.empty(used + _ENOUGH, np.uint8)  # asked for, and given back at once
        # One call and one write for all: each time this thread needs Python's lock, it has to wait.
        packed = self._compressor.multi_compress_to_buffer(
            zstandard.BufferWithSegments(buffer[:used].data, segments.tobytes())
        )
        self._file.add_chunks(
            buffer[:used].data, [packed[place].tobytes() for place in range(len(packed))], chunks
        )
        return buffer if len(buffer) == _BUFFER_BYTES else _blank()


def _blank() -> NDArray[np.uint8]:
    return np.empty(_BUFFER_BYTES, dtype=np.uint8)


class _Part:
    """The messages of one stream while they are put into chunks.

    Args:
        messages: the stream.
        positions: i64, start of each message, counted from the batch's first.
        copy: copies the bytes after the heads.
    """

    def __init__(self, messages: Messages, positions: NDArray[np.int64], copy: Callable[..., None]) -> None:
        self._messages = messages
        self._positions = positions
        self._copy = copy if messages.length.any() else None
        self._done = 0

    def put(self, last: int, buffer: NDArray[np.uint8], shift: int, index: MessageIndex) -> None:
        """Write the remaining messages of the rows before ``last``.

        Args:
            last: a row of the batch.
            buffer: u8, the chunk.
            shift: position in the buffer of the batch's first message.
            index: of the chunk.
        """
        messages = self._messages
        chosen = slice(self._done, int(np.searchsorted(messages.rows, last)))
        if chosen.start == chosen.stop:
            return
        self._done = chosen.stop
        positions = self._positions[chosen] + shift
        heads = messages.heads(chosen)
        if self._copy is not None:
            self._copy(
                buffer,
                positions + messages.head_bytes,
                messages.data,
                messages.offset[chosen],
                messages.length[chosen],
            )
        put_rows(buffer, positions, heads)
        channel = messages.channel_id
        index.add(
            channel if isinstance(channel, int) else channel[chosen], messages.log_time[chosen], positions
        )
