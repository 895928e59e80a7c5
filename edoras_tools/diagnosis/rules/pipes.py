"""What is lost on the way to Command Ingest, in its socket, and at the pipes of the software bus."""

from __future__ import annotations

import re
from collections import Counter
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.cfs import command_ingest, queues, telemetry_output
from edoras_tools.cfs.commands import ENABLE_OUTPUT
from edoras_tools.cfs.executive_services import STARTS
from edoras_tools.cfs.names import MSG_ID_NAMES
from edoras_tools.diagnosis.accounting.ingest import QUOTED
from edoras_tools.diagnosis.accounting.losses import CI_SOCKET, SBN_SOCKET, TAIL_NS, Loss
from edoras_tools.diagnosis.accounting.pipes import TICKS, more_at_once
from edoras_tools.diagnosis.advice import advise, capacity, crowding_of, depth_at
from edoras_tools.diagnosis.evidence.relays import RELAY_HOP
from edoras_tools.diagnosis.ledger import CAUSES
from edoras_tools.diagnosis.rules.about import loss_verdict, lost_at, of_messages, packet
from edoras_tools.diagnosis.rules.commands import refusals
from edoras_tools.diagnosis.verdict import Advice, Severity, Verdict, error, note, warning
from edoras_tools.links.bare import CI, TO
from edoras_tools.model import NO_MSG_ID, NO_ROUTE, Finding
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import cfe
from edoras_tools.wire.arrays import by_key, groups
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.evidence.loss_reports import PipeKind


def app_pipe_limit(case: Case) -> Iterator[Verdict]:
    """Too many of one MsgId waited in an application's pipe: the software bus dropped the rest.

    Name the MsgId, the pipe and the rate that would be clean.
    """
    yield from (_over_app_limit(case, loss) for loss in case.losses if _at_application(loss, "limit"))


def _at_application(loss: Loss, kind: PipeKind) -> bool:
    """Tell whether a pipe of an application lost something, and of which MsgId."""
    elsewhere = loss.hop == telemetry_output.PIPE or loss.hop.startswith("SBN")
    return loss.kind == kind and not elsewhere and not loss.rivals


def _by_another(case: Case, loss: Loss, least: str) -> Verdict:
    """Tell what another application sent and a pipe did not take: its reader may have been stopped."""
    over = (item for item in case.outages if item.start_ns < loss.end_ns + TAIL_NS)
    over = (item for item in over if loss.start_ns < (item.end_ns or case.end_ns))
    why = f"{loss.sender} sent more than may wait, or nobody read the pipe"
    remedy = "see whether the application that reads this pipe runs"
    for item in over:
        tick = case.of_known(TICKS.get(item.app, NO_MSG_ID))
        if item.reads(loss.hop) or tick == loss.msg_id:
            why, remedy = f"{item.app} did not run", revival(case, item.app, restarts=item.restarted)
    return loss_verdict(case, loss, f"{least}{lost_at(case, loss)}: {why}", remedy)


def _over_app_limit(case: Case, loss: Loss) -> Verdict:
    period_ns = queues.application_pipe(case.profile, over_network=loss.over_network).round_ns
    least = "at least " if loss.instance not in case.tracks else ""
    beside = loss.stream is None and any(item.msg_id == loss.msg_id for item in case.streams)
    if loss.sender and (beside or not loss.sender.startswith((*command_ingest.NAMES, "SBN"))):
        return _by_another(case, loss, least)
    why = "; ".join(filter(None, (capacity(case, loss), crowding_of(case, loss))))
    reason, rate = f"{least}{lost_at(case, loss, 'commands')}: {why}", ""
    if loss.span is not None and loss.stream is not None and loss.span.rate_hz:
        times = loss.stream.time_ns[loss.span.rows]
        most = int((np.searchsorted(times, times + period_ns) - np.arange(len(times))).max())
        rate = f"sent at {loss.span.rate_hz:.1f} Hz, at most {most:,} within {period_ns // MILLISECOND} ms"
    link = "sbn" if loss.over_network else "ci"
    return loss_verdict(case, loss, reason, advise(case, loss), rate, link=link)


