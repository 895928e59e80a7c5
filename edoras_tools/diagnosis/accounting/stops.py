"""What was sent to something that did not run or did not listen, and what nobody can follow after that.

Rules:

1. Where it can be seen what comes out: from what arrived last before an application stopped to what arrives
   first after it, nothing arrived.
2. Elsewhere what was sent after its end, and before the command that starts it again, is lost, if this
   application surely takes it: events name its pipe for the MsgId, or there is one application that stopped
   and one such MsgId. What was sent just before either may have been taken, and so may all that is sent while
   one restarts: no event tells when it ended.
3. Elsewhere it is unaccounted for what was sent since the first stop and is not lost by rule 2: whether an
   application that was started again took it, or whether it was for the one that stopped, nothing shows.
   So it is after a command that stops one, where no event that answers it can be read.
4. What came over SBN, or was to leave over it, is lost while SBN was stopped, and while the peer that it was
   for was away or had not subscribed to it: the timeline says when. Of what an application that keeps the
   newest was to send, that is one message a round.
5. What an application was to send on by Telemetry Output is lost while that was stopped, sent nothing until
   it was enabled, or had no entry for it: it did not come out, and could not.
"""

from __future__ import annotations

from dataclasses import dataclass
from operator import itemgetter
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from edoras_tools.cfs import command_ingest, executive_services, names, sbn, telemetry_output
from edoras_tools.diagnosis.accounting.closed import silences_of
from edoras_tools.diagnosis.accounting.fates import WAITS_NS, Fate, loss_of
from edoras_tools.diagnosis.accounting.losses import TAIL_NS, Known, Loss, LossKind
from edoras_tools.diagnosis.evidence.timeline.reasons import Way, reasons_for
from edoras_tools.diagnosis.evidence.timeline.table import NEVER
from edoras_tools.model import NO_ROUTE
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.evidence.timeline.table import Timeline
    from edoras_tools.diagnosis.matching.crossing import Hop


_LINKS: Final = frozenset({*command_ingest.NAMES, *telemetry_output.NAMES, sbn.NAME})
"""Applications whose stops other accounts follow: CI's by its counter, Telemetry Output's by its port."""
_CLOSED: Final[Mapping[str, tuple[int, LossKind, str]]] = {
    "app": (0, "stopped", sbn.NAME),
    "peer": (1, "away", "SBN peer"),
    "subscription": (2, "unsubscribed", "SBN peer"),
}
"""Kind of the subject that was closed to which of several is the cause, the kind of the loss, and where."""
_LEAST_ROUNDS: Final = 5
_FASTER: Final = 1.25
"""Messages that come faster than rounds by this give way to newer ones."""
_COMMAND_NS: Final = 10 * SECOND
"""An application that is told to stop may take so long."""


@dataclass(frozen=True, slots=True)
class Outage:
    """A time in which an application did not run.

    Attributes:
        app: its name.
        start_ns: told to stop, or said to have.
        end_ns: said to have started again; None where it was not.
        ended_ns: it surely took nothing from then on,
        asked_ns: until then, where it started again: it was told to, or could take what CI had not read.
        witness: commands and events that show it.
        system: number of the cFS that it is of.
        restarted: whether it was restarted, and not stopped.
    """

    app: str
    start_ns: int
    end_ns: int | None
    ended_ns: int
    asked_ns: int
    witness: str
    system: int
    restarted: bool = False


def outages(timeline: Timeline, begin_ns: int) -> list[Outage]:
    """Return every stop and restart that is sure, the earliest first.

    Args:
        begin_ns: when the capture begins.
    """
    items = []
    for system, subject in timeline.subjects:
        changes = timeline.of(subject, system) if subject.kind == "app" else ()
        for state in ("stopped", "restarting"):
            items += [
                Outage(
                    subject.name,
                    span.start_lo,
                    span.end_hi if span.end else None,
                    span.start_hi,
                    span.end_lo,
                    span.change.witness,
                    system,
                    restarted=state == "restarting",
                )
                for span in timeline.spans(subject, state, system)
                if span.change.sure or (span.end and span.end.sure)
            ]
        first = changes[0] if changes else None
        if first and first.state == "running" and first.sure and len(first.rows) > 1:
            # It was told to start: it was stopped before the capture began, or never ran.
            start_ns, end_ns = begin_ns - 1, first.not_after_ns
            items.append(
                Outage(subject.name, start_ns, end_ns, start_ns, first.not_before_ns, first.witness, system)
            )
    return sorted(items, key=lambda item: item.start_ns)


