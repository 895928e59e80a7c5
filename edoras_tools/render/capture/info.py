"""The contents of a capture or a recording: totals, a table of routes, a table of findings.

Also the live table of a run on a terminal: its routes, with their counts and rates.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.table import Table
from rich.text import Text

from edoras_tools import words
from edoras_tools.links import table
from edoras_tools.render.severity import Level, explain
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.live_table import LiveRun, LiveTable, Moment, title_line
from edoras_tools.render.terminal.table import Column, build, count_cell, one_line, plain
from edoras_tools.render.terminal.text import clean
from edoras_tools.words import plural

if TYPE_CHECKING:
    from pathlib import Path

    from edoras_tools.model import Link


def exported_lines(summary: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line for each file of a report in the shape of ``export --json``."""
    for item in summary["files"]:
        kind = f", {item['type']}" if item["type"] else ""
        yield clean(f"{item['path']}: {plural(item['rows'], 'row')} of {item['topic']}{kind}")


def capture_summary(summary: Mapping[str, Any], *, explain: bool = True) -> RenderableType:
    """Return the view of the object that ``info --json`` prints.

    Args:
        summary: the object. Besides its fixed keys it may have ``source`` (a name), ``kind``, ``bytes``,
            ``skipped``, ``warnings`` (lines), and per route ``name`` (of a packet that belongs to no topic),
            ``processor_id``, ``bytes_min`` and ``findings`` (label to count). Routes keep their order.
        explain: whether to explain every finding.
    """
    return _CaptureSummary(summary, explain)


class _CaptureSummary(NamedTuple):
    summary: Mapping[str, Any]
    explain: bool

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield the totals and the tables, with the columns that fit into the width."""
        yield totals(self.summary)
        if self.summary.get("routes"):
            yield Text()
            every = self.summary["routes"]
            yield routes(every[:_MOST_ROUTES], options.max_width)
            if len(every) > _MOST_ROUTES:
                yield plain(f"and {len(every) - _MOST_ROUTES:,} more, which --json has", palette.DIM)
        if self.summary.get("entries"):
            yield Text()
            yield _entries(self.summary["entries"])
        if self.summary.get("samples"):
            yield Text()
            yield _writers(self.summary["samples"])
        if self.summary.get("findings"):
            yield Text()
            yield findings(self.summary["findings"], self.summary.get("datagrams", 0), meaning=self.explain)
        for line in self.summary.get("warnings", ()):
            yield plain(f"! {line}", Level.WARNING.style)


def _entries(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Return the table of the entries of an F Prime dictionary."""
    grid = Table.grid(padding=(0, 2))
    grid.add_row(*(plain(name, palette.STRONG) for name in ("F Prime", "ID", "Entry", "Count")))
    for row in rows:
        grid.add_row(row["is"], row["id"], plain(row["entry"]), f"{row['count']:,}")
    grid.columns[3].justify = "right"
    return grid


