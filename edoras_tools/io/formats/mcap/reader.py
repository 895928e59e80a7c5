"""Reads recordings: the frames of ``/edoras/datagrams``, chunk by chunk.

Messages come in the order of the file, which is the order of the capture. Therefore a capture made from a
recording is equal to the original one, bit for bit, even if its timestamps step back.
"""

from __future__ import annotations

import os
import struct
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec
import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Metadata, Schema, Statistics
from msgspec.structs import replace

from edoras_tools import __version__, model
from edoras_tools.errors import CaptureError, NoDatagramsError, OnFailure, WireError, os_errors
from edoras_tools.io.formats.mcap.chunks import chunk_records
from edoras_tools.io.formats.mcap.file import (
    CHUNK_HEAD_BYTES,
    CHUNK_INDEX,
    INDEX_ENTRY,
    INDEX_HEAD,
    INDEX_PLACE,
    MAX_CHUNK_BYTES,
    MESSAGE_HEAD,
    MOST_IDLE,
    RECORD_HEAD,
)
from edoras_tools.io.formats.mcap.messages import scanned
from edoras_tools.io.formats.table import TOPIC_READERS
from edoras_tools.io.frames.frame_batch import FrameBatch, frames_at, joined_frames, packed_frames
from edoras_tools.io.frames.linklayer import FrameSource
from edoras_tools.io.topics import messages
from edoras_tools.io.topics.edoras import FAULTS_TOPIC, HOST_TOPIC, fault_of, host_counters_of
from edoras_tools.links.table import links
from edoras_tools.ros import TypeStore
from edoras_tools.units import SECOND
from edoras_tools.wire.arrays import Integers, Mask, Octets, Places, crc32, read_at

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.io import Choice
    from edoras_tools.sessions.faults.rules import Fault

T = TypeVar("T")

METADATA_NAMES = ("edoras_opening", "edoras")
"""Metadata records of a recording. The later one has more values; a cut-off recording has only the first."""

_LEAD_NS = 10 * SECOND
"""Time before a period that is read too: a packet of the period, or its first copy, may begin there."""
_BATCH_BYTES = 4 << 20
"""Bytes of a batch; several chunks are joined, because they are small."""
_AHEAD_BYTES = 256 << 10
"""Bytes of the file that are read at once, because records are small."""
_MOST_INDEX_BYTES = 1 << 20
"""Largest summary record that can be an index, in bytes."""
_CHECKED_BYTES = 256 << 20
"""Largest file whose checksum is compared, in bytes: it takes less time than the start of a command."""
_DESCRIBING = {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS, Opcode.METADATA, Opcode.ATTACHMENT}
_DATA_END = struct.Struct("<BQI")
"""The record before the summary, with the CRC of all bytes before it."""
_CRC = struct.Struct("<I")
_KIND = 0xFFFF
"""The bits of a CDR encapsulation that contain the byte order; the rest are options."""


