"""The emulated cFS as a live source, with the missions and types to decode it."""

from __future__ import annotations

import time
from dataclasses import replace
from importlib.resources import as_file, files
from typing import TYPE_CHECKING

from edoras_tools.addons.lab.emulator import BOOT_NS, MISSIONS, Scenario, Simulation
from edoras_tools.addons.lab.emulator.source import RealTimeSource

if TYPE_CHECKING:
    from collections.abc import Callable

    from edoras_tools.pipelines.workbench import Settings, Workbench


def start_simulation(
    scenario: Scenario, settings: Settings, clock: Callable[[], int]
) -> tuple[RealTimeSource, Workbench]:
    """Boot an emulated cFS with its bridges and robots.

    Args:
        settings: missions and types; if no mission is named, the demo's own are used.
        clock: monotonic time in ns.

    Raises:
        ConfigError: a mission has errors.
    """
    if not settings.configs:
        with as_file(files("edoras_tools.samples")) as samples:
            paths = [samples / f"missions/{name}.yaml" for name in MISSIONS[scenario]]
            bench = replace(settings, configs=paths).workbench()
    else:
        bench = settings.workbench()
    simulation = Simulation(scenario=scenario, start_ns=time.time_ns() - BOOT_NS).boot()
    return RealTimeSource(simulation, clock), bench
