"""Ways to find packets of the list, and to keep them: search, number, marks, filters, copies, save."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from textual import work
from textual.binding import Binding
from textual.worker import get_current_worker

from edoras_tools.addons.tui.lists.lines import Lines
from edoras_tools.addons.tui.lists.overviews import Drawing
from edoras_tools.addons.tui.panes import Panes
from edoras_tools.addons.tui.prompts import Sheet
from edoras_tools.addons.tui.store import matcher, next_number
from edoras_tools.decode.filters.rows import ColumnRows
from edoras_tools.decode.filters.syntax import WhereError
from edoras_tools.errors import EdorasError
from edoras_tools.io.formats.table import WRITTEN
from edoras_tools.model import Decoded, SourceInfo, SourceStatistics
from edoras_tools.pipelines.capture.record import Target, check_output, open_sink
from edoras_tools.pipelines.recorder import PushedSource
from edoras_tools.render.capture.packet_list import COLUMNS
from edoras_tools.render.severity import Level
from edoras_tools.render.terminal.text import clean, clip
from edoras_tools.words import plural

if TYPE_CHECKING:
    from edoras_tools.addons.tui.store import Part
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.render.capture.tree import TreeRow


def filter_of(decoded: Decoded, row: TreeRow) -> str:
    """Return the filter for packets with the same value as a row of the tree; empty if there is none.

    For a layer, return the filter for packets that have this layer.
    """
    for layer in decoded.layers:
        if row.role == "layer" and (layer.start, layer.end, layer.title) == (row.start, row.end, row.label):
            return layer.name
        for item in layer.fields:
            if row.role != "field" or (item.start, item.end) != (row.start, row.end):
                continue
            if item.name == row.label or item.name.endswith(f".{row.label}"):
                value = _constant(item.value, item.text)
                return f"{layer.name}.{item.name} == {value}" if value else ""
    return ""


def _constant(value: Any, text: str) -> str:
    match value:
        case bool():
            return "true" if value else "false"
        case int():
            return text.partition(" ")[0] if text.startswith("0x") else str(value)
        case float():
            return repr(value) if math.isfinite(value) else ""
        case str():
            escaped = value.replace("\\", "\\\\").replace('"', '\\"')
            return f'"{escaped}"' if value.isprintable() else ""
        case _:
            return ""


class Navigation(Panes):
    """The panes, with search, go to packet, marks, filters for the selection, copies, and save."""

    BINDINGS: ClassVar[list[Any]] = [
        Binding("n", "again(False)", "Next found", show=False),
        Binding("N", "again(True)", "Found before", show=False),
        Binding("right_square_bracket", "to_mark(False)", "Next mark", show=False),
        Binding("left_square_bracket", "to_mark(True)", "Mark before", show=False),
        Binding("colon", "number", "Go to", show=False),
        Binding("W", "save", "Save", show=False),
        Binding("c", "columns", "Columns", show=False),
        Binding("y", "copy", "Copy", show=False),
        Binding("C", "conversation", "Conversation", show=False),
        Binding("ctrl+t", "reference", "Time reference", show=False),
        Binding("M", "filter_marks", "Marked only", show=False),
        Binding("equals_sign", "filter_selected('')", "Filter for the value", show=False),
        Binding("ampersand", "filter_selected('and ')", "And the value", show=False),
        Binding("vertical_line", "filter_selected('or ')", "Or the value", show=False),
        Binding("exclamation_mark", "filter_selected('and not ')", "Not the value", show=False),
    ]
    _searched = ""

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Disable the search keys while a text is being entered."""
        writing = self.filter_line.input.has_focus or self.prompt.input.has_focus
        return not (action == "search" and writing)

    def action_search(self) -> None:
        """Ask for a search."""
        hint = "text, bytes such as 0x0b0c, or a comparison such as apid == 39"
        self._ask("Find", hint, self._find, self._searched)

    def action_number(self) -> None:
        """Ask for a packet's number."""
        self._ask("Go to packet", "its number", self._go_to_number)

    def action_columns(self) -> None:
        """Ask for the columns of the list; the field selected among the layers is added."""
        selected = self._selected_filter() if self.layers.has_focus else ""
        names = [*self.packets.columns, *selected.split()[:1]]
        hint = f"{' '.join(COLUMNS)}, and fields"
        self._ask("Columns", hint, self._choose_columns, " ".join(dict.fromkeys(names)), extends=True)

    def _choose_columns(self, names: str) -> None:
        try:
            self.packets.choose(names.replace(",", " ").split())
        except WhereError as error:
            self._notice(clean(error.why), Level.WARNING)

    def action_save(self) -> None:
        """Ask for a file for the packets of the list."""
        if len(self.store):
            packets_text = plural(len(self.store), "packet")
            self._ask(f"Save {packets_text} to", f"a new file: {WRITTEN}", self._save_to)
        else:
            self._notice("there is no packet to save yet")

    def _save_to(self, path: str) -> None:
        self._save(Path(path).expanduser(), self.filter_line.input.value)

    @work(thread=True, exclusive=True, group="save")
    def _save(self, path: Path, selection: str) -> None:
        try:
            count = save_packets(self.store.parts(), path, self._source.info, self._bench, selection)
        except EdorasError as error:
            self._later(self._notice, clean(str(error)), Level.WARNING)
        else:
            self._later(self._notice, f"{clean(str(path))}: {plural(count, 'packet')}")

    def _ask(
        self, label: str, hint: str, then: Callable[[str], object], value: str = "", *, extends: bool = False
    ) -> None:
        """Ask for a text, see ``Prompt.ask``; an empty one is an answer only if it extends the first one."""

        def answer(text: str) -> None:
            self.packets.focus()
            if text or extends:
                then(text)

        self.prompt.ask(label, hint, answer, value, extends=extends)

    def _find(self, text: str) -> None:
        self._searched = text
        self.action_again(back=False)

    def _go_to_number(self, text: str) -> None:
        row = self.store.find_number(int(text)) if text.isdecimal() else None
        if row is None:
            self._notice(f"there is no packet {clean(text)}", Level.WARNING)
        else:
            self.packets.go(row, centre=True)

    def action_again(self, back: bool) -> None:
        """Go to the next packet that the search matches, or the previous one."""
        if not self._searched:
            self.action_search()
            return
        self._notice(f"searching {clean(self._searched)}")
        self._search(self._searched, self.store.place(self.packets.cursor), back)

    @work(thread=True, exclusive=True, group="search")
    def _search(self, text: str, row: int, back: bool) -> None:
        worker = get_current_worker()
        test = matcher(text, self._decoding, self.store.begin_ns)
        number = next_number(self.store.parts(), test, row, back=back, given_up=lambda: worker.is_cancelled)
        if not worker.is_cancelled:
            self._later(self._go_to_match, text, number)

    def _go_to_match(self, text: str, number: int | None) -> None:
        row = None if number is None else self.store.find_number(number)
        if row is None:
            self._notice(f"no packet shown contains {clean(text)}", Level.WARNING)
            return
        wrapped = self.store.place(row) <= self.store.place(self.packets.cursor)
        self._notice(f"found {clean(text)}{' · from the other end' if wrapped else ''} · n next, N previous")
        self.packets.go(row, centre=True)

    def action_mark(self) -> None:
        """Mark the packet under the cursor, or remove its mark."""
        if not len(self.store):
            return
        self.packets.marks ^= {self._at_cursor}
        self.packets.refresh()
        self._refresh_status()

    def action_to_mark(self, back: bool) -> None:
        """Go to the next mark among the packets shown; after the last one, to the first."""
        current = self._at_cursor
        marks = sorted(self.packets.marks, reverse=back)
        ahead = [item for item in marks if (item < current if back else item > current)]
        for number in [*ahead, *marks]:
            row = self.store.find_number(number)
            if row is not None and self.store.number(row) == number:
                self.packets.go(row, centre=True)
                return
        self._notice("none of the packets shown is marked; m marks one")

    @property
    def _number(self) -> int:
        return self.decoded.datagram.number if self.decoded else 0

    @property
    def _at_cursor(self) -> int:
        """Number of the packet under the cursor; 0 if there is none."""
        return self.store.number(self.packets.cursor) if len(self.store) else 0

    def _later(self, call: Callable[..., object], *arguments: Any) -> None:
        """Call a function in the drawing thread, from another thread; do nothing after the end of the app."""
        with suppress(RuntimeError):
            self.call_later(call, *arguments)

    # The selection: a field, or a line that leads to packets

    def _selected_filter(self) -> str:
        """Return the filter for the selection; empty if it has no value."""
        if self.focused is self.routes:
            return self.routes.filter
        if isinstance(self.focused, Drawing):
            return self.focused.filter
        row = self.layers.field
        return filter_of(self.decoded, row) if self.decoded and row else ""

    def action_filter_marks(self) -> None:
        """Filter for the marked packets."""
        if not self.packets.marks:
            self._notice("no packet is marked; m marks one")
            return
        self._filter_for(f"number in {{{', '.join(map(str, sorted(self.packets.marks)))}}}")

    def action_filter_selected(self, joined: str) -> None:
        """Write a filter for the selection, joined to the present text; Enter applies it.

        Args:
            joined: ``and ``, ``or ``, ``and not ``; empty: replace the present text.
        """
        text = self._selected_filter()
        if not text:
            self._notice("select a field with a value first")
            return
        line = self.filter_line.input
        line.value = joined_filter(line.value.strip() if joined else "", joined, text)
        line.cursor_position = len(line.value)
        line.focus()

    def _filter_for(self, text: str) -> None:
        self.filter_line.accept(text, self.store.begin_ns)
        self.packets.focus()

    def action_conversation(self) -> None:
        """Filter for the packets between the two ends of the packet under the cursor."""
        if self.decoded is None:
            return
        both = self.decoded.datagram.source, self.decoded.datagram.destination
        ends = ", ".join(f'"{end}"' if ":" in end.address else str(end) for end in dict.fromkeys(both))
        self._filter_for(f"source in {{{ends}}} and destination in {{{ends}}}")

    def action_reference(self) -> None:
        """Set the packet under the cursor as zero of the times; again: remove it."""
        number = self._at_cursor
        if not number:
            return
        if self.packets.references.pop(number, None) is None:
            self.packets.references[number] = self.store.time_ns(self.packets.cursor)
        self.packets.forget()
        self._notice(f"times count from packet {number:,} on" * (number in self.packets.references))

    def action_copy(self) -> None:
        """Ask which text of the selection to copy to the terminal's clipboard."""
        texts = {key: item for key, item in self._copies().items() if item[1]}
        rows = [(key, f"{name:<7} {clip(clean(text), 56)}") for key, (name, text) in texts.items()]
        if texts:
            self.push_screen(Sheet("Copy", rows, {key: text for key, (_, text) in texts.items()}), self._copy)

    def _copies(self) -> dict[str, tuple[str, str]]:
        pane = self.focused if isinstance(self.focused, Lines) else self.packets
        texts = {"=": ("filter", self._selected_filter())}
        if pane.rows() and pane not in {self.layers, self.hex_pane}:
            texts["l"] = ("line", pane.draw(pane.cursor, pane.room).text.strip())
        row, name = self.layers.field, self.layers.field_name
        if self.decoded is not None and row is not None and (pane is self.packets or "l" not in texts):
            payload = self.decoded.datagram.payload
            octets = payload[row.start : row.end] if row.end > row.start else payload
            texts |= {"v": ("value", row.value), "f": ("field", f"{name}: {row.value}" * bool(row.value))}
            texts["x"] = ("hex", octets.hex(" "))
        return texts

    def _copy(self, text: str | None) -> None:
        if text:
            self.copy_to_clipboard(text)
            self._notice(f"copied: {clip(clean(text), 60)}")


def joined_filter(before: str, joined: str, text: str) -> str:
    """Return two filters joined to one.

    Args:
        joined: ``and ``, ``or `` or ``and not ``.
    """
    if " or " in text:
        text = f"({text})"
    if not before:
        return joined.removeprefix("and ").removeprefix("or ") + text
    if " or " in before and joined != "or ":
        before = f"({before})"
    return f"{before} {joined}{text}"


def save_packets(
    parts: Sequence[Part], path: Path, info: SourceInfo, bench: Workbench, selection: str
) -> int:
    """Write packets to a new file; return their number.

    Args:
        parts: result of ``Store.parts``.
        path: path of the file; its suffix sets the format.
        selection: the filter that the packets passed; a recording stores it.

    Raises:
        CaptureError: the file cannot be written.
        ConfigError: the suffix is unknown, or the file exists.
    """
    target = Target(path)
    check_output(target, ())
    source, count = PushedSource(info, SourceStatistics()), 0
    sink = open_sink(target, source, bench, selection=selection)
    try:
        for block, _, members in parts:
            rows = ColumnRows(bench.columns.context, 0, block.batch, block.columns, np.asarray(members))
            sink.write(*rows.alone())
            count += len(members)
    finally:
        sink.close(source.statistics)
    return count
