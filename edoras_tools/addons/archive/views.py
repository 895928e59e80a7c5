"""An archive's report: one self-contained HTML page, or tables for people; and the queries of an index.

Lists of captures and of losses are queries too. Their SQL is in ``queries.sql``, where the line ``-- name:
NAME`` stands above each.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import datetime, timedelta
from decimal import Decimal
from fnmatch import fnmatchcase
from html import escape
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from edoras_tools import words
from edoras_tools.decode.spacecraft import FIRST_SPACECRAFT
from edoras_tools.errors import CaptureError
from edoras_tools.io.formats.columns import json_value
from edoras_tools.older import UTC
from edoras_tools.pipelines.selection import fits_topic
from edoras_tools.render import pages
from edoras_tools.render.pages import CHART_WIDTH, LEFT, RIGHT, Frame, TimeSpan, svg_box
from edoras_tools.render.severity import Level
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.table import Column, build, figure, plain
from edoras_tools.render.terminal.text import cells
from edoras_tools.units import SECOND
from edoras_tools.words import plural

if TYPE_CHECKING:
    from edoras_tools.addons.archive.index import Index

_LOST: Final = Level.ERROR.style
_WIDEST: Final = 40
"""Maximum width of a column of an answer, in cells."""
_MOST_LINES: Final = 1000
"""Maximum number of rows of an answer in a table; CSV and JSON have all."""


def update_lines(summary: Mapping[str, Any], index: str) -> Iterator[str]:
    """Yield lines on an update, from the shape of ``archive --json``."""
    parts = [f"{summary['read']:,} read", f"{summary['unchanged']:,} unchanged"]
    parts += [f"{summary[name]:,} {text}" for name, text in _RARE.items() if summary[name]]
    yield f"{index}: {plural(summary['found'], 'capture')}: {', '.join(parts)}"
    if not summary["found"]:
        yield "no capture was found; name files, or folders with .mcap, .pcapng or .pcap"


_RARE: Final = {
    "same": "with a new date and the same contents",
    "gone": "no longer there",
    "left": "not read yet",
}


def captures_table(rows: Sequence[Mapping[str, Any]], width: int) -> RenderableType:
    """Return captures as a table, and below it the reasons why some are incomplete.

    Args:
        rows: rows in the shape of ``archive list --json``.
    """
    columns = (
        Column("Began (UTC)", lambda row: plain(_when(row["start_ns"])), justify="left"),
        Column("Capture", lambda row: plain(short(row["capture"])), justify="left", elastic=True),
        Column("Length", lambda row: plain(_length(row["seconds"])), rank=1),
        Column("Datagrams", figure("datagrams")),
        Column("Lost", figure("lost", _LOST)),
        Column("Unaccounted", figure("unaccounted", _LOST), rank=2),
        Column("Worst", lambda row: plain(row["worst"] or ""), justify="left", rank=1),
        Column("State", lambda row: plain("gone" if row["gone"] else row["state"]), justify="left"),
    )
    errors = [plain(row["error"]) for row in rows if row["error"]]
    return Group(build(columns, rows, width), *errors, Text(f"{plural(len(rows), 'capture')}."))


def losses_table(rows: Sequence[Mapping[str, Any]], width: int) -> RenderableType:
    """Return losses as a table.

    Args:
        rows: rows in the shape of ``archive losses --json``.
    """
    columns = (
        Column("Began (UTC)", lambda row: plain(_when(row["start_ns"])), justify="left"),
        Column("Capture", lambda row: plain(short(row["capture"])), justify="left", elastic=True),
        Column("Link", lambda row: plain((row["link"] or "").upper()), justify="left", rank=1),
        Column("Topic", lambda row: plain(_route(row)), justify="left"),
        Column("Sent", figure("sent")),
        Column("Lost", figure("lost", _LOST)),
        Column("Unaccounted", figure("unaccounted", _LOST), rank=1),
        Column("Share", lambda row: plain(_share(row["share"]))),
        Column("By", lambda row: plain(", ".join(row["causes"])), justify="left", rank=2),
    )
    lost, unaccounted = (sum(row[name] for row in rows) for name in ("lost", "unaccounted"))
    captures = plural(len({row["capture"] for row in rows}), "capture")
    total = f"{lost:,} lost, {unaccounted:,} unaccounted for, in {captures}."
    return Group(build(columns, rows, width), Text(total))


def _route(row: Mapping[str, Any]) -> str:
    whose = f"sc_{row['spacecraft']} " if (row["spacecraft"] or 0) > FIRST_SPACECRAFT else ""
    return row["topic"] or f"{whose}{row['name'] or row['msg_id'] or '?'}"


ROW_TABLES: Final = {"captures": captures_table, "losses": losses_table}
"""Tables by the name of their rows in JSON."""


def answer_table(names: Sequence[str], rows: Iterable[Sequence[Any]], width: int) -> RenderableType:
    """Return the answer to a query as a table, numbers on the right; below it, a note on what is left out."""
    some = iter(rows)
    first_rows = list(islice(some, _MOST_LINES))
    rest = sum(1 for _ in some)
    texts = [
        [plain(_cell(value), palette.DIM if value is None else "") for value in row] for row in first_rows
    ]
    table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, header_style=palette.STRONG)
    hidden = []
    for place, name in enumerate(names):
        column = [row[place] for row in texts]
        room = min(_WIDEST, max([cells(name), *(text.cell_len for text in column)]))
        if place and room > width:
            hidden.append(name)
            continue
        width -= room + 2
        right = any(isinstance(row[place], int | float) for row in first_rows)
        for text in column:
            text.truncate(room, overflow="ellipsis")
        table.add_column(plain(name), justify="right" if right else "left", no_wrap=True, overflow="ellipsis")
    places = [place for place, name in enumerate(names) if name not in hidden]
    for row in texts:
        table.add_row(*(row[place] for place in places))
    lines = [f"and {plural(rest, 'row')} more: --format csv"] * bool(rest)
    if hidden:
        columns = plural(len(hidden), "column")
        lines.append(
            f"{columns} of {len(names)} not shown: {', '.join(hidden)}; SELECT some, or --format csv"
        )
    return Group(table, *(Text(line, palette.DIM) for line in lines))


def short(capture: str) -> str:
    """Return a short name of a capture for people: its URL without the common folder."""
    path, folder = Path(capture), Path.cwd()
    return str(path.relative_to(folder)) if path.is_relative_to(folder) else capture


def json_rows(rows: Iterable[Sequence[Any]]) -> list[list[Any]]:
    """Return the rows of an answer as JSON values: times and the like become texts."""
    return [[_plain(value) for value in row] for row in rows]


def _plain(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {str(name): _plain(item) for name, item in value.items()}
    if isinstance(value, Decimal):
        value = float(value)
    if isinstance(value, bytes):
        return value.hex()
    return json_value(value) if value is None or isinstance(value, bool | int | float) else str(value)


def _cell(value: Any) -> str:
    if value is None:
        return words.NONE
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _when(time_ns: int | None) -> str:
    return words.NONE if time_ns is None else words.utc(time_ns, digits=0)


def _length(seconds: float | None) -> str:
    return words.NONE if seconds is None else words.duration(seconds)


def _share(share: float | None) -> str:
    return words.NONE if share is None else f"{100 * share:.3g} %"


_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
_MOST_WORST: Final = 20
_MOST_ERRORS: Final = 200
BINS: Final = 60
"""Maximum number of bars of a trend."""
MOST_COLUMNS: Final = 60
"""Maximum number of runs in the heat map."""
_MOST_ROWS: Final = 12
_STRIP: Final = 40
_HEAT: Final = (0.0, 0.01, 0.1, 0.5)
"""Upper limits of the shares for the colours of a heat map cell; a larger share has the fifth colour."""
_HEATS: Final = ("nothing missing", "up to 1 %", "up to 10 %", "up to 50 %", "more")
_MARKS: Final = 3
_DAY_S: Final = 86_400
_ROUND_S: Final = (
    *(1, 2, 5, 10, 20, 30),
    *(60 * item for item in (1, 2, 5, 10, 20, 30, 60, 120, 180, 360, 720)),
    *(_DAY_S * item for item in (1, 2, 4, 7, 14, 28)),
)
_PARTS: Final = {
    "crossing": "through cFS",
    "delay": "from publication to the wire",
    "to_robot": "to the robot",
}


class ArchiveTrends(msgspec.Struct, frozen=True):
    """The contents of a report; rows have the names of the queries in ``addons.archive.questions``.

    Attributes:
        name: name of the index.
        totals: totals of all captures with datagrams.
        runs: one row for each run, the oldest first.
        routes: routes with the most losses.
        shares: sent and missing messages of the latest runs, one row for each route and run, the oldest
            first.
        trends: sent and missing messages of routes with several runs, by bin of the whole time.
        delays: routes with the longest latencies: the 99th percentile of each run.
        rules: errors and warnings by rule.
        errors: reasons why captures are incomplete, one line each.
    """

    name: str
    totals: dict[str, Any]
    runs: list[dict[str, Any]]
    routes: list[dict[str, Any]]
    shares: list[dict[str, Any]]
    trends: list[tuple[dict[str, Any], list[dict[str, Any]]]]
    delays: list[tuple[dict[str, Any], list[dict[str, Any]]]]
    rules: list[dict[str, Any]]
    errors: list[str]

    @property
    def bin_ns(self) -> int:
        """Length of a bin, ns."""
        return bin_ns(self.totals)


def bin_ns(totals: dict[str, Any]) -> int:
    """Return the length of a bin of the whole time, ns: a round time that gives at most ``BINS`` bins."""
    least = max(1, -(-(int(totals["end_ns"]) - int(totals["start_ns"])) // BINS))
    return next((step * SECOND for step in _ROUND_S if step * SECOND >= least), least)


class _Calendar(TimeSpan, frozen=True):
    """The span of a chart, s."""

    @classmethod
    def of(cls, trends: ArchiveTrends) -> _Calendar:
        """Return the span of all captures."""
        start_ns, end_ns = trends.totals["start_ns"], trends.totals["end_ns"]
        return cls(start_ns / 1e9, max(1.0, (end_ns - start_ns) / 1e9))

    def at(self, time_ns: int) -> float:
        """Return a time as s since the begin."""
        return float(time_ns / 1e9 - self.begin)


class _DateFrame(Frame):
    """A plot over days or months: the marks of its time axis are dates, or times within a day."""

    def seconds(self) -> list[str]:
        """Return the marks of the time axis."""
        marks = []
        for number in range(_MARKS):
            share = number / (_MARKS - 1)
            when = _EPOCH + timedelta(seconds=self.begin + share * self.x_most)
            text = f"{when:%Y-%m-%d}" if self.x_most > 2 * _DAY_S else f"{when:%m-%d %H:%M}"
            style = "first" if number == 0 else "end" if number == _MARKS - 1 else "mid"
            marks.append(
                f'<text class="{style}" x="{self.x(share * self.x_most)}" y="{self.height - 8}">{text}</text>'
            )
        return marks


def archive_page(trends: ArchiveTrends, origin: pages.Origin) -> str:
    """Return the HTML page."""
    calendar = _Calendar.of(trends)
    sections = [
        pages.section(
            "Runs over time",
            _runs(trends, calendar),
            pages.colour_key((("note", "nothing missing"), ("error", "something missing"))),
        ),
        pages.section(
            "Runs and topics",
            _heat_map(trends),
            pages.colour_key([(f"heat{place}", text) for place, text in enumerate(_HEATS)]),
        ),
        pages.section(
            "Trends", _trends(trends, calendar), pages.colour_key((("error", "lost or unaccounted for"),))
        ),
        pages.section("Latency", _delays(trends, calendar)),
        pages.section("Worst routes", [_routes(trends)]),
        pages.section("Worst runs", [_worst(trends)] if trends.totals["with_loss"] else []),
        pages.section("Verdicts by rule", [_rules(trends)]),
        pages.section("Not whole", _errors(trends)),
    ]
    return pages.document(
        f"edoras archive report: {trends.name}",
        [_head(trends), pages.contents(sections), *sections, pages.footer(origin)],
    )


def _head(trends: ArchiveTrends) -> str:
    totals = trends.totals
    missing = totals["lost"] + totals["unaccounted"]
    style = "lost" if missing else "fine"
    sent = sum(row["sent"] for row in trends.runs)
    of = f", {_percent(missing, sent)} of {sent:,} sent" if sent and missing else ""
    text = (
        f"{totals['lost']:,} lost, {totals['unaccounted']:,} unaccounted for, in "
        f"{totals['with_loss']:,} of {plural(totals['captures'], 'run')}{of}"
    )
    when = f"{words.utc(totals['start_ns'], digits=0)} to {words.utc(totals['end_ns'], digits=0)} UTC"
    return (
        f"<header>{pages.heading(short(trends.name))}"
        f'<p class="dim">{plural(totals["captures"], "run")}, {totals["datagrams"]:,} datagrams, '
        f"{words.duration(totals['seconds'])} in all, {when}</p>"
        f'<p class="end-note {style}">{text}</p></header>'
    )


def _runs(trends: ArchiveTrends, calendar: _Calendar) -> Iterable[str]:
    shares = [
        (calendar.at(row["start_ns"]), 100 * (row["lost"] + row["unaccounted"]) / row["sent"], row["worst"])
        for row in trends.runs
        if row["sent"]
    ]
    most = max((share for _, share, _ in shares), default=0.0)
    frame = _DateFrame(calendar, most or 1.0, "% missing", "share of each run's messages that is missing")
    for lossy, style in ((False, "run"), (True, "run lossy")):
        frame.dots(_apart(frame, ((x, y) for x, y, _ in shares if bool(y) is lossy)), style)
    yield pages.chart_card("Missing of what was sent, a dot for each run", frame.svg())
    counts = [0.0] * _bins(trends)
    for row in trends.runs:
        counts[min((row["start_ns"] - trends.totals["start_ns"]) // trends.bin_ns, len(counts) - 1)] += 1
    frame = _DateFrame(calendar, max(counts), "runs", "runs over time")
    frame.bars(counts, [0.0] * len(counts), trends.bin_ns / 1e9, "seen all")
    yield pages.chart_card("Runs", frame.svg(), f"a bar is {_round_time(trends.bin_ns / SECOND)}")


def _round_time(seconds: float) -> str:
    for unit, name in ((_DAY_S, "day"), (3600, "hour"), (60, "minute"), (1, "second")):
        if seconds % unit == 0:
            return plural(int(seconds // unit), name)
    return words.duration(seconds)


def _bins(trends: ArchiveTrends) -> int:
    span = int(trends.totals["end_ns"]) - int(trends.totals["start_ns"])
    return max(1, -(-span // trends.bin_ns))


def _apart(frame: Frame, points: Iterable[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return points that are distinguishable in the picture, from any number."""
    return list({(frame.x(x), frame.y(y)): (x, y) for x, y in points}.values())


