"""Overviews of many packets: their routes, the control room, drawings, and the sequence diagram.

- Routes and their rates, one line each; Enter filters for the route.
- The control room: the page of ``edoras live`` in lines, with doctor, hops, routes and events.
- Drawings below the list: graphs, the way of a packet, findings, sums; some lines lead to packets.
- The sequence diagram of a conversation: a lifeline for each party, an arrow for each run of equal packets.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain
from typing import TYPE_CHECKING, Any, ClassVar, Final, NamedTuple

from msgspec.structs import replace
from rich.segment import Segment
from rich.text import Text
from textual.binding import Binding
from textual.strip import Strip

from edoras_tools import words
from edoras_tools.addons.tui.lists.lines import Lines, strip_of
from edoras_tools.links.table import link_of_label
from edoras_tools.model import Link
from edoras_tools.render.capture.info import SPACECRAFT, departures, link_text, msg_id_text, route_text
from edoras_tools.render.plot.terminal import plot_lines
from edoras_tools.render.severity import Level, explain
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.live_table import Rates
from edoras_tools.render.terminal.table import Column, build, count_cell, figure, plain
from edoras_tools.render.terminal.text import clean, clip, clip_middle, fit, wrap

if TYPE_CHECKING:
    from rich.console import Console

    from edoras_tools.pipelines.capture.ledger import Ledger
    from edoras_tools.render.capture.sequence import SequenceMessage
    from edoras_tools.render.plot.figure import Figure

_SUMS: Final = ("packets", "bytes", "from", "to", "time", "packets/s", "bytes/s", "bytes, mean")
_AROUND: Final = 6
"""Lines of a graph besides its plot: heading, legend, axis."""


class DrawnRow(NamedTuple):
    """A line of a drawing, and the filter for its packets; empty if it has none."""

    text: Text
    filter: str = ""


class Drawing(Lines):
    """A drawing that fills its pane; a line with a filter can be chosen.

    Attributes:
        empty: text that is shown while there is no drawing.
    """

    def __init__(self, name: str) -> None:
        super().__init__(id=name)
        self.empty = "no packet"
        self._draw: Callable[[int], Sequence[Text | DrawnRow]] | None = None
        self._rows: list[DrawnRow] = []

    def show(self, draw: Callable[[int], Sequence[Text | DrawnRow]] | None) -> None:
        """Show a drawing, which is made for a width; the cursor stays on a line with the same filter."""
        self._draw = draw
        self._lay_out()

    @property
    def filter(self) -> str:
        """The filter of the line under the cursor."""
        return self._rows[self.cursor].filter if self.cursor < len(self._rows) else ""

    def rows(self) -> int:
        """Return the number of lines."""
        return len(self._rows)

    def draw(self, row: int, width: int) -> Strip:
        """Return a line."""
        return strip_of(self._rows[row].text, self.app.console).crop(0, width)

    def row_style(self, row: int) -> str:
        """Return the cursor's style for the lines of the chosen filter; no style if nothing can be chosen."""
        current = self.filter if row < len(self._rows) else ""
        same = row == self.cursor or (current and self._rows[row].filter == current)
        return "lines--cursor" if same and any(item.filter for item in self._rows) else ""

    def watch_cursor(self, before: int, after: int) -> None:
        """Redraw, because the chosen filter may have several lines."""
        self.refresh()
        super().watch_cursor(before, after)

    def on_resize(self) -> None:
        """Draw it in another size."""
        self._lay_out()

    def _lay_out(self) -> None:
        current = self.filter
        drawn = self._draw(self.room) if self._draw else [Text(f"  {self.empty}", palette.DIM)]
        self._rows = [item if isinstance(item, DrawnRow) else DrawnRow(item) for item in drawn]
        if current and self.filter != current:
            places = (place for place, row in enumerate(self._rows) if row.filter == current)
            self.cursor = next(places, self.cursor)
        self.recount()


class RateGraph(Drawing):
    """A graph over time, as high as its pane."""

    _figure: Figure | None = None

    def plot(self, figure: Figure | None) -> None:
        """Show a graph."""
        self._figure = figure
        self.show(self._plotted if figure else None)

    def _plotted(self, width: int) -> list[Text]:
        assert self._figure is not None
        return plot_lines(self._figure, width, colour=True, rows=max(3, self.page - _AROUND), most=width)


def hanging(mark: Text, text: str, width: int, filter_text: str = "", style: str = "") -> Iterator[DrawnRow]:
    """Yield a text behind a mark as lines of at most ``width`` cells; further lines are indented."""
    room = max(8, width - mark.cell_len)
    for place, line in enumerate(wrap(text, room)):
        before = Text(" " * mark.cell_len) if place else mark
        yield DrawnRow(Text.assemble(before, (line, style)), filter_text)