def _writers(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Return the table of the writers of DDS."""
    grid = Table.grid(padding=(0, 2))
    heads = ("DDS", "Type", "Samples", "Missing", "Copies")
    grid.add_row(*(plain(name, palette.STRONG) for name in heads))
    for row in rows:
        counts = (f"{row[name]:,}" for name in ("count", "missing", "copies"))
        grid.add_row(plain(row["topic"], palette.STRONG), plain(row["type"] or words.NONE), *counts)
    for column in grid.columns[2:]:
        column.justify = "right"
    return grid


def contents_lines(summary: Mapping[str, Any]) -> Iterator[str]:
    """Yield lines about a cFE file without packets, whose summary has the shape of ``info --json``."""
    yield f"source   {clean(summary['source'])}  {summary['kind']}"
    yield f"by       spacecraft {summary['spacecraft_id']}, processor {summary['processor_id']}"
    yield f"says     {clean(summary['description'])}"
    if summary["made_ns"]:
        yield f"made     {words.utc(summary['made_ns'])} (mission time)"
    if "table_name" in summary:
        yield f"table    {clean(summary['table_name'])}, {plural(summary['load_bytes'], 'byte')}"
    if not summary["entries"]:
        return
    yield ""
    if "text" in summary["entries"][0]:
        yield from (clean(item["text"]) for item in summary["entries"])
        return
    names = [*summary["entries"][0]]
    rows = [[name.removesuffix("_ns").replace("_", " ") for name in names]]
    rows += [[_content(name, item[name]) for name in names] for item in summary["entries"]]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        yield "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()


def _content(name: str, value: Any) -> str:
    """Return the text of an entry's field: a time, a duration, or the value."""
    if name == "time_ns":
        return words.utc(value)
    return words.milliseconds(value / 1e6) if name.endswith("_ns") else clean(str(value))


def totals(summary: Mapping[str, Any]) -> Table:
    """Return the table of totals: source, datagrams, span, drops."""
    grid = Table.grid(padding=(0, 2))
    grid.add_column(style=palette.DIM, no_wrap=True)
    grid.add_column(overflow="fold")
    if summary.get("source"):
        kind = plain(summary.get("kind") or "", palette.DIM)
        grid.add_row("source", Text.assemble(plain(summary["source"], palette.STRONG), "  ", kind))
    topics = "messages" in summary
    count = summary["messages"] if topics else summary.get("datagrams", 0)
    line = Text(plural(count, "message" if topics else "datagram"))
    if summary.get("bytes"):
        line.append(f", {words.size(summary['bytes'])}")
    if summary.get("skipped"):
        line.append(f", {plural(summary['skipped'], 'other frame')} skipped", palette.DIM)
    grid.add_row("content" if topics else "packets", line)
    start, end = summary.get("start_ns"), summary.get("end_ns")
    if count and start is not None and end is not None:
        grid.add_row("from", Text(f"{words.utc(start)} UTC"))
        span = Text(f"   {words.duration((end - start) / 1e9)}", palette.STRONG)
        grid.add_row("to", Text(f"{words.utc(end)} UTC").append_text(span))
    if topics:
        return grid
    drops = summary.get("capture_drops")
    if drops is None:
        why = " (pcap does not record them)" if summary.get("kind") == "pcap" else ""
        grid.add_row("drops", Text(f"unknown{why}", palette.DIM))
    elif drops:
        lost = f"{plural(drops, 'frame')} lost by the capture itself; gaps below may be among them"
        grid.add_row("drops", Text(lost, Level.ERROR.style))
    else:
        grid.add_row("drops", "none by the capture")
    return grid


def route_text(route: Mapping[str, Any]) -> Text:
    """Return a route's topic, or the name of its packets in another style."""
    if route.get("topic"):
        return plain(route["topic"], palette.STRONG)
    return plain(route.get("name") or words.NONE)


def _link(route: Mapping[str, Any]) -> Link | None:
    return table.link_of_label(route["link"]) if route.get("link") else None


def link_text(route: Mapping[str, Any]) -> Text:
    """Return a route's link in its colour."""
    link = _link(route)
    return plain(link.name, link.colour) if link else plain("")


def msg_id_text(route: Mapping[str, Any]) -> Text:
    """Return a route's MsgId in its link's colour."""
    link = _link(route)
    return plain(route.get("msg_id") or words.NONE, link.colour if link else "")


def departures(counts: Mapping[str, int]) -> Text:
    """Return the numbers of errors and warnings, as ``✗ 3 ! 12``."""
    totals: dict[Level, int] = {}
    for label, count in counts.items():
        severity = explain(label).severity
        totals[severity] = totals.get(severity, 0) + count
    out = Text()
    for severity in sorted(totals, reverse=True):
        if severity >= Level.WARNING:
            out.append(" " if out else "").append(f"{severity.mark} {totals[severity]:,}", severity.style)
    return out


def _sizes(route: Mapping[str, Any]) -> Text:
    least, most = route.get("bytes_min"), route.get("bytes_max")
    return Text(words.count(most) if least in {None, most} else f"{words.count(least)}-{words.count(most)}")


def _several(route: Mapping[str, Any], key: str) -> float | None:
    """Return a figure that exists only for several packets."""
    value: float | None = route.get(key)
    return value if route.get("count", 0) > 1 and value else None


_CPU: Final = Column("CPU", lambda row: plain(row.get("processor_id") or ""), rank=3)
_COLUMNS: Final = (
    Column("Link", link_text, justify="left"),
    Column("MsgId", msg_id_text, justify="left"),
    Column("Topic", route_text, justify="left", elastic=True),
    Column("Type", lambda row: plain(row.get("type") or ""), rank=6, justify="left"),
    _CPU,
    Column("Count", lambda row: Text(words.count(row.get("count")), palette.STRONG)),
    Column("Rate", lambda row: Text(words.rate(_several(row, "rate_hz")))),
    Column("Jitter", lambda row: Text(words.milliseconds(_several(row, "jitter_ms"))), rank=2),
    Column("Gaps", lambda row: count_cell(row.get("gaps"), Level.WARNING.style), rank=1),
    Column("Dup", lambda row: count_cell(row.get("duplicates"), Level.WARNING.style), rank=5),
    Column("Bytes", _sizes, rank=4),
    Column("Findings", lambda row: departures(row.get("findings") or {}), rank=1, justify="left"),
)


SPACECRAFT: Final = Column("Spacecraft", lambda row: plain(row["spacecraft"]), rank=1)
_MOST_ROUTES: Final = 500
"""Most rows in the table of routes; rich takes some ms for each."""
_OF_TOPICS: Final = [
    item for item in _COLUMNS if item.title in {"Topic", "Type", "Count", "Rate", "Jitter", "Bytes"}
]


def routes(rows: Sequence[Mapping[str, Any]], width: int) -> Table:
    """Return the table of routes, with the columns that ``width`` has room for; topics have fewer."""
    columns = [*(_COLUMNS if any(row.get("link") for row in rows) else _OF_TOPICS)]
    if any("spacecraft" in row for row in rows):
        columns.append(SPACECRAFT)
    return build(columns, rows, width, apart=lambda row: "topic" if row.get("topic") else row.get("link"))


def findings(counts: Mapping[str, int], datagrams: int, *, meaning: bool = True) -> Table:
    """Return the table of findings, the gravest and then the most frequent first.

    Args:
        counts: label to count.
        meaning: whether to explain every finding.
    """
    table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, header_style=palette.STRONG)
    table.add_column("Finding", no_wrap=True)
    table.add_column("Packets", justify="right", no_wrap=True)
    table.add_column("", justify="right", no_wrap=True, style=palette.DIM)
    if meaning:
        table.add_column("Meaning", overflow="fold")
    explained = [(label, count, explain(label)) for label, count in counts.items()]
    for label, count, it in sorted(explained, key=lambda item: (-item[2].severity, -item[1])):
        name = plain(f"{it.severity.mark} {label}", it.severity.style)
        share = (
            "" if not datagrams else "<1%" if 200 * count < datagrams else f"{100 * count / datagrams:.0f}%"
        )
        table.add_row(name, words.count(count), share, *([Text(it.meaning)] if meaning else []))
    return table


