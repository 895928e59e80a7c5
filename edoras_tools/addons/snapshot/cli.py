"""Functions that ``edoras record`` calls for its options on snapshots."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from edoras_tools.addons.snapshot.sink import ask, listening, record_snapshots
from edoras_tools.cli.output import finish, print_json, watcher
from edoras_tools.pipelines.reading import Keys, Limits
from edoras_tools.words import plural

if TYPE_CHECKING:
    from pathlib import Path

    from edoras_tools.cli.options import PrintOptions
    from edoras_tools.cli.record import SnapshotOptions
    from edoras_tools.io import Source
    from edoras_tools.pipelines.capture.record import Target
    from edoras_tools.pipelines.selection import Selection
    from edoras_tools.pipelines.workbench import Workbench


def fire(path: Path) -> str:
    """Ask the recorder at a socket for a snapshot; return its answer."""
    return ask(path)


def record(
    source: Source,
    bench: Workbench,
    target: Target,
    request: SnapshotOptions,
    selection: Selection,
    limits: Limits,
    printing: PrintOptions,
) -> None:
    """Record snapshots, and print what was recorded.

    Raises:
        EdorasError: the source ended early, or a file cannot be written.
        typer.Exit: with code 3, if packets were lost.
    """
    with ExitStack() as stack:
        stack.callback(source.close)
        is_terminal = sys.stdin is not None and sys.stdin.isatty()
        keys = stack.enter_context(Keys()) if is_terminal else None
        triggers = stack.enter_context(listening(keys, request.socket))
        quiet = printing.quiet or printing.json
        watch = stack.enter_context(watcher(source, None, quiet=quiet, live=source.live))
        how: dict[str, Any] = {"selection": selection, "limits": limits, "watcher": watch}
        report, sink = record_snapshots(source, bench, target, request, triggers=triggers, **how)
    if printing.json:
        print_json(
            {
                **report.summary(),
                "outputs": [str(item) for item in report.outputs],
                "snapshots": [item.as_json() for item in sink.snapshots],
                "dropped": sink.dropped,
                "deleted": {"files": report.keep.deleted, "datagrams": report.keep.datagrams},
            }
        )
    elif not printing.quiet:
        files = plural(len(sink.snapshots), "snapshot") if sink.snapshots else "no trigger fired, no file"
        sys.stderr.write(f"{files}; {report.ledger.datagrams:,} datagrams were seen\n")
    finish(report, live=source.live)
