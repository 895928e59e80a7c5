"""Text in terminal cells: escaped, cut and padded."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final, Protocol, TypeVar

from rich.cells import cell_len, chop_cells, set_cell_size

if TYPE_CHECKING:
    from pathlib import Path

    from edoras_tools.io import Source


_Run_contra = TypeVar("_Run_contra", contravariant=True)


class Progress(Protocol):
    """Receives the progress of long work; cheap to call."""

    def read(self, source: Source) -> None:
        """Show the progress of reading a source."""
        ...

    def step(self, activity: str, count: int, of: int) -> None:
        """Show the progress of other work, as ``judging``, 3, 57."""
        ...


class ReadingRun(Protocol):
    """A run that reads a source."""

    @property
    def source(self) -> Source:
        """Source of the datagrams."""
        ...

    def summary(self) -> Mapping[str, Any]:
        """Return the results so far, in the shape of ``info --json``."""
        ...


class Watcher(Protocol[_Run_contra]):
    """A view that shows a run repeatedly; cheap enough to be called for every batch."""

    def update(self, run: _Run_contra, /) -> None:
        """Show the present state of the run."""


def size_of(path: Path) -> int:
    """Return the bytes of a file, or of a directory's files; 0 if it does not exist."""
    try:
        return sum(item.stat().st_size for item in path.iterdir()) if path.is_dir() else path.stat().st_size
    except OSError:
        return 0


ELLIPSIS: Final = "…"
_NAMED: Final = {"\n": r"\n", "\r": r"\r", "\t": r"\t", "\0": r"\0"}
# Variation selectors are printable for Python, but terminals disagree on the width that they give a
# character.
_SELECTORS: Final = re.compile("[\ufe00-\ufe0f\U000e0100-\U000e01ef]")
_UNITS: Final = re.compile(r"(?<=\d) (?=(?:s|ms|Hz|%)(?!\w))")
"""The space between a number and its unit, where no line breaks."""
_JOINED: Final = "\ue000"
"""A character that no text has, in place of that space."""
_STYLES: Final = re.compile("\x1b\\[[0-9;]*m")


def clean(text: str) -> str:
    r"""Return text on one line that cannot drive a terminal.

    Control and format characters (escape sequences, newlines, text direction, joiners) become ``\x1b``,
    ``\u202e`` and the like.
    """
    if text.isprintable() and (text.isascii() or not _SELECTORS.search(text)):
        return text
    return "".join(
        char if char.isprintable() and not _SELECTORS.match(char) else _escape(char) for char in text
    )


def _escape(char: str) -> str:
    if char in _NAMED:
        return _NAMED[char]
    number = ord(char)
    if number < 0x100:
        return f"\\x{number:02x}"
    return f"\\u{number:04x}" if number < 0x10000 else f"\\U{number:08x}"


def cells(text: str) -> int:
    """Return the terminal cells that clean text takes."""
    return len(text) if text.isascii() else cell_len(text)


def clip(text: str, width: int) -> str:
    """Cut clean text to at most ``width`` cells; an ellipsis shows the cut."""
    if cells(text) <= width:
        return text
    return set_cell_size(text, width - 1).rstrip() + ELLIPSIS if width > 0 else ""


def clip_left(text: str, width: int) -> str:
    """Cut the front of clean text so that at most ``width`` cells of its end remain."""
    if cells(text) <= width:
        return text
    if width <= 0:
        return ""
    tail = text[-(width - 1) :] if width > 1 else ""
    while cells(tail) > width - 1:
        tail = tail[1:]
    return ELLIPSIS + tail


def clip_middle(text: str, width: int) -> str:
    """Cut the middle of clean text, for topics whose two ends identify them."""
    if cells(text) <= width:
        return text
    tail = clip_left(text, width - width // 3)
    return set_cell_size(text, max(0, width - cells(tail))) + tail


def fit(text: str, width: int) -> str:
    """Cut or pad clean text to exactly ``width`` cells, at the left."""
    text = clip(text, width)
    return text + " " * (width - cells(text))


def fit_right(text: str, width: int) -> str:
    """Cut or pad clean text to exactly ``width`` cells, at the right."""
    text = clip(text, width)
    return " " * (width - cells(text)) + text


def wrap(text: str, width: int) -> list[str]:
    """Break clean text between words into lines of at most ``width`` cells; longer words are broken anywhere.

    Args:
        text: the text; runs of spaces may shrink to one where a line breaks.
        width: at least 2, so that the widest character has room.
    """
    lines = [""]
    for word in _UNITS.sub(_JOINED, text).split(" "):
        joined = f"{lines[-1]} {word}" if lines[-1] else word
        if cells(joined) <= width:
            lines[-1] = joined
        else:
            lines += chop_cells(word, width)
    return [line.rstrip().replace(_JOINED, " ") for line in lines if line] or [""]


def plain_cells(line: str) -> int:
    """Return the terminal cells of a line that holds ANSI styles and clean text."""
    return cells(_STYLES.sub("", line))