def _heat_map(trends: ArchiveTrends) -> Iterable[str]:
    """Yield one row for each topic with the most losses, one cell for each run; the legend is elsewhere."""
    captures = list(dict.fromkeys(row["capture"] for row in trends.shares))
    cells = {(row["route"], row["link"], row["capture"]): row for row in trends.shares}
    drawn = {key[:2] for key in cells}
    routes = [row for row in trends.routes if (row["route"], row["link"]) in drawn][:_MOST_ROWS]
    if len(captures) < 2 or not routes:
        return
    width = (CHART_WIDTH - LEFT - RIGHT) / max(len(captures), 12)
    inside, texts = [], []
    for place, route in enumerate(routes):
        top = 4 + place * _STRIP
        name = f"{route['route']}, {route['link'].upper()}".rstrip(", ")
        inside.append(f'<text x="{LEFT}" y="{top + 12}">{escape(name)}</text>')
        for column, capture in enumerate(captures):
            if row := cells.get((route["route"], route["link"], capture)):
                step = sum(row["missing"] / row["sent"] > limit for limit in _HEAT)
                missing = _percent(row["missing"], row["sent"])
                title = f"{short(capture)}: {row['missing']:,} of {row['sent']:,} missing, {missing}"
                inside.append(
                    f'<rect class="heat{step}" x="{LEFT + column * width:.1f}" y="{top + 17}" height="14" '
                    f'width="{max(1.0, width - 1):.1f}"><title>{escape(title)}</title></rect>'
                )
        texts.append(f"{name}: missing in {route['with_loss']:,} of {route['captures']:,} runs")
    title = f"Share missing of topics and runs. {'; '.join(texts)}"
    which = "the latest " if len(captures) == MOST_COLUMNS else ""
    note = (
        f"a column a run, the oldest first, {which}{len(captures)} runs; empty where it has none of a topic"
    )
    picture = svg_box("".join(inside), 4 + _STRIP * len(routes), title)
    yield pages.chart_card("Missing of what was sent, topic by topic", picture, note)


