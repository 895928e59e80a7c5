"""Checks a capture against expectations: one result for each, with the observed value.

Expectations are about counts while a capture is read, and about figures of messages.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import compress
from typing import TYPE_CHECKING, Any, Final, TypeVar
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import msgspec
import numpy as np
from msgspec.structs import asdict, replace

from edoras_tools.addons.runs.expectations import LOSS_KEYS
from edoras_tools.decode.filters.filter import Where
from edoras_tools.decode.filters.names import Names
from edoras_tools.decode.filters.syntax import WhereError
from edoras_tools.decode.spacecraft import FIRST_SPACECRAFT, split_topic
from edoras_tools.diagnosis.accounts import latency_ms
from edoras_tools.diagnosis.balance import not_counted, sent
from edoras_tools.diagnosis.ledger import CAPTURE, Row
from edoras_tools.diagnosis.verdict import CAPTURE_RULES, Severity, group_verdicts
from edoras_tools.errors import EdorasError, OnFailure, RouteError
from edoras_tools.io.outputs import write_bytes
from edoras_tools.io.topics.messages import APART
from edoras_tools.mission.tree import Mistakes, printable
from edoras_tools.model import NO_MSG_ID, rate_hz
from edoras_tools.pipelines.capture.info import Counting
from edoras_tools.pipelines.doctor import Findings, Pace, Scope, examine
from edoras_tools.pipelines.reading import ReadLoop, reading
from edoras_tools.pipelines.selection import PATTERN_SIGNS, PacketKinds, Selection, find_packets
from edoras_tools.render.severity import NOTABLE
from edoras_tools.structs.shapes import Key
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe
from edoras_tools.words import plural

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from edoras_tools.addons.runs.expectations import (
        EventExpectation,
        Expectations,
        FieldExpectation,
        Tolerance,
    )
    from edoras_tools.decode.context import Context
    from edoras_tools.decode.filters.rows import ColumnRows
    from edoras_tools.diagnosis.examination import Diagnosis
    from edoras_tools.io import Source
    from edoras_tools.links.doors import SampleStream
    from edoras_tools.mission import Mission
    from edoras_tools.pipelines.capture.ledger import Account, Ledger
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.render.terminal.text import Progress

NOT_OBSERVABLE: Final = "not observable in this recording: it has messages and no datagrams"
"""Result of an expectation that needs datagrams; it is not met."""


class CountedMessages(msgspec.Struct):
    """The end of counting messages; has the attributes of ``doctor.Findings`` that apply.

    Attributes:
        zero_ns: time of its first message, ns since 1970.
        failure: error that ended it early, if any.
        warnings: warnings, one line each.
        unnamed: always empty: a recording has no ports.
        diagnosis: always None.
    """

    zero_ns: int = 0
    failure: EdorasError | None = None
    warnings: list[str] = msgspec.field(default_factory=list)
    unnamed: tuple[str, ...] = ()
    diagnosis: None = None


Examined = Findings | CountedMessages


def examine_or_count(
    source: Source,
    bench: Workbench,
    counting: Counting,
    *,
    scope: Scope | None = None,
    pace: Pace | None = None,
    progress: Progress | None = None,
) -> Examined:
    """Read a source to its end, as ``examine`` does; the messages of a recording are only counted.

    Raises:
        RouteError: the selection names no topic.
        ConfigError: its filter has an error, or it selects datagrams of a recording.
    """
    if not bench.mission.recorded:
        return examine(source, bench, scope=scope, pace=pace, progress=progress, counting=counting)
    scope = scope or Scope()
    with reading(source, bench, scope.selection, examined=scope.period, keeps_failure=True) as loop:
        for rows in loop:
            if progress is not None:
                progress.read(source)
            counting.add(rows, loop)
    ledger = counting.report.ledger
    warnings = [*bench.columns.context.notes, *ledger.notes, *ledger.unread]
    return CountedMessages(loop.begin_ns or 0, loop.failure, warnings)


class Subject(msgspec.Struct, frozen=True):
    """The messages of a name.

    Attributes:
        name: name for people.
        packets: kinds of packets.
        spacecraft: number of the spacecraft; 0 for all.
    """

    name: str
    packets: PacketKinds
    spacecraft: int = FIRST_SPACECRAFT

    @classmethod
    def of_name(cls, name: str, context: Context) -> Subject:
        """Return the messages of a name in a file of expectations.

        Raises:
            RouteError: the name has no messages; the text suggests a similar name.
        """
        prefix, rest = ("", name) if context.mission.recorded else split_topic(name)
        spacecraft = (context.mission.number_of(prefix) if prefix else 0) or FIRST_SPACECRAFT
        own = context.of(spacecraft)
        try:
            packets = find_packets(name, own)
        except RouteError:
            if not prefix:
                raise
            packets = find_packets(rest[1:], own)
        if packets.routes:
            return cls(own.mission.routes[min(packets.routes)].topic, packets, spacecraft)
        number = name[:1].isdecimal()
        return cls(f"0x{int(name, 0):04x}" if number else name, packets, spacecraft)

    def mask(self, rows: ColumnRows) -> NDArray[np.bool_]:
        """Return which rows belong to it: bool (n,)."""
        own = self.packets.mask(rows.batch, rows.columns)[rows.indices()]
        return own & self.owns(rows)

    def is_among(self, selection: Selection, mission: Mission) -> bool:
        """Return whether a prepared selection may have some of its messages; the filter is ignored."""
        packets = self.packets
        links = {mission.routes[index].link for index in packets.routes}
        if selection.links and links and links.isdisjoint(selection.links):
            return False
        ids = packets.msg_ids(mission)
        return all(
            ids & item.msg_ids(mission) or packets.kinds & item.kinds or packets.shares_samples(item)
            for item in selection.packets_of(self.spacecraft)
        )

    def owns(self, rows: ColumnRows) -> NDArray[np.bool_]:
        """Return which rows belong to its spacecraft: bool (n,)."""
        own: NDArray[np.bool_] = rows.column("spacecraft") == self.spacecraft
        return own if self.spacecraft else ~own


EVENT_MESSAGES = Subject("events", PacketKinds(keys=frozenset({Key(cfe.EVENT_MSG_ID)})), 0)


class FilterCount(msgspec.Struct):
    """Counts the messages that pass a filter.

    Attributes:
        subject: messages.
        where: filter.
        then: filter that a later packet must pass, or None.
        tested: number of messages tested.
        hits: number of messages that passed.
        first_hit: number and time of the first message that passed; None if none did.
        first_miss: number and time of the first message that did not pass; None if all did.
    """

    subject: Subject
    where: Where
    then: Where | None = None
    tested: int = 0
    hits: int = 0
    first_hit: tuple[int, int] | None = None
    first_miss: tuple[int, int] | None = None
    _hits_ns: list[NDArray[np.int64]] = msgspec.field(default_factory=list)
    _then_ns: list[NDArray[np.int64]] = msgspec.field(default_factory=list)

    def add(self, messages: ColumnRows, rows: ColumnRows) -> None:
        """Count the messages of the subject, and search all rows for the packets that must follow."""
        passed = self.where.passing(messages)
        number, time_ns = messages.datagram("number"), messages.datagram("time_ns")
        self.tested += len(messages)
        self.hits += int(passed.sum())
        self.first_hit = self.first_hit or _first(number, time_ns, passed)
        self.first_miss = self.first_miss or _first(number, time_ns, ~passed)
        if self.then is not None:
            self._hits_ns.append(time_ns[passed])
            after = self.then.passing(rows) & self.subject.owns(rows)
            self._then_ns.append(rows.datagram("time_ns")[after])

    def unanswered(self, within_ns: int, end_ns: int) -> tuple[NDArray[np.int64], int]:
        """Return the times of hits without a timely follower, and the number of hits left open by the end."""
        hits, answers = (np.sort(np.concatenate([*item])) for item in (self._hits_ns, self._then_ns))
        after = np.append(answers, np.iinfo(np.int64).max)[np.searchsorted(answers, hits, "right")]
        missed = hits[after - hits > within_ns]
        decided = missed + within_ns <= end_ns
        return missed[decided], int((~decided).sum())


class Observation(Counting):
    """Counts datagrams, fields and events; see ``Counting``.

    Attributes:
        subjects: messages of each topic of the expectations, in their order.
        fields: counters of the expectations of fields, by topic.
        events: counters of the expectations of events; empty without datagrams.

    Raises:
        ConfigError: an expectation names no topic, or a filter no field; all such errors at once.
    """

    def __init__(self, source: Source, bench: Workbench, expected: Expectations) -> None:
        super().__init__(source, bench)
        self._expected = expected
        report, context = Mistakes(expected.file), bench.columns.context
        names = Names(context)
        self.subjects: list[Subject] = []
        self.fields: list[list[FilterCount]] = []
        for topic in expected.topics:
            try:
                subject = Subject.of_name(topic.name, context)
            except RouteError as error:
                report.mistake(topic.line, topic.name, str(error))
                continue
            self.subjects.append(subject)
            self.fields.append(list(_watches(subject, topic.fields, names, report)))
        events = () if context.mission.recorded else expected.events
        self.events = [FilterCount(EVENT_MESSAGES, Where(item.where, context)) for item in events]
        report.raise_all()

    def about(self, selection: Selection) -> Expectations:
        """Drop the topics outside a prepared selection; return the other expectations."""
        keep = [item.is_among(selection, self.report.ledger.mission) for item in self.subjects]
        self.subjects, self.fields = (list(compress(self.subjects, keep)), list(compress(self.fields, keep)))
        return replace(self._expected, topics=tuple(compress(self._expected.topics, keep)))

    def add(self, rows: ColumnRows, loop: ReadLoop) -> ColumnRows:
        """Count the chosen rows of a batch; return those that count."""
        own = super().add(rows, loop)
        groups = [*zip(self.subjects, self.fields, strict=True), (EVENT_MESSAGES, self.events)]
        for subject, watches in groups:
            messages = own.take(np.flatnonzero(subject.mask(own))) if watches else own
            for watch in watches:
                watch.add(messages, own)
        return own


def _watches(
    subject: Subject, fields: Sequence[FieldExpectation], names: Names, report: Mistakes
) -> Iterator[FilterCount]:
    own = names.of_types(subject.packets.types(names.context.mission))
    for item in fields:
        try:
            then = Where(item.then, names.context, names=names) if item.then else None
            yield FilterCount(subject, Where(item.where, names.context, names=own), then)
        except WhereError as error:
            key = f"{subject.name}.fields"
            report.mistake(item.line, key, f"{item}: character {error.at + 1} of the filter: {error.why}")


def _first(
    number: NDArray[np.int64], time_ns: NDArray[np.int64], mask: NDArray[np.bool_]
) -> tuple[int, int] | None:
    row = int(mask.argmax()) if mask.any() else None
    return None if row is None else (int(number[row]), int(time_ns[row]))


_Item = TypeVar("_Item")


class Parts:
    """The sources of figures, grouped by route, MsgId and topic once for all subjects.

    Args:
        ledger: counts of the capture.
        diagnosis: diagnosis; None for messages alone.
    """

    def __init__(self, ledger: Ledger, diagnosis: Diagnosis | None) -> None:
        self.ledger, self.diagnosis = ledger, diagnosis
        self._accounts = _laid_out(
            [*ledger.accounts.values()],
            lambda item: (
                ("route", item.spacecraft, item.route),
                ("id", item.spacecraft, item.msg_id),
                ("kind", item.spacecraft, int(item.link), item.kind) if item.msg_id == NO_MSG_ID else None,
            ),
        )
        routes, balance = (diagnosis.routes, diagnosis.balance) if diagnosis else ([], [])
        topics, first = diagnosis.topics if diagnosis else {}, FIRST_SPACECRAFT
        self._routes = _laid_out(
            routes, lambda row: (row["topic"], ("id", row.get("spacecraft", first), int(row["msg_id"], 0)))
        )
        self._balance = _laid_out(
            balance, lambda row: (topics.get(row.route), ("id", row.spacecraft or first, row.msg_id))
        )
        self._sample_rows = _laid_out(balance, lambda row: (row.topic,))
        samples = diagnosis.capture.samples() if diagnosis else []
        self._samples = _laid_out(samples, lambda item: (item.topic,))

    def accounts(self, subject: Subject) -> list[Account]:
        """Return the accounts of a subject."""
        return _under(self._accounts, self._keys(subject))

    def balance(self, subject: Subject) -> list[Row]:
        """Return its rows of the balance."""
        return _under(self._balance, self._keys(subject))

    def routes(self, subject: Subject) -> list[dict[str, Any]]:
        """Return its rows of the routes."""
        return _under(self._routes, self._keys(subject))

    def _keys(self, subject: Subject) -> list[Any]:
        number, packets = subject.spacecraft, subject.packets
        own, mission = number or FIRST_SPACECRAFT, self.ledger.mission
        routes = (mission if own == mission.number else mission.of(own)).routes
        keys: list[Any] = [
            key for index in packets.routes for key in (("route", number, index), routes[index].topic)
        ]
        keys += [("id", number, key.msg_id) for key in packets.keys]
        return keys + [("kind", number, *kind) for kind in packets.kinds]

    def samples(self, packets: PacketKinds) -> tuple[list[SampleStream], list[Row]]:
        """Return the samples on announced topics, and their rows of the balance."""
        names = [item.pattern for item in packets.samples]
        if any(not PATTERN_SIGNS.isdisjoint(name) for name in names):
            topics = [name for name in {*self._samples, *self._sample_rows} if name is not None]
        else:
            topics = [topic for name in names for topic in (name, f"/{name}", name.removeprefix(APART))]
        own = [name for name in topics if packets.has_sample_topic(name)]
        return _under(self._samples, own), _under(self._sample_rows, own)


def _laid_out(
    items: Sequence[_Item], keys: Callable[[_Item], Iterable[Any]]
) -> dict[Any, list[tuple[int, _Item]]]:
    """Return items with their indices, by each of their keys."""
    rows: dict[Any, list[tuple[int, _Item]]] = {}
    for place, item in enumerate(items):
        for key in keys(item):
            rows.setdefault(key, []).append((place, item))
    return rows


def _under(rows: Mapping[Any, list[tuple[int, _Item]]], keys: Iterable[Any]) -> list[_Item]:
    """Return the items under any of some keys, each once, in order."""
    own = dict(entry for key in keys for entry in rows.get(key, ()))
    return [own[place] for place in sorted(own)]


class Figures(msgspec.Struct, frozen=True):
    """The figures of some messages.

    Attributes:
        count: messages in the capture.
        rate: messages per second between the first and the last, of all senders; None below two.
        silence: longest time in s without a message, from the capture's start to its end.
        end_silence: time in s from the last message to the capture's end.
        size: smallest and largest datagram in bytes; None without messages.
        latency: 99th percentile, s; None if the capture does not show it.
        sent: messages sent, as far as the balance knows.
        lost: lost messages, from the balance.
        superseded: messages replaced by newer ones, from the balance.
        unaccounted: messages without a known fate, from the balance.
        not_counted: place where losses are not counted, and what would count them; empty if all are counted.
    """

    count: int
    rate: float | None
    silence: float
    end_silence: float
    size: tuple[int, int] | None
    latency: float | None
    sent: int
    lost: int
    superseded: int
    unaccounted: int
    not_counted: str

    @classmethod
    def of(cls, subject: Subject, parts: Parts) -> Figures:
        """Return the figures of a subject; without a diagnosis, those of its messages alone."""
        packets, ledger, size, latency = subject.packets, parts.ledger, None, None
        own: Sequence[Account | SampleStream]
        if packets.only_samples and parts.diagnosis is not None:
            own, rows = parts.samples(packets)
            rates = [rate_hz(item.count, item.last_ns - item.first_ns) for item in own]
            rates = [item for item in rates if item]
        else:
            accounts = parts.accounts(subject)
            own, rows = accounts, parts.balance(subject)
            rates = [item.rate_hz for item in accounts if item.count > 1]
            waits = [item for row in parts.routes(subject) if (item := latency_ms(row)) is not None]
            latency = max(waits) / 1e3 if waits else None
            if accounts:
                size = min(item.bytes_min for item in accounts), max(item.bytes_max for item in accounts)
        silences = [
            max(item.longest_ns, item.first_ns - ledger.start_ns, ledger.end_ns - item.last_ns)
            for item in own
        ]
        return cls(
            count=sum(item.count for item in own),
            rate=sum(rates) if rates else None,
            silence=max(silences, default=ledger.end_ns - ledger.start_ns) / SECOND,
            end_silence=(ledger.end_ns - max((item.last_ns for item in own), default=0)) / SECOND,
            size=size,
            latency=latency,
            sent=sent(rows),
            **_losses(rows),
        )

    @classmethod
    def whole(cls, ledger: Ledger, diagnosis: Diagnosis | None) -> Figures:
        """Return the figures of all messages; ``silence`` is the duration of the capture."""
        rows = [row for row in diagnosis.balance if row.hop != CAPTURE] if diagnosis else []
        seconds = (ledger.end_ns - ledger.start_ns) / SECOND
        return cls(ledger.datagrams, None, seconds, 0.0, None, None, sent(rows), **_losses(rows))


def _losses(rows: Sequence[Row]) -> dict[str, Any]:
    return {
        "not_counted": not_counted(rows),
        "lost": sum(row.all_lost for row in rows),
        "superseded": sum(row.superseded for row in rows),
        "unaccounted": sum(row.unaccounted for row in rows),
    }


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
