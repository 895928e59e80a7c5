"""CI's socket was full: more datagrams reach it than CI reads, and what it cannot hold is dropped unseen."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.diagnosis.accounting.losses import CI_SOCKET
from edoras_tools.diagnosis.loss_verdict import loss_verdict, lost_at
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links.ci import CI
from edoras_tools.links.to import TO
from edoras_tools.units import SECOND
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "ci_backlog"


def judge(case: Case) -> Iterator[Verdict]:
    """Name the route and the span; and what waits at the end, if it is more than a wake-up reads."""
    profile = case.profile
    ceiling = profile.ci_datagrams_per_wake * SECOND / profile.ci_wake_ns
    reads = f"CI reads {profile.ci_datagrams_per_wake} a wake-up, about {ceiling:.0f}/s"
    remedy = f"send at most {ceiling:.0f} commands a second in all"
    for loss in case.losses:
        if loss.kind == "socket":
            reason = f"{lost_at(case, loss, 'commands')}: {reads}, and its socket was full"
            evidence = (*loss.evidence, *_counted(case))
            yield loss_verdict(case, ID, loss, reason, link="ci", remedy=remedy, evidence=evidence)
    for account in case.ingests:
        if account.waiting > profile.ci_datagrams_per_wake:
            yield Verdict(
                ID,
                Severity.WARNING,
                f"{plural(account.waiting, 'datagram')} wait in CI's socket at its last count, or were "
                f"dropped: {reads}",
                link="ci",
                hop=CI_SOCKET,
                of=account.taken + account.lost + account.waiting,
                start_ns=account.first_ns,
                end_ns=account.last_ns,
                evidence=(f"0x884: CI took {account.taken:,}",),
                remedy=remedy,
                confidence="medium",
            )


def _counted(case: Case) -> Iterator[str]:
    """Yield what the kernel of the recording host counted in CI's sockets, if it was recorded."""
    if any(account.by_kernel for account in case.ingests):
        return  # the losses themselves are told by it
    for port in sorted(case.host.ports):
        if case.context.ports[CI][port] and not case.context.ports[TO][port]:
            count = case.host.by_port.get(port, 0)
            yield f"{count:,} dropped in CI's socket, UDP port {port} (kernel counter)"
