"""Telemetry and topics that stop."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from operator import itemgetter
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from edoras_tools.cfs import telemetry_output
from edoras_tools.cfs.names import MSG_ID_NAMES
from edoras_tools.diagnosis.evidence.instances import NOBODY
from edoras_tools.diagnosis.matching.spans import Span, steady_rate
from edoras_tools.diagnosis.rules.messages import struct_overrun
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links.table import among
from edoras_tools.links.to import TO
from edoras_tools.model import NO_ROUTE
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.accounting.stops import Outage
    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.matching.streams import Stream

_FIRST: Final = itemgetter(0)
_FEW: Final = 2
_ABOUT: Final = 0.25
_LEAST: Final = 5
_WAIT_NS: Final = 5 * SECOND
_WAIT_PERIODS: Final = 6
_NEAR_NS: Final = 3 * SECOND
_EVENTS: Final = frozenset({cfe.EVENT_MSG_ID, cfe.SHORT_EVENT_MSG_ID})
"""They come as there is something to say, and no more of one kind once cFS has said it 16 times."""


def telemetry_vanished(case: Case) -> Iterator[Verdict]:
    """A telemetry MsgId came steadily and then never again, while the rest goes on.

    No counter has what would have come: it is estimated, and in no figure of the balance.

    Look for a stream that ended for good, and for what happened just then.
    """
    stops = case.outages
    removed = _removed(case)
    overruns: list[Verdict] | None = None
    strange = _strange(case)
    for stream in case.streams:
        if stream.link is not TO or len(stream) < _LEAST or stream.known_id in _EVENTS:
            continue
        if _asked_for(case, stream, removed) or _stopped(case, stream, stops):
            continue
        if stream.instance == NOBODY or stream.instance != case.known.owner(stream):
            continue  # handed on for a peer, which may be gone
        times = case.rows.time_ns[stream.rows]
        last_ns = int(times[-1])
        usual = (last_ns - int(times[0])) / (len(times) - 1)
        # Its own cFS goes on: another boot behind the same address would be a restart.
        alive_ns = case.instances.items[stream.instance].last_ns
        if alive_ns - last_ns < max(_WAIT_NS, _WAIT_PERIODS * usual):
            continue
        overruns = list(struct_overrun(case)) if overruns is None else overruns
        after = strange[
            bisect_right(strange, last_ns, key=_FIRST) : bisect_left(strange, last_ns + _NEAR_NS, key=_FIRST)
        ]
        size = int(case.rows.packet_length[stream.rows[-1]])
        alike = [other for _, other in after if case.rows.packet_length[other.rows[0]] == size]
        signs = list(_signs(case, stream, (last_ns, alive_ns), overruns, alike))
        if not signs:
            continue  # topic_silent tells of it
        signs += _longer(case, last_ns)
        sure = len(signs) > 1
        missed = round((alive_ns - last_ns) / usual) if usual > 0 else None
        if missed:
            signs.append(
                f"about {plural(missed, 'message')} would have come since then: an estimate, in no figure of "
                "the balance"
            )
        yield Verdict(
            Severity.ERROR,
            f"{case.name(stream.msg_id)} came every {usual / SECOND:.1f} s until {case.at(last_ns)} and "
            "never again, while other telemetry goes on: its header in the application's memory was "
            "overwritten",
            msg_id=stream.msg_id,
            link="to",
            hop="flight application",
            estimated=missed,
            span=(last_ns, alive_ns),
            evidence=tuple(signs),
            remedy="make the struct in front of it large enough (see struct_overrun), and restart the "
            "application: the MsgId does not come back by itself",
            confidence="high" if sure else "medium",
        )


def _removed(case: Case) -> dict[int, list[int]]:
    """Return when Telemetry Output was told to stop sending, in order, by MsgId; -1: all of them."""
    stops = {telemetry_output.REMOVE_PACKET, telemetry_output.REMOVE_ALL}
    found: dict[int, list[int]] = {}
    for item in case.payloads.output:
        if item.function_code in stops:
            found.setdefault(item.msg_id, []).append(int(case.rows.time_ns[item.row]))
    return {msg_id: sorted(times) for msg_id, times in found.items()}


def _asked_for(case: Case, stream: Stream, removed: Mapping[int, Sequence[int]]) -> bool:
    """Tell whether Telemetry Output was told to stop sending it."""
    last_ns = int(case.rows.time_ns[stream.rows[-1]])
    times = (removed.get(msg_id, ()) for msg_id in {-1, stream.msg_id})
    return any(
        bisect_left(item, last_ns + _NEAR_NS) > bisect_right(item, last_ns - _NEAR_NS) for item in times
    )


def _stopped(case: Case, stream: Stream, stops: Sequence[Outage]) -> bool:
    """Tell whether an application was stopped just then: another rule tells of it."""
    last_ns = int(case.rows.time_ns[stream.rows[-1]])
    return any(abs(item.start_ns - last_ns) < _NEAR_NS for item in stops)


def _strange(case: Case) -> list[tuple[int, Stream]]:
    """Return the streams from Telemetry Output that are nobody's, and when each came first, in that order."""
    found = [
        (int(case.rows.time_ns[item.rows[0]]), item)
        for item in case.streams
        if item.link is TO and item.msg_id not in MSG_ID_NAMES and case.route(item.msg_id) is None
    ]
    return sorted(found, key=_FIRST)


