"""The output of commands: views, JSON and CSV on standard output, progress on standard error, exit codes.

A command says last what was lost, and ends with ``LOST`` if anything was.
"""

from __future__ import annotations

import csv
import json
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import BadParameter, Option

from edoras_tools import doors
from edoras_tools.cli.settings import in_effect
from edoras_tools.errors import CaptureError, EdorasError

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import RenderableType

    from edoras_tools.decode import Context
    from edoras_tools.io import Source
    from edoras_tools.io.formats.watched import OutputLoss
    from edoras_tools.model import Endpoint
    from edoras_tools.pipelines.capture.record import CaptureReport
    from edoras_tools.pipelines.export.sources import TopicSource
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
    from edoras_tools.render.capture.info import live_table
    from edoras_tools.render.terminal.palette import error_console

    title = f"{source.info.name} → {output}" if output else source.info.name
    return live_table(title, error_console(), output)


def address(text: str) -> Endpoint:
    """Read ``HOST:PORT``."""
    from edoras_tools.io.net.sockets import parse_endpoint

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
    writer = csv.writer(sys.stdout, lineterminator="\n")
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
    from edoras_tools.render.terminal.palette import output_console

    console = output_console()
    console.print(view(console.width) if callable(view) else view, soft_wrap=is_whole)


def file_progress(names: Iterable[object], *, quiet: bool) -> FileProgress:
    """Return the progress bar for reading and judging the named files."""
    from edoras_tools.render.terminal.palette import error_console
    from edoras_tools.render.terminal.progress import FileProgress

    return FileProgress(", ".join(map(str, names)), console=error_console(), quiet=quiet)


LOST = 3
"""Exit code: finished, but data was lost or found lost."""
INTERRUPTED = 130
"""Exit code of a command that Ctrl-C, SIGTERM or SIGHUP ended before its work was done, as in shells."""


def no_datagrams(source: Source) -> None:
    """Raise an error if a file contained no UDP datagram.

    Raises:
        CaptureError: the file contained none.
    """
    statistics = source.statistics
    if not statistics.datagrams:
        content = f"{statistics.skipped:,} frames of other kinds" if statistics.skipped else "it is empty"
        raise CaptureError(f"{source.info.name}: no UDP datagram in it ({content}); nothing to decode")


def nothing_shown(source: Source, count: int, context: Context, *, live: bool, every: bool) -> None:
    """Print why a list is empty, notes from decoding, and the capture's losses.

    Args:
        count: number of packets shown.
        live: whether the source has no end.
        every: whether datagrams of no link were shown too.

    Raises:
        CaptureError: a file contained no UDP at all.
        typer.Exit: with code 3, if the capture lost packets, or traffic of a link was left out.
    """
    if not count and not live:
        no_datagrams(source)
    tell(*context.notes)
    if not count:
        _none_chosen(source, "" if every else "; -a shows every link")
    lost(source)
    end(lost=context.unnamed and not every)


def _none_chosen(source: Source, hint: str = "") -> None:
    if total := source.statistics.datagrams:
        tell(f"none of the {total:,} datagrams was selected{hint}")


def lost(source: Source) -> None:
    """End with exit code 3 if the capture itself lost packets.

    Raises:
        typer.Exit: with code 3, if it did.
    """
    statistics = source.statistics
    lines = statistics.warnings
    if statistics.outages:
        from edoras_tools.render.capture.host import outage_lines

        lines = [*lines, *outage_lines(statistics.outages)]
    tell(*lines)
    if drops := statistics.kernel_drops:
        end(f"the capture itself lost {drops:,} packets; it was too slow for them", lost=drops)


def say(*lines: str) -> None:
    """Print lines on standard error, without the program's name."""
    sys.stderr.writelines(f"{line}\n" for line in lines)
    sys.stderr.flush()


def tell(*lines: str) -> None:
    """Print lines on standard error while a command runs."""
    say(*(f"edoras: {line}" for line in lines))


def end(*lines: str, failure: EdorasError | None = None, lost: object = False) -> None:
    """End a command: print lines, then the reason why its work ended early, or that something was lost.

    Args:
        failure: error that ended the work early, if any.
        lost: true if data was lost or found lost.

    Raises:
        EdorasError: ``failure``.
        typer.Exit: with code 3, if something was lost.
    """
    tell(*lines)
    if failure is not None:
        raise failure
    if lost:
        raise typer.Exit(LOST)


def tell_reach(endpoint: Endpoint, may: str, **words: str) -> None:
    """Print before any traffic who may send to a port, except on loopback. See ``reach_note``."""
    from edoras_tools.io.net.sockets import reach_note

    if note := reach_note(endpoint, may, **words):
        tell(note)


def lost_outputs(losses: Sequence[OutputLoss]) -> None:
    """Report outputs that were removed while they were written.

    Raises:
        typer.Exit: with code 3, if there are any.
    """
    end(*map(str, losses), lost=losses)


def topics_read(source: TopicSource) -> None:
    """End a command that read the topics of an input.

    Raises:
        EdorasError: the input ended early, or contained no UDP at all.
        typer.Exit: with code 3, if the capture lost packets, or traffic of a link was left out.
    """
    tell(*source.notes)
    if source.left_out:
        tell(f"{source.left_out:,} messages are incomplete and were left out")
    end(failure=source.failure)
    if source.source is not None:
        no_datagrams(source.source)
        lost(source.source)
    end(lost=source.unnamed)


def no_messages(source: Source, count: int) -> None:
    """Print that no message was selected.

    Raises:
        CaptureError: the recording has no message.
    """
    total = source.statistics.datagrams
    if not total:
        raise CaptureError(f"{source.info.name}: no message in it")
    if not count:
        tell(f"none of the {total:,} messages was selected")


def finish(report: CaptureReport, *, live: bool) -> None:
    """End a command that read a whole source.

    Raises:
        EdorasError: the source ended early, or contained no UDP at all.
        typer.Exit: with code 3, if the capture lost packets, or traffic of a link was left out.
    """
    ledger = report.ledger
    end(*ledger.unfit(), *ledger.mission.warnings, *report.notes, *ledger.unread, failure=report.failure)
    if ledger.mission.recorded:
        no_messages(report.source, ledger.datagrams)
    elif not live:
        no_datagrams(report.source)
        if not ledger.datagrams:
            _none_chosen(report.source)
    if report.losses:
        with suppress(typer.Exit):
            lost(report.source)
        lost_outputs(report.losses)
    lost(report.source)
    end(lost=report.unnamed)
