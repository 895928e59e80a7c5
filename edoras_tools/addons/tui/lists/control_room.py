"""The control room: the contents of the page of ``edoras live``, in lines: doctor, hops, routes, events."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from rich.text import Text

from edoras_tools.addons.tui.lists.drawings import DrawnRow, hanging
from edoras_tools.links.table import link_of_label
from edoras_tools.render import units
from edoras_tools.render.severity import Level
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.table import Column, build, count_cell, plain
from edoras_tools.render.terminal.text import clean, clip

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from rich.console import Console

_SILENT_S: Final = 2.0
"""Time without traffic from which a link is called silent, as on the page, s."""
_STILL_S: Final = 3.0
_MOST_NAMES: Final = 3
_NOTES: Final = ("superseded", "waiting", "duplicated")
_LEVELS: Final = {50: Level.ERROR, 40: Level.ERROR, 30: Level.WARNING}
"""Severity by the level of ``rcl_interfaces/msg/Log``."""
_SEVERITIES: Final = {item.label: item for item in Level}


def room_rows(state: Mapping[str, Any], width: int, console: Console, *, live: bool) -> list[DrawnRow]:
    """Return the lines for a state of a link.

    Args:
        state: state from the monitor; see ``doors.part("monitor")``.
        width: cells of a line.
        live: whether more traffic may come.
    """
    width = max(20, width - 1)
    rows = [DrawnRow(_state_line(state, live=live))]
    doctor = state["doctor"]
    if doctor is None:
        rows.append(DrawnRow(Text(" not judged yet", palette.DIM)))
    else:
        rows += _doctor_rows(doctor, state["time_ns"], width)
        if doctor["flows"]:
            rows += _heading("From hop to hop")
        for flow in doctor["flows"]:
            rows += _flow_rows(flow, width, live=live)
    rows += [*_heading("Routes"), *_route_rows(state["routes"], width, console)]
    rows += _heading("Events")
    for item in state["events"]:
        style = _LEVELS.get(item["level"], Level.NOTE)
        mark = Text.assemble(
            (f" {units.utc(item['time_ns'])[11:19]} ", palette.DIM),
            (f"{clip(clean(item['app']), 16):<16} ", "" if style is Level.NOTE else style.style),
        )
        times = f" ({item['count']:,} times)" if item["count"] > 1 else ""
        rows += hanging(mark, clean(item["text"]) + times, width, _event_filter(item["text"]))
    return rows if state["events"] else [*rows, DrawnRow(Text(" none yet", palette.DIM))]


def _heading(title: str) -> list[DrawnRow]:
    return [DrawnRow(Text("")), DrawnRow(Text(f" {title}", palette.STRONG))]


def _state_line(state: Mapping[str, Any], *, live: bool) -> Text:
    silent = state["silent_s"]
    if not live:
        words, style = "at the end of the file", palette.DIM
    elif silent is None:
        words, style = "no traffic yet", Level.WARNING.style
    elif silent >= _SILENT_S:
        words, style = f"silent for {_seconds(silent)}", f"bold {Level.WARNING.style}"
    else:
        words, style = "● live", f"bold {palette.GOOD}"
    drops = state["kernel_drops"]
    lost = f", {drops:,} lost by this capture" if drops else ""
    sums = f"{_rate(state['rate_hz'])} datagrams/s, {units.size(state['bytes_per_s'])}/s, "
    return Text.assemble(
        " ", (words, style), "  ", (f"{sums}{state['datagrams']:,} in all{lost}", palette.DIM)
    )


def _doctor_rows(doctor: Mapping[str, Any], now_ns: int, width: int) -> Iterator[DrawnRow]:
    bad = doctor["lost"] or doctor["unaccounted"]
    level = Level.ERROR if bad else _SEVERITIES.get(doctor["worst"], Level.NOTE)
    colour = palette.GOOD if level is Level.NOTE else level.style
    yield from hanging(Text(" ▌", colour), clean(doctor["headline"]), width, style="bold")
    for item in doctor["problems"]:
        severity = _SEVERITIES.get(item["severity"], Level.WARNING)
        count = f"{item['lost']:,}" if item["lost"] else severity.mark
        where = _problem_filter(item)
        yield from hanging(Text(f" ▌{count:>7}  ", severity.style), clean(item["text"]), width, where)
        if item["remedy"]:
            rest = f"; left: {item['promise']}" if item["promise"] else ""
            mark = Text.assemble((" ▌", severity.style), (" " * 7 + "→ ", palette.GOOD))
            yield from hanging(mark, clean(item["remedy"]) + rest, width, where)
    age = _seconds(max(0.0, (now_ns - doctor["until_ns"]) / 1e9))
    since = f" since {units.utc(doctor['since_ns'])[11:19]}" if doctor["since_ns"] else ""
    uncertain = f"; up to {doctor['uncertain']:,} more may be lost" if doctor["uncertain"] else ""
    text = f"{doctor['fine']} {doctor['datagrams']:,} datagrams judged{since}, {age} ago{uncertain}."
    yield from hanging(Text(" ▌", colour), clean(text.strip()), width, style=palette.DIM)


def _problem_filter(problem: Mapping[str, Any]) -> str:
    """Return the filter for the messages that a problem lost, else for those of its routes."""
    numbers = sorted({item["number"] for item in problem["messages"] if item["number"] is not None})
    if numbers:
        return f"number in {{{', '.join(map(str, numbers))}}}"
    routes = {(item["link"], item["msg_id"]) for item in problem["messages"] if item["msg_id"]}
    return " or ".join(f"(link == {link} and msg_id == {msg_id})" for link, msg_id in sorted(routes))


def _event_filter(text: str) -> str:
    """Return the filter for the events with a text, as far as a filter can express it."""
    whole = text.partition('"')[0].partition("\\")[0]
    return f'cfe_event.message contains "{whole}"' if whole.isprintable() and whole else ""


def _flow_rows(flow: Mapping[str, Any], width: int, *, live: bool) -> Iterator[DrawnRow]:
    """Yield the names of the traffic, and its hops with the messages between them; rates only if live."""
    names, colour = flow["names"], _colour(flow["link"])
    more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
    craft, where = flow["spacecraft"], f"link == {flow['link']}" * bool(flow["link"])
    whose = f"spacecraft {craft}: " if craft > 1 and not "".join(names[:1]).startswith("/sc_") else ""
    title = f"{whose}{', '.join(names[:_MOST_NAMES]) or 'traffic'}{more}"
    yield DrawnRow(Text.assemble((" ▌", colour), (clip(clean(title), width - 3), palette.DIM)), where)
    source, destination = flow["ends"]
    pieces = [Text.assemble((source, "bold")).append_text(_arrow(flow["hops"][0]["in"], None, 0, 0))]
    for place, hop in enumerate(flow["hops"]):
        notes = "".join(f" {hop[name]:,} {name}" for name in _NOTES if hop[name])
        piece = Text.assemble((clean(hop["hop"]), "bold"), (notes, palette.DIM))
        if place < len(flow["hops"]) - 1 or destination or hop["lost"] or hop["uncertain"]:
            lost = hop["lost"] + hop["unaccounted"]
            piece.append_text(_arrow(hop["out"], hop["rate_hz"] if live else None, lost, hop["uncertain"]))
        pieces.append(piece)
    pieces.append(Text(destination, "bold"))
    line = Text.assemble((" ▌ ", colour))
    for piece in filter(None, pieces):
        if line.cell_len > 3 and line.cell_len + piece.cell_len > width:
            yield DrawnRow(line, where)
            line = Text.assemble((" ▌   ", colour))
        line.append_text(piece)
    yield DrawnRow(line, where)


def _arrow(count: int, hertz: float | None, lost: int, uncertain: int) -> Text:
    """Return an arrow with the number of passed messages, their present rate, and the lost ones."""
    arrow = Text.assemble((" ─ ", palette.DIM), f"{count:,}")
    arrow.append(f" {_rate(hertz)}/s" if hertz else "", palette.DIM)
    arrow.append(f" −{lost:,}" if lost else "", Level.ERROR.style)  # noqa: RUF001  a minus
    arrow.append(f" {uncertain:,} uncertain" if uncertain else "", Level.WARNING.style)
    return arrow.append(" ─▶ ", palette.DIM)


def _route_rows(routes: list[dict[str, Any]], width: int, console: Console) -> Iterator[DrawnRow]:
    options = console.options.update(width=width - 1, height=None)
    lines = console.render_lines(build(_COLUMNS, routes, width - 1), options)
    for segments, where in zip(lines, ["", *map(_route_filter, routes)], strict=False):
        yield DrawnRow(Text.assemble(" ", *((part.text, part.style or "") for part in segments)), where)


def _route_filter(row: Mapping[str, Any]) -> str:
    words = [f"link == {row['link']}"] if row["link"] else []
    words += [f"msg_id == {row['msg_id']}"] if row["msg_id"] else []
    words += [f"spacecraft == {row['spacecraft']}"] if row["spacecraft"] != 1 else []
    return " and ".join(words)


def _topic(row: Mapping[str, Any]) -> Text:
    text = plain(row["topic"] or row["name"] or row["msg_id"] or "without a MsgId")
    if row["level"]:
        text.append(f" {row['message']}", (Level.WARNING if row["level"] == 1 else Level.ERROR).style)
    return text


def _hertz(row: Mapping[str, Any]) -> Text:
    """Return the rate, with the rate that passes on, or with the rate of publishing, if they differ."""
    now = _rate(row["rate_hz"])
    if row["passed_hz"]:
        return Text(f"{now} → {_rate(row['passed_hz'])}")
    return Text(f"{now} of {_rate(row['sent_hz'])}" if row["sent_hz"] else now)


def _age(row: Mapping[str, Any]) -> Text:
    if row["age_s"] < _STILL_S or row["rate_hz"]:
        return Text(f"{row['age_s']:.1f} s")
    silent = f"silent {_seconds(row['age_s'])}" if row["topic"] else _seconds(row["age_s"])
    return Text(silent, Level.WARNING.style if row["topic"] else palette.DIM)


def _lost(row: Mapping[str, Any]) -> Text:
    if not row["uncertain"]:
        return count_cell(row["lost"], Level.ERROR.style)
    text = f"{row['lost']:,} to {row['lost'] + row['uncertain']:,}"
    return Text(text, Level.ERROR.style if row["lost"] else Level.WARNING.style)


_COLUMNS: Final = (
    Column("Topic", _topic, justify="left", elastic=True),
    Column("Link", lambda row: plain(row["link"], _colour(row["link"])), rank=2, justify="left"),
    Column("MsgId", lambda row: plain(row["msg_id"] or ""), rank=3, justify="left"),
    Column("Hz", _hertz),
    Column("Age", _age),
    Column("Count", lambda row: Text(f"{row['count']:,}"), rank=1),
    Column("Lost", _lost),
    Column("Last value", lambda row: plain((row["value"] or "")[:40], palette.DIM), rank=4, justify="left"),
)


def _colour(link: str) -> str:
    return link_of_label(link).colour if link else ""


def _rate(hertz: float) -> str:
    return f"{hertz:,.0f}" if hertz >= 100 else f"{round(hertz, 1):g}"


def _seconds(value: float) -> str:
    return f"{int(value)} s" if value < 60 else f"{int(value // 60)} min {int(value % 60)} s"
