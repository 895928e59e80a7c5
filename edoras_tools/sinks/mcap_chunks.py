"""Messages to chunks: laid out by numpy, compressed, indexed and written."""

from __future__ import annotations

import struct
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import zstandard
from mcap.opcode import Opcode
from mcap.records import Chunk

from edoras_tools.sinks.mcap_file import FinishedChunk
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
_IN_FLIGHT = 2
"""Batches that may wait for the thread; bounds memory, and the caller waits when it is ahead."""

_INDEX_ENTRY = np.dtype([("log_time", "<u8"), ("offset", "<u8")])


class ChunkWriter:
    """Appends messages to a file, chunk by chunk, in a thread of its own.

    Laying out and compressing are long numpy and zstd calls that do without Python, so they run while
    the caller reads and decodes the next batch.

    Args:
        file: where the chunks go; until ``flush`` returns it belongs to the thread.

    Raises:
        CaptureError: from every method: the file cannot be written. What failed in the thread is raised by
            the next call.
    """

    def __init__(self, file: McapFile) -> None:
        self._file = file
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="edoras-mcap")
        self._pending: deque[Future[None]] = deque()
        self._compressor = zstandard.ZstdCompressor(level=_LEVEL, write_checksum=True)
        self._buffer = np.empty(CHUNK_BYTES, dtype=np.uint8)
        self._used = 0
        self._placed: list[tuple[NDArray[np.uint16], NDArray[np.uint64], NDArray[np.int64]]] = []
        self._appended = 0

    @property
    def size_bound(self) -> int:
        """Bytes the file has at most when all that was appended is written, leaving its summary out."""
        waiting = self._appended - sum(chunk.uncompressed_size for chunk in self._file.summary.chunks)
        return self._file.size + waiting

    def append(self, streams: Sequence[Messages], rows: int) -> None:
        """Append messages of a batch, row by row, in each row in the order of ``streams``.

        Args:
            streams: the messages; their arrays are read until ``flush`` returns.
            rows: rows of the batch.
        """
        streams = [stream for stream in streams if len(stream)]
        self._appended += sum(
            len(stream) * stream.head_bytes + int(stream.length.sum()) for stream in streams
        )
        if streams:
            self._submit(self._lay_out, streams, rows)

    def flush(self) -> None:
        """End the chunk under way, and wait until all are out of the process."""
        self._submit(self._store)
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

    def _submit(self, work: Callable[..., None], *arguments: Any) -> None:
        """Give work to the thread, after waiting until it is no more than ``_IN_FLIGHT`` behind."""
        while len(self._pending) >= _IN_FLIGHT:
            self._pending.popleft().result()
        self._pending.append(self._thread.submit(work, *arguments))

    def _lay_out(self, streams: Sequence[Messages], rows: int) -> None:
        """Write messages into chunks; runs in the thread, as all that follows."""
        total = np.zeros(rows, dtype=np.int64)
        within = [within_rows(stream, total) for stream in streams]
        longest_first = sorted(zip(streams, within, strict=True), key=lambda pair: -len(pair[0]))
        ends = np.cumsum(total)
        starts = ends - total
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
            copy = spill_rows  # the longest stream's: all others are written over what it spills
            for stream, inside in longest_first:
                low, high = np.searchsorted(stream.rows, (first, last)).tolist()
                if low < high:
                    chosen = slice(low, high)
                    positions = starts[stream.rows[chosen]] + inside[chosen] + (self._used - base)
                    self._place(stream, chosen, positions, copy)
                copy = copy_rows
            self._used += int(ends[last - 1]) - base
            first = last

    def _place(
        self, messages: Messages, chosen: slice, positions: NDArray[np.int64], copy: Callable[..., None]
    ) -> None:
        """Write the chosen messages at their positions in the chunk."""
        heads = messages.heads(chosen)
        copy(
            self._buffer,
            positions + messages.head_bytes,
            messages.data,
            messages.offset[chosen],
            messages.length[chosen],
        )
        put_rows(self._buffer, positions, heads)
        self._placed.append((heads["channel_id"].copy(), heads["log_time"].copy(), positions))

    def _store(self) -> None:
        """Compress, index and write the chunk under way, and begin another."""
        if not self._used:
            return
        raw = self._buffer[: self._used].data
        channel, log_time, position = (np.concatenate(column) for column in zip(*self._placed, strict=True))
        index, places, counts = message_index(channel, log_time, position)
        record = Chunk(
            compression="zstd",
            data=self._compressor.compress(raw),
            message_end_time=int(log_time.max()),
            message_start_time=int(log_time.min()),
            uncompressed_crc=0,  # not given: the zstd frame has a checksum of its own, a third as dear
            uncompressed_size=self._used,
        )
        self._file.add_chunk(FinishedChunk(record, index, places, counts))
        self._placed.clear()
        self._used = 0
        if len(self._buffer) != CHUNK_BYTES:
            self._buffer = np.empty(CHUNK_BYTES, dtype=np.uint8)


def message_index(
    channel: NDArray[np.uint16], log_time: NDArray[np.uint64], position: NDArray[np.int64]
) -> tuple[bytes, dict[int, int], dict[int, int]]:
    """Return the MessageIndex records of a chunk, where in them each channel's starts, and each one's count.

    Args:
        channel: u16, of each message; the messages of one channel in the order of their positions.
        log_time: u64.
        position: i64, where its record starts in the uncompressed chunk.
    """
    order = np.argsort(channel, kind="stable")
    entries = np.empty(len(order), dtype=_INDEX_ENTRY)
    entries["log_time"], entries["offset"] = log_time[order], position[order]
    ordered = channel[order].astype(np.int64)
    index = bytearray()
    places: dict[int, int] = {}
    counts: dict[int, int] = {}
    starts = np.flatnonzero(np.diff(ordered, prepend=-1)).tolist()
    for start, end in pairwise([*starts, len(order)]):
        channel_id, count = int(ordered[start]), end - start
        places[channel_id], counts[channel_id] = len(index), count
        size = count * entries.itemsize
        index += struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + size, channel_id, size)
        index += entries[start:end].tobytes()
    return bytes(index), places, counts
