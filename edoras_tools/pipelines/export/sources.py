"""Reads captures, and recordings of other tools, by topic: blocks of messages in columns.

A capture has the same topics as a recording of it (``io.topics.streams``). A recording of another tool has
the topics that were recorded. It contains no datagrams, so nothing can be selected by link or MsgId.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.errors import CaptureError
from edoras_tools.io.formats.merge import recorded_faults
from edoras_tools.io.formats.open import is_cfe_file
from edoras_tools.io.topics.faults import fault_messages
from edoras_tools.io.topics.names import DATAGRAMS_TOPIC
from edoras_tools.io.topics.rows import RECORD_BYTES, lay_out
from edoras_tools.io.topics.streams import FAULTS, STATISTICS_TOPIC, Streams
from edoras_tools.mission.report import printable
from edoras_tools.model import Finding
from edoras_tools.pipelines.ahead import read_ahead
from edoras_tools.pipelines.capture.ledger import LONGEST_NOTE
from edoras_tools.pipelines.clocks import open_aligned
from edoras_tools.pipelines.doctor.scope import Scope
from edoras_tools.pipelines.export.block import TopicBlock
from edoras_tools.pipelines.export.judged import JUDGED, judged_block, judged_blocks
from edoras_tools.pipelines.messages.opening import open_inputs
from edoras_tools.pipelines.reading import reading
from edoras_tools.pipelines.workbench import open_files
from edoras_tools.units import SECOND
from edoras_tools.wire.arrays.order import by_value
from edoras_tools.words import listed

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
    from pathlib import Path

    from edoras_tools.errors import EdorasError
    from edoras_tools.io import Source
    from edoras_tools.io.topics.rows import Messages
    from edoras_tools.io.topics.streams import Topic
    from edoras_tools.pipelines.workbench import Settings, Workbench
    from edoras_tools.render.terminal.run import Progress
    from edoras_tools.ros import TypeStore

    Judge = Callable[[Collection[str], Progress | None], Iterator[TopicBlock]]


_OWN_THREADS: Final = 2
"""Processors that one process keeps busy by itself: one thread makes columns, another writes tables."""


class TopicSource(ABC):
    """An input that is read by topic, once.

    Attributes:
        name: of the input.
        topics: every topic that it can contain, with its type; those that only the content names are added
            while it is read.
        wants_new: whether blocks of these are wanted, too.
        unread: other topics of a recording, and why their messages cannot be read.
        source: where its datagrams come from; None if it has none.
        zero_ns: the time that its times count from; -1 until it is known.
        last_ns: latest time that was read; -1 before.
        left_out: messages on wanted topics that are incomplete or do not fit their type.
        unnamed: see ``Context``.
        failure: why it ended early, if it did.
        interrupted: Ctrl-C ended it.
        jobs: how many processes share the work, see ``read_ahead``; may be set before it is read.
    """

    source: Source | None = None
    wants_new = False

    def __init__(self, name: str, scope: Scope | None) -> None:
        self.name = name
        self.topics: dict[str, str] = {}
        self.unread: dict[str, str] = {}
        self.zero_ns = self.last_ns = -1
        self.left_out = self.unnamed = 0
        self.failure: EdorasError | None = None
        self.interrupted = False
        self.jobs = 1
        self._scope = scope or Scope()

    @property
    @abstractmethod
    def notes(self) -> list[str]:
        """Notes on the input for the user, a line each."""

    @abstractmethod
    def types(self, topic: str) -> TypeStore:
        """Return the types that include a topic's."""

    def empty(self, topic: str) -> TopicBlock:
        """Return a block of a topic without messages; it has the columns of all its blocks."""
        if topic in JUDGED and not self.topics[topic]:
            return judged_block(topic)
        none = np.zeros(0, np.int64)
        columns = self.types(topic).columns(
            self.topics[topic], np.zeros(0, np.uint8), none, none.astype(np.int32)
        )
        if self.source is None:
            return TopicBlock(topic, none, columns)
        return TopicBlock(topic, none, columns, none, none.astype(np.uint32))

    def look(self) -> None:  # noqa: B027  most name all of them
        """Add topics that only the content names, if that needs reading it."""

    def definition(self, topic: str) -> str:
        """Return the definition of a topic's type; empty if it has none."""
        kind = self.topics[topic]
        return self.types(topic).definition(kind) if kind else ""

    @abstractmethod
    def blocks(self, wanted: Collection[str], progress: Progress | None = None) -> Iterator[TopicBlock]:
        """Yield the messages of some topics; a failure of the input is kept in ``failure``.

        Raises:
            RouteError: the selection names a topic that is not configured.
            ConfigError: its filter has a mistake.
        """

    def check_found(self, found: Collection[object], wanted: Collection[str]) -> None:
        """Check, once the whole input was read, that there was a message on a wanted topic.

        Raises:
            CaptureError: there was none, and why.
        """
        if found:
            return
        if self.failure is not None:
            raise self.failure
        after = ""
        if self.last_ns >= 0:
            after = f"; its times go from 0 to {(self.last_ns - self.zero_ns) / SECOND:.3f} s"
        topics = listed(sorted(wanted)) or "any topic"
        raise CaptureError(f"{self.name}: no message on {topics} in the selected part{after}")

    def close(self) -> None:
        """Close the input; may be called twice."""
        if self.source is not None:
            self.source.close()


