"""``edoras export``: the messages of topics as tables."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from shutil import copyfileobj
from tempfile import TemporaryDirectory
from typing import Annotated, Any, NamedTuple

from typer import BadParameter, Option

from edoras_tools import doors
from edoras_tools.cli import options, recordings
from edoras_tools.cli.inputs import FileOptions
from edoras_tools.cli.options import grouped
from edoras_tools.cli.output import file_progress, print_json, topics_read
from edoras_tools.errors import ConfigError
from edoras_tools.io.formats.table import TABLE_FORMATS, TABLES_WRITTEN, TimeForm, written_as

_FORMATS = ", ".join(item.suffix[1:] for item in TABLE_FORMATS)


def table_format(text: str) -> str:
    """Read the name of a table's format."""
    if written_as(Path(f"x.{text}"), table=True) is None:
        raise BadParameter(f"{text!r} is not a table format; use {_FORMATS}")
    return text


class TableOptions(NamedTuple):
    """The content and form of the tables."""

    fields: Annotated[str | None, Option(metavar="A,B,C", help="Only these: 'linear.*,angular.z'.")] = None
    explode: Annotated[bool, Option("--explode", help="A row for each element of a list.")] = False
    time: Annotated[TimeForm, Option(help="utc, ns since 1970, or seconds since the start.")] = TimeForm.UTC
    layout: Annotated[str | None, Option("--format", parser=table_format, help=f"Of DIR: {_FORMATS}.")] = None
    partition: Annotated[
        bool,
        Option("--partition", help="DIR/TOPIC/recording=NAME/: each input, or file of a folder, by itself."),
    ] = False
    force: recordings.Force = False


@grouped
def export(
    *,
    inputs: FileOptions,
    output: Annotated[
        str, Option("--output", "-o", metavar="FILE|DIR/", help=f"A file ({TABLES_WRITTEN}), a folder, or -.")
    ],
    table: TableOptions,
    jobs: options.Jobs = None,
    printing: options.PrintOptions,
    part: options.ScopeOptions,
    decoding: options.DecodingOptions,
) -> None:
    """Export topics as Parquet, Arrow, CSV or JSON Lines.

    The topics are those of a recording: of the mission, of C structs, and /edoras/events,
    /edoras/link_statistics and so on; in a folder each has its own file. Only with --topic:
    /edoras/datagrams, and the results of the doctor, /edoras/verdicts and /edoras/lost.
    A performance log of cFE becomes a trace for Perfetto and Chrome, a .json file.
    """
    if output == "-" and printing.json:
        raise ConfigError("-o - prints the table where --json prints its report: leave one of them out")
    printing = printing._replace(quiet=printing.quiet or output == "-")
    with _printed(output, table.layout) as place:
        _export(place, inputs, table, printing, part, decoding, jobs or 0)


@contextmanager
def _printed(output: str, layout: str | None) -> Iterator[str]:
    """Yield where to write: of ``-`` a temporary file, which is copied to standard output at the end."""
    if output != "-":
        yield output
        return
    with TemporaryDirectory(prefix="edoras-") as folder:
        file = Path(folder) / f"-.{layout or 'csv'}"
        try:
            yield str(file)
        finally:
            if file.exists():
                with file.open("rb") as table:
                    copyfileobj(table, sys.stdout.buffer)


def _export(
    output: str,
    inputs: FileOptions,
    table: TableOptions,
    printing: options.PrintOptions,
    part: options.ScopeOptions,
    decoding: options.DecodingOptions,
    jobs: int,
) -> None:
    from msgspec.structs import replace

    from edoras_tools.io.formats.open import is_cfe_file
    from edoras_tools.pipelines.export.reading import TableForm
    from edoras_tools.pipelines.export.run import ExportTarget
    from edoras_tools.pipelines.export.run import export as write
    from edoras_tools.pipelines.export.sources import open_topics

    path, files = options.recording_path(output), inputs.required()
    if len(files) == 1 and is_cfe_file(files[0]):
        trace = doors.part("performance_trace")(files, path, force=table.force)
        if trace is not None:
            print_written(trace, printing)
            return
    target = ExportTarget.of(path, name=table.layout, folder=output.endswith("/"), force=table.force)
    target.check(files)
    scope = part.scope()
    patterns, scope = scope.selection.topics, replace(scope, selection=replace(scope.selection, topics=()))
    fields = tuple(item.strip() for item in (table.fields or "").split(",") if item.strip())
    form = TableForm(fields, table.explode, table.time)
    quiet, settings = printing.quiet or printing.json, decoding.settings()
    if table.partition:
        how: dict[str, Any] = {"patterns": patterns, "form": form, "jobs": jobs}
        doors.part("partition")(files, target, settings, scope, printing, **how)
        return
    source = open_topics(files, settings, scope)
    with file_progress([source.name], quiet=quiet) as bar:
        report = write(source, target, patterns, form, bar, jobs)
    print_written(report.summary(), printing)
    topics_read(source)


def print_written(summary: dict[str, Any], printing: options.PrintOptions) -> None:
    """Print which files were written."""
    if printing.json:
        print_json(summary)
    elif not printing.quiet:
        from edoras_tools.render.capture.info import exported_lines

        sys.stderr.writelines(f"{line}\n" for line in exported_lines(summary))
