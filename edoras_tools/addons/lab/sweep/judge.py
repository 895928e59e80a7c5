"""The results of a step, and the limit between the steps of a sweep.

The diagnosis shows cFS's losses, with place and cause. A sweep adds what only it knows: how many messages it
sent or requested, and which came back altered.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import msgspec
from msgspec.structs import replace

from edoras_tools.cfs import command_ingest
from edoras_tools.cfs.queues import application_pipe
from edoras_tools.diagnosis.accounting.losses import CI_SOCKETS
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links.bare import TO
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Iterable

    from edoras_tools.addons.lab.sweep.observer import Mark, Observer
    from edoras_tools.addons.lab.sweep.plan import SweepPlan
    from edoras_tools.cfs.profile import SimProfile
    from edoras_tools.diagnosis.examination import Diagnosis
    from edoras_tools.errors import EdorasError
    from edoras_tools.mission import Route


_PREDICTED: Final = frozenset({"ci_cut", "ground_bridge_buffer", "flight_bridge_length"})
"""Rules about the size of a message only: no loss for a sweep, because it sees which messages get through."""
_GAPS_ONLY: Final = frozenset({"lost_after_cfs", "unexplained_gap"})


class StepOutcome(msgspec.Struct, frozen=True):
    """The fates of the messages of a step.

    Attributes:
        sent: messages to cFS, or published by it.
        delivered: messages that got through.
        lost: messages that did not.
        bus: messages lost by the software bus.
        gaps: messages missing by their sequence counts.
        not_ingested: messages dropped because Command Ingest's socket was full.
        altered: messages that came back with other bytes or another length.
        unseen: messages requested and never published, or lost without any trace.
        hop: place of most losses; empty if none was lost.
        reason: cause of most losses.
        others: verdicts about other messages, or about losses that are not measured here.
    """

    sent: int
    delivered: int
    lost: int
    bus: int = 0
    gaps: int = 0
    not_ingested: int = 0
    altered: int = 0
    unseen: int = 0
    hop: str = ""
    reason: str = ""
    others: tuple[Verdict, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Return the evidence in the shape of ``sweep --json``."""
        return {
            "software_bus": self.bus,
            "sequence_gaps": self.gaps,
            "not_ingested": self.not_ingested,
            "altered": self.altered,
            "without_trace": self.unseen,
        }


class Judge:
    """Judges the steps of one route.

    Args:
        profile: constants of the cFS at the other end.
        measures: whether the limit of an application's pipe is measured, not taken from the profile.
    """

    def __init__(self, route: Route, profile: SimProfile, *, measures: bool) -> None:
        self._route, self._profile, self._measures = route, profile, measures

    def commands(
        self, observer: Observer, before: Mark, after: Mark, *, sent: int, rate_hz: float
    ) -> StepOutcome:
        """Judge messages to cFS.

        Args:
            before: counts at the start of the step.
            after: counts when no message of the step was in transit any more.
            sent: number of messages of the route.
            rate_hz: messages of the route per second.
        """
        diagnosis = observer.diagnose(self._profile)
        ours, others = self._divided(diagnosis)
        main = _main(ours)
        by_cfs = min(sent, sum(verdict.lost or 0 for verdict in ours))
        if main is not None and main.rule == "app_pipe_limit" and self._measures:
            pipe = application_pipe(self._profile, over_network=self._route.link.peers)
            limit = max(1, round((sent - by_cfs) / max(1, sent) * rate_hz * pipe.round_ns / SECOND))
            measured = replace(self._profile, app_msg_limit=limit)
            main = _main(self._divided(observer.diagnose(measured))[0]) or main
        not_ingested = sum(verdict.lost or 0 for verdict in ours if verdict.hop in CI_SOCKETS)
        altered = (after.arrived - before.arrived) - (after.whole - before.whole)
        lost = min(sent, by_cfs + altered)
        hop, reason = _cause(main)
        if main is None and altered:
            hop, reason = command_ingest.NAME, f"the echo differs from byte {after.differs_at} on"
            cut = next((item for item in diagnosis.verdicts if item.rule == "ci_cut"), None)
            if cut and after.differs_at == self._profile.ci_buffer:
                hop, reason = _cause(cut)
        return StepOutcome(
            sent,
            sent - lost,
            lost,
            bus=by_cfs - not_ingested,
            not_ingested=not_ingested,
            altered=altered,
            hop=hop,
            reason=reason,
            others=others,
        )

    def telemetry(
        self, observer: Observer, before: Mark, after: Mark, *, least: int = 0, requested: int = 0
    ) -> StepOutcome:
        """Judge messages from cFS.

        Args:
            before: counts at the start of the step.
            after: counts when no message of the step was in transit any more.
            least: messages that must have been published in that time.
            requested: requested messages; 0 if others publish them and the step does not wait for the last
                ones: then only gaps count, because counters come later.
        """
        diagnosis = observer.diagnose(self._profile)
        ours, others = self._divided(diagnosis)
        main = _main(ours)
        delivered = after.whole - before.whole
        altered = after.arrived - before.arrived - delivered
        gaps = sum(
            row["gaps"]
            for row in diagnosis.routes
            if (row["link"], row["msg_id"]) == (self._route.link.label, f"0x{self._route.msg_id:04x}")
        )
        lost = (sum(verdict.lost or 0 for verdict in ours) if requested else gaps) + altered
        unseen = requested - delivered - lost if delivered + lost < least else 0
        hop = reason = ""
        if main is not None and lost:
            hop, reason = _cause(main)
        elif altered:
            hop, reason = "network", f"{altered:,} arrived with another length than they were published with"
        elif lost or unseen:
            hop, reason = self._event(diagnosis) or (
                "unknown",
                f"{lost + unseen:,} of 0x{self._route.msg_id:04x} never came, and cFS reported no reason",
            )
            if not delivered and self._route.link is TO and diagnosis.case is not None:
                add = diagnosis.case.inject("to-add", f"0x{self._route.msg_id:04x}")
                reason += f"; if Telemetry Output is not to send it yet: {add}"
        return StepOutcome(
            delivered + lost + unseen,
            delivered,
            lost + unseen,
            bus=sum(verdict.lost or 0 for verdict in ours if verdict.rule not in _GAPS_ONLY),
            gaps=gaps,
            altered=altered,
            unseen=unseen,
            hop=hop,
            reason=reason,
            others=others,
        )

    def _divided(self, diagnosis: Diagnosis) -> tuple[list[Verdict], tuple[Verdict, ...]]:
        """Return the verdicts on losses of the route, and those on all other losses."""
        errors = [item for item in diagnosis.verdicts if item.severity is Severity.ERROR and item.lost]
        ours = [
            item
            for item in errors
            if (item.msg_id, item.rule in _PREDICTED) == (self._route.msg_id, False)
            and (item.link or self._route.link.label) == self._route.link.label
        ]
        others = [item for item in errors if item not in ours and item.msg_id is not None]
        if not ours and not others:
            # No other messages were sent that could be lost.
            ours = [item for item in errors if item.rule == "unattributed_loss"]
        return ours, tuple(others)

    def _event(self, diagnosis: Diagnosis) -> tuple[str, str] | None:
        """Return the hop and the reason from an event of cFS about the route, if any."""
        assert diagnosis.case is not None
        for reported, loss in diagnosis.case.reported_losses.items():
            if reported.msg_id == self._route.msg_id:
                return reported.pipe or "software bus", f"cFS said: {loss.records[0]}"
        return None


