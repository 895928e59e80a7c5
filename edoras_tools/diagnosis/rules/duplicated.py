"""The network delivered datagrams twice, or late."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.wire.arrays.order import by_value
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "duplicated"


def judge(case: Case) -> Iterator[Verdict]:
    """Say so for each way between two endpoints."""
    rows, doubled = case.rows, case.prepared.duplicates
    pair = rows.source[doubled].astype("i8") << 32 | rows.destination[doubled]
    for _, members in by_value(pair):
        own = doubled[members]
        row = int(own[0])
        sender, receiver = case.endpoints[rows.source[row]], case.endpoints[rows.destination[row]]
        yield Verdict(
            ID,
            Severity.NOTE,
            f"{plural(len(own), 'datagram')} from {sender} to {receiver} "
            f"{'was' if len(own) == 1 else 'were'} doubled by the network",
            hop="network",
            start_ns=int(rows.time_ns[own].min()),
            end_ns=int(rows.time_ns[own].max()),
            evidence=("the same bytes with the same IP identification, captured at one place",),
            remedy="none; whoever receives them gets them twice",
        )
