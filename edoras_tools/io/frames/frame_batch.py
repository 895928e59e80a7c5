"""Chains of records, captured frames in columns, and frames made for payloads without headers.

``FrameBatch`` has the frames of a source; operations on them here do not depend on their content. A payload
that a socket received or a program made gets a frame by ``frames_of``. These frames are LINKTYPE_RAW, so that
the rest of the pipeline, and every reader of a capture written from them, sees the same as in a capture.
Lengths, addresses, ports and checksums are correct; fields that a socket does not know have default values
(identification 0, time to live 64).

Frames come in chains of records: the position of a record is known only from the length of the one before it.

pcap records, pcapng blocks, the packets of a TPACKET_V3 block and MCAP records are such chains.
``walk_records`` follows several parts of one chain at the same time: it starts at the one position known to
be a record and at *seeds*, positions that look like records, and moves all of them forward, with one numpy
operation for a step of each.
A part counts only if the proven chain reaches its seed, so the result is exactly that of walking from record
to record, whatever the payloads contain; a wrong seed costs time, but never gives a wrong result.
"""

from __future__ import annotations

import ipaddress
from bisect import bisect_left
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.wire.arrays import PADDING, Integers, Octets, Places, by_value, copy_rows, word_sums

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.model import Endpoint, PacketBatch

    _Successor = Callable[[Integers], Integers]
    """Returns the start of the record after each of some records."""


_LANES = 16
"""Fewest parts for which one step of all of them costs less than single steps."""
_BLOCK = 16
"""Number of steps between two checks of which parts have reached their limit."""


def walk_records(
    start: int, end: int, seeds: Integers, successor: _Successor, step: Callable[[int], int]
) -> tuple[Integers, int]:
    """Follow a chain of records from ``start`` as far as the records are complete.

    Args:
        start: position of the first record.
        end: one past the last available byte.
        seeds: increasing positions that may be records; optional, good ones make the walk fast.
        successor: returns the position of the record after each given one, never less than that; the given
            position itself if the chain cannot continue. Its arguments go up to ``end + 1``.
        step: the same function for a single position.

    Returns:
        The positions of all complete records (whose successor is not past ``end``), and the position where
        the walk stopped: ``end``, or the first record that is incomplete or cannot be passed.
    """
    seeds = seeds[(seeds > start) & (seeds < end)]
    starts = np.concatenate((np.array([start], dtype=np.int64), seeds))
    positions, counts, landings = _march(starts, np.append(seeds, end), end, successor)
    bases = np.cumsum(counts) - counts
    joined = landings[:-1] == starts[1:]
    if joined.all() and landings[-1] == end:
        return positions, end
    # The last part also ends with a break, because nothing follows it.
    breaks = np.append(np.flatnonzero(~joined), len(starts) - 1)
    begins = starts.tolist()
    pieces: list[Integers] = []
    lane = 0
    while True:
        last = int(breaks[np.searchsorted(breaks, lane)])
        pieces.append(positions[bases[lane] : bases[last] + counts[last]])
        position = int(landings[last])
        singles: list[int] = []
        while (lane := bisect_left(begins, position, last + 1)) == len(begins) or begins[lane] != position:
            after = step(position) if position < end else position
            if not position < after <= end:
                pieces.append(np.array(singles, dtype=np.int64))
                return np.concatenate(pieces), position
            singles.append(position)
            position = after
        pieces.append(np.array(singles, dtype=np.int64))


def _march(
    starts: Integers, limits: Integers, end: int, successor: _Successor
) -> tuple[Integers, Integers, Integers]:
    """Walk every part from its start up to its limit, all at the same time.

    Returns:
        The complete records below each part's limit, part by part; their number in each part; and the
        position where each part ended: at or past its limit, or before it if it could not continue or was
        left to single steps.
    """
    counts = np.zeros(len(starts), dtype=np.int64)
    landings = starts.copy()
    lanes = np.arange(len(starts))
    blocks = [np.empty(0, dtype=np.int64)]
    while len(lanes) >= _LANES:
        track = np.empty((_BLOCK + 1, len(lanes)), dtype=np.int64)
        track[0] = landings[lanes]
        for positions, following in pairwise(track):
            np.minimum(successor(positions), end + 1, out=following)
        positions, following = track[:-1], track[1:]
        whole = (positions < limits[lanes]) & (following > positions) & (following <= end)
        steps = whole.sum(axis=0)
        blocks.append(positions[whole])
        counts[lanes] += steps
        landings[lanes] = track[steps, np.arange(len(lanes))]
        lanes = lanes[steps == _BLOCK]
    # No part reaches into the next one, so sorting by position gives the order of the parts.
    # Blocks are runs, which a stable sort merges.
    return np.sort(np.concatenate(blocks), kind="stable"), counts, landings


