"""``edoras sim``: the emulated cFS."""

from __future__ import annotations

import sys
from enum import StrEnum
from typing import Annotated

import typer

from edoras_tools.cli import options


class Scenario(StrEnum):
    """A demo of the EDORAS paper."""

    ROVER = "rover"
    ARM = "arm"
    TWO_ROVERS = "two-rovers"
    TWO_ARMS = "two-arms"


def sim(
    scenario: Annotated[Scenario, typer.Argument(help="Which of the EDORAS demos.")] = Scenario.ROVER,
    bridges: Annotated[bool, typer.Option(help="Play the operator, the bridges and the robots too.")] = True,
    rate: Annotated[
        float, typer.Option("--hz", metavar="HZ", min=0.01, max=1000, help="Commands a second.")
    ] = 5.0,
    limit: Annotated[
        int,
        typer.Option(metavar="N", min=1, max=255, help="Telemetry Output: how many of one MsgId may wait."),
    ] = 4,
    host: Annotated[str, typer.Option(metavar="ADDRESS", help="Where to bind.")] = "127.0.0.1",
    duration: options.Duration = None,
    quiet: options.Quiet = False,
) -> None:
    """Run an emulated cFS: CI, TO, SBN and a robot app on loopback, with the limits of the real one.

    Its console goes to stdout. Look at it from another terminal: edoras sniff -i lo
    """
    from dataclasses import replace
    from threading import Event
    from time import time_ns

    from edoras_tools.pipelines.interrupt import on_interrupt
    from edoras_tools.sessions.profile import TO_TABLE, SimProfile
    from edoras_tools.sim import Simulation, serve

    # Bound to every address, the parts still talk to each other on loopback.
    address = "127.0.0.1" if host == "0.0.0.0" else host  # noqa: S104  what was asked for
    profile = SimProfile()
    peers = tuple(replace(peer, address=address) for peer in profile.sbn_peers)
    limits = {
        msg_id: limit if room == profile.to_default_limit else room for msg_id, room in TO_TABLE.items()
    }
    profile = replace(profile, to_default_limit=limit, to_limits=limits, address=address, sbn_peers=peers)
    simulation = Simulation(
        profile, scenario.value, start_ns=time_ns(), bridges=bridges, command_rate_hz=rate, state_rate_hz=rate
    )
    stop = Event()
    # Telemetry's source is a port of the system's choice.
    bound = [item for item in simulation.endpoints if item != simulation.cfs.to_endpoint]
    ends = ", ".join(f"{item.port}" for item in bound)

    def ready() -> None:
        sys.stderr.write(f"emulated cFS ({scenario.value}) on {host}, UDP {ends}; Ctrl-C ends\n")

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
