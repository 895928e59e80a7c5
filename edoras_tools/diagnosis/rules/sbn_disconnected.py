"""An SBN peer said goodbye, or cFS did to its peer."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.cfs.sbn import NAME
from edoras_tools.diagnosis.evidence.peers import SAID_GOODBYE
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.units import SECOND
from edoras_tools.wire import sbn

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "sbn_disconnected"


def judge(case: Case) -> Iterator[Verdict]:
    """Name every DISCONNECT, and when the peer came back."""
    yield from _by_cfs(case)
    for connection in case.network.connections.values():
        for at, change in enumerate(connection.changes):
            if change.state != "disconnected" or change.why == SAID_GOODBYE:
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


def _by_cfs(case: Case) -> Iterator[Verdict]:
    """Name what a cFS says goodbye to: it does so when SBN is loaded anew, or ends."""
    rows, network = case.rows, case.network
    observers = {observer for _, observer in network.connections}
    for row in np.flatnonzero(rows.sbn_msg_type == sbn.MsgType.DISCONNECT).tolist():
        sender, target = (network.party(int(end[row])) for end in (rows.source, rows.destination))
        if sender not in observers or (target in observers and (sender, target) in network.connections):
            continue
        who, peer = sender[0], target[0]
        when = int(rows.time_ns[row])
        sent = (rows.source == rows.source[row]) & (rows.time_ns > when + SECOND)
        back = bool((sent & (rows.sbn_msg_type == sbn.MsgType.APP)).any())
        yield Verdict(
            ID,
            Severity.WARNING if back else Severity.ERROR,
            f"{who} disconnected from its SBN peer {peer or 'there'} at {case.at(when)}"
            + ("" if back else ", and sent no application message to anybody after that"),
            link="sbn",
            hop=f"SBN peer {peer}",
            start_ns=when,
            end_ns=case.end_ns,
            evidence=(f"packet {rows.number[row]}: DISCONNECT from {who}",),
            remedy="look at the events of SBN around that time; to restart it: "
            f"{case.inject('es-restart-app', NAME)}",
        )
