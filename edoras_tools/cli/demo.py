"""``edoras demo``: the tour."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from edoras_tools.cli import options


def demo(
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="Folder for the recordings.")
    ] = Path("edoras_demo"),
    duration: options.Duration = None,
) -> None:
    """Tour the main job on loopback against an emulated cFS: sniff, decode, record, and what comes next."""
    from edoras_tools.pipelines.demo import tour
    from edoras_tools.render.demo import Guide
    from edoras_tools.render.terminal import look

    seconds = duration / 1e9 if duration else 6.0
    guide = Guide(sys.stdout, look(sys.stdout))
    guide.begin(seconds)
    result = tour(output, seconds, show=guide.packet, notice=guide.notice)
    guide.end(result.live.summary(), result.real.summary(), result.folder)
