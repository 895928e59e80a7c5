"""The doctor's result for people: verdicts with their evidence, then the figures behind them."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from edoras_tools.diagnosis.verdict import Severity, Verdict, alike, group_verdicts
from edoras_tools.render import units
from edoras_tools.render.capture.info import link_text, msg_id_text, route_text
from edoras_tools.render.doctor import balance
from edoras_tools.render.severity import Level
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.table import Column, build, figure, plain
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from edoras_tools.diagnosis.accounting.budget import Budget
    from edoras_tools.diagnosis.examination import Diagnosis
    from edoras_tools.diagnosis.matching.comparison import CaptureComparison

_STYLES: Final = {
    Severity.ERROR: Level.ERROR,
    Severity.WARNING: Level.WARNING,
    Severity.SECURITY: Level.WARNING,
    Severity.NOTE: Level.NOTE,
}
_MOST_SPANS: Final = 24
_MOST_LINES: Final = 12
_ALIKE: Final = 4
"""So many verdicts of one rule, or more, are one entry with a line each."""
_MANY_ERRORS: Final = 12
"""The same for errors, whose evidence matters more."""
_STATES: Final = {
    "connected": "green",
    "silent": "yellow",
    "timed_out": "bold red",
    "disconnected": "yellow",
}


def diagnosis(found: Diagnosis, name: str, width: int) -> RenderableType:
    """Return the whole view: verdicts first."""
    parts: list[RenderableType] = [_head(found, name), *(plain(line) for line in limits(found)), Text()]
    told = balance.balance_lines(found)
    parts += [plain(line, palette.STRONG) for line in told[:_MOST_LINES]]
    if len(told) > _MOST_LINES:
        parts.append(Text(f"... {len(told) - _MOST_LINES} more routes, in the table below", palette.DIM))
    if told:
        parts.append(Text())
    for several in alike(group_verdicts(found.verdicts)):
        if len(several) >= (_MANY_ERRORS if several[0][0].severity is Severity.ERROR else _ALIKE):
            parts += [_alike(found, [item for group in several for item in group]), Text()]
        else:
            parts += [part for group in several for part in (_verdict(found, group), Text())]
    if found.balance:
        parts += [balance.balance_table(found, width), Text()]
    if found.routes:
        parts += [_routes(found.routes, width), Text()]
    if found.peers:
        parts += [_peers(found), Text()]
    if found.habits:
        parts.append(
            Text("Habits of these senders; nothing is wrong with this link for them", palette.STRONG)
        )
        parts += [
            Padding(Text(item.reason, palette.DIM), (0, 0, 0, 2), expand=False) for item in found.habits
        ]
        parts.append(Text())
    parts.append(_conclusion(found))
    return Group(*parts)


def _head(found: Diagnosis, name: str) -> Text:
    line = Text.assemble(plain(name, palette.STRONG), f"  {plural(found.datagrams, 'datagram')}")
    if found.datagrams:
        seconds = (found.end_ns - found.start_ns) / 1e9
        line.append(f" over {units.duration(seconds)}, from {units.utc(found.start_ns, digits=3)} UTC")
    return line


def limits(found: Diagnosis) -> list[str]:
    """Return what was outside the chosen time, and what is not shown, one line each."""
    lines = [item.told for item in found.unnamed]
    if other := found.left_out - found.capture.cut - sum(item.datagrams for item in found.unnamed):
        lines.append(
            f"{plural(other, 'datagram')} not examined: states that a robot sends, or traffic of another "
            "link or of none"
        )
    if found.capture.cut:
        lines.append(
            f"{plural(found.capture.cut, 'datagram')} outside the chosen time not examined; what began "
            "before it or ended after it is not followed"
        )
    if found.choice and (rest := found.not_shown):
        lines.append(
            f"only {found.choice.text} is shown, counted from all traffic; not shown: "
            f"{plural(rest['verdicts'], 'verdict')}, {plural(rest['routes'], 'route')} "
            f"with {rest['lost']:,} lost"
        )
    return lines


def _verdict(found: Diagnosis, group: Sequence[Verdict]) -> RenderableType:
    """Return one problem: its worst time span in full, all of its spans in a table."""
    worst = max(group, key=lambda item: item.lost or 0)
    grade = _STYLES[worst.severity]
    title = Text.assemble((f"{grade.mark} {worst.rule}", grade.style))
    if len(group) == 1:
        title.append(f"  {_when(found, worst)}, confidence {worst.confidence}", palette.DIM)
    else:
        lost, of = sum(item.lost or 0 for item in group), sum(item.of or 0 for item in group)
        title.append(f"  {len(group)} spans of time, {lost:,} of {of:,} in all", palette.DIM)
    body: list[RenderableType] = [plain(told_of(group), palette.STRONG)]
    if len(group) > 1:
        body.append(_spans(found, group))
    body += [Text.assemble(("· ", palette.DIM), plain(line)) for line in worst.evidence]
    if worst.remedy:
        body.append(Text.assemble(("→ ", "green"), plain(worst.remedy)))
    return Group(title, *(Padding(item, (0, 0, 0, 2), expand=False) for item in body))


def told_of(group: Sequence[Verdict]) -> str:
    """Return the sentence of one problem: that of its worst span of time, said to be one of several."""
    worst = max(group, key=lambda item: item.lost or 0)
    return worst.reason if len(group) == 1 else f"the worst: {worst.reason}"


def _alike(found: Diagnosis, several: Sequence[Verdict]) -> RenderableType:
    """Return many verdicts of one rule as one entry."""
    first = several[0]
    grade = _STYLES[first.severity]
    lost = sum(item.lost or 0 for item in several)
    told = f"  {len(several):,} times" + (f", {lost:,} lost in all" if lost else "")
    title = Text.assemble((f"{grade.mark} {first.rule}", grade.style), (told, palette.DIM))
    table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, show_header=False)
    table.add_column(no_wrap=True, style=palette.DIM)
    for item in sorted(several, key=lambda item: item.start_ns)[:_MOST_SPANS]:
        table.add_row(_when(found, item), plain(item.reason))
    body: list[RenderableType] = [table]
    if len(several) > _MOST_SPANS:
        body.append(Text(f"... {len(several) - _MOST_SPANS:,} more, in --json", palette.DIM))
    body += [
        Text.assemble(("→ ", "green"), plain(remedy))
        for remedy in list(dict.fromkeys(item.remedy for item in several if item.remedy))[:_ALIKE]
    ]
    return Group(title, *(Padding(item, (0, 0, 0, 2), expand=False) for item in body))


def _when(found: Diagnosis, verdict: Verdict) -> str:
    start, end = ((time_ns - found.zero_ns) / 1e9 for time_ns in (verdict.start_ns, verdict.end_ns))
    return f"{start:.1f} s" if end - start < 0.1 else f"{start:.1f} to {end:.1f} s"


def _spans(found: Diagnosis, group: Sequence[Verdict]) -> Table:
    table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, header_style=palette.DIM)
    for title in ("when", "lost", "of", "", "sent at", "confidence"):
        table.add_column(title, justify="left" if title in {"when", "confidence"} else "right", no_wrap=True)
    for item in group[:_MOST_SPANS]:
        share = f"{100 * (item.lost or 0) / item.of:.0f}%" if item.of else ""
        seconds = (item.end_ns - item.start_ns) / 1e9
        rate = units.rate(item.of / seconds) if item.of and seconds > 0 else units.NONE
        cells = (units.count(item.lost), units.count(item.of), share, rate, item.confidence)
        table.add_row(_when(found, item), *cells)
    if len(group) > _MOST_SPANS:
        table.add_row(f"... {len(group) - _MOST_SPANS} more")
    return table


def _ms(value: Mapping[str, Any] | None, key: str) -> Text:
    return Text(units.milliseconds(value[key]) if value else "")


def _latency(row: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the best latency figure: across cFS where it is known, else since publication."""
    crossing = next((item["latency"] for item in row["crossings"] if item["latency"]), None)
    latency: Mapping[str, Any] | None = crossing or row["delay"]
    return latency


