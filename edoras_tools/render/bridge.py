"""Bridges as a table: their routes, what crosses, what is held back and what cannot go."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Final, Protocol, Self

from rich.console import Group
from rich.live import Live
from rich.text import Text

from edoras_tools.render import palette, units
from edoras_tools.render.live import Rates
from edoras_tools.render.severity import Severity
from edoras_tools.render.table import Column, build, plain
from edoras_tools.render.watch import size_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from rich.console import Console, RenderableType

_REFRESH_S: Final = 0.5
_NOTES: Final = 4


class Bridges(Protocol):
    """Bridges under way."""

    def summary(self) -> Mapping[str, Any]:
        """Return what there is so far, in the shape of ``bridge --json``."""
        ...


class BridgeTable:
    """Shows bridges while they run; a context manager.

    Args:
        console: a terminal.
        output: the recording that grows.
    """

    def __init__(self, console: Console, output: Path | None = None) -> None:
        self._output = output
        self._rates = Rates()
        self._began = self._drawn = time.monotonic()
        # Transient: the report takes its place.
        self._live = Live(console=console, auto_refresh=False, redirect_stdout=False, transient=True)

    def __enter__(self) -> Self:
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def update(self, bridges: Bridges, /) -> None:
        """Draw, if the last drawing is long enough ago; from one thread only."""
        now = time.monotonic()
        if now - self._drawn < _REFRESH_S:
            return
        self._drawn = now
        summary = bridges.summary()
        counts: dict[object, int] = {
            (item["name"], route["topic"]): route["out"]
            for item in summary["bridges"]
            for route in item["routes"]
        }
        written = size_of(self._output) if self._output else None
        head = _head(summary, now - self._began, written)
        last = [plain(line, palette.DIM) for line in summary["notes"][-_NOTES:]]
        body = _body(summary, self._live.console.width, self._rates.add(now, counts))
        self._live.update(Group(head, *body, *last, Text("Ctrl-C ends", palette.DIM)), refresh=True)


def outcome(summary: Mapping[str, Any], width: int, output: Path | None = None) -> Group:
    """Return what came of bridges, for people.

    Args:
        summary: in the shape of ``bridge --json``.
        width: of the terminal.
        output: the recording.
    """
    head = _head(summary, None, size_of(output) if output else None)
    return Group(head, *_body(summary, width, None), *(plain(line) for line in losses(summary)))


def plan(bridges: Sequence[Mapping[str, Any]], ros: str, output: Path | None, width: int) -> Group:
    """Return what bridges would do; ``bridges`` as ``bridge --dry-run --json`` has them."""
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
    """Return what was lost, refused or could not be sent, a line each."""
    found = []
    for item in summary["bridges"]:
        name = item["name"]
        for route in item["routes"]:
            for reason, count in route["refused"].items():
                what = units.plural(count, "message")
                found.append(f"{name}: {route['topic']}: {what} refused: {reason}")
        for reason, count in item["refused"].items():
            found.append(f"{name}: {units.plural(count, 'datagram')} refused: {reason}")
        if item["unreadable"]:
            found.append(f"{name}: {units.plural(item['unreadable'], 'datagram')} too short for a packet")
        ways = item["to_cfs"], item["from_cfs"]
        if ways[0]["failed"]:
            count = units.plural(ways[0]["failed"], "datagram")
            found.append(f"{name}: {count} not sent: {ways[0]['reason']}")
        if ways[0]["overflowed"]:
            count = units.plural(ways[0]["overflowed"], "datagram")
            found.append(f"{name}: {count} lost: the socket took no more")
        if ways[1]["kernel_drops"]:
            count = units.plural(ways[1]["kernel_drops"], "datagram")
            found.append(f"{name}: {count} lost before the bridge read them: the receive buffer was full")
    if summary["inbox_overflowed"]:
        count = units.plural(summary["inbox_overflowed"], "message")
        found.append(f"{count} lost: ROS 2 was faster than the bridge")
    if summary["unrecorded"]:
        found.append(f"{units.plural(summary['unrecorded'], 'datagram')} bridged, but not recorded")
    return found


def _title(item: Mapping[str, Any]) -> str:
    return f"{item['name']}  {item['kind']} {item['listen']} ↔ {item['target']}"


def _head(summary: Mapping[str, Any], elapsed: float | None, written: int | None) -> Text:
    count = len(summary["bridges"])
    head = plain(f"{units.plural(count, 'bridge')}, ROS 2 through {summary['ros']}", palette.STRONG)
    if elapsed is not None:
        head.append(f"   {units.duration(elapsed)}", palette.DIM)
    if summary["recorded"] is not None:
        head.append(f"   {units.plural(summary['recorded'], 'datagram')} recorded", palette.DIM)
        head.append(f", {units.size(written or 0)}", palette.DIM)
    if summary["lost"]:
        head.append(f"   {units.count(summary['lost'])} lost", Severity.ERROR.style)
    head.no_wrap, head.overflow = True, "ellipsis"
    return head


def _body(
    summary: Mapping[str, Any], width: int, rates: Mapping[object, float] | None
) -> list[RenderableType]:
    parts: list[RenderableType] = []
    columns = [item for item in _ROUTES if rates is not None or item.title != "Rate"]
    for item in summary["bridges"]:
        line = plain(_title(item), palette.STRONG)
        line.append(*_state(item, live=rates is not None))
        line.no_wrap, line.overflow = True, "ellipsis"
        rows = [
            dict(
                route,
                rate=None if rates is None else rates.get((item["name"], route["topic"])),
                latency_us=item[route["direction"]]["latency_us"],
            )
            for route in item["routes"]
        ]
        parts += [Text(), line, build(columns, rows, width)]
    parts.append(Text())
    return parts


def _state(item: Mapping[str, Any], *, live: bool) -> tuple[str, str]:
    if item["kind"] == "ground":
        if item["connected"]:
            return "   telemetry arrives" if live else "", palette.DIM
        return "   no telemetry", Severity.WARNING.style
    lost = sum(item["losses"].values())
    times = f", connection lost {units.plural(lost, 'time')}" if lost else ""
    if item["connected"]:
        return f"   peer {item['peer']} connected{times}", Severity.WARNING.style if lost else palette.DIM
    return f"   peer {item['peer']} not connected{times}", Severity.WARNING.style


def _count(name: str) -> Any:
    def cell(row: Mapping[str, Any]) -> Text:
        value = row[name]
        return Text(units.count(value), "" if value else palette.DIM)

    return cell


def _refused(row: Mapping[str, Any]) -> Text:
    value = sum(row["refused"].values())
    return Text(units.count(value), Severity.ERROR.style if value else palette.DIM)


def _latency(name: str) -> Any:
    def cell(row: Mapping[str, Any]) -> Text:
        value = row["latency_us"][name]
        if value is None or not row["out"]:
            return Text(units.NONE)
        return Text(f"{value:.0f} µs" if value < 999.5 else units.milliseconds(value / 1000))

    return cell


def _limit(row: Mapping[str, Any]) -> Text:
    return Text(units.rate(row["max_rate"]), "" if row["max_rate"] else palette.DIM)


def _arrow(row: Mapping[str, Any]) -> Text:
    return Text("to cFS" if row["direction"] == "to_cfs" else "from cFS", palette.DIM)


_FIRST: Final = (
    Column("", _arrow, justify="left"),
    Column("MsgId", lambda row: plain(row["msg_id"]), rank=1),
    Column("Topic", lambda row: plain(row["topic"]), justify="left", elastic=True),
)
_ROUTES: Final = (
    *_FIRST,
    Column("In", _count("in")),
    Column("Out", _count("out")),
    Column("Rate", lambda row: Text(units.rate(row["rate"]))),
    Column("Limit", _limit, rank=2),
    Column("Held", _count("held")),
    Column("Refused", _refused),
    Column("p50", _latency("p50"), rank=1),
    Column("p99", _latency("p99"), rank=1),
)
_PLANNED: Final = (
    *_FIRST,
    Column("Type", lambda row: plain(row["type"]), justify="left"),
    Column("Limit", _limit),
)
