"""Reads the data of a plot: fields over time, and beneath them rates, losses and events.

What is asked for: ``/cmd_vel.linear.*``, ``/imu.covariance[4]``, ``rate:/cmd_vel``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing
from itertools import product
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.decode.spacecraft import split_topic
from edoras_tools.errors import ConfigError, InterruptError, RouteError
from edoras_tools.io.formats.table import TimeForm
from edoras_tools.older import StrEnum
from edoras_tools.pipelines.export.reading import TableForm, chosen_topics, fits_field
from edoras_tools.pipelines.export.sources import LOST_TOPIC, TopicSource, open_topics
from edoras_tools.pipelines.selection import PATTERN_SIGNS, Period, fits_topic
from edoras_tools.render.plot.figure import (
    GREY,
    EventMark,
    Figure,
    Panel,
    PlotLine,
    RateCounts,
    bar_seconds,
    extremes,
)
from edoras_tools.ros.cdr.bulk import Ragged, TopicBlock
from edoras_tools.words import did_you_mean, listed, plural

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from edoras_tools.io.formats.columns import TableColumn
    from edoras_tools.pipelines.doctor import Scope
    from edoras_tools.pipelines.workbench import Settings
    from edoras_tools.render.terminal.text import Progress

_INDEX: Final = re.compile(r"\[(\d+)\]")
_NUMBERS: Final = "biuf"
_USE: Final = "write /topic.field, rate:/topic or loss:/topic"


class Quantity(StrEnum):
    """The quantity that is drawn of a topic."""

    FIELD = "field"
    RATE = "rate"
    """Messages per second."""
    LOSS = "loss"
    """Lost messages per second, as ``doctor --list-lost`` lists them."""


class PlotRequest(msgspec.Struct, frozen=True):
    """One request.

    Attributes:
        text: text as given.
        quantity: the quantity that is drawn.
        topic: a shell pattern of topics.
        field: a shell pattern of fields, which includes the fields inside them; empty for all.
        index: index of an element in a list; None for all elements.
    """

    text: str
    quantity: Quantity
    topic: str
    field: str = ""
    index: int | None = None

    def topics(self, source: TopicSource, narrowed: Sequence[str]) -> list[str]:
        """Return the topics of an input that this request means.

        Args:
            narrowed: patterns; if there are any, a topic must also match one of them.

        Raises:
            RouteError: there is none, or none is left.
        """
        for pattern in narrowed:
            chosen_topics(source, [pattern], ())
        fitting = chosen_topics(source, [self.topic], ())
        selection = [
            topic for topic in fitting if not narrowed or any(fits_topic(topic, item) for item in narrowed)
        ]
        if not selection:
            raise RouteError(f"{self.text}: --topic leaves out {listed(fitting, 3)}; leave out --topic")
        return selection

    def fields(self, source: TopicSource, topics: Sequence[str]) -> dict[str, list[str]]:
        """Return the fields with numbers that this request means, by topic.

        Raises:
            ConfigError: there is none, or the index does not fit.
        """
        columns_of = {topic: _columns(source, topic, self.field) for topic in topics}
        names = {name: column for columns in columns_of.values() for name, column in columns.items()}
        matches = {
            name: column for name, column in names.items() if not self.field or fits_field(name, self.field)
        }
        where = listed(sorted(topics), 3)
        if not matches:
            hint = did_you_mean(self.field, names, cutoff=0.5) or f"there are {listed([*names], 12)}"
            raise ConfigError(f"{self.text}: {self.field!r} is no field of {where}; {hint}")
        numbers = {name: column for name, column in matches.items() if _kind(column) in _NUMBERS}
        if not numbers:
            raise ConfigError(f"{self.text}: {listed([*matches], 3)} of {where} holds text, not numbers")
        for name, column in numbers.items():
            self._check_index(name, column)
        return {topic: [name for name in columns if name in numbers] for topic, columns in columns_of.items()}

    def _check_index(self, name: str, column: TableColumn) -> None:
        """Check that an index fits a column.

        Raises:
            ConfigError: the field is no list, or its lists have fewer elements.
        """
        values = column.values
        if self.index is None or isinstance(values, Ragged):
            return
        if values.ndim == 1:
            raise ConfigError(f"{self.text}: {name} is one number; leave out [{self.index}]")
        if self.index >= values.shape[1]:
            raise ConfigError(
                f"{self.text}: {name} has {values.shape[1]} elements; use [0] to [{values.shape[1] - 1}]"
            )


def parse_request(text: str) -> tuple[PlotRequest, ...]:
    """Read a request; parts with commas between them share a panel.

    Raises:
        ConfigError: the request cannot be read.
    """
    parts = tuple(_parse_one(part.strip()) for part in text.split(",") if part.strip())
    if not parts:
        raise ConfigError(f"{text!r} cannot be plotted; {_USE}")
    return parts


def _parse_one(text: str) -> PlotRequest:
    name, colon, rest = text.partition(":")
    if colon:
        if name not in (Quantity.RATE, Quantity.LOSS) or not rest:
            raise ConfigError(f"{text!r} cannot be plotted; {_USE}")
        return PlotRequest(text, Quantity(name), rest)
    topic, _, pattern = text.partition(".")
    indices = _INDEX.findall(pattern)
    if len(indices) > 1:
        raise ConfigError(f"{text}: more than one index; lists inside lists are joined, so give one")
    index = int(indices[0]) if indices else None
    return PlotRequest(text, Quantity.FIELD, topic, _INDEX.sub("", pattern), index)


def _columns(source: TopicSource, topic: str, pattern: str) -> dict[str, TableColumn]:
    """Return a topic's columns by name; columns that this package adds, only if the pattern names them."""
    block = source.empty(topic)
    columns = TableForm().columns(block, 0)[1:]
    return {item.name: item for item in columns if item.name in {*block.message.fields, pattern}}


