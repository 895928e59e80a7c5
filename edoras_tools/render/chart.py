"""A chart of delivered against requested rate or size: for the terminal, as SVG."""

from __future__ import annotations

import math
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any, Final

from rich.text import Text

from edoras_tools.render.severity import Level
from edoras_tools.render.terminal import palette

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

_MOST_TICKS: Final = 6
_CLEAN, _LOSSY, _IDEAL = "●", "✗", "·"
WIDTH: Final = 720
"""Of the SVG's view box."""
_HEIGHT: Final = 420
_LEFT, _RIGHT, _TOP, _BOTTOM = 70, 20, 56, 56
_COLOURS: Final = {"clean": "#1a7f37", "lossy": "#cf222e", "ideal": "#8c959f", "grid": "#d8dee4"}


@dataclass(frozen=True, slots=True)
class Chart:
    """Points of a sweep.

    Attributes:
        title: above all.
        across: name of the axis of what was asked for.
        up: name of the axis of what got through.
        points: (asked for, got through, whether something was lost), by what was asked for.
        ideal: two points of the line on which nothing is lost.
        threshold: the highest that was clean below all that lost something; None where there is none.
    """

    title: str
    across: str
    up: str
    points: Sequence[tuple[float, float, bool]]
    ideal: tuple[tuple[float, float], tuple[float, float]]
    threshold: float | None

    @classmethod
    def of(cls, summary: Mapping[str, Any]) -> Chart:
        """Make a chart of a sweep in the shape of ``sweep --json``."""
        by_size = summary["swept"] == "size"
        points = []
        for step in summary["steps"]:
            share = step["delivered"] / step["sent"] if step["sent"] else 0.0
            x = step["size"] if by_size else step["rate_hz"]
            points.append((x, 100 * share if by_size else x * share, bool(step["lost"])))
        points.sort()
        end = max((x for x, _, _ in points), default=1.0) or 1.0
        return cls(
            title=f"{summary['route']}, {summary['msg_id']}",
            across="packet size, bytes" if by_size else "asked for, messages/s",
            up="got through, %" if by_size else "got through, messages/s",
            points=points,
            ideal=((0, 100), (end, 100)) if by_size else ((0, 0), (end, end)),
            threshold=summary["threshold_bytes"] if by_size else summary["threshold_hz"],
        )

    @property
    def ends(self) -> tuple[float, float]:
        """Where the two axes end; both begin at 0."""
        return (
            max([self.ideal[1][0], *(x for x, _, _ in self.points)]),
            max([self.ideal[1][1], *(y for _, y, _ in self.points)]),
        )


_LINES: Final = 12
_WIDEST: Final = 200
"""Lines of the field in a terminal."""


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


