"""Counts, while a capture is read, the facts that expectations need besides the diagnosis."""

from __future__ import annotations

from itertools import compress
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.decode.filters.filter import Where
from edoras_tools.decode.filters.names import Names
from edoras_tools.decode.filters.syntax import WhereError
from edoras_tools.decode.spacecraft import FIRST_SPACECRAFT, split_topic
from edoras_tools.errors import EdorasError, RouteError
from edoras_tools.mission.report import Mistakes
from edoras_tools.pipelines.capture.info import Counting
from edoras_tools.pipelines.doctor.doctor import Findings, Pace, examine
from edoras_tools.pipelines.doctor.scope import Scope
from edoras_tools.pipelines.names import PacketKinds, find_packets
from edoras_tools.pipelines.reading import ReadLoop, reading
from edoras_tools.structs.shapes import Key
from edoras_tools.wire import cfe

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from edoras_tools.addons.runs.expectations import Expectations, FieldExpectation
    from edoras_tools.decode.context import Context
    from edoras_tools.decode.filters.rows import ColumnRows
    from edoras_tools.io import Source
    from edoras_tools.mission import Mission
    from edoras_tools.pipelines.selection import Selection
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.render.terminal.text import Progress


NOT_OBSERVABLE: Final = "not observable in this recording: it has messages and no datagrams"
"""Result of an expectation that needs datagrams; it is not met."""


class CountedMessages(msgspec.Struct):
    """The end of counting messages; has the attributes of ``doctor.Findings`` that apply.

    Attributes:
        source: the recording.
        zero_ns: time of its first message, ns since 1970.
        failure: error that ended it early, if any.
        warnings: warnings, one line each.
        unnamed: always empty: a recording has no ports.
        diagnosis: always None.
    """

    source: Source
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
    return CountedMessages(source, loop.begin_ns or 0, loop.failure, warnings)


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
    if not mask.any():
        return None
    row = int(mask.argmax())
    return int(number[row]), int(time_ns[row])
