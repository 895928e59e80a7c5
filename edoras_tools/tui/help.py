"""What the keys do."""

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
        ("↑ ↓ j k", "a line"),
        ("PgUp PgDn ^u ^d", "a page, half a page"),
        ("Home End g G", "first, last; at the end new packets are followed"),
        ("Tab", "next pane; a click does it too"),
        ("Enter", "to the layers; routes: filter; sequence: go there"),
        ("← → h l", "layers: close, open; bytes: move"),
        ("* -", "layers: open all, close all"),
    ),
    (
        "Finding",
        ("f", "filter: Tab completes, Enter applies, Esc leaves"),
        ("=", "make a filter of the chosen field"),
        ("/", "search: words, bytes (0x0b0c), or a comparison"),
        ("n N", "the next that is sought, the one before"),
        (":", "go to a packet's number"),
        ("m ] [", "mark; next mark, mark before"),
        ("M", "filter for what is marked"),
        ("F", "follow what comes"),
    ),
    (
        "Looking",
        ("r", "routes and their rates"),
        ("s S", "sequence of the SBN conversation, of all links"),
        ("Esc", "back to the packet"),
        ("t", "time: since the start, since the line above, UTC, epoch"),
        ("b", "bytes of the UDP payload, or the whole frame"),
        ("z", "the pane alone, large; and back"),
        ("< >", "more room below, more room for the list"),
        ("T", "dark or light"),
        ("w", "open in Wireshark, at the same packet"),
        ("q ^c", "quit"),
    ),
)
"""Under their heads: keys, and what they do."""


class Help(ModalScreen[None]):
    """All keys, over the view; any of a few takes it away."""

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
