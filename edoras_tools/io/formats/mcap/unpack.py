"""Decompresses chunks, and checks the proof of their contents."""

from __future__ import annotations

from contextlib import suppress
from enum import Enum
from typing import TYPE_CHECKING, Any, Final

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from edoras_tools.errors import CaptureError
from edoras_tools.io.formats.mcap.file import CHUNK_HEAD_BYTES, MAX_CHUNK_BYTES, ChunkHead, chunk_head
from edoras_tools.wire.arrays.sums import crc32

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


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
