"""The abilities of the stream that a view is written to."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, Final, NamedTuple, TextIO

from rich.console import Console
from rich.theme import Theme

from edoras_tools.render.terminal.palette import SHADES

if TYPE_CHECKING:
    from collections.abc import Mapping


def output_console() -> Console:
    """Return a console on standard output, for tables."""
    return _console(sys.stdout)


def error_console() -> Console:
    """Return a console on standard error, for progress and live tables."""
    return _console(sys.stderr)


def _console(stream: TextIO) -> Console:
    terminal = detect_terminal(stream)
    bold = {f"{name} bold": f"{shade} bold" for name, shade in SHADES.items()}  # a theme knows whole styles
    return Console(
        file=stream,
        width=None if terminal.interactive else terminal.width,
        color_system="256" if terminal.colour else None,
        theme=Theme(SHADES | bold),
        force_terminal=terminal.colour or terminal.interactive,
        highlight=False,
        markup=False,
        emoji=False,
    )


FILE_WIDTH: Final = 1_000_000
"""Columns for a pipe or a file: nothing is cut."""
_DEFAULT_WIDTH: Final = 80


class Terminal(NamedTuple):
    """The output of a view.

    Attributes:
        width: columns.
        colour: whether ANSI styles are wanted.
        interactive: whether it is a terminal that can redraw, for progress bars and live tables.
    """

    width: int
    colour: bool
    interactive: bool


def detect_terminal(stream: TextIO, environ: Mapping[str, str] | None = None) -> Terminal:
    """Return the abilities of a stream.

    ``NO_COLOR`` and ``TERM=dumb`` forbid colour, ``FORCE_COLOR`` asks for it, ``COLUMNS`` sets the width.

    Args:
        stream: usually ``sys.stdout`` or ``sys.stderr``.
        environ: environment in place of the process's own.
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
