"""The messages of every datagram in a batch: the whole datagram, and the ROS message in it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np
from msgspec.structs import replace

from edoras_tools.io.topics.rows import (
    CDR_LE_WORD,
    OPCODE_MESSAGE,
    RECORD,
    RECORD_BYTES,
    RECORD_PREFIX_BYTES,
    Messages,
    whole_messages,
)
from edoras_tools.model import Columns, Finding, PacketBatch
from edoras_tools.wire.arrays.order import Integers, by_value

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from edoras_tools.mission import Route
    from edoras_tools.ros import TypeStore

NO_MESSAGE = Finding.CDR_INVALID | Finding.ENVELOPE_OVERRUN | Finding.TRUNCATED | Finding.CAPTURE_CUT
"""Findings of a datagram that contains no complete ROS message."""
_LONGER: Final = Finding.CDR_TRAILING | Finding.CDR_TOO_LONG

_MAPPED = 0xFFFF0000
"""Bytes 8 to 11 of an IPv4-mapped IPv6 address (RFC 4291 2.5.5.2), little-endian; all before are 0."""

DATAGRAM = np.dtype(
    [
        *RECORD,
        ("encapsulation", "<u4"),
        ("number", "<u8"),
        ("findings", "<u4"),
        ("original_length", "<u4"),
        ("msg_id", "<i4"),
        ("payload_offset", "<i4"),
        ("payload_length", "<u4"),
        ("link_type", "<u2"),
        ("source_port", "<u2"),
        ("destination_port", "<u2"),
        ("link", "u1"),
        ("ip_version", "u1"),
        ("source_zero", "<u8"),
        ("source_mapped", "<u4"),
        ("source_ipv4", ">u4"),
        ("destination_zero", "<u8"),
        ("destination_mapped", "<u4"),
        ("destination_ipv4", ">u4"),
        ("frame_length", "<u4"),
    ]
)
"""``edoras_msgs/msg/Datagram`` as a record, up to the bytes of its frame."""

_ADDRESS_BYTES = 16


class DatagramWriter:
    """Makes one ``edoras_msgs/msg/Datagram`` for every row."""

    def __init__(self, channel_id: int) -> None:
        self._channel_id = channel_id
        self._heads = self._blank(0)

    def messages(self, batch: PacketBatch, columns: Columns, published: Integers) -> Messages:
        """Return the messages of a batch; their heads are made when they are requested.

        Args:
            published: i64, publish time, ns since 1970.
        """
        rows = np.arange(len(batch))
        if (batch.original_length < 0).any():  # packets from inside of frames: only the frames are written
            rows = np.flatnonzero(batch.original_length >= 0)
            batch, columns, published = batch.take(rows), columns.take(rows), published[rows]

        def heads(part: slice) -> NDArray[Any]:
            return self._fill(batch.take(part), columns.take(part), published[part])

        return Messages(
            rows,
            self._channel_id,
            batch.time_ns,
            DATAGRAM.itemsize,
            heads,
            batch.data,
            batch.frame_offset,
            batch.frame_length,
        )

    def _blank(self, count: int) -> NDArray[Any]:
        """Return heads with the constant values; they are reused, so they stay in the processor's cache."""
        heads = np.zeros(count, dtype=DATAGRAM)
        heads["opcode"] = OPCODE_MESSAGE
        heads["channel_id"] = self._channel_id
        heads["encapsulation"] = CDR_LE_WORD
        heads["source_mapped"] = heads["destination_mapped"] = _MAPPED
        return heads

    def _fill(self, batch: PacketBatch, columns: Columns, published: Integers) -> NDArray[Any]:
        if len(self._heads) < len(batch):
            self._heads = self._blank(len(batch))
        heads = self._heads[: len(batch)]
        heads["record_length"] = batch.frame_length + np.int64(DATAGRAM.itemsize - RECORD_PREFIX_BYTES)
        heads["sequence"] = columns.sequence_count
        heads["log_time"] = batch.time_ns
        heads["publish_time"] = published
        heads["number"] = batch.number
        heads["findings"] = columns.findings | batch.capture_findings
        heads["original_length"] = batch.original_length
        heads["msg_id"] = columns.msg_id
        start = batch.offset - batch.frame_offset
        inside = (start >= 0) & (start + batch.length <= batch.frame_length)
        heads["payload_offset"] = np.where(inside, start, -1)
        heads["payload_length"] = batch.length
        heads["link_type"] = batch.link_type
        heads["source_port"] = batch.source_port
        heads["destination_port"] = batch.destination_port
        heads["link"] = columns.link
        heads["ip_version"] = batch.ip_version
        heads["frame_length"] = batch.frame_length
        heads["source_ipv4"] = batch.source_address
        heads["destination_ipv4"] = batch.destination_address
        rows = np.flatnonzero(batch.ip_version == 6)
        if len(rows):
            self._fill_ipv6(heads, batch, rows)
        return heads

    def _fill_ipv6(self, heads: NDArray[Any], batch: PacketBatch, rows: Integers) -> None:
        table = np.frombuffer(b"".join(batch.ipv6), dtype=f"V{_ADDRESS_BYTES}")
        places: Any = DATAGRAM.fields
        addresses = {"source_zero": batch.source_address, "destination_zero": batch.destination_address}
        for name, address in addresses.items():
            whole = heads.getfield(f"V{_ADDRESS_BYTES}", places[name][1])
            whole[rows] = table[address[rows]]
        # These values are no longer constant.
        self._heads = self._heads[:0]


def without_trailing(
    batch: PacketBatch, columns: Columns, types: TypeStore, routes: Sequence[Route]
) -> Columns:
    """Return the columns with CDR lengths that end at the message's last field.

    C++ and JavaScript readers ignore bytes after that field; rosbags rejects more than 3.
    """
    rows = np.flatnonzero((columns.route >= 0) & (columns.findings & np.uint32(_LONGER) != 0))
    if not len(rows):
        return columns
    length = columns.cdr_length.copy()
    for route, picked in by_value(columns.route[rows]):
        at = rows[picked]
        trailing = types.trailing(routes[route].type, batch.data, columns.cdr_offset[at], length[at])
        length[at] -= np.maximum(trailing, 0)
    return replace(columns, cdr_length=length)


def ros_messages(
    batch: PacketBatch, columns: Columns, channel_ids: NDArray[np.uint16], published: Integers
) -> Messages:
    """Return the ROS message of every row with a complete one on a configured topic, CDR as captured.

    Args:
        channel_ids: u16, MCAP channel of each of ``Mission.routes``.
        published: i64, publish time, ns since 1970.
    """
    findings = columns.findings | batch.capture_findings
    rows = np.flatnonzero(
        (columns.route >= 0) & (columns.cdr_length > 0) & (findings & np.uint32(NO_MESSAGE) == 0)
    )
    heads = np.empty(len(rows), dtype=np.dtype(RECORD))
    channel_id: NDArray[np.uint16] | int = channel_ids[columns.route[rows]] if len(rows) else 0
    rest = batch.data, columns.cdr_offset[rows], columns.cdr_length[rows]
    sequence, log_time = columns.sequence_count[rows], batch.time_ns[rows]
    return whole_messages(rows, heads, channel_id, sequence, log_time, published[rows], rest)


assert DATAGRAM.itemsize == RECORD_BYTES + 4 + 72