def _trends(archive: ArchiveTrends, calendar: _Calendar) -> Iterable[str]:
    for row, bins in archive.trends:
        values = [0.0] * _bins(archive)
        for item in bins:
            if item["sent"]:
                values[min(item["bin"], len(values) - 1)] = 100 * item["missing"] / item["sent"]
        frame = _DateFrame(calendar, max(values), "% missing", f"share of {row['route']} that is missing")
        frame.bars(values, [0.0] * len(values), archive.bin_ns / 1e9, "missing")
        missing = row["lost"] + row["unaccounted"]
        runs = f"{row['with_loss']:,} of {plural(row['captures'], 'run')}"
        note = f"{missing:,} of {row['sent']:,} missing, in {runs}"
        yield pages.chart_card(f"{row['route']}, {row['link'].upper()}".rstrip(", "), frame.svg(), note)


def _delays(trends: ArchiveTrends, calendar: _Calendar) -> Iterable[str]:
    for row, delays in trends.delays:
        frame = _DateFrame(calendar, row["p99_ms"], "ms", f"latency of {row['route']}")
        frame.dots(_apart(frame, ((calendar.at(item["start_ns"]), item["p99_ms"]) for item in delays)), "run")
        note = (
            f"a dot is the 99th percentile of a run, the highest {words.milliseconds(row['p99_ms'])}; "
            f"{row['timed']:,} messages in {plural(row['captures'], 'run')}"
        )
        yield pages.chart_card(
            f"{row['route']}, {row['link'].upper()}, {_PARTS[row['part']]}", frame.svg(), note
        )


