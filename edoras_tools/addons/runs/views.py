"""The results of a check, and of a comparison, for people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from rich.console import Console, Group, RenderableType
from rich.text import Text

from edoras_tools import words
from edoras_tools.render.capture.info import SPACECRAFT, link_text, msg_id_text, route_text
from edoras_tools.render.doctor import latency_text
from edoras_tools.render.severity import Level
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.table import Column, build, figure, plain
from edoras_tools.words import plural

if TYPE_CHECKING:
    from edoras_tools.addons.runs.comparison import CaptureComparison


def _hanging(mark: Text, text: Text, width: int) -> Text:
    """Return a text behind a mark; wrapped lines are indented below it."""
    indent = mark.cell_len + 1
    lines = text.wrap(Console(width=width), max(1, width - indent))
    return Text("\n" + " " * indent).join(
        [Text.assemble(mark, " ", line) if not place else line for place, line in enumerate(lines)]
    )


def check_view(report: Mapping[str, Any], width: int) -> RenderableType:
    """Return the view of a check.

    Args:
        report: the report, in the form of ``check --json``.
    """
    head = plain(report["source"], palette.STRONG)
    head.append(f"  {words.duration(report['seconds'])}", palette.DIM)
    lines: list[RenderableType] = []
    for item in report["results"]:
        mark, style = ("✓", "green") if item["passed"] else (Level.ERROR.mark, Level.ERROR.style)
        expected = "" if item["expected"] is None else f" {item['expected']}"
        line = plain(f"{item['about']}  {item['expectation']}{expected}")
        line.append_text(plain(f"  {item['found']}", palette.DIM if item["passed"] else style))
        lines.append(_hanging(Text(mark, style), line, width))
    of = plural(len(report["results"]), "expectation")
    if report["failed"]:
        end = Text(f"{report['failed']:,} of {of} not met.", Level.ERROR.style)
    else:
        end = Text(f"{of} met.", "green")
    return Group(head, Text(), *lines, Text(), end)


_SHOWN: Final = {"rate_hz": "rate", "lost": "lost", "latency_ms": "99 % within"}
"""Figures that a table shows for both sides even if they are equal."""


def runs_view(report: Mapping[str, Any], width: int) -> RenderableType:
    """Return the view of a comparison: figures of both sides in a table, then all differences.

    Args:
        report: report in the form of ``compare --json``.
    """
    parts: list[RenderableType] = [
        _hanging(Text(f"{label:<4}", palette.STRONG), _side(report[label]), width)
        for label in ("good", "bad")
    ]
    many = min(report[label]["runs"] for label in ("good", "bad")) > 1
    if report["changes"]:
        routes = {item["route"] for item in report["changes"]}
        rows = [item for item in report["points"] if item["what"] in _SHOWN and item["route"] in routes]
        rows = [row for row in rows if row["good"] != row["bad"]]
        parts += [Text(), _figures(rows, width, many=many)] if rows else []
        parts.append(Text())
    for item in report["changes"]:
        level = Level.ERROR if item["worse"] else Level.NOTE
        parts.append(_hanging(Text(level.mark, level.style), plain(item["text"]), width))
    parts.append(Text())
    worse = sum(item["worse"] for item in report["changes"])
    one = "The second run is" if not many and report["bad"]["runs"] == 1 else "The later runs are"
    if worse:
        parts.append(Text(f"{one} worse in {plural(worse, 'point')}.", Level.ERROR.style))
    else:
        parts.append(Text(f"{one} no worse.", "green"))
    return Group(*parts)


def _figures(rows: Sequence[Mapping[str, Any]], width: int, *, many: bool) -> RenderableType:
    """Return a table of figures before and after, with their difference."""

    def text(row: Mapping[str, Any], value: float | None, *, sign: str = "") -> str:
        if value is None:
            return words.NONE
        if row["what"] == "lost":
            return f"{value:{sign},.0f}" if row["interval"] is None else f"{value:{sign}.2%}"
        written = words.rate(abs(value)) if row["what"] == "rate_hz" else words.milliseconds(abs(value))
        return f"{'-' if value < 0 else sign}{written}"

    def difference(row: Mapping[str, Any]) -> Text:
        if row["good"] is None or row["bad"] is None:
            return plain(words.NONE)
        change = text(row, row["bad"] - row["good"], sign="+")
        if row["interval"] is not None:
            low, high = (text(row, value, sign="+") for value in row["interval"])
            change += f" ({low} to {high})"
        return plain(change, Level.ERROR.style if row["worse"] else "")

    columns = (
        Column("Route", lambda row: plain(row["route"] or "other"), justify="left", elastic=True),
        Column("", lambda row: plain(_SHOWN[row["what"]]), justify="left"),
        Column("Before", lambda row: plain(text(row, row["good"]))),
        Column("After", lambda row: plain(text(row, row["bad"]))),
        Column("Difference (95 %)" if many else "Difference", difference),
    )
    order = sorted(rows, key=lambda row: (row["route"] or "~", list(_SHOWN).index(row["what"])))
    return build(columns, order, width)


def _side(side: Mapping[str, Any]) -> Text:
    line = plain(side["source"], palette.STRONG)
    line.append(
        f"  {plural(side['datagrams'], 'datagram')} over {words.duration(side['seconds'])}, "
        f"{words.count(side['lost'])} lost",
        palette.DIM,
    )
    return line


_DIFF: Final = (
    Column("Link", link_text, justify="left"),
    Column("MsgId", msg_id_text, justify="left"),
    Column("Topic", route_text, justify="left", elastic=True),
    Column("Way", lambda row: Text("←" if row["direction"] == "second to first" else "→")),
    Column("First", lambda row: Text(words.count(row["first"]))),
    Column("Second", lambda row: Text(words.count(row["second"]))),
    Column("Same", lambda row: Text(words.count(row["same"]))),
    Column("Lost", figure("lost", Level.ERROR.style)),
    Column("Extra", lambda row: Text(words.count(row["extra"])), rank=1),
    Column("Doubled", lambda row: Text(words.count(row["doubled"])), rank=1),
    Column("Altered", lambda row: Text(words.count(row["altered"])), rank=1),
    Column("Late", lambda row: Text(words.count(row["late"])), rank=1),
    Column("In neither", lambda row: Text(words.count(row["neither"])), rank=1),
    Column("p50", lambda row: latency_text(row["latency"], "p50_ms"), rank=2),
    Column("p99", lambda row: latency_text(row["latency"], "p99_ms"), rank=2),
    Column("max", lambda row: latency_text(row["latency"], "max_ms"), rank=3),
)


def comparison_table(comparison: CaptureComparison, width: int) -> RenderableType:
    """Return the table that compares one capture with another."""
    rows = comparison.as_json()["routes"]
    drift = f" at the start, and drift by {comparison.drift * 1e6:+.1f} ppm" if comparison.drift else ""
    offset = (
        f"clocks differ by {words.milliseconds(comparison.offset_ns / 1e6)}{drift}; latencies are beyond that"
    )
    columns = [*_DIFF, SPACECRAFT] if any("spacecraft" in row for row in rows) else _DIFF
    lost, neither, extra = (sum(row[name] for row in rows) for name in ("lost", "neither", "extra"))
    end = f"Lost between the two: {plural(lost, 'message')}." if lost else "Nothing lost between the two."
    style = Level.ERROR.style if lost else "green"
    if neither:
        end += f" {neither:,} are missing in both by sequence count: lost before either point."
    if extra:
        end += f" {extra:,} are on the receiver's side alone: not recorded by the other, or sent by others."
    return Group(
        Text(offset, palette.DIM),
        build(columns, rows, width, apart=lambda row: row["link"]),
        Text(end, style),
    )
