"""What a diagnosis says: one verdict per rule, route and span of time; and what of it is shown."""

from __future__ import annotations

from collections.abc import Callable, Iterable  # noqa: TC003  for readers of the signature
from enum import IntEnum
from functools import partial
from itertools import groupby
from typing import TYPE_CHECKING, Any, Final, Literal, TypedDict

import msgspec
from msgspec.structs import replace

from edoras_tools.wire.arrays.order import by_key

if TYPE_CHECKING:
    from typing_extensions import Unpack

Confidence = Literal["high", "medium", "low"]


class Severity(IntEnum):
    """How much a verdict matters."""

    HABIT = 0
    """What these senders always do; nothing is wrong with this link."""
    NOTE = 1
    """Worth knowing; nothing is lost by it."""
    SECURITY = 2
    """Nothing is wrong with the link: who may do what on it is. A group of its own, without an exit code."""
    WARNING = 3
    """Odd, refused, or lost at some receivers only."""
    ERROR = 4
    """Data was lost or garbled."""

    @property
    def label(self) -> str:
        """``habit``, ``note``, ``security``, ``warning`` or ``error``."""
        return self.name.lower()


class Advice(msgspec.Struct, frozen=True):
    """What to change at one queue.

    Attributes:
        why: what the queue takes, and whether that was measured.
        remedy: what to change; lines to paste come last.
        left: messages that would still be lost, by the queue model; None where it cannot tell.
    """

    why: str
    remedy: str
    left: int | None = None


WHOLE: Final = (0, 0)
"""The span of a verdict that is about the whole capture."""
_SHOWN: Final = (
    *("rule", "severity", "reason", "msg_id", "topic", "link", "hop", "lost", "of", "start_ns", "end_ns"),
    *("evidence", "remedy", "confidence"),
)


class Verdict(msgspec.Struct, frozen=True):
    """One thing that is so, and why that is believed.

    Attributes:
        severity: how much it matters.
        reason: one sentence: what, where and because of what.
        msg_id: of the route; None where it concerns no single one.
        topic: configured topic of the route, or None; ``judge`` fills in that of ``msg_id``.
        link: label of the link, or None.
        hop: where it happened: a pipe, a process, a stretch of network.
        lost: messages lost; None where that cannot be counted from here.
        of: messages sent, as far as they are known.
        span: first and last sign of it, capture time in ns; ``WHOLE`` until ``judge`` knows the capture's.
        evidence: what was seen, a line each.
        remedy: what to change.
        confidence: ``high``: counted or said by cFS; ``medium``: follows from what was seen; ``low``: likely.
        rule: name of the rule that says so, as its page of documentation has it; ``judge`` fills it in.
        cause: kind of the loss that it explains, as ``lost_by`` of the balance has it; empty otherwise.
        by_type: it follows from the types of a mission alone, which may be wrong: ``lost`` are then only
            those of which counts and datagrams show that they did not arrive.
        advice: what to change at the queue that lost them, where the queue model tells.
        spacecraft: its number, where there are several.
    """

    severity: Severity
    reason: str
    msg_id: int | None = None
    topic: str | None = None
    link: str | None = None
    hop: str | None = None
    lost: int | None = None
    of: int | None = None
    span: tuple[int, int] = WHOLE
    evidence: tuple[str, ...] = ()
    remedy: str = ""
    confidence: Confidence = "high"
    rule: str = ""
    cause: str = ""
    by_type: bool = False
    advice: Advice | None = None
    spacecraft: int | None = None

    @property
    def start_ns(self) -> int:
        """First sign of it, capture time."""
        return self.span[0]

    @property
    def end_ns(self) -> int:
        """Last sign of it."""
        return self.span[1]

    @property
    def key(self) -> tuple[str, int | None, str | None, str | None]:
        """What it is about, whenever it was: spans of one trouble share it."""
        return self.rule, self.msg_id, self.link, self.hop

    @property
    def rank(self) -> tuple[bool, int, bool]:
        """What people read first has the least: what is said of the capture itself, then what is grave."""
        return self.rule not in CAPTURE_RULES, -self.severity, self.rule == QUOTING_RULE

    def as_json(self) -> dict[str, Any]:
        """Return the verdict in the shape of ``doctor --json``."""
        return {
            **{name: getattr(self, name) for name in _SHOWN},
            "severity": self.severity.label,
            "msg_id": None if self.msg_id is None else f"0x{self.msg_id:04x}",
            "evidence": list(self.evidence),
            "estimated": None,
            **({"spacecraft": self.spacecraft} if self.spacecraft else {}),
        }


