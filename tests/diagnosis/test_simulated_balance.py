"""Bursts and outages of the emulated cFS: what the balance says, held to what the emulator itself counted."""

from __future__ import annotations

import random

import pytest
from msgspec.structs import replace

from edoras_tools.addons.lab.emulator import Simulation
from edoras_tools.addons.lab.emulator.apps import generator
from edoras_tools.addons.lab.emulator.simulation import frames_of
from edoras_tools.cfs import telemetry_output
from edoras_tools.cfs.profile import SimProfile
from edoras_tools.diagnosis.examination import Examination
from edoras_tools.io.frames.linklayer import Demux
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe
from tests.support.balance import wrong_rows

QUICK = 12
ALL = 200
QUIET_S = 16
"""So long nothing is sent at the end: whatever waits in a socket is read, and 0x803 counts it."""


def run(seed, lab):
    """Return a simulation of one kind, with what it sent."""
    chance = random.Random(seed)
    scenario = chance.choice(["rover", "rover", "arm", "two-rovers", "two-arms"])
    profile = SimProfile(
        app_msg_limit=chance.choice([2, 4, 4, 8]),
        to_pipe_depth=chance.choice([12, 50, 50]),
        socket_queue=chance.choice([40, 256]),
        seed=seed,
    )
    if chance.random() < 0.5:
        profile = replace(profile, to_limits={**profile.to_limits, 0x8F1: chance.choice([4, 10, 255])})
    seconds = chance.randint(12, 25)
    hertz = chance.choice([1.0, 4.0, 9.0, 12.0, 20.0])
    simulation = Simulation(
        profile,
        scenario,
        start_ns=lab.start_ns,
        command_rate_hz=hertz,
        state_rate_hz=chance.choice([1.0, 4.0, 12.0]),
        command_count=int(hertz * (seconds - 4)),
    )
    at = 5.0
    for _ in range(chance.randint(0, 3)):
        rate, length = chance.choice([6, 20, 60, 200]), chance.uniform(0.3, 4)
        for when, value in ((at, rate), (at + length, 0)):
            payload = generator.set_command(0x8F1, value)
            packet = cfe.emit_command(generator.COMMAND_MSG_ID, 2, payload, sequence_flags=0)
            simulation.feed(lab.start_ns + int(when * SECOND), simulation.cfs.ci_endpoint, packet)
        at += length + chance.uniform(0.2, 3)
    sent = list(simulation.run(lab.start_ns + (seconds + QUIET_S) * SECOND))
    return simulation, sent


@pytest.mark.each(2)
@pytest.mark.quick("1", "6")
@pytest.mark.parametrize(
    "seed", [pytest.param(seed, marks=pytest.mark.long if seed >= QUICK else []) for seed in range(ALL)]
)
def test_the_sums_are_the_counters_of_the_emulator(seed, lab):
    simulation, sent = run(seed, lab)
    bench = Settings(configs=[]).workbench()
    examination = Examination(bench.columns.context)
    demux = Demux()
    for first in range(0, len(sent), 1000):
        batch = demux.demux(frames_of(sent[first : first + 1000], first + 1))
        examination.add(batch, bench.columns.decode(batch))
    found = examination.diagnose()
    assert wrong_rows(found.balance) == []
    (track,) = found.case.tracks.values()
    told = sum(row.lost.get("limit", 0) + row.lost.get("overflow", 0) for row in found.balance)
    unknown = sum(
        row.lost.get("unknown", 0)
        for row in found.balance
        if row.msg_id is None and row.hop == "software bus"
    )
    counted = track.growth("msg_limits") + track.growth("pipe_overflows")
    # What the emulator lost before its first 0x803 is older than the capture; what it lost behind its last is
    # told where sequence counts show it.
    older = sum(track.older[name] for name in ("msg_limits", "pipe_overflows"))
    counters = simulation.cfs.bus.counters
    assert counted <= told + unknown <= counters.msg_limits + counters.pipe_overflows - older
    by_msg_id = {}
    for (msg_id, _), number in simulation.cfs.bus.losses.items():
        by_msg_id[msg_id] = by_msg_id.get(msg_id, 0) + number
    for row in found.balance:
        if row.msg_id in by_msg_id and row.hop == telemetry_output.PIPE:
            lost = row.lost.get("limit", 0) + row.lost.get("overflow", 0)
            # What was lost behind the last message of a burst is shared with what others lost just then.
            assert lost == pytest.approx(by_msg_id[row.msg_id], rel=0.3, abs=24)
    assert sum(row.lost.get("after", 0) for row in found.balance) <= 2
    if simulation.cfs.profile.socket_queue == SimProfile().socket_queue:  # else the assumed size misleads
        assert sum(row.lost.get("network", 0) for row in found.balance) <= 2


def test_msg_ids_of_version_2_change_nothing_but_the_numbers(lab):
    """The same flight with both, by the same names: losses of commands, by limits and in the application."""
    told = []
    for headers in (cfe.WITH_EXTENDED, cfe.WITH_EXTENDED_2):
        sent, _ = lab.simulate("two-rovers", seconds=14, hz=12.0, headers=headers)
        bench = Settings(configs=lab.missions("two-rovers")).workbench().with_headers(headers)
        examination, batch = Examination(bench.columns.context), Demux().demux(frames_of(sent))
        examination.add(batch, bench.columns.decode(batch))
        found = examination.diagnose()
        known = headers.msg_ids.standard
        rows = [
            (known(row.msg_id), row.hop, row.name, row.came, row.lost)
            for row in found.balance
            if row.msg_id is not None
        ]
        told.append((sorted(rows, key=str), [item.rule for item in found.verdicts]))
    assert told[0] == told[1]
    assert sum(row.lost.get("limit", 0) for row in found.balance) > 40


@pytest.mark.parametrize("hertz", [10.0, 12.0, 20.0])
def test_what_pipes_lose_behind_the_last_count_is_in_the_range(hertz, lab):
    """Two robots share a counter, and each message is at two pipes that lose to the end."""
    sent, counters = lab.simulate("two-rovers", 20, hz=hertz, state_hz=hertz)
    found = lab.examine(sent)
    assert found.lost < counters.msg_limits <= found.lost + found.uncertain
    assert not wrong_rows(found.balance)
