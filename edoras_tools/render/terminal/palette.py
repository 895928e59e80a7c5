"""Colours with one meaning each, readable on light and on dark backgrounds.

Red, green, yellow, magenta, cyan and bright blue; dim, bold and reverse. Not plain blue, which is too dark on
black, and no other bright colour: cyan and yellow vanish on white, and Solarized's background is its bright
black. A word or a mark always repeats the meaning of a colour.

xterm's own yellow, cyan and green vanish on white (1.7 to 2.2 to 1). Where a terminal has 256 colours they
are shades with 3.1 to 6.3 to 1 on white, black and both grounds of Solarized.

``detect_terminal`` finds the abilities of the stream that a view is written to.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import Final, NamedTuple, TextIO

from rich.color import ColorSystem
from rich.console import Console
from rich.style import Style
from rich.theme import Theme

_WIDE: Final = "256color" in os.environ.get("TERM", "") or "COLORTERM" in os.environ
SHADES: Final = {"yellow": "color(136)", "cyan": "color(30)", "green": "color(64)"} if _WIDE else {}
"""Name of a colour to a darker shade; empty on terminals with sixteen colours."""

DIM: Final = "dim"
STRONG: Final = "bold"
GOOD: Final = "green"
CHOSEN: Final = "reverse"
"""Style of bytes that the user selected."""

_ORANGE: Final = "color(166)" if _WIDE else "bold bright_blue"
_LAYERS: Final = {
    "sbn": "magenta",
    "ccsds": "cyan",
    "cfe": "bright_blue",
    "edoras": "yellow",
    "cdr": _ORANGE,
    "ethernet": DIM,
    "ip": DIM,
    "ipv4": DIM,
    "ipv6": DIM,
    "udp": DIM,
    "frame": DIM,
    "padding": DIM,
}
_BODY: Final = "green"
_FREE: Final = ("cyan", "yellow", "magenta", "bright_blue", _BODY, _ORANGE)
"""Styles for layers whose own style is already used by another layer of the packet."""


def layer(name: str) -> str:
    """Return the style of a layer; layers of one protocol (``cfe_command``, ``cfe_event``) share theirs."""
    return _LAYERS.get(name) or _LAYERS.get(name.partition("_")[0], _BODY)


def layers(names: Iterable[str]) -> dict[str, str]:
    """Return the style of each layer of a packet, outermost first: all different, up to six layers."""
    styles: dict[str, str] = {}
    for name in dict.fromkeys(names):
        style = layer(name)
        if style != DIM and style in styles.values():
            style = next((item for item in _FREE if item not in styles.values()), style)
        styles[name] = style
    return styles


@lru_cache(maxsize=256)
def escapes(style: str) -> tuple[str, str]:
    """Return the ANSI sequences that begin and end a rich style such as ``bold red``."""
    style = " ".join(SHADES.get(word, word) for word in style.split())
    before, _, after = Style.parse(style).render("|", color_system=ColorSystem.EIGHT_BIT).partition("|")
    return before, after


class Paint:
    """Applies styles to text; without colour it returns the text unchanged."""

    __slots__ = ("colour",)

    def __init__(self, colour: bool) -> None:
        self.colour = colour

    def __call__(self, text: str, style: str) -> str:
        """Return clean text in a rich style."""
        if not self.colour or not text or not style:
            return text
        before, after = escapes(style)
        return f"{before}{text}{after}"


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
