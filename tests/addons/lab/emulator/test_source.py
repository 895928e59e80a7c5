"""A simulation read as a source: the same datagrams, in frames that everyone can read."""

from __future__ import annotations

import itertools
import tracemalloc

import pytest
from scapy.layers.inet import IP, UDP

from edoras_tools.addons.lab.emulator import SCENARIOS, Simulation
from edoras_tools.addons.lab.emulator.simulation import SimulatedSource
from edoras_tools.io.frames.frame_batch import frames_of
from edoras_tools.units import SECOND

START_NS = 1_795_000_000 * SECOND


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_every_datagram_comes_through_whole(scenario):
    expected = list(Simulation(scenario=scenario, start_ns=START_NS).run(START_NS + 4 * SECOND))
    source = SimulatedSource(Simulation(scenario=scenario, start_ns=START_NS), 4 * SECOND)
    batches = list(source.batches())
    found = [batch[row] for batch in batches for row in range(len(batch))]
    assert len(found) == len(expected) == source.statistics.datagrams > 10
    for number, (datagram, sent) in enumerate(zip(found, expected, strict=True), 1):
        assert datagram.number == number
        assert (datagram.time_ns, datagram.payload) == (sent.time_ns, sent.payload)
        assert (datagram.source, datagram.destination) == (sent.source, sent.destination)


def test_a_long_simulation_takes_no_memory_before_it_runs():
    simulation = Simulation(scenario="rover", start_ns=START_NS)
    tracemalloc.start()
    source = SimulatedSource(simulation, 100_000 * SECOND)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 100_000
    assert len(next(source.batches()))


def test_scapy_reads_the_frames():
    sent = list(
        itertools.islice(Simulation(scenario="two-rovers", start_ns=START_NS).run(START_NS + 2 * SECOND), 50)
    )
    frames = frames_of(sent, 7)
    assert frames.number.tolist() == list(range(7, 57))
    for at, size, item in zip(frames.offset.tolist(), frames.length.tolist(), sent, strict=True):
        packet = IP(frames.data[at : at + size].tobytes())
        again = IP(bytes(packet))
        assert (packet.src, packet[UDP].sport) == (item.source.address, item.source.port)
        assert (packet.dst, packet[UDP].dport) == (item.destination.address, item.destination.port)
        assert bytes(packet[UDP].payload) == item.payload
        del again.chksum, again[UDP].chksum
        again = IP(bytes(again))
        assert (packet.chksum, packet[UDP].chksum) == (again.chksum, again[UDP].chksum)
