"""Drafts expectations from good runs: limits that a similar next run meets (``limits``).

The recordings of a draft meet it. Their losses become bounds, and the draft notes this. But a draft never
allows traffic to be left out because nobody named its port: a check would pass for traffic that nobody
examined.

A file of expectations can be widened by a run that the user judged good: each unmet bound moves as far as a
draft from this run alone would set it. A missing topic, an event, and a filter that no draft writes, are
left to the user.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Final

from edoras_tools.addons.runs.check import NOTABLE_FINDINGS, CheckReport, CheckResult, Figures, Subject
from edoras_tools.addons.runs.differences import (
    RunLimit,
    field_filter,
    field_limit,
    loss_limits,
    topic_limits,
)
from edoras_tools.addons.runs.expectations import LOSS_KEYS, TOPIC_BOUNDS, WHOLE_BOUNDS
from edoras_tools.cfs.names import message_name
from edoras_tools.decode.filters.filter import Where
from edoras_tools.decode.filters.names import Names
from edoras_tools.decode.filters.syntax import WhereError
from edoras_tools.diagnosis.ledger import CAPTURE
from edoras_tools.diagnosis.verdict import Severity
from edoras_tools.mission.tree import LARGEST_FILE
from edoras_tools.model import NO_MSG_ID, NO_ROUTE
from edoras_tools.pipelines.selection import PacketKinds, SampleTopics
from edoras_tools.structs.shapes import Key
from edoras_tools.words import listed

if TYPE_CHECKING:
    from edoras_tools.addons.runs.expectations import Expectations, Tolerance
    from edoras_tools.addons.runs.run import Run


class Draft:
    """Expectations from good runs.

    Args:
        runs: good runs, at least one.

    Attributes:
        text: text of the file.
        notes: lines on accepted facts that are not those of a good run.
    """

    def __init__(self, runs: Sequence[Run]) -> None:
        self.runs = runs
        self._parts = [run.parts() for run in runs]
        self.notes: list[str] = []
        self._names = Names(runs[0].context)
        self.text = "".join(f"{line}\n" for line in self._lines())
        if len(self.text.encode()) > LARGEST_FILE:
            self.notes.append(
                f"a check reads {LARGEST_FILE >> 10} KiB and the draft is larger; --topic makes it shorter"
            )

    def _lines(self) -> Iterator[str]:
        names = ["".join(char if char.isprintable() else "?" for char in run.name) for run in self.runs]
        source = names[0] if len(names) == 1 else f"{len(names)} runs"
        yield f"# What edoras check expects, drafted from {source}."
        yield "schema: 1"
        if subjects := self._subjects():
            yield "topics:"
        for subject in subjects:
            yield from self._topic(subject)
        diagnoses = [run.diagnosis for run in self.runs if run.diagnosis is not None]
        if len(diagnoses) < len(self.runs):
            self.notes.append(
                "the recording has messages and no datagrams: losses, latencies, events, findings and "
                "verdicts are not observable in it, so the draft expects nothing of them"
            )
            return
        findings = {name for run in self.runs for name in NOTABLE_FINDINGS & run.ledger.findings.keys()}
        verdicts = (item for diagnosis in diagnoses for item in diagnosis.verdicts)
        grave = {item.rule for item in verdicts if item.severity >= Severity.WARNING}
        if any(diagnosis.unnamed for diagnosis in diagnoses):
            grave.discard("not_examined")
            self.notes.append(
                "this run does not meet the draft, which is incomplete: name the ports, and draft again"
            )
        whole = [run.whole() for run in self.runs]
        limits = dict(loss_limits(whole, max(run.spread() for run in self.runs)))
        yield from self._losses("capture", whole, limits, "")
        yield from self._allowed("findings", sorted(findings))
        yield from self._allowed("verdicts", sorted(grave))

    def _subjects(self) -> list[Subject]:
        """Return the topics in all runs, and other messages that are not cFS's own."""
        every = [{subject.name: subject for subject in subjects_of(run)} for run in self.runs]
        common = [name for name in every[0] if all(name in own for own in every)]
        rare = sorted({name for own in every for name in own} - {*common})
        silent = [route.topic for route in self.runs[0].context.mission.routes]
        silent = [topic for topic in dict.fromkeys(silent) if not any(topic in own for own in every)]
        where = "this run" if len(self.runs) == 1 else f"these {len(self.runs)} runs"
        absent = {f"no message was examined in {where}": silent, "not in all runs": rare}
        for why, names in absent.items():
            if names:
                self.notes.append(f"nothing is expected of {listed(names)}: {why}")
        return [every[0][name] for name in common]

    def _topic(self, subject: Subject) -> Iterator[str]:
        figures = [Figures.of(subject, parts) for parts in self._parts]
        yield f"  {key_text(subject.name)}:"
        yield "    count: at least 1"
        limits = _topic_limits(self.runs, subject, figures)
        for key, limit in limits.items():
            if key not in LOSS_KEYS:
                yield f"    {key}: {limit.text(TOPIC_BOUNDS[key])}  # {limit.why}"
        yield from self._losses(subject.name, figures, limits, "    ")
        names = self._names.of_types(subject.packets.types(self.runs[0].context.mission))
        fields = [
            f"      - always: {json.dumps(where)}  # {limit.why}"
            for name, where, limit in field_limits(self.runs, subject.name)
            if self._always(subject.name, name, figures) and _is_filter(where, names)
        ]
        yield from ["    fields:", *fields] if fields else ()

    def _always(self, topic: str, field: str, figures: Sequence[Figures]) -> bool:
        """Return whether a field has a number in each message of a topic in every run."""
        pairs = zip(self.runs, figures, strict=True)
        return all(run.values[topic].fields[field].count == own.count for run, own in pairs)

    def _losses(
        self, name: str, figures: Sequence[Figures], limits: dict[str, RunLimit], indent: str
    ) -> Iterator[str]:
        for key in LOSS_KEYS:
            missing = next((item.not_counted for item in figures if item.not_counted), "")
            if key == "lost" and missing:
                self.notes.append(f"{name}: what was lost is {missing}, so the draft has no bound")
            if key not in limits:
                continue
            limit = limits[key]
            bound = limit.text(WHOLE_BOUNDS[key])
            yield f"{indent}{key}: {bound}  # {limit.why}"
            if limit.high:
                most = bound.replace("at most", "up to")
                self.notes.append(f"{name}: {key} {limit.why}; the draft accepts {most}")

    def _allowed(self, key: str, names: list[str]) -> Iterator[str]:
        yield f"{key}: [{', '.join(names)}]"
        if names:
            have = "this run has" if len(self.runs) == 1 else "these runs have"
            self.notes.append(f"{key} that the draft allows because {have} them: {', '.join(names)}")


