"""``edoras record``: live traffic or files into MCAP, rosbag2, pcapng or pcap."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from edoras_tools.cli import options

if TYPE_CHECKING:
    from edoras_tools.pipelines.selection import Selection
    from edoras_tools.pipelines.workbench import Settings


@options.takes_decoding
@options.takes_choice
def record(
    settings: Settings,
    selection: Selection,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="FILE", help="What to write; .mcap, .pcapng or .pcap tells the kind."
        ),
    ] = None,
    read: options.Read = None,
    interface: options.Interface = None,
    listen: options.Listen = None,
    rosbag2: Annotated[bool, typer.Option("--rosbag2", help="Write a rosbag2 directory.")] = False,
    split_size: Annotated[
        int | None,
        typer.Option(metavar="SIZE", parser=options.size, help="Begin another file at this size, as 500M."),
    ] = None,
    split_time: Annotated[
        int | None,
        typer.Option(
            metavar="TIME", parser=options.duration, help="Begin another file after so long, as 10m."
        ),
    ] = None,
    count: options.Count = None,
    duration: options.Duration = None,
    every: Annotated[
        bool, typer.Option("--all", "-a", help="Live: also UDP that belongs to no link.")
    ] = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Record CI, TO and SBN traffic: every datagram whole, and every ROS message on its topic.

    Several inputs become one recording in time order. A recording converts back: record -r a.mcap -o b.pcap.
    """
    from time import monotonic_ns, strftime

    from edoras_tools.cli.endings import finish
    from edoras_tools.cli.inputs import open_input
    from edoras_tools.pipelines.record import Target, check_target
    from edoras_tools.pipelines.record import record as run
    from edoras_tools.render.watch import watcher

    live = read is None
    path = output or Path(strftime("edoras_%Y%m%d_%H%M%S") + ("" if rosbag2 else ".mcap"))
    target = Target(path, rosbag2, split_size or 0, split_time or 0)
    check_target(target, read or ())
    source, bench = open_input(read, interface, listen, settings, every_port=every)
    with watcher(source, path, quiet=quiet or json, live=live) as watch:
        report = run(
            source,
            bench,
            target,
            selection=selection,
            clock=monotonic_ns,
            duration_ns=duration or 0,
            count=count or 0,
            watcher=watch,
            by_route=json or not quiet,
        )
    if json:
        from edoras_tools.cli.output import print_json

        print_json({**report.summary(), "outputs": [str(item) for item in report.outputs]})
    elif not quiet:
        from edoras_tools.render.watch import recorded

        sys.stderr.write(recorded(report.summary(), report.outputs) + "\n")
    finish(report, live=live)
