"""The filter line at the top, the line that asks for a search text or a number, and the menu of copies."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, ClassVar, Final

from rich.table import Table
from rich.text import Text
from textual.binding import Binding
from textual.containers import Horizontal, Vertical, VerticalScroll
from textual.message import Message
from textual.screen import ModalScreen
from textual.widgets import Input, Static

from edoras_tools.decode.filters.filter import Where
from edoras_tools.decode.filters.names import Names, Unknown
from edoras_tools.decode.filters.syntax import WhereError
from edoras_tools.render.severity import Level
from edoras_tools.render.terminal.text import clean, wrap

if TYPE_CHECKING:
    from textual.app import ComposeResult
    from textual.events import Key

    from edoras_tools.decode.context import Context

_LAST_WORD: Final = re.compile(r"(?:^|[\s(])([a-z_][\w.]*)$", re.ASCII)
_LAST_VALUE: Final = re.compile(
    r"([a-z_][\w.]*)\s*(?:[!=]=|in\s*\{(?:[^{}]*,)?)\s*([^\s,{}()\"']*)$", re.ASCII
)
_KEYWORDS: Final = ("and", "or", "not", "in", "contains", "matches", "any", "all", "len")
_OFFERED: Final = 6
"""Number of completions shown at once."""


class Completions(Static):
    """Completions for the last word of a filter: names of fields, or values of a field; one is chosen.

    Attributes:
        words: completions; empty if there are none.
        chosen: index of the completion that Tab accepts.
    """

    def __init__(self, context: Context) -> None:
        super().__init__(id="filter-completions")
        self._decoding = context
        self._names: Names | None = None
        self._fields: list[str] = []
        self._start = 0
        self.words: list[str] = []
        self.chosen = 0

    def offer(self, value: str) -> None:
        """Show completions for the last word of a filter."""
        self._start, words = self._find(value)
        typed = value[self._start :].lower()
        self.words = [word for word in words if word.lower().startswith(typed)]
        if typed in map(str.lower, self.words):
            self.words = []  # the word is complete
        self.chosen = 0
        self._draw()

    def move(self, by: int) -> None:
        """Choose another completion."""
        self.chosen = (self.chosen + by) % len(self.words)
        self._draw()

    def accept(self, value: str) -> str:
        """Return the filter with the chosen completion as its last word."""
        return value[: self._start] + self.words[self.chosen]

    def hide(self) -> None:
        """Show no completions."""
        self.words = []
        self._draw()

    def _find(self, value: str) -> tuple[int, Sequence[str]]:
        """Return the begin of the last word, and all words that could replace it."""
        if self._names is None:
            self._names = Names(self._decoding)
            self._fields = sorted(set(self._names.all()), key=lambda name: (name.count("."), len(name), name))
        if (match := _LAST_VALUE.search(value)) is not None:
            with suppress(Unknown):
                fields = self._names.find(match[1])
                return match.start(2), [
                    word for field in fields for word in (*field.names.values(), *field.choices)
                ]
            return len(value), ()
        match = _LAST_WORD.search(value)
        if match is None or match[1] in _KEYWORDS:
            return len(value), ()
        return match.start(1), self._fields

    def _draw(self) -> None:
        self.display = bool(self.words)
        first = max(0, min(self.chosen - _OFFERED + 1, len(self.words) - _OFFERED))
        lines = [
            Text(f" {clean(word)} ", "reverse" if first + place == self.chosen else "")
            for place, word in enumerate(self.words[first : first + _OFFERED])
        ]
        more = len(self.words) - len(lines)
        hint = f" {more:,} more · " * bool(more) + "Tab accepts · ↑ ↓ choose"
        self.update(Text("\n").join([*lines, Text(hint if more else f" {hint}", "dim")]))


class FilterLine(Vertical):
    """The filter, its error, and the number of packets that pass.

    Posts ``Applied`` with a valid filter; None lets all packets pass.

    Attributes:
        applied: filter that the list shows.
        history: filters that were entered, the latest last.
        input: text field.
        count: number of packets that pass.
        completions: completions of the last word.
        wrong: caret and error.
    """

    class Applied(Message):
        """A filter was applied."""

        def __init__(self, where: Where | None) -> None:
            super().__init__()
            self.where = where

    def __init__(self, context: Context) -> None:
        super().__init__(id="filter-line")
        self._decoding = context
        self.applied = ""
        self.history: list[str] = []
        self.completions = Completions(context)
        self.input = _Line(
            placeholder="msg_id == 0x827 and pose.position.x > 1",
            completions=self.completions,
            id="filter",
            compact=True,
            select_on_focus=False,
        )
        self.input.history = self.history
        self.count = Static(id="filter-count")
        self.wrong = Static(id="filter-wrong")

    def compose(self) -> ComposeResult:
        """Lay out the line, and space for the error."""
        with Horizontal():
            yield Static("Filter ", id="filter-label")
            yield self.input
            yield self.count
        yield self.completions
        yield self.wrong

    def show_count(self, text: str) -> None:
        """Show the number of packets that pass, or that the text is not the applied filter."""
        pending = self.input.value.strip() != self.applied.strip()
        self.count.update("Enter applies" if pending else text)

    def restore(self) -> None:
        """Show the applied filter; a text that was not applied goes to the history."""
        self._keep(self.input.value)
        self.input.value = self.applied
        self._show(None)

    def compile(self, text: str, begin_ns: int | None) -> Where | None:
        """Compile a filter; None lets all packets pass.

        Raises:
            WhereError: the filter is not valid.
        """
        return Where(text, self._decoding, begin_ns) if text.strip() else None

    def accept(self, text: str, begin_ns: int | None) -> bool:
        """Apply a filter, or show its error with a caret; return whether it was applied."""
        self.input.value = text
        try:
            where = self.compile(text, begin_ns)
        except WhereError as error:
            self._show(error)
            return False
        self._show(None)
        self.completions.hide()
        self._keep(text)
        self.applied = text
        self.post_message(self.Applied(where))
        return True

    def _keep(self, text: str) -> None:
        if text.strip():
            self.history[:] = [*(item for item in self.history if item != text), text]

    def on_input_changed(self, event: Input.Changed) -> None:
        """Colour the line: green for a valid filter, red for one with an error."""
        event.stop()
        try:
            self.compile(event.value, None)
        except WhereError:
            self.input.set_class(True, "-wrong")
            self.input.set_class(False, "-right")
        else:
            self.input.set_class(False, "-wrong")
            self.input.set_class(bool(event.value.strip()), "-right")
        self.wrong.display = False
        if self.input.has_focus and self.input.cursor_at_end and event.value not in self.history:
            self.completions.offer(event.value)

    def on_descendant_blur(self) -> None:
        """Hide the completions."""
        self.completions.hide()

    def _show(self, error: WhereError | None) -> None:
        self.wrong.display = error is not None
        if error is None:
            return
        self.completions.hide()
        field = self.input
        before = field.region.x - self.region.x
        place = before + error.at - round(field.scroll_x)
        marks = "^" * max(1, min(error.end - error.at, self.region.width - place))
        style = Level.ERROR.style
        error_lines = [Text(line) for line in wrap(clean(error.why), max(20, self.region.width - before))]
        lines = [Text(" " * max(before, place) + marks, style)]
        # The message stands after the caret if it fits, as in compilers, else below it.
        if len(error_lines) == 1 and place + len(marks) + 1 + error_lines[0].cell_len <= self.region.width:
            lines[0].append_text(Text(" ")).append_text(Text(error_lines[0].plain, "not bold"))
        else:
            lines += [Text(" " * before).append_text(line) for line in error_lines]
        self.wrong.update(Text("\n").join(lines))
        field.cursor_position = error.at
        field.focus()


class Prompt(Horizontal):
    """A line at the bottom that asks for a text; hidden at other times.

    Attributes:
        input: text field.
    """

    def __init__(self) -> None:
        super().__init__(id="prompt")
        self._answer: Callable[[str], object] = str
        self._label = Static(id="prompt-label")
        self.input: Input = _Line(id="prompt-input", compact=True)

    def compose(self) -> ComposeResult:
        """Lay out the line."""
        yield self._label
        yield self.input

    def ask(
        self,
        label: str,
        placeholder: str,
        answer: Callable[[str], object],
        value: str = "",
        *,
        extends: bool = False,
    ) -> None:
        """Ask for a text.

        Args:
            label: shown in front of the line.
            placeholder: shown while the line is empty.
            answer: called with the text, without white space around it.
            value: the initial text.
            extends: whether the user extends the initial text, rather than replaces it.
        """
        self._answer = answer
        self.display = True
        self._label.update(f"{label} ")
        self.input.placeholder = placeholder
        self.input.value = value
        self.input.select_on_focus = not extends
        self.input.cursor_position = len(value)
        self.input.focus()

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Pass the answer on."""
        event.stop()
        self.display = False
        self._answer(event.value.strip())


