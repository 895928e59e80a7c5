"""Recordings for notebooks: ``edoras_tools.read("a.mcap")["/cmd_vel"].to_pandas()``.

Columns are made from blocks of messages: selected fields, times, lists as lists or as rows.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cached_property, partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools import doors
from edoras_tools.errors import ConfigError, RouteError
from edoras_tools.io.formats.columns import TableColumn, TableHead
from edoras_tools.io.formats.rosbag2.reader import METADATA
from edoras_tools.io.formats.table import TimeForm
from edoras_tools.io.topics.streams import EVENTS_TOPIC
from edoras_tools.pipelines.doctor import Scope
from edoras_tools.pipelines.export.sources import JUDGED, LOST_TOPIC, VERDICTS_TOPIC, TopicSource, open_topics
from edoras_tools.pipelines.selection import PATTERN_SIGNS, Period, Selection, fits_topic
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.ros.cdr.bulk import Ragged, TopicBlock
from edoras_tools.words import did_you_mean, listed, plural

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.wire.arrays import Integers

    Paths = str | os.PathLike[str] | Iterable[str | os.PathLike[str]]

ELEMENT: Final = "element"
"""The column with the index of an element, if every element of a list has a row."""


class TableForm(NamedTuple):
    """The form in which a block becomes columns.

    Attributes:
        fields: patterns of fields, e.g. ``linear.*``; a name includes the fields inside it. Empty: all.
        explode: every element of a list has a row, and fixed arrays a column for each element.
        time: how times are written; seconds count from the input's start.
    """

    fields: Sequence[str] = ()
    explode: bool = False
    time: TimeForm = TimeForm.UTC

    def columns(self, block: TopicBlock, zero_ns: int) -> list[TableColumn]:
        """Return the columns of a block: its time, its recording, and the selected fields.

        Args:
            block: the messages.
            zero_ns: zero of the times in seconds, ns since 1970.
        """
        columns = [
            column
            for place, column in enumerate(self._all(block, zero_ns))
            if not place
            or not self.fields
            or column.values is block.recording
            or any(fits_field(column.name, item) for item in self.fields)
        ]
        return exploded(columns) if self.explode else columns

    def _all(self, block: TopicBlock, zero_ns: int) -> Iterator[TableColumn]:
        fields = block.message.fields
        yield self._time(_free("time", fields), block.time_ns, zero_ns)
        if block.publish_ns is not None:
            yield self._time(_free("publish_time", fields), block.publish_ns, zero_ns)
        if block.sequence is not None:
            yield TableColumn(_free("sequence", fields), block.sequence)
        if block.recording is not None:
            yield TableColumn(_free("recording", fields), block.recording)
        for name in fields:
            yield TableColumn(name, fields[name], block.present.get(name))

    def _time(self, name: str, time_ns: Integers, zero_ns: int) -> TableColumn:
        if self.time is TimeForm.UTC:
            return TableColumn(name, time_ns.astype("datetime64[ns]"))
        if self.time is TimeForm.NS:
            return TableColumn(name, time_ns, unit="ns")
        return TableColumn(name, (time_ns - zero_ns) / 1e9, unit="s")


def chosen_topics(source: TopicSource, patterns: Sequence[str], usual: Collection[str]) -> list[str]:
    """Return the requested topics.

    Args:
        source: has the topics.
        patterns: shell patterns.
        usual: the topics if there is no pattern.

    Raises:
        RouteError: a pattern fits no topic.
    """
    if not source.topics and source.unread:
        reasons = listed([f"{topic}: {why}" for topic, why in source.unread.items()], 3)
        raise RouteError(f"{source.name}: {reasons}")
    if not patterns:
        return [topic for topic in source.topics if topic in usual]
    if not all(map(PATTERN_SIGNS.isdisjoint, patterns)):
        source.look_ahead()
    if not all(any(fits_topic(topic, item) for topic in source.topics) for item in patterns):
        source.add_hidden_topics()
    for pattern in patterns:
        if not any(fits_topic(topic, pattern) for topic in source.topics):
            raise _no_topic(source, pattern)
    return [topic for topic in source.topics if any(fits_topic(topic, item) for item in patterns)]


def _no_topic(source: TopicSource, pattern: str) -> RouteError:
    for topic, why in source.unread.items():
        if fits_topic(topic, pattern):
            return RouteError(f"{topic} of {source.name}: {why}")
    if source.damage:
        return RouteError(f"no topic of what can be read matches {pattern!r}: {source.damage}")
    near = did_you_mean(f"/{pattern.removeprefix('/')}", source.topics)
    of_mission = [item for item in source.topics if not item.startswith(("/edoras/", "/cfs/"))]
    hint = near or f"there are {listed(list(of_mission or source.topics), 12)}"
    hint += "" if near or of_mission else "; name a mission with -c for its topics"
    return RouteError(f"no topic of {source.name} matches {pattern!r}; {hint}")


def check_fields(patterns: Sequence[str], names_of: Mapping[str, Sequence[str]]) -> list[str]:
    """Return the topics that have a requested field.

    Args:
        patterns: see ``TableForm.fields``.
        names_of: the columns of each topic.

    Raises:
        ConfigError: a pattern fits no field of any topic.
    """
    names = sorted({name for columns in names_of.values() for name in columns})
    for pattern in patterns:
        if not any(fits_field(name, pattern) for name in names):
            hint = did_you_mean(pattern, names, cutoff=0.5) or f"there are {', '.join(names[:12])}"
            raise ConfigError(f"--fields: {pattern!r} is no field of {', '.join(sorted(names_of))}; {hint}")
    return [topic for topic, columns in names_of.items() if has_field(patterns, columns)]


def has_field(patterns: Sequence[str], *columns: Sequence[str]) -> bool:
    """Return whether one of some columns is a requested field, or nothing is requested."""
    names = [name for some in columns for name in some]
    return not patterns or any(fits_field(name, item) for name in names for item in patterns)


def exploded(columns: Sequence[TableColumn]) -> list[TableColumn]:
    """Return columns without lists.

    A fixed array becomes a column for each element, ``covariance[0]`` and so on. A row with lists becomes one
    row for each element of the longest. ``element`` counts them from 0, the other columns are repeated, and a
    shorter list has no value at its end. A row whose lists are all empty stays, without an element.
    """
    flat: list[TableColumn] = []
    for column in columns:
        if isinstance(column.values, Ragged) or column.values.ndim == 1:
            flat.append(column)
            continue
        flat += [
            TableColumn(f"{column.name}[{place}]", column.values[:, place], unit=column.unit)
            for place in range(column.values.shape[1])
        ]
    lengths = [np.diff(column.values.offsets) for column in flat if isinstance(column.values, Ragged)]
    if not lengths:
        return flat
    most = np.maximum.reduce(lengths)
    rows = np.maximum(most, 1)
    owner = np.repeat(np.arange(len(rows)), rows)
    element = np.arange(len(owner)) - np.repeat(np.cumsum(rows) - rows, rows)
    result = []
    for column in flat:
        values: NDArray[Any] | Ragged = column.values
        if not isinstance(values, Ragged):
            present = None if column.present is None else column.present[owner]
            result.append(TableColumn(column.name, values[owner], present, column.unit))
            continue
        inside = element < np.diff(values.offsets)[owner]
        spread = np.zeros(len(owner), values.values.dtype)
        if spread.dtype.kind == "O":
            spread[:] = ""
        spread[inside] = values.values
        result.append(TableColumn(column.name, spread, inside, column.unit))
    name = _free(ELEMENT, {column.name: None for column in flat})
    return [result[0], TableColumn(name, element.astype(np.uint32), (most > 0)[owner]), *result[1:]]


def _free(name: str, used: Mapping[str, object]) -> str:
    """Return a name for a column of this package that no field of the message has."""
    while name in used:
        name = f"_{name}"
    return name


def fits_field(name: str, pattern: str) -> bool:
    """Return whether a field, or one that it is inside, matches a shell pattern."""
    return fnmatchcase(name, pattern) or name.startswith(f"{pattern}.")


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
        configured = replace(configured, configs=configs)
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
