"""``edoras sim``: the emulated cFS."""

from __future__ import annotations

import sys
from time import time_ns
from typing import Annotated, Any, NamedTuple

from msgspec.structs import replace
from typer import Argument, Option

from edoras_tools.cli import options
from edoras_tools.cli.declare import grouped
from edoras_tools.cli.options import SCENARIOS, Scenario
from edoras_tools.cli.output import tell_reach


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
    from edoras_tools.addons.lab.emulator.messages import bus_id
    from edoras_tools.addons.lab.emulator.routes import mission_profile, routes_of, with_limit
    from edoras_tools.cfs.profile import SbnPeerConfig, SimProfile
    from edoras_tools.model import Endpoint
    from edoras_tools.pipelines.interrupt import on_interrupt

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
