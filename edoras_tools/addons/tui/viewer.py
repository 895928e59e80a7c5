"""The three-pane view: connects source, filter, panes and keys."""

from __future__ import annotations

import asyncio
import queue
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np
from msgspec.structs import replace
from textual import on, work
from textual.binding import Binding
from textual.widgets import Input
from textual.worker import get_current_worker

from edoras_tools import doors, words
from edoras_tools.addons.tui.lists.lines import Lines
from edoras_tools.addons.tui.lists.overviews import Drawing, Routes, finding_rows, room_rows, sum_rows
from edoras_tools.addons.tui.lists.packet import HexPane
from edoras_tools.addons.tui.navigation import Navigation
from edoras_tools.addons.tui.panes import VIEWS, ViewOptions
from edoras_tools.addons.tui.prompts import FilterLine
from edoras_tools.addons.tui.store import PacketBlock, WatchThread, field_figure, rate_figure, sort_order
from edoras_tools.decode.filters.rows import ColumnRows
from edoras_tools.decode.filters.syntax import WhereError
from edoras_tools.errors import EdorasError
from edoras_tools.io.outputs import ENDING
from edoras_tools.links.table import among
from edoras_tools.pipelines.capture.conversation import Conversation
from edoras_tools.pipelines.capture.ledger import Ledger
from edoras_tools.pipelines.capture.record import compact
from edoras_tools.pipelines.reading import reading
from edoras_tools.render.severity import Level
from edoras_tools.render.terminal.text import clean
from edoras_tools.words import plural

if TYPE_CHECKING:
    import subprocess

    from numpy.typing import NDArray
    from rich.text import Text
    from textual.driver import Driver

    from edoras_tools.addons.tui.store import Part
    from edoras_tools.decode.filters.filter import Where
    from edoras_tools.io import Source
    from edoras_tools.pipelines.workbench import Settings, Workbench


def open_in_wireshark(parts: Sequence[Part], row: int, settings: Settings) -> subprocess.Popen[bytes]:
    """Open Wireshark on packets from ``Store.parts``; see ``addons.wireshark.program``."""
    batches = (
        block.batch if isinstance(rows, range) else block.batch.take(np.asarray(rows))
        for block, _, rows in parts
    )
    return doors.part("wireshark")(batches, row, settings)


__all__ = ["ViewOptions", "Viewer"]
_BUILT: Final = {"rates", "graph", "sequence"}
"""Views that a thread computes from the packets of the list."""


class TerminalOutput:
    """Terminal output that drops text after the terminal was closed.

    Textual's writing thread would end with an error, and the view would wait for it for ever.
    """

    def __init__(self, file: Any) -> None:
        self.isatty, self.fileno = file.isatty, file.fileno
        self._file = file

    def write(self, text: str) -> None:
        """Write the text, if the terminal accepts it."""
        with suppress(OSError):
            self._file.write(text)

    def flush(self) -> None:
        """Flush the text, if the terminal accepts it."""
        with suppress(OSError):
            self._file.flush()


def _outliving(driver: type[Driver]) -> type[Driver]:
    """Return a textual driver whose output survives the end of its terminal."""

    class Outliving(driver):  # type: ignore[valid-type,misc]
        _file: Any

        def __init__(self, *args: Any, **options: Any) -> None:
            super().__init__(*args, **options)
            self._file = TerminalOutput(self._file)

    return Outliving