def scale_line(labels: Sequence[tuple[int, str]], room: int) -> str:
    """Return the line below a horizontal axis.

    Args:
        labels: cell and text of each; one that would touch the one before it is left out.
        room: cells.
    """
    scale = ""
    for cell, text in labels:
        at = min(max(0, cell - len(text) // 2), room - len(text))
        if at > len(scale) or not scale:
            scale = scale.ljust(at) + text
    return scale


def terminal(chart: Chart, width: int) -> list[Text]:
    """Draw a chart in terminal cells.

    Args:
        width: of all, at least 40 cells.
    """
    height = _LINES
    end_x, end_y = chart.ends
    labels = {round(value / end_y * (height - 1)): _figure(value) for value in ticks(end_y)}
    margin = max(len(text) for text in labels.values())
    width = min(width, _WIDEST)
    room = width - margin - 2

    def place(x: float, y: float) -> tuple[int, int]:
        return round(x / end_x * (room - 1)), round(y / end_y * (height - 1))

    field: dict[tuple[int, int], tuple[str, str]] = {}
    (x0, y0), (x1, y1) = chart.ideal
    for column in range(room):
        share = column / (room - 1)
        field[place(x0 + (x1 - x0) * share, y0 + (y1 - y0) * share)] = (_IDEAL, palette.DIM)
    for x, y, lossy in chart.points:
        field[place(x, y)] = (_LOSSY, Level.ERROR.style) if lossy else (_CLEAN, "green")
    lines = [Text(chart.up, palette.DIM)]
    for row in range(height - 1, -1, -1):
        line = Text(labels.get(row, "").rjust(margin) + (" ┤" if row in labels else " │"), palette.DIM)
        for column in range(room):
            line.append(*field.get((column, row), (" ", "")))
        line.rstrip()
        lines.append(line)
    lines.append(Text(" " * margin + " └" + "─" * room, palette.DIM))
    scale = scale_line([(place(value, 0)[0], _figure(value)) for value in ticks(end_x)], room)
    lines.append(Text(" " * (margin + 2) + scale, palette.DIM))
    lines.append(Text(chart.across.rjust(width), palette.DIM))
    return lines


def svg(chart: Chart, subtitle: str = "") -> str:
    """Draw a chart as SVG; it loads nothing from elsewhere.

    Args:
        subtitle: one line below the title.
    """
    end_x, end_y = chart.ends

    def at(x: float, y: float) -> tuple[float, float]:
        across = _LEFT + x / end_x * (WIDTH - _LEFT - _RIGHT)
        return across, _HEIGHT - _BOTTOM - y / end_y * (_HEIGHT - _TOP - _BOTTOM)

    def line(a: tuple[float, float], b: tuple[float, float], colour: str, more: str = "") -> str:
        ends = f'x1="{a[0]:.1f}" y1="{a[1]:.1f}" x2="{b[0]:.1f}" y2="{b[1]:.1f}"'
        return f'<line {ends} stroke="{_COLOURS[colour]}"{more}/>'

    def text(x: float, y: float, words: str, more: str = "") -> str:
        return f'<text x="{x:.1f}" y="{y:.1f}"{more}>{escape(words)}</text>'

    middle, right, dashes = ' text-anchor="middle"', ' text-anchor="end"', ' stroke-dasharray="4 4"'
    font = 'font-family="sans-serif" font-size="13" fill="#24292f"'
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {_HEIGHT}" {font}>',
        f'<rect width="{WIDTH}" height="{_HEIGHT}" fill="#ffffff"/>',
        text(_LEFT, 22, chart.title, ' font-size="15" font-weight="bold"'),
        text(_LEFT, 42, subtitle),
    ]
    for value in ticks(end_x):
        parts.append(line(at(value, 0), at(value, end_y), "grid"))
        parts.append(text(at(value, 0)[0], _HEIGHT - _BOTTOM + 18, _figure(value), middle))
    for value in ticks(end_y):
        parts.append(line(at(0, value), at(end_x, value), "grid"))
        parts.append(text(_LEFT - 8, at(0, value)[1] + 4, _figure(value), right))
    parts.append(line(at(*chart.ideal[0]), at(*chart.ideal[1]), "ideal", dashes))
    if chart.threshold is not None:
        parts.append(line(at(chart.threshold, 0), at(chart.threshold, end_y), "clean", dashes))
    for x, y, lossy in chart.points:
        kind, (across, up) = ("lossy" if lossy else "clean"), at(x, y)
        parts.append(f'<circle cx="{across:.1f}" cy="{up:.1f}" r="4.5" fill="{_COLOURS[kind]}"/>')
    parts.append(text((_LEFT + WIDTH - _RIGHT) / 2, _HEIGHT - 14, chart.across, middle))
    turned = f'{middle} transform="rotate(-90 18 {_HEIGHT / 2:.0f})"'
    parts += [text(18, _HEIGHT / 2, chart.up, turned), "</svg>"]
    return "\n".join(parts) + "\n"


def _figure(value: float) -> str:
    return f"{value:,.0f}" if value >= 10 or value == int(value) else f"{value:.1f}"
