"""What self-contained pages are made of: frame, sections and footer; charts as inline SVG, in cards.

Charts are sized by their box and coloured by the page, and readable without scripts.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from html import escape
from importlib.resources import files
from math import ceil, floor
from typing import Final, NamedTuple

import msgspec

from edoras_tools import __version__, words
from edoras_tools.render.plot.figure import tick_texts, ticks

CHART_WIDTH: Final = 720
CHART_HEIGHT: Final = 202
LEFT, RIGHT, TOP, BOTTOM = 66, 12, 30, 32
_COUNTED: Final = ("messages", "runs")
"""Units without fractions. The margins hold the large letters that a phone gets."""


class TimeSpan(msgspec.Struct, frozen=True):
    """The span of a time axis.

    Attributes:
        begin: begin, s, on any clock.
        seconds: length, s.
    """

    begin: float
    seconds: float


class Frame:
    """A plot's axes; ``x`` and ``y`` turn values into positions.

    Args:
        drawn: length and begin of the time axis.
        title: text for screen readers.
        height: height of the whole chart, in units of the view box.
    """

    def __init__(
        self, drawn: TimeSpan, y_most: float, unit: str, title: str, height: int = CHART_HEIGHT
    ) -> None:
        self.begin, self.x_most, self.y_most = drawn.begin, drawn.seconds or 1.0, (y_most or 1.0) * 1.08
        self.unit, self.title, self.height = unit, title, height
        self.parts: list[str] = []

    def x(self, value: float) -> float:
        """Return the position of a time."""
        return round(LEFT + value / self.x_most * (CHART_WIDTH - LEFT - RIGHT), 1)

    def y(self, value: float) -> float:
        """Return the position of a value."""
        room = self.height - TOP - BOTTOM
        return round(self.height - BOTTOM - min(value, self.y_most) / self.y_most * room, 1)

    def line(self, points: Sequence[tuple[float, float]], style: str) -> None:
        """Draw a line through points."""
        path = " ".join(f"{self.x(x)},{self.y(y)}" for x, y in points)
        self.parts.append(f'<polyline class="{style}" points="{path}"/>')

    def level(self, value: float, style: str, text: str) -> None:
        """Draw a horizontal line; its name stands above the plot, outside the data."""
        if value > self.y_most:
            return
        for x, y in ((LEFT, self.y(value)), (CHART_WIDTH - 40, TOP - 14)):
            ends = f'x1="{x}" x2="{CHART_WIDTH - RIGHT}" y1="{y}" y2="{y}"'
            self.parts.append(f'<line class="{style}" {ends}/>')
        self.parts.append(f'<text class="end" x="{CHART_WIDTH - 46}" y="{TOP - 10}">{escape(text)}</text>')

    def bars(self, values: Sequence[float], base: Sequence[float], width: float, style: str) -> None:
        """Draw bars of ``width`` s on top of other bars."""
        path = []
        for index, (value, under) in enumerate(zip(values, base, strict=True)):
            if value:
                begin, right = self.x(index * width), self.x(min((index + 1) * width, self.x_most))
                path.append(f"M{begin} {self.y(under)}V{self.y(under + value)}H{right}V{self.y(under)}Z")
        if path:
            self.parts.append(f'<path class="{style}" d="{"".join(path)}"/>')

    def dots(self, points: Sequence[tuple[float, float]], style: str) -> None:
        """Draw points."""
        path = "".join(f"M{self.x(x)} {self.y(y)}h0" for x, y in points)
        self.parts.append(f'<path class="{style}" d="{path}"/>')

    def seconds(self) -> list[str]:
        """Return the marks of the time axis."""
        marks = ticks(self.x_most, max(3, min(7, 42 // len(f"{self.begin + self.x_most:.0f} s"))))
        step = marks[1] if len(marks) > 1 else self.x_most or 1.0  # of few, the first may be beyond the end
        first, last = ceil(self.begin / step), floor((self.begin + self.x_most) / step)
        return [
            f'<text class="{"mid" if index * step > self.begin else "first"}" '
            f'x="{self.x(index * step - self.begin)}" y="{self.height - 8}">{index * step:g} s</text>'
            for index in range(first, last + 1)
        ]

    def svg(self) -> str:
        """Return the chart."""
        axes = []
        for value, text in tick_texts(0, self.y_most / 1.08, 6):
            if self.unit in _COUNTED and value != int(value):
                continue
            y = self.y(value)
            axes.append(f'<line class="grid" x1="{LEFT}" x2="{CHART_WIDTH - RIGHT}" y1="{y}" y2="{y}"/>')
            axes.append(f'<text class="end" x="{LEFT - 6}" y="{y + 4}">{text}</text>')
        axes += self.seconds()
        axes.append(f'<text x="4" y="{TOP - 10}">{escape(self.unit)}</text>')
        return svg_box("".join(axes + self.parts), self.height, self.title)


def svg_box(inside: str, height: int, title: str) -> str:
    """Return an SVG element that fills its box."""
    return (
        f'<svg viewBox="0 0 {CHART_WIDTH} {height}" role="img" aria-label="{escape(title, quote=True)}">'
        f"{inside}</svg>"
    )


_HEADING: Final = re.compile(r'<section id="([\w-]+)"><h2>(.*?)</h2>')


class Origin(NamedTuple):
    """How and when a page was made: its footer.

    Attributes:
        command: the command line that makes it again.
        time_ns: time of making, ns since 1970-01-01 UTC.
    """

    command: str
    time_ns: int


def document(title: str, parts: Iterable[str]) -> str:
    """Return a whole page; it loads nothing from other places."""
    style = (files("edoras_tools.render") / "pages.css").read_text(encoding="utf-8")
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n"
        + "\n".join(part for part in parts if part)
        + "\n</body>\n</html>\n"
    )


def contents(sections: Sequence[str]) -> str:
    """Return links to the sections of the page."""
    headings = [match for section in sections for match in _HEADING.findall(section)]
    links = "".join(f'<a href="#{anchor}">{title}</a>' for anchor, title in headings)
    return f'<nav class="dim">{links}</nav>' if len(headings) > 1 else ""


def heading(name: str) -> str:
    """Return the page's heading; a path may break between its parts, and only where necessary."""
    return f"<h1>{escape(name).replace('/', '/<wbr>')}</h1>"