def finding_rows(counts: Mapping[str, int], width: int) -> list[DrawnRow]:
    """Return the lines of findings, the most severe first: number of packets with each, and its meaning.

    Args:
        counts: label to number of packets.
    """
    rows: list[DrawnRow] = []
    for label, count in sorted(counts.items(), key=lambda item: (-explain(item[0]).severity, -item[1])):
        entry = explain(label)
        mark = Text.assemble((f" {entry.severity.mark} {count:>7,}  ", entry.severity.style), f"{label:<20} ")
        rows += hanging(mark, entry.meaning, width - 1, f"findings == {label}", palette.DIM)
    return rows or [DrawnRow(Text(" no packet of the list has a finding", palette.DIM))]


def sum_rows(every: Ledger, listed: Ledger, facts: Sequence[str]) -> list[DrawnRow]:
    """Return the lines of sums, for all packets and for those of the list.

    Args:
        facts: facts about the source, one line each.
    """
    rows = [DrawnRow(Text(f" {fact}")) for fact in facts]
    rows.append(DrawnRow(Text(f" {'':<14}{'all':>26}  {'in the list':>26}", palette.STRONG)))
    for name, left, right in zip(_SUMS, _sum_texts(every), _sum_texts(listed), strict=True):
        rows.append(DrawnRow(Text.assemble((f" {name:<14}", palette.DIM), f"{left:>26}  {right:>26}")))
    counts, some = (Counter[Link](), Counter[Link]())
    for ledger, by_link in ((every, counts), (listed, some)):
        for account in ledger.accounts.values():
            by_link[account.link] += account.count
    for link, count in counts.items():
        text = Text.assemble((f" {link.name:<14}", link.colour), f"{count:>26,}  {some[link]:>26,}")
        rows.append(DrawnRow(text, f"link == {link.label}"))
    return rows


def _sum_texts(ledger: Ledger) -> list[str]:
    """Return the texts of ``_SUMS``."""
    if not (count := ledger.datagrams):
        return ["0", *[words.NONE] * (len(_SUMS) - 1)]
    seconds, size = (
        (ledger.end_ns - ledger.start_ns) / 1e9,
        sum(item.bytes for item in ledger.accounts.values()),
    )
    rates = [f"{value / seconds:,.1f}" if seconds else words.NONE for value in (count, size)]
    times = [words.utc(item, digits=3) for item in (ledger.start_ns, ledger.end_ns)]
    return [f"{count:,}", f"{size:,}", *times, f"{seconds:,.3f} s", *rates, f"{size / count:,.1f}"]


_TIME: Final = 11
_WIDEST: Final = 22
_NARROWEST: Final = 8
"""Usual least distance of two lifelines, in cells."""
_TOLD: Final = 54
"""Cells for a whole label."""
_NAMED: Final = 18
"""Cells for the name in a label; if there are fewer, the distance of the lifelines shrinks further."""
_CLOSEST: Final = 6
"""Least distance of two lifelines, in cells."""


