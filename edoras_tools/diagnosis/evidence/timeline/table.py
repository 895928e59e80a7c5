"""One table of state changes in time: of a cFS, its applications, tables and peers, the capture itself.

1. A change has an interval [not before, not after] of capture time: a command takes effect between its
   sending and the next round of who takes it, an event is said some time before it is captured.
2. Every state has a witness. What nothing shows is no state.
3. A subject is in one state at a time. Changes are put in order; one that repeats the state confirms it, and
   makes its interval no wider. So the spans of a subject never overlap.
4. What a boot ends, it ends for all subjects of its cFS; who makes the changes says so (``changes``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Literal, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.cfs import sbn, telemetry_output
from edoras_tools.model import NO_MSG_ID, Link

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence


Kind = Literal["cfs", "app", "output", "entry", "peer", "subscription", "route", "clock", "capture"]
NEVER: Final = int(np.iinfo(np.int64).max)


class StateOwner(NamedTuple):
    """What has a state.

    ``kind`` is one of: ``cfs`` itself; ``app``, an application by ``name``; ``output``, whether Telemetry
    Output sends and where to; ``entry`` of its table, by ``msg_id``, ``NO_MSG_ID`` for all of them; ``peer``
    of SBN by ``name`` (``66:3``); ``subscription`` of the peer ``name`` to ``msg_id``; ``route`` on the
    software bus, by ``msg_id``; ``clock``; or ``capture``, the interface, which is of no cFS: its system is
    ``EVERY``.
    """

    kind: Kind
    name: str = ""
    msg_id: int = NO_MSG_ID


EVERY: Final = -1
"""The system of what is of no cFS."""


class Change(msgspec.Struct, frozen=True):
    """A subject gets into a state.

    Attributes:
        system: number of the cFS, as ``Instances.systems`` has them; ``EVERY`` of the capture.
        subject: whose state it is.
        state: the state, e.g. ``stopped``.
        not_before_ns: capture time before which it was surely not yet in it.
        not_after_ns: capture time after which it surely was.
        witness: what shows it: commands with their arguments, events, what is in the traffic.
        rows: rows of the table of datagrams that show it, in order.
        value: the limit, the address or the step in ns, where the state has one.
        sure: whether more than a command without an answer, or a silence, shows it.
    """

    system: int
    subject: StateOwner
    state: str
    not_before_ns: int
    not_after_ns: int
    witness: str
    rows: tuple[int, ...] = ()
    value: int | str | None = None
    sure: bool = True

    @property
    def same(self) -> tuple[str, int | str | None]:
        """State and value."""
        return self.state, self.value


class StateSpan(NamedTuple):
    """A time in one state: it began between the first two times, and ended between the last two.

    The last two are ``NEVER`` where the state goes on to the end; ``end`` is None then.
    """

    start_lo: int
    start_hi: int
    end_lo: int
    end_hi: int
    change: Change
    end: Change | None

    def overlaps(self, start_ns: int, end_ns: int) -> bool:
        """Tell whether it may hold some of a time."""
        return self.start_lo < end_ns and start_ns < self.end_hi


class Timeline:
    """All changes of a capture, in order.

    Args:
        changes: in any order; of one subject they are put into one.

    Attributes:
        subjects: whose they are: system and subject.
    """

    def __init__(self, changes: Iterable[Change]) -> None:
        by_subject: dict[tuple[int, StateOwner], list[Change]] = {}
        for change in sorted(changes, key=lambda item: (item.not_before_ns, item.not_after_ns)):
            _follow(by_subject.setdefault((change.system, change.subject), []), change)
        self._of = by_subject
        self.subjects: Sequence[tuple[int, StateOwner]] = list(by_subject)

    def of(self, subject: StateOwner, system: int = 0) -> Sequence[Change]:
        """Return the changes of a subject, in order."""
        return self._of.get((system, subject), ())

    def spans(self, subject: StateOwner, state: str, system: int = 0) -> list[StateSpan]:
        """Return the times in which a subject was in a state."""
        own = self.of(subject, system)
        out = []
        for at, item in enumerate(own):
            if item.state == state:
                end = own[at + 1] if at + 1 < len(own) else None
                ends = (end.not_before_ns, end.not_after_ns) if end else (NEVER, NEVER)
                out.append(StateSpan(item.not_before_ns, item.not_after_ns, *ends, item, end))
        return out

    def every(self, *states: str) -> Iterator[StateSpan]:
        """Yield the times in which anything was in one of some states."""
        for system, subject in self.subjects:
            for state in states:
                yield from self.spans(subject, state, system)


def _follow(before: list[Change], change: Change) -> None:
    """Put a change behind those before it of its subject."""
    last = before[-1] if before else None
    if last is None:
        before.append(change)
        return
    if last.same != change.same:
        before.append(_behind(last, change))
    elif change.sure and not last.sure:
        # An answer: it was done by then.
        before[-1] = _joined(last, change)
    elif last.sure and not change.sure and len(last.rows) == 1 and _meet(last, change):
        # The command that an event, whose time is known to a round only, answers.
        before[-1] = _joined(change, last)
    if len(before) > 1 and before[-1].sure:
        # It was in the state before no later than it surely is in this one.
        last, change = before[-2:]
        high = max(last.not_before_ns, min(last.not_after_ns, change.not_after_ns))
        before[-2:] = replace(last, not_after_ns=high), _behind(replace(last, not_after_ns=high), change)


def _meet(one: Change, other: Change) -> bool:
    return one.not_before_ns <= other.not_after_ns and other.not_before_ns <= one.not_after_ns


def _joined(command: Change, answer: Change) -> Change:
    """Return one change from a command and what shows that it was obeyed."""
    # A restart is over when it is said; all else may be done as soon as it is asked for.
    low = max(command.not_before_ns, answer.not_before_ns if answer.state == "running" else 0)
    return replace(
        answer,
        not_before_ns=low,
        not_after_ns=max(low, answer.not_after_ns),
        witness=f"{command.witness}; {answer.witness}",
        rows=(*command.rows, *answer.rows),
    )


def _behind(last: Change, change: Change) -> Change:
    """Return a change that neither begins nor ends before the one before it."""
    low = max(last.not_before_ns, change.not_before_ns)
    return replace(change, not_before_ns=low, not_after_ns=max(low, last.not_after_ns, change.not_after_ns))


NOT_RUNNING: Final = ("stopped", "restarting", "failed", "down", "stalled")
"""States in which nothing is taken."""


class Way(NamedTuple):
    """Where messages go: the MsgId, its link, the cFS, and the SBN peer."""

    msg_id: int
    link: Link
    system: int = 0
    to_cfs: bool = False
    peer: str = ""


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
    reasons = [
        Reason(span, reason_text(span, at))
        for system, subject, states in _blocking(way)
        for state in states
        for span in _spans(timeline, subject, state, system)
        if span.overlaps(start_ns, end_ns)
    ]
    return sorted(reasons, key=lambda item: item.span[:2])


def _spans(timeline: Timeline, subject: StateOwner, state: str, system: int) -> list[StateSpan]:
    """Return the times of a subject in a state; what is done to all entries of a table is done to each."""
    if subject.kind != "entry":
        return timeline.spans(subject, state, system)
    both = [*timeline.of(subject, system), *timeline.of(StateOwner("entry"), system)]
    return Timeline(replace(item, subject=subject) for item in both).spans(subject, state, system)


def _blocking(way: Way) -> Iterator[tuple[int, StateOwner, Sequence[str]]]:
    """Yield what messages need on a way, and the states in which it does not let them through."""
    yield EVERY, StateOwner("capture"), ("away",)
    yield way.system, StateOwner("cfs"), NOT_RUNNING
    yield way.system, StateOwner("route", "", way.msg_id), ("cut",)
    if way.link.only_from_cfs:
        for app in telemetry_output.NAMES:
            yield way.system, StateOwner("app", app), NOT_RUNNING
        yield way.system, StateOwner("output"), ("disabled", "suppressed")
        yield way.system, StateOwner("entry", "", way.msg_id), ("unsubscribed",)
    elif way.link.peers:
        yield way.system, StateOwner("app", sbn.NAME), NOT_RUNNING
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
        "route": f"the route of {number} on the software bus",
        "peer": f"SBN peer {subject.name}",
        "subscription": f"{number} for SBN peer {subject.name}",
        "clock": "cFS's clock",
        "capture": "the capture",
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
    "cut": "was disabled",
}
"""State that explains a loss or a silence to how people are told of it."""


def reason_text(span: StateSpan, at: Callable[[int], str]) -> str:
    """Return one line: who was in which state from when to when, and what shows it."""
    change = span.change
    until = f" to {at(span.end_hi)}" if span.end_hi != NEVER else " on"
    since = f"{_VERBS[change.state]} from {at(span.start_lo)}{until}"
    return f"{subject_name(change.subject)} {since}: {change.witness}"
