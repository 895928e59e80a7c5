"""The kernel of the recording host dropped datagrams: its own counters say so, whatever else can be seen."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "host_drops"
_LARGER: Final = "sudo sysctl -w net.core.rmem_default=4194304, then start that program again"


def judge(case: Case) -> Iterator[Verdict]:
    """Name each socket that was full, fragments that did not come, and frames that interfaces dropped.

    ``ci_backlog`` tells of CI's socket: its own count is nearer, and the kernel's is evidence beside it.
    """
    for port, count in case.host.by_port.items():
        link = _link(case, port)
        ingests = [item for item in case.ingests if case.endpoints[item.endpoint].port == port]
        if any(loss.cause == "socket" for item in ingests for loss in item.losses):
            continue
        sent = _sent_to(case, port)
        of = f" of {sent:,}" if sent >= count else ""
        whose = f"{link.upper()}'s socket" if link else "the socket"
        yield Verdict(
            ID,
            Severity.ERROR,
            f"{plural(count, 'datagram')}{of} dropped in {whose} (UDP port {port}), which was full: "
            "the kernel counted them",
            link=link or None,
            hop=f"socket of UDP port {port}",
            lost=None if ingests else count,
            of=sent if sent >= count else None,
            start_ns=case.start_ns,
            end_ns=case.end_ns,
            evidence=("/edoras/host: the kernel's counter of that socket",),
            remedy=f"send less at once, or make its buffer larger: {_LARGER}",
        )
    for count, what, remedy in (
        (
            case.host.reassembly_failures,
            "IP packets were dropped because not all of their fragments came",
            "send datagrams that fit a frame (1,472 bytes on Ethernet), or look for what loses frames",
        ),
        (
            case.host.interface_drops,
            "frames were dropped by the interfaces of this host before any program got them",
            "look at the interface: ethtool -S, its ring sizes, the load of the host",
        ),
    ):
        if count:
            yield Verdict(
                ID,
                Severity.WARNING,
                f"{count:,} {what}; they may be others' than these links'",
                hop="host",
                start_ns=case.start_ns,
                end_ns=case.end_ns,
                evidence=("/edoras/host: the kernel's counters of the host",),
                remedy=remedy,
            )


def _link(case: Case, port: int) -> str:
    """Return the link of a port, where it is one link's only."""
    claimants = case.context.claimants[case.context.claim[port]]
    return claimants[0].label if len(claimants) == 1 else ""


def _sent_to(case: Case, port: int) -> int:
    """Return how many datagrams of the capture went to a port."""
    to_port = np.array([item.port == port for item in case.endpoints], bool)
    return int(to_port[case.rows.destination].sum()) if len(to_port) else 0
