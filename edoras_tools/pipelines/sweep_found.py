"""What a sweep found: its steps, and the limit between them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from edoras_tools.errors import EdorasError
    from edoras_tools.pipelines.sweep_evidence import Account
    from edoras_tools.pipelines.sweep_plan import Plan


@dataclass(frozen=True, slots=True)
class Step:
    """One rate and one size.

    Attributes:
        rate_hz: messages a second.
        size: bytes of their space packets.
        account: what became of them.
        hop: where most were lost; empty where none was.
        reason: why.
    """

    rate_hz: float
    size: int
    account: Account
    hop: str = ""
    reason: str = ""

    @property
    def lost(self) -> int:
        """How many were lost."""
        return self.account.lost

    def as_json(self) -> dict[str, Any]:
        """Return it in the shape of ``sweep --json``."""
        return {
            "rate_hz": self.rate_hz,
            "size": self.size,
            "sent": self.account.sent,
            "delivered": self.account.delivered,
            "lost": self.account.lost,
            "hop": self.hop or None,
            "evidence": self.account.as_json(),
        }


@dataclass(slots=True)
class Sweep:
    """What was found.

    Attributes:
        plan: what was asked for.
        steps: in the order they were done.
        watched: nothing was published for it; it only looked.
        interrupted: ended by Ctrl-C.
        failure: why it ended early.
        notes: one line each, for people.
    """

    plan: Plan
    steps: list[Step] = field(default_factory=list)
    watched: bool = False
    interrupted: bool = False
    failure: EdorasError | None = None
    notes: list[str] = field(default_factory=list)

    def value(self, step: Step) -> float:
        """Return what is swept, of a step."""
        return step.size if self.plan.by_size else step.rate_hz

    @property
    def bad(self) -> Step | None:
        """The lowest step that lost something."""
        return min((step for step in self.steps if step.lost), key=self.value, default=None)

    @property
    def good(self) -> Step | None:
        """The highest step below that one that lost nothing; None as well where nothing was ever lost."""
        bad = self.bad
        if bad is None:
            return None
        below = (step for step in self.steps if not step.lost and self.value(step) < self.value(bad))
        return max(below, key=self.value, default=None)

    @property
    def telling(self) -> Step | None:
        """The step whose hop and reason stand for all: the lowest that lost something.

        Where it only watched, that one may have begun or ended in the middle; then the fastest.
        """
        lossy = [step for step in self.steps if step.lost]
        return max(lossy, key=self.value) if self.watched and lossy else self.bad

    def note(self, text: str) -> None:
        """Tell people something, once."""
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
            "limiting_hop": telling.hop if telling else None,
            "reason": telling.reason if telling else None,
            "watched": self.watched,
            "interrupted": self.interrupted,
            "failure": str(self.failure) if self.failure else None,
            "notes": self.notes,
        }