def _kind(column: TableColumn) -> str:
    values = column.values.values if isinstance(column.values, Ragged) else column.values
    return str(np.asarray(values).dtype.kind)


LARGE: Final = 16 << 20
"""Size of a capture in bytes from which on an examination takes too long to wait for."""
MOST_LINES: Final = 24
_OF_CFS: Final = re.compile(r"(/sc_\d+)?/cfs/(?!robot_)")
"""Matches the topics that cFS itself sends and receives."""
MOST_MARKS: Final = 500
"""Most events of a recording that are drawn."""
_ERROR: Final = 40
"""Level of an error in a ``Log``."""
_LOG: Final = "rcl_interfaces/msg/Log"
_OWN: Final = "/edoras/"
_PER_SECOND: Final = "messages/s"


class _Recording(msgspec.Struct):
    """The collected data of one recording.

    Attributes:
        source: the recording.
        topics: topics of each request, with the requested fields of each.
        log_topics: topics of events.
        fields: values by topic, field and element.
        rates: messages of topics.
        losses: lost messages of topics.
        marks: time, level and text of each event.
        first: time of the earliest message, s.
        large: whether the recording is large: losses are then searched only on request.
    """

    source: TopicSource
    topics: dict[PlotRequest, dict[str, list[str]]]
    log_topics: list[str] = msgspec.field(default_factory=list)
    fields: dict[tuple[str, str, int | None], Values] = msgspec.field(default_factory=dict)
    rates: dict[str, RateCounts] = msgspec.field(default_factory=dict)
    losses: dict[str, RateCounts] = msgspec.field(default_factory=dict)
    marks: list[tuple[float, int, str]] = msgspec.field(default_factory=list)
    first: float = 0.0
    large: bool = False

    @classmethod
    def of(
        cls, source: TopicSource, requests: Sequence[PlotRequest], narrowed: Sequence[str], *, bare: bool
    ) -> _Recording:
        """Determine what has to be read.

        Raises:
            ConfigError: a field is not there, or holds no numbers.
            RouteError: a topic is not there.
        """
        recording = cls(source, {})
        for item in requests:
            topics = item.topics(source, narrowed)
            if item.quantity is Quantity.FIELD:
                recording.topics[item] = item.fields(source, topics)
                continue
            if not PATTERN_SIGNS.isdisjoint(item.topic):
                source.wants_new = not narrowed
                topics = [topic for topic in topics if not topic.startswith(_OWN)]
            counts = recording.rates if item.quantity is Quantity.RATE else recording.losses
            counts |= {topic: RateCounts() for topic in topics}
            recording.topics[item] = {topic: [] for topic in topics}
        if recording.losses and LOST_TOPIC not in source.topics:
            raise ConfigError(f"{source.name}: losses are only known of captures that can be read twice")
        if not bare:
            recording._add_background()
        return recording

    def _add_background(self) -> None:
        """Also read the rates, losses and events of the plotted topics."""
        source = self.source
        plotted = {topic for item in self.topics.values() for topic, names in item.items() if names}
        topics = sorted(topic for topic in plotted if not topic.startswith(_OWN))
        self.rates |= {topic: RateCounts() for topic in topics if topic not in self.rates}
        self.large = source.source is not None and source.source.statistics.total_bytes > LARGE
        if LOST_TOPIC in source.topics and not self.large:
            self.losses |= {topic: RateCounts() for topic in self.rates if topic not in self.losses}
        self.log_topics = [topic for topic, kind in source.topics.items() if kind == _LOG]

    @property
    def topics_to_read(self) -> set[str]:
        """The topics that must be read."""
        with_fields = {topic for item in self.topics.values() for topic, names in item.items() if names}
        return with_fields | {*self.rates, *self.log_topics} | ({LOST_TOPIC} if self.losses else set())

    def take(self, block: TopicBlock) -> None:
        """Add a block of messages."""
        if block.topic not in self.topics_to_read:
            self._take_new(block.topic)
        seconds = (block.time_ns - self.source.zero_ns) / 1e9
        self.first = min(self.first, float(seconds.min()))
        if block.topic in self.rates:
            self.rates[block.topic].add(seconds)
        if block.topic in self.log_topics:
            texts = (_array(block, name).tolist() for name in ("level", "name", "msg"))
            whose = block.topic.removesuffix(split_topic(block.topic)[1])
            self.marks += [
                (moment, level, f"{whose}/{name}: {text}".removeprefix("/" * (not whose)))
                for moment, level, name, text in zip(seconds.tolist(), *texts, strict=True)
            ]
        if block.topic == LOST_TOPIC:
            topics, counts = _array(block, "topic"), _array(block, "count")
            until = np.maximum((_array(block, "until_ns") - self.source.zero_ns) / 1e9, seconds)
            for topic, losses in self.losses.items():
                rows = np.flatnonzero(topics == topic)
                losses.add_spans(seconds[rows], until[rows], counts[rows])
        indexes: dict[str, set[int | None]] = {}
        for item, name_of in self.topics.items():
            for name in name_of.get(block.topic, ()):
                indexes.setdefault(name, set()).add(item.index)
        every = TableForm(time=TimeForm.NS).columns(block, 0) if indexes else ()
        columns = {item.name: item for item in every}
        for name, elements in indexes.items():
            for index in {None} if None in elements else elements:
                for element, rows, values in numbers(columns[name], index):
                    self._values(block.topic, name, element).add(seconds[rows], values)

    def _take_new(self, topic: str) -> None:
        """Add a topic that appeared during reading, e.g. one of a second spacecraft."""
        for item in self.topics:
            if split_topic(topic)[1].startswith(_OWN) or not fits_topic(topic, item.topic):
                continue
            self.topics[item][topic] = []
            self.rates[topic] = RateCounts()
            if self.losses:
                self.losses[topic] = RateCounts()
        if self.log_topics and self.source.topics[topic] == _LOG:
            self.log_topics.append(topic)

    def _values(self, topic: str, name: str, element: int | None) -> Values:
        key = topic, name, element
        if key not in self.fields:
            if len(self.fields) == MOST_LINES:
                raise ConfigError(
                    f"{topic}.{name} and others are more than {MOST_LINES} lines; "
                    "name fewer fields, or elements of lists: /topic.field[0]"
                )
            self.fields[key] = Values()
        return self.fields[key]

    def span(self, period: Period) -> tuple[float, float]:
        """Return the begin and end of the data that was read, s.

        Args:
            period: requested period, after the first datagram.
        """
        last = max(0.0, (self.source.last_ns - self.source.zero_ns) / 1e9)
        return period.start_ns / 1e9 or self.first, min(last, period.end_ns / 1e9) if period.end_ns else last


