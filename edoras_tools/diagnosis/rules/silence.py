"""Telemetry and topics that stop."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from msgspec.structs import replace

from edoras_tools.cfs.names import MSG_ID_NAMES
from edoras_tools.diagnosis.evidence.instances import NOBODY
from edoras_tools.diagnosis.evidence.timeline.table import StateOwner, Way, reasons_for
from edoras_tools.diagnosis.matching.streams import Span, Stream, steady_rate
from edoras_tools.diagnosis.rules.about import sent_before
from edoras_tools.diagnosis.rules.pipes import START_AGAIN, revival
from edoras_tools.diagnosis.verdict import Severity, Verdict, verdict
from edoras_tools.units import SECOND
from edoras_tools.words import listed

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from edoras_tools.diagnosis.accounting.closed import Outage
    from edoras_tools.diagnosis.case import Case
    from edoras_tools.wire.arrays.order import Integers

_FEW: Final = 2
_NAMED: Final = 4
_LEAST: Final = 5
_WAIT_NS: Final = 5 * SECOND
_WAIT_PERIODS: Final = 6
_NEAR_NS: Final = 3 * SECOND
_NOT_STEADY: Final = frozenset(number for number, name in MSG_ID_NAMES.items() if name[-3:] != "_HK")
"""Events come as there is something to say, cFS's other telemetry as answers to commands."""


_IRREGULAR: Final = 3
"""What comes irregularly is silent when it is so for so many times its longest pause before,"""
_LONG_NS: Final = 10 * SECOND
"""and for so long."""
_PUBLISHER: Final = "the peer that sends them is there, so what publishes them ended"
_LOOK_AT_NODE: Final = "see whether the ROS 2 node that publishes them runs"
_SLACK_NS: Final = SECOND
_ALIKE: Final = 1.5


class Rate(NamedTuple):
    """How often a topic came, and from when to when that was seen."""

    hz: float
    start_ns: int
    end_ns: int


class Silence(NamedTuple):
    """A time in which nothing came of a stream, and how often it came before, if steadily.

    ``until_ns`` is None where it lasted until ``end_ns``, when its cFS or the capture ended; ``system`` is
    that cFS.
    """

    stream: Stream
    system: int
    start_ns: int
    until_ns: int | None
    end_ns: int
    rate: Rate | None


def topic_silent(case: Case) -> Iterator[Verdict]:
    """Topics fell silent and no sequence count is missing, while others go on: nothing is lost by that.

    Look at each topic that cFS or an SBN peer publishes, not at what an operator sends; tell those that fall
    silent together as one, with what was stopped or commanded then.
    """
    for members in _together([item for item in _every(case) if not _explained(case, item)]):
        causes = _causes(case, members)
        if rest := members if causes else [item for item in members if _others_go_on(case, item, members)]:
            yield _verdict(case, rest, causes)


_TELLS_CAUSE: Final = frozenset(
    {
        *("app_outage", "to_stopped", "to_not_enabled", "cfs_restart", "cfs_stalled", "port_closed"),
        *("sbn_timeout", "sbn_disconnected", "sbn_peer_restart"),
    }
)


def note_silences(case: Case) -> None:
    """Note under each verdict what fell silent with what it tells of, once all rules were asked."""
    for members in _together([item for item in _every(case) if _explained(case, item)]):
        start_ns, next_ns = members[0].start_ns, _next_ns(members[0])
        causes = [
            (abs(item.start_ns - start_ns), place)
            for place, item in enumerate(case.verdicts)
            if item.rule in _TELLS_CAUSE and item.start_ns < next_ns and item.end_ns > start_ns - _NEAR_NS
        ]
        if causes:
            place = min(causes)[1]
            text = _stopped(case, members)
            before = case.verdicts[place]
            case.verdicts[place] = replace(before, evidence=(*before.evidence, text))


def _next_ns(silence: Silence) -> int:
    """Return when the next message would have come: a cause comes before that."""
    rate = silence.rate
    return silence.start_ns + (_SLACK_NS + int(SECOND / rate.hz) if rate else _NEAR_NS)