_STOPPED: Final[LossKind] = "stopped"
_RESTART_FAILED: Final[LossKind] = "restart_failed"


class _Cause(NamedTuple):
    """Why nothing got through for a time."""

    kind: LossKind
    hop: str
    evidence: tuple[str, ...]


class Stops:
    """What was sent while applications did not run or peers did not listen, and what nobody can follow.

    Attributes:
        losses: of what surely was lost so.
    """

    def __init__(self, known: Known, fates: Sequence[Fate]) -> None:
        self._known = known
        begin_ns = int(known.rows.time_ns[0]) if len(known.rows) else 0
        self._gone = [item for item in outages(known.timeline, begin_ns) if item.app not in _LINKS]
        self._causes: list[_Cause] = []
        self.losses: list[Loss] = []
        self._fates = [
            fate
            for fate in fates
            if fate.stream.known_id not in names.MSG_ID_NAMES or fate.stream.route != NO_ROUTE
        ]
        for fate in self._fates:
            for item in self._gone if fate.seen else ():
                self._mark(fate, item)
            if fate.seen:
                self._mark_closed(fate)
                self._mark_unsent(fate)
            own = [
                item
                for item in self._gone
                if known.into_system(fate.stream, item.system)
                and item.app not in executive_services.SCHEDULERS
            ]
            if not own and not fate.seen:
                _asked(known, fate)
            if own and not fate.seen:
                alone = sum(not other.seen and other.stream.link is fate.stream.link for other in self._fates)
                self.losses += _unfollowed(known, fate, own, alone=alone == 1)

    def _mark(self, fate: Fate, item: Outage) -> None:
        """Mark the messages that an application that was stopped did not take (rule 1)."""
        times = self._known.captured(fate.stream)
        back = times[fate.arrived & (times > item.start_ns + WAITS_NS)]
        until_ns = int(back[0]) if len(back) else None
        inside = fate.open & (times > item.start_ns - WAITS_NS) & (fate.stop < 0)
        if item.app in executive_services.SCHEDULERS:
            inside &= ~fate.newer  # nobody woke the application: it kept the newest
        if until_ns is not None:
            inside &= times < until_ns
        # What arrived last was taken before it stopped.
        last = times[fate.arrived & (times <= item.start_ns + WAITS_NS)]
        inside &= times > (int(last[-1]) if len(last) else 0)
        again = np.zeros(len(times), bool)
        if item.end_ns is not None and (until_ns is None or until_ns > item.end_ns + TAIL_NS):
            again = times > item.end_ns  # it runs, and passes nothing on
        for rows, kind in ((inside & ~again, _STOPPED), (inside & again, _RESTART_FAILED)):
            if rows.any():
                fate.stop[rows] = len(self._causes)
                self._causes.append(_Cause(kind, item.app, (item.witness,)))

    def _mark_closed(self, fate: Fate) -> None:
        """Mark the messages that came over SBN, or were to leave over it, when that was closed (rule 4)."""
        known, stream = self._known, fate.stream
        system, peer = known.system(stream), known.network.identity_of.get
        every = np.ones(len(stream), bool)
        ways = [(Way(stream.msg_id, stream.link, system, to_cfs=True), every)]
        if all(hop.out.link.peers for hop in fate.hops):
            ways += [
                (
                    Way(hop.out.msg_id, hop.out.link, system, peer=peer(hop.out.receiver, "")),
                    _newest(known, fate, hop),
                )
                for hop in fate.hops
            ]
        times = known.captured(stream)
        closed = [
            (_CLOSED[reason.span.change.subject.kind], reason, newest)
            for way, newest in ways
            if way.link.peers
            for reason in reasons_for(known.timeline, way, 0, NEVER, known.at)
            if reason.span.change.subject.kind in _CLOSED and reason.span.change.state != "silent"
        ]
        for early_ns, until in ((0, "end_lo"), (WAITS_NS, "end_hi")):
            for (_, kind, hop), (span, text), newest in sorted(closed, key=itemgetter(0)):
                inside = fate.open & ~fate.newer & (fate.stop < 0)
                inside &= (times > span.start_lo - early_ns) & (times < getattr(span, until))
                fate.newer |= inside & ~newest
                inside &= newest
                cause = _Cause(kind, hop, (text,))
                if inside.any() and cause not in self._causes:
                    self._causes.append(cause)
                if inside.any():
                    fate.stop[inside] = self._causes.index(cause)

    def _mark_unsent(self, fate: Fate) -> None:
        """Mark the messages that Telemetry Output was not to send (rule 5)."""
        known, outs = self._known, [hop.out for hop in fate.hops]
        if not all(out.link.only_from_cfs for out in outs):
            return
        spans: set[tuple[int, int, LossKind, str]] = {
            (*item, "disabled", f"Telemetry Output sent nothing until it was enabled, {known.at(item[1])}")
            for out in outs
            for item in silences_of(known, out.sender)
        }
        stopped = []
        for out in outs:
            way = Way(out.msg_id, out.link, known.system(fate.stream))
            for span, text in reasons_for(known.timeline, way, 0, NEVER, known.at):
                if span.change.subject.kind == "entry" or (span.change.state == "stopped" and not span.end):
                    kind: LossKind = "stopped" if span.change.state == "stopped" else "disabled"
                    spans.add((span.start_lo, span.end_lo, kind, text))
                elif span.change.state == "stopped":
                    stopped.append(span)  # what is missing from counts tells of that
        times = known.captured(fate.stream)
        for start_ns, end_ns, kind, text in sorted(spans):
            inside = fate.open & (fate.stop < 0) & (times > start_ns) & (times < end_ns)
            if inside.any() and not any(span.overlaps(start_ns, end_ns) for span in stopped):
                fate.stop[inside] = len(self._causes)
                self._causes.append(_Cause(kind, telemetry_output.NAME, (text,)))

    def tell(self) -> None:
        """Make losses of what was marked, did not come out by the counts there, and no counter has."""
        for fate in self._fates:
            open_ = fate.open & ~fate.passed
            for place in np.unique(fate.stop[open_ & (fate.stop >= 0)]).tolist():
                rows = np.flatnonzero(open_ & (fate.stop == place))
                fate.claim(rows)
                kind, hop, evidence = self._causes[place]
                self.losses.append(loss_of(self._known, fate, kind, rows, list(evidence), hop=hop))


