"""Bytes of TCP streams are missing in the capture: TCP delivered them, so nobody lost what was in them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.model import Finding
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "stream_gap"


def judge(case: Case) -> Iterator[Verdict]:
    """Name each link whose streams have messages behind missing bytes."""
    rows = case.rows
    behind = rows.has(Finding.STREAM_GAP) & ~rows.has(Finding.FRAGMENT)
    for link in case.context.links:
        members = np.flatnonzero(behind & (rows.link == link))
        if not link.transport.tcp or not len(members):
            continue
        first = int(members[0])
        yield Verdict(
            ID,
            Severity.WARNING,
            f"{link.name} over TCP: bytes are missing in front of {plural(len(members), 'message')} of "
            f"{int((rows.link == link).sum()):,}; what was in them is not judged",
            link=link.label,
            hop="capture",
            start_ns=int(rows.time_ns[first]),
            end_ns=int(rows.time_ns[members[-1]]),
            evidence=(
                f"packet {rows.number[first]}: the first message behind bytes that are missing or no message",
                "TCP delivers every byte or ends the connection: the capture lacks them, the peer does not",
            ),
            remedy="capture whole frames, with a larger buffer, and from before the connections begin",
        )
