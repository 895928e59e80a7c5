"""Opens a capture by its content, not by its name; merges several in order of time."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from heapq import heappop, heappush
from itertools import chain
from pathlib import Path
from socket import if_nameindex
from typing import TYPE_CHECKING, Final

import numpy as np
from msgspec.structs import replace

from edoras_tools.errors import CaptureError, NoDatagramsError, OnFailure
from edoras_tools.io import Source, SourceDefaults
from edoras_tools.io.formats import capture_file, table
from edoras_tools.io.formats.pcap import MAGICS, PcapSource
from edoras_tools.model import HostCounters, PacketBatch, SourceInfo, SourceStatistics, concatenate
from edoras_tools.units import SECOND
from edoras_tools.wire.arrays import PADDING, Integers
from edoras_tools.wire.cfe import CFE_MAGIC

if TYPE_CHECKING:
    from edoras_tools.links.doors import Framing
    from edoras_tools.sessions.faults.rules import Fault

SEAM_NS: Final = 2 * SECOND
"""Longest time between the end of a file and the beginning of one that continues it."""
_TOGETHER: Final = 512
"""Most small batches that are joined into one: each batch costs milliseconds, even with few rows."""


def merge_sources(sources: Sequence[Source]) -> Source:
    """Read several sources as one, in order of time.

    Every source keeps its own order: a datagram that is earlier than its predecessor is treated as if it had
    the same time. Of equal times, the source named first comes first. Datagrams are numbered from 1. If a
    source ends with an error, the others are read to their end before it is raised.

    Args:
        sources: at least one; a single one is returned as it is. They are files: a source that waits would
            make all of them wait.
    """
    return sources[0] if len(sources) == 1 else MergedSource(sources)


class MergedSource(SourceDefaults):
    """See ``merge_sources``."""

    section = 0

    def __init__(self, sources: Sequence[Source]) -> None:
        self._sources = list(sources)
        self._statistics = SourceStatistics()
        self._first, self._origin = 1, np.zeros(1, np.int64)

    @property
    def info(self) -> SourceInfo:
        """Information on all sources: all names, the finest resolution, the largest snap length."""
        infos = [source.info for source in self._sources]
        kinds = {info.kind for info in infos}
        return SourceInfo(
            name=", ".join(info.name for info in infos),
            kind=kinds.pop() if len(kinds) == 1 else "merged",
            time_resolution_ns=min(info.time_resolution_ns for info in infos),
            snap_length=max(info.snap_length for info in infos),
            attachments={name: data for info in reversed(infos) for name, data in info.attachments.items()},
            definitions={name: text for info in reversed(infos) for name, text in info.definitions.items()},
            read_with={name: text for info in reversed(infos) for name, text in info.read_with.items()},
            damage="; ".join(info.damage for info in infos if info.damage),
        )

    @property
    def statistics(self) -> SourceStatistics:
        """The sums of the sources' statistics; 0 drops become None if a source does not know its drops."""
        total = self._statistics
        for name in SourceStatistics.__struct_fields__:
            values = [getattr(source.statistics, name) for source in self._sources]
            if isinstance(values[0], list):
                setattr(total, name, [*chain(*values)])
            else:
                added = sum(value or 0 for value in values)
                setattr(total, name, None if None in values and not added else added)
        return total

    @property
    def files(self) -> Sequence[str]:
        """The names of the sources."""
        return [source.info.name for source in self._sources]

    def follow(self, framings: Mapping[int, Framing]) -> None:
        """Read the TCP streams of these ports, and no others; call it before the first batch."""
        for source in self._sources:
            source.follow(framings)

    def faults(self) -> list[Fault]:
        """Return the injected faults in all recordings."""
        return [fault for source in self._sources for fault in source.faults()]

    def host(self) -> list[HostCounters]:
        """Return the counters of the recording host's kernel, if exactly one recording has them."""
        counters = [item for source in self._sources if (item := source.host())]
        return counters[0] if len(counters) == 1 else []

    def origin(self, number: Integers) -> Integers:
        """Return the index of the source that each datagram of the last batch is from."""
        return self._origin[(number - self._first).clip(0, len(self._origin) - 1)]

    def batches(self) -> Iterator[PacketBatch]:
        """Yield all datagrams in order of time; see ``Source.batches``.

        Raises:
            CaptureError: a source raised it; it has the messages of all sources.
        """
        errors: list[str] = []
        heads = [_Head(source, errors) for source in self._sources]
        number, until, touched = 1, 1, [*range(len(heads))]
        waiting: list[tuple[PacketBatch, Integers]] = []
        ends: list[tuple[int, int]] = []
        begins: list[tuple[int, int]] = []
        reading: set[int] = set()
        while True:
            ended = bool(reading)
            for place in touched:
                if not heads[place].fill():
                    reading.discard(place)
                else:
                    heappush(ends, (heads[place].end, place))
                    heappush(begins, (int(heads[place].keys[0]), place))
            while ends and ends[0][0] != heads[ends[0][1]].end:  # an old end: rows were taken since
                heappop(ends)
            ended = ended and not reading and bool(begins) and begins[0][0] - until > SEAM_NS
            if waiting and (not ends or ended or max(len(waiting), len(waiting[-1][0])) >= _TOGETHER):
                batch = concatenate([_trim(part) for part, _ in waiting])
                self._first, self._origin = number, np.concatenate([origin for _, origin in waiting])
                yield replace(batch, number=np.arange(number, number + len(batch)))
                number += len(batch)
                waiting = []
            if not ends:
                break
            self.section += ended
            # The first source that ends at this time may deliver it completely: later ones hold it back.
            until, last = ends[0]
            touched = []
            while begins and begins[0] <= (until, last):
                touched.append(heappop(begins)[1])
            touched.sort()
            reading.update(touched)
            parts = [heads[place].take(until, whole=place <= last) for place in touched]
            waiting.append(_in_order(parts, touched))
        if errors:
            raise CaptureError("; ".join(errors))

    def close(self) -> None:
        """Close all sources."""
        for source in self._sources:
            source.close()


