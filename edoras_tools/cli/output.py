"""The output of commands: views, JSON and CSV on standard output, progress on standard error."""

from __future__ import annotations

import csv
import json
import os
import sys
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Annotated, Any

from typer import BadParameter, Option

from edoras_tools import doors
from edoras_tools.cli.settings import in_effect
from edoras_tools.errors import EdorasError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence
    from pathlib import Path

    from rich.console import RenderableType

    from edoras_tools.io import Source
    from edoras_tools.model import Endpoint
    from edoras_tools.render.terminal.progress import FileProgress
    from edoras_tools.render.terminal.text import ReadingRun, Watcher


def watcher(
    source: Source, output: Path | None, *, quiet: bool, live: bool
) -> AbstractContextManager[Watcher[ReadingRun] | None]:
    """Return the view of a run on standard error: a live table, a progress bar, or nothing.

    Args:
        output: output file, if any.
        quiet: whether to show nothing; if standard error is no terminal, nothing is shown either.
        live: whether the source is live, so that a progress bar would have no end.
    """
    if quiet or not sys.stderr.isatty() or os.environ.get("TERM") == "dumb":
        return nullcontext()  # and nothing is loaded that shows
    if not live:
        return file_progress([source.info.name], quiet=False)
    from edoras_tools.render.capture.watch import live_table
    from edoras_tools.render.terminal.terminal import error_console

    title = f"{source.info.name} → {output}" if output else source.info.name
    return live_table(title, error_console(), output)


def address(text: str) -> Endpoint:
    """Read ``HOST:PORT``."""
    from edoras_tools.io.net.address import parse_endpoint

    try:
        return parse_endpoint(text)
    except EdorasError as error:
        raise BadParameter(str(error)) from None


def place(text: str) -> Endpoint:
    """Read ``[HOST:]PORT``; the default host is 127.0.0.1."""
    return address(text if ":" in text else f"127.0.0.1:{text}")


Metrics = Annotated[
    Any,
    Option("--metrics", parser=place, metavar="[HOST:]PORT", help="Serve figures for Prometheus, e.g. 9100."),
]


def measured(watcher: AbstractContextManager[Any], metrics: Endpoint | None) -> AbstractContextManager[Any]:
    """Return a watcher that also serves the figures of the run, if this is requested."""
    return doors.part("metrics")(watcher, metrics) if metrics else watcher


def print_json(value: Mapping[str, Any]) -> None:
    """Print one JSON object, as ``docs/schemas`` describes it.

    ``schema`` is the version of its shape, 1 unless the value has another one; ``settings`` is the path of
    the settings file, if there is one.
    """
    file = in_effect()
    value = {"schema": 1, **value} | ({"settings": str(file.path)} if file else {})
    sys.stdout.write(json.dumps(value, indent=2, ensure_ascii=False) + "\n")


def print_csv(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print rows with the same keys as CSV with a header; lists and maps as JSON, None as an empty field."""
    if rows:
        write_csv(list(rows[0]), (list(row.values()) for row in rows))


def write_csv(names: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Print rows below the names of their columns, as ``print_csv`` does; a terminal gets no raw escapes."""
    writer = csv.writer(sys.stdout)
    from edoras_tools.render.terminal.text import clean

    escaped = clean if sys.stdout.isatty() else str

    def cell(value: Any) -> Any:
        if isinstance(value, dict | list):
            value = json.dumps(value, ensure_ascii=False)
        return escaped(value) if isinstance(value, str) else value

    writer.writerow(map(cell, names))
    for row in rows:
        writer.writerow(map(cell, row))


def print_view(view: RenderableType | Callable[[int], RenderableType], *, is_whole: bool = False) -> None:
    """Print a view for people; a function of the width is called with that of the terminal.

    Args:
        is_whole: whether its lines are already wrapped; longer ones are for pasting, and stay whole.
    """
    from edoras_tools.render.terminal.terminal import output_console

    console = output_console()
    console.print(view(console.width) if callable(view) else view, soft_wrap=is_whole)


def file_progress(names: Iterable[object], *, quiet: bool) -> FileProgress:
    """Return the progress bar for reading and judging the named files."""
    from edoras_tools.render.terminal.progress import FileProgress
    from edoras_tools.render.terminal.terminal import error_console

    return FileProgress(", ".join(map(str, names)), console=error_console(), quiet=quiet)
