"""An SBN peer said goodbye."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.diagnosis.verdict import Severity, Verdict

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "sbn_disconnected"


def judge(case: Case) -> Iterator[Verdict]:
    """Name every DISCONNECT, and when the peer came back."""
    for connection in case.network.connections.values():
        for at, change in enumerate(connection.changes):
            if change.state != "disconnected":
                continue
            later = connection.changes[at + 1 :]
            back = next((item for item in later if item.state == "connected"), None)
            told = f"connected again at {case.at(back.time_ns)}" if back else "not back in this capture"
            yield Verdict(
                ID,
                Severity.NOTE,
                f"SBN peer {connection.peer} disconnected from {connection.observer} at "
                f"{case.at(change.time_ns)}, in order; {told}",
                link="sbn",
                hop=f"SBN peer {connection.peer}",
                start_ns=change.time_ns,
                end_ns=back.time_ns if back else case.end_ns,
                evidence=(change.why,),
                remedy="none",
            )
