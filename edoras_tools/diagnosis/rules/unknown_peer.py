"""SBN datagrams of a spacecraft and processor that the receiver's table does not name."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.cfs import sbn as facts
from edoras_tools.diagnosis.rules.bad_network_message import answers
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links.sbn import SBN
from edoras_tools.model import Finding, Peer
from edoras_tools.units import SECOND
from edoras_tools.wire import sbn
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "unknown_peer"


def judge(case: Case) -> Iterator[Verdict]:
    """Name every such sender: by cFS's own words, or by an endpoint that has another name."""
    rows = case.rows
    listed = np.isin(rows.sbn_msg_type, (sbn.MsgType.SUB, sbn.MsgType.UNSUB))
    foreign = (rows.link == SBN) & rows.has(Finding.SBN_ID_MISMATCH) & ~listed
    network = np.flatnonzero((rows.link == SBN) & (rows.sbn_msg_type >= 0) & ~rows.has(Finding.TRUNCATED))
    times = rows.time_ns[network]
    for record in case.said(case.start_ns, case.end_ns, facts.NAME):
        named = facts.UNKNOWN_PEER.pattern.search(record.message)
        if named:
            spacecraft, processor = map(int, named.groups())
            low, high = np.searchsorted(times, (record.time_ns - 2 * SECOND, record.time_ns), "right")
            near = network[low:high]
            same = (rows.spacecraft_id[near] == spacecraft) & (rows.processor_id[near] == processor)
            foreign[near[same]] = True
    identity = rows.spacecraft_id.astype(np.uint64) << 32 | rows.processor_id
    for who in np.unique(identity[foreign]).tolist():
        members = np.flatnonzero(foreign & (identity == who))
        first, start_ns = int(members[0]), int(rows.time_ns[members[0]])
        peer = Peer(who >> 32, who & 0xFFFFFFFF)
        said = answers(case, start_ns, facts.UNKNOWN_PEER.text.format(**peer._asdict()))
        yield Verdict(
            ID,
            Severity.ERROR,
            f"{plural(len(members), 'SBN datagram')} from {peer}, which is not the peer known at "
            f"{case.endpoints[rows.source[first]]}: "
            + ("cFS refuses them" if said else "a cFS whose table does not name it refuses them"),
            link="sbn",
            hop="SBN",
            lost=len(members),
            of=len(members),
            start_ns=start_ns,
            end_ns=int(rows.time_ns[members[-1]]),
            evidence=(f"packet {rows.number[first]} at {case.at(start_ns)}", *said),
            remedy="make spacecraft_id and processor_id of the bridge agree with cFS's SBN table "
            "(sbn_conf_tbl)",
            confidence="high" if said else "medium",
        )
