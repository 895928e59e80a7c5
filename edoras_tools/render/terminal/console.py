"""Rich consoles on the standard streams, as wide and as colourful as those can show."""

from __future__ import annotations

import sys
from typing import TextIO

from rich.console import Console

from edoras_tools.render.terminal.terminal import look


def output_console() -> Console:
    """Return a console on standard output, for tables."""
    return _console(sys.stdout)


def error_console() -> Console:
    """Return a console on standard error, for progress and live tables."""
    return _console(sys.stderr)


def _console(stream: TextIO) -> Console:
    terminal = look(stream)
    return Console(
        file=stream,
        width=None if terminal.interactive else terminal.width,
        color_system="standard" if terminal.colour else None,
        force_terminal=terminal.colour or terminal.interactive,
        highlight=False,
        markup=False,
        emoji=False,
    )
