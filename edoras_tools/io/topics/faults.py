"""``/edoras/faults``: the faults that were injected, so that no analysis attributes them to the link."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Final

from edoras_tools.errors import WireError
from edoras_tools.io.topics.rows import Messages, bodies_of
from edoras_tools.links import table
from edoras_tools.sessions.faults.fault import Fault
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Sequence


FAULTS_TOPIC: Final = "/edoras/faults"
FAULTS_TYPE: Final = "edoras_msgs/msg/Fault"

_FIXED: Final = struct.Struct("<iIiB?2x")
"""stamp, msg_id, link, to_cfs, and the padding before the length of the first string."""


def fault_messages(faults: Sequence[Fault], channel_id: int) -> Messages:
    """Return one message per fault, each in its own row.

    Args:
        faults: with times in ns since 1970.
    """
    return bodies_of([_body(fault) for fault in faults], [fault.time_ns for fault in faults], channel_id)


def _body(fault: Fault) -> bytes:
    """Return a message's CDR without its encapsulation."""
    seconds, rest = divmod(fault.time_ns, SECOND)
    body = bytearray(_FIXED.pack(seconds, rest, fault.msg_id, fault.link, fault.to_cfs))
    for text in (fault.kind, fault.detail, fault.rule):
        data = text.encode(errors="replace") + b"\0"
        body += bytes(-len(body) % 4) + struct.pack("<I", len(data)) + data
    body += bytes(-len(body) % 4) + struct.pack("<I", len(fault.original)) + fault.original
    return bytes(body)


def fault_of(cdr: bytes) -> Fault:
    """Return the fault in a message.

    Args:
        cdr: the message, encapsulation included, as ``fault_messages`` writes it.

    Raises:
        WireError: the message is not one of these.
    """
    body = cdr[4:]
    try:
        seconds, rest, msg_id, link, to_cfs = _FIXED.unpack_from(body)
        at, parts = _FIXED.size, []
        for _ in range(4):
            at += -at % 4
            (length,) = struct.unpack_from("<I", body, at)
            parts.append(body[at + 4 : at + 4 + length])
            at += 4 + length
    except struct.error as error:
        raise WireError(f"{FAULTS_TOPIC}: a message of {len(cdr)} bytes ends too early") from error
    kind, detail, rule = (part.rstrip(b"\0").decode(errors="replace") for part in parts[:3])
    time_ns = seconds * SECOND + rest
    return Fault(time_ns, kind, detail, parts[3], table.link(link), to_cfs, msg_id, rule)