class CaptureTopics(TopicSource):
    """A capture, or a recording with its datagrams, by topic; see ``TopicSource``.

    Args:
        source: where datagrams come from; it is closed.
        bench: mission, types and decoders.
        scope: which datagrams.
        judge: makes the topics of ``JUDGED``; None if the source cannot be read again.
        seek: reads the source again for the topics that only its content names; None if it cannot.
    """

    def __init__(
        self,
        source: Source,
        bench: Workbench,
        scope: Scope | None = None,
        judge: Judge | None = None,
        seek: Callable[[], Mapping[str, str]] | None = None,
    ) -> None:
        super().__init__(source.info.name, scope)
        self.source, self._source, self._bench, self._judge = source, source, bench, judge
        self._seek = seek
        self._new: set[str] = set()
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

    def look(self) -> None:
        """Add the topics of RACS2, of DDS and of files that were transferred."""
        if self._seek is not None:
            self.topics = {**self._seek(), **self.topics}
            self._seek = None

    def types(self, topic: str) -> TypeStore:
        """Return the types that include a topic's."""
        structs = self._structs
        return structs.types if self.topics[topic] in structs.definitions else self._bench.types

    def blocks(self, wanted: Collection[str], progress: Progress | None = None) -> Iterator[TopicBlock]:
        """Yield the messages of some topics."""
        routes = [place for place, item in enumerate(self._bench.mission.routes) if item.topic in wanted]
        statistics = STATISTICS_TOPIC in wanted
        scope, source = self._scope, self._source
        if not scope.selection and not scope.period:  # else it is decoded where it is selected
            source = read_ahead(source, self._bench.columns, self.jobs, own=_OWN_THREADS)
        with reading(source, self._bench, scope.selection, examined=scope.period, keeps_failure=True) as loop:
            for rows in loop:
                if progress is not None:
                    progress.read(self._source)
                if loop.begin_ns is not None:
                    self.zero_ns, self.last_ns = loop.begin_ns, loop.last_ns
                if not len(rows):
                    continue
                batch, columns = rows.alone()
                self.left_out += int(np.isin(columns.route, routes).sum())
                found = self._streams.messages(
                    batch, columns, datagrams=DATAGRAMS_TOPIC in wanted, statistics=statistics
                )
                yield from self._blocks(found, len(batch), wanted)
            self.failure, self.interrupted = loop.failure, loop.interrupted
            loop.note()
            self.unnamed = self._bench.columns.context.unnamed
        rest = [self._streams.finish()] if statistics else []
        rest.append(self._streams.outages(self._source.statistics.outages))
        period = self._scope.period.since(self.zero_ns)
        faults = [item for item in recorded_faults(self._source) if period.holds(item.time_ns - self.zero_ns)]
        rest.append(fault_messages(faults, self._places.index(FAULTS)))
        for messages in rest:
            yield from self._blocks([messages], len(messages), wanted)
        if self._judge is not None and JUDGED & set(wanted) and not self.interrupted:
            try:
                yield from self._judge(JUDGED & set(wanted), progress)
            except CaptureError as error:
                self.failure = self.failure or error

    def _add(self, topic: Topic) -> int:
        if topic.name not in self.topics:
            self.topics[topic.name] = topic.type
            self._new.add(topic.name)
        self._places.append(topic)
        return len(self._places) - 1

    def _blocks(
        self, streams: Sequence[Messages], rows: int, wanted: Collection[str]
    ) -> Iterator[TopicBlock]:
        routes = range(len(self._streams.topics) - len(self._bench.mission.routes), len(self._streams.topics))
        for messages in streams:
            places = by_value(np.broadcast_to(messages.channel_id, len(messages)))
            if self.wants_new:
                wanted = {*wanted, *self._new}
            chosen = [item for item in places if self._places[item[0]].name in wanted]
            if not chosen:
                continue
            if (
                messages.head_bytes == RECORD_BYTES
            ):  # the message is the bytes behind the head, where they lie
                data, start, length = messages.data, messages.offset, messages.length
            else:
                laid = lay_out([messages], rows)
                data, start, length = np.frombuffer(laid.data, np.uint8), laid.start, laid.end - laid.start
            heads = messages.heads(slice(0, len(messages)))
            for place, here in chosen:
                topic = self._places[place]
                columns = self.types(topic.name).columns(
                    topic.type, data, start[here], length[here].astype(np.int32)
                )
                if place in routes:
                    self.left_out -= len(here)
                yield TopicBlock(
                    topic.name,
                    messages.log_time[here],
                    columns,
                    heads["publish_time"][here].astype(np.int64),
                    heads["sequence"][here],
                )


