"""One table of state changes in time: of a cFS, its applications, tables and peers, and the capture itself.

Rules:

1. A change has an interval [not before, not after] of capture time. A command takes effect between its
   sending and the next round of its receiver. An event was sent some time before it was captured.
2. Every state has a witness. Without evidence there is no state.
3. A subject is in one state at a time. Changes are sorted; a change that repeats the state confirms it and
   never widens its interval. So the spans of a subject never overlap.
4. A boot changes the states of several subjects; ``changes`` makes a change for each of them.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from operator import attrgetter, itemgetter
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.cfs import sbn, telemetry_output
from edoras_tools.model import NO_MSG_ID, Link

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence


Kind = Literal["cfs", "app", "output", "entry", "peer", "subscription", "route", "clock", "capture"]
_BEGIN: Final = attrgetter("not_before_ns", "not_after_ns")
NEVER: Final = int(np.iinfo(np.int64).max)


class StateOwner(NamedTuple):
    """The subject that a state belongs to.

    Attributes:
        kind: ``cfs``; ``app``; ``output`` (Telemetry Output's sending); ``entry`` of its table; ``peer`` of
            SBN; ``subscription`` of a peer; ``route`` on the software bus; ``clock``; or ``capture`` (the
            interface, whose system is ``EVERY``).
        name: name of the application, or identity of the peer (``66:3``); else empty.
        msg_id: MsgId of an entry, a subscription or a route; ``NO_MSG_ID`` for all entries, or for none.
    """

    kind: Kind
    name: str = ""
    msg_id: int = NO_MSG_ID


EVERY: Final = -1
"""The system of a subject that belongs to no cFS."""


class Change(msgspec.Struct, frozen=True):
    """The change of a subject into a state.

    Attributes:
        system: number of the cFS, as in ``Instances.systems``; ``EVERY`` for the capture.
        subject: subject that changes.
        state: new state, such as ``stopped``.
        not_before_ns: capture time before which the state had certainly not begun.
        not_after_ns: capture time by which it had certainly begun.
        witness: evidence as text: commands with their arguments, events, or facts about the traffic.
        rows: rows of the table of datagrams that are the evidence, in order.
        value: limit of an entry, address of an output, or step of a clock in ns; None for other states.
        sure: whether the evidence is more than an unanswered command or a silence.
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
        """State and value, which a repeated change has in common."""
        return self.state, self.value

    @property
    def limit(self) -> int | None:
        """Limit that it sets for an entry of Telemetry Output's table; None if it sets none."""
        return self.value if isinstance(self.value, int) else None


class StateSpan(NamedTuple):
    """A time in one state.

    Attributes:
        start_lo: earliest begin, ns.
        start_hi: latest begin, ns.
        end_lo: earliest end, ns; ``NEVER`` if the state lasts to the end of the capture.
        end_hi: latest end, ns; likewise.
        change: change into the state.
        end: next change of the subject; None if there is none.
    """

    start_lo: int
    start_hi: int
    end_lo: int
    end_hi: int
    change: Change
    end: Change | None

    def overlaps(self, start_ns: int, end_ns: int) -> bool:
        """Return whether the state may have held at some time of a span."""
        return self.start_lo < end_ns and start_ns < self.end_hi


class Timeline:
    """All changes of a capture, sorted for each subject.

    Args:
        changes: changes in any order; repeated ones are merged.

    Attributes:
        subjects: (system, subject) of all that changed.
    """

    def __init__(self, changes: Iterable[Change]) -> None:
        by_subject: dict[tuple[int, StateOwner], list[Change]] = {}
        for change in sorted(changes, key=_BEGIN):
            _follow(by_subject.setdefault((change.system, change.subject), []), change)
        self._of = by_subject
        self._spans: dict[tuple[int, StateOwner, str], list[StateSpan]] = {}
        self.subjects: Sequence[tuple[int, StateOwner]] = list(by_subject)

    def of(self, subject: StateOwner, system: int = 0) -> Sequence[Change]:
        """Return the changes of a subject, in order of time."""
        return self._of.get((system, subject), ())

    def spans(self, subject: StateOwner, state: str, system: int = 0) -> list[StateSpan]:
        """Return the spans in which a subject was in a state, in order of time.

        A change of all entries of a table applies to each entry.
        """
        key = system, subject, state
        if key not in self._spans:
            own = list(self.of(subject, system))
            if subject.kind == "entry" and subject.msg_id != NO_MSG_ID:
                own.clear()
                for item in self.entry(subject.msg_id, system):
                    _follow(own, replace(item, subject=subject))
            ends = [(end.not_before_ns, end.not_after_ns, end) for end in own[1:]] + [(NEVER, NEVER, None)]
            self._spans[key] = [
                StateSpan(item.not_before_ns, item.not_after_ns, low, high, item, end)
                for item, (low, high, end) in zip(own, ends, strict=False)
                if item.state == state
            ]
        return self._spans[key]

    def within(
        self, subject: StateOwner, state: str, system: int, start_ns: int, end_ns: int
    ) -> list[StateSpan]:
        """Return those of these spans that overlap a time."""
        spans = self.spans(subject, state, system)
        first = bisect_right(spans, start_ns, key=attrgetter("end_hi"))
        return spans[first : bisect_left(spans, end_ns, key=attrgetter("start_lo"))]

    def entry(self, msg_id: int, system: int) -> list[Change]:
        """Return the changes of an entry of Telemetry Output's table, or of all entries, in order of time."""
        both = [*self.of(StateOwner("entry", "", msg_id), system), *self.of(StateOwner("entry"), system)]
        return sorted(both, key=_BEGIN)

    def blocking(self, way: Way, start_ns: int, end_ns: int) -> list[StateSpan]:
        """Return the states that may have blocked messages on a path in a span of time, in order."""
        spans = [
            span
            for system, subject, states in _blocking(way)
            for state in states
            for span in self.within(subject, state, system, start_ns, end_ns)
        ]
        return sorted(spans, key=itemgetter(0, 1))

    def every(self, *states: str) -> Iterator[StateSpan]:
        """Yield the spans of all subjects in any of some states."""
        for system, subject in self.subjects:
            for state in states:
                yield from self.spans(subject, state, system)


def _follow(before: list[Change], change: Change) -> None:
    """Append a change to the earlier ones of its subject, or merge it with the last one."""
    last = before[-1] if before else replace(change, state="", sure=True)
    ended = change.state == "stopped" and last.state == "restarting"
    if change.sure and not last.sure and (ended or last.same == change.same):
        # An answer to the command: the state had begun by then.
        before[-1] = _joined(last, replace(change, state=last.state))
    elif last.same != change.same:
        before.append(change)
    elif last.sure and not change.sure and len(last.rows) == 1 and change.not_before_ns <= last.not_after_ns:
        # The command that an event answers: the event's time is known only to one round.
        before[-1] = _joined(change, last)
    for at in range(len(before) - 1, 0, -1):
        high = before[at].not_after_ns
        if not before[-1].sure or before[at - 1].not_after_ns <= high:
            break
        # A state cannot begin later than the one behind it certainly has.
        before[at - 1] = replace(before[at - 1], not_after_ns=high)
    if len(before) > 1:
        before[-1] = _behind(before[-2], before[-1])


def _joined(command: Change, answer: Change) -> Change:
    """Return one change from a command and from the evidence that it was executed."""
    # A restart is over no earlier than its event; other commands may take effect at once.
    low = max(command.not_before_ns, answer.not_before_ns if answer.state == "running" else 0)
    return replace(
        answer,
        not_before_ns=low,
        not_after_ns=max(low, answer.not_after_ns),
        witness=f"{command.witness}; {answer.witness}",
        rows=(*command.rows, *answer.rows),
    )


def _behind(last: Change, change: Change) -> Change:
    """Return a change with its interval moved, so that no bound is before that of the last one."""
    low = max(last.not_before_ns, change.not_before_ns)
    return replace(change, not_before_ns=low, not_after_ns=max(low, last.not_after_ns, change.not_after_ns))


NOT_RUNNING: Final = ("stopped", "restarting", "failed", "down", "stalled")
"""States in which a subject takes no messages."""


class Way(NamedTuple):
    """A path of messages.

    Attributes:
        msg_id: cFE MsgId.
        link: link that carries the messages.
        system: number of the cFS.
        to_cfs: whether they go to cFS; only of interest on SBN.
        peer: identity of the SBN peer, as ``66:3``; empty elsewhere.
    """

    msg_id: int
    link: Link
    system: int = 0
    to_cfs: bool = False
    peer: str = ""


def _blocking(way: Way) -> Iterator[tuple[int, StateOwner, Sequence[str]]]:
    """Yield the subjects on a path (system and subject), with the states in which each blocks messages."""
    yield EVERY, StateOwner("capture"), ("away",)
    yield way.system, StateOwner("cfs"), NOT_RUNNING
    yield way.system, StateOwner("route", "", way.msg_id), ("cut",)
    if way.link.only_from_cfs:
        yield from ((way.system, StateOwner("app", app), NOT_RUNNING) for app in telemetry_output.NAMES)
        yield way.system, StateOwner("output"), ("disabled", "suppressed")
        yield way.system, StateOwner("entry", "", way.msg_id), ("unsubscribed",)
    elif way.link.peers:
        yield way.system, StateOwner("app", sbn.NAME), NOT_RUNNING
        if way.peer and not way.to_cfs:
            yield way.system, StateOwner("peer", way.peer), ("silent", "timed_out", "disconnected")
            yield way.system, StateOwner("subscription", way.peer, way.msg_id), ("unsubscribed",)


def subject_name(subject: StateOwner) -> str:
    """Return the name of a subject for people."""
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
"""State that explains a loss or a silence to its predicate in a sentence."""


def reason_text(span: StateSpan, at: Callable[[int], str]) -> str:
    """Return one sentence: the subject, its state, from when to when, and the evidence."""
    change = span.change
    until = f" to {at(span.end_hi)}" if span.end_hi != NEVER else " on"
    since = f"{_VERBS[change.state]} from {at(span.start_lo)}{until}"
    return f"{subject_name(change.subject)} {since}: {change.witness}"
