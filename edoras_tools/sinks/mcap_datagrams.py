"""A batch to the messages every datagram makes: itself whole, and the ROS message inside it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from edoras_tools.model import Finding
from edoras_tools.sinks.mcap_rows import (
    ENCAPSULATION,
    OPCODE_MESSAGE,
    RECORD,
    RECORD_BYTES,
    Messages,
    fill_record,
)
from edoras_tools.wire.mcap import RECORD_PREFIX_BYTES

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.model import Columns, PacketBatch

NO_MESSAGE = Finding.CDR_INVALID | Finding.ENVELOPE_OVERRUN | Finding.TRUNCATED | Finding.CAPTURE_CUT
"""A datagram with any of these carries no whole ROS message."""

_MAPPED = 0xFFFF0000
"""Bytes 8 to 11 of an IPv4-mapped IPv6 address (RFC 4291 2.5.5.2), little-endian; all before are 0."""

_DATAGRAM = np.dtype(
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
    """Makes one ``edoras_msgs/msg/Datagram`` for every row.

    Args:
        channel_id: MCAP channel.
    """

    def __init__(self, channel_id: int) -> None:
        self._channel_id = channel_id
        self._heads = self._blank(0)

    def messages(self, batch: PacketBatch, columns: Columns, published: NDArray[np.int64]) -> Messages:
        """Return the messages of a batch; their heads are made when they are asked for.

        Args:
            batch: the datagrams.
            columns: of the same rows.
            published: i64, publish time, ns since 1970.
        """

        def heads(chosen: slice) -> NDArray[Any]:
            return self._fill(batch.take(chosen), columns.take(chosen), published[chosen])

        rows = np.arange(len(batch))
        return Messages(
            rows,
            self._channel_id,
            batch.time_ns,
            _DATAGRAM.itemsize,
            heads,
            batch.data,
            batch.frame_offset,
            batch.frame_length,
        )

    def _blank(self, count: int) -> NDArray[Any]:
        """Return heads with what is the same in all; being used again, they stay in the processor's cache."""
        heads = np.zeros(count, dtype=_DATAGRAM)
        heads["opcode"] = OPCODE_MESSAGE
        heads["channel_id"] = self._channel_id
        heads["encapsulation"] = ENCAPSULATION
        heads["source_mapped"] = heads["destination_mapped"] = _MAPPED
        return heads

    def _fill(self, batch: PacketBatch, columns: Columns, published: NDArray[np.int64]) -> NDArray[Any]:
        if len(self._heads) < len(batch):
            self._heads = self._blank(len(batch))
        heads = self._heads[: len(batch)]
        heads["record_length"] = batch.frame_length + np.int64(_DATAGRAM.itemsize - RECORD_PREFIX_BYTES)
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

    def _fill_ipv6(self, heads: NDArray[Any], batch: PacketBatch, rows: NDArray[np.int64]) -> None:
        table = np.frombuffer(b"".join(batch.ipv6), dtype=f"V{_ADDRESS_BYTES}")
        places: Any = _DATAGRAM.fields
        addresses = {"source_zero": batch.source_address, "destination_zero": batch.destination_address}
        for name, address in addresses.items():
            whole = heads.getfield(f"V{_ADDRESS_BYTES}", places[name][1])
            whole[rows] = table[address[rows]]
        # What was the same in all heads no longer is.
        self._heads = self._heads[:0]


def ros_messages(
    batch: PacketBatch, columns: Columns, channel_ids: NDArray[np.uint16], published: NDArray[np.int64]
) -> Messages:
    """Return the ROS message of every row that carries a whole one on a configured topic, CDR as captured.

    Args:
        batch: the datagrams.
        columns: of the same rows.
        channel_ids: u16, MCAP channel of each ``Mission.routes``.
        published: i64, publish time, ns since 1970.
    """
    findings = columns.findings | batch.capture_findings
    rows = np.flatnonzero(
        (columns.route >= 0) & (columns.cdr_length > 0) & (findings & np.uint32(NO_MESSAGE) == 0)
    )
    heads = np.empty(len(rows), dtype=np.dtype(RECORD))
    channel_id: NDArray[np.uint16] | int = channel_ids[columns.route[rows]] if len(rows) else 0
    length, log_time = columns.cdr_length[rows], batch.time_ns[rows]
    fill_record(heads, channel_id, length, columns.sequence_count[rows], log_time, published[rows])
    offset = columns.cdr_offset[rows]
    return Messages(rows, channel_id, log_time, RECORD_BYTES, heads.__getitem__, batch.data, offset, length)


assert _DATAGRAM.itemsize == RECORD_BYTES + 4 + 72
