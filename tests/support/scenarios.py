"""Random flights of the emulated cFS: rates, limits, bursts, applications that stop and begin again."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from hypothesis import strategies as st

from edoras_tools.addons.lab.emulator import Simulation
from edoras_tools.addons.lab.emulator.apps import generator
from edoras_tools.addons.lab.emulator.simulation import WireDatagram
from edoras_tools.cfs import executive_services as es
from edoras_tools.cfs import telemetry_output
from edoras_tools.cfs.profile import SimProfile
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import cfe

START_NS = 1_800_000_000 * SECOND
EXTRA = 0x8F1
"""What the generator publishes."""


class Flight(NamedTuple):
    """One flight: ``commands`` are (seconds, MsgId, function code, payload)."""

    scenario: str
    profile: SimProfile
    hertz: float
    state_hertz: float
    seconds: int
    quiet: int
    commands: tuple


def _application(at, code, name):
    file, entry = es.STARTS[name]
    payload = name.encode().ljust(es.APP_NAME_BYTES, b"\0")
    if code == es.START_APP:
        payload += entry.encode().ljust(es.APP_NAME_BYTES, b"\0")
        payload += file.encode().ljust(es.FILE_NAME_BYTES, b"\0") + bytes(12)
    return at, es.COMMAND_MSG_ID, code, payload


@st.composite
def flights(draw, *, ends=True):
    """Draw a flight of at most 25 s and 16 s of silence; ``ends``: applications may be stopped."""
    scenario = draw(st.sampled_from(["rover", "arm", "two-rovers", "two-arms"]))
    limits = draw(st.sampled_from([None, 1, 4, 20, 255]))
    profile = SimProfile(
        app_msg_limit=draw(st.sampled_from([2, 4, 4, 8, 20])),
        to_pipe_depth=draw(st.sampled_from([12, 50, 50])),
        socket_queue=draw(st.sampled_from([10, 40, 256])),
        msg_max=draw(st.sampled_from([0, 0, 20])),
        to_wake_ns=draw(st.sampled_from([100, 500, 500])) * MILLISECOND,
        ci_wake_ns=draw(st.sampled_from([250, 500, 500])) * MILLISECOND,
        seed=draw(st.integers(0, 1000)),
    )
    if limits:
        profile = replace(profile, to_limits={**profile.to_limits, EXTRA: limits})
    seconds = draw(st.integers(12, 25))
    commands = []
    for _ in range(draw(st.integers(0, 3))):
        at, length = draw(st.floats(5, seconds - 3)), draw(st.floats(0.3, 4))
        rate = draw(st.sampled_from([6, 20, 60, 200]))
        commands += [
            (when, generator.COMMAND_MSG_ID, generator.SET, generator.set_command(EXTRA, value))
            for when, value in ((at, rate), (at + length, 0))
        ]
    if ends and draw(st.booleans()):
        at, name = (
            draw(st.floats(6, seconds - 4)),
            draw(st.sampled_from(["EDORAS_APP", "CI_LAB_APP", "TO_LAB_APP"])),
        )
        code = draw(st.sampled_from([es.STOP_APP, es.RESTART_APP]))
        commands.append(_application(at, code, name))
        if name == "TO_LAB_APP" and code == es.RESTART_APP:
            address = b"127.0.0.1".ljust(16, b"\0")
            commands.append((at + 8, telemetry_output.COMMAND_MSG_ID, telemetry_output.ENABLE, address))
        elif code == es.STOP_APP and name != "CI_LAB_APP":
            commands.append(_application(at + 8, es.START_APP, name))
    hertz = draw(st.sampled_from([0.0, 1.0, 4.0, 9.0, 12.0, 20.0, 60.0]))
    return Flight(
        scenario,
        profile,
        hertz,
        draw(st.sampled_from([1.0, 4.0, 12.0])),
        seconds,
        16,
        tuple(sorted(commands)),
    )


def fly(flight, *, with_account=True):
    """Return the simulation of a flight, at its end, and the datagrams that it sent."""
    simulation = Simulation(
        flight.profile,
        flight.scenario,
        start_ns=START_NS,
        command_rate_hz=flight.hertz,
        state_rate_hz=flight.state_hertz,
        command_count=int(flight.hertz * (flight.seconds - 4)) or None,
        with_account=with_account,
    )
    ci, operator = simulation.cfs.ci_endpoint, simulation.ground.endpoint
    more = []
    for at, msg_id, code, payload in flight.commands:
        packet = cfe.emit_command(msg_id, code, payload, sequence_flags=0)
        more.append(WireDatagram(START_NS + int(at * SECOND), operator, ci, packet))
        simulation.feed(more[-1].time_ns, ci, packet)
    sent = simulation.run(START_NS + (flight.seconds + flight.quiet) * SECOND)
    return simulation, sorted([*sent, *more], key=lambda item: item.time_ns)