def app_pipe_overflow(case: Case) -> Iterator[Verdict]:
    """An application's pipe was full: its task does not keep up with all that it subscribes to.

    Name the MsgId and the pipe.
    """
    remedy = "send less of all that this pipe takes, make it deeper, or have its task run more often"
    for loss in case.losses:
        if _at_application(loss, "overflow"):
            yield loss_verdict(case, loss, f"{lost_at(case, loss)}: the pipe was full", remedy)


def to_message_limit(case: Case) -> Iterator[Verdict]:
    """Telemetry Output's table lets so many of a MsgId wait between two of its rounds; the rest is dropped.

    Name the MsgId, and the rate that gets through, as measured where it can be.
    """
    for loss in case.losses:
        if loss.kind == "limit" and loss.hop == telemetry_output.PIPE and not (loss.closed or loss.rivals):
            yield _over_limit(case, loss, "to")


def _over_limit(case: Case, loss: Loss, link: str) -> Verdict:
    """Return the verdict on what a pipe that is emptied in rounds did not take."""
    offered = f"published at {loss.offered_hz:,.0f} a second on average" if loss.offered_hz else ""
    reason = f"{lost_at(case, loss)}: {capacity(case, loss)}"
    return loss_verdict(case, loss, reason, advise(case, loss), offered, link=link)


def to_pipe_overflow(case: Case) -> Iterator[Verdict]:
    """Telemetry Output's own pipe overflowed: it loses whatever comes last, the events about it included.

    Name the MsgId that fills the pipe, and what else went down with it.
    """
    open_ = (x for x in case.losses if x.kind == "overflow" and not (x.closed or x.rivals))
    full = [item for item in open_ if item.hop == telemetry_output.PIPE]
    # The routes have a verdict each; without any, what lost most.
    routes = [x for x in full if x.msg_id not in MSG_ID_NAMES or (x.stream and x.stream.route != NO_ROUTE)]
    routes = routes or sorted(full, key=lambda item: -item.lost)[:1]
    others = [item for item in full if item not in routes]
    for loss in routes:
        yield _output_overflow(case, loss, [item for item in others if _together(item, loss)])
    yield from (_with_them(case, own) for own in by_key(others, lambda item: item.instance).values())


def _together(loss: Loss, other: Loss) -> bool:
    return loss.instance == other.instance and loss.start_ns <= other.end_ns and other.start_ns <= loss.end_ns


def _by_name(case: Case, losses: Sequence[Loss]) -> list[str]:
    """Return each MsgId, and how many it lost."""
    lost = Counter[str]()
    for item in losses:
        lost[case.name(item.msg_id)] += item.lost
    return [f"{name} {number:,}" for name, number in lost.items()]


def _with_them(case: Case, others: Sequence[Loss]) -> Verdict:
    """Return the verdict on what did not fill the pipe and was lost at it."""
    names, lost = _by_name(case, others), sum(item.lost for item in others)
    return error(
        f"{plural(lost, 'message')} of cFS itself lost at {telemetry_output.PIPE}, of "
        f"{plural(len(names), 'MsgId')}: a pipe that is full takes nothing, whoever filled it",
        ", ".join(names),
        place=("to", telemetry_output.PIPE),
        lost=lost,
        span=(min(item.start_ns for item in others), max(item.end_ns for item in others)),
        remedy="as for the MsgId that fills it",
        confidence=min((item.confidence for item in others), key=("low", "medium", "high").index),
        cause="overflow",
    )


