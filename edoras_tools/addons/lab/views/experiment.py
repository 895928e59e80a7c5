"""The results of an experiment for each setting, as a table."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rich.console import Group, RenderableType
from rich.text import Text

from edoras_tools.render import units
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.table import Column, build, plain

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping


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
        Column("Lost", _cell("loss", lambda value: f"{value:.2%}")),
        Column("Hz", _cell("rate_hz", lambda value: f"{value:.3g}"), rank=2),
        Column("Delay", _cell("delay_ms", units.milliseconds), rank=1),
    )
    table = build(columns, rows, width, apart=lambda row: row["cell"])
    end = (
        f"Mean of the runs, and in which interval the mean of all possible ones is (95 %). {report['folder']}"
    )
    return Group(table, Text(), plain(end, palette.DIM))


def _cell(name: str, text: Callable[[float], str]) -> Callable[[Mapping[str, Any]], Text]:
    def cell(row: Mapping[str, Any]) -> Text:
        interval = row[name]
        if interval is None:
            return plain(units.NONE)
        mean, low, high = (text(interval[key]) for key in ("mean", "low", "high"))
        return plain(mean if low == high else f"{mean} ({low} to {high})")

    return cell
