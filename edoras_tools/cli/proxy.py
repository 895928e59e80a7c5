"""``edoras proxy``: a relay in the middle."""

from __future__ import annotations

import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from edoras_tools.cli import options
from edoras_tools.cli.endings import LOST
from edoras_tools.cli.live import Origins, Show, Shown, showing
from edoras_tools.cli.sending import DryRun, Yes, endpoint

if TYPE_CHECKING:
    from edoras_tools.errors import EdorasError
    from edoras_tools.pipelines.proxy import Proxy
    from edoras_tools.pipelines.proxy_plan import ProxyPlan
    from edoras_tools.pipelines.workbench import Settings, Workbench
    from edoras_tools.sessions.faults import FaultPlan

_IDLE_NS = 60_000_000_000


class LinkName(StrEnum):
    """A link that can be relayed."""

    CI = "ci"
    TO = "to"
    SBN = "sbn"


@options.takes_decoding
@options.takes_faults
def proxy(
    settings: Settings,
    faults: FaultPlan,
    link: Annotated[LinkName, typer.Argument(help="What is relayed.")],
    listen: Annotated[
        Any,
        typer.Option(
            "--listen",
            metavar="[HOST:]PORT",
            parser=endpoint,
            help="Where to wait for clients; for to: for cFS.",
        ),
    ],
    target: Annotated[
        Any, typer.Option("--target", metavar="HOST:PORT", parser=endpoint, help="Where it all goes.")
    ],
    further: Annotated[
        list[Any] | None,
        typer.Option(
            "--to",
            metavar="HOST:PORT",
            parser=endpoint,
            help="And there, as to a second ground station; repeatable.",
        ),
    ] = None,
    bind: Annotated[
        Any,
        typer.Option(
            "--bind",
            metavar="[HOST:]PORT",
            parser=endpoint,
            help="Where the target sends to, as an SBN peer's port in cFS's table.",
        ),
    ] = None,
    client: Annotated[
        Any,
        typer.Option(
            "--client",
            metavar="HOST:PORT",
            parser=endpoint,
            help="With --bind: who gets it before anybody has spoken.",
        ),
    ] = None,
    limit: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[ROUTE=]HZ[,latest]",
            help="No more a second of each MsgId, of a topic or MsgId, or of all=HZ; repeatable.",
        ),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE", help="Record to .mcap, .pcapng or .pcap.")
    ] = None,
    live: Shown = None,
    allow_origin: Origins = None,
    idle: Annotated[
        int | None,
        typer.Option(metavar="TIME", parser=options.duration, help="Forget clients silent for so long; 60s."),
    ] = None,
    duration: options.Duration = None,
    yes: Yes = False,
    dry_run: DryRun = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Relay CI, TO or SBN: transparent, recorded, limited, to several stations, or wrong on purpose.

    Send what was sent to the target to the proxy instead. Keys 1 to 9 switch faults, q ends.
    """
    from dataclasses import replace

    from edoras_tools.cli.output import print_json
    from edoras_tools.model import Link
    from edoras_tools.pipelines.proxy_plan import ProxyPlan, as_relayed, limit_rule
    from edoras_tools.pipelines.safety import check_target
    from edoras_tools.render import proxy as view
    from edoras_tools.render.console import error_console, output_console
    from edoras_tools.render.foxglove import served

    relayed = Link[link.name]
    bench = as_relayed(settings, relayed, target).workbench()
    limits = tuple(limit_rule(text, bench.mission) for text in limit or ())
    plan = ProxyPlan(
        link=relayed,
        listen=listen,
        targets=(target, *(further or ())),
        bind=bind,
        client=client,
        faults=replace(faults, rules=(*faults.rules, *limits)),
        idle_ns=idle or _IDLE_NS,
    )
    if dry_run:
        if json:
            print_json(plan.summary())
        else:
            output_console().print(view.plan(plan.summary(), output))
        return
    asks = sys.stdin is not None and sys.stdin.isatty() and sys.stderr.isatty()
    for item in plan.targets:
        check_target(item, yes=yes, confirm=_confirm if asks else None)
    relay = _opened(plan, bench, output, showing(bench, live, allow_origin))
    failure = _run(relay, output, duration or 0, keyboard=asks, quiet=quiet or json)
    summary = relay.summary()
    shown = relay.recorder.shown.summary() if relay.recorder and relay.recorder.shown else None
    if json:
        print_json({**summary, "foxglove": shown})
    elif not quiet:
        console = error_console()
        console.print(view.outcome(summary, console.width, output))
        for line in served(shown) if shown else ():
            sys.stderr.write(f"{line}\n")
    if quiet or json:
        for line in view.notes(summary):
            sys.stderr.write(f"edoras: {line}\n")
    if failure is not None:
        raise failure
    if summary["lost"]:
        raise typer.Exit(LOST)


def _opened(plan: ProxyPlan, bench: Workbench, output: Path | None, show: Show | None) -> Proxy:
    """Bind the ports, then begin the recording, and to show it."""
    from edoras_tools.pipelines.fault_where import compiler
    from edoras_tools.pipelines.proxy import Proxy

    if output is None and show is None:
        return Proxy(plan, where=compiler(bench))
    from edoras_tools.pipelines.proxy_recorder import Recorder
    from edoras_tools.pipelines.record import Target, check_target

    goal = Target(output) if output else None
    if goal:
        check_target(goal, ())
    name = f"{plan.link.label} {plan.listen} to {plan.targets[0]}"
    return Proxy(plan, recorder=lambda: Recorder(goal, bench, name, show=show), where=compiler(bench))


def _run(
    relay: Proxy, output: Path | None, duration_ns: int, *, keyboard: bool, quiet: bool
) -> EdorasError | None:
    """Relay until the end; return what ended it early, if anything did."""
    from contextlib import ExitStack

    from edoras_tools.errors import EdorasError
    from edoras_tools.pipelines.interrupt import on_interrupt
    from edoras_tools.pipelines.keys import Keys
    from edoras_tools.render.console import error_console
    from edoras_tools.render.proxy import ProxyTable
    from edoras_tools.render.terminal import look

    failure: EdorasError | None = None
    with ExitStack() as stack:
        stack.enter_context(on_interrupt(relay.stop))  # from the moment that it is told
        sys.stderr.write(f"relaying {relay.title}; Ctrl-C ends\n")
        sys.stderr.flush()
        table = keys = None
        if not quiet and look(sys.stderr).interactive:
            keys = stack.enter_context(Keys()) if keyboard else None
            table = stack.enter_context(ProxyTable(error_console(), output, keys=keyboard))
        try:
            relay.run(duration_ns=duration_ns, watcher=table, keys=keys)
        except EdorasError as error:
            failure = error
        finally:
            relay.close()
    return failure or (relay.recorder.failure if relay.recorder else None)


def _confirm(question: str) -> bool:
    return typer.confirm(question, err=True)
