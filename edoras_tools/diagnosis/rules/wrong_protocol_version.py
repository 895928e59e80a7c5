"""PROTO with another protocol version than 11."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.cfs import sbn as facts
from edoras_tools.diagnosis.rules.bad_network_message import answers
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links.sbn import SBN
from edoras_tools.model import Finding
from edoras_tools.wire import sbn

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "wrong_protocol_version"


def judge(case: Case) -> Iterator[Verdict]:
    """Name every sender of one."""
    rows = case.rows
    wrong = (rows.link == SBN) & rows.has(Finding.SBN_VERSION_MISMATCH)
    for source in np.unique(rows.source[wrong]).tolist():
        members = np.flatnonzero(wrong & (rows.source == source))
        first, start_ns = int(members[0]), int(rows.time_ns[members[0]])
        said = answers(case, start_ns, facts.VERSION_MISMATCH.phrase)
        yield Verdict(
            ID,
            Severity.ERROR,
            f"{len(members):,} PROTO of {case.network.identity_of.get(source, 'a peer')} "
            f"{'names' if len(members) == 1 else 'name'} another "
            f"protocol version than {sbn.PROTOCOL_VERSION}: cFS reports an error and goes on",
            link="sbn",
            hop="SBN",
            lost=len(members),
            of=len(members),
            start_ns=start_ns,
            end_ns=int(rows.time_ns[members[-1]]),
            evidence=(f"packet {rows.number[first]} at {case.at(start_ns)}", *said),
            remedy="build both sides from the same SBN version",
            confidence="high" if said else "medium",
        )