class BagTopics(TopicSource):
    """Recordings without datagrams by topic; see ``TopicSource``.

    Args:
        source: the messages; it is closed.
        bench: what reads them.
        scope: which messages.
    """

    def __init__(self, source: Source, bench: Workbench, scope: Scope | None = None) -> None:
        super().__init__(source.info.name, scope)
        self._messages, self._bench = source, bench
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

    def blocks(self, wanted: Collection[str], progress: Progress | None = None) -> Iterator[TopicBlock]:
        """Yield the messages of some topics."""
        scope, types = self._scope, self._bench.types
        places = {place: topic for place, topic in self._places.items() if topic in wanted}
        with reading(
            self._messages, self._bench, scope.selection, examined=scope.period, keeps_failure=True
        ) as loop:
            for rows in loop:
                if progress is not None:
                    progress.read(self._messages)
                if loop.begin_ns is not None:
                    self.zero_ns, self.last_ns = loop.begin_ns, loop.last_ns
                batch, route = rows.batch, rows.column("route")
                invalid = (rows.column("findings") & np.uint32(Finding.CDR_INVALID)) != 0
                for place, here in by_value(route):
                    if place not in places:
                        continue
                    self.left_out += int(invalid[here].sum())
                    here = here[~invalid[here]]  # noqa: PLW2901  without the incomplete ones
                    offset, length = rows.datagram("offset")[here], rows.datagram("length")[here]
                    columns = types.columns(self.topics[places[place]], batch.data, offset, length)
                    yield TopicBlock(places[place], rows.datagram("time_ns")[here], columns)
            self.failure, self.interrupted = loop.failure, loop.interrupted

    def close(self) -> None:
        """Close the input; may be called twice."""
        self._messages.close()


def open_topics(paths: Sequence[Path], settings: Settings, scope: Scope | None = None) -> TopicSource:
    """Open captures, recordings, or rosbag2 directories by topic.

    Raises:
        CaptureError: one cannot be opened.
        ConfigError: the mission has mistakes, or some contain datagrams and others only topics.
    """
    if len(paths) > 1 and any(map(is_cfe_file, paths)) and "-" not in map(str, paths):
        source, notes = open_aligned(paths, settings)
        bench = settings.workbench(source.info)
        bench.columns.context.notes += notes
    else:
        source, bench = open_inputs(paths, settings)
    if bench.mission.recorded:
        return BagTopics(source, bench, scope)

    def judge(wanted: Collection[str], progress: Progress | None) -> Iterator[TopicBlock]:
        return judged_blocks(wanted, paths, settings, scope or Scope(), progress)

    def seek() -> dict[str, str]:
        found: dict[str, str] = {}

        def add(topic: Topic) -> int:
            found[topic.name] = topic.type
            return len(found)

        again = open_files(paths)
        bench = settings.workbench(again.info)
        structs = bench.columns.context.structs
        streams = Streams(bench.mission, bench.types, again.statistics, structs=structs, add=add)
        streams.endpoints = bench.columns.context.endpoints
        with reading(again, bench, keeps_failure=True) as loop:
            for rows in loop:
                streams.prepare(*rows.alone(), statistics=False)
        return found

    again = all(path.is_file() or path.is_dir() for path in paths)
    return CaptureTopics(source, bench, scope, *((judge, seek) if again else ()))
