"""The report's page, put together."""

from __future__ import annotations

from html import escape
from importlib.resources import files
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.diagnosis.plots import plots
from edoras_tools.diagnosis.verdict import Severity, grouped
from edoras_tools.render import units
from edoras_tools.render.report import charts

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from edoras_tools.diagnosis.examination import Diagnosis
    from edoras_tools.diagnosis.plots import Plots
    from edoras_tools.diagnosis.verdict import Verdict

_MOST_CHARTS: Final = 24
_MOST_VERDICTS: Final = 200


def page(found: Diagnosis, name: str) -> str:
    """Return the HTML page.

    Args:
        found: the diagnosis.
        name: of the source.
    """
    parts = [_head(found, name), _verdicts(found)]
    if found.case is not None and found.datagrams:
        drawn = plots(found.case)
        parts += [_rates(drawn), _latency(drawn), _time(drawn), _sizes(drawn)]
    parts += [_routes(found), _habits(found)]
    style = (files("edoras_tools.render.report") / "style.css").read_text(encoding="utf-8")
    title = escape(f"edoras report: {name}")
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{title}</title>\n<style>\n{style}</style>\n</head>\n<body>\n"
        + "\n".join(part for part in parts if part)
        + "\n</body>\n</html>\n"
    )


def _head(found: Diagnosis, name: str) -> str:
    seconds = (found.end_ns - found.start_ns) / 1e9
    when = (
        f", {units.duration(seconds)} from {units.utc(found.start_ns, digits=3)} UTC"
        if found.datagrams
        else ""
    )
    if found.lost:
        end = f'<p class="end-note lost">{units.plural(found.lost, "message")} lost</p>'
    elif any(item.severity >= Severity.WARNING for item in found.verdicts):
        end = '<p class="end-note">No loss found; see the warnings.</p>'
    elif found.datagrams:
        end = '<p class="end-note fine">No loss, nothing wrong.</p>'
    else:
        end = '<p class="end-note">No traffic of CI, TO or SBN.</p>'
    line = f'<p class="dim">{units.plural(found.datagrams, "datagram")}{when}</p>'
    return f"<header><h1>{escape(name)}</h1>{line}{end}</header>"


def _verdicts(found: Diagnosis) -> str:
    groups = grouped(found.verdicts)
    if not groups:
        return ""
    rest = len(groups) - _MOST_VERDICTS
    more = f'<p class="dim">... and {rest:,} more, in doctor --json</p>' if rest > 0 else ""
    cards = "".join(_verdict(found, members) for members in groups[:_MOST_VERDICTS])
    return f"<section><h2>Verdicts</h2>{cards}{more}</section>"


def _verdict(found: Diagnosis, members: Sequence[Verdict]) -> str:
    """Return one trouble: its worst span in full, all of its spans in a table."""
    worst = max(members, key=lambda item: item.lost or 0)
    told = f"{_when(found, worst)}, confidence {worst.confidence}"
    spans = ""
    if len(members) > 1:
        lost, of = sum(item.lost or 0 for item in members), sum(item.of or 0 for item in members)
        told = f"{len(members)} spans of time, {lost:,} of {of:,} in all"
        spans = _spans(found, members)
    evidence = "".join(f"<li>{escape(line)}</li>" for line in worst.evidence)
    remedy = f'<p class="remedy">{escape(worst.remedy)}</p>' if worst.remedy else ""
    return (
        f'<article class="verdict {worst.severity.label}"><p class="what">{escape(worst.reason)}</p>'
        f'<p class="rule">{escape(worst.rule)}, {told}</p>{spans}<ul>{evidence}</ul>{remedy}</article>'
    )


def _spans(found: Diagnosis, members: Sequence[Verdict]) -> str:
    rows = "".join(
        f"<tr><td>{_when(found, item)}</td><td>{units.count(item.lost)}</td><td>{units.count(item.of)}</td>"
        f"<td>{f'{100 * (item.lost or 0) / item.of:.0f}%' if item.of else ''}</td>"
        f"<td>{item.confidence}</td></tr>"
        for item in members
    )
    head = "<tr><th>when</th><th>lost</th><th>of</th><th></th><th>confidence</th></tr>"
    return f'<div class="scroll"><table class="spans">{head}{rows}</table></div>'


def _when(found: Diagnosis, item: Verdict) -> str:
    start, end = ((time_ns - found.start_ns) / 1e9 for time_ns in (item.start_ns, item.end_ns))
    return f"{start:.1f} s" if end - start < 0.1 else f"{start:.1f} to {end:.1f} s"