def _signs(
    case: Case,
    stream: Stream,
    span: tuple[int, int],
    overruns: Sequence[Verdict],
    alike: Sequence[Stream],
) -> Iterator[str]:
    """Yield what happened when it stopped: a message too long, a MsgId that is garbage.

    Args:
        span: when it did, and until when its cFS went on.
        overruns: messages that were too long for their structs.
        alike: streams of nobody's that began just then, of the same size.
    """
    last_ns, alive_ns = span
    for verdict in overruns:
        if abs(verdict.start_ns - last_ns) < _NEAR_NS and verdict.msg_id is not None:
            yield f"{case.name(verdict.msg_id)} overran its struct at {case.at(verdict.start_ns)}"
    for reported, said in case.reported_losses.items():
        internal = not reported.sender.startswith(("CI_LAB", "SBN"))
        told = internal and not reported.at_pipe
        if told and -_NEAR_NS < said.first_ns - last_ns < 2 * _NEAR_NS:
            yield f"event at {case.at(said.first_ns)}: {said.records[0]}"
    for other in alike:
        first_ns = int(case.rows.time_ns[other.rows[0]])
        yield f"0x{other.msg_id:04x}, of the same size and nobody's, came first at {case.at(first_ns)}"
    owner = case.instances.owner(stream.sender, last_ns)
    track = case.tracks.get(owner)
    if track:
        errors = track.growth("send_errors", last_ns, last_ns + 2 * _NEAR_NS)
        losses = sum(
            track.growth(name, last_ns, last_ns + 2 * _NEAR_NS) for name in ("msg_limits", "pipe_overflows")
        )
        if errors > losses:
            yield f"0x803: {errors - losses} sends failed just after, and no pipe was to blame"
        before_ns = last_ns - max(track.times[0], 2 * last_ns - alive_ns)
        before = track.growth("no_subscribers", last_ns - before_ns, last_ns)
        more = track.growth("no_subscribers", last_ns, alive_ns)
        more -= round(before * (alive_ns - last_ns) / before_ns) if before_ns > 0 else 0
        missed = (alive_ns - last_ns) / float(np.median(np.diff(case.rows.time_ns[stream.rows])))
        if more > _FEW and abs(more - missed) < _ABOUT * missed:
            yield f"0x803: from then on {more} more have no subscriber, about as many as are missing here"


def _longer(case: Case, last_ns: int) -> Iterator[str]:
    """Yield messages into cFS that were longer than all before, just when it stopped."""
    for stream in case.streams:
        if stream.link is TO:
            continue
        rows = case.rows
        times, sizes = rows.time_ns[stream.rows], rows.cdr_length[stream.rows]
        near = (times > last_ns - _NEAR_NS) & (times < last_ns + _NEAR_NS)
        before = sizes[times <= last_ns - _NEAR_NS]
        if near.any() and len(before) and int(sizes[near].max()) > int(before.max()):
            at = int(times[near][int(sizes[near].argmax())])
            text = f"{int(sizes[near].max())} bytes of CDR at {case.at(at)}, longer than any before"
            yield f"{case.name(stream.msg_id)} into cFS: {text} ({int(before.max())})"