def _array(block: TopicBlock, name: str) -> NDArray[Any]:
    values = block.message.fields[name]
    assert isinstance(values, np.ndarray)
    return values


class PlotReport(msgspec.Struct):
    """A plot, and how its inputs were read.

    Attributes:
        figure: the plot.
        sources: the inputs.
    """

    figure: Figure
    sources: Sequence[TopicSource]

    def summary(self) -> dict[str, Any]:
        """Return the report in the form of ``plot --json``."""
        return {
            "sources": [source.name for source in self.sources],
            "panels": [
                {
                    "title": panel.title,
                    "unit": panel.unit or None,
                    "lines": [_line_json(self.figure, line) for line in panel.lines],
                }
                for panel in self.figure.panels
            ],
            "events": self.figure.events,
            "left_out": sum(source.left_out for source in self.sources),
            "warnings": [note for source in self.sources for note in source.notes],
        }


def _line_json(figure: Figure, line: PlotLine) -> dict[str, Any]:
    some = len(line.values) > 0
    return {
        "label": line.label,
        "recording": figure.recordings[line.recording],
        "read": line.read,
        "not_finite": line.not_finite,
        "least": float(line.values.min()) if some else None,
        "greatest": float(line.values.max()) if some else None,
        "first_s": float(line.seconds[0]) if some else None,
        "last_s": float(line.seconds[-1]) if some else None,
    }