LINKTYPE_RAW = 101
"""The packet starts with its IP header."""


class FrameBatch(msgspec.Struct, frozen=True, eq=False):
    """Captured frames in columns over one contiguous byte buffer; all arrays have the same length.

    Attributes:
        data: buffer, u8. ``PADDING`` bytes after the last frame should be readable; if not, it is copied.
        number: number of the frame in its source, i64, from 1.
        time_ns: capture time, i64, ns since 1970-01-01 UTC.
        link_type: pcap LINKTYPE, u16.
        offset: start of the frame in ``data``, i64.
        length: captured bytes, i32.
        original_length: bytes on the wire, i32. Values from 2 GiB on, which no frame has, become the largest
            i32; a negative value marks a row that was not captured.
    """

    data: Octets
    number: Integers
    time_ns: Integers
    link_type: NDArray[np.uint16]
    offset: Integers
    length: NDArray[np.int32]
    original_length: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.time_ns)

    def __post_init__(self) -> None:
        """Keep garbled lengths from being taken for rows that were not captured."""
        garbled = self.original_length < 0
        if garbled.any():
            self.original_length[garbled] = np.iinfo(np.int32).max


class MadeFrames(FrameBatch, frozen=True, eq=False):
    """Raw IPv4 frames made from datagrams; their headers need not be parsed again.

    Attributes:
        ends: endpoints of each datagram, ``ENDS``.
    """

    ends: NDArray[np.void]


def joined_frames(parts: Sequence[FrameBatch]) -> FrameBatch:
    """Join batches, at least one, into one with a padded buffer."""
    sizes = np.array([0, *(len(part.data) for part in parts)])
    columns = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in FrameBatch.__struct_fields__
        if name != "data"
    }
    columns["offset"] += np.repeat(np.cumsum(sizes)[:-1], [len(part) for part in parts])
    return FrameBatch(
        np.concatenate([*(part.data for part in parts), np.zeros(PADDING, np.uint8)]), **columns
    )


def packed_frames(frames: FrameBatch) -> FrameBatch:
    """Copy frames into a new buffer without gaps."""
    length = frames.length.astype(np.int64)
    offset = np.cumsum(length) - length
    data = np.zeros(int(length.sum()), np.uint8)
    copy_rows(data, offset, frames.data, frames.offset, length)
    return replace(frames, data=data, offset=offset)


def frames_at(frames: FrameBatch, rows: Integers | None) -> FrameBatch:
    """Return some frames, over the same buffer; None for all."""
    if rows is None:
        return frames
    return FrameBatch(
        frames.data, *(getattr(frames, name)[rows] for name in FrameBatch.__struct_fields__ if name != "data")
    )


def order_behind(count: int, row: Integers) -> Places:
    """Return an order, i64, that puts each further row after one of the first ``count`` rows.

    Args:
        count: number of the first rows, 0 to ``count`` - 1; the further rows follow.
        row: row after which each further row is put.
    """
    return np.argsort(np.concatenate([np.arange(count), row]), kind="stable")


def packets_behind(
    batch: PacketBatch, buffer: Octets, row: Integers, start: Integers, length: Integers
) -> PacketBatch:
    """Return a batch with packets inserted after the rows in which they end; their original length is -1.

    Args:
        buffer: bytes that the packets point into, u8.
        row: row in which each packet ends.
        start: start of each packet in the buffer.
        length: bytes of each packet.
    """
    if not len(row):
        return batch
    count = len(batch)
    order = order_behind(count, row)
    own = order >= count
    place = order[own] - count
    out = batch.take(np.concatenate([np.arange(count), row])[order])
    out.frame_length[own] = out.capture_findings[own] = 0
    out.original_length[own] = -1
    if out.streams is not None:
        out.streams[own] = False
    out.offset[own] = len(batch.data) + start[place]
    out.length[own] = length[place]
    return replace(out, data=np.concatenate([batch.data, buffer]))


ENDS: Final = np.dtype(
    [
        ("version", "u1"),
        ("source", "u1", 16),
        ("destination", "u1", 16),
        ("source_port", "u2"),
        ("destination_port", "u2"),
    ]
)
"""Source and destination: IP version, addresses (for IPv4 the first 4 bytes), UDP ports."""
_ENDS_COPIED: Final = np.dtype(f"V{ENDS.itemsize}")
"""``ENDS`` without its fields, because numpy copies it ten times as fast."""
_UDP_BYTES: Final = 8
_HEADER_BYTES: Final = np.array([0, 0, 0, 0, 20 + _UDP_BYTES, 0, 40 + _UDP_BYTES], np.int64)
"""Bytes of the headers before each payload, by IP version."""
HEADER_BYTES: Final = 40 + _UDP_BYTES + 2
"""Maximum bytes that a page needs for a datagram besides its payload."""
_COLUMNS: Final = ("time_ns", "_offset", "_length", "_ends")
"""The arrays of a page with an element for each datagram."""
_TIME_TO_LIVE: Final = 64
_LARGEST: Final = 65535
"""Most bytes of a frame whose header can hold its length."""
_UDP: Final = 17
_LEAST_ROWS: Final = 16
_LEAST_BYTES: Final = 1 << 12
_ROWS: Final = 256
_BYTES: Final = 1 << 16