def _main(verdicts: Iterable[Verdict]) -> Verdict | None:
    return max(verdicts, key=lambda item: item.lost or 0, default=None)


def _cause(verdict: Verdict | None) -> tuple[str, str]:
    """Return the place and the cause of a loss, from a verdict on it; empty without one."""
    return (verdict.hop or "", verdict.reason) if verdict else ("", "")


class SweepStep(msgspec.Struct, frozen=True):
    """One step, at one rate and one size.

    Attributes:
        rate_hz: messages per second.
        size: bytes of their space packets.
        outcome: fates of the messages.
    """

    rate_hz: float
    size: int
    outcome: StepOutcome

    @property
    def lost(self) -> int:
        """Number of lost messages."""
        return self.outcome.lost

    def as_json(self) -> dict[str, Any]:
        """Return the step in the shape of ``sweep --json``."""
        return {
            "rate_hz": self.rate_hz,
            "size": self.size,
            "sent": self.outcome.sent,
            "delivered": self.outcome.delivered,
            "lost": self.outcome.lost,
            "hop": self.outcome.hop or None,
            "evidence": self.outcome.as_json(),
        }


class Sweep(msgspec.Struct):
    """The result of a sweep.

    Attributes:
        plan: the plan of the sweep.
        steps: steps in the order in which they ran.
        watched: whether it published nothing and only measured.
        interrupted: whether Ctrl-C ended it.
        failure: error that ended it early, if any.
        notes: for the user, one line each.
    """

    plan: SweepPlan
    steps: list[SweepStep] = msgspec.field(default_factory=list)
    watched: bool = False
    interrupted: bool = False
    failure: EdorasError | None = None
    notes: list[str] = msgspec.field(default_factory=list)

    def value(self, step: SweepStep) -> float:
        """Return a step's rate or size, whichever is swept."""
        return step.size if self.plan.by_size else step.rate_hz

    @property
    def bad(self) -> SweepStep | None:
        """The lowest step that lost something."""
        return min((step for step in self.steps if step.lost), key=self.value, default=None)

    @property
    def good(self) -> SweepStep | None:
        """The highest step below the first loss that lost nothing; None if no step lost anything."""
        bad = self.bad
        if bad is None:
            return None
        below = (step for step in self.steps if not step.lost and self.value(step) < self.value(bad))
        return max(below, key=self.value, default=None)

    @property
    def telling(self) -> SweepStep | None:
        """The step whose hop and reason are reported: the lowest that lost something.

        If the sweep only watched, that step may have started or ended in the middle; then the fastest.
        """
        lossy = [step for step in self.steps if step.lost]
        return max(lossy, key=self.value) if self.watched and lossy else self.bad

    def note(self, text: str) -> None:
        """Add a note, if it is new."""
        if text not in self.notes:
            self.notes.append(text)

    def summary(self) -> dict[str, Any]:
        """Return the shape of ``sweep --json``."""
        route, by_size = self.plan.route, self.plan.by_size
        good, bad, telling = self.good, self.bad, self.telling
        return {
            "route": route.topic,
            "msg_id": f"0x{route.msg_id:04x}",
            "type": route.type or None,
            "link": route.link.label,
            "to_cfs": self.plan.to_cfs,
            "emulated": self.plan.scenario,
            "swept": "size" if by_size else "rate",
            "steps": [step.as_json() for step in self.steps],
            "threshold_hz": good.rate_hz if good and not by_size else None,
            "first_loss_hz": bad.rate_hz if bad and not by_size else None,
            "threshold_bytes": good.size if good and by_size else None,
            "first_loss_bytes": bad.size if bad and by_size else None,
            "limiting_hop": telling.outcome.hop or None if telling else None,
            "reason": telling.outcome.reason or None if telling else None,
            "watched": self.watched,
            "interrupted": self.interrupted,
            "failure": str(self.failure) if self.failure else None,
            "notes": self.notes,
        }
