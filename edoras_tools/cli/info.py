"""``edoras info``: what is in a capture or a recording."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from edoras_tools.cli import options

if TYPE_CHECKING:
    from edoras_tools.pipelines.selection import Selection
    from edoras_tools.pipelines.workbench import Settings


@options.takes_decoding
@options.takes_choice
def info(
    settings: Settings,
    selection: Selection,
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="pcap, pcapng or MCAP; - is stdin.")],
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Tell what is in a capture: routes, counts, rates, jitter, gaps, sizes and findings."""
    from edoras_tools.cli.endings import finish
    from edoras_tools.cli.inputs import open_input
    from edoras_tools.pipelines.info import inspect
    from edoras_tools.render.watch import watcher

    source, bench = open_input(files, None, None, settings)
    with watcher(source, None, quiet=quiet or json, live=False) as watch:
        report = inspect(source, bench, selection=selection, watcher=watch)
    if json:
        from edoras_tools.cli.output import print_json

        print_json(report.summary())
    elif report.ledger.datagrams:
        from edoras_tools.render.console import output_console
        from edoras_tools.render.info import capture_summary

        output_console().print(capture_summary(report.summary()))
    finish(report, live=False)
