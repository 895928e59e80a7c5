"""A proxy as a table: both directions, clients, and injected faults."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from rich.console import Console, Group, RenderableType
from rich.text import Text

from edoras_tools import words
from edoras_tools.render.severity import Level
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.live_table import LiveRun, LiveTable, Moment, title_line
from edoras_tools.render.terminal.table import Column, build, count_cell, figure, plain
from edoras_tools.render.terminal.text import size_of
from edoras_tools.words import plural

if TYPE_CHECKING:
    from pathlib import Path


_MOST_CLIENTS: Final = 8


def stream_lines(summary: Mapping[str, Any]) -> list[str]:
    """Return lines on the result of a TCP relay, from its summary."""
    texts = {"cut": "cut", "refused": "refused by the target", "silent": "without a byte, so not made"}
    ends = "".join(f", {summary[key]} {text}" for key, text in texts.items() if summary[key])
    bytes_ = f"{summary['bytes_to_target']:,} bytes to the target, {summary['bytes_to_client']:,} back"
    return [
        f"{plural(summary['connections'], 'connection')}{ends}: {bytes_}",
        *(f"  {fault['rule']} held bytes {fault['struck']:,} times" for fault in summary["faults"]),
    ]


def live_table(console: Console, output: Path | None = None, *, keys: bool = False) -> LiveTable[LiveRun]:
    """Return the table of a proxy while it runs.

    Args:
        keys: whether keys switch faults.
    """
    hint = Text("1 to 9 switch faults, q ends" if keys else "Ctrl-C ends", palette.DIM)
    return LiveTable(lambda _, moment: Group(*_view(moment), hint), _counts, console, output)


def _counts(summary: Mapping[str, Any]) -> dict[object, int]:
    return {way["name"]: way["received"] for way in summary["ways"]}


def outcome(summary: Mapping[str, Any], width: int, output: Path | None = None) -> Group:
    """Return the view of a proxy's result.

    Args:
        summary: in the shape of ``proxy --json``.
    """
    moment = Moment(summary, written=size_of(output) if output else None, width=width)
    return Group(*_view(moment), *(plain(line) for line in notes(summary)))


def plan(summary: Mapping[str, Any], output: Path | None) -> Group:
    """Return the view of a proxy's plan."""
    lines = [Text.assemble("would relay ", (_title(summary), palette.STRONG), "; nothing was opened")]
    lines += [plain(f"  fault  {item['rule']}{'' if item['on'] else ' (off)'}") for item in summary["faults"]]
    if summary["faults"]:
        lines.append(plain(f"  seed   {summary['seed']}"))
    if output:
        lines.append(plain(f"  record {output}"))
    return Group(*lines)


_NOTES_OF_A_WAY: Final = {
    "refused": ("time", "refused {}: nothing listens there; start it, or see --target"),
    "failed": ("datagram", "{} not sent: {reason}"),
    "unclaimed": ("datagram", "{} for no client"),
    "kernel_drops": ("datagram", "{} lost before the proxy read them: the receive buffer was full"),
    "overflowed": ("datagram", "{} lost: the queue was full"),
}
"""What each count of a direction counts, and what it says if it is not 0."""
_NOTES: Final = {
    "held": ("datagram", "{} still held back on purpose at the end"),
    "held_overflowed": ("datagram", "{} lost: too much was held back"),
    "unrecorded": ("datagram", "{} relayed, but not recorded"),
    "clients_evicted": ("client", "{} forgotten: too many clients"),
}
"""The same for counts of the whole."""


def notes(summary: Mapping[str, Any]) -> list[str]:
    """Return notes, one line each: refusals, losses, datagrams not delivered at the end."""
    lines = [
        f"{way['name']}: {text.format(plural(way[key], noun), reason=way['reason'])}"
        for way in summary["ways"]
        for key, (noun, text) in _NOTES_OF_A_WAY.items()
        if way[key]
    ]
    return lines + [
        text.format(plural(summary[key], noun)) for key, (noun, text) in _NOTES.items() if summary[key]
    ]


def _title(summary: Mapping[str, Any]) -> str:
    return f"{summary['link']} {summary['listen']} → {', '.join(summary['targets'])}"


def _view(moment: Moment) -> list[RenderableType]:
    summary, rates, width = moment.summary, moment.rates, moment.width
    ways = [dict(way, rate=None if rates is None else rates.get(way["name"])) for way in summary["ways"]]
    columns = [item for item in _WAYS if rates is not None or item.title != "Rate"]
    parts: list[RenderableType] = [title_line(_title(summary), moment), build(columns, ways, width)]
    if summary["clients"]:
        clients: Sequence[Mapping[str, Any]] = summary["clients"][:_MOST_CLIENTS]
        parts += [Text(), build(_CLIENTS, clients, width)]
        if len(summary["clients"]) > len(clients):
            parts.append(Text(f"and {len(summary['clients']) - len(clients):,} more clients", palette.DIM))
    if summary["faults"]:
        faults = [dict(item, key=index) for index, item in enumerate(summary["faults"], 1)]
        parts += [Text(), build(_FAULTS, faults, width)]
    parts.append(Text())
    return parts


def _latency(name: str) -> Any:
    return lambda row: Text(words.microseconds(row["latency_us"][name]))


def _lost(row: Mapping[str, Any]) -> Text:
    return count_cell(row["kernel_drops"] + row["overflowed"], Level.ERROR.style)


_WAYS: Final = (
    Column("Way", lambda row: plain(row["name"]), justify="left", elastic=True),
    Column("In", figure("received")),
    Column("Rate", lambda row: Text(words.rate(row["rate"]))),
    Column("Out", figure("sent")),
    Column("Queue", figure("queued"), rank=2),
    Column("Refused", figure("refused", Level.ERROR.style), rank=1),
    Column("Lost", _lost),
    Column("p50", _latency("p50"), rank=1),
    Column("p99", _latency("p99"), rank=1),
    Column("Max", _latency("max"), rank=3),
)
_CLIENTS: Final = (
    Column("Client", lambda row: plain(row["address"]), justify="left", elastic=True),
    Column("From it", figure("received")),
    Column("To it", figure("answered")),
)
_FAULTS: Final = (
    Column("Key", lambda row: Text(str(row["key"]) if row["key"] < 10 else "")),
    Column("Fault", lambda row: plain(row["rule"]), justify="left", elastic=True),
    Column("", lambda row: Text("on", Level.WARNING.style) if row["on"] else Text("off", palette.DIM)),
    Column("Struck", figure("struck")),
)