def _output_overflow(case: Case, loss: Loss, beside: Sequence[Loss]) -> Verdict:
    pipe = queues.telemetry_pipe(case.profile)
    depth = depth_at(case, loss, pipe)
    text = f"rounds of {depth} came often, and none was larger (is fs.mqueue.msg_max {depth}?)"
    room = pipe.rate_hz(depth)
    reason = (
        f"{lost_at(case, loss)}: TO's pipe of {depth} is emptied every "
        f"{pipe.round_ns // MILLISECOND} ms: {room:.0f}/s of all telemetry together"
    )
    remedy = (
        f"publish less: {room:.0f}/s of everything, housekeeping included; a lower limit of this "
        "MsgId in TO's table keeps the others safe; or make TO's pipe deeper or its delay shorter"
    )
    names, event_id = _by_name(case, beside), case.of_known(cfe.EVENT_MSG_ID)
    with_it = f"lost with it: {', '.join(names)}" if names else ""
    is_one = any(item.msg_id == event_id for item in beside)
    events = "events are among the lost: that none names the pipe proves nothing" * is_one
    return loss_verdict(case, loss, reason, remedy, text * (depth < pipe.depth), with_it, events, link="to")


def sbn_peer_pipe(case: Case) -> Iterator[Verdict]:
    """The pipe of an SBN peer takes eight of one MsgId between two rounds of 200 ms; the rest is dropped.

    Name the MsgId, and the rate that gets through, as measured where it can be.
    """
    for loss in case.losses:
        if loss.kind in {"limit", "overflow"} and loss.hop.startswith("SBN") and not loss.rivals:
            yield _over_limit(case, loss, "sbn")


_LARGER: Final = "sudo sysctl -w net.core.rmem_default=4194304, then start that program again"
_BY_HOST: Final = {
    "reassembly_failures": (
        "IP packets were dropped because not all of their fragments came",
        "send datagrams that fit a frame (1,472 bytes on Ethernet), or look for what loses frames",
    ),
    "interface_drops": (
        "frames were dropped by the interfaces of this host before any program got them",
        "look at the interface: ethtool -S, its ring sizes, the load of the host",
    ),
}
"""Counts of ``HostDrops`` that belong to no socket: what they say, and what to do."""


def host_drops(case: Case) -> Iterator[Verdict]:
    """The kernel of the recording host dropped datagrams: its own counters say so, whatever else can be seen.

    Name each socket that was full, fragments that did not come, and frames that interfaces dropped.

    ``ci_backlog`` tells of CI's socket: its own count is nearer, and the kernel's is evidence beside it.
    """
    ports = np.array([item.port for item in case.endpoints], np.int64)
    for port, count in case.host.by_port.items():
        claimants = case.context.claimants[case.context.claim[port]]
        link = claimants[0].label if len(claimants) == 1 else None
        ingests = [item for item in case.ingests if case.endpoints[item.endpoint].port == port]
        if any(loss.cause == "socket" for item in ingests for loss in item.losses):
            continue
        sent = int((ports[case.rows.destination] == port).sum())
        of = f" of {sent:,}" if sent >= count else ""
        whose = f"{link.upper()}'s socket" if link else "the socket"
        yield error(
            f"{plural(count, 'datagram')}{of} dropped in {whose} (UDP port {port}), by the kernel's count",
            "/edoras/host: the kernel's counter of that socket",
            place=(link, f"socket of UDP port {port}"),
            lost=None if ingests else count,
            of=sent if of else None,
            remedy=f"send less at once, or make its buffer larger: {_LARGER}",
        )
    for name, (text, remedy) in _BY_HOST.items():
        if count := getattr(case.host, name):
            reason = f"{count:,} {text}; they may be others' than these links'"
            why = "/edoras/host: the kernel's counters of the host"
            yield warning(reason, why, hop="host", remedy=remedy)


