"""``edoras archive``: an index of many recordings, and queries of it."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from typer import Argument, Exit, Option

from edoras_tools.cli import options, recordings
from edoras_tools.cli.main import Command, Group, command_group
from edoras_tools.cli.options import grouped, headed, moment
from edoras_tools.cli.output import INTERRUPTED, end, file_progress, print_csv, print_json, print_view, tell
from edoras_tools.errors import ConfigError
from edoras_tools.older import StrEnum
from edoras_tools.words import plural

if TYPE_CHECKING:
    from edoras_tools.addons.archive.views import ArchiveSpan


class _Archive(Group):
    """The group: a word that is no command of it is a folder to index."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments; ``archive DIR`` is ``archive index DIR``."""
        own = {*self.commands, "-h", "--help"}
        if args and args[0] not in own and not args[0].startswith("--color"):
            args = ["index", *args]
        return super().parse_args(ctx, args)


class _ArchiveCommand(Command):
    """A command of the group; without the libraries of the extra it fails with one line."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command."""
        missing = [name for name in ("duckdb", "distributed", "fsspec", "pyarrow") if find_spec(name) is None]
        if missing:
            raise ConfigError(
                f"edoras archive needs {', '.join(missing)}, not installed here: "
                "pip install 'edoras-tools[archive]'"
            )
        return super().invoke(ctx)


archive = command_group(
    "archive", "Index many recordings, and ask the index. 'archive DIR' is 'archive index DIR'.", _Archive
)

Index = Annotated[Path, Option(envvar="EDORAS_ARCHIVE", help="The index, a DuckDB file.")]
_INDEX = Path("archive.duckdb")
_MOST_TOLD = 50
"""Most incomplete captures that an update lists; the index has all."""


class RowFormat(StrEnum):
    """Formats of printed rows."""

    TABLE = "table"
    CSV = "csv"


@headed("Printing")
class RowOptions(NamedTuple):
    """Format of printed rows."""

    json: options.Json = False
    layout: Annotated[RowFormat, Option("--format", help="Format of the rows.")] = RowFormat.TABLE
    older: Annotated[bool, Option("--csv", hidden=True)] = False

    @property
    def csv(self) -> bool:
        """Whether rows are printed as CSV."""
        return self.older or self.layout is RowFormat.CSV


class WorkerOptions(NamedTuple):
    """The processes that read the captures."""

    jobs: Annotated[int | None, Option(parser=options.count, help="Processes; default: one per core.")] = None
    scheduler: Annotated[str | None, Option(help="Use dask's workers, e.g. tcp://10.0.0.5:8786.")] = None


@headed("Selection")
class SpanOptions(NamedTuple):
    """The period of the captures."""

    start: Annotated[Any, Option(parser=moment, metavar="DATE", help="Only captures that end later.")] = None
    end: Annotated[Any, Option(parser=moment, metavar="DATE", help="Only captures that begin before.")] = None
    tz: Annotated[Any, Option(parser=options.time_zone, hidden=True)] = None

    def span(self) -> ArchiveSpan:
        """Return these options in the form that pipelines take.

        Raises:
            ConfigError: a time has no date.
        """
        from edoras_tools.addons.archive.views import ArchiveSpan
        from edoras_tools.older import UTC

        moments: list[int | None] = []
        for name, value in (("--start", self.start), ("--end", self.end)):
            if value is None:
                moments.append(None)
                continue
            clock = options.at(value[0], self.tz[0] if self.tz else UTC) if value[0] else None
            if clock is None or clock.day is None:
                raise ConfigError(f"{name} needs a date: write 2026-05-01 or 2026-05-01T12:00")
            moments.append(clock.first(0))
        return ArchiveSpan(*moments)


@archive.command("index", cls=_ArchiveCommand)
@grouped
def index_captures(
    *,
    places: Annotated[list[str], Argument(metavar="DIR|URL...", help="Folders, files; s3: and http:.")],
    index: Index = _INDEX,
    again: Annotated[bool, Option("--force", help="Read all captures, not only new or changed.")] = False,
    forget: Annotated[bool, Option("--forget", help="Delete captures that are no longer there.")] = False,
    work: WorkerOptions,
    printing: options.PrintOptions,
    decoding: options.DecodingOptions,
) -> None:
    """Make an index of recordings, or bring it up to date.

    Only new and changed captures are read. Exit code 3: some cannot be read whole; the index says which.
    """
    from edoras_tools.addons.archive.index import open_index
    from edoras_tools.addons.archive.update import Update, bring_up_to_date
    from edoras_tools.addons.archive.views import update_lines

    if work.jobs and work.scheduler:
        raise ConfigError(
            "--jobs is for workers of this machine, --scheduler for those of a cluster; choose one"
        )
    update = Update(
        tuple(places), decoding.settings(), work.jobs or 0, work.scheduler or "", again=again, forget=forget
    )
    json, quiet = printing
    with open_index(index, write=True) as opened, file_progress(places, quiet=quiet or json) as bar:
        report = bring_up_to_date(opened, update, bar, tell)
    summary = {"index": str(index), **report.summary()}
    if json:
        print_json(summary)
    elif not quiet:
        sys.stderr.writelines(f"{line}\n" for line in update_lines(summary, str(index)))
        tell(*report.bad[:_MOST_TOLD])
        if (rest := len(report.bad) - _MOST_TOLD) > 0:
            tell(f"and {rest:,} more that are not whole; 'edoras archive list' has them all")
    if report.interrupted:
        tell(f"interrupted: {report.unfinished:,} captures are not read yet; run the same again to go on")
        raise Exit(INTERRUPTED)
    end(lost=report.bad)


