"""``edoras report``: one self-contained HTML page."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from edoras_tools.cli import options

if TYPE_CHECKING:
    from edoras_tools.pipelines.workbench import Settings


@options.takes_decoding
def report(
    settings: Settings,
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="pcap, pcapng or MCAP; - is stdin.")],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE", help="What to write; FILE.html if not said."),
    ] = None,
    constant: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="A constant of your cFS, as app_msg_limit=8."),
    ] = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Write what the doctor finds as one HTML page: verdicts, then plots. It needs no network.

    Exit code 3 tells that loss was found. With --json the diagnosis goes to stdout as well.
    """
    from edoras_tools.cli.endings import LOST, no_datagrams
    from edoras_tools.cli.inputs import open_input
    from edoras_tools.errors import ConfigError
    from edoras_tools.pipelines.doctor import examine, profile_with
    from edoras_tools.pipelines.report import write
    from edoras_tools.render import units

    profile = profile_with(constant or ())
    path = output or Path(f"{files[0].name if str(files[0]) != '-' else 'report'}.html")
    if any(item.exists() and path.exists() and item.samefile(path) for item in files):
        raise ConfigError(f"{path}: would overwrite its own input; name another output")
    source, bench = open_input(files, None, None, settings)
    findings = examine(source, bench, profile=profile)
    if findings.failure is None:
        no_datagrams(source)
    elif not findings.diagnosis.datagrams:
        raise findings.failure  # a page of nothing would say that nothing is wrong
    size = write(findings.diagnosis, source.info.name, path)
    if json:
        from edoras_tools.cli.output import print_json

        print_json({**findings.summary(), "output": str(path)})
    elif not quiet:
        lost = findings.diagnosis.lost
        told = f"{units.plural(lost, 'message')} lost" if lost else "no loss"
        verdicts = units.plural(len(findings.diagnosis.verdicts), "verdict")
        sys.stderr.write(f"{path}: {told}, {verdicts}, {size / 1024:.0f} KiB\n")
    if findings.failure is not None:
        raise findings.failure
    if findings.diagnosis.lost or findings.diagnosis.capture.drops:
        raise typer.Exit(LOST)
