"""What cFS says of itself: restarts, errors, events that it suppresses; and what it cannot show."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from edoras_tools.cfs.commands import ENABLE_OUTPUT
from edoras_tools.cfs.event_services import SQUELCHED, EventType
from edoras_tools.cfs.executive_services import COMMAND_MSG_ID as ES_COMMAND_MSG_ID
from edoras_tools.cfs.executive_services import RESTART
from edoras_tools.cfs.software_bus import NAME, STOPS_AFTER
from edoras_tools.diagnosis.accounting.closed import boots
from edoras_tools.diagnosis.accounting.losses import LEAD_NS, Loss
from edoras_tools.diagnosis.advice import LET_RUN
from edoras_tools.diagnosis.evidence.loss_reports import parse_loss_event
from edoras_tools.diagnosis.rules.about import sent_before
from edoras_tools.diagnosis.verdict import Severity, Verdict, note, verdict, warning
from edoras_tools.links.ci import CI
from edoras_tools.links.robot import ROBOT
from edoras_tools.links.sbn import SBN
from edoras_tools.links.to import TO
from edoras_tools.model import Finding
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe
from edoras_tools.wire.arrays.order import by_key
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.evidence.payloads import EventRecord


def cfs_restart(case: Case) -> Iterator[Verdict]:
    """A cFS started anew while the capture ran: its clock, counts and counters began again.

    Find boots of the same name, one after the other; and one whose counts alone began again.
    """
    for reset in case.resets:
        yield _restarted(
            case,
            case.label(reset.instance),
            (reset.start_ns, reset.end_ns),
            "its clock went on, as after a processor reset: counts begin lower",
        )
    items = case.instances.items
    for before, index, boot_ns in boots(case):
        earlier, later = items[before], items[index]
        span = earlier.last_ns, later.first_ns
        if earlier.name or later.name or _down(case, *span):  # frames that were cut name nobody
            moved = (later.offset_ns - earlier.offset_ns) / SECOND
            how = f"mission time against the capture's moved by {moved:.1f} s"
            yield _restarted(case, case.label(index), span, how, boot_ns)


def cfs_stalled(case: Case) -> Iterator[Verdict]:
    """A whole cFS stood still while the capture ran: its host stopped or starved it.

    Name each time, and how many messages were sent into it: they wait, and then come all at once.
    """
    rows = case.rows
    for span in case.timeline.every("stalled"):
        into = rows.on(lambda link: link.only_to_cfs)
        into |= rows.on(lambda link: link.peers) & (rows.function_code >= 0)
        sent = int((into & (rows.time_ns > span.start_lo) & (rows.time_ns < span.end_hi)).sum())
        text = f"; {plural(sent, 'message')} sent to it then had to wait, and came at once"
        waited = text if sent else ""
        whose = case.label(case.instances.systems.index(span.change.system))
        yield warning(
            f"{whose} stood still from {case.at(span.start_lo)} to {case.at(span.end_hi)}{waited}",
            span.change.witness,
            hop="cFS",
            span=(span.start_lo, span.end_hi),
            remedy=LET_RUN,
            confidence="medium",
        )


def _down(case: Case, start_ns: int, end_ns: int) -> list[Loss]:
    """Return what was lost while a cFS was down."""
    return [
        loss for loss in case.losses if loss.kind == "down" and start_ns - SECOND <= loss.start_ns <= end_ns
    ]


def _restarted(case: Case, whose: str, span: tuple[int, int], how: str, beside_ns: int = 0) -> Verdict:
    """Return that a cFS was started again; ``how`` it shows, and when, if the one before still ran."""
    rows, down = case.rows, _down(case, *span)
    commanded = (rows.known_id == ES_COMMAND_MSG_ID) & (rows.function_code == RESTART)
    commanded &= (rows.time_ns > span[0] - SECOND) & (rows.time_ns < span[1])
    lost, msg_ids = sum(loss.lost for loss in down), {loss.msg_id for loss in down}
    noun = "command" if all(loss.stream is None or loss.stream.is_command for loss in down) else "message"
    began = f"restarted between {case.at(span[0])} and {case.at(span[1])}"
    meanwhile, remedy = "counts begin again", f"enable Telemetry Output: {case.inject(ENABLE_OUTPUT)}"
    if beside_ns:
        began = f"was started at {case.at(beside_ns)} beside another one, which ran until {case.at(span[0])}"
        meanwhile = "only the later one gets what is sent to CI's port"
    if lost:
        span = min(loss.start_ns for loss in down), max(loss.end_ns for loss in down)
        times = f"from {case.at(span[0])} to {case.at(span[1])}"
        meanwhile = f"{plural(lost, noun)} sent {times} reached nobody"
        remedy = f"send nothing until cFS runs again; then {remedy}"
    return verdict(
        Severity.ERROR if lost else Severity.WARNING,
        f"{whose} {began}: {meanwhile}",
        how,
        *(f"packet {at}: the processor was told to restart" for at in rows.number[commanded].tolist()),
        *dict.fromkeys(line for loss in down for line in loss.evidence),
        msg_id=down[0].msg_id if len(msg_ids) == 1 else None,
        link=down[0].stream.link.label if len(msg_ids) == 1 and down[0].stream else "ci" if down else None,
        hop="cFS",
        lost=lost or None,
        of=sum(loss.of or 0 for loss in down) or None,
        span=span,
        remedy=remedy,
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
            reason = "only the robot link is here: nothing tells what was sent, so nothing what was lost"
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
        remedy = f"have Telemetry Output send it: {case.inject('to-add', f'0x{case.of_known(0x0803):04x}')}"
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
    15: "publish shorter messages, or build cFE for longer ones (CFE_MISSION_SB_MAX_SB_MSG_SIZE)",
    16: "let fewer or shorter messages wait, or give the bus more memory (CFE_PLATFORM_SB_BUF_MEMORY_BYTES)",
}
"""Events of CFE_SB that say why a send failed before it came to a pipe, and what helps."""


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
    for members in groups.values():
        yield _error(case, members)
    every = case.reported_losses.items()
    refused = sum(events.count for item, events in every if item.kind in {"invalid", "too_big"})
    for instance, track in case.tracks.items():
        unsent = track.growth("send_errors")
        losses = sum(track.growth(name) for name in ("msg_limits", "pipe_overflows"))
        if unsent > losses + refused and not any("sends failed" in line for line in quotes):
            reported = any(app == NAME and number in _FAILED for _, app, number in groups)
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
    texts = list(dict.fromkeys(item.message for item in members))
    grave = len(members) >= _GOES_ON or any(item.event_type >= EventType.CRITICAL for item in members)
    again = f" {len(members):,} times, the last at {case.at(last.time_ns)}" if len(members) > 1 else ""
    return verdict(
        Severity.ERROR if grave else Severity.WARNING,
        f"cFS {first.sender} reports an error at {case.at(first.time_ns)}{again}: {first}",
        *(f"event {first.app} {first.event_id}: {text}" for text in texts[1 : _SHOWN + 1]),
        *sent_before(case, first.time_ns),
        hop=first.app,
        span=(first.time_ns, last.time_ns),
        remedy=(_FAILED.get(first.event_id) if first.app == NAME else None)
        or "look at the console of cFS around that time, and at what was commanded just before",
    )
