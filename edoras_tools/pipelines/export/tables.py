"""Makes the columns of tables from blocks of messages: selected fields, times, lists as lists or as rows."""

from __future__ import annotations

from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from edoras_tools.errors import ConfigError, RouteError
from edoras_tools.io.formats.columns import TableColumn
from edoras_tools.io.formats.table import TimeForm
from edoras_tools.pipelines.selection import PATTERN_SIGNS, fits_topic
from edoras_tools.ros.cdr.columns import Ragged, TopicBlock
from edoras_tools.words import did_you_mean, listed

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from edoras_tools.pipelines.export.sources import TopicSource
    from edoras_tools.wire.arrays import Integers

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
        own = {"time": block.time_ns, "publish_time": block.publish_ns}
        for name, times in own.items():
            if times is not None:
                yield self._time(_free(name, fields), times, zero_ns)
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
        spread = (
            np.full(len(owner), "", object)
            if values.values.dtype.kind == "O"
            else np.zeros(len(owner), values.values.dtype)
        )
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
