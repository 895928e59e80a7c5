"""Which state changes explain that messages of a MsgId do not get through, or fall silent, in a time."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final, NamedTuple

from edoras_tools.cfs import command_ingest, sbn, telemetry_output
from edoras_tools.diagnosis.evidence.timeline.table import (
    EVERY,
    NEVER,
    Change,
    StateOwner,
    StateSpan,
    Timeline,
)
from edoras_tools.model import NO_MSG_ID

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from edoras_tools.model import Link

_NOT_RUNNING: Final = ("stopped", "restarting", "failed", "down", "stalled")


class Way(NamedTuple):
    """Where messages go: the MsgId, its link, the cFS, the SBN peer, the applications that handle them."""

    msg_id: int
    link: Link
    system: int = 0
    to_cfs: bool = False
    peer: str = ""
    apps: tuple[str, ...] = ()


class Reason(NamedTuple):
    """A time in a state in which messages do not get through, and the line that says so."""

    span: StateSpan
    text: str


def reasons_for(
    timeline: Timeline, way: Way, start_ns: int, end_ns: int, at: Callable[[int], str]
) -> list[Reason]:
    """Return every state that explains it, the earliest first.

    Args:
        start_ns: when the first message did not get through,
        end_ns: and when the last did not.
        at: writes a time for people.
    """
    found = [
        Reason(span, reason_text(span, at))
        for system, subject, states in _blocking(way)
        for state in states
        for span in _spans(timeline, subject, state, system)
        if span.overlaps(start_ns, end_ns)
    ]
    return sorted(found, key=lambda item: item.span[:2])


def _spans(timeline: Timeline, subject: StateOwner, state: str, system: int) -> list[StateSpan]:
    """Return the times of a subject in a state; what is done to all entries of a table is done to each."""
    if subject.kind != "entry":
        return timeline.spans(subject, state, system)
    both = [*timeline.of(subject, system), *timeline.of(StateOwner("entry"), system)]
    return Timeline(replace(item, subject=subject) for item in both).spans(subject, state, system)


def _blocking(way: Way) -> Iterator[tuple[int, StateOwner, Sequence[str]]]:
    """Yield what messages need on a way, and the states in which it does not let them through."""
    yield EVERY, StateOwner("capture"), ("away",)
    yield way.system, StateOwner("cfs"), _NOT_RUNNING
    for app in way.apps:
        yield way.system, StateOwner("app", app), _NOT_RUNNING
    if way.link.only_to_cfs:
        for app in command_ingest.NAMES:
            yield way.system, StateOwner("app", app), _NOT_RUNNING
    elif way.link.only_from_cfs:
        for app in telemetry_output.NAMES:
            yield way.system, StateOwner("app", app), _NOT_RUNNING
        yield way.system, StateOwner("output"), ("disabled", "suppressed")
        yield way.system, StateOwner("entry", "", way.msg_id), ("unsubscribed",)
    elif way.link.peers:
        yield way.system, StateOwner("app", sbn.NAME), _NOT_RUNNING
        if way.peer and not way.to_cfs:
            yield way.system, StateOwner("peer", way.peer), ("silent", "timed_out", "disconnected")
            yield way.system, StateOwner("subscription", way.peer, way.msg_id), ("unsubscribed",)


def subject_name(subject: StateOwner) -> str:
    """Return how people are told of a subject."""
    number = "" if subject.msg_id == NO_MSG_ID else f"0x{subject.msg_id:04x}"
    return {
        "cfs": "cFS",
        "app": subject.name,
        "output": "Telemetry Output",
        "entry": f"{number or 'every MsgId'} in Telemetry Output's table",
        "peer": f"SBN peer {subject.name}",
        "subscription": f"{number} for SBN peer {subject.name}",
        "events": f"the events of {subject.name}",
        "table": f"table {subject.name}",
        "clock": "cFS's clock",
        "counters": f"the counters of {number}",
        "schedule": "the requests for housekeeping",
        "capture": "the capture",
        "port": f"port {subject.name}",
    }[subject.kind]


_VERBS: Final = {
    "stopped": "was stopped",
    "restarting": "was restarted",
    "failed": "had failed",
    "down": "was down",
    "stalled": "stood still",
    "disabled": "sent nothing",
    "suppressed": "sent nothing",
    "unsubscribed": "was not subscribed",
    "silent": "was silent",
    "timed_out": "was given up",
    "disconnected": "was not connected",
    "away": "saw nothing",
    "closed": "was closed",
}
"""State to how people are told of it; of others its name is."""


def reason_text(span: StateSpan, at: Callable[[int], str]) -> str:
    """Return one line: who was in which state from when to when, and what shows it."""
    change: Change = span.change
    value = "" if change.value is None else f" ({change.value})"
    until = f" to {at(span.end_hi)}" if span.end_hi != NEVER else " on"
    verb = _VERBS.get(change.state, change.state.replace("_", " "))
    return f"{subject_name(change.subject)} {verb}{value} from {at(span.start_lo)}{until}: {change.witness}"
