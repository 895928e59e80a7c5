"""Repairs damaged files: recordings by ``mcap.recover``, captures, and databases of rosbag2.

A repaired capture keeps all bytes except those in which no record can be read. Captures have no checksums.

A database is read page by page, because SQLite itself stops at the first damaged page: a row is kept if
it is complete and has the columns of its table (https://sqlite.org/fileformat2.html). The result is MCAP.
"""

from __future__ import annotations

import re
import struct
from array import array
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from itertools import pairwise
from typing import IO, TYPE_CHECKING, Any, Final

import numpy as np
from mcap.opcode import Opcode
from msgspec.structs import replace

from edoras_tools.errors import CaptureError, ConfigError, os_errors
from edoras_tools.io.formats.capture_file import Window
from edoras_tools.io.formats.mcap.chunks import CHUNK_BYTES
from edoras_tools.io.formats.mcap.file import MESSAGE_HEAD, RECORD_HEAD, McapFile
from edoras_tools.io.formats.mcap.recover import Recording, add_chunk, read_again
from edoras_tools.io.formats.mcap.recovery.records import FileBytes, KnownTopics, walk
from edoras_tools.io.formats.mcap.recovery.report import LostStretch, Recovery
from edoras_tools.io.formats.open import unwrapped
from edoras_tools.io.formats.pcap import MAGICS, PcapSource
from edoras_tools.io.formats.pcapng import PcapngSource
from edoras_tools.io.formats.rosbag2.reader import query
from edoras_tools.io.outputs import NewFile

if TYPE_CHECKING:
    from pathlib import Path

    Progress = Callable[[int, int], None]

