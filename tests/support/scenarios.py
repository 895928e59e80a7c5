"""Random flights of the emulated cFS: rates, limits, bursts, applications that stop and begin again."""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

from hypothesis import strategies as st
from msgspec.structs import replace

from edoras_tools.addons.lab.emulator import Simulation, messages
from edoras_tools.addons.lab.emulator.account import socket
from edoras_tools.addons.lab.emulator.apps import generator
from edoras_tools.addons.lab.emulator.apps.core import SingleRobotApp
from edoras_tools.addons.lab.emulator.simulation import WireDatagram, frames_of
from edoras_tools.cfs import edoras_app, telemetry_output
from edoras_tools.cfs import executive_services as es
from edoras_tools.cfs.profile import SimProfile
from edoras_tools.cfs.queues import QueueEnd
from edoras_tools.diagnosis.examination import Examination
from edoras_tools.io.frames.linklayer import Demux
from edoras_tools.model import Endpoint
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import cfe, envelope

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


def application(at, code, name):
    """Return a command to Executive Services that starts, stops or restarts an application."""
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
        commands.append(application(at, code, name))
        if name == "TO_LAB_APP" and code == es.RESTART_APP:
            address = b"127.0.0.1".ljust(16, b"\0")
            commands.append((at + 8, telemetry_output.COMMAND_MSG_ID, telemetry_output.ENABLE, address))
        elif code == es.STOP_APP and name != "CI_LAB_APP":
            commands.append(application(at + 8, es.START_APP, name))
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


class Bounds(NamedTuple):
    """The truth of a flight: arrivals that were lost at all, and those of which counters tell.

    ``most`` has the ends that nothing here can show, too; ``least`` only what 0x803, 0x884 and events surely
    cover: between the first and the last count, and not what was sent just before the first.
    """

    least: int
    most: int


def truth(simulation, sent):
    """Return the bounds of what was lost in a flight."""
    account, profile, application = simulation.cfs.account, simulation.cfs.profile, simulation.apps.edoras
    read = Counter((item.hop, item.msg_id) for item in account.arrivals if item.end is QueueEnd.DELIVERED)
    down = sum(item.destination == simulation.ground.endpoint for item in sent)
    sent_to_nobody = sum(number for (hop, _), number in read.items() if hop == telemetry_output.PIPE) - down
    if isinstance(application, SingleRobotApp):
        sent_to_nobody += read[edoras_app.PIPE, application.command] - application.robot_commands
    most = account.losses().total() + sent_to_nobody
    counts = {
        msg_id: [item.time_ns for item in sent if item.payload[:2] == msg_id.to_bytes(2, "big")]
        for msg_id in (0x803, 0x884)
    }
    if not all(counts.values()) or any(b"TO_LAB_APP" in item.payload for item in sent):
        return Bounds(0, most)
    first_ns, last_ns = max(item[0] for item in counts.values()), min(item[-1] for item in counts.values())
    seen = {telemetry_output.PIPE, edoras_app.PIPE, socket(profile.ci_port)}
    covered = (
        item.hop in seen
        and item.end in {QueueEnd.MSG_LIMIT, QueueEnd.PIPE_OVERFLOW}
        and item.msg_id not in application.wakeups
        and first_ns <= item.begin_ns <= last_ns - 3 * SECOND // 2
        for item in account.arrivals
    )
    just_before = sum(
        item.destination == simulation.cfs.ci_endpoint
        and 0 <= counts[0x884][0] - item.time_ns < SECOND // 100
        for item in sent
    )
    return Bounds(sum(covered) - just_before, most)


def replayed(hertz, count, *, enabled_before):
    """Return the simulation of a replay of commands to a cFS without bridges, and what it recorded."""
    simulation = Simulation(start_ns=START_NS, bridges=False, with_account=True)
    ground = Endpoint(simulation.cfs.profile.address, 50_000)
    enable = cfe.emit_command(
        telemetry_output.COMMAND_MSG_ID, telemetry_output.ENABLE, b"127.0.0.1".ljust(16, b"\0")
    )
    command = envelope.DEFAULT.emit(messages.twist(0.5, 0.1))
    begin_ns = START_NS + 4 * SECOND
    packets = [(begin_ns + index * SECOND // hertz, 0x1827, command) for index in range(count)]
    fed = [
        (at, cfe.emit_command(msg_id, edoras_app.SET, data, sequence_flags=0)) for at, msg_id, data in packets
    ]
    fed.append((begin_ns - (3 * SECOND if enabled_before else SECOND // 100), enable))
    for at, packet in fed:
        simulation.feed(at, simulation.cfs.ci_endpoint, packet)
    more = [WireDatagram(at, ground, simulation.cfs.ci_endpoint, packet) for at, packet in fed]
    sent = simulation.run(begin_ns + count * SECOND // hertz + 20 * SECOND)
    return simulation, sorted([*sent, *more], key=lambda item: item.time_ns)


def examined(sent):
    """Return what ``doctor --json`` says of some datagrams."""
    bench, demux = Settings(configs=[]).workbench(), Demux()
    examination = Examination(bench.columns.context)
    for first in range(0, len(sent), 1000):
        batch = demux.demux(frames_of(sent[first : first + 1000], first + 1))
        examination.add(batch, bench.columns.decode(batch))
    return examination.diagnose().as_json()
