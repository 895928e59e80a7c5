"""Recordings as a source: the frames of ``/edoras/datagrams``, a chunk at a time.

Messages come in the order of the file, which in a recording is the order of the capture, so that a capture
made from it is the one it was made from, bit for bit, even where its timestamps step back.
"""

from __future__ import annotations

import os
import struct
import zlib
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema

from edoras_tools.errors import CaptureError
from edoras_tools.model import SourceInfo, SourceStatistics
from edoras_tools.sources.framing import PADDING
from edoras_tools.sources.linklayer import Demux, FrameBatch
from edoras_tools.wire.mcap import MAGIC
from edoras_tools.wire.window import read_at

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from edoras_tools.model import PacketBatch

TOPIC = "/edoras/datagrams"
METADATA_NAMES = ("edoras_opening", "edoras")
"""The later one says more, and is missing where a recording was cut off."""
MAX_CHUNK_BYTES = 1 << 30
"""A chunk that claims to be larger than this is taken for damaged."""

_PREFIX = struct.Struct("<BQ")
"""Opcode and length of a record."""
_CHUNK = struct.Struct("<QQQII")
"""Start time, end time, uncompressed size, CRC, length of the compression's name."""
_ENCAPSULATION = 0x0100
"""CDR, little-endian: bytes 00 01."""

_DATAGRAM = np.dtype(
    {
        "names": [
            "opcode",
            "record_length",
            "channel_id",
            "log_time",
            "encapsulation",
            "number",
            "original_length",
            "link_type",
            "frame_length",
        ],
        "formats": ["u1", "<u8", "<u2", "<u8", "<u2", "<u8", "<u4", "<u2", "<u4"],
        "offsets": [0, 1, 9, 15, 31, 35 + 0, 35 + 12, 35 + 28, 35 + 68],
        "itemsize": 35 + 72,
    }
)
"""A Message record of ``edoras_msgs/msg/Datagram`` up to its frame; the CDR body starts at byte 35."""


