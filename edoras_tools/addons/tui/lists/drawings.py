"""The drawings below the list: graphs, the way of a packet, findings, sums; some lines lead to packets.

Also the sequence diagram of a conversation: a lifeline for each party, an arrow for each run of equal
packets.
"""

from __future__ import annotations

from collections import Counter
from itertools import chain
from typing import TYPE_CHECKING, Final, NamedTuple

from rich.text import Text

from edoras_tools.addons.tui.lists.lines import Lines, strip_of
from edoras_tools.model import Link
from edoras_tools.render import units
from edoras_tools.render.plot.terminal import plot_lines
from edoras_tools.render.severity import Level, explain
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.text import clean, clip, clip_middle, fit, wrap

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from textual.strip import Strip

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
        return ["0", *[units.NONE] * (len(_SUMS) - 1)]
    seconds, size = (
        (ledger.end_ns - ledger.start_ns) / 1e9,
        sum(item.bytes for item in ledger.accounts.values()),
    )
    rates = [f"{value / seconds:,.1f}" if seconds else units.NONE for value in (count, size)]
    times = [units.utc(item, digits=3) for item in (ledger.start_ns, ledger.end_ns)]
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
    period = f" every {units.milliseconds(item.period_ns / 1e6)}" if item.period_ns >= 1e6 else ""
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
