"""The three-pane view: what comes from where, and what each key does."""

from __future__ import annotations

import asyncio
import signal
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import cycle, islice
from typing import TYPE_CHECKING, Any, ClassVar, Final

from rich.text import Text
from textual import on, work
from textual.app import App
from textual.binding import Binding
from textual.containers import Horizontal, Vertical
from textual.message import Message
from textual.widgets import ContentSwitcher, Footer, Input, Static
from textual.worker import get_current_worker

from edoras_tools.decode.where_rows import ColumnRows
from edoras_tools.errors import EdorasError
from edoras_tools.model import Link
from edoras_tools.pipelines.accounts import Ledger
from edoras_tools.pipelines.conversation import Conversation
from edoras_tools.render import palette, units
from edoras_tools.render.facts import facts, link_name
from edoras_tools.render.packet_list import TimeFormat
from edoras_tools.render.severity import Severity
from edoras_tools.render.text import clean
from edoras_tools.tui import look
from edoras_tools.tui.feed import Feed
from edoras_tools.tui.help import Help
from edoras_tools.tui.ladder import Ladder
from edoras_tools.tui.layers import Layers
from edoras_tools.tui.lines import Lines
from edoras_tools.tui.octets import NARROW, WIDE, Octets
from edoras_tools.tui.packets import Heads, Packets
from edoras_tools.tui.prompts import FilterLine, Prompt
from edoras_tools.tui.routes import Routes
from edoras_tools.tui.search import next_number, seeker
from edoras_tools.tui.sieve import Sieve
from edoras_tools.tui.store import Block, Store
from edoras_tools.tui.words import filter_of
from edoras_tools.tui.wireshark import open_in_wireshark

if TYPE_CHECKING:
    import subprocess

    import numpy as np
    from numpy.typing import NDArray
    from textual.app import ComposeResult

    from edoras_tools.decode.where import Where
    from edoras_tools.model import Decoded
    from edoras_tools.pipelines.selection import Selection
    from edoras_tools.pipelines.workbench import Settings, Workbench
    from edoras_tools.render.sequence import Message as Run
    from edoras_tools.sources import Source

LIMIT: Final = 1 << 30
"""Bytes of packets and columns that are held: about four million packets."""
_WIDE_FROM: Final = WIDE + 50
"""Cells from which the bytes have 16 a line."""
_SHARES: Final = (1, 9)
_EVERY_S: Final = 0.5
"""Between two looks at rates and drops."""


@dataclass(frozen=True, slots=True)
class Choice:
    """What to show, and how.

    Attributes:
        selection: what is taken; its filter is the one to begin with.
        settings: for Wireshark's dissector.
        time_format: how to tell time.
        follow: stay at the end as packets come.
        count: take so many packets; 0 all.
        duration_ns: read so long; 0 to the end.
        limit: bytes that are held.
    """

    selection: Selection
    settings: Settings
    time_format: TimeFormat = TimeFormat.RELATIVE
    follow: bool = False
    count: int = 0
    duration_ns: int = 0
    limit: int = LIMIT


