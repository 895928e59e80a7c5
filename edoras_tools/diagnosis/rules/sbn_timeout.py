"""An SBN peer fell silent and timed out; what cFS sent to it meanwhile reached nobody."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.diagnosis.peers import UNSEEN
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.sessions.profile import SECOND

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.peers import Change, Connection

ID = "sbn_timeout"


def judge(case: Case) -> Iterator[Verdict]:
    """Name every silence, how long it was, and what was lost in it."""
    for connection in case.network.connections.values():
        for at, change in enumerate(connection.changes):
            if change.state == "timed_out" and at:
                yield _verdict(case, connection, at, connection.changes[at - 1], change)
            elif change.why == UNSEEN:
                yield _unseen(case, connection, change)


def _unseen(case: Case, connection: Connection, silent: Change) -> Verdict:
    """Say that a peer is not dead, but out of sight."""
    return Verdict(
        ID,
        Severity.NOTE,
        f"nothing of SBN peer {connection.peer} is seen here after {case.at(silent.time_ns)}, yet "
        f"{connection.observer} goes on sending to it: its datagrams do not cross this point any more",
        link="sbn",
        hop="capture",
        start_ns=silent.time_ns,
        end_ns=case.end_ns,
        evidence=(f"{connection.observer} still sent at {case.at(int(connection.sent_ns[-1]))}",),
        remedy="capture on the host of cFS, where both directions pass",
        confidence="medium",
    )


def _verdict(case: Case, connection: Connection, at: int, silent: Change, out: Change) -> Verdict:
    later = connection.changes[at + 1 :]
    back = next((change for change in later if change.state == "connected"), None)
    until = back.time_ns if back else case.end_ns
    sent = connection.sent_ns[(connection.sent_ns > silent.time_ns) & (connection.sent_ns < until)]
    evidence = [
        f"last datagram of {connection.peer} at {case.at(silent.time_ns)}",
        f"{connection.observer} sent it {len(sent):,} messages after that",
    ]
    if len(sent) and int(sent[-1]) > silent.time_ns:
        evidence.append(f"the last of them at {case.at(int(sent[-1]))}: then it had given the peer up")
    evidence += [
        f"event at {case.at(record.time_ns)}: {record}"
        for record in case.said(silent.time_ns, until + SECOND, "SBN")
        if connection.peer in record.message and "isconnected" in record.message
    ]
    returned = (
        f"back after {(back.time_ns - silent.time_ns) / SECOND:.1f} s" if back else "not back in this capture"
    )
    return Verdict(
        ID,
        Severity.ERROR if len(sent) else Severity.WARNING,
        f"SBN peer {connection.peer} fell silent at {case.at(silent.time_ns)} and timed out at "
        f"{connection.observer} {(out.time_ns - silent.time_ns) // SECOND} s later; {returned}. It was "
        "killed, stopped or cut off: a stop looks the same as a kill, no DISCONNECT is sent",
        link="sbn",
        hop=f"SBN peer {connection.peer}",
        lost=len(sent) or None,
        of=len(sent) or None,
        start_ns=silent.time_ns,
        # It is lost until the peer is given up, however long it stays away.
        end_ns=min(max(out.time_ns, int(sent[-1]) if len(sent) else 0), until),
        evidence=tuple(evidence),
        remedy="restart the peer; it is connected again with its first SUB or PROTO. Send DISCONNECT "
        "before a planned stop",
    )
