"""Pictures of robots in a terminal: tracks of rovers in Braille characters, joints of arms as bars."""

from __future__ import annotations

from math import pi
from typing import TYPE_CHECKING, Final

from rich.text import Text

from edoras_tools.render.terminal import palette

if TYPE_CHECKING:
    from collections.abc import Sequence

COLOURS: Final = ("cyan", "yellow")
"""Of the first robot and the second."""
_DOTS: Final = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))
"""Bits of a Braille cell (U+2800), by row and column."""
_ARROWS: Final = "→↗↑↖←↙↓↘"
_BAR: Final = 24
_EIGHTHS: Final = " ▏▎▍▌▋▊▉█"


def draw_tracks(
    robots: Sequence[tuple[Sequence[tuple[float, float]], Sequence[float]]], width: int, height: int
) -> list[Text]:
    """Draw where rovers were and are, as large as it fits.

    Args:
        robots: of each its track, m, and its place: x, y, heading; the place may be empty.
        width: cells.
        height: lines.
    """
    points = [point for track, _ in robots for point in track]
    if not points:
        return [Text("waiting for the first pose ...", palette.DIM)]
    low = [min(point[axis] for point in points) for axis in (0, 1)]
    high = [max(point[axis] for point in points) for axis in (0, 1)]
    # A metre is as long across as up: a dot is as wide as high.
    room = max(2 * width - 5, 1), max(4 * height - 5, 1)
    scale = max((high[0] - low[0]) / room[0], (high[1] - low[1]) / room[1], 0.02)
    middle = [(low[axis] + high[axis]) / 2 for axis in (0, 1)]

    def dot(x: float, y: float) -> tuple[int, int]:
        column, row = width + (x - middle[0]) / scale, 2 * height - (y - middle[1]) / scale
        return min(max(round(column), 0), 2 * width - 1), min(max(round(row), 0), 4 * height - 1)

    cells: dict[tuple[int, int], tuple[int, str]] = {}
    marks: dict[tuple[int, int], tuple[str, str]] = {}
    for (track, place), colour in zip(robots, COLOURS, strict=False):
        for (x0, y0), (x1, y1) in zip(track, [*track[1:], track[-1]], strict=True):
            (a, b), (c, d) = dot(x0, y0), dot(x1, y1)
            steps = max(abs(c - a), abs(d - b), 1)
            for step in range(steps + 1):
                column, row = a + (c - a) * step // steps, b + (d - b) * step // steps
                cell = column // 2, row // 4
                bits, _ = cells.get(cell, (0, colour))
                cells[cell] = bits | _DOTS[row % 4][column % 2], colour
        if len(place) == 3:
            column, row = dot(place[0], place[1])
            marks[column // 2, row // 4] = (_ARROWS[round(place[2] / (pi / 4)) % 8], f"bold {colour}")
    lines = []
    for row in range(height):
        line = Text(no_wrap=True)
        for column in range(width):
            if (column, row) in marks:
                line.append(*marks[column, row])
            elif (column, row) in cells:
                bits, colour = cells[column, row]
                line.append(chr(0x2800 + bits), colour)
            else:
                line.append(" ")
        line.rstrip()
        lines.append(line)
    return lines


def joints(robots: Sequence[tuple[str, Sequence[float]]]) -> list[Text]:
    """Draw the joints of arms side by side, a bar each; half a turn either way is a whole bar.

    Args:
        robots: of each its name and its joints, rad, which may be none yet.
    """
    most = max((len(place) for _, place in robots), default=0)
    if not most:
        return [Text("waiting for the first joint state ...", palette.DIM)]
    head = Text(no_wrap=True)
    lines = [Text(no_wrap=True) for _ in range(most)]
    for (name, place), colour in zip(robots, COLOURS, strict=False):
        head.append(f"{name:<{_BAR + 18}}", palette.DIM)
        for index, line in enumerate(lines):
            value = place[index] if index < len(place) else 0.0
            share = min(abs(value) / pi, 1.0) * _BAR
            whole = int(share)
            bar = "█" * whole + _EIGHTHS[round((share - whole) * 8)].strip()
            line.append(f"joint {index + 2} ", palette.DIM)
            line.append(f"{value:6.2f} ")
            line.append(f"{bar:<{_BAR}}", colour)
            line.append("   ")
    for line in lines:
        line.rstrip()
    head.rstrip()
    return [head, *lines] if len(robots) > 1 else lines
