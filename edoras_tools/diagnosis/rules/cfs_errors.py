"""What cFS itself calls an error, and no other rule has told of: quoted, one verdict for each event."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from edoras_tools.cfs.event_services import EventType
from edoras_tools.diagnosis.evidence.events import parse_loss_event
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.accounting.losses import LossKind
    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.evidence.payloads import EventRecord

ID = "cfs_errors"
_GOES_ON: Final = 5
"""An error that is said so often is no single refusal."""
_SHOWN: Final = 3


def judge(case: Case) -> Iterator[Verdict]:
    """Go through the error and critical events; then the counters that grew without one."""
    told = {line for item in case.verdicts for line in item.evidence}
    quoted = "\n".join(told)
    groups: dict[tuple[str, str, int], list[EventRecord]] = {}
    known = {(loss.kind, loss.msg_id, loss.instance) for loss in case.losses}
    for record in case.payloads.events:
        if record.event_type >= EventType.ERROR and not _is_told(case, record, quoted, known):
            groups.setdefault((record.sender, record.app, record.event_id), []).append(record)
    for members in groups.values():
        yield _verdict(case, members)
    named = (parse_loss_event(record) for record in case.payloads.events)
    refused = sum(item is not None and item.kind in {"invalid", "too_big"} for item in named)
    for instance, track in case.tracks.items():
        errors = track.growth("send_errors")
        losses = sum(track.growth(name) for name in ("msg_limits", "pipe_overflows"))
        if errors > losses + refused and not any("sends failed" in line for line in told):
            yield Verdict(
                ID,
                Severity.WARNING,
                f"{plural(errors - losses - refused, 'send')} on the software bus of {case.label(instance)} "
                "failed, and neither a pipe nor an event says why",
                hop="software bus",
                start_ns=track.times[0],
                end_ns=track.times[-1],
                evidence=(f"0x803: MessageSendErrors +{errors:,}, of them {losses:,} at pipes",),
                remedy="look at the console of cFS",
                confidence="medium",
            )


def _is_told(case: Case, record: EventRecord, quoted: str, known: set[tuple[LossKind, int, int]]) -> bool:
    """Tell whether a verdict quotes an event, or the balance has what it names."""
    if record.message in quoted:
        return True
    instance = case.instances.saying(record)
    reported = parse_loss_event(record, instance)
    if reported is None:
        return False
    if not reported.at_pipe:
        return any(item.msg_id == reported.msg_id and item.lost for item in case.verdicts)
    track = case.tracks.get(instance)
    older = track is not None and int(case.instances.made_ns[record.row]) <= track.times[0]
    return older or (reported.kind, reported.msg_id, instance) in known


def _verdict(case: Case, members: list[EventRecord]) -> Verdict:
    first, last = members[0], members[-1]
    texts = list(dict.fromkeys(item.message for item in members))
    grave = len(members) >= _GOES_ON or any(item.event_type >= EventType.CRITICAL for item in members)
    again = f" {len(members):,} times, the last at {case.at(last.time_ns)}" if len(members) > 1 else ""
    return Verdict(
        ID,
        Severity.ERROR if grave else Severity.WARNING,
        f"cFS {first.sender} reports an error at {case.at(first.time_ns)}{again}: {first}",
        hop=first.app,
        start_ns=first.time_ns,
        end_ns=last.time_ns,
        evidence=tuple(f"event {first.app} {first.event_id}: {text}" for text in texts[1 : _SHOWN + 1]),
        remedy="look at the console of cFS around that time, and at what was commanded just before",
    )
