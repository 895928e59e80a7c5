"""A plot as SVG: light or dark like the reader's system, readable at 400 pixels; it loads nothing.

Also pictures of the views for documentation, and SVG as PNG.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from html import escape
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.errors import ConfigError
from edoras_tools.render.plot.figure import DARK_COLOURS, LIGHT_COLOURS, text_width, tick_texts
from edoras_tools.render.terminal.text import clean, clip, wrap

if TYPE_CHECKING:
    from edoras_tools.render.plot.figure import Figure, Panel, PlotLine

PLOT_WIDTH: Final = 640
"""Width of the view box."""
_LEFT, _RIGHT, _HEIGHT, _HEIGHT_BENEATH = 66, 14, 150, 84
_ROOM: Final = PLOT_WIDTH - _LEFT - _RIGHT
_COLUMNS: Final = 2 * _ROOM
"""Columns of long lines: a PNG has two pixels for each unit."""
_SPARSE: Final = 60
"""Number of values up to which each is also drawn as a point."""
_SIZE: Final = 14
"""Size of letters."""
_GROUND: Final = ("#ffffff", "#15171a")
_INK: Final = ("#1c1e21", "#e6e7e9")
_DIM: Final = ("#5b6067", "#a4abb3")
_RULE: Final = ("#dfe1e4", "#363b42")
_SEVERE: Final = ("#b3261e", "#ff8a80")


def _style(number: int) -> str:
    """Return the style sheet of the light look, 0, or the dark one, 1."""
    rules = [f".ground{{fill:{_GROUND[number]}}}", f"text{{fill:{_INK[number]}}}"]
    rules += [f".dim{{fill:{_DIM[number]}}}", f".rule{{stroke:{_RULE[number]}}}"]
    rules += [f".event{{stroke:{_DIM[number]}}}", f".severe{{stroke:{_SEVERE[number]}}}"]
    for place, colour in enumerate((LIGHT_COLOURS, DARK_COLOURS)[number]):
        rules.append(f".c{place}{{stroke:{colour};fill:none}}")
    return "".join(rules)


def plot_svg(figure: Figure) -> str:
    """Draw a plot as SVG."""
    drawing = _Drawing(figure)
    drawing.draw()
    height = f"{drawing.y:.0f}"
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {PLOT_WIDTH} {height}" width="{PLOT_WIDTH}" '
        f'height="{height}" font-family="sans-serif" font-size="{_SIZE}" role="img">'
        f"<title>{escape(clean(f'{figure.title}, {figure.subtitle}'))}</title>"
        f"<desc>{escape(clean(' '.join(figure.notes)))}</desc>"
        f"<style>{_style(0)}@media (prefers-color-scheme:dark){{{_style(1)}}}</style>"
        f'<rect class="ground" width="{PLOT_WIDTH}" height="{height}"/>'
    )
    return "\n".join([head, *drawing.parts, "</svg>", ""])


class _Drawing:
    """Draws from top to bottom.

    Attributes:
        y: top of the next part.
        parts: elements drawn so far.
    """

    def __init__(self, figure: Figure) -> None:
        self.y = 10.0
        self.parts: list[str] = []
        self._figure = figure
        self._begin, self._end = figure.span

    def draw(self) -> None:
        """Draw all."""
        figure = self._figure
        self._line(figure.title, 'font-size="16" font-weight="bold"', 22)
        self._line(figure.subtitle, 'class="dim"', 20)
        for panel in figure.panels:
            self._panel(panel)
        self._events()
        for value, text in tick_texts(*figure.span, 9):
            self._text(self._x(value), self.y + 16, text, 'class="dim" text-anchor="middle"')
        self.y += 18
        self._text(PLOT_WIDTH - _RIGHT, self.y + 18, figure.across, 'class="dim" text-anchor="end"')
        self.y += 26
        for note in figure.footnotes(_COLUMNS):
            for part in wrap(clean(note), 82):
                self._line(part, 'class="dim" font-size="13"', 17)
        self.y += 8

    def _x(self, seconds: float) -> float:
        return _LEFT + (seconds - self._begin) / (self._end - self._begin) * _ROOM

    def _text(self, x: float, y: float, words: str, more: str = "") -> None:
        self.parts.append(f'<text x="{x:.1f}" y="{y:.1f}" {more}>{escape(clean(words))}</text>')

    def _line(self, words: str, more: str, height: int) -> None:
        """Write a line of text; the part that does not fit is cut."""
        self.y += height
        self._text(10, self.y - 4, clip(clean(words), 66 if "bold" in more else 86), more)

    def _panel(self, panel: Panel) -> None:
        self.y += 8
        if panel.heading != self._figure.title:
            self._line(panel.heading, 'font-weight="bold"', 20)
        if panel.has_names:
            self._legend(panel)
        self.y += 6
        height = _HEIGHT_BENEATH if panel.beneath else _HEIGHT
        low, high = panel.ends
        top = self.y

        def y(value: float) -> float:
            return top + (high - value) / (high - low) * height

        for value, text in tick_texts(low, high, 4 if panel.beneath else 6):
            self._rule(_LEFT, y(value), PLOT_WIDTH - _RIGHT, y(value))
            self._text(_LEFT - 6, y(value) + 5, text, 'class="dim" text-anchor="end"')
        for value, _ in tick_texts(*self._figure.span, 9):
            self._rule(self._x(value), top, self._x(value), top + height)
        for line in panel.lines:
            thin = line.thinned(_COLUMNS, self._figure.span)
            points = [
                f"{self._x(moment):.1f} {y(value):.1f}"
                for moment, value in zip(thin.seconds.tolist(), thin.values.tolist(), strict=True)
            ]
            self.parts.append(
                f'<path {_look(line)} stroke-linejoin="round" d="M{"L".join(points)}"/>'
                * bool(points)
                * (not line.sign)
            )
            if line.sign or (len(points) <= _SPARSE and not panel.beneath):
                dots = "".join(f"M{point}h0" for point in points)
                self.parts.append(f'<path {_dots(line)} d="{dots}"/>')
        self.y = top + height

    def _rule(self, x1: float, y1: float, x2: float, y2: float, style: str = "rule") -> None:
        ends = f'x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"'
        self.parts.append(f'<line class="{style}" {ends}/>')

    def _legend(self, panel: Panel) -> None:
        x = 10.0
        self.y += 20
        for text, line in panel.legend:
            label = clip(clean(text), 64)
            width = text_width(label, _SIZE)
            if x > 10 and x + 36 + width > PLOT_WIDTH:
                x, self.y = 10.0, self.y + 20
            look, way = (_dots(line), "m13 0h0") if line.sign else (_look(line), "h26")
            self.parts.append(f'<path {look} d="M{x:.0f} {self.y - 9:.0f}{way}"/>')
            self._text(x + 32, self.y - 4, label)
            x += 32 + width + 14

    def _events(self) -> None:
        figure = self._figure
        if figure.marks is None:
            return
        self.y += 8
        self._line(figure.event_title, 'font-weight="bold"', 20)
        for place, name in enumerate(figure.recordings if figure.marks else ()):
            if len(figure.recordings) > 1:
                self._line(name, 'class="dim"', 18)
            self._rule(_LEFT, self.y + 20, PLOT_WIDTH - _RIGHT, self.y + 20)
            for mark in figure.marks:
                if mark.recording == place:
                    x, top = self._x(mark.seconds), self.y + (2 if mark.severe else 8)
                    style = "severe" if mark.severe else "event"
                    self.parts.append(
                        f'<path class="{style}" stroke-width="2" d="M{x:.1f} {top:.0f}V{self.y + 20:.0f}">'
                        f"<title>{mark.seconds:.3f} s {escape(clean(mark.text))}</title></path>"
                    )
            self.y += 20


def _look(line: PlotLine) -> str:
    colour, dashes = line.look
    dashed = f' stroke-dasharray="{dashes}"' if dashes else ""
    return f'class="c{colour}"{dashed} stroke-width="1.6"'


def _dots(line: PlotLine) -> str:
    return f'class="c{line.look[0]}" stroke-width="5" stroke-linecap="round"'


_DEJAVU: Final = {
    "serif_family": "DejaVu Serif",
    "sans_serif_family": "DejaVu Sans",
    "monospace_family": "DejaVu Sans Mono",
}
"""Fonts for systems without fontconfig, such as small containers, where resvg finds no ``sans-serif``."""


def need_png() -> Callable[..., Any]:
    """Return ``resvg_py.svg_to_bytes`` after a test drawing of one letter.

    Raises:
        ConfigError: it is not installed, or this system has no font.
    """
    try:
        resvg = import_module("resvg_py")
    except ImportError:
        raise ConfigError(
            "PNG needs resvg, which is not installed: pip install 'edoras-tools[plot]', or write SVG"
        ) from None
    box = '<svg xmlns="http://www.w3.org/2000/svg" width="20" height="20">{}</svg>'
    texts = ("", '<text y="15" font-family="sans-serif">W</text>')
    for names in ({}, _DEJAVU):
        draw = partial(resvg.svg_to_bytes, **names)
        blank, letter = (draw(svg_string=box.format(text)) for text in texts)
        if blank != letter:
            return draw
    raise ConfigError("PNG needs a font, and this system has none: install fonts-dejavu-core, or write SVG")


def png(svg: str, width: int) -> bytes:
    """Return an SVG picture as PNG.

    Args:
        svg: the picture; its size is that of its view box.
        width: pixels.

    Raises:
        ConfigError: see ``need_png``.
    """
    return bytes(need_png()(svg_string=svg, width=width))