def open_recordings(paths: Sequence[Path], settings: Settings, scope: Scope) -> list[TopicSource]:
    """Open each input of a plot as a separate source.

    Raises:
        CaptureError: one cannot be opened.
        ConfigError: the mission has mistakes.
    """
    part = replace(scope, selection=replace(scope.selection, topics=()))
    with ExitStack() as opened:
        sources = []
        for path in paths:
            sources.append(open_topics([path], settings, part))
            opened.callback(sources[-1].close)
        opened.pop_all()
        return sources


def read_plot(
    sources: Sequence[TopicSource],
    names: Sequence[str],
    panels_requested: Sequence[Sequence[PlotRequest]],
    scope: Scope,
    *,
    bare: bool = False,
    progress: Progress | None = None,
) -> PlotReport:
    """Read the data of a plot; the inputs are closed.

    Args:
        sources: the inputs; each is drawn from its own start on.
        names: names of the inputs, for legends.
        panels_requested: the requests of each panel; none for the rates of all topics.
        scope: the topics to which requests are narrowed, and the period; the inputs apply the rest
            themselves.
        bare: leave out the rates, losses and events beneath.

    Raises:
        CaptureError: there is nothing to draw.
        ConfigError: a field is not there, is no number, or there are too many.
        RouteError: a topic is not there.
    """
    panels = panels_requested or [[PlotRequest("rate:*", Quantity.RATE, "*")]]
    requests = [item for panel in panels for item in panel]
    with ExitStack() as stack:
        for source in sources:
            stack.enter_context(closing(source))
        read = [_Recording.of(source, requests, scope.selection.topics, bare=bare) for source in sources]
        for recording in read:
            for block in filter(len, recording.source.blocks(recording.topics_to_read, progress)):
                recording.take(block)
            if isinstance(recording.source.failure, InterruptError):
                break
    return PlotReport(_Assembly(read, names, scope).figure(panels), sources)


