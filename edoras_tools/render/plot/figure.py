"""The content of a plot: lines over time in panels that share their time axis, and events.

Counts over time are collected while an input is read, in bounded memory.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.words import plural

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.wire.arrays import Integers

AXIS: Final = "seconds since the start of the capture"
_MOST_TICKS: Final = 6
_COLOURS: Final = (
    ("#0072b2", "#56b4e9"), ("#c04a00", "#ff9e4a"), ("#007f5f", "#2fcf9f"), ("#a0437f", "#e79ac6"),
    ("#7a5c00", "#f0e442"), ("#3d4a9e", "#aab4ff"), ("#c2185b", "#ff6f91"), ("#00838f", "#4dd0e1"),
    ("#5d4037", "#c9a58f"), ("#6a1b9a", "#ce93ff"), ("#4a7d29", "#aed581"), ("#5b6067", "#a4abb3"),
)  # fmt: skip
LIGHT_COLOURS, DARK_COLOURS = zip(*_COLOURS, strict=True)
"""Colours of lines on a light and a dark background, the first ones by Okabe and Ito; the last is grey."""
GREY: Final = -1
"""Number of the colour of cFS's own packets, and of reference lines."""
DASHES: Final = ("", "7 4", "2 3", "10 3 2 3")
"""Dashes of lines by recording, so that colour is not the only difference; also used after all colours."""
_WIDE, _NARROW = frozenset("MWmw@%"), frozenset("iljtfrI.,:;'|!()[]/- ")


