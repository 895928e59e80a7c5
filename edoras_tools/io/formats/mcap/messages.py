"""The messages of an indexed MCAP file of any tool, in columns."""

from __future__ import annotations

from typing import IO, TYPE_CHECKING, Final, NamedTuple

import numpy as np
from mcap.opcode import Opcode

from edoras_tools.errors import CaptureError
from edoras_tools.io.formats.mcap.heads import INDEX_ENTRY, INDEX_HEAD, RECORD_HEAD, chunk_head
from edoras_tools.io.formats.mcap.unpack import COMPRESSIONS, Proof, unpack_chunk
from edoras_tools.io.topics.names import RECORD_PREFIX_BYTES
from edoras_tools.io.topics.rows import RECORD, RECORD_BYTES
from edoras_tools.wire.arrays.window import read_at

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from mcap.records import ChunkIndex
    from mcap.summary import Summary
    from numpy.typing import NDArray

_BATCH_BYTES: Final = 4 << 20
"""Chunks are put together up to this."""


class SelectedMessages(NamedTuple):
    """The messages of some channels in a few chunks, arrays one element a message.

    Attributes:
        channel_id: u16.
        log_time: i64, ns since 1970.
        data: u8, the chunks' records.
        offset: i64, first byte of the message data in ``data``.
        length: i64, its bytes.
    """

    channel_id: NDArray[np.uint16]
    log_time: NDArray[np.int64]
    data: NDArray[np.uint8]
    offset: NDArray[np.int64]
    length: NDArray[np.int64]


def is_indexed(summary: Summary | None) -> bool:
    """Tell whether indices lead to every message of a file, so that ``chunk_messages`` can read it."""
    if summary is None or summary.statistics is None or not summary.chunk_indexes:
        return False
    every = len(summary.chunk_indexes) == summary.statistics.chunk_count
    return every and all(item.message_index_offsets for item in summary.chunk_indexes)


def chunk_messages(
    file: IO[bytes], name: str, summary: Summary, channels: Collection[int]
) -> Iterator[SelectedMessages]:
    """Yield the messages of some channels, in the order of the file.

    Args:
        file: the file.
        name: of it, for errors.
        summary: of the file, which ``is_indexed``.
        channels: ids.

    Raises:
        CaptureError: a chunk is damaged; after all those before it.
    """
    parts: list[SelectedMessages] = []
    failure: CaptureError | None = None
    for index in sorted(summary.chunk_indexes, key=lambda item: item.chunk_start_offset):
        there = [channel for channel in index.message_index_offsets if channel in channels]
        if not there:
            continue
        offset = np.sort(np.concatenate([_offsets(file, index, channel) for channel in there]))
        try:
            parts.append(_messages(_unpacked(file, name, index), offset, name, index))
        except CaptureError as error:
            failure = error
            break
        if sum(len(part.data) for part in parts) >= _BATCH_BYTES:
            yield _joined(parts)
            parts = []
    if parts:
        yield _joined(parts)
    if failure is not None:
        raise failure


def _joined(parts: Sequence[SelectedMessages]) -> SelectedMessages:
    """Put the messages of several chunks together: what is done with them costs about as much for few."""
    ends = np.cumsum([len(part.data) for part in parts])
    offsets = [part.offset + (end - len(part.data)) for part, end in zip(parts, ends.tolist(), strict=True)]
    return SelectedMessages(
        np.concatenate([part.channel_id for part in parts]),
        np.concatenate([part.log_time for part in parts]),
        np.concatenate([part.data for part in parts]),
        np.concatenate(offsets),
        np.concatenate([part.length for part in parts]),
    )


def _offsets(file: IO[bytes], index: ChunkIndex, channel: int) -> NDArray[np.int64]:
    """Return where the Message records of a channel start in a chunk."""
    file.seek(index.message_index_offsets[channel])
    _, length = RECORD_HEAD.unpack(file.read(RECORD_HEAD.size))
    entries = file.read(min(length, index.message_index_length))[INDEX_HEAD.itemsize - RECORD_HEAD.size :]
    return np.frombuffer(entries, INDEX_ENTRY, len(entries) // INDEX_ENTRY.itemsize)["offset"].astype(
        np.int64
    )


def _unpacked(file: IO[bytes], name: str, index: ChunkIndex) -> NDArray[np.uint8]:
    file.seek(index.chunk_start_offset)
    content = memoryview(file.read(index.chunk_length))[RECORD_HEAD.size :]
    head = chunk_head(content)
    if head is not None and head.compression not in COMPRESSIONS:
        raise CaptureError(f"{name}: chunks are compressed with {head.compression!r}; there are zstd and lz4")
    raw, proof = unpack_chunk(head, content[head.data :]) if head is not None else (b"", Proof.FAILED)
    if proof is Proof.FAILED:
        raise _damaged(name, index)
    return np.frombuffer(raw, np.uint8)


def _messages(
    data: NDArray[np.uint8], offset: NDArray[np.int64], name: str, index: ChunkIndex
) -> SelectedMessages:
    if len(offset) and (int(offset[0]) < 0 or int(offset[-1]) + RECORD_BYTES > len(data)):
        raise _damaged(name, index)
    heads = read_at(data, offset, np.dtype(RECORD))
    start = offset + RECORD_BYTES
    length = heads["record_length"].astype(np.int64) - (RECORD_BYTES - RECORD_PREFIX_BYTES)
    if not ((heads["opcode"] == Opcode.MESSAGE) & (length >= 0) & (length <= len(data) - start)).all():
        raise _damaged(name, index)
    return SelectedMessages(heads["channel_id"], heads["log_time"].astype(np.int64), data, start, length)


def _damaged(name: str, index: ChunkIndex) -> CaptureError:
    return CaptureError(
        f"{name}: the chunk at byte {index.chunk_start_offset} is damaged; all before was read"
    )
