"""The result of a sweep: its steps, a chart, and the limit; and of an experiment: a row for each setting."""

from __future__ import annotations

import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from edoras_tools.render import units
from edoras_tools.render.plot.figure import GREY, Figure, Panel, PlotLine
from edoras_tools.render.plot.terminal import plot_lines
from edoras_tools.render.severity import Level
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.table import Column, build, facts_grid, figure, plain
from edoras_tools.render.terminal.terminal import detect_terminal

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from rich.table import Table

_CHART_WIDTH: Final = 78


def outcome(summary: Mapping[str, Any], width: int) -> RenderableType:
    """Return the view of the result.

    Args:
        summary: in the shape of ``sweep --json``.
    """
    steps = sorted(summary["steps"], key=lambda step: (step["rate_hz"], step["size"]))
    parts: list[RenderableType] = []
    if steps:
        parts += [_steps(steps, width), Text()]
    if len(steps) > 1:
        parts += [*plot_lines(chart(summary), min(width, _CHART_WIDTH), colour=True), Text()]
    facts = facts_grid()
    name = (
        summary["route"] if summary["route"] == summary["msg_id"] else "{route} ({msg_id})".format(**summary)
    )
    facts.add_row("route", plain(f"{name}, {_way(summary)}"))
    facts.add_row("threshold", Text(threshold_line(summary), palette.STRONG))
    if summary["limiting_hop"]:
        facts.add_row("limiting hop", plain(summary["limiting_hop"], Level.ERROR.style))
        facts.add_row("reason", plain(summary["reason"]))
    for note in summary["notes"]:
        facts.add_row("note", plain(note))
    if summary["interrupted"]:
        facts.add_row("ended", "early, by Ctrl-C")
    return Group(*parts, facts)


def chart(summary: Mapping[str, Any], *subtitle: str) -> Figure:
    """Return the chart of delivered messages over the requested ones.

    Args:
        subtitle: line below the title.
    """
    by_size = summary["swept"] == "size"
    points: dict[bool, list[tuple[float, float]]] = {False: [], True: []}
    for step in summary["steps"]:
        share = step["delivered"] / step["sent"] if step["sent"] else 0.0
        x = step["size"] if by_size else step["rate_hz"]
        points[bool(step["lost"])].append((x, 100 * share if by_size else x * share))
    end = max((x for x, _ in points[False] + points[True]), default=1.0) or 1.0
    ideal, clean = (100.0 if by_size else end), summary["threshold_bytes" if by_size else "threshold_hz"]
    lines = [plot_line("what was asked for", [(0.0, 100.0 if by_size else 0.0), (end, ideal)], colour=GREY)]
    if clean is not None:
        lines.append(plot_line("threshold", [(clean, 0.0), (clean, ideal)], colour=2))
    lines.append(plot_line("all arrived", sorted(points[False]), colour=0, sign="●"))
    lines.append(plot_line("some were lost", sorted(points[True]), colour=1, sign="✗"))
    panel = Panel(
        f"{summary['route']}, {summary['msg_id']}",
        [item for item in lines if len(item.values)],
        "got through, %" if by_size else "got through, messages/s",
        from_zero=True,
    )
    across = "packet size, bytes" if by_size else "asked for, messages/s"
    return Figure(subtitle, [panel], (0.0, end), across=across)


def plot_line(label: str, points: Sequence[tuple[float, float]], **look: Any) -> PlotLine:
    """Return a line through points, given as x and y."""
    x, y = np.array(points, np.float64).reshape(-1, 2).T
    return PlotLine(label, 0 if "sign" in look else 1, x, y, len(points), **look)


def plan(summary: Mapping[str, Any]) -> RenderableType:
    """Return the view of ``--dry-run``."""
    facts = facts_grid()
    facts.add_row("route", plain(f"{summary['route']} ({summary['msg_id']}) over {summary['link'].upper()}"))
    rates, sizes = summary["rates_hz"], summary["sizes"]
    facts.add_row("rate", f"{rates[0]:,} to {rates[1]:,} Hz" if rates[0] != rates[1] else f"{rates[0]:,} Hz")
    facts.add_row(
        "size", f"{sizes[0]:,} to {sizes[1]:,} bytes" if sizes[0] != sizes[1] else f"{sizes[0]:,} bytes"
    )
    facts.add_row("step", units.duration(summary["step_s"]))
    facts.add_row("target", plain(summary["target"]))
    facts.add_row("listening", f"at {summary['listen']}")
    facts.add_row("would send", ", ".join(summary["sends"]))
    return facts


