"""``edoras recover``: repair a damaged or cut-off recording."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from msgspec.structs import asdict
from typer import Argument, Option

from edoras_tools.cli import options, recordings
from edoras_tools.cli.options import grouped
from edoras_tools.cli.output import end, print_json
from edoras_tools.io.outputs import in_the_way, refuse_existing


@grouped
def recover(
    file: Annotated[Path, Argument(metavar="FILE", help="A damaged or cut-off recording or capture.")],
    output: Annotated[
        Path | None,
        Option("--output", "-o", help="Default: NAME.recovered.mcap; of a capture, .pcap or .pcapng."),
    ] = None,
    config: options.Config = None,
    force: recordings.Force = False,
    unproved: options.Unproved = False,
    json: options.Json = False,
) -> None:
    """Repair a recording that was cut off or damaged.

    It keeps what a checksum proves, and counts the rest. With -c it knows the mission's topics without their
    description.
    """
    from edoras_tools.io.formats.recover import repair, repairable_as
    from edoras_tools.render.capture.watch import byte_progress

    kind = repairable_as(file).replace("db3", "mcap")
    target = (
        output
        or file.parent / f"{file.name.partition('.pcap')[0].removesuffix(file.suffix)}.recovered.{kind}"
    )
    obstacle = in_the_way(target)
    if obstacle and not force and not (file.exists() and target.samefile(file)):
        refuse_existing(obstacle)
    with byte_progress(file, quiet=json) as progress:
        report = repair(
            file, target, topics=recordings.known_topics(config), unproved=unproved, progress=progress
        )
    if json:
        print_json({**asdict(report), "output": None if report.whole else str(target)})
    else:
        sys.stdout.write(f"{report.text(written=True)}\n")
    end(lost=report.lost)
