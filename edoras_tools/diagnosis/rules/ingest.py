"""What is lost on the way to Command Ingest, in its socket, and in an application behind it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.cfs import command_ingest, queues
from edoras_tools.cfs.commands import ENABLE_OUTPUT
from edoras_tools.cfs.executive_services import STARTS
from edoras_tools.diagnosis.accounting.losses import CI_SOCKET
from edoras_tools.diagnosis.advice import advise, loss_verdict, lost_at
from edoras_tools.diagnosis.rules.commands import refusals
from edoras_tools.diagnosis.verdict import Verdict, error, note, warning
from edoras_tools.links.ci import CI
from edoras_tools.links.to import TO
from edoras_tools.model import Finding
from edoras_tools.wire.arrays.order import groups
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

_LARGER: Final = "sudo sysctl -w net.core.rmem_default=4194304, then start that program again"


def host_drops(case: Case) -> Iterator[Verdict]:
    """The kernel of the recording host dropped datagrams: its own counters say so, whatever else can be seen.

    Name each socket that was full, fragments that did not come, and frames that interfaces dropped.

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
        yield error(
            f"{plural(count, 'datagram')}{of} dropped in {whose} (UDP port {port}), which was full: "
            "the kernel counted them",
            "/edoras/host: the kernel's counter of that socket",
            link=link or None,
            hop=f"socket of UDP port {port}",
            lost=None if ingests else count,
            of=sent if sent >= count else None,
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
            yield warning(
                f"{count:,} {what}; they may be others' than these links'",
                "/edoras/host: the kernel's counters of the host",
                hop="host",
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


def lost_before_ci(case: Case) -> Iterator[Verdict]:
    """Commands that were sent and that CI never counted, at a rate that it can read: lost on the network.

    Name the route; and what CI counted that is not in the capture.
    """
    for loss in case.losses:
        if loss.kind == "network":
            yield loss_verdict(
                case,
                loss,
                f"{lost_at(case, loss, 'commands')}: CI counted fewer than were sent, and it reads so many",
                link="ci",
                remedy="look at the uplink: a capture on the cFS host shows which of them arrive there",
            )
    for fate in case.commands.fates.values():
        if number := fate.ends["uncounted"]:
            stream = fate.stream
            start_ns = int(case.rows.time_ns[stream.rows[0]])
            counted = (item.first_ns for item in case.ingests if item.endpoint == stream.receiver)
            yield warning(
                f"{number:,} of {len(stream):,} commands on {case.name(stream.msg_id)} are not "
                "accounted for: CI's first count has fewer than were sent before it",
                "lost on the way, or read by a CI that started again since: no count tells",
                msg_id=stream.msg_id,
                link="ci",
                hop=command_ingest.NAME,
                of=len(stream),
                span=(start_ns, max(start_ns, *counted)),
                remedy="capture from before the commands, and have Telemetry Output enabled first",
                confidence="medium",
            )
    for account in case.ingests:
        if account.not_captured:
            yield note(
                f"CI counted {plural(account.not_captured, 'datagram')} more than the capture shows: the "
                "capture missed some, another sender's do not pass here, or the network doubles some",
                f"0x884: CI took {account.taken + account.not_captured:,}",
                link="ci",
                hop="capture",
                span=(account.first_ns, account.last_ns),
                remedy="capture on the cFS host",
                confidence="medium",
            )


def ci_backlog(case: Case) -> Iterator[Verdict]:
    """CI's socket was full: more datagrams reach it than CI reads, and what it cannot hold is dropped unseen.

    Name the route and the span; and what waits at the end, if it is more than a wake-up reads.
    """
    socket = queues.ci_socket(case.profile)
    ceiling = socket.rate_hz(socket.reads)
    reads = f"CI reads {socket.reads} a wake-up, about {ceiling:.0f}/s"
    remedy = f"send at most {ceiling:.0f} commands a second in all"
    for loss in case.losses:
        if loss.kind == "socket":
            reason = f"{lost_at(case, loss, 'commands')}: {reads}, and its socket was full"
            evidence = (*loss.evidence, *_counted(case))
            yield loss_verdict(case, loss, reason, link="ci", remedy=advise(case, loss), evidence=evidence)
    for account in case.ingests:
        if account.waiting > socket.reads:
            yield warning(
                f"{plural(account.waiting, 'datagram')} wait in CI's socket at its last count, or were "
                f"dropped: {reads}",
                f"0x884: CI took {account.taken:,}",
                f"a socket holds about {case.profile.socket_queue:,}, unless it was given more room",
                link="ci",
                hop=CI_SOCKET,
                of=account.taken + account.lost + account.waiting,
                span=(account.first_ns, account.last_ns),
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


def ci_cut(case: Case) -> Iterator[Verdict]:
    """Command Ingest receives into 768 bytes: what is longer is cut there, silently.

    Name every MsgId whose commands are cut.
    """
    rows = case.rows
    cut = (rows.link == CI) & rows.has(Finding.OVER_CI_BUFFER)
    limit = case.profile.ci_buffer
    for msg_id, members in groups(rows.msg_id, np.flatnonzero(cut)):
        sizes = rows.length[members]
        of = int(((rows.link == CI) & (rows.msg_id == msg_id)).sum())
        packets = ", ".join(
            f"packet {rows.number[row]} at {case.at(int(rows.time_ns[row]))}: {rows.length[row]:,} bytes"
            for row in members[:4].tolist()
        )
        said = next((item for row in members.tolist() for item in refusals(case, row, limit)), None)
        words = f"said: {said}" if said else "says nothing of it"
        yield error(
            f"{len(members):,} of {of:,} commands on {case.name(msg_id)} are longer than CI's {limit} bytes: "
            f"CI cuts them there and {'drops what lacks its end' if said else 'accepts them silently'}",
            packets,
            f"up to {int(sizes.max()):,} bytes; cFS {words}",
            msg_id=msg_id,
            link="ci",
            hop="CI_LAB_APP",
            lost=len(members),
            of=of,
            span=case.span(members),
            remedy=f"send less than {limit} bytes a command, header included; or build CI with a larger "
            "buffer",
        )


_KINDS: Final = {
    "restart": "restarted",
    "ci_stopped": "stopped",
    "stopped": "stopped",
    "restart_failed": "started again, and nothing came out of it after that",
}


def app_outage(case: Case) -> Iterator[Verdict]:
    """CI or an application was stopped or restarted: what was sent to it meanwhile reached nobody.

    Name every outage, and what was lost in it.
    """
    told = []
    for loss in case.losses:
        if loss.kind in _KINDS:
            told.append(loss)
            noun = "commands" if loss.stream is None or loss.stream.is_command else "messages"
            yield loss_verdict(
                case,
                loss,
                f"{lost_at(case, loss, noun)}: {loss.hop} was {_KINDS[loss.kind]}",
                link="ci" if loss.stream is None else loss.stream.link.label,
                remedy=START_AGAIN if loss.kind == "restart_failed" else revival(case, case.called(loss.hop)),
            )
    for item in case.outages:
        start_ns = max(item.start_ns, case.start_ns)
        end_ns = max(start_ns, item.end_ns if item.end_ns is not None else case.end_ns)
        if any(
            case.called(loss.hop) == item.app and loss.start_ns <= end_ns + case.profile.ci_wake_ns
            for loss in told
        ):
            continue
        since = f"stopped at {case.at(item.start_ns)}" if item.start_ns >= case.start_ns else "not running"
        until = "" if item.end_ns is None else f" and started again at {case.at(item.end_ns)}"
        what = f"restarted at {case.at(item.start_ns)}" if item.restarted else since + until
        yield warning(
            f"{item.app} was {what}; no loss by it can be seen here",
            item.witness,
            hop=item.app,
            span=(start_ns, end_ns),
            remedy=revival(case, item.app, restarts=item.restarted),
        )


START_AGAIN: Final = (
    "start cFS again, not that application alone: its console says what failed, often a socket that is still "
    "in use"
)


def revival(case: Case, app: str, *, restarts: bool = False) -> str:
    """Return what helps: to start it again where it still does not run."""
    last = next((item for item in reversed(case.outages) if item.app == app), None)
    stands = app in STARTS and last is not None and last.end_ns is None and not restarts
    is_output = app.startswith("TO_")
    if stands and app in command_ingest.NAMES:
        return "start cFS again, or CI from cFS's own side: while CI is stopped, no command gets in"
    if stands:
        line = case.inject("es-start-app", app)
        if is_output:
            return f"start it again, and a second later enable it: {line}; {case.inject(ENABLE_OUTPUT)}"
        return f"start it again: {line}"
    if is_output:
        return f"enable it again after it restarts: {case.inject(ENABLE_OUTPUT)}"
    return "send nothing while an application is restarted"