class PlotLine(msgspec.Struct, frozen=True):
    """Values over time.

    Attributes:
        label: label in the legend.
        recording: place of its recording in ``Figure.recordings``.
        seconds: f64 (n,), time since the start of its recording, s, not decreasing.
        values: f64 (n,), finite.
        read: number of values, or of messages for a rate, before thinning.
        not_finite: number of NaN and infinite values, which are not drawn.
        colour: number of its colour, or ``GREY``.
        sign: character of each point in a terminal, for points without a line; empty for a line.
    """

    label: str
    recording: int
    seconds: NDArray[np.float64]
    values: NDArray[np.float64]
    read: int
    not_finite: int = 0
    colour: int = 0
    sign: str = ""

    @property
    def look(self) -> tuple[int, str]:
        """Index of its colour in ``LIGHT_COLOURS``, and its dashes."""
        shades = len(LIGHT_COLOURS) - 1
        if self.colour < 0:
            return shades, DASHES[self.recording % len(DASHES)]
        return self.colour % shades, DASHES[(self.recording + self.colour // shades) % len(DASHES)]

    def thinned(self, columns: int, span: tuple[float, float]) -> PlotLine:
        """Return the line with at most two values in each column: the smallest and the largest."""
        rows = extremes(self.seconds, self.values, columns, span)
        return replace(self, seconds=self.seconds[rows], values=self.values[rows])


def extremes(
    seconds: NDArray[np.float64], values: NDArray[np.float64], columns: int, span: tuple[float, float]
) -> NDArray[np.intp]:
    """Return the indices of the smallest and the largest value in each of ``columns`` equal parts of time.

    Args:
        seconds: f64 (n,), not decreasing.
        values: f64 (n,).
        columns: number of parts.
        span: begin and end of all parts, s.
    """
    if len(seconds) <= 2 * columns:
        return np.arange(len(seconds))
    column = np.floor((seconds - span[0]) / ((span[1] - span[0]) or 1.0) * columns)
    order = np.lexsort((values, column))
    first = np.flatnonzero(np.diff(column[order], prepend=np.nan) != 0)
    return np.unique(np.concatenate([order[first], order[np.append(first[1:], len(order)) - 1]]))


class Panel(msgspec.Struct, frozen=True):
    """Lines that share an axis.

    Attributes:
        title: name of the values.
        lines: the lines.
        unit: unit of the values, if known.
        beneath: whether it is a smaller panel, such as rates; its axis begins at 0.
        from_zero: whether its axis begins at 0.
    """

    title: str
    lines: Sequence[PlotLine]
    unit: str = ""
    beneath: bool = False
    from_zero: bool = False

    @property
    def heading(self) -> str:
        """Title and unit."""
        return f"{self.title}, {self.unit}" if self.unit else self.title

    @property
    def has_names(self) -> bool:
        """Whether the panel needs a legend."""
        return len(self.lines) > 1 or any(line.label != self.title for line in self.lines)

    @property
    def legend(self) -> list[tuple[str, PlotLine]]:
        """Entries of the legend; many grey lines of one recording are one entry."""
        entries = []
        for line in self.lines:
            alike = [item for item in self.lines if line.colour < 0 and item.look == line.look]
            if len(alike) < 2 or alike[0] is line:
                text = f"cFS itself: {len(alike)} topics" if len(alike) > 1 else line.label
                entries.append((text, line))
        return entries

    @property
    def ends(self) -> tuple[float, float]:
        """Lower and upper end of its axis, with some margin."""
        low = min((float(line.values.min()) for line in self.lines if len(line.values)), default=0.0)
        high = max((float(line.values.max()) for line in self.lines if len(line.values)), default=0.0)
        low = min(low, 0.0) if self.beneath or self.from_zero else low
        room = (high - low) * 0.05 or abs(high) * 0.05 or 1.0
        return low if (self.beneath or self.from_zero) and not low else low - room, high + room


class EventMark(NamedTuple):
    """An event.

    Attributes:
        seconds: time since the start of its recording, s.
        recording: place of its recording in ``Figure.recordings``.
        severe: whether it is an error.
        text: sender and text of the event.
    """

    seconds: float
    recording: int
    severe: bool
    text: str


class Figure(msgspec.Struct, frozen=True):
    """A plot.

    Attributes:
        recordings: names of the recordings.
        panels: panels from top to bottom.
        span: begin and end of the time axis, s.
        marks: events that are drawn; None if events are not requested.
        events: number of all events; of several close to each other only the most severe is drawn.
        notes: further notes, one line each.
        across: name of the axis that all panels share.
    """

    recordings: Sequence[str]
    panels: Sequence[Panel]
    span: tuple[float, float]
    marks: Sequence[EventMark] | None = None
    events: int = 0
    notes: Sequence[str] = msgspec.field(default_factory=tuple)
    across: str = AXIS

    @property
    def title(self) -> str:
        """Names of the drawn values."""
        return ", ".join(panel.title for panel in self.panels if not panel.beneath) or "Rates"

    @property
    def subtitle(self) -> str:
        """Names of the recordings; if there are several, each starts at 0."""
        names = " and ".join(self.recordings)
        return f"{names}, each from its own start" if len(self.recordings) > 1 else names

    @property
    def event_title(self) -> str:
        """Heading of the events."""
        title = plural(self.events, "event")
        return title if len(self.marks or ()) == self.events else f"{title}, {len(self.marks or ()):,} drawn"

    def footnotes(self, columns: int) -> list[str]:
        """Return the notes, including one on values left out by thinning to ``columns``."""
        thinned = any(len(line.values) > 2 * columns for panel in self.panels for line in panel.lines)
        notes = [f"long lines: least and greatest value in each of {columns:,} columns of time"] * thinned
        return [*self.notes, *notes]


def text_width(text: str, size: float) -> float:
    """Return an upper bound of a text's width in the usual sans-serif fonts, in units of ``size``."""
    return size * sum(1.0 if sign in _WIDE else 0.42 if sign in _NARROW else 0.68 for sign in text)


def ticks(end: float, most: int = _MOST_TICKS) -> list[float]:
    """Return round numbers from 0 up to ``end``, at most ``most``."""
    return ticks_between(0, end, most) if end > 0 else [0.0]


def ticks_between(low: float, high: float, most: int = _MOST_TICKS) -> list[float]:
    """Return at most about ``most`` round numbers from ``low`` to ``high``, which is greater."""
    rough = (high - low) / (most - 1)
    unit = 10.0 ** math.floor(math.log10(rough))
    step = next(unit * factor for factor in (1, 2, 5, 10) if unit * factor >= rough * (1 - 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [step * index for index in range(first, last + 1)]


def tick_texts(low: float, high: float, most: int) -> list[tuple[float, str]]:
    """Return round numbers of an axis, and their texts."""
    ticks = ticks_between(low, high, most)
    step = ticks[1] - ticks[0] if len(ticks) > 1 else high - low
    largest = max(abs(low), abs(high))
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    if largest >= 1e7 or decimals > 5:
        digits = min(17, max(1, math.ceil(math.log10(largest / step))) + 1)
        return [(value, f"{value:.{digits}g}") for value in ticks]
    return [(value, f"{value if round(value, decimals) else 0.0:,.{decimals}f}") for value in ticks]


_FINEST: Final = 0.1
"""Seconds of one interval in which messages are counted."""
_BARS: Final = 100
"""Most values of a rate."""
_MOST_PARTS: Final = 1_000_000
"""Most intervals that spans of messages are spread over."""


class RateCounts(msgspec.Struct):
    """Number of messages over time.

    Attributes:
        spread: number of messages with a span instead of a time; they are counted evenly over it.
    """

    spread: int = 0
    _parts: list[Integers] = msgspec.field(default_factory=list)
    _numbers: list[NDArray[np.float64]] = msgspec.field(default_factory=list)

    def add(self, seconds: NDArray[np.float64], numbers: NDArray[Any] | None = None) -> None:
        """Add messages.

        Args:
            seconds: times of the messages, s.
            numbers: number of messages of each row; one by default.
        """
        parts, places = np.unique(np.floor(seconds / _FINEST).astype(np.int64), return_inverse=True)
        self._parts.append(parts)
        self._numbers.append(np.bincount(places, numbers, len(parts)).astype(np.float64))

    def add_spans(self, begin: NDArray[np.float64], end: NDArray[np.float64], numbers: Integers) -> None:
        """Add messages with a span of time instead of a time.

        Spans beyond a day use coarser intervals: a clock that was set during a run gives spans of decades.

        Args:
            begin: starts of the spans, s.
            end: ends of the spans, s; not before ``begin``.
            numbers: number of messages of each row.
        """
        first, last = (np.floor(item / _FINEST).astype(np.int64) for item in (begin, end))
        exact = first == last
        self.add(begin[exact], numbers[exact])
        if exact.all():
            return
        first, last, counts = first[~exact], last[~exact], numbers[~exact]
        self.spread += int(counts.sum())
        start = int(first.min())
        coarse = (int(last.max()) - start) // _MOST_PARTS + 1
        first, last = (first - start) // coarse, (last - start) // coarse
        steps = np.zeros(int(last.max()) + 2)
        share = counts / (last - first + 1)
        np.add.at(steps, first, share)
        np.add.at(steps, last + 1, -share)
        self._parts.append(start + np.arange(len(steps) - 1) * coarse)
        self._numbers.append(np.cumsum(steps)[:-1].clip(0))

    def join(self, other: RateCounts) -> None:
        """Add the messages of another count."""
        self.spread += other.spread
        self._parts += other._parts
        self._numbers += other._numbers

    @property
    def total(self) -> int:
        """Number of all messages."""
        return round(sum(float(part.sum()) for part in self._numbers))

    def line(self, recording: int, span: tuple[float, float], width: float, label: str = "") -> PlotLine:
        """Return the messages per second over time.

        Args:
            recording: index of the recording.
            span: first and last time of the chart, s.
            width: seconds of one mean, a multiple of 0.1; the last mean covers the rest, 0.5 to 1.5 times as
                long.
            label: label in the legend.
        """
        begin = math.floor(span[0] / _FINEST + 1e-9) * _FINEST
        count = max(1, round((span[1] - begin) / width))
        edges = np.append(begin + np.arange(count) * width, span[1])
        rates = np.zeros(count)
        if self._parts:
            moments = (np.concatenate(self._parts) + 0.5) * _FINEST
            parts = np.floor((moments - begin) / width).astype(np.int64)
            np.add.at(rates, parts.clip(0, count - 1), np.concatenate(self._numbers))
        rates /= np.diff(edges).clip(_FINEST)
        return PlotLine(label, recording, (edges[1:] + edges[:-1]) / 2, rates, self.total)


def bar_seconds(span: tuple[float, float], most: int = _BARS) -> float:
    """Return the seconds of one mean: a round number that divides a span into at most ``most`` parts."""
    least = max((span[1] - span[0]) / most, _FINEST)
    unit = 10.0 ** math.floor(math.log10(least) + 1e-9)
    return next(unit * factor for factor in (1, 2, 5, 10) if unit * factor >= least * (1 - 1e-9))