def _from(row: Mapping[str, Any]) -> Text:
    return plain(", ".join(f"{item['from_link'].upper()} {item['from']}" for item in row["crossings"]))


def _sender(row: Mapping[str, Any]) -> Text:
    """Return the sender: the cFS if it is known, and the port, which distinguishes its senders."""
    if not row["instance"]:
        return plain(row["sender"])
    return Text(f"{row['instance'].removeprefix('cFS ')} :{row['sender'].rpartition(':')[2]}")


def clean_to(row: Mapping[str, Any]) -> str:
    """Return to what rate a route gets through, and whether the capture or cFS's usual constants say so."""
    return f"{units.rate(row['limit_hz'])} {row['limit_from']}" if row["limit_hz"] else "not seen"


_SENDER: Final = Column("Sent by", _sender, rank=1, justify="left")
_COLUMNS: Final = (
    Column("Link", link_text, justify="left"),
    Column("MsgId", msg_id_text, justify="left"),
    Column("Topic", route_text, justify="left", elastic=True),
    Column("Sent", lambda row: Text(units.count(row["sent"]))),
    Column("Lost", figure("lost", Level.ERROR.style)),
    Column("Rate", lambda row: Text(units.rate(row["rate_hz"] or None)), rank=1),
    Column("Clean to", lambda row: Text(clean_to(row), palette.DIM), rank=1),
    Column("p50", lambda row: _ms(_latency(row), "p50_ms"), rank=2),
    Column("p99", lambda row: _ms(_latency(row), "p99_ms"), rank=2),
    Column("max", lambda row: _ms(_latency(row), "max_ms"), rank=3),
    Column(
        "In rounds of", lambda row: Text(units.milliseconds(row["comb_ms"]) if row["comb_ms"] else ""), rank=3
    ),
    Column("Came in as", _from, rank=4, justify="left"),
    Column("Bytes", lambda row: Text(units.count(row["bytes_max"])), rank=5),
)


