"""``edoras sniff --tui``: the three-pane view on the terminal."""

from __future__ import annotations

import os
import sys
from importlib.util import find_spec
from typing import TYPE_CHECKING

import typer

from edoras_tools.cli.endings import nothing_shown
from edoras_tools.errors import CaptureError, ConfigError

if TYPE_CHECKING:
    from edoras_tools.pipelines.selection import Selection
    from edoras_tools.pipelines.workbench import Settings, Workbench
    from edoras_tools.sources import Source


def check_terminal() -> None:
    """Find out early whether the view can be shown.

    Raises:
        ConfigError: there is no textual, or standard output is no terminal.
    """
    if find_spec("textual") is None:
        raise ConfigError("--tui needs textual: pip install 'edoras-tools[tui]'")
    if not sys.stdout.isatty():
        raise ConfigError("--tui needs a terminal, and standard output is none; leave --tui out")


def show(
    source: Source,
    bench: Workbench,
    settings: Settings,
    selection: Selection,
    time: str,
    *,
    count: int | None,
    duration_ns: int | None,
    verbose: bool,
) -> None:
    """Show packets until the user quits.

    Raises:
        EdorasError: the filter or a topic is wrong, the source ended early, or held no UDP at all.
        typer.Exit: with code 3, when the capture lost packets.
    """
    from edoras_tools.render.packet_list import TimeFormat
    from edoras_tools.tui.viewer import Choice, Viewer

    live = hasattr(source, "stop")
    try:
        selection.over(bench)
        _take_keyboard()
        choice = Choice(
            selection,
            settings,
            time_format=TimeFormat(time),
            follow=live,
            count=count or 0,
            duration_ns=duration_ns or 0,
            verbose=verbose,
        )
        viewer = Viewer(source, bench, choice)
    except BaseException:
        source.close()
        raise
    viewer.run()
    if viewer.return_code:
        raise typer.Exit(viewer.return_code)
    if viewer.failure:
        raise CaptureError(viewer.failure)
    # A file that was not read to its end has not shown that there is nothing in it.
    nothing_shown(source, viewer.ledger.datagrams, live=live or viewer.reading)


def _take_keyboard() -> None:
    """Make the terminal standard input where packets come from there, as in ``tcpdump -w - | ...``.

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
