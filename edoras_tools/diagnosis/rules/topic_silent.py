"""A topic fell silent and no sequence count is missing: what is missing is estimated, and not counted."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from edoras_tools.cfs import telemetry_output
from edoras_tools.cfs.names import MSG_ID_NAMES
from edoras_tools.diagnosis.evidence.instances import NOBODY
from edoras_tools.diagnosis.matching.spans import steady_rate
from edoras_tools.diagnosis.rules import telemetry_vanished
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links.table import among
from edoras_tools.model import NO_ROUTE
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.matching.spans import Span
    from edoras_tools.diagnosis.matching.streams import Stream

ID = "topic_silent"
_LEAST: Final = 5
_WAIT_NS: Final = 5 * SECOND
_PERIODS: Final = 6
_IRREGULAR: Final = 3
"""What comes irregularly is silent when it is so for so many times its longest pause before,"""
_LONG_NS: Final = 10 * SECOND
"""and for so long."""
_NEAR_NS: Final = 3 * SECOND
_SLACK_NS: Final = SECOND
_ALIKE: Final = 1.5
_SAID: Final = frozenset({cfe.EVENT_MSG_ID, cfe.SHORT_EVENT_MSG_ID})
"""Events come as there is something to say."""


class Rate(NamedTuple):
    """How often a topic came, and from when to when that was seen."""

    hz: float
    start_ns: int
    end_ns: int


def judge(case: Case) -> Iterator[Verdict]:
    """Look at each topic that cFS or an SBN peer publishes, not at what an operator sends."""
    told = {item.msg_id for item in case.verdicts if item.rule == telemetry_vanished.ID}
    for stream in case.streams:
        published = stream.link.from_cfs or stream.link.peers
        # Of packets without a time nothing tells whether their cFS ran on.
        dated = stream.instance != NOBODY or not (stream.counted or stream.known_id in MSG_ID_NAMES)
        dated &= id(stream) not in case.telemetry.untold
        told_of = stream.known_id in _SAID or stream.msg_id in told
        if published and dated and len(stream) >= _LEAST and not told_of:
            yield from _silences(case, stream)


def _silences(case: Case, stream: Stream) -> Iterator[Verdict]:
    times = case.rows.time_ns[stream.rows]
    steps = np.diff(np.append(times, _ends(case, stream)))
    spans = case.known.spans(stream)
    for at in np.flatnonzero((steps > _WAIT_NS) & (stream.missing == 0)).tolist():
        until_ns = int(times[at + 1]) if at + 1 < len(times) else None
        before = [item for item in spans if item.first <= at]
        rate = _rate(stream, times, before, at)
        start_ns, length = int(times[at]), int(steps[at])
        if rate is None and not _surely_silent(stream, times[before[-1].first : at + 1], length):
            continue
        if rate is not None and length * rate.hz < _PERIODS * SECOND:
            continue
        if not _explained(case, stream, start_ns, start_ns + length) and _alive(
            case, stream, start_ns, length
        ):
            yield _verdict(case, stream, start_ns, until_ns, rate)


def _rate(stream: Stream, times: NDArray[np.int64], before: Sequence[Span], at: int) -> Rate | None:
    """Return how often a stream came before a row, if steadily; a short span may go on as an earlier one."""
    first = before[-1].first
    now_hz = (at - first) * SECOND / max(1, int(times[at] - times[first]))
    for span in reversed(before):
        last = min(span.last, at)
        hz = steady_rate(times[span.first : last + 1], int(stream.missing[span.first : last].sum()))
        if hz and (span is before[-1] or hz < _ALIKE * now_hz < _ALIKE**2 * hz):
            return Rate(hz, int(times[span.first]), int(times[last]))
    return None


def _ends(case: Case, stream: Stream) -> int:
    """Return until when the stream could have gone on: while the cFS that made it and that sent it ran."""
    ran = {stream.instance, case.known.owner(stream)} - {NOBODY}
    return min((case.instances.items[index].last_ns for index in ran), default=case.end_ns)


def _surely_silent(stream: Stream, before: NDArray[np.int64], length: int) -> bool:
    """Tell whether what came irregularly is silent for longer than ever before; housekeeping may be."""
    housekeeping = stream.known_id in MSG_ID_NAMES and stream.route == NO_ROUTE
    if housekeeping or len(before) < _LEAST:
        return False
    return length > max(_LONG_NS, _IRREGULAR * int(np.diff(before).max()))


def _explained(case: Case, stream: Stream, start_ns: int, end_ns: int) -> bool:
    """Tell whether something else tells of it: it was asked for, or what it is made from is silent too."""
    for item in case.payloads.output:
        when = int(case.rows.time_ns[item.row])
        stops = item.function_code in telemetry_output.STOPS and item.msg_id in {-1, stream.msg_id}
        if stops and start_ns - _NEAR_NS < when < end_ns:
            return True
    if any(item.start_ns < end_ns and (item.end_ns or end_ns) > start_ns for item in case.capture.outages):
        return True
    network = case.network
    if stream.link.peers and network.unsubscribed_within(stream.msg_id, start_ns - _NEAR_NS, end_ns):
        return True
    connection = network.crossing(stream.sender, stream.receiver) if stream.link.peers else None
    if connection is not None and connection.broken_within(start_ns, end_ns):
        return True  # cFS sends nothing to a peer that is away
    for hop in case.hops:
        if hop.out is stream:
            times = case.rows.time_ns[hop.into.rows]
            return not ((times > start_ns) & (times < end_ns - _SLACK_NS)).any()
    # What cFS sends to a bridge is mostly what an operator sends to cFS.
    rows = case.rows
    sent = rows.time_ns[among(rows.link, lambda link: link.only_to_cfs)]
    onward = stream.link.peers and stream.counted and len(sent) > 0
    return onward and not ((sent > start_ns) & (sent < end_ns - _SLACK_NS)).any()


def _alive(case: Case, stream: Stream, start_ns: int, length: int) -> bool:
    """Tell whether its sender, or its cFS, sent anything else meanwhile, or others did to a peer."""
    rows = case.rows
    inside = (rows.time_ns > start_ns + length // 4) & (rows.time_ns < start_ns + length)
    if not stream.link.from_cfs or stream.link.peers:
        return bool(inside.any())
    return bool((inside & (rows.link == stream.link.code) & (rows.msg_id != stream.msg_id)).any())


def _verdict(case: Case, stream: Stream, start_ns: int, until_ns: int | None, rate: Rate | None) -> Verdict:
    end_ns = until_ns or _ends(case, stream)
    seconds = (end_ns - start_ns) / SECOND
    again = f"until {case.at(until_ns)}" if until_ns else "to the end"
    evidence = [
        "no sequence count is missing: it was not published meanwhile, or had no route"
        if stream.counted
        else "it has no sequence count: nothing tells how many were sent"
    ]
    if rate is None:
        estimated, came = None, ""
        told = "it came irregularly before, so how many are missing cannot be estimated"
    else:
        estimated = max(1, int(seconds * rate.hz) - (until_ns is not None))
        came = f" came at {rate.hz:.2g} Hz and"
        told = f"about {plural(estimated, 'message')} would have come at that rate"
        evidence.append(
            f"an estimate, in no figure of the balance: {rate.hz:.3g} Hz from {case.at(rate.start_ns)} to "
            f"{case.at(rate.end_ns)}, for {seconds:.1f} s of silence"
        )
    evidence += [
        f"event {item.said}"
        for item in case.outages
        if start_ns - _NEAR_NS < item.start_ns < start_ns + 2 * _NEAR_NS
    ]
    return Verdict(
        ID,
        Severity.NOTE if rate is None else Severity.WARNING,
        f"{case.name(stream.msg_id)}{came} is silent from {case.at(start_ns)} {again}, {seconds:.1f} s: "
        f"{told}; whether its source, its robot or TO's table ended it is not observable from here",
        msg_id=stream.msg_id,
        topic=case.topic(stream.msg_id),
        link=stream.link.label,
        hop="source",
        estimated=estimated,
        start_ns=start_ns,
        end_ns=end_ns,
        evidence=tuple(evidence),
        remedy="look at the application's console and events; capture its SBN link or its input to see "
        "whether it still gets what it needs",
        confidence="low",
    )
