"""Widens a file of expectations by a run that somebody judged good; all else in the file stays as it is.

What the run does not meet is moved as far as a draft from this run alone would have it. A topic that is not
there, an event, and a filter that no draft writes, are left to whoever judged.
"""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Final

from edoras_tools.addons.runs.draft import field_limits
from edoras_tools.addons.runs.figures import Figures
from edoras_tools.addons.runs.limits import RunLimit, field_filter, loss_limits, topic_limits
from edoras_tools.addons.runs.observation import Subject
from edoras_tools.diagnosis.ledger import CAPTURE

if TYPE_CHECKING:
    from collections.abc import Mapping

    from edoras_tools.addons.runs.check import CheckReport, CheckResult
    from edoras_tools.addons.runs.expectations import Expectations, Tolerance
    from edoras_tools.addons.runs.run import Run

_FIELD: Final = re.compile(r"(\S+) (?:in (\S+?)\.\.(\S+)|== (\S+))")
_LINE: Final = re.compile(r"(\s*(?:- )?[\w ]+:\s*)([^#]*?)(\s*#.*)?")


class ExpectationUpdate:
    """The new text of a file of expectations.

    Args:
        text: of the file.
        expected: what it says.
        report: of the check that the run did not pass.
        run: the same run.

    Attributes:
        text: the new text.
        notes: what was widened, and what was not, a line each.
    """

    def __init__(self, text: str, expected: Expectations, report: CheckReport, run: Run) -> None:
        self._lines, self._expected, self._run = text.splitlines(), expected, run
        self._parts = run.parts()
        self.notes: list[str] = []
        for item in report.results:
            if not item.passed:
                before = list(self._lines)
                self._widen(item)
                what = "widened" if self._lines != before else "left as it is"
                self.notes.append(f"{item.about}: {item.name}: {what}; found {item.found}")
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
            spreads = (self._run.spread(subject, captured=captured) for captured in (False, True))
            limits = dict(topic_limits([figures], *spreads))
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
            return  # a bound in messages stays one
        suffix = limit.suffix if bound.to_end else ""
        joined = (
            RunLimit(bound.low, bound.high, "").joined(limit)._replace(suffix=suffix, is_share=limit.is_share)
        )
        self._replace(bound.line, joined.text(bound.unit), limit.why)

    def _replace(self, line: int, value: str, why: str) -> None:
        if match := _LINE.fullmatch(self._lines[line - 1]):
            self._lines[line - 1] = f"{match[1]}{value}  # widened: {why}"

    def _allow(self, key: str, name: str) -> None:
        for place, line in enumerate(self._lines):
            if match := re.fullmatch(rf"({key}:\s*\[)([^\]]*)(\].*)", line):
                names = [item.strip() for item in match[2].split(",") if item.strip()]
                self._lines[place] = f"{match[1]}{', '.join([*names, name])}{match[3]}"
