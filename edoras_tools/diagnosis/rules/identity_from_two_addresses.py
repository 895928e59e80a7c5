"""One SBN identity that speaks from two addresses."""

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

ID = "identity_from_two_addresses"
_UNSOUND = Finding.TRUNCATED | Finding.SBN_UNKNOWN_TYPE | Finding.SBN_SIZE_MISMATCH


def judge(case: Case) -> Iterator[Verdict]:
    """Name every identity that does: a receiver tells peers apart by it, never by their address."""
    rows = case.rows
    spoke = np.flatnonzero((rows.link == SBN) & (rows.sbn_msg_type >= 0) & ~rows.has(_UNSOUND))
    identity = rows.spacecraft_id[spoke].astype(np.uint64) << 32 | rows.processor_id[spoke]
    for who in np.unique(identity).tolist():
        members = spoke[identity == who]
        first: dict[str, int] = {}
        count: dict[str, int] = {}
        for source in np.unique(rows.source[members]).tolist():
            address = case.endpoints[source].address
            own = members[rows.source[members] == source]
            first[address] = min(int(own[0]), first.get(address, int(own[0])))
            count[address] = count.get(address, 0) + len(own)
        if len(first) < 2:
            continue
        order = sorted(first, key=first.__getitem__)
        second = first[order[1]]
        yield Verdict(
            ID,
            Severity.SECURITY,
            f"SBN peer {Peer(who >> 32, who & 0xFFFFFFFF)} speaks from {len(order)} addresses: "
            f"{', '.join(order)}; cFS takes whatever bears its identity",
            link="sbn",
            hop="SBN",
            start_ns=int(rows.time_ns[second]),
            end_ns=int(rows.time_ns[members[-1]]),
            evidence=tuple(
                f"{address}: {plural(count[address], 'datagram')}, the first at "
                f"{case.at(int(rows.time_ns[first[address]]))}"
                for address in order[:8]
            ),
            remedy="give each peer its own processor_id; if there is only one, somebody else uses its name",
            confidence="medium",
        )
