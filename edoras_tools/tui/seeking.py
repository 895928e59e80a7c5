"""How packets are found in the list: by what is searched, by number, by mark."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any, ClassVar

from textual import on, work
from textual.binding import Binding
from textual.worker import get_current_worker

from edoras_tools.render.severity import Severity
from edoras_tools.render.text import clean
from edoras_tools.tui import news
from edoras_tools.tui.panes import Panes
from edoras_tools.tui.prompts import Prompt
from edoras_tools.tui.search import next_number, seeker

if TYPE_CHECKING:
    from textual.message import Message


class Seeking(Panes):
    """The panes with search and marks."""

    BINDINGS: ClassVar[list[Any]] = [
        Binding("n", "again(False)", "Next found", show=False),
        Binding("N", "again(True)", "Found before", show=False),
        Binding("right_square_bracket", "to_mark(False)", "Next mark", show=False),
        Binding("left_square_bracket", "to_mark(True)", "Mark before", show=False),
        Binding("colon", "number", "Go to", show=False),
    ]
    _sought = ""

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Offer no search while something is being written: its key is a letter there."""
        del parameters
        writing = self.filter_line.input.has_focus or self.prompt.input.has_focus
        return not (action == "search" and writing)

    def action_search(self) -> None:
        """Ask what to search."""
        hint = "words, bytes as 0x0b0c, or a comparison as apid == 39"
        self.prompt.ask("search", "Find", hint, self._sought)

    def action_number(self) -> None:
        """Ask for a packet's number."""
        self.prompt.ask("number", "Go to packet", "its number")

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
        number = next_number(self.store.parts(), seek, row, back=back, given_up=lambda: worker.is_cancelled)
        if not worker.is_cancelled:
            self._tell(news.Found(text, number))

    @on(news.Found)
    def _found(self, event: news.Found) -> None:
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

    def _tell(self, message: Message) -> None:
        """Post a message from a thread; one that comes after the end is of no use."""
        with suppress(RuntimeError):
            self.post_message(message)
