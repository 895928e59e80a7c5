"""The doctor's result for people: one screen; then verdicts with their evidence, and the figures.

The balance of every route and hop is a table whose rows add up; the lost messages can be listed.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import partial
from itertools import groupby
from operator import attrgetter, itemgetter
from typing import TYPE_CHECKING, Any, Final

from msgspec.structs import replace
from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.table import Column as TableColumn
from rich.table import Table
from rich.text import Text

from edoras_tools import words
from edoras_tools.cfs.names import MSG_ID_NAMES
from edoras_tools.diagnosis.balance import PEER_TO_ROBOT, Chain
from edoras_tools.diagnosis.ledger import cause_text
from edoras_tools.diagnosis.summary import Problem, summarize
from edoras_tools.diagnosis.verdict import Severity, Verdict, alike, group_verdicts
from edoras_tools.render.capture.info import link_text, msg_id_text, route_text
from edoras_tools.render.capture.tree import value_text
from edoras_tools.render.severity import Level
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.live_table import LiveView
from edoras_tools.render.terminal.palette import detect_terminal, error_console
from edoras_tools.render.terminal.table import Column, build, figure, plain
from edoras_tools.render.terminal.text import clean, wrap
from edoras_tools.wire.arrays import by_key
from edoras_tools.words import plural

if TYPE_CHECKING:
    from typing_extensions import Self

    from edoras_tools.diagnosis.accounting.budget import Budget
    from edoras_tools.diagnosis.examination import Diagnosis
    from edoras_tools.diagnosis.missing import Missing

FIGURES: Final = {
    "in": "In",
    "duplicated": "Twice",
    "late": "Late",
    "out_of_order": "Out of order",
    "out": "Out",
    "lost": "Lost",
    "superseded": "Superseded",
    "waiting": "Waiting",
    "not_captured": "Not seen",
    "unaccounted": "Unaccounted",
}
"""Name of each figure to its column title."""
_ALWAYS: Final = frozenset({"in", "out", "lost"})


def shown_rows(result: Diagnosis) -> list[dict[str, Any]]:
    """Return the rows to show: packets of cFS itself are joined to one row if none is missing."""
    balance = [row.as_json(result.topics.get(row.route)) for row in result.balance]
    for item, row_json in zip(result.balance, balance, strict=True):
        if not item.observed:
            row_json.update(lost=None, not_counted=item.counted["lost"])
    rows = _with_ends(result, balance)
    own = MSG_ID_NAMES.values()
    quiet = [row for row in rows if not row["topic"] and row["name"] in own and row["in"] == row["out"]]
    if len(quiet) < 2:
        return rows
    left_out = {id(row) for row in quiet}
    rest = [row for row in rows if id(row) not in left_out]
    first: dict[tuple[Any, ...], int] = {}
    for row in quiet:  # count a message that crosses two hops once
        first.setdefault((row["link"], row["msg_id"], row["instance"]), row["in"])
    number = sum(first.values())
    others = {**quiet[0], **dict.fromkeys(FIGURES, 0), "in": number, "out": number, "lost_by": {}}
    name = f"{plural(len(first), 'other')} of cFS itself"
    return [*rest, {**others, "msg_id": None, "link": None, "instance": None, "name": name, "hop": "all"}]


def _with_ends(result: Diagnosis, rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows of a table, with the uncounted hops in front of and behind each command's rows."""
    before: dict[int, dict[str, Any]] = {}
    behind: dict[int, dict[str, Any]] = {}
    for chain in result.chains:
        key = ("ci", f"0x{chain.msg_id:04x}", chain.instance)
        own = [at for at, row in enumerate(rows) if (row["link"], row["msg_id"], row["instance"]) == key]
        for ends, hop, at in ((before, chain.hops[0], own[0]), (behind, chain.hops[-1], own[-1])):
            if not hop.observed and hop.hop != PEER_TO_ROBOT:
                ends[at] = {**rows[at], **dict.fromkeys(FIGURES), **hop.as_json(), "lost_by": {}}
                ends[at]["not_counted"] = hop.counted
    return [
        item
        for at, row in enumerate(rows)
        for item in (before.get(at), row, behind.get(at))
        if item is not None
    ]


def causes(row: Mapping[str, Any]) -> str:
    """Return the causes of a row's losses: ``92 over a message limit``; else where they would be counted."""
    if row.get("lost", 0) is None:
        return str(row["not_counted"])
    return ", ".join(f"{number:,} {cause_text(cause)}" for cause, number in row["lost_by"].items())