def _routes(trends: ArchiveTrends) -> str:
    rows = (
        (
            *(row["route"], row["link"].upper(), f"{row['with_loss']:,} of {row['captures']:,}"),
            *_missing(row, "lost", "unaccounted", "sent"),
        )
        for row in trends.routes
    )
    heads = ("route", "link", "runs with loss", "missing", "lost", "unaccounted", "sent")
    return pages.html_table(heads, (map(escape, row) for row in rows), "figures")


def _worst(trends: ArchiveTrends) -> str:
    runs = sorted(trends.runs, key=lambda row: (-(row["lost"] + row["unaccounted"]), row["capture"]))
    rows = (
        (
            *(short(row["capture"]), words.utc(row["start_ns"], digits=0), row["worst"] or ""),
            *_missing(row, "lost", "unaccounted", "datagrams"),
        )
        for row in runs[:_MOST_WORST]
        if row["lost"] + row["unaccounted"]
    )
    heads = ("run", "began (UTC)", "worst", "missing", "lost", "unaccounted", "datagrams")
    return pages.html_table(heads, (map(escape, row) for row in rows), "figures")


def _rules(trends: ArchiveTrends) -> str:
    names, figures = ("rule", "severity", "example"), ("captures", "verdicts", "lost")
    rows = (
        [*(row[name] for name in names), *(words.count(row[name]) for name in figures)]
        for row in trends.rules
    )
    heads = ("rule", "severity", "for example", "runs", "verdicts", "lost")
    return pages.html_table(heads, (map(escape, row) for row in rows), "rules")


