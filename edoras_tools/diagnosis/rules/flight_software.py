"""What stops, and what cFS says of itself: silences, restarts, errors, events that it suppresses."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from msgspec.structs import replace

from edoras_tools.cfs.commands import ENABLE_OUTPUT
from edoras_tools.cfs.event_services import SQUELCHED, EventType
from edoras_tools.cfs.executive_services import COMMAND_MSG_ID as ES_COMMAND_MSG_ID
from edoras_tools.cfs.executive_services import RESTART
from edoras_tools.cfs.names import MSG_ID_NAMES
from edoras_tools.cfs.software_bus import NAME, STOPS_AFTER
from edoras_tools.diagnosis.accounting.closed import boots
from edoras_tools.diagnosis.accounting.losses import LEAD_NS, Loss, Outage
from edoras_tools.diagnosis.advice import LET_RUN
from edoras_tools.diagnosis.case import keep_results
from edoras_tools.diagnosis.evidence.instances import NOBODY
from edoras_tools.diagnosis.evidence.loss_reports import parse_loss_event
from edoras_tools.diagnosis.evidence.timeline.table import StateOwner, Way
from edoras_tools.diagnosis.matching.streams import Span, Stream, steady_rate
from edoras_tools.diagnosis.rules.about import sent_before
from edoras_tools.diagnosis.rules.pipes import START_AGAIN, revival
from edoras_tools.diagnosis.verdict import Advice, Severity, Verdict, note, verdict, warning
from edoras_tools.links.bare import CI, ROBOT, TO
from edoras_tools.links.sbn import SBN
from edoras_tools.model import Finding
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe
from edoras_tools.wire.arrays import by_key
from edoras_tools.words import listed, plural

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.evidence.payloads import EventRecord
    from edoras_tools.wire.arrays import Integers

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
_PUBLISHER: Final = "what publishes them ended, or their sender stood still, or was cut off"
_ROBOT: Final = "the robot's states"
_LOOK_AT_NODE: Final = "look at the ROS 2 node that publishes them, and at the load of its host"
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
            before = case.verdicts[place := min(causes)[1]]
            case.verdicts[place] = replace(before, evidence=(*before.evidence, _stopped(case, members)))


def _next_ns(silence: Silence) -> int:
    """Return when the next message would have come: a cause comes before that."""
    return silence.start_ns + (_SLACK_NS + int(SECOND / silence.rate.hz) if silence.rate else _NEAR_NS)


@keep_results
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
    # It could have gone on while the cFS that made it and that sent it ran.
    ran = {stream.instance, case.owner(stream)} - {NOBODY}
    ended_ns = min((case.instances.items[index].last_ns for index in ran), default=case.end_ns)
    steps = np.diff(np.append(times, ended_ns))
    for at in np.flatnonzero((steps > _WAIT_NS) & (stream.missing == 0)).tolist():
        start_ns = int(times[at])
        until_ns = int(times[at + 1]) if at + 1 < len(times) else _again(case, stream, start_ns)
        before = [item for item in stream.spans if item.first <= at]
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
            near = max(item.start_ns - first.start_ns, abs(item.end_ns - first.end_ns)) < _NEAR_NS
            return near and (item.system, item.until_ns is None) == (first.system, first.until_ns is None)

        yield [item for item in rest if alike(item)]
        rest = [item for item in rest if not alike(item)]


def _causes(case: Case, members: Sequence[Silence]) -> list[str]:
    """Return what was stopped, closed or overwritten just before they fell silent: a half sentence each."""
    first, last = members[0].start_ns, members[-1].start_ns
    closed = [
        f"nobody listened on {span.port} at {case.at(span.start_ns)}"
        for span in case.unreachable.spans
        if span.errors and first - _NEAR_NS < span.start_ns < last + _NEAR_NS
    ]
    closed += [
        f"{case.name(item.msg_id or 0)} overran its struct at {case.at(item.start_ns)}, and what is behind"
        for item in case.verdicts
        if item.rule == "struct_overrun" and item.msg_id and abs(item.start_ns - first) < _NEAR_NS
    ]
    for item in case.passed_states:
        left, sent = (times[times < members[0].end_ns - _SLACK_NS] for times in (item.time_ns, item.sent_ns))
        if len(left) and abs(left[-1] - first) < _SLACK_NS and sent[-1] < first + _SLACK_NS:
            name = case.name(item.msg_id)
            closed.append(f"{_ROBOT} stopped at {case.at(int(sent[-1]))}, and {name} with them")
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
            later = (other.time_ns > start_ns + (end_ns - start_ns) // 4) & (other.time_ns < end_ns)
            if int(later.sum()) > _FEW and (other.time_ns <= start_ns).any():
                return True
    return False


def _again(case: Case, stream: Stream, start_ns: int) -> int | None:
    """Return when a stream went on between the same peers, from or to another port."""
    if not stream.link.peers:
        return None
    party = case.network.party
    later = [
        when
        for item in case.streams
        if (item.link, item.msg_id) == (stream.link, stream.msg_id)
        and (party(item.sender), party(item.receiver)) == (party(stream.sender), party(stream.receiver))
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


def _silent_unusually_long(stream: Stream, before: Integers, length: int) -> bool:
    """Tell whether what came irregularly is silent for longer than ever before; housekeeping may be."""
    enough = not stream.is_housekeeping and len(before) >= _LEAST
    return enough and length > max(_LONG_NS, _IRREGULAR * int(np.diff(before).max()))


def _explained(case: Case, silence: Silence) -> bool:
    """Tell whether something else tells of it: it was asked for, or what it is made from is silent too."""
    stream, start_ns, end_ns = silence.stream, silence.start_ns, silence.end_ns
    system, name = silence.system, case.network.identity_of.get
    way = Way(stream.msg_id, stream.link, system, stream.is_command, name(stream.receiver, ""))
    stalls = (item for item in case.timeline.every("stalled") if item.change.system == system)
    spans = [*case.timeline.blocking(way, start_ns, end_ns), *stalls]
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
        # It may have gone on under another name.
        others = (own.span for own in case.refused if own.rule == "unknown_peer" and own.span)
        return bool(inside.any()) and not any(abs(ns - start_ns) < _NEAR_NS for own in others for ns in own)
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
    counts = "no sequence count: nothing shows whether any were sent"
    if all(item.stream.counted for item in members):
        counts = "no sequence count is missing: nothing was published meanwhile, or nobody asked for it"
    rates = [(case.name(item.stream.msg_id), item.rate) for item in members if item.rate]
    return verdict(
        Severity.WARNING if rates and not (fed or is_said) else Severity.NOTE,
        f"{_stopped(case, members)}: {why}",
        counts,
        *(
            f"{name}: {_hz(rate.hz, 3)} from {case.at(rate.start_ns)} to {case.at(rate.end_ns)}"
            for name, rate in rates
        ),
        *(item.witness for item in outages),
        *commands,
        msg_id=first.stream.msg_id if len(members) == 1 else None,
        place=(first.stream.link.label, "source"),
        span=(first.start_ns, max(item.end_ns for item in members)),
        remedy=_LOOK_AT_NODE if fed and not outages else _remedy(case, outages, first, "; ".join(causes)),
        confidence="medium" if causes else "low",
    )


def _stopped(case: Case, members: Sequence[Silence]) -> str:
    """Return who stopped, when, and for how long."""
    first = members[0]
    names = list(dict.fromkeys(case.name(item.stream.msg_id) for item in members))
    who = names[0] if len(names) == 1 else f"{len(names)} topics ({listed(names, _NAMED)})"
    before = f" ({_hz(first.rate.hz, 2)} before)" if first.rate and len(members) == 1 else ""
    seconds = (first.end_ns - first.start_ns) / SECOND
    until = f" for {seconds:.1f} s" if first.until_ns else " and did not come back"
    return f"{who} stopped at {case.at(first.start_ns)}{until}{before}"


def _remedy(case: Case, outages: Sequence[Outage], silence: Silence, why: str) -> str:
    """Return what helps: what helps the application, where one was stopped or started again."""
    if not outages:
        if why.startswith(_ROBOT):
            return "see whether the robot, or its simulator, runs"
        return "look at the application's console and events; capture what goes into it, or its SBN link"
    runs = outages[-1].restarted or outages[-1].end_ns is not None
    return START_AGAIN if runs and not silence.until_ns else revival(case, outages[-1].app)


def cfs_restart(case: Case) -> Iterator[Verdict]:
    """A cFS started anew while the capture ran: its clock, counts and counters began again.

    Find boots of the same name, one after the other; and one whose counts alone began again.
    """
    how = "its clock went on, as after a processor reset: counts begin lower"
    for reset in case.resets:
        yield _restarted(case, reset.instance, (reset.start_ns, reset.end_ns), how)
    items = case.instances.items
    for own in by_key(range(len(items)), lambda at: case.instances.systems[at]).values():
        at = min(own, key=lambda at: items[at].first_ns)
        booted_ns, span = items[at].boot_ns(case.profile), (case.start_ns, items[at].first_ns)
        if span[0] < booted_ns < span[1] and _down(case, at, *span):
            yield _restarted(case, at, span, "its mission time began then", booted_ns)
    for before, index, boot_ns in boots(case):
        earlier, later = items[before], items[index]
        span = earlier.last_ns, later.first_ns
        if earlier.name or later.name or _down(case, index, *span):  # frames that were cut name nobody
            moved = (later.offset_ns - earlier.offset_ns) / SECOND
            how = f"mission time against the capture's moved by {moved:.1f} s"
            yield _restarted(case, index, span, how, boot_ns)


def cfs_stalled(case: Case) -> Iterator[Verdict]:
    """A whole cFS stood still while the capture ran: its host stopped or starved it.

    Name each time, and how many messages were sent into it: they wait, and then come all at once.
    """
    rows = case.rows
    for span in case.timeline.every("stalled"):
        into = rows.on(lambda link: link.only_to_cfs)
        into |= rows.on(lambda link: link.peers) & (rows.function_code >= 0)
        sent = int((into & (rows.time_ns > span.start_lo) & (rows.time_ns < span.end_hi)).sum())
        whole = span.change.subject.kind == "cfs"
        waited = f"; {plural(sent, 'message')} sent to it then had to wait" + ", and came at once" * whole
        whose = case.label(case.instances.systems.index(span.change.system))
        yield warning(
            f"{whose} {'stood still' if whole else 'hardly ran'} from {case.at(span.start_lo)} "
            f"to {case.at(span.end_hi)}{waited * bool(sent)}",
            span.change.witness,
            hop="cFS",
            span=(span.start_lo, span.end_hi),
            remedy=LET_RUN,
            confidence="medium",
        )


def _down(case: Case, instance: int, start_ns: int, end_ns: int) -> list[Loss]:
    """Return what was lost while a cFS was down, and what waited in its sockets when it ended."""
    items = zip(case.instances.items, case.instances.systems, strict=True)
    own = [item.first_ns for item, system in items if system == case.instances.systems[instance]]
    own += [reset.end_ns for reset in case.resets]
    since_ns = min(start_ns - SECOND, max((when for when in own if when < start_ns), default=start_ns))
    down = (loss for loss in case.losses if loss.kind == "down" and since_ns <= loss.start_ns <= end_ns)
    return [loss for loss in down if not loss.stream or case.goes_to(loss.stream, instance)]


def _restarted(case: Case, instance: int, span: tuple[int, int], how: str, booted_ns: int = 0) -> Verdict:
    """Return that a cFS was started; ``how`` it shows, and when, if none ran before or one still ran."""
    rows, down = case.rows, _down(case, instance, *span)
    commanded = (rows.known_id == ES_COMMAND_MSG_ID) & (rows.function_code == RESTART)
    ended_ns = min((loss.start_ns + SECOND for loss in down), default=span[1])  # later ones were lost
    commanded &= (rows.time_ns > span[0] - SECOND) & (rows.time_ns < min(ended_ns, span[1]))
    numbers = rows.number[commanded].tolist()
    lost, msg_ids = sum(loss.lost for loss in down), {loss.msg_id for loss in down}
    noun = "command" if all(loss.stream is None or loss.stream.is_command for loss in down) else "message"
    began = f"restarted between {case.at(span[0])} and {case.at(span[1])}"
    meanwhile, remedy = "counts begin again", f"enable Telemetry Output: {case.inject(ENABLE_OUTPUT)}"
    if booted_ns:
        began = f"was started at {case.at(booted_ns)}"
        if span[0] > case.start_ns:
            began += f" beside another one, which ran until {case.at(span[0])}"
            meanwhile = "only the later one gets what is sent to CI's port"
    if lost:
        span = min(loss.start_ns for loss in down), max(loss.end_ns for loss in down)
        meanwhile = f"{plural(lost, noun)} sent from {case.at(span[0])} to {case.at(span[1])} reached nobody"
        remedy = f"send nothing until cFS runs again; then {remedy}"
    return verdict(
        Severity.ERROR if lost else Severity.WARNING,
        f"{case.label(instance)} {began}: {meanwhile}",
        how,
        *(f"packet {at}: the processor was told to restart" for at in numbers),
        *dict.fromkeys(line for loss in down for line in loss.evidence),
        msg_id=down[0].msg_id if len(msg_ids) == 1 else None,
        link=down[0].stream.link.label if len(msg_ids) == 1 and down[0].stream else "ci" if down else None,
        hop="cFS",
        lost=lost or None,
        of=sum(loss.of or 0 for loss in down) or None,
        span=span,
        remedy=remedy,
        advice=Advice(f"ES RESTART (packet {numbers[0]})", remedy) if numbers else None,
    )


def not_observable(case: Case) -> Iterator[Verdict]:
    """Commands went in, and nothing that cFS says is in the capture.

    Say what cannot be known from here, and which capture point would tell.
    """
    rows = case.rows
    if case.tracks:
        return
    cut = (rows.known_id == cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID) & rows.has(Finding.CAPTURE_CUT)
    sent = int(((rows.link == CI) | ((rows.link == SBN) & (rows.function_code >= 0))).sum())
    if cut.any():
        reason = "the capture cut 0x803 before its counters: how many the software bus lost cannot be shown"
        remedy = "capture whole frames, without -s or with -s 0"
    elif not sent and not (rows.link == TO).any():
        if len(rows) and (rows.link == ROBOT).all():
            reason = "only the robot link is here: it shows neither what was sent nor what was lost"
            yield warning(reason, hop="capture", remedy="capture what goes to CI and comes from TO, too")
        return
    elif not sent:
        reason = "0x803 is not in the capture: loss inside cFS shows only where a sequence count has a gap"
        remedy = "add 0x803 and 0x808 to Telemetry Output's table"
    elif not case.has_telemetry:
        into = f"what became of {plural(sent, 'message')} into cFS cannot be shown"
        reason = f"{into}: no telemetry of that cFS is in the capture"
        link = "Telemetry Output's link too (UDP port 1235 on the ground's host)"
        remedy = f"capture {link}: 0x803 counts, 0x808 names"
    else:
        reason = "0x803 is not in the capture: how many messages the software bus lost cannot be shown"
        remedy = f"have Telemetry Output send it: {case.add_line(case.of_known(0x0803))}"
    yield note(reason, hop="capture", remedy=remedy)


_COUNTERS = {"limit": ("msg_limits", 17), "overflow": ("pipe_overflows", 25)}


def event_suppression(case: Case) -> Iterator[Verdict]:
    """An event about loss stops after 16; the loss goes on.

    Compare events with counters.
    """
    reported = case.reported_losses.items()
    for instance, track in case.tracks.items():
        for kind, (name, number) in _COUNTERS.items():
            again = case.inject("evs-reset-filters", NAME)
            reports = [own for item, own in reported if (item.instance, item.kind) == (instance, kind)]
            last_ns = max((report.last_ns for report in reports), default=0)
            events, later = sum(report.count for report in reports), track.growth(name, last_ns + LEAD_NS)
            if reports and later > 1 and track.growth(name) > events:
                yield note(
                    f"cFS reported CFE_SB {number} {plural(events, 'time')}, the last at {case.at(last_ns)}, "
                    f"while its counter grew by {track.growth(name):,}: cFS stops this event after "
                    f"{STOPS_AFTER}, until its filter is reset, and events may be lost themselves",
                    f"after the last of them +{later:,} in 0x803",
                    hop="event services",
                    span=(last_ns, track.times[-1]),
                    remedy=f"trust the counter; to hear of it again: {again}",
                )


def event_squelch(case: Case) -> Iterator[Verdict]:
    """Event Services squelched an application: it said more than 32 things at once, or 15 a second.

    Name the application whose events are not all here.
    """
    firsts: dict[tuple[str, str], EventRecord] = {}
    whole = case.start_ns, case.end_ns
    for record in case.events_between(*whole, SQUELCHED.app, event_ids=[SQUELCHED.event_id]):
        match = SQUELCHED.pattern.search(record.message)
        firsts.setdefault((record.sender, match["app"] if match else record.message), record)
    for (_, app), record in firsts.items():
        yield note(
            f"events of {app} on cFS {record.sender} are squelched: Event Services does not let all through",
            f"packet {record.number}, {case.at(record.time_ns)}: {record}",
            hop="event services",
            span=(record.time_ns, record.time_ns),
            remedy=f"do not conclude from silence of {app}; its counters go on",
        )


_GOES_ON: Final = 5
"""An error that is said so often is no single refusal."""
_SHOWN: Final = 3
_FAILED: Final = {
    8: "subscribe to fewer MsgIds, or build cFE for more (CFE_PLATFORM_SB_MAX_MSG_IDS): these come to nobody",
    15: "publish shorter messages, or build cFE for longer ones (CFE_MISSION_SB_MAX_SB_MSG_SIZE)",
    16: "let fewer or shorter messages wait, or give the bus more memory (CFE_PLATFORM_SB_BUF_MEMORY_BYTES)",
}
"""Events of CFE_SB: why a subscription failed (8), or a send before it came to a pipe, and what helps."""


def cfs_errors(case: Case) -> Iterator[Verdict]:
    """What cFS itself calls an error, and no other rule has told of: quoted, one verdict for each event.

    Go through the error and critical events; then the counters that grew without one.
    """
    quotes = {line for item in case.verdicts for line in item.evidence}
    quoted = "\n".join(quotes)
    errors = [record for record in case.payloads.events if record.event_type >= EventType.ERROR]
    told_texts = {text for text in {record.message for record in errors} if text in quoted}
    untold = (item for item in errors if item.message not in told_texts and not _is_reported(case, item))
    groups = by_key(untold, lambda item: (item.sender, item.app, item.event_id))
    yield from (_error(case, members) for members in groups.values())
    every = case.reported_losses.items()
    refused = sum(events.count for item, events in every if item.kind in {"invalid", "too_big"})
    for instance, track in case.tracks.items():
        unsent = track.growth("send_errors")
        losses = sum(track.growth(name) for name in ("msg_limits", "pipe_overflows"))
        if unsent > losses + refused and not any("sends failed" in line for line in quotes):
            reported = any(app == NAME and number in {*_FAILED} - {8} for _, app, number in groups)
            cause = "as cFS reports" if reported else "and neither a pipe nor an event says why"
            number = plural(unsent - losses - refused, "send")
            reason = f"{number} on the software bus of {case.label(instance)} failed, {cause}"
            why = f"0x803: MessageSendErrors +{unsent:,}, of them {losses:,} at pipes"
            span, remedy = (track.times[0], track.times[-1]), "look at the console of cFS"
            yield warning(reason, why, hop="software bus", span=span, remedy=remedy, confidence="medium")


def _is_reported(case: Case, record: EventRecord) -> bool:
    """Tell whether a verdict or the balance has what an event names, as by counters."""
    reported = parse_loss_event(record)
    if reported is None:
        return False
    if not reported.at_pipe:
        return any(item.msg_id == reported.msg_id and item.lost for item in case.verdicts)
    counted = case.instances.saying(record) in case.tracks
    return counted or any(loss.msg_id == reported.msg_id for loss in case.losses)


def _error(case: Case, members: list[EventRecord]) -> Verdict:
    first, last = members[0], members[-1]
    quotes = [quote for quote, _ in Counter(map(str, members)).most_common(_SHOWN + 1)]
    grave = len(members) >= _GOES_ON or any(item.event_type >= EventType.CRITICAL for item in members)
    again = f" {len(members):,} times, the last at {case.at(last.time_ns)}" if len(members) > 1 else ""
    return verdict(
        Severity.ERROR if grave else Severity.WARNING,
        f"cFS {first.sender} reports an error at {case.at(first.time_ns)}{again}: {quotes[0]}",
        *(f"event {quote}" for quote in quotes[1:]),
        *sent_before(case, first.time_ns),
        hop=first.app,
        span=(first.time_ns, last.time_ns),
        remedy=(_FAILED.get(first.event_id) if first.app == NAME else None)
        or "look at the console of cFS around that time, and at what was commanded just before",
    )
