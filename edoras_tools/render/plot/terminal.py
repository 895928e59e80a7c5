"""A plot in terminal cells: eight dots of Braille in each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Final

import numpy as np
from msgspec.structs import replace
from rich.text import Text

from edoras_tools.render.plot.figure import Figure, Panel, PlotLine, tick_texts
from edoras_tools.render.severity import Level
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.text import clean, clip, wrap

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Span = tuple[float, float]

_STYLES: Final = ("cyan", "yellow", "magenta", "green", "bright_blue", "red")
_ROWS, _ROWS_BENEATH = 10, 5
_WIDEST, _NARROWEST = 160, 40
_BLANK: Final = 0x2800
_DOTS: Final = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]], np.uint8)
"""Bit of each dot of a Braille character: four rows from the top, two columns."""


def plot_lines(figure: Figure, width: int, *, colour: bool, rows: int = 0, most: int = _WIDEST) -> list[Text]:
    """Draw a plot.

    Args:
        width: columns of the terminal; at least 40 are used, at most ``most``.
        colour: whether colours distinguish lines; if not, each line has its own panel.
        rows: lines of each panel; 0 for the usual ones.
    """
    width = max(_NARROWEST, min(width, most))
    colour = colour or any(line.sign for panel in figure.panels for line in panel.lines)
    panels = [part for panel in figure.panels for part in (_parts if colour else _split)(panel)]
    margin = max(len(text) for panel in panels for _, text in _levels(panel))
    room = width - margin - 2
    lines = [Text(clip(clean(figure.subtitle), width), palette.STRONG)] if figure.subtitle else []
    for panel in panels:
        lines += _heading(panel, width, colour=colour)
        height = rows or (_ROWS_BENEATH if panel.beneath else _ROWS)
        lines += _field(panel, figure.span, (height, room), margin)
    lines.append(Text(" " * margin + " └" + "─" * room, palette.DIM))
    begin, end = figure.span
    places = [
        (round((value - begin) / (end - begin) * (room - 1)), text)
        for value, text in tick_texts(begin, end, max(3, room // 12))
    ]
    lines.append(Text(" " * (margin + 2) + scale_line(places, room), palette.DIM))
    lines += _events(figure, room, margin)
    lines.append(Text(figure.across.rjust(width), palette.DIM))
    for note in figure.footnotes(2 * room):
        lines += [Text(part, palette.DIM) for part in wrap(clean(note), width)]
    return lines


def _split(panel: Panel) -> Iterator[Panel]:
    for line in panel.lines:
        title = line.label if line.label.startswith(panel.title) else f"{panel.title}: {line.label}"
        yield type(panel)(title if panel.has_names else panel.title, [line], panel.unit, panel.beneath)


def _heading(panel: Panel, width: int, *, colour: bool) -> list[Text]:
    lines = [Text(clip(clean(panel.heading), width), palette.STRONG)]
    if not colour or not panel.has_names:
        return lines
    legend = Text()
    for text, line in panel.legend:
        label = clip(clean(text), width - 4)
        if legend.cell_len and legend.cell_len + len(label) + 5 > width:
            lines.append(legend)
            legend = Text()
        legend.append("  " * bool(legend.cell_len)).append(f"{line.sign or '━'} {label}", _style(panel, line))
    return [*lines, legend]


def _style(panel: Panel, line: PlotLine) -> str:
    """Return the style of a line by its position in the panel: a terminal has no dashes for recordings."""
    if line.colour < 0:
        return palette.DIM
    coloured = [item for item in panel.lines if item.colour >= 0]
    return _STYLES[next(place for place, item in enumerate(coloured) if item is line) % len(_STYLES)]


def _parts(panel: Panel) -> Iterator[Panel]:
    """Yield a panel in parts in which each line has its own style; grey ones are in the first."""
    coloured = [line for line in panel.lines if line.colour >= 0]
    grey = [line for line in panel.lines if line.colour < 0]
    for first in range(0, max(1, len(coloured)), len(_STYLES)):
        yield replace(
            panel, lines=[*grey[: None if not first else 0], *coloured[first : first + len(_STYLES)]]
        )


def _levels(panel: Panel) -> list[tuple[float, str]]:
    return tick_texts(*panel.ends, 3 if panel.beneath else 5)


def _field(panel: Panel, span: Span, size: tuple[int, int], margin: int) -> Iterator[Text]:
    """Yield the rows of a panel; its size is in rows and cells."""
    rows, room = size
    low, high = panel.ends
    labels = {round((high - value) / (high - low) * (rows - 1)): text for value, text in _levels(panel)}
    lines = [(line.thinned(2 * room, span), _style(panel, line)) for line in panel.lines]
    for row, drawn in enumerate(draw_lines(lines, span, panel.ends, size)):
        mark = " ┤" if row in labels else " │"
        text = Text(labels.get(row, "").rjust(margin) + mark, palette.DIM).append_text(drawn)
        text.rstrip()
        yield text


def draw_lines(
    lines: Sequence[tuple[PlotLine, str]], span: Span, ends: Span, size: tuple[int, int]
) -> Iterator[Text]:
    """Yield the rows of a picture of lines, from the top.

    Args:
        lines: lines and points, each with its style; a later one covers an earlier one.
        span: x of the first and of the last dot across.
        ends: y of the lowest and of the highest dot.
        size: rows, and cells in each.
    """
    rows, room = size
    dots = np.zeros((rows, room), np.uint8)
    owners = np.zeros((rows, room), np.intp)
    signs: dict[tuple[int, int], str] = {}
    for place, (line, _) in enumerate(lines):
        y, x = _dots(line, span, ends, 4 * rows - 1, 2 * room - 1)
        np.bitwise_or.at(dots, (y // 4, x // 2), _DOTS[y % 4, x % 2])
        owners[y // 4, x // 2] = place
        signs |= dict.fromkeys(zip((y // 4).tolist(), (x // 2).tolist(), strict=True), line.sign)
    for row in range(rows):
        text = Text(no_wrap=True)
        for cell, (dot, place) in enumerate(zip(dots[row].tolist(), owners[row].tolist(), strict=True)):
            sign = signs.get((row, cell)) or (chr(_BLANK + dot) if dot else " ")
            text.append(sign, lines[place][1] if dot else "")
        text.rstrip()
        yield text


def _dots(
    line: PlotLine, span: Span, ends: Span, last_y: int, last_x: int
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the dots of a line, including the straight connections of its values; y counts from the top."""
    x = (line.seconds - span[0]) / (span[1] - span[0]) * last_x
    y = (ends[1] - line.values) / (ends[1] - ends[0]) * last_y
    if line.sign:
        return y.round().astype(np.intp).clip(0, last_y), x.round().astype(np.intp).clip(0, last_x)
    steps = np.ceil(np.maximum(np.abs(np.diff(x)), np.abs(np.diff(y)))).astype(np.intp) + 1
    start = np.repeat(np.arange(len(steps)), steps)
    share = (np.arange(len(start)) - np.repeat(np.cumsum(steps) - steps, steps)) / steps[start]
    drawn = [
        np.append(item[start] + np.diff(item)[start] * share, item[-1:]).round().astype(np.intp)
        for item in (y, x)
    ]
    return drawn[0].clip(0, last_y), drawn[1].clip(0, last_x)


