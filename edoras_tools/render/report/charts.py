"""Charts as inline SVG: sized by their box, coloured by the page, readable without scripts."""

from __future__ import annotations

from html import escape
from math import ceil, floor, log10
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

WIDTH: Final = 720
HEIGHT: Final = 190
_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 12, 24, 26


def ticks(most: float, count: int = 4) -> list[float]:
    """Return round values from 0 to ``most``, about ``count`` of them."""
    if most <= 0:
        return [0.0]
    raw = most / count
    power = 10 ** floor(log10(raw))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= raw)
    return [index * step for index in range(ceil(most / step) + 1) if index * step <= most * 1.0001]


class Frame:
    """A plot's axes; ``x`` and ``y`` turn values into positions.

    Args:
        x_most: largest time, s.
        y_most: largest value.
        unit: of the values.
        title: what a screen reader says.
        height: of the whole, in the view box's units.
    """

    def __init__(self, x_most: float, y_most: float, unit: str, title: str, height: int = HEIGHT) -> None:
        self.x_most, self.y_most = x_most or 1.0, (y_most or 1.0) * 1.08
        self.unit, self.title, self.height = unit, title, height
        self.parts: list[str] = []

    def x(self, value: float) -> float:
        """Return the place of a time."""
        return round(_LEFT + value / self.x_most * (WIDTH - _LEFT - _RIGHT), 1)

    def y(self, value: float) -> float:
        """Return the place of a value."""
        room = self.height - _TOP - _BOTTOM
        return round(self.height - _BOTTOM - min(value, self.y_most) / self.y_most * room, 1)

    def line(self, points: Sequence[tuple[float, float]], style: str) -> None:
        """Draw a line through points."""
        path = " ".join(f"{self.x(x)},{self.y(y)}" for x, y in points)
        self.parts.append(f'<polyline class="{style}" points="{path}"/>')

    def level(self, value: float, style: str, text: str) -> None:
        """Draw a horizontal line with a name."""
        if value > self.y_most:
            return
        y = self.y(value)
        self.parts.append(f'<line class="{style}" x1="{_LEFT}" x2="{WIDTH - _RIGHT}" y1="{y}" y2="{y}"/>')
        self.parts.append(f'<text class="end" x="{WIDTH - _RIGHT - 4}" y="{y - 4}">{escape(text)}</text>')

    def bars(self, values: Sequence[float], base: Sequence[float], width: float, style: str) -> None:
        """Draw bars of ``width`` s on top of others."""
        path = []
        for index, (value, under) in enumerate(zip(values, base, strict=True)):
            if value:
                left, right = self.x(index * width), self.x(min((index + 1) * width, self.x_most))
                path.append(f"M{left} {self.y(under)}V{self.y(under + value)}H{right}V{self.y(under)}Z")
        if path:
            self.parts.append(f'<path class="{style}" d="{"".join(path)}"/>')

    def dots(self, points: Sequence[tuple[float, float]], style: str) -> None:
        """Draw points."""
        path = "".join(f"M{self.x(x)} {self.y(y)}h0" for x, y in points)
        self.parts.append(f'<path class="{style}" d="{path}"/>')

    def seconds(self) -> list[str]:
        """Return the marks of the time axis."""
        return [
            f'<text class="mid" x="{self.x(value)}" y="{self.height - 8}">{value:g} s</text>'
            for value in ticks(self.x_most, 6)
        ]

    def svg(self) -> str:
        """Return the chart."""
        axes = []
        for value in ticks(self.y_most / 1.08):
            y = self.y(value)
            axes.append(f'<line class="grid" x1="{_LEFT}" x2="{WIDTH - _RIGHT}" y1="{y}" y2="{y}"/>')
            axes.append(f'<text class="end" x="{_LEFT - 6}" y="{y + 4}">{value:g}</text>')
        axes += self.seconds()
        axes.append(f'<text x="4" y="{_TOP - 10}">{escape(self.unit)}</text>')
        return wrap("".join(axes + self.parts), self.height, self.title)


def wrap(inside: str, height: int, title: str) -> str:
    """Return an SVG element that fills its box."""
    return (
        f'<svg viewBox="0 0 {WIDTH} {height}" role="img" aria-label="{escape(title, quote=True)}">'
        f"{inside}</svg>"
    )


def rate(row: Mapping[str, Any], bin_s: float, seconds: float) -> str:
    """Return a route's rate: seen, missing on top of it, and the clean rate as a line."""
    total = [a + b for a, b in zip(row["seen"], row["missing"], strict=True)]
    peak = max(total, default=1.0)
    clean = row["limit"] or 0.0
    frame = Frame(
        seconds, max(peak, clean if clean < 4 * peak else 0.0), "per second", f"rate of {row['label']}"
    )
    frame.bars(row["seen"], [0.0] * len(total), bin_s, f"seen {row['link']}")
    frame.bars(row["missing"], row["seen"], bin_s, "missing")
    if clean:
        frame.level(clean, "limit", f"clean to {clean:g}/s")
    return frame.svg()


def delays(row: Mapping[str, Any], seconds: float) -> str:
    """Return the delays of a way through cFS, over time."""
    frame = Frame(seconds, max(row["delays"], default=1.0), "ms", f"latency of {row['label']}")
    frame.dots(list(zip(row["times"], row["delays"], strict=True)), "dot")
    return frame.svg()


def counters(row: Mapping[str, Any], seconds: float) -> str:
    """Return the growth of the loss counters of a cFS."""
    most = max([*row["limits"], *row["overflows"], 1])
    frame = Frame(seconds, most, "messages", f"loss counters of {row['label']}")
    for name, style in (("limits", "limits"), ("overflows", "overflows")):
        frame.line(list(zip(row["times"], row[name], strict=True)), style)
    return frame.svg()


def timeline(peers: Sequence[Mapping[str, Any]], events: Sequence[Mapping[str, Any]], seconds: float) -> str:
    """Return connections as bars and events as ticks, over time."""
    height = 30 * (len(peers) + bool(events)) + _BOTTOM + _TOP
    frame = Frame(seconds, 1.0, "", "connections and events", height)
    parts = []
    for at, row in enumerate(peers):
        top = _TOP + 30 * at
        parts.append(f'<text x="{_LEFT}" y="{top + 9}">{escape(row["label"])}</text>')
        for state in row["states"]:
            left, right = frame.x(state["from"]), frame.x(min(state["to"], seconds))
            label = escape(f"{state['state'].replace('_', ' ')} at {state['from']:.1f} s: {state['why']}")
            parts.append(
                f'<rect class="{state["state"]}" x="{left}" y="{top + 13}" height="11" '
                f'width="{max(right - left, 1.5):.1f}"><title>{label}</title></rect>'
            )
    if events:
        top = _TOP + 30 * len(peers)
        parts.append(f'<text x="{_LEFT}" y="{top + 9}">events</text>')
        for item in events:
            x, grade = frame.x(item["time"]), "error" if item["type"] >= 3 else "info"
            label = escape(f"{item['time']:.1f} s {item['text']}")
            parts.append(
                f'<line class="event {grade}" x1="{x}" x2="{x}" y1="{top + 13}" y2="{top + 24}">'
                f"<title>{label}</title></line>"
            )
    parts += frame.seconds()
    return wrap("".join(parts), height, frame.title)