class Viewer(Navigation):
    """``edoras sniff --tui``.

    Args:
        source: source of the packets; closed at the end.

    Attributes:
        failure: error that ended reading early; empty if there was none.
    """

    BINDINGS: ClassVar[list[Any]] = [
        Binding("f", "filter", "Filter"),
        Binding("slash", "search", "Find", key_display="/"),
        Binding("m", "mark", "Mark"),
        Binding("d", "view('room')", "Doctor"),
        Binding("r", "view('routes')", "Routes"),
        Binding("s", "view('sequence')", "Sequence"),
        Binding("w", "wireshark", "Wireshark"),
        Binding("question_mark", "help", "Help", key_display="?"),
        Binding("q", "quit", "Quit"),
        Binding("ctrl+c", "quit", "Quit", show=False, priority=True),
        Binding("t", "view('trace')", "Trace", show=False),
        Binding("S", "view('sequence', True)", "Sequence of all links", show=False),
        Binding("R", "view('rates')", "Rates", show=False),
        Binding("p", "graph", "Graph", show=False),
        Binding("e", "view('findings')", "Findings", show=False),
        Binding("i", "view('sums')", "Sums", show=False),
        Binding("o", "sort", "Sort", show=False),
        Binding("O", "sort(True)", "Other way round", show=False),
        Binding("escape", "leave", "Back", show=False),
    ]

    def __init__(self, source: Source, bench: Workbench, choice: ViewOptions) -> None:
        super().__init__(source, bench, choice)
        self.failure = ""
        self._choice = choice
        self._where: Where | None = None
        self._wanted: int | None = None
        self._drawn = 0, 0
        self._field = ""
        self._watch: WatchThread | None = None
        self._wireshark: list[subprocess.Popen[bytes]] = []
        bench.dissector.detail = True
        self._unfiltered: queue.SimpleQueue[tuple[Where, PacketBlock] | None] = queue.SimpleQueue()
        self._filter_thread = threading.Thread(target=self._filter, name="filter", daemon=True)
        self._feed = threading.Thread(target=self._read, name="packets", daemon=True)
        self._stopping = threading.Event()

    def get_driver_class(self) -> type[Driver]:
        """Return the terminal's driver, which also ends if the terminal was closed."""
        return _outliving(super().get_driver_class())

    def on_mount(self) -> None:
        """Start reading."""
        self.packets.empty = "waiting for the first packet" if self.live else "reading"
        self.packets.follow = self._choice.follow
        if threading.current_thread() is threading.main_thread():
            for number in ENDING:
                with suppress(NotImplementedError):  # this event loop has no signals, as on Windows
                    asyncio.get_running_loop().add_signal_handler(number, self.exit)
        self._feed.start()
        self._filter_thread.start()
        if self._choice.selection.where:
            self.filter_line.accept(self._choice.selection.where, None)

    def on_unmount(self) -> None:
        """Stop the threads; a live source is read up to what has already arrived."""
        self._stopping.set()
        self._source.stop()
        self._where = None
        self._unfiltered.put(None)
        if self._watch is not None:
            self._watch.stop()
        for process in self._wireshark:
            # Wireshark may still run: with a return code, Popen does not warn about that.
            process.returncode = process.poll() or 0

    # The thread that reads, and what the threads call

    def _read(self) -> None:
        """Read to the end of the source, or until stopped."""
        why, failed = "", True
        try:
            why = self._read_blocks()
            failed = False
        except EdorasError as error:
            why = str(error)
        except Exception as error:  # noqa: BLE001  if the thread died silently, the link would look idle
            why = f"reading stopped: {type(error).__name__}: {error}"
        finally:
            self._later(self._end, why, failed)

    def _read_blocks(self) -> str:
        """Read in blocks; return why reading ended early, if it did."""
        count = size = 0
        selection = replace(self._choice.selection, where="")  # the view filters
        with reading(self._source, self._bench, selection, self._choice.limits) as loop:
            for rows in loop:
                if self._stopping.is_set():
                    break
                if len(rows):
                    block = PacketBlock(*compact(*rows.alone()), begin_ns=rows.begin_ns)
                    count, size = count + len(block), size + block.size
                    self._later(self._take, block)
                if not self.live and size >= self._choice.limit:  # of a live link the oldest are dropped
                    return (
                        f"only the first {plural(count, 'packet')} were read: the limit is "
                        f"{words.size(size)}; select fewer with --link, --topic or --msg-id"
                    )
        return ""

    def _take(self, block: PacketBlock) -> None:
        first = not self.store.packets
        self.ledger.add(block.batch, block.columns)
        if self._watch is not None:
            self._watch.put(block)
        dropped = self.store.append(block)
        if self._where is not None:
            self._unfiltered.put((self._where, block))
        if first:
            self.packets.forget()
        self._more_rows(dropped)

    def _filter(self) -> None:
        """Run filters on blocks until stopped; not a filter that was replaced meanwhile."""
        while (task := self._unfiltered.get()) is not None:
            where, block = task
            if where is not self._where:
                continue
            try:
                rows = np.flatnonzero(where.mask(block.batch, block.columns))
            except Exception as error:  # noqa: BLE001  without a word, no packet would seem to pass
                why = f"the filter failed: {type(error).__name__}: {error}"
                self._later(self._take_failure, where, clean(why))
            else:
                self._later(self._take_answer, where, block, rows)

    def _take_answer(self, where: Where, block: PacketBlock, rows: NDArray[np.int64]) -> None:
        if where is not self._where:
            return
        if len(rows):
            self.routes.ledger.add(block.batch.take(rows), block.columns.take(rows))
        self.store.settle(block, rows)
        self._more_rows(0)

    def _take_failure(self, where: Where, why: str) -> None:
        if where is self._where:
            self.packets.empty = why
            self.packets.forget()
            self._notice(why, Level.WARNING)

    def _end(self, why: str, failed: bool) -> None:
        self.reading = False
        self.failure = why if failed else ""
        self.packets.empty = "no packet"
        if self._watch is not None:
            self._watch.put(None)
        if why:
            self._notice(why, Level.WARNING)
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
        """Sort by the next column, after the last one in the capture's order; or reverse the order."""
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
            self._later(self._take_order, column, order, forgotten)

    def _take_order(self, column: str, order: NDArray[np.int64], forgotten: int) -> None:
        same = (self.store.forgotten, self.packets.sorted_by) == (forgotten, column)
        if same and len(order) <= len(self.store):
            self._reorder(order)

    def _reorder(self, order: NDArray[np.int64] | None) -> None:
        self._wanted = self._number or None
        self.store.order = order
        self.packets.forget()
        self._more_rows(0)

    def _sort_again(self) -> None:
        """Sort again if unsorted packets exceed an eighth of the sorted ones; at the end if there are any."""
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
        listed = Ledger(self._bench.mission, structs=self._decoding.structs)
        self.routes.count(listed if event.where else self.ledger)
        self.store.restart(filtered=event.where is not None)
        if event.where is not None:
            for block in self.store.blocks:
                self._unfiltered.put((event.where, block))
        self.packets.forget()
        self._more_rows(0)
        self._update_lower()

    def action_filter(self) -> None:
        """Edit the filter."""
        self.filter_line.input.focus()

    # The lower half

    def action_view(self, name: str, every: bool = False) -> None:
        """Show the packet, or one of ``VIEWS``; again: go back."""
        if self._view == name and (name != "sequence" or every == self._every_link):
            self.action_leave()
            return
        if name == "room" and not self._begin_watch():
            return
        self._lower.current = name if name == "packet" else f"{name}-view"
        self._every_link = every
        if name in VIEWS:
            getattr(self, name).focus()
        self._refresh_figures()
        self._update_lower()
        self._refresh_title()
        if name == "trace":
            self.trace.empty = f"packet {self._number:,}: the whole capture is examined"
            self.trace.show(None)
            self._follow(self._number)

    def action_leave(self) -> None:
        """Go back: from one pane to all, from another view to the packet, to the list."""
        writing = self.filter_line.input.has_focus or self.prompt.input.has_focus
        self.filter_line.restore()
        self.prompt.display = False
        if self.zoomed:
            self._zoom("")
        elif not writing:
            self._lower.current = "packet"
        self.packets.focus()
        self._refresh_title()

    def action_graph(self) -> None:
        """Show the graph of the selected field."""
        name, _, _ = self._selected_filter().partition(" ")
        if self._view == "graph" and name in {"", self._field}:
            self.action_leave()
        elif name:
            self._field = name
            self.graph.empty = f"no number in {name} of the packets of the list"
            self.graph.plot(None)
            self._lower.current = "packet"
            self.action_view("graph")
        else:
            self._notice("select a field with a value first")

    def _begin_watch(self) -> bool:
        """Begin to judge all kept packets, unless that has begun; return whether it has."""
        source = self._source
        if self._watch is None:
            try:
                monitor = doors.part("monitor")(self._bench, source.info, source.statistics, live=self.live)
            except EdorasError as error:
                self._notice(str(error), Level.WARNING)
                return False
            self._watch = WatchThread(monitor, self.store.blocks)
            if not self.reading:
                self._watch.put(None)
            self._watch.start()
        return True

    @on(Lines.Chosen)
    def _choose_row(self, event: Lines.Chosen) -> None:
        if isinstance(event.lines, Drawing | Routes) and event.lines.filter:
            self._filter_for(event.lines.filter)

    @on(Lines.Chosen, "#sequence")
    def _choose_run(self) -> None:
        row = self.store.find_time(self.sequence.first_ns + (self.store.begin_ns or 0))
        if row is not None:
            self.packets.go(row, centre=True)

    def _update_lower(self) -> None:
        """Rebuild the view of the lower half from the packets of the list."""
        listed = self.routes.ledger
        if self._view == "room":
            assert self._watch is not None
            state, live = self._watch.state(), self.live and self.reading
            self.room.show(lambda width: room_rows(state, width, self.console, live=live))
        elif self._view == "findings":
            self.findings.show(lambda width: finding_rows(listed.findings, width))
        elif self._view == "sums":
            facts = [self._source.info.name, *self.ledger.notes]
            self.sums.show(lambda _: sum_rows(self.ledger, listed, facts))
        elif self._view in _BUILT:
            self._build(self._view, self._every_link)

    def _refresh_figures(self) -> None:
        super()._refresh_figures()
        self._sort_again()
        drawn, self._drawn = self._drawn, (self.store.packets, len(self.store))
        if self._view == "room" or (drawn != self._drawn and self._view != "sequence"):
            self._update_lower()
        for process in [item for item in self._wireshark if item.poll() is not None]:
            self._wireshark.remove(process)
            if process.returncode:
                self._notice(f"Wireshark ended with exit code {process.returncode}", Level.WARNING)

    @work(thread=True, exclusive=True, group="view")
    def _build(self, view: str, every: bool) -> None:
        """Compute a view, and show it."""
        worker, parts, begin_ns = get_current_worker(), self.store.parts(), self.store.begin_ns or 0
        given_up = lambda: worker.is_cancelled  # noqa: E731
        result: Any = None
        match view:
            case "rates":
                result = rate_figure(parts, self._decoding, begin_ns, given_up, max(20, self.size.width - 10))
            case "graph":
                try:
                    result = field_figure(parts, self._decoding, self._field, begin_ns, given_up)
                except WhereError as error:
                    self._later(self._notice, clean(error.why), Level.WARNING)
            case "sequence":
                conversation = Conversation(self._decoding)
                for block, _, selection in parts:
                    rows = np.asarray(selection)
                    if not every:
                        rows = rows[among(block.columns.link[rows], lambda link: link.peers)]
                    if len(rows) and not worker.is_cancelled:
                        conversation.add(
                            ColumnRows(self._decoding, begin_ns, block.batch, block.columns, rows)
                        )
                result = conversation.messages()
        if not worker.is_cancelled:
            self._later(self._show_result, view, result)

    def _show_result(self, view: str, result: Any) -> None:
        if view == "sequence":
            self.sequence.empty = "no SBN among the packets shown; S shows all links"
            self.sequence.show(result)
        else:
            (self.rates if view == "rates" else self.graph).plot(result)
        self._refresh_title()

    @work(thread=True, exclusive=True, group="trace")
    def _follow(self, number: int) -> None:
        worker = get_current_worker()
        blocks = [(block.batch, block.columns) for block in self.store.blocks]
        zero_ns = self.store.begin_ns or 0
        try:
            ladder = doors.part("trace")(self._decoding, blocks, number, zero_ns, lambda: worker.is_cancelled)
        except EdorasError as error:
            self._later(self._show_trace, str(error))
        else:
            if ladder is not None:
                self._later(self._show_trace, ladder)

    def _show_trace(self, ladder: Callable[[int], list[Text]] | str) -> None:
        self.trace.empty = ladder if isinstance(ladder, str) else ""
        self.trace.show(None if isinstance(ladder, str) else ladder)

    def action_wireshark(self) -> None:
        """Open the packets of the list in Wireshark."""
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
            self._later(self._notice, str(error), Level.WARNING)
        else:
            self._later(self._notice, f"Wireshark opens at packet {row + 1:,} of those shown")
