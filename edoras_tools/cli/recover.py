"""``edoras recover``: make a cut-off recording whole."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from edoras_tools.cli import options


def recover(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A cut-off MCAP recording.")],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="FILE", help="What to write; FILE.recovered.mcap if not said."
        ),
    ] = None,
    json: options.Json = False,
) -> None:
    """Make a recording whole that was cut off, as by kill -9 or a full disk."""
    from dataclasses import asdict

    from edoras_tools.sinks.recover import recover as run

    target = output or file.parent / f"{file.stem}.recovered.mcap"
    report = run(file, target)
    if json:
        from edoras_tools.cli.output import print_json

        print_json({**asdict(report), "output": None if report.whole else str(target)})
        return
    sys.stdout.write(f"{report}\n")