def _every(case: Case) -> list[Silence]:
    """Return every silence of what cFS or an SBN peer publishes steadily."""
    silences: list[Silence] = []
    for stream in case.streams:
        published = stream.link.from_cfs or stream.link.peers
        # Of packets without a time nothing tells whether their cFS ran on.
        dated = stream.instance != NOBODY or not (stream.counted or stream.known_id in MSG_ID_NAMES)
        dated &= "undecided" not in case.telemetry.ends[stream]
        dated &= stream.is_command or stream.known_id not in _NOT_STEADY
        if published and dated and len(stream) >= _LEAST:
            silences += _silences(case, stream)
    return silences


def _silences(case: Case, stream: Stream) -> Iterator[Silence]:
    times = stream.time_ns
    steps = np.diff(np.append(times, _ends(case, stream)))
    spans = stream.spans
    for at in np.flatnonzero((steps > _WAIT_NS) & (stream.missing == 0)).tolist():
        start_ns = int(times[at])
        until_ns = int(times[at + 1]) if at + 1 < len(times) else _again(case, stream, start_ns)
        before = [item for item in spans if item.first <= at]
        rate = _rate(stream, times, before, at)
        length = until_ns - start_ns if until_ns else int(steps[at])
        own = times[before[-1].first : at + 1]
        if rate is None and not _silent_unusually_long(stream, own, length):
            continue
        if rate is None and np.diff(own).max() < _ALIKE * np.diff(own).min():
            rate = Rate(SECOND / float(np.diff(own).mean()), int(own[0]), int(own[-1]))
        if rate is not None and length * rate.hz < _WAIT_PERIODS * SECOND:
            continue
        if _alive(case, stream, start_ns, length):
            system = case.system(stream) if stream.is_command else case.instances.system(case.owner(stream))
            yield Silence(stream, system, start_ns, until_ns, start_ns + length, rate)


def _together(silences: Sequence[Silence]) -> Iterator[list[Silence]]:
    """Yield those that fell silent at one time and came back at one time, or not."""
    rest = sorted(silences, key=lambda item: item.start_ns)
    while rest:
        first = rest[0]

        def alike(item: Silence, first: Silence = first) -> bool:
            near = item.start_ns - first.start_ns < _NEAR_NS
            back = abs(item.end_ns - first.end_ns) < _NEAR_NS
            same = (item.system, item.until_ns is None) == (first.system, first.until_ns is None)
            return near and back and same

        yield [item for item in rest if alike(item)]
        rest = [item for item in rest if not alike(item)]


def _causes(case: Case, members: Sequence[Silence]) -> list[str]:
    """Return what was stopped, closed or overwritten just before they fell silent: a half sentence each."""
    first, last = members[0].start_ns, members[-1].start_ns
    overruns = [item for item in case.verdicts if item.rule == "struct_overrun" and item.msg_id is not None]
    closed = [
        f"nobody listened on {span.port} at {case.at(span.start_ns)}"
        for span in case.unreachable.spans
        if first - _NEAR_NS < span.start_ns < last + _NEAR_NS
    ]
    closed += [
        f"{case.name(item.msg_id or 0)} overran its struct at {case.at(item.start_ns)}, and what is behind"
        for item in overruns
        if abs(item.start_ns - first) < _NEAR_NS
    ]
    for item in case.passed_states:
        left, sent = (times[times < members[0].end_ns - _SLACK_NS] for times in (item.time_ns, item.sent_ns))
        if len(left) and abs(left[-1] - first) < _SLACK_NS and sent[-1] < first + _SLACK_NS:
            name = case.name(item.msg_id)
            closed.append(f"the robot's states stopped at {case.at(int(sent[-1]))}, and {name} with them")
    return closed + [
        f"{item.app} was {'restarted' if item.restarted else 'stopped'} {case.end_of(item)}"
        for item in case.outages
        if item.system == members[0].system
        and item.start_ns < max(map(_next_ns, members))
        and first < item.ended_ns + _NEAR_NS
        and item.start_ns >= case.start_ns
    ]


