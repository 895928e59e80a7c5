"""The public flight bridge keeps a received length in 8 bits: below 11 modulo 256 it drops the datagram."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links.sbn import SBN
from edoras_tools.model import Finding
from edoras_tools.wire import sbn

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "flight_bridge_length"


def judge(case: Case) -> Iterator[Verdict]:
    """Name every MsgId whose messages have such a length."""
    rows = case.rows
    whole = (rows.link == SBN) & (rows.sbn_msg_type == sbn.MsgType.APP)
    dropped = whole & rows.has(Finding.BRIDGE_DROPS_LENGTH)
    for msg_id in np.unique(rows.msg_id[dropped]).tolist():
        members = np.flatnonzero(dropped & (rows.msg_id == msg_id))
        towards = int(rows.destination[members[0]])
        of = int((whole & (rows.msg_id == msg_id) & (rows.destination == towards)).sum())
        sizes = ", ".join(str(size) for size in np.unique(rows.length[members])[:4].tolist())
        yield Verdict(
            ID,
            Severity.ERROR,
            f"{len(members):,} of {of:,} messages on {case.name(msg_id)} have a length that the public "
            "flight bridge drops: it keeps it in 8 bits, and below 11 is no header",
            msg_id=msg_id,
            topic=case.topic(msg_id),
            link="sbn",
            hop="flight bridge",
            lost=len(members),
            of=of,
            start_ns=int(rows.time_ns[members[0]]),
            end_ns=int(rows.time_ns[members[-1]]),
            evidence=(f"datagrams of {sizes} bytes to {case.endpoints[towards]}",),
            remedy="pad the flight struct by 11 bytes or more, or keep the length in a size_t in the bridge",
            confidence="medium",
        )
