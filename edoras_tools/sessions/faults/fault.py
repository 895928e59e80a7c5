"""What a fault is, for those who record or read one."""

from __future__ import annotations

from typing import NamedTuple

from edoras_tools.model import NO_MSG_ID, Link


class Fault(NamedTuple):
    """One fault of one datagram, as it is recorded.

    Attributes:
        time_ns: when the datagram came, on the caller's clock.
        kind: name of the kind, or ``overflow`` where ``HOLD_BYTES`` were exceeded.
        detail: what was done.
        original: the datagram as it came.
        link: which link it was on.
        to_cfs: which way it went.
        msg_id: its MsgId; ``NO_MSG_ID`` where it has none.
        rule: the rule, as it was written.
        stream: as it was given with the datagram.
    """

    time_ns: int
    kind: str
    detail: str
    original: bytes
    link: Link
    to_cfs: bool
    msg_id: int = NO_MSG_ID
    rule: str = ""
    stream: int = 0
