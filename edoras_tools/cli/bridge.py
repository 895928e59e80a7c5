"""``edoras bridge``: in the place of the ground bridge and the flight bridge."""

from __future__ import annotations

import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from edoras_tools.cli import options
from edoras_tools.cli.endings import LOST
from edoras_tools.cli.live import Origins, Shown, showing

if TYPE_CHECKING:
    from collections.abc import Callable

    from edoras_tools.errors import EdorasError
    from edoras_tools.model import Endpoint
    from edoras_tools.pipelines.bridge import Bridges
    from edoras_tools.pipelines.bridge_plan import BridgePlan
    from edoras_tools.pipelines.proxy_recorder import Recorder
    from edoras_tools.pipelines.workbench import Settings


class Kind(StrEnum):
    """Which of the bridges that the files describe."""

    GROUND = "ground"
    FLIGHT = "flight"


class Ros(StrEnum):
    """A way into the ROS 2 graph."""

    ZENOH = "zenoh"
    DDS = "dds"
    RCLPY = "rclpy"
    FOXGLOVE = "foxglove"
    LOCAL = "local"


def ros_option(text: str) -> str:
    """Check ``NAME=VALUE``."""
    name, equals, _ = text.partition("=")
    if not name or not equals:
        raise typer.BadParameter(f"{text!r} is no NAME=VALUE")
    return text


@options.takes_decoding
def bridge(
    settings: Settings,
    kind: Annotated[
        Kind | None, typer.Argument(help="Only the ground, or the flight bridges of the files; else all.")
    ] = None,
    ros: Annotated[
        Ros | None,
        typer.Option(
            help="The way to ROS 2; dds, or zenoh where RMW_IMPLEMENTATION says so.", show_default=False
        ),
    ] = None,
    domain: Annotated[
        int | None,
        typer.Option(metavar="N", min=0, max=232, help="ROS 2 domain; ROS_DOMAIN_ID, or 0."),
    ] = None,
    ros_options: Annotated[
        list[str] | None,
        typer.Option(
            "--ros-option", metavar="NAME=VALUE", parser=ros_option, help="For the middleware; repeatable."
        ),
    ] = None,
    max_rate: Annotated[
        list[str] | None,
        typer.Option(
            "--max-rate",
            metavar="[TOPIC=]HZ[,KEEP]",
            help="No more a second of each topic to cFS, of one, or of all=HZ; KEEP: latest, first.",
        ),
    ] = None,
    checksum: Annotated[bool, typer.Option("--checksum", help="Real checksums in commands, not 0.")] = False,
    sequence: Annotated[bool, typer.Option("--sequence", help="Real sequence counts, not 0.")] = False,
    enable: Annotated[bool, typer.Option(help="Ask Telemetry Output to send here.")] = True,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE", help="Record to .mcap, .pcapng or .pcap.")
    ] = None,
    live: Shown = None,
    allow_origin: Origins = None,
    duration: options.Duration = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would be bridged; open nothing.")
    ] = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Bridge ROS 2 and cFS as ground and flight bridges do, by the same files, without a ROS 2 installed.

    Every bridge of every file runs, in one process: edoras bridge -c ground.yaml -c flight.yaml
    """
    from edoras_tools.cli.output import print_json
    from edoras_tools.middleware.opening import usual, usual_domain
    from edoras_tools.pipelines.bridge_plan import Wishes, plan_bridges
    from edoras_tools.render import bridge as view
    from edoras_tools.render.console import error_console, output_console
    from edoras_tools.render.foxglove import served

    way = ros.value if ros else usual()
    wishes = Wishes(
        kind.value if kind else None,
        tuple(max_rate or ()),
        checksum=checksum,
        sequence=sequence,
        enable=enable,
    )
    plan = plan_bridges(settings, wishes)
    if dry_run:
        planned = [item.summary() for item in plan.stations]
        if json:
            print_json({"ros": way, "bridges": planned, "notes": list(plan.notes)})
        else:
            for note in plan.notes:
                _say(note)
            console = output_console()
            console.print(view.plan(planned, way, output, console.width))
        return
    from edoras_tools.pipelines.bridge import Bridges
    from edoras_tools.render.terminal import look

    shows = not quiet and not json and look(sys.stderr).interactive
    bridges = Bridges(
        plan,
        wishes,
        ros=way,
        domain=usual_domain() if domain is None else domain,
        options=_options(way, ros_options, allow_origin),
        recorder=_recorder(plan, output, live, allow_origin),
        say=None if shows else _say,
    )
    failure = _run(bridges, output, duration or 0, shows=shows)
    summary = bridges.summary()
    shown = bridges.recorder.shown.summary() if bridges.recorder and bridges.recorder.shown else None
    if json:
        print_json({**summary, "foxglove": shown})
    elif not quiet:
        if shows:
            for note in bridges.notes:
                _say(note)
        console = error_console()
        console.print(view.outcome(summary, console.width, output))
        for line in served(shown) if shown else ():
            sys.stderr.write(f"{line}\n")
    if json or quiet:
        for line in view.losses(summary):
            _say(line)
    if failure is not None:
        raise failure
    if summary["lost"]:
        raise typer.Exit(LOST)


def _options(way: str, given: list[str] | None, origins: list[str] | None) -> dict[str, str]:
    """Return the middleware's options; where that is Foxglove itself, it has the origins too."""
    pairs = dict(item.split("=", 1) for item in given or ())
    return {**pairs, "origins": ",".join(origins)} if origins and way == Ros.FOXGLOVE else pairs


def _recorder(
    plan: BridgePlan, output: Path | None, live: Endpoint | None, origins: list[str] | None
) -> Callable[[], Recorder] | None:
    """Return what records and shows it, checked before anything is opened; None where nobody wants it."""
    if output is None and live is None:
        return None
    from edoras_tools.pipelines.proxy_recorder import Recorder
    from edoras_tools.pipelines.record import Target, check_target

    goal = Target(output) if output else None
    if goal:
        check_target(goal, ())
    bench = plan.workbench()
    name = ", ".join(f"{item.kind} bridge {item.listen} to {item.target}" for item in plan.stations)
    show = showing(bench, live, origins)
    return lambda: Recorder(goal, bench, name, "bridge", show=show)


def _run(bridges: Bridges, output: Path | None, duration_ns: int, *, shows: bool) -> EdorasError | None:
    """Bridge until the end; return what ended it early, if anything did."""
    from contextlib import ExitStack

    from edoras_tools.errors import EdorasError
    from edoras_tools.pipelines.interrupt import on_interrupt
    from edoras_tools.render.bridge import BridgeTable
    from edoras_tools.render.console import error_console

    failure: EdorasError | None = None
    with ExitStack() as stack:
        stack.enter_context(on_interrupt(bridges.stop))  # from the moment that it is told
        for station in bridges.stations:
            count = len(station.machine.routes)
            sys.stderr.write(
                f"bridging {count} topic{'' if count == 1 else 's'} through {bridges.ros}: "
                f"{station.plan.name}, {station.plan.kind}, {station.endpoint} to {station.plan.target}; "
                "Ctrl-C ends\n"
            )
        sys.stderr.flush()
        table = stack.enter_context(BridgeTable(error_console(), output)) if shows else None
        try:
            bridges.run(duration_ns=duration_ns, watcher=table)
        except EdorasError as error:
            failure = error
        finally:
            bridges.close()
    return failure or (bridges.recorder.failure if bridges.recorder else None)


def _say(text: str) -> None:
    from edoras_tools.render.text import clean

    sys.stderr.write(f"edoras: {clean(text)}\n")  # a peer's own words may be in it
    sys.stderr.flush()
