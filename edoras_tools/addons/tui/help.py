"""The list of keys."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Final

from rich.table import Table
from rich.text import Text
from textual.binding import Binding
from textual.containers import VerticalScroll
from textual.screen import ModalScreen
from textual.widgets import Static

if TYPE_CHECKING:
    from textual.app import ComposeResult

KEYS: Final = (
    (
        "Moving",
        ("↑ ↓ j k", "one line"),
        ("PgUp PgDn ^u ^d", "a page, half a page"),
        ("Home End g G", "first, last; at the end, new packets are followed"),
        ("Tab", "next pane; a click does the same"),
        ("Enter", "to the layers; in routes: filter; in the sequence: go to the packet"),
        ("← → h l", "layers: close, open; bytes: move"),
        ("* -", "layers: open all, close all"),
    ),
    (
        "Finding",
        ("f", "filter: ↑ ↓ choose a completion, Tab accepts it, Enter applies, Esc cancels"),
        ("=", "make a filter from the selected field"),
        ("/", "search: text, bytes (0x0b0c), or a comparison"),
        ("n N", "next match, previous match"),
        (":", "go to a packet by its number"),
        ("m ] [", "mark; next mark, previous mark"),
        ("M", "filter for the marked packets"),
        ("F", "follow new packets"),
    ),
    (
        "Viewing",
        ("r", "routes and their rates"),
        ("s S", "sequence diagram of SBN, of all links"),
        ("R", "graph of the rates of the packets in the list"),
        ("o O", "sort the list, or the routes, by the next column, the other way round"),
        ("Esc", "back to the packet"),
        ("t", "time: since the start, since the previous line, UTC, epoch"),
        ("c", "columns of the list: any of its own, and any field; the selected one is added"),
        ("b", "bytes of the UDP payload, or the whole frame"),
        ("z", "only this pane; all panes again"),
        ("< >", "more space below, more space for the list"),
        ("T", "dark or light theme"),
        ("w", "open in Wireshark, at the same packet"),
        ("W", "save the packets of the list to a file"),
        ("q ^c", "quit"),
    ),
)
"""Groups of keys: a title, then each key with what it does."""


class Help(ModalScreen[None]):
    """All keys, shown over the view; Escape, q, ? or Enter close it."""

    BINDINGS: ClassVar[list[Any]] = [
        Binding("escape,q,question_mark,enter,space", "dismiss", "Close", show=False)
    ]

    def compose(self) -> ComposeResult:
        """Make the table."""
        table = Table.grid(padding=(0, 2))
        table.add_column(no_wrap=True)
        table.add_column()
        for head, *keys in KEYS:
            table.add_row(Text(head, "bold"), "")
            for names, what in keys:
                table.add_row(Text(f"  {names}", "cyan"), Text(what))
        box = VerticalScroll(Static(table))
        box.border_title = "Keys"
        yield box