class Viewer(App[None]):
    """``edoras sniff --tui``.

    Args:
        source: where packets come from; closed at the end.
        bench: mission, types and decoders.
        choice: what to show, and how.

    Attributes:
        store: the packets.
        ledger: what came, by route.
        failure: why reading ended early; nothing where it did not.
        reading: whether more may come.
    """

    CSS = look.CSS
    ENABLE_COMMAND_PALETTE = False
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
        Binding("n", "again(False)", "Next found", show=False),
        Binding("N", "again(True)", "Found before", show=False),
        Binding("right_square_bracket", "to_mark(False)", "Next mark", show=False),
        Binding("left_square_bracket", "to_mark(True)", "Mark before", show=False),
        Binding("M", "filter_marks", "Marked only", show=False),
        Binding("equals_sign", "filter_field", "Filter for the field", show=False),
        Binding("colon", "number", "Go to", show=False),
        Binding("F", "follow", "Follow", show=False),
        Binding("t", "time", "Time", show=False),
        Binding("b", "base", "Bytes", show=False),
        Binding("z", "zoom", "Zoom", show=False),
        Binding("T", "theme", "Theme", show=False),
        Binding("less_than_sign", "share(-1)", "More below", show=False),
        Binding("greater_than_sign", "share(1)", "More list", show=False),
    ]

    class Arrived(Message):
        """Packets came."""

        def __init__(self, block: Block) -> None:
            super().__init__()
            self.block = block

    class Ended(Message):
        """No more will come."""

        def __init__(self, why: str) -> None:
            super().__init__()
            self.why = why

    class Settled(Message):
        """A filter has answered for a block."""

        def __init__(self, where: Where, block: Block, shown: NDArray[np.int64]) -> None:
            super().__init__()
            self.where = where
            self.block = block
            self.shown = shown

    class Found(Message):
        """A search has ended."""

        def __init__(self, text: str, number: int | None) -> None:
            super().__init__()
            self.text = text
            self.number = number

    class Folded(Message):
        """A conversation has been gathered."""

        def __init__(self, runs: list[Run]) -> None:
            super().__init__()
            self.runs = runs

    class Said(Message):
        """Something to say in the status bar."""

        def __init__(self, text: str, severity: Severity = Severity.NOTE) -> None:
            super().__init__()
            self.text = text
            self.severity = severity

    def __init__(self, source: Source, bench: Workbench, choice: Choice) -> None:
        super().__init__()
        self.title = f"edoras sniff {source.info.name}"
        live = hasattr(source, "stop")
        self.store = Store(choice.limit if live else 0)
        self.ledger = Ledger(bench.mission)
        self.failure = ""
        self.reading = True
        self.decoded: Decoded | None = None
        self._source = source
        self._bench = bench
        self._choice = choice
        self._live = live
        self._decoding = bench.columns.context
        self._where: Where | None = None
        self._wanted: int | None = None
        self._sought = ""
        self._said = ("", Severity.NOTE)
        self._every_link = False
        self._share = 5
        self._wireshark: list[subprocess.Popen[bytes]] = []
        bench.dissector.detail = True
        self._sieve = Sieve(lambda where, block, shown: self._tell(self.Settled(where, block, shown)))
        self._feed = Feed(
            source,
            bench,
            replace(choice.selection, where=""),
            deliver=lambda block: self._tell(self.Arrived(block)),
            ended=lambda why: self._tell(self.Ended(why)),
            clock=time.monotonic_ns,
            count=choice.count,
            duration_ns=choice.duration_ns,
            limit=0 if live else choice.limit,
        )

    def compose(self) -> ComposeResult:
        """Make the panes."""
        yield FilterLine(self._decoding)
        yield Heads("", id="heads")
        yield Packets(self.store, self._decoding, self._choice.time_format)
        with Horizontal(classes="bar"):
            yield Static("", id="title-left", classes="left")
            yield Static("", id="title-right", classes="right")
        with ContentSwitcher(initial="packet", id="lower"):
            with Horizontal(id="packet"):
                yield Layers()
                yield Octets()
            with Vertical(id="routes-view"):
                yield Static("", id="routes-heads")
                yield Routes(self.ledger, live=self._live)
            with Vertical(id="ladder-view"):
                yield Static("", id="ladder-heads")
                yield Ladder()
        yield Prompt()
        with Horizontal(id="status"):
            yield Static("", id="status-left")
            yield Static("", id="status-right")
        yield Footer(show_command_palette=False, compact=True)

    def on_mount(self) -> None:
        """Begin to read."""
        for theme in (look.DARK, look.LIGHT):
            self.register_theme(theme)
        self.ansi_theme_dark, self.ansi_theme_light = look.DARK_SIXTEEN, look.LIGHT_SIXTEEN
        self.theme = look.DARK.name
        self.packets.empty = "waiting for the first packet" if self._live else "reading"
        self.packets.follow = self._choice.follow
        self.packets.focus()
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                with suppress(NotImplementedError):  # no signals in this loop, as on Windows
                    asyncio.get_running_loop().add_signal_handler(number, self.exit)
        self.set_interval(_EVERY_S, self._refresh_figures)
        self._sieve.start()
        self._feed.start()
        if self._choice.selection.where:
            self.query_one(FilterLine).accept(self._choice.selection.where, None)

    def on_unmount(self) -> None:
        """Stop the threads; a live source gives up what has arrived."""
        self._feed.stop()
        self._sieve.stop()
        for process in self._wireshark:
            # It goes on without us.
            process.returncode = process.poll() or 0

    def on_resize(self) -> None:
        """Give the bytes 16 a line where there is room."""
        self.screen.set_class(self.size.width >= _WIDE_FROM, "-wide")

    @property
    def packets(self) -> Packets:
        """The packet list."""
        return self.query_one(Packets)

    # What comes from the threads.

    @on(Arrived)
    def _take(self, event: Arrived) -> None:
        block = event.block
        first = not self.store.packets
        self.ledger.add(block.batch, block.columns)
        gone = self.store.append(block)
        if self.store.filtered:
            self._sieve.put(block)
        if first:
            self.packets.forget()
        self._grown(gone)

    @on(Settled)
    def _settle(self, event: Settled) -> None:
        if event.where is not self._where:
            return
        self.store.settle(event.block, event.shown)
        self._grown(0)

    @on(Ended)
    def _end(self, event: Ended) -> None:
        self.reading = False
        self.failure = event.why
        self.packets.empty = "no packet"
        if event.why:
            self._say(event.why, Severity.WARNING)
        self._refresh_status()

    def _grown(self, gone: int) -> None:
        """Show that there are more rows."""
        packets = self.packets
        before = len(self.store) and self._number
        packets.arrived(gone)
        if self._wanted is not None:
            row = self.store.find_number(self._wanted)
            if row is not None or self._all_settled:
                self._wanted = None
                packets.go(row if row is not None else -1, centre=True)
        if self._at_cursor != before or self.decoded is None:
            self._show_packet()
        self._refresh_status()

    def _tell(self, message: Message) -> None:
        """Post a message from a thread; one that comes after the end is of no use."""
        with suppress(RuntimeError):
            self.post_message(message)

    # The chosen packet, its fields, its bytes.

    @property
    def _all_settled(self) -> bool:
        return self.store.settled == self.store.packets

    @property
    def _number(self) -> int:
        return self.decoded.datagram.number if self.decoded else 0

    @property
    def _at_cursor(self) -> int:
        """The number of the packet under the cursor; 0 where there is none."""
        if not len(self.store):
            return 0
        block, index = self.store.locate(self.packets.cursor)
        return int(block.batch.number[index])

    @on(Lines.Moved, "#packets")
    def _show_packet(self) -> None:
        row = self.packets.cursor
        self.decoded = None
        if row < len(self.store):
            self.decoded = self._bench.dissector.dissect(self.store.datagram(row))
        self.query_one(Octets).show(self.decoded)
        self.query_one(Layers).show(self.decoded)
        self._refresh_title()

    @on(Lines.Chosen, "#packets")
    def _enter_packet(self) -> None:
        self.action_view("packet")
        self.query_one(Layers).focus()

    @on(Lines.Moved, "#layers")
    def _show_field(self) -> None:
        row = self.query_one(Layers).field
        octets = self.query_one(Octets)
        if row is None or row.end <= row.start:
            octets.point(0, 0)
        elif not octets.has_focus:
            octets.point(row.start, row.end)
        else:
            octets.point(row.start, row.end, octets.at - max(0, octets.shift))
        self._refresh_status()

    @on(Octets.Pointed)
    def _show_byte(self, event: Octets.Pointed) -> None:
        if not self.query_one(Layers).choose_byte(event.at):
            self.query_one(Octets).point(0, 0)

    # The filter.

    @on(Input.Submitted, "#filter")
    def _submit(self, event: Input.Submitted) -> None:
        if self.query_one(FilterLine).accept(event.value, self.store.begin_ns):
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
        self.query_one(FilterLine).input.focus()

    def action_filter_marks(self) -> None:
        """Filter for what is marked."""
        if not self.packets.marks:
            self._say("nothing is marked; m marks a packet")
            return
        self._filter_for(f"number in {{{', '.join(map(str, sorted(self.packets.marks)))}}}")

    def action_filter_field(self) -> None:
        """Write a filter for the chosen field, to be looked at before it is applied."""
        row = self.query_one(Layers).field
        text = filter_of(self.decoded, row) if self.decoded and row else ""
        if not text:
            self._say("choose a field with a value first")
            return
        line = self.query_one(FilterLine).input
        line.value = f"{line.value} and {text}" if line.value.strip() else text
        line.cursor_position = len(line.value)
        line.focus()

    def _filter_for(self, text: str) -> None:
        self.query_one(FilterLine).accept(text, self.store.begin_ns)
        self.packets.focus()

    # Search and marks.

    def action_search(self) -> None:
        """Ask what to search."""
        hint = "words, bytes as 0x0b0c, or a comparison as apid == 39"
        self.query_one(Prompt).ask("search", "Find", hint, self._sought)

    def action_number(self) -> None:
        """Ask for a packet's number."""
        self.query_one(Prompt).ask("number", "Go to packet", "its number")

    @on(Prompt.Given)
    def _answer(self, event: Prompt.Given) -> None:
        self.packets.focus()
        text = event.text.strip()
        if not text:
            return
        if event.kind == "search":
            self._sought = text
            self.action_again(back=False)
            return
        row = self.store.find_number(int(text)) if text.isdecimal() else None
        if row is None:
            self._say(f"there is no packet {clean(text)}", Severity.WARNING)
        else:
            self.packets.go(row, centre=True)

    def action_again(self, back: bool) -> None:
        """Go to the next packet that is sought."""
        if not self._sought:
            self.action_search()
            return
        self._say(f"searching {clean(self._sought)}")
        self._seek(self._sought, self.packets.cursor, back)

    @work(thread=True, exclusive=True, group="search")
    def _seek(self, text: str, row: int, back: bool) -> None:
        worker = get_current_worker()
        seek = seeker(text, self._decoding, self.store.begin_ns)
        number = next_number(
            self.store.parts(), seek, row, back=back, given_up=lambda: worker.is_cancelled
        )
        if not worker.is_cancelled:
            self._tell(self.Found(text, number))

    @on(Found)
    def _found(self, event: Found) -> None:
        row = None if event.number is None else self.store.find_number(event.number)
        if row is None:
            self._say(f"{clean(event.text)} is in none of the packets shown", Severity.WARNING)
            return
        wrapped = row <= self.packets.cursor
        self._say(f"found {clean(event.text)}{' · from the other end' if wrapped else ''} · n next, N before")
        self.packets.go(row, centre=True)

    def action_mark(self) -> None:
        """Mark the packet under the cursor, or take its mark away."""
        if not len(self.store):
            return
        self.packets.marks ^= {self._at_cursor}
        self.packets.refresh()
        self._refresh_status()

    def action_to_mark(self, back: bool) -> None:
        """Go to the next mark that is shown, round the end."""
        here = self._at_cursor
        marks = sorted(self.packets.marks, reverse=back)
        ahead = [item for item in marks if (item < here if back else item > here)]
        for number in [*ahead, *marks]:
            row = self.store.find_number(number)
            if row is not None and self._is_at(row, number):
                self.packets.go(row, centre=True)
                return
        self._say("no packet shown is marked; m marks one")

    def _is_at(self, row: int, number: int) -> bool:
        block, index = self.store.locate(row)
        return int(block.batch.number[index]) == number

    # What the lower half shows.

    def action_view(self, name: str, every: bool = False) -> None:
        """Show the packet, the routes or the conversation."""
        switcher = self.query_one("#lower", ContentSwitcher)
        wanted = name if name == "packet" else f"{name}-view"
        if switcher.current == wanted and (name != "ladder" or every == self._every_link):
            self.action_leave()
            return
        switcher.current = wanted
        self._every_link = every
        if name != "packet":
            self.query_one(f"#{name}", Lines).focus()
        self._refresh_figures()
        self._gather()
        self._refresh_title()

    def action_leave(self) -> None:
        """Go back: from a pane made large, from another view, to the list."""
        if self.screen.maximized is not None:
            self.screen.minimize()
        self.query_one("#lower", ContentSwitcher).current = "packet"
        self.query_one(Prompt).display = False
        self.packets.focus()
        self._refresh_title()

    @on(Lines.Chosen, "#routes")
    def _choose_route(self) -> None:
        self._filter_for(self.query_one(Routes).filter)

    @on(Lines.Chosen, "#ladder")
    def _choose_run(self) -> None:
        row = self.store.find_time(self.query_one(Ladder).first_ns + (self.store.begin_ns or 0))
        if row is not None:
            self.packets.go(row, centre=True)

    @property
    def _view(self) -> str:
        return str(self.query_one("#lower", ContentSwitcher).current)

    def _gather(self) -> None:
        if self._view == "ladder-view":
            self._fold(self._every_link)

    @work(thread=True, exclusive=True, group="ladder")
    def _fold(self, every: bool) -> None:
        import numpy as np

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
        self._tell(self.Folded(conversation.messages()))

    @on(Folded)
    def _show_ladder(self, event: Folded) -> None:
        ladder = self.query_one(Ladder)
        ladder.show(event.runs)
        self.query_one("#ladder-heads", Static).update(
            ladder.header if event.runs else Text("  no SBN among the packets shown; S takes all links", "dim")
        )
        self._refresh_title()

    # The rest of the keys.

    def action_help(self) -> None:
        """Say what the keys do."""
        self.push_screen(Help())

    def action_follow(self) -> None:
        """Stay at the end as packets come, or not."""
        self.packets.follow = not self.packets.follow
        if self.packets.follow:
            self.packets.go(-1)
        self._refresh_status()

    def action_time(self) -> None:
        """Tell time another way."""
        formats = cycle(TimeFormat)
        self.packets.time_format = next(islice(formats, list(TimeFormat).index(self.packets.time_format) + 1, None))
        self._say(f"time: {self.packets.time_format.value}")

    def action_base(self) -> None:
        """Show the payload's bytes, or the frame's."""
        octets = self.query_one(Octets)
        octets.turn("frame" if octets.base == "payload" else "payload")
        self._refresh_title()

    def action_zoom(self) -> None:
        """Give the pane the whole screen, or all their places."""
        if self.screen.maximized is not None:
            self.screen.minimize()
        elif isinstance(self.focused, Lines):
            self.screen.maximize(self.focused, container=False)

    def action_theme(self) -> None:
        """Change between dark and light."""
        self.theme = look.LIGHT.name if self.theme == look.DARK.name else look.DARK.name
        self.packets.forget()

    def action_share(self, by: int) -> None:
        """Give the list more or less of the height."""
        low, high = _SHARES
        self._share = max(low, min(high, self._share + by))
        self.packets.styles.height = f"{self._share}fr"
        self.query_one("#lower").styles.height = f"{low + high - self._share}fr"

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
            self._tell(self.Said(str(error), Severity.WARNING))
        else:
            self._tell(self.Said(f"Wireshark opens at packet {row + 1:,} of what is shown"))

    # The lines that tell how things are.

    @on(Said)
    def _on_said(self, event: Said) -> None:
        self._say(event.text, event.severity)

    def _say(self, text: str, severity: Severity = Severity.NOTE) -> None:
        """Say something until the next thing is chosen."""
        self._said = (text, severity)
        self._refresh_status()
        self._said = ("", Severity.NOTE)

    def _refresh_figures(self) -> None:
        if self._view == "routes-view":
            routes = self.query_one(Routes)
            routes.update_rates(time.monotonic())
            self.query_one("#routes-heads", Static).update(routes.header)
        self.query_one(FilterLine).tell(self._counted())
        self._refresh_right()

    def _counted(self) -> str:
        shown, there = len(self.store), self.store.packets
        if not self.store.filtered:
            return units.plural(there, "packet")
        share = "" if self._all_settled else f" · {100 * self.store.settled // max(1, there)} %"
        return f"{shown:,} of {there:,}{share}"

    def _refresh_status(self) -> None:
        text, severity = self._said
        left = Text(text, "" if severity is Severity.NOTE else severity.style)
        row = self.query_one(Layers).field
        if not text and row is not None and row.end > row.start:
            span = f"{row.start}" if row.end == row.start + 1 else f"{row.start}-{row.end - 1}"
            left = Text.assemble((row.label, row.style), (f"  bytes {span}", "dim"), f"  {row.doc}")
        left.no_wrap, left.overflow = True, "ellipsis"
        self.query_one("#status-left", Static).update(left)
        self.query_one(FilterLine).tell(self._counted())
        self._refresh_right()

    def _refresh_right(self) -> None:
        statistics = self._source.statistics
        right = Text()
        if self.packets.marks:
            right.append(f"◆ {len(self.packets.marks)}  ", "yellow")
        if statistics.kernel_drops:
            right.append(f"{statistics.kernel_drops:,} dropped  ", Severity.ERROR.style)
        if self.store.forgotten:
            right.append(f"{self.store.forgotten:,} oldest gone  ")
        if self.reading and not self._live and statistics.total_bytes:
            right.append(f"reading {100 * statistics.position // statistics.total_bytes} %  ")
        elif self.reading:
            right.append("● live  " if self._live else "● reading  ", "green")
        if self.packets.follow and self.reading:
            right.append("following  ", "green")
        row = self.packets.cursor + 1 if len(self.store) else 0
        right.append(f"{row:,}/{len(self.store):,}")
        self.query_one("#status-right", Static).update(right)

    def _refresh_title(self) -> None:
        left, right = Text(""), Text("")
        if self._view == "routes-view":
            left, right = Text("Routes"), Text("Enter filters · Esc back")
        elif self._view == "ladder-view":
            left = Text("Conversation of all links" if self._every_link else "SBN conversation")
            right = Text("Enter goes to the packet · Esc back")
        elif self.decoded is not None:
            left, right = _packet_title(self.decoded), Text(self.query_one(Octets).title)
        left.no_wrap, left.overflow = True, "ellipsis"
        self.query_one("#title-left", Static).update(left)
        self.query_one("#title-right", Static).update(right)


def _packet_title(decoded: Decoded) -> Text:
    fact = facts(decoded)
    msg_id = f"0x{fact.msg_id:04x}" if fact.msg_id >= 0 else ""
    words = " ".join(filter(None, (link_name(decoded.link), fact.kind, msg_id, clean(fact.name))))
    return Text.assemble(f"Packet {decoded.datagram.number}  ", (words, palette.LINKS[decoded.link]))


__all__ = ["LIMIT", "NARROW", "Choice", "Viewer"]
