"""Drafts expectations from a good run: what held in it, with room for the differences between two runs.

A draft passes on its own recording. What was lost in it becomes a bound, and the draft says so. But it never
allows that traffic was left out because nobody named its port: a check would be green for what nobody looked
at.
"""

from __future__ import annotations

import json
import math
import re
from typing import TYPE_CHECKING, Final

from edoras_tools.addons.check.expectations import LOSS_KEYS
from edoras_tools.addons.check.observation import Examined, Subject, examine_or_count
from edoras_tools.addons.check.run import NOTABLE_FINDINGS, Figures, Parts
from edoras_tools.cfs.names import message_name
from edoras_tools.diagnosis.verdict import Severity
from edoras_tools.model import NO_MSG_ID, NO_ROUTE
from edoras_tools.pipelines.capture.info import Counting
from edoras_tools.pipelines.names import PacketKinds, SampleTopics

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from edoras_tools.decode.context import Context
    from edoras_tools.io import Source
    from edoras_tools.pipelines.capture.ledger import Ledger
    from edoras_tools.pipelines.doctor.scope import Scope
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.render.terminal.text import Progress

_ROOM: Final = 0.2
"""Share by which a rate may differ from that of the good run."""
_TIMES: Final = 2
"""How many times the good run's latency and silence are accepted, and ``_LEAST_S`` more."""
_LEAST_S: Final = 1.0
_FEWEST: Final = 5
"""A topic with fewer messages has no rate."""


class Draft:
    """Expectations from a good run.

    Attributes:
        text: of the file.
        notes: what the draft accepts although it is no good run's, a line each.
        findings: of the doctor.
    """

    def __init__(self, ledger: Ledger, context: Context, findings: Examined, name: str) -> None:
        self.findings = findings
        self._diagnosis = findings.diagnosis
        self._parts = Parts(ledger, findings.diagnosis)
        self.notes: list[str] = []
        self._ledger, self._context, self._mission = ledger, context, context.mission
        self.text = "".join(f"{line}\n" for line in self._lines(name))

    def _lines(self, name: str) -> Iterator[str]:
        yield f"# What edoras check expects, drafted from {_one_line(name)}."
        yield "schema: 1"
        subjects = self._subjects()
        if subjects:
            yield "topics:"
        for subject in subjects:
            yield from self._topic(subject)
        diagnosis = self._diagnosis
        if diagnosis is None:
            self.notes.append(
                "the recording has messages and no datagrams: losses, latencies, events, findings and "
                "verdicts are not observable in it, so the draft expects nothing of them"
            )
            return
        findings = sorted(NOTABLE_FINDINGS & self._ledger.findings.keys())
        grave = {item.rule for item in diagnosis.verdicts if item.severity >= Severity.WARNING}
        if diagnosis.unnamed:
            grave.discard("not_examined")
            self.notes.append(
                "this run does not meet the draft, which is incomplete: name the ports, and draft again"
            )
        yield from self._losses("capture", Figures.whole(self._ledger, diagnosis), "")
        yield from self._allowed("findings", findings)
        yield from self._allowed("verdicts", sorted(grave))

    def _subjects(self) -> list[Subject]:
        """Return the configured topics that are there, and other messages that are not cFS's own."""
        routes = sorted({item.route for item in self._ledger.accounts.values()} - {NO_ROUTE})
        others = sorted(
            {
                item.msg_id
                for item in self._ledger.accounts.values()
                if item.route == NO_ROUTE and item.msg_id != NO_MSG_ID and not message_name(item.msg_id)
            }
            - {self._mission.routes[index].msg_id for index in routes}
        )
        topics: dict[str, list[int]] = {}
        silent = [item.topic for index, item in enumerate(self._mission.routes) if index not in routes]
        self.notes += [f"{topic}: no message in this run, so nothing is expected of it" for topic in silent]
        for index in routes:
            topics.setdefault(self._mission.routes[index].topic, []).append(index)
        return [
            *(Subject(topic, PacketKinds(frozenset(own))) for topic, own in topics.items()),
            *map(Subject.of, others),
            *self._sample_subjects(),
        ]

    def _sample_subjects(self) -> Iterator[Subject]:
        """Yield the topics of samples."""
        if self._diagnosis is not None:
            context = self._context
            names = dict.fromkeys(item.topic for item in self._diagnosis.capture.samples())
            for topic in names:
                if topic.startswith("/"):
                    samples = SampleTopics.of(topic, context)
                    yield Subject(samples.pattern, PacketKinds(samples=(samples,)))

    def _topic(self, subject: Subject) -> Iterator[str]:
        figures = Figures.of(subject, self._parts)
        yield f"  {_key(subject.name)}:"
        yield "    count: at least 1"
        if figures.count >= _FEWEST and figures.rate:
            low, high = figures.rate * (1 - _ROOM), figures.rate * (1 + _ROOM)
            yield f"    rate: {_down(low)}..{_up(high)}"
            yield f"    silence: at most {_up(_TIMES * figures.silence + _LEAST_S)}s"
        if figures.size is not None:
            low, high = figures.size
            yield f"    size: {low}" if low == high else f"    size: {low}..{high}"
        if figures.latency is not None:
            yield f"    latency: at most {_up(_TIMES * figures.latency + _LEAST_S)}s"
        yield from self._losses(subject.name, figures, "    ")

    def _losses(self, name: str, figures: Figures, indent: str) -> Iterator[str]:
        for key in LOSS_KEYS if figures.sent else ():
            number = getattr(figures, key)
            if key == "lost" and figures.not_counted:
                self.notes.append(
                    f"{name}: what was lost is {figures.not_counted}, so the draft has no bound"
                )
                continue
            if not number:
                yield f"{indent}{key}: 0"
                continue
            share = min(100, _up(number / figures.sent * 100))
            share_text = f"{number:,} of {figures.sent:,} {key}"
            yield f"{indent}{key}: at most {share}%  # {share_text} here"
            self.notes.append(f"{name}: {share_text}; the draft accepts up to {share}%")

    def _allowed(self, key: str, names: list[str]) -> Iterator[str]:
        yield f"{key}: [{', '.join(names)}]"
        if names:
            self.notes.append(f"{key} that the draft allows because this run has them: {', '.join(names)}")


def draft(
    source: Source,
    bench: Workbench,
    *,
    scope: Scope | None = None,
    progress: Progress | None = None,
) -> Draft:
    """Read a source to its end and draft expectations from it; the source is closed."""
    counting = Counting(source, bench)
    findings = examine_or_count(source, bench, counting, scope=scope, progress=progress)
    return Draft(counting.report.ledger, bench.columns.context, findings, source.info.name)


def _down(value: float) -> float:
    """Return a value of three digits at most, not above it."""
    return _rounded(value, math.floor)


def _up(value: float) -> float:
    """Return a value of three digits at most, not below it."""
    return _rounded(value, math.ceil)


def _rounded(value: float, how: Callable[[float], int]) -> float:
    digits = 2 - math.floor(math.log10(value)) if value > 0 else 0
    scale = 10.0**digits
    rounded = how(value * scale) / scale
    return int(rounded) if rounded == int(rounded) else rounded


def _key(name: str) -> str:
    return name if re.fullmatch(r"[\w/.-]+", name) else json.dumps(name)


def _one_line(name: str) -> str:
    return "".join(char if char.isprintable() else "?" for char in name)