def _errors(trends: ArchiveTrends) -> Iterable[str]:
    if trends.errors:
        lines = "".join(f"<li>{escape(line)}</li>" for line in trends.errors[:_MOST_ERRORS])
        rest = len(trends.errors) - _MOST_ERRORS
        yield f"<ul>{lines}</ul>" + (f'<p class="dim">and {rest:,} more</p>' if rest > 0 else "")


def _missing(row: Mapping[str, Any], *figures: str) -> list[str]:
    """Return the share of a row's messages that is missing, and some of its figures."""
    share = _percent(row["lost"] + row["unaccounted"], row["sent"])
    return [share, *(words.count(row[name]) for name in figures)]


def _percent(missing: int, sent: int) -> str:
    return f"{100 * missing / sent:.3g} %" if sent else words.NONE


_FILE: Final = Path(__file__).with_name("queries.sql")
_QUERIES: Final = dict(
    part.split("\n", 1) for part in _FILE.read_text(encoding="utf-8").split("\n-- name: ")[1:]
)
"""Queries by name."""


class ArchiveSpan(msgspec.Struct, frozen=True):
    """A span of time; it selects captures that overlap it.

    Attributes:
        since_ns: ns since 1970 UTC; None for no limit.
        until_ns: ns since 1970 UTC, not included; None for no limit.
    """

    since_ns: int | None = None
    until_ns: int | None = None

    @property
    def values(self) -> list[int | None]:
        """Values of the four parameters of a query."""
        return [self.since_ns, self.since_ns, self.until_ns, self.until_ns]


