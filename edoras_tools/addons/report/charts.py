"""The charts of a report: rates, delays, counters, connections and events over time."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.render.pages.charts import BOTTOM, LEFT, TOP, Frame, svg_box

if TYPE_CHECKING:
    from collections.abc import Mapping

    from edoras_tools.addons.report.plots import Plots

_ROW: Final = 36


def rate_chart(row: Mapping[str, Any], drawn: Plots) -> str:
    """Return a route's rate: messages that arrived, lost ones on top, and the clean rate as a line."""
    total = [a + b for a, b in zip(row["seen"], row["missing"], strict=True)]
    peak = max(total, default=1.0)
    clean = row["limit"] or 0.0
    most = max(peak, clean if clean < 4 * peak else 0.0)
    frame = Frame(drawn, most, "per second", f"rate of {row['label']}")
    frame.bars(row["seen"], [0.0] * len(total), drawn.bin_s, f"seen {row['link']}")
    frame.bars(row["missing"], row["seen"], drawn.bin_s, "missing")
    if clean:
        frame.level(clean, "limit", f"clean to {clean:g}/s, {row['limit_from']}")
    return frame.svg()


def delays(row: Mapping[str, Any], drawn: Plots) -> str:
    """Return the delays of a path through cFS, over time."""
    frame = Frame(drawn, max(row["delays"], default=1.0), "ms", f"latency of {row['label']}")
    frame.dots(list(zip(row["times"], row["delays"], strict=True)), "dot")
    return frame.svg()


def counters(row: Mapping[str, Any], drawn: Plots) -> str:
    """Return the growth of the loss counters of a cFS."""
    most = max([*row["limits"], *row["overflows"], 1])
    frame = Frame(drawn, most, "messages", f"loss counters of {row['label']}")
    for name, style in (("limits", "limits"), ("overflows", "overflows")):
        frame.line(list(zip(row["times"], row[name], strict=True)), style)
    return frame.svg()


def timeline(drawn: Plots) -> str:
    """Return connections as bars and events as ticks, over time."""
    peers, events = drawn.peers, drawn.events
    height = _ROW * (len(peers) + bool(events)) + BOTTOM + TOP
    frame = Frame(drawn, 1.0, "", "connections and events", height)
    parts = []
    for at, row in enumerate(peers):
        top = TOP + _ROW * at
        parts.append(f'<text x="{LEFT}" y="{top + 12}">{escape(row["label"])}</text>')
        for state in row["states"]:
            begin, right = frame.x(state["from"]), frame.x(min(state["to"], drawn.seconds))
            when = f"{drawn.begin + state['from']:.1f} s: {state['why']}"
            label = escape(f"{state['state'].replace('_', ' ')} at {when}")
            parts.append(
                f'<rect class="{state["state"]}" x="{begin}" y="{top + 17}" height="11" '
                f'width="{max(right - begin, 1.5):.1f}"><title>{label}</title></rect>'
            )
    if events:
        top = TOP + _ROW * len(peers)
        parts.append(f'<text x="{LEFT}" y="{top + 12}">events</text>')
        for item in events:
            x, grade = frame.x(item["time"]), "error" if item["type"] >= 3 else "info"
            label = escape(f"{drawn.begin + item['time']:.1f} s {item['text']}")
            parts.append(
                f'<line class="event {grade}" x1="{x}" x2="{x}" y1="{top + 17}" y2="{top + 28}">'
                f"<title>{label}</title></line>"
            )
    parts += frame.seconds()
    return svg_box("".join(parts), height, frame.title)
