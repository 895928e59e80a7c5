"""The ground bridge receives into 1024 bytes, then trusts buffer_length: longer telemetry becomes garbage."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.cfs.limits import BRIDGE_BUFFER
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links.to import TO
from edoras_tools.model import Finding

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "ground_bridge_buffer"


def judge(case: Case) -> Iterator[Verdict]:
    """Name every MsgId that the bridge publishes cut; housekeeping it does not publish at all."""
    rows = case.rows
    over = (rows.link == TO) & rows.has(Finding.OVER_BRIDGE_BUFFER) & (rows.space > 0)
    for msg_id in np.unique(rows.msg_id[over]).tolist():
        members = np.flatnonzero(over & (rows.msg_id == msg_id))
        of = int(((rows.link == TO) & (rows.msg_id == msg_id)).sum())
        yield Verdict(
            ID,
            Severity.ERROR,
            f"{len(members):,} of {of:,} messages on {case.name(msg_id)} are longer than the ground "
            f"bridge's {BRIDGE_BUFFER} bytes: it publishes what follows its buffer as garbage",
            msg_id=msg_id,
            topic=case.topic(msg_id),
            link="to",
            hop="ground bridge",
            lost=len(members),
            of=of,
            start_ns=int(rows.time_ns[members[0]]),
            end_ns=int(rows.time_ns[members[-1]]),
            evidence=(f"up to {int(rows.length[members].max()):,} bytes a datagram",),
            remedy=f"keep telemetry below {BRIDGE_BUFFER} bytes, or give the bridge a larger buffer",
            confidence="medium",
        )
