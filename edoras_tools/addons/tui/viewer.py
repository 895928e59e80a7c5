"""The three-pane view: connects source, filter, panes and keys."""

from __future__ import annotations

import asyncio
import threading
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from textual import on, work
from textual.binding import Binding
from textual.widgets import Input
from textual.worker import get_current_worker

from edoras_tools import doors
from edoras_tools.addons.tui.data import messages
from edoras_tools.addons.tui.data.feed import Feed, FilterThread
from edoras_tools.addons.tui.data.rates import rate_figure
from edoras_tools.addons.tui.data.sort import sort_order
from edoras_tools.addons.tui.lists.hex_pane import HexPane
from edoras_tools.addons.tui.lists.lines import Lines
from edoras_tools.addons.tui.navigation import Navigation, filter_of
from edoras_tools.addons.tui.panes import ViewOptions
from edoras_tools.addons.tui.prompts import FilterLine
from edoras_tools.decode.filters.rows import ColumnRows
from edoras_tools.errors import EdorasError
from edoras_tools.io.outputs import ENDING
from edoras_tools.links.table import among
from edoras_tools.pipelines.capture.conversation import Conversation
from edoras_tools.render.severity import Level

if TYPE_CHECKING:
    import subprocess
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from edoras_tools.addons.tui.data.store import Part
    from edoras_tools.decode.filters.filter import Where
    from edoras_tools.io import Source
    from edoras_tools.pipelines.workbench import Settings, Workbench


def open_in_wireshark(parts: Sequence[Part], row: int, settings: Settings) -> subprocess.Popen[bytes]:
    """Open Wireshark on packets, which ``Store.parts`` returned; see ``addons.wireshark.program``."""
    batches = (
        block.batch if isinstance(rows, range) else block.batch.take(np.asarray(rows))
        for block, _, rows in parts
    )
    process: subprocess.Popen[bytes] = doors.part("wireshark")(batches, row, settings)
    return process


__all__ = ["ViewOptions", "Viewer"]