@archive.command("list", cls=_ArchiveCommand)
@grouped
def list_(*, index: Index = _INDEX, printing: RowOptions, dates: SpanOptions) -> None:
    """List the captures of the index: when, how many datagrams, what was lost, which are not whole."""
    from edoras_tools.addons.archive.index import open_index
    from edoras_tools.addons.archive.views import list_captures

    with open_index(index) as opened:
        rows = list_captures(opened, dates.span())
    _print_rows("captures", rows, printing)


@archive.command(cls=_ArchiveCommand)
@grouped
def losses(
    *,
    index: Index = _INDEX,
    topic: Annotated[list[str] | None, Option(help="Only topics, names or MsgIds, e.g. '/robot_*'.")] = None,
    max_loss: Annotated[
        float | None, Option(parser=options.share, help="Only where more is missing, e.g. 1%.")
    ] = None,
    printing: RowOptions,
    dates: SpanOptions,
) -> None:
    """List what was lost or is unaccounted for, by capture and topic.

    Exit code 3: something is listed.
    """
    from edoras_tools.addons.archive.index import open_index
    from edoras_tools.addons.archive.views import count_examined, list_losses

    with open_index(index) as opened:
        span, topics = dates.span(), tuple(topic or ())
        rows = list_losses(opened, span, topics, over=max_loss or 0.0)
        examined = 0 if rows else count_examined(opened, span, topics)
    if not (rows or printing.csv or printing.json):
        sys.stdout.write(
            f"No loss{' over this share' if max_loss else ''} in {plural(examined, 'capture')}.\n"
        )
        return
    _print_rows("losses", rows, printing)
    end(lost=rows)


def _print_rows(kind: str, rows: list[dict[str, Any]], printing: RowOptions) -> None:
    """Print captures, or losses, in one of the formats."""
    if printing.json:
        print_json({kind: rows})
    elif printing.csv:
        print_csv(rows)
    else:
        from edoras_tools.addons.archive.views import ROW_TABLES

        print_view(lambda width: ROW_TABLES[kind](rows, width))


@archive.command(cls=_ArchiveCommand)
@grouped
def query(
    *,
    sql: Annotated[str, Argument(metavar="SQL", help="A query; - reads it from standard input.")],
    index: Index = _INDEX,
    printing: RowOptions,
) -> None:
    """Ask the index in SQL; SHOW TABLES lists its tables, docs/archive.md explains them."""
    from edoras_tools.addons.archive.index import open_index

    with open_index(index) as opened:
        names, rows = opened.answer(sys.stdin.read() if sql == "-" else sql)
        if printing.json:
            from edoras_tools.addons.archive.views import json_rows

            print_json({"columns": names, "rows": json_rows(rows)})
        elif printing.csv:
            from edoras_tools.cli.output import write_csv

            write_csv(names, rows)
        else:
            from edoras_tools.addons.archive.views import answer_table

            print_view(lambda width: answer_table(names, rows, width))


@archive.command(cls=_ArchiveCommand)
@grouped
def report(
    *,
    index: Index = _INDEX,
    output: Annotated[Path, Option("--output", "-o", help="Output file.")] = Path("archive.html"),
    force: recordings.Force = False,
    quiet: options.Quiet = False,
    dates: SpanOptions,
) -> None:
    """Write one HTML page: runs over time, trends of losses and latencies, the worst of both."""
    from edoras_tools.addons.archive.index import open_index
    from edoras_tools.addons.archive.views import archive_page, trends_of
    from edoras_tools.io.outputs import check_new

    check_new(output, [index], force=force)
    with open_index(index) as opened:
        page = archive_page(trends_of(opened, dates.span()), recordings.page_origin())
    size = recordings.write_page(page, output)
    if not quiet:
        sys.stderr.write(f"{output}: {size / 1024:.0f} KiB\n")


@archive.command(cls=_ArchiveCommand)
@grouped
def export(
    *,
    output: Annotated[Path, Option("--output", "-o", help="A new or empty folder.")],
    index: Index = _INDEX,
    force: Annotated[bool, Option("--force", help="Replace an earlier export.")] = False,
    printing: options.PrintOptions,
) -> None:
    """Write the index as Parquet: a folder for each table, partitioned by date, link and topic."""
    from edoras_tools.addons.archive.index import export_dataset, open_index

    with open_index(index) as opened:
        written = export_dataset(opened, output, force=force)
    if printing.json:
        print_json({"output": str(output), "rows": written})
    elif not printing.quiet:
        sys.stderr.write(f"{output}: {sum(written.values()):,} rows of {len(written)} tables\n")