def ends_of(source: Endpoint, destination: Endpoint) -> NDArray[np.void]:
    """Return two endpoints as a value of ``ENDS``; if only one is IPv6, the other is mapped to IPv6."""
    addresses = [ipaddress.ip_address(item.address.partition("%")[0]) for item in (source, destination)]
    version = max(item.version for item in addresses)
    ends = np.zeros((), ENDS)
    ends["version"], ends["source_port"], ends["destination_port"] = version, source.port, destination.port
    for name, address in zip(("source", "destination"), addresses, strict=True):
        mapped = address if address.version == version else ipaddress.ip_address(f"::ffff:{address}")
        ends[name][: len(mapped.packed)] = list(mapped.packed)
    return ends


class FramePage:
    """Payloads with space for headers before each of them; the headers of all are written at once.

    Args:
        rows: initial capacity in datagrams; it grows by copying.
        size: initial capacity in bytes; it grows by copying.

    Attributes:
        rows: number of datagrams.
        used: number of their bytes, headers included.
        time_ns: time of each, i64, ns since 1970; the first ``rows`` elements are valid.
    """

    def __init__(self, rows: int = _ROWS, size: int = _BYTES) -> None:
        self.rows = self.used = 0
        self.time_ns = np.empty(rows, np.int64)
        self._data = np.zeros(size + PADDING, np.uint8)
        self._offset = np.empty(rows, np.int64)
        self._length = np.empty(rows, np.int32)
        self._ends = np.empty(rows, _ENDS_COPIED)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for ``pickle``, without unused space."""
        state = dict(vars(self))
        for name in _COLUMNS:
            state[name] = state[name][: self.rows]
        return {**state, "_data": self._data[: self.used + PADDING]}

    @property
    def size(self) -> int:
        """Allocated bytes for payloads and headers."""
        return len(self._data)

    def add(
        self,
        data: Octets,
        start: Integers,
        length: NDArray[np.integer[Any]],
        time_ns: Integers,
        ends: NDArray[np.void],
    ) -> None:
        """Copy payloads.

        Args:
            data: contiguous buffer that contains the payloads, u8.
            start: start of each payload, i64 (n,).
            length: bytes of each payload, integer (n,).
            time_ns: time of each, i64 (n,), ns since 1970.
            ends: endpoints, ``ENDS``: one for all, or (n,).
        """
        header = _HEADER_BYTES[ends["version"]]
        stride = (header + length + 2) & ~1  # the next one starts at an even offset, after a zero byte
        stop = self.used + np.cumsum(stride)
        rows = slice(self.rows, self.rows + len(length))
        used = int(stop[-1]) if len(length) else self.used
        self._reserve(rows.stop, used)
        offset = stop - stride
        copy_rows(self._data, offset + header, data, start, length)
        self._offset[rows], self._length[rows], self.time_ns[rows] = offset, length, time_ns
        self._ends[rows] = ends.view(_ENDS_COPIED)
        self.rows, self.used = rows.stop, used

    def part(self, rows: Integers) -> FramePage:
        """Return a page of some rows, in this order."""
        if not len(rows):
            return FramePage(max(self.rows, _LEAST_ROWS), max(self.used, _LEAST_BYTES))
        page, ends = FramePage(), self._ends[rows].view(ENDS)
        start = self._offset[rows] + _HEADER_BYTES[ends["version"]]
        page.add(self._data, start, self._length[rows], self.time_ns[rows], ends)
        return page

    def frames(self, number: int, rows: Integers | None = None) -> FrameBatch:
        """Write the headers; return frames over the page's own bytes.

        Args:
            number: number of the first frame.
            rows: datagrams to take, in this order; None for all.
        """
        selection = slice(0, self.rows) if rows is None else rows
        data, ends = self._data[: self.used + PADDING], self._ends[selection].view(ENDS)
        offset, length = self._offset[selection], self._length[selection]
        for version, of in by_value(ends["version"]):
            one = len(of) == len(offset)
            _write_headers(
                data, version, *((offset, length, ends) if one else (offset[of], length[of], ends[of]))
            )
        whole = length + _HEADER_BYTES[ends["version"]].astype(np.int32)
        columns = (
            data,
            np.arange(number, number + len(offset), dtype=np.int64),
            self.time_ns[selection],
            np.full(len(offset), LINKTYPE_RAW, np.uint16),
            offset,
            whole,
            whole,
        )
        readable = len(offset) and int(whole.max()) <= _LARGEST and (ends["version"] == 4).all()
        return MadeFrames(*columns, ends) if readable else FrameBatch(*columns)

    def _reserve(self, rows: int, size: int) -> None:
        """Make space for this total number of rows and bytes."""
        if size > len(self._data) - PADDING:
            self._data = _grown(self._data, self.used, max(size, 2 * self.used) + PADDING)
        if rows > len(self.time_ns):
            more = max(rows, 2 * self.rows)
            for name in _COLUMNS:
                setattr(self, name, _grown(getattr(self, name), self.rows, more))


def frames_of(datagrams: Iterable[tuple[int, Endpoint, Endpoint, bytes]], number: int = 1) -> FrameBatch:
    """Make frames of datagrams one by one, for small numbers of them.

    Args:
        datagrams: time in ns since 1970, source, destination and payload of each.
        number: number of the first frame.
    """
    times, sources, destinations, payloads = zip(*datagrams, strict=True)
    by_pair: dict[tuple[Endpoint, Endpoint], NDArray[np.void]] = {}
    pairs = list(zip(sources, destinations, strict=True))
    for pair in pairs:
        if pair not in by_pair:
            by_pair[pair] = ends_of(*pair)
    length = np.array([len(item) for item in payloads], np.int64)
    page = FramePage(len(length), int(length.sum()) + len(length) * HEADER_BYTES)
    page.add(
        np.frombuffer(b"".join(payloads) + bytes(PADDING), np.uint8),
        np.cumsum(length) - length,
        length,
        np.array(times, np.int64),
        np.array([by_pair[pair] for pair in pairs], ENDS),
    )
    return page.frames(number)


def _write_headers(
    data: Octets, version: int, offset: Integers, length: NDArray[np.int32], ends: NDArray[np.void]
) -> None:
    """Write the headers before some payloads (RFC 791, RFC 8200, RFC 768).

    Args:
        data: buffer, u8; it has each payload after the room for its headers, and a zero byte after the
            payload.
        version: IP version, 4 or 6.
        offset: start of each frame; even.
        length: bytes of each payload.
        ends: endpoints, ``ENDS``, all of this version.
    """
    whole = int(_HEADER_BYTES[version])
    size = whole - _UDP_BYTES
    header = np.zeros((len(offset), whole), dtype=np.uint8)
    if version == 4:
        header[:, 0] = 0x45
        put_words(header, 2, whole + length)
        header[:, 8] = _TIME_TO_LIVE
        header[:, 9] = _UDP
        addresses = 12
    else:
        header[:, 0] = 0x60
        put_words(header, 4, _UDP_BYTES + length)
        header[:, 6] = _UDP
        header[:, 7] = _TIME_TO_LIVE
        addresses = 8
    width = (size - addresses) // 2
    header[:, addresses : addresses + width] = ends["source"][:, :width]
    header[:, addresses + width : size] = ends["destination"][:, :width]
    put_words(header, size, ends["source_port"])
    put_words(header, size + 2, ends["destination_port"])
    put_words(header, size + 4, _UDP_BYTES + length)
    if version == 4:
        put_words(header, 10, internet_checksum(words_of(header[:, :size]).sum(axis=1)))
    # The UDP checksum covers addresses, protocol and UDP length, then header and payload (RFC 768).
    total = words_of(header[:, addresses:]).sum(axis=1) + _UDP + _UDP_BYTES + length
    checksum = internet_checksum(total + word_sums(data, offset + whole, length))
    put_words(header, size + 6, np.where(checksum == 0, 0xFFFF, checksum))
    data[offset[:, None] + np.arange(whole)] = header


def _grown(array: NDArray[Any], used: int, size: int) -> NDArray[Any]:
    """Return a larger copy; the new part is zero."""
    larger = np.zeros(size, array.dtype)
    larger[:used] = array[:used]
    return larger


def put_words(header: Octets, at: int, values: NDArray[Any]) -> None:
    """Write a column of 16-bit fields, big-endian."""
    header[:, at : at + 2] = values.astype(">u2").view(np.uint8).reshape(-1, 2)


def words_of(header: Octets) -> Integers:
    """Read rows of bytes as rows of big-endian 16-bit words."""
    return np.ascontiguousarray(header).view(">u2").astype(np.int64)


def internet_checksum(total: Integers) -> Integers:
    """Fold sums into the Internet checksum (RFC 1071)."""
    total = (total & 0xFFFF) + (total >> 16)
    total = (total & 0xFFFF) + (total >> 16)
    return ~total & 0xFFFF
