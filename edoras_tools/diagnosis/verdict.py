"""Verdicts: the findings of a diagnosis, one for each rule, route and span of time; and their choice."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from enum import IntEnum
from functools import partial
from itertools import groupby
from typing import TYPE_CHECKING, Any, Final, Literal, TypedDict

import msgspec
from msgspec.structs import replace

from edoras_tools.wire.arrays import by_key

if TYPE_CHECKING:
    from typing_extensions import Unpack

Confidence = Literal["high", "medium", "low"]


class Severity(IntEnum):
    """The importance of a verdict."""

    HABIT = 0
    """Normal for these senders; nothing is wrong with this link."""
    NOTE = 1
    """Worth knowing; nothing was lost by it."""
    SECURITY = 2
    """Who can do what on the link. The link itself works, so this does not change the exit code."""
    WARNING = 3
    """Unusual, refused, or lost at some receivers only."""
    ERROR = 4
    """Data was lost or garbled."""

    @property
    def label(self) -> str:
        """``habit``, ``note``, ``security``, ``warning`` or ``error``."""
        return self.name.lower()


class Advice(msgspec.Struct, frozen=True):
    """Advice on one queue.

    Attributes:
        why: capacity of the queue, and whether that was measured.
        remedy: change to make; lines to paste come last.
        left: number of messages that would still be lost, by the queue model; None if unknown.
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
    """One finding of a rule, with its evidence.

    Attributes:
        severity: importance.
        reason: one sentence with the fact, the place and the cause.
        msg_id: MsgId of the route; None if it concerns no single one.
        topic: configured topic of the route, or None; ``judge`` fills in that of ``msg_id``.
        link: label of the link, or None.
        hop: place: a pipe, a process, a part of the network; or None.
        lost: number of messages lost; None if nothing counts them.
        of: number of messages sent; None if unknown.
        span: capture times of the first and the last sign, ns; ``judge`` replaces ``WHOLE`` by the capture's.
        evidence: facts that prove it, one sentence each.
        remedy: change to make.
        confidence: ``high``: counted, or reported by cFS; ``medium``: deduced from traffic; ``low``: likely.
        rule: name of the rule, as in its page of documentation; ``judge`` fills it in.
        cause: kind of the loss that it explains, as in ``lost_by`` of the balance; else empty.
        by_type: whether it rests on the mission's types alone, which may be wrong: ``lost`` then has only
            messages that did not arrive by counts and datagrams.
        advice: advice on the queue that lost the messages; None without any.
        spacecraft: number of the spacecraft; None if there is only one.
        perhaps: number of messages that it may have cost; nothing shows whether it did.
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
    perhaps: int = 0

    @property
    def start_ns(self) -> int:
        """Capture time of the first sign, ns."""
        return self.span[0]

    @property
    def end_ns(self) -> int:
        """Capture time of the last sign, ns."""
        return self.span[1]

    @property
    def key(self) -> tuple[str, int | None, str | None, str | None]:
        """The subject without its time: equal for all spans of one problem."""
        return self.rule, self.msg_id, self.link, self.hop

    @property
    def rank(self) -> tuple[bool, int, bool]:
        """The order for people, least first: the capture itself, then by severity."""
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
    """The optional attributes of ``Verdict``."""

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
    """Return a verdict; ``error``, ``warning``, ``note``, ``habit`` and ``security`` set the severity.

    Args:
        severity: importance.
        reason: one sentence with the fact, the place and the cause.
        evidence: facts that prove it, one sentence each; empty ones are left out.
        place: label of the link and the hop, in place of ``link`` and ``hop``.
        about: other attributes of the verdict.
    """
    if place:
        about["link"], about["hop"] = place
    return Verdict(severity, reason, evidence=tuple(filter(None, evidence)), **about)


error = partial(verdict, Severity.ERROR)
warning = partial(verdict, Severity.WARNING)
note = partial(verdict, Severity.NOTE)
habit = partial(verdict, Severity.HABIT)
security = partial(verdict, Severity.SECURITY)
QUOTING_RULE: Final = "cfs_errors"
"""The rule that quotes error events of cFS: its verdicts come behind the others of equal severity."""
CAPTURE_RULES: Final = frozenset({"not_examined", "capture_drops", "cut_frames", "out_of_order"})
"""Rules about the capture itself, which qualify all other verdicts."""
NOTHING_SENT: Final = "nothing", "has a value that was sent"
"""Two parts of the reason of a verdict on a way on which no message arrives with its original values."""
ONE_BY_ONE: Final = frozenset({"bad_command", "bad_network_message"})
"""Rules whose verdicts are about single datagrams, and are never grouped."""


def group_verdicts(verdicts: Iterable[Verdict]) -> list[list[Verdict]]:
    """Return the verdicts in the order for people; the spans of one problem are one group."""

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
    """Return lists of the groups with one rule and severity, in the same order."""
    return list(by_key(groups, lambda members: (members[0].severity, members[0].rule)).values())


class Choice(msgspec.Struct, frozen=True):
    """A choice of the links, MsgIds and DDS topics to show.

    Attributes:
        text: description of the choice for people.
        takes: function that returns whether something is shown. It gets the label of a link, a MsgId (None if
            unknown) and, for DDS, a topic; and ``spacecraft``, if it is not the first.
    """

    text: str
    takes: Callable[..., bool]

    def of(self, spacecraft: int) -> Choice:
        """Return the choice for one spacecraft."""
        return replace(self, takes=partial(self.takes, spacecraft=spacecraft))
