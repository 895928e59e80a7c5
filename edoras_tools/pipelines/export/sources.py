"""Reads captures, and recordings of other tools, by topic: blocks of messages in columns.

A capture has the same topics as a recording of it (``io.topics.streams``), and the results of the doctor as
topics: its verdicts, and the messages that did not arrive. A recording of another tool has the topics that
were recorded. It contains no datagrams, so nothing can be selected by link or MsgId.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from itertools import chain
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from msgspec.structs import replace

from edoras_tools.diagnosis.examination import Examination
from edoras_tools.errors import CaptureError, EdorasError, InterruptError
from edoras_tools.io.formats.open import is_cfe_file
from edoras_tools.io.processes import InOrder, Workers, jobs_for
from edoras_tools.io.topics.edoras import fault_messages
from edoras_tools.io.topics.messages import APART, DATAGRAMS_TOPIC, RECORD, RECORD_BYTES, Messages, lay_out
from edoras_tools.io.topics.streams import FAULTS, STATISTICS_TOPIC, PreparedBatch, Streams, Topic
from edoras_tools.mission.tree import printable
from edoras_tools.model import Columns, Finding, PacketBatch
from edoras_tools.pipelines.capture.ledger import LONGEST_NOTE
from edoras_tools.pipelines.clocks import open_aligned
from edoras_tools.pipelines.doctor import Scope, examine, list_missing
from edoras_tools.pipelines.messages import open_inputs
from edoras_tools.pipelines.reading import reading, reads_by_heads
from edoras_tools.pipelines.workbench import Settings, Workbench, open_files
from edoras_tools.ros.cdr.bulk import MessageColumns, Ragged, TopicBlock
from edoras_tools.units import SECOND
from edoras_tools.wire.arrays import Integers, Mask, by_value, read_at
from edoras_tools.words import listed

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.io import Source
    from edoras_tools.render.terminal.text import Progress
    from edoras_tools.ros import TypeStore

    Made = tuple[str, int, Any]
    """Result for a block: its topic, its number of rows, and the value that ``Maker`` returned."""
    Maker = Callable[[TopicBlock, int], Any]
    Judge = Callable[[Collection[str], Progress | None], Iterator[TopicBlock]]

VERDICTS_TOPIC: Final = "/edoras/verdicts"
LOST_TOPIC: Final = "/edoras/lost"
_TEXT, _COUNT, _TEXTS = "text", "count", "texts"
_FIELDS: Final = {
    VERDICTS_TOPIC: {
        "rule": _TEXT,
        "severity": _TEXT,
        "reason": _TEXT,
        "link": _TEXT,
        "msg_id": _TEXT,
        "topic": _TEXT,
        "hop": _TEXT,
        "lost": _COUNT,
        "of": _COUNT,
        "estimated": _COUNT,
        "end_ns": _COUNT,
        "evidence": _TEXTS,
        "remedy": _TEXT,
        "confidence": _TEXT,
    },
    LOST_TOPIC: {
        "link": _TEXT,
        "msg_id": _TEXT,
        "topic": _TEXT,
        "count": _COUNT,
        "until_ns": _COUNT,
        "number": _COUNT,
        "first": _COUNT,
        "one_of": _COUNT,
        "what": _TEXT,
        "message": _TEXT,
    },
}
"""Columns of each topic, named as in ``doctor --json`` and ``doctor --list-lost json``; a message is JSON."""
_TIME: Final = {VERDICTS_TOPIC: "start_ns", LOST_TOPIC: "time_ns"}
JUDGED: Final = frozenset(_FIELDS)
"""Topics that need an examination of the whole capture; made only if requested by name."""


def judged_blocks(
    topics: Collection[str],
    paths: Sequence[Path],
    settings: Settings,
    scope: Scope,
    progress: Progress | None = None,
) -> Iterator[TopicBlock]:
    """Examine captures, and yield the requested results.

    Args:
        topics: topics of ``JUDGED``.
        paths: the captures; they are read again.
        settings: missions, types and options.
        scope: part that is examined, and part that is shown.
        progress: shows the progress.
    """

    def opened() -> Any:
        return open_files(paths) if len(paths) == 1 else open_aligned(paths, settings, progress)[0]

    source = opened()
    bench = settings.workbench(source.info, paths)
    examination = Examination(bench.columns.context)
    examination.listing = LOST_TOPIC in topics
    diagnosis = examine(source, bench, scope=scope, progress=progress, examination=examination).diagnosis
    if VERDICTS_TOPIC in topics:
        yield judged_block(VERDICTS_TOPIC, [item.as_json() for item in diagnosis.verdicts])
    if examination.listing:
        result = list_missing(diagnosis, opened(), bench, progress)
        yield judged_block(LOST_TOPIC, [item.as_json() for item in result])


def judged_block(topic: str, rows: Sequence[Mapping[str, Any]] = ()) -> TopicBlock:
    """Return rows of JSON as a block; the time of a row is its start."""
    fields: dict[str, NDArray[Any] | Ragged] = {}
    present: dict[str, Mask] = {}
    for name, kind in _FIELDS[topic].items():
        values = [row[name] for row in rows]
        fields[name] = _MAKE[kind](values)
        if kind != _TEXTS:
            present[name] = np.array([value is not None for value in values], bool)
    time_ns = np.array([row[_TIME[topic]] for row in rows], np.int64)
    return TopicBlock(topic, time_ns, MessageColumns("", np.ones(len(rows), bool), fields), present=present)


def _texts(values: Sequence[Any]) -> NDArray[Any]:
    texts = [value if isinstance(value, str) else dumps(value, ensure_ascii=False) for value in values]
    return np.array(
        ["" if value is None else text for value, text in zip(values, texts, strict=True)], object
    )


def _lists(values: Sequence[Sequence[str]]) -> Ragged:
    offsets = np.cumsum([0, *map(len, values)])
    return Ragged(np.array([text for texts in values for text in texts], object), offsets)


_MAKE: Final[Mapping[str, Callable[[Sequence[Any]], NDArray[Any] | Ragged]]] = {
    _TEXT: _texts,
    _COUNT: lambda values: np.array([value or 0 for value in values], np.int64),
    _TEXTS: _lists,
}


_MOST_MADE: Final = 8
"""Batches whose results may wait for those of earlier batches: limits memory."""


class TopicSource(ABC):
    """An input that is read by topic, once.

    Attributes:
        name: name of the input.
        topics: every topic that it can contain, with its type; topics that only the content names are added
            while it is read.
        wants_new: whether blocks of added topics are wanted, too.
        unread: other topics of a recording, each with the reason why its messages cannot be read.
        source: source of its datagrams; None if it has none.
        zero_ns: zero of its times, ns since 1970; -1 until it is known.
        last_ns: latest time that was read; -1 before.
        left_out: messages on wanted topics that are incomplete or do not fit their type.
        unnamed: see ``Context``.
        damage: reason why not all topics are known; empty if they are.
        failure: error that ended it early, if any.
        recordings: names of its recordings, and an empty one; no names if it is a single one.
    """

    source: Source | None = None
    wants_new = False

    def __init__(self, source: Source, bench: Workbench, scope: Scope | None) -> None:
        self.name = source.info.name
        self._source, self._bench = source, bench
        self.topics: dict[str, str] = {}
        self.unread: dict[str, str] = {}
        self.zero_ns = self.last_ns = -1
        self.left_out = self.unnamed = 0
        self.damage = source.info.damage
        self.failure: EdorasError | None = None
        self._scope = scope or Scope()
        self.recordings = np.array([*recording_names(source.files), ""] if source.files else [], object)

    @property
    @abstractmethod
    def notes(self) -> list[str]:
        """Notes on the input for the user, a line each."""

    @abstractmethod
    def types(self, topic: str) -> TypeStore:
        """Return the types that include a topic's."""

    def empty(self, topic: str) -> TopicBlock:
        """Return an empty block of a topic, with the columns that all blocks of the topic have."""
        if topic in JUDGED and not self.topics[topic]:
            return self._with_name(judged_block(topic))
        none = np.zeros(0, np.int64)
        columns = self.types(topic).columns(
            self.topics[topic], np.zeros(0, np.uint8), none, none.astype(np.int32)
        )
        recording = self.recordings[none] if len(self.recordings) else None
        if self.source is None:
            return TopicBlock(topic, none, columns, recording=recording)
        return TopicBlock(topic, none, columns, none, none.astype(np.uint32), recording=recording)

    def add_hidden_topics(self) -> None:  # noqa: B027  most name all of them
        """Add topics that only the content names, if this needs a pass over it."""

    def look_ahead(self) -> None:  # noqa: B027  as add_hidden_topics
        """Add the DDS topics that the content announces, if it can be read twice."""

    def definition(self, topic: str) -> str:
        """Return the definition of a topic's type; empty if it has none."""
        kind = self.topics[topic]
        return self.types(topic).definition(kind) if kind else ""

    def blocks(self, topics: Collection[str], progress: Progress | None = None) -> Iterator[TopicBlock]:
        """Yield the messages of some topics; see ``pieces``."""
        for _, _, block in self.pieces(topics, lambda block, _: block, progress):
            yield block

    @abstractmethod
    def pieces(
        self, topics: Collection[str], make: Maker, progress: Progress | None = None, jobs: int = 1
    ) -> Iterator[Made]:
        """Yield the result of a function for the messages of some topics, block by block.

        A failure of the input is kept in ``failure``.

        Args:
            topics: the topics.
            make: function of a block and ``zero_ns``; it may run in any process.
            progress: updated while the input is read.
            jobs: number of processes that share the work, see ``jobs_for``.

        Raises:
            RouteError: the selection names a topic that is not configured.
            ConfigError: its filter has a mistake.
        """

    def _recording(self, origin: Integers, rows: NDArray[Any]) -> NDArray[np.object_] | None:
        """Return the name of the recording of each row of a batch; None if there is a single one."""
        return self.recordings[origin[rows]] if len(self.recordings) else None

    def _with_name(self, block: TopicBlock) -> TopicBlock:
        """Return the block of an examination with the name of the recording that was examined."""
        one = len(self.recordings) == 2
        return replace(block, recording=np.full(len(block), self.recordings[0], object)) if one else block

    def _shared(
        self,
        arguments_of: Callable[[PacketBatch, Columns], tuple[Any, ...]],
        work: Callable[..., list[Made]],
        progress: Progress | None,
        jobs: int,
    ) -> Iterator[Made]:
        """Read the source; yield what a function returns for each batch, in order.

        Args:
            arguments_of: returns the arguments of ``work``; called in this process, batch after batch.
            work: may run in other processes.
            progress: see ``pieces``.
            jobs: see ``pieces``.
        """
        scope, source, bench = self._scope, self._source, self._bench
        with ExitStack() as ends:
            workers = None
            if (count := jobs_for(source, jobs, fixed=False)) > 1:
                why = "a process that made its tables was killed, perhaps because memory ran out"
                killed = CaptureError(f"{self.name}: {why}; --jobs 1 needs only one")
                with suppress(OSError):  # without other processes it takes longer
                    workers = ends.enter_context(closing(Workers(count - 1, work, killed, yields=not jobs)))
                    source.borrow(workers.lend)
            results = InOrder(work, workers)
            loop = ends.enter_context(
                reading(
                    source, bench, scope.selection, examined=scope.period, keeps_failure=True, selected=True
                )
            )
            for rows in loop:
                if progress is not None:
                    progress.read(source)
                if loop.begin_ns is not None:
                    self.zero_ns, self.last_ns = loop.begin_ns, loop.last_ns
                if len(rows):
                    results.add(*arguments_of(*rows.alone()), alone=source.statistics.ended)
                    yield from chain.from_iterable(results.results(_MOST_MADE))
            yield from chain.from_iterable(results.results(0))
            self.failure = loop.failure
            loop.note()
            self.unnamed = bench.columns.context.unnamed

    def shared(self, jobs: int) -> bool:
        """Return whether several processes share the work; see ``pieces``."""
        return jobs_for(self._source, jobs, fixed=False) > 1

    def check_found(self, topics_found: Collection[object], selection: Collection[str]) -> None:
        """Check, once the whole input was read, that there was a message on a wanted topic.

        Raises:
            CaptureError: there was none; it says why.
        """
        if topics_found:
            return
        if self.failure is not None:
            raise self.failure
        after = ""
        if self.last_ns >= 0:
            after = f"; its times go from 0 to {(self.last_ns - self.zero_ns) / SECOND:.3f} s"
        topics = listed(sorted(selection)) or "any topic"
        raise CaptureError(f"{self.name}: no message on {topics} in the selected part{after}")

    def close(self) -> None:
        """Close the input; may be called twice."""
        self._source.close()


