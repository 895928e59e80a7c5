"""A proxy as a table: the ways through it, its clients, and what goes wrong on purpose."""

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
_MOST_CLIENTS: Final = 8


class Proxy(Protocol):
    """A proxy under way."""

    def summary(self) -> Mapping[str, Any]:
        """Return what there is so far, in the shape of ``proxy --json``."""
        ...


class ProxyTable:
    """Shows a proxy while it runs; a context manager.

    Args:
        console: a terminal.
        output: the recording that grows.
        keys: whether keys switch faults.
    """

    def __init__(self, console: Console, output: Path | None = None, *, keys: bool = False) -> None:
        self._output, self._keys = output, keys
        self._rates = Rates()
        self._began = self._drawn = time.monotonic()
        # Transient: the report takes its place.
        self._live = Live(console=console, auto_refresh=False, redirect_stdout=False, transient=True)

    def __enter__(self) -> Self:
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def update(self, proxy: Proxy) -> None:
        """Draw, if the last drawing is long enough ago; from one thread only."""
        now = time.monotonic()
        if now - self._drawn < _REFRESH_S:
            return
        self._drawn = now
        summary = proxy.summary()
        rates = self._rates.add(now, {way["name"]: way["received"] for way in summary["ways"]})
        written = size_of(self._output) if self._output else None
        head = _head(summary, now - self._began, written)
        hint = Text("1 to 9 switch faults, q ends" if self._keys else "Ctrl-C ends", palette.DIM)
        self._live.update(Group(head, *_body(summary, self._live.console.width, rates), hint), refresh=True)


def outcome(summary: Mapping[str, Any], width: int, output: Path | None = None) -> Group:
    """Return what came of a proxy, for people.

    Args:
        summary: in the shape of ``proxy --json``.
        width: of the terminal.
        output: the recording.
    """
    lines: list[RenderableType] = [_head(summary, None, size_of(output) if output else None)]
    return Group(*lines, *_body(summary, width, None), *(plain(line) for line in notes(summary)))


def plan(summary: Mapping[str, Any], output: Path | None) -> Group:
    """Return what a proxy would do."""
    lines = [Text.assemble("would relay ", (_title(summary), palette.STRONG), "; nothing was opened")]
    lines += [plain(f"  fault  {item['rule']}{'' if item['on'] else ' (off)'}") for item in summary["faults"]]
    if summary["faults"]:
        lines.append(plain(f"  seed   {summary['seed']}"))
    if output:
        lines.append(plain(f"  record {output}"))
    return Group(*lines)


def notes(summary: Mapping[str, Any]) -> list[str]:
    """Return what people should know, a line each: refusals, losses, what was left."""
    found = []
    for way in summary["ways"]:
        if way["refused"]:
            answers = units.plural(way["refused"], "time")
            found.append(
                f"{way['name']}: refused {answers}: nothing listens there; start it, or see --target"
            )
        if way["failed"]:
            found.append(
                f"{way['name']}: {units.plural(way['failed'], 'datagram')} not sent: {way['reason']}"
            )
        if way["unclaimed"]:
            found.append(f"{way['name']}: {units.plural(way['unclaimed'], 'datagram')} for no client")
        if way["kernel_drops"]:
            drops = units.plural(way["kernel_drops"], "datagram")
            found.append(
                f"{way['name']}: {drops} lost before the proxy read them: the receive buffer was full"
            )
        if way["overflowed"]:
            found.append(
                f"{way['name']}: {units.plural(way['overflowed'], 'datagram')} lost: the queue was full"
            )
    if summary["held"]:
        found.append(f"{units.plural(summary['held'], 'datagram')} still held back on purpose at the end")
    if summary["held_overflowed"]:
        found.append(f"{units.plural(summary['held_overflowed'], 'datagram')} lost: too much was held back")
    if summary["unrecorded"]:
        found.append(f"{units.plural(summary['unrecorded'], 'datagram')} relayed, but not recorded")
    if summary["clients_evicted"]:
        found.append(f"{units.plural(summary['clients_evicted'], 'client')} forgotten for want of room")
    return found


def _title(summary: Mapping[str, Any]) -> str:
    return f"{summary['link']} {summary['listen']} → {', '.join(summary['targets'])}"


def _head(summary: Mapping[str, Any], elapsed: float | None, written: int | None) -> Text:
    head = plain(_title(summary), palette.STRONG)
    if elapsed is not None:
        head.append(f"   {units.duration(elapsed)}", palette.DIM)
    if summary["recorded"] is not None:
        head.append(f"   {units.plural(summary['recorded'], 'datagram')} recorded", palette.DIM)
        head.append(f", {units.size(written or 0)}", palette.DIM)
    lost = summary["lost"]
    if lost:
        head.append(f"   {units.count(lost)} lost", Severity.ERROR.style)
    head.no_wrap, head.overflow = True, "ellipsis"
    return head


def _body(
    summary: Mapping[str, Any], width: int, rates: Mapping[object, float] | None
) -> list[RenderableType]:
    ways = [dict(way, rate=None if rates is None else rates.get(way["name"])) for way in summary["ways"]]
    columns = [item for item in _WAYS if rates is not None or item.title != "Rate"]
    parts: list[RenderableType] = [build(columns, ways, width)]
    if summary["clients"]:
        shown: Sequence[Mapping[str, Any]] = summary["clients"][:_MOST_CLIENTS]
        parts += [Text(), build(_CLIENTS, shown, width)]
        if len(summary["clients"]) > len(shown):
            parts.append(Text(f"and {len(summary['clients']) - len(shown):,} more clients", palette.DIM))
    if summary["faults"]:
        faults = [dict(item, key=index) for index, item in enumerate(summary["faults"], 1)]
        parts += [Text(), build(_FAULTS, faults, width)]
    parts.append(Text())
    return parts


def _count(name: str, *, bad: bool = False) -> Any:
    def cell(row: Mapping[str, Any]) -> Text:
        value = row[name]
        style = Severity.ERROR.style if bad and value else "" if value else palette.DIM
        return Text(units.count(value), style)

    return cell


def _latency(name: str) -> Any:
    return lambda row: Text(_microseconds(row["latency_us"][name]))


def _microseconds(value: float | None) -> str:
    if value is None:
        return units.NONE
    return f"{value:.0f} µs" if value < 999.5 else units.milliseconds(value / 1000)


def _lost(row: Mapping[str, Any]) -> Text:
    value = row["kernel_drops"] + row["overflowed"]
    return Text(units.count(value), Severity.ERROR.style if value else palette.DIM)


_WAYS: Final = (
    Column("Way", lambda row: plain(row["name"]), justify="left", elastic=True),
    Column("In", _count("received")),
    Column("Rate", lambda row: Text(units.rate(row["rate"]))),
    Column("Out", _count("sent")),
    Column("Queue", _count("queued"), rank=2),
    Column("Refused", _count("refused", bad=True), rank=1),
    Column("Lost", _lost),
    Column("p50", _latency("p50"), rank=1),
    Column("p99", _latency("p99"), rank=1),
    Column("Max", _latency("max"), rank=3),
)
_CLIENTS: Final = (
    Column("Client", lambda row: plain(row["address"]), justify="left", elastic=True),
    Column("From it", _count("received")),
    Column("To it", _count("answered")),
)
_FAULTS: Final = (
    Column("Key", lambda row: Text(str(row["key"]) if row["key"] < 10 else "")),
    Column("Fault", lambda row: plain(row["rule"]), justify="left", elastic=True),
    Column("", lambda row: Text("on", Severity.WARNING.style) if row["on"] else Text("off", palette.DIM)),
    Column("Struck", _count("struck")),
)
