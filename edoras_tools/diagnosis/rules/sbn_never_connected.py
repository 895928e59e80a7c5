"""Someone sends SBN datagrams and never gets an answer."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links.sbn import SBN
from edoras_tools.units import SECOND
from edoras_tools.wire import sbn
from edoras_tools.wire.arrays.order import numbered
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "sbn_never_connected"
_WAIT_NS: Final = 12 * SECOND
_LEAST_SECONDS: Final = 8


def judge(case: Case) -> Iterator[Verdict]:
    """Look for a direction of a link on which nothing ever came."""
    rows = case.rows
    network = (rows.link == SBN) & (rows.sbn_msg_type >= 0)
    sources, targets = rows.source[network], rows.destination[network]
    first, _ = numbered(sources, targets)
    ways = set(zip(sources[first].tolist(), targets[first].tolist(), strict=True))
    for source, target in sorted(ways):
        if (target, source) in ways:
            continue
        there = np.flatnonzero(network & (rows.source == source) & (rows.destination == target))
        first_ns, last_ns = int(rows.time_ns[there[0]]), int(rows.time_ns[there[-1]])
        seconds = len(np.unique(rows.time_ns[there] // SECOND))
        if last_ns - first_ns < _WAIT_NS or seconds < _LEAST_SECONDS:
            continue  # cFS sends each new SUB to every peer of its table, there or not
        who = case.network.identity_of.get(source, str(case.endpoints[source]))
        kinds = np.unique(rows.sbn_msg_type[there]).tolist()
        names = ", ".join(sbn.MSG_TYPE_NAMES.get(kind, hex(kind)) for kind in kinds)
        yield Verdict(
            ID,
            Severity.WARNING,
            f"{who} sends to {case.endpoints[target]} and nothing comes back: the peers are not connected, "
            "or the answers do not cross this capture point",
            link="sbn",
            hop="SBN",
            start_ns=first_ns,
            end_ns=last_ns,
            evidence=(
                (
                    f"{plural(len(there), 'datagram')} ({names}) in {(last_ns - first_ns) / SECOND:.0f} s, "
                    "no answer"
                ),
                (
                    "stock SBN announces only to a peer whose spacecraft and processor both differ: "
                    "between equal spacecraft numbers the first SUB or PROTO of either side has to come "
                    "through"
                ),
            ),
            remedy="see that the peer runs, listens at that port, and is in cFS's SBN table with this "
            "identity; capture at the peer to see whether answers leave it",
            confidence="medium",
        )