class _Head:
    """The datagrams of a source that wait to be merged.

    Attributes:
        keys: sort key of each waiting datagram, i64: the largest time up to it.
    """

    def __init__(self, source: Source, errors: list[str]) -> None:
        self._batches = source.batches()
        self._errors = errors
        self._rest: PacketBatch | None = None
        self._latest = np.iinfo(np.int64).min
        self.keys: Integers = np.empty(0, dtype=np.int64)

    @property
    def end(self) -> int:
        """The key of the last waiting datagram; the smallest i64 if none waits."""
        return int(self.keys[-1]) if len(self.keys) else np.iinfo(np.int64).min

    def fill(self) -> bool:
        """Read until a datagram waits; return False at the end of the source."""
        while not len(self.keys):
            try:
                self._rest = next(self._batches, None)
            except CaptureError as error:
                self._errors.append(str(error))
                return False
            if self._rest is None:
                return False
            self.keys = np.maximum.accumulate(np.maximum(self._rest.time_ns, self._latest))
        return True

    def take(self, until: int, *, whole: bool) -> tuple[PacketBatch, Integers]:
        """Return the waiting datagrams before a time, and their keys; ``whole`` includes those of that time.

        At least one must qualify.
        """
        count = int(np.searchsorted(self.keys, until, side="right" if whole else "left"))
        assert self._rest is not None
        part, keys = self._rest, self.keys
        self._latest = int(keys[count - 1])
        self.keys = keys[count:]
        if len(self.keys):
            part, self._rest = part.take(slice(count)), part.take(slice(count, None))
        return part, keys[:count]


def _in_order(parts: list[tuple[PacketBatch, Integers]], places: list[int]) -> tuple[PacketBatch, Integers]:
    """Interleave batches by key; of equal keys the first batch comes first. Return each row's place, too."""
    origin = np.repeat(places, [len(keys) for _, keys in parts])
    if len(parts) == 1:
        return parts[0][0], origin
    order = np.argsort(np.concatenate([keys for _, keys in parts]), kind="stable")
    return concatenate([_trim(batch) for batch, _ in parts]).take(order), origin[order]


def _trim(batch: PacketBatch) -> PacketBatch:
    """Drop the bytes before and after those that the rows use, so that they are not copied."""
    at = int(min(batch.frame_offset.min(), batch.offset.min()))
    ends = (batch.frame_offset + batch.frame_length).max(), (batch.offset + batch.length).max()
    data = batch.data[at : int(max(ends)) + PADDING]
    return replace(batch, data=data, frame_offset=batch.frame_offset - at, offset=batch.offset - at)


