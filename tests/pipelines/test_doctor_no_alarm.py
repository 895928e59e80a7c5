"""Where nothing is wrong nothing is said: clean demos for hours, one constant command."""

import pytest
from effort import LONG, long_but
from places import MISSIONS

from edoras_tools.addons.lab.emulator import Simulation, bridges
from edoras_tools.addons.lab.emulator.simulation import SimulatedSource
from edoras_tools.pipelines.doctor import examine
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.units import SECOND

CONSTANT = bridges.messages.twist(0.5, 0.1)
MINUTES = 6 * 60 if LONG else 2
DEMOS = {
    "rover": ("rover_ground",),
    "arm": ("single_arm_ground",),
    "two-rovers": ("two_rovers_ground", "two_rovers_flight"),
    "two-arms": ("two_arms_ground", "two_arms_flight"),
}


def diagnosed(seconds, hz, scenario):
    run = Simulation(scenario=scenario, command_rate_hz=hz, state_rate_hz=hz, start_ns=1_800_000_000 * SECOND)
    bench = Settings([MISSIONS / f"{name}.yaml" for name in DEMOS[scenario]]).workbench()
    return examine(SimulatedSource(run, int(seconds * SECOND)), bench).diagnosis


@pytest.mark.long
@pytest.mark.limit(3600)
@pytest.mark.parametrize("scenario", long_but(["arm", "two-rovers"], DEMOS))
def test_a_clean_demo_of_hours_has_no_verdict(scenario):
    found = diagnosed(60 * MINUTES, 4.0, scenario)
    assert found.datagrams > 500 * MINUTES
    assert [item.reason for item in found.verdicts] == []
    assert (found.lost, found.unaccounted, found.bad) == (0, 0, False)


@pytest.mark.quick("4.0")
@pytest.mark.parametrize("hz", [2.0, 4.0, 8.0])
def test_one_constant_twist_for_a_minute_has_no_verdict(hz, monkeypatch):
    monkeypatch.setattr(bridges.messages, "twist", lambda *_: CONSTANT)
    found = diagnosed(60, hz, "rover")
    assert [item.reason for item in found.verdicts] == []
    assert (found.lost, found.superseded, found.unaccounted, found.bad) == (0, 0, 0, False)
