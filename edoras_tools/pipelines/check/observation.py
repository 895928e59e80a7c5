"""Counts, while a capture is read, what expectations need beside the diagnosis."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.cfs.names import MSG_ID_NAMES
from edoras_tools.decode.filters.filter import Where
from edoras_tools.decode.filters.syntax import WhereError
from edoras_tools.mission.fields import suggestion
from edoras_tools.mission.report import Mistakes
from edoras_tools.pipelines.capture.info import Counting
from edoras_tools.pipelines.selection import fits_topic
from edoras_tools.wire import cfe

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from edoras_tools.decode.context import Context
    from edoras_tools.decode.filters.rows import ColumnRows
    from edoras_tools.io import Source
    from edoras_tools.mission import Mission
    from edoras_tools.pipelines.check.expectations import Expectations, FieldExpectation
    from edoras_tools.pipelines.reading import ReadLoop
    from edoras_tools.pipelines.workbench import Workbench


@dataclass(frozen=True, slots=True)
class Subject:
    """The messages that a name stands for.

    Attributes:
        name: as it is told.
        routes: indices of the configured routes of a topic.
        msg_ids: MsgIds, where it is no topic.
    """

    name: str
    routes: frozenset[int] = frozenset()
    msg_ids: frozenset[int] = frozenset()

    def takes(self, route: int, msg_id: int | None) -> bool:
        """Return whether messages of a route, with a MsgId, are meant."""
        return route in self.routes or msg_id in self.msg_ids

    def mask(self, rows: ColumnRows) -> NDArray[np.bool_]:
        """Return which rows are meant."""
        return np.isin(rows.column("route"), list(self.routes)) | np.isin(
            rows.column("msg_id"), list(self.msg_ids)
        )


EVENT_MESSAGES = Subject("events", msg_ids=frozenset({cfe.EVENT_MSG_ID}))


def find_subject(name: str, mission: Mission) -> Subject:
    """Return what a name in a file of expectations stands for.

    Raises:
        ValueError: nothing; with what was perhaps meant.
    """
    routes = frozenset(index for index, route in enumerate(mission.routes) if fits_topic(route.topic, name))
    if routes:
        return Subject(mission.routes[min(routes)].topic, routes)
    named = frozenset(value for value, known in MSG_ID_NAMES.items() if known == name.upper())
    if named:
        return Subject(name.upper(), msg_ids=named)
    try:
        value = int(name, 0)
    except ValueError:
        value = -1
    if 0 <= value <= 0xFFFF:
        return Subject(f"0x{value:04x}", msg_ids=frozenset({value}))
    known = [route.topic for route in mission.routes]
    near = suggestion(name if name[:1] != "/" and name.isupper() else f"/{name.removeprefix('/')}", known)
    near = near or suggestion(name.upper(), MSG_ID_NAMES.values())
    there = f"there are {', '.join(known)}" if known else "topics need a mission: name it with -c"
    raise ValueError(f"no topic, packet or MsgId of this name; {near or there}")


@dataclass(slots=True)
class FilterCount:
    """Counts which messages pass a filter.

    Attributes:
        subject: which messages.
        where: the filter.
        then: the filter that has to pass afterwards, on any packet; or None.
        seen: how many there were.
        hits: how many passed.
        first_hit: number and time of the first that passed; None where none did.
        first_miss: likewise of the first that did not.
    """

    subject: Subject
    where: Where
    then: Where | None = None
    seen: int = 0
    hits: int = 0
    first_hit: tuple[int, int] | None = None
    first_miss: tuple[int, int] | None = None
    _hits_ns: list[NDArray[np.int64]] = field(default_factory=list)
    _then_ns: list[NDArray[np.int64]] = field(default_factory=list)

    def add(self, messages: ColumnRows, rows: ColumnRows) -> None:
        """Count messages of the subject, and look for what has to come afterwards in all rows."""
        passed = self.where.passing(messages)
        number, time_ns = messages.datagram("number"), messages.datagram("time_ns")
        self.seen += len(messages)
        self.hits += int(passed.sum())
        self.first_hit = self.first_hit or _first(number, time_ns, passed)
        self.first_miss = self.first_miss or _first(number, time_ns, ~passed)
        if self.then is not None:
            self._hits_ns.append(time_ns[passed])
            self._then_ns.append(rows.datagram("time_ns")[self.then.passing(rows)])

    def unanswered(self, within_ns: int, end_ns: int) -> tuple[NDArray[np.int64], int]:
        """Return the times of the hits that nothing followed in time, and how many the end leaves open."""
        hits, answers = (np.sort(np.concatenate([*item])) for item in (self._hits_ns, self._then_ns))
        after = np.append(answers, np.iinfo(np.int64).max)[np.searchsorted(answers, hits, "right")]
        missed = hits[after - hits > within_ns]
        told = missed + within_ns <= end_ns
        return missed[told], int((~told).sum())


class Observation(Counting):
    """Counts datagrams, fields and events; see ``Counting``.

    Args:
        source: what is read.
        bench: mission and decoders.
        expected: what has to be observed.

    Attributes:
        subjects: what each topic of the expectations stands for, in their order.
        fields: a watch for each expectation of fields, by topic.
        events: a watch for each event.

    Raises:
        ConfigError: an expectation names no topic, or a filter no field; all of them at once.
    """

    def __init__(self, source: Source, bench: Workbench, expected: Expectations) -> None:
        super().__init__(source, bench)
        report, context = Mistakes(expected.file), bench.columns.context
        self.subjects: list[Subject] = []
        self.fields: list[list[FilterCount]] = []
        for topic in expected.topics:
            try:
                subject = find_subject(topic.name, bench.mission)
            except ValueError as error:
                report.mistake(topic.line, topic.name, str(error))
                continue
            self.subjects.append(subject)
            self.fields.append(list(_watches(subject, topic.fields, context, report)))
        self.events = [FilterCount(EVENT_MESSAGES, Where(item.where, context)) for item in expected.events]
        report.raise_all()

    def add(self, rows: ColumnRows, loop: ReadLoop) -> ColumnRows:
        """Count the chosen rows of a batch; return those that count."""
        kept = super().add(rows, loop)
        groups = [*zip(self.subjects, self.fields, strict=True), (EVENT_MESSAGES, self.events)]
        for subject, watches in groups:
            messages = kept.take(np.flatnonzero(subject.mask(kept))) if watches else kept
            for watch in watches:
                watch.add(messages, kept)
        return kept


def _watches(
    subject: Subject, fields: Sequence[FieldExpectation], context: Context, report: Mistakes
) -> Iterator[FilterCount]:
    for item in fields:
        try:
            then = Where(item.then, context) if item.then else None
            yield FilterCount(subject, Where(item.where, context), then)
        except WhereError as error:
            key = f"{subject.name}.fields"
            report.mistake(item.line, key, f"{item}: character {error.at + 1} of the filter: {error.why}")


def _first(
    number: NDArray[np.int64], time_ns: NDArray[np.int64], chosen: NDArray[np.bool_]
) -> tuple[int, int] | None:
    if not chosen.any():
        return None
    row = int(chosen.argmax())
    return int(number[row]), int(time_ns[row])