_SECTION_HEADER = b"\x0a\x0d\x0d\x0a"
_MCAP = b"\x89MCAP0\r\n"
_DATABASE = b"SQLite f"
"""First bytes of a SQLite file: rosbag2's ``.db3`` storage."""
_COMPRESSED = {b"\x1f\x8b": "gzip", b"\x28\xb5\x2f\xfd": "zstd"}
_MODIFIED_PCAP = {b"\x34\xcd\xb2\xa1", b"\xa1\xb2\xcd\x34"}
_OTHERS = (
    (b"GMBU", "a Microsoft Network Monitor capture"),
    (b"RTSS", "a Microsoft Network Monitor capture"),
    (b"snoop\x00\x00\x00", "a snoop capture"),
    (b"#ROSBAG", "a ROS 1 bag"),
    (b"PK\x03\x04", "a zip archive"),
    (b"BZh", "bzip2 data"),
    (b"\xfd7zXZ\x00", "xz data"),
    (b"\x7fELF", "a program"),
)
"""First bytes of other files that users may try to open, and what those files are."""
_CONVERT = "captures can be made readable with: editcap -F pcapng IN OUT"


def open_file(path: str | Path, name: str = "") -> Source:
    """Open a capture or a recording by its content: pcap, pcapng or MCAP, perhaps with gzip or zstd.

    Args:
        path: a file, a named pipe, a rosbag2 directory, or ``-`` for standard input.
        name: the name in messages; by default the path.

    Raises:
        CaptureError: ``path`` cannot be read.
        NoDatagramsError: it is a recording of another tool, with topics only.
    """
    try:
        if os.path.isdir(path):  # noqa: PTH112  Path raises an error at a name that no file can have
            return _open_folder(Path(path))
        file = capture_file.FileStream(_open(path), name or str(path))
        with OnFailure(file.close):
            stream, head, wrapped = _unpacked(file)
            return _source(stream, path, head, wrapped)
    except NoDatagramsError as error:
        error.path = str(path)
        raise


def _open_folder(path: Path) -> Source:
    from edoras_tools.io.formats.rosbag2.reader import open_folder

    source = open_folder(path, open_file)
    if source is None and (path / "metadata.yaml").exists():
        raise CaptureError(f"{path}: the files that its metadata.yaml names are not there")
    if source is None:
        raise CaptureError(f"{path}: is a directory; name a capture in it, or a rosbag2 directory")
    return source


def is_cfe_file(path: Path) -> bool:
    """Return whether a regular file was written by cFE, so that its times are mission times."""
    if not path.is_file():
        return False
    with suppress(OSError), path.open("rb") as file:
        return file.read(len(CFE_MAGIC)) == CFE_MAGIC
    return False


def _unpacked(file: capture_file.FileStream) -> tuple[capture_file.ByteStream, bytes, str]:
    """Return the stream inside of gzip or zstd, its first bytes, which are read, and the compression."""
    head = _head(file)
    kind = next((kind for magic, kind in _COMPRESSED.items() if head.startswith(magic)), "")
    if not kind:
        return file, head, ""
    stream = capture_file.CompressedStream(file, kind, head)
    return stream, _head(stream), kind


def _source(stream: capture_file.ByteStream, path: str | Path, head: bytes, wrapped: str) -> Source:
    """Make the source of a stream; ``head`` is its first bytes, ``wrapped`` the compression it had."""
    whole_file = stream.total_bytes and not wrapped and str(path) != "-"  # as a file of that name
    if not head:
        problem = f"contains only an empty {wrapped} stream" if wrapped else "is empty"
        raise CaptureError(f"{stream.name}: {problem}; a capture has at least a header")
    if head[:4] in MAGICS:
        return PcapSource(capture_file.Window(stream, head))
    if head.startswith(_SECTION_HEADER):
        return table.PCAPNG.source()(capture_file.Window(stream, head))
    if head.startswith(CFE_MAGIC):
        return table.CFE.source()(capture_file.Window(stream, head))
    if head.startswith(_MCAP):
        return _mcap(stream, path, b"" if whole_file else head)
    if head.startswith(_DATABASE):
        raise _database(stream, path, b"" if whole_file else head)
    for item in table.installed_formats():
        if item.magic and head.startswith(item.magic):
            return item.source()(capture_file.Window(stream, head))
    raise CaptureError(f"{stream.name}: {_looks_like(head, wrapped)}")