class CaptureTopics(TopicSource):
    """A capture, or a recording with its datagrams, by topic; see ``TopicSource``.

    Args:
        source: source of the datagrams; it is closed.
        bench: mission, types and decoders.
        scope: selects the datagrams.
        judge: function that makes the topics of ``JUDGED``; None if the source cannot be read again.
        seek: function that reads the source again for topics that only its content names; returns them, and
            the error that ended it early, if any. None if the source cannot be read again.
    """

    def __init__(
        self,
        source: Source,
        bench: Workbench,
        scope: Scope | None = None,
        judge: Judge | None = None,
        seek: Callable[[], tuple[Mapping[str, str], EdorasError | None]] | None = None,
    ) -> None:
        super().__init__(source, bench, scope)
        self.source, self._judge = source, judge
        self._seek = seek
        self._new: set[str] = set()
        self._origin = np.full(1, -1)
        self._structs = bench.columns.context.structs
        self._streams = Streams(
            bench.mission, bench.types, source.statistics, structs=self._structs, add=self._add
        )
        self._streams.endpoints = bench.columns.context.endpoints
        self._places: list[Topic] = [*self._streams.topics, FAULTS]
        self.topics = {item.name: item.type for item in self._places}
        self.topics |= {item.topic: item.type for item in self._streams.structs.all}
        self.topics |= dict.fromkeys(sorted(JUDGED) if judge else (), "")

    @property
    def notes(self) -> list[str]:
        """Notes on the input for the user."""
        return [*self._bench.mission.warnings, *self._bench.columns.context.notes]

    def look_ahead(self) -> None:
        """Add the DDS topics that the content announces, if it can be read twice."""
        for topic, kind in self._bench.columns.context.announced_topics().items():
            if self._bench.types.has(kind):
                self.topics.setdefault(f"{APART}{topic}" if topic in self.topics else topic, kind)

    def add_hidden_topics(self) -> None:
        """Add the topics of RACS2, of DDS and of transferred files."""
        if self._seek is not None:
            topics, failure = self._seek()
            self.topics = {**topics, **self.topics}
            self.damage, self._seek = str(failure or ""), None

    def types(self, topic: str) -> TypeStore:
        """Return the types that include a topic's."""
        return self._types(self.topics[topic])

    def _types(self, kind: str) -> TypeStore:
        structs = self._structs
        return structs.types if kind in structs.definitions else self._bench.types

    def pieces(
        self, requested: Collection[str], make: Maker, progress: Progress | None = None, jobs: int = 1
    ) -> Iterator[Made]:
        """Yield the result of a function for the messages of some topics."""
        routed: set[str] = set()
        statistics = STATISTICS_TOPIC in requested
        scope, source, streams = self._scope, self._source, self._streams

        def arguments(batch: PacketBatch, columns: Columns) -> tuple[Any, ...]:
            published = source.published(batch.number)
            prepared = streams.prepare(batch, columns, published, statistics=statistics)
            selection = {*requested, *self._new} if self.wants_new else requested
            for number, rows in by_value(columns.spacecraft):
                topics = [item.topic for item in self._bench.mission.of(number).routes]
                routed.update(topics)
                claimed = [place for place, topic in enumerate(topics) if topic in selection]
                self.left_out += int(np.isin(columns.route[rows], claimed).sum())
            self._origin = source.origin(batch.number)
            return batch, columns, prepared, selection, tuple(self._places), self.zero_ns, self._origin

        def work(
            batch: PacketBatch,
            columns: Columns,
            prepared: PreparedBatch,
            selection: Collection[str],
            places: Sequence[Topic],
            zero_ns: int,
            origin: Integers,
        ) -> list[Made]:
            of_topics = streams.prepared_messages(
                batch, columns, prepared, datagrams=DATAGRAMS_TOPIC in selection
            )
            return [
                (block.topic, len(block), make(block, zero_ns))
                for block in self._blocks(of_topics, len(batch), selection, places, origin)
            ]

        if not (self.wants_new or scope.period or scope.selection.topics) and self._in_packets(requested):
            selection = replace(scope.selection, topics=tuple(requested))
            self._scope = replace(scope, selection=selection)
        for item in self._shared(arguments, work, progress, jobs):
            if item[0] in routed:
                self.left_out -= item[1]
            yield item
        rest = [(streams.finish(), self._origin[-1])] if statistics else []
        rest.append((streams.outages(source.statistics.outages), -1))
        period = scope.period.since(self.zero_ns)
        faults = [item for item in source.faults() if period.holds(item.time_ns - self.zero_ns)]
        rest.append((fault_messages(faults, self._places.index(FAULTS)), -1))
        for messages, place in rest:
            origin = np.full(len(messages), place)
            for block in self._blocks([messages], len(messages), requested, self._places, origin):
                yield block.topic, len(block), make(block, self.zero_ns)
        if (
            self._judge is not None
            and JUDGED & set(requested)
            and not isinstance(self.failure, InterruptError)
        ):
            try:
                for block in map(self._with_name, self._judge(JUDGED & set(requested), progress)):
                    yield block.topic, len(block), make(block, self.zero_ns)
            except CaptureError as error:
                self.failure = self.failure or error

    def _in_packets(self, topics: Collection[str]) -> bool:
        """Return whether the topics are only of packets, and a recording says where its packets are."""
        packets = {item.topic for item in self._bench.mission.routes}
        packets |= {item.topic for item in self._streams.structs.all if item.key.port is None}
        return packets.issuperset(topics) and reads_by_heads(self._source, self._bench)

    def _add(self, topic: Topic) -> int:
        if topic.name not in self.topics:
            self.topics[topic.name] = topic.type
            self._new.add(topic.name)
        self._places.append(topic)
        return len(self._places) - 1

    def _blocks(
        self,
        streams: Sequence[Messages],
        rows: int,
        requested: Collection[str],
        topics: Sequence[Topic],
        origin: Integers,
    ) -> Iterator[TopicBlock]:
        for messages in _in_order(streams, rows):
            places = by_value(np.broadcast_to(messages.channel_id, len(messages)))
            selection = [item for item in places if topics[item[0]].name in requested]
            if not selection:
                continue
            whole = messages if messages.head_bytes == RECORD_BYTES else _laid([messages], rows)
            data, start, length = whole.data, whole.offset, whole.length
            heads = whole.heads(slice(0, len(whole)))
            for place, positions in selection:
                topic = topics[place]
                columns = self._types(topic.type).columns(
                    topic.type, data, start[positions], length[positions].astype(np.int32)
                )
                yield TopicBlock(
                    topic.name,
                    messages.log_time[positions],
                    columns,
                    heads["publish_time"][positions].astype(np.int64),
                    heads["sequence"][positions],
                    recording=self._recording(origin, messages.rows[positions]),
                )