_OPENINGS: Final = {
    "pcap": [struct.pack(f"{order}IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 262144, 1) for order in "<>"],
    "pcapng": [
        struct.pack("<IIIHHqI", 0x0A0D0D0A, 28, 0x1A2B3C4D, 1, 0, -1, 28)
        + struct.pack("<IIHHII", 1, 20, 1, 0, 262144, 20)
    ],
}
"""Headers to try for a capture whose own header cannot be read."""
_LARGEST: Final = 256 << 20
"""Most bytes of a row."""
_LEAF: Final = 0x0D
_INTEGERS: Final = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8}
"""Bytes of an integer, by its serial type."""


def repairable_as(path: Path) -> str:
    """Return the format of a file, from its first bytes, else from its name: mcap, pcap, pcapng or db3.

    Raises:
        CaptureError: it cannot be read.
    """
    stream, head = unwrapped(path)
    stream.close()
    magics = {b"\x89MCAP0\r\n": "mcap", b"\x0a\x0d\x0d\x0a": "pcapng", b"SQLite f": "db3"}
    magics |= dict.fromkeys(MAGICS, "pcap")
    kind = next((kind for magic, kind in magics.items() if head.startswith(magic)), "")
    names = {".pcapng": "pcapng", ".pcap": "pcap", ".cap": "pcap", ".db3": "db3"}
    return kind or next((names[suffix] for suffix in reversed(path.suffixes) if suffix in names), "mcap")


def repair(
    source: Path,
    target: Path | None,
    *,
    topics: KnownTopics | None = None,
    unproved: bool = False,
    progress: Progress = lambda *_: None,
) -> Recovery:
    """Repair a damaged or cut-off file.

    Args:
        source: the file; it is only read.
        target: the file to write; it appears when it is complete, and only if ``source`` is not intact.
            None: only report what can be recovered.
        topics: topics of a recording of ours whose channel records are lost.
        unproved: also keep readable messages of damaged and cut-off chunks.
        progress: called with the bytes read and the bytes in total; each further reading starts again.

    Returns:
        The report.

    Raises:
        CaptureError: ``source`` cannot be read or contains nothing to recover, or ``target`` cannot be
            written.
        ConfigError: ``target`` is ``source``.
    """
    topics, kind = topics or KnownTopics(), repairable_as(source)
    if target is not None and target.exists() and target.samefile(source):
        raise ConfigError(f"{target}: is the recording itself; name another file to write")
    recording: Recording | _Database | _Capture
    if kind in _OPENINGS:
        recording = _Capture(source, kind)
    else:
        recording = (_Database if kind == "db3" else Recording)(source, topics, unproved)
    report = recording.report(progress)
    if not sum(report.messages.values()) and not report.whole:
        raise CaptureError(f"{source}: it contains nothing to recover")
    if target is None or report.whole:
        return report
    with os_errors(f"{target}: cannot be written"):
        new = NewFile(target)
        try:
            report = recording.write(new, progress)
            new.keep()
        except CaptureError as error:
            text = str(error).partition("; `edoras")[0].replace(str(new.place), str(target))
            raise CaptureError(text) from error
        finally:
            new.remove()
    return report


class _Capture:
    """A pcap or pcapng file, possibly compressed; the result is uncompressed."""

    def __init__(self, path: Path, kind: str) -> None:
        self._path, self._kind, self._opening = path, kind, b""

    def report(self, progress: Progress) -> Recovery:
        """Read the whole file, with an assumed header if its own cannot be read."""
        with suppress(CaptureError, KeyError):  # its header cannot be read
            if (report := self._read(progress)).whole or report.messages["packets"]:
                return report
        reports: dict[bytes, Recovery] = {}
        for opening in _OPENINGS[self._kind]:
            self._opening = opening
            reports[opening] = self._read(progress)
        self._opening, report = max(reports.items(), key=lambda item: item[1].messages["packets"])
        # The bytes behind an assumed header always look like one record.
        return report if report.messages["packets"] > 1 else replace(report, messages={})

    def write(self, new: NewFile, progress: Progress) -> Recovery:
        """Read the whole file again, write all that can be read, and check the result by reading it."""
        report = self._read(progress, new.file)
        new.file.flush()
        if new.regular:
            again = _Capture(new.place, self._kind).report(lambda *_: None)
            if not again.whole or again.messages != report.messages:
                return replace(
                    report, reasons=[*report.reasons, "of the result: it is not read as it was written"]
                )
        return report

    def _read(self, progress: Progress, file: IO[bytes] | None = None) -> Recovery:
        stream, head = unwrapped(self._path)
        failure = None
        with closing(stream):
            reader = PcapSource if self._kind == "pcap" else PcapngSource
            window = Window(stream, self._opening + head)
            source = reader(window)
            if file is not None:
                source.keep = file.write
            try:
                for _ in source.batches():
                    progress(stream.position, stream.total_bytes or stream.position)
            except CaptureError as error:
                failure = error
            size = window.base + window.end - len(self._opening)
        losses = [
            LostStretch(
                item.start - len(self._opening),
                item.end - item.start,
                re.sub(r" at byte \d+", "", item.reason),
                None,
                item.before_ns,
                item.after_ns,
            )
            for item in source.left_out
        ]
        reasons = (
            ["its header cannot be read: Ethernet, and microseconds, are assumed"] if self._opening else []
        )
        if failure is not None and not losses:
            reasons.append(str(failure).removeprefix(f"{self._path}: "))
        return _report({"packets": source.statistics.frames}, size, losses, reasons, "packets")


def _report(
    messages: dict[str, int], size: int, losses: list[LostStretch], reasons: list[str], unit: str = "messages"
) -> Recovery:
    """Return the report on a file of ``size`` bytes without checksums; whole if nothing is wrong with it."""
    whole, lost = not losses and not reasons, sum(item.bytes for item in losses)
    return Recovery(
        whole=whole,
        messages=messages,
        kept_bytes=size - lost,
        lost_bytes=lost,
        unproved=sum(messages.values()),
        lost=not whole,
        lost_messages=0 if whole else None,
        losses=losses,
        reasons=reasons,
        unit=unit,
    )


class _Database:
    """One file of a rosbag2 recording in SQLite."""

    def __init__(self, path: Path, topics: KnownTopics, unproved: bool) -> None:
        self._path, self._known, self._unproved = path, topics, unproved
        self._topics: dict[int, tuple[str, ...]] = {}
        self._texts: dict[str, tuple[str, str]] = {}
        self._rows = array("q")
        """Number, page, time and topic of each message, four i64 each, in the order of the pages."""

    def report(self, progress: Progress) -> Recovery:
        """Read all pages; the file is whole if SQLite finds it intact and all its rows were read."""
        with FileBytes(self._path) as file:
            for page, number, values in _rows(file, progress, self._unproved):
                match values:
                    case None, int() as topic, int() as time_ns, bytes():
                        self._rows.extend((number, page, time_ns, topic))
                    case None, str() as name, str(), str(), *_ if name.startswith("/"):
                        self._topics.setdefault(number, tuple(map(str, values[1:])))
                    case None, str() as name, str() as encoding, str() as text, *_:
                        self._texts[name] = encoding, text
            size, page_size = file.size, _page_size(file)
        rows = np.frombuffer(self._rows, np.int64).reshape(-1, 4)
        _, self._first = np.unique(rows[:, 0], return_index=True)
        rows = rows[self._first]
        whole = False
        with suppress(CaptureError):
            sound = next(query(self._path, "PRAGMA quick_check(1)", ()))[0] == "ok"
            whole = sound and next(query(self._path, "SELECT count(*) FROM messages", ()))[0] == len(rows)
        losses = [
            LostStretch(
                int(before[1]) * page_size,
                max(int(after[1]) - int(before[1]), 1) * page_size,
                "rows are missing",
                int(after[0] - before[0] - 1),
                int(before[2]),
                int(after[2]),
            )
            for before, after in pairwise(rows)
            if after[0] > before[0] + 1
        ]
        counts = Counter(self._name(topic) for topic in rows[:, 3].tolist())
        reasons = ["SQLite finds it damaged, or it ends too early: what followed is unknown"]
        self._report = _report(dict(counts), size, *(([], []) if whole else (losses, reasons)))
        return self._report

    def _name(self, topic: int) -> str:
        return self._topics[topic][0] if topic in self._topics else f"/unknown/{topic}"

    def write(self, new: NewFile, progress: Progress) -> Recovery:
        """Write an MCAP file of the messages, and read it again."""
        out, channels, chunks = McapFile(new.place), dict[int, int](), bytearray()
        places = set(self._first.tolist())
        place = -1
        with FileBytes(self._path) as file:
            for _, _, values in _rows(file, progress, self._unproved):
                match values:
                    case None, int() as topic, int() as time_ns, bytes() as data:
                        place += 1
                        if place in places:
                            if topic not in channels:
                                channels[topic] = self._channel(out, topic)
                            head = MESSAGE_HEAD.pack(channels[topic], 0, time_ns, time_ns)
                            chunks += RECORD_HEAD.pack(Opcode.MESSAGE, len(head) + len(data)) + head + data
                if len(chunks) >= CHUNK_BYTES:
                    add_chunk(out, walk(bytes(chunks)), proved=False)
                    chunks = bytearray()
        if chunks:
            add_chunk(out, walk(bytes(chunks)), proved=False)
        out.finish()
        report = replace(self._report, chunks=out.summary.chunks)
        return read_again(new.place, report) if new.regular else report

    def _channel(self, out: McapFile, topic: int) -> int:
        name, kind, encoding, qos, *_ = (*self._topics.get(topic, (self._name(topic), "", "")), "")
        text = self._texts.get(kind) or ("ros2msg", self._known.definition(kind))
        schema = out.add_schema(kind, text[1], text[0]) if kind else 0
        return out.add_channel(name, schema, {"offered_qos_profiles": qos}, encoding)


def _page_size(file: FileBytes) -> int:
    size = int.from_bytes(file.read(16, 18), "big")
    return 65536 if size == 1 else size if size >= 512 and not size & (size - 1) else 4096


def _rows(file: FileBytes, progress: Progress, zeros: bool) -> Iterator[tuple[int, int, list[Any]]]:
    """Yield the page, the row number and the values of every readable row of every table.

    Args:
        zeros: accept a page of zeros as a part of a row: it may be one, or its content may be lost.
    """
    size = _page_size(file)
    usable = size - (file.read(20, 21) or b"\0")[0]
    for number in range(-(-file.size // size)):
        page, first = file.read(number * size, (number + 1) * size), 0 if number else 100
        progress(min((number + 1) * size, file.size), file.size)
        if len(page) < first + 8 or page[first] != _LEAF:
            continue
        count = int.from_bytes(page[first + 3 : first + 5], "big")
        for place in range(first + 8, min(first + 8 + 2 * count, len(page) - 1), 2):
            with suppress(IndexError, ValueError):  # the page is damaged
                at = int.from_bytes(page[place : place + 2], "big")
                length, at = _varint(page, at)
                row, at = _varint(page, at)
                yield number, row, _values(_payload(file, page[at:], length, usable, zeros))


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = 0
    for place in range(at, at + 8):
        value = value << 7 | data[place] & 0x7F
        if data[place] < 0x80:
            return value, place + 1
    return value << 8 | data[at + 8], at + 9


def _payload(file: FileBytes, page: bytes, length: int, usable: int, zeros: bool) -> bytes:
    """Return the bytes of a row, including those in overflow pages.

    Raises:
        ValueError: some of them are missing.
    """
    if length > min(_LARGEST, file.size):
        raise ValueError(length)
    local = length
    if length > usable - 35:
        least = (usable - 12) * 32 // 255 - 23
        local = least + (length - least) % (usable - 4)
        local = local if local <= usable - 35 else least
    size = _page_size(file)
    pieces = [page[:local]]
    after = int.from_bytes(page[local : local + 4], "big") if local < length else 0
    rest = length - local
    while rest > 0 and after:
        piece = file.read((after - 1) * size, (after - 1) * size + usable)
        if not zeros and not any(piece):
            raise ValueError(after)
        pieces.append(piece[4 : 4 + rest])
        rest -= usable - 4
        after = int.from_bytes(piece[:4], "big")
    data = b"".join(pieces)
    if len(data) != length or after:
        raise ValueError(length)
    return data


def _values(data: bytes) -> list[Any]:
    """Read a row: NULL as None, integers, texts and bytes.

    Raises:
        ValueError: the bytes are not a row.
        IndexError: the bytes end too early.
    """
    body, at = _varint(data, 0)
    values: list[Any] = []
    place = body
    while at < body:
        kind, at = _varint(data, at)
        size = _INTEGERS.get(kind, (kind - 12) // 2 if kind >= 12 else 0)
        piece = data[place : place + size]
        place += size
        if kind in {0, 8, 9}:
            values.append(None if kind == 0 else kind - 8)
        elif kind in _INTEGERS:
            values.append(int.from_bytes(piece, "big", signed=True))
        elif kind >= 12:
            values.append(piece.decode() if kind % 2 else piece)
        else:
            raise ValueError(kind)
    if at != body or place != len(data):
        raise ValueError(place)
    return values