def _routes(rows: Sequence[Mapping[str, Any]], width: int) -> Table:
    several = len({(row["link"], row["msg_id"]) for row in rows}) < len(rows)
    columns = (*_COLUMNS[:3], _SENDER, *_COLUMNS[3:]) if several else _COLUMNS
    return build(columns, rows, width, apart=lambda row: "topic" if row.get("topic") else row.get("link"))


def _peers(found: Diagnosis) -> Table:
    table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, header_style=palette.STRONG)
    table.add_column("SBN peer", no_wrap=True)
    table.add_column("seen by", no_wrap=True)
    table.add_column("")
    for row in found.peers:
        line = Text()
        for change in row["states"]:
            state = change["state"]
            at = (change["time_ns"] - found.zero_ns) / 1e9
            line.append(f"{at:.1f} s ", palette.DIM).append(state.replace("_", " "), _STATES[state]).append(
                "  "
            )
        table.add_row(row["peer"], row["observer"], line)
    return table


def _conclusion(found: Diagnosis) -> Text:
    end = conclusion(found)
    if found.lost or found.unaccounted or found.worst is Severity.ERROR:
        style = Level.ERROR.style
    elif not found.datagrams or found.worst >= Severity.WARNING:
        style = Level.WARNING.style
    else:
        style = "green"
    return Text(end, style)


def conclusion(found: Diagnosis) -> str:
    """Return the last line: what is lost, superseded and not accounted for, or that nothing is wrong.

    What looks like a link's traffic and was not examined is said first: nothing is known of it.
    """
    if found.unnamed:
        told = "; ".join(item.told for item in found.unnamed)
        return f"Not all was examined: {told}. {_of_the_rest(found)}"
    if not found.datagrams:
        where = "in the chosen time" if found.capture.cut else "here"
        return f"No cFS {where}: nothing of CI, TO or SBN was examined."
    return _found(found)


def _of_the_rest(found: Diagnosis) -> str:
    if not found.datagrams:
        return "Nothing else of CI, TO or SBN is here."
    told = _found(found)
    return f"In the rest: {told[0].lower()}{told[1:]}"


def _found(found: Diagnosis) -> str:
    rest = ""
    if found.superseded:
        rest += f", {found.superseded:,} superseded"
    if found.unaccounted:
        rest += f", {found.unaccounted:,} unaccounted for"
    if found.lost:
        return f"Lost: {plural(found.lost, 'message')}{rest}."
    if found.worst >= Severity.SECURITY:
        return f"No loss found{rest}; see the verdicts above."
    of = " with what is shown" if found.choice else ""
    return f"No loss{rest}, nothing wrong{of}." if found.superseded else f"No loss, nothing wrong{of}."


