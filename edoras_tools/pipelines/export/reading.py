"""Recordings for notebooks: ``edoras_tools.read("a.mcap")["/cmd_vel"].to_pandas()``."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property, partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import msgspec
import numpy as np

from edoras_tools import doors
from edoras_tools.errors import ConfigError, RouteError
from edoras_tools.io.formats.columns import TableColumn, TableHead
from edoras_tools.io.formats.rosbag2.reader import METADATA
from edoras_tools.io.formats.table import TimeForm
from edoras_tools.io.topics.streams import EVENTS_TOPIC
from edoras_tools.pipelines.doctor.scope import Scope
from edoras_tools.pipelines.export.sources import JUDGED, LOST_TOPIC, VERDICTS_TOPIC, TopicSource, open_topics
from edoras_tools.pipelines.export.tables import TableForm, chosen_topics
from edoras_tools.pipelines.selection import Period, Selection
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.ros.cdr.columns import Ragged
from edoras_tools.words import listed, plural

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Paths = str | os.PathLike[str] | Iterable[str | os.PathLike[str]]


class TopicTable(msgspec.Struct, frozen=True, dict=True):
    """The messages of a topic, one row each; they are read at their first use.

    Attributes:
        topic: with its leading slash.
        type: ROS type name.
        pieces: function that reads them and yields groups of columns; the first group has no rows.
    """

    topic: str
    type: str
    pieces: Callable[[], Iterator[Sequence[TableColumn]]]

    @cached_property
    def columns(self) -> Sequence[TableColumn]:
        """``time``, then the fields with dotted names, in wire order."""
        return [_joined(column) for column in zip(*self.pieces(), strict=True)]

    def __len__(self) -> int:
        return len(self.columns[0])

    def __repr__(self) -> str:
        names = ", ".join(item.name for item in self.columns)
        title = f"{self.topic}, {self.type}" if self.type else self.topic
        return f"<{len(self):,} rows of {title}: {names}>"

    def to_numpy(self) -> dict[str, NDArray[Any]]:
        """Return an array for each column.

        A fixed array has shape (rows, elements). Lists of different lengths are an array of arrays, one for
        each row; texts are objects; with ``explode`` missing values are masked.
        """
        return {
            item.name: _array(item.values)
            if item.present is None
            else np.ma.masked_array(_array(item.values), ~item.present)
            for item in self.columns
        }

    def to_arrow(self, *, lazy: bool = False) -> Any:
        """Return a ``pyarrow.Table``, with types, units and the message definition's name.

        Args:
            lazy: return a ``RecordBatchReader``, which reads the input piece by piece, once.

        Raises:
            ConfigError: pyarrow is not installed.
        """
        arrays = _arrow_tables("to_arrow()")
        head = TableHead(self.topic, self.type)
        if lazy:
            return arrays.record_batches(head, self.pieces())
        return arrays.arrow_table([arrays.arrow_batch(self.columns, arrays.arrow_schema(head, self.columns))])

    def to_polars(self, *, lazy: bool = False) -> Any:
        """Return a ``polars.DataFrame``.

        Args:
            lazy: return a ``LazyFrame``, which reads the input piece by piece each time it is collected, and
                keeps only the columns and rows that the query needs.

        Raises:
            ConfigError: polars or pyarrow is not installed.
        """
        return _arrow_tables("to_polars()").polars_frame(self, lazy=lazy)

    def to_pandas(self) -> Any:
        """Return a ``pandas.DataFrame``; lists are arrays, times are timestamps in UTC.

        Raises:
            ConfigError: pandas is not installed.
        """
        try:
            pandas = import_module("pandas")
        except ImportError as error:
            raise ConfigError("to_pandas() needs pandas: pip install pandas; to_numpy() does not") from error
        columns = {}
        for item in self.columns:
            values = _array(item.values)
            series = pandas.Series(values if values.ndim == 1 else list(values))
            if values.dtype.kind == "M":
                series = series.dt.tz_localize("UTC")
            columns[item.name] = series if item.present is None else series.where(item.present)
        return pandas.DataFrame(columns)


class NoTopicError(RouteError, KeyError):
    """Error: a recording has no such topic."""

    __str__ = RouteError.__str__


@dataclass(frozen=True)
class RecordingTables(Mapping[str, TopicTable]):
    """The topics of files. A file is read again for each topic that is used for the first time.

    Its keys are the topics that have messages. Unreadable parts cause a warning.

    Attributes:
        paths: the files.
        settings: mission, types and options.
        scope: part of the files that is read.
        form: form of times and lists.
        recording: value of the column ``recording``, if the files are one recording; empty: no such column.
    """

    paths: Sequence[Path]
    settings: Settings
    scope: Scope
    form: TableForm
    recording: str = ""

    def __repr__(self) -> str:
        rows = [f"{count:>12,}  {topic}" for topic, count in self.topics.items()]
        return "\n".join([f"{listed([*map(str, self.paths)], 3)}: {plural(len(rows), 'topic')}", *rows])

    def __getitem__(self, topic: str) -> TopicTable:
        """Return the messages of a topic, perhaps none; the leading slash may be left out.

        Raises:
            NoTopicError: there is no such topic, or several match.
        """
        with closing(self._open()) as source:
            name = _find_topic(source, topic)
        if name not in self._tables:
            self._tables[name] = TopicTable(name, source.topics[name], partial(self._pieces, name))
        return self._tables[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.topics)

    def __len__(self) -> int:
        return len(self.topics)

    def __contains__(self, topic: object) -> bool:
        return f"/{str(topic).removeprefix('/')}" in self.topics

    @cached_property
    def topics(self) -> dict[str, int]:
        """The number of messages of each topic that has any."""
        counts = dict[str, int]()
        with closing(self._open()) as source:
            for block in source.blocks(source.topics.keys() - JUDGED):
                counts[block.topic] = counts.get(block.topic, 0) + len(block)
        _warn(source)
        return counts

    @property
    def events(self) -> TopicTable:
        """The events that cFE sent, ``/edoras/events``."""
        return self[EVENTS_TOPIC]

    @property
    def lost(self) -> TopicTable:
        """The messages that did not arrive, as in ``doctor --list-lost``."""
        return self[LOST_TOPIC]

    @property
    def verdicts(self) -> TopicTable:
        """The verdicts of the doctor, the most severe first; times are the start of each."""
        return self[VERDICTS_TOPIC]

    @cached_property
    def _tables(self) -> dict[str, TopicTable]:
        return {}

    def _open(self) -> TopicSource:
        source = open_topics(self.paths, self.settings, self.scope)
        if self.recording:
            source.recordings = np.array([self.recording, ""], object)
        return source

    def _pieces(self, topic: str) -> Iterator[Sequence[TableColumn]]:
        """Read the messages of a topic."""
        with closing(self._open()) as source:
            topic = _find_topic(source, topic)
            yield self.form.columns(source.empty(topic), 0)
            for block in source.blocks([topic]):
                yield self.form.columns(block, source.zero_ns)
        _warn(source)


def read(
    paths: Paths,
    *,
    config: Paths = (),
    where: str = "",
    start: float = 0,
    end: float = 0,
    time: str = "utc",
    explode: bool = False,
    settings: Settings | None = None,
) -> RecordingTables:
    """Open captures, recordings or rosbag2 directories to read their topics as tables.

    If several are read, the column ``recording`` names the one that a row is from.

    Args:
        paths: one file; several, which are read as one, in order of time; or a folder or pattern of
            recordings, each of which is read by itself.
        config: mission files; a recording carries its own.
        where: only datagrams that pass this filter, like ``--where``.
        start: datagrams before this many seconds after the first one are left out.
        end: datagrams from this many seconds after the first one on are left out; 0 for none.
        time: ``utc`` timestamps, ``ns`` since 1970, or ``seconds`` since the start.
        explode: see ``edoras export --explode``.
        settings: message definitions and decoding options; ``config`` replaces its mission files.

    Raises:
        CaptureError: a file cannot be opened.
        ConfigError: a mission file or the filter has mistakes, or ``time`` is unknown.
    """
    if time not in list(TimeForm):
        raise ConfigError(f"time={time!r} is not a time format; use {', '.join(TimeForm)}")
    configured = settings or Settings()
    if configs := _paths(config):
        configured = Settings(
            configs, configured.distro, configured.msg_paths, configured.options, configured.structs
        )
    scope = Scope(Selection(where=where), Period(int(start * 1e9), int(end * 1e9)))
    form = TableForm(explode=explode, time=TimeForm(time))
    tables = RecordingTables(_paths(paths), configured, scope, form)
    if any(not path.exists() or (path.is_dir() and not (path / METADATA).exists()) for path in tables.paths):
        tables = cast("RecordingTables", doors.part("recordings")(tables))
    tables._open().close()  # noqa: SLF001  what is wrong is told now
    return tables


def _arrow_tables(method: str) -> Any:
    """Return the module that makes tables of pyarrow; ``ConfigError`` for a method if it is absent."""
    try:
        return doors.part("arrow_tables")
    except ImportError as error:
        raise ConfigError(
            f"{method} needs pyarrow: pip install 'edoras-tools[analysis]'; to_numpy() does not"
        ) from error


def _paths(paths: Paths) -> tuple[Path, ...]:
    if isinstance(paths, (str, os.PathLike)):
        return (Path(paths),)
    return tuple(map(Path, paths))


def _find_topic(source: TopicSource, pattern: str) -> str:
    try:
        topics = chosen_topics(source, [pattern], ())
    except RouteError as error:
        raise NoTopicError(*error.args) from None
    if len(topics) != 1:
        raise NoTopicError(f"{pattern!r} fits several topics: {', '.join(topics)}; name one")
    return topics[0]


def _warn(source: TopicSource) -> None:
    """Warn about an incomplete input; everything readable is kept."""
    if source.failure is not None:
        warnings.warn(str(source.failure), stacklevel=4)
    if source.left_out:
        warnings.warn(f"{source.left_out:,} messages are incomplete and were left out", stacklevel=4)


def _joined(pieces: Sequence[TableColumn]) -> TableColumn:
    """Return the rows of several pieces of one column."""
    first = pieces[0]
    present = None
    if first.present is not None:
        present = np.concatenate([item.present for item in pieces if item.present is not None])
    values: NDArray[Any] | Ragged
    if isinstance(first.values, Ragged):
        lists = [item.values for item in pieces if isinstance(item.values, Ragged)]
        offsets = np.cumsum(np.concatenate([[0], *(np.diff(item.offsets) for item in lists)]))
        values = Ragged(np.concatenate([item.values for item in lists]), offsets)
    else:
        values = np.concatenate([item.values for item in pieces if not isinstance(item.values, Ragged)])
    return TableColumn(first.name, values, present, first.unit)


def _array(values: NDArray[Any] | Ragged) -> NDArray[Any]:
    if not isinstance(values, Ragged):
        return values
    result = np.empty(len(values), object)
    for row in range(len(values)):
        result[row] = values[row]
    return result
