"""The filter line at the top, and the line that asks for a search text or a packet number."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, ClassVar, Final

from rich.text import Text
from textual.binding import Binding
from textual.containers import Horizontal, Vertical
from textual.message import Message
from textual.suggester import Suggester
from textual.widgets import Input, Static

from edoras_tools.decode.filters.filter import Where
from edoras_tools.decode.filters.names import Names
from edoras_tools.decode.filters.syntax import WhereError
from edoras_tools.render.severity import Level
from edoras_tools.render.terminal.text import clean, wrap

if TYPE_CHECKING:
    from textual.app import ComposeResult

    from edoras_tools.decode.context import Context

_LAST_WORD: Final = re.compile(r"(?:^|[\s(])([a-z_][\w.]*)$", re.ASCII)
_KEYWORDS: Final = ("and", "or", "not", "in", "contains", "matches", "any", "all", "len")


class _Fields(Suggester):
    """Completes field names."""

    def __init__(self, context: Context) -> None:
        super().__init__(case_sensitive=True)
        self._decoding = context
        self._names: list[str] = []

    async def get_suggestion(self, value: str) -> str | None:
        """Return the value with its last word completed to the shortest field name that begins with it."""
        found = _LAST_WORD.search(value)
        if found is None or found[1] in _KEYWORDS:
            return None
        if not self._names:
            self._names = sorted(
                set(Names(self._decoding).all()), key=lambda name: (name.count("."), len(name), name)
            )
        name = next((name for name in self._names if name.startswith(found[1]) and name != found[1]), None)
        return None if name is None else value[: found.start(1)] + name


class FilterLine(Vertical):
    """The filter, the error in it, and how many packets pass.

    Posts ``Applied`` with a valid filter; None lets all packets pass.

    Attributes:
        input: the text field.
        count: how many packets pass.
        wrong: the caret and the error.
    """

    class Applied(Message):
        """A filter was applied."""

        def __init__(self, where: Where | None) -> None:
            super().__init__()
            self.where = where

    def __init__(self, context: Context) -> None:
        super().__init__(id="filter-line")
        self._decoding = context
        self.input: Input = _Line(
            placeholder="msg_id == 0x827 and pose.position.x > 1",
            suggester=_Fields(context),
            id="filter",
            compact=True,
            select_on_focus=False,
        )
        self.count = Static(id="filter-count")
        self.wrong = Static(id="filter-wrong")

    def compose(self) -> ComposeResult:
        """Lay out the line, and a place for the error."""
        with Horizontal():
            yield Static("Filter ", id="filter-label")
            yield self.input
            yield self.count
        yield self.wrong

    def show_count(self, text: str) -> None:
        """Show how many packets pass."""
        self.count.update(text)

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
        self.post_message(self.Applied(where))
        return True

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

    def _show(self, error: WhereError | None) -> None:
        self.wrong.display = error is not None
        if error is None:
            return
        field = self.input
        before = field.region.x - self.region.x
        place = before + error.at - round(field.scroll_x)
        marks = "^" * max(1, min(error.end - error.at, self.region.width - place))
        style = Level.ERROR.style
        told = [Text(line) for line in wrap(clean(error.why), max(20, self.region.width - before))]
        lines = [Text(" " * max(before, place) + marks, style)]
        # The message stands after the caret if there is space, as in compilers, else below it.
        if len(told) == 1 and place + len(marks) + 1 + told[0].cell_len <= self.region.width:
            lines[0].append_text(Text(" ")).append_text(Text(told[0].plain, "not bold"))
        else:
            lines += [Text(" " * before).append_text(line) for line in told]
        self.wrong.update(Text("\n").join(lines))
        field.cursor_position = error.at
        field.focus()


class Prompt(Horizontal):
    """A line at the bottom that asks for a text; hidden at other times.

    Posts ``Given`` with the kind of question and the answer.

    Attributes:
        input: the text field.
    """

    class Given(Message):
        """A text was entered."""

        def __init__(self, kind: str, text: str) -> None:
            super().__init__()
            self.kind = kind
            self.text = text

    def __init__(self) -> None:
        super().__init__(id="prompt")
        self._kind = ""
        self._label = Static(id="prompt-label")
        self.input: Input = _Line(id="prompt-input", compact=True)

    def compose(self) -> ComposeResult:
        """Lay out the line."""
        yield self._label
        yield self.input

    def ask(self, kind: str, label: str, placeholder: str, value: str = "") -> None:
        """Ask for a text.

        Args:
            kind: returned with the answer.
            label: shown in front of the line.
            placeholder: shown while the line is empty.
            value: the initial text.
        """
        self._kind = kind
        self.display = True
        self._label.update(f"{label} ")
        self.input.placeholder = placeholder
        self.input.value = value
        self.input.focus()

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Post the answer."""
        event.stop()
        self.display = False
        self.post_message(self.Given(self._kind, event.value))


class _Line(Input):
    """A line of text: Tab accepts the completion, Escape and Down go back to the list."""

    BINDINGS: ClassVar[list[Any]] = [
        Binding("enter", "submit", "Apply"),
        Binding("tab", "complete", "Complete"),
        Binding("escape,down", "app.leave", "Back", key_display="esc"),
    ]

    def action_complete(self) -> None:
        """Accept the completion; without one, go back to the list."""
        if self._suggestion:
            self.value = self._suggestion
            self.cursor_position = len(self.value)
        else:
            self.app.action_leave()  # type: ignore[attr-defined]  # a method of the viewer
