"""``edoras report``: one self-contained HTML page."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from typer import Option

from edoras_tools.cli import options, recordings
from edoras_tools.cli.inputs import FileOptions, InputOptions, open_input
from edoras_tools.cli.options import grouped
from edoras_tools.cli.output import end, file_progress, no_datagrams, print_json
from edoras_tools.io.outputs import check_new
from edoras_tools.words import plural


@grouped
def report(
    inputs: FileOptions,
    output: Annotated[Path | None, Option("--output", "-o", help="Output file; default FILE.html.")] = None,
    *,
    force: recordings.Force = False,
    printing: options.PrintOptions,
    part: options.ScopeOptions,
    decoding: options.DecodingOptions,
) -> None:
    """Write the doctor's findings as one HTML page with plots.

    Exit code 3: a loss or an error was found. With --json the diagnosis is also printed on stdout.
    """
    from edoras_tools.addons.report.page import page
    from edoras_tools.diagnosis.verdict import group_verdicts
    from edoras_tools.pipelines.doctor import examine

    files, scope, (json, quiet) = inputs.required(), part.scope(), printing
    path = output or Path(f"{files[0].name if str(files[0]) != '-' else 'report'}.html")
    check_new(path, files, force=force)
    with file_progress(files, quiet=quiet or json) as bar:
        settings = decoding.settings(constants=True)
        source, bench = open_input(InputOptions(inputs), settings, aligned=True, progress=bar)
        findings = examine(source, bench, scope=scope, progress=bar)
    if findings.failure is None:
        no_datagrams(source)
    elif not findings.diagnosis.datagrams:
        raise findings.failure  # an empty page would claim that there is no problem
    text = page(findings.diagnosis, source.info.name, recordings.page_origin())
    size = recordings.write_page(text, path)
    if json:
        print_json({**findings.summary(), "output": str(path)})
    elif not quiet:
        lost = findings.diagnosis.lost
        outcome = f"{plural(lost, 'message')} lost" if lost else "no loss found"
        if not findings.diagnosis.datagrams:
            outcome = "nothing was examined"
        verdicts = plural(len(group_verdicts(findings.diagnosis.verdicts)), "verdict")
        sys.stderr.write(f"{path}: {outcome}, {verdicts}, {size / 1024:.0f} KiB\n")
    unnamed = map(str, findings.unnamed)
    end(*findings.warnings, *unnamed, failure=findings.failure, lost=findings.diagnosis.bad)