def _in_order(streams: Sequence[Messages], rows: int) -> Sequence[Messages]:
    """Return messages, row by row if several kinds share a topic, as events and resets do."""
    channels = chain.from_iterable(np.unique(item.channel_id).tolist() for item in streams if len(item))
    return [_laid(streams, rows)] if max(Counter(channels).values(), default=0) > 1 else streams


def _laid(streams: Sequence[Messages], rows: int) -> Messages:
    """Put messages in order of their rows, each with its header in front of its bytes."""
    laid = lay_out(streams, rows)
    data = np.frombuffer(laid.data, np.uint8)
    number = np.sort(np.concatenate([item.rows for item in streams]))
    heads = read_at(data, laid.start - RECORD_BYTES, RECORD).__getitem__
    time_ns, length = laid.log_time.astype(np.int64), laid.end - laid.start
    return Messages(number, laid.channel_id, time_ns, RECORD_BYTES, heads, data, laid.start, length)


class BagTopics(TopicSource):
    """Recordings without datagrams by topic; see ``TopicSource``.

    Args:
        source: the messages; it is closed.
        bench: workbench that reads them.
        scope: selects the messages.
    """

    def __init__(self, source: Source, bench: Workbench, scope: Scope | None = None) -> None:
        super().__init__(source, bench, scope)
        self._places: dict[int, str] = {}
        for place, (route, recorded) in enumerate(
            zip(bench.mission.routes, bench.mission.recorded, strict=True)
        ):
            why = recorded.unread
            if not why and route.topic in self.topics:
                why = f"some messages are {route.type}, others {self.topics[route.topic]}"
            if why:
                self.unread[route.topic] = why
            else:
                self.topics[route.topic] = route.type
                self._places[place] = route.topic

    @property
    def notes(self) -> list[str]:
        """Notes on the input for the user."""
        left_out = [
            printable(f"{topic} is left out: {why}", LONGEST_NOTE) for topic, why in self.unread.items()
        ]
        return [*left_out, *self._bench.columns.context.notes]

    def types(self, _: str) -> TypeStore:
        """Return the types that include a topic's."""
        return self._bench.types

    def pieces(
        self, requested: Collection[str], make: Maker, progress: Progress | None = None, jobs: int = 1
    ) -> Iterator[Made]:
        """Yield the result of a function for the messages of some topics."""
        types = self._bench.types
        places = {place: topic for place, topic in self._places.items() if topic in requested}

        def arguments(batch: PacketBatch, columns: Columns) -> tuple[Any, ...]:
            self.left_out += int((_invalid(columns) & np.isin(columns.route, [*places])).sum())
            return batch, columns, self.zero_ns, self._source.origin(batch.number)

        def work(batch: PacketBatch, columns: Columns, zero_ns: int, origin: Integers) -> list[Made]:
            results, invalid = [], _invalid(columns)
            for place, rows in by_value(columns.route):
                if place in places:
                    valid_rows = rows[~invalid[rows]]
                    kind = self.topics[places[place]]
                    values = types.columns(
                        kind, batch.data, batch.offset[valid_rows], batch.length[valid_rows]
                    )
                    recording = self._recording(origin, valid_rows)
                    block = TopicBlock(places[place], batch.time_ns[valid_rows], values, recording=recording)
                    results.append((block.topic, len(block), make(block, zero_ns)))
            return results

        return self._shared(arguments, work, progress, jobs)


