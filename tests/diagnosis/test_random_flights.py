"""Random flights of the emulated cFS, and what the doctor says of them beside the emulator's own account."""

from __future__ import annotations

import pytest
from effort import examples
from hypothesis import given, settings
from scenarios import examined, flights, fly, replayed, truth
from truth import bounds, sums

from edoras_tools.addons.lab.emulator.account import LOST, socket
from edoras_tools.cfs import edoras_app
from edoras_tools.cfs.profile import SimProfile

CAUSES = {"limit", "socket"}
HOPS = {edoras_app.PIPE, socket(SimProfile().ci_port)}
UNSURE = 0.05
"""Of what counters cover so much may be told as given way to a newer one: which of two nothing shows."""


@settings(max_examples=examples(120))
@given(flights())
def test_what_is_proven_was_lost_and_what_counters_cover_is_told(flight):
    simulation, sent = fly(flight)
    result, (least, most) = examined(sent), truth(simulation, sent)
    assert sums(result) == []
    proven, more = bounds(result)
    assert proven <= most
    open_ = more + sum(result.get(name) or 0 for name in ("waiting", "not_captured"))
    assert least * (1 - UNSURE) <= proven + open_


@pytest.mark.quick("10-before", "60-by the first packet")
@pytest.mark.parametrize("enabled", ["before", "by the first packet"])
@pytest.mark.parametrize("hertz", [8, 10, 30, 60])
def test_what_a_replay_records_tells_what_was_lost(hertz, enabled):
    simulation, sent = replayed(hertz, 300, enabled_before=enabled == "before")
    result = examined(sent)
    first_ns = next(item.time_ns for item in sent if item.payload[:2] == b"\x08\x03")
    losses = [item for item in simulation.cfs.account.arrivals if item.end in LOST and item.hop in HOPS]
    # What the first 0x803 has already may be older than the recording.
    seen = sum(item.begin_ns > first_ns for item in losses)
    proven, more = bounds(result)
    assert seen <= proven + more
    assert proven <= len(losses)
    assert more <= 6
    assert bool(proven) == bool(losses) == (hertz > 8)
    assert {name for row in result["balance"] for name, lost in row["lost_by"].items() if lost} <= CAUSES
