"""Checks a capture against expectations: one result for each, with the observed value."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import msgspec
from msgspec.structs import asdict

from edoras_tools.addons.runs.expectations import LOSS_KEYS
from edoras_tools.addons.runs.observation import (
    NOT_OBSERVABLE,
    Examined,
    Figures,
    FilterCount,
    Observation,
    Parts,
    examine_or_count,
)
from edoras_tools.diagnosis.ledger import CAPTURE
from edoras_tools.diagnosis.verdict import CAPTURE_RULES, Severity, group_verdicts
from edoras_tools.errors import OnFailure
from edoras_tools.io.outputs import write_bytes
from edoras_tools.mission.tree import printable
from edoras_tools.render.severity import NOTABLE
from edoras_tools.units import SECOND
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from edoras_tools.addons.runs.expectations import (
        EventExpectation,
        Expectations,
        FieldExpectation,
        Tolerance,
    )
    from edoras_tools.diagnosis.examination import Diagnosis
    from edoras_tools.io import Source
    from edoras_tools.pipelines.capture.ledger import Ledger
    from edoras_tools.pipelines.doctor.doctor import Pace
    from edoras_tools.pipelines.doctor.scope import Scope
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.render.terminal.text import Progress


TO_END: Final = 5
"""Messages that may be missing, by the rate, at the end of a topic that lasts to the end of the capture."""
NOTABLE_FINDINGS: Final = frozenset(item.label for item in NOTABLE)
"""Labels of the findings that are warnings or errors."""
_MUST: Final = {True: "must appear", False: "must not appear"}
_UNSEEN: Final = {"rate": "not seen: at least two messages are needed"}
_OF_DATAGRAMS: Final = frozenset({*LOSS_KEYS, "latency"})
"""Keys of bounds that only datagrams show."""


class CheckResult(msgspec.Struct, frozen=True):
    """One expectation, and its result.

    Attributes:
        about: subject: a topic, ``events``, ``findings``, ``verdicts`` or ``capture``.
        expectation: key, or field or event.
        expected: bound, or allowed names; None if ``expectation`` says all.
        found: observed value.
        passed: whether the expectation is met.
    """

    about: str
    expectation: str
    expected: str | None
    found: str
    passed: bool

    @property
    def name(self) -> str:
        """Expectation in one line."""
        return self.expectation if self.expected is None else f"{self.expectation}: {self.expected}"


_LONGEST: Final = 4000
"""Most characters of a text. Control characters are escaped too, because XML cannot contain them."""


def junit(results: Sequence[CheckResult], names: tuple[str, str, str], seconds: float = 0.0) -> bytes:
    """Return results as JUnit XML, one test case each.

    Args:
        names: names of the command, of the reference of the runs, and of the runs.
        seconds: duration of the runs, s.
    """
    command, suite_name, source_name = names
    failed = sum(not item.passed for item in results)
    counts = {"tests": str(len(results)), "failures": str(failed), "errors": "0"}
    root = Element("testsuites", {"name": f"edoras {command}", **counts})
    suite = SubElement(
        root,
        "testsuite",
        {"name": printable(suite_name, _LONGEST), **counts, "skipped": "0", "time": f"{seconds:.3f}"},
    )
    source = {"name": "source", "value": printable(source_name, _LONGEST)}
    SubElement(SubElement(suite, "properties"), "property", source)
    for item in results:
        name = printable(item.name, _LONGEST)
        case = SubElement(suite, "testcase", {"classname": printable(item.about), "name": name, "time": "0"})
        observed = printable(item.found, _LONGEST)
        if not item.passed:
            SubElement(
                case, "failure", {"message": observed, "type": "expectation"}
            ).text = f"{printable(item.about)}: {name}; found {observed}"
    indent(root)
    return tostring(root, encoding="utf-8", xml_declaration=True)


def write_junit(
    path: Path, results: Sequence[CheckResult], names: tuple[str, str, str], seconds: float = 0.0
) -> None:
    """Write results as JUnit XML; see ``junit``.

    Raises:
        CaptureError: the file cannot be written.
    """
    write_bytes(path, junit(results, names, seconds), folders=True)


class CheckReport(msgspec.Struct, frozen=True):
    """All expectations of a file, and their results.

    Attributes:
        source: name of the capture.
        file: file of expectations.
        results: results, one for each expectation.
        seconds: duration of the capture, s.
        findings: diagnosis; for a recording without datagrams, the counts.
    """

    source: str
    file: str
    results: tuple[CheckResult, ...]
    seconds: float
    findings: Examined

    @property
    def failed(self) -> int:
        """Number of expectations that are not met."""
        return sum(not item.passed for item in self.results)

    def as_json(self) -> dict[str, Any]:
        """Return the report in the form of ``check --json``."""
        return {
            "source": self.source,
            "expectations": self.file,
            "seconds": self.seconds,
            "passed": not self.failed,
            "failed": self.failed,
            "results": [asdict(item) for item in self.results],
        }


def check(
    source: Source,
    bench: Workbench,
    expected: Expectations,
    *,
    scope: Scope | None = None,
    pace: Pace | None = None,
    progress: Progress | None = None,
) -> CheckReport:
    """Read a source to its end and check it against expectations; the source is closed.

    Args:
        scope: part that is examined; expectations of topics outside it are left out.

    Raises:
        ConfigError: an expectation names no topic, or a filter no field.
    """
    with OnFailure(source.close):
        observed = Observation(source, bench, expected)
    findings = examine_or_count(source, bench, observed, scope=scope, pace=pace, progress=progress)
    expected = observed.about(scope.selection.over(bench)) if scope else expected
    results = tuple(_results(expected, observed, findings))
    ledger = observed.report.ledger
    seconds = (ledger.end_ns - ledger.start_ns) / SECOND
    return CheckReport(source.info.name, expected.file, results, seconds, findings)


def _results(expected: Expectations, observed: Observation, findings: Examined) -> Iterator[CheckResult]:
    ledger = observed.report.ledger
    diagnosis = findings.diagnosis
    if findings.failure is not None:
        yield CheckResult(CAPTURE, "input", "read to its end", str(findings.failure), passed=False)
    if not ledger.datagrams:
        expected_input = "messages" if diagnosis is None else "datagrams of a link"
        yield CheckResult(CAPTURE, "input", expected_input, "none", passed=False)
    parts = Parts(ledger, diagnosis)
    for topic, subject, watches in zip(expected.topics, observed.subjects, observed.fields, strict=True):
        yield from _bounds(subject.name, topic.bounds, Figures.of(subject, parts), diagnosis)
        for item, watch in zip(topic.fields, watches, strict=True):
            yield _field(item, watch, ledger, findings.zero_ns)
    if diagnosis is None:
        yield from _not_observable(expected)
    else:
        yield from _judged(expected, observed, diagnosis)
    yield from _bounds(CAPTURE, expected.bounds, Figures.whole(ledger, diagnosis), diagnosis)


def _judged(expected: Expectations, observed: Observation, diagnosis: Diagnosis) -> Iterator[CheckResult]:
    """Yield the results of expectations of events, findings and verdicts."""
    for event, watch in zip(expected.events, observed.events, strict=True):
        yield _event(event, watch, diagnosis.zero_ns)
    if expected.findings is not None:
        counts = {
            name: plural(number, "datagram")
            for name, number in observed.report.ledger.findings.items()
            if name in NOTABLE_FINDINGS
        }
        yield from _allowed("findings", expected.findings, counts)
    # A fault of the capture itself affects all results: it must be allowed by name.
    grave = [item for item in diagnosis.verdicts if item.severity >= Severity.WARNING]
    if expected.verdicts is None:
        grave = [item for item in grave if item.rule in CAPTURE_RULES]
    if grave or expected.verdicts is not None:
        reasons = {members[0].rule: members[0].reason for members in group_verdicts(grave)}
        yield from _allowed("verdicts", expected.verdicts or frozenset(), reasons)


def _not_observable(expected: Expectations) -> Iterator[CheckResult]:
    """Yield these results for a recording without datagrams."""
    for event in expected.events:
        yield CheckResult("events", event.text, _MUST[event.must], NOT_OBSERVABLE, passed=False)
    for about, allowed in {"findings": expected.findings, "verdicts": expected.verdicts}.items():
        if allowed is not None:
            yield CheckResult(about, "allowed", _only(allowed), NOT_OBSERVABLE, passed=False)


def _bounds(
    about: str, bounds: Mapping[str, Tolerance], figures: Figures, diagnosis: Diagnosis | None
) -> Iterator[CheckResult]:
    for key, bound in bounds.items():
        if diagnosis is None and key in _OF_DATAGRAMS:
            yield CheckResult(about, key, bound.text, NOT_OBSERVABLE, passed=False)
        else:
            yield _bounded(about, key, bound, figures)


def _bounded(about: str, key: str, bound: Tolerance, figures: Figures) -> CheckResult:
    unit, ended = bound.unit, ""
    if bound.to_end and figures.end_silence * max(bound.low, figures.rate or 0.0) > TO_END:
        ended = f"; the last is {figures.end_silence:.1f} s before the end"
    if key in LOSS_KEYS:
        number = getattr(figures, key)
        share = number / figures.sent if figures.sent else 0.0
        observed = f"{number:,} of {figures.sent:,} ({share:.2%})"
        passed = bound.holds(share if bound.share else number) and (figures.sent > 0 or not figures.count)
        if passed and key == "lost" and figures.not_counted:
            observed, passed = f"{observed}; the rest is {figures.not_counted}", False
    elif key == "size" and figures.size is not None:
        passed = all(map(bound.holds, figures.size))
        low, high = figures.size
        observed = unit.text_of(high) if low == high else f"{low:,} to {unit.text_of(high)}"
    else:
        value = figures.silence if key == "duration" else getattr(figures, key)
        passed = value is not None and bound.holds(value)
        observed = _UNSEEN.get(key, "the capture does not show it") if value is None else unit.text_of(value)
    observed, passed = observed + ended, passed and not ended
    if about != CAPTURE and not figures.count:
        observed = "no message"
        passed = passed and key == "count"
    return CheckResult(about, key, bound.text, observed, passed)


def _field(item: FieldExpectation, watch: FilterCount, ledger: Ledger, zero_ns: int) -> CheckResult:
    unit = "message" if ledger.mission.recorded else "packet"

    def first_place(place: tuple[int, int] | None) -> str:
        return f"first is {unit} {place[0]:,} at {(place[1] - zero_ns) / SECOND:.3f} s" if place else ""

    # A DDS datagram may be sent again, and may contain several samples.
    of = plural(watch.tested, "datagram" if watch.subject.packets.only_samples else "message")
    passed = watch.tested > 0
    observed = f"{watch.hits:,} of {of}"
    if not watch.tested:
        observed = "no message"
    elif item.sort == "always":
        passed = watch.hits == watch.tested
        observed += "" if passed else f" pass; of those that do not, the {first_place(watch.first_miss)}"
    elif item.sort == "never":
        passed = not watch.hits
        observed += "" if passed else f"; the {first_place(watch.first_hit)}"
    elif item.sort == "at least once":
        passed = watch.hits > 0
        observed += f"; the {first_place(watch.first_hit)}" if passed else ""
    else:
        missed, undecided = watch.unanswered(item.within_ns, ledger.end_ns)
        passed = watch.hits > undecided and not len(missed)
        observed = f"{watch.hits - len(missed) - undecided:,} of {watch.hits:,} were followed"
        if undecided:
            observed += f"; after {undecided:,} the capture ends too early"
        if len(missed):
            observed += f"; the first that was not is at {(int(missed[0]) - zero_ns) / SECOND:.3f} s"
    return CheckResult(watch.subject.name, str(item), None, observed, passed)


def _event(item: EventExpectation, watch: FilterCount, zero_ns: int) -> CheckResult:
    observed = f"{watch.hits:,} of {plural(watch.tested, 'event')}"
    if watch.first_hit is not None:
        number, time_ns = watch.first_hit
        observed += f"; the first is packet {number:,} at {(time_ns - zero_ns) / SECOND:.3f} s"
    return CheckResult("events", item.text, _MUST[item.must], observed, bool(watch.hits) == item.must)


def _allowed(about: str, allowed: frozenset[str], observed: dict[str, Any]) -> Iterator[CheckResult]:
    """Yield a result for each observed name, with its count or reason; it fails unless it is allowed."""
    others = [name for name in observed if name not in allowed]
    for name in others:
        yield CheckResult(about, name, "is not allowed", str(observed[name]), passed=False)
    if not others:
        yield CheckResult(about, "allowed", _only(allowed), ", ".join(observed) or "none", passed=True)


def _only(allowed: frozenset[str]) -> str:
    return f"only {', '.join(sorted(allowed))}" if allowed else "none"
