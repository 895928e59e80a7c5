"""Messages of one kind in columns, and their record headers, from which chunks are made."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from edoras_tools.wire.arrays.window import copy_rows, put_rows

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from edoras_tools.wire.arrays.order import Integers, Octets


MAGIC: Final = b"\x89MCAP0\r\n"
"""The first and last bytes of a file."""
RECORD_PREFIX_BYTES: Final = 9
"""Bytes of a record that its length field does not count: the opcode, and the field itself."""
DATAGRAMS_TOPIC: Final = "/edoras/datagrams"
OUTAGE_METADATA_NAME: Final = "edoras_outage"
"""Name of the metadata records that are written when an interface goes away and when it returns."""
COUNTS_METADATA_NAME: Final = "edoras_counts"
"""Name of the metadata with the counts for ``info``, the version, and the covered bytes with their CRC-32."""
APART: Final = "/dds"
"""Prefix of a DDS topic that the mission has too, or that has two types, so that messages are not mixed."""


RECORD = [
    ("opcode", "u1"),
    ("record_length", "<u8"),
    ("channel_id", "<u2"),
    ("sequence", "<u4"),
    ("log_time", "<u8"),
    ("publish_time", "<u8"),
]
"""An MCAP Message record up to its data."""
RECORD_BYTES = np.dtype(RECORD).itemsize
OPCODE_MESSAGE = 0x05
CDR_LE_WORD = 0x00000100
"""The CDR encapsulation ``00 01 00 00`` (little-endian CDR, no options) as a little-endian u32."""

_WHOLE = np.dtype([*RECORD, ("encapsulation", "<u4")])


class Messages(msgspec.Struct, frozen=True, eq=False):
    """Messages of one kind in columns: a fixed head, then bytes from a buffer.

    Attributes:
        rows: row of the batch that each message belongs to, i64, increasing.
        channel_id: MCAP channel, one for each message or one for all.
        log_time: log time, i64, ns since 1970.
        head_bytes: bytes of a head.
        heads: function that returns the heads of a slice of the messages: records that begin with ``RECORD``,
            then the fixed bytes at the start of the message data. They are valid until the next call.
        data: buffer that ``offset`` points into, u8.
        offset: start of the rest of the message data, i64.
        length: bytes of this rest, integer; may be 0.
        repeats: whether ``rows`` may contain a row more than once.
    """

    rows: Integers
    channel_id: NDArray[np.uint16] | int
    log_time: Integers
    head_bytes: int
    heads: Callable[[slice], NDArray[Any]]
    data: Octets
    offset: Integers
    length: NDArray[np.integer[Any]]
    repeats: bool = False

    def __len__(self) -> int:
        return len(self.rows)


def whole_messages(
    rows: Integers,
    heads: NDArray[Any],
    channel_id: NDArray[np.uint16] | int,
    sequence: NDArray[np.integer[Any]] | int,
    log_time: Integers,
    publish_time: NDArray[np.integer[Any]],
    rest: tuple[Octets, Integers, NDArray[np.integer[Any]]] | None = None,
    *,
    repeats: bool = False,
) -> Messages:
    """Return messages with these heads; record headers, and the encapsulation if any, are filled in here.

    Args:
        rows: see ``Messages``, as for ``channel_id``, ``log_time`` and ``repeats``.
        heads: records that begin with ``RECORD``.
        sequence: sequence number, u32.
        publish_time: publish time, ns since 1970.
        rest: bytes after the heads: a buffer, the start of each part in it, and its length; None: nothing.
    """
    if rest is None:
        nothing = np.zeros(len(rows), np.int64)
        rest = np.zeros(1, np.uint8), nothing, nothing
    data, offset, length = rest
    heads["opcode"] = OPCODE_MESSAGE
    heads["record_length"] = length + (heads.itemsize - RECORD_PREFIX_BYTES)
    heads["channel_id"] = channel_id
    heads["sequence"] = sequence
    heads["log_time"] = log_time
    heads["publish_time"] = publish_time
    if "encapsulation" in (heads.dtype.names or ()):
        heads["encapsulation"] = CDR_LE_WORD
    return Messages(
        rows, channel_id, log_time, heads.itemsize, heads.__getitem__, data, offset, length, repeats
    )


def bodies_of(
    bodies: Sequence[bytes],
    times_ns: Sequence[int],
    channel_id: int,
    rows: Integers | None = None,
    *,
    repeats: bool = False,
) -> Messages:
    """Return whole messages from their bodies.

    Args:
        bodies: CDR, little-endian, without the encapsulation.
        times_ns: log and publish time of each, ns since 1970.
        rows: rows that they belong to; by default 0, 1, 2 and so on.
        repeats: see ``Messages``.
    """
    length = np.array([len(body) for body in bodies], dtype=np.int64)
    heads = np.zeros(len(bodies), dtype=_WHOLE)
    time_ns = np.array(times_ns, dtype=np.int64)
    rest = np.frombuffer(b"".join(bodies), dtype=np.uint8), np.cumsum(length) - length, length
    rows = np.arange(len(bodies)) if rows is None else rows
    return whole_messages(rows, heads, channel_id, 0, time_ns, time_ns, rest, repeats=repeats)


def no_messages(channel_id: int, head: np.dtype[np.void]) -> Messages:
    """Return no messages: most small batches have none of most kinds.

    Args:
        head: record type with which each message would begin.
    """
    nowhere = np.zeros(0, np.int64)
    return whole_messages(nowhere, np.zeros(0, head), channel_id, 0, nowhere, nowhere)


class Records(msgspec.Struct, frozen=True, eq=False):
    """Messages in sequence; arrays have one element a message.

    Attributes:
        channel_id: MCAP channel, u16.
        log_time: log time, u64, ns since 1970.
        start: start of the message data in ``data``, i64.
        end: offset after its last byte, i64.
        data: complete MCAP Message records.
    """

    channel_id: NDArray[np.uint16]
    log_time: NDArray[np.uint64]
    start: Integers
    end: Integers
    data: bytes

    def __len__(self) -> int:
        return len(self.start)


def lay_out(streams: Sequence[Messages], rows: int) -> Records:
    """Put messages of a batch one after the other: row by row, within a row in the order of ``streams``."""
    streams = [stream for stream in streams if len(stream)]
    total = np.zeros(rows, dtype=np.int64)
    within = [within_rows(stream, total) for stream in streams]
    ends = np.cumsum(total)
    starts = ends - total
    data = np.empty(int(ends[-1]) if rows else 0, dtype=np.uint8)
    count = sum(map(len, streams))
    channel_id, log_time = np.empty(count, np.uint16), np.empty(count, np.uint64)
    first, last = np.empty(count, np.int64), np.empty(count, np.int64)
    at = 0
    for stream, inside in zip(streams, within, strict=True):
        position = starts[stream.rows] + inside
        put_rows(data, position, stream.heads(slice(0, len(stream))))
        copy_rows(data, position + stream.head_bytes, stream.data, stream.offset, stream.length)
        these = slice(at, at + len(stream))
        channel_id[these], log_time[these] = stream.channel_id, stream.log_time
        first[these] = position + RECORD_BYTES
        last[these] = position + stream.head_bytes + stream.length
        at += len(stream)
    order = np.argsort(first, kind="stable")
    return Records(channel_id[order], log_time[order], first[order], last[order], data.tobytes())


def within_rows(stream: Messages, total: Integers) -> Integers:
    """Return each message's start in its row, after ``total`` bytes there; add its bytes to ``total``."""
    size = stream.head_bytes + stream.length.astype(np.int64)
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
