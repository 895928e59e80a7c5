"""``edoras demo``: the tour, and the demos of the EDORAS paper."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, NamedTuple

from typer import Argument, Exit, Option

from edoras_tools import doors
from edoras_tools.cli import options, recordings
from edoras_tools.cli.declare import grouped, headed
from edoras_tools.cli.options import SCENARIOS, Scenario
from edoras_tools.cli.output import LOST, print_json, print_view, say, tell
from edoras_tools.cli.relays import run_relay
from edoras_tools.errors import ConfigError
from edoras_tools.io.outputs import in_the_way, path_beside
from edoras_tools.older import StrEnum

if TYPE_CHECKING:
    from edoras_tools.addons.lab.demo.run import Demo, DemoPlan
    from edoras_tools.addons.lab.emulator import Scenario as ScenarioName

_TOUR_S: Final = 6.0
_DEMO_S: Final = 20.0
_PANEL: Final = "The paper's demos"


class Ros(StrEnum):
    """A way to connect to the ROS 2 graph."""

    LOCAL = "local"
    ZENOH = "zenoh"
    DDS = "dds"
    RCLPY = "rclpy"


@headed(_PANEL)
class DemoOptions(NamedTuple):
    """Options of the demos of the paper; the tour does not have them."""

    ros: Annotated[Ros, Option(help="Middleware; local: inside this process.")] = Ros.LOCAL
    rate: Annotated[
        float, Option(min=0, max=1000, metavar="HZ", help="Commands per second to a robot; 0: none.")
    ] = 10.0
    state_rate: Annotated[
        float | None,
        Option(min=0, max=2000, metavar="HZ", help="States a second of each of two robots; default 250."),
    ] = None
    ros_options: options.RosOption = None
    max_rate: Annotated[float, Option(min=0, metavar="HZ", help="States forwarded a second; 0: all.")] = 30.0
    live: Annotated[bool, Option("--live", help="Show it in Foxglove, and drive the robots there.")] = False
    ws_port: Annotated[int | None, Option(min=0, max=65535, hidden=True)] = None
    distro: Annotated[str, Option(envvar="ROS_DISTRO", hidden=True)] = options.DISTRO
    domain: options.RosDomain = None

    def plan(self, scenario: ScenarioName, output: Path, *, replace: bool) -> DemoPlan:
        """Return these options in the form that pipelines take."""
        from edoras_tools.addons.lab.demo.run import DemoPlan
        from edoras_tools.middleware.opening import usual_domain

        return DemoPlan(
            scenario,
            output,
            command_hz=self.rate,
            state_hz=self.state_rate,
            max_rate=self.max_rate,
            ros=self.ros.value,
            domain=usual_domain() if self.domain is None else self.domain,
            options=dict(self.ros_options or ()),
            distro=self.distro,
            live=doors.part("foxglove").usual_address(self.ws_port) if self.live else None,
            replace=replace,
        )


@grouped
def demo(
    *,
    scenario: Annotated[Scenario | None, Argument(metavar="[SCENARIO]", help=SCENARIOS)] = None,
    output: Annotated[
        Path | None,
        Option(
            "--output", "-o", parser=recordings.recording_path, help="The recording, or the tour's folder."
        ),
    ] = None,
    force: recordings.Force = False,
    duration: Annotated[
        int | None, Option("--duration", parser=options.duration, help="Default 20s; of the tour 6s.")
    ] = None,
    demos: DemoOptions,
    printing: options.PrintOptions,
) -> None:
    """Show the main features, or run a demo of the paper.

    Without SCENARIO: a tour of the main features.

    For example: edoras demo two-rovers --live
    """
    if scenario is None:
        _tour(output, duration, force=force)
        return
    usual = Path(f"{scenario.value.replace('-', '_')}.mcap")
    layout = usual.with_name(f"{usual.stem}_layout.json")
    existing = in_the_way(usual) or in_the_way(layout)
    free = path_beside(usual) if existing and not force else usual
    plan = demos.plan(scenario.value, output or free, replace=force)
    _show(plan, duration or int(_DEMO_S * 1e9), printing)


def _tour(output: Path | None, duration: int | None, *, force: bool) -> None:
    from edoras_tools.addons.lab.demo.tour import tour
    from edoras_tools.addons.lab.views.tour import Guide
    from edoras_tools.render.terminal.terminal import detect_terminal

    seconds = duration / 1e9 if duration else _TOUR_S
    usual = Path("edoras_demo")
    folder = output or (path_beside(usual) if usual.exists() and not force else usual)
    if not force and folder.is_dir() and any(folder.iterdir()):
        raise ConfigError(f"{folder}: not an empty folder; name a new one, or --force replaces a tour in it")
    guide = Guide(sys.stdout, detect_terminal(sys.stdout))
    guide.begin(seconds, folder)
    live, real = tour(folder, seconds, show=guide.packet, notice=guide.notice, replace=force)
    guide.end(live.summary(), real.summary(), folder)


def _show(plan: DemoPlan, duration_ns: int, printing: options.PrintOptions) -> None:
    """Run a demo and print its result."""
    from edoras_tools.addons.lab.demo.run import Demo
    from edoras_tools.addons.lab.views import view
    from edoras_tools.render.terminal.terminal import detect_terminal

    json, quiet = printing
    shows = not quiet and not json and detect_terminal(sys.stderr).interactive
    running = Demo(plan, None if shows or quiet else tell)
    table = partial(view.live_table, output=plan.output) if shows else None
    failure = run_relay(running, partial(_begin, running, quiet=quiet), duration_ns, table) or running.failure
    summary = running.summary()
    if json:
        print_json(summary)
    elif not quiet:
        print_view(lambda width: view.outcome(summary, running.tracks, width, plan.output))
    if failure is not None:
        raise failure
    if summary["lost"]:
        raise Exit(LOST)


def _begin(running: Demo, *, quiet: bool) -> None:
    """Print what is emulated, and where it is shown."""
    if quiet:
        return
    from edoras_tools.addons.lab.views.view import beside

    say(f"emulated {running.plan.scenario}, recorded to {running.plan.output}; Ctrl-C ends")
    say(beside(running.summary()))
    if running.foxglove:
        app, page = running.foxglove.addresses
        say(f"Foxglove: {app}\nor in a browser: {page}")