class _Assembly(msgspec.Struct):
    """Makes the figure of the data that was read."""

    read: Sequence[_Recording]
    names: Sequence[str]
    scope: Scope
    colours: dict[str, int] = msgspec.field(default_factory=dict)

    def figure(self, requested: Sequence[Sequence[PlotRequest]]) -> Figure:
        """Return the figure.

        Raises:
            CaptureError: there is nothing to draw.
            ConfigError: no list has a requested element.
        """
        panels = [self._panel(panel) for panel in requested]
        requests = [item for panel in requested for item in panel]
        for item, recording in product(requests, self.read):
            lines = [line for _, line in self._lines(item, 0, recording)]
            if item.index is not None and lines and not any(line.read + line.not_finite for line in lines):
                raise ConfigError(f"{item.text}: no list of {recording.source.name} has so many elements")
        lines_read = [line for panel in panels for line in panel.lines if line.read]
        if all(item.quantity is not Quantity.LOSS for item in requests):  # no loss is also a result
            for recording in self.read:
                topics = {topic for item in recording.topics.values() for topic in item}
                recording.source.check_found(lines_read, topics)
        beneath = self._rates(requests)
        marks = [mark for place in range(len(self.read)) for mark in self._marks(place)]
        return Figure(
            self.names,
            [*panels, *([beneath] if beneath.lines else ())],
            self._span(*self.read),
            marks if any(item.log_topics for item in self.read) else None,
            sum(len(item.marks) for item in self.read),
            self._notes(panels, beneath),
        )

    def _span(self, *read: _Recording) -> tuple[float, float]:
        """Return the period that is drawn of some recordings, s."""
        ends = [item.span(self.scope.period.since(item.source.zero_ns)) for item in read]
        begin, end = min(begin for begin, _ in ends), max(end for _, end in ends)
        return begin, max(end, begin + 1e-3)

    @property
    def _width(self) -> float:
        return bar_seconds(self._span(*self.read))

    def _panel(self, requests: Sequence[PlotRequest]) -> Panel:
        """Return a requested panel."""
        lines: list[tuple[str, PlotLine]] = []
        for item in requests:
            for place, recording in enumerate(self.read):
                named = self._lines(item, place, recording)
                lines += [(name, line) for name, line in named if line.read or len(requests) == 1]
        title = ", ".join(item.text for item in requests)
        if len(lines) > MOST_LINES:  # only rates and losses; there may be hundreds of topics
            lines = sorted(lines, key=lambda item: -item[1].read)[:MOST_LINES]
            title += f", the {MOST_LINES} largest"
        has_field = any(item.quantity is Quantity.FIELD for item in requests)
        return self._name_lines(title, lines, "" if has_field else _PER_SECOND)

    def _lines(self, item: PlotRequest, place: int, recording: _Recording) -> Iterator[tuple[str, PlotLine]]:
        for topic, names in recording.topics[item].items():
            if item.quantity is not Quantity.FIELD:
                counts = recording.rates if item.quantity is Quantity.RATE else recording.losses
                label = topic if item.quantity is Quantity.RATE else f"{topic} lost"
                if counts[topic].total or len(recording.topics[item]) == 1:
                    yield label, counts[topic].line(place, self._span(recording), self._width)
                continue
            for (owner, name, element), values in recording.fields.items():
                if owner == topic and name in names and item.index in {None, element}:
                    full = f"{topic}.{name}"
                    yield full if element is None else f"{full}[{element}]", values.line(place)

    def _rates(self, requests: Sequence[PlotRequest]) -> Panel:
        """Return the panel of rates and losses beneath the requested ones."""
        drawn = {
            (item.quantity, topic) for read in self.read for item in requests for topic in read.topics[item]
        }
        lines = []
        for place, recording in enumerate(self.read):
            span = self._span(recording)
            for topic, counts in recording.rates.items():
                if (Quantity.RATE, topic) not in drawn:
                    lines.append((topic, counts.line(place, span, self._width)))
            for topic, counts in recording.losses.items():
                if (Quantity.LOSS, topic) not in drawn and counts.total:
                    lines.append((f"{topic} lost", counts.line(place, span, self._width)))
        return self._name_lines("rates", lines, _PER_SECOND, beneath=True)

    def _name_lines(
        self, title: str, named_lines: Sequence[tuple[str, PlotLine]], unit: str, *, beneath: bool = False
    ) -> Panel:
        """Return a panel; its legend omits what all lines share. Each name has one colour in the figure."""
        full = list(dict.fromkeys(name for name, _ in named_lines))
        topics = {name.partition(".")[0] for name in full}
        same = f"{topics.pop()}." if len(topics) == 1 and all("." in name for name in full) else ""
        grey = {name for name in full if unit and _OF_CFS.match(name)}
        lines = []
        for name, line in named_lines:
            words = [name.removeprefix(same)] if len(full) > 1 or len(self.names) == 1 else []
            words += [self.names[line.recording]] if len(self.names) > 1 else []
            colour = GREY if name in grey else self.colours.setdefault(name, len(self.colours))
            lines.append(replace(line, label=" · ".join(words), colour=colour))
        if len(full) == 1:
            title = full[0]
            lines = [replace(line, label=line.label if len(self.names) > 1 else title) for line in lines]
        return Panel(title, lines, unit, beneath)

    def _marks(self, place: int) -> Iterator[EventMark]:
        """Yield the events of a recording; of many close events, only the most severe."""
        recording = self.read[place]
        marks = sorted(recording.marks)
        if len(marks) > MOST_MARKS:
            begin, end = self._span(recording)
            worst: dict[int, tuple[float, int, str]] = {}
            for item in marks:
                part = int((item[0] - begin) / (end - begin) * MOST_MARKS)
                if part not in worst or item[1] > worst[part][1]:
                    worst[part] = item
            marks = list(worst.values())
        for moment, level, text in marks:
            yield EventMark(moment, place, level >= _ERROR, text)

    def _notes(self, panels: Sequence[Panel], beneath: Panel) -> list[str]:
        notes = [
            f"{line.label}: {plural(line.not_finite, 'value')} NaN or infinite, not drawn"
            for panel in panels
            for line in panel.lines
            if line.not_finite
        ]
        if beneath.lines or any(panel.unit == _PER_SECOND for panel in panels):
            notes.append(f"rates: means over {self._width:g} s")
        spread: dict[str, int] = {}
        for topic, counts in (pair for item in self.read for pair in item.losses.items() if pair[1].spread):
            spread[topic] = spread.get(topic, 0) + counts.spread
        notes += [
            f"{topic}: when {number:,} were lost is known as a span only; drawn as its mean"
            for topic, number in sorted(spread.items())
        ]
        large = [self.names[place] for place, item in enumerate(self.read) if item.large and not item.losses]
        if large:
            where = f"{listed(large)}, a large file"
            notes.append(f"losses: not looked for in {where}; loss:/topic asks for them")
        if judged := [topic for item in self.read for topic, own in item.losses.items() if not own.total]:
            notes.append(f"no lost message is known of {listed(sorted(set(judged)), 4)}")
        return notes


