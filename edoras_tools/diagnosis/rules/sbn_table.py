"""SBN's table beside what SBN sends: peers of it that are silent, and senders that it does not name."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links.sbn import SBN
from edoras_tools.model import Finding, Peer
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "sbn_table"


def judge(case: Case) -> Iterator[Verdict]:
    """Compare who speaks on SBN with the table, if an image of it was given."""
    table = {item.peer: item for item in case.profile.sbn_table}
    rows = case.rows
    spoken = np.flatnonzero((rows.link == SBN) & (rows.sbn_msg_type >= 0) & ~rows.has(Finding.TRUNCATED))
    if not table or not len(spoken):
        return
    identity = rows.spacecraft_id[spoken].astype(np.uint64) << 32 | rows.processor_id[spoken]
    seen, first, counts = np.unique(identity, return_index=True, return_counts=True)
    heard = {
        Peer(who >> 32, who & 0xFFFFFFFF): (int(spoken[at]), number)
        for who, at, number in zip(seen.tolist(), first.tolist(), counts.tolist(), strict=True)
    }
    for peer, (row, number) in heard.items():
        start_ns = int(rows.time_ns[row])
        if peer not in table:
            yield Verdict(
                ID,
                Severity.WARNING,
                f"{peer} sends on SBN, and the table that was given does not name it: a cFS with this table "
                "refuses what it sends",
                link="sbn",
                hop="SBN",
                start_ns=start_ns,
                end_ns=case.end_ns,
                evidence=(f"{plural(number, 'datagram')} of it, from {case.endpoints[rows.source[row]]}",),
                remedy=f"add {peer} to sbn_conf_tbl, or give the bridge an identity that is in it",
                confidence="medium",
            )
    for peer, place in table.items():
        if peer not in heard:
            yield Verdict(
                ID,
                Severity.NOTE,
                f"{peer}, which the table that was given names at {place.address}:{place.port}, sends "
                "nothing that was captured",
                link="sbn",
                hop="SBN",
                start_ns=case.start_ns,
                end_ns=case.end_ns,
                evidence=(f"on SBN are {', '.join(map(str, heard))}",),
                remedy="see whether it runs; capture where its datagrams pass",
                confidence="high",
            )
