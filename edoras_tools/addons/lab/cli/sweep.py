"""``edoras sweep``: measures how much a route can carry."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from typer import Argument, BadParameter, Exit, Option

from edoras_tools.cli import options, recordings, sending
from edoras_tools.cli.declare import grouped, headed
from edoras_tools.cli.options import Scenario
from edoras_tools.cli.output import INTERRUPTED, print_json, print_view, tell_reach
from edoras_tools.errors import ConfigError
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from edoras_tools.addons.lab.sweep.plan import SweepPlan
    from edoras_tools.mission import Route
    from edoras_tools.model import Endpoint, Link
    from edoras_tools.pipelines.sending.options import SendOptions
    from edoras_tools.wire.cfe import Headers

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
    from edoras_tools.addons.lab.sweep.plan import route_of
    from edoras_tools.addons.lab.sweep.run import sweep as carry_out
    from edoras_tools.addons.lab.views import sweep as view
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
            print_view(view.plan(summary))
        return
    if steps.sim is None:
        assert send_options.target is not None
        sending.confirm_targets(send_options.target, confirmed=how.yes)
        if send_options.listen is not None:
            tell_reach(send_options.listen, "answer")
    with view.step_status(quiet=quiet) as trying:
        result = carry_out(plan, bench, trying=trying)
    summary = result.summary()
    if json:
        print_json(summary)
    elif not quiet and (result.steps or result.failure is None):
        print_view(lambda width: view.outcome(summary, width))
    if result.steps:
        _draw(summary, pictures)
    if result.failure is not None:
        raise result.failure
    if result.interrupted:
        raise Exit(INTERRUPTED)


def _draw(summary: dict[str, Any], pictures: dict[str, Path]) -> None:
    from edoras_tools.addons.lab.views.sweep import chart, threshold_line
    from edoras_tools.io.outputs import write_bytes
    from edoras_tools.render.plot.svg import PLOT_WIDTH, plot_svg, png

    picture = plot_svg(chart(summary, f"threshold {threshold_line(summary)}"))
    for form, path in pictures.items():
        write_bytes(path, png(picture, 2 * PLOT_WIDTH) if form == "png" else picture.encode())