STATISTICS: Final = ("routes", "sbn", "sizes", "findings")

_SIZES: Final = (
    *_COLUMNS[:3],
    _CPU,
    Column("Count", lambda row: Text(words.count(row["count"]), palette.STRONG)),
    Column("Least, B", lambda row: Text(words.count(row["bytes_min"]))),
    Column("Mean, B", lambda row: Text(f"{row['bytes'] / row['count']:,.1f}")),
    Column("Most, B", lambda row: Text(words.count(row["bytes_max"]))),
    Column("Total", lambda row: Text(words.size(row["bytes"])), rank=1),
)
_NETWORK: Final = (
    Column("From", lambda row: plain(row["source"], palette.STRONG), justify="left"),
    Column("To", lambda row: plain(row["destination"]), justify="left"),
    Column("Message", lambda row: plain(row["message"]), justify="left", elastic=True),
    Column("Count", lambda row: Text(words.count(row["count"]), palette.STRONG)),
    Column("Every", lambda row: Text(words.milliseconds(row["period_ms"]))),
    Column("First", lambda row: Text(f"{row['first_ns'] / 1e9:.3f} s"), rank=1),
    Column("Last", lambda row: Text(f"{row['last_ns'] / 1e9:.3f} s"), rank=1),
    Column("Runs", lambda row: Text(words.count(row["runs"])), rank=2),
)