def kept_recording(path: Path) -> capture_file.SettledFile | Source:
    """Return a recording from a pipe as a file that can be opened again, and a capture as a source.

    Raises:
        CaptureError: it cannot be read.
    """
    stream, head = unwrapped(path)
    if head.startswith((_MCAP, _DATABASE)):
        return capture_file.settled_file(stream, path, head)
    with OnFailure(stream.close):
        return _source(stream, path, head, "")


def unwrapped(path: Path) -> tuple[capture_file.ByteStream, bytes]:
    """Open a file or pipe; return its decompressed stream, and the first bytes, which are already read.

    Raises:
        CaptureError: it cannot be read.
    """
    file = capture_file.FileStream(_open(path), str(path))
    with OnFailure(file.close):
        stream, head, _ = _unpacked(file)
    return stream, head


def _mcap(stream: capture_file.ByteStream, path: str | Path, head: bytes) -> Source:
    """Open a recording; standard input and compressed data are copied first: the index is at the end.

    ``head`` is the bytes already read of a stream that has to be copied; else empty.
    """
    file = capture_file.settled_file(stream, Path(path), head)
    try:
        source: Source = table.MCAP.source()(file.path, file.name, file.copy)
    except NoDatagramsError as error:
        error.files = [file]
        raise
    return source


def _database(stream: capture_file.ByteStream, path: str | Path, head: bytes) -> NoDatagramsError:
    """Return the error for a database, which has no datagrams; ``head`` is as for ``_mcap``."""
    error = NoDatagramsError(
        f"{stream.name}: a database holds topics and no datagrams; {table.TOPIC_READERS}"
    )
    error.files = [capture_file.settled_file(stream, Path(path), head)]
    return error


def _open(path: str | Path) -> io.FileIO:
    if str(path) == "-":
        try:
            # A duplicate, so that closing the source does not close standard input.
            return io.FileIO(os.dup(sys.stdin.fileno()), "rb")
        except (AttributeError, OSError, ValueError) as error:
            raise CaptureError("-: there is no standard input; name a file") from error
    try:
        return io.FileIO(path, "rb")
    except FileNotFoundError as error:
        live = str(path) in {name for _, name in if_nameindex()}
        hint = f"for live traffic: -i {path}" if live else "check the name"
        raise CaptureError(f"{path}: there is no such file; {hint}") from error
    except PermissionError as error:
        raise CaptureError(f"{path}: may not be read by this user; check its permissions") from error
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise CaptureError(f"{path}: cannot be opened: {reason}") from error


def _head(stream: capture_file.ByteStream) -> bytes:
    """Read the bytes of the longest magic number; fewer at the end of the stream."""
    buffer = bytearray(table.LONGEST_MAGIC)
    filled = 0
    while filled < table.LONGEST_MAGIC and (count := stream.fill(memoryview(buffer)[filled:])):
        filled += count
    return bytes(buffer[:filled])


def _looks_like(head: bytes, wrapped: str) -> str:
    """Return what a file that is not a capture probably is, and what to do."""
    inside = f"{wrapped} data that contains " if wrapped else "looks like "
    can = f"{table.READABLE} can be read"
    if head[:4] in _MODIFIED_PCAP:
        return f"a modified pcap (magic {head[:4].hex()}), whose records differ from file to file; {_CONVERT}"
    for magic, likely in _OTHERS:
        if head.startswith(magic):
            return f"{inside}{likely}; {can}; {_CONVERT}"
    if len(head) < 4:
        return f"ends after {len(head)} bytes, before its format can be recognised; {can}"
    for magic, kind in _COMPRESSED.items():
        if head.startswith(magic):
            return f"{inside}{kind} data again; unpack it once"
    if all(byte in b"\t\n\r\x1b" or 32 <= byte < 127 for byte in head):
        return f"{inside}text; {can}"
    return f"is not a capture (it starts with {head.hex(' ')}); {can}"
