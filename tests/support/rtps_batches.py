"""Payloads as the datagrams of a batch."""

import numpy as np
from rtps import buffer

from edoras_tools.model import PacketBatch


def batch_of(*payloads, number=1):
    """Return payloads as the datagrams of a batch."""
    octets, offset, length = buffer(*payloads)
    count = len(payloads)
    zero = np.zeros(count, np.uint16)
    return PacketBatch(
        data=np.concatenate([octets, np.zeros(64, np.uint8)]),
        number=np.arange(number, number + count),
        time_ns=np.arange(count) * 10**6,
        link_type=zero + np.uint16(101),
        frame_offset=offset,
        frame_length=length,
        original_length=length,
        offset=offset,
        length=length,
        source_address=np.full(count, 0x7F000001, np.uint32),
        source_port=zero + np.uint16(40001),
        destination_address=np.full(count, 0x7F000001, np.uint32),
        destination_port=zero + np.uint16(40002),
        ip_version=zero.astype(np.uint8) + np.uint8(4),
        capture_findings=zero.astype(np.uint32),
    )