def _topic_limits(runs: Sequence[Run], subject: Subject, figures: Sequence[Figures]) -> dict[str, RunLimit]:
    """Return the limits of one topic by their key, for its figures in each run."""
    every, captured = (max(run.spread(subject, captured=only) for run in runs) for only in (False, True))
    return dict(topic_limits(figures, every, captured))


def _is_filter(where: str, names: Names) -> bool:
    """Return whether a filter is valid: single fields of structs in lists cannot be filtered."""
    try:
        Where(where, names.context, names=names)
    except WhereError:
        return False
    return True


def field_limits(runs: Sequence[Run], topic: str) -> Iterator[tuple[str, str, RunLimit]]:
    """Yield the fields of a topic that all runs have, with their filters and limits."""
    own = [run.values[topic] for run in runs if topic in run.values]
    if len(own) < len(runs):
        return
    for name in own[0].fields:
        if all(name in values.fields for values in own):
            fields = [values.fields[name] for values in own]
            limit = field_limit(fields, to_cfs=own[0].to_cfs)
            if limit is not None:
                yield name, field_filter(name, limit, is_flag=fields[0].is_flag), limit


def subjects_of(run: Run) -> Iterator[Subject]:
    """Yield the configured topics in a run, other messages that are not cFS's own, and samples."""
    for spacecraft in sorted({item.spacecraft for item in run.ledger.accounts.values()}):
        mission = run.context.mission.of(spacecraft)
        accounts = [item for item in run.ledger.accounts.values() if item.spacecraft == spacecraft]
        routes = sorted({item.route for item in accounts} - {NO_ROUTE})
        others = {item.msg_id for item in accounts if item.route == NO_ROUTE and item.msg_id != NO_MSG_ID}
        topics: dict[str, list[int]] = {}
        for index in routes:
            topics.setdefault(mission.routes[index].topic, []).append(index)
        for topic, own in topics.items():
            yield Subject(topic, PacketKinds(frozenset(own)), spacecraft)
        for msg_id in sorted(others - {mission.routes[index].msg_id for index in routes}):
            if not message_name(msg_id):
                name = mission.own_name(f"0x{msg_id:04x}", spacecraft)
                yield Subject(name, PacketKinds(keys=frozenset({Key(msg_id)})), spacecraft)
    if run.diagnosis is not None:
        for topic in dict.fromkeys(item.topic for item in run.diagnosis.capture.samples()):
            if topic.startswith("/"):
                samples = SampleTopics.of(topic, run.context)
                yield Subject(samples.pattern, PacketKinds(samples=(samples,)))