_MOST: Final = 1 << 20
"""Most values of a line; a line with more is thinned."""
_COLUMNS: Final = 1 << 15
"""Parts of its time of which a thinned line keeps the least and the greatest value."""


class Values(msgspec.Struct):
    """The values of a field, in order of arrival."""

    _seconds: list[NDArray[np.float64]] = msgspec.field(default_factory=list)
    _values: list[NDArray[np.float64]] = msgspec.field(default_factory=list)
    _count: int = 0
    _read: int = 0
    _not_finite: int = 0

    def add(self, seconds: NDArray[np.float64], values: NDArray[Any]) -> None:
        """Add values and their times."""
        numbers = values.astype(np.float64)
        finite = np.isfinite(numbers)
        if not finite.all():
            self._not_finite += int(len(numbers) - finite.sum())
            seconds, numbers = seconds[finite], numbers[finite]
        self._seconds.append(seconds)
        self._values.append(numbers)
        self._read += len(numbers)
        self._count += len(numbers)
        if self._count > _MOST:
            self._join()
            seconds, numbers = self._seconds[0], self._values[0]
            rows = extremes(seconds, numbers, _COLUMNS, (seconds[0], seconds[-1]))
            self._seconds, self._values, self._count = [seconds[rows]], [numbers[rows]], len(rows)

    def _join(self) -> None:
        seconds, values = np.concatenate(self._seconds), np.concatenate(self._values)
        order = np.argsort(seconds, kind="stable")
        self._seconds, self._values = [seconds[order]], [values[order]]

    def line(self, recording: int) -> PlotLine:
        """Return all values as a line."""
        self._join()
        return PlotLine("", recording, self._seconds[0], self._values[0], self._read, self._not_finite)


def numbers(
    column: TableColumn, index: int | None
) -> Iterator[tuple[int | None, NDArray[np.intp], NDArray[Any]]]:
    """Yield the numbers of a column: the element in its list, the rows that have it, their values.

    Args:
        index: the only element of lists to yield; None for all.
    """
    values = column.values
    rows = np.arange(len(values)) if column.present is None else np.flatnonzero(column.present)
    if isinstance(values, Ragged):
        starts, lengths = values.offsets[:-1], np.diff(values.offsets)
        elements = range(int(lengths.max(initial=0))) if index is None else (index,)
        for place in elements:
            holders = rows[lengths[rows] > place]
            yield place, holders, values.values[starts[holders] + place]
    elif values.ndim == 2:
        for place in range(values.shape[1]) if index is None else (index,):
            yield place, rows, values[rows, place]
    else:
        yield None, rows, values[rows]