def figure_text(value: int | None) -> str:
    """Return a figure as text; empty if it was not counted."""
    return "" if value is None else words.count(value)


def _figure(name: str) -> Any:
    style = Level.ERROR.style if name in {"lost", "unaccounted"} else ""

    def cell(row: Mapping[str, Any]) -> Text:
        text = figure_text(row.get(name)) if row.get(name) or name in _ALWAYS else ""
        return Text(text, style if row.get(name) else palette.DIM if name == "lost" else "")

    return cell


def balance_table(result: Diagnosis, width: int) -> RenderableType:
    """Return the balance as a table, without columns that are empty in every row."""
    last = "Lost by", causes
    return _table(shown_rows(result), FIGURES, {"lost"}, last, width, lambda row: row["msg_id"])


def chain_table(chains: Sequence[Chain], width: int) -> RenderableType:
    """Return the ways of the commands, one row for each hop."""
    rows = [
        {**hop.as_json(), "msg_id": f"0x{item.msg_id:04x}", "topic": item.topic, "name": item.instance}
        for item in chains
        for hop in item.hops
    ]
    figures = {"in": "In", "entered": "Entered", **FIGURES}
    last = "Counted", itemgetter("counted")
    return _table(rows, figures, _ALWAYS, last, width, itemgetter("msg_id", "name"))


def _table(
    rows: Sequence[dict[str, Any]],
    figures: Mapping[str, str],
    always: Collection[str],
    last: tuple[str, Callable[[Any], Any]],
    width: int,
    apart: Callable[[Any], Any],
) -> RenderableType:
    """Return a table of hops.

    Args:
        figures: name of each figure to its column title.
        always: figures with a column even if it is empty in every row.
        last: title of the last column, and the function that gives its text.
        apart: argument of ``build``.
    """
    whose = Column("cFS", lambda row: plain((row.get("instance") or "").removeprefix("cFS ")), justify="left")
    columns = [
        Column("MsgId", lambda row: msg_id_text(row) if row["msg_id"] else Text(""), justify="left"),
        Column("Topic", route_text, justify="left", elastic=True),
        *[whose] * (len({row["instance"] for row in rows if row.get("instance")}) > 1),
        Column("Hop", lambda row: plain(row["hop"]), justify="left"),
        *(
            Column(head, _figure(name), rank=0 if name in _ALWAYS else 1)
            for name, head in figures.items()
            if name in always or any(row.get(name) for row in rows)
        ),
        Column(last[0], lambda row: plain(last[1](row)), rank=2, justify="left"),
    ]
    return build(columns, rows, width, apart=apart)


_MOST_LINES: Final = 1000
"""Lines on a terminal; CSV and JSON have all."""
_SAME: Final = attrgetter("number", "time_ns", "until_ns", "msg_id", "link", "topic", "what", "one_of")
"""The common values of messages that share a line; a message that is a packet has its own."""


def missing_table(missing: Sequence[Missing], start_ns: int, width: int) -> RenderableType:
    """Return the table.

    Args:
        start_ns: time of the first datagram, zero of the times, ns since 1970.
    """
    lines = [list(alike) for _, alike in groupby(missing, lambda item: (_SAME(item), item.first is None))]
    columns = (
        Column("When", lambda row: plain(f"{(row[0].time_ns - start_ns) / 1e9:.3f} s")),
        Column("Packet", lambda row: plain("" if row[0].number is None else words.count(row[0].number))),
        Column("MsgId", lambda row: plain(row[0].as_json()["msg_id"] or ""), justify="left"),
        Column("Topic", lambda row: plain(row[0].topic or ""), justify="left", elastic=True),
        Column("Count", lambda row: plain(words.count(sum(item.count for item in row)))),
        Column("What", lambda row: plain(_message_text(row)), justify="left"),
        Column(
            "Values",
            lambda row: plain(value_text(row[0].message) if row[0].message else ""),
            justify="left",
            rank=1,
        ),
    )
    parts: list[RenderableType] = [build(columns, lines[:_MOST_LINES], width)]
    if rest := sum(item.count for alike in lines[_MOST_LINES:] for item in alike):
        parts.append(Text(f"and {rest:,} more: --list-lost csv", palette.DIM))
    parts.append(Text(f"{plural(sum(item.count for item in missing), 'message')} lost."))
    return Group(*parts)


