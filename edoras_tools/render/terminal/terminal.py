"""What the stream that a view goes to can show."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, TextIO

if TYPE_CHECKING:
    from collections.abc import Mapping

FILE_WIDTH: Final = 1_000_000
"""Columns for a pipe or a file: nothing is cut."""
_DEFAULT_WIDTH: Final = 80


@dataclass(frozen=True, slots=True)
class Terminal:
    """Where a view goes.

    Attributes:
        width: columns.
        colour: whether ANSI styles are wanted.
        interactive: whether it is a terminal that can redraw, for progress bars and live tables.
    """

    width: int
    colour: bool
    interactive: bool


def look(stream: TextIO, environ: Mapping[str, str] | None = None) -> Terminal:
    """Find out what a stream can show.

    ``NO_COLOR`` and ``TERM=dumb`` forbid colour, ``FORCE_COLOR`` asks for it, ``COLUMNS`` sets the width.

    Args:
        stream: usually ``sys.stdout`` or ``sys.stderr``.
        environ: instead of the process's own.
    """
    environ = os.environ if environ is None else environ
    tty = stream.isatty()
    dumb = environ.get("TERM") == "dumb"
    colour = not environ.get("NO_COLOR") and (bool(environ.get("FORCE_COLOR")) or (tty and not dumb))
    return Terminal(_width(stream, environ, tty=tty), colour, tty and not dumb)


def _width(stream: TextIO, environ: Mapping[str, str], *, tty: bool) -> int:
    columns = environ.get("COLUMNS", "")
    if columns.isascii() and columns.isdigit() and int(columns):
        return int(columns)
    if not tty:
        return FILE_WIDTH
    try:
        return os.get_terminal_size(stream.fileno()).columns or _DEFAULT_WIDTH
    except (OSError, ValueError):
        return _DEFAULT_WIDTH
