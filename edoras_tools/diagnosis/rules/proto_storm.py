"""The public flight bridge answers every datagram with PROTO."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links.sbn import SBN
from edoras_tools.wire import sbn

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "proto_storm"
_LEAST: Final = 6


def judge(case: Case) -> Iterator[Verdict]:
    """Find who sends about as many PROTO as it receives datagrams."""
    rows = case.rows
    protos = (rows.link == SBN) & (rows.sbn_msg_type == sbn.MsgType.PROTO)
    for source in np.unique(rows.source[protos]).tolist():
        sent = np.flatnonzero(protos & (rows.source == source))
        heard = int(((rows.link == SBN) & (rows.destination == source)).sum())
        if len(sent) < _LEAST or 2 * len(sent) < heard:
            continue
        yield Verdict(
            ID,
            Severity.HABIT,
            f"{case.network.identity_of.get(source, 'a peer')} answers every datagram with PROTO, "
            f"{len(sent):,} in all: the public flight bridge does; cFS reports an event for each and goes on",
            link="sbn",
            hop="flight bridge",
            start_ns=int(rows.time_ns[sent[0]]),
            end_ns=int(rows.time_ns[sent[-1]]),
            evidence=(f"{len(sent):,} PROTO for {heard:,} datagrams received",),
            remedy="none needed; the events may squelch SBN's others (15 a second)",
        )
