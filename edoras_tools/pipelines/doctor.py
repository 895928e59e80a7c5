"""Diagnoses a source, or a part of it: once at its end, or repeatedly while it is live."""

from __future__ import annotations

import pickle
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from functools import cache, partial
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.decode import Dissector
from edoras_tools.decode.spacecraft import FIRST_SPACECRAFT
from edoras_tools.diagnosis.case import Capture
from edoras_tools.diagnosis.evidence.table import Recorder
from edoras_tools.diagnosis.examination import Chapter, Diagnosis, Examination
from edoras_tools.diagnosis.summary import summarize
from edoras_tools.diagnosis.verdict import Choice
from edoras_tools.errors import CaptureError, EdorasError, OnFailure
from edoras_tools.io.formats.columns import json_value
from edoras_tools.io.processes import Workers, jobs_for
from edoras_tools.links import table
from edoras_tools.pipelines.reading import Limits, reading
from edoras_tools.pipelines.selection import Period, Selection

if TYPE_CHECKING:
    from edoras_tools.diagnosis.missing import Missing
    from edoras_tools.io import Source
    from edoras_tools.links.protocol import LinkProtocol
    from edoras_tools.model import Columns, PacketBatch
    from edoras_tools.pipelines.capture.info import Counting
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.render.terminal.text import Progress, Watcher
    from edoras_tools.wire.arrays import Integers, Octets

    _Table = TypeVar("_Table", PacketBatch, Columns)


class Scope(msgspec.Struct, frozen=True):
    """The scope that the options of a command select.

    Attributes:
        selection: part that is shown; loss is counted from all traffic.
        period: part that is examined.
    """

    selection: Selection = msgspec.field(default_factory=Selection)
    period: Period = msgspec.field(default_factory=Period)


class Chosen:
    """Applies a selection to batches, and returns at the end which routes are shown.

    Args:
        selection: selection from the options.
        bench: mission and decoders.

    Raises:
        RouteError: the selection names a topic that is not configured.
        ConfigError: its filter has an error.
    """

    def __init__(self, selection: Selection, bench: Workbench) -> None:
        self._selection = selection.over(bench)
        self._mission = bench.mission
        self._endpoints = bench.columns.context.endpoints
        self._seen: set[tuple[int, str, int]] = set()
        self._sampling = [link for link in table.links() if link.samples]
        self._writers: set[tuple[LinkProtocol, bytes]] = set()

    def add(self, batch: PacketBatch, columns: Columns) -> None:
        """Add a batch; with a filter, a route is shown if one of its packets passes the filter."""
        if self._selection.where:
            rows = self.rows(batch, columns)
            key = np.stack([columns.spacecraft, columns.link, columns.msg_id & 0xFFFF])[:, rows]
            self._seen |= {
                (number, table.link(link).label, msg_id)
                for number, link, msg_id in np.unique(key, axis=1).T.tolist()
            }
            for link in self._sampling:
                own = rows[columns.link[rows] == link]
                self._writers |= {(link, guid) for guid in link.sample_reader().writers(batch, own)}

    def rows(self, batch: PacketBatch, columns: Columns) -> Integers:
        """Return which rows of a batch are selected."""
        return self._selection.rows(batch, columns)

    def choice(self) -> Choice | None:
        """Return the part that is shown; None for all."""
        return Choice(str(self._selection), self._takes) if self._selection else None

    def _takes(
        self, link: str | None, msg_id: int | None, topic: str = "", /, spacecraft: int = FIRST_SPACECRAFT
    ) -> bool:
        of_samples = topic if link in {item.label for item in self._sampling} else ""
        if not self._selection.about(link, msg_id, self._mission, of_samples, spacecraft):
            return False
        if not self._selection.where:
            return True
        if of_samples:
            return any(
                topic == item.sample_reader().topic_of(guid, self._endpoints) for item, guid in self._writers
            )
        return any(
            (number, msg_id) == (spacecraft, own) and link in {None, label}
            for number, label, own in self._seen
        )