def statistics(kind: str, figures: Any, datagrams: int, width: int) -> Table:
    """Return one table.

    Args:
        kind: one of ``STATISTICS``.
        figures: rows, or counts by label for ``findings``, as the pipeline gives them.
    """
    if kind == "routes":
        return routes(figures, width)
    if kind == "findings":
        return findings(figures, datagrams)
    rows: Sequence[Mapping[str, Any]] = figures
    return build(_SIZES if kind == "sizes" else _NETWORK, rows, width)


def live_table(title: str, console: Console, output: Path | None = None) -> LiveTable[LiveRun]:
    """Return the live table of a run; its last state stays on the screen.

    Args:
        title: name of the run, as ``eth0 → a.mcap``.
        output: file or directory whose size is shown.
    """
    return LiveTable(lambda _, moment: view(title, moment), _counts, console, output, transient=False)


def _counts(summary: Mapping[str, Any]) -> dict[object, int]:
    counts: dict[object, int] = {_key(row): row.get("count", 0) for row in summary.get("routes", ())}
    return {**counts, None: summary.get("datagrams", 0)}


def view(title: str, moment: Moment) -> Group:
    """Return the content of the live table; routes that do not fit are only counted."""
    rates = moment.rates or {}
    parts: list[RenderableType] = [title_line(title, moment), one_line(_totals(moment, rates))]
    rows = list(moment.summary.get("routes", ()))
    room = max(1, moment.height - 6)
    if not rows:
        return Group(*parts, Text("waiting for the first packet ... Ctrl-C ends", palette.DIM))

    def now(row: Mapping[str, Any]) -> Text:
        rate = rates.get(_key(row))
        return Text(words.rate(rate), "" if rate else palette.DIM)

    columns = (*_LIVE_COLUMNS[:3], Column("Now", now), *_LIVE_COLUMNS[3:])
    parts += [Text(), build(columns, rows[:room], moment.width)]
    if len(rows) > room:
        parts.append(Text(f"and {len(rows) - room:,} more routes", palette.DIM))
    return Group(*parts)


def _totals(moment: Moment, rates: Mapping[object, float]) -> Text:
    count, drops = moment.summary.get("datagrams", 0), moment.summary.get("capture_drops")
    line = Text(plural(count, "packet"), palette.STRONG)
    line.append(f"   {words.rate(rates.get(None)).replace('Hz', 'packets/s')}", palette.DIM)
    if drops:
        line.append(f"   {words.count(drops)} dropped", Level.ERROR.style)
    elif drops is not None:
        line.append("   no drops", palette.DIM)
    if moment.written is not None:
        line.append(f"   {words.size(moment.written)} written", palette.DIM)
    return line


_LIVE_COLUMNS: Final = (
    *_COLUMNS[:3],
    Column("CPU", lambda row: plain(row.get("processor_id") or ""), rank=2),
    Column("Count", lambda row: Text(words.count(row.get("count")), palette.STRONG)),
    Column("Mean", lambda row: Text(words.rate(row.get("rate_hz") or None), palette.DIM), rank=3),
    Column("Gaps", lambda row: count_cell(row.get("gaps")), rank=2),
    Column("Largest", lambda row: Text(words.count(row.get("bytes_max"))), rank=4),
    Column("Findings", lambda row: departures(row.get("findings") or {}), rank=1, justify="left"),
)


def _key(row: Mapping[str, Any]) -> object:
    return row.get("link"), row.get("processor_id"), row.get("msg_id"), row.get("name"), row.get("topic")