def verdict_table(found: Diagnosis, title: str, height: int) -> RenderableType:
    """Return the table that a live diagnosis keeps current."""
    table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, header_style=palette.STRONG)
    for head, side in (
        ("", "left"),
        ("Lost", "right"),
        ("Of", "right"),
        ("Since", "right"),
        ("Verdict", "left"),
    ):
        table.add_column(head, justify="right" if side == "right" else "left", no_wrap=head != "Verdict")
    merged = merge_spans(found.verdicts)
    for item in merged[: max(3, (height - 4) // 2)]:
        grade = _STYLES[item.severity]
        since = f"{(item.start_ns - found.zero_ns) / 1e9:.0f} s"
        lost = units.count(item.lost) if item.lost is not None else ""
        of = units.count(item.of) if item.of is not None else ""
        table.add_row(Text(grade.mark, grade.style), lost, of, since, plain(item.reason))
    quiet = Text("nothing wrong so far", "green")
    return Group(_head(found, title), table if merged else quiet, _conclusion(found))


def merge_spans(verdicts: Sequence[Verdict]) -> list[Verdict]:
    """Return one verdict for each problem: the last of its spans, with the losses of all."""
    found: dict[tuple[Any, ...], Verdict] = {}
    for item in verdicts:
        known = found.get(item.key)
        if known is None:
            found[item.key] = item
            continue
        last = max(known, item, key=lambda verdict: verdict.end_ns)
        lost = (known.lost or 0) + (item.lost or 0) if known.lost or item.lost else None
        of = (known.of or 0) + (item.of or 0) if known.of or item.of else None
        span = min(known.start_ns, item.start_ns), last.end_ns
        found[item.key] = replace(last, span=span, lost=lost, of=of)
    return list(found.values())


def verdict_line(verdict: Verdict) -> str:
    """Return a verdict in a line, for logs."""
    return f"{verdict.severity.label}: {verdict.rule}: {verdict.reason}"


_BUDGET: Final = (
    Column("Link", link_text, justify="left"),
    Column("MsgId", msg_id_text, justify="left"),
    Column("Topic", route_text, justify="left", elastic=True),
    Column("Clean to", lambda row: Text(units.rate(row["limit_hz"] or None), palette.STRONG)),
    Column("Bytes", lambda row: Text(units.count(row["bytes"]))),
    Column("Where", lambda row: plain(row["hop"]), rank=1, justify="left"),
    Column("Why", lambda row: plain(row["reason"]), rank=2, justify="left"),
)


def budgets(found: Sequence[Budget], width: int) -> RenderableType:
    """Return the table of what every route can carry."""
    rows = [item.as_json() for item in found]
    parts: list[RenderableType] = [build(_BUDGET, rows, width, apart=lambda row: row["link"])]
    parts += [
        Text.assemble((f"{Level.WARNING.mark} ", Level.WARNING.style), plain(f"{item.route.topic}: {trap}"))
        for item in found
        for trap in item.traps
    ]
    return Group(*parts)


_DIFF: Final = (
    Column("Link", link_text, justify="left"),
    Column("MsgId", msg_id_text, justify="left"),
    Column("Topic", route_text, justify="left", elastic=True),
    Column("Way", lambda row: Text("←" if row["direction"] == "second to first" else "→")),
    Column("First", lambda row: Text(units.count(row["first"]))),
    Column("Second", lambda row: Text(units.count(row["second"]))),
    Column("Same", lambda row: Text(units.count(row["same"]))),
    Column("Lost", figure("lost", Level.ERROR.style)),
    Column("Extra", lambda row: Text(units.count(row["extra"])), rank=1),
    Column("Doubled", lambda row: Text(units.count(row["doubled"])), rank=1),
    Column("Altered", lambda row: Text(units.count(row["altered"])), rank=1),
    Column("Late", lambda row: Text(units.count(row["late"])), rank=1),
    Column("In neither", lambda row: Text(units.count(row["neither"])), rank=1),
    Column("p50", lambda row: _ms(row["latency"], "p50_ms"), rank=2),
    Column("p99", lambda row: _ms(row["latency"], "p99_ms"), rank=2),
    Column("max", lambda row: _ms(row["latency"], "max_ms"), rank=3),
)


def comparison_table(found: CaptureComparison, width: int) -> RenderableType:
    """Return the table that compares one capture with another."""
    rows = found.as_json()["routes"]
    drift = f" at the start, and drift by {found.drift * 1e6:+.1f} ppm" if found.drift else ""
    offset = f"clocks differ by {units.milliseconds(found.offset_ns / 1e6)}{drift}; latencies are beyond that"
    lost, neither = (sum(row[name] for row in rows) for name in ("lost", "neither"))
    end = f"Lost between the two: {plural(lost, 'message')}." if lost else "Nothing lost between the two."
    style = Level.ERROR.style if lost else "green"
    if neither:
        end += f" {neither:,} are missing in both by sequence count: lost before either point."
    return Group(
        Text(offset, palette.DIM), build(_DIFF, rows, width, apart=lambda row: row["link"]), Text(end, style)
    )