def _message_text(alike: Sequence[Missing]) -> str:
    first, last = alike[0], alike[-1]
    if first.one_of is not None:
        return f"{first.what}; which of {first.one_of:,} is not known"
    if first.first is None or last.first is None:
        return first.what if first.number is not None else f"{first.what}; which is not known"
    counts = f"count {first.first}" if last is first else f"counts {first.first} to {last.first}"
    return f"{first.what}, {counts}"


_STYLES: Final = {
    Severity.ERROR: Level.ERROR,
    Severity.WARNING: Level.WARNING,
    Severity.SECURITY: Level.WARNING,
    Severity.NOTE: Level.NOTE,
}
_SCREEN: Final = 23
"""Lines of the first screen: with the shell's prompt below, the first line stays visible."""
_WIDEST: Final = 100
_FULL: Final = 3
"""Problems that are shown in full."""
_COUNT: Final = 7
"""Columns of the figure in front of a problem."""
_MOST_SPANS: Final = 24
_MOMENT_S: Final = 0.1
"""What is no longer is a moment, without an end and a rate."""
_ALIKE: Final = 4
"""Least number of verdicts of one rule that are shown as one entry, with one line each."""
_MANY_ERRORS: Final = 12
"""The same number for errors, whose evidence matters more."""
_grid = partial(Table, box=None, padding=(0, 2, 0, 0), pad_edge=False)
_text_column = partial(TableColumn, no_wrap=True)
_number_column = partial(TableColumn, no_wrap=True, justify="right")
_STATES: Final = {"connected": "green", "silent": "yellow", "timed_out": "bold red", "disconnected": "yellow"}


