"""Recordings for notebooks: ``edoras_tools.read("a.mcap")["/cmd_vel"].to_pandas()``."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from edoras_tools.errors import ConfigError, RouteError
from edoras_tools.io.formats.columns import TableColumn, TableHead
from edoras_tools.io.formats.table import TimeForm
from edoras_tools.io.topics.streams import EVENTS_TOPIC
from edoras_tools.pipelines.doctor.scope import Scope
from edoras_tools.pipelines.export.judged import JUDGED, LOST_TOPIC, VERDICTS_TOPIC
from edoras_tools.pipelines.export.sources import TopicSource, open_topics
from edoras_tools.pipelines.export.tables import TableForm, chosen_topics
from edoras_tools.pipelines.selection import Period, Selection
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.ros.cdr.columns import Ragged

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    Paths = str | os.PathLike[str] | Iterable[str | os.PathLike[str]]


@dataclass(frozen=True, slots=True)
class TopicTable:
    """The messages of a topic, a row each.

    Attributes:
        topic: with its leading slash.
        type: ROS type name.
        columns: ``time``, then the fields with dotted names, in wire order.
    """

    topic: str
    type: str
    columns: Sequence[TableColumn]

    def __len__(self) -> int:
        return len(self.columns[0])

    def __repr__(self) -> str:
        names = ", ".join(item.name for item in self.columns)
        title = f"{self.topic}, {self.type}" if self.type else self.topic
        return f"<{len(self):,} rows of {title}: {names}>"

    def to_numpy(self) -> dict[str, NDArray[Any]]:
        """Return an array for each column.

        A fixed array has shape (rows, elements); where lists differ in length the array holds an array for
        each row; texts are objects; where values are not there (``explode``) the array is masked.
        """
        return {
            item.name: _array(item.values)
            if item.present is None
            else np.ma.masked_array(_array(item.values), ~item.present)
            for item in self.columns
        }

    def to_arrow(self) -> Any:
        """Return a ``pyarrow.Table``, with types, units and the message definition's name.

        Raises:
            ConfigError: pyarrow is not installed.
        """
        try:
            arrays = import_module("edoras_tools.io.formats.arrow")
        except ImportError as error:
            raise ConfigError(
                "to_arrow() needs pyarrow: pip install 'edoras-tools[analysis]'; to_numpy() does not"
            ) from error
        schema = arrays.arrow_schema(TableHead(self.topic, self.type), self.columns)
        return arrays.arrow_table([arrays.arrow_batch(self.columns, schema)])

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
    """A recording has no such topic."""

    __str__ = RouteError.__str__


@dataclass(frozen=True)
class RecordingTables(Mapping[str, TopicTable]):
    """The topics of files. A file is read again for each topic that is used for the first time.

    Its keys are the topics that have messages. A warning says what could not be read.

    Attributes:
        paths: the files.
        settings: mission, types and options.
        scope: which part of them.
        form: how times are given, and lists.
    """

    paths: Sequence[Path]
    settings: Settings
    scope: Scope
    form: TableForm

    def __repr__(self) -> str:
        return f"<{', '.join(map(str, self.paths))}: {', '.join(self.topics)}>"

    def __getitem__(self, topic: str) -> TopicTable:
        """Return the messages of a topic, none where there are none; the leading slash may be left out.

        Raises:
            NoTopicError: there is no such topic, or several fit.
        """
        source = self._open()
        try:
            name = _find_topic(source, topic)
            if name not in self._tables:
                self._tables[name] = _read(source, name, self.form)
        finally:
            source.close()
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
        source, counts = self._open(), dict[str, int]()
        try:
            for block in source.blocks(source.topics.keys() - JUDGED):
                counts[block.topic] = counts.get(block.topic, 0) + len(block)
        finally:
            source.close()
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
        return open_topics(self.paths, self.settings, self.scope)


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

    Args:
        paths: one file, or several.
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
    tables._open().close()  # noqa: SLF001  what is wrong is told now
    return tables


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


def _read(source: TopicSource, topic: str, form: TableForm) -> TopicTable:
    """Read the messages of one topic."""
    blocks = [form.columns(source.empty(topic), 0)]
    blocks += [form.columns(block, source.zero_ns) for block in source.blocks([topic])]
    _warn(source)
    joined = [_joined([block[place] for block in blocks]) for place in range(len(blocks[0]))]
    return TopicTable(topic, source.topics[topic], joined)


def _warn(source: TopicSource) -> None:
    """Warn about an incomplete input; what could be read of it is kept."""
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
