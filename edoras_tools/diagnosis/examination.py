"""From batches to a diagnosis, in bounded memory: what is too long is judged in chapters."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.diagnosis.accounts import accounts
from edoras_tools.diagnosis.case import Capture, Case
from edoras_tools.diagnosis.rules import (
    RULES,
    capture_drops,
    older_losses,
    to_pipe_overflow,
    topic_never_seen,
)
from edoras_tools.diagnosis.table import Recorder
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.sessions.profile import SimProfile

if TYPE_CHECKING:
    from edoras_tools.decode import Context
    from edoras_tools.model import Columns, PacketBatch

CHAPTER: Final = 1_000_000
"""Datagrams that are judged together: 100 MB. What crosses from one chapter into the next is not matched."""


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """What is wrong, where and why.

    Attributes:
        verdicts: the gravest first.
        habits: what these senders always do; nothing is wrong with this link.
        routes: the account of every route, as in ``doctor --json``.
        peers: SBN connections over time, as in ``doctor --json``.
        datagrams: how many were judged.
        start_ns: the first.
        end_ns: the last.
        capture: what is known of the capture itself.
        case: what it was judged by, for plots; of a long capture the last chapter.
        aside: messages that went down with those that verdicts are of.
    """

    verdicts: tuple[Verdict, ...]
    habits: tuple[Verdict, ...]
    routes: list[dict[str, Any]]
    peers: list[dict[str, Any]]
    datagrams: int
    start_ns: int
    end_ns: int
    capture: Capture = field(default_factory=Capture)
    case: Case | None = None
    aside: int = 0

    @property
    def lost(self) -> int:
        """Messages found lost, of all verdicts; frames that the capture itself lost are none of them."""
        told = sum(verdict.lost or 0 for verdict in self.verdicts if verdict.rule != capture_drops.ID)
        return told + self.aside

    def as_json(self) -> dict[str, Any]:
        """Return the diagnosis in the shape of ``doctor --json``."""
        return {
            "datagrams": self.datagrams,
            "start_ns": self.start_ns,
            "end_ns": self.end_ns,
            "capture_drops": self.capture.drops,
            "lost": self.lost,
            "verdicts": [verdict.as_json() for verdict in self.verdicts],
            "habits": [verdict.as_json() for verdict in self.habits],
            "routes": self.routes,
            "peers": self.peers,
        }


def judge(case: Case) -> list[Verdict]:
    """Ask every rule."""
    return [verdict for rule in RULES for verdict in rule.judge(case)] if len(case.rows) else []


class Examination:
    """Takes batches as they come; gives a diagnosis of all so far whenever it is asked.

    Args:
        context: mission, types and options, shared with the decoder.
        profile: the constants of the cFS on the link.
    """

    def __init__(self, context: Context, profile: SimProfile | None = None) -> None:
        self.context = context
        self.profile = profile or SimProfile()
        self._recorder = Recorder(context)
        self._before: list[Diagnosis] = []

    def __len__(self) -> int:
        return sum(part.datagrams for part in self._before) + len(self._recorder)

    def add(self, batch: PacketBatch, columns: Columns) -> None:
        """Take a batch and its columns."""
        if len(self._recorder) >= CHAPTER:
            self._before.append(self._chapter(Capture(), keep=False))
            self._recorder = Recorder(self.context)
        self._recorder.add(batch, columns)

    def diagnose(self, capture: Capture | None = None) -> Diagnosis:
        """Judge all that was taken."""
        capture = capture or Capture()
        last = self._chapter(capture, keep=True)
        return _joined([*self._before, last], capture) if self._before else last

    def _chapter(self, capture: Capture, *, keep: bool) -> Diagnosis:
        case = Case(self._recorder, self.profile, capture)
        found = judge(case)
        return Diagnosis(
            verdicts=_sorted(item for item in found if item.severity is not Severity.HABIT),
            habits=tuple(item for item in found if item.severity is Severity.HABIT),
            routes=accounts(case) if len(case.rows) else [],
            peers=[item.as_json() for item in case.network.connections.values()],
            datagrams=len(case.rows),
            start_ns=case.start_ns,
            end_ns=case.end_ns,
            capture=capture,
            case=case if keep else None,
            aside=to_pipe_overflow.aside(case) if len(case.rows) else 0,
        )


def _sorted(verdicts: Any) -> tuple[Verdict, ...]:
    return tuple(sorted(verdicts, key=lambda item: (-item.severity, -(item.lost or 0), item.start_ns)))


def _joined(parts: list[Diagnosis], capture: Capture) -> Diagnosis:
    """Put chapters together: sums of what counts, every verdict of each."""
    verdicts = [item for part in parts for item in part.verdicts]
    silent = [{item.topic for item in part.verdicts if item.rule == topic_never_seen.ID} for part in parts]
    never = set.intersection(*silent)
    first = {id(item) for item in parts[0].verdicts}
    kept = [
        item
        for item in verdicts
        if (item.rule != older_losses.ID or id(item) in first)
        and (item.rule != topic_never_seen.ID or (item.topic in never and id(item) in first))
    ]
    routes: dict[tuple[Any, ...], dict[str, Any]] = {}
    for row in (row for part in parts for row in part.routes):
        key = row["link"], row["msg_id"], row["sender"], row["receiver"], row["instance"]
        known = routes.setdefault(key, {**row, **dict.fromkeys(_SUMS, 0), "bytes_max": 0})
        for name in _SUMS:
            known[name] += row[name]
        known["bytes_max"] = max(known["bytes_max"], row["bytes_max"])
    habits = {(item.rule, item.msg_id, item.hop): item for part in parts for item in part.habits}
    last = parts[-1]
    return Diagnosis(
        verdicts=_sorted(kept),
        habits=tuple(habits.values()),
        routes=list(routes.values()),
        peers=[row for part in parts for row in part.peers],
        datagrams=sum(part.datagrams for part in parts),
        start_ns=parts[0].start_ns,
        end_ns=last.end_ns,
        capture=capture,
        case=last.case,
        aside=sum(part.aside for part in parts),
    )


_SUMS: Final = ("sent", "seen", "lost", "gaps", "duplicates", "reordered", "restarts")