class _Judge:
    """One examining process, as the reading process sees it.

    Raises:
        OSError: there is no memory for it.
    """

    def __init__(self, examination: Examination, killed: CaptureError) -> None:
        self._examination = examination
        self._recorder = Recorder(examination.context)
        self._results: deque[list[Any]] = deque()
        self.workers = Workers(1, self._work, killed)

    def ask(self, work: Callable[..., Any], *values: Any) -> Callable[[], Any]:
        """Let the process run one of the methods below; return a function that waits for the result."""
        self.workers.start()
        while self.workers.full and self.workers.waiting:
            self._take()
        result: list[Any] = []
        if self.workers.full:
            result.append(self._work(work.__name__, *values))
        else:
            self.workers.submit(work.__name__, *values)
            self._results.append(result)

        def wait() -> Any:
            while not result:
                self._take()
            return result[0]

        return wait

    def keep(self, batch: PacketBatch, columns: Columns, unrouted: list[Any]) -> None:
        """Keep datagrams; ``unrouted`` belongs to the context of the reading process."""
        self._examination.context.unrouted = unrouted
        self._recorder.keep(_own(batch), _own(columns))

    def judge(self, chapter: Chapter) -> bytes:
        """Judge the kept datagrams; return the diagnosis, pickled so that its arrays stay valid."""
        recorder, self._recorder = self._recorder, Recorder(self._examination.context)
        recorder.conversations.flows, recorder.left_out = chapter.flows, chapter.left_out
        recorder.ends = True
        self._examination.progress = lambda _position, _of: None  # one process shows the progress
        diagnosis = self._examination.judged(recorder, chapter)
        return pickle.dumps(replace(diagnosis, capture=Capture(), case=None))

    def _work(self, name: str, *values: Any) -> Any:
        return getattr(self, name)(*values)

    def _take(self) -> None:
        self._results.popleft().append(self.workers.take())


class _Judges:
    """Examining processes that take turns; see ``Apart``."""

    def __init__(self, examination: Examination, judges: list[_Judge]) -> None:
        self._context, self._judges = examination.context, deque(judges)

    def lend(self, size: int) -> Octets:
        """Return memory to read into; its contents are not copied for the process whose turn it is."""
        return self._judges[0].workers.lend(size)

    def keep(self, batch: PacketBatch, columns: Columns) -> None:
        """See ``Apart``."""
        judge = self._judges[0]
        judge.ask(judge.keep, batch, columns, self._context.unrouted)

    def judge(self, chapter: Chapter) -> Callable[[], Diagnosis]:
        """See ``Apart``."""
        judge = self._judges[0]
        self._judges.rotate(-1)
        wait = judge.ask(judge.judge, chapter)

        @cache
        def received() -> Diagnosis:
            diagnosis: Diagnosis = pickle.loads(wait())  # noqa: S301  from our own process
            return replace(diagnosis, capture=chapter.capture)

        return received


def _own(table: _Table) -> _Table:
    """Return a batch or its columns with all arrays copied to this process, except the bytes."""
    columns = {name: getattr(table, name) for name in table.__struct_fields__ if name != "data"}
    arrays: Any = {name: value.copy() for name, value in columns.items() if isinstance(value, np.ndarray)}
    return replace(table, **arrays)


@contextmanager
def examined_in_processes(examination: Examination, source: Source, jobs: int) -> Iterator[None]:
    """Let ``jobs`` other processes examine a source; none if ``jobs`` is 1, or if memory is short.

    Raises:
        CaptureError: raised by the examination: a process was killed.
    """
    why = "a process that examined part of it was killed, perhaps because memory ran out"
    killed = CaptureError(f"{source.info.name}: {why}; --jobs 1 needs only one")
    with ExitStack() as ends:
        try:
            judges = [_Judge(examination, killed) for _ in range(jobs if jobs > 1 else 0)]
        except OSError:
            judges = []
        if judges:
            for judge in judges:
                ends.enter_context(closing(judge.workers))
            judges_ = _Judges(examination, judges)
            source.borrow(judges_.lend)
            examination.use_processes(judges_)
        yield


class Pace(NamedTuple):
    """The interval at which a live source is judged, and the end.

    Attributes:
        clock: monotonic time in ns.
        every_ns: also judge at this interval, less often if judging takes long; 0: only at the end.
        duration_ns: stop after this time; 0: never.
        watcher: called with every intermediate diagnosis.
        jobs: number of processes that share the work on a large file; 0: one for each processor core.
    """

    clock: Callable[[], int]
    every_ns: int = 0
    duration_ns: int = 0
    watcher: Watcher[Diagnosis] | None = None
    jobs: int = 1


class Findings(msgspec.Struct):
    """The result of an examination.

    Attributes:
        diagnosis: diagnosis of everything that was read.
        source: the source, for its statistics.
        failure: error that ended the source early, if any; everything before it is judged.
    """

    diagnosis: Diagnosis
    source: Source
    failure: EdorasError | None = None

    @property
    def warnings(self) -> Sequence[str]:
        """Notes on the capture, a line each."""
        return self.diagnosis.capture.warnings

    @property
    def unnamed(self) -> Sequence[object]:
        """Traffic that looks like a link's and was left out, because its port was not named."""
        return self.diagnosis.unnamed

    @property
    def zero_ns(self) -> int:
        """Zero of the times, ns since 1970."""
        return self.diagnosis.zero_ns

    def summary(self) -> dict[str, Any]:
        """Return the findings in the shape of ``doctor --json``."""
        return {
            "schema": 2,
            "source": self.source.info.name,
            "summary": summarize(self.diagnosis).as_json(),
            **self.diagnosis.as_json(),
            "warnings": list(self.diagnosis.capture.warnings),
        }


