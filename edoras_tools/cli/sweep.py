"""``edoras sweep``: how much a route can carry."""

from __future__ import annotations

import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from edoras_tools.cli import options, sending
from edoras_tools.cli.sim import Scenario

if TYPE_CHECKING:
    from edoras_tools.pipelines.workbench import Settings

_LEAST_STEP_NS = 2_000_000_000


class Way(StrEnum):
    """The link that a route takes."""

    CI = "ci"
    TO = "to"
    SBN = "sbn"


def span(text: str) -> tuple[int, int]:
    """Read ``FROM..TO``, or one number for both."""
    first, dots, last = text.partition("..")
    try:
        found = int(first, 0), int(last if dots else first, 0)
    except ValueError:
        found = 0, 0
    if not 1 <= found[0] <= found[1] <= 65535:
        raise typer.BadParameter(f"{text!r} is no FROM..TO; write 1..1000, in whole numbers from 1 to 65535")
    return found


@options.takes_decoding
def sweep(
    settings: Settings,
    route: Annotated[str, typer.Argument(metavar="ROUTE", help="A topic or a key of the mission; a MsgId.")],
    to: Annotated[
        Way | None,
        typer.Option(metavar="LINK", help="Commands through ci, telemetry through to, either over sbn."),
    ] = None,
    rate: Annotated[
        Any,
        typer.Option(
            metavar="FROM..TO",
            parser=span,
            help="Messages a second, upward; 1..1000. With a range of sizes one rate; 2.",
        ),
    ] = None,
    size: Annotated[
        Any,
        typer.Option(
            metavar="FROM..TO",
            parser=span,
            help="Bytes of the space packet, upward; or one size. The message's own if not said.",
        ),
    ] = None,
    step_time: Annotated[
        int | None,
        typer.Option("--step-time", metavar="TIME", parser=options.duration, help="How long a step is; 8s."),
    ] = None,
    sim: Annotated[
        Scenario | None,
        typer.Option("--sim", metavar="SCENARIO", help="An emulated cFS, in simulated time: at once."),
    ] = None,
    limit: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            min=1,
            max=255,
            help="With --sim: how many of the route's messages may wait in its pipe.",
        ),
    ] = None,
    watch: Annotated[bool, typer.Option("--watch", help="Publish nothing, look at what comes.")] = False,
    duration: options.Duration = None,
    target: sending.Target = None,
    listen: sending.Ear = None,
    sender: sending.As = None,
    timeout: sending.Timeout = None,
    allow: sending.Allow = None,
    unlimited: sending.Unlimited = False,
    yes: sending.Yes = False,
    svg: Annotated[Path | None, typer.Option(metavar="FILE", help="Write the chart as SVG.")] = None,
    png: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the chart as PNG; needs matplotlib.")
    ] = None,
    dry_run: sending.DryRun = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Raise a route's rate, or size, until messages are lost: where the limit is, at which hop, and why.

    For example: edoras sweep /cmd_vel -c rover.yaml, or without any cFS with --sim rover
    """
    from edoras_tools.cli.output import print_json
    from edoras_tools.errors import ConfigError
    from edoras_tools.model import Link
    from edoras_tools.pipelines.orders import Orders
    from edoras_tools.pipelines.safety import check_target
    from edoras_tools.pipelines.sweep import sweep as carry_out
    from edoras_tools.pipelines.sweep_plan import Plan, receiver, route_of
    from edoras_tools.render import chart
    from edoras_tools.render import sweep as view
    from edoras_tools.render.console import output_console
    from edoras_tools.sessions.profile import SECOND

    by_size = size is not None and size[0] != size[1]
    if by_size and rate is not None and rate[0] != rate[1]:
        raise ConfigError(
            "one range at a time: --rate FROM..TO at one --size, or --size FROM..TO at one --rate"
        )
    if limit is not None and sim is None:
        raise ConfigError("--limit sets up the emulated cFS; it needs --sim")
    if sim is not None and target is not None:
        raise ConfigError("--sim needs no --target: the emulated cFS is inside this program")
    if sim is not None and watch:
        raise ConfigError("--watch looks at what others publish, and nobody else is in --sim")
    if step_time is not None and step_time < _LEAST_STEP_NS:
        raise ConfigError("--step-time: 2s at the least, as long as cFS needs to wake up a few times")
    if png is not None:
        chart.need_png()
    bench = settings.workbench()
    chosen = route_of(route, Link[to.name] if to else None, bench.mission)
    orders = Orders(
        to=receiver(chosen.link),
        target=target,
        listen=listen,
        sender=sender,
        wait_for=("peer" if chosen.link is Link.SBN else "to-enabled",),
        timeout_ns=timeout or 10 * SECOND,
        allow=tuple(allow or ()),
        unlimited=unlimited,
        yes=yes,
    ).placed(bench.mission)
    plan = Plan(
        chosen,
        rate or ((2, 2) if by_size else (1, 1000)),
        size or (0, 0),
        step_time or 8 * SECOND,
        orders,
        sim.value if sim else None,
        limit,
        watch,
        duration or 60 * SECOND,
    )
    plan.check(bench)
    if dry_run:
        summary = plan.as_json(bench)
        if json:
            print_json(summary)
        else:
            output_console().print(view.plan(summary))
        return
    if sim is None:
        assert orders.target is not None
        asks = sys.stdin is not None and sys.stdin.isatty() and sys.stderr.isatty()
        check_target(orders.target, yes=yes, confirm=_confirm if asks else None)
    with view.watching(quiet=quiet) as trying:
        found = carry_out(plan, bench, trying=trying)
    summary = found.summary()
    if json:
        print_json(summary)
    elif not quiet and (found.steps or found.failure is None):
        console = output_console()
        console.print(view.outcome(summary, console.width))
    if found.steps:
        _draw(summary, svg, png)
    if found.failure is not None:
        raise found.failure


def _confirm(question: str) -> bool:
    return typer.confirm(question, err=True)


def _draw(summary: dict[str, Any], svg: Path | None, png: Path | None) -> None:
    from io import BytesIO

    from edoras_tools.errors import CaptureError
    from edoras_tools.render import chart
    from edoras_tools.render.sweep import threshold

    drawn = chart.Chart.of(summary)
    subtitle = f"threshold {threshold(summary)}"
    images: list[tuple[Path, bytes]] = []
    if svg is not None:
        images.append((svg, chart.svg(drawn, subtitle).encode()))
    if png is not None:
        image = BytesIO()
        chart.png(drawn, image, subtitle)
        images.append((png, image.getvalue()))
    for path, content in images:
        try:
            path.write_bytes(content)
        except OSError as error:
            raise CaptureError(f"{path}: cannot be written: {error.strerror or error}") from None