class About(TypedDict, total=False):
    """What a verdict is about, and what to do: attributes of ``Verdict``."""

    msg_id: int | None
    topic: str | None
    link: str | None
    hop: str | None
    lost: int | None
    of: int | None
    span: tuple[int, int]
    remedy: str
    confidence: Confidence
    rule: str
    cause: str
    by_type: bool
    advice: Advice | None


def verdict(
    severity: Severity,
    reason: str,
    *evidence: str,
    place: tuple[str | None, str | None] | None = None,
    **about: Unpack[About],
) -> Verdict:
    """Return a verdict; ``error``, ``warning``, ``note``, ``habit`` and ``security`` have the severity.

    Args:
        place: the link's label and the hop, where it is at both.
    """
    if place:
        about["link"], about["hop"] = place
    return Verdict(severity, reason, evidence=evidence, **about)


error = partial(verdict, Severity.ERROR)
warning = partial(verdict, Severity.WARNING)
note = partial(verdict, Severity.NOTE)
habit = partial(verdict, Severity.HABIT)
security = partial(verdict, Severity.SECURITY)
QUOTING_RULE: Final = "cfs_errors"
"""What a rule knows comes before what cFS is only quoted with."""
CAPTURE_RULES: Final = frozenset({"not_examined", "capture_drops", "cut_frames", "out_of_order"})
"""Rules about the capture itself: what they say goes for everything below."""
NOTHING_SENT: Final = "nothing", "has a value that was sent"
"""How a verdict begins, and goes on, on a way where nothing that arrives is what was sent."""
ONE_BY_ONE: Final = frozenset({"bad_command", "bad_network_message"})
"""Rules whose verdicts are about single datagrams, and are never shown together."""


def group_verdicts(verdicts: Iterable[Verdict]) -> list[list[Verdict]]:
    """Return the verdicts as people read them: the gravest first, spans of one trouble together."""

    def order(verdict: Verdict) -> tuple[Any, ...]:
        single = verdict.lost is None or verdict.rule in ONE_BY_ONE
        return (
            *verdict.rank,
            verdict.lost is None,
            verdict.rule,
            verdict.spacecraft or 0,
            verdict.link or "",
            verdict.msg_id if verdict.msg_id is not None else -1,
            verdict.hop or "",
            verdict.start_ns if single else 0,
            verdict.reason if single else "",
        )

    groups = [list(members) for _, members in groupby(sorted(verdicts, key=order), key=order)]
    groups.sort(key=lambda members: (*order(members[0])[:4], -sum(item.lost or 0 for item in members)))
    return [sorted(members, key=lambda item: item.start_ns) for members in groups]


def alike(groups: Iterable[list[Verdict]]) -> list[list[list[Verdict]]]:
    """Join the groups of one rule and severity, in the same order."""
    return list(by_key(groups, lambda members: (members[0].severity, members[0].rule)).values())


class Choice(msgspec.Struct, frozen=True):
    """Which links, MsgIds and topics of DDS are shown.

    Attributes:
        text: how people are told of it.
        takes: called with the label of a link, a MsgId (None where unknown) and, for DDS, a topic; and with
            ``spacecraft`` where it is not the first. Tells whether what they concern is shown.
    """

    text: str
    takes: Callable[..., bool]

    def of(self, spacecraft: int) -> Choice:
        """Return what is shown of one spacecraft."""
        return replace(self, takes=partial(self.takes, spacecraft=spacecraft))