class SequenceView(Lines):
    """The runs of a conversation; choosing one goes to its first packet.

    Attributes:
        empty: text to show when there is no conversation.
    """

    def __init__(self) -> None:
        super().__init__(id="sequence")
        self._messages: Sequence[SequenceMessage] = ()
        self._parties: list[str] = []
        self.empty = ""

    def show(self, messages: Sequence[SequenceMessage]) -> None:
        """Show a conversation."""
        self._messages = messages
        names = chain.from_iterable((item.source, item.destination) for item in messages)
        self._parties = list(dict.fromkeys(names))
        self.recount()
        self.refresh_header()

    @property
    def first_ns(self) -> int:
        """Start of the run under the cursor, ns since the capture's first packet."""
        return self._messages[self.cursor].first_ns

    def on_resize(self) -> None:
        """Lay out the lifelines for another width."""
        self.refresh_header()

    def header(self) -> Text:
        """Return the parties, each above its lifeline."""
        if not self._messages:
            return Text(f"  {self.empty}", palette.DIM)
        step = self._step
        line = Text(" " * _TIME)
        for name in self._parties:
            title = clean(name)
            title = title if len(title) < step else clip_middle(title.removeprefix("SBN "), step - 1)
            line.append(f"{title:^{step}}", palette.STRONG)
        return line

    def rows(self) -> int:
        """Return the number of runs."""
        return len(self._messages)

    def draw(self, row: int, width: int) -> Strip:
        """Return a run: time, arrow from sender to receiver, label."""
        item = self._messages[row]
        line = Text.assemble((fit(f"{item.first_ns / 1e9:>{_TIME - 2}.3f}", _TIME), palette.DIM))
        line.append_text(self._arrow(item))
        line.append_text(_words(item, width - line.cell_len))
        return strip_of(line, self.app.console)

    @property
    def _step(self) -> int:
        count, room = max(1, len(self._parties)), self.room - _TIME
        narrowest = max(_CLOSEST, min(_NARROWEST, (room - _NAMED) // count))
        return max(narrowest, min(_WIDEST, (room - _TOLD) // count))

    def _arrow(self, item: SequenceMessage) -> Text:
        step, count = self._step, len(self._parties)
        cells = ["│" if place % step == step // 2 else " " for place in range(step * count)]
        source, target = (
            self._parties.index(name) * step + step // 2 for name in (item.source, item.destination)
        )
        low, high = min(source, target), max(source, target)
        arrow = "─" * (high - low - 1)
        if source == target:
            cells[source] = "↻"
        else:
            cells[low : high + 1] = ["●", *arrow, "▶"] if source < target else ["◀", *arrow, "●"]
        line = Text.assemble(("".join(cells), palette.DIM))
        line.stylize(_style(item), low, high + 1)
        return line


def _style(item: SequenceMessage) -> str:
    return f"not dim {_severity(item).style if item.findings and _severity(item) > Level.NOTE else 'cyan'}"


def _severity(item: SequenceMessage) -> Level:
    return max((explain(label).severity for label in item.findings), default=Level.NOTE)


def _words(item: SequenceMessage, room: int) -> Text:
    """Return the text of an arrow: label, count, period, end, findings."""
    often = f"  x{item.count:,}" if item.count > 1 else ""
    period = f" every {words.milliseconds(item.period_ns / 1e6)}" if item.period_ns >= 1e6 else ""
    until = f" until {item.last_ns / 1e9:.3f}" if item.count > 1 else ""
    wrong = [explain(label) for label in item.findings]
    badge = " ".join(
        f"{finding.severity.mark} {finding.short}" for finding in wrong if finding.severity > Level.NOTE
    )
    line = Text("  ")
    if badge:
        line.append(f"{clip(badge, max(4, room // 2))}  ", _severity(item).style)
    line.append(clean(item.label), palette.STRONG)
    line.append(often).append(period + until, palette.DIM)
    line.truncate(max(1, room), overflow="ellipsis")
    return line


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
            (f" {words.utc(item['time_ns'])[11:19]} ", palette.DIM),
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
        text, style = "at the end of the file", palette.DIM
    elif silent is None:
        text, style = "no traffic yet", Level.WARNING.style
    elif silent >= _SILENT_S:
        text, style = f"silent for {_seconds(silent)}", f"bold {Level.WARNING.style}"
    else:
        text, style = "● live", f"bold {palette.GOOD}"
    drops = state["kernel_drops"]
    lost = f", {drops:,} lost by this capture" if drops else ""
    sums = f"{_rate(state['rate_hz'])} datagrams/s, {words.size(state['bytes_per_s'])}/s, "
    return Text.assemble(
        " ", (text, style), "  ", (f"{sums}{state['datagrams']:,} in all{lost}", palette.DIM)
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
    since = f" since {words.utc(doctor['since_ns'])[11:19]}" if doctor["since_ns"] else ""
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
    terms = [f"link == {row['link']}"] if row["link"] else []
    terms += [f"msg_id == {row['msg_id']}"] if row["msg_id"] else []
    terms += [f"spacecraft == {row['spacecraft']}"] if row["spacecraft"] != 1 else []
    return " and ".join(terms)


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


_RATE: Final = "now_hz"
_GUTTER: Final = 2


def _rate_cell(row: Mapping[str, Any], key: str) -> Text:
    value = row.get(key) if row["count"] > 1 else None
    return Text(words.rate(value or None), "" if value else palette.DIM)


_ROUTE_COLUMNS: Final = (
    Column("Link", link_text, justify="left"),
    Column("MsgId", msg_id_text, justify="left"),
    Column("Topic", route_text, justify="left", elastic=True),
    Column("Type", lambda row: plain(row.get("type") or "", palette.DIM), rank=6, justify="left"),
    Column("CPU", lambda row: plain(row.get("processor_id") or ""), rank=3),
    Column("Count", lambda row: Text(words.count(row["count"]), palette.STRONG)),
    Column("Now", lambda row: _rate_cell(row, _RATE)),
    Column("Mean", lambda row: _rate_cell(row, "rate_hz"), rank=1),
    Column("Jitter", lambda row: Text(words.milliseconds(row["jitter_ms"] or None)), rank=4),
    Column("Gaps", figure("gaps", "yellow"), rank=2),
    Column("Bytes", lambda row: Text(words.size(row["bytes"])), rank=5),
    Column("Findings", lambda row: departures(row["findings"]), rank=1, justify="left"),
)


_SORTS: Final[Mapping[str, Callable[[Mapping[str, Any]], Any]]] = {
    "Link": lambda row: row["link"],
    "MsgId": lambda row: row["msg_id"] or "",
    "Topic": lambda row: row["topic"] or row["name"] or "",
    "Count": lambda row: -row["count"],
    "Now": lambda row: -(row.get(_RATE) or 0),
    "Mean": lambda row: -(row["rate_hz"] or 0),
    "Jitter": lambda row: -(row["jitter_ms"] or 0),
    "Gaps": lambda row: -row["gaps"],
    "Bytes": lambda row: -row["bytes"],
}
"""Sort keys by column: texts from A to Z, numbers from the largest."""


class Routes(Lines):
    """The routes of a ledger.

    Args:
        live: whether packets arrive live, so that there is a current rate.

    Attributes:
        ledger: ledger with the routes.
    """

    BINDINGS: ClassVar[list[Any]] = [
        Binding("o", "sort", "Sort", show=False),
        Binding("O", "reverse", "Other way round", show=False),
    ]

    def __init__(self, ledger: Ledger, *, live: bool) -> None:
        super().__init__(id="routes")
        self.ledger = ledger
        self._columns = [column for column in _ROUTE_COLUMNS if live or column.title != "Now"]
        self._sorted = ""
        self._reverse = False
        self._rates = Rates()
        self._counted: list[dict[str, Any]] = []
        self._rows: list[dict[str, Any]] = []
        self._lines: list[list[Segment]] = [[]]

    def count(self, ledger: Ledger) -> None:
        """Show the routes of another ledger."""
        self.ledger, self._rates = ledger, Rates()

    def update_rates(self, now: float) -> None:
        """Update counts and rates.

        Args:
            now: monotonic time, s.
        """
        self._counted = self.ledger.routes()
        rates = self._rates.add(now, {_key(row): row["count"] for row in self._counted})
        for row in self._counted:
            row[_RATE] = rates[_key(row)]
        self._sort()

    def action_sort(self) -> None:
        """Sort by the next column; after the last one, in order of the first packets."""
        titles = ["", *(column.title for column in self._columns if column.title in _SORTS)]
        self._sorted = titles[(titles.index(self._sorted) + 1) % len(titles)]
        self._reverse = False
        self._sort()

    def action_reverse(self) -> None:
        """Reverse the order."""
        self._reverse = not self._reverse
        self._sort()

    def _sort(self) -> None:
        """Sort the rows; the cursor stays on its route."""
        at = _key(self._rows[self.cursor]) if self._rows else None
        self._rows = list(self._counted)
        if self._sorted:
            self._rows.sort(key=_SORTS[self._sorted])
        if self._reverse:
            self._rows.reverse()
        self._lay_out()
        self.cursor = next((place for place, row in enumerate(self._rows) if _key(row) == at), self.cursor)

    @property
    def filter(self) -> str:
        """The filter for the route under the cursor."""
        row = self._rows[self.cursor]
        terms = [f"link == {row['link']}"]
        if row["msg_id"]:
            terms.append(f"msg_id == {row['msg_id']}")
        elif (row["name"] or "").startswith("SBN_") and "0x" not in row["name"]:
            terms.append(f"sbn.msg_type == {row['name'].removeprefix('SBN_')}")
        if row["processor_id"]:
            terms.append(f"processor_id == {row['processor_id']}")
        if "spacecraft" in row:
            terms.append(f"spacecraft == {row['spacecraft']}")
        return " and ".join(terms)

    def header(self) -> Text:
        """Return the column titles."""
        return Text.assemble(" " * _GUTTER, *((part.text, part.style or "") for part in self._lines[0]))

    def rows(self) -> int:
        """Return the number of routes."""
        return len(self._lines) - 1

    def draw(self, row: int, width: int) -> Strip:
        """Return a route's line."""
        return Strip([Segment(" " * _GUTTER), *self._lines[row + 1]]).crop(0, width)

    def on_resize(self) -> None:
        """Lay out the columns for another width."""
        self._lay_out()

    def _lay_out(self) -> None:
        width = max(20, self.room - _GUTTER)
        console = self.app.console
        mark = "▲" if self._reverse else "▼"
        columns = [
            replace(item, title=f"{item.title} {mark}", rank=0) if item.title == self._sorted else item
            for item in (*self._columns, *[SPACECRAFT] * any("spacecraft" in row for row in self._rows))
        ]
        table = build(columns, self._rows, width)
        options = console.options.update(width=width, height=None)
        self._lines = console.render_lines(table, options) or [[]]
        self.recount()
        self.refresh_header()


def _key(row: Mapping[str, Any]) -> object:
    names = "link", "spacecraft", "processor_id", "msg_id", "name", "topic"
    return tuple(row.get(name) for name in names)