class Sheet(ModalScreen[str]):
    """A table of keys over the view; Escape, q, ? or Enter close it, and so does a key that has an answer.

    Args:
        title: title of the table.
        rows: keys with their actions; a heading has no keys.
        answers: results by key.
    """

    BINDINGS: ClassVar[list[Any]] = [
        Binding("escape,q,question_mark,enter,space", "dismiss", "Close", show=False)
    ]

    def __init__(self, title: str, rows: Iterable[tuple[str, str]], answers: Mapping[str, str] = {}) -> None:
        super().__init__()
        self._title, self._rows, self._answers = title, rows, answers

    def compose(self) -> ComposeResult:
        """Make the table."""
        table = Table.grid(padding=(0, 2))
        table.add_column(no_wrap=True)
        for keys, text in self._rows:
            table.add_row(
                Text(f"  {keys}", "cyan") if keys else Text(text, "bold"), Text(text if keys else "")
            )
        box = VerticalScroll(Static(table))
        box.border_title = self._title
        yield box

    def on_key(self, event: Key) -> None:
        """Return the answer of a key."""
        if (answer := self._answers.get(event.character or "")) is not None:
            event.stop()
            self.dismiss(answer)


class _Line(Input):
    """A line of text: Tab accepts a completion, Up and Down choose one, else an earlier text.

    Down behind the latest text, and Escape, leave the line.

    Args:
        completions: completions; None for none.
        options: arguments of ``Input``.

    Attributes:
        history: earlier texts, the latest last.
    """

    history: Sequence[str] = ()

    BINDINGS: ClassVar[list[Any]] = [
        Binding("enter", "submit", "OK"),
        Binding("tab", "complete", "Complete"),
        Binding("down", "choose(1)", "Next", show=False),
        Binding("up", "choose(-1)", "Previous", show=False),
        Binding("escape", "leave", "Back", key_display="esc"),
    ]

    def __init__(self, *, completions: Completions | None = None, **options: Any) -> None:
        super().__init__(**options)
        self._completions = completions
        self._back, self._draft = 0, ""

    def on_focus(self) -> None:
        """Start at the latest of the earlier texts again."""
        self._back = 0

    @property
    def _offered(self) -> Completions | None:
        return self._completions if self._completions is not None and self._completions.words else None

    def action_complete(self) -> None:
        """Accept the completion; without one, go back to the list."""
        if self._offered:
            self.value = self._offered.accept(self.value)
            self.cursor_position = len(self.value)
        else:
            self._leave()

    def action_choose(self, by: int) -> None:
        """Choose another completion; without one, an earlier text, or go back to the list."""
        back = self._back - by
        if self._offered:
            self._offered.move(by)
        elif back < 0:
            self._leave()
        elif back <= len(self.history):
            if not self._back:
                self._draft = self.value
            self._back = back
            self.value = self.history[-back] if back else self._draft
            self.cursor_position = len(self.value)

    def action_leave(self) -> None:
        """Hide the completions; if none are shown, go back to the list."""
        if self._offered:
            self._offered.hide()
        else:
            self._leave()

    def _leave(self) -> None:
        self.app.action_leave()  # type: ignore[attr-defined]  # a method of the viewer
