"""Expectations, from a YAML file.

::

    topics:
      /cmd_vel:                    # a topic, the name of a packet (SB_HK), or a MsgId (0x0827)
        count: at least 500
        rate: 9..11
        silence: at most 2s
        size: 76
        lost: at most 1%
        superseded: 0
        unaccounted: 0
        latency: at most 300ms
        fields:
          - always: linear.x in -1..1
          - never: angular.z > 2
          - at least once: linear.x > 0.4
          - after: linear.x > 0.4
            within: 2s
            then: pose.position.x > 1
    events:
      must: ["TO_LAB_APP 3"]
      never: [Pipe Overflow]
    findings: [stale_tail]         # allowed; all others of severity warning or error fail
    verdicts: [app_pipe_limit]     # likewise
    lost: at most 1%               # of all messages
    duration: at least 60s

All errors of a file are reported at once, with file, line and key.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from enum import Enum
from math import inf
from typing import TYPE_CHECKING, Final, Literal, TypeAlias

import msgspec
from msgspec.structs import replace

from edoras_tools import words
from edoras_tools.decode.filters.syntax import WhereError, parse_filter
from edoras_tools.diagnosis.rules import rules
from edoras_tools.mission.tree import (
    Mistakes,
    ScalarNode,
    SequenceNode,
    Tree,
    named_entries,
    read_document,
    suggestion,
)
from edoras_tools.model import Finding
from edoras_tools.sessions.faults.rules import time_ns
from edoras_tools.units import SECOND
from edoras_tools.words import plural

if TYPE_CHECKING:
    from pathlib import Path


_BOUND_FORM: Final = re.compile(r"(at least|at most|>=|<=)\s*(\S.*)|(\S+?)\s*\.\.\s*(\S.*)|(\S.*)")


_TO_END: Final = " to the end"


class Unit(Enum):
    """Unit of a bound; the value is an example in text form."""

    MESSAGES = "600, 590..610 or at least 1"
    BYTES = "76, 76..116 or at most 768"
    RATE = "9..11, at least 9 Hz or 9..11 to the end"
    TIME = "at most 300ms or 1s..3s"
    LOSS = "0, at most 12 or at most 1%"

    def number(self, text: str) -> float:
        """Read one number; times are in seconds.

        Raises:
            ValueError: the text has another unit.
        """
        if self is Unit.TIME:
            return time_ns(text) / SECOND
        name = {Unit.RATE: "Hz", Unit.BYTES: "bytes"}.get(self, "")
        plain = text.removesuffix(name).strip()
        if not re.fullmatch(r"\d+(\.\d+)?", plain) or ("." in plain and self is not Unit.RATE):
            raise ValueError(text)
        return float(plain)

    def text_of(self, value: float | None) -> str:
        """Return a value as text for people."""
        if value is None:
            return words.NONE
        if self is Unit.RATE:
            return f"{value:.4g} Hz"
        if self is Unit.TIME:
            return words.milliseconds(value * 1e3)
        return plural(int(value), "byte" if self is Unit.BYTES else "message")


class Tolerance(msgspec.Struct, frozen=True):
    """Lower and upper bound, both included.

    Attributes:
        text: text as written.
        unit: unit of both; times are in seconds.
        low: lower bound.
        high: upper bound.
        share: whether both are shares of the sent messages, from 0 to 1.
        to_end: whether messages must come up to the end of the capture; for a rate.
        line: line in the file.
    """

    text: str
    unit: Unit
    low: float = 0
    high: float = inf
    share: bool = False
    to_end: bool = False
    line: int = 0

    def holds(self, value: float) -> bool:
        """Return whether a value is accepted."""
        return self.low <= value <= self.high


def parse_bound(text: str, unit: Unit) -> Tolerance:
    """Read a bound.

    Raises:
        ValueError: the text is no bound; it says what is allowed.
    """
    plain = text.strip().removesuffix(_TO_END)
    to_end = plain != text.strip()
    match = _BOUND_FORM.fullmatch(plain)
    word, alone, low, high, exact = match.groups() if match else ("", "", "", "", "")
    numbers = [item for item in (alone, low, high, exact) if item]
    share = unit is Unit.LOSS and bool(numbers) and all(item.endswith("%") for item in numbers)
    values = []
    with suppress(ValueError):
        values = [float(item[:-1]) / 100 if share else unit.number(item) for item in numbers]
    never = exact and (share or unit in {Unit.RATE, Unit.TIME})  # measured rates are never exact
    if (
        not values
        or never
        or values != sorted(values)
        or (share and not 0 <= values[-1] <= 1)
        or (to_end and unit is not Unit.RATE)
    ):
        raise ValueError(f"{text!r} is no bound; write {unit.value}")
    least, most = values[0], values[-1]
    if word in {"at least", ">="}:
        most = inf
    elif word:
        least = 0
    return Tolerance(text.strip(), unit, least, most, share, to_end)


Sort: TypeAlias = Literal["always", "never", "at least once", "after"]

LOSS_KEYS: Final = ("lost", "superseded", "unaccounted")
TOPIC_BOUNDS: Final[Mapping[str, Unit]] = {
    "count": Unit.MESSAGES,
    "rate": Unit.RATE,
    "silence": Unit.TIME,
    "size": Unit.BYTES,
    **dict.fromkeys(LOSS_KEYS, Unit.LOSS),
    "latency": Unit.TIME,
}
WHOLE_BOUNDS: Final[Mapping[str, Unit]] = {**dict.fromkeys(LOSS_KEYS, Unit.LOSS), "duration": Unit.TIME}
_KEYS: Final = ("schema", "topics", "events", "findings", "verdicts", *WHOLE_BOUNDS)
_SORTS: Final[tuple[Sort, ...]] = ("always", "never", "at least once", "after")
_FORM: Final = (
    "expectations are topics: with a topic and what is expected of it, events:, findings:, verdicts:"
)
_EVENT: Final = re.compile(r"(\w+) (\d+)(?::\s*(.*))?", re.DOTALL)


class FieldExpectation(msgspec.Struct, frozen=True):
    """A condition on the messages of a topic.

    Attributes:
        sort: quantifier of ``where``; ``after``: a packet must follow each message that passes it.
        where: filter.
        line: line in the file.
        then: filter that a later packet must pass.
        within_ns: time in which it must follow, ns.
    """

    sort: Sort
    where: str
    line: int
    then: str = ""
    within_ns: int = 0

    def __str__(self) -> str:
        rest = f", within {self.within_ns / 1e9:g}s: {self.then}" if self.then else ""
        return f"{self.sort} {self.where}{rest}"


class EventExpectation(msgspec.Struct, frozen=True):
    """An event of cFE that must occur, or must not.

    Attributes:
        must: whether it must occur.
        text: part of its text, or ``APP ID: TEXT`` as the doctor quotes events.
        line: line in the file.
    """

    must: bool
    text: str
    line: int

    @property
    def where(self) -> str:
        """The filter that such an event passes."""
        match = _EVENT.fullmatch(self.text)
        app, number, text = match.groups() if match else ("", "", self.text)
        tests = [f"cfe_event.app_name == {_quoted(app)}", f"cfe_event.event_id == {number}"] if match else []
        tests += [f"cfe_event.message contains {_quoted(text)}"] if text else []
        return " and ".join(tests)


class TopicExpectation(msgspec.Struct, frozen=True):
    """The expectations of one topic.

    Attributes:
        name: name as written: a topic, the name of a packet, or a MsgId.
        line: line in the file.
        bounds: bounds by key, in the file's order.
        fields: conditions on its messages.
    """

    name: str
    line: int
    bounds: Mapping[str, Tolerance]
    fields: tuple[FieldExpectation, ...] = ()


class Expectations(msgspec.Struct, frozen=True):
    """The expectations of a capture.

    Attributes:
        file: path of the file.
        topics: expectations of single topics.
        events: expectations of cFE's events.
        findings: labels of the allowed findings; None: all.
        verdicts: rules with allowed verdicts; None: all except those about the capture itself.
        bounds: bounds of the whole capture, by key.
    """

    file: str
    topics: tuple[TopicExpectation, ...] = ()
    events: tuple[EventExpectation, ...] = ()
    findings: frozenset[str] | None = None
    verdicts: frozenset[str] | None = None
    bounds: Mapping[str, Tolerance] = msgspec.field(default_factory=dict)


def load_expectations(path: Path) -> Expectations:
    """Read a file of expectations.

    Raises:
        ConfigError: all errors at once, each with file, line and key.
    """
    report = Mistakes(str(path))
    document = read_document(
        path, report, _FORM, one="expectations are one document", instead="a file of expectations"
    )
    expectations = _Reader(report).expectations(document) if document is not None else Expectations(str(path))
    report.raise_all()
    return expectations


class _Reader:
    """Reads a tree; mistakes go to the report."""

    def __init__(self, report: Mistakes) -> None:
        self.report = report

    def expectations(self, tree: Tree) -> Expectations:
        topics: list[TopicExpectation] = []
        events: list[EventExpectation] = []
        allowed: dict[str, frozenset[str]] = {}
        bounds: dict[str, Tolerance] = {}
        for key, line, value in self._entries(tree, "", _KEYS):
            if key == "topics":
                topics = [self._topic(name, at, node) for name, at, node in self._entries(value, key)]
            elif key == "events":
                for word, _, node in self._entries(value, key, ("must", "never")):
                    texts = self._texts(node, f"events.{word}")
                    events += [EventExpectation(word == "must", text, at) for text, at in texts]
            elif key in {"findings", "verdicts"}:
                allowed[key] = self._allowed(key, value)
            elif key == "schema":
                if not (isinstance(value, ScalarNode) and value.value == 1):
                    self.report.mistake(line, key, "this version reads schema 1")
            else:
                self._bound(bounds, key, key, WHOLE_BOUNDS[key], value)
        result = Expectations(self.report.file, tuple(topics), tuple(events), bounds=bounds, **allowed)
        if result == Expectations(self.report.file) and not self.report.mistakes:
            self.report.mistake(tree.line, "", f"nothing is expected; {_FORM}")
        return result

    def _topic(self, name: str, line: int, tree: Tree) -> TopicExpectation:
        bounds: dict[str, Tolerance] = {}
        fields: list[FieldExpectation] = []
        for key, _, value in self._entries(tree, name, (*TOPIC_BOUNDS, "fields")):
            place = f"{name}.{key}"
            if key != "fields":
                self._bound(bounds, key, place, TOPIC_BOUNDS[key], value)
            elif not isinstance(value, SequenceNode):
                self.report.mistake(value.line, place, "a list is needed, e.g. - always: linear.x < 1")
            else:
                parsed = [self._field(f"{place}[{at}]", item) for at, item in enumerate(value.items)]
                fields += [item for item in parsed if item is not None]
        return TopicExpectation(name, line, bounds, tuple(fields))

    def _field(self, place: str, tree: Tree) -> FieldExpectation | None:
        values = {
            key: (line, node) for key, line, node in self._entries(tree, place, (*_SORTS, "within", "then"))
        }
        sorts = [item for item in _SORTS if item in values]
        if len(sorts) != 1:
            self.report.mistake(tree.line, place, f"one of {', '.join(_SORTS)} is needed, with a filter")
            return None
        sort, rest = sorts[0], values.keys() - set(sorts)
        if rest != ({"within", "then"} if sort == "after" else set()):
            only = f"{', '.join(sorted(rest))} can only be used with after:"
            needed = "after: needs within: and then:, e.g. within: 2s"
            self.report.mistake(tree.line, place, needed if sort == "after" else only)
            return None
        texts = {key: self._text(node, f"{place}.{key}") for key, (_, node) in values.items()}
        for key in (sort, "then"):
            if texts.get(key):
                self._filter(texts[key], values[key][0], f"{place}.{key}")
        within_ns = 0
        if sort == "after":
            try:
                within_ns = time_ns(texts["within"])
            except ValueError as error:
                self.report.mistake(values["within"][0], f"{place}.within", str(error))
        return FieldExpectation(sort, texts[sort], values[sort][0], texts.get("then", ""), within_ns)

    def _filter(self, text: str, line: int, place: str) -> None:
        try:
            parse_filter(text)
        except WhereError as error:
            self.report.mistake(line, place, f"character {error.at + 1}: {error.why}")

    def _bound(self, bounds: dict[str, Tolerance], key: str, place: str, unit: Unit, value: Tree) -> None:
        text = self._text(value, place)
        try:
            if text:
                bounds[key] = replace(parse_bound(text, unit), line=value.line)
        except ValueError as error:
            self.report.mistake(value.line, place, str(error))

    def _allowed(self, key: str, value: Tree) -> frozenset[str]:
        allowed_names = list(rules()) if key == "verdicts" else [item.label for item in Finding]
        names = self._texts(value, key)
        for name, line in names:
            if name not in allowed_names:
                hint = suggestion(name, allowed_names) or "see edoras doctor, info"
                self.report.mistake(line, key, f"{name!r} is no {key[:-1]}; {hint}")
        return frozenset(name for name, _ in names)

    def _entries(
        self, tree: Tree, place: str, allowed: Collection[str] = ()
    ) -> Iterator[tuple[str, int, Tree]]:
        """Yield the keys of a mapping, with line and value."""
        needed = (
            f"keys are needed: {', '.join(allowed)}" if allowed else "a name is needed, then what is expected"
        )
        return named_entries(tree, place, self.report, needed if place else _FORM, allowed)

    def _texts(self, value: Tree, place: str) -> list[tuple[str, int]]:
        items = value.items if isinstance(value, SequenceNode) else (value,)
        return [(text, item.line) for item in items if (text := self._text(item, place))]

    def _text(self, value: Tree, place: str) -> str:
        if isinstance(value, ScalarNode) and not value.missing:
            return value.text
        self.report.mistake(value.line, place, "a value is needed")
        return ""


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'
