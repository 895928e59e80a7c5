"""Ports that were closed, and hosts that could not be reached, as ICMP errors say."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.diagnosis.accounting.closed import PORT_CLOSED, REFUSED, UDP_PORT
from edoras_tools.diagnosis.evidence.timeline.table import NEVER
from edoras_tools.diagnosis.verdict import Severity, Verdict, error, verdict
from edoras_tools.units import SECOND
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.evidence.unreachable import ClosedSpan
    from edoras_tools.model import Endpoint

_MOST_NAMED = 4


def port_closed(case: Case) -> Iterator[Verdict]:
    """Nobody listened on a port for a time, as ICMP errors say; what was sent there meanwhile was lost.

    Name the port, from when to when, how many messages of which MsgIds, and whether the port itself fell
    silent.
    """
    before: dict[Endpoint, int] = {}
    for span in case.unreachable.spans:
        open_ns = before.get(span.port, 0)
        before[span.port] = span.end_ns
        lost, uncertain = (_within(case, span, open_ns, cause) for cause in (PORT_CLOSED, None))
        if not lost and not uncertain:
            continue
        again = span.end_ns != NEVER
        times = f"the first at {case.at(span.start_ns)}, the last at {case.at(span.last_ns)}"
        evidence = [
            f"{plural(span.errors, 'ICMP error')} (port unreachable), {times}",
            f"open again at {case.at(span.end_ns)}" if again else "not open again in this capture",
        ]
        if uncertain:
            evidence.append(f"{plural(uncertain.total(), 'more message')} may not have been read there")
        number = lost.total()
        names = ", ".join(f"{count:,} of {name}" for name, count in lost.most_common(_MOST_NAMED))
        more = ", ..." if len(lost) > _MOST_NAMED else ""
        until = case.at(span.end_ns) if again else "the end of the capture"
        reason = f"nobody listened on {span.port} from {case.at(span.start_ns)} to {until}"
        if number:
            reason += f": {plural(number, 'message')} reached nobody ({names}{more})"
        if span.step_ns:
            reason += f"; its own datagrams, {SECOND / span.step_ns:.1f} a second, stopped too"
        yield verdict(
            Severity.ERROR if number else Severity.WARNING,
            reason,
            *evidence,
            hop=f"{UDP_PORT} {span.port}",
            lost=number or None,
            of=number + uncertain.total(),
            span=(span.start_ns, span.last_ns),
            remedy="start the program that listens there before what sends to it; if it ended, its own log "
            "says why",
        )


def unreachable(case: Case) -> Iterator[Verdict]:
    """Datagrams came back as ICMP errors: a host, a network or a firewall on the way did not let them pass.

    Name the endpoint, how many, and what the errors say.
    """
    for item in case.unreached:
        rows = item.lost.get(REFUSED)
        if rows is None:
            continue
        endpoint = case.endpoints[item.endpoint]
        yield error(
            f"{plural(len(rows), 'message')} of {case.name(item.stream.msg_id)} did not reach {endpoint}: "
            "ICMP errors about them came back",
            "edoras sniff --link icmp shows what each error says",
            msg_id=item.stream.msg_id if item.own else None,
            link=item.stream.link.label,
            hop=f"{UDP_PORT} {endpoint}",
            lost=len(rows),
            of=len(rows),
            span=case.span(item.stream.rows[rows]),
            remedy="look at the route to that host, and at firewalls on the way",
        )


def _within(case: Case, span: ClosedSpan, open_ns: int, cause: str | None) -> Counter[str]:
    """Return how many messages of each name were lost in a span, or may be if there is no cause.

    Args:
        open_ns: when the span before it on this port ended.
    """
    found: Counter[str] = Counter()
    for item in case.unreached:
        if case.endpoints[item.endpoint] != span.port:
            continue
        rows = item.uncertain if cause is None else item.lost.get(cause, np.zeros(0, np.intp))
        times = item.sent_ns[rows]
        number = int(((times >= open_ns) & (times < span.end_ns)).sum())
        if number:
            name = case.name(item.stream.msg_id) if item.own else "robot commands"
            found[name] += number
    for loss in case.commands.losses if cause else ():
        if loss.kind == cause and loss.stream and case.endpoints[loss.stream.receiver] == span.port:
            assert loss.among is not None
            times = case.captured(loss.stream)[loss.among.rows]
            if number := int(((times >= open_ns) & (times < span.end_ns)).sum()):
                found[case.name(loss.msg_id)] += number
    return found
