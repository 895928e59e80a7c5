"""Bridges as a table: routes, messages in and out, held back and refused."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from rich.console import Console, Group, RenderableType
from rich.text import Text

from edoras_tools import words
from edoras_tools.render.severity import Level
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.live_table import LiveRun, LiveTable, Moment, title_line
from edoras_tools.render.terminal.table import Column, build, count_cell, figure, one_line, plain
from edoras_tools.render.terminal.text import size_of
from edoras_tools.words import plural

if TYPE_CHECKING:
    from pathlib import Path


_NOTES: Final = 4
_LOST: Final = {
    "missed": "by their publisher's history or the network, before they came",
    "overwritten": "at most, overwritten here before a subscriber had them",
}


def live_table(console: Console, output: Path | None = None) -> LiveTable[LiveRun]:
    """Return the table of bridges while they run."""

    def show(_: LiveRun, moment: Moment) -> Group:
        last = [plain(line, palette.DIM) for line in moment.summary["notes"][-_NOTES:]]
        return Group(*_view(moment), *last, Text("Ctrl-C ends", palette.DIM))

    return LiveTable(show, _counts, console, output)


def _counts(summary: Mapping[str, Any]) -> dict[object, int]:
    return {
        (item["name"], route["topic"]): route["out"]
        for item in summary["bridges"]
        for route in item["routes"]
    }


def outcome(summary: Mapping[str, Any], width: int, output: Path | None = None) -> Group:
    """Return the view of the result of bridges.

    Args:
        summary: in the shape of ``bridge --json``.
    """
    moment = Moment(summary, written=size_of(output) if output else None, width=width)
    return Group(*_view(moment), *(plain(line) for line in losses(summary)))


def plan(bridges: Sequence[Mapping[str, Any]], ros: str, output: Path | None, width: int) -> Group:
    """Return the view of the plan; ``bridges`` in the shape of ``bridge --dry-run --json``."""
    lines: list[RenderableType] = [
        Text.assemble("would bridge to ROS 2 through ", (ros, palette.STRONG), "; nothing was opened")
    ]
    for item in bridges:
        lines.append(plain(_title(item)))
        lines.append(build(_PLANNED, item["routes"], width))
    if output:
        lines.append(plain(f"record {output}"))
    return Group(*lines)


def losses(summary: Mapping[str, Any]) -> list[str]:
    """Return lines on lost, refused and unsent messages."""
    lines = []
    for item in summary["bridges"]:
        name = item["name"]
        for route in item["routes"]:
            for reason, count in route["refused"].items():
                lines.append(f"{name}: {route['topic']}: {plural(count, 'message')} refused: {reason}")
            for key, reason in _LOST.items():
                if route[key]:
                    lines.append(f"{name}: {route['topic']}: {plural(route[key], 'message')} lost: {reason}")
        for reason, count in item["refused"].items():
            lines.append(f"{name}: {plural(count, 'datagram')} refused: {reason}")
        if item["unreadable"]:
            lines.append(f"{name}: {plural(item['unreadable'], 'datagram')} too short for a packet")
        if item["graph_drops"]:
            count = plural(item["graph_drops"], "datagram")
            lines.append(
                f"{name}: {count} of ROS 2 dropped: the receive buffer was full; some may have come again"
            )
        ways = item["to_cfs"], item["from_cfs"]
        if ways[0]["failed"]:
            count = plural(ways[0]["failed"], "datagram")
            lines.append(f"{name}: {count} not sent: {ways[0]['reason']}")
        if ways[0]["overflowed"]:
            count = plural(ways[0]["overflowed"], "datagram")
            lines.append(f"{name}: {count} lost: the socket took no more")
        if ways[1]["kernel_drops"]:
            count = plural(ways[1]["kernel_drops"], "datagram")
            lines.append(f"{name}: {count} lost before the bridge read them: the receive buffer was full")
    if summary["inbox_overflowed"]:
        count = plural(summary["inbox_overflowed"], "message")
        lines.append(f"{count} lost: ROS 2 was faster than the bridge")
    if summary["unrecorded"]:
        lines.append(f"{plural(summary['unrecorded'], 'datagram')} bridged, but not recorded")
    return lines


def _title(item: Mapping[str, Any]) -> str:
    return f"{item['name']}  {item['kind']} {item['listen']} ↔ {item['target']}"


def _view(moment: Moment) -> list[RenderableType]:
    summary, rates = moment.summary, moment.rates
    title = f"{plural(len(summary['bridges']), 'bridge')}, ROS 2 through {summary['ros']}"
    parts: list[RenderableType] = [title_line(title, moment)]
    columns = [item for item in _ROUTES if rates is not None or item.title != "Rate"]
    for item in summary["bridges"]:
        line = plain(_title(item), palette.STRONG)
        line.append(*_state(item, live=rates is not None))
        rows = [
            dict(
                route,
                rate=None if rates is None else rates.get((item["name"], route["topic"])),
                latency_us=item[route["direction"]]["latency_us"],
            )
            for route in item["routes"]
        ]
        parts += [Text(), one_line(line), build(columns, rows, moment.width)]
    parts.append(Text())
    return parts


def _state(item: Mapping[str, Any], *, live: bool) -> tuple[str, str]:
    if item["kind"] == "ground":
        if item["connected"]:
            return "   telemetry arrives" if live else "", palette.DIM
        return "   no telemetry", Level.WARNING.style
    lost = sum(item["losses"].values())
    times = f", connection lost {plural(lost, 'time')}" if lost else ""
    if item["connected"]:
        return f"   peer {item['peer']} connected{times}", Level.WARNING.style if lost else palette.DIM
    return f"   peer {item['peer']} not connected{times}", Level.WARNING.style


def _latency(name: str) -> Any:
    def cell(row: Mapping[str, Any]) -> Text:
        return Text(words.microseconds(row["latency_us"][name] if row["out"] else None))

    return cell


def _limit(row: Mapping[str, Any]) -> Text:
    return Text(words.rate(row["max_rate"]), "" if row["max_rate"] else palette.DIM)


def _arrow(row: Mapping[str, Any]) -> Text:
    return Text("to cFS" if row["direction"] == "to_cfs" else "from cFS", palette.DIM)


_FIRST: Final = (
    Column("", _arrow, justify="left"),
    Column("MsgId", lambda row: plain(row["msg_id"]), rank=1),
    Column("Topic", lambda row: plain(row["topic"]), justify="left", elastic=True),
)
_ROUTES: Final = (
    *_FIRST,
    Column("In", figure("in")),
    Column("Out", figure("out")),
    Column("Rate", lambda row: Text(words.rate(row["rate"]))),
    Column("Limit", _limit, rank=2),
    Column("Held", figure("held")),
    Column("Refused", lambda row: count_cell(sum(row["refused"].values()), Level.ERROR.style)),
    Column("p50", _latency("p50"), rank=1),
    Column("p99", _latency("p99"), rank=1),
)
_PLANNED: Final = (
    *_FIRST,
    Column("Type", lambda row: plain(row["type"]), justify="left"),
    Column("Limit", _limit),
)
