"""A proxy, or a replay, did something wrong on purpose: the recording says so, and nobody is to blame."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.diagnosis.balance import ON_PURPOSE
from edoras_tools.diagnosis.evidence.relays.proxied import PROXY_HOP
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links import table
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "proxy_faults"


def judge(case: Case) -> Iterator[Verdict]:
    """Say what was done to each MsgId."""
    if case.prepared.relayed:
        yield Verdict(
            ID,
            Severity.NOTE,
            f"{plural(case.prepared.relayed, 'datagram')} were captured in front of the proxy: they are its "
            "own recording's once more, and not counted again",
            hop=PROXY_HOP,
            start_ns=case.start_ns,
            end_ns=case.end_ns,
            evidence=("what the proxy dropped is among them",),
            remedy="none",
        )
    for (link, to_cfs, msg_id), item in case.proxied.items():
        done = [
            f"{number:,} {what}"
            for what, number in (("dropped", len(item.dropped)), ("sent again", item.doubled))
            if number
        ]
        done += [f"{number:,} struck by {kind}" for kind, number in item.others.items()]
        way = "to cFS" if to_cfs else "from cFS"
        yield Verdict(
            ID,
            Severity.WARNING if item.dropped else Severity.NOTE,
            f"datagrams on {case.name(msg_id)} {way}: {', '.join(done)} on purpose by the proxy",
            msg_id=msg_id if msg_id >= 0 else None,
            topic=case.topic(msg_id),
            link=table.link(link).label,
            hop=PROXY_HOP,
            lost=len(item.dropped) or None,
            start_ns=item.start_ns,
            end_ns=item.end_ns,
            evidence=(ON_PURPOSE, *(f"rule {rule}" for rule in item.rules)),
            remedy="none: it was asked for",
        )