def screen(result: Diagnosis, width: int, args: str = "", lines: int = _SCREEN) -> RenderableType:
    """Return the first screen of a diagnosis.

    Args:
        width: columns.
        args: arguments that examine the same input again; empty if this is impossible.
        lines: most lines, if this is possible with fewer than three problems.
    """
    summary, width = summarize(result), min(width, _WIDEST)
    head = _wrapped(plain(summary.headline, f"{_style(result)} {palette.STRONG}".strip()), width)
    notes = plural(summary.notes, "note") + "." if summary.notes else ""
    tail = [
        plain(item)
        for item in (" ".join(filter(None, (summary.fine, notes))), *_selection_notes(result))
        if item
    ]
    more = f"More: edoras doctor -v {args}"
    if len(f"{more} | edoras report {args}") <= width:
        more += f" | edoras report {args}"
    for full in range(_FULL, 0, -1):
        body = [line for item in _shared(summary.problems[:full]) for line in _problem(*item, width, args)]
        rest = summary.rest(full)
        below = [line for item in ([plain(rest)] if rest else []) + tail for line in _wrapped(item, width)]
        whole = [*head, *body, *below, *[Text(more, palette.DIM)] * bool(args)]
        if sum(max(1, -(-line.cell_len // width)) for line in whole) <= lines:  # a long command is cut in two
            break
    return Group(*whole)


def _shared(problems: Sequence[Problem]) -> Iterator[tuple[Problem, bool]]:
    """Yield problems, and whether to show their remedy: the last of several with the same remedy does."""
    for place, item in enumerate(problems):
        yield item, bool(item.remedy) and item.remedy not in {other.remedy for other in problems[place + 1 :]}


def _problem(item: Problem, remedied: bool, width: int, args: str) -> list[Text]:
    """Return the lines of a problem: its number in front, then the text, then the remedy.

    Args:
        remedied: whether to show the remedy.
        args: argument of ``screen``.
    """
    grade = _STYLES[item.severity]
    start = words.count(item.lost) if item.lost else grade.mark
    lines = _hanging(plain(f"{start:>{_COUNT}}", grade.style), item.text, width)
    if remedied:
        first, *commands = re.split(r"\s+(?=edoras [a-z])", item.remedy)
        lines += _hanging(Text("  do", palette.GOOD), first.rstrip(), width)
        if args:
            commands += [f"edoras doctor {option} {args}" for option in re.findall(r"--set port=\S+", first)]
        for line in commands:
            lines.append(Text(clean(f"{'':{_COUNT + 2}}{line.rstrip('; ')}"), palette.STRONG))
        if item.promise:
            lines += _hanging(Text("  left", palette.GOOD), item.promise, width)
    return lines


def _hanging(start: Text, text: str, width: int) -> list[Text]:
    """Return a text behind its label; further lines are indented below it."""
    lines = wrap(clean(text), width - _COUNT - 2)
    first = Text.assemble(start, " " * (_COUNT + 2 - start.cell_len), lines[0])
    return [first, *(Text(f"{'':{_COUNT + 2}}{line}") for line in lines[1:])]


def _wrapped(text: Text, width: int) -> list[Text]:
    return [Text(line, text.style) for line in wrap(text.plain, width)]


def diagnosis(result: Diagnosis, name: str, width: int) -> RenderableType:
    """Return the whole view: the first screen, then verdicts with their evidence, then tables."""
    parts: list[RenderableType] = [_head(result, name), *(plain(line) for line in limits(result)), Text()]
    parts += [screen(result, width), Text()]
    for several in alike(group_verdicts(result.verdicts)):
        if len(several) >= (_MANY_ERRORS if several[0][0].severity is Severity.ERROR else _ALIKE):
            parts += [_alike(result, [item for group in several for item in group]), Text()]
        else:
            parts += [part for group in several for part in (_verdict(result, group), Text())]
    if result.balance:
        parts += [balance_table(result, width), Text()]
    if result.routes:
        parts += [_routes(result.routes, width), Text()]
    if result.peers:
        parts += [_peers(result), Text()]
    if result.habits:
        parts.append(Text("Normal for these senders", palette.STRONG))
        parts += [
            Padding(Text(item.reason, palette.DIM), (0, 0, 0, 2), expand=False) for item in result.habits
        ]
        parts.append(Text())
    return Group(*parts[:-1])


def _head(result: Diagnosis, name: str) -> Text:
    line = Text.assemble(plain(name, palette.STRONG), f"  {plural(result.datagrams, 'datagram')}")
    if result.datagrams:
        seconds = (result.end_ns - result.start_ns) / 1e9
        line.append(f" over {words.duration(seconds)}, from {words.utc(result.start_ns, digits=3)} UTC")
    return line


def limits(result: Diagnosis) -> list[str]:
    """Return notes on datagrams outside the chosen time, and on results that are not shown, one line each."""
    lines = [item.advice for item in result.unnamed]
    if other := result.left_out - result.capture.cut - sum(item.datagrams for item in result.unnamed):
        lines.append(f"{plural(other, 'datagram')} skipped: robot states, or of no known link")
    return [*lines, *_selection_notes(result)]


def _selection_notes(result: Diagnosis) -> list[str]:
    """Return notes on parts of the capture that were not chosen, so not examined or not shown."""
    lines = []
    if result.capture.cut:
        lines.append(
            f"{plural(result.capture.cut, 'datagram')} outside the chosen time not examined; what began "
            "before it or ended after it is not followed"
        )
    if result.choice and (rest := result.not_shown):
        lines.append(
            f"Only {result.choice.text} is shown, counted from all traffic; not shown: "
            f"{plural(rest['verdicts'], 'verdict')}, {plural(rest['routes'], 'route')} "
            f"with {rest['lost']:,} lost"
        )
    return lines


def _verdict(result: Diagnosis, group: Sequence[Verdict]) -> RenderableType:
    """Return the view of one problem: its worst time span in full, all of its spans in a table."""
    worst = max(group, key=lambda item: item.lost or 0)
    title = f"{_when(result, worst)}, confidence {worst.confidence}"
    body: list[RenderableType] = [plain(told_of(group), palette.STRONG)]
    if len(group) > 1:
        lost, of = sum(item.lost or 0 for item in group), sum(item.of or 0 for item in group)
        title = f"{lost:,}{f' of {of:,}' if of else ''} lost, in {len(group)} periods"
        body.append(_spans(result, group))
    body += [Text.assemble(("· ", palette.DIM), plain(line)) for line in worst.evidence]
    return _entry(worst, title, body, [worst.remedy])


def _entry(first: Verdict, title: str, body: Sequence[RenderableType], remedies: Sequence[str]) -> Group:
    """Return an entry: rule and title, below them the body and the remedies, indented."""
    grade = _STYLES[first.severity]
    head = Text.assemble((f"{grade.mark} {first.rule}", grade.style), (f"  {title}", palette.DIM))
    changes = [Text.assemble(("→ ", "green"), plain(item)) for item in remedies if item]
    return Group(head, *(Padding(item, (0, 0, 0, 2), expand=False) for item in (*body, *changes)))


def told_of(group: Sequence[Verdict]) -> str:
    """Return the sentence of one problem: that of its worst time span, marked as one of several."""
    worst = max(group, key=lambda item: item.lost or 0)
    return worst.reason if len(group) == 1 else f"the worst: {worst.reason}"


def _alike(result: Diagnosis, several: Sequence[Verdict]) -> RenderableType:
    """Return many verdicts of one rule as one entry."""
    lost = sum(item.lost or 0 for item in several)
    table = _grid(_text_column("", style=palette.DIM), "", show_header=False)
    for item in sorted(several, key=lambda item: item.start_ns)[:_MOST_SPANS]:
        table.add_row(_when(result, item), plain(item.reason))
    body: list[RenderableType] = [table]
    if len(several) > _MOST_SPANS:
        body.append(Text(f"... {len(several) - _MOST_SPANS:,} more, in --json", palette.DIM))
    title = f"{len(several):,} times" + (f", {lost:,} lost in all" if lost else "")
    return _entry(
        several[0], title, body, list(dict.fromkeys(item.remedy for item in several if item.remedy))[:_ALIKE]
    )


def _when(result: Diagnosis, verdict: Verdict) -> str:
    start, end = ((time_ns - result.zero_ns) / 1e9 for time_ns in (verdict.start_ns, verdict.end_ns))
    return f"{start:.1f} s" if end - start < _MOMENT_S else f"{start:.1f} to {end:.1f} s"


def _spans(result: Diagnosis, group: Sequence[Verdict]) -> Table:
    figures = map(_number_column, ("lost", "of", "sent at"))
    table = _grid(_text_column("when"), *figures, _text_column("confidence"), header_style=palette.DIM)
    for item in group[:_MOST_SPANS]:
        seconds = (item.end_ns - item.start_ns) / 1e9
        rate = words.rate(item.of / seconds) if item.of and seconds > _MOMENT_S else words.NONE
        cells = (words.count(item.lost), words.count(item.of), rate, item.confidence)
        table.add_row(_when(result, item), *cells)
    if len(group) > _MOST_SPANS:
        table.add_row(f"... {len(group) - _MOST_SPANS} more")
    return table


def latency_text(value: Mapping[str, Any] | None, key: str) -> Text:
    """Return a figure of a latency, ms; empty if there is none."""
    return Text(words.milliseconds(value[key]) if value else "")


def _latency(row: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the best latency figure: across cFS, else since publication, else to the robot."""
    crossing = next((item["latency"] for item in row["crossings"] if item["latency"]), None)
    return crossing or row["delay"] or row["to_robot"]


def _from(row: Mapping[str, Any]) -> Text:
    return plain(", ".join(f"{item['from_link'].upper()} {item['from']}" for item in row["crossings"]))


def _sender(row: Mapping[str, Any]) -> Text:
    """Return the sender: the cFS if it is known, and the port, which distinguishes its senders."""
    if not row["instance"]:
        return plain(row["sender"])
    return Text(f"{row['instance'].removeprefix('cFS ')} :{row['sender'].rpartition(':')[2]}")


def clean_to(row: Mapping[str, Any]) -> str:
    """Return the rate up to which a route loses nothing, and whether it is measured or assumed."""
    return f"{words.rate(row['limit_hz'])} {row['limit_from']}" if row["limit_hz"] else "not seen"


_SENDER: Final = Column("Sent by", _sender, rank=1, justify="left")
_COLUMNS: Final = (
    Column("Link", link_text, justify="left"),
    Column("MsgId", msg_id_text, justify="left"),
    Column("Topic", route_text, justify="left", elastic=True),
    Column("Sent", lambda row: Text(words.count(row["sent"]))),
    Column("Lost", figure("lost", Level.ERROR.style)),
    Column("Rate", lambda row: Text(words.rate(row["rate_hz"] or None)), rank=1),
    Column("Clean to", lambda row: Text(clean_to(row), palette.DIM), rank=1),
    Column("Delay p50", lambda row: latency_text(_latency(row), "p50_ms"), rank=2),
    Column("p99", lambda row: latency_text(_latency(row), "p99_ms"), rank=2),
    Column("max", lambda row: latency_text(_latency(row), "max_ms"), rank=3),
    Column(
        "In rounds of", lambda row: Text(words.milliseconds(row["comb_ms"]) if row["comb_ms"] else ""), rank=3
    ),
    Column("Came in as", _from, rank=4, justify="left"),
    Column("Bytes", lambda row: Text(words.count(row["bytes_max"])), rank=5),
)


def _routes(rows: Sequence[Mapping[str, Any]], width: int) -> Table:
    several = len({(row["link"], row["msg_id"]) for row in rows}) < len(rows)
    columns = (*_COLUMNS[:3], _SENDER, *_COLUMNS[3:]) if several else _COLUMNS
    return build(columns, rows, width, apart=lambda row: "topic" if row.get("topic") else row.get("link"))


def _peers(result: Diagnosis) -> Table:
    table = _grid(_text_column("SBN peer"), _text_column("seen by"), "", header_style=palette.STRONG)
    for row in result.peers:
        line = Text()
        for change in row["states"]:
            at = (change["time_ns"] - result.zero_ns) / 1e9
            line.append(f"{at:.1f} s ", palette.DIM)
            line.append(change["state"].replace("_", " "), _STATES[change["state"]]).append("  ")
        table.add_row(row["peer"], row["observer"], line)
    return table


def _style(result: Diagnosis) -> str:
    """Return the style of the headline."""
    if result.lost or result.unaccounted or result.worst is Severity.ERROR:
        return Level.ERROR.style
    return Level.WARNING.style if not result.datagrams or result.worst >= Severity.WARNING else palette.GOOD


def _live_table(result: Diagnosis, title: str, height: int) -> RenderableType:
    """Return the table that a live diagnosis keeps current."""
    figures = map(_number_column, ("Lost", "Of", "Since"))
    table = _grid(_text_column(""), *figures, "Verdict", header_style=palette.STRONG)
    merged = [_merged(group) for group in by_key(result.verdicts, lambda item: item.key).values()]
    for item in merged[: max(3, (height - 4) // 2)]:
        grade = _STYLES[item.severity]
        since = f"{(item.start_ns - result.zero_ns) / 1e9:.0f} s"
        lost = words.count(item.lost) if item.lost is not None else ""
        of = words.count(item.of) if item.of is not None else ""
        table.add_row(Text(grade.mark, grade.style), lost, of, since, plain(item.reason))
    quiet = Text("nothing wrong so far", "green")
    total = plain(summarize(result).headline, _style(result))
    return Group(_head(result, title), table if merged else quiet, total)


class LiveVerdicts:
    """Shows verdicts as they come, and rings the terminal bell once for each new one; a context manager."""

    def __init__(self, title: str, *, quiet: bool = False) -> None:
        def table(diagnosis: Diagnosis, _now: float) -> RenderableType:
            return _live_table(diagnosis, title, self._console.height)

        self._quiet = quiet
        self._known: set[tuple[object, ...]] = set()
        self._console = error_console()
        interactive = detect_terminal(sys.stderr).interactive and not quiet
        self._live = LiveView(table, self._console) if interactive else None

    def __enter__(self) -> Self:
        if self._live:
            self._live.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.__exit__()

    def update(self, diagnosis: Diagnosis) -> None:
        """Show the diagnosis as it is now."""
        new = []
        for verdict in diagnosis.verdicts:
            if verdict.severity >= Severity.WARNING and verdict.key not in self._known:
                self._known.add(verdict.key)
                new.append(verdict)
        if self._live:
            self._live.update(diagnosis)
            if new:
                self._console.bell()
        elif not self._quiet:
            for verdict in new:
                sys.stderr.write(f"\a{verdict.severity.label}: {verdict.rule}: {verdict.reason}\n")
            sys.stderr.flush()


def _merged(group: Sequence[Verdict]) -> Verdict:
    """Return one verdict for one problem: that of its last span, with the losses of all."""
    last = max(group, key=lambda item: item.end_ns)
    lost, of = (sum(getattr(item, name) or 0 for item in group) or None for name in ("lost", "of"))
    span = min(item.start_ns for item in group), last.end_ns
    return replace(last, span=span, lost=lost, of=of) if len(group) > 1 else last


_BUDGET: Final = (
    Column("Link", link_text, justify="left"),
    Column("MsgId", msg_id_text, justify="left"),
    Column("Topic", route_text, justify="left", elastic=True),
    Column("Clean to", lambda row: Text(words.rate(row["limit_hz"] or None), palette.STRONG)),
    Column("Bytes", lambda row: Text(words.count(row["bytes"]))),
    Column("Where", lambda row: plain(row["hop"]), rank=1, justify="left"),
    Column("Why", lambda row: plain(row["reason"]), rank=2, justify="left"),
)


def budgets(routes: Sequence[Budget], width: int) -> RenderableType:
    """Return the table of the capacities of all routes."""
    rows = [item.as_json() for item in routes]
    parts: list[RenderableType] = [build(_BUDGET, rows, width, apart=lambda row: row["link"])]
    parts += [
        Text.assemble((f"{Level.WARNING.mark} ", Level.WARNING.style), plain(f"{item.route.topic}: {trap}"))
        for item in routes
        for trap in item.traps
    ]
    return Group(*parts)
