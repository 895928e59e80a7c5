"""The commands of the lab.

``demo`` shows the tour and the demos of the EDORAS paper, ``sim`` runs the emulated cFS. ``sweep`` measures
how much a route can carry, ``experiment`` makes many runs of a system under several settings.
``doctor --prove`` puts the losses of a capture beside those of an emulated cFS with the same input.
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from time import time_ns
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple

from msgspec.structs import replace
from typer import Argument, BadParameter, Exit, Option

from edoras_tools import doors
from edoras_tools.cli import options, recordings, sending
from edoras_tools.cli.inputs import InputOptions, open_input
from edoras_tools.cli.options import SCENARIOS, PrintOptions, Scenario, grouped, headed
from edoras_tools.cli.output import (
    INTERRUPTED,
    end,
    file_progress,
    print_json,
    print_view,
    say,
    tell,
    tell_reach,
)
from edoras_tools.cli.relays import run_relay
from edoras_tools.errors import ConfigError
from edoras_tools.io.outputs import check_new, in_the_way, path_beside, write_bytes
from edoras_tools.older import StrEnum
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from edoras_tools.addons.lab.demo.run import Demo, DemoPlan
    from edoras_tools.addons.lab.emulator import Scenario as ScenarioName
    from edoras_tools.addons.lab.sweep.plan import SweepPlan
    from edoras_tools.cli.doctor import TaskOptions
    from edoras_tools.mission import Route
    from edoras_tools.model import Endpoint, Link
    from edoras_tools.pipelines.sending.options import SendOptions
    from edoras_tools.pipelines.workbench import Settings
    from edoras_tools.wire.cfe import Headers

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
        from edoras_tools.middleware.graph import usual_domain

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
        Option("--output", "-o", parser=options.recording_path, help="The recording, or the tour's folder."),
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
    from edoras_tools.addons.lab.demo.run import tour
    from edoras_tools.addons.lab.views import Guide
    from edoras_tools.render.terminal.palette import detect_terminal

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
    from edoras_tools.addons.lab import views
    from edoras_tools.addons.lab.demo.run import Demo
    from edoras_tools.render.terminal.palette import detect_terminal

    json, quiet = printing
    shows = not quiet and not json and detect_terminal(sys.stderr).interactive
    running = Demo(plan, None if shows or quiet else tell)
    table = partial(views.live_table, output=plan.output) if shows else None
    failure = run_relay(running, partial(_begin, running, quiet=quiet), duration_ns, table) or running.failure
    summary = running.summary()
    if json:
        print_json(summary)
    elif not quiet:
        print_view(lambda width: views.outcome(summary, running.tracks, width, plan.output))
    end(failure=failure, lost=summary["lost"])


def _begin(running: Demo, *, quiet: bool) -> None:
    """Print what is emulated, and where it is shown."""
    if quiet:
        return
    from edoras_tools.addons.lab.views import beside

    say(f"emulated {running.plan.scenario}, recorded to {running.plan.output}; Ctrl-C ends")
    say(beside(running.summary()))
    if running.foxglove:
        app, page = running.foxglove.addresses
        say(f"Foxglove: {app}\nor in a browser: {page}")


class FlightOptions(NamedTuple):
    """Configuration of the emulated cFS."""

    limit: Annotated[int, Option(min=0, max=255, hidden=True)] = 0
    msg_max: Annotated[int, Option(min=0, hidden=True)] = 0
    generator: Annotated[Any, Option(parser=options.msg_id, hidden=True)] = None
    extended_header: Annotated[bool | None, Option("--extended-header", hidden=True)] = None
    msg_id_version: Annotated[int | None, Option(min=1, max=2, hidden=True)] = None
    set_values: Annotated[
        list[Any] | None,
        Option(
            "--set",
            parser=options.name_value,
            metavar="NAME=VALUE",
            help="A constant of cFS: msg_max=10, extended-header=yes; all: edoras help decoding.",
        ),
    ] = None


@grouped
def sim(
    *,
    scenario: Annotated[Scenario, Argument(metavar="[SCENARIO]", help=SCENARIOS)] = Scenario.ROVER,
    config: options.Config = None,
    bridges: Annotated[bool, Option(" /--no-bridges", help="cFS alone, without bridges and robots.")] = True,
    rate: Annotated[float, Option(min=0.01, max=1000, metavar="HZ", help="Commands per second.")] = 5.0,
    flight: FlightOptions,
    host: Annotated[str, Option("--bind", help="Address to bind.")] = "127.0.0.1",
    duration: options.Duration = None,
    quiet: options.Quiet = False,
) -> None:
    """Run an emulated cFS on loopback, with the real limits.

    Its console is printed on stdout. In another terminal, edoras sniff -i lo shows its traffic. With -c it is
    the cFS of a mission file: its MsgIds, ports, envelopes and constants, as edoras mission learn finds them.
    """
    from threading import Event

    from edoras_tools.addons.lab.emulator import Simulation, serve
    from edoras_tools.addons.lab.emulator.cfs import mission_profile, routes_of, with_limit
    from edoras_tools.addons.lab.emulator.messages import bus_id
    from edoras_tools.cfs.profile import SbnPeerConfig, SimProfile
    from edoras_tools.model import Endpoint
    from edoras_tools.pipelines.reading import on_interrupt

    # If the sockets are bound to every address, the parts still use loopback among themselves.
    address = "127.0.0.1" if host == "0.0.0.0" else host  # noqa: S104  the user asked for it
    built = options.DecodingOptions(
        config=config,
        set_values=flight.set_values,
        extended_header=flight.extended_header,
        msg_id_version=flight.msg_id_version,
    )
    bench = built.merged().settings(constants=True).workbench()
    profile = mission_profile(bench)
    # The lab's table contains the first processor too: each of its cFS has the others as peers.
    first = SimProfile()
    table = (SbnPeerConfig(first.peer, first.sbn_port), *profile.sbn_peers)
    peers = tuple(replace(peer, address=address) for peer in table if peer.peer != profile.peer)
    profile = replace(
        with_limit(profile, flight.limit or profile.to_default_limit),
        msg_max=flight.msg_max or profile.msg_max,
        address=address,
        sbn_peers=peers,
        sbn_says_start=True,
    )
    if flight.generator is not None:
        profile = replace(profile, generator_msg_id=bus_id(flight.generator, profile))
    simulation = Simulation(
        profile,
        routes_of(bench) if config else scenario.value,
        start_ns=time_ns(),
        bridges=bridges,
        command_rate_hz=rate,
        state_rate_hz=rate,
    )
    stop = Event()
    # The system chooses the source port of telemetry.
    cfs = simulation.cfs
    others = {cfs.to_endpoint, cfs.sbn_endpoint} if profile.sbn_tcp else {cfs.to_endpoint}
    bound = [item for item in simulation.endpoints if item not in others]
    ends = ", ".join(f"{item.port}" for item in bound)

    def ready() -> None:
        tell_reach(Endpoint(host, profile.ci_port), "command the emulated cFS", instead="leave --bind out")
        over = f", SBN over TCP {profile.sbn_port}" if profile.sbn_tcp else ""
        sys.stderr.write(f"emulated cFS ({simulation.scenario}) on {host}, UDP {ends}{over}; Ctrl-C ends\n")

    def line(time_ns: int, text: str) -> None:
        sys.stdout.write(f"{time_ns / 1e9:.6f} {text}\n")
        sys.stdout.flush()

    simulation.cfs.listener = None if quiet else line
    with on_interrupt(stop.set):
        sent = serve(simulation, host, duration / 1e9 if duration else None, stop, ready)
    if quiet:
        return
    counters = simulation.cfs.bus.counters
    sys.stderr.write(
        f"{sent:,} datagrams sent; lost on the software bus: {counters.msg_limits:,} over a message limit, "
        f"{counters.pipe_overflows:,} by full pipes\n"
    )


_LEAST_STEP_NS = 2_000_000_000


def span(text: str) -> tuple[int, int]:
    """Read ``FROM..TO``, or one number for both."""
    first, dots, last = text.partition("..")
    try:
        limits = int(first, 0), int(last if dots else first, 0)
    except ValueError:
        limits = 0, 0
    if not 1 <= limits[0] <= limits[1] <= 65535:
        raise BadParameter(f"{text!r} is not FROM..TO; write 1..1000, in whole numbers from 1 to 65535")
    return limits


class StepOptions(NamedTuple):
    """The steps, their duration, and the receiver."""

    rate: Annotated[Any, Option(parser=span, metavar="FROM..TO", help="Hz to try; default 1..1000.")] = None
    size: Annotated[
        Any, Option(parser=span, metavar="FROM..TO", help="Bytes of a packet to try; or one size.")
    ] = None
    step_time: Annotated[int | None, Option(parser=options.duration, help="Of a step; default 8s.")] = None
    sim: Annotated[Scenario | None, Option(help="Measure an emulated cFS.")] = None
    limit: Annotated[int | None, Option(min=1, max=255, help="With --sim: messages that may wait.")] = None
    generator: Annotated[
        Any, Option(parser=options.msg_id, help="MsgId of the generator's commands; default 0x18F0.")
    ] = None
    watch: Annotated[bool, Option("--watch", help="Publish nothing; only measure what arrives.")] = False
    duration: options.Duration = None

    @property
    def by_size(self) -> bool:
        """Whether sizes are varied instead of rates."""
        return self.size is not None and self.size[0] != self.size[1]

    def check(self, target: Endpoint | None) -> None:
        """Refuse options that exclude each other.

        Raises:
            ConfigError: such options are given.
        """
        if self.by_size and self.rate is not None and self.rate[0] != self.rate[1]:
            raise ConfigError(
                "only one range can be given: --rate FROM..TO at one --size, or --size FROM..TO at one --rate"
            )
        if self.limit is not None and self.sim is None:
            raise ConfigError("--limit configures the emulated cFS; it needs --sim")
        if self.sim is not None and target is not None:
            raise ConfigError("--sim needs no --target: the emulated cFS is inside this program")
        if self.sim is not None and self.watch:
            raise ConfigError("--watch measures what other programs publish; with --sim there are none")
        if self.step_time is not None and self.step_time < _LEAST_STEP_NS:
            raise ConfigError("--step-time must be at least 2s, so that cFS wakes up several times in a step")

    def plan(self, route: Route, send_options: SendOptions) -> SweepPlan:
        """Return these options in the form that pipelines take."""
        from edoras_tools.addons.lab.sweep.plan import SweepPlan
        from edoras_tools.cfs.profile import GENERATOR_MSG_ID

        return SweepPlan(
            route,
            self.rate or ((2, 2) if self.by_size else (1, 1000)),
            self.size or (0, 0),
            self.step_time or 8 * SECOND,
            send_options,
            self.sim.value if self.sim else None,
            self.limit,
            self.watch,
            self.duration or 60 * SECOND,
            self.generator or send_options.headers.msg_ids.of_known(GENERATOR_MSG_ID),
        )


@headed("Sending")
class SendingOptions(NamedTuple):
    """Settings of sending."""

    target: sending.Target = None
    listen: sending.Listen = None
    sender: sending.As = None
    timeout: sending.Timeout = None
    allow: sending.Allow = None
    max_rate: sending.MaxRate = None
    unlimited: Annotated[bool, Option("--unlimited", hidden=True)] = False
    yes: sending.Yes = False

    def send_options(self, link: Link, headers: Headers | None) -> SendOptions:
        """Return these options in the form that pipelines take, for a route of this link.

        Args:
            link: link of the route.
            headers: headers of the cFE; None for the usual ones.
        """
        from edoras_tools.addons.lab.sweep.plan import command_receiver
        from edoras_tools.pipelines.sending.options import SendOptions
        from edoras_tools.wire.cfe import STANDARD

        return SendOptions(
            to=command_receiver(link),
            target=self.target,
            listen=self.listen,
            sender=self.sender,
            wait_for=("peer" if link.peers else "to-enabled",),
            timeout_ns=10 * SECOND if self.timeout is None else self.timeout,
            allow=tuple(self.allow or ()),
            max_rate_hz=self.max_rate or 0.0,
            unlimited=self.unlimited or self.max_rate == 0,
            confirmed=self.yes,
            headers=headers or STANDARD,
        )


@headed("Outputs")
class ChartOptions(NamedTuple):
    """Files for the chart."""

    output: Annotated[Path | None, Option("--output", "-o", help="Write the chart: .svg or .png.")] = None
    svg: Annotated[Path | None, Option(hidden=True)] = None
    png: Annotated[Path | None, Option(hidden=True)] = None
    force: recordings.Force = False

    def files(self) -> dict[str, Path]:
        """Return the files to write, by format.

        Raises:
            ConfigError: the suffix of ``--output`` is of neither format.
        """
        files = {"svg": self.svg, "png": self.png}
        if self.output is not None:
            if self.output.suffix not in {".svg", ".png"}:
                raise ConfigError(f"{self.output}: a chart is a .svg or a .png file")
            files[self.output.suffix[1:]] = self.output
        return {form: path for form, path in files.items() if path is not None}


@grouped
def sweep(
    *,
    route: Annotated[str, Argument(metavar="ROUTE", help="A topic or a key of the mission, or a MsgId.")],
    to: Annotated[str, Option(metavar="LINK", help="Commands by ci, telemetry by to, both by sbn.")] = "",
    steps: StepOptions,
    how: SendingOptions,
    charts: ChartOptions,
    dry_run: sending.DryRun = False,
    printing: options.PrintOptions,
    decoding: options.DecodingOptions,
) -> None:
    """Raise a route's rate or size until messages are lost.

    It prints the limit, its hop and its cause.

    For example: edoras sweep /cmd_vel -c rover.yaml, or with an emulated cFS: --sim rover
    """
    from edoras_tools.addons.lab import views
    from edoras_tools.addons.lab.sweep.plan import route_of
    from edoras_tools.addons.lab.sweep.run import sweep as carry_out
    from edoras_tools.io.outputs import check_new
    from edoras_tools.links.table import links
    from edoras_tools.render.plot import svg

    json, quiet = printing
    steps.check(how.target)
    pictures = charts.files()
    for path in pictures.values():
        check_new(path, force=charts.force)
    if "png" in pictures:
        svg.need_png()
    bench = decoding.settings().workbench()
    link = next((item for item in links() if item.label == to.lower()), None)
    if to and not (link and link.packets and link.bridge):
        raise ConfigError(
            f"--to {to}: a sweep counts with cFS's own counters: ci, to, sbn; edoras inject --rate and "
            "edoras replay --speed send others at a rate"
        )
    route_ = route_of(route, link, bench.mission)
    headers = bench.columns.context.options.headers
    send_options = how.send_options(route_.link, headers).placed(bench.mission)
    plan = steps.plan(route_, send_options)
    plan.check(bench)
    if dry_run:
        summary = plan.as_json(bench)
        if json:
            print_json(summary)
        else:
            print_view(views.sweep_plan(summary))
        return
    if steps.sim is None:
        assert send_options.target is not None
        sending.confirm_targets(send_options.target, confirmed=how.yes)
        if send_options.listen is not None:
            tell_reach(send_options.listen, "answer")
    with views.step_status(quiet=quiet) as trying:
        result = carry_out(plan, bench, trying=trying)
    summary = result.summary()
    if json:
        print_json(summary)
    elif not quiet and (result.steps or result.failure is None):
        print_view(lambda width: views.sweep_outcome(summary, width))
    if result.steps:
        _draw(summary, pictures)
    end(failure=result.failure)
    if result.interrupted:
        raise Exit(INTERRUPTED)


def _draw(summary: dict[str, Any], pictures: dict[str, Path]) -> None:
    from edoras_tools.addons.lab.views import chart, threshold_line
    from edoras_tools.io.outputs import write_bytes
    from edoras_tools.render.plot.svg import PLOT_WIDTH, plot_svg, png

    picture = plot_svg(chart(summary, f"threshold {threshold_line(summary)}"))
    for form, path in pictures.items():
        write_bytes(path, png(picture, 2 * PLOT_WIDTH) if form == "png" else picture.encode())


@grouped
def experiment(
    *,
    plan: Annotated[Path, Argument(metavar="PLAN.yaml", help="What is tried, and how often.")],
    output: Annotated[
        Path | None, Option("--output", "-o", help="Folder of the runs; default: the plan's name.")
    ] = None,
    yes: sending.Yes = False,
    printing: options.PrintOptions,
) -> None:
    """Make many runs, and say what each setting loses.

    Each run is recorded and diagnosed in the folder. Runs that are there are not made again, so the same
    command resumes what was broken off.

    For example, PLAN.yaml: {scenario: rover, settings: {rate: [5, 10]}, runs: 5..40, width: 1%}
    """
    from edoras_tools.addons.lab.experiment import Experiment, load_plan
    from edoras_tools.addons.lab.views import cells_table, step_status
    from edoras_tools.io.net.sockets import parse_endpoint

    plan_ = load_plan(plan)
    if plan_.target:
        sending.confirm_targets(parse_endpoint(plan_.target), confirmed=yes)
    carried_out = Experiment(plan_, output or plan.with_suffix(""))
    with step_status(quiet=printing.quiet) as trying:
        report = carried_out.run(trying)
    if printing.json:
        print_json(report)
    elif not printing.quiet:
        print_view(lambda width: cells_table(report, width))


def prove(inputs: InputOptions, settings: Settings, printing: PrintOptions, task: TaskOptions) -> None:
    """Prove a capture, and print the proof; with an output file, draw it too.

    Raises:
        ConfigError: the picture cannot be written.
        Exit: the model does not explain the losses, or an advice does not keep its promise.
    """
    from edoras_tools.addons.lab.proof import prove_capture
    from edoras_tools.addons.lab.views import proof_picture, proof_view

    output = task.output
    if output is not None:
        check_new(output, inputs.paths, force=task.force)
        if output.suffix.lower() != ".svg":
            raise ConfigError(f"{output}: the picture of --prove is SVG; name a file .svg")
    with file_progress(inputs.paths, quiet=printing.quiet or printing.json) as bar:
        diagnosis, proof = prove_capture(lambda: open_input(inputs, settings, aligned=True, progress=bar))
    if output is not None and not proof.not_modelled:
        picture = proof_picture(proof, diagnosis.zero_ns, " and ".join(item.name for item in inputs.paths))
        write_bytes(output, picture.encode())
    if printing.json:
        print_json(proof.as_json())
    else:
        print_view(lambda width: proof_view(proof, diagnosis.zero_ns, width))
    end(lost=not proof.explained or not all(item.keeps_promise for item in proof.advices))
