"""Checks a capture against expectations: one result for each, with what was found."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Final, TypeVar
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from edoras_tools.addons.check.expectations import LOSS_KEYS
from edoras_tools.addons.check.observation import (
    NOT_OBSERVABLE,
    Examined,
    FilterCount,
    Observation,
    Subject,
    examine_or_count,
)
from edoras_tools.diagnosis.accounts import latency_ms
from edoras_tools.diagnosis.balance import not_counted, sent
from edoras_tools.diagnosis.ledger import CAPTURE, Row
from edoras_tools.diagnosis.verdict import CAPTURE_RULES, Severity, group_verdicts
from edoras_tools.io.outputs import write_bytes
from edoras_tools.io.topics.rows import APART
from edoras_tools.mission.report import printable
from edoras_tools.model import NO_MSG_ID
from edoras_tools.render.severity import NOTABLE
from edoras_tools.units import SECOND
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from edoras_tools.addons.check.expectations import (
        EventExpectation,
        Expectations,
        FieldExpectation,
        Tolerance,
    )
    from edoras_tools.diagnosis.examination import Diagnosis
    from edoras_tools.io import Source
    from edoras_tools.links.doors import SampleStream
    from edoras_tools.pipelines.capture.ledger import Account, Ledger
    from edoras_tools.pipelines.doctor.doctor import Pace
    from edoras_tools.pipelines.doctor.scope import Scope
    from edoras_tools.pipelines.names import PacketKinds
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.render.terminal.text import Progress


_LONGEST = 4000
"""Characters of a text; also, control characters are escaped, which XML cannot hold."""


def junit(report: CheckReport) -> bytes:
    """Return a report as JUnit XML: a test case for each expectation, named as in the file."""
    counts = {"tests": str(len(report.results)), "failures": str(report.failed)}
    root = Element("testsuites", {"name": "edoras check", **counts, "errors": "0"})
    suite = SubElement(
        root,
        "testsuite",
        {
            "name": printable(report.file, _LONGEST),
            **counts,
            "errors": "0",
            "skipped": "0",
            "time": f"{report.seconds:.3f}",
        },
    )
    source = {"name": "source", "value": printable(report.source, _LONGEST)}
    SubElement(SubElement(suite, "properties"), "property", source)
    for item in report.results:
        name = printable(item.name, _LONGEST)
        case = SubElement(suite, "testcase", {"classname": printable(item.about), "name": name, "time": "0"})
        observed = printable(item.found, _LONGEST)
        if not item.passed:
            SubElement(
                case, "failure", {"message": observed, "type": "expectation"}
            ).text = f"{printable(item.about)}: {name}; found {observed}"
    indent(root)
    document: bytes = tostring(root, encoding="utf-8", xml_declaration=True)
    return document


def write_junit(report: CheckReport, path: Path) -> None:
    """Write a report as JUnit XML.

    Raises:
        CaptureError: the file cannot be written.
    """
    write_bytes(path, junit(report), folders=True)


NOTABLE_FINDINGS: Final = frozenset(item.label for item in NOTABLE)
"""Labels of the findings that are warnings or errors."""
_PATTERN: Final = frozenset("*?[")
_Item = TypeVar("_Item")
_OF_DATAGRAMS: Final = frozenset({*LOSS_KEYS, "latency"})
"""Bounds of what only datagrams show."""


@dataclass(frozen=True, slots=True)
class CheckResult:
    """One expectation, and what was found.

    Attributes:
        about: a topic, ``events``, ``findings``, ``verdicts`` or ``capture``.
        expectation: the key, or the field or event.
        expected: the bound, or what is allowed; None where ``expectation`` says all.
        found: what was found instead, or as expected.
        passed: whether it is as expected.
    """

    about: str
    expectation: str
    expected: str | None
    found: str
    passed: bool

    @property
    def name(self) -> str:
        """The expectation in one line."""
        return self.expectation if self.expected is None else f"{self.expectation}: {self.expected}"


@dataclass(frozen=True, slots=True)
class CheckReport:
    """All expectations of a file, and what was found.

    Attributes:
        source: the capture.
        file: the expectations.
        results: one for each.
        seconds: how long the capture lasts.
        findings: of the doctor; of a recording without datagrams, what was counted.
    """

    source: str
    file: str
    results: tuple[CheckResult, ...]
    seconds: float
    findings: Examined

    @property
    def failed(self) -> int:
        """How many expectations are not met."""
        return sum(not item.passed for item in self.results)

    def as_json(self) -> dict[str, Any]:
        """Return it in the form of ``check --json``."""
        return {
            "source": self.source,
            "expectations": self.file,
            "seconds": self.seconds,
            "passed": not self.failed,
            "failed": self.failed,
            "results": [asdict(item) for item in self.results],
        }


class Parts:
    """What figures are made of, laid out by route, MsgId and topic once for all subjects.

    Args:
        ledger: of the capture.
        diagnosis: of the doctor; None of messages alone.
    """

    def __init__(self, ledger: Ledger, diagnosis: Diagnosis | None) -> None:
        self.ledger, self.diagnosis = ledger, diagnosis
        self._accounts = _laid_out(
            [*ledger.accounts.values()],
            lambda item: (
                ("route", item.route),
                ("id", item.msg_id),
                ("kind", int(item.link), item.kind) if item.msg_id == NO_MSG_ID else None,
            ),
        )
        routes, balance = (diagnosis.routes, diagnosis.balance) if diagnosis else ([], [])
        self._routes = _laid_out(routes, lambda row: (("topic", row["topic"]), ("id", int(row["msg_id"], 0))))
        self._balance = _laid_out(balance, lambda row: (("route", row.route), ("id", row.msg_id)))
        self._sample_rows = _laid_out(balance, lambda row: (row.topic,))
        samples = diagnosis.capture.samples() if diagnosis else []
        self._samples = _laid_out(samples, lambda item: (item.topic,))

    def accounts(self, packets: PacketKinds) -> list[Account]:
        """Return the accounts of some packets."""
        kinds = [("kind", *kind) for kind in packets.kinds]
        return _under(self._accounts, [*_keys(packets), *kinds])

    def balance(self, packets: PacketKinds) -> list[Row]:
        """Return their rows of the balance."""
        return _under(self._balance, _keys(packets))

    def routes(self, packets: PacketKinds) -> list[dict[str, Any]]:
        """Return their rows of the routes."""
        topics = self.diagnosis.topics if self.diagnosis else {}
        own = [("topic", topics.get(index)) for index in packets.routes]
        return _under(self._routes, [*own, *(("id", key.msg_id) for key in packets.keys)])

    def samples(self, packets: PacketKinds) -> tuple[list[SampleStream], list[Row]]:
        """Return the samples on announced topics, and their rows of the balance."""
        names = [item.pattern for item in packets.samples]
        if any(not _PATTERN.isdisjoint(name) for name in names):
            topics = [name for name in {*self._samples, *self._sample_rows} if name is not None]
        else:
            topics = [topic for name in names for topic in (name, f"/{name}", name.removeprefix(APART))]
        own = [name for name in topics if packets.has_sample_topic(name)]
        return _under(self._samples, own), _under(self._sample_rows, own)


def _laid_out(
    items: Sequence[_Item], keys: Callable[[_Item], Iterable[Any]]
) -> dict[Any, list[tuple[int, _Item]]]:
    """Return items, each with its place, by each of their keys."""
    rows: dict[Any, list[tuple[int, _Item]]] = {}
    for place, item in enumerate(items):
        for key in keys(item):
            rows.setdefault(key, []).append((place, item))
    return rows


def _under(rows: Mapping[Any, list[tuple[int, _Item]]], keys: Iterable[Any]) -> list[_Item]:
    """Return the items under any of some keys, each once, in their order."""
    own = dict(entry for key in keys for entry in rows.get(key, ()))
    return [own[place] for place in sorted(own)]


def _keys(packets: PacketKinds) -> list[tuple[str, int]]:
    return [
        *(("route", index) for index in packets.routes),
        *(("id", key.msg_id) for key in packets.keys),
    ]


@dataclass(frozen=True, slots=True)
class Figures:
    """What was counted of some messages.

    Attributes:
        count: messages in the capture.
        rate: messages per second between the first and the last, of all senders; None below two.
        silence: longest time in s without a message, from the capture's start to its end.
        size: smallest and largest datagram in bytes; None without messages.
        latency: in s, 99 percent took no longer; None where the capture does not show it.
        sent: messages sent, as far as the balance knows.
        lost: of the balance.
        superseded: of the balance.
        unaccounted: of the balance.
        not_counted: where nothing counts what was lost, and what would; empty where all was counted.
    """

    count: int
    rate: float | None
    silence: float
    size: tuple[int, int] | None
    latency: float | None
    sent: int
    lost: int
    superseded: int
    unaccounted: int
    not_counted: str

    @classmethod
    def of(cls, subject: Subject, parts: Parts) -> Figures:
        """Return the figures of a subject; without a diagnosis, those of messages alone."""
        packets = subject.packets
        if packets.only_samples and parts.diagnosis is not None:
            samples, rows = parts.samples(packets)
            spans = [(item.count - 1, item.last_ns - item.first_ns) for item in samples]
            rates = [number * SECOND / span_ns for number, span_ns in spans if span_ns > 0]
            return cls._counted(samples, rates, rows, parts.ledger, size=None, latency=None)
        accounts = parts.accounts(packets)
        waits = [latency_ms(row) for row in parts.routes(packets)]
        slowest = max((item for item in waits if item is not None), default=None)
        low = min((item.bytes_min for item in accounts), default=0)
        high = max((item.bytes_max for item in accounts), default=0)
        return cls._counted(
            accounts,
            [item.rate_hz for item in accounts if item.count > 1],
            parts.balance(packets),
            parts.ledger,
            size=(low, high) if accounts else None,
            latency=None if slowest is None else slowest / 1e3,
        )

    @classmethod
    def _counted(
        cls,
        own: Sequence[Account | SampleStream],
        rates: Sequence[float],
        rows: Sequence[Row],
        ledger: Ledger,
        *,
        size: tuple[int, int] | None,
        latency: float | None,
    ) -> Figures:
        silences = [
            max(item.longest_ns, item.first_ns - ledger.start_ns, ledger.end_ns - item.last_ns)
            for item in own
        ]
        return cls(
            count=sum(item.count for item in own),
            rate=sum(rates) if rates else None,
            silence=max(silences, default=ledger.end_ns - ledger.start_ns) / SECOND,
            size=size,
            latency=latency,
            sent=sent(rows),
            **_losses(rows),
        )

    @classmethod
    def whole(cls, ledger: Ledger, diagnosis: Diagnosis | None) -> Figures:
        """Return the figures of all messages; ``silence`` is how long the capture lasts."""
        rows = [row for row in diagnosis.balance if row.hop != CAPTURE] if diagnosis else []
        seconds = (ledger.end_ns - ledger.start_ns) / SECOND
        return cls(ledger.datagrams, None, seconds, None, None, sent(rows), **_losses(rows))


def check(
    source: Source,
    bench: Workbench,
    expected: Expectations,
    *,
    scope: Scope | None = None,
    pace: Pace | None = None,
    progress: Progress | None = None,
) -> CheckReport:
    """Read a source to its end and hold it against expectations; the source is closed.

    Args:
        scope: what is examined; expectations of topics that it leaves out are left out.

    Raises:
        ConfigError: an expectation names no topic, or a filter no field.
    """
    try:
        observed = Observation(source, bench, expected)
    except BaseException:
        source.close()
        raise
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
        figures = Figures.of(subject, parts)
        for key, bound in topic.bounds.items():
            if diagnosis is None and key in _OF_DATAGRAMS:
                yield CheckResult(subject.name, key, bound.text, NOT_OBSERVABLE, passed=False)
            else:
                yield _bounded(subject.name, key, bound, figures)
        for item, watch in zip(topic.fields, watches, strict=True):
            yield _field(subject.name, item, watch, ledger, findings.zero_ns)
    if diagnosis is None:
        yield from _recorded(expected, Figures.whole(ledger, None))
        return
    for event, watch in zip(expected.events, observed.events, strict=True):
        yield _event(event, watch, diagnosis.zero_ns)
    if expected.findings is not None:
        counts = {
            name: plural(number, "datagram")
            for name, number in ledger.findings.items()
            if name in NOTABLE_FINDINGS
        }
        yield from _allowed("findings", expected.findings, counts)
    # What is wrong with the capture itself goes for all the rest: it has to be allowed by name.
    grave = [item for item in diagnosis.verdicts if item.severity >= Severity.WARNING]
    if expected.verdicts is None:
        grave = [item for item in grave if item.rule in CAPTURE_RULES]
    if grave or expected.verdicts is not None:
        reasons = {members[0].rule: members[0].reason for members in group_verdicts(grave)}
        yield from _allowed("verdicts", expected.verdicts or frozenset(), reasons)
    whole = Figures.whole(ledger, diagnosis)
    for key, bound in expected.bounds.items():
        yield _bounded(CAPTURE, key, bound, whole)


def _recorded(expected: Expectations, whole: Figures) -> Iterator[CheckResult]:
    """Yield the results of expectations that are of no topic, for a recording without datagrams."""
    for event in expected.events:
        expectation = "must appear" if event.must else "must not appear"
        yield CheckResult("events", event.text, expectation, NOT_OBSERVABLE, passed=False)
    for about, allowed in {"findings": expected.findings, "verdicts": expected.verdicts}.items():
        if allowed is not None:
            yield CheckResult(about, "allowed", _only(allowed), NOT_OBSERVABLE, passed=False)
    for key, bound in expected.bounds.items():
        if key in _OF_DATAGRAMS:
            yield CheckResult(CAPTURE, key, bound.text, NOT_OBSERVABLE, passed=False)
        else:
            yield _bounded(CAPTURE, key, bound, whole)


def _bounded(about: str, key: str, bound: Tolerance, figures: Figures) -> CheckResult:
    observed, unit = "", bound.unit
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
        observed = unit.text_of(value)
        if value is None:
            observed = (
                "not seen: at least two messages are needed"
                if key == "rate"
                else "the capture does not show it"
            )
    if about != CAPTURE and not figures.count:
        observed = "no message"
        passed = passed and key == "count"
    return CheckResult(about, key, bound.text, observed, passed)


def _field(
    about: str, item: FieldExpectation, watch: FilterCount, ledger: Ledger, zero_ns: int
) -> CheckResult:
    unit = "message" if ledger.mission.recorded else "packet"

    def first_place(place: tuple[int, int] | None) -> str:
        return f"first is {unit} {place[0]:,} at {(place[1] - zero_ns) / SECOND:.3f} s" if place else ""

    # A datagram of DDS may be sent again, and may hold several samples.
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
    return CheckResult(about, str(item), None, observed, passed)


def _event(item: EventExpectation, watch: FilterCount, zero_ns: int) -> CheckResult:
    observed = f"{watch.hits:,} of {plural(watch.tested, 'event')}"
    if watch.first_hit is not None:
        number, time_ns = watch.first_hit
        observed += f"; the first is packet {number:,} at {(time_ns - zero_ns) / SECOND:.3f} s"
    expected = "must appear" if item.must else "must not appear"
    return CheckResult("events", item.text, expected, observed, bool(watch.hits) == item.must)


def _allowed(about: str, allowed: frozenset[str], observed: dict[str, Any]) -> Iterator[CheckResult]:
    """Compare what was found, a name to a count or a reason, with what is allowed: each other one fails."""
    expected = _only(allowed)
    others = [name for name in observed if name not in allowed]
    for name in others:
        yield CheckResult(about, name, "is not allowed", str(observed[name]), passed=False)
    if not others:
        yield CheckResult(about, "allowed", expected, ", ".join(observed) or "none", passed=True)


def _only(allowed: frozenset[str]) -> str:
    return f"only {', '.join(sorted(allowed))}" if allowed else "none"


def _losses(rows: Sequence[Row]) -> dict[str, Any]:
    return {
        "not_counted": not_counted(rows),
        "lost": sum(row.all_lost for row in rows),
        "superseded": sum(row.superseded for row in rows),
        "unaccounted": sum(row.unaccounted for row in rows),
    }
