"""A bench for the doctor: captures, simulations and single datagrams, examined the way the command does."""

from __future__ import annotations

from functools import cache

import pytest
from msgspec.structs import replace
from places import ROOT

from edoras_tools.addons.lab.emulator import Simulation, WireDatagram
from edoras_tools.addons.lab.emulator.apps import generator
from edoras_tools.cfs.profile import SimProfile
from edoras_tools.diagnosis.case import Capture
from edoras_tools.diagnosis.examination import Examination
from edoras_tools.io.formats.open import open_file
from edoras_tools.io.frames.frame_batch import frames_of
from edoras_tools.io.frames.linklayer import Demux
from edoras_tools.model import Endpoint, Peer
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe, sbn

SAMPLES = ROOT / "samples/captures"
BRIDGE = Peer(0x42, 3)
START_NS = 1_800_000_000 * SECOND
MISSIONS = {
    "rover": ("rover_ground",),
    "arm": ("single_arm_ground",),
    "two-rovers": ("two_rovers_ground", "two_rovers_flight"),
    "two-arms": ("two_arms_ground", "two_arms_flight"),
}


@cache
def _simulated(scenario, seconds, hz, state_hz, profile, count, limits, generators, feeds):
    built = SimProfile(**dict(profile))
    if limits:
        built = replace(built, to_limits={**built.to_limits, **dict(limits)})
    simulation = Simulation(
        built,
        scenario,
        start_ns=START_NS,
        command_rate_hz=hz,
        state_rate_hz=state_hz,
        command_count=count,
    )
    for at, msg_id, rate in generators:
        command = cfe.emit_command(
            generator.COMMAND_MSG_ID, 2, generator.set_command(msg_id, rate), sequence_flags=0
        )
        simulation.feed(START_NS + int(at * SECOND), simulation.cfs.ci_endpoint, command)
    for at, port, data in feeds:
        simulation.feed(START_NS + int(at * SECOND), Endpoint("127.0.0.1", port), data)
    sent = tuple(simulation.run(START_NS + int(seconds * SECOND)))
    return sent, simulation.cfs.bus.counters


class Lab:
    """Makes traffic and examines it."""

    start_ns = START_NS
    ci = Endpoint("127.0.0.1", 1234)
    ground = Endpoint("127.0.0.1", 1235)
    cfs = Endpoint("127.0.0.1", 2234)
    bridge = Endpoint("127.0.0.1", 2236)

    def mission(self, *names):
        return [ROOT / f"samples/missions/{name}.yaml" for name in names]

    def missions(self, scenario):
        return self.mission(*MISSIONS[scenario])

    def simulate(
        self,
        scenario="rover",
        seconds=20,
        hz=4.0,
        state_hz=4.0,
        count=None,
        limits=(),
        generators=(),
        feeds=(),
        **profile,
    ):
        """Return the datagrams of a simulation and what its software bus really counted."""
        sent, counters = _simulated(
            scenario,
            seconds,
            hz,
            state_hz,
            tuple(sorted(profile.items())),
            count,
            tuple(limits),
            tuple(generators),
            tuple(feeds),
        )
        return list(sent), counters

    def examine(self, sent, config=(), *, drops=0, profile=None, faults=(), outages=(), host=()):
        """Return the diagnosis of some datagrams, in the order given."""
        bench = Settings(configs=list(config)).workbench()
        examination = Examination(bench.columns.context, profile)
        examination.faults = faults
        demux, chunk = Demux(), 1000
        for at in range(0, len(sent), chunk):
            batch = demux.demux(frames_of(sent[at : at + chunk], at + 1))
            examination.add(batch, bench.columns.decode(batch))
        return examination.diagnose(Capture(drops, outages=tuple(outages), host=tuple(host)))

    def read(self, path, config=(), structs=()):
        """Return the diagnosis of a capture."""
        source = open_file(path)
        bench = Settings(configs=list(config), structs=structs).workbench()
        examination = Examination(bench.columns.context)
        for batch in source.batches():
            examination.add(batch, bench.columns.decode(batch))
        return examination.diagnose(Capture(lacking=tuple(source.statistics.cut)))

    def datagrams(self, name):
        """Return the datagrams of a captured file."""
        (path,) = SAMPLES.glob(f"{name}.pcap*")
        return [
            WireDatagram(item.time_ns, item.source, item.destination, bytes(item.payload))
            for batch in open_file(path).batches()
            for item in batch
        ]

    def at(self, seconds, source, destination, payload):
        """Return one datagram."""
        return WireDatagram(START_NS + int(seconds * SECOND), source, destination, payload)

    def merged(self, sent, *more):
        """Return datagrams in order of time."""
        return sorted([*sent, *more], key=lambda item: item.time_ns)

    def network(self, seconds, kind, payload=b"", peer=BRIDGE):
        """Return an SBN datagram of the bridge to cFS."""
        return self.at(seconds, self.bridge, self.cfs, sbn.emit(kind, peer, payload))

    def event(self, seconds, app, number, message, kind=3):
        """Return an event on Telemetry Output's link, as if of the simulated cFS."""
        payload = cfe.EVENT.emit(
            {
                "app_name": app,
                "event_id": number,
                "event_type": kind,
                "spacecraft_id": 0x42,
                "processor_id": 1,
                "message": message,
            }
        )
        packet = cfe.emit_telemetry(
            cfe.EVENT_MSG_ID, payload, seconds=1_001_000 + int(seconds), sequence_flags=0
        )
        return self.at(seconds, Endpoint("127.0.0.1", 49152), self.ground, packet)


def msg_id_of(item):
    """Return the MsgId of a datagram, behind an SBN header or not."""
    data = item.payload
    if item.destination.port in {2234, 2235, 2236}:
        data = data[sbn.HEADER.size :] if data[2:3] == b"\x03" else b""
    return int.from_bytes(data[:2], "big") if len(data) >= 2 else -1


@pytest.fixture(scope="session")
def lab():
    return Lab()


@pytest.fixture(scope="session")
def msg_id():
    return msg_id_of


@pytest.fixture(scope="session")
def capture():
    """Return the diagnosis of a captured file, with or without its mission."""
    bench = Lab()

    @cache
    def diagnosis(name, *missions):
        packed = SAMPLES / f"{name}.pcap.gz"
        path = packed if packed.exists() else SAMPLES / f"{name}.pcap"
        return bench.read(path, bench.mission(*missions))

    return diagnosis
