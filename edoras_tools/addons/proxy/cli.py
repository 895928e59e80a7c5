"""``edoras proxy``: a relay between the two ends of a link."""

from __future__ import annotations

import sys
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from msgspec.structs import replace
from typer import Argument, Option

from edoras_tools.cli import options
from edoras_tools.cli.options import grouped
from edoras_tools.cli.output import address, end, print_json, print_view, say, tell_reach
from edoras_tools.cli.relays import RelayOutputOptions, finish_relay, run_relay
from edoras_tools.cli.sending import DryRun, Yes, confirm_targets
from edoras_tools.errors import ConfigError

if TYPE_CHECKING:
    from edoras_tools.addons.proxy.plan import ProxyPlan
    from edoras_tools.addons.proxy.run import Proxy
    from edoras_tools.addons.proxy.streams import StreamProxy

_IDLE_NS = 60_000_000_000
_NEVER_NS = 1 << 62


class RelayOptions(NamedTuple):
    """The link, the addresses, and the rates."""

    link: Annotated[str, Argument(metavar="LINK", help="The link to relay: ci, to, sbn, fprime ...")]
    listen: Annotated[
        Any,
        Option(parser=address, metavar="[HOST:]PORT", help="Where clients send; of link to: where cFS does."),
    ]
    target: Annotated[Any, Option(parser=address, help="Where to send everything.")]
    further: Annotated[
        list[Any] | None,
        Option(
            "--to", parser=address, metavar="HOST:PORT", help="Another target, e.g. a second ground station."
        ),
    ] = None
    bind: Annotated[
        Any,
        Option(parser=address, metavar="[HOST:]PORT", help="Where the target sends, as an SBN peer's port."),
    ] = None
    client: Annotated[Any, Option(parser=address, help="With --bind: the first client.")] = None
    limit: Annotated[
        list[str] | None,
        Option(
            "--max-rate",
            metavar="[ROUTE=]HZ[,latest]",
            help="Messages per second: for each MsgId, for one topic or MsgId, or for all=HZ.",
        ),
    ] = None
    tcp: Annotated[bool, Option("--tcp", help="Relay TCP connections, not datagrams.")] = False
    cut: Annotated[int | None, Option(parser=options.duration, help="TCP: cut connections after.")] = None


class TimeOptions(NamedTuple):
    """Time that clients are kept, and duration of the proxy."""

    timeout: Annotated[
        int | None, Option(parser=options.duration, help="Forget silent clients; default 60s; 0: never.")
    ] = None
    duration: options.Duration = None


@grouped
def proxy(
    *,
    relayed: RelayOptions,
    outputs: RelayOutputOptions,
    times: TimeOptions,
    yes: Yes = False,
    dry_run: DryRun = False,
    printing: options.PrintOptions,
    faults: options.FaultOptions,
    decoding: options.DecodingOptions,
) -> None:
    """Relay a link: recorded, at limited rates, with faults.

    Several stations can be served at once.

    Programs send to the proxy instead of the target. Keys 1 to 9 switch faults on and off, q quits.
    """
    from edoras_tools.addons.proxy import views
    from edoras_tools.addons.proxy.plan import ProxyPlan, as_relayed, limit_rule
    from edoras_tools.addons.proxy.run import Proxy
    from edoras_tools.links.table import link_of_label, protocol
    from edoras_tools.model import OTHER
    from edoras_tools.pipelines.faults import compiler
    from edoras_tools.render.terminal.palette import detect_terminal

    settings, injected = decoding.settings(), faults.plan()
    (json, quiet), output = printing, outputs.output
    link, target = link_of_label(relayed.link), relayed.target
    if link == OTHER or not protocol(link).relayed:
        raise ConfigError(f"{link.label} cannot be relayed: its ends do not send to a port that is agreed on")
    bench = as_relayed(settings, link, target).workbench()
    limits = tuple(limit_rule(text, bench.mission) for text in relayed.limit or ())
    plan = ProxyPlan(
        link=link,
        listen=relayed.listen,
        targets=(target, *(relayed.further or ())),
        bind=relayed.bind,
        client=relayed.client,
        faults=replace(injected, rules=(*injected.rules, *limits)),
        headers=bench.columns.context.headers,
        idle_ns=_IDLE_NS if times.timeout is None else times.timeout or _NEVER_NS,
    )
    streams = relayed.tcp or not link.transport.udp
    if relayed.cut and not streams:
        raise ConfigError("--cut is for TCP connections: add --tcp")
    if streams and not dry_run:
        _relay_streams(plan, relayed, outputs, times, printing, confirmed=yes)
        return
    if dry_run:
        if json:
            print_json(plan.summary())
        else:
            print_view(views.plan(plan.summary(), output))
        return
    asks = confirm_targets(*plan.targets, confirmed=yes)
    name = f"{link.label} {plan.listen} to {target}"
    recorder = outputs.recorder(lambda: bench, name, apart=True)
    relay = Proxy(plan, recorder=recorder, where=compiler(bench))
    tell_reach(relayed.listen, f"send to {target} through it")
    if relayed.bind:
        tell_reach(relayed.bind, "answer as the target")
    shows = not (quiet or json) and detect_terminal(sys.stderr).interactive
    table = partial(views.live_table, output=output, keys=asks) if shows else None
    begin = partial(_begin, relay)
    failure = run_relay(relay, begin, times.duration, table, keyboard=asks, metrics=outputs.metrics)
    finish_relay(relay, views.outcome, views.notes, output, printing, failure)


def _relay_streams(
    plan: ProxyPlan,
    relayed: RelayOptions,
    outputs: RelayOutputOptions,
    times: TimeOptions,
    printing: options.PrintOptions,
    *,
    confirmed: bool,
) -> None:
    """Relay TCP connections until the end, and print what was relayed."""
    from edoras_tools.addons.proxy.streams import StreamProxy
    from edoras_tools.addons.proxy.views import stream_lines

    if not plan.link.transport.tcp:
        raise ConfigError(f"{plan.link.label} is not a link over TCP: leave --tcp out")
    if len(plan.targets) > 1 or plan.bind or relayed.limit:
        raise ConfigError("--to, --bind and --max-rate are for datagrams: a TCP connection has one target")
    if outputs.output or outputs.live is not None or outputs.metrics:
        raise ConfigError(
            "a relay of TCP does not record: use edoras record -i beside it, on the interface of the target"
        )
    confirm_targets(*plan.targets, confirmed=confirmed)
    relay = StreamProxy(plan, relayed.cut or 0)
    tell_reach(relayed.listen, f"connect to {plan.targets[0]} through it")
    failure = run_relay(relay, partial(_begin, relay), times.duration)
    end(failure=failure)
    json, quiet = printing
    if json:
        print_json(relay.summary())
    elif not quiet:
        say(*stream_lines(relay.summary()))


def _begin(relay: Proxy | StreamProxy) -> None:
    """Print what is relayed."""
    say(f"relaying {relay.title}; Ctrl-C ends")