_IRREGULAR: Final = 3
"""What comes irregularly is silent when it is so for so many times its longest pause before,"""
_LONG_NS: Final = 10 * SECOND
"""and for so long."""
_SLACK_NS: Final = SECOND
_ALIKE: Final = 1.5


class Rate(NamedTuple):
    """How often a topic came, and from when to when that was seen."""

    hz: float
    start_ns: int
    end_ns: int


def topic_silent(case: Case) -> Iterator[Verdict]:
    """A topic fell silent and no sequence count is missing: what is missing is estimated, and not counted.

    Look at each topic that cFS or an SBN peer publishes, not at what an operator sends.
    """
    told = {item.msg_id for item in case.verdicts if item.rule == "telemetry_vanished"}
    for stream in case.streams:
        published = stream.link.from_cfs or stream.link.peers
        # Of packets without a time nothing tells whether their cFS ran on.
        dated = stream.instance != NOBODY or not (stream.counted or stream.known_id in MSG_ID_NAMES)
        dated &= id(stream) not in case.telemetry.untold
        told_of = stream.known_id in _EVENTS or stream.msg_id in told
        if published and dated and len(stream) >= _LEAST and not told_of:
            yield from _silences(case, stream)


def _silences(case: Case, stream: Stream) -> Iterator[Verdict]:
    times = case.rows.time_ns[stream.rows]
    steps = np.diff(np.append(times, _ends(case, stream)))
    spans = case.known.spans(stream)
    for at in np.flatnonzero((steps > _WAIT_NS) & (stream.missing == 0)).tolist():
        start_ns = int(times[at])
        until_ns = int(times[at + 1]) if at + 1 < len(times) else _again(case, stream, start_ns)
        before = [item for item in spans if item.first <= at]
        rate = _rate(stream, times, before, at)
        length = until_ns - start_ns if until_ns else int(steps[at])
        if rate is None and not _surely_silent(stream, times[before[-1].first : at + 1], length):
            continue
        if rate is not None and length * rate.hz < _WAIT_PERIODS * SECOND:
            continue
        if not _explained(case, stream, start_ns, start_ns + length) and _alive(
            case, stream, start_ns, length
        ):
            yield _verdict(case, stream, start_ns, until_ns, rate)


def _again(case: Case, stream: Stream, start_ns: int) -> int | None:
    """Return when a stream went on between the same peers, on a TCP connection of another port."""
    if not stream.link.peers:
        return None
    party = case.network.party
    ways = party(stream.sender), party(stream.receiver)
    later = [
        int(case.rows.time_ns[item.rows[0]])
        for item in case.streams
        if (item.link, item.msg_id) == (stream.link, stream.msg_id)
        and (party(item.sender), party(item.receiver)) == ways
        and (item.sender, item.receiver) != (stream.sender, stream.receiver)
    ]
    return min((when for when in later if when > start_ns), default=None)


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


def _hz(value: float, digits: int) -> str:
    return f"{value:,.0f} Hz" if value >= 10**digits else f"{value:.{digits}g} Hz"


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
        came = f" came at {_hz(rate.hz, 2)} and"
        told = f"about {plural(estimated, 'message')} would have come at that rate"
        evidence.append(
            f"an estimate, in no figure of the balance: {_hz(rate.hz, 3)} from {case.at(rate.start_ns)} to "
            f"{case.at(rate.end_ns)}, for {seconds:.1f} s of silence"
        )
    evidence += [
        item.witness for item in case.outages if start_ns - _NEAR_NS < item.start_ns < start_ns + 2 * _NEAR_NS
    ]
    return Verdict(
        Severity.NOTE if rate is None else Severity.WARNING,
        f"{case.name(stream.msg_id)}{came} is silent from {case.at(start_ns)} {again}, {seconds:.1f} s: "
        f"{told}; whether its source, its robot or TO's table ended it is not observable from here",
        msg_id=stream.msg_id,
        link=stream.link.label,
        hop="source",
        estimated=estimated,
        span=(start_ns, end_ns),
        evidence=tuple(evidence),
        remedy="look at the application's console and events; capture its SBN link or its input to see "
        "whether it still gets what it needs",
        confidence="low",
    )