class Viewer(Navigation):
    """``edoras sniff --tui``.

    Args:
        source: where packets come from; closed at the end.

    Attributes:
        failure: why reading ended early; empty if it did not.
    """

    BINDINGS: ClassVar[list[Any]] = [
        Binding("f", "filter", "Filter"),
        Binding("slash", "search", "Find", key_display="/"),
        Binding("m", "mark", "Mark"),
        Binding("r", "view('routes')", "Routes"),
        Binding("s", "view('sequence')", "Sequence"),
        Binding("w", "wireshark", "Wireshark"),
        Binding("question_mark", "help", "Help", key_display="?"),
        Binding("q", "quit", "Quit"),
        Binding("ctrl+c", "quit", "Quit", show=False, priority=True),
        Binding("t", "view('trace')", "Trace", show=False),
        Binding("S", "view('sequence', True)", "Sequence of all links", show=False),
        Binding("R", "view('rates')", "Rates", show=False),
        Binding("o", "sort", "Sort", show=False),
        Binding("O", "sort(True)", "Other way round", show=False),
        Binding("escape", "leave", "Back", show=False),
        Binding("M", "filter_marks", "Marked only", show=False),
        Binding("equals_sign", "filter_field", "Filter for the field", show=False),
    ]

    def __init__(self, source: Source, bench: Workbench, choice: ViewOptions) -> None:
        super().__init__(source, bench, choice)
        self.failure = ""
        self._choice = choice
        self._where: Where | None = None
        self._wanted: int | None = None
        self._drawn = 0, 0
        self._wireshark: list[subprocess.Popen[bytes]] = []
        bench.dissector.detail = True
        self._filter_thread = FilterThread(
            lambda where, block, rows: self._post(messages.FilterAnswer(where, block, rows))
        )
        self._feed = Feed(
            source,
            bench,
            replace(choice.selection, where=""),
            deliver=lambda block: self._post(messages.Arrived(block)),
            ended=lambda why, failed: self._post(messages.Ended(why, failed=failed)),
            limits=choice.limits,
            size=0 if self.live else choice.limit,
        )

    def on_mount(self) -> None:
        """Start reading."""
        self.packets.empty = "waiting for the first packet" if self.live else "reading"
        self.packets.follow = self._choice.follow
        if threading.current_thread() is threading.main_thread():
            for number in ENDING:
                with suppress(NotImplementedError):  # this event loop has no signals, as on Windows
                    asyncio.get_running_loop().add_signal_handler(number, self.exit)
        self._filter_thread.start()
        self._feed.start()
        if self._choice.selection.where:
            self.filter_line.accept(self._choice.selection.where, None)

    def on_unmount(self) -> None:
        """Stop the threads; a live source is read up to what has already arrived."""
        self._feed.stop()
        self._filter_thread.stop()
        for process in self._wireshark:
            # Wireshark may still run: with a return code, Popen does not warn about that.
            process.returncode = process.poll() or 0

    # Messages of the threads

    @on(messages.Arrived)
    def _take(self, event: messages.Arrived) -> None:
        block = event.block
        first = not self.store.packets
        self.ledger.add(block.batch, block.columns)
        dropped = self.store.append(block)
        if self.store.filtered:
            self._filter_thread.put(block)
        if first:
            self.packets.forget()
        self._more_rows(dropped)

    @on(messages.FilterAnswer)
    def _take_answer(self, event: messages.FilterAnswer) -> None:
        if event.where is not self._where:
            return
        self.store.settle(event.block, event.rows)
        self._more_rows(0)

    @on(messages.Ended)
    def _end(self, event: messages.Ended) -> None:
        self.reading = False
        self.failure = event.why if event.failed else ""
        self.packets.empty = "no packet"
        if event.why:
            self._notice(event.why, Level.WARNING)
        self._refresh_status()

    def _more_rows(self, dropped: int) -> None:
        """Update the list after rows were added."""
        packets = self.packets
        if dropped and self.store.order is not None:
            self._wanted, dropped = self._number or None, 0
        packets.arrived(dropped)
        if self._wanted is not None:
            row = self.store.find_number(self._wanted)
            if row is not None or self._all_settled:
                self._wanted = None
                packets.go(row if row is not None else -1, centre=True)
        if self._at_cursor != self._number:
            self._show_packet()
        self._refresh_status()

    # The order of the list

    def action_sort(self, reverse: bool = False) -> None:
        """Sort by the next column, after the last in the capture's order; or the other way round."""
        packets = self.packets
        if not reverse:
            names = ["", *packets.columns]
            place = names.index(packets.sorted_by) + 1 if packets.sorted_by in names else 0
            packets.sorted_by = names[place % len(names)]
        packets.reverse = reverse and not packets.reverse
        if packets.sorted_by:
            self._sort(packets.sorted_by, packets.reverse)
        else:
            self._reorder(None)

    @work(thread=True, exclusive=True, group="sort")
    def _sort(self, column: str, reverse: bool) -> None:
        worker, forgotten = get_current_worker(), self.store.forgotten
        given_up = lambda: worker.is_cancelled  # noqa: E731
        order = sort_order(self.store.parts(), column, self._decoding, reverse=reverse, given_up=given_up)
        if order is not None and not worker.is_cancelled:
            self._post(messages.Sorted(column, order, forgotten))

    @on(messages.Sorted)
    def _take_order(self, event: messages.Sorted) -> None:
        rows = self.store.forgotten, event.column
        if rows == (event.forgotten, self.packets.sorted_by) and len(event.order) <= len(self.store):
            self._reorder(event.order)

    def _reorder(self, order: NDArray[np.int64] | None) -> None:
        self._wanted = self._number or None
        self.store.order = order
        self.packets.forget()
        self._more_rows(0)

    def _sort_again(self) -> None:
        """Sort once what came after the last time is an eighth, or is all."""
        sorted_rows = 0 if self.store.order is None else len(self.store.order)
        late = len(self.store) - sorted_rows
        if self.packets.sorted_by and late > (
            sorted_rows // 8 if self.reading or not self._all_settled else 0
        ):
            self._sort(self.packets.sorted_by, self.packets.reverse)

    # The chosen packet, its fields, its bytes

    @property
    def _all_settled(self) -> bool:
        return self.store.settled == self.store.packets

    @on(Lines.Moved, "#packets")
    def _show_packet(self) -> None:
        row = self.packets.cursor
        self.decoded = None
        if row < len(self.store):
            self.decoded = self._bench.dissector.dissect(self.store.datagram(row))
        self.hex_pane.show(self.decoded)
        self.layers.show(self.decoded)
        self._refresh_title()

    @on(Lines.Chosen, "#packets")
    def _enter_packet(self) -> None:
        self.action_view("packet")
        self.layers.focus()

    @on(Lines.Moved, "#layers")
    def _show_field(self) -> None:
        row = self.layers.field
        pane = self.hex_pane
        if self.layers.has_focus:
            self._said_until = 0.0
        if row is None or row.end <= row.start:
            pane.point(0, 0)
        elif not pane.has_focus:
            pane.point(row.start, row.end)
        else:
            pane.point(row.start, row.end, pane.at - max(0, pane.shift))
        self._refresh_status()

    @on(HexPane.Pointed)
    def _show_byte(self, event: HexPane.Pointed) -> None:
        if not self.layers.choose_byte(event.at):
            self.hex_pane.point(0, 0)

    # The filter

    @on(Input.Submitted, "#filter")
    def _submit(self, event: Input.Submitted) -> None:
        if self.filter_line.accept(event.value, self.store.begin_ns):
            self.packets.focus()

    @on(FilterLine.Applied)
    def _apply(self, event: FilterLine.Applied) -> None:
        self._where = event.where
        self._wanted = self._number or None
        self.packets.empty = "no packet passes the filter"
        self.store.restart(filtered=event.where is not None)
        self._filter_thread.begin(event.where, self.store.blocks)
        self.packets.forget()
        self._more_rows(0)
        self._update_lower()

    def action_filter(self) -> None:
        """Edit the filter."""
        self.filter_line.input.focus()

    def action_filter_marks(self) -> None:
        """Filter for the marked packets."""
        if not self.packets.marks:
            self._notice("no packet is marked; m marks one")
            return
        self._filter_for(f"number in {{{', '.join(map(str, sorted(self.packets.marks)))}}}")

    def action_filter_field(self) -> None:
        """Add the selected field to the filter line; Enter applies it."""
        row = self.layers.field
        text = filter_of(self.decoded, row) if self.decoded and row else ""
        if not text:
            self._notice("select a field with a value first")
            return
        line = self.filter_line.input
        line.value = f"{line.value} and {text}" if line.value.strip() else text
        line.cursor_position = len(line.value)
        line.focus()

    def _filter_for(self, text: str) -> None:
        self.filter_line.accept(text, self.store.begin_ns)
        self.packets.focus()

    # The lower half

    def action_view(self, name: str, every: bool = False) -> None:
        """Show the packet, the routes, the conversation, the rates or the way of the message."""
        switcher = self._lower
        pane = name if name == "packet" else f"{name}-view"
        if switcher.current == pane and (name != "sequence" or every == self._every_link):
            self.action_leave()
            return
        switcher.current = pane
        self._every_link = every
        if name != "packet":
            views = {"routes": self.routes, "sequence": self.sequence, "rates": self.rates}
            views.get(name, self.trace).focus()
        self._refresh_figures()
        self._update_lower()
        self._refresh_title()
        if name == "trace":
            self.trace.empty = f"packet {self._number:,}: the whole capture is examined"
            self.trace.show(None)
            self._follow(self._number)

    def action_leave(self) -> None:
        """Go back: from one pane to all, from another view to the packet, to the list."""
        if self.screen.maximized is not None:
            self.screen.minimize()
        self._lower.current = "packet"
        self.prompt.display = False
        self.packets.focus()
        self._refresh_title()

    @on(Lines.Chosen, "#routes")
    def _choose_route(self) -> None:
        self._filter_for(self.routes.filter)

    @on(Lines.Chosen, "#sequence")
    def _choose_run(self) -> None:
        row = self.store.find_time(self.sequence.first_ns + (self.store.begin_ns or 0))
        if row is not None:
            self.packets.go(row, centre=True)

    def _update_lower(self) -> None:
        """Make what the lower half shows of the packets of the list anew."""
        if self._view == "sequence-view":
            self._build_conversation(self._every_link)
        elif self._view == "rates-view":
            self._build_rates()

    def _refresh_figures(self) -> None:
        super()._refresh_figures()
        self._sort_again()
        if self._view == "rates-view" and (self.store.packets, len(self.store)) != self._drawn:
            self._build_rates()

    @work(thread=True, exclusive=True, group="rates")
    def _build_rates(self) -> None:
        worker = get_current_worker()
        self._drawn = self.store.packets, len(self.store)
        parts, begin_ns = self.store.parts(), self.store.begin_ns or 0
        figure = rate_figure(parts, self._decoding, begin_ns, lambda: worker.is_cancelled)
        if not worker.is_cancelled:
            self._post(messages.RatesReady(figure))

    @on(messages.RatesReady)
    def _show_rates(self, event: messages.RatesReady) -> None:
        self.rates.plot(event.figure)

    @work(thread=True, exclusive=True, group="trace")
    def _follow(self, number: int) -> None:
        worker = get_current_worker()
        blocks = [(block.batch, block.columns) for block in self.store.blocks]
        zero_ns = self.store.begin_ns or 0
        try:
            ladder = doors.part("trace")(self._decoding, blocks, number, zero_ns, lambda: worker.is_cancelled)
        except EdorasError as error:
            self._post(messages.TraceReady(str(error)))
        else:
            if ladder is not None:
                self._post(messages.TraceReady(ladder))

    @on(messages.TraceReady)
    def _show_trace(self, event: messages.TraceReady) -> None:
        self.trace.empty = event.ladder if isinstance(event.ladder, str) else ""
        self.trace.show(None if isinstance(event.ladder, str) else event.ladder)

    @work(thread=True, exclusive=True, group="sequence")
    def _build_conversation(self, every: bool) -> None:
        worker = get_current_worker()
        conversation = Conversation(self._decoding)
        begin_ns = self.store.begin_ns or 0
        for block, _, selection in self.store.parts():
            if worker.is_cancelled:
                return
            rows = np.asarray(selection)
            if not every:
                rows = rows[among(block.columns.link[rows], lambda link: link.peers)]
            if len(rows):
                conversation.add(ColumnRows(self._decoding, begin_ns, block.batch, block.columns, rows))
        self._post(messages.ConversationReady(conversation.messages()))

    @on(messages.ConversationReady)
    def _show_sequence(self, event: messages.ConversationReady) -> None:
        view = self.sequence
        view.empty = "no SBN among the packets shown; S shows all links"
        view.show(event.runs)
        self._refresh_title()

    def action_wireshark(self) -> None:
        """Open what the list shows in Wireshark."""
        if not len(self.store):
            self._notice("there is no packet to open in Wireshark yet")
            return
        self._notice("opening Wireshark")
        self._open_wireshark(self.store.place(self.packets.cursor))

    @work(thread=True, exclusive=True, group="wireshark")
    def _open_wireshark(self, row: int) -> None:
        try:
            self._wireshark.append(open_in_wireshark(self.store.parts(), row, self._choice.settings))
        except EdorasError as error:
            self._post(messages.Notice(str(error), Level.WARNING))
        else:
            self._post(messages.Notice(f"Wireshark opens at packet {row + 1:,} of those shown"))