def _chart(title: str, svg: str, note: str = "") -> str:
    told = f'<p class="dim">{escape(note)}</p>' if note else ""
    return f'<figure class="chart"><figcaption><h3>{escape(title)}</h3>{told}</figcaption>{svg}</figure>'


def _section(title: str, inside: Iterable[str], lead: str = "") -> str:
    drawn = list(inside)
    return f"<section><h2>{title}</h2>{lead}{''.join(drawn)}</section>" if drawn else ""


def _key(entries: Sequence[tuple[str, str]]) -> str:
    spans = "".join(f'<span style="background:var(--{colour})"></span>{text}' for colour, text in entries)
    return f'<p class="key dim">{spans}</p>'


def _rates(drawn: Plots) -> str:
    key = _key((("ci", "CI"), ("to", "TO"), ("sbn", "SBN"), ("error", "missing by sequence count")))
    rows = drawn.rates[:_MOST_CHARTS]
    return _section(
        "Rates against limits",
        (
            _chart(f"{row['label']}, {row['link'].upper()}", charts.rate(row, drawn.bin_s, drawn.seconds))
            for row in rows
        ),
        key,
    )


def _latency(drawn: Plots) -> str:
    def note(row: dict[str, Any]) -> str:
        told = row["latency"]
        figures = [units.milliseconds(told[name]) for name in ("p50_ms", "p99_ms", "max_ms")]
        return "p50 {}, p99 {}, max {}".format(*figures)

    return _section(
        "Latency through cFS",
        (
            _chart(row["label"], charts.delays(row, drawn.seconds), note(row))
            for row in drawn.delays[:_MOST_CHARTS]
        ),
    )


def _time(drawn: Plots) -> str:
    inside = [
        _chart(
            f"Lost on the software bus, {row['label']}",
            charts.counters(row, drawn.seconds),
            "from 0x803; solid: over a message limit, dashed: by full pipes",
        )
        for row in drawn.counters
        if row["limits"][-1] or row["overflows"][-1]
    ]
    if drawn.peers or drawn.events:
        inside.append(
            _chart("SBN peers and events", charts.timeline(drawn.peers, drawn.events, drawn.seconds))
        )
    key = _key(
        (
            ("good", "connected"),
            ("warning", "silent"),
            ("error", "timed out, error event"),
            ("dim", "disconnected"),
            ("note", "event"),
        )
    )
    return _section("Over time", inside, key)


def _sizes(drawn: Plots) -> str:
    rows = "".join(
        f"<tr><td>{escape(row['label'])}</td><td>{row['link'].upper()}</td>"
        f'<td><meter min="0" max="{row["room"]}" high="{row["room"] * 0.999:.1f}" '
        f'value="{row["bytes"]}">{row["bytes"]} of {row["room"]}</meter></td>'
        f"<td>{row['bytes']:,}</td><td>{row['room']:,}</td></tr>"
        for row in drawn.sizes
    )
    head = "<tr><th>route</th><th>link</th><th></th><th>largest</th><th>buffer</th></tr>"
    table = f'<div class="scroll"><table>{head}{rows}</table></div>'
    return f"<section><h2>Sizes against buffers</h2>{table}</section>" if rows else ""


def _routes(found: Diagnosis) -> str:
    def cell(value: Any) -> str:
        return f"<td>{escape(str(value))}</td>"

    head = "".join(
        f"<th>{name}</th>"
        for name in ("link", "MsgId", "topic", "sent", "seen", "lost", "gaps", "rate", "clean to", "bytes")
    )
    rows = "".join(
        "<tr>"
        + "".join(
            cell(value)
            for value in (
                row["link"].upper(),
                row["msg_id"],
                row["topic"] or row["name"] or "",
                units.count(row["sent"]),
                units.count(row["seen"]),
                units.count(row["lost"]),
                units.count(row["gaps"]) if row["counted"] else "no count",
                units.rate(row["rate_hz"] or None),
                units.rate(row["limit_hz"]),
                units.count(row["bytes_max"]),
            )
        )
        + "</tr>"
        for row in found.routes
    )
    table = f'<div class="scroll"><table><tr>{head}</tr>{rows}</table></div>'
    return f"<section><h2>Accounts</h2>{table}</section>" if rows else ""


def _habits(found: Diagnosis) -> str:
    lines = "".join(f"<li>{escape(item.reason)}</li>" for item in found.habits)
    lead = '<p class="dim">What these senders always do; nothing is wrong with this link for it.</p>'
    return f"<section><h2>Habits</h2>{lead}<ul>{lines}</ul></section>" if lines else ""