class McapSource:
    """Reads a recording.

    Args:
        path: the file.

    Attributes:
        info: resolution and snap length are those of the capture it was recorded from; the attachments are
            its mission files, the definitions its schemas.
        statistics: frames and datagrams counted so far.

    Raises:
        CaptureError: it is no MCAP file, or a whole one that holds no datagrams.
    """

    def __init__(self, path: str | Path) -> None:
        self._name = str(path)
        try:
            self._file = Path(path).open("rb")  # noqa: SIM115  closed by close()
            self._size = os.fstat(self._file.fileno()).st_size
        except OSError as error:
            raise CaptureError(f"{path}: cannot be opened: {error.strerror or error}") from error
        self._topics: dict[int, str] = {}
        self._metadata: dict[str, dict[str, str]] = {}
        self._attachments: dict[str, bytes] = {}
        self._definitions: dict[str, str] = {}
        self.statistics = SourceStatistics(total_bytes=self._size)
        self._demux = Demux()
        try:
            self._check(whole=self._read_front())
        except BaseException:
            self.close()
            raise
        values: dict[str, str] = {}
        for name in METADATA_NAMES:
            values |= self._metadata.get(name, {})
        self.info = SourceInfo(
            name=self._name,
            kind="mcap",
            time_resolution_ns=_positive(values, "time_resolution_ns", 1),
            snap_length=_positive(values, "snap_length", 262144),
            attachments=self._attachments,
            definitions=self._definitions,
        )

    def batches(self) -> Iterator[PacketBatch]:
        """Hand over the datagrams, a chunk at a time.

        Raises:
            CaptureError: the file is cut off or damaged, or holds no datagrams; after all that is whole.
        """
        failure: CaptureError | None = None
        stray = bytearray()
        position = len(MAGIC)
        ended = False
        while not ended and (record := self._prefix(position)) is not None:
            opcode, start, end = record
            position = end
            try:
                if opcode == Opcode.CHUNK:
                    offsets, position = self._index(end)
                    yield from self._batch(self._chunk(start, end), offsets, start)
                elif opcode == Opcode.MESSAGE:
                    stray += self._read(start - _PREFIX.size, end)
                    if len(stray) >= 1 << 20:
                        yield from self._batch(_padded(stray), None, start)
                        stray.clear()
                else:
                    self._remember(opcode, start, end)
            except CaptureError as error:
                failure = failure or error
            self.statistics.position = position
            ended = opcode == Opcode.DATA_END
        if stray:
            yield from self._batch(_padded(stray), None, position)
        if failure is not None:
            raise failure
        if not ended:
            raise CaptureError(
                f"{self._name}: is cut off at byte {position} of {self._size}; all before it was read; "
                f"`edoras recover {self._name}` makes it whole"
            )
        if TOPIC not in self._topics.values():
            raise self._no_datagrams()
        self.statistics.position = self._size

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _batch(
        self, data: NDArray[np.uint8], offsets: NDArray[np.int64] | None, place: int
    ) -> Iterator[PacketBatch]:
        """Read the datagrams of a chunk; at most one batch.

        Args:
            data: the uncompressed records, padded.
            offsets: where the datagram messages start; None where no index says it.
            place: of the chunk in the file, for error messages.
        """
        if offsets is None:
            offsets = self._walk(data)
        size = data.size - PADDING
        damaged = CaptureError(f"{self._name}: the chunk at byte {place} is damaged and was left out")
        if len(offsets) == 0:
            return
        if int(offsets.min()) < 0 or int(offsets.max()) + _DATAGRAM.itemsize > size:
            raise damaged
        heads = read_at(data, offsets, _DATAGRAM)
        room = heads["record_length"].astype(np.int64) + (_PREFIX.size - _DATAGRAM.itemsize)
        length = heads["frame_length"].astype(np.int64)
        start = offsets + _DATAGRAM.itemsize
        sound = (
            (heads["opcode"] == Opcode.MESSAGE)
            & (heads["encapsulation"] == _ENCAPSULATION)
            & (length <= room)
            & (start + length <= size)
        )
        if not sound.all():
            raise damaged
        frames = FrameBatch(
            data=data,
            number=heads["number"].astype(np.int64),
            time_ns=heads["log_time"].astype(np.int64),
            link_type=heads["link_type"].astype(np.uint16),
            offset=start,
            length=length.astype(np.int32),
            original_length=heads["original_length"].astype(np.int32),
        )
        batch = self._demux.demux(frames)
        count = self.statistics
        count.frames += len(frames)
        count.datagrams += len(batch)
        count.skipped = self._demux.skipped
        count.bytes += int(length.sum())
        yield batch

    def _walk(self, data: NDArray[np.uint8]) -> NDArray[np.int64]:
        """Find the datagram messages in records that no index tells of; learn channels on the way."""
        view, size = data.data, data.size - PADDING
        found: list[int] = []
        position = 0
        while position + _PREFIX.size <= size:
            opcode, length = _PREFIX.unpack_from(view, position)
            start, end = position + _PREFIX.size, position + _PREFIX.size + length
            if end > size:
                break
            if opcode == Opcode.CHANNEL:
                self._learn(opcode, bytes(view[start:end]))
            elif opcode == Opcode.MESSAGE and length >= 2:
                channel_id = int.from_bytes(view[start : start + 2], "little")
                if self._topics.get(channel_id) == TOPIC:
                    found.append(position)
            position = end
        return np.array(found, dtype=np.int64)

    def _chunk(self, start: int, end: int) -> NDArray[np.uint8]:
        """Decompress the chunk whose record content is at ``start``."""
        import zstandard

        content = memoryview(self._read(start, end))
        damaged = CaptureError(f"{self._name}: the chunk at byte {start} is damaged and was left out")
        try:
            _, _, size, crc, named = _CHUNK.unpack_from(content)
            compression = bytes(content[_CHUNK.size : _CHUNK.size + named]).decode()
            packed = content[_CHUNK.size + named + 8 :]
        except (struct.error, ValueError) as error:
            raise damaged from error
        if size > MAX_CHUNK_BYTES:
            raise damaged
        if compression == "":
            data = _padded(packed)
        elif compression == "zstd":
            data = np.empty(size + PADDING, dtype=np.uint8)
            data[size:] = 0
            try:
                with zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True) as reader:
                    filled = 0
                    while count := reader.readinto(data[filled:size].data):
                        filled += count
            except zstandard.ZstdError as error:
                raise damaged from error
            data = data if filled == size else data[:0]
        elif compression == "lz4":
            import lz4.frame  # type: ignore[import-untyped]

            try:
                data = _padded(lz4.frame.decompress(packed))
            except RuntimeError as error:
                raise damaged from error
        else:
            raise CaptureError(
                f"{self._name}: the chunk at byte {start} is compressed with {compression!r}, "
                "which cannot be read; there are zstd and lz4"
            )
        if data.size != size + PADDING or (crc and zlib.crc32(data[:size].data) != crc):
            raise damaged
        return data

    def _index(self, position: int) -> tuple[NDArray[np.int64] | None, int]:
        """Read the message index behind a chunk.

        Returns:
            Where the datagram messages start in the chunk, None where no whole index says it; and where the
            next record is.
        """
        found: list[NDArray[np.int64]] = []
        seen = False
        while (record := self._prefix(position)) is not None and record[0] == Opcode.MESSAGE_INDEX:
            _, start, end = record
            seen = True
            channel_id = int.from_bytes(self._read(start, min(start + 2, end)), "little")
            # An unknown channel is one whose record is in the chunk: then the chunk is walked.
            if channel_id not in self._topics:
                seen = False
                position = self._skip_index(end)
                break
            if self._topics[channel_id] == TOPIC:
                entries = self._read(start + 6, end)
                found.append(
                    np.frombuffer(entries[: len(entries) // 16 * 16], dtype="<u8")[1::2].astype(np.int64)
                )
            position = end
        if not seen or record is None:
            return None, position
        return np.sort(np.concatenate(found)) if found else np.zeros(0, dtype=np.int64), position

    def _skip_index(self, position: int) -> int:
        while (record := self._prefix(position)) is not None and record[0] == Opcode.MESSAGE_INDEX:
            position = record[2]
        return position

    def _check(self, *, whole: bool) -> None:
        if self._read(0, len(MAGIC)) != MAGIC:
            raise CaptureError(f"{self._name}: is no MCAP file")
        if whole and TOPIC not in self._topics.values():
            raise self._no_datagrams()

    def _read_front(self) -> bool:
        """Read what is in front of the first message, and the summary; tell whether there is a summary."""
        position = len(MAGIC)
        while (record := self._prefix(position)) is not None:
            opcode, start, end = record
            if opcode in {Opcode.CHUNK, Opcode.MESSAGE, Opcode.DATA_END}:
                break
            self._remember(opcode, start, end)
            position = end
        footer = _PREFIX.size + 20
        tail = self._size - len(MAGIC) - footer
        if tail < position or self._read(self._size - len(MAGIC), self._size) != MAGIC:
            return False
        summary = int.from_bytes(self._read(tail + _PREFIX.size, tail + _PREFIX.size + 8), "little")
        if not 0 < summary <= tail:
            return False
        while summary < tail and (record := self._prefix(summary)) is not None:
            opcode, start, end = record
            if opcode in {Opcode.METADATA_INDEX, Opcode.ATTACHMENT_INDEX}:
                place = int.from_bytes(self._read(start, start + 8), "little")
                there = self._prefix(place)
                if there is not None:
                    self._remember(*there)
            else:
                self._remember(opcode, start, end)
            summary = end
        return True

    def _remember(self, opcode: int, start: int, end: int) -> None:
        if opcode in {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.ATTACHMENT}:
            self._learn(opcode, self._read(start, end))

    def _learn(self, opcode: int, content: bytes) -> None:
        """Keep what a record about the recording says; one that is not sound says nothing."""
        stream = ReadDataStream(BytesIO(content))
        try:
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(stream)
                if schema.encoding == "ros2msg":
                    self._definitions[schema.name] = schema.data.decode()
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(stream)
                self._topics[channel.id] = channel.topic
            elif opcode == Opcode.METADATA:
                record = Metadata.read(stream)
                self._metadata[record.name] = record.metadata
            else:
                attachment = Attachment.read(stream)
                if attachment.media_type == "application/yaml":
                    self._attachments[attachment.name] = attachment.data
        except (McapError, struct.error, ValueError, OverflowError):
            self.statistics.warnings.append(f"{self._name}: a {Opcode(opcode).name} record is damaged")

    def _prefix(self, position: int) -> tuple[int, int, int] | None:
        """Return opcode, start and end of a record's content; None where no whole record is."""
        prefix = self._read(position, position + _PREFIX.size)
        if len(prefix) < _PREFIX.size:
            return None
        opcode, length = _PREFIX.unpack(prefix)
        start = position + _PREFIX.size
        return (opcode, start, start + length) if start + length <= self._size else None

    def _read(self, start: int, end: int) -> bytes:
        try:
            self._file.seek(start)
            return self._file.read(max(end - start, 0))
        except OSError as error:
            raise CaptureError(f"{self._name}: cannot be read: {error.strerror or error}") from error

    def _no_datagrams(self) -> CaptureError:
        topics = ", ".join(sorted(set(self._topics.values()))) or "none"
        return CaptureError(
            f"{self._name}: holds no {TOPIC}, so there are no datagrams to read; its topics are {topics}"
        )


def _padded(data: bytes | bytearray | memoryview) -> NDArray[np.uint8]:
    padded = np.zeros(len(data) + PADDING, dtype=np.uint8)
    padded[: len(data)] = np.frombuffer(data, dtype=np.uint8)
    return padded


def _positive(values: dict[str, str], name: str, default: int) -> int:
    text = values.get(name, "")
    return int(text) if text.isdecimal() and int(text) > 0 else default