def scale_line(labels: Sequence[tuple[int, str]], room: int) -> str:
    """Return the line below a horizontal axis.

    Args:
        labels: cell and text of each label; a label that would touch the previous one is left out.
        room: width in cells.
    """
    scale = ""
    for cell, text in labels:
        at = min(max(0, cell - len(text) // 2), room - len(text))
        if at > len(scale) or not scale:
            scale = scale.ljust(at) + text
    return scale


def _events(figure: Figure, room: int, margin: int) -> list[Text]:
    if figure.marks is None:
        return []
    lines = [Text(figure.event_title, palette.STRONG)]
    begin, end = figure.span
    for number, name in enumerate(figure.recordings):
        cells: list[tuple[str, str]] = [(" ", "")] * room
        for mark in sorted(figure.marks, key=lambda item: item.severe):
            if mark.recording == number:
                sign = ("✗", Level.ERROR.style) if mark.severe else ("│", "")
                cells[round((mark.seconds - begin) / (end - begin) * (room - 1))] = sign
        line = Text(" " * (margin + 2)).append_text(Text.assemble(*cells))
        line.rstrip()
        lines += [Text(clip(clean(name), room), palette.DIM)] if len(figure.recordings) > 1 else []
        lines.append(line)
    return lines if figure.marks else lines[:1]
