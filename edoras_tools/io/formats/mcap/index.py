"""MessageIndex records: the positions of each channel's messages in a chunk."""

from __future__ import annotations

import struct
from contextlib import suppress
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np
from mcap.opcode import Opcode

from edoras_tools.io.topics.rows import RECORD_PREFIX_BYTES
from edoras_tools.wire.arrays.order import Integers, Octets, by_value
from edoras_tools.wire.arrays.window import put_rows

if TYPE_CHECKING:
    from numpy.typing import NDArray


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
