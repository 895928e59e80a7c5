"""The result of a sweep: its steps, and the limit between them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from edoras_tools.addons.lab.sweep.judge import StepOutcome
    from edoras_tools.addons.lab.sweep.plan import SweepPlan
    from edoras_tools.errors import EdorasError


@dataclass(frozen=True, slots=True)
class SweepStep:
    """One step, at one rate and one size.

    Attributes:
        rate_hz: messages per second.
        size: bytes of their space packets.
        outcome: what happened to them.
    """

    rate_hz: float
    size: int
    outcome: StepOutcome

    @property
    def lost(self) -> int:
        """How many were lost."""
        return self.outcome.lost

    def as_json(self) -> dict[str, Any]:
        """Return it in the shape of ``sweep --json``."""
        return {
            "rate_hz": self.rate_hz,
            "size": self.size,
            "sent": self.outcome.sent,
            "delivered": self.outcome.delivered,
            "lost": self.outcome.lost,
            "hop": self.outcome.hop or None,
            "evidence": self.outcome.as_json(),
        }


@dataclass(slots=True)
class Sweep:
    """The result.

    Attributes:
        plan: the plan of the sweep.
        steps: in the order in which they ran.
        watched: it published nothing and only measured.
        interrupted: whether Ctrl-C ended it.
        failure: why it ended early.
        notes: for the user, one line each.
    """

    plan: SweepPlan
    steps: list[SweepStep] = field(default_factory=list)
    watched: bool = False
    interrupted: bool = False
    failure: EdorasError | None = None
    notes: list[str] = field(default_factory=list)

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
