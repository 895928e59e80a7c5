"""``edoras sniff --tui``: the three-pane view in the terminal."""

from __future__ import annotations

import os
import sys
from importlib.util import find_spec
from typing import TYPE_CHECKING

import typer

from edoras_tools.cli.output import nothing_shown
from edoras_tools.errors import CaptureError, ConfigError, OnFailure

if TYPE_CHECKING:
    from edoras_tools.io import Source
    from edoras_tools.pipelines.reading import Limits
    from edoras_tools.pipelines.selection import Selection
    from edoras_tools.pipelines.workbench import Settings, Workbench
    from edoras_tools.words import TimeFormat


def check_terminal() -> None:
    """Check that the view can be shown.

    Raises:
        ConfigError: textual is not installed, or standard output is not a terminal.
    """
    if find_spec("textual") is None:
        raise ConfigError("--tui needs textual: pip install 'edoras-tools[tui]'")
    if not sys.stdout.isatty():
        raise ConfigError("--tui needs a terminal, and standard output is not one; leave --tui out")


def show(
    source: Source,
    bench: Workbench,
    settings: Settings,
    selection: Selection,
    time: TimeFormat,
    limits: Limits,
    *,
    verbose: bool,
) -> None:
    """Show packets until the user quits.

    Raises:
        EdorasError: the filter or a topic is wrong, the source ended early, or contained no UDP at all.
        typer.Exit: with code 3, if the capture lost packets.
    """
    from edoras_tools.addons.tui.viewer import Viewer, ViewOptions

    with OnFailure(source.close):
        selection.over(bench)
        _take_keyboard()
        choice = ViewOptions(
            selection, settings, time_format=time, follow=source.live, limits=limits, verbose=verbose
        )
        viewer = Viewer(source, bench, choice)
    viewer.run()
    if viewer.return_code:
        raise typer.Exit(viewer.return_code)
    if viewer.failure:
        raise CaptureError(viewer.failure)
    # Only a file that was read to its end is known to be empty.
    count, context = viewer.ledger.datagrams, bench.columns.context
    nothing_shown(source, count, context, live=source.live or viewer.reading, every=True)


def _take_keyboard() -> None:
    """Use the terminal as standard input if packets come from standard input, as in ``tcpdump -w - | ...``.

    Raises:
        ConfigError: there is no terminal.
    """
    if sys.stdin.isatty():
        return
    try:
        terminal = os.open("/dev/tty", os.O_RDWR)
    except OSError as error:
        raise ConfigError("--tui needs a keyboard, and there is no terminal; leave --tui out") from error
    os.dup2(terminal, 0)
    os.close(terminal)
