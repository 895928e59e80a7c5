"""The panes of the view, their keys and the list of keys; the viewer connects them.

There are a dark and a light theme, and the terminal's sixteen colours in each.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final

import msgspec
from rich.terminal_theme import TerminalTheme
from rich.text import Text
from textual.app import App, ComposeResult
from textual.binding import Binding
from textual.containers import Horizontal, Vertical
from textual.theme import Theme
from textual.widgets import ContentSwitcher, Footer, Static

from edoras_tools.addons.tui.lists.lines import HeaderLine, Lines, Packets
from edoras_tools.addons.tui.lists.overviews import Drawing, RateGraph, Routes, SequenceView
from edoras_tools.addons.tui.lists.packet import WIDE, HexPane, Layers
from edoras_tools.addons.tui.prompts import FilterLine, Prompt, Sheet
from edoras_tools.addons.tui.store import Store
from edoras_tools.decode.lines import line_of
from edoras_tools.pipelines.capture.ledger import Ledger
from edoras_tools.pipelines.reading import Limits
from edoras_tools.render.severity import Level
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.text import clean
from edoras_tools.words import TimeFormat, plural

if TYPE_CHECKING:
    from edoras_tools.io import Source
    from edoras_tools.model import Decoded
    from edoras_tools.pipelines.selection import Selection
    from edoras_tools.pipelines.workbench import Settings, Workbench

KEYS: Final = (
    (
        "Moving",
        ("↑ ↓ j k", "one line"),
        ("PgUp PgDn ^u ^d", "a page, half a page"),
        ("Home End g G", "first, last; at the end, new packets are followed"),
        ("Tab", "next pane; a click does the same"),
        ("Enter", "to the layers; in the sequence: go to the packet; in other views: filter"),
        ("← → h l", "layers: close, open; bytes: move"),
        ("* -", "layers: open all, close all"),
    ),
    (
        "Finding",
        ("f", "filter: ↑ ↓ completions or earlier filters, Tab accepts, Enter applies, Esc cancels"),
        ("=", "filter for the selected value; Enter applies it"),
        ("& | !", "that filter and, or, and not the selected value"),
        ("C", "conversation: what the two ends of the packet say to each other"),
        ("/", "search: text, bytes (0x0b0c), or a comparison"),
        ("n N", "next match, previous match"),
        (":", "go to a packet by its number"),
        ("m ] [", "mark; next mark, previous mark"),
        ("M", "filter for the marked packets"),
        ("F", "follow new packets"),
    ),
    (
        "Viewing",
        ("d", "control room: what was lost and what to do, hops, routes, events"),
        ("r", "routes of the packets in the list, and their rates"),
        ("e", "findings of the packets in the list"),
        ("i", "sums of the packets in the list, and of all"),
        ("s S", "sequence diagram of SBN, of all links"),
        ("R p", "graph of the rates of the packets in the list, of the selected field"),
        ("o O", "sort the list, or the routes, by the next column, the other way round"),
        ("Esc", "back to the packet"),
        ("t", "trace: the way of the packet's message through cFS, hop by hop"),
        ("u", "time: since the start, since the previous line, UTC, epoch"),
        ("^t", "time counts from this packet on; again: no longer"),
        ("c", "columns of the list: any of its own, and any field; the selected one is added"),
        ("b", "bytes of the UDP payload, or the whole frame"),
        ("z", "only this pane; all panes again"),
        ("< >", "more space below, more space for the list"),
        ("T", "dark or light theme"),
        ("y", "copy the selected value, field, bytes, line, or its filter"),
        ("w", "open in Wireshark, at the same packet"),
        ("W", "save the packets of the list to a file"),
        ("q ^c", "quit"),
    ),
)
"""Groups of keys: a title, then each key with its action."""
VIEWS: Final = {
    "room": ("Control room", "Enter shows the packets · Esc back"),
    "routes": ("Routes", "Enter filters · o O sort · Esc back"),
    "findings": ("Findings", "Enter filters · Esc back"),
    "sums": ("Sums", "Enter filters · Esc back"),
    "sequence": ("SBN conversation", "Enter goes to the packet · Esc back"),
    "rates": ("Rates", "z fills the screen · Esc back"),
    "graph": ("Graph", "z fills the screen · Esc back"),
    "trace": ("Trace", "z fills the screen · Esc back"),
}
"""Title of each view of the lower half, and its keys."""


LIMIT: Final = 1 << 30
"""Bytes of packets and columns to keep: about four million packets."""
_WIDE_FROM: Final = WIDE + 50
"""Width from which the hex pane shows 16 bytes per line."""
_SHARES: Final = (1, 9)
_EVERY_S: Final = 0.5
"""Time between two updates of rates and drops."""
_SAID_S: Final = 6.0
"""Time that a notice is shown, s."""


class ViewOptions(msgspec.Struct, frozen=True):
    """Settings of the view.

    Attributes:
        selection: selection of packets to read; its filter is the first filter of the view.
        settings: settings for Wireshark's dissector.
        time_format: format of the time column.
        follow: whether to stay at the end when packets arrive.
        limits: part of the source that is read.
        verbose: whether to show notes in the list, besides warnings and errors.
        limit: maximum size of the kept packets, bytes.
    """

    selection: Selection
    settings: Settings
    time_format: TimeFormat = TimeFormat.RELATIVE
    follow: bool = False
    limits: Limits = Limits()
    verbose: bool = False
    limit: int = LIMIT


class Panes(App[None]):
    """The panes, and the keys that change their appearance.

    Attributes:
        live: whether packets arrive live.
        store: packets.
        ledger: counts by route.
        reading: whether more packets may come.
        decoded: packet that is shown; None if there is none.
        filter_line: filter.
        packets: packet list.
        layers: tree.
        hex_pane: bytes.
        routes: routes and their rates.
        sequence: conversation.
        rates: graph of rates.
        graph: graph of a field.
        trace: way of one message.
        room: control room.
        findings: the findings.
        sums: the sums.
        zoomed: id of the pane that is shown alone; empty if all are shown.
        prompt: line that asks for a search text or a packet number.
    """

    CSS_PATH = "panes.tcss"
    ENABLE_COMMAND_PALETTE = False
    BINDINGS: ClassVar[list[Any]] = [
        Binding("F", "follow", "Follow", show=False),
        Binding("u", "time", "Time", show=False),
        Binding("b", "base", "Bytes", show=False),
        Binding("z", "zoom", "Zoom", show=False),
        Binding("T", "theme", "Theme", show=False),
        Binding("less_than_sign", "share(-1)", "More below", show=False),
        Binding("greater_than_sign", "share(1)", "More list", show=False),
    ]

    def __init__(self, source: Source, bench: Workbench, choice: ViewOptions) -> None:
        super().__init__()
        self.title = f"edoras sniff {source.info.name}"
        self.live = source.live
        self.store = Store(choice.limit if self.live else 0)
        self.ledger = Ledger(bench.mission, structs=bench.columns.context.structs)
        self.reading = True
        self.decoded: Decoded | None = None
        self._source = source
        self._bench = bench
        self._decoding = bench.columns.context
        self.zoomed = ""
        self._said = ("", Level.NOTE)
        self._said_until = 0.0
        self._every_link = False
        self._share = sum(_SHARES) // 2
        # Kept as attributes: queries do not find them while another screen is open.
        self.filter_line = FilterLine(self._decoding)
        self.packets = Packets(self.store, self._decoding, choice.time_format, verbose=choice.verbose)
        self.layers, self.hex_pane = Layers(), HexPane()
        self.routes, self.sequence = Routes(self.ledger, live=self.live), SequenceView()
        self.rates, self.graph, self.trace = RateGraph("rates"), RateGraph("graph"), Drawing("trace")
        self.room, self.findings, self.sums = Drawing("room"), Drawing("findings"), Drawing("sums")
        self.prompt = Prompt()
        self._lower = ContentSwitcher(initial="packet", id="lower")
        self._title_left, self._title_right = Static(classes="left"), Static(classes="right")
        self._status_left, self._status_right = Static(id="status-left"), Static(id="status-right")

    def compose(self) -> ComposeResult:
        """Lay out the panes."""
        yield self.filter_line
        yield HeaderLine("packets")
        yield self.packets
        with Horizontal(classes="bar"):
            yield self._title_left
            yield self._title_right
        with self._lower:
            with Horizontal(id="packet"):
                yield self.layers
                yield self.hex_pane
            for name in VIEWS:
                with Vertical(id=f"{name}-view", classes="view"):
                    if name in {"routes", "sequence"}:
                        yield HeaderLine(name)
                    yield getattr(self, name)
        yield self.prompt
        with Horizontal(id="status"):
            yield self._status_left
            yield self._status_right
        yield Footer(show_command_palette=False, compact=True)

    def on_mount(self) -> None:
        """Register both themes and choose that of the terminal, if it is known; else the dark one."""
        for theme in (DARK, LIGHT):
            self.register_theme(theme)
        palette.SHADES.clear()  # the themes have sixteen colours of their own
        palette.escapes.cache_clear()
        # Without an event: the theme, which is set next, reloads the style sheet for all three.
        self.set_reactive(App.ansi_theme_dark, DARK_SIXTEEN)
        self.set_reactive(App.ansi_theme_light, LIGHT_SIXTEEN)
        self.theme = of_terminal(os.environ.get("COLORFGBG", "")).name
        self.packets.focus()
        self.set_interval(_EVERY_S, self._refresh_figures)

    def on_resize(self) -> None:
        """Show 16 bytes per line if there is space."""
        self.hex_pane.set_class(self.size.width >= _WIDE_FROM, "-wide")

    def action_help(self) -> None:
        """Show the list of keys."""
        rows = [row for head, *keys in KEYS for row in (("", head), *keys)]
        self.push_screen(Sheet("Keys", rows))

    def action_follow(self) -> None:
        """Start or stop following new packets."""
        self.packets.follow = not self.packets.follow
        if self.packets.follow:
            self.packets.go(-1)
        self._refresh_status()

    def action_time(self) -> None:
        """Show the next time format."""
        formats = list(TimeFormat)
        after = formats.index(self.packets.time_format) + 1
        self.packets.time_format = formats[after % len(formats)]
        self._notice(f"time: {self.packets.time_format.value}")

    def action_base(self) -> None:
        """Switch between the bytes of the payload and of the frame."""
        pane = self.hex_pane
        pane.set_base("frame" if pane.base == "payload" else "payload")
        self._refresh_title()

    def action_zoom(self) -> None:
        """Show the focused pane alone, with its titles, or all panes."""
        pane = self.focused.id if isinstance(self.focused, Lines) else None
        self._zoom("" if self.zoomed else pane or "")

    def _zoom(self, pane: str) -> None:
        self.zoomed = pane
        half = pane if pane in {"", "packets"} else "lower"
        for name in ("packets", "lower", "layers", "hex-pane"):
            self.screen.set_class(name in {pane, half}, f"-zoom-{name}")

    def action_theme(self) -> None:
        """Switch between the dark and the light theme."""
        self.theme = LIGHT.name if self.theme == DARK.name else DARK.name
        self.packets.forget()

    def action_share(self, by: int) -> None:
        """Give the list more or less of the height."""
        low, high = _SHARES
        self._share = max(low, min(high, self._share + by))
        self.packets.styles.height = f"{self._share}fr"
        self._lower.styles.height = f"{low + high - self._share}fr"

    @property
    def _view(self) -> str:
        """Name of the view in the lower half: one of ``VIEWS``, or ``packet``."""
        return str(self._lower.current).removesuffix("-view")

    def _notice(self, text: str, severity: Level = Level.NOTE) -> None:
        """Show a notice for some time, or until a field is selected."""
        self._said = (text, severity)
        self._said_until = time.monotonic() + _SAID_S
        self._refresh_status()

    def _refresh_figures(self) -> None:
        if self.live or self._view == "routes":
            self.routes.update_rates(time.monotonic())
        self._refresh_status()

    def _count_text(self) -> str:
        count, total = len(self.store), self.store.packets
        if not self.store.filtered:
            return plural(total, "packet")
        share = "" if self.store.settled == total else f" · {100 * self.store.settled // max(1, total)} %"
        return f"{count:,} of {total:,}{share}"

    def _refresh_status(self) -> None:
        text, severity = self._said if time.monotonic() < self._said_until else ("", Level.NOTE)
        name = clean(Path(self._source.info.name).name)
        status = Text(text, "" if severity is Level.NOTE else severity.style) if text else Text(name, "dim")
        row = self.layers.field
        if not text and row is not None and row.end > row.start:
            span = f"{row.start}" if row.end == row.start + 1 else f"{row.start}-{row.end - 1}"
            status = Text.assemble(
                (self.layers.field_name, row.style), (f"  bytes {span}", "dim"), f"  {row.doc}"
            )
        status.no_wrap, status.overflow = True, "ellipsis"
        self._status_left.update(status)
        self.filter_line.show_count(self._count_text())
        self._status_right.update(self._figures())

    def _figures(self) -> Text:
        statistics = self._source.statistics
        right = Text()
        if self.packets.marks:
            right.append(f"◆ {len(self.packets.marks)}  ", "yellow")
        if (drops := statistics.kernel_drops) is not None:
            right.append(f"{drops:,} dropped  ", Level.ERROR.style if drops else "")
        if self.store.forgotten:
            right.append(f"{self.store.forgotten:,} oldest removed  ")
        if self.reading and not self.live and statistics.total_bytes:
            right.append(f"reading {100 * statistics.position // statistics.total_bytes} %  ")
        elif self.reading:
            right.append("● live  " if self.live else "● reading  ", "green")
        if self.packets.sorted_by:
            right.append(f"by {self.packets.sorted_by} {'▼' if self.packets.reverse else '▲'}  ")
        if self.packets.follow and self.reading:
            right.append("following  ", "green")
        row = self.packets.cursor + 1 if len(self.store) else 0
        right.append(f"{row:,}/{len(self.store):,}")
        return right

    def _refresh_title(self) -> None:
        title, right = Text(""), Text("")
        if self._view in VIEWS:
            title, right = map(Text, VIEWS[self._view])
            if self._view == "sequence" and self._every_link:
                title = Text("Conversation of all links")
        elif self.decoded is not None:
            title, right = _packet_title(self.decoded), Text(self.hex_pane.title)
        title.no_wrap, title.overflow = True, "ellipsis"
        self._title_left.update(title)
        self._title_right.update(right)


def _packet_title(decoded: Decoded) -> Text:
    line = line_of(decoded)
    msg_id = f"0x{line.msg_id:04x}" if line.msg_id >= 0 else ""
    words = " ".join(filter(None, (decoded.link_name, line.kind, msg_id, clean(line.name))))
    return Text.assemble(f"Packet {decoded.datagram.number}  ", (words, decoded.link.colour))


def _rgb(text: str) -> tuple[int, int, int]:
    return int(text[:2], 16), int(text[2:4], 16), int(text[4:], 16)


def _sixteen(background: str, foreground: str, *colours: str) -> TerminalTheme:
    table = [_rgb(item) for item in colours]
    return TerminalTheme(_rgb(background), _rgb(foreground), table[:8], table[8:])


DARK: Final = Theme(
    name="edoras-dark",
    primary="#4c9fd4",
    secondary="#7a8fa6",
    warning="#d7a846",
    error="#e0616b",
    success="#6cb272",
    accent="#e0a95c",
    foreground="#d5dbe3",
    background="#10141a",
    surface="#141920",
    panel="#1d242e",
    dark=True,
)
LIGHT: Final = Theme(
    name="edoras-light",
    primary="#1f6fa8",
    secondary="#5b6b7c",
    warning="#a86f00",
    error="#c0323e",
    success="#2f7d3a",
    accent="#b06a00",
    foreground="#22272e",
    background="#fbfbf9",
    surface="#f5f5f2",
    panel="#e6e8ea",
    dark=False,
)


def of_terminal(colours: str) -> Theme:
    """Return the theme that matches a terminal.

    Args:
        colours: numbers of its text and background colours among the sixteen, as in ``COLORFGBG``, which
            rxvt, Konsole and others set: ``0;15``, ``15;default;0``.
    """
    return LIGHT if colours.rpartition(";")[2] in _LIGHT_GROUNDS else DARK


_LIGHT_GROUNDS: Final = ("7", *map(str, range(9, 16)))
DARK_SIXTEEN: Final = _sixteen(
    *("10141a", "d5dbe3"),
    *("1d242e", "e0616b", "7fc38a", "d9b25f", "6aa5e8", "c792d9", "5fc3cf", "c3cbd5"),
    *("6b7787", "f07f88", "98d6a2", "ecc97e", "8bbdf5", "dcaeea", "84dbe5", "ffffff"),
)
LIGHT_SIXTEEN: Final = _sixteen(
    *("fbfbf9", "22272e"),
    *("22272e", "b8262f", "2b7a37", "93670a", "1d5fae", "8b3fa3", "0c7480", "6b7480"),
    *("8a939e", "d0404a", "3a8f47", "a9790f", "2f74c8", "a054b8", "138a98", "3a424c"),
)
