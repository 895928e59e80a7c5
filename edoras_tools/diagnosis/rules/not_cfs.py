"""Traffic on the links' ports that is not cFS's: left out; what reached a cFS is told by sender."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.decode.conversations import ConversationKind, foreign
from edoras_tools.diagnosis.verdict import Severity, Verdict

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "not_cfs"


def judge(case: Case) -> Iterator[Verdict]:
    """One line for each port, and one verdict for each stranger."""
    flows = case.prepared.flows
    for line in foreign(flow for flow in flows if flow.kind is ConversationKind.FOREIGN):
        yield Verdict(
            ID,
            Severity.NOTE,
            line,
            hop="capture",
            start_ns=case.start_ns,
            end_ns=case.end_ns,
            remedy="none; another program uses this port, and no cFS gets it",
        )
    for flow in flows:
        if flow.kind is ConversationKind.STRANGER:
            yield Verdict(
                ID,
                Severity.WARNING,
                f"{flow.datagrams:,} datagrams on port {flow.destination.port} do not look like cFS, left "
                f"out: {flow.source} sends them to {flow.destination}, where {flow.link.name} is",
                link=flow.link.label,
                hop=str(flow.source),
                start_ns=flow.first_ns,
                end_ns=flow.last_ns,
                evidence=("none of them is a packet whose length agrees, or has a MsgId that is known",),
                remedy=f"let {flow.source.address} send elsewhere; what listens there reads every datagram",
            )
