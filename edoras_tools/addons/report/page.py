"""Assembles the page of a report."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING, Any, Final

from edoras_tools import words
from edoras_tools.addons.report import charts
from edoras_tools.diagnosis.ledger import Row, summed
from edoras_tools.diagnosis.summary import summarize
from edoras_tools.diagnosis.verdict import Severity, Verdict, alike, group_verdicts
from edoras_tools.render import doctor, pages
from edoras_tools.render.doctor import clean_to, limits, told_of
from edoras_tools.wire.arrays import by_key
from edoras_tools.words import plural

if TYPE_CHECKING:
    from edoras_tools.diagnosis.examination import Diagnosis

_MOST_CHARTS: Final = 24
_MOST_PROBLEMS: Final = 3
_MOST_VERDICTS: Final = 200
_LINK: Final = re.compile(r'class="(?:band )?seen (\w+)"')
_LINKS: Final[Sequence[str]] = ("ci", "to", "sbn", "robot")
"""Links with a colour of their own."""
_ENDS: Final = {'missing"': ("error", "lost"), ' rest"': ("dim", "superseded, waiting, not seen")}
_STATES: Final = {
    "connected": ("good", "connected"),
    "silent": ("warning", "silent"),
    "timed_out": ("late", "timed out"),
    "disconnected": ("dim", "disconnected"),
    "event info": ("note", "event"),
    "event error": ("error", "error event"),
}
"""Colour and name of the elements of a timeline, by their class."""
_ALIKE: Final = 4
"""Number of verdicts of one rule from which on they share a table."""


def page(result: Diagnosis, name: str, origin: pages.Origin) -> str:
    """Return the HTML page."""
    picture = charts.sankey(result)
    sections = [pages.section("Messages", [_card(picture)], _key(picture, "bands"))]
    drawn = [
        (whose, charts.plots(part.case, part.choice))
        for whose, part in _parts(result)
        if part.case is not None and part.datagrams and (part.routes or part is result)
    ]
    for whose, item in drawn:
        picture = charts.strip(item)
        sections.append(pages.section(f"Routes over time{whose}", [_card(picture)], _key(picture)))
    sections += [pages.section("Links", [links_picture(result)]), _verdicts(result)]
    for whose, item in drawn:
        sections += [draw(item, whose) for draw in (_rates, _latency, _time, _sizes)]
    sections += [_balance(result), _routes(result), _habits(result)]
    whole = [_head(result, name), _summary(result), pages.contents(sections), *sections, pages.footer(origin)]
    return pages.document(f"edoras report: {name}", whole)


def _parts(result: Diagnosis) -> list[tuple[str, Diagnosis]]:
    """Return the diagnosis of each spacecraft, with the suffix of its titles; empty for a single one."""
    each = [(f" of {result.mission.called(number)}", part) for number, part in result.parts.items()]
    return each or [("", result)]


def _key(drawing: str, style: str = "") -> str:
    """Return the key of the colours in a drawing: its links, and lost messages."""
    links = set(_LINK.findall(drawing))
    entries = [(label, label.upper()) for label in _LINKS if label in links]
    others = sorted(links - {*_LINKS})
    entries += [("other", ", ".join(others).upper())] * bool(others)
    return pages.colour_key([*entries, *(entry for end, entry in _ENDS.items() if end in drawing)], style)


def _card(svg: str) -> str:
    return f'<figure class="chart">{svg}</figure>' if svg else ""


def _head(result: Diagnosis, name: str) -> str:
    seconds = (result.end_ns - result.start_ns) / 1e9
    when = (
        f", {words.duration(seconds)} from {words.utc(result.start_ns, digits=3)} UTC"
        if result.datagrams
        else ""
    )
    bad = result.lost or result.unaccounted or result.worst is Severity.ERROR
    style = "lost" if bad else "fine" if result.datagrams and result.worst < Severity.WARNING else ""
    summary = summarize(result)
    end = f'<p class="end-note {style}">{escape(summary.headline)}</p><ul>'
    for item in summary.problems[:_MOST_PROBLEMS]:
        count = f"<strong>{item.lost:,}</strong> " if item.lost else ""
        end += f"<li>{count}{escape(item.text)}{_remedy(item.remedy, item.promise)}</li>"
    end += f"</ul><p>{escape(f'{summary.rest(_MOST_PROBLEMS)} {summary.fine}'.strip())}</p>"
    line = "".join(
        f'<p class="dim">{escape(text)}</p>'
        for text in (f"{plural(result.datagrams, 'datagram')}{when}", *limits(result))
    )
    warned = "".join(f'<p class="warning">{escape(text)}</p>' for text in result.capture.warnings)
    return f"<header>{pages.heading(name)}{line}{warned}{end}</header>"


def _summary(result: Diagnosis) -> str:
    """Return the number of verdicts of each severity, and their lost messages."""
    rows = ""
    for severity in sorted(Severity, reverse=True):
        members = [item for item in result.verdicts if item.severity is severity]
        if members:
            lost, problems = sum(item.lost or 0 for item in members), len(group_verdicts(members))
            rows += (
                f'<tr><td class="{severity.label}">{severity.label}</td><td>{problems:,}</td>'
                f"<td>{lost:,}</td></tr>"
            )
    head = "<tr><th>severity</th><th>verdicts</th><th>lost</th></tr>"
    return f'<table class="summary">{head}{rows}</table>' if rows else ""


def _verdicts(result: Diagnosis) -> str:
    groups = group_verdicts(result.verdicts)
    if not groups:
        return ""
    cards = [
        card
        for several in alike(groups)
        for card in (
            [_many(result, several)]
            if len(several) >= _ALIKE
            else [_verdict(result, members) for members in several]
        )
    ]
    rest = len(cards) - _MOST_VERDICTS
    more = f'<p class="dim">... and {rest:,} more, in doctor --json</p>' if rest > 0 else ""
    return pages.section("Verdicts", [*cards[:_MOST_VERDICTS], more])


def _many(result: Diagnosis, several: Sequence[Sequence[Verdict]]) -> str:
    """Return many verdicts of one rule as one table, with the worst in full above it."""
    every = [item for members in several for item in members]
    rows = (
        (_when(result, item), escape(item.reason), words.count(item.lost) if item.lost is not None else "")
        for item in every[:_MOST_VERDICTS]
    )
    worst = max(several, key=lambda members: sum(item.lost or 0 for item in members))
    more = f", the first {_MOST_VERDICTS}" if len(every) > _MOST_VERDICTS else ""
    summary = f"{len(every):,} verdicts of {escape(every[0].rule)}{more}"
    table = pages.html_table(("when", "what", "lost"), rows, "alike")
    return f"{_verdict(result, worst)}<details><summary>{summary}</summary>{table}</details>"


def _verdict(result: Diagnosis, members: Sequence[Verdict]) -> str:
    """Return one problem: its worst period in full, and all of its periods in a table."""
    worst = max(members, key=lambda item: item.lost or 0)
    reason, text = told_of(members), f"{_when(result, worst)}, confidence {worst.confidence}"
    spans = ""
    if len(members) > 1:
        lost, of = sum(item.lost or 0 for item in members), sum(item.of or 0 for item in members)
        reason, text = f"{lost:,} of {of:,} lost; {reason}", f"in {len(members)} periods"
        rows = (
            (
                *(_when(result, item), words.count(item.lost), words.count(item.of)),
                *(f"{100 * (item.lost or 0) / item.of:.0f}%" if item.of else "", item.confidence),
            )
            for item in members
        )
        spans = pages.html_table(("when", "lost", "of", "", "confidence"), rows, "spans")
    evidence = "".join(f"<li>{escape(line)}</li>" for line in worst.evidence)
    return (
        f'<article class="verdict {worst.severity.label}"><p class="what">{escape(reason)}</p>'
        f'<p class="rule">{escape(worst.rule)}, {text}</p>{spans}<ul>{evidence}</ul>'
        f"{_remedy(worst.remedy)}</article>"
    )


def _remedy(text: str, promise: str = "") -> str:
    """Return the remedy, with commands marked, and the losses that would remain; empty without a remedy."""
    pieces = re.split(r"\s*(edoras [a-z][^;]*);?", escape(text, quote=False))
    marked = "".join(f"<code>{piece}</code>" if place % 2 else piece for place, piece in enumerate(pieces))
    rest = f'<span class="dim left">left {promise}</span>' if promise else ""
    return f'<p class="remedy">{marked}{rest}</p>' if text else ""


def _when(result: Diagnosis, item: Verdict) -> str:
    start, end = ((time_ns - result.zero_ns) / 1e9 for time_ns in (item.start_ns, item.end_ns))
    return f"{start:.1f} s" if end - start < 0.1 else f"{start:.1f} to {end:.1f} s"


def _rates(drawn: charts.Plots, whose: str) -> str:
    cards = "".join(
        pages.chart_card(f"{row['label']}, {row['link'].upper()}", charts.rate_chart(row, drawn))
        for row in drawn.rates[:_MOST_CHARTS]
    )
    return pages.section(f"Rates against limits{whose}", [cards], _key(cards))


def _latency(drawn: charts.Plots, whose: str) -> str:
    def note(row: dict[str, Any]) -> str:
        latency = row["latency"]
        figures = [words.milliseconds(latency[name]) for name in ("p50_ms", "p99_ms", "max_ms")]
        return "p50 {}, p99 {}, max {}".format(*figures)

    return pages.section(
        f"Latency through cFS{whose}",
        (
            pages.chart_card(row["label"], charts.delays(row, drawn), note(row))
            for row in drawn.delays[:_MOST_CHARTS]
        ),
    )


def _time(drawn: charts.Plots, whose: str) -> str:
    inside = [
        pages.chart_card(
            f"Lost on the software bus, {row['label']}",
            charts.counters(row, drawn),
            "from 0x803; solid: over a message limit, dashed: by full pipes",
        )
        for row in drawn.counters
        if row["limits"][-1] or row["overflows"][-1]
    ]
    if drawn.peers or drawn.events:
        picture = charts.timeline(drawn)
        entries = [entry for style, entry in _STATES.items() if f'class="{style}"' in picture]
        inside += [pages.colour_key(entries), pages.chart_card("SBN peers and events", picture)]
    return pages.section(f"Over time{whose}", inside)


def _sizes(drawn: charts.Plots, whose: str) -> str:
    def meter(used: int, room: int) -> str:
        ends = f'min="0" max="{room}" high="{room * 0.999:.1f}"'
        return f'<meter {ends} value="{used}">{used} of {room}</meter>'

    sizes = ((escape(row["label"]), row["link"].upper(), row["bytes"], row["room"]) for row in drawn.sizes)
    rows = ((name, link, meter(used, room), f"{used:,}", f"{room:,}") for name, link, used, room in sizes)
    table = pages.html_table(("route", "link", "", "largest", "buffer"), rows)
    return pages.section(f"Sizes against buffers{whose}", [table])


def _balance(result: Diagnosis) -> str:
    """Return the balance: a row for each route and hop, whose numbers add up."""
    lines = doctor.shown_rows(result)
    figures = [
        (name, head)
        for name, head in doctor.FIGURES.items()
        if name in {"in", "out", "lost"} or any(row[name] for row in lines)
    ]
    titles = ("MsgId", "topic", "hop", *(head for _, head in figures), "lost by")
    rows = (
        (
            *(row["msg_id"] or "", row["topic"] or row["name"] or "", row["hop"]),
            *(doctor.figure_text(row[name]) for name, _ in figures),
            doctor.causes(row),
        )
        for row in lines
    )
    both = "In and Twice are" if any(name == "duplicated" for name, _ in figures) else "In is"
    lead = f'<p class="dim">{both} the sum of the figures that follow, in every row.</p>'
    table = pages.html_table(titles, (map(escape, row) for row in rows), "balance")
    return pages.section("Balance", [table], lead)


def _routes(result: Diagnosis) -> str:
    heads = ("link", "MsgId", "topic", "sent", "seen", "lost", "gaps", "rate", "clean to", "bytes")
    rows = (
        (
            *(row["link"].upper(), row["msg_id"], row["topic"] or row["name"] or ""),
            *(words.count(row[name]) for name in ("sent", "seen", "lost")),
            words.count(row["gaps"]) if row["counted"] else "no count",
            *(words.rate(row["rate_hz"] or None), clean_to(row), words.count(row["bytes_max"])),
        )
        for row in result.routes
    )
    return pages.section("Accounts", [pages.html_table(heads, (map(escape, row) for row in rows))])


def _habits(result: Diagnosis) -> str:
    lines = "".join(f"<li>{escape(item.reason)}</li>" for item in result.habits)
    lead = '<p class="dim">What these senders always do.</p>'
    return pages.section("Habits", [f"<ul>{lines}</ul>"] if lines else [], lead)


_MOST: Final = 12
_MOST_NAMES: Final = 2
_REST: Final = tuple(
    (name, head.lower()) for name, head in doctor.FIGURES.items() if name not in {"in", "out"}
)


def links_picture(result: Diagnosis) -> str:
    """Return the picture: a line of boxes for the messages of one path; empty without messages."""
    ways = by_key(summed(result.balance), lambda row: (row.route, row.link, row.msg_id, row.instance))
    lanes: dict[tuple[Any, ...], list[list[Row]]] = {}
    for (_, link, _, _), rows in ways.items():
        own = rows[0].route not in result.topics and bool(rows[0].name)
        lanes.setdefault((own, link, tuple(row.hop for row in rows)), []).append(rows)
    first_lanes = sorted(lanes.items(), key=lambda lane: lane[0][0])[:_MOST]
    drawn = [
        f"<h3>{escape(_title(result, link, members, own=own))}</h3>{_lane(link, hops, members)}"
        for (own, link, hops), members in first_lanes
    ]
    if len(lanes) > _MOST:
        drawn.append(f'<p class="dim">and {len(lanes) - _MOST} more, in the balance</p>')
    return f'<div class="links">{"".join(drawn)}</div>' if drawn else ""


def _title(result: Diagnosis, link: str, members: list[list[Row]], *, own: bool) -> str:
    names = list(
        dict.fromkeys(
            result.topics.get(rows[0].route)
            or ("not known which" if rows[0].msg_id is None else f"0x{rows[0].msg_id:04x}")
            for rows in members
        )
    )
    text = ", ".join(names) if len(names) <= _MOST_NAMES else f"{len(names)} MsgIds"
    if own:
        text = f"{plural(len(names), 'MsgId')} of cFS itself"
    return f"{link.upper()}: {text}" if link else text


def _lane(link: str, hops: tuple[str, ...], members: list[list[Row]]) -> str:
    """Return the boxes of one path."""
    boxes = []
    for place, hop in enumerate(hops):
        sums: Counter[str] = Counter()
        for rows in members:
            row_json = rows[place].as_json(None)
            sums.update({name: row_json[name] for name in doctor.FIGURES})
        bad = " bad" if sums["lost"] or sums["unaccounted"] else ""
        figures = [(f"{sums['in']:,} in, {sums['out']:,} out", "dim")] + [
            (f"{sums[name]:,} {text}", "lost" if name in {"lost", "unaccounted"} else "dim")
            for name, text in _REST
            if sums[name]
        ]
        lines = "".join(f'<span class="{kind}">{text}</span>' for text, kind in figures)
        boxes.append(f'<li class="hop {link}{bad}"><strong>{escape(hop)}</strong>{lines}</li>')
    return f"<ol>{''.join(boxes)}</ol>"
