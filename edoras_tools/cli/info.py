"""``edoras info``: shows what a capture or a recording contains."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from msgspec.structs import asdict
from typer import Option

from edoras_tools.cli import options
from edoras_tools.cli.inputs import FileOptions, InputOptions, open_input
from edoras_tools.cli.options import grouped
from edoras_tools.cli.output import end, finish, print_json, print_view, watcher
from edoras_tools.cli.recordings import known_topics
from edoras_tools.errors import ConfigError


@grouped
def info(
    *,
    files: FileOptions,
    verify: Annotated[bool, Option("--verify", help="Only check every checksum of the recordings.")] = False,
    jobs: options.Jobs = None,
    printing: options.PrintOptions,
    part: options.PartOptions,
    filters: options.SelectionOptions,
    decoding: options.DecodingOptions,
) -> None:
    """Say what is in a capture: routes, rates, gaps, findings."""
    paths = files.required()
    limits = part.limits(paths)
    if verify:
        if part != options.PartOptions() or filters.selection():
            raise ConfigError(
                "--verify checks whole files: options that select a part have no effect with it"
            )
        _verify(paths, printing, decoding)
        return
    from edoras_tools.io.formats.cfe import read_cfe_file
    from edoras_tools.pipelines.capture.info import inspect

    contents = [item for path in paths if (item := read_cfe_file(path)) is not None]
    for item in contents:
        if printing.json:
            print_json(item.summary())
        else:
            from edoras_tools.render.capture.info import contents_lines

            sys.stdout.writelines(f"{line}\n" for line in [*contents_lines(item.summary()), ""])
    captures = [path for path in paths if path not in {item.path for item in contents}]
    if not captures:
        return
    source, bench = open_input(InputOptions(FileOptions(captures)), decoding.settings(), messages=True)
    with watcher(source, None, quiet=printing.quiet or printing.json, live=False) as watch:
        report = inspect(
            source, bench, selection=filters.selection(), limits=limits, watcher=watch, jobs=jobs or 0
        )
    if printing.json:
        print_json(report.summary())
    elif report.ledger.datagrams:
        from edoras_tools.render.capture.info import capture_summary

        summary = report.summary()
        warnings = () if bench.mission.recorded else summary["warnings"]  # printed below
        print_view(capture_summary({**summary, "warnings": warnings}))
    finish(report, live=False)


def _verify(files: list[Path], printing: options.PrintOptions, decoding: options.DecodingOptions) -> None:
    """Check recordings, and the files of rosbag2 directories; the exit code is as for ``recover``.

    Raises:
        typer.Exit: with code 3, if one of them lost data.
    """
    from edoras_tools.io.formats.recover import repair
    from edoras_tools.io.formats.rosbag2.reader import files_of
    from edoras_tools.render.capture.watch import byte_progress

    topics = known_topics(decoding.config)
    every = [item for path in files for item in (files_of(path) if path.is_dir() else [path])]
    lost = False
    for path in every:
        with byte_progress(path, quiet=printing.quiet or printing.json) as progress:
            report = repair(path, None, topics=topics, progress=progress)
        lost |= report.lost
        if printing.json:
            print_json({"source": str(path), **asdict(report)})
        else:
            sys.stdout.write(f"{path}: {report.text(written=False)}\n")
    end(lost=lost)