def lost_before_ci(case: Case) -> Iterator[Verdict]:
    """Commands that were sent and that CI never read, at a rate that it can read: lost on the network.

    Name the route; and what CI counted that is not in the capture.
    """
    profile = case.profile
    for loss in case.losses:
        if loss.kind == "network":
            relay, peers = loss.hop.startswith(RELAY_HOP), loss.hop == SBN_SOCKET
            why = "they did not come " + ("out" if relay else "to cFS")
            if not (relay or peers):
                reads_hz = profile.ci_datagrams_per_wake * SECOND / profile.ci_wake_ns
                why = f"its socket can hold what waited ({profile.socket_queue:,}, assumed)"
                why = "it can read so many" if loss.offered_hz < reads_hz else why
                why = f"CI did not read them, and {why}"
            more = ": a capture on the cFS host shows which of them arrive there" * (not case.capture.shared)
            remedy = f"look at the {'network' if peers else 'uplink'}{more}"
            if relay:
                remedy = "look at its log and its queue"
            elif any(line.startswith(QUOTED) for line in loss.evidence):
                remedy = "look at the route to that host, and at firewalls on the way: ICMP errors came back"
            elif size := _least_length(case, loss):
                remedy = f"look at the MTU on the way: just as many are {size:,} bytes or longer"
            which = lost_at(case, loss, "messages" if peers else "commands")
            yield loss_verdict(case, loss, f"{which}: {why}", remedy, link=None if loss.stream else "ci")
    for account in case.ingests:
        if account.not_captured:
            yield note(
                f"CI counted {plural(account.not_captured, 'datagram')} more than the capture shows: the "
                "capture missed some, another sender's do not pass here, or the network doubles some",
                f"0x884: CI took {account.read_count + account.not_captured:,}",
                place=("ci", "capture"),
                span=(account.first_ns, account.last_ns),
                remedy="capture on the cFS host",
                confidence="medium",
            )


def _least_length(case: Case, loss: Loss) -> int:
    """Return from what length on just as many were sent as were lost; 0 where no length tells."""
    if loss.stream is None or loss.among is None or loss.lost < _MANY:
        return 0
    longest = np.sort(case.rows.length[loss.stream.rows[loss.among.rows]])[::-1]
    parts = len(longest) > loss.lost >= _MANY * len(np.unique(longest))  # there are many of each length
    return int(longest[loss.lost - 1]) if parts and longest[loss.lost - 1] > longest[loss.lost] else 0


_MANY: Final = 8
"""So many of one length are lost by no chance."""


def ci_backlog(case: Case) -> Iterator[Verdict]:
    """CI's socket was full: more datagrams reach it than CI reads, and what it cannot hold is dropped unseen.

    Name the route and the span; and what waits at the end, if it is more than a wake-up reads.
    """
    socket = queues.ci_socket(case.profile)
    ceiling = socket.rate_hz(socket.reads)
    reads = f"CI reads {socket.reads} a wake-up, about {ceiling:.0f}/s"
    for loss in case.losses:
        if loss.kind == "socket":
            reason = f"{lost_at(case, loss, 'commands')}: {reads}, and its socket was full"
            yield loss_verdict(case, loss, reason, advise(case, loss), *_by_kernel(case), link="ci")
    for account in case.ingests:
        sent_ns = case.rows.time_ns[account.rows]
        if account.unread > socket.reads and more_at_once(sent_ns, socket.round_ns, socket.reads):
            yield warning(
                f"{plural(account.unread, 'datagram')} wait in CI's socket, or were dropped: {reads}",
                f"0x884: CI took {account.read_count:,}",
                f"a socket holds about {case.profile.socket_queue:,}, unless it was given more room",
                place=("ci", CI_SOCKET),
                of=account.read_count + account.lost + account.waiting,
                span=(account.first_ns, account.last_ns),
                remedy=f"send at most {ceiling:.0f} commands a second in all",
                confidence="medium",
            )


def _by_kernel(case: Case) -> Iterator[str]:
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
    # A message that ends before is whole: what CI cuts is padding.
    ends = np.where(rows.space > 0, rows.packet_length - rows.space + rows.cdr_length, rows.length)
    for _, members in groups(rows.msg_id << 1 | (ends <= limit), np.flatnonzero(cut)):
        packets = (f"{packet(case, row)}: {rows.length[row]:,} bytes" for row in members[:4].tolist())
        answer = next((item for row in members.tolist() for item in refusals(case, row, limit)), None)
        words = f"said: {answer}" if answer else "says nothing of it"
        yield of_messages(
            Severity.WARNING if ends[members[0]] <= limit and not answer else Severity.ERROR,
            case,
            members,
            f"are longer than CI's {limit} bytes: CI cuts them there and "
            f"{'drops what lacks its end' if answer else 'accepts them silently'}",
            ", ".join(packets),
            f"up to {int(rows.length[members].max()):,} bytes; cFS {words}",
            noun="commands",
            hop="CI_LAB_APP",
            remedy=f"send commands of at most {limit} bytes, header included; or build CI with a larger "
            "buffer",
        )