def key_text(name: str) -> str:
    """Return a name as a key of YAML."""
    return name if re.fullmatch(r"[\w/.-]+", name) else json.dumps(name)


_FIELD: Final = re.compile(r"(\S+) (?:in (\S+?)\.\.(\S+)|== (\S+))")
_LINE: Final = re.compile(r"(\s*(?:- )?[\w ]+:\s*)([^#]*?)(\s*#.*)?")


class ExpectationUpdate:
    """The new text of a file of expectations.

    Args:
        text: text of the file.
        expected: its contents.
        report: report of the check that the run failed.
        run: the same run.

    Attributes:
        text: the new text.
        notes: lines on widened bounds, and on others that were not widened.
    """

    def __init__(self, text: str, expected: Expectations, report: CheckReport, run: Run) -> None:
        self._lines, self._expected, self._run = text.splitlines(), expected, run
        self._parts = run.parts()
        self.notes: list[str] = []
        for item in report.results:
            if not item.passed:
                before = list(self._lines)
                self._widen(item)
                change = "widened" if self._lines != before else "left as it is"
                self.notes.append(f"{item.about}: {item.name}: {change}; found {item.found}")
        self.text = "".join(f"{line}\n" for line in self._lines)

    def _widen(self, item: CheckResult) -> None:
        if item.about in {"findings", "verdicts"}:
            self._allow(item.about, item.expectation)
        elif item.about == CAPTURE:
            whole = self._run.whole()
            limits = dict(loss_limits([whole], self._run.spread()))
            limits["duration"] = RunLimit(whole.silence, whole.silence, f"{whole.silence:.3g} s in 1 run")
            self._bound(self._expected.bounds.get(item.expectation), item.expectation, limits)
        else:
            self._topic(item)

    def _topic(self, item: CheckResult) -> None:
        for topic in self._expected.topics:
            subject = Subject.of_name(topic.name, self._run.context)
            if subject.name != item.about:
                continue
            figures = Figures.of(subject, self._parts)
            limits = _topic_limits([self._run], subject, [figures])
            limits["count"] = RunLimit(figures.count, figures.count, f"{figures.count:,} in 1 run")
            if figures.count:
                self._bound(topic.bounds.get(item.expectation), item.expectation, limits)
            for field in topic.fields:
                if str(field) == item.expectation and (match := _FIELD.fullmatch(field.where)):
                    name, low, high, same = match.groups()
                    every = {name: own for name, _, own in field_limits([self._run], subject.name)}
                    if own := every.get(name):
                        old = RunLimit(float(low or same), float(high or same), "")
                        joined = old.joined(own)
                        self._replace(field.line, json.dumps(field_filter(name, joined)), joined.why)

    def _bound(self, bound: Tolerance | None, key: str, limits: Mapping[str, RunLimit]) -> None:
        if bound is None or key not in limits:
            return
        limit = limits[key]
        if limit.is_share and not bound.share and bound.high:
            return  # a bound in messages remains in messages
        suffix = limit.suffix if bound.to_end else ""
        joined = RunLimit(bound.low, bound.high, "", suffix, limit.is_share).joined(limit)
        self._replace(bound.line, joined.text(bound.unit), limit.why)

    def _replace(self, line: int, value: str, why: str) -> None:
        if match := _LINE.fullmatch(self._lines[line - 1]):
            self._lines[line - 1] = f"{match[1]}{value}  # widened: {why}"

    def _allow(self, key: str, name: str) -> None:
        for place, line in enumerate(self._lines):
            if match := re.fullmatch(rf"({key}:\s*\[)([^\]]*)(\].*)", line):
                names = [item.strip() for item in match[2].split(",") if item.strip()]
                self._lines[place] = f"{match[1]}{', '.join([*names, name])}{match[3]}"
