"""Messages to chunks: laid out by numpy in one thread, compressed and written in another."""

from __future__ import annotations

import struct
import zlib
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import zstandard
from mcap.opcode import Opcode
from mcap.records import Chunk

from edoras_tools.sinks.mcap_file import FinishedChunk
from edoras_tools.sinks.mcap_rows import Messages, copy_rows, put_rows

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from edoras_tools.sinks.mcap_file import McapFile

CHUNK_BYTES = 2 << 20
"""Uncompressed bytes of a full chunk; more only where one message is larger."""
_LEVEL = 1
"""zstd level: the first of the regular ones; faster ones gain little here and compress worse."""
_IN_FLIGHT = 2
"""Chunks that may wait for the other thread; bounds memory, and the producer waits when it is ahead."""

_INDEX_ENTRY = np.dtype([("log_time", "<u8"), ("offset", "<u8")])


class _OpenChunk:
    """A chunk being filled."""

    def __init__(self, capacity: int) -> None:
        self.buffer = np.empty(capacity, dtype=np.uint8)
        self.used = 0
        self.placed: list[tuple[NDArray[np.uint16], NDArray[np.uint64], NDArray[np.int64]]] = []

    def clear(self) -> None:
        self.used = 0
        self.placed = []

    def place(self, messages: Messages, chosen: slice, positions: NDArray[np.int64]) -> None:
        """Write the chosen messages at their positions."""
        heads = messages.heads[chosen]
        put_rows(self.buffer, positions, heads)
        copy_rows(
            self.buffer,
            positions + heads.itemsize,
            messages.data,
            messages.offset[chosen],
            messages.length[chosen],
        )
        # Copies: a view would keep the whole batch's heads alive until the chunk is full.
        self.placed.append((heads["channel_id"].copy(), heads["log_time"].copy(), positions))


class ChunkWriter:
    """Appends messages to a file, chunk by chunk.

    Args:
        file: where the chunks go; while chunks are pending it belongs to this writer's thread.

    Raises:
        CaptureError: from every method: the file cannot be written.
    """

    def __init__(self, file: McapFile) -> None:
        self._file = file
        self._compressor = zstandard.ZstdCompressor(level=_LEVEL)
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="edoras-mcap")
        self._pending: deque[tuple[Future[None], _OpenChunk]] = deque()
        self._chunk = _OpenChunk(CHUNK_BYTES)

    @property
    def size_bound(self) -> int:
        """Bytes the file has at most once everything appended is written, leaving its summary out."""
        waiting = [chunk for _, chunk in tuple(self._pending)] + [self._chunk]
        return self._file.size + sum(chunk.used for chunk in waiting)

    def append(self, streams: Sequence[Messages], rows: int) -> None:
        """Append messages of a batch, row by row, in each row in the order of ``streams``.

        Args:
            streams: the messages.
            rows: rows of the batch.
        """
        streams = [stream for stream in streams if len(stream)]
        if not streams:
            return
        total = np.zeros(rows, dtype=np.int64)
        within = [_within_rows(stream, total) for stream in streams]
        ends = np.cumsum(total)
        starts = ends - total
        first = 0
        while first < rows:
            base = int(starts[first])
            room = len(self._chunk.buffer) - self._chunk.used
            last = int(np.searchsorted(ends, base + room, side="right"))
            if last == first:
                if self._chunk.used:
                    self._hand_over()
                    continue
                self._chunk = _OpenChunk(int(total[first]))
                last = first + 1
            for stream, inside in zip(streams, within, strict=True):
                low, high = np.searchsorted(stream.rows, (first, last))
                if low < high:
                    chosen = slice(int(low), int(high))
                    shift = self._chunk.used - base
                    self._chunk.place(stream, chosen, starts[stream.rows[chosen]] + inside[chosen] + shift)
            self._chunk.used += int(ends[last - 1]) - base
            first = last

    def flush(self) -> None:
        """End the chunk under way and wait until all of them are out of the process."""
        if self._chunk.used:
            self._hand_over()
        while self._pending:
            self._await_oldest()

    def close(self) -> None:
        """Flush, and end the thread."""
        try:
            self.flush()
        finally:
            self._thread.shutdown()

    def abandon(self) -> None:
        """End the thread, and forget what it has not begun to write."""
        self._thread.shutdown(cancel_futures=True)

    def _hand_over(self) -> None:
        """Give the chunk to the thread; go on with a new one, or with the buffer of one that is done."""
        self._pending.append((self._thread.submit(self._store, self._chunk), self._chunk))
        spare = self._await_oldest() if len(self._pending) > _IN_FLIGHT else None
        self._chunk = spare if spare and len(spare.buffer) == CHUNK_BYTES else _OpenChunk(CHUNK_BYTES)

    def _await_oldest(self) -> _OpenChunk:
        future, chunk = self._pending.popleft()
        future.result()
        chunk.clear()
        return chunk

    def _store(self, chunk: _OpenChunk) -> None:
        """Compress, index and write a chunk; runs in the thread."""
        raw = chunk.buffer[: chunk.used].data
        channel, log_time, position = (np.concatenate(column) for column in zip(*chunk.placed, strict=True))
        index, places, counts = message_index(channel, log_time, position)
        record = Chunk(
            compression="zstd",
            data=self._compressor.compress(raw),
            message_end_time=int(log_time.max()),
            message_start_time=int(log_time.min()),
            uncompressed_crc=zlib.crc32(raw),
            uncompressed_size=chunk.used,
        )
        self._file.add_chunk(FinishedChunk(record, index, places, counts))


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


def _within_rows(stream: Messages, total: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return where in its row each message starts, after what ``total`` holds; add its bytes to that."""
    size = stream.heads.itemsize + stream.length.astype(np.int64)
    rows = stream.rows
    if len(rows) == len(total) and not stream.repeats:
        inside = total.copy()
        total += size
    elif not stream.repeats:
        inside = total[rows]
        total[rows] += size
    else:
        before = np.cumsum(size) - size
        inside = total[rows] + before - before[np.searchsorted(rows, rows)]
        np.add.at(total, rows, size)
    return inside