_COMMAND: Final = re.compile(r"\b(?:STOP|RESTART|RELOAD)_APP \w+")
"""A command that ends an application, in a witness."""
_KINDS: Final = frozenset({"restart", "ci_stopped", "stopped", "restart_failed"})


def app_outage(case: Case) -> Iterator[Verdict]:
    """CI or an application was stopped or restarted: what was sent to it meanwhile reached nobody.

    Name every outage, and what was lost in it.
    """
    losses = [loss for loss in case.losses if loss.closed]
    for loss in case.losses:
        if loss.kind in _KINDS:
            losses.append(loss)
            noun = "commands" if loss.stream is None or loss.stream.is_command else "messages"
            reason = f"{lost_at(case, loss, noun)}: {CAUSES[loss.kind].listed.format(hop=loss.hop)}"
            app, failed = case.called(loss.hop), loss.kind == "restart_failed"
            command = "" if failed else _command_of(case, loss, app)
            advice = Advice(command, START_AGAIN if failed else revival(case, app))
            yield loss_verdict(case, loss, reason, advice, link=None if loss.stream else "ci")
    for item in case.outages:
        start_ns = max(item.start_ns, case.start_ns)
        end_ns = max(start_ns, item.end_ns if item.end_ns is not None else case.end_ns)
        own = [loss for loss in losses if loss.start_ns <= end_ns + case.profile.ci_wake_ns]
        output = item.app in telemetry_output.NAMES
        if any(
            loss.end_ns >= start_ns if output and loss.closed else case.called(loss.hop) == item.app
            for loss in own
        ):
            continue
        since = f"stopped {case.end_of(item)}" if item.start_ns >= case.start_ns else "not running"
        until = "" if item.end_ns is None else f" and started at {case.at(item.end_ns)}"
        event = f"restarted {case.end_of(item)}" if item.restarted else since + until
        reason = f"{item.app} was {event}; what it lost, if anything, cannot be seen here"
        span, remedy = (start_ns, end_ns), revival(case, item.app, restarts=item.restarted)
        yield warning(reason, item.witness, hop=item.app, span=span, remedy=remedy)


def _command_of(case: Case, loss: Loss, app: str) -> str:
    """Return the command that ended an application when it lost messages; empty if nothing names it."""
    mine = [item for item in case.outages if item.app == app and item.start_ns <= loss.end_ns]
    over = [item.witness for item in mine if item.end_ns is None or item.end_ns >= loss.start_ns]
    match = _COMMAND.search("\n".join((*loss.evidence, *over[::-1])))
    return match[0] if match else ""


START_AGAIN: Final = "start cFS again, not that application alone: see its console, often a socket is in use"


def revival(case: Case, app: str, *, restarts: bool = False) -> str:
    """Return what helps: to start it again where it still does not run."""
    last = next((item for item in reversed(case.outages) if item.app == app), None)
    stands = app in STARTS and last is not None and last.end_ns is None and not restarts
    enable = case.inject(ENABLE_OUTPUT) if app.startswith("TO_") else ""
    if not stands:
        after = f"enable it again after it restarts: {enable}"
        return after if enable else "send nothing while an application does not run"
    if app in command_ingest.NAMES:
        return "start cFS again, or CI from cFS's own side: while CI is stopped, no command gets in"
    line = case.inject("es-start-app", app)
    again = f"start it again, and a second later enable it: {line}; {enable}"
    return again if enable else f"start it again: {line}"
