"""A cFS of its own, emulated: ports, MsgIds, rounds and limits of no lab application, and its driver."""

from __future__ import annotations

from msgspec.structs import replace

from edoras_tools.addons.lab.emulator import Simulation, WireDatagram
from edoras_tools.addons.lab.emulator.apps import generator
from edoras_tools.addons.lab.emulator.cfs import SystemRoutes
from edoras_tools.cfs.profile import SimProfile
from edoras_tools.io.formats.pcap import PcapSink
from edoras_tools.io.frames.frame_batch import frames_of
from edoras_tools.io.frames.linklayer import Demux
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import cfe
from edoras_tools.wire.envelope import EnvelopeFormat

START_NS = 1_800_000_000 * SECOND
COMMAND, STATE = 0x1A01, 0x0A01
TWIST, POSE_STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/PoseStamped"
CONSTANTS = {
    "spacecraft_id": 7,
    "processor_id": 3,
    "ci_wake_ns": 250 * MILLISECOND,
    "to_wake_ns": 100 * MILLISECOND,
    "app_msg_limit": 2,
    "robot_port": 8585,
    "big_endian": 1,
}
PORTS = {"ci_port": 5010, "to_port": 5011}
LIMITS = {STATE: 20}
TIME = "little, 1/1000 s, since 2000-01-01T12:00:00"
PROFILE = replace(SimProfile().stating(CONSTANTS | PORTS, LIMITS), time=cfe.MissionTime.of_text(TIME))
ENVELOPE = EnvelopeFormat.of_name("length: u16be, capacity: u16be")
ROUTES = SystemRoutes(
    {COMMAND: TWIST, STATE: POSE_STAMPED}, [COMMAND], [STATE], envelopes={COMMAND: ENVELOPE, STATE: ENVELOPE}
)
_STEPS = ((2, 300), (6, 100), (9, 0))
"""From which second on the generator publishes the state how often a second."""


def play(profile=PROFILE, routes=ROUTES, *, seconds=16, seed=1):
    """Drive a system: commands at 20 Hz, its state published faster than it lets through.

    Returns:
        every datagram on the wire, and the simulation.
    """
    simulation = Simulation(replace(profile, seed=seed), routes, start_ns=START_NS, command_rate_hz=20)
    ci, ground = simulation.cfs.ci_endpoint, simulation.ground.endpoint
    driven = []
    for second, rate in _STEPS:
        payload = generator.set_command(routes.telemetry[0], rate)
        packet = cfe.emit_command(generator.COMMAND_MSG_ID, generator.SET, payload, sequence_flags=0)
        driven.append(WireDatagram(START_NS + second * SECOND, ground, ci, packet))
        simulation.feed(driven[-1].time_ns, ci, packet)
    sent = [*driven, *simulation.run(START_NS + seconds * SECOND)]
    return sorted(sent, key=lambda item: item.time_ns), simulation


def lost(simulation):
    """Return what a system lost: over a limit, in full pipes, and of its commands."""
    counters = simulation.cfs.bus.counters
    commands = simulation.ground.sent - simulation.apps.edoras.robot_commands
    return counters.msg_limits, counters.pipe_overflows, commands


def write(sent, path):
    """Write datagrams as a capture."""
    with path.open("wb") as file:
        sink = PcapSink(file, nanosecond=True)
        sink.write(Demux().demux(frames_of(sent, 1)))
        sink.close()
    return path
