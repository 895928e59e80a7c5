"""The record of an injected fault."""

from __future__ import annotations

from typing import NamedTuple

from edoras_tools.model import NO_MSG_ID, Link


class Fault(NamedTuple):
    """One fault of one datagram, as it is recorded.

    Attributes:
        time_ns: time at which the datagram came, on the caller's clock.
        kind: name of the kind, or ``overflow`` if ``HOLD_BYTES`` were exceeded.
        detail: description of the change.
        original: bytes of the datagram as it came.
        link: link of the datagram.
        to_cfs: whether it went to cFS.
        msg_id: its MsgId; ``NO_MSG_ID`` if it has none.
        rule: text of the rule.
        stream: number of the sender.
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