def _others_go_on(case: Case, silence: Silence, members: Sequence[Silence]) -> bool:
    """Tell whether others than these go on: where everything ends a silence says nothing.

    Commands and topics do, and for a packet of cFS's own its others.
    """
    start_ns, end_ns = silence.start_ns, silence.end_ns
    own = {item.stream for item in members}
    for other in case.streams:
        if other not in own and (silence.stream.is_housekeeping or not other.is_housekeeping):
            times = other.time_ns
            later = (times > start_ns + (end_ns - start_ns) // 4) & (times < end_ns)
            if int(later.sum()) > _FEW and (times <= start_ns).any():
                return True
    return False


def _again(case: Case, stream: Stream, start_ns: int) -> int | None:
    """Return when a stream went on between the same peers, from or to another port."""
    if not stream.link.peers:
        return None
    party = case.network.party
    ways = party(stream.sender), party(stream.receiver)
    later = [
        when
        for item in case.streams
        if (item.link, item.msg_id) == (stream.link, stream.msg_id)
        and (party(item.sender), party(item.receiver)) == ways
        and (item.sender, item.receiver) != (stream.sender, stream.receiver)
        for when in item.time_ns[item.time_ns > start_ns][:1].tolist()
    ]
    return min(later, default=None)


def _rate(stream: Stream, times: Integers, before: Sequence[Span], at: int) -> Rate | None:
    """Return how often a stream came before a row, if steadily; a short span may go on as an earlier one."""
    first = before[-1].first
    now_hz = (at - first) * SECOND / max(1, int(times[at] - times[first]))
    for span in reversed(before):
        last = min(span.last, at)
        once = np.flatnonzero(~stream.repeats[span.first : last + 1]) + span.first
        hz = steady_rate(times[once], int(stream.missing[span.first : last].sum()))
        if hz and (span is before[-1] or hz < _ALIKE * now_hz < _ALIKE**2 * hz):
            return Rate(hz, int(times[span.first]), int(times[last]))
    return None


def _ends(case: Case, stream: Stream) -> int:
    """Return until when the stream could have gone on: while the cFS that made it and that sent it ran."""
    ran = {stream.instance, case.owner(stream)} - {NOBODY}
    return min((case.instances.items[index].last_ns for index in ran), default=case.end_ns)


def _silent_unusually_long(stream: Stream, before: Integers, length: int) -> bool:
    """Tell whether what came irregularly is silent for longer than ever before; housekeeping may be."""
    if stream.is_housekeeping or len(before) < _LEAST:
        return False
    return length > max(_LONG_NS, _IRREGULAR * int(np.diff(before).max()))


def _explained(case: Case, silence: Silence) -> bool:
    """Tell whether something else tells of it: it was asked for, or what it is made from is silent too."""
    stream, start_ns, end_ns = silence.stream, silence.start_ns, silence.end_ns
    system, name = silence.system, case.network.identity_of.get
    way = Way(stream.msg_id, stream.link, system, stream.is_command, name(stream.receiver, ""))
    spans = [item.span for item in reasons_for(case.timeline, way, start_ns, end_ns, case.at)]
    if stream.link.peers and stream.is_command:
        sender = StateOwner("peer", name(stream.sender, ""))
        for state in ("silent", "timed_out", "disconnected"):
            spans += case.timeline.spans(sender, state, system)
    closed = sum(max(0, min(item.end_hi, end_ns) - max(item.start_lo, start_ns)) for item in spans)
    if 2 * closed > end_ns - start_ns or any(item.overlaps(start_ns, start_ns + _NEAR_NS) for item in spans):
        return True
    inputs = [hop.into.time_ns for hop in case.hops if hop.out is stream]
    inputs += [item.sent_ns for item in case.passed_states if item.msg_id == stream.msg_id]
    if inputs:
        return not ((inputs[0] > start_ns) & (inputs[0] < end_ns - _SLACK_NS)).any()
    # What cFS sends to a bridge is mostly what an operator sends to cFS.
    sent = [item.time_ns for item in case.streams if item.link.only_to_cfs and len(item) >= _LEAST]
    ended = [ns for ns in sent if not ((ns > start_ns) & (ns < end_ns - _SLACK_NS)).any()]
    near = any(ns[ns <= start_ns].max(initial=0) > start_ns - _NEAR_NS for ns in ended)
    return stream.link.peers and stream.counted and (near or 0 < len(sent) == len(ended))


def _alive(case: Case, stream: Stream, start_ns: int, length: int) -> bool:
    """Tell whether its sender, or its cFS, sent anything else meanwhile, or others did to a peer."""
    rows = case.rows
    inside = (rows.time_ns > start_ns + length // 4) & (rows.time_ns < start_ns + length)
    if not stream.link.from_cfs or stream.link.peers:
        return bool(inside.any())
    return bool((inside & (rows.link == stream.link.code) & (rows.msg_id != stream.msg_id)).any())


def _hz(value: float, digits: int) -> str:
    return f"{value:,.0f} Hz" if value >= 10**digits else f"{value:.{digits}g} Hz"


def _verdict(case: Case, members: Sequence[Silence], causes: Sequence[str]) -> Verdict:
    first = members[0]
    fed = all(item.stream.link.peers and item.stream.is_command for item in members)
    commands = list(sent_before(case, first.start_ns, SECOND))
    why = "; ".join(causes) or (_PUBLISHER if fed else next(iter(commands), "the capture cannot show why"))
    outages = [item for item in case.outages if any(line.startswith(item.app) for line in causes)]
    is_said = bool(outages) and any(item.rule == "app_outage" and item.lost for item in case.verdicts)
    return verdict(
        Severity.NOTE if fed or is_said or all(item.rate is None for item in members) else Severity.WARNING,
        f"{_stopped(case, members)}: {why}",
        *_evidence(case, members),
        *(item.witness for item in outages),
        *commands,
        msg_id=first.stream.msg_id if len(members) == 1 else None,
        place=(first.stream.link.label, "source"),
        span=(first.start_ns, max(item.end_ns for item in members)),
        remedy=_LOOK_AT_NODE if fed and not outages else _remedy(case, outages, first),
        confidence="medium" if causes else "low",
    )


def _stopped(case: Case, members: Sequence[Silence]) -> str:
    """Return who stopped, when, and for how long."""
    first = members[0]
    names = [case.name(item.stream.msg_id) for item in members]
    rate = first.rate if len(members) == 1 else None
    who = names[0] if len(names) == 1 else f"{len(names)} topics ({listed(names, _NAMED)})"
    before = f" ({_hz(rate.hz, 2)} before)" if rate else ""
    seconds = (first.end_ns - first.start_ns) / SECOND
    until = f" for {seconds:.1f} s" if first.until_ns else " and did not come back"
    return f"{who} stopped at {case.at(first.start_ns)}{until}{before}"


def _evidence(case: Case, members: Sequence[Silence]) -> Iterator[str]:
    """Yield whether counts are missing, and how often each came before."""
    if all(item.stream.counted for item in members):
        yield "no sequence count is missing: nothing was published meanwhile, or nobody asked for it"
    else:
        yield "no sequence count: nothing shows whether any were sent"
    for item in members:
        if item.rate:
            times = f"from {case.at(item.rate.start_ns)} to {case.at(item.rate.end_ns)}"
            yield f"{case.name(item.stream.msg_id)}: {_hz(item.rate.hz, 3)} {times}"


def _remedy(case: Case, outages: Sequence[Outage], silence: Silence) -> str:
    """Return what helps: what helps the application, where one was stopped or started again."""
    if not outages:
        return "look at the application's console and events; capture what goes into it, or its SBN link"
    last = outages[-1]
    runs = last.restarted or last.end_ns is not None
    return START_AGAIN if runs and not silence.until_ns else revival(case, last.app)
