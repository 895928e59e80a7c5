"""An SBN peer fell silent and timed out; what cFS sent to it meanwhile reached nobody."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.cfs import sbn as facts
from edoras_tools.diagnosis.evidence.peers import UNSEEN
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.units import SECOND
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.evidence.peers import Connection, PeerChange, PeerSilence

ID = "sbn_timeout"


def judge(case: Case) -> Iterator[Verdict]:
    """Name every silence, how long it was, and what was lost in it."""
    for connection in case.network.connections.values():
        for silence in connection.silences(case.end_ns):
            yield (
                _verdict(case, connection, silence) if silence.given_up else _still(case, connection, silence)
            )
        for change in connection.changes:
            if change.why == UNSEEN:
                yield _unseen(case, connection, change)


def _unseen(case: Case, connection: Connection, silent: PeerChange) -> Verdict:
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


def _still(case: Case, connection: Connection, silence: PeerSilence) -> Verdict:
    """Say that a peer is silent when the capture ends: nobody knows whether it is there."""
    sent = connection.sent_in(silence)
    seconds = (case.end_ns - silence.start_ns) / SECOND
    return Verdict(
        ID,
        Severity.WARNING,
        f"SBN peer {connection.peer} is silent since {case.at(silence.start_ns)}, {seconds:.1f} s to the "
        f"end of the capture; {connection.observer} sent it {plural(len(sent), 'message')} since, and "
        "nothing shows whether they were heard",
        link="sbn",
        hop=f"SBN peer {connection.peer}",
        of=len(sent) or None,
        start_ns=silence.start_ns,
        end_ns=case.end_ns,
        evidence=(f"last datagram of {connection.peer} at {case.at(silence.start_ns)}",),
        remedy="capture longer: a peer that is gone is given up after 11 s",
        confidence="medium",
    )


def _verdict(case: Case, connection: Connection, silent: PeerSilence) -> Verdict:
    back_ns = silent.until_ns if silent.until_ns < case.end_ns else None
    until = silent.until_ns
    out_ns = connection.changes[silent.change + 1].time_ns
    sent = connection.sent_in(silent)
    evidence = [
        f"last datagram of {connection.peer} at {case.at(silent.start_ns)}",
        f"{connection.observer} sent it {plural(len(sent), 'message')} after that",
    ]
    if len(sent) and int(sent[-1]) > silent.start_ns:
        evidence.append(f"the last of them at {case.at(int(sent[-1]))}: then it had given the peer up")
    evidence += [
        f"event at {case.at(record.time_ns)}: {record}"
        for record in case.said(silent.start_ns, until + SECOND, facts.NAME)
        if connection.peer in record.message
        and any(event.phrase in record.message for event in (facts.TIMED_OUT, facts.DISCONNECTED))
    ]
    returned = (
        f"back after {(back_ns - silent.start_ns) / SECOND:.1f} s" if back_ns else "not back in this capture"
    )
    return Verdict(
        ID,
        Severity.ERROR if len(sent) else Severity.WARNING,
        f"SBN peer {connection.peer} fell silent at {case.at(silent.start_ns)} and timed out at "
        f"{connection.observer} {(out_ns - silent.start_ns) // SECOND} s later; {returned}. It was "
        "killed, stopped or cut off: a stop looks the same as a kill, no DISCONNECT is sent",
        link="sbn",
        hop=f"SBN peer {connection.peer}",
        lost=len(sent) or None,
        of=len(sent) or None,
        start_ns=silent.start_ns,
        # It is lost until the peer is given up, however long it stays away.
        end_ns=min(max(out_ns, int(sent[-1]) if len(sent) else 0), until),
        evidence=tuple(evidence),
        remedy="restart the peer; it is connected again with its first SUB or PROTO. Send DISCONNECT "
        "before a planned stop",
    )
