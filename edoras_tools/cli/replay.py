"""``edoras replay``: a recording sent again."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from edoras_tools.cli import options, sending

if TYPE_CHECKING:
    from edoras_tools.pipelines.orders import Orders
    from edoras_tools.pipelines.selection import Selection
    from edoras_tools.pipelines.workbench import Settings
    from edoras_tools.sessions.faults import FaultPlan


def pair(text: str) -> tuple[str, str]:
    """Read ``A:=B``."""
    old, sign, new = text.partition(":=")
    if not (old and sign and new):
        raise typer.BadParameter(f"{text!r} is no A:=B; write 0x1827:=0x1828 or /cmd_vel:=/robot_1/cmd_vel")
    return old, new


@options.takes_decoding
@options.takes_choice
@sending.takes_sending
@options.takes_faults
def replay(
    settings: Settings,
    selection: Selection,
    orders: Orders,
    faults: FaultPlan,
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="pcap, pcapng or MCAP; with --from-topics also rosbag2.")
    ],
    to: Annotated[
        str, typer.Option("--to", metavar="TO", help="Into ci, as an sbn peer, or to the ground bridge.")
    ],
    from_topics: Annotated[
        bool, typer.Option("--from-topics", help="Make packets of ROS messages that any tool recorded.")
    ] = False,
    speed: Annotated[
        float | None,
        typer.Option(metavar="X", parser=sending.positive, help="Times the recorded speed."),
    ] = None,
    rate: Annotated[
        list[Any] | None,
        typer.Option(
            metavar="[ROUTE=]HZ",
            parser=sending.rate,
            help="Even spacing, of everything or of a route, as /cmd_vel=30; repeatable.",
        ),
    ] = None,
    fastest: Annotated[bool, typer.Option("--max", help="As fast as it goes.")] = False,
    loop: Annotated[
        int | None,
        typer.Option(metavar="N", parser=sending.loops, help="Send it N times; 0 for no end."),
    ] = None,
    start: Annotated[
        int | None,
        typer.Option(
            metavar="TIME", parser=options.duration, help="From so long after the recording's start."
        ),
    ] = None,
    end: Annotated[
        int | None,
        typer.Option(
            metavar="TIME", parser=options.duration, help="Up to so long after the recording's start."
        ),
    ] = None,
    duration: Annotated[
        int | None,
        typer.Option("--duration", metavar="TIME", parser=options.duration, help="So long from --start."),
    ] = None,
    count: Annotated[
        int | None,
        typer.Option("--count", "-n", metavar="N", parser=options.counted, help="The first N datagrams."),
    ] = None,
    route: Annotated[
        list[str] | None,
        typer.Option(metavar="PATTERN", help="Only MsgIds, topics or keys that fit, as '0x18*'; repeatable."),
    ] = None,
    remap: Annotated[
        list[Any] | None,
        typer.Option(metavar="A:=B", parser=pair, help="Send MsgId, topic or key A as B; repeatable."),
    ] = None,
    restamp: Annotated[
        bool, typer.Option("--restamp", help="Header stamps become the time of sending.")
    ] = False,
    output: sending.Output = None,
    dry_run: sending.DryRun = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Send a recording again: into CI, as an SBN peer, or to a ground bridge; exactly, faster, or changed.

    Every byte is as it was captured unless an option says otherwise. In a terminal: space pauses, n sends the
    next one, q ends.
    """
    from dataclasses import replace

    from edoras_tools.errors import ConfigError
    from edoras_tools.pipelines import replay as pipeline
    from edoras_tools.pipelines.orders import To
    from edoras_tools.pipelines.transmission import Transmission

    if end and duration:
        raise ConfigError("--end and --duration both say when to stop; name one")
    begin = start or 0
    choice = pipeline.Choice(
        selection, tuple(route or ()), begin, end or (begin + duration if duration else 0), count or 0
    )
    orders = replace(
        orders,
        to=sending.one_of(To, to, "--to"),
        speed=speed or 1.0,
        rates=tuple(rate or ()),
        unpaced=fastest,
        passes=1 if loop is None else loop,
    )
    pairs = list(remap or ())
    if from_topics:
        from edoras_tools.pipelines.topics import load_topics
        from edoras_tools.sources.rosbag2 import open_rosbag

        bag = open_rosbag(file)
        bench = settings.workbench()
        orders = orders.placed(bench.mission)
        renamed = {"/" + old.removeprefix("/"): new for old, new in pairs if not old[:1].isdigit()}
        loaded = load_topics(bag, bench, orders, choice, renamed)
        pairs = [(old, new) for old, new in pairs if old[:1].isdigit()]
    else:
        from edoras_tools.pipelines.workbench import open_files

        source = open_files([file])
        bench = settings.workbench(source.info)
        orders = orders.placed(bench.mission)
        loaded = pipeline.load(source, bench, orders, choice)
    names = pipeline.remapped(pairs, bench.mission, extended=settings.options.extended_header)
    changes = pipeline.changes_for(orders, names, bench.mission, bench.types, restamp=restamp)
    transmission = Transmission.of(loaded, orders, bench.mission, changes)
    sending.carry_out(
        transmission,
        bench,
        faults,
        inputs=(file,),
        output=output,
        dry_run=dry_run,
        json=json,
        quiet=quiet,
    )
