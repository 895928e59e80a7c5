"""The account of an emulated run: its sums are what cFS itself counts, and keeping it changes nothing."""

from __future__ import annotations

from collections import Counter

import pytest
from effort import examples
from hypothesis import given, settings
from scenarios import START_NS, flights, fly

from edoras_tools.addons.lab.emulator import Simulation
from edoras_tools.addons.lab.emulator.account import socket
from edoras_tools.cfs import edoras_app, telemetry_output
from edoras_tools.cfs.queues import QueueEnd
from edoras_tools.units import SECOND


@settings(max_examples=examples(30, least=5))
@given(flights())
def test_its_sums_are_the_counters_of_the_emulator(flight):
    simulation, sent = fly(flight)
    account, cfs = simulation.cfs.account, simulation.cfs
    ends = Counter((item.hop, item.end) for item in account.arrivals)
    refused = Counter()
    for (hop, msg_id, end), number in account.losses().items():
        if end in {QueueEnd.MSG_LIMIT, QueueEnd.PIPE_OVERFLOW} and not hop.startswith("socket"):
            refused[msg_id, hop] += number
    assert refused == cfs.bus.losses
    counters = cfs.bus.counters
    assert refused.total() == counters.msg_limits + counters.pipe_overflows
    down = sum(item.destination == simulation.ground.endpoint for item in sent)
    assert ends[telemetry_output.PIPE, QueueEnd.DELIVERED] >= down
    ci = socket(flight.profile.ci_port)
    up = sum(item.destination == cfs.ci_endpoint for item in sent)
    assert sum(number for (hop, _), number in ends.items() if hop == ci) == up
    if not any(b"CI_LAB" in payload for *_, payload in flight.commands):
        assert ends[ci, QueueEnd.PIPE_OVERFLOW] == simulation.apps.ci.socket_drops
        assert ends[ci, QueueEnd.WAITING] == len(simulation.apps.ci.queue)
    for name, pipe in cfs.bus.pipes.items():
        assert ends[name, QueueEnd.WAITING] == len(pipe)
    assert all(
        (item.end_ns >= item.begin_ns) == (item.end is not QueueEnd.WAITING) for item in account.arrivals
    )


@pytest.mark.long
@settings(max_examples=3)
@given(flights())
def test_keeping_it_changes_nothing_that_is_sent(flight):
    assert fly(flight)[1] == fly(flight, with_account=False)[1]


def test_a_restart_of_the_processor_ends_what_waits_and_closes_the_ports():
    simulation = Simulation(start_ns=START_NS, command_rate_hz=10.0, command_count=100, with_account=True)
    list(simulation.run(START_NS + 8 * SECOND + 300_000_000))
    simulation.cfs.restart()
    list(simulation.run(START_NS + 30 * SECOND))
    losses = simulation.cfs.account.losses()
    closed = losses[socket(simulation.cfs.profile.ci_port), 0, QueueEnd.CLOSED]
    down = 10 * simulation.cfs.profile.boot_ns / SECOND
    assert min(down, 27) - 2 <= closed <= min(down, 27) + 7
    assert closed + losses[edoras_app.PIPE, 0x1827, QueueEnd.CLOSED] > 0
