"""A sequence diagram of a conversation: a lifeline for each party, an arrow for each run of equal packets."""

from __future__ import annotations

from itertools import chain
from typing import TYPE_CHECKING, Final

from rich.text import Text

from edoras_tools.addons.tui.lists.lines import Lines, strip_of
from edoras_tools.render import units
from edoras_tools.render.severity import Level, explain
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.text import clean, clip, clip_middle, fit

if TYPE_CHECKING:
    from collections.abc import Sequence

    from textual.strip import Strip

    from edoras_tools.render.capture.sequence import SequenceMessage

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
