"""The three-pane view: what comes from where, and what each key does."""

from __future__ import annotations

import asyncio
import signal
import threading
import time
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from textual import on, work
from textual.binding import Binding
from textual.widgets import Input
from textual.worker import get_current_worker

from edoras_tools.decode.where_rows import ColumnRows
from edoras_tools.errors import EdorasError
from edoras_tools.model import Link
from edoras_tools.pipelines.conversation import Conversation
from edoras_tools.render.severity import Severity
from edoras_tools.tui import news
from edoras_tools.tui.feed import Feed
from edoras_tools.tui.lines import Lines
from edoras_tools.tui.octets import Octets
from edoras_tools.tui.panes import Choice
from edoras_tools.tui.prompts import FilterLine
from edoras_tools.tui.seeking import Seeking
from edoras_tools.tui.sieve import Sieve
from edoras_tools.tui.wireshark import open_in_wireshark
from edoras_tools.tui.words import filter_of

if TYPE_CHECKING:
    import subprocess

    from edoras_tools.decode.where import Where
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.sources import Source

__all__ = ["Choice", "Viewer"]


class Viewer(Seeking):
    """``edoras sniff --tui``.

    Args:
        source: where packets come from; closed at the end.
        bench: mission, types and decoders.
        choice: what to show, and how.

    Attributes:
        failure: why reading ended early; nothing where it did not.
    """

    BINDINGS: ClassVar[list[Any]] = [
        Binding("f", "filter", "Filter"),
        Binding("slash", "search", "Find", key_display="/"),
        Binding("m", "mark", "Mark"),
        Binding("r", "view('routes')", "Routes"),
        Binding("s", "view('ladder')", "Sequence"),
        Binding("w", "wireshark", "Wireshark"),
        Binding("question_mark", "help", "Help", key_display="?"),
        Binding("q", "quit", "Quit"),
        Binding("ctrl+c", "quit", "Quit", show=False, priority=True),
        Binding("S", "view('ladder', True)", "Sequence of all links", show=False),
        Binding("escape", "leave", "Back", show=False),
        Binding("M", "filter_marks", "Marked only", show=False),
        Binding("equals_sign", "filter_field", "Filter for the field", show=False),
    ]

    def __init__(self, source: Source, bench: Workbench, choice: Choice) -> None:
        super().__init__(source, bench, choice)
        self.failure = ""
        self._bench = bench
        self._choice = choice
        self._where: Where | None = None
        self._wanted: int | None = None
        self._wireshark: list[subprocess.Popen[bytes]] = []
        bench.dissector.detail = True
        self._sieve = Sieve(lambda where, block, shown: self._tell(news.Settled(where, block, shown)))
        self._feed = Feed(
            source,
            bench,
            replace(choice.selection, where=""),
            deliver=lambda block: self._tell(news.Arrived(block)),
            ended=lambda why, failed: self._tell(news.Ended(why, failed=failed)),
            clock=time.monotonic_ns,
            count=choice.count,
            duration_ns=choice.duration_ns,
            limit=0 if self.live else choice.limit,
        )

    def on_mount(self) -> None:
        """Begin to read."""
        self.packets.empty = "waiting for the first packet" if self.live else "reading"
        self.packets.follow = self._choice.follow
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                with suppress(NotImplementedError):  # no signals in this loop, as on Windows
                    asyncio.get_running_loop().add_signal_handler(number, self.exit)
        self._sieve.start()
        self._feed.start()
        if self._choice.selection.where:
            self.filter_line.accept(self._choice.selection.where, None)

    def on_unmount(self) -> None:
        """Stop the threads; a live source gives up what has arrived."""
        self._feed.stop()
        self._sieve.stop()
        for process in self._wireshark:
            # It goes on without us.
            process.returncode = process.poll() or 0

    # What comes from the threads.

    @on(news.Arrived)
    def _take(self, event: news.Arrived) -> None:
        block = event.block
        first = not self.store.packets
        self.ledger.add(block.batch, block.columns)
        gone = self.store.append(block)
        if self.store.filtered:
            self._sieve.put(block)
        if first:
            self.packets.forget()
        self._grown(gone)

    @on(news.Settled)
    def _settle(self, event: news.Settled) -> None:
        if event.where is not self._where:
            return
        self.store.settle(event.block, event.shown)
        self._grown(0)

    @on(news.Ended)
    def _end(self, event: news.Ended) -> None:
        self.reading = False
        self.failure = event.why if event.failed else ""
        self.packets.empty = "no packet"
        if event.why:
            self._say(event.why, Severity.WARNING)
        self._refresh_status()

    def _grown(self, gone: int) -> None:
        """Show that there are more rows."""
        packets = self.packets
        packets.arrived(gone)
        if self._wanted is not None:
            row = self.store.find_number(self._wanted)
            if row is not None or self._all_settled:
                self._wanted = None
                packets.go(row if row is not None else -1, centre=True)
        if self._at_cursor != self._number:
            self._show_packet()
        self._refresh_status()

    # The chosen packet, its fields, its bytes.

    @property
    def _all_settled(self) -> bool:
        return self.store.settled == self.store.packets

    @on(Lines.Moved, "#packets")
    def _show_packet(self) -> None:
        row = self.packets.cursor
        self.decoded = None
        if row < len(self.store):
            self.decoded = self._bench.dissector.dissect(self.store.datagram(row))
        self.octets.show(self.decoded)
        self.layers.show(self.decoded)
        self._refresh_title()

    @on(Lines.Chosen, "#packets")
    def _enter_packet(self) -> None:
        self.action_view("packet")
        self.layers.focus()

    @on(Lines.Moved, "#layers")
    def _show_field(self) -> None:
        row = self.layers.field
        octets = self.octets
        if self.layers.has_focus:
            self._said_until = 0.0
        if row is None or row.end <= row.start:
            octets.point(0, 0)
        elif not octets.has_focus:
            octets.point(row.start, row.end)
        else:
            octets.point(row.start, row.end, octets.at - max(0, octets.shift))
        self._refresh_status()

    @on(Octets.Pointed)
    def _show_byte(self, event: Octets.Pointed) -> None:
        if not self.layers.choose_byte(event.at):
            self.octets.point(0, 0)

    # The filter.

    @on(Input.Submitted, "#filter")
    def _submit(self, event: Input.Submitted) -> None:
        if self.filter_line.accept(event.value, self.store.begin_ns):
            self.packets.focus()

    @on(FilterLine.Applied)
    def _apply(self, event: FilterLine.Applied) -> None:
        self._where = event.where
        self._wanted = self._number or None
        self.packets.empty = "no packet passes the filter"
        self.store.ask(filtered=event.where is not None)
        self._sieve.begin(event.where, self.store.blocks)
        self.packets.forget()
        self._grown(0)
        self._gather()

    def action_filter(self) -> None:
        """Write a filter."""
        self.filter_line.input.focus()

    def action_filter_marks(self) -> None:
        """Filter for what is marked."""
        if not self.packets.marks:
            self._say("nothing is marked; m marks a packet")
            return
        self._filter_for(f"number in {{{', '.join(map(str, sorted(self.packets.marks)))}}}")

    def action_filter_field(self) -> None:
        """Write a filter for the chosen field, to be looked at before it is applied."""
        row = self.layers.field
        text = filter_of(self.decoded, row) if self.decoded and row else ""
        if not text:
            self._say("choose a field with a value first")
            return
        line = self.filter_line.input
        line.value = f"{line.value} and {text}" if line.value.strip() else text
        line.cursor_position = len(line.value)
        line.focus()

    def _filter_for(self, text: str) -> None:
        self.filter_line.accept(text, self.store.begin_ns)
        self.packets.focus()

    # What the lower half shows.

    def action_view(self, name: str, every: bool = False) -> None:
        """Show the packet, the routes or the conversation."""
        switcher = self._lower
        wanted = name if name == "packet" else f"{name}-view"
        if switcher.current == wanted and (name != "ladder" or every == self._every_link):
            self.action_leave()
            return
        switcher.current = wanted
        self._every_link = every
        if name != "packet":
            (self.routes if name == "routes" else self.ladder).focus()
        self._refresh_figures()
        self._gather()
        self._refresh_title()

    def action_leave(self) -> None:
        """Go back: from a pane made large, from another view, to the list."""
        if self.screen.maximized is not None:
            self.screen.minimize()
        self._lower.current = "packet"
        self.prompt.display = False
        self.packets.focus()
        self._refresh_title()

    @on(Lines.Chosen, "#routes")
    def _choose_route(self) -> None:
        self._filter_for(self.routes.filter)

    @on(Lines.Chosen, "#ladder")
    def _choose_run(self) -> None:
        row = self.store.find_time(self.ladder.first_ns + (self.store.begin_ns or 0))
        if row is not None:
            self.packets.go(row, centre=True)

    def _gather(self) -> None:
        if self._view == "ladder-view":
            self._fold(self._every_link)

    @work(thread=True, exclusive=True, group="ladder")
    def _fold(self, every: bool) -> None:
        worker = get_current_worker()
        conversation = Conversation(self._decoding)
        begin_ns = self.store.begin_ns or 0
        for block, _, shown in self.store.parts():
            if worker.is_cancelled:
                return
            rows = np.asarray(shown)
            if not every:
                rows = rows[block.columns.link[rows] == Link.SBN]
            if len(rows):
                conversation.add(ColumnRows(self._decoding, begin_ns, block.batch, block.columns, rows))
        self._tell(news.Folded(conversation.messages()))

    @on(news.Folded)
    def _show_ladder(self, event: news.Folded) -> None:
        ladder = self.ladder
        ladder.empty = "no SBN among the packets shown; S takes all links"
        ladder.show(event.runs)
        self._refresh_title()

    def action_wireshark(self) -> None:
        """Open what the list shows in Wireshark."""
        if not len(self.store):
            self._say("there is no packet to open in Wireshark yet")
            return
        self._say("opening Wireshark")
        self._open_wireshark(self.packets.cursor)

    @work(thread=True, exclusive=True, group="wireshark")
    def _open_wireshark(self, row: int) -> None:
        try:
            self._wireshark.append(open_in_wireshark(self.store.parts(), row, self._choice.settings))
        except EdorasError as error:
            self._tell(news.Said(str(error), Severity.WARNING))
        else:
            self._tell(news.Said(f"Wireshark opens at packet {row + 1:,} of what is shown"))
