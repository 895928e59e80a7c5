"""``/edoras/faults``: what was done to datagrams on purpose, so that no analysis blames the link for it."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.sinks.mcap_rows import ENCAPSULATION, RECORD, Messages, fill_record

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.sessions.faults import Fault

FAULTS_TOPIC: Final = "/edoras/faults"
FAULTS_TYPE: Final = "edoras_msgs/msg/Fault"

_HEAD: Final = np.dtype([*RECORD, ("encapsulation", "<u4")])
_FIXED: Final = struct.Struct("<iIiB?2x")
"""stamp, msg_id, link, to_cfs, and the padding before the length of the first string."""


def fault_messages(faults: Sequence[Fault], channel_id: int) -> Messages:
    """Return a message a fault, a row each.

    Args:
        faults: with times in ns since 1970.
        channel_id: MCAP channel.
    """
    bodies = [_body(fault) for fault in faults]
    length = np.array([len(body) for body in bodies], dtype=np.int64)
    heads = np.zeros(len(faults), dtype=_HEAD)
    time_ns = np.array([fault.time_ns for fault in faults], dtype=np.int64)
    fill_record(heads, channel_id, length, 0, time_ns, time_ns)
    heads["encapsulation"] = ENCAPSULATION
    pool = np.frombuffer(b"".join(bodies), dtype=np.uint8)
    rows = np.arange(len(faults))
    offset = np.cumsum(length) - length
    return Messages(rows, channel_id, time_ns, heads.itemsize, heads.__getitem__, pool, offset, length)


def _body(fault: Fault) -> bytes:
    """Return a message's CDR behind its encapsulation."""
    seconds, rest = divmod(fault.time_ns, 1_000_000_000)
    body = bytearray(_FIXED.pack(seconds, rest, fault.msg_id, fault.link, fault.to_cfs))
    for text in (fault.kind, fault.detail, fault.rule):
        data = text.encode(errors="replace") + b"\0"
        body += bytes(-len(body) % 4) + struct.pack("<I", len(data)) + data
    body += bytes(-len(body) % 4) + struct.pack("<I", len(fault.original)) + fault.original
    return bytes(body)