def list_captures(index: Index, span: ArchiveSpan) -> list[dict[str, Any]]:
    """Return the captures of a span of time, the oldest first; with a span, only those with datagrams."""
    return index.rows(_QUERIES["listed"], span.values)


def list_losses(
    index: Index, span: ArchiveSpan, topics: tuple[str, ...] = (), *, over: float = 0.0
) -> list[dict[str, Any]]:
    """Return lost and unaccounted messages, by capture and route, the oldest capture first.

    Args:
        topics: patterns of topics, names or MsgIds; empty for all.
        over: share of the sent messages; only rows with more missing messages are returned.
    """
    losses = [row for row in index.rows(_QUERIES["lost"], span.values) if not topics or _fits(row, topics)]
    for row in losses:
        missing = row["lost"] + row["unaccounted"]
        row["share"] = missing / row["sent"] if row["sent"] else None
        row["causes"] = row["causes"] or []
    return [row for row in losses if row["share"] is None or row["share"] > over]


def count_examined(index: Index, span: ArchiveSpan, topics: tuple[str, ...] = ()) -> int:
    """Return the number of captures of a span of time with messages, of these topics if any are named.

    Raises:
        CaptureError: there is no such capture.
    """
    captures = {
        row["capture"]
        for row in index.rows(_QUERIES["sent"], span.values)
        if not topics or _fits(row, topics)
    }
    if not captures:
        of = " of these topics" if topics else ""
        raise CaptureError(
            f"{index.path}: has no capture of this time with messages{of}; "
            "'edoras archive list' shows the captures"
        )
    return len(captures)


def _fits(row: Mapping[str, Any], patterns: tuple[str, ...]) -> bool:
    names = [str(row[name]).upper() for name in ("name", "msg_id") if row[name]]
    return any(
        (row["topic"] and fits_topic(row["topic"], pattern))
        or any(fnmatchcase(name, pattern.upper()) for name in names)
        for pattern in patterns
    )


_MOST_ROUTES: Final = 12


def trends_of(index: Index, span: ArchiveSpan) -> ArchiveTrends:
    """Query an index for all contents of a report.

    Raises:
        CaptureError: no capture with datagrams is in the span.
    """
    limits = [f"end_ns >= {span.since_ns}"] if span.since_ns is not None else []
    limits += [f"start_ns < {span.until_ns}"] if span.until_ns is not None else []
    index.run(_QUERIES["route"])
    index.run(_QUERIES["chosen"].format(" AND ".join(limits) or "true"))

    def rows(name: str, *values: object) -> list[dict[str, Any]]:
        return index.rows(_QUERIES[name], values)

    (totals,) = rows("totals")
    if not totals["captures"]:
        raise CaptureError(f"{index.path}: has no capture with datagrams in this time; nothing to report")
    bad = index.ask("SELECT error FROM captures WHERE error IS NOT NULL ORDER BY capture")
    routes = rows("routes")
    often = [row for row in routes if row["captures"] > 1]  # a single run is no trend
    bins = totals["start_ns"], bin_ns(totals), BINS - 1
    return ArchiveTrends(
        str(index.path),
        totals,
        rows("runs"),
        routes,
        rows("shares", MOST_COLUMNS),
        [(row, rows("trend", *bins, row["route"], row["link"])) for row in often[:_MOST_ROUTES]],
        [(row, rows("delays", row["route"], row["link"], row["part"])) for row in rows("delayed")],
        rows("rules"),
        [error for (error,) in bad],
    )