def _newest(known: Known, fate: Fate, hop: Hop) -> NDArray[np.bool_]:
    """Tell which messages an application that keeps the newest would send: the last of each of its rounds."""
    times, out = known.captured(fate.stream), known.captured(hop.out)
    steps = np.diff(out)[hop.out.missing[:-1] == 0]
    period = int(np.median(steps)) if len(steps) >= _LEAST_ROUNDS else 0
    if not fate.newer.any() or period < _FASTER * float(np.median(np.diff(times))):
        return np.ones(len(times), bool)
    before = out[np.maximum(np.searchsorted(out, times) - 1, 0)]
    turn = (times - before) // period
    return np.append((np.diff(before) != 0) | (np.diff(turn) != 0), True)


def _asked(known: Known, fate: Fate) -> None:
    """Mark what was sent after a command that stops an application, where no event says what came of it."""
    rows = known.rows
    answers_ns = [record.time_ns for record in known.payloads.events if record.app == executive_services.NAME]
    for item in known.payloads.executive:
        when, code = int(rows.time_ns[item.row]), item.function_code
        answered = any(0 <= answer_ns - when <= _COMMAND_NS for answer_ns in answers_ns)
        ends = code in executive_services.ENDS_APP and item.app not in _LINKS
        if ends and not answered and fate.stream.receiver == rows.destination[item.row]:
            fate.unfollowed = rows.time_ns[fate.stream.rows] > when
            fate.unfollowed_since = (
                f"packet {rows.number[item.row]}: {rows.msg_id[item.row]:#06x}, function code "
                f"{code}, for {item.app}; no event that answers it can be read here"
            )
            return


def _unfollowed(known: Known, fate: Fate, own: Sequence[Outage], *, alone: bool) -> list[Loss]:
    """Rules 2 and 3."""
    times = known.captured(fate.stream)
    pipes = {
        reported.pipe
        for reported in known.reported_losses
        if reported.at_pipe and reported.msg_id == fate.stream.msg_id and not reported.at_output
    }
    named = [item for item in own if any(pipe.startswith(item.app) for pipe in pipes)]
    surely = named or (own if alone and len({item.app for item in own}) == 1 else [])
    losses = []
    for item in surely:
        inside = fate.open & (times > item.ended_ns)
        if item.end_ns is not None:
            inside &= times < item.asked_ns
        if (lacking := np.flatnonzero(inside)).size:
            fate.claim(lacking)
            losses.append(loss_of(known, fate, "stopped", lacking, [item.witness], hop=item.app))
    first = min(surely or own, key=lambda item: item.start_ns)
    fate.unfollowed = times > first.start_ns
    fate.unfollowed_since = first.witness
    return losses
