"""Messages to chunks: laid out by numpy, compressed, indexed and written."""

from __future__ import annotations

from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np
import zstandard
from mcap.records import Chunk

from edoras_tools.sinks.mcap_index import MessageIndex
from edoras_tools.sinks.mcap_rows import within_rows
from edoras_tools.wire.window import copy_rows, put_rows, spill_rows

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from edoras_tools.sinks.mcap_file import McapFile
    from edoras_tools.sinks.mcap_rows import Messages

CHUNK_BYTES = 4 << 20
"""Uncompressed bytes of a full chunk; more only where one message is larger."""
_LEVEL = -1
"""zstd level: an eighth faster than 1 for a twentieth more bytes; those beyond compress much worse."""
_IN_FLIGHT = 3
"""Chunks that may wait for the thread; bounds memory, and the caller waits when it is ahead."""


class ChunkWriter:
    """Appends messages to a file, chunk by chunk; a thread of its own compresses and writes the full ones.

    Compressing does without Python, so it runs while the caller goes on with the next chunk.

    Args:
        file: where the chunks go; until ``flush`` returns it belongs to the thread.

    Raises:
        CaptureError: from every method: the file cannot be written. What failed in the thread is raised by
            a later call.
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
        """Bytes the file has at most when all that was appended is written, leaving its summary out."""
        waiting = self._appended - sum(chunk.uncompressed_size for chunk in self._file.summary.chunks)
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
        """End the chunk under way, and wait until all are out of the process."""
        self._store()
        while self._pending:
            self._pending.popleft().result()

    def close(self) -> None:
        """Flush, and end the thread."""
        try:
            self.flush()
        finally:
            self.abandon()

    def abandon(self) -> None:
        """End the thread, and forget what it has not begun to write."""
        self._thread.shutdown(cancel_futures=True)

    def _lay_out(self, streams: Sequence[Messages], rows: int) -> None:
        total = np.zeros(rows, dtype=np.int64)
        within = [within_rows(stream, total) for stream in streams]
        ends = np.cumsum(total)
        starts = ends - total
        # The longest first: all others are written over what it spills.
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
        """Hand over the chunk under way, and begin another."""
        if not self._used:
            return
        self._pending.append(self._thread.submit(self._press, self._buffer, self._used, self._index))
        self._buffer = self._pending.popleft().result() if len(self._pending) > _IN_FLIGHT else _blank()
        self._used = 0
        self._index = MessageIndex()

    def _press(self, buffer: NDArray[np.uint8], used: int, index: MessageIndex) -> NDArray[np.uint8]:
        """Compress and write a chunk; runs in the thread. Return a buffer that is free then."""
        record = Chunk(
            compression="zstd",
            data=self._compressor.compress(buffer[:used].data),
            message_end_time=index.end_ns,
            message_start_time=index.start_ns,
            uncompressed_crc=0,  # not given: the zstd frame has a checksum of its own, a third as dear
            uncompressed_size=used,
        )
        self._file.add_chunk(record, index)
        return buffer if len(buffer) == CHUNK_BYTES else _blank()


def _blank() -> NDArray[np.uint8]:
    return np.empty(CHUNK_BYTES, dtype=np.uint8)


class _Part:
    """The messages of one stream on their way into chunks.

    Args:
        messages: the stream.
        positions: i64, where each message starts, counted from the batch's first.
        copy: moves the bytes behind the heads.
    """

    def __init__(self, messages: Messages, positions: NDArray[np.int64], copy: Callable[..., None]) -> None:
        self._messages = messages
        self._positions = positions
        self._copy = copy if messages.length.any() else None
        self._done = 0

    def put(self, last: int, buffer: NDArray[np.uint8], shift: int, index: MessageIndex) -> None:
        """Write those that are left of the rows before ``last``.

        Args:
            last: a row of the batch.
            buffer: u8, the chunk.
            shift: where in it the batch's first message would start.
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
