"""Bytes of an earlier, longer message stand behind the CDR: readers ignore them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links.ci import CI
from edoras_tools.links.sbn import SBN
from edoras_tools.links.to import TO
from edoras_tools.model import Finding

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "stale_tail"


def judge(case: Case) -> Iterator[Verdict]:
    """Name each MsgId that has them, as harmless."""
    rows = case.rows
    stale = rows.has(Finding.STALE_TAIL) & (rows.space > rows.cdr_length)
    for link in (CI, TO, SBN):
        for msg_id in np.unique(rows.msg_id[stale & (rows.link == link)]).tolist():
            members = np.flatnonzero(stale & (rows.link == link) & (rows.msg_id == msg_id))
            of = int(((rows.link == link) & (rows.msg_id == msg_id)).sum())
            first = int(members[0])
            tail = int(rows.space[first] - rows.cdr_length[first])
            yield Verdict(
                ID,
                Severity.NOTE,
                f"{len(members):,} of {of:,} messages on {case.name(msg_id)} carry bytes of an earlier, "
                "longer message behind their CDR: harmless, readers stop where the envelope says",
                msg_id=msg_id,
                topic=case.topic(msg_id),
                link=link.label,
                hop="flight application",
                start_ns=int(rows.time_ns[first]),
                end_ns=int(rows.time_ns[members[-1]]),
                evidence=(
                    (
                        f"packet {rows.number[first]}: {tail} bytes behind {rows.cdr_length[first]} bytes "
                        "of CDR, not all zero: the struct has a fixed size and is not cleared"
                    ),
                ),
                remedy="none needed; clear the struct before each message to keep old data off the link",
            )