class McapSource(FrameSource):
    """Reads a recording.

    Args:
        path: path of the file.
        name: name in messages; by default the path.
        copy: temporary file that exists until the source is closed, or None.

    Attributes:
        info: information on the recording: resolution and snap length of the original capture, mission files
            as attachments, schemas as definitions.
        statistics: frames and datagrams counted so far.

    Raises:
        CaptureError: it is not an MCAP file, or a complete recording without datagrams.
    """

    def __init__(self, path: str | Path, name: str = "", copy: Any = None) -> None:
        self._name, self._path, self._copy = name or str(path), Path(path), copy
        with os_errors(f"{path}: cannot be opened"):
            self._file = self._path.open("rb")
            self._size = os.fstat(self._file.fileno()).st_size
        self._topics: dict[int, str] = {}
        self._metadata: dict[str, dict[str, str]] = {}
        self._attachments: dict[str, bytes] = {}
        self._definitions: dict[str, str] = {}
        self._chunks: list[bytes] = []
        self._channels: dict[int, dict[str, str]] = {}
        self._counts: dict[int, int] = {}
        self._period: Callable[[int], tuple[int, int]] | None = None
        self._chosen: Choice | None = None
        self._heads: list[NDArray[np.void]] = []
        self._ahead = b""
        self._ahead_at = 0
        self._data_end = 0
        super().__init__(model.SourceStatistics(total_bytes=self._size))
        # The copy is still needed: a recording without datagrams may have topics.
        with OnFailure(self._file.close):
            self._check(whole=self._read_front())
        values = {key: item for kind in METADATA_NAMES for key, item in self._metadata.get(kind, {}).items()}
        self._flows = _flows(values.get("flows", ""))
        self._info = model.SourceInfo(
            name=self._name,
            kind="mcap",
            time_resolution_ns=_positive(values, "time_resolution_ns", 1),
            snap_length=_positive(values, "snap_length", 262144),
            attachments=self._attachments,
            definitions=self._definitions,
            read_with=_of_json(values.get("read_with", ""), dict[str, str]) or {},
            links=_of_json(values.get("links", ""), frozenset[str]),
            apart=values.get("apart") == __version__ and sum(self._flows.values()) == self._total,
            sound=values.get("sound") == "true",
        )

    def _batches(self) -> Iterator[model.PacketBatch]:
        """Yield the datagrams, chunk by chunk.

        Raises:
            CaptureError: the file is cut off or damaged, or has no datagrams; raised after all complete
            chunks.
        """
        failure: CaptureError | None = None
        stray = bytearray()
        parts: list[FrameBatch] = []
        position = len(messages.MAGIC)
        ended = False
        size = idle = 0
        needed: list[int] | None = None if self._chosen is None else self._holding(self._chosen)
        while not ended and idle < MOST_IDLE and (record := self._prefix(position)) is not None:
            opcode, start, end = record
            if opcode == Opcode.CHUNK and (later := _following(needed, position)) > position:
                position = later
                continue
            position, idle = end, idle + 1
            try:
                if opcode == Opcode.CHUNK:
                    offsets, position = self._index(end)
                    parts.append(self._frames(self._chunk(start, end), offsets, start))
                    size += len(parts[-1].data)
                    idle = 0
                elif opcode == Opcode.MESSAGE and end - start >= MESSAGE_HEAD.size:
                    idle = 0
                    stray += self._read(start - RECORD_HEAD.size, end)
                    if len(stray) >= _BATCH_BYTES:
                        parts.append(self._frames(_array(stray), None, start))
                        size += len(stray)
                        stray = bytearray()
                else:
                    self._remember(opcode, start, end)
            except CaptureError as error:
                failure = failure or error
            if size >= _BATCH_BYTES:
                self.statistics.position = position
                for batch in self._batch(parts):
                    if self._period is not None and needed is None and len(batch):
                        needed = self._needed(*self._period(int(batch.time_ns[0])))
                    yield batch
                parts, self._heads, size = [], [], 0
            ended = opcode == Opcode.DATA_END
        if stray:
            parts.append(self._frames(_array(stray), None, position))
        self.statistics.position = position
        yield from self._batch(parts)
        yield from self._rest()
        if needed or self._chosen is not None:
            self.statistics.passed_over = max(0, self._total - self.statistics.frames)
        if failure := failure or self._wrong_end(position, ended=ended):
            raise failure
        self.statistics.position = self._size

    def _wrong_end(self, position: int, *, ended: bool) -> CaptureError | None:
        if ended:
            return None if messages.DATAGRAMS_TOPIC in self._topics.values() else self._no_datagrams()
        has_end = self._read(self._size - len(messages.MAGIC), self._size) == messages.MAGIC
        return CaptureError(
            f"{self._name}: is {'damaged' if has_end else 'cut off'} at byte {position} of {self._size}; "
            "everything before was read; "
            f"`edoras recover {self._name}` repairs it"
        )

    def narrow(self, period: Callable[[int], tuple[int, int]]) -> None:
        """See ``SourceDefaults``; chunks are skipped only if the summary lists them."""
        self._period = period if self._chunks else None

    def choose(self, choice: Choice) -> None:
        """See ``SourceDefaults``."""
        self._chosen = choice

    def decoded(
        self, batch: model.PacketBatch, decode: Callable[[model.PacketBatch], model.Columns]
    ) -> model.Columns:
        """Return the columns of a batch; after ``choose`` with the recorded findings.

        Other datagrams, which are skipped now, may have caused these findings.
        """
        columns = decode(batch)
        heads = self._heads_of(batch.number)
        return columns if heads is None else replace(columns, findings=heads["findings"])

    def published(self, number: Integers) -> Integers | None:
        """See ``SourceDefaults``."""
        heads = self._heads_of(number)
        return None if heads is None else heads["publish_time"].astype(np.int64)

    def _heads_of(self, number: Integers) -> NDArray[np.void] | None:
        """Return the recorded headers of datagrams of the last batch, after ``choose``; else None."""
        if self._chosen is None or not len(number):
            return None
        heads = self._heads[0] if len(self._heads) == 1 else np.concatenate(self._heads)
        self._heads = [heads]
        order = np.argsort(heads["number"], kind="stable")
        return heads[order[np.searchsorted(heads["number"], number, sorter=order)]]

    def _needed(self, start_ns: int, end_ns: int) -> list[int]:
        """Return the positions of the chunks that may hold a datagram of a period, and of the last chunk.

        An empty list means all chunks: the summary is damaged.
        """
        heads, _, _ = self._indexes()
        needed = (heads["end_ns"] >= max(start_ns - _LEAD_NS, 0)) & (heads["start_ns"] < max(end_ns, 0))
        needed[-1:] = True
        return self._passing_over(heads, needed)

    def _holding(self, choice: Choice) -> list[int]:
        """Return the positions of chunks that may hold a chosen datagram, and of the first and last chunk.

        An empty list means all chunks: their times overlap, or the number of messages of a chosen MsgId is
        not that of its datagrams.
        """
        (heads, owner, places), channels = self._indexes(), self._channels_of(choice)
        if not channels or (heads["end_ns"][:-1] > heads["start_ns"][1:]).any():
            return []
        datagrams, needed = self._datagrams, np.zeros(len(heads), np.bool_)
        whole = owner[np.isin(places["channel_id"], [*datagrams])]
        needed[whole[:1]] = needed[whole[-1:]] = True
        holding = np.unique(owner[np.isin(places["channel_id"], [*channels])])
        needed[holding] = True
        first, end = (np.searchsorted(owner, holding, side).tolist() for side in ("left", "right"))
        for chunk, begin, beyond in zip(holding.tolist(), first, end, strict=True):
            inside = dict(places[begin:beyond].tolist())
            # The datagram of the first message may be at the end of the chunk before.
            if self._first(inside, channels) < self._first(inside, datagrams):
                needed[max(chunk - 1, 0)] = True
        return self._passing_over(heads, needed)

    def _passing_over(self, heads: NDArray[np.void], needed: Mask) -> list[int]:
        """Return the positions of the needed chunks; warn if the file's checksum is wrong.

        The damage may be in chunks that are skipped. The checksum of a large file is not computed, because
        that would take longer than reading the needed chunks.
        """
        _, _, crc = _DATA_END.unpack(self._pread(self._data_end, _DATA_END.size))
        small = self._data_end <= _CHECKED_BYTES and crc and not needed.all()
        if small and crc != self._checksum(0, self._data_end):
            self.statistics.warnings.append(
                f"{self._name}: is damaged, perhaps only where nothing was asked for; "
                "`edoras info --verify` says where"
            )
        return heads["position"][needed].tolist()

    def _first(self, inside: Mapping[int, int], channels: Collection[int]) -> int:
        """Return the position in a chunk of the first message of some channels; the maximum if there is none.

        Args:
            inside: position of the MessageIndex record of each channel of the chunk.
        """
        places = [place for key, place in inside.items() if key in channels]
        entries = [
            self._pread(min(place + INDEX_HEAD.itemsize, self._size), INDEX_ENTRY.itemsize)
            for place in places
        ]
        return min((int.from_bytes(entry[8:], "little") for entry in entries), default=MAX_CHUNK_BYTES)

    def _pread(self, position: int, size: int) -> bytes:
        with os_errors(f"{self._name}: cannot be read"):
            return os.pread(self._file.fileno(), size, position)

    def _channels_of(self, choice: Choice) -> set[int]:
        """Return the channels of the messages in chosen datagrams.

        The set is empty if some of these datagrams have no message, or if there are datagrams of no link,
        which are always read.
        """
        codes = {link.label: int(link) for link in links()}
        if not self._flows or any(label not in codes for label, _ in self._flows):
            return set()
        of_link = np.array([codes[label] for label, _ in self._flows], np.uint8)
        mask = choice(of_link, np.array([msg_id for _, msg_id in self._flows], np.int32))
        total = Counter[int]()
        for (_, msg_id), count in self._flows.items():
            total[msg_id] += count
        channels: set[int] = set()
        for (label, msg_id), is_selected in zip(self._flows, mask.tolist(), strict=True):
            counts = {label: self._flows[label, msg_id], None: total[msg_id]}
            whole = {
                key
                for key, values in self._channels.items()
                if values.get("msg_id") == f"{msg_id:#06x}"
                and self._counts.get(key) == counts.get(values.get("link"))
            }
            if is_selected and not whole:
                return set()
            channels |= whole if is_selected else set()
        return channels

    @property
    def _datagrams(self) -> set[int]:
        return {key for key, topic in self._topics.items() if topic == messages.DATAGRAMS_TOPIC}

    @property
    def _total(self) -> int:
        """Number of datagrams in the recording; after a repair it may be less than was recorded."""
        return sum(self._counts.get(key, 0) for key in self._datagrams)

    def _indexes(self) -> tuple[NDArray[np.void], Places, NDArray[np.void]]:
        """Return the chunk indexes of the summary, in the order of the file; empty if it is damaged.

        Returns:
            ``CHUNK_INDEX`` of each chunk; then, for each list of messages, the index of its chunk, and its
            ``INDEX_PLACE``.
        """
        size = CHUNK_INDEX.itemsize
        chunks = sorted(self._chunks, key=lambda item: int.from_bytes(item[16:24], "little"))
        if not self._listed() or any(len(item) < size for item in chunks):
            chunks = []
        heads = np.frombuffer(b"".join(item[:size] for item in chunks), CHUNK_INDEX)
        counts = (heads["places"] // INDEX_PLACE.itemsize).tolist()
        lists = [
            np.frombuffer(item, INDEX_PLACE, min(count, (len(item) - size) // INDEX_PLACE.itemsize), size)
            for item, count in zip(chunks, counts, strict=True)
        ]
        places = np.concatenate([np.zeros(0, INDEX_PLACE), *lists])
        return heads, np.repeat(np.arange(len(heads)), [*map(len, lists)]), places

    def _listed(self) -> bool:
        """Return whether the summary's checksum is right; a summary without one is accepted."""
        start, end = self._data_end + _DATA_END.size, self._size - len(messages.MAGIC) - _CRC.size
        (value,) = _CRC.unpack(self._pread(end, _CRC.size))
        return value in {0, self._checksum(start, end)}

    def _checksum(self, start: int, end: int, value: int = 0) -> int:
        """Return the CRC-32 of a part of the file; ``value`` is the CRC of the bytes before it."""
        while start < end and (block := self._pread(start, min(end - start, _AHEAD_BYTES))):
            value = crc32(block, value)
            start += len(block)
        return value

    def recorder_counts(self) -> str:
        """See ``SourceDefaults``; the checksums of all bytes before the summary are compared."""
        values = self._metadata.get(messages.COUNTS_METADATA_NAME, {})
        if values.get("version") != __version__ or not self._data_end:
            return ""
        covered, end = min(_positive(values, "covers", 0), self._data_end), self._data_end
        value = self._checksum(0, covered)
        last = _DATA_END.pack(Opcode.DATA_END, _CRC.size, self._checksum(covered, end, value))
        whole = str(value) == values.get("crc") and self._pread(end, _DATA_END.size) == last
        return values.get("counts", "") if whole else ""

    def faults(self) -> list[Fault]:
        """Return the faults that a proxy or a replay injected, if the recording can be read."""
        return self._extras(FAULTS_TOPIC, fault_of)

    def host(self) -> list[model.HostCounters]:
        """Return the counters of the recording host's kernel, if the recording can be read."""
        types = TypeStore()
        return self._extras(HOST_TOPIC, lambda cdr: host_counters_of(cdr, types))

    def _extras(self, topic: str, read: Callable[[bytes], T]) -> list[T]:
        """Return the messages of an optional topic of ours."""
        if topic not in self._topics.values():
            return []
        values = []
        with self._path.open("rb") as file, suppress(McapError, WireError, EOFError, struct.error):
            for _, _, message in make_reader(file).iter_messages([topic], log_time_order=False):
                values.append(read(message.data))
        return values

    def close(self) -> None:
        """Close the file, and remove the temporary copy."""
        self._file.close()
        if self._copy is not None:
            self._copy.close()

    def _batch(self, parts: list[FrameBatch]) -> Iterator[model.PacketBatch]:
        """Make a batch of the frames of several chunks; nothing if there are none."""
        if any(map(len, parts)):
            yield self._demuxed(joined_frames(parts))

    def _frames(self, data: Octets, offsets: Integers | None, place: int) -> FrameBatch:
        """Return the frames in a chunk.

        Args:
            data: the uncompressed records; without padding, which ``joined_frames`` adds.
            offsets: start of each datagram message; None if there is no index.
            place: position of the chunk in the file, for error messages.
        """
        if offsets is None:
            offsets = self._walk(data)
        damaged = CaptureError(f"{self._name}: the chunk at byte {place} is damaged and was left out")
        if len(offsets) and (
            int(offsets.min()) < 0 or int(offsets.max()) + messages.DATAGRAM.itemsize > len(data)
        ):
            raise damaged
        heads = read_at(data, offsets, messages.DATAGRAM)
        room = heads["record_length"].astype(np.int64) + (RECORD_HEAD.size - messages.DATAGRAM.itemsize)
        length = heads["frame_length"].astype(np.int64)
        start = offsets + messages.DATAGRAM.itemsize
        sound = (
            (heads["opcode"] == Opcode.MESSAGE)
            & (heads["encapsulation"] & _KIND == messages.CDR_LE_WORD)
            & (length <= room)
            & (start + length <= len(data))
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
        if self._chosen is None or not len(frames):
            return frames
        keep = self._chosen(heads["link"], heads["msg_id"]) | (heads["link"] == model.OTHER)
        keep[[0, frames.time_ns.argmin(), frames.time_ns.argmax()]] = True
        rows = np.flatnonzero(keep)
        self._heads.append(heads[rows])
        return packed_frames(frames_at(frames, rows))

    def _walk(self, data: Octets) -> Integers:
        """Return the positions of datagram messages in records without an index; also learn channels."""
        view, size = data.data, data.size
        positions: list[int] = []
        position = 0
        while position + RECORD_HEAD.size <= size:
            opcode, length = RECORD_HEAD.unpack_from(view, position)
            start, end = position + RECORD_HEAD.size, position + RECORD_HEAD.size + length
            if end > size:
                break
            if opcode == Opcode.CHANNEL:
                self._learn(opcode, bytes(view[start:end]))
            elif opcode == Opcode.MESSAGE and length >= 2:
                channel_id = int.from_bytes(view[start : start + 2], "little")
                if self._topics.get(channel_id) == messages.DATAGRAMS_TOPIC:
                    positions.append(position)
            position = end
        return np.array(positions, dtype=np.int64)

    def _chunk(self, start: int, end: int) -> Octets:
        """Decompress the chunk whose content starts at ``start``."""
        ending = " and was left out"
        return _array(chunk_records(self._name, start, end - start, lambda: self._read(start, end), ending))

    def _index(self, position: int) -> tuple[Integers | None, int]:
        """Read the message index after a chunk.

        Returns:
            The start of each datagram message in the chunk, or None without a complete index; and the
            position of the next record.
        """
        parts: list[Integers] = []
        indexed = False
        while (record := self._prefix(position)) is not None and record[0] == Opcode.MESSAGE_INDEX:
            _, start, end = record
            indexed = True
            channel_id = int.from_bytes(self._read(start, min(start + 2, end)), "little")
            # The Channel record of an unknown channel is in the chunk: then all its records are read one by
            # one.
            if channel_id not in self._topics:
                return None, end
            if self._topics[channel_id] == messages.DATAGRAMS_TOPIC:
                entries = self._read(start + INDEX_HEAD.itemsize - RECORD_HEAD.size, end)
                listed = np.frombuffer(entries, INDEX_ENTRY, len(entries) // INDEX_ENTRY.itemsize)
                parts.append(listed["offset"].astype(np.int64))
            position = end
        if not indexed or record is None:
            return None, position
        return np.sort(np.concatenate(parts)) if parts else np.zeros(0, dtype=np.int64), position

    def _check(self, *, whole: bool) -> None:
        if self._read(0, len(messages.MAGIC)) != messages.MAGIC:
            raise CaptureError(f"{self._name}: is not an MCAP file")
        if not whole and messages.DATAGRAMS_TOPIC not in self._topics.values():
            self._scan_topics()
            whole = bool(self._topics)
        if whole and messages.DATAGRAMS_TOPIC not in self._topics.values():
            raise self._no_datagrams()

    def _scan_topics(self) -> None:
        """Look for topics in a file without a summary: other tools describe them anywhere."""
        with suppress(CaptureError):  # the file is cut off: the error is raised when it is read
            for record in scanned(self._path, self._name):
                if isinstance(record, Channel):
                    self._topics[record.id] = record.topic
                    if record.topic == messages.DATAGRAMS_TOPIC:
                        return

    def _read_front(self) -> bool:
        """Read the records before the first message, and the summary; return whether there is a summary."""
        position, idle = len(messages.MAGIC), 0
        while idle < MOST_IDLE and (record := self._prefix(position)) is not None:
            opcode, start, end = record
            idle += 1
            if opcode in {Opcode.CHUNK, Opcode.MESSAGE, Opcode.DATA_END}:
                break
            self._remember(opcode, start, end)
            position = end
        footer = RECORD_HEAD.size + 20
        tail = self._size - len(messages.MAGIC) - footer
        if tail < position or self._read(self._size - len(messages.MAGIC), self._size) != messages.MAGIC:
            return False
        summary = int.from_bytes(self._read(tail + RECORD_HEAD.size, tail + RECORD_HEAD.size + 8), "little")
        if not 0 < summary <= tail:
            return False
        self._data_end = max(0, summary - _DATA_END.size)
        for opcode, start, end, content in self._summary(summary, tail):
            if opcode == Opcode.CHUNK_INDEX:
                self._chunks.append(content)
            elif opcode in {Opcode.METADATA_INDEX, Opcode.ATTACHMENT_INDEX}:
                prefix = self._prefix(int.from_bytes(content[:8], "little"))
                if prefix is not None:
                    self._remember(*prefix)
            else:
                self._remember(opcode, start, end)
        return True

    def _summary(self, position: int, until: int) -> Iterator[tuple[int, int, int, bytes]]:
        """Yield opcode, start, end and content of summary records; the content of a large one is empty."""
        piece, at = b"", 0
        while position + RECORD_HEAD.size <= until:
            if at + RECORD_HEAD.size > len(piece):
                piece, at = self._piece(position, until), 0
            opcode, length = RECORD_HEAD.unpack_from(piece, at)
            start, end = position + RECORD_HEAD.size, position + RECORD_HEAD.size + length
            if end > until:
                return
            if length > _MOST_INDEX_BYTES:
                content, piece, at = b"", b"", 0
            else:
                if at + RECORD_HEAD.size + length > len(piece):
                    piece, at = self._piece(position, until), 0
                at += RECORD_HEAD.size + length
                content = piece[at - length : at]
            yield opcode, start, end, content
            position = end

    def _piece(self, position: int, until: int) -> bytes:
        """Read a piece of the summary that holds at least one index record."""
        return self._pread(position, min(until - position, 2 * _MOST_INDEX_BYTES))

    def _remember(self, opcode: int, start: int, end: int) -> None:
        if opcode in _DESCRIBING and end - start <= MAX_CHUNK_BYTES:  # none of ours is larger
            self._learn(opcode, self._read(start, end))

    def _learn(self, opcode: int, content: bytes) -> None:
        """Store the contents of a record about the recording; a damaged one is ignored, with a warning."""
        stream = ReadDataStream(BytesIO(content))
        try:
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(stream)
                if schema.encoding == "ros2msg":
                    self._definitions[schema.name] = schema.data.decode()
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(stream)
                self._topics[channel.id], self._channels[channel.id] = channel.topic, channel.metadata
            elif opcode == Opcode.STATISTICS:
                self._counts = Statistics.read(stream).channel_message_counts
            elif opcode == Opcode.METADATA:
                record = Metadata.read(stream)
                if record.name == messages.OUTAGE_METADATA_NAME:
                    self._note(model.InterfaceOutage.from_text(record.metadata))
                if record.name not in self._metadata and "kernel_drops" in record.metadata:
                    before = self.statistics.kernel_drops or 0
                    self.statistics.kernel_drops = before + int(record.metadata["kernel_drops"])
                self._metadata[record.name] = record.metadata
            else:
                attachment = Attachment.read(stream)
                if attachment.media_type == "application/yaml":
                    self._attachments[attachment.name] = attachment.data
        except (McapError, struct.error, ValueError, OverflowError):
            warning = f"{self._name}: a {Opcode(opcode).name} record is damaged"
            if warning not in self.statistics.warnings:  # there may be millions
                self.statistics.warnings.append(warning)

    def _note(self, outage: model.InterfaceOutage) -> None:
        """Store an outage; the record of its end replaces the record of its beginning."""
        outages = {(item.interface, item.start_ns): item for item in self.statistics.outages}
        before = outages.get((outage.interface, outage.start_ns))
        if before is None or not before.end_ns:
            outages[outage.interface, outage.start_ns] = outage
        self.statistics.outages[:] = sorted(outages.values(), key=lambda item: item.start_ns)

    def _prefix(self, position: int) -> tuple[int, int, int] | None:
        """Return opcode, start and end of a record's content; None if there is no complete record."""
        prefix = self._read(position, position + RECORD_HEAD.size)
        if len(prefix) < RECORD_HEAD.size:
            return None
        opcode, length = RECORD_HEAD.unpack(prefix)
        start = position + RECORD_HEAD.size
        # No record has opcode 0: zeros may go on for gigabytes.
        return (opcode, start, start + length) if opcode and start + length <= self._size else None

    def _read(self, start: int, end: int) -> bytes:
        if end - start > MAX_CHUNK_BYTES + CHUNK_HEAD_BYTES:
            raise CaptureError(f"{self._name}: the record at byte {start} is too large and was left out")
        start, end = min(start, self._size), min(end, self._size)  # an index may name any place
        if start < self._ahead_at or end > self._ahead_at + len(self._ahead):
            with os_errors(f"{self._name}: cannot be read"):
                self._file.seek(start)
                self._ahead, self._ahead_at = self._file.read(max(end - start, _AHEAD_BYTES)), start
        return self._ahead[start - self._ahead_at : end - self._ahead_at]

    def _no_datagrams(self) -> CaptureError:
        topics = ", ".join(sorted(set(self._topics.values()))) or "none"
        return NoDatagramsError(
            f"{self._name}: contains no {messages.DATAGRAMS_TOPIC}, so no datagrams can be read, and its "
            f"topics are {topics}; {TOPIC_READERS}"
        )


def _following(needed: list[int] | None, position: int) -> int:
    """Return the position of the next needed chunk from ``position`` on.

    All chunks are needed if ``needed`` is empty, and those after the last needed one.
    """
    return needed[bisect_left(needed, position)] if needed and position < needed[-1] else position


def _array(data: bytes | bytearray | memoryview) -> Octets:
    return np.frombuffer(data, dtype=np.uint8)


def _of_json(text: str, kind: type[T]) -> T | None:
    """Return a value of a type from JSON; None if it is not one."""
    with suppress(msgspec.DecodeError):
        return msgspec.json.decode(text or "null", type=kind)
    return None


def _flows(text: str) -> dict[tuple[str, int], int]:
    """Return the number of datagrams by link and MsgId, from a JSON object; empty if it is not one."""
    counts = [(name.partition("/"), count) for name, count in (_of_json(text, dict[str, int]) or {}).items()]
    with suppress(ValueError):
        return {(label, int(msg_id, 16)): count for (label, _, msg_id), count in counts}
    return {}


def _positive(values: dict[str, str], name: str, default: int) -> int:
    text = values.get(name, "")
    return int(text) if text.isdecimal() and int(text) > 0 else default