def examine(
    source: Source,
    bench: Workbench,
    *,
    scope: Scope | None = None,
    pace: Pace | None = None,
    progress: Progress | None = None,
    counting: Counting | None = None,
    examination: Examination | None = None,
) -> Findings:
    """Read a source to its end and judge it.

    Args:
        source: source of the datagrams; it is closed.
        bench: mission, types and decoders.
        scope: part that is examined, and part that is shown; all by default.
        pace: for a live source, and how many processes share the work; by default one.
        progress: updated after every batch, and while judging.
        counting: counter of the datagrams that the scope selects.
        examination: takes the datagrams; by default one that lists no lost messages.

    Raises:
        RouteError: the scope names a topic that is not configured.
        ConfigError: its filter has an error.
    """
    examination = examination or Examination(bench.columns.context)
    if progress is not None:
        examination.progress = partial(progress.step, "judging")
    scope = scope or Scope()
    with OnFailure(source.close):
        choices = Chosen(scope.selection, bench)
    pace = pace or Pace(lambda: 0)
    host = tuple(source.host())

    def diagnose(*, ends: bool = False) -> Diagnosis:
        statistics = source.statistics
        warnings = *bench.columns.context.notes, *statistics.warnings
        capture = Capture(
            statistics.kernel_drops,
            warnings,
            examination.zero_ns,
            loop.outside + statistics.passed_over,
            tuple(statistics.outages),
            host,
            unwrappers=bench.unwrappers,
            lacking=tuple(statistics.cut),
            shared=statistics.shared,
            astray=tuple(statistics.astray),
            begins={(source, to): time_ns for source, to, time_ns in statistics.begins},
        )
        diagnosis, choice = examination.diagnose(capture, ends=ends), choices.choice()
        return diagnosis.limited(choice) if choice else diagnosis

    judged, pause = pace.clock(), pace.every_ns
    limits = Limits(duration_ns=pace.duration_ns, clock=pace.clock)
    conversing = counting is not None
    with (
        examined_in_processes(examination, source, jobs_for(source, pace.jobs)),
        reading(
            source, bench, limits=limits, examined=scope.period, keeps_failure=True, conversing=conversing
        ) as loop,
    ):
        part, faults = 0, source.faults()
        for rows in loop:
            if loop.part != part:
                examination.separate()
                part = loop.part
            if scope.period:
                examination.zero_ns = loop.begin_ns
            if len(rows):
                if faults:
                    begin_ns = loop.begin_ns or 0
                    period = scope.period.since(begin_ns)
                    examination.faults = [item for item in faults if period.holds(item.time_ns - begin_ns)]
                    faults = []
                examination.add(rows.batch, rows.columns)
                choices.add(rows.batch, rows.columns)
            if counting is not None:
                some = rows.take(choices.rows(rows.batch, rows.columns)) if scope.selection else rows
                counting.add(some, loop)
            if progress is not None:
                progress.read(source)
            now = pace.clock()
            if pace.watcher and pace.every_ns and now - judged >= pause:
                pace.watcher.update(diagnose())
                judged = pace.clock()
                # Judging takes at most a fifth of the time, however large the capture is.
                pause = max(pace.every_ns, 5 * (judged - now))
        return Findings(diagnose(ends=True), source, loop.failure)


def list_missing(
    diagnosis: Diagnosis, source: Source, bench: Workbench, progress: Progress | None = None
) -> list[Missing]:
    """Return the messages that were lost, with the values of those that the capture contains.

    Args:
        diagnosis: diagnosis of the capture, with its missing messages.
        source: the same capture, opened again for the values; it is closed.
        bench: decoders for the values.
        progress: updated while the source is read.
    """
    rows = [*diagnosis.missing]
    places = {item.number: place for place, item in enumerate(rows) if item.number is not None}
    dissector = Dissector(bench.columns.context, detail=False)
    source.follow(bench.columns.context.framings)
    with closing(source):
        for batch in source.batches() if places else ():
            if progress is not None:
                progress.read(source)
            for row in np.flatnonzero(np.isin(batch.number, list(places))).tolist():
                message = dissector.dissect(batch[row]).message
                place = places[int(batch.number[row])]
                rows[place] = replace(rows[place], message=json_value(message.values) if message else None)
    return rows