def _invalid(columns: Columns) -> Mask:
    """Return which messages are incomplete: bool (rows,)."""
    return (columns.findings & np.uint32(Finding.CDR_INVALID)) != 0


def recording_names(files: Sequence[str]) -> list[str]:
    """Return the names of recordings in tables: file names without suffix, or paths if two would be equal."""
    names = [Path(Path(file).name.removesuffix(".gz").removesuffix(".zst")).stem for file in files]
    return [name if names.count(name) == 1 else file for name, file in zip(names, files, strict=True)]


def open_topics(paths: Sequence[Path], settings: Settings, scope: Scope | None = None) -> TopicSource:
    """Open captures, recordings, or rosbag2 directories by topic.

    Raises:
        CaptureError: one cannot be opened.
        ConfigError: the mission has mistakes, or only some of the paths contain datagrams.
    """
    if len(paths) > 1 and any(map(is_cfe_file, paths)) and "-" not in map(str, paths):
        source, notes = open_aligned(paths, settings)
        bench = settings.workbench(source.info, paths)
        bench.columns.context.notes += notes
    else:
        source, bench = open_inputs(paths, settings)
    if bench.mission.recorded:
        return BagTopics(source, bench, scope)

    def judge(requested: Collection[str], progress: Progress | None) -> Iterator[TopicBlock]:
        return judged_blocks(requested, paths, settings, scope or Scope(), progress)

    def seek() -> tuple[dict[str, str], EdorasError | None]:
        topics: dict[str, str] = {}

        def add(topic: Topic) -> int:
            topics[topic.name] = topic.type
            return len(topics)

        again = open_files(paths)
        bench = settings.workbench(again.info, paths)
        structs = bench.columns.context.structs
        streams = Streams(bench.mission, bench.types, again.statistics, structs=structs, add=add)
        streams.endpoints = bench.columns.context.endpoints
        with reading(again, bench, keeps_failure=True) as loop:
            for rows in loop:
                streams.prepare(*rows.alone(), statistics=False)
        return topics, loop.failure

    again = all(path.is_file() or path.is_dir() for path in paths)
    return CaptureTopics(source, bench, scope, *((judge, seek) if again else ()))