def threshold_line(summary: Mapping[str, Any]) -> str:
    """Return the limit in a line."""
    by_size = summary["swept"] == "size"
    unit = "bytes" if by_size else "Hz"
    good = summary["threshold_bytes" if by_size else "threshold_hz"]
    bad = summary["first_loss_bytes" if by_size else "first_loss_hz"]
    if good is not None:
        return f"between {good:,} and {bad:,} {unit}"
    if bad is not None:
        return f"below {bad:,} {unit}: the lowest that was tried lost something"
    values = [step["size" if by_size else "rate_hz"] for step in summary["steps"]]
    return f"none found: nothing was lost up to {max(values):,} {unit}" if values else "none found"


@contextmanager
def step_status(*, quiet: bool) -> Iterator[Callable[[str], None]]:
    """Yield a function that shows the present step on a terminal."""
    if quiet or not detect_terminal(sys.stderr).interactive:
        yield lambda _: None
        return

    def show(text: str) -> None:
        sys.stderr.write(f"\r\x1b[K{text} ...  Ctrl-C ends")
        sys.stderr.flush()

    try:
        yield show
    finally:
        sys.stderr.write("\r\x1b[K")
        sys.stderr.flush()


def _way(summary: Mapping[str, Any]) -> str:
    towards = "to cFS" if summary["to_cfs"] else "from cFS"
    where = f", emulated ({summary['emulated']})" if summary["emulated"] else ""
    return f"{towards} over {summary['link'].upper()}{where}"


def _steps(steps: list[Mapping[str, Any]], width: int) -> Table:
    def share(step: Mapping[str, Any]) -> Text:
        text = f"{100 * step['lost'] / step['sent']:.1f} %" if step["lost"] else ""
        return Text(text, Level.ERROR.style)

    columns = (
        Column("Rate", lambda step: Text(f"{step['rate_hz']:,} Hz")),
        Column("Size", lambda step: Text(f"{step['size']:,} B")),
        Column("Sent", lambda step: Text(units.count(step["sent"]))),
        Column("Delivered", lambda step: Text(units.count(step["delivered"]))),
        Column("Lost", figure("lost", Level.ERROR.style)),
        Column("Share", share, rank=1),
        Column("At", lambda step: plain(step["hop"] or ""), justify="left", elastic=True),
    )
    return build(columns, steps, width)


def cells_table(report: Mapping[str, Any], width: int) -> RenderableType:
    """Return a row for each cell and topic.

    Args:
        report: in the shape of ``experiment --json``.
    """
    rows = [{**cell, **topic} for cell in report["cells"] for topic in cell["topics"]]
    columns = (
        Column("Setting", lambda row: plain(row["cell"]), justify="left", elastic=True),
        Column("Runs", lambda row: plain(row["runs"])),
        Column("Topic", lambda row: plain(row["topic"]), justify="left"),
        Column("Lost", _interval_of("loss", lambda value: f"{value:.2%}")),
        Column("Hz", _interval_of("rate_hz", lambda value: f"{value:.3g}"), rank=2),
        Column("Delay", _interval_of("delay_ms", units.milliseconds), rank=1),
    )
    table = build(columns, rows, width, apart=lambda row: row["cell"])
    end = (
        f"Mean of the runs, and in which interval the mean of all possible ones is (95 %). {report['folder']}"
    )
    return Group(table, Text(), plain(end, palette.DIM))


def _interval_of(name: str, text: Callable[[float], str]) -> Callable[[Mapping[str, Any]], Text]:
    def cell(row: Mapping[str, Any]) -> Text:
        interval = row[name]
        if interval is None:
            return plain(units.NONE)
        mean, low, high = (text(interval[key]) for key in ("mean", "low", "high"))
        return plain(mean if low == high else f"{mean} ({low} to {high})")

    return cell
