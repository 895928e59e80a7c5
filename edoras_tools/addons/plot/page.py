"""A plot as one HTML page with zoom and a shared cursor; it loads nothing from elsewhere."""

from __future__ import annotations

import json
from html import escape
from importlib.resources import files
from typing import Any, Final

from edoras_tools.render.plot.figure import AXIS, DARK_COLOURS, LIGHT_COLOURS, Figure, PlotLine
from edoras_tools.render.plot.svg import plot_svg
from edoras_tools.render.terminal.text import clean

_COLUMNS: Final = 4000
"""Columns of long lines: the detail that zooming can show."""
_HOW: Final = (
    "Drag: zoom in. Double click: all. Keys: + - to zoom, arrows to move, 0 for all. "
    "Click a name: hide its line, or show it."
)


def plot_page(figure: Figure) -> str:
    """Return a plot as an HTML page; without scripts it shows the plot as SVG."""
    folder = files("edoras_tools.render.plot")
    style, script = ((folder / name).read_text(encoding="utf-8") for name in ("page.css", "page.js"))
    data = json.dumps(_data(figure), separators=(",", ":")).replace("<", "\\u003c")
    colours = (
        "".join(f"--c{place}:{colour};" for place, colour in enumerate(item))
        for item in (LIGHT_COLOURS, DARK_COLOURS)
    )
    light, dark = (f":root{{{item}}}" for item in colours)
    notes = "".join(f"<p>{escape(clean(note))}</p>" for note in figure.footnotes(_COLUMNS))
    head = [
        '<meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{escape(clean(f'edoras plot: {figure.title}'))}</title>",
        f"<style>\n{light}\n@media (prefers-color-scheme: dark) {{ {dark} }}\n{style}</style>",
    ]
    body = [
        f"<h1>{escape(clean(figure.title))}</h1>",
        f'<p class="dim">{escape(clean(figure.subtitle))}</p>',
        f'<div id="plot"></div>\n<noscript>{plot_svg(figure)}</noscript>',
        f'<footer class="dim">{notes}<p>{_HOW}</p></footer>',
        f'<script type="application/json" id="data">{data}</script>',
        f"<script>\n{script}</script>",
    ]
    return "\n".join(
        ['<!DOCTYPE html>\n<html lang="en">\n<head>', *head, "</head>\n<body>", *body, "</body>\n</html>\n"]
    )


def _data(figure: Figure) -> dict[str, Any]:
    return {
        "axis": AXIS,
        "span": figure.span,
        "recordings": [clean(name) for name in figure.recordings],
        "panels": [
            {
                "heading": clean(panel.heading),
                "zero": panel.beneath,
                "lines": [_line(line, figure) for line in panel.lines],
            }
            for panel in figure.panels
        ],
        "events": None if figure.marks is None else clean(figure.event_title),
        "marks": [
            [round(mark.seconds, 6), mark.recording, mark.severe, clean(mark.text)]
            for mark in figure.marks or ()
        ],
    }


def _line(line: PlotLine, figure: Figure) -> dict[str, Any]:
    thinned = line.thinned(_COLUMNS, figure.span)
    colour, dashes = line.look
    return {
        "label": clean(line.label),
        "colour": f"var(--c{colour})",
        "dashes": dashes,
        "t": [round(value, 6) for value in thinned.seconds.tolist()],
        "v": [float(f"{value:.9g}") for value in thinned.values.tolist()],
    }
