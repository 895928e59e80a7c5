"""``edoras demo``: the tour, and the demos of the EDORAS paper."""

from __future__ import annotations

import sys
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from edoras_tools.cli import options
from edoras_tools.cli.endings import LOST
from edoras_tools.cli.sim import Scenario

if TYPE_CHECKING:
    from edoras_tools.errors import EdorasError
    from edoras_tools.model import Endpoint
    from edoras_tools.pipelines.demo_run import Demo, DemoPlan

_TOUR_S: Final = 6.0
_DEMO_S: Final = 20.0
_demos = partial(typer.Option, rich_help_panel="The paper's demos")


class Ros(StrEnum):
    """A way into the ROS 2 graph."""

    LOCAL = "local"
    ZENOH = "zenoh"
    DDS = "dds"
    RCLPY = "rclpy"


def demo(
    scenario: Annotated[
        Scenario | None, typer.Argument(help="A demo of the EDORAS paper; without one, the tour.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="PATH", help="The recording; of the tour, the folder for them."
        ),
    ] = None,
    duration: Annotated[
        int | None,
        typer.Option(
            *("--duration", "--seconds"),
            metavar="TIME",
            parser=options.duration,
            help="How long, as 30, 10m; 6 s the tour, 20 s a demo.",
        ),
    ] = None,
    ros: Annotated[
        Ros, _demos(help="Where robots and ground station meet; local: inside this process.")
    ] = Ros.LOCAL,
    rate: Annotated[
        float, _demos("--rate", metavar="HZ", min=0, max=1000, help="Commands a second and robot; 0: none.")
    ] = 10.0,
    state_rate: Annotated[
        float | None,
        _demos(
            "--state-rate",
            metavar="HZ",
            min=0,
            max=2000,
            help="States that each of two robots publishes a second; 250, as Gazebo does.",
            show_default=False,
        ),
    ] = None,
    max_rate: Annotated[
        float,
        _demos("--max-rate", metavar="HZ", min=0, help="States that the flight bridge lets through; 0: all."),
    ] = 30.0,
    live: Annotated[
        bool, _demos("--live", help="Show it in Foxglove; robots may be driven from there.")
    ] = False,
    ws_port: Annotated[
        int | None,
        _demos(
            "--ws-port",
            metavar="PORT",
            min=0,
            max=65535,
            help="Where Foxglove connects to; 8765, or any that is free.",
            show_default=False,
        ),
    ] = None,
    distro: Annotated[
        str, _demos(metavar="NAME", help="ROS 2 distribution; nodes on Zenoh meet only those of their own.")
    ] = "humble",
    domain: Annotated[
        int | None, _demos(metavar="N", min=0, max=232, help="ROS 2 domain; ROS_DOMAIN_ID, or 0.")
    ] = None,
    ros_options: Annotated[
        list[str] | None,
        _demos("--ros-option", metavar="NAME=VALUE", help="For the middleware; repeatable."),
    ] = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Tour the main job on loopback against an emulated cFS; or run a demo of the paper, with both bridges.

    For example: edoras demo two-rovers --live
    """
    if scenario is None:
        _tour(output, duration)
        return
    from edoras_tools.errors import ConfigError
    from edoras_tools.middleware.opening import usual_domain
    from edoras_tools.pipelines.demo_run import DemoPlan

    pairs = [item.partition("=") for item in ros_options or ()]
    if wrong := [name for name, equals, _ in pairs if not name or not equals]:
        raise ConfigError(f"--ros-option {wrong[0]!r} is no NAME=VALUE")
    plan = DemoPlan(
        scenario.value,
        output or Path(f"{scenario.value.replace('-', '_')}.mcap"),
        command_hz=rate,
        state_hz=state_rate,
        max_rate=max_rate,
        ros=ros.value,
        domain=usual_domain() if domain is None else domain,
        options={name: value for name, _, value in pairs},
        distro=distro,
        live=_where(ws_port) if live else None,
    )
    _show(plan, duration or int(_DEMO_S * 1e9), json=json, quiet=quiet)


def _tour(output: Path | None, duration: int | None) -> None:
    from edoras_tools.pipelines.demo import tour
    from edoras_tools.render.demo import Guide
    from edoras_tools.render.terminal import look

    seconds = duration / 1e9 if duration else _TOUR_S
    guide = Guide(sys.stdout, look(sys.stdout))
    guide.begin(seconds)
    result = tour(output or Path("edoras_demo"), seconds, show=guide.packet, notice=guide.notice)
    guide.end(result.live.summary(), result.real.summary(), result.folder)


def _show(plan: DemoPlan, duration_ns: int, *, json: bool, quiet: bool) -> None:
    """Run a demo and say what came of it."""
    from edoras_tools.cli.output import print_json
    from edoras_tools.pipelines.demo_run import Demo
    from edoras_tools.render import demo_view as view
    from edoras_tools.render.console import output_console
    from edoras_tools.render.terminal import look

    shows = not quiet and not json and look(sys.stderr).interactive
    with Demo(plan, None if shows or quiet else _say) as running:
        failure = _run(running, duration_ns, shows=shows, quiet=quiet)
    summary = running.summary()
    if json:
        print_json(summary)
    elif not quiet:
        console = output_console()
        console.print(view.outcome(summary, running.tracks, console.width, plan.output))
    if failure is not None:
        raise failure
    if summary["lost"]:
        raise typer.Exit(LOST)


def _run(running: Demo, duration_ns: int, *, shows: bool, quiet: bool) -> EdorasError | None:
    """Let it run; return what ended it early, if anything did."""
    from contextlib import ExitStack

    from edoras_tools.errors import EdorasError
    from edoras_tools.render import demo_view as view
    from edoras_tools.render.console import error_console

    if not quiet:
        sys.stderr.write(
            f"emulated {running.plan.scenario}, recorded to {running.plan.output}; Ctrl-C ends\n"
        )
        sys.stderr.write(f"{view.beside(running.summary())}\n")
        if running.foxglove:
            sys.stderr.write(f"Foxglove: {running.foxglove.server.app_url}\n")
        sys.stderr.flush()
    with ExitStack() as stack:
        table = stack.enter_context(view.DemoTable(error_console(), running.plan.output)) if shows else None
        try:
            running.run(duration_ns=duration_ns, watcher=table)
        except EdorasError as error:
            return error
    return running.failure


def _where(port: int | None) -> Endpoint:
    """Return where Foxglove connects to: the usual port if it is free, unless one is named."""
    import socket

    from edoras_tools.model import Endpoint
    from edoras_tools.pipelines.live import HERE

    if port is None:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((HERE.address, HERE.port))
            except OSError:
                port = 0
            else:
                port = HERE.port
    return Endpoint(HERE.address, port)


def _say(text: str) -> None:
    sys.stderr.write(f"edoras: {text}\n")
    sys.stderr.flush()