def footer(origin: Origin) -> str:
    """Return the footer: how and when the page was made."""
    text = f"edoras-tools {__version__}, {words.utc(origin.time_ns, digits=0)} UTC"
    return f'<footer class="dim">{text}<br><code>{escape(origin.command)}</code></footer>'


def chart_card(title: str, svg: str, note: str = "") -> str:
    """Return a chart below its title, and a note on it."""
    note_html = f'<p class="dim">{escape(note)}</p>' if note else ""
    return f'<figure class="chart"><figcaption><h3>{escape(title)}</h3>{note_html}</figcaption>{svg}</figure>'


def section(title: str, inside: Iterable[str], lead: str = "") -> str:
    """Return a section; empty if it has no contents."""
    drawn = "".join(inside)
    anchor = title.lower().replace(" ", "-")
    return f'<section id="{anchor}"><h2>{title}</h2>{lead}{drawn}</section>' if drawn else ""


def html_table(heads: Iterable[str], rows: Iterable[Iterable[str]], style: str = "") -> str:
    """Return a table; empty without rows.

    Args:
        rows: cells as HTML: the caller escapes what is text.
        style: class of the table.
    """
    head = "".join(f"<th>{name}</th>" for name in heads)
    body = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows)
    kind = f' class="{style}"' if style else ""
    return f'<div class="scroll"><table{kind}><tr>{head}</tr>{body}</table></div>' if body else ""


def colour_key(entries: Sequence[tuple[str, str]], style: str = "") -> str:
    """Return the legend of colours: each with its text."""
    spans = "".join(f'<span style="background:var(--{colour})"></span>{text}' for colour, text in entries)
    return f'<p class="key dim {style}">{spans}</p>'
