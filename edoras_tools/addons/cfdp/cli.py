"""``edoras files``: the files that CFDP transferred."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from typer import Exit, Option

from edoras_tools.cli import options
from edoras_tools.cli.declare import grouped
from edoras_tools.cli.endings import LOST, lost, no_datagrams
from edoras_tools.cli.inputs import FileOptions, InputOptions, open_input
from edoras_tools.cli.output import file_progress, print_json


@grouped
def files(
    *,
    inputs: FileOptions,
    output: Annotated[Path | None, Option("--output", "-o", help="Write them to a new or empty DIR.")] = None,
    printing: options.PrintOptions,
    part: options.PartOptions,
    chosen: options.SelectionOptions,
    decoding: options.DecodingOptions,
) -> None:
    """Show the files that CFDP transferred, or take them out.

    Names of files that would lie outside DIR are refused.
    """
    from edoras_tools.addons.cfdp.taking import take_out

    paths = inputs.named()
    limits, quiet = part.limits(paths), printing.quiet or printing.json
    with file_progress(paths, quiet=quiet) as bar:
        source, bench = open_input(InputOptions(inputs), decoding.settings())
        report = take_out(source, bench, output, selection=chosen.selection(), limits=limits, progress=bar)
    if report.failure is None:
        no_datagrams(source)
    if printing.json:
        print_json(report.summary())
    elif not printing.quiet:
        from edoras_tools.render.capture.info import files_lines

        sys.stdout.writelines(f"{line}\n" for line in files_lines(report.summary()))
    if report.failure is not None:
        raise report.failure
    if not all(item.good for item in report.files):
        raise Exit(LOST)
    lost(source)
